"""How likely a recorded axis is under one of the plants: the innovations of a Kalman filter.

The motion is linear, so the filter steps from position to position, however many inputs lie between: what they do is
summed beforehand. So are its gains, which come of the times alone. All times are counted in instants of half a
millisecond, so few different lengths occur, and each is a product of powers of one instant's motion. Several parameter
vectors, of several axes, go through at once: the gradients of three axes cost one pass.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from uavctl.identify.axis_model import AxisModel, LinearMotion
from uavctl.identify.history import Stretch

Array = NDArray[np.float64]
Counts = NDArray[np.int64]

OUTLIER = 5.0  # standard deviations beyond which an innovation counts by its size and not by its square (Huber)
INSTANT_S = 5e-4  # a vehicle at 1.5 m/s goes 0.4 mm in half of it, less than the noise of any camera
_ORDER = 8  # of the series of one instant, in which no lag is shorter than twenty
_GAUSS_X, _GAUSS_W = np.polynomial.legendre.leggauss(3)


@dataclass(frozen=True, eq=False)
class Timeline:
    """A stretch of some axes, cut where an input changes or a position was captured.

    Attributes:
        lengths: (n,) of the parts [instants].
        inputs_mps2: (n, axes), held in each [m/s²].
        measured: (m,), the part at whose end each position was captured.
        positions_m: (m, axes) [m].
        counted: (m,), whether each counts for the likelihood; the filter takes all.
    """

    lengths: Counts
    inputs_mps2: Array
    measured: Counts
    positions_m: Array
    counted: NDArray[np.bool_]

    @cached_property
    def captured(self) -> Counts:
        """Time of capture of each position, from the first one on (m,) [instants]."""
        return np.cumsum(self.lengths)[self.measured]

    @cached_property
    def spacings(self) -> tuple[Counts, Counts]:
        """Different times between two positions [instants], and which of them each is (m - 1,)."""
        different, which = np.unique(np.diff(self.captured), return_inverse=True)
        return different, which

    @cached_property
    def pieces(self) -> tuple[Counts, Counts, Counts]:
        """Different lengths of parts and times from their ends to the next position, and which of them each is (n,)."""
        ends = np.cumsum(self.lengths)
        rests = self.captured[np.searchsorted(self.measured, np.arange(len(ends)))] - ends
        most = int(rests.max()) + 1
        different, which = np.unique(self.lengths * most + rests, return_inverse=True)
        return different // most, different % most, which


class Advance(NamedTuple):
    """Motion over different lengths, for k parameter vectors.

    Attributes:
        move: (lengths, k, n, n).
        push: (lengths, k, n), by a held input of one.
        spread: Covariance that the noise makes (lengths, k, n, n).
    """

    move: Array
    push: Array
    spread: Array


@dataclass(frozen=True, eq=False)
class Filtered:
    """What the filter made of a timeline, under one parameter vector.

    Attributes:
        driven: (m, n), what the inputs alone have done since the begin.
        rest: (m, n), the state without that, with the position there.
        innovations_m: (m,): position minus what was predicted of it, in the order of capture [m].
        stds_m: (m,), standard deviation that the filter gives each [m].
    """

    driven: Array
    rest: Array
    innovations_m: Array
    stds_m: Array


class Tried(NamedTuple):
    """Parameter vectors of an axis.

    Attributes:
        place: Of the axis among those of the timeline.
        model: The plant, with as many states as all that are tried in one pass.
        parameters: (k, l).
    """

    place: int
    model: AxisModel
    parameters: Array


class Likelihood(NamedTuple):
    """How likely the positions of an axis are under k parameter vectors.

    Attributes:
        deviances: -2 log likelihood, up to a constant (k,).
        innovations_m: Of each position that counts (m, k) [m].
        variances_m2: That the filter gives them (m, k) [m²].
    """

    deviances: Array
    innovations_m: Array
    variances_m2: Array


class Passed(NamedTuple):
    """What the filter made of a timeline, for k parameter vectors.

    Attributes:
        deviances: -2 log likelihood, up to a constant (k,).
        states: With the position there (m, k, n).
        innovations_m: (m, k) [m].
        variances_m2: Of the innovations (m, k) [m²].
    """

    deviances: Array
    states: Array
    innovations_m: Array
    variances_m2: Array


def timeline(stretch: Stretch, axes: Sequence[int], dead_time_s: float) -> Timeline:
    """Cut a stretch for some axes, their inputs acting `dead_time_s` after they were sent."""
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
    """Likelihood of all parts of each axis that is tried, all in one pass."""
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
    """States and innovations of one part's first axis under one parameter vector (l,)."""
    motion, place = model.motion(parameters[None]), np.zeros(1, dtype=np.int64)
    passed = _pass(part, place, motion, _seen_var(model, parameters[None]), model.start_std)
    driven = _driven(part, place, motion)[:, 0]
    return Filtered(
        driven, passed.states[:, 0] - driven, passed.innovations_m[:, 0], np.sqrt(passed.variances_m2[:, 0])
    )


def advance(motion: LinearMotion, lengths: Counts) -> Advance:
    """Motion over some lengths (n,) [instants], by the binary digits of each."""
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
    """Transition, effect of a held input, and covariance of the noise, of one instant."""
    move, integral = _series(motion.a, INSTANT_S)
    spread = np.zeros_like(motion.noise)
    for node, weight in zip(_GAUSS_X, _GAUSS_W, strict=True):
        left, _ = _series(motion.a, INSTANT_S * (1.0 + float(node)) / 2.0)
        spread += INSTANT_S * float(weight) / 2.0 * (left @ motion.noise @ left.swapaxes(1, 2))
    return move, (integral @ motion.b[..., None])[..., 0], spread


def _series(slope: Array, time_s: float) -> tuple[Array, Array]:
    """exp(A t) and its integral from 0 to t, (k, n, n) each."""
    term = np.broadcast_to(np.eye(slope.shape[-1]), slope.shape)
    power, integral = term.copy(), time_s * term
    for order in range(1, _ORDER + 1):
        term = term @ slope * (time_s / order)
        power += term
        integral = integral + term * (time_s / (order + 1))
    return power, integral


def _seen_var(model: AxisModel, parameters: Array) -> Array:
    """Variance of a position's noise (k,) [m²]."""
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
    """Gain (m, k, n) and variance of the innovation (m, k) at each position: they come of the times alone."""
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
    """What the inputs since the position before have done at each position (m, k, n, 1)."""
    lengths, rests, which = part.pieces
    different, held = np.unique(lengths, return_inverse=True)
    pushes = advance(motion, different).push[held]
    different, after = np.unique(rests, return_inverse=True)
    carried = (advance(motion, different).move[after] @ pushes[..., None])[which]
    carried *= part.inputs_mps2[:, place, None, None]
    return np.add.reduceat(carried, np.concatenate([[0], part.measured[:-1] + 1]), axis=0)


def _driven(part: Timeline, place: Counts, motion: LinearMotion) -> Array:
    """What the inputs alone have done at each position (m, k, n)."""
    different, which = part.spacings
    moves, pushed = advance(motion, different).move, _pushed(part, place, motion)
    states = np.empty(pushed.shape)
    state = states[0] = pushed[0]
    for index, kind in enumerate(which):
        state = states[index + 1] = moves[kind] @ state + pushed[index + 1]
    return states[..., 0]
