"""Monitor: do positions move otherwise than the vehicle says it does?

1. At each position the offset is noted: the position minus the distance by the vehicle's own velocity.
2. The slope of the offsets over a second or so is the difference of both velocities. Stamps that are late explain a
   part that is the acceleration times the delay. What is left is compared with its bound. Then: end the plans.
3. The mean offsets of half a minute show a frame that creeps: their change is compared with a bound that grows with
   time. Smoothing in a camera system explains a part: one delay for all, times the change of the velocity. Then: end
   the plans.
4. Velocities contradicted each other, and then no position came for 0.6 s. Then: end the plans.
5. While positions that have come back correct the vehicle's own velocity, no difference counts.

False alarms (docs/soak.md): 0 of 200 missions, with a bound of 0.255 m/s. The largest difference was 0.036 m/s.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from operator import itemgetter

import msgspec
import numpy as np
from msgspec.structs import replace

from uavctl.arrays import Array
from uavctl.event_codes import EventCode
from uavctl.flight.monitors.motion import PositionObservation, TickObservation, find_distance
from uavctl.flight.monitors.noise import USUAL_STD_M
from uavctl.flight.monitors.observation import EnvelopeParameters, describe_vector
from uavctl.flight.monitors.verdict import NO_VERDICT, Verdict, end_plans
from uavctl.records import Vector

PERSISTS_NS = 100_000_000  # time for which a difference has to last, over two positions at least
PLAIN = 1.5  # this many times the bound is beyond it at once
# In a silence of more than a second a vehicle flies by its own sensors. Positions that come then correct its own
# velocity, which is wrong for this time: by up to 1.0 m/s for 0.8 s after 4 s, in flights.
CORRECTS_NS = 1_000_000_000
UNRESOLVED_NS = 600_000_000  # longest time without positions after a contradiction
LATE_S = 0.15  # largest difference between the delays of positions and of the vehicle's own velocity
SMOOTHED_S = 0.3  # the same with smoothing inside a camera system, which makes positions follow late
SHORTEST = 0.3  # of the window: over less, two velocities are not compared
PLACES_NS, PLACE_NS = 30_000_000_000, 1_000_000_000  # mean offsets are compared over so long, one for each such time
# Of the disagreement: the bound of a change of offset begins with so many seconds of it, and grows by such a part.
DRIFT_S, DRIFT_PART = 2.0, 0.16
LEAST_PLACES = 4  # that tell a drift from the delay of smoothing
LEAST_OFFSETS = 3  # for a slope
NOISE_SIGMA = 4.0  # standard deviations of a slope that chance may make
_TIME = itemgetter(0)  # of pairs that begin with their time, oldest first

Offsets = tuple[
    tuple[int, Vector], ...
]  # (capture time [ns], position minus the vehicle's own distance (3,)), in order

Places = tuple[tuple[int, Vector, Vector], ...]  # (at_ns, mean offset (3,), own velocity (3,)) over the window


class VelocityState(msgspec.Struct, frozen=True, eq=False):
    """State of the monitor."""

    offsets: Offsets = ()  # of the window
    places: Places = ()  # means of the offsets, one for each second or so
    apart_mps: float | None = None  # difference of both velocities when last compared; None where it is not known
    is_contradicted: bool = False  # whether it was beyond its bound when last compared
    # Capture time from which it has been beyond its bound, as far as it counts [ns]; None while it is not
    apart_ns: int | None = None

    def agrees(self, parameters: EnvelopeParameters) -> bool:
        """Whether no difference beyond the bound is known."""
        return (self.apart_mps or 0.0) <= parameters.disagreement_mps


def update(state: VelocityState, observation: PositionObservation) -> tuple[VelocityState, Verdict]:
    """Take a position.

    Where the unexplained acceleration hints at something amiss, a difference need not last.
    """
    at_ns, path, parameters = observation.at_ns, observation.motion.vehicle_path, observation.parameters
    offsets = _add_offset(state.offsets, observation)
    points = np.array([point for _, point in offsets])
    slope = _fit_slope(offsets, points, parameters)
    if slope is None:
        # Over a gap the vehicle's own distance is not known so well.
        places = state.places if len(offsets) > 1 else ()
        return replace(state, offsets=offsets, places=places, apart_mps=None, apart_ns=None), NO_VERDICT
    resumed_ns = observation.motion.resumed_ns
    corrects = resumed_ns is not None and at_ns - parameters.window_ns < resumed_ns + CORRECTS_NS
    drift, places = (None, ()) if corrects else _find_drift(state.places, offsets, points, path, parameters)
    apart = _remove_delay(slope, path, offsets)
    apart_mps = math.hypot(*apart)
    bound_mps = parameters.disagreement_mps + _bound_noise_mps(offsets, observation.std_m)
    is_contradicted = apart_mps > bound_mps
    apart_ns = (state.apart_ns or at_ns) if is_contradicted and not corrects else None
    state = VelocityState(offsets, places, apart_mps, is_contradicted, apart_ns)
    plain = observation.is_hinted or apart_mps >= PLAIN * bound_mps
    if apart_ns is not None and (plain or at_ns - apart_ns >= PERSISTS_NS):
        text = f"positions move otherwise than the vehicle itself says, by {describe_vector(apart)} m/s"
        return state, end_plans(EventCode.VELOCITY, text)
    if drift is not None:
        s, off = drift
        text = f"positions have come {describe_vector(off)} m away from the vehicle's own way in {s:.0f} s"
        return state, end_plans(EventCode.VELOCITY, text)
    return state, NO_VERDICT


def update_silence(state: VelocityState, observation: TickObservation) -> tuple[VelocityState, Verdict]:
    """Take a tick, after its positions: has a contradiction been left open for too long?"""
    at_ns = observation.tick.at_ns
    if len(observation.motion.vehicle_path) < 2 and (
        state.offsets or state.places
    ):  # the distance has begun anew, or is unknown
        state = replace(state, offsets=(), places=())
    if state.apart_ns is None or at_ns - state.apart_ns < UNRESOLVED_NS:
        return state, NO_VERDICT
    text = "positions moved otherwise than the vehicle itself says, and none has come since"
    return state, end_plans(EventCode.VELOCITY, text)


def _add_offset(offsets: Offsets, observation: PositionObservation) -> Offsets:
    at_ns, distance = observation.at_ns, find_distance(observation.motion.vehicle_path, observation.at_ns)
    if distance is None:
        return ()
    since_ns = at_ns - observation.parameters.window_ns
    kept = (one for one in offsets if one[0] > since_ns)
    offset = tuple(p - s for p, s in zip(observation.position.tolist(), distance, strict=True))
    return (*kept, (at_ns, offset))


def _find_drift(
    places: Places,
    offsets: Offsets,
    points: Array,
    path: tuple[tuple[int, Vector], ...],
    parameters: EnvelopeParameters,
) -> tuple[tuple[float, list[float]] | None, Places]:
    """Find the time [s] in which offsets changed too much, and the change (3,) [m]; return too the places after it."""
    at_ns = sum(one[0] - offsets[0][0] for one in offsets) // len(offsets) + offsets[0][0]
    # ō = Σ o_i / n
    mean: Array = np.add.reduce(points, axis=0) / len(offsets)
    place: list[float] = mean.tolist()
    places = places[bisect_right(places, at_ns - PLACES_NS, key=_TIME) :]
    velocity = _find_mean_velocity(path, offsets)
    late_s = _find_delay_s((*places, (at_ns, tuple(place), velocity)))
    for since_ns, before, velocity_before in places:
        s, off = (at_ns - since_ns) * 1e-9, [now - then for now, then in zip(place, before, strict=True)]
        change_mps = [now - then for now, then in zip(velocity, velocity_before, strict=True)]
        # Δo + τ Δv
        pair_late_s = _bound_delay_s(off, change_mps) if late_s is None else late_s
        off = [o + pair_late_s * v for o, v in zip(off, change_mps, strict=True)]
        # |ō - ō_0| > (2 s + 0.16 s) v_max
        if math.hypot(*off) > (DRIFT_S + DRIFT_PART * s) * parameters.disagreement_mps:
            return (s, off), places
    if not places or at_ns - places[-1][0] >= PLACE_NS:
        places = (*places, (at_ns, tuple(place), velocity))
    return None, places


def _find_mean_velocity(path: tuple[tuple[int, Vector], ...], offsets: Offsets) -> Vector:
    """Find the vehicle's own mean velocity (3,) [m/s] over the window; zero where it is not known."""
    (begin_ns, _), (end_ns, _) = offsets[0], offsets[-1]
    begin, end = find_distance(path, begin_ns), find_distance(path, end_ns)
    if begin is None or end is None:
        return 0.0, 0.0, 0.0
    # v̄ = (s_1 - s_0) / T
    return tuple((s_1 - s_0) / ((end_ns - begin_ns) * 1e-9) for s_0, s_1 in zip(begin, end, strict=True))


def _bound_delay_s(off: list[float], change_mps: list[float]) -> float:
    """Return the delay [s] by which smoothing may explain most of a change of offsets (3,) by that of the velocity."""
    along = sum(v * v for v in change_mps)
    # τ = -Δo' Δv / Δv' Δv, within [0, τ_max]
    delay_s = -sum(o * v for o, v in zip(off, change_mps, strict=True)) / along if along > 0.0 else 0.0
    return min(max(delay_s, 0.0), SMOOTHED_S)


def _find_delay_s(places: Places) -> float | None:
    """Find the one delay [s] by which smoothing explains all mean offsets, beside a drift; None from too few."""
    if len(places) < LEAST_PLACES:
        return None
    times_s = np.array([(at_ns - places[0][0]) * 1e-9 for at_ns, _, _ in places])
    values = np.array([(*offset, *velocity) for _, offset, velocity in places])
    # o' = o - ō - t' (Σ t' o / Σ t'²), and v' alike: without their lines in time
    centred = times_s - np.add.reduce(times_s) / len(places)
    values = values - np.add.reduce(values, axis=0) / len(places)
    values = values - np.outer(centred, centred @ values / float(centred @ centred))
    return _bound_delay_s(values[:, :3].ravel().tolist(), values[:, 3:].ravel().tolist())


def _fit_slope(offsets: Offsets, points: Array, parameters: EnvelopeParameters) -> Array | None:
    """Fit the velocity (3,) [m/s] of the line through offsets; None where they are too few, or too close in time."""
    if len(offsets) < LEAST_OFFSETS or offsets[-1][0] - offsets[0][0] < SHORTEST * parameters.window_ns:
        return None
    times_s = np.array([(at_ns - offsets[0][0]) * 1e-9 for at_ns, _ in offsets])
    # slope = Σ (t_i - t̄) o_i / Σ (t_i - t̄)²
    centred = times_s - np.add.reduce(times_s) / len(times_s)
    slope: Array = centred @ points / float(centred @ centred)
    return slope


def _bound_noise_mps(offsets: Offsets, std_m: float) -> float:
    """Bound the slope [m/s] that noise makes, where positions are noisier than usual."""
    if std_m <= USUAL_STD_M:
        return 0.0
    mean_ns = sum(at_ns - offsets[0][0] for at_ns, _ in offsets) / len(offsets)
    # 4 σ / √Σ (t_i - t̄)²
    return NOISE_SIGMA * std_m / math.hypot(*((at_ns - offsets[0][0] - mean_ns) * 1e-9 for at_ns, _ in offsets))


def _remove_delay(apart: Array, path: tuple[tuple[int, Vector], ...], offsets: Offsets) -> Array:
    """Return a difference of velocities (3,) without the part that late stamps explain.

    Late stamps make a difference of the mean acceleration, by the vehicle's own distance, times their delay.
    """
    (begin_ns, _), (end_ns, _) = offsets[0], offsets[-1]
    begin, middle, end = (find_distance(path, at_ns) for at_ns in (begin_ns, (begin_ns + end_ns) // 2, end_ns))
    if begin is None or middle is None or end is None:
        return apart
    # ā = 4 (s_0 - 2 s_½ + s_1) / T²
    accel = (np.array(begin) - 2.0 * np.array(middle) + np.array(end)) * 4.0 / ((end_ns - begin_ns) * 1e-9) ** 2
    along = float(accel @ accel)
    # τ = -Δv' ā / ā' ā, within ±0.15 s; Δv + τ ā
    late_s = min(max(-float(apart @ accel) / along, -LATE_S), LATE_S) if along > 0.0 else 0.0
    rest: Array = apart + late_s * accel
    return rest
