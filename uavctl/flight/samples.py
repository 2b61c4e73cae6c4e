"""Which position samples count, and how many in a row were fresh. A sample that does not count is as good as lost."""

from __future__ import annotations

import math
from collections.abc import Sequence

import msgspec
import numpy as np
from msgspec.structs import replace

from uavctl.data import PositionSample, StepInput, VehicleStatus
from uavctl.flight.estimator import History, absorb, begin, belief_at, move_on
from uavctl.flight.kalman import Array, Belief, EstimatorParameters, Kalman, captured_ns, shown_by
from uavctl.flight.reach import JUMP, Reach, Suspect, doubt, judge, radius
from uavctl.flight.stuck import FROZEN, Watches, observe, stuck

INVALID = "sample-invalid"
FUTURE = "sample-future"

# How far a stamp may lie after the arrival: clocks over a link are known to milliseconds, and a stamp that is
# further off says nothing of the capture. A constant, as a tick may be of any length.
STAMP_TOLERANCE_NS = 20_000_000

# A plan bridges H steps; a sample that used up no more than this part of them on its way leaves it most of them.
_FRESH_PART = 3


class Trust(msgspec.Struct, frozen=True, eq=False):
    """What is known of the sources.

    Attributes:
        suspect: Samples that the vehicle cannot have come to and that agree; None without any.
        doubt_mps: How wrong the velocity may be, each axis of the plant [m/s]; None before it was held against one.
        watches: What each source has said.
    """

    suspect: Suspect | None = None
    doubt_mps: Array | None = None
    watches: Watches = msgspec.field(default_factory=dict)


class Intake(msgspec.Struct, frozen=True, eq=False):
    """What came of a tick's samples.

    Attributes:
        history: The estimator with them.
        trust: What is known of the sources.
        moved: A source has moved: positions are not to be believed any more.
        accepted: Number of samples taken.
        refused: Reason (an event's code) for each one that was not.
        fresh: Fresh samples in a row, up to now.
    """

    history: History
    trust: Trust
    moved: bool
    accepted: int
    refused: tuple[str, ...]
    fresh: int


def take(
    kalman: Kalman, reach: Reach, history: History, trust: Trust, inp: StepInput, horizon: int, fresh: int
) -> Intake:
    """Check a tick's samples and give them to the estimator.

    A sample is fresh if it is newer than all before and at most H/3 steps (at least one) old when a tick takes it:
    what a link with a steady delay, or a camera slower than Δt, does in TRACK is enough for the way back. A newer
    one that is older than that breaks the row, and so does a boundary at which the age reaches H: no plan bridges that.
    Here this is seen of boundaries between two captures (their ticks may have been missed), in `step` of the last one.

    Args:
        kalman: The filter.
        reach: Where the vehicle can be.
        history: The estimator before.
        trust: What is known of the sources, before.
        inp: The tick's input.
        horizon: H, the steps that a plan bridges.
        fresh: Fresh samples in a row, before.
    """
    newest_ns = history.captured_ns
    history = move_on(kalman, history, inp.at_ns)
    accepted = 0
    refused: tuple[str, ...] = ()
    if inp.samples:
        history, trust, taken, refused = _believe(kalman, reach, history, trust, inp)
        accepted, fresh = len(taken), _fresh_in_row(kalman, history, newest_ns, inp.at_ns, taken, horizon, fresh)
    return Intake(
        history=history,
        trust=trust,
        moved=trust.suspect is not None and trust.suspect.moved(reach.parameters),
        accepted=accepted,
        refused=refused,
        fresh=fresh,
    )


def forget(kalman: Kalman, intake: Intake, at_ns: int) -> Intake:
    """Forget all positions: estimator and trust as they begin, at `at_ns`."""
    history = begin(kalman, intake.history.origin_ns, at_ns)
    return replace(intake, history=history, trust=Trust(), moved=False, fresh=0)


def _fresh_in_row(
    kalman: Kalman,
    history: History,
    newest_ns: int | None,
    now_ns: int,
    taken: Sequence[PositionSample],
    horizon: int,
    fresh: int,
) -> int:
    """Fresh samples in a row with those of a tick at `now_ns`, before which the newest was captured at `newest_ns`."""
    dt_ns = kalman.propagation.dt_ns
    late_ns = max(dt_ns, horizon * dt_ns // _FRESH_PART)
    for at_ns in sorted(map(captured_ns, taken)):
        if newest_ns is None or at_ns > newest_ns:
            boundary_ns = at_ns - 1 - (at_ns - 1 - history.origin_ns) % dt_ns  # the last one before the capture
            in_row = newest_ns is not None and boundary_ns - newest_ns < horizon * dt_ns
            fresh = (fresh + 1 if in_row else 1) if now_ns - at_ns <= late_ns else 0
            newest_ns = at_ns
    return fresh


def _believe(
    kalman: Kalman, reach: Reach, history: History, trust: Trust, inp: StepInput
) -> tuple[History, Trust, list[PositionSample], tuple[str, ...]]:
    """Give samples to the estimator in the order of their capture, each after it is held against what is known."""
    reasons = [refusal(sample, inp.at_ns, kalman.parameters) for sample in inp.samples]
    valid = [sample for sample, reason in zip(inp.samples, reasons, strict=True) if reason is None]
    refused = [reason for reason in reasons if reason is not None]
    taken: list[PositionSample] = []
    for sample in sorted(valid, key=captured_ns):
        at_ns = captured_ns(sample)
        belief = belief_at(kalman, history, at_ns) if at_ns > history.horizon_ns else None
        if belief is not None:  # else it is the first one, or too old
            trust, reason = _distrust(kalman, reach, history, trust, inp, sample, belief)
            if reason is not None:
                refused.append(reason)
                continue
        history, one, why = absorb(kalman, history, inp.at_ns, (sample,), belief)
        taken.extend(one)
        refused.extend(why)
    return history, trust, taken, tuple(refused)


def _distrust(
    kalman: Kalman,
    reach: Reach,
    history: History,
    trust: Trust,
    inp: StepInput,
    sample: PositionSample,
    belief: Belief,
) -> tuple[Trust, str | None]:
    """What is known of the sources with one more sample, and why it is not believed (None if it is).

    `belief` is the prediction for the sample's capture time.
    """
    at_ns = captured_ns(sample)
    values, variances = shown_by(kalman, sample)
    off = values - belief.mean[kalman.shown[: len(values)]]
    n_axes = len(kalman.axes)
    watches = observe(trust.watches, kalman, history, sample, off[:n_axes])
    trust = replace(trust, watches=watches)
    watch = watches[sample.source]
    newest = watch.at_ns == at_ns
    if newest and _flies(inp.vehicle) and stuck(watch, kalman, sample, reach.parameters):
        return replace(trust, watches={**watches, sample.source: replace(watch, found=True)}), FROZEN
    doubted = np.zeros(n_axes) if trust.doubt_mps is None else trust.doubt_mps
    width = radius(reach, kalman, belief, variances, doubted)
    believed, suspect = judge(trust.suspect, at_ns, off, width, n_axes)
    if believed and at_ns > (history.captured_ns or at_ns):
        trust = replace(trust, doubt_mps=doubt(reach, belief, off[:n_axes]))
    if not believed and newest and watch.repeats:
        return trust, FROZEN  # a value that came before did not jump
    return replace(trust, suspect=suspect), None if believed else JUMP


def _flies(vehicle: VehicleStatus | None) -> bool:
    """Whether the vehicle moves on its own, as far as it is known; one that is on the ground may stand still."""
    return vehicle is None or (vehicle.armed and not vehicle.landed)


def refusal(sample: PositionSample, at_ns: int, parameters: EstimatorParameters) -> str | None:
    """Why a sample does not count, as an event's code; None if it does.

    Args:
        sample: The sample, after frame and clock conversion.
        at_ns: The tick that takes it [ns].
        parameters: Largest plausible position and velocity.
    """
    if not _plausible(sample.position_m, parameters.max_position_m):
        return INVALID
    if sample.velocity_mps is not None and not _plausible(sample.velocity_mps, parameters.max_velocity_mps):
        return INVALID
    # A standard deviation beyond the largest position says nothing, and its square may overflow.
    if not 0.0 < sample.std_m <= parameters.max_position_m:
        return INVALID
    if sample.received_ns > at_ns or sample.captured_ns > sample.received_ns + STAMP_TOLERANCE_NS:
        return FUTURE
    return None


def _plausible(values: tuple[float, float, float], limit: float) -> bool:
    return all(math.isfinite(value) and abs(value) <= limit for value in values)
