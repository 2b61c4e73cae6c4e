"""The most likely parameters of an axis, by maximum likelihood of the filter's innovations."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from uavctl.identify.history import Stretch
from uavctl.identify.response import Timeline, deviance, timeline

Array = NDArray[np.float64]

# Least and largest value of each parameter, and the step of its difference quotient. The lag's pole stays
# above the drag's: a motion does not tell which is whose.
_BOUNDS = ((np.log(0.01), np.log(0.6)), (-0.1, 1.5), (0.2, 5.0), (np.log(1e-4), np.log(10.0)), (np.log(1e-3), 0.0))
_STEPS = np.array([1e-4, 1e-4, 1e-4, 1e-3, 1e-3])
# The likelihood has more than one hill: one start with little drag, one with much.
_STARTS = tuple(np.array([np.log(0.2), drag, 1.0, np.log(0.05), np.log(0.01)]) for drag in (0.1, 1.0))
COARSE_S = tuple(0.04 * i for i in range(1, 9))
FINE_S = 0.02
FITS = len(COARSE_S) + 3  # of an axis: without dead time, the coarse grid, and two neighbours of its best
_HESSIAN_STEP = 1e-2


@dataclass(frozen=True)
class AxisFit:
    """Response of one axis.

    Attributes:
        dead_time_s: d [s].
        lag_s: T [s].
        gain: g.
        drag_1ps: c [1/s].
        wind_mps2_rts: Density of the white acceleration noise [m/s² √s].
        noise_m: Standard deviation of a position [m].
        deviance: -2 log likelihood, up to a constant.
        parameters: The same as a parameter vector of `response`.
    """

    dead_time_s: float
    lag_s: float
    gain: float
    drag_1ps: float
    wind_mps2_rts: float
    noise_m: float
    deviance: float
    parameters: tuple[float, ...]


def fit_axis(flown: Sequence[Stretch], axis: int, dead_time_s: float, start: Sequence[float] | None = None) -> AxisFit:
    """Fit one axis with a given dead time.

    Args:
        flown: Stretches of the flight.
        axis: 0 north, 1 east, 2 down.
        dead_time_s: d [s].
        start: Parameter vector to begin with.
    """
    parts = [timeline(stretch, axis, dead_time_s) for stretch in flown]
    begins = _STARTS if start is None else (np.array(start),)

    def slope(x: Array) -> tuple[float, Array]:
        return _slope(parts, x)

    ends = [minimize(slope, x, jac=True, method="L-BFGS-B", bounds=_BOUNDS) for x in begins]
    found = min(ends, key=lambda end: float(end.fun))
    x = np.array(found.x)
    return AxisFit(
        dead_time_s=dead_time_s,
        lag_s=float(np.exp(x[0])),
        gain=float(x[2]),
        drag_1ps=float(x[1]),
        wind_mps2_rts=float(np.exp(x[3])),
        noise_m=float(np.exp(x[4])),
        deviance=float(found.fun),
        parameters=tuple(x.tolist()),
    )


def scan_dead_time(flown: Sequence[Stretch], axis: int, without: AxisFit, advance: Callable[[], None]) -> AxisFit:
    """The most likely dead time of a grid, the other parameters free; each fit begins where the last one ended."""
    best = last = without
    for dead_time_s in COARSE_S:
        last = fit_axis(flown, axis, dead_time_s, last.parameters)
        best = min(best, last, key=lambda fit: fit.deviance)
        advance()
    for dead_time_s in (best.dead_time_s - FINE_S, best.dead_time_s + FINE_S):
        if dead_time_s > 0.0:
            near = fit_axis(flown, axis, dead_time_s, best.parameters)
            best = min(best, near, key=lambda fit: fit.deviance)
        advance()
    return best


def standard_errors(flown: Sequence[Stretch], axis: int, fit: AxisFit) -> tuple[float, float, float]:
    """Standard errors of lag [s], drag [1/s] and gain, by the curvature at the optimum; infinite without."""
    parts = [timeline(stretch, axis, fit.dead_time_s) for stretch in flown]
    x = np.array(fit.parameters)
    moves = _HESSIAN_STEP * np.eye(len(x))
    rows = [(_slope(parts, x + move)[1] - _slope(parts, x - move)[1]) / (2.0 * _HESSIAN_STEP) for move in moves]
    curvature = (np.array(rows) + np.array(rows).T) / 4.0  # of the log likelihood: half the deviance's
    try:
        variances = np.diag(np.linalg.inv(curvature))
    except np.linalg.LinAlgError:
        variances = np.full(len(x), -1.0)
    log_lag, drag, gain = (float(np.sqrt(value)) if value > 0.0 else float("inf") for value in variances[:3])
    return log_lag * fit.lag_s, drag, gain


def _slope(parts: Sequence[Timeline], x: Array) -> tuple[float, Array]:
    """Deviance and its gradient (5,), by central differences in one pass."""
    moves = np.diag(_STEPS)
    values = deviance(parts, np.vstack([x, x + moves, x - moves]))
    count = len(x)
    return float(values[0]), (values[1 : count + 1] - values[count + 1 :]) / (2.0 * _STEPS)
