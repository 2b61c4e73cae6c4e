"""The most likely parameters of an axis, by maximum likelihood of the filter's innovations."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from uavctl.identify.axis_model import AxisModel, places, values
from uavctl.identify.history import Stretch
from uavctl.identify.response import Timeline, deviance, timeline

Array = NDArray[np.float64]

_HESSIAN_STEP = 1e-2
_CLOSE = 1e-7  # of a deviance of thousands: differences that no data tell


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


def fit_axis(
    flown: Sequence[Stretch],
    axis: int,
    model: AxisModel,
    dead_time_s: float,
    start: Sequence[float] | None = None,
) -> AxisFit:
    """Fit one axis with a given dead time.

    Args:
        flown: Stretches of the flight.
        axis: 0 north, 1 east, 2 down.
        model: The plant.
        dead_time_s: d [s].
        start: Parameter vector to begin with; else where the model says, and the best of these.
    """
    parts = [timeline(stretch, axis, dead_time_s) for stretch in flown]
    begins = [places(model, one) for one in model.starts] if start is None else [np.array(start)]
    bounds = [(one.inside(one.least), one.inside(one.most)) for one in model.free]

    def slope(x: Array) -> tuple[float, Array]:
        return _slope(parts, model, x)

    ends = [
        minimize(slope, x, jac=True, method="L-BFGS-B", bounds=bounds, options={"ftol": _CLOSE, "gtol": 1e-2})
        for x in begins
    ]
    found = min(ends, key=lambda end: float(end.fun))
    return AxisFit(model, dead_time_s, tuple(np.array(found.x).tolist()), float(found.fun))


def standard_errors(flown: Sequence[Stretch], axis: int, fit: AxisFit) -> dict[str, float]:
    """Standard error of each fitted value with the dead time as given, by the curvature at the optimum.

    Infinite where the flight tells nothing, or where the value is at its bound.
    """
    parts = [timeline(stretch, axis, fit.dead_time_s) for stretch in flown]
    x = np.array(fit.parameters)
    moves = _HESSIAN_STEP * np.eye(len(x))
    rows = [
        (_slope(parts, fit.model, x + move)[1] - _slope(parts, fit.model, x - move)[1]) / (2.0 * _HESSIAN_STEP)
        for move in moves
    ]
    curvature = (np.array(rows) + np.array(rows).T) / 4.0  # of the log likelihood: half the deviance's
    free = np.diag(curvature) > 0.0  # what is at its bound may go on falling beyond
    variances = np.full(len(x), np.inf)
    with suppress(np.linalg.LinAlgError):
        variances[free] = np.diag(np.linalg.inv(curvature[np.ix_(free, free)]))
    spread = np.sqrt(np.where(variances > 0.0, variances, np.inf))
    scale = [one.outside(place) if one.logarithmic else 1.0 for one, place in zip(fit.model.free, x, strict=True)]
    return {one.name: float(s * size) for one, s, size in zip(fit.model.free, spread, scale, strict=True)}


def _slope(parts: Sequence[Timeline], model: AxisModel, x: Array) -> tuple[float, Array]:
    """Deviance and its gradient (m,), by central differences in one pass."""
    steps = np.array([one.step for one in model.free])
    moves = np.diag(steps)
    found = deviance(parts, model, np.vstack([x, x + moves, x - moves]))
    count = len(x)
    return float(found[0]), (found[1 : count + 1] - found[count + 1 :]) / (2.0 * steps)
