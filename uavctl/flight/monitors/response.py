"""Monitor: does the vehicle answer setpoints as they say, or turned, mirrored, late, or not at all?

1. The acceleration a is shown by inertial data; without them, by changes of the vehicle's own velocity. The setpoints
   give u, behind the vehicle's lag. All is horizontal.
2. Each hypothesis predicts a = R u - c v + d, with drag c of the velocity v, and wind d. A right response has R = g I,
   with a gain g of 0.7 to 1.5, and may be up to 0.15 s late: the model of a vehicle is rarely exact.
3. What a hypothesis leaves is a - R u + c v. Its variance V over the last half second counts, and the jump J of its
   mean since the last seconds: a wind that sets in makes one, too. Older samples are forgotten.
4. The evidence for a wrong response is the log-likelihood ratio of V and J against those of a right one.
5. Evidence above a bound ends the plans. The bound is lower where little time is left to brake before a wall.
6. Inertial data count only while the vehicle's own velocity changes as they do. Nothing counts while both contradict
   each other: one of them is wrong.

Positions are right, so they go on to the vehicle.

False alarms: none of 100 flights between walls, half of them in gusts of up to 8 m/s; none in recorded flights of PX4
and ArduCopter, with gains of 0.5 and 1.5, or where a wind of up to 8 m/s sets in at once (12 each). 2 of 12 with 0.1 to
0.15 s of delay more than the model has, and 2 of 12 where a wind of 8 to 12 m/s sets in at once.
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
from uavctl.flight.monitors.motion import TickObservation
from uavctl.flight.monitors.observation import MOTION_NS, EnvelopeParameters, Observation, read_vehicle_velocity
from uavctl.flight.monitors.observer import DRAG_1PS
from uavctl.flight.monitors.velocity_change import VelocityChangeState
from uavctl.flight.monitors.verdict import NO_VERDICT, Verdict, end_plans

MEMORY_S = 0.4  # time constant with which samples are forgotten
CORRELATED_S = 0.05  # for so long what is left is about the same: one sample
LEAST_SAMPLES = 4.0
BASELINE_S = 10.0  # the same for the mean before a jump
# Of the acceleration that positions may show unexplained (1.5 m/s² in a room), standard deviations of what a right
# response leaves (attitude loop, noise of inertial data), and of a jump of the wind.
NOISE_PART, JUMP_PART = 0.2, 0.65
NEAR, FAR = 1.4, 3.0  # bounds of the evidence: with no time left to brake, and with `FAR_S` left
FAR_S = 1.0
# Factor of the bounds for the vehicle's own velocity, which its estimator smooths, and without positions for so long:
# inertial data and the own velocity that begin to err together would be taken for a wrong response.
UNCERTAIN, SILENT_NS = 3.0, 400_000_000
REACTION_S = 0.3  # from a setpoint to its effect: recorded autopilots need 0.18 to 0.32 s
GAINS = (1.0, 0.7, 1.5)  # of a right response: the model of a vehicle is rarely exact
LATE_NS, TOO_LATE_NS = 150_000_000, 300_000_000  # delays beyond the vehicle's lag: of a right response, of a wrong one

Pair = tuple[float, float]  # north, east

_I, _0 = np.eye(2), np.zeros((2, 2))
# Hypotheses: R for u now, u of `LATE_NS` ago, u of `TOO_LATE_NS` ago.
_RIGHT = tuple((gain * _I, _0, _0) for gain in GAINS) + tuple((_0, gain * _I, _0) for gain in GAINS)
_WRONG = {
    "turned by 90°": (np.array([[0.0, -1.0], [1.0, 0.0]]), _0, _0),
    "turned by 180°": (-_I, _0, _0),
    "turned by 270°": (np.array([[0.0, 1.0], [-1.0, 0.0]]), _0, _0),
    "mirrored in north": (np.diag([-1.0, 1.0]), _0, _0),
    "mirrored in east": (np.diag([1.0, -1.0]), _0, _0),
    "not at all": (_0, _0, _0),
    "too late": (_0, _0, _I),
}
WRONG = tuple(_WRONG)
# A sample is z = (a, u now, u late, u too late, v, 1), and e = M z is what a hypothesis leaves: M = (I, -R..., 0).
_ONE = np.zeros((2, 1))
_LEFT = [np.hstack([_I, *(-r for r in rows), _0, _ONE]) for rows in (*_RIGHT, *_WRONG.values())]
_VELOCITY = np.hstack([_0, _0, _0, _0, _I, _ONE])
_SIZE = 11
_COUNT = len(_LEFT)
# With S = Σ w z z': Σ |e|² = <M' M, S>, Σ e' v = <M' N, S>, Σ |v|² = <N' N, S>, and Σ e = M S (0, ..., 0, 1)'
_SQUARES = np.array([(m.T @ m).ravel() for m in (*_LEFT, _VELOCITY)])
_PRODUCTS = np.array([(m.T @ _VELOCITY).ravel() for m in _LEFT])
_SUMS = np.array([np.outer(row, np.eye(_SIZE)[-1]).ravel() for m in (*_LEFT, _VELOCITY) for row in m])
_FORMS = np.vstack([_SQUARES, _PRODUCTS, _SUMS])
_TIME = itemgetter(0)


class ResponseState(msgspec.Struct, frozen=True, eq=False):
    """State of the monitor."""

    requested: tuple[tuple[int, Pair], ...] = ()  # u of the last ticks, oldest first
    inertial_ns: int | None = None  # tick of the newest inertial data [ns]; None before any
    velocity: tuple[int, Pair] | None = None  # the vehicle's own velocity, without inertial data; None before any
    moments: Array = np.zeros((_SIZE, _SIZE))  # Σ w z z' over the samples, where forgotten ones count less
    # The same over a longer time: Σ w, and Σ w e (north, east) of a right response, Σ w v (north, east)
    baseline: tuple[float, ...] = (0.0,) * 5


class _Acceleration(msgspec.Struct, frozen=True):
    """Mean acceleration of a span of time."""

    middle_ns: int
    span_s: float
    accel_mps2: Pair


def update(
    state: ResponseState, observation: TickObservation, change: VelocityChangeState
) -> tuple[ResponseState, Verdict]:
    """Take a tick.

    Args:
        change: State of the monitor that compares inertial data with the vehicle's own velocity, after this tick.
    """
    tick, (north, east, _) = observation.tick, observation.motion.model_mps2
    kept = state.requested[bisect_right(state.requested, tick.at_ns - TOO_LATE_NS - MOTION_NS, key=_TIME) :]
    state, shown = _find_acceleration(replace(state, requested=(*kept, (tick.at_ns, (north, east)))), tick)
    if change.contradicts:
        return ResponseState(requested=state.requested), NO_VERDICT
    if shown is None:
        return state, NO_VERDICT
    state = _add_sample(state, shown, tick)
    by_inertial = tick.inertial_mps2 is not None
    if by_inertial and not change.supports_velocity(tick.at_ns):
        return state, NO_VERDICT
    evidence, kind = compute_evidence(state, observation.parameters.unexplained_mps2)
    observer = observation.motion.observer
    is_silent = observer is None or tick.at_ns - observer.at_ns > SILENT_NS
    factor = 1.0 if by_inertial and not is_silent else UNCERTAIN
    if evidence <= factor * NEAR or evidence <= factor * _compute_bound(tick, observation.parameters):
        return state, NO_VERDICT
    text = f"the vehicle does not answer setpoints as they say ({kind}), or a strong wind has set in"
    return state, end_plans(EventCode.SETPOINT_RESPONSE, text)


def _find_acceleration(state: ResponseState, tick: Observation) -> tuple[ResponseState, _Acceleration | None]:
    """Find the acceleration that this tick shows, if any."""
    before_ns = state.requested[-2][0] if len(state.requested) > 1 else tick.at_ns
    if tick.inertial_mps2 is not None:
        north, east, _ = tick.inertial_mps2
        if state.inertial_ns is None or tick.at_ns - state.inertial_ns > MOTION_NS:
            state = ResponseState(requested=state.requested)
        shown = _Acceleration(tick.at_ns, (tick.at_ns - before_ns) * 1e-9, (north, east))
        return replace(state, inertial_ns=tick.at_ns, velocity=None), shown
    own, motion = read_vehicle_velocity(tick.motion, tick.at_ns), tick.motion
    has_inertial = state.inertial_ns is not None and tick.at_ns - state.inertial_ns <= MOTION_NS
    if has_inertial or own is None or motion is None or motion.velocity_ns is None:
        return replace(state, velocity=None), None
    before, now = state.velocity, (motion.velocity_ns, (own[0], own[1]))
    if before is None or now[0] - before[0] > MOTION_NS:
        return ResponseState(requested=state.requested, velocity=now), None
    span_s = (now[0] - before[0]) * 1e-9
    if span_s < CORRELATED_S:
        return state, None
    # a = Δv / Δt
    north, east = ((v - v_before) / span_s for v, v_before in zip(now[1], before[1], strict=True))
    return replace(state, velocity=now), _Acceleration((now[0] + before[0]) // 2, span_s, (north, east))


def _add_sample(state: ResponseState, shown: _Acceleration, tick: Observation) -> ResponseState:
    """Add a sample; those before count less."""
    now, late, too_late = (_find_requested(state, shown.middle_ns - ns) for ns in (0, LATE_NS, TOO_LATE_NS))
    velocity = read_vehicle_velocity(tick.motion, tick.at_ns) or tick.velocity_mps
    north, east = (v if math.isfinite(v) else 0.0 for v in velocity[:2])
    accel, weight = shown.accel_mps2, shown.span_s / CORRELATED_S
    z = np.array([*accel, *now, *late, *too_late, north, east, 1.0])
    # w = Δt / t_c; S = e^(-Δt/τ) S + w z z'
    moments = math.exp(-shown.span_s / MEMORY_S) * state.moments + (weight * z)[:, None] * z
    remaining, added = math.exp(-shown.span_s / BASELINE_S), (1.0, accel[0] - now[0], accel[1] - now[1], north, east)
    baseline = tuple(remaining * sum_before + weight * x for sum_before, x in zip(state.baseline, added, strict=True))
    return replace(state, moments=moments, baseline=baseline)


def _find_requested(state: ResponseState, at_ns: int) -> Pair:
    """Find the acceleration that setpoints gave at a time; the oldest one for all before."""
    return state.requested[max(bisect_right(state.requested, at_ns, key=_TIME) - 1, 0)][1]


def compute_evidence(state: ResponseState, unexplained_mps2: float) -> tuple[float, str]:
    """Compute the evidence for the likeliest wrong response, and its kind; zero where a right one leaves little.

    Args:
        unexplained_mps2: Acceleration that positions may show unexplained.
    """
    count = float(state.moments[-1, -1])
    if count < LEAST_SAMPLES:
        return 0.0, ""
    forms: list[float] = (_FORMS @ state.moments.ravel() / count).tolist()
    squares, products, means = forms[: _COUNT + 1], forms[_COUNT + 1 : 2 * _COUNT + 1], forms[2 * _COUNT + 1 :]
    before = [total / state.baseline[0] for total in state.baseline[1:]]
    velocity_mps = means[-2], means[-1]
    change_mps = velocity_mps[0] - before[2], velocity_mps[1] - before[3]
    variance_v = squares[_COUNT] - _dot(velocity_mps, velocity_mps)
    noise_mps2, jump_mps2 = NOISE_PART * unexplained_mps2, JUMP_PART * unexplained_mps2

    def compute_cost(k: int) -> float:
        mean = means[2 * k], means[2 * k + 1]
        jump = mean[0] - before[0], mean[1] - before[1]
        # var e = mean |e|² - |ē|²; cov(e, v) = mean e' v - ē' v̄
        variance, covariance = squares[k] - _dot(mean, mean), products[k] - _dot(mean, velocity_mps)
        # V = var e + 2 c cov(e, v) + c² var v; J = |Δē + c Δv̄|²; each with the best c
        left = _remove_drag(variance, covariance, variance_v)
        jumped = _remove_drag(_dot(jump, jump), _dot(jump, change_mps), _dot(change_mps, change_mps))
        # -ln p = n / 2 ln(1 + V / σ²) + J / 2 σ_J²
        return 0.5 * count * math.log(1.0 + left / noise_mps2**2) + jumped / (2.0 * jump_mps2**2)

    right = math.inf
    for k in range(len(_RIGHT)):
        right = min(right, compute_cost(k))
        if right <= NEAR:  # no cost is below zero, so the evidence is below each bound
            return 0.0, ""
    wrong = [compute_cost(k) for k in range(len(_RIGHT), _COUNT)]
    least = min(wrong)
    return right - least, WRONG[wrong.index(least)]


def _remove_drag(left: float, with_velocity: float, speed: float) -> float:
    """Return the smallest value of left + 2 c with_velocity + c² speed, for a drag c within [0, c_max]."""
    # c = -with_velocity / speed
    drag_1ps = min(max(-with_velocity / speed, 0.0), DRAG_1PS) if speed > 0.0 else 0.0
    return max(left + 2.0 * drag_1ps * with_velocity + drag_1ps**2 * speed, 0.0)


def _dot(a: Pair, b: Pair) -> float:
    return a[0] * b[0] + a[1] * b[1]


def _compute_bound(tick: Observation, parameters: EnvelopeParameters) -> float:
    """Compute the bound of the evidence, by the time that is left to brake before a wall."""
    if tick.position_m is None:
        return FAR
    left_s = FAR_S
    rows = zip(
        tick.position_m[:2],
        tick.velocity_mps[:2],
        parameters.lower_m[:2],
        parameters.upper_m[:2],
        parameters.brake_mps2[:2],
        strict=True,
    )
    for position, velocity, lower, upper, brake in rows:
        distance_m, speed_mps = (upper - position, velocity) if velocity > 0.0 else (position - lower, -velocity)
        if speed_mps > 0.0:
            # t = (x - v T - v² / 2 a) / v
            left_s = min(left_s, distance_m / speed_mps - REACTION_S - speed_mps / (2.0 * brake))
    return NEAR + (FAR - NEAR) * max(left_s, 0.0) / FAR_S
