"""Monitor: do positions move otherwise than the vehicle says it does?

1. At each position the offset is noted: the position minus the distance by the vehicle's own velocity.
2. The slope of the offsets over a second or so is the difference of both velocities. Stamps that are late explain a
   part that is the acceleration times the delay. What is left is compared with its bound. Then: end the plans.
3. The mean offsets of half a minute show a frame that creeps: their change is compared with a bound that grows with
   time. Smoothing in a camera system explains a part: one delay for all, times the change of the velocity. Then: end
   the plans. The bound begins with half as much where the vehicle's own way leads it to a wall or the ceiling:
   positions that stay where they were would let a slow drift carry it out.
4. Velocities contradicted each other, and then no position came for 0.6 s. Then: end the plans.
5. The first position after a silence lies far from the vehicle's own way through it, or positions move far from that
   way later, together with that. Then: end the plans.
6. While positions that have come back correct the vehicle's own velocity, no difference counts.

False alarms (docs/soak.md): 0 of 200 missions, with a bound of 0.255 m/s. The largest difference was 0.036 m/s.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from itertools import repeat
from operator import itemgetter

import msgspec
import numpy as np
from msgspec.structs import replace

from uavctl.arrays import Array, sum_in_order
from uavctl.event_codes import EventCode
from uavctl.flight.limits import ZERO
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
# Distance of the first position after a silence from the vehicle's own way, in disagreements of the velocity, and its
# growth with t². Flights of real autopilots' software had up to 0.42 m after 4 s, simulated ones 0.44 m in wind: less
# than two thirds of the bound.
RETURN_S, RETURN_1PS = 0.8, 0.12
LATE_S = 0.15  # largest difference between the delays of positions and of the vehicle's own velocity
SMOOTHED_S = 0.3  # the same with smoothing inside a camera system, which makes positions follow late
SHORTEST = 0.3  # of the window: over less, two velocities are not compared
PLACES_NS, PLACE_NS = 30_000_000_000, 1_000_000_000  # mean offsets are compared over so long, one for each such time
# Of the disagreement: the bound of a change of offset begins with so many seconds of it, and grows by such a part.
DRIFT_S, DRIFT_PART = 2.0, 0.16
# The same where the own way comes so near to a limit. Recorded flights reached 0.7 of this: 0.27 m in 3.3 s.
NEAR_DRIFT_S, NEAR_M = 1.0, 0.5
# Of the bound of a return, where the own way comes so near: simulated flights reached 0.3 of it, recorded ones 0.6.
NEAR_RETURN_PART = 0.8
LEAST_PLACES = 4  # that tell a drift from the delay of smoothing
LEAST_OFFSETS = 3  # for a slope
NOISE_SIGMA = 4.0  # standard deviations of a slope that chance may make
_TIME = itemgetter(0)  # of pairs that begin with their time, oldest first

Offsets = tuple[
    tuple[int, Vector], ...
]  # (capture time [ns], position minus the vehicle's own distance (3,)), in order

Places = tuple[tuple[int, Vector, Vector], ...]  # (at_ns, mean offset (3,), own velocity (3,)) over the window
Aligned = tuple[float, list[list[float]]]  # delay of smoothing [s], and the mean offsets (3,) without its part


class VelocityState(msgspec.Struct, frozen=True, eq=False):
    """State of the monitor."""

    offsets: Offsets = ()  # of the window
    places: Places = ()  # means of the offsets, one for each second or so
    aligned: Aligned | None = None  # of these places; None for too few, or where it is to be found anew
    apart_mps: float | None = None  # difference of both velocities when last compared; None where it is not known
    is_contradicted: bool = False  # whether it was beyond its bound when last compared
    # Capture time from which it has been beyond its bound, as far as it counts [ns]; None while it is not
    apart_ns: int | None = None
    # How far beside its own way they came back last (3,), and the bound of that [m]; None before
    returned: tuple[list[float], float] | None = None

    def agrees(self, parameters: EnvelopeParameters) -> bool:
        """Whether no difference beyond the bound is known."""
        return (self.apart_mps or 0.0) <= parameters.disagreement_mps


def update(state: VelocityState, observation: PositionObservation) -> tuple[VelocityState, Verdict]:
    """Take a position.

    Where the unexplained acceleration hints at something amiss, a difference need not last.
    """
    at_ns, path, parameters = observation.at_ns, observation.motion.vehicle_path, observation.parameters
    offsets = _add_offset(state.offsets, observation)
    returned = _find_return(state.offsets, offsets, observation)
    if returned is not None:
        s, off, bound_m = returned
        state = replace(state, returned=(off, bound_m))
        if math.hypot(*off) > bound_m:
            text = f"positions came back after {s:.0f} s, {describe_vector(off)} m off the vehicle's velocity estimate"
            return replace(state, offsets=offsets), end_plans(EventCode.VELOCITY, text)
    points = np.array([point for _, point in offsets])
    slope = _fit_slope(offsets, points, parameters)
    if slope is None:
        # Over a gap the vehicle's own distance is not known so well.
        places = state.places if len(offsets) > 1 else ()
        aligned = state.aligned if places else None
        state = replace(state, offsets=offsets, places=places, aligned=aligned, apart_mps=None, apart_ns=None)
        return state, NO_VERDICT
    resumed_ns = observation.motion.resumed_ns
    corrects = resumed_ns is not None and at_ns - parameters.window_ns < resumed_ns + CORRECTS_NS
    span_s, (begin, middle, end) = _find_way(path, offsets)
    velocity = _find_mean_velocity(begin, end, span_s)
    drift, places, aligned = None, (), None
    if not corrects:
        drift, places, aligned = _find_drift(state, offsets, points, velocity, observation)
    apart = _remove_delay(slope, begin, middle, end, span_s)
    apart_mps = math.hypot(*apart)
    bound_mps = parameters.disagreement_mps + _bound_noise_mps(offsets, observation.std_m)
    is_contradicted = apart_mps > bound_mps
    counted_mps = apart_mps
    if corrects and resumed_ns is not None:
        counted_mps, bound_mps = _find_apart_since(resumed_ns + CORRECTS_NS, offsets, observation)
    apart_ns = (state.apart_ns or at_ns) if counted_mps > bound_mps else None
    state = VelocityState(offsets, places, aligned, apart_mps, is_contradicted, apart_ns, state.returned)
    plain = observation.is_hinted or counted_mps >= PLAIN * bound_mps
    if apart_ns is not None and (plain or at_ns - apart_ns >= PERSISTS_NS):
        text = f"velocity by positions differs from the vehicle's velocity estimate by {describe_vector(apart)} m/s"
        return state, end_plans(EventCode.VELOCITY, text)
    if drift is not None:
        s, off = drift
        text = f"positions drifted {describe_vector(off)} m off the vehicle's velocity estimate in {s:.0f} s"
        return state, end_plans(EventCode.VELOCITY, text)
    return state, NO_VERDICT


def update_silence(state: VelocityState, observation: TickObservation) -> tuple[VelocityState, Verdict]:
    """Take a tick, after its positions: has a contradiction been left open for too long?"""
    at_ns = observation.tick.at_ns
    # The distance has begun anew, or is unknown.
    if len(observation.motion.vehicle_path) < 2 and (state.offsets or state.places):
        state = replace(state, offsets=(), places=(), aligned=None)
    if state.apart_ns is None or at_ns - state.apart_ns < UNRESOLVED_NS:
        return state, NO_VERDICT
    text = "velocity by positions differed from the vehicle's velocity estimate, and no position came since"
    return state, end_plans(EventCode.VELOCITY, text)


def _find_apart_since(since_ns: int, offsets: Offsets, observation: PositionObservation) -> tuple[float, float]:
    """Find the difference of both velocities by offsets from a time on, and its bound [m/s]; zero from too few.

    Differences while the vehicle's own velocity is corrected say nothing of those after it.
    """
    kept, parameters = offsets[bisect_left(offsets, since_ns, key=_TIME) :], observation.parameters
    slope = _fit_slope(kept, np.array([point for _, point in kept]), parameters)
    if slope is None:
        return 0.0, parameters.disagreement_mps
    span_s, (begin, middle, end) = _find_way(observation.motion.vehicle_path, kept)
    apart_mps = math.hypot(*_remove_delay(slope, begin, middle, end, span_s))
    return apart_mps, parameters.disagreement_mps + _bound_noise_mps(kept, observation.std_m)


def _add_offset(offsets: Offsets, observation: PositionObservation) -> Offsets:
    at_ns, distance = observation.at_ns, find_distance(observation.motion.vehicle_path, observation.at_ns)
    if distance is None:
        return ()
    since_ns = at_ns - observation.parameters.window_ns
    kept = offsets[bisect_right(offsets, since_ns, key=_TIME) :]
    offset = tuple([p - s for p, s in zip(observation.position.tolist(), distance, strict=True)])
    return (*kept, (at_ns, offset))


def _find_return(
    before: Offsets, offsets: Offsets, observation: PositionObservation
) -> tuple[float, list[float], float] | None:
    """Find the time without positions [s], how far (3,) [m] beside its own way they came back, and the bound of that.

    Return None where they do not come back, or the way is not known.
    """
    if not before or not offsets or observation.motion.resumed_ns != observation.at_ns:
        return None
    (then_ns, then), (at_ns, now) = before[-1], offsets[-1]
    path = observation.motion.vehicle_path
    step_then, step_now = _find_step(path, then_ns), _find_step(path, at_ns)
    # The way is a sum Σ Δt v_k of ticks: the trapezoidal rule takes off ½ (Δt v_1 - Δt v_0).
    steps = zip(step_then, step_now, strict=True)
    s, half = (at_ns - then_ns) * 1e-9, [0.5 * (last - first) for first, last in steps]
    off = [b - a + h for a, b, h in zip(then, now, half, strict=True)]
    # |o - o_0| > (0.8 s + 0.12 1/s t²) v_max
    bound_m = (RETURN_S + RETURN_1PS * s * s) * observation.parameters.disagreement_mps
    return s, off, bound_m


def _find_step(path: tuple[tuple[int, Vector], ...], at_ns: int) -> Vector:
    """Find the distance (3,) [m] that the vehicle flew in the tick of a time, by its own velocity; zero if unknown."""
    after = bisect_left(path, at_ns, key=_TIME)
    if not 0 < after < len(path):
        return ZERO
    return tuple(_subtract(path[after][1], path[after - 1][1]))


def _find_drift(
    state: VelocityState, offsets: Offsets, points: Array, velocity: Vector, observation: PositionObservation
) -> tuple[tuple[float, list[float]] | None, Places, Aligned | None]:
    """Find the time [s] in which offsets changed too much, and the change (3,) [m]; return too the places after it.

    Args:
        velocity: The vehicle's own mean velocity over the window (3,) [m/s].
    """
    at_ns, parameters = sum([captured_ns for captured_ns, _ in offsets]) // len(offsets), observation.parameters
    # ō = Σ o_i / n
    mean: Array = np.add.reduce(points, axis=0) / len(offsets)
    place: list[float] = mean.tolist()
    places = state.places[bisect_right(state.places, at_ns - PLACES_NS, key=_TIME) :]
    is_known = state.aligned is not None and len(places) == len(state.places)
    aligned = state.aligned if is_known else _align(places)
    # ō + τ v
    now = place if aligned is None else [o + aligned[0] * v for o, v in zip(place, velocity, strict=True)]
    thens = [before for _, before, _ in places] if aligned is None else aligned[1]
    returned = _find_return_drift(state, now, thens, places, observation)
    if returned is not None:
        return returned, places, aligned
    # No place is further away than the least bound, as a rule: then none needs its own.
    is_any_far = max(map(math.dist, repeat(now), thens), default=0.0) > NEAR_DRIFT_S * parameters.disagreement_mps
    for (since_ns, _, velocity_before), then in zip(places if is_any_far else (), thens, strict=False):
        s = (at_ns - since_ns) * 1e-9
        off = _subtract(now, then)
        if aligned is None:
            off = _remove_smoothing(off, _subtract(velocity, velocity_before))
        # |ō - ō_0| > (2 s + 0.16 s) v_max, or (1 s + 0.16 s) v_max
        begin_s = NEAR_DRIFT_S if _leads_out(observation, off) else DRIFT_S
        if math.hypot(*off) > (begin_s + DRIFT_PART * s) * parameters.disagreement_mps:
            return (s, off), places, aligned
    if not places or at_ns - places[-1][0] >= PLACE_NS:
        places, aligned = (*places, (at_ns, tuple(place), velocity)), None
    return None, places, aligned


def _find_return_drift(
    state: VelocityState,
    now: list[float],
    thens: Sequence[Sequence[float]],
    places: Places,
    observation: PositionObservation,
) -> tuple[float, list[float]] | None:
    """Find the change of offset over the last silence and since [s], [m]; None where it is within the bound of that."""
    resumed_ns, disagreement_mps = observation.motion.resumed_ns, observation.parameters.disagreement_mps
    if state.returned is None or not places or resumed_ns is None or places[0][0] < resumed_ns:
        return None
    (back, bound_m), s = state.returned, (observation.at_ns - places[0][0]) * 1e-9
    off = [b + p - q for b, p, q in zip(back, now, thens[0], strict=True)]
    # |o_r - o_0 + ō - ō_r| > max(b, 2 s v_max) + 0.16 t v_max, or max(0.8 b, 1 s v_max) + 0.16 t v_max
    leads_out = _leads_out(observation, off)
    part, begin_s = (NEAR_RETURN_PART, NEAR_DRIFT_S) if leads_out else (1.0, DRIFT_S)
    bound_m = max(part * bound_m, begin_s * disagreement_mps) + DRIFT_PART * s * disagreement_mps
    return (s, off) if math.hypot(*off) > bound_m else None


def _leads_out(observation: PositionObservation, off: list[float]) -> bool:
    """Whether the vehicle's own way has come near a wall or the ceiling, nearer than positions, which are `off` it.

    The floor does not count: it stops a vehicle.
    """
    parameters = observation.parameters
    rows = zip(observation.position.tolist(), off, parameters.lower_m, (*parameters.upper_m[:2], math.inf), strict=True)
    # p - Δō < p_min + 0.5 m, or beyond p_max - 0.5 m
    return any(
        (change > 0.0 and place - change < lower + NEAR_M) or (change < 0.0 and place - change > upper - NEAR_M)
        for place, change, lower, upper in rows
    )


def _find_way(path: tuple[tuple[int, Vector], ...], offsets: Offsets) -> tuple[float, list[Vector | None]]:
    """Find the time of the window [s], and the vehicle's own distance (3,) [m] at its begin, in its middle and its end.

    A distance is None where it is not known.
    """
    begin_ns, end_ns = offsets[0][0], offsets[-1][0]
    times_ns = begin_ns, (begin_ns + end_ns) // 2, end_ns
    return (end_ns - begin_ns) * 1e-9, [find_distance(path, at_ns) for at_ns in times_ns]


def _find_mean_velocity(begin: Vector | None, end: Vector | None, span_s: float) -> Vector:
    """Find the vehicle's own mean velocity (3,) [m/s] over the window; zero where it is not known."""
    if begin is None or end is None:
        return ZERO
    # v̄ = (s_1 - s_0) / T
    return tuple([(s_1 - s_0) / span_s for s_0, s_1 in zip(begin, end, strict=True)])


def _remove_smoothing(off: list[float], change_mps: list[float]) -> list[float]:
    """Return a change of offsets (3,) [m] without the part that smoothing makes of a change of the velocity (3,)."""
    late_s = _bound_delay_s(off, change_mps)
    # Δo + τ Δv
    return [o + late_s * v for o, v in zip(off, change_mps, strict=True)]


def _bound_delay_s(off: list[float], change_mps: list[float]) -> float:
    """Return the delay [s] by which smoothing may explain most of a change of offsets (3,) by that of the velocity."""
    along = sum_in_order([v * v for v in change_mps])
    # τ = -Δo' Δv / Δv' Δv, within [0, τ_max]
    delay_s = -sum_in_order([o * v for o, v in zip(off, change_mps, strict=True)]) / along if along > 0.0 else 0.0
    return min(max(delay_s, 0.0), SMOOTHED_S)


def _align(places: Places) -> Aligned | None:
    """Find the one delay [s] by which smoothing explains all mean offsets, and those without it; None from too few."""
    if len(places) < LEAST_PLACES:
        return None
    times_s = np.array([(at_ns - places[0][0]) * 1e-9 for at_ns, _, _ in places])
    values = np.array([(*offset, *velocity) for _, offset, velocity in places])
    # o' = o - ō - t' (Σ t' o / Σ t'²), and v' alike: without their lines in time, which a drift makes
    centred = times_s - np.add.reduce(times_s) / len(places)
    beside = values - np.add.reduce(values, axis=0) / len(places)
    beside -= np.outer(centred, centred @ beside / float(centred @ centred))
    late_s = _bound_delay_s(beside[:, :3].ravel().tolist(), beside[:, 3:].ravel().tolist())
    # ō + τ v
    return late_s, (values[:, :3] + late_s * values[:, 3:]).tolist()


def _subtract(a: Sequence[float], b: Sequence[float]) -> list[float]:
    return [x - y for x, y in zip(a, b, strict=True)]


def _fit_slope(offsets: Offsets, points: Array, parameters: EnvelopeParameters) -> Array | None:
    """Fit the velocity (3,) [m/s] of the line through offsets; None where they are too few, or too close in time."""
    if len(offsets) < LEAST_OFFSETS or offsets[-1][0] - offsets[0][0] < SHORTEST * parameters.window_ns:
        return None
    times_s = np.array([(at_ns - offsets[0][0]) * 1e-9 for at_ns, _ in offsets])
    # slope = Σ (t_i - t̄) o_i / Σ (t_i - t̄)²
    centred = times_s - np.add.reduce(times_s) / len(times_s)
    slope: Array = centred.dot(points) / float(centred.dot(centred))
    return slope


def _bound_noise_mps(offsets: Offsets, std_m: float) -> float:
    """Bound the slope [m/s] that noise makes, where positions are noisier than usual."""
    if std_m <= USUAL_STD_M:
        return 0.0
    mean_ns = sum(at_ns - offsets[0][0] for at_ns, _ in offsets) / len(offsets)
    # 4 σ / √Σ (t_i - t̄)²
    return NOISE_SIGMA * std_m / math.hypot(*((at_ns - offsets[0][0] - mean_ns) * 1e-9 for at_ns, _ in offsets))


def _remove_delay(
    apart: Array, begin: Vector | None, middle: Vector | None, end: Vector | None, span_s: float
) -> Array:
    """Return a difference of velocities (3,) without the part that late stamps explain.

    Late stamps make a difference of the mean acceleration, by the vehicle's own distance, times their delay.
    """
    if begin is None or middle is None or end is None:
        return apart
    # ā = 4 (s_0 - 2 s_½ + s_1) / T²
    rows = zip(begin, middle, end, strict=True)
    accel = np.array([(s_0 - 2.0 * s_half + s_1) * 4.0 / span_s**2 for s_0, s_half, s_1 in rows])
    along = float(accel.dot(accel))
    # τ = -Δv' ā / ā' ā, within ±0.15 s; Δv + τ ā
    late_s = min(max(-float(apart.dot(accel)) / along, -LATE_S), LATE_S) if along > 0.0 else 0.0
    rest: Array = apart + late_s * accel
    return rest
