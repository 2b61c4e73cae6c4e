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
from uavctl.arrays import Array, Flags
from uavctl.errors import RecordingError
from uavctl.lab.identify.history import MIN_SAMPLES, Stretch
from uavctl.lab.identify.response import (
    OUTLIER,
    TIME_UNIT_S,
    AxisModel,
    FilterResult,
    Likelihood,
    Timeline,
    Trial,
    compute_likelihood,
    compute_transition,
    get_values,
    make_parameters,
    make_timeline,
    run_filter,
)

_HESSIAN_STEP = 1e-2
_DIFFERENCE_STEP = 1e-5  # of the difference quotients: truncation and rounding change no result by a millionth
# Gain of the deviance by one more step, below which the search ends; a standard error is a gain of 1.
TOLERANCE, ROUGH_TOLERANCE = 1e-9, 1e-6
_MAX_STEPS = 60
_MAX_STEP = 1.0  # largest change of a parameter; for a logarithm, a factor of e
_LINEAR_RANGE = 0.1  # within this step the gradient is about linear
_DAMPING, _MIN_DAMPING, _MAX_DAMPING = 1e-2, 1e-4, 1e6


@dataclass(frozen=True)
class AxisFit:
    """Fitted response of one axis."""

    model: AxisModel  # the plant
    dead_time_s: float  # d [s]
    parameters: tuple[float, ...]  # on the scale of the search, see `make_parameters`
    deviance: float  # -2 log likelihood, up to a constant

    def value(self, name: str) -> float:
        """Return a fitted value by its name."""
        return get_values(self.model, self.parameters)[name]


def fit_axes(
    flown: Sequence[Stretch],
    axes: Sequence[int],
    models: Sequence[AxisModel],
    dead_time_s: float,
    starts: Sequence[Sequence[float] | None],
    tolerance: float = TOLERANCE,
) -> tuple[AxisFit, ...]:
    """Fit some axes with a given dead time, independently, in as many passes as the slowest search needs.

    Args:
        axes: 0 north, 1 east, 2 down.
        models: The plant of each axis, all of one kind.
        dead_time_s: d [s].
        starts: Parameter vector of each axis to begin with; None: the model's starts, and the best result of these.
        tolerance: Gain of the deviance by one more step, below which a search ends.
    """
    parts = [make_timeline(stretch, axes, dead_time_s) for stretch in flown]
    starting_points = [
        (axis_index, np.array(vector))
        for axis_index, (model, start) in enumerate(zip(models, starts, strict=True))
        for vector in (
            [make_parameters(model, start_values) for start_values in model.starts] if start is None else [start]
        )
    ]
    searches = [_search_minimum(x, models[axis_index], tolerance) for axis_index, x in starting_points]
    points = {i: next(search) for i, search in enumerate(searches)}
    results: dict[int, tuple[Array, float]] = {}
    while points:
        slopes = _compute_slopes(
            parts, [(starting_points[i][0], models[starting_points[i][0]], x) for i, x in points.items()]
        )
        for i, slope in zip(list(points), slopes, strict=True):
            try:
                points[i] = searches[i].send(slope)
            except StopIteration as end:
                results[i] = end.value
                del points[i]
    fits = []
    for axis_index, model in enumerate(models):
        x, deviance = min(
            (results[i] for i, (index, _) in enumerate(starting_points) if index == axis_index),
            key=lambda result: result[1],
        )
        fits.append(AxisFit(model, dead_time_s, tuple(x.tolist()), deviance))
    return tuple(fits)


def compute_standard_errors(flown: Sequence[Stretch], axis: int, fit: AxisFit) -> dict[str, float]:
    """Return the standard error of each fitted value with the dead time given, by the curvature at the optimum.

    Infinite where the flight does not determine the value, or where the value is at its bound.
    """
    parts = [make_timeline(stretch, (axis,), fit.dead_time_s) for stretch in flown]
    x = np.array(fit.parameters)
    offsets = _HESSIAN_STEP * np.eye(len(x))
    slopes = _compute_slopes(parts, [(0, fit.model, x_moved) for x_moved in (*(x + offsets), *(x - offsets))])
    forward, backward = slopes[: len(x)], slopes[len(x) :]
    rows = [
        (plus.gradient - minus.gradient) / (2.0 * _HESSIAN_STEP) for plus, minus in zip(forward, backward, strict=True)
    ]
    curvature = (np.array(rows) + np.array(rows).T) / 4.0  # of the log likelihood: half the deviance's
    is_free = np.diag(curvature) > 0.0  # false at a bound, beyond which the deviance may fall further
    variances = np.full(len(x), np.inf)
    with suppress(np.linalg.LinAlgError):
        variances[is_free] = np.diag(np.linalg.inv(curvature[np.ix_(is_free, is_free)]))
    stds = np.sqrt(np.where(variances > 0.0, variances, np.inf))
    scales = [
        parameter.from_search_scale(scaled) if parameter.logarithmic else 1.0
        for parameter, scaled in zip(fit.model.free, x, strict=True)
    ]
    return {
        parameter.name: float(std * factor) for parameter, std, factor in zip(fit.model.free, stds, scales, strict=True)
    }


class _Slope(NamedTuple):
    """Deviance at a parameter vector, its gradient (l,) and its expected curvature (l, l)."""

    deviance: float
    gradient: Array
    curvature: Array


def _search_minimum(x: Array, model: AxisModel, tolerance: float) -> Generator[Array, _Slope, tuple[Array, float]]:
    """Minimise the deviance by damped Newton steps: yield parameter vectors, receive their slopes."""
    lower, upper = np.array(
        [
            (parameter.to_search_scale(parameter.lower), parameter.to_search_scale(parameter.upper))
            for parameter in model.free
        ]
    ).T
    current, damping = (yield x), _DAMPING
    for _ in range(_MAX_STEPS):
        is_free = ~(((x <= lower) & (current.gradient > 0.0)) | ((x >= upper) & (current.gradient < 0.0)))
        is_free &= np.diag(current.curvature) > 0.0  # a parameter without effect stays unchanged
        gradient, curvature = current.gradient[is_free], current.curvature[np.ix_(is_free, is_free)]
        if not is_free.any() or gradient @ _compute_damped_step(curvature, gradient, _MIN_DAMPING) < 2.0 * tolerance:
            break
        while damping < _MAX_DAMPING:
            step = np.zeros(len(x))
            step[is_free] = -_compute_damped_step(curvature, gradient, damping)
            trial = np.clip(x + np.clip(step, -_MAX_STEP, _MAX_STEP), lower, upper)
            next_slope = yield trial
            if next_slope.deviance < current.deviance:
                break
            damping *= 10.0
        else:
            break
        corrected = _correct_curvature(next_slope.curvature, trial - x, next_slope.gradient - current.gradient)
        x, current, damping = trial, next_slope._replace(curvature=corrected), max(0.1 * damping, _MIN_DAMPING)
    return x, current.deviance


def _compute_damped_step(curvature: Array, gradient: Array, damping: float) -> Array:
    """Return the damped Newton step uphill."""
    return np.asarray(np.linalg.solve(curvature + damping * np.diag(np.diag(curvature)), gradient), dtype=np.float64)


def _correct_curvature(curvature: Array, step: Array, change: Array) -> Array:
    """Return the expected curvature, corrected by the change of the gradient along a step (BFGS)."""
    # H := H - H s (H s)' / (s' H s) + y y' / (s' y), with step s and change y of the gradient
    curvature_step = curvature @ step
    if step @ change <= 0.0 or np.abs(step).max() > _LINEAR_RANGE:
        return curvature
    return np.asarray(
        curvature
        - np.outer(curvature_step, curvature_step) / (step @ curvature_step)
        + np.outer(change, change) / (step @ change),
        dtype=np.float64,
    )


def _compute_slopes(parts: Sequence[Timeline], points: Sequence[tuple[int, AxisModel, Array]]) -> list[_Slope]:
    """Return the slope at each of some (index of the axis, model, parameter vector), all in one pass."""
    trials = [
        Trial(axis_index, model, np.vstack([x, x + _DIFFERENCE_STEP * np.eye(len(x))]))
        for axis_index, model, x in points
    ]
    return [_compute_slope(result) for result in compute_likelihood(parts, trials)]


def _compute_slope(result: Likelihood) -> _Slope:
    """Return the slope by finite differences of the other parameter vectors from the first."""
    std = np.sqrt(result.variances_m2[:, 0])
    innovation_slopes = (result.innovations_m[:, 1:] - result.innovations_m[:, :1]) / (_DIFFERENCE_STEP * std[:, None])
    # The slope of an outlier's Huber loss is constant.
    innovation_slopes[np.abs(result.innovations_m[:, 0]) > OUTLIER * std] = 0.0
    variance_slopes = (result.variances_m2[:, 1:] - result.variances_m2[:, :1]) / (_DIFFERENCE_STEP * std[:, None] ** 2)
    curvature = 2.0 * innovation_slopes.T @ innovation_slopes + variance_slopes.T @ variance_slopes
    # f(x + h) - f(x) = h g + h² H / 2
    gradient = (result.deviances[1:] - result.deviances[0]) / _DIFFERENCE_STEP - 0.5 * _DIFFERENCE_STEP * np.diag(
        curvature
    )
    return _Slope(float(result.deviances[0]), gradient, curvature)


AHEAD_S = (0.25, 0.5, 1.0, 2.0)
R2_AHEAD_S = 1.0
LAGS = 20
_SETTLED_RATIO = 4.0  # over the median standard deviation; larger where a stretch begins, before the velocity is known


@dataclass(frozen=True, eq=False)
class PositionsAhead:
    """Predicted positions of a stretch, each a given time after another position."""

    begins: NDArray[np.intp]  # (k,), index of the position that it is predicted from
    later: NDArray[np.intp]  # (k,), index of the position that is predicted
    predicted_m: Array  # (k,) [m]
    rows: Array  # c'Φ (k, n): what the state at the begin adds to the position
    noise_m2: Array  # c'N c (k,): variance that the noise since then adds


@dataclass(frozen=True, eq=False)
class MotionAhead:
    """Motion from each position to the first one at least a given time later, flown and predicted."""

    times_s: Array  # (k,), where it begins [s]
    moved_m: Array  # (k,), flown motion [m]
    predicted_m: Array  # (k,), predicted motion [m]

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
    moved_m: Array  # (k,), flown motion of the next `R2_AHEAD_S` [m]
    predicted_m: Array  # (k,), predicted motion of that time [m]
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
        axis_timeline = make_timeline(stretch, (axis,), fit.dead_time_s)
        result = run_filter(axis_timeline, fit.model, np.array(fit.parameters))
        times.append(stretch.times_s[0] + axis_timeline.captured[1:] * TIME_UNIT_S)
        innovations.append(result.innovations_m[1:])  # without the first, which is only its distance from zero
        stds.append(result.stds_m[1:])
    all_stds = np.concatenate(stds)
    is_settled = all_stds < _SETTLED_RATIO * np.median(all_stds)
    residuals = np.concatenate(innovations)[is_settled]
    (ahead,) = predict_ahead(flown, axis, fit, (R2_AHEAD_S,))
    return Prediction(
        times_s=np.concatenate(times)[is_settled],
        innovations_m=residuals,
        stds_m=all_stds[is_settled],
        moved_m=ahead.moved_m,
        predicted_m=ahead.predicted_m,
        correlation=autocorrelation(residuals / all_stds[is_settled], min(LAGS, len(residuals) - 1)),
    )


def predict_ahead(
    flown: Sequence[Stretch], axis: int, fit: AxisFit, ahead_s: Sequence[float] = AHEAD_S
) -> tuple[MotionAhead, ...]:
    """Predict the motion over some times from every position, with the setpoints as they were sent.

    The state at each position is the filter's, from that position and those before; after it only setpoints are known.
    """
    parts = [_predict_ahead(stretch, axis, fit, ahead_s) for stretch in flown]
    return tuple(
        MotionAhead(
            *(np.concatenate([getattr(part[i], key) for part in parts]) for key in MotionAhead.__dataclass_fields__)
        )
        for i in range(len(ahead_s))
    )


def _predict_ahead(stretch: Stretch, axis: int, fit: AxisFit, ahead_s: Sequence[float]) -> list[MotionAhead]:
    axis_timeline = make_timeline(stretch, (axis,), fit.dead_time_s)
    parameters, positions_m = np.array(fit.parameters), axis_timeline.positions_m[:, 0]
    result = run_filter(axis_timeline, fit.model, parameters)
    predictions = []
    for time_s in ahead_s:
        ahead = predict_positions(axis_timeline, result, fit.model, parameters, time_s)
        begins, filtered_m = ahead.begins, result.driven[ahead.begins, 0] + result.undriven[ahead.begins, 0]
        predictions.append(
            MotionAhead(
                times_s=stretch.times_s[0] + axis_timeline.captured[begins] * TIME_UNIT_S,
                moved_m=positions_m[ahead.later] - positions_m[begins],
                predicted_m=ahead.predicted_m - filtered_m,
            )
        )
    return predictions


def predict_positions(
    part: Timeline, result: FilterResult, model: AxisModel, parameters: Array, time_s: float
) -> PositionsAhead:
    """Predict the first position at least a time after each one, where the filter has settled, with setpoints known."""
    captured = part.captured
    is_settled = result.stds_m < _SETTLED_RATIO * np.median(result.stds_m)
    later = np.searchsorted(captured, captured + round(time_s / TIME_UNIT_S))
    begins = np.flatnonzero(is_settled & (later < len(captured)))
    later = later[begins]
    lengths, index = np.unique(captured[later] - captured[begins], return_inverse=True)
    transition = compute_transition(model.motion(parameters[None]), lengths)
    # p = c'Φ x, the effect of the inputs apart
    rows = transition.transition[index, 0, 0]
    return PositionsAhead(
        begins=begins,
        later=later,
        predicted_m=result.driven[later, 0] + np.einsum("kn,kn->k", rows, result.undriven[begins]),
        rows=rows,
        noise_m2=transition.noise_cov[index, 0, 0, 0],
    )


COARSE_S = tuple(round(0.04 * i, 2) for i in range(9))
FINE_S = 0.02
MAX_TRIES = len(COARSE_S) + 3  # the coarse grid, two neighbours of its best, and the halves
_DEVIANCE_RISE = 4.0  # of the deviance: two standard errors
BLOCK_S = 8.0
_GROUP_S = 4.0  # errors nearer to each other in time are not independent
_CONFIDENCE_STDS = 2.0  # standard errors


@dataclass(frozen=True, eq=False)
class HeldOutError:
    """Prediction errors of a plant on the halves that it was not fitted to."""

    squares: Array  # sums of squared errors by group of time, axis and time ahead (groups, axes, ahead) [m²]
    counts: Array  # numbers of these errors (groups, axes, ahead)

    @property
    def rms_m(self) -> Array:
        """Rms error (axes, ahead) [m]."""
        return np.asarray(np.sqrt(self.squares.sum(axis=0) / np.maximum(self.counts.sum(axis=0), 1.0)))

    def compute_scores(self) -> Array:
        """Return the logarithm of `error_m` without each group (groups + 1,); the last is with all groups."""
        squares = np.vstack([self.squares.sum(axis=0) - self.squares, self.squares.sum(axis=0)[None]])
        counts = np.vstack([self.counts.sum(axis=0) - self.counts, self.counts.sum(axis=0)[None]])
        return np.asarray(0.5 * np.log(np.maximum(squares, 1e-12) / np.maximum(counts, 1.0)).mean(axis=(1, 2)))

    @property
    def error_m(self) -> float:
        """Geometric mean of the rms errors [m]."""
        return float(np.exp(self.compute_scores()[-1]))


@dataclass(frozen=True, eq=False)
class ChosenPlant:
    """Plant model with its likeliest dead time."""

    # Dead times that were tried [s], in order, and the deviance of each above the least
    curve: tuple[tuple[float, float], ...]
    dead_time_s: float  # the one with the least deviance [s]
    range_s: tuple[float, float]  # where the deviance is less than 4 above its least, linear between tried ones [s]
    fits: tuple[AxisFit, ...]  # each axis, fitted to the whole flight with it
    held_out: HeldOutError  # prediction errors on the halves that it was not fitted to

    @property
    def name(self) -> str:
        """Name of the plant."""
        return self.fits[0].model.name


def choose_dead_time(
    flown: Sequence[Stretch], axes: Sequence[int], models: Sequence[AxisModel], on_fit: Callable[[], None]
) -> ChosenPlant:
    """Choose the likeliest dead time, one for all axes.

    Args:
        axes: 0 north, 1 east, 2 down.

    Raises:
        RecordingError: The flight is too short for two halves.
    """
    both_halves = split_halves(flown)
    fits_by_dead_time: dict[float, tuple[AxisFit, ...]] = {}

    def fit(dead_time_s: float) -> None:
        dead_time_s = round(dead_time_s, 3)
        if dead_time_s >= 0.0 and dead_time_s not in fits_by_dead_time:
            nearest_s = min(fits_by_dead_time, key=lambda fitted_s: abs(fitted_s - dead_time_s), default=None)
            starts = (
                [None] * len(axes)
                if nearest_s is None
                else [fitted_s.parameters for fitted_s in fits_by_dead_time[nearest_s]]
            )
            fits_by_dead_time[dead_time_s] = fit_axes(flown, axes, models, dead_time_s, starts, ROUGH_TOLERANCE)
        on_fit()

    def find_best() -> float:
        return min(fits_by_dead_time, key=lambda fitted_s: _sum_deviance(fits_by_dead_time[fitted_s]))

    for dead_time_s in COARSE_S:
        fit(dead_time_s)
    coarse_s = find_best()
    for dead_time_s in (coarse_s - FINE_S, coarse_s + FINE_S):
        fit(dead_time_s)
    best_s = find_best()
    fits_by_dead_time[best_s] = fit_axes(
        flown, axes, models, best_s, [fitted_s.parameters for fitted_s in fits_by_dead_time[best_s]]
    )
    curve = tuple(
        (key, _sum_deviance(fits_by_dead_time[key]) - _sum_deviance(fits_by_dead_time[best_s]))
        for key in sorted(fits_by_dead_time)
    )
    models, starts = (
        [fitted_s.model for fitted_s in fits_by_dead_time[best_s]],
        [fitted_s.parameters for fitted_s in fits_by_dead_time[best_s]],
    )
    held_out = compute_held_out_error(flown, both_halves, axes, models, best_s, starts)
    on_fit()
    return ChosenPlant(curve, best_s, _find_range_s(curve, best_s), fits_by_dead_time[best_s], held_out)


def _sum_deviance(fits: Sequence[AxisFit]) -> float:
    return sum(fit.deviance for fit in fits)


def _find_range_s(curve: Sequence[tuple[float, float]], best_s: float) -> tuple[float, float]:
    """Return the bounds at which the deviance is 4 above its least [s]; the end of the curve where it is never."""
    bounds = []
    for branch in (
        [point for point in curve if point[0] <= best_s][::-1],
        [point for point in curve if point[0] >= best_s],
    ):
        end_s = branch[-1][0]
        for (inner_s, inner_rise), (outer_s, outer_rise) in pairwise(branch):
            if outer_rise >= _DEVIANCE_RISE:
                end_s = inner_s + (outer_s - inner_s) * (_DEVIANCE_RISE - inner_rise) / (outer_rise - inner_rise)
                break
        bounds.append(end_s)
    return bounds[0], bounds[1]


def is_worse(error: HeldOutError, other: HeldOutError) -> bool:
    """Return whether an error is larger by over two standard errors of the difference (jackknife, groups of 4 s)."""
    difference = error.compute_scores() - other.compute_scores()
    leave_one_out, overall = difference[:-1], difference[-1]
    count = len(leave_one_out)
    std = np.sqrt((count - 1) / count * np.sum((leave_one_out - leave_one_out.mean()) ** 2))
    return bool(overall > _CONFIDENCE_STDS * std and overall > 0.0)


class Block(NamedTuple):
    """Start and end of a part of a stretch [s]."""

    begin_s: float
    end_s: float


def split_halves(flown: Sequence[Stretch]) -> tuple[tuple[Block, ...], tuple[Block, ...]]:
    """Return two halves of a flight: alternating blocks of each stretch.

    Raises:
        RecordingError: There are no two blocks.
    """
    blocks: list[Block] = []
    for stretch in flown:
        count = max(round(stretch.length_s / BLOCK_S), 1 if len(flown) > 1 else 2)
        edges = np.linspace(stretch.times_s[0], stretch.times_s[-1] + 1e-6, count + 1)
        for begin, end in pairwise(edges.tolist()):
            times_s = stretch.times_s[(stretch.times_s >= begin) & (stretch.times_s < end)]
            if len(times_s) >= MIN_SAMPLES:
                blocks.append(Block(float(times_s[0]), float(times_s[-1])))
    if len(blocks) < 2:
        raise RecordingError(
            f"the flight has {len(blocks)} block of {BLOCK_S:g} s with {MIN_SAMPLES} positions: a fit to one half "
            "cannot be judged by the other. Fly for longer, or with more positions"
        )
    return tuple(blocks[::2]), tuple(blocks[1::2])


def compute_held_out_error(
    flown: Sequence[Stretch],
    both_halves: tuple[tuple[Block, ...], tuple[Block, ...]],
    axes: Sequence[int],
    models: Sequence[AxisModel],
    dead_time_s: float,
    starts: Sequence[Sequence[float] | None],
    ahead_s: Sequence[float] = AHEAD_S,
    tolerance: float = TOLERANCE,
) -> HeldOutError:
    """Compute errors on each half by plants that were fitted to the other; other arguments as of `fit_axes`."""
    begin = min(stretch.times_s[0] for stretch in flown)
    groups = 1 + int((max(stretch.times_s[-1] for stretch in flown) - begin) / _GROUP_S)
    squares, counts = (np.zeros((groups, len(axes), len(ahead_s))) for _ in range(2))
    for fitted_half, judged_half in (both_halves, both_halves[::-1]):
        fitted_flight = [replace(stretch, counts_for_fit=_is_within(fitted_half, stretch.times_s)) for stretch in flown]
        for i, fit in enumerate(fit_axes(fitted_flight, axes, models, dead_time_s, starts, tolerance)):
            for j, ahead in enumerate(predict_ahead(flown, axes[i], fit, ahead_s)):
                in_judged_half = _is_within(judged_half, ahead.times_s, ahead_s[j])
                group = ((ahead.times_s[in_judged_half] - begin) / _GROUP_S).astype(np.int64)
                squares[:, i, j] += np.bincount(group, weights=ahead.errors_m[in_judged_half] ** 2, minlength=groups)
                counts[:, i, j] += np.bincount(group, minlength=groups)
    return HeldOutError(squares, counts)


def _is_within(half: Sequence[Block], times_s: Array, ahead_s: float = 0.0) -> Flags:
    """Return whether one block of a half contains each time and also the time `ahead_s` later."""
    in_blocks = [(times_s >= block.begin_s) & (times_s + ahead_s <= block.end_s) for block in half]
    return np.asarray(np.logical_or.reduce(in_blocks), dtype=np.bool_)
