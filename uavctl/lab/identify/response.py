"""Likelihood of a recorded axis under one of the plants, by the innovations of a Kalman filter.

The two plants are continuous motions under white noise, with the parameters that a flight can show:

    drag-lag              p' = v,  v' = a − c v + b + w,  T a' = g u(t − d) − a,  b' = n
    velocity-reference    `uavctl.smpc.plant`, with input u(t − d) + e

w, e and n are white. The dead time d shifts the inputs and is no part of the motion.

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

from uavctl.arrays import Array
from uavctl.lab.identify.history import Stretch

DRAG_LAG, VELOCITY_REFERENCE = "drag-lag", "velocity-reference"


class Free(NamedTuple):
    """A parameter that is fitted, with its bounds."""

    name: str  # what it is, with its unit
    least: float  # least value
    most: float  # largest value
    logarithmic: bool  # whether its logarithm is what is fitted

    def inside(self, value: float) -> float:
        """Return the place of a value within the bounds, on the scale of the search."""
        value = min(max(value, self.least), self.most)
        return math.log(value) if self.logarithmic else value

    def outside(self, place: float) -> float:
        """Return the value at a place on the scale of the search."""
        return math.exp(place) if self.logarithmic else place


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
    def free(self) -> tuple[Free, ...]:
        """Parameters that are fitted."""

    @property
    def start_std(self) -> tuple[float, ...]:
        """Standard deviation of each state where a stretch begins."""

    @property
    def starts(self) -> tuple[dict[str, float], ...]:
        """Values to start the search with, by name."""

    def motion(self, parameters: Array) -> LinearMotion:
        """Return the motion for k parameter vectors (k, len(free))."""


# The lag's pole stays above the drag's: a motion does not tell which is whose.
_LAG = Free("lag_s", 0.01, 0.6, True)
_DRAG = Free("drag_1ps", -0.1, 1.5, False)
_GAIN = Free("gain", 0.2, 5.0, False)
_WIND = Free("wind_mps2_rts", 1e-4, 10.0, True)
_NOISE = Free("noise_m", 1e-3, 1.0, True)
_INPUT = Free("input_mps2_rts", 1e-3, 10.0, True)
_DRIFT = Free("drift_mps2_rts", 1e-3, 10.0, True)
_MOTION_STD = (10.0, 2.0, 2.0)  # of position, velocity and acceleration


@dataclass(frozen=True)
class DragLagAxis:
    """Plant of model drag-lag."""

    drifts: bool  # whether the bias is a random walk, as the estimator's is with `bias_drift`, and not a constant
    name: ClassVar[str] = DRAG_LAG
    start_std: ClassVar[tuple[float, ...]] = (*_MOTION_STD, 0.5)

    @property
    def free(self) -> tuple[Free, ...]:
        """Lag, drag, gain and noises."""
        return (_LAG, _DRAG, _GAIN, _WIND, _NOISE, *((_DRIFT,) if self.drifts else ()))

    @property
    def starts(self) -> tuple[dict[str, float], ...]:
        """Two starts, with little and with much drag, as the likelihood has more than one maximum."""
        rest = {"lag_s": 0.2, "gain": 1.0, "wind_mps2_rts": 0.05, "noise_m": 0.01, "drift_mps2_rts": 0.05}
        return tuple({**rest, "drag_1ps": drag} for drag in (0.1, 1.0))

    def motion(self, parameters: Array) -> LinearMotion:
        """Return the motion of the states (p, v, a, b)."""
        count, lag_s = len(parameters), np.exp(parameters[:, 0])
        a, b, noise = np.zeros((count, 4, 4)), np.zeros((count, 4)), np.zeros((count, 4, 4))
        a[:, 0, 1] = a[:, 1, 2] = a[:, 1, 3] = 1.0
        a[:, 1, 1] = -parameters[:, 1]
        a[:, 2, 2] = -1.0 / lag_s
        b[:, 2] = parameters[:, 2] / lag_s
        noise[:, 1, 1] = np.exp(2.0 * parameters[:, 3])
        if self.drifts:
            noise[:, 3, 3] = np.exp(2.0 * parameters[:, 5])
        return LinearMotion(a, b, noise)


@dataclass(frozen=True)
class ReferenceAxis:
    """Plant of model velocity-reference with known loop gains."""

    position_1ps: float  # gain kp of the position loop [1/s]
    velocity_1ps: float  # gain kv of the velocity loop [1/s]
    integral_1ps2: float  # integral gain ki of the velocity loop [1/s²]
    name: ClassVar[str] = VELOCITY_REFERENCE
    free: ClassVar[tuple[Free, ...]] = (_LAG, _DRAG, _WIND, _NOISE, _INPUT, _DRIFT)
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
        along = np.zeros((3, count, 6))  # what wind, input error and drift push
        along[0, :, 1], along[0, :, 4] = 1.0, -1.0
        along[1] = b
        along[2, :, 2] = along[2, :, 5] = 1.0
        for push, place in zip(along, (2, 4, 5), strict=True):
            pushed = np.exp(parameters[:, place])[:, None] * push
            noise += pushed[:, :, None] * pushed[:, None, :]
        return LinearMotion(a, b, noise)


def places(model: AxisModel, values: dict[str, float]) -> Array:
    """Return the parameter vector of values by name; names that the model lacks are ignored."""
    return np.array([one.inside(values[one.name]) for one in model.free])


def values(model: AxisModel, parameters: Sequence[float]) -> dict[str, float]:
    """Return the values of a parameter vector by name."""
    return {one.name: one.outside(place) for one, place in zip(model.free, parameters, strict=True)}


_PART_S = 0.01  # a ramp at 5 m/s³ is 0.05 m/s² high in it


def ramped(stretch: Stretch, level_mps3: float, down_mps3: float) -> Stretch:
    """Return the stretch with setpoints ramped by a jerk limit instead of steps; it begins at its first setpoint.

    Args:
        level_mps3: Jerk limit of north and east together [m/s³].
        down_mps3: Jerk limit of down [m/s³]; without limits it comes back as it is.
    """
    if math.isinf(level_mps3) and math.isinf(down_mps3):
        return stretch
    times_s, inputs = [float(stretch.input_times_s[0])], [stretch.inputs_mps2[0]]
    accel = stretch.inputs_mps2[0]
    ends_s = [*stretch.input_times_s[1:], np.inf]
    for (now_s, end_s), wanted in zip(pairwise([stretch.input_times_s[0], *ends_s]), stretch.inputs_mps2, strict=True):
        while now_s < end_s and np.any(accel != wanted):
            part_s = min(_PART_S, end_s - now_s)
            after = _towards(accel, wanted, level_mps3 * part_s, down_mps3 * part_s)
            times_s.append(now_s)
            inputs.append(0.5 * (accel + after))
            accel, now_s = after, now_s + part_s
        if now_s < end_s:
            times_s.append(now_s)
            inputs.append(wanted)
    return replace(stretch, input_times_s=np.array(times_s), inputs_mps2=np.array(inputs))


def _towards(accel: Array, wanted: Array, level_mps2: float, down_mps2: float) -> Array:
    """Return the acceleration after a step towards the wanted one, limited in its change."""
    change = wanted - accel
    level = float(np.hypot(change[0], change[1]))
    share = min(1.0, level_mps2 / level) if level > 0.0 else 1.0
    steps = np.array([share * change[0], share * change[1], np.clip(change[2], -down_mps2, down_mps2)])
    return np.where(np.abs(change - steps) > 0.0, accel + steps, wanted)


Counts = NDArray[np.int64]

OUTLIER = 5.0  # standard deviations beyond which an innovation counts by its size and not by its square (Huber)
INSTANT_S = 5e-4  # a vehicle at 1.5 m/s goes 0.4 mm in half of it, less than the noise of any camera
_ORDER = 8  # of the series of one instant, in which no lag is shorter than twenty
_GAUSS_X, _GAUSS_W = np.polynomial.legendre.leggauss(3)


@dataclass(frozen=True, eq=False)
class Timeline:
    """A stretch of some axes, cut wherever an input changes or a position was captured."""

    lengths: Counts  # (n,) of the parts [instants]
    inputs_mps2: Array  # (n, axes), held in each [m/s²]
    measured: Counts  # (m,), the part at whose end each position was captured
    positions_m: Array  # (m, axes) [m]
    counted: NDArray[np.bool_]  # (m,), whether each counts for the likelihood; the filter takes all

    @cached_property
    def captured(self) -> Counts:
        """Capture time of each position, counted from the first one (m,) [instants]."""
        return np.cumsum(self.lengths)[self.measured]

    @cached_property
    def spacings(self) -> tuple[Counts, Counts]:
        """Distinct times between two positions [instants], and the index of each into them (m - 1,)."""
        different, which = np.unique(np.diff(self.captured), return_inverse=True)
        return different, which

    @cached_property
    def pieces(self) -> tuple[Counts, Counts, Counts]:
        """Distinct lengths of pieces and of their distance to the next position; each one's index into them (n,)."""
        ends = np.cumsum(self.lengths)
        rests = self.captured[np.searchsorted(self.measured, np.arange(len(ends)))] - ends
        most = int(rests.max()) + 1
        different, which = np.unique(self.lengths * most + rests, return_inverse=True)
        return different // most, different % most, which


class Advance(NamedTuple):
    """Transition of the motion over different lengths, for k parameter vectors."""

    move: Array  # (lengths, k, n, n)
    push: Array  # (lengths, k, n), by a held input of one
    spread: Array  # covariance that the noise makes (lengths, k, n, n)


@dataclass(frozen=True, eq=False)
class Filtered:
    """States and innovations of a timeline under one parameter vector."""

    driven: Array  # (m, n), what the inputs alone have done since the begin
    rest: Array  # (m, n), the state without that, with the position there
    innovations_m: Array  # (m,): position minus what was predicted of it, in the order of capture [m]
    stds_m: Array  # (m,), standard deviation that the filter gives each [m]


class Tried(NamedTuple):
    """Parameter vectors of an axis, to be tried."""

    place: int  # of the axis among those of the timeline
    model: AxisModel  # the plant, with as many states as all that are tried in one pass
    parameters: Array  # (k, l)


class Likelihood(NamedTuple):
    """Likelihood of an axis' positions under k parameter vectors."""

    deviances: Array  # -2 log likelihood, up to a constant (k,)
    innovations_m: Array  # of each position that counts (m, k) [m]
    variances_m2: Array  # that the filter gives them (m, k) [m²]


class Passed(NamedTuple):
    """Result of one pass of the filter over a timeline, for k parameter vectors."""

    deviances: Array  # -2 log likelihood, up to a constant (k,)
    states: Array  # with the position there (m, k, n)
    innovations_m: Array  # (m, k) [m]
    variances_m2: Array  # of the innovations (m, k) [m²]


def timeline(stretch: Stretch, axes: Sequence[int], dead_time_s: float) -> Timeline:
    """Cut a stretch for some axes, with inputs that act `dead_time_s` after they were sent."""
    chosen = list(axes)
    captured, first = np.unique(_instants(stretch.times_s), return_index=True)
    changes = _instants(stretch.input_times_s + dead_time_s)
    begin, end = captured[0], captured[-1]
    cuts = np.unique(np.concatenate([changes[(changes > begin) & (changes < end)], captured]))
    held = np.clip(np.searchsorted(changes, cuts[:-1], side="right") - 1, 0, None)
    return Timeline(
        lengths=np.concatenate([[0], np.diff(cuts)]),
        inputs_mps2=np.vstack([np.zeros((1, len(chosen))), stretch.inputs_mps2[held][:, chosen]]),
        measured=np.searchsorted(cuts, captured),
        positions_m=stretch.positions_m[first][:, chosen],
        counted=np.ones(len(first), dtype=np.bool_) if stretch.counted is None else stretch.counted[first],
    )


def likelihood(parts: Sequence[Timeline], tried: Sequence[Tried]) -> tuple[Likelihood, ...]:
    """Return the likelihood of all parts of each axis that is tried, computed in one pass."""
    counts = [len(one.parameters) for one in tried]
    place = np.repeat([one.place for one in tried], counts)
    motion = LinearMotion(*map(np.concatenate, zip(*(one.model.motion(one.parameters) for one in tried), strict=True)))
    seen_var = np.concatenate([_seen_var(one.model, one.parameters) for one in tried])
    passed = [_pass(part, place, motion, seen_var, tried[0].model.start_std) for part in parts]
    edges = np.cumsum([0, *counts])

    def counted(rows: Sequence[Array]) -> list[Array]:
        return [row[part.counted] for row, part in zip(rows, parts, strict=True)]

    return tuple(
        Likelihood(
            deviances=np.sum([one.deviances[begin:end] for one in passed], axis=0),
            innovations_m=np.concatenate(counted([one.innovations_m[:, begin:end] for one in passed])),
            variances_m2=np.concatenate(counted([one.variances_m2[:, begin:end] for one in passed])),
        )
        for begin, end in pairwise(edges)
    )


def filtered(part: Timeline, model: AxisModel, parameters: Array) -> Filtered:
    """Return states and innovations of one part's first axis under one parameter vector (l,)."""
    motion, place = model.motion(parameters[None]), np.zeros(1, dtype=np.int64)
    passed = _pass(part, place, motion, _seen_var(model, parameters[None]), model.start_std)
    driven = _driven(part, place, motion)[:, 0]
    return Filtered(
        driven, passed.states[:, 0] - driven, passed.innovations_m[:, 0], np.sqrt(passed.variances_m2[:, 0])
    )


def advance(motion: LinearMotion, lengths: Counts) -> Advance:
    """Return the transition over some lengths (n,) [instants], by the binary digits of each."""
    move, push, spread = _instant(motion)
    count, size = len(lengths), move.shape[-1]
    moves = np.tile(np.eye(size), (count, len(move), 1, 1))
    pushes, spreads = np.zeros((count, *push.shape)), np.zeros((count, *spread.shape))
    for digit in range(int(lengths.max(initial=0)).bit_length()):
        chosen = (lengths >> digit) & 1 == 1
        moves[chosen] = move @ moves[chosen]
        pushes[chosen] = push + (move @ pushes[chosen][..., None])[..., 0]
        spreads[chosen] = spread + move @ spreads[chosen] @ move.swapaxes(1, 2)
        push = push + (move @ push[..., None])[..., 0]
        spread = spread + move @ spread @ move.swapaxes(1, 2)
        move = move @ move
    return Advance(moves, pushes, spreads)


def _instants(times_s: Array) -> Counts:
    return np.rint(times_s / INSTANT_S).astype(np.int64)


def _instant(motion: LinearMotion) -> tuple[Array, Array, Array]:
    """Return transition, effect of a held input, and covariance of the noise, for one instant."""
    move, integral = _series(motion.a, INSTANT_S)
    spread = np.zeros_like(motion.noise)
    for node, weight in zip(_GAUSS_X, _GAUSS_W, strict=True):
        left, _ = _series(motion.a, INSTANT_S * (1.0 + float(node)) / 2.0)
        spread += INSTANT_S * float(weight) / 2.0 * (left @ motion.noise @ left.swapaxes(1, 2))
    return move, (integral @ motion.b[..., None])[..., 0], spread


def _series(slope: Array, time_s: float) -> tuple[Array, Array]:
    """Return exp(A t) and its integral from 0 to t, (k, n, n) each."""
    term = np.broadcast_to(np.eye(slope.shape[-1]), slope.shape)
    power, integral = term.copy(), time_s * term
    for order in range(1, _ORDER + 1):
        term = term @ slope * (time_s / order)
        power += term
        integral = integral + term * (time_s / (order + 1))
    return power, integral


def _seen_var(model: AxisModel, parameters: Array) -> Array:
    """Return the variance of a position's noise (k,) [m²]."""
    return np.exp(2.0 * parameters[:, [one.name for one in model.free].index("noise_m")])


def _pass(part: Timeline, place: Counts, motion: LinearMotion, seen_var: Array, start_std: Sequence[float]) -> Passed:
    """Run the filter over a part, for each of k parameter vectors of the axes at `place` (k,)."""
    different, which = part.spacings
    moves, _, spreads = advance(motion, different)
    gains, variances = _gains(moves, spreads, which, seen_var, start_std)
    pushed = _pushed(part, place, motion)
    positions_m = part.positions_m[:, place]
    most = OUTLIER * np.sqrt(variances)
    least = -most
    state = np.zeros((*motion.b.shape, 1))
    state[:, 0, 0] = positions_m[0]
    innovations, states = np.empty_like(variances), np.empty_like(gains)
    for index, position_m in enumerate(positions_m):
        if index:
            state = moves[which[index - 1]] @ state
            state += pushed[index]
        innovation = position_m - state[:, 0, 0]
        innovations[index] = innovation
        # Beyond the bounds an innovation counts by its size: what moves the state is no larger than they are.
        trusted = np.minimum(np.maximum(innovation, least[index]), most[index])
        state = state + (gains[index] * trusted[:, None])[:, :, None]
        states[index] = state[:, :, 0]
    size = np.abs(innovations) / np.sqrt(variances)
    likely = np.where(size < OUTLIER, size**2, OUTLIER * (2.0 * size - OUTLIER)) + np.log(variances)
    return Passed(likely[part.counted].sum(axis=0), states, innovations, variances)


def _gains(
    moves: Array, spreads: Array, which: Counts, seen_var: Array, start_std: Sequence[float]
) -> tuple[Array, Array]:
    """Return gain (m, k, n) and variance of the innovation (m, k) at each position; they depend on the times alone."""
    turned = np.ascontiguousarray(moves.swapaxes(-1, -2))
    size, count = len(start_std), len(seen_var)
    cov = np.tile(np.diag(np.square(start_std)), (count, 1, 1))
    gains, variances = np.empty((len(which) + 1, count, size)), np.empty((len(which) + 1, count))
    for index in range(len(which) + 1):
        if index:
            kind = which[index - 1]
            cov = moves[kind] @ cov @ turned[kind]
            cov += spreads[kind]
        variance = variances[index]
        np.add(cov[:, 0, 0], seen_var, out=variance)
        gain = gains[index]
        np.divide(cov[:, :, 0], variance[:, None], out=gain)
        cov = cov - gain[:, :, None] * cov[:, None, 0, :]
    return gains, variances


def _pushed(part: Timeline, place: Counts, motion: LinearMotion) -> Array:
    """Return the effect at each position of the inputs since the position before (m, k, n, 1)."""
    lengths, rests, which = part.pieces
    different, held = np.unique(lengths, return_inverse=True)
    pushes = advance(motion, different).push[held]
    different, after = np.unique(rests, return_inverse=True)
    carried = (advance(motion, different).move[after] @ pushes[..., None])[which]
    carried *= part.inputs_mps2[:, place, None, None]
    return np.add.reduceat(carried, np.concatenate([[0], part.measured[:-1] + 1]), axis=0)


def _driven(part: Timeline, place: Counts, motion: LinearMotion) -> Array:
    """Return the effect at each position of all inputs (m, k, n)."""
    different, which = part.spacings
    moves, pushed = advance(motion, different).move, _pushed(part, place, motion)
    states = np.empty(pushed.shape)
    state = states[0] = pushed[0]
    for index, kind in enumerate(which):
        state = states[index + 1] = moves[kind] @ state + pushed[index + 1]
    return states[..., 0]
