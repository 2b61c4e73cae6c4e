"""Fit of a plant to a flight: its parameters, its dead time, and its prediction errors on held-out halves.

1. The parameters of an axis maximise the likelihood of the filter's innovations. The search is Fisher scoring with
   Levenberg-Marquardt damping: the slopes of innovations and variances give gradient and expected curvature at once.
2. The dead time minimises the deviance of the whole flight, summed over the axes. Prediction errors tell plants apart
   but not dead times: a lag replaces a dead time with hardly a difference at 0.25 s and more.
3. Plants are compared on halves of the flight. The halves are alternating blocks, so each has a part of every
   manoeuvre. The measure is the motion of the next 0.25 to 2 s: the geometric mean of the rms errors over these times
   and the axes.
4. The filter always runs over the whole flight; only innovations or motions within a half count. A restart in each
   block would measure how the filter converges, and little of the plant.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from logs.report.statistics import autocorrelation
from uavctl.arrays import Array
from uavctl.errors import RecordingError
from uavctl.lab.identify.history import LEAST_SAMPLES, Stretch
from uavctl.lab.identify.response import (
    INSTANT_S,
    OUTLIER,
    AxisModel,
    Likelihood,
    Timeline,
    Tried,
    advance,
    filtered,
    likelihood,
    places,
    timeline,
    values,
)

_HESSIAN_STEP = 1e-2
_STEP = 1e-5  # of the difference quotients: its error and that of rounding move no result by a millionth
# Gain of the deviance by one more step, below which the search ends; a standard error is a gain of 1.
CLOSE, ROUGH = 1e-9, 1e-6
_MOST_STEPS = 60
_LONGEST = 1.0  # step of a parameter; of a logarithm, a factor of e
_NEAR = 0.1  # where the gradient is about linear
_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-2, 1e-4, 1e6


@dataclass(frozen=True)
class AxisFit:
    """Fitted response of one axis."""

    model: AxisModel  # the plant
    dead_time_s: float  # d [s]
    parameters: tuple[float, ...]  # what was fitted, as `axis_model.places` has it
    deviance: float  # -2 log likelihood, up to a constant

    def value(self, name: str) -> float:
        """Return a fitted value by its name."""
        return values(self.model, self.parameters)[name]


def fit_axes(
    flown: Sequence[Stretch],
    axes: Sequence[int],
    models: Sequence[AxisModel],
    dead_time_s: float,
    starts: Sequence[Sequence[float] | None],
    close: float = CLOSE,
) -> tuple[AxisFit, ...]:
    """Fit some axes with a given dead time, each by itself, in as many passes as the slowest of them needs.

    Args:
        axes: 0 north, 1 east, 2 down.
        models: The plant of each axis, all of one kind.
        dead_time_s: d [s].
        starts: Parameter vector of each axis to begin with; None is where the model says, and the best of these.
        close: Gain of the deviance by one more step, below which a search ends.
    """
    parts = [timeline(stretch, axes, dead_time_s) for stretch in flown]
    begins = [
        (place, np.array(begin))
        for place, (model, start) in enumerate(zip(models, starts, strict=True))
        for begin in ([places(model, one) for one in model.starts] if start is None else [start])
    ]
    searches = [_search(x, models[place], close) for place, x in begins]
    asked = {i: next(search) for i, search in enumerate(searches)}
    ends: dict[int, tuple[Array, float]] = {}
    while asked:
        slopes = _slopes(parts, [(begins[i][0], models[begins[i][0]], x) for i, x in asked.items()])
        for i, slope in zip(list(asked), slopes, strict=True):
            try:
                asked[i] = searches[i].send(slope)
            except StopIteration as end:
                ends[i] = end.value
                del asked[i]
    found = []
    for place, model in enumerate(models):
        x, least = min((ends[i] for i, (at, _) in enumerate(begins) if at == place), key=lambda one: one[1])
        found.append(AxisFit(model, dead_time_s, tuple(x.tolist()), least))
    return tuple(found)


def standard_errors(flown: Sequence[Stretch], axis: int, fit: AxisFit) -> dict[str, float]:
    """Return the standard error of each fitted value with the dead time given, by the curvature at the optimum.

    Infinite where the flight tells nothing, or where the value is at its bound.
    """
    parts = [timeline(stretch, (axis,), fit.dead_time_s) for stretch in flown]
    x = np.array(fit.parameters)
    moves = _HESSIAN_STEP * np.eye(len(x))
    slopes = _slopes(parts, [(0, fit.model, at) for at in (*(x + moves), *(x - moves))])
    up, down = slopes[: len(x)], slopes[len(x) :]
    rows = [(above.gradient - below.gradient) / (2.0 * _HESSIAN_STEP) for above, below in zip(up, down, strict=True)]
    curvature = (np.array(rows) + np.array(rows).T) / 4.0  # of the log likelihood: half the deviance's
    free = np.diag(curvature) > 0.0  # what is at its bound may go on falling beyond
    variances = np.full(len(x), np.inf)
    with suppress(np.linalg.LinAlgError):
        variances[free] = np.diag(np.linalg.inv(curvature[np.ix_(free, free)]))
    spread = np.sqrt(np.where(variances > 0.0, variances, np.inf))
    scale = [one.outside(place) if one.logarithmic else 1.0 for one, place in zip(fit.model.free, x, strict=True)]
    return {one.name: float(s * size) for one, s, size in zip(fit.model.free, spread, scale, strict=True)}


class _Slope(NamedTuple):
    """Deviance at a parameter vector, its gradient (l,) and its expected curvature (l, l)."""

    deviance: float
    gradient: Array
    curvature: Array


def _search(x: Array, model: AxisModel, close: float) -> Generator[Array, _Slope, tuple[Array, float]]:
    """Search the least deviance by damped Newton steps: yield parameter vectors, take their slopes."""
    least, most = np.array([(one.inside(one.least), one.inside(one.most)) for one in model.free]).T
    now, damping = (yield x), _DAMPING
    for _ in range(_MOST_STEPS):
        free = ~(((x <= least) & (now.gradient > 0.0)) | ((x >= most) & (now.gradient < 0.0)))
        free &= np.diag(now.curvature) > 0.0  # what tells nothing stays
        gradient, curvature = now.gradient[free], now.curvature[np.ix_(free, free)]
        if not free.any() or gradient @ _damped(curvature, gradient, _LEAST_DAMPING) < 2.0 * close:
            break
        while damping < _MOST_DAMPING:
            step = np.zeros(len(x))
            step[free] = -_damped(curvature, gradient, damping)
            trial = np.clip(x + np.clip(step, -_LONGEST, _LONGEST), least, most)
            then = yield trial
            if then.deviance < now.deviance:
                break
            damping *= 10.0
        else:
            break
        corrected = _corrected(then.curvature, trial - x, then.gradient - now.gradient)
        x, now, damping = trial, then._replace(curvature=corrected), max(0.1 * damping, _LEAST_DAMPING)
    return x, now.deviance


def _damped(curvature: Array, gradient: Array, damping: float) -> Array:
    """Return the Newton step uphill, shorter the more it is damped."""
    return np.asarray(np.linalg.solve(curvature + damping * np.diag(np.diag(curvature)), gradient), dtype=np.float64)


def _corrected(curvature: Array, step: Array, change: Array) -> Array:
    """Return the expected curvature, corrected by how the gradient changed along a step (BFGS)."""
    bent = curvature @ step
    if step @ change <= 0.0 or np.abs(step).max() > _NEAR:
        return curvature
    return np.asarray(
        curvature - np.outer(bent, bent) / (step @ bent) + np.outer(change, change) / (step @ change), dtype=np.float64
    )


def _slopes(parts: Sequence[Timeline], asked: Sequence[tuple[int, AxisModel, Array]]) -> list[_Slope]:
    """Return the slope at each of some (place of the axis, plant, parameter vector), all in one pass."""
    tried = [Tried(place, model, np.vstack([x, x + _STEP * np.eye(len(x))])) for place, model, x in asked]
    return [_slope(one) for one in likelihood(parts, tried)]


def _slope(found: Likelihood) -> _Slope:
    """Return the slope by finite differences of the other parameter vectors from the first."""
    std = np.sqrt(found.variances_m2[:, 0])
    pulls = (found.innovations_m[:, 1:] - found.innovations_m[:, :1]) / (_STEP * std[:, None])
    pulls[np.abs(found.innovations_m[:, 0]) > OUTLIER * std] = 0.0  # an outlier pulls the same wherever it is
    swells = (found.variances_m2[:, 1:] - found.variances_m2[:, :1]) / (_STEP * std[:, None] ** 2)
    curvature = 2.0 * pulls.T @ pulls + swells.T @ swells
    # The difference goes up by the gradient and by half a step of the curvature.
    gradient = (found.deviances[1:] - found.deviances[0]) / _STEP - 0.5 * _STEP * np.diag(curvature)
    return _Slope(float(found.deviances[0]), gradient, curvature)


AHEAD_S = (0.25, 0.5, 1.0, 2.0)
SHOWN_S = 1.0
LAGS = 20
_SETTLED = 4.0  # where a stretch begins, the filter does not know the velocity yet


@dataclass(frozen=True, eq=False)
class Ahead:
    """Motion from each position to the first one at least a given time later."""

    times_s: Array  # (k,), where it begins [s]
    moved_m: Array  # (k,), how far the vehicle went [m]
    predicted_m: Array  # (k,), how far it was predicted to go [m]

    @property
    def errors_m(self) -> Array:
        """Errors of the predicted motion (k,) [m]."""
        return self.moved_m - self.predicted_m


@dataclass(frozen=True, eq=False)
class Prediction:
    """Prediction of one axis' motion against the flight."""

    times_s: Array  # (m,), of the positions [s]
    innovations_m: Array  # (m,), position minus its prediction from the one before [m]
    stds_m: Array  # (m,), standard deviation that the fit gives them [m]
    moved_m: Array  # (k,), how far the vehicle went in the next `SHOWN_S` [m]
    predicted_m: Array  # (k,), how far it was predicted to go [m]
    correlation: Array  # (LAGS,), of innovations one, two ... positions apart.

    @property
    def residual_std_m(self) -> float:
        """Standard deviation of an innovation [m]."""
        return float(np.std(self.innovations_m))

    @property
    def r2(self) -> float:
        """Share of the motion of the next second that was predicted, R²; 0 where nothing moved."""
        spread = float(np.sum((self.moved_m - self.moved_m.mean()) ** 2)) if len(self.moved_m) else 0.0
        return 1.0 - float(np.sum((self.moved_m - self.predicted_m) ** 2)) / spread if spread > 0.0 else 0.0


def predict(flown: Sequence[Stretch], axis: int, fit: AxisFit) -> Prediction:
    """Predict each position of a flight from the ones before it."""
    times, innovations, stds = [], [], []
    for stretch in flown:
        cut = timeline(stretch, (axis,), fit.dead_time_s)
        one = filtered(cut, fit.model, np.array(fit.parameters))
        times.append(stretch.times_s[0] + cut.captured[1:] * INSTANT_S)
        innovations.append(one.innovations_m[1:])  # the first one's is nothing but its distance from zero
        stds.append(one.stds_m[1:])
    known = np.concatenate(stds)
    settled = known < _SETTLED * np.median(known)
    left = np.concatenate(innovations)[settled]
    (second,) = predict_ahead(flown, axis, fit, (SHOWN_S,))
    return Prediction(
        times_s=np.concatenate(times)[settled],
        innovations_m=left,
        stds_m=known[settled],
        moved_m=second.moved_m,
        predicted_m=second.predicted_m,
        correlation=autocorrelation(left / known[settled], min(LAGS, len(left) - 1)),
    )


def predict_ahead(
    flown: Sequence[Stretch], axis: int, fit: AxisFit, ahead_s: Sequence[float] = AHEAD_S
) -> tuple[Ahead, ...]:
    """Predict the motion over some times from every position, with the setpoints as they were sent.

    The state there is the filter's, by that position and those before; what follows is known of the setpoints alone.
    """
    parts = [_ahead(stretch, axis, fit, ahead_s) for stretch in flown]
    return tuple(
        Ahead(*(np.concatenate([getattr(part[i], key) for part in parts]) for key in Ahead.__dataclass_fields__))
        for i in range(len(ahead_s))
    )


def _ahead(stretch: Stretch, axis: int, fit: AxisFit, ahead_s: Sequence[float]) -> list[Ahead]:
    cut = timeline(stretch, (axis,), fit.dead_time_s)
    parameters = np.array(fit.parameters)
    one = filtered(cut, fit.model, parameters)
    motion = fit.model.motion(parameters[None])
    captured = cut.captured
    settled = one.stds_m < _SETTLED * np.median(one.stds_m)
    found = []
    for time_s in ahead_s:
        later = np.searchsorted(captured, captured + round(time_s / INSTANT_S))
        begins = np.flatnonzero(settled & (later < len(captured)))
        later = later[begins]
        different, which = np.unique(captured[later] - captured[begins], return_inverse=True)
        rows = advance(motion, different).move[which, 0, 0]  # of the position
        predicted = one.driven[later, 0] + np.einsum("kn,kn->k", rows, one.rest[begins])
        found.append(
            Ahead(
                times_s=stretch.times_s[0] + captured[begins] * INSTANT_S,
                moved_m=cut.positions_m[later, 0] - cut.positions_m[begins, 0],
                predicted_m=predicted - one.driven[begins, 0] - one.rest[begins, 0],
            )
        )
    return found


COARSE_S = tuple(round(0.04 * i, 2) for i in range(9))
FINE_S = 0.02
TRIES = len(COARSE_S) + 3  # the coarse grid, two neighbours of its best, and the halves
_RISE = 4.0  # of the deviance: two standard errors
BLOCK_S = 8.0
_GROUP_S = 4.0  # errors nearer to each other in time are not independent
_CERTAIN = 2.0  # standard errors


@dataclass(frozen=True, eq=False)
class HeldOutError:
    """Prediction errors of a plant on the halves that it was not fitted to."""

    squares: Array  # sums of squared errors by group of time, axis and time ahead (groups, axes, ahead) [m²]
    counts: Array  # how many they are, alike

    @property
    def rms_m(self) -> Array:
        """Rms error (axes, ahead) [m]."""
        return np.asarray(np.sqrt(self.squares.sum(axis=0) / np.maximum(self.counts.sum(axis=0), 1.0)))

    def scores(self) -> Array:
        """Return the logarithm of `error_m` without each group in turn (groups + 1,), and last with all."""
        squares = np.vstack([self.squares.sum(axis=0) - self.squares, self.squares.sum(axis=0)[None]])
        counts = np.vstack([self.counts.sum(axis=0) - self.counts, self.counts.sum(axis=0)[None]])
        return np.asarray(0.5 * np.log(np.maximum(squares, 1e-12) / np.maximum(counts, 1.0)).mean(axis=(1, 2)))

    @property
    def error_m(self) -> float:
        """Geometric mean of the rms errors [m]."""
        return float(np.exp(self.scores()[-1]))


@dataclass(frozen=True, eq=False)
class ChosenPlant:
    """One kind of plant with its likeliest dead time."""

    # Dead times that were tried [s], in order, and the deviance of each above the least
    curve: tuple[tuple[float, float], ...]
    dead_time_s: float  # the one with the least deviance [s]
    range_s: tuple[float, float]  # where the deviance is less than 4 above it, between tried ones by straight lines [s]
    fits: tuple[AxisFit, ...]  # each axis, fitted to the whole flight with it
    judged: HeldOutError  # what it predicts of the halves

    @property
    def name(self) -> str:
        """Name of the plant."""
        return self.fits[0].model.name


def choose_dead_time(
    flown: Sequence[Stretch], axes: Sequence[int], models: Sequence[AxisModel], advance: Callable[[], None]
) -> ChosenPlant:
    """Choose the likeliest dead time, one for all axes.

    Args:
        axes: 0 north, 1 east, 2 down.

    Raises:
        RecordingError: The flight is too short for two halves.
    """
    both = halves(flown)
    tried: dict[float, tuple[AxisFit, ...]] = {}

    def fit(dead_time_s: float) -> None:
        dead_time_s = round(dead_time_s, 3)
        if dead_time_s >= 0.0 and dead_time_s not in tried:
            near = min(tried, key=lambda one: abs(one - dead_time_s), default=None)
            starts = [None] * len(axes) if near is None else [one.parameters for one in tried[near]]
            tried[dead_time_s] = fit_axes(flown, axes, models, dead_time_s, starts, ROUGH)
        advance()

    def least() -> float:
        return min(tried, key=lambda one: _total(tried[one]))

    for dead_time_s in COARSE_S:
        fit(dead_time_s)
    near_s = least()
    for dead_time_s in (near_s - FINE_S, near_s + FINE_S):
        fit(dead_time_s)
    best_s = least()
    tried[best_s] = fit_axes(flown, axes, models, best_s, [one.parameters for one in tried[best_s]])
    curve = tuple((key, _total(tried[key]) - _total(tried[best_s])) for key in sorted(tried))
    models, starts = [one.model for one in tried[best_s]], [one.parameters for one in tried[best_s]]
    judged = held_out(flown, both, axes, models, best_s, starts)
    advance()
    return ChosenPlant(curve, best_s, _range_s(curve, best_s), tried[best_s], judged)


def _total(fits: Sequence[AxisFit]) -> float:
    return sum(fit.deviance for fit in fits)


def _range_s(curve: Sequence[tuple[float, float]], best_s: float) -> tuple[float, float]:
    """Return where the deviance is 4 above its least on either side [s]; the end of the curve where it never is."""
    ends = []
    for side in ([one for one in curve if one[0] <= best_s][::-1], [one for one in curve if one[0] >= best_s]):
        end_s = side[-1][0]
        for (near_s, low), (far_s, high) in pairwise(side):
            if high >= _RISE:
                end_s = near_s + (far_s - near_s) * (_RISE - low) / (high - low)
                break
        ends.append(end_s)
    return ends[0], ends[1]


def is_worse(one: HeldOutError, other: HeldOutError) -> bool:
    """Return whether an error is larger by over two standard errors of the difference (jackknife, groups of 4 s)."""
    difference = one.scores() - other.scores()
    without, whole = difference[:-1], difference[-1]
    count = len(without)
    spread = np.sqrt((count - 1) / count * np.sum((without - without.mean()) ** 2))
    return bool(whole > _CERTAIN * spread and whole > 0.0)


class Block(NamedTuple):
    """Begin and end of a part of a stretch [s]."""

    begin_s: float
    end_s: float


def halves(flown: Sequence[Stretch]) -> tuple[tuple[Block, ...], tuple[Block, ...]]:
    """Return two halves of a flight: blocks of each stretch in turn.

    Raises:
        RecordingError: There are no two blocks.
    """
    blocks: list[Block] = []
    for stretch in flown:
        count = max(round(stretch.length_s / BLOCK_S), 1 if len(flown) > 1 else 2)
        edges = np.linspace(stretch.times_s[0], stretch.times_s[-1] + 1e-6, count + 1)
        for begin, end in pairwise(edges.tolist()):
            held = stretch.times_s[(stretch.times_s >= begin) & (stretch.times_s < end)]
            if len(held) >= LEAST_SAMPLES:
                blocks.append(Block(float(held[0]), float(held[-1])))
    if len(blocks) < 2:
        raise RecordingError(
            f"the flight has {len(blocks)} block of {BLOCK_S:g} s with {LEAST_SAMPLES} positions: a fit to one half "
            "cannot be judged by the other. Fly for longer, or with more positions"
        )
    return tuple(blocks[::2]), tuple(blocks[1::2])


def held_out(
    flown: Sequence[Stretch],
    both: tuple[tuple[Block, ...], tuple[Block, ...]],
    axes: Sequence[int],
    models: Sequence[AxisModel],
    dead_time_s: float,
    starts: Sequence[Sequence[float] | None],
    ahead_s: Sequence[float] = AHEAD_S,
    close: float = CLOSE,
) -> HeldOutError:
    """Errors on each half by plants that were fitted to the other; arguments beside the halves as of `fit_axes`."""
    begin = min(stretch.times_s[0] for stretch in flown)
    groups = 1 + int((max(stretch.times_s[-1] for stretch in flown) - begin) / _GROUP_S)
    squares, counts = (np.zeros((groups, len(axes), len(ahead_s))) for _ in range(2))
    for half, other in (both, both[::-1]):
        counting = [replace(stretch, counted=_within(half, stretch.times_s)) for stretch in flown]
        for i, fit in enumerate(fit_axes(counting, axes, models, dead_time_s, starts, close)):
            for j, one in enumerate(predict_ahead(flown, axes[i], fit, ahead_s)):
                held_out = _within(other, one.times_s, ahead_s[j])
                group = ((one.times_s[held_out] - begin) / _GROUP_S).astype(np.int64)
                squares[:, i, j] += np.bincount(group, weights=one.errors_m[held_out] ** 2, minlength=groups)
                counts[:, i, j] += np.bincount(group, minlength=groups)
    return HeldOutError(squares, counts)


def _within(half: Sequence[Block], times_s: Array, ahead_s: float = 0.0) -> NDArray[np.bool_]:
    """Return whether one block of a half contains both each of some times and the time so much later."""
    held = [(times_s >= block.begin_s) & (times_s + ahead_s <= block.end_s) for block in half]
    return np.asarray(np.logical_or.reduce(held), dtype=np.bool_)
