"""Monitor: does the vehicle answer setpoints as they say, or turned, mirrored, late, or not at all?

1. The acceleration a is shown by inertial data; without them, by changes of the vehicle's own velocity. The setpoints
   give u, behind the vehicle's lag. Horizontal axes are compared together, the vertical axis by itself.
2. Each hypothesis predicts a = R u - c v + d, with drag c of the velocity v, and wind d. A right response has R = g I,
   with a gain g of 0.7 to 1.5, and may be up to 0.15 s late: the model of a vehicle is rarely exact. A wrong one
   near to it (turned by 45°, 2.5 times as much) needs more evidence.
3. What a hypothesis leaves is a - R u + c v. Its variance V over the last half second counts, and the jump J of its
   mean since the last seconds: a wind that sets in makes one, too. Older samples are forgotten.
4. The evidence for a wrong response is the log-likelihood ratio of V and J against those of a right one. Where R = I
   leaves little, nothing else is compared.
5. A response that has just become wrong shows sooner in the last 0.35 s alone, all samples alike. What setpoints gave
   before fades with the vehicle's lag.
6. Evidence above a bound ends the plans. The bound is lower where little time is left to brake before a wall, and
   lowest while the fallback brakes and positions come: a wrong response would accelerate the vehicle for a second.
7. Inertial data count only while the vehicle's own velocity changes as they do. Where no own velocity comes, positions
   are witness. Nothing counts while both sources contradict each other: one of them is wrong.

Positions are right, so they go on to the vehicle.

False alarms, of ten flights each, before turns by 45° and 2.5 times as much were compared: 1 where a wind of 4 to 8 m/s
sets in at once, 3 with 8 to 12 m/s, 4 where it reverses at once, 1 with 0.1 s of delay more than the model has, 6 with
0.15 s.
"""

from __future__ import annotations

import math
import operator
from bisect import bisect_right
from collections.abc import Sequence
from operator import itemgetter

import msgspec
import numpy as np
from msgspec.structs import replace

from uavctl.arrays import Array, sum_in_order
from uavctl.event_codes import EventCode
from uavctl.flight.limits import ZERO
from uavctl.flight.monitors.motion import TickObservation
from uavctl.flight.monitors.observation import MOTION_NS, EnvelopeParameters, Observation, read_vehicle_velocity
from uavctl.flight.monitors.observer import DRAG_1PS, MIN_LAG_S, measure_size_mps2, remove_drag
from uavctl.flight.monitors.outside import REACTION_S, describe_overrun, list_approaches
from uavctl.flight.monitors.velocity_change import VelocityChangeState
from uavctl.flight.monitors.verdict import NO_VERDICT, Verdict, end_plans
from uavctl.records import Vec3

MEMORY_S = 0.4  # time constant with which samples are forgotten
CORRELATED_S = 0.05  # for so long what is left is about the same: one sample
LEAST_SAMPLES = 4.0
WINDOW_NS = 2_000_000_000  # samples older than five time constants weigh less than a hundredth
BASELINE_S = 10.0  # the same for the mean before a jump
# Of the acceleration that positions may show unexplained (1.5 m/s² in a room), standard deviations of what a right
# response leaves (attitude loop, noise of inertial data), and of a jump of the wind.
NOISE_PART, JUMP_PART = 0.2, 0.65
NEAR, FAR = 1.4, 3.0  # bounds of the evidence: with no time left to brake, and with `FAR_S` left
FAR_S = 1.0
# Cost of an exact response up to which no other is compared: a wrong one soon leaves more. In recorded flights it
# delays a discovery by a tick or two at most, and nine of ten ticks of right responses end there.
LITTLE = 5.0
# Factor of the bounds for the vehicle's own velocity, which its estimator smooths, and with no position for so long:
# inertial data and the own velocity that begin to err together would be taken for a wrong response.
UNCERTAIN, SILENT_NS = 3.0, 400_000_000
# Time since a response may have become wrong: over a longer one gusts look like it, a shorter one shows too little.
# Factor of the bounds for it: a wind of 2 m/s² that sets in at once makes evidence of 3.8.
ONSET_NS, ONSET = 350_000_000, 1.5
WITNESSED = 2.5  # the same where positions are the witness: sudden winds of 5 to 8 m/s² make evidence of up to 7.4
# Of the acceleration that positions may show unexplained: from there on they are witness of inertial data. A choice:
# more than noise of positions shows, less than a wrong response does in half a second.
WITNESSED_PART = 0.3
GAINS = (1.0, 0.7, 1.5)  # of a right response: the model of a vehicle is rarely exact
LATE_NS, TOO_LATE_NS = 150_000_000, 300_000_000  # delays beyond the vehicle's lag: of a right response, of a wrong one
RARE = 1.0  # cost of a response so near to a right one that wind or noise is taken for it sooner
REQUESTED_NS = WINDOW_NS + TOO_LATE_NS + MOTION_NS  # setpoints are kept for so long

_TIME = itemgetter(0)

# A sample: time [ns]; weight, then acceleration, that by setpoints, and velocity, each (3,)
Sample = tuple[int, tuple[float, ...]]


class _Group:
    """Hypotheses on axes that are compared together.

    What one leaves is e = a - R_0 u - R_1 u_late - R_2 u_too_late - R_3 f, with f of setpoints before, which fades.
    """

    def __init__(self, axes: Sequence[int], wrong: dict[str, Array], rare: dict[str, Array]) -> None:
        """Make the group.

        Args:
            wrong: R of each wrong response: for u now.
            rare: The same, for those near to a right one.
        """
        one, zero = np.eye(len(axes)), np.zeros((len(axes), len(axes)))
        right = [(gain * one, zero, zero, zero) for gain in GAINS] + [(zero, gain * one, zero, zero) for gain in GAINS]
        rows = [*right, (zero, zero, one, zero)]
        # a = R u + (I - R) f, as u = f + what was sent since gives
        rows += [(r, zero, zero, one - r) for r in (wrong | rare).values()]
        self.axes = tuple(axes)
        self.kinds = ("too late", *wrong, *rare)
        self.right = len(right)
        self.offsets = [0.0] * (len(rows) - len(rare)) + [RARE] * len(rare)
        # What each leaves is e = L s of s = (a, u, u_late, u_too_late, f): L (k, d, 5 d), and L'L (k, 25 d²)
        self.left = np.array([np.hstack([one, *(-r for r in row)]) for row in rows])
        self.squares = (self.left.transpose(0, 2, 1) @ self.left).reshape(len(rows), -1)


_HORIZONTAL = _Group(
    (0, 1),
    {
        "turned by 90°": np.array([[0.0, -1.0], [1.0, 0.0]]),
        "turned by 180°": -np.eye(2),
        "turned by 270°": np.array([[0.0, 1.0], [-1.0, 0.0]]),
        "mirrored in north": np.diag([-1.0, 1.0]),
        "mirrored in east": np.diag([1.0, -1.0]),
        "not at all": np.zeros((2, 2)),
    },
    {
        "turned by 45°": math.sqrt(0.5) * np.array([[1.0, -1.0], [1.0, 1.0]]),
        "turned by 315°": math.sqrt(0.5) * np.array([[1.0, 1.0], [-1.0, 1.0]]),
        "2.5 times as much": 2.5 * np.eye(2),
    },
)
_VERTICAL = _Group((2,), {"mirrored in down": -np.eye(1), "not at all in down": np.zeros((1, 1))}, {})
_GROUPS = (_HORIZONTAL, _VERTICAL)
WRONG = tuple(dict.fromkeys((*_HORIZONTAL.kinds, *_VERTICAL.kinds)))


class ResponseState(msgspec.Struct, frozen=True):
    """State of the monitor."""

    requested: tuple[tuple[int, Vec3], ...] = ()  # u of the last ticks, oldest first
    heard_ns: int | None = None  # tick in which positions came last, believed or not [ns]; None before any
    inertial_ns: int | None = None  # tick of the newest inertial data [ns]; None before any
    velocity: tuple[int, Vec3] | None = None  # the vehicle's own velocity, without inertial data; None before any
    samples: tuple[Sample, ...] = ()  # of the window, oldest first
    # Sums over samples, where forgotten ones count less: w, w e (3), w e² (3), w a (3), w a² (3), with e of a right
    # response
    recent: tuple[float, ...] = (0.0,) * 13
    # The same over a longer time: w, w e (3), w v (3)
    baseline: tuple[float, ...] = (0.0,) * 7


class _Acceleration(msgspec.Struct, frozen=True):
    """Mean acceleration of a span of time."""

    middle_ns: int
    span_s: float
    accel_mps2: Vec3


def update(
    state: ResponseState, observation: TickObservation, change: VelocityChangeState
) -> tuple[ResponseState, Verdict]:
    """Take a tick.

    Args:
        change: State of the monitor that compares inertial data with the vehicle's own velocity, after this tick.
    """
    tick, (north, east, down) = observation.tick, observation.motion.model_mps2
    heard_ns = tick.at_ns if tick.has_positions else state.heard_ns
    kept = state.requested[bisect_right(state.requested, tick.at_ns - REQUESTED_NS, key=_TIME) :]
    state = replace(state, requested=(*kept, (tick.at_ns, (north, east, down))), heard_ns=heard_ns)
    state, shown = _find_acceleration(state, tick)
    if change.contradicts:
        return ResponseState(requested=state.requested, heard_ns=state.heard_ns), NO_VERDICT
    if shown is None:
        return state, NO_VERDICT
    state = _add_sample(state, shown, tick)
    by_inertial = tick.inertial_mps2 is not None
    is_silent = state.heard_ns is None or tick.at_ns - state.heard_ns > SILENT_NS
    is_supported = change.agrees(tick.at_ns)
    if by_inertial and not is_supported and not _is_witnessed(observation):
        return state, NO_VERDICT
    is_urgent = tick.braking and not is_silent
    bound = NEAR if is_urgent else _compute_bound(tick, observation.parameters)
    evidence, kind = compute_evidence(state, observation.parameters.unexplained_mps2)
    factor = UNCERTAIN
    if by_inertial and not is_silent:
        factor = 1.0 if is_supported else WITNESSED
    if factor == 1.0:
        onset, onset_kind = compute_onset_evidence(state, observation.parameters, ONSET * bound)
        evidence, kind = max((evidence, kind), (onset / ONSET, onset_kind))
    if evidence <= factor * bound:
        return state, NO_VERDICT
    text = f"the vehicle responds wrongly to setpoints ({kind}), or a strong wind has set in"
    return state, end_plans(EventCode.SETPOINT_RESPONSE, text + describe_overrun(tick, observation.parameters))


def _is_witnessed(observation: TickObservation) -> bool:
    """Whether positions show the acceleration of inertial data, and not that of setpoints, in place of an own velocity.

    A right response shows the opposite, whatever inertial data say.
    """
    tick, observer = observation.tick, observation.motion.observer
    if observer is None or observer.inertial is None or read_vehicle_velocity(tick.motion, tick.at_ns) is not None:
        return False
    if tick.at_ns - observer.at_ns > SILENT_NS:
        return False
    beside_sent_mps2, beside_inertial_mps2 = (
        measure_size_mps2(remove_drag(mean[2], mean[1])) for mean in (observer.mean, observer.inertial)
    )
    shown_mps2 = WITNESSED_PART * observation.parameters.unexplained_mps2
    return beside_sent_mps2 > max(shown_mps2, 2.0 * beside_inertial_mps2)


def _find_acceleration(state: ResponseState, tick: Observation) -> tuple[ResponseState, _Acceleration | None]:
    """Find the acceleration that this tick shows, if any."""
    before_ns = state.requested[-2][0] if len(state.requested) > 1 else tick.at_ns
    if tick.inertial_mps2 is not None:
        if state.inertial_ns is None or tick.at_ns - state.inertial_ns > MOTION_NS:
            state = ResponseState(requested=state.requested, heard_ns=state.heard_ns)
        shown = _Acceleration(tick.at_ns, (tick.at_ns - before_ns) * 1e-9, tick.inertial_mps2)
        return replace(state, inertial_ns=tick.at_ns, velocity=None), shown
    own, motion = read_vehicle_velocity(tick.motion, tick.at_ns), tick.motion
    has_inertial = state.inertial_ns is not None and tick.at_ns - state.inertial_ns <= MOTION_NS
    if has_inertial or own is None or motion is None or motion.velocity_ns is None:
        return replace(state, velocity=None), None
    before, now = state.velocity, (motion.velocity_ns, own)
    if before is None or now[0] - before[0] > MOTION_NS:
        return ResponseState(requested=state.requested, heard_ns=state.heard_ns, velocity=now), None
    span_s = (now[0] - before[0]) * 1e-9
    if span_s < CORRELATED_S:
        return state, None
    # a = Δv / Δt
    north, east, down = ((v - v_before) / span_s for v, v_before in zip(now[1], before[1], strict=True))
    return replace(state, velocity=now), _Acceleration((now[0] + before[0]) // 2, span_s, (north, east, down))


def _add_sample(state: ResponseState, shown: _Acceleration, tick: Observation) -> ResponseState:
    """Add a sample; those before count less."""
    now = state.requested[max(bisect_right(state.requested, shown.middle_ns, key=_TIME) - 1, 0)][1]
    own = read_vehicle_velocity(tick.motion, tick.at_ns) or tick.velocity_mps
    velocity = [v if math.isfinite(v) else 0.0 for v in own]
    # w = Δt / t_c; S = e^(-Δt/τ) S + w x
    weight = shown.span_s / CORRELATED_S
    left = [a - u for a, u in zip(shown.accel_mps2, now, strict=True)]
    kept, kept_long = math.exp(-shown.span_s / MEMORY_S), math.exp(-shown.span_s / BASELINE_S)
    shown_mps2 = shown.accel_mps2
    recent = (1.0, *left, *(e * e for e in left), *shown_mps2, *(a * a for a in shown_mps2))
    baseline = (1.0, *left, *velocity)
    sample = shown.middle_ns, (weight, *shown.accel_mps2, *now, *velocity)
    first = bisect_right(state.samples, shown.middle_ns - WINDOW_NS, key=_TIME)
    return replace(
        state,
        samples=(*state.samples[first:], sample),
        recent=tuple([kept * total + weight * x for total, x in zip(state.recent, recent, strict=True)]),
        baseline=tuple([kept_long * total + weight * x for total, x in zip(state.baseline, baseline, strict=True)]),
    )


def compute_evidence(state: ResponseState, unexplained_mps2: float) -> tuple[float, str]:
    """Compute the evidence for the likeliest wrong response, and its kind; zero where a right one leaves little.

    Args:
        unexplained_mps2: Acceleration that positions may show unexplained.
    """
    best = 0.0, ""
    if state.recent[0] < LEAST_SAMPLES:
        return best
    noise_mps2, jump_mps2 = NOISE_PART * unexplained_mps2, JUMP_PART * unexplained_mps2
    for group in _GROUPS:
        if _compute_exact_cost(state.recent, state.baseline, group, noise_mps2, jump_mps2) > LITTLE:
            best = max(best, _compare(_compute_costs(state, group, noise_mps2, jump_mps2), group))
    return best


def compute_onset_evidence(
    state: ResponseState, parameters: EnvelopeParameters, bound: float = ONSET * NEAR
) -> tuple[float, str]:
    """Compute the evidence for the likeliest response that has just become wrong, and its kind.

    It is zero where a right one leaves no more than `bound`: no evidence can be larger.

    Args:
        bound: Evidence that has an effect; the least one where that is not known.
    """
    noise_mps2, jump_mps2 = NOISE_PART * parameters.unexplained_mps2, JUMP_PART * parameters.unexplained_mps2
    best, since_ns = (0.0, ""), state.samples[-1][0] - ONSET_NS
    if state.samples[0][0] > since_ns:
        return best
    first = bisect_right(state.samples, since_ns, key=_TIME)
    recent = _sum_samples([sample for _, sample in state.samples[first:]])
    for group in _GROUPS:
        if _compute_exact_cost(recent, state.baseline, group, noise_mps2, jump_mps2) > bound:
            costs = _compute_costs(state, group, noise_mps2, jump_mps2, since_ns, parameters.lag_s)
            best = max(best, _compare(costs, group))
    return best


def _sum_samples(numbers: Sequence[tuple[float, ...]]) -> tuple[float, ...]:
    """Sum samples alike: w, w e (3), w e² (3), with e of a right response."""
    weights = [sample[0] for sample in numbers]
    left = [[sample[1 + axis] - sample[4 + axis] for sample in numbers] for axis in range(3)]
    weighted = [list(map(operator.mul, weights, row)) for row in left]
    squares = [map(operator.mul, products, row) for products, row in zip(weighted, left, strict=True)]
    return (sum_in_order(weights), *map(sum_in_order, weighted), *map(sum_in_order, squares))


def _compare(costs: list[float], group: _Group) -> tuple[float, str]:
    """Compare the likeliest wrong response with the likeliest right one: the evidence for it, and its kind."""
    wrong = costs[group.right :]
    least = min(wrong)
    return min(costs[: group.right]) - least, group.kinds[wrong.index(least)]


def _compute_exact_cost(
    recent: Sequence[float], baseline: Sequence[float], group: _Group, noise_mps2: float, jump_mps2: float
) -> float:
    """Compute the cost of an exact response, without drag: where it is little, no other needs to be compared."""
    count, variance, jumped = recent[0], 0.0, 0.0
    for axis in group.axes:
        mean = recent[1 + axis] / count
        variance += recent[4 + axis] / count - mean * mean
        jumped += (mean - baseline[1 + axis] / baseline[0]) ** 2
    return _compute_cost(count, max(variance, 0.0), jumped, noise_mps2, jump_mps2)


def _compute_cost(count: float, variance: float, jumped: float, noise_mps2: float, jump_mps2: float) -> float:
    # -ln p = n / 2 ln(1 + V / σ²) + J / 2 σ_J²
    return 0.5 * count * math.log(1.0 + variance / noise_mps2**2) + jumped / (2.0 * jump_mps2**2)


def _compute_costs(
    state: ResponseState,
    group: _Group,
    noise_mps2: float,
    jump_mps2: float,
    since_ns: int | None = None,
    lag_s: Vec3 = ZERO,
) -> list[float]:
    """Compute the negative log-likelihood of each hypothesis of a group.

    Args:
        since_ns: Time since a response has been wrong; None for a long time, of which older samples are forgotten.
        lag_s: The vehicle's lag, with which what was asked for before then fades.
    """
    samples, axes, newest_ns = np.array([numbers for _, numbers in state.samples]), group.axes, state.samples[-1][0]
    # Relative to the newest sample: a difference of two is exact.
    at_ns, requested_ns = (np.array([ns - newest_ns for ns, _ in rows]) for rows in (state.samples, state.requested))
    requested = np.array([u for _, u in state.requested])[:, axes]
    delayed = [
        requested[np.maximum(np.searchsorted(requested_ns, at_ns - ns, side="right") - 1, 0)]
        for ns in (LATE_NS, TOO_LATE_NS)
    ]
    accel, now, velocity = (samples[:, [first + axis for axis in axes]] for first in (1, 4, 7))
    if since_ns is None:
        weights, faded = samples[:, 0] * np.exp(at_ns * (1e-9 / MEMORY_S)), np.zeros_like(now)
    else:
        onset_ns = since_ns - newest_ns
        before = requested[int(np.searchsorted(requested_ns, onset_ns, side="right")) - 1]
        lags_s = np.maximum([lag_s[axis] for axis in axes], MIN_LAG_S)
        # f = u(t_0) e^(-(t - t_0) / τ)
        is_since = at_ns > onset_ns
        weights, since_s = samples[:, 0] * is_since, (at_ns - onset_ns) * is_since * 1e-9
        faded = before * np.exp(-since_s[:, None] / lags_s)
    count = float(weights.sum())
    weights = weights / count
    # s = (a, u, u late, u too late, f), and v behind: s̄ = Σ w s, C = Σ w (s - s̄)(s - s̄)'
    shown, n_s = np.hstack([accel, now, *delayed, faded, velocity]), group.left.shape[2]
    mean_shown = weights @ shown
    centred = shown - mean_shown
    cov = (weights * centred.T) @ centred
    # e = L s: var e = tr L C_ss L', cov(e, v) = tr L C_sv, var v = tr C_vv
    variance = (group.squares @ cov[:n_s, :n_s].ravel()).tolist()
    covariance = (group.left.reshape(len(group.left), -1) @ cov[n_s:, :n_s].ravel()).tolist()
    variance_v = float(cov[n_s:, n_s:].trace())
    long = [total / state.baseline[0] for total in state.baseline]
    jump = group.left @ mean_shown[:n_s] - [long[1 + axis] for axis in axes]
    change_mps = mean_shown[n_s:] - [long[4 + axis] for axis in axes]
    squared, along = (jump * jump).sum(axis=1).tolist(), (jump @ change_mps).tolist()
    squared_v = float(change_mps @ change_mps)
    # V = var e + 2 c cov(e, v) + c² var v; J = |Δē + c Δv̄|²; each with the best c
    return [
        group.offsets[k]
        + _compute_cost(
            count,
            _remove_drag(variance[k], covariance[k], variance_v),
            _remove_drag(squared[k], along[k], squared_v),
            noise_mps2,
            jump_mps2,
        )
        for k in range(len(group.left))
    ]


def _remove_drag(left: float, with_velocity: float, speed: float) -> float:
    """Return the smallest value of left + 2 c with_velocity + c² speed, for a drag c within [0, c_max]."""
    # c = -with_velocity / speed
    drag_1ps = min(max(-with_velocity / speed, 0.0), DRAG_1PS) if speed > 0.0 else 0.0
    return max(left + 2.0 * drag_1ps * with_velocity + drag_1ps**2 * speed, 0.0)


def _compute_bound(tick: Observation, parameters: EnvelopeParameters) -> float:
    """Compute the bound of the evidence, by the time that is left to brake before a wall."""
    left_s = FAR_S
    for approach in list_approaches(tick, parameters, tick.velocity_mps):
        speed_mps = approach.speed_mps
        # t = (x - v T - v² / 2 a) / v
        left_s = min(left_s, approach.distance_m / speed_mps - REACTION_S - speed_mps / (2.0 * approach.brake_mps2))
    return NEAR + (FAR - NEAR) * max(left_s, 0.0) / FAR_S
