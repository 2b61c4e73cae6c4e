"""Outliers: a position that the vehicle cannot have come to is refused, and a source that moved is found.

The set around the prediction is what inputs anywhere inside their limits, instead of those that are known, can have
done since the newest sample, some standard deviations of the prediction and the sample, and a margin: gusts are
stronger than any model of them. It grows with silence, so that nothing true is refused after it.

A source that jumps would be let in again by that growth. So as long as refused samples agree about how far they are
off, a sample that is nearer to them than to the prediction is refused too.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uavctl.flight.kalman import Array, Belief, Kalman
from uavctl.flight.limits import LimitsParameters
from uavctl.smpc.plant import AXES, Plant

JUMP = "sample-jump"

_SAMPLES = 3  # that agree make a jump; two may be a chance,
_SUSPECT_SAMPLES, _SUSPECT_NS = 2, 100_000_000  # and so long apart are reason enough to brake until it is known
_HORIZONS = 2  # the vehicle may be anywhere after that many horizons of silence


@dataclass(frozen=True)
class GateParameters:
    """How far positions are believed."""

    sigma: float  # half-width of the set in standard deviations, beside what inputs can do
    margin_m: float  # and beside both, for what no model says [m]
    jump_ns: int  # time for which refused samples agree before the source counts as moved [ns]
    # Below this speed, by its own word, a vehicle may be where it was; 0 where its word proves nothing
    at_rest_mps: float = 0.0


@dataclass(frozen=True, eq=False)
class Reach:
    """The reachable set; constant."""

    parameters: GateParameters  # its size in standard deviations, and the time of a jump
    tick_ns: int  # time between the rows of `far` [ns]
    # (n, n_shown): how far inputs can have carried what a sample shows (positions, then velocities) from the prediction
    # in that many ticks
    far: Array


@dataclass(frozen=True, eq=False)
class OutlierTrack:
    """Refused samples that agree."""

    first_ns: int  # capture time of the first one [ns]
    last_ns: int  # that of the last one
    count: int  # how many they are
    offset_m: Array  # position of the last one minus the prediction, each axis of the plant [m]

    @property
    def likely(self) -> bool:
        """Whether the source may well have moved: nothing is flown on what is left of it."""
        return self.count >= _SUSPECT_SAMPLES and self.last_ns - self.first_ns >= _SUSPECT_NS

    def moved(self, parameters: GateParameters) -> bool:
        """Whether this is no chance any more: the source has moved, or the estimate is lost."""
        return self.count >= _SAMPLES and self.last_ns - self.first_ns >= parameters.jump_ns


def make_reach(
    plant: Plant, limits: LimitsParameters, parameters: GateParameters, tick_ns: int, ticks_per_horizon: int
) -> Reach:
    """The set of a plant whose inputs are what the last gate lets through."""
    a, b, _ = plant.transition(tick_ns * 1e-9)
    bounds = np.array([limits.accel_mps2[AXES.index(axis)] for axis in plant.axes])
    largest = np.abs(np.linalg.pinv(plant.accel_map)) @ bounds
    shown = list(plant.position_index + plant.velocity_index)
    far, effect = [np.zeros(len(shown))], b
    for _ in range(_HORIZONS * ticks_per_horizon):
        far.append(far[-1] + np.abs(effect[shown]) @ (2.0 * largest))  # from one limit to the other
        effect = a @ effect
    return Reach(parameters=parameters, tick_ns=tick_ns, far=np.array(far))


def radius(reach: Reach, kalman: Kalman, belief: Belief, variances: Array, doubt_mps: Array) -> Array:
    """Half-width of the set for each value that a sample shows.

    Args:
        belief: The prediction for the sample's capture time.
        doubt_mps: Of the prediction's velocity (n_axes,), see `doubt`.
    """
    values = slice(len(variances))
    age_s = (belief.at_ns - belief.captured_ns) * 1e-9
    spread: Array = np.sqrt(np.diagonal(belief.cov)[kalman.shown[values]] + variances)
    doubted = np.concatenate((reach.parameters.margin_m + doubt_mps * age_s, doubt_mps))
    return reach.parameters.sigma * spread + (_far(reach, belief) + doubted)[values]


def doubt(reach: Reach, belief: Belief, off_m: Array) -> Array:
    """How wrong the velocity may be (n_axes,) [m/s] once a sample that was `off_m` the prediction has been believed.

    A filter that knows its inputs takes what is off for a velocity that disturbances made; inputs that it does not know
    of may have made the position and none of that velocity, as far as they can.
    """
    age_ns = belief.at_ns - belief.captured_ns
    if not age_ns:
        return np.zeros(len(off_m))
    made: Array = np.minimum(2.0 * np.abs(off_m) / (age_ns * 1e-9), _far(reach, belief)[len(off_m) :])
    return made


def _far(reach: Reach, belief: Belief) -> Array:
    """How far inputs can have carried positions, then velocities, since the newest sample of a belief."""
    ticks = -(-(belief.at_ns - belief.captured_ns) // reach.tick_ns)
    return reach.far[ticks] if ticks < len(reach.far) else np.full(reach.far.shape[1], np.inf)


def judge(
    suspect: OutlierTrack | None, at_ns: int, off: Array, width: Array, n_axes: int
) -> tuple[bool, OutlierTrack | None]:
    """Whether a sample may count, and who is suspected after it.

    Args:
        at_ns: Capture time of the sample [ns].
        off: The sample's values minus those predicted.
        width: Half-width of the set for each.
        n_axes: Number of positions among them, which come first.
    """
    offset_m = off[:n_axes]
    inside = bool((np.abs(off) <= width).all())
    if suspect is None:
        return inside, None if inside else OutlierTrack(at_ns, at_ns, 1, offset_m)
    apart_m = offset_m - suspect.offset_m
    if inside and float(apart_m @ apart_m) >= float(offset_m @ offset_m):
        return True, suspect if at_ns < suspect.last_ns else None
    if at_ns <= suspect.last_ns:
        return False, suspect
    if (np.abs(apart_m) <= width[:n_axes]).all():
        return False, OutlierTrack(suspect.first_ns, at_ns, suspect.count + 1, offset_m)
    return False, OutlierTrack(at_ns, at_ns, 1, offset_m)
