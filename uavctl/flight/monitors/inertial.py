"""Monitor: inertial data against the model, positions and the vehicle's own velocity. May they be used?

1. A reading further than 3 σ from the filter's prediction is left out. Three in a row are distrusted.
2. A position far from where inertial data carried the estimate: they are distrusted.
3. A velocity that they carried on differs from the vehicle's own, which may be believed: they are distrusted.
4. Distrust ends with a position that agrees, three seconds later at the earliest. Where the model alone was the reason,
   and the vehicle's own velocity changes as they do, it is wind: then a silence is no reason to brake.

A late sample changes what came after it, so the filter keeps this state in each belief (`uavctl.flight.kalman`).

False alarms cost little: the model alone flies, as in a vehicle without inertial data. Chance alone makes 1e-8 of
positions inconsistent. A take-off often makes one false alarm, from the shock of leaving the ground.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum, auto

import msgspec
from msgspec.structs import replace

from uavctl.event_codes import EventCode
from uavctl.flight.monitors.verdict import NO_VERDICT, Action, Verdict

# Twenty readings come in a second, so one that is left out for nothing costs next to nothing.
PLAUSIBLE_SIGMA = 3.0  # standard deviations in each axis
MOST_REFUSED = 3  # readings in a row that are left out
MOST_CHI2 = 40.0  # squared distance of a position by its covariance; three axes exceed it with a chance of 1e-8
DISTRUST_NS = 3_000_000_000  # least time of distrust
# An agreement says something only so shortly after the position before. After a silence nearly every position agrees.
CONSISTENT_NS = 1_000_000_000


class ComparedSource(Enum):
    """Source that inertial data are compared with."""

    MODEL = auto()
    POSITION = auto()
    VEHICLE_VELOCITY = auto()


class InertialTrust(msgspec.Struct, frozen=True):
    """State of the monitor."""

    used_ns: int | None = None  # time of the newest reading that was used [ns]; None without any
    refused: int = 0  # readings in a row that were left out
    distrusted_ns: int | None = None  # since when they are distrusted [ns]; None while they are used


class InertialObservation(msgspec.Struct, frozen=True):
    """Comparison of inertial data with another source."""

    source: ComparedSource
    is_consistent: bool
    at_ns: int  # time of the comparison [ns]
    captured_ns: int  # capture time of the newest position before it [ns]


UNUSED = InertialTrust()


def update(trust: InertialTrust, observation: InertialObservation) -> tuple[InertialTrust, Verdict]:
    """Take one comparison."""
    at_ns = observation.at_ns
    if trust.distrusted_ns is not None:
        return _update_distrusted(trust, trust.distrusted_ns, observation), NO_VERDICT
    if observation.source is ComparedSource.MODEL:
        if observation.is_consistent:
            return InertialTrust(used_ns=at_ns), NO_VERDICT
        trust = replace(trust, refused=trust.refused + 1)
        return _distrust(trust, at_ns) if trust.refused >= MOST_REFUSED else (trust, NO_VERDICT)
    carried_on = trust.used_ns is not None and trust.used_ns > observation.captured_ns
    if observation.is_consistent or not carried_on:
        return trust, NO_VERDICT
    return _distrust(trust, at_ns)


def _update_distrusted(trust: InertialTrust, since_ns: int, observation: InertialObservation) -> InertialTrust:
    if observation.source is not ComparedSource.POSITION or not observation.is_consistent:
        return trust
    is_close = observation.at_ns - observation.captured_ns <= CONSISTENT_NS
    if is_close and observation.at_ns - since_ns >= DISTRUST_NS:
        return InertialTrust(used_ns=trust.used_ns)
    return trust


def contradict_model_alone(trust: InertialTrust) -> bool:
    """Whether inertial data are distrusted, and the model was the reason."""
    return trust.distrusted_ns is not None and trust.refused >= MOST_REFUSED


def _distrust(trust: InertialTrust, at_ns: int) -> tuple[InertialTrust, Verdict]:
    verdict = Verdict(Action.DISTRUST_INERTIAL, EventCode.INERTIAL_DOUBTED, since_ns=at_ns)
    return replace(trust, distrusted_ns=at_ns), verdict


def is_plausible(innovation: Sequence[float], variances: Sequence[float]) -> bool:
    """Whether no axis of a reading is too far from its prediction."""
    # ν_i² ≤ 3² S_ii
    return all(v * v <= PLAUSIBLE_SIGMA**2 * s for v, s in zip(innovation, variances, strict=True))


def is_consistent(chi2: float) -> bool:
    """Whether a position's squared distance by its covariance, ν' S⁻¹ ν, is no larger than chance makes it."""
    return not chi2 > MOST_CHI2
