"""Likelihood of a recorded axis under one of the plants, by the innovations of a Kalman filter.

The two plants are continuous motions under white noise, with the parameters that a flight can show:

    drag-lag              p' = v,  v' = a − c v + b + h + w,  T a' = g u(t − d) − a,  b' = n,  h' = −h / T_h + m
    velocity-reference    `uavctl.smpc.plant`, with input u(t − d) + e

w, e, n and m are white; the gust h is there on request. The dead time d shifts the inputs and is no part of the motion.

The motion is linear, so the filter steps from position to position; the effect of all inputs in between is summed
beforehand. So are its gains, which depend on the times alone. All times are counted in units of half a millisecond, so
few different lengths occur, and each transition is a product of powers of one unit's. Several parameter vectors, of
several axes, are filtered at once: the gradients of three axes cost one pass.

ArduPilot limits the jerk of its reference, so its acceleration moves towards each setpoint no faster. North and east
share one limit (PSC_JERK_XY), so setpoints within it on each axis may exceed it together; the reference never reaches
those. Down has its own limit (PSC_JERK_Z).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import ClassVar, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from uavctl.arrays import Array, Flags
from uavctl.lab.identify.history import Stretch

DRAG_LAG, VELOCITY_REFERENCE = "drag-lag", "velocity-reference"


class FreeParameter(NamedTuple):
    """Fitted parameter with its bounds."""

    name: str  # with its unit
    lower: float  # lower bound
    upper: float  # upper bound
    logarithmic: bool  # whether its logarithm is fitted

    def to_search_scale(self, value: float) -> float:
        """Return a value, clipped to the bounds, on the scale of the search."""
        value = min(max(value, self.lower), self.upper)
        return math.log(value) if self.logarithmic else value

    def from_search_scale(self, scaled: float) -> float:
        """Return the value of a number on the scale of the search."""
        return math.exp(scaled) if self.logarithmic else scaled


class LinearMotion(NamedTuple):
    """x' = A x + B u + white noise of intensity S, for k parameter vectors."""

    a: Array  # (k, n, n)
    b: Array  # (k, n)
    noise: Array  # S (k, n, n)


class AxisModel(Protocol):
    """Interface of a plant of one axis; position is the first state, velocity the second."""

    @property
    def name(self) -> str:
        """Name as in `plant.model`."""

    @property
    def free(self) -> tuple[FreeParameter, ...]:
        """Parameters that are fitted."""

    @property
    def start_std(self) -> tuple[float, ...]:
        """Standard deviation of each state where a stretch begins."""

    @property
    def starts(self) -> tuple[dict[str, float], ...]:
        """Values to start the search with, by name."""

    def motion(self, parameters: Array) -> LinearMotion:
        """Return the motion for k parameter vectors (k, len(free))."""


# The lag's pole stays above the drag's, as a motion does not show which pole is which.
_LAG = FreeParameter("lag_s", 0.01, 0.6, True)
_DRAG = FreeParameter("drag_1ps", -0.1, 1.5, False)
_GAIN = FreeParameter("gain", 0.2, 5.0, False)
_WIND = FreeParameter("wind_mps2_rts", 1e-4, 10.0, True)
_NOISE = FreeParameter("noise_m", 1e-3, 1.0, True)
_INPUT = FreeParameter("input_mps2_rts", 1e-3, 10.0, True)
_DRIFT = FreeParameter("drift_mps2_rts", 1e-3, 10.0, True)
_GUST = FreeParameter("gust_mps2", 1e-3, 10.0, True)
_GUST_TIME = FreeParameter("gust_s", 0.05, 10.0, True)  # a gust that lasts longer is a drift of the bias
_MOTION_STD = (10.0, 2.0, 2.0)  # of position, velocity and acceleration


@dataclass(frozen=True)
class DragLagAxis:
    """Plant of model drag-lag."""

    drifts: bool  # whether the bias is a random walk, as the estimator's is with `bias_drift`, and not a constant
    has_gusts: bool = False
    name: ClassVar[str] = DRAG_LAG

    @property
    def start_std(self) -> tuple[float, ...]:
        """Standard deviation of position, velocity, acceleration, bias, and gust, where a stretch begins."""
        return (*_MOTION_STD, *((0.5, 0.5) if self.has_gusts else (0.5,)))

    @property
    def free(self) -> tuple[FreeParameter, ...]:
        """Lag, drag, gain and noises."""
        gusts = (_GUST, _GUST_TIME) if self.has_gusts else ()
        return (_LAG, _DRAG, _GAIN, _WIND, _NOISE, *((_DRIFT,) if self.drifts else ()), *gusts)

    @property
    def starts(self) -> tuple[dict[str, float], ...]:
        """Two starts, with little and with much drag, as the likelihood has more than one maximum."""
        start_values = {"lag_s": 0.2, "gain": 1.0, "wind_mps2_rts": 0.05, "noise_m": 0.01, "drift_mps2_rts": 0.05}
        start_values |= {"gust_mps2": 0.1, "gust_s": 0.5}
        return tuple({**start_values, "drag_1ps": drag} for drag in (0.1, 1.0))

    def motion(self, parameters: Array) -> LinearMotion:
        """Return the motion of the states (p, v, a, b), and h behind them."""
        count, lag_s, size = len(parameters), np.exp(parameters[:, 0]), len(self.start_std)
        a, b, noise = np.zeros((count, size, size)), np.zeros((count, size)), np.zeros((count, size, size))
        a[:, 0, 1] = a[:, 1, 2] = a[:, 1, 3] = 1.0
        a[:, 1, 1] = -parameters[:, 1]
        a[:, 2, 2] = -1.0 / lag_s
        b[:, 2] = parameters[:, 2] / lag_s
        noise[:, 1, 1] = np.exp(2.0 * parameters[:, 3])
        if self.drifts:
            noise[:, 3, 3] = np.exp(2.0 * parameters[:, 5])
        if self.has_gusts:
            # Var h = s²:  m has the intensity 2 s² / T_h
            rate_1ps = np.exp(-parameters[:, -1])
            a[:, 1, 4], a[:, 4, 4] = 1.0, -rate_1ps
            noise[:, 4, 4] = 2.0 * rate_1ps * np.exp(2.0 * parameters[:, -2])
        return LinearMotion(a, b, noise)


@dataclass(frozen=True)
class ReferenceAxis:
    """Plant of model velocity-reference with known loop gains."""

    position_1ps: float  # gain kp of the position loop [1/s]
    velocity_1ps: float  # gain kv of the velocity loop [1/s]
    integral_1ps2: float  # integral gain ki of the velocity loop [1/s²]
    name: ClassVar[str] = VELOCITY_REFERENCE
    free: ClassVar[tuple[FreeParameter, ...]] = (_LAG, _DRAG, _WIND, _NOISE, _INPUT, _DRIFT)
    start_std: ClassVar[tuple[float, ...]] = (*_MOTION_STD, 0.5, 0.5, 0.5)
    starts: ClassVar[tuple[dict[str, float], ...]] = (
        {
            "lag_s": 0.1,
            "drag_1ps": 0.2,
            "wind_mps2_rts": 0.02,
            "noise_m": 0.01,
            "input_mps2_rts": 0.05,
            "drift_mps2_rts": 0.05,
        },
    )

    def motion(self, parameters: Array) -> LinearMotion:
        """Return the motion of the states (p, v, a, q, s, i)."""
        count, rate_1ps = len(parameters), np.exp(-parameters[:, 0])
        kp, kv, ki = self.position_1ps, self.velocity_1ps, self.integral_1ps2
        a, b, noise = np.zeros((count, 6, 6)), np.zeros((count, 6)), np.zeros((count, 6, 6))
        a[:, 0, 1] = a[:, 1, 2] = a[:, 3, 4] = 1.0
        a[:, 1, 1] = -parameters[:, 1]
        a[:, 2] = rate_1ps[:, None] * np.array([0.0, 0.0, -1.0, kv * kp, kv, 1.0])
        a[:, 4] = -a[:, 1]
        a[:, 5, 3:5] = ki * kp, ki
        b[:, 2], b[:, 4] = rate_1ps, 1.0
        directions = np.zeros((3, count, 6))  # effect of wind, input error and drift on the states
        directions[0, :, 1], directions[0, :, 4] = 1.0, -1.0
        directions[1] = b
        directions[2, :, 2] = directions[2, :, 5] = 1.0
        for direction, column in zip(directions, (2, 4, 5), strict=True):
            scaled_direction = np.exp(parameters[:, column])[:, None] * direction
            noise += scaled_direction[:, :, None] * scaled_direction[:, None, :]
        return LinearMotion(a, b, noise)


def make_parameters(model: AxisModel, values: dict[str, float]) -> Array:
    """Return the parameter vector of values by name; names that the model lacks are ignored."""
    return np.array([parameter.to_search_scale(values[parameter.name]) for parameter in model.free])


def get_values(model: AxisModel, parameters: Sequence[float]) -> dict[str, float]:
    """Return the values of a parameter vector by name."""
    return {
        parameter.name: parameter.from_search_scale(scaled)
        for parameter, scaled in zip(model.free, parameters, strict=True)
    }


_RAMP_STEP_S = 0.01  # a ramp of 5 m/s³ rises by 0.05 m/s² in it


def ramp_setpoints(stretch: Stretch, level_mps3: float, down_mps3: float) -> Stretch:
    """Return the stretch with setpoints ramped by a jerk limit instead of steps; it begins at its first setpoint.

    Args:
        level_mps3: Jerk limit of north and east together [m/s³].
        down_mps3: Jerk limit of down [m/s³]; without limits the stretch is unchanged.
    """
    if math.isinf(level_mps3) and math.isinf(down_mps3):
        return stretch
    times_s, inputs = [float(stretch.input_times_s[0])], [stretch.inputs_mps2[0]]
    accel = stretch.inputs_mps2[0]
    ends_s = [*stretch.input_times_s[1:], np.inf]
    for (now_s, end_s), setpoint in zip(
        pairwise([stretch.input_times_s[0], *ends_s]), stretch.inputs_mps2, strict=True
    ):
        while now_s < end_s and np.any(accel != setpoint):
            step_s = min(_RAMP_STEP_S, end_s - now_s)
            next_accel = _step_towards(accel, setpoint, level_mps3 * step_s, down_mps3 * step_s)
            times_s.append(now_s)
            inputs.append(0.5 * (accel + next_accel))
            accel, now_s = next_accel, now_s + step_s
        if now_s < end_s:
            times_s.append(now_s)
            inputs.append(setpoint)
    return replace(stretch, input_times_s=np.array(times_s), inputs_mps2=np.array(inputs))


def _step_towards(accel: Array, setpoint: Array, level_mps2: float, down_mps2: float) -> Array:
    """Return the acceleration after a step of limited size towards the setpoint."""
    change = setpoint - accel
    level = float(np.hypot(change[0], change[1]))
    level_share = min(1.0, level_mps2 / level) if level > 0.0 else 1.0
    steps = np.array([level_share * change[0], level_share * change[1], np.clip(change[2], -down_mps2, down_mps2)])
    return np.where(np.abs(change - steps) > 0.0, accel + steps, setpoint)


Counts = NDArray[np.int64]

OUTLIER = 5.0  # standard deviations beyond which an innovation counts by its size and not by its square (Huber)
TIME_UNIT_S = 5e-4  # a vehicle at 1.5 m/s goes 0.4 mm in half of it, less than the noise of any camera
_SERIES_ORDER = 8  # of the series of one time unit; every lag is at least twenty units long
_GAUSS_X, _GAUSS_W = np.polynomial.legendre.leggauss(3)


@dataclass(frozen=True, eq=False)
class Timeline:
    """Stretch of some axes, cut at each change of an input and at each capture."""

    lengths: Counts  # (n,) of the segments [time units]
    inputs_mps2: Array  # (n, axes), constant in each [m/s²]
    measured: Counts  # (m,), the segment at whose end each position was captured
    positions_m: Array  # (m, axes) [m]
    counts_for_fit: Flags  # (m,), whether each counts for the likelihood; the filter uses all

    @cached_property
    def captured(self) -> Counts:
        """Capture time of each position, from the first one (m,) [time units]."""
        return np.cumsum(self.lengths)[self.measured]

    @cached_property
    def spacings(self) -> tuple[Counts, Counts]:
        """Distinct times between two positions [time units], and the index of each spacing into them (m - 1,)."""
        distinct, index_of = np.unique(np.diff(self.captured), return_inverse=True)
        return distinct, index_of

    @cached_property
    def segments(self) -> tuple[Counts, Counts, Counts]:
        """Distinct pairs of a segment's length and its distance to the next position, and each segment's index (n,)."""
        ends = np.cumsum(self.lengths)
        rests = self.captured[np.searchsorted(self.measured, np.arange(len(ends)))] - ends
        base = int(rests.max()) + 1
        distinct, index_of = np.unique(self.lengths * base + rests, return_inverse=True)
        return distinct // base, distinct % base, index_of


class Transition(NamedTuple):
    """Transition of the motion over different lengths, for k parameter vectors."""

    transition: Array  # (lengths, k, n, n)
    input_effect: Array  # (lengths, k, n), of a constant input of 1
    noise_cov: Array  # covariance of the noise (lengths, k, n, n)


@dataclass(frozen=True, eq=False)
class FilterResult:
    """States and innovations of a timeline under one parameter vector."""

    driven: Array  # (m, n), effect of the inputs alone since the start
    undriven: Array  # (m, n), corrected state minus `driven`
    innovations_m: Array  # (m,), position minus its prediction [m]
    stds_m: Array  # (m,), their standard deviations by the filter [m]
    covs: Array  # (m, n, n), covariance of the corrected state


class Trial(NamedTuple):
    """Parameter vectors of an axis whose likelihood is computed."""

    axis_index: int  # column of the axis in the timeline
    model: AxisModel  # all trials of one pass have the same number of states
    parameters: Array  # (k, l)


class Likelihood(NamedTuple):
    """Likelihood of an axis' positions under k parameter vectors."""

    deviances: Array  # -2 log likelihood, up to a constant (k,)
    innovations_m: Array  # of the positions that count (m, k) [m]
    variances_m2: Array  # of these innovations, by the filter (m, k) [m²]


class FilterPass(NamedTuple):
    """Result of one pass of the filter over a timeline, for k parameter vectors."""

    deviances: Array  # -2 log likelihood, up to a constant (k,)
    states: Array  # after the correction by each position (m, k, n)
    innovations_m: Array  # (m, k) [m]
    variances_m2: Array  # of the innovations (m, k) [m²]
    covs: Array  # of the states (m, k, n, n)


def make_timeline(stretch: Stretch, axes: Sequence[int], dead_time_s: float) -> Timeline:
    """Make the timeline of some axes, with inputs that act `dead_time_s` after they were sent."""
    columns = list(axes)
    captured, first_index = np.unique(_to_time_units(stretch.times_s), return_index=True)
    changes = _to_time_units(stretch.input_times_s + dead_time_s)
    begin, end = captured[0], captured[-1]
    cuts = np.unique(np.concatenate([changes[(changes > begin) & (changes < end)], captured]))
    input_index = np.clip(np.searchsorted(changes, cuts[:-1], side="right") - 1, 0, None)
    return Timeline(
        lengths=np.concatenate([[0], np.diff(cuts)]),
        inputs_mps2=np.vstack([np.zeros((1, len(columns))), stretch.inputs_mps2[input_index][:, columns]]),
        measured=np.searchsorted(cuts, captured),
        positions_m=stretch.positions_m[first_index][:, columns],
        counts_for_fit=np.ones(len(first_index), dtype=np.bool_)
        if stretch.counts_for_fit is None
        else stretch.counts_for_fit[first_index],
    )


def compute_likelihood(parts: Sequence[Timeline], trials: Sequence[Trial]) -> tuple[Likelihood, ...]:
    """Return the likelihood of each trial over all parts, computed in one pass."""
    counts = [len(trial.parameters) for trial in trials]
    axis_indices = np.repeat([trial.axis_index for trial in trials], counts)
    motion = LinearMotion(
        *map(np.concatenate, zip(*(trial.model.motion(trial.parameters) for trial in trials), strict=True))
    )
    noise_variance = np.concatenate([get_noise_variance(trial.model, trial.parameters) for trial in trials])
    passes = [_run_pass(part, axis_indices, motion, noise_variance, trials[0].model.start_std) for part in parts]
    bounds = np.cumsum([0, *counts])

    def select_counted(rows: Sequence[Array]) -> list[Array]:
        return [row[part.counts_for_fit] for row, part in zip(rows, parts, strict=True)]

    return tuple(
        Likelihood(
            deviances=np.sum([trial.deviances[begin:end] for trial in passes], axis=0),
            innovations_m=np.concatenate(select_counted([trial.innovations_m[:, begin:end] for trial in passes])),
            variances_m2=np.concatenate(select_counted([trial.variances_m2[:, begin:end] for trial in passes])),
        )
        for begin, end in pairwise(bounds)
    )


def run_filter(part: Timeline, model: AxisModel, parameters: Array) -> FilterResult:
    """Return states and innovations of one part's first axis under one parameter vector (l,)."""
    motion, axis_indices = model.motion(parameters[None]), np.zeros(1, dtype=np.int64)
    result = _run_pass(part, axis_indices, motion, get_noise_variance(model, parameters[None]), model.start_std)
    driven = _compute_driven_states(part, axis_indices, motion)[:, 0]
    return FilterResult(
        driven,
        result.states[:, 0] - driven,
        result.innovations_m[:, 0],
        np.sqrt(result.variances_m2[:, 0]),
        result.covs[:, 0],
    )


def compute_transition(motion: LinearMotion, lengths: Counts) -> Transition:
    """Return the transition over some lengths (n,) [time units], by their binary digits."""
    transition, input_effect, noise_cov = _compute_unit_transition(motion)
    count, size = len(lengths), transition.shape[-1]
    transitions = np.tile(np.eye(size), (count, len(transition), 1, 1))
    input_effects, noise_covs = np.zeros((count, *input_effect.shape)), np.zeros((count, *noise_cov.shape))
    for digit in range(int(lengths.max(initial=0)).bit_length()):
        has_digit = (lengths >> digit) & 1 == 1
        transitions[has_digit] = transition @ transitions[has_digit]
        input_effects[has_digit] = input_effect + (transition @ input_effects[has_digit][..., None])[..., 0]
        noise_covs[has_digit] = noise_cov + transition @ noise_covs[has_digit] @ transition.swapaxes(1, 2)
        input_effect = input_effect + (transition @ input_effect[..., None])[..., 0]
        noise_cov = noise_cov + transition @ noise_cov @ transition.swapaxes(1, 2)
        transition = transition @ transition
    return Transition(transitions, input_effects, noise_covs)


def _to_time_units(times_s: Array) -> Counts:
    return np.rint(times_s / TIME_UNIT_S).astype(np.int64)


def _compute_unit_transition(motion: LinearMotion) -> tuple[Array, Array, Array]:
    """Return transition, effect of a constant input, and covariance of the noise, for one time unit."""
    transition, integral = _compute_exponential(motion.a, TIME_UNIT_S)
    noise_cov = np.zeros_like(motion.noise)
    for node, weight in zip(_GAUSS_X, _GAUSS_W, strict=True):
        partial, _ = _compute_exponential(motion.a, TIME_UNIT_S * (1.0 + float(node)) / 2.0)
        noise_cov += TIME_UNIT_S * float(weight) / 2.0 * (partial @ motion.noise @ partial.swapaxes(1, 2))
    return transition, (integral @ motion.b[..., None])[..., 0], noise_cov


def _compute_exponential(slope: Array, time_s: float) -> tuple[Array, Array]:
    """Return exp(A t) and its integral from 0 to t, (k, n, n) each."""
    term = np.broadcast_to(np.eye(slope.shape[-1]), slope.shape)
    power, integral = term.copy(), time_s * term
    for order in range(1, _SERIES_ORDER + 1):
        term = term @ slope * (time_s / order)
        power += term
        integral = integral + term * (time_s / (order + 1))
    return power, integral


def get_noise_variance(model: AxisModel, parameters: Array) -> Array:
    """Return the variance of a position's noise (k,) [m²]."""
    return np.exp(2.0 * parameters[:, [parameter.name for parameter in model.free].index("noise_m")])


def _run_pass(
    part: Timeline, axis_indices: Counts, motion: LinearMotion, noise_variance: Array, start_std: Sequence[float]
) -> FilterPass:
    """Run the filter over a part, for k parameter vectors of the axes `axis_indices` (k,)."""
    lengths, index_of = part.spacings
    transitions, _, noise_covs = compute_transition(motion, lengths)
    gains, variances, covs = _compute_gains(transitions, noise_covs, index_of, noise_variance, start_std)
    input_effects = _compute_input_effects(part, axis_indices, motion)
    positions_m = part.positions_m[:, axis_indices]
    upper = OUTLIER * np.sqrt(variances)
    lower = -upper
    state = np.zeros((*motion.b.shape, 1))
    state[:, 0, 0] = positions_m[0]
    innovations, states = np.empty_like(variances), np.empty_like(gains)
    for index, position_m in enumerate(positions_m):
        if index:
            state = transitions[index_of[index - 1]] @ state
            state += input_effects[index]
        innovation = position_m - state[:, 0, 0]
        innovations[index] = innovation
        # Huber: beyond the bounds an innovation corrects the state no more than at them.
        clipped = np.minimum(np.maximum(innovation, lower[index]), upper[index])
        state = state + (gains[index] * clipped[:, None])[:, :, None]
        states[index] = state[:, :, 0]
    scaled = np.abs(innovations) / np.sqrt(variances)
    deviances = np.where(scaled < OUTLIER, scaled**2, OUTLIER * (2.0 * scaled - OUTLIER)) + np.log(variances)
    return FilterPass(deviances[part.counts_for_fit].sum(axis=0), states, innovations, variances, covs)


def _compute_gains(
    transitions: Array, noise_covs: Array, index_of: Counts, noise_variance: Array, start_std: Sequence[float]
) -> tuple[Array, Array, Array]:
    """Return gain (m, k, n), variance of the innovation (m, k) and covariance after it (m, k, n, n) at each position.

    They depend on the times alone.
    """
    transposed = np.ascontiguousarray(transitions.swapaxes(-1, -2))
    size, count = len(start_std), len(noise_variance)
    cov = np.tile(np.diag(np.square(start_std)), (count, 1, 1))
    gains, variances = np.empty((len(index_of) + 1, count, size)), np.empty((len(index_of) + 1, count))
    covs = np.empty((len(index_of) + 1, count, size, size))
    for index in range(len(index_of) + 1):
        if index:
            length_index = index_of[index - 1]
            cov = transitions[length_index] @ cov @ transposed[length_index]
            cov += noise_covs[length_index]
        variance = variances[index]
        np.add(cov[:, 0, 0], noise_variance, out=variance)
        gain = gains[index]
        np.divide(cov[:, :, 0], variance[:, None], out=gain)
        # P = P - K c'P
        cov = cov - gain[:, :, None] * cov[:, None, 0, :]
        covs[index] = cov
    return gains, variances, covs


def _compute_input_effects(part: Timeline, axis_indices: Counts, motion: LinearMotion) -> Array:
    """Return the effect at each position of the inputs since the position before (m, k, n, 1)."""
    lengths, distances, index_of = part.segments
    distinct, input_index = np.unique(lengths, return_inverse=True)
    effects = compute_transition(motion, distinct).input_effect[input_index]
    distinct, distance_index = np.unique(distances, return_inverse=True)
    effects_at_positions = (compute_transition(motion, distinct).transition[distance_index] @ effects[..., None])[
        index_of
    ]
    effects_at_positions *= part.inputs_mps2[:, axis_indices, None, None]
    return np.add.reduceat(effects_at_positions, np.concatenate([[0], part.measured[:-1] + 1]), axis=0)


def _compute_driven_states(part: Timeline, axis_indices: Counts, motion: LinearMotion) -> Array:
    """Return the effect at each position of all inputs (m, k, n)."""
    lengths, index_of = part.spacings
    transitions, input_effects = (
        compute_transition(motion, lengths).transition,
        _compute_input_effects(part, axis_indices, motion),
    )
    states = np.empty(input_effects.shape)
    state = states[0] = input_effects[0]
    for index, length_index in enumerate(index_of):
        state = states[index + 1] = transitions[length_index] @ state + input_effects[index + 1]
    return states[..., 0]
