"""The most likely parameters of an axis, by maximum likelihood of the filter's innovations.

The search is Fisher's scoring with Levenberg and Marquardt's damping: what the innovations and their variances change
by with each parameter gives the gradient and the expected curvature at once.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from uavctl.identify.axis_model import AxisModel, places, values
from uavctl.identify.history import Stretch
from uavctl.identify.response import OUTLIER, Likelihood, Timeline, Tried, likelihood, timeline

Array = NDArray[np.float64]

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
    """Response of one axis.

    Attributes:
        model: The plant.
        dead_time_s: d [s].
        parameters: What was fitted, as `axis_model.places` has it.
        deviance: -2 log likelihood, up to a constant.
    """

    model: AxisModel
    dead_time_s: float
    parameters: tuple[float, ...]
    deviance: float

    def value(self, name: str) -> float:
        """A fitted value by its name."""
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
        flown: Stretches of the flight.
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


def fit_axis(
    flown: Sequence[Stretch], axis: int, model: AxisModel, dead_time_s: float, start: Sequence[float] | None = None
) -> AxisFit:
    """Fit one axis, see `fit_axes`."""
    return fit_axes(flown, (axis,), (model,), dead_time_s, (start,))[0]


def standard_errors(flown: Sequence[Stretch], axis: int, fit: AxisFit) -> dict[str, float]:
    """Standard error of each fitted value with the dead time as given, by the curvature at the optimum.

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
    """Ask for the slope at one parameter vector after the other; the last, downhill of x, has the least deviance."""
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
    """The step uphill of a parabola, shorter the more it is damped."""
    return np.asarray(np.linalg.solve(curvature + damping * np.diag(np.diag(curvature)), gradient), dtype=np.float64)


def _corrected(curvature: Array, step: Array, change: Array) -> Array:
    """The expected curvature, with what a step has shown of the gradient's change along it (BFGS)."""
    bent = curvature @ step
    if step @ change <= 0.0 or np.abs(step).max() > _NEAR:
        return curvature
    return np.asarray(
        curvature - np.outer(bent, bent) / (step @ bent) + np.outer(change, change) / (step @ change), dtype=np.float64
    )


def _slopes(parts: Sequence[Timeline], asked: Sequence[tuple[int, AxisModel, Array]]) -> list[_Slope]:
    """Deviance and what it does around each of some (place of the axis, plant, parameter vector), in one pass."""
    tried = [Tried(place, model, np.vstack([x, x + _STEP * np.eye(len(x))])) for place, model, x in asked]
    return [_slope(one) for one in likelihood(parts, tried)]


def _slope(found: Likelihood) -> _Slope:
    """By the differences of the vectors from the first."""
    std = np.sqrt(found.variances_m2[:, 0])
    pulls = (found.innovations_m[:, 1:] - found.innovations_m[:, :1]) / (_STEP * std[:, None])
    pulls[np.abs(found.innovations_m[:, 0]) > OUTLIER * std] = 0.0  # an outlier pulls the same wherever it is
    swells = (found.variances_m2[:, 1:] - found.variances_m2[:, :1]) / (_STEP * std[:, None] ** 2)
    curvature = 2.0 * pulls.T @ pulls + swells.T @ swells
    # The difference goes up by the gradient and by half a step of the curvature.
    gradient = (found.deviances[1:] - found.deviances[0]) / _STEP - 0.5 * _STEP * np.diag(curvature)
    return _Slope(float(found.deviances[0]), gradient, curvature)
