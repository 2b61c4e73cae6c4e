"""Monitor: positions that the vehicle cannot have come to. Is it an outlier, or has the source moved?

1. The gate is a box around the prediction. Its half-width is what inputs anywhere inside their limits, instead of those
   that are known, can have done since the newest sample; some standard deviations of the prediction and the sample; and
   a margin, as gusts are stronger than any model of them. It grows with silence, so nothing true is refused after it.
2. A sample outside the gate is refused: distrust this position.
3. That growth would let a source that jumped in again. So as long as refused samples agree about their offset, a sample
   nearer to them than to the prediction is refused too.
4. Two of them, 0.1 s apart: brake (`uavctl.flight.supervise`). Three, over `jump_ns`: the source has moved. Then: end
   the plans.

False alarms (docs/soak.md): no position of 200 missions was refused.
"""

from __future__ import annotations

from dataclasses import dataclass

import msgspec
import numpy as np

from uavctl.arrays import Array
from uavctl.event_codes import EventCode
from uavctl.flight.kalman import Belief, Kalman
from uavctl.flight.limits import LimitsParameters
from uavctl.flight.monitors.verdict import NO_VERDICT, Action, Verdict
from uavctl.smpc.plant import AXES, Plant

_SAMPLES = 3  # samples that agree make a jump; two may be a chance,
_SUSPECT_SAMPLES, _SUSPECT_NS = 2, 100_000_000  # but so long apart they are reason enough to brake
_HORIZONS = 2  # the vehicle may be anywhere after that many horizons of silence


@dataclass(frozen=True)
class GateParameters:
    """Parameters of the gate for positions."""

    sigma: float  # half-width of the gate in standard deviations, beside what inputs can do
    margin_m: float  # added half-width, for gusts and other disturbances that no model has [m]
    jump_ns: int  # time for which refused samples agree before the source has moved [ns]
    # Below this speed, by its own velocity, a vehicle may be where it was; 0 where its velocity proves nothing
    at_rest_mps: float = 0.0


@dataclass(frozen=True, eq=False)
class Reach:
    """Largest changes that inputs can make, by the time since a sample; constant."""

    parameters: GateParameters  # its size in standard deviations, and the time of a jump
    tick_ns: int  # time between the rows of `max_change` [ns]
    # (n, n_values): largest change of positions, then velocities, that inputs can make in so many ticks
    max_change: Array


@dataclass(frozen=True, eq=False)
class OutlierTrack:
    """Refused samples that agree."""

    first_ns: int  # capture time of the first one [ns]
    last_ns: int  # that of the last one
    count: int  # how many they are
    offset_m: Array  # position of the last one minus the prediction, each axis of the plant [m]

    @property
    def is_likely(self) -> bool:
        """Whether the source may well have moved: no plan is flown meanwhile."""
        return self.count >= _SUSPECT_SAMPLES and self.last_ns - self.first_ns >= _SUSPECT_NS

    def has_moved(self, parameters: GateParameters) -> bool:
        """Whether chance is ruled out: the source has moved, or the estimate is lost."""
        return self.count >= _SAMPLES and self.last_ns - self.first_ns >= parameters.jump_ns


def make_reach(
    plant: Plant, limits: LimitsParameters, parameters: GateParameters, tick_ns: int, ticks_per_horizon: int
) -> Reach:
    """Make the reach of a plant whose inputs pass the setpoint limiter."""
    a, b, _ = plant.transition(tick_ns * 1e-9)
    bounds = np.array([limits.accel_mps2[AXES.index(axis)] for axis in plant.axes])
    largest = np.abs(np.linalg.pinv(plant.accel_map)) @ bounds
    shown = list(plant.position_index + plant.velocity_index)
    max_change, effect = [np.zeros(len(shown))], b
    # Δy(k) = Σ |C A^i B| 2 u_max: from one limit to the other
    for _ in range(_HORIZONS * ticks_per_horizon):
        max_change.append(max_change[-1] + np.abs(effect[shown]) @ (2.0 * largest))
        effect = a @ effect
    return Reach(parameters=parameters, tick_ns=tick_ns, max_change=np.array(max_change))


class OutlierObservation(msgspec.Struct, frozen=True, eq=False):
    """A sample beside its prediction."""

    at_ns: int  # its capture time [ns]
    offset: Array  # its values minus those predicted
    width: Array  # half-width of the gate for each
    n_axes: int  # number of positions among them, which come first


def compute_gate(reach: Reach, kalman: Kalman, belief: Belief, variances: Array, velocity_error_mps: Array) -> Array:
    """Compute the half-width of the gate for each value of a sample.

    Args:
        belief: The prediction for the sample's capture time.
        velocity_error_mps: Of the prediction (n_axes,), see `bound_velocity_error`.
    """
    values = slice(len(variances))
    age_s = (belief.at_ns - belief.captured_ns) * 1e-9
    # w = σ √(H P H' + R) + Δy(age) + (margin + e age, e)
    offset_std: Array = np.sqrt(belief.cov.diagonal()[kalman.measured_index[values]] + variances)
    beside_inputs = np.concatenate((reach.parameters.margin_m + velocity_error_mps * age_s, velocity_error_mps))
    return reach.parameters.sigma * offset_std + (_find_max_change(reach, belief) + beside_inputs)[values]


def bound_velocity_error(reach: Reach, belief: Belief, offset_m: Array) -> Array:
    """Bound the error of the velocity (n_axes,) [m/s] after a sample `offset_m` away from its prediction counted.

    A filter that knows its inputs takes the offset for a velocity that disturbances made. Inputs that it does not know
    may have made the position and none of that velocity, up to `Reach.max_change`.
    """
    age_ns = belief.at_ns - belief.captured_ns
    if not age_ns:
        return np.zeros(len(offset_m))
    # e = min(2 |ν| / age, Δv(age))
    max_velocity_change = _find_max_change(reach, belief)[len(offset_m) :]
    error: Array = np.minimum(2.0 * np.abs(offset_m) / (age_ns * 1e-9), max_velocity_change)
    return error


def _find_max_change(reach: Reach, belief: Belief) -> Array:
    """Return the change of positions, then velocities, that inputs can have made since a belief's newest sample."""
    ticks = -(-(belief.at_ns - belief.captured_ns) // reach.tick_ns)
    return reach.max_change[ticks] if ticks < len(reach.max_change) else np.full(reach.max_change.shape[1], np.inf)


_DISTRUSTED = Verdict(Action.DISTRUST_POSITIONS, EventCode.SAMPLE_JUMP)


def update(track: OutlierTrack | None, observation: OutlierObservation) -> tuple[OutlierTrack | None, Verdict]:
    """Take a sample; the verdict is about this sample alone.

    Args:
        track: Refused samples that agree; None for none.
    """
    at_ns, n_axes = observation.at_ns, observation.n_axes
    offset_m, width = observation.offset[:n_axes], observation.width
    is_inside = bool((np.abs(observation.offset) <= width).all())
    if track is None:
        return (None, NO_VERDICT) if is_inside else (OutlierTrack(at_ns, at_ns, 1, offset_m), _DISTRUSTED)
    apart_m = offset_m - track.offset_m
    # |ν - ν_refused|² ≥ |ν|²: nearer to the prediction
    if is_inside and float(apart_m @ apart_m) >= float(offset_m @ offset_m):
        return track if at_ns < track.last_ns else None, NO_VERDICT
    if at_ns <= track.last_ns:
        return track, _DISTRUSTED
    if (np.abs(apart_m) <= width[:n_axes]).all():
        return OutlierTrack(track.first_ns, at_ns, track.count + 1, offset_m), _DISTRUSTED
    return OutlierTrack(at_ns, at_ns, 1, offset_m), _DISTRUSTED
