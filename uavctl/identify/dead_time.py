"""The dead time of a plant by what it predicts: fitted to one half of a flight, judged by the other.

Halves are blocks in turn, so that each has something of every manoeuvre. Judged is the motion of the next 0.25 to 2 s;
the figure is the geometric mean of its rms errors over these times and the axes, in which each counts alike.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from uavctl.errors import RecordingError
from uavctl.identify.axis_model import AxisModel
from uavctl.identify.fit import AxisFit, fit_axis
from uavctl.identify.history import LEAST_SAMPLES, Stretch
from uavctl.identify.prediction import predict_ahead

Array = NDArray[np.float64]

COARSE_S = tuple(round(0.04 * i, 2) for i in range(8))
FINE_S = 0.02
TRIES = len(COARSE_S) + 3  # the coarse grid, two neighbours of its best, and the whole flight
BLOCK_S = 8.0
_GROUP_S = 4.0  # errors nearer to each other in time are not independent
_CERTAIN = 2.0  # standard errors


@dataclass(frozen=True, eq=False)
class Judged:
    """What one dead time predicts of the halves that it was not fitted to.

    Attributes:
        dead_time_s: d [s].
        squares: Sums of squared errors by group of time, axis and time ahead (groups, axes, ahead) [m²].
        counts: How many they are, alike.
    """

    dead_time_s: float
    squares: Array
    counts: Array

    @property
    def rms_m(self) -> Array:
        """Rms error (axes, ahead) [m]."""
        return np.asarray(np.sqrt(self.squares.sum(axis=0) / np.maximum(self.counts.sum(axis=0), 1.0)))

    def scores(self) -> Array:
        """Logarithm of the figure without each group in turn (groups + 1,), and last with all."""
        squares = np.vstack([self.squares.sum(axis=0) - self.squares, self.squares.sum(axis=0)[None]])
        counts = np.vstack([self.counts.sum(axis=0) - self.counts, self.counts.sum(axis=0)[None]])
        return np.asarray(0.5 * np.log(np.maximum(squares, 1e-12) / np.maximum(counts, 1.0)).mean(axis=(1, 2)))

    @property
    def error_m(self) -> float:
        """Geometric mean of the rms errors [m]."""
        return float(np.exp(self.scores()[-1]))


@dataclass(frozen=True, eq=False)
class Chosen:
    """One kind of plant with the dead time that predicts best.

    Attributes:
        curve: Every dead time that was tried, in order.
        best: The one with the least error.
        alike_s: Least and largest dead time whose error is not larger beyond two standard errors [s].
        fits: Each axis, fitted to the whole flight with the best one.
    """

    curve: tuple[Judged, ...]
    best: Judged
    alike_s: tuple[float, float]
    fits: tuple[AxisFit, ...]

    @property
    def name(self) -> str:
        """Of the plant."""
        return self.fits[0].model.name


def choose_dead_time(
    flown: Sequence[Stretch], axes: Sequence[int], models: Sequence[AxisModel], advance: Callable[[], None]
) -> Chosen:
    """One dead time for all axes.

    Args:
        flown: Stretches of the flight.
        axes: 0 north, 1 east, 2 down.
        models: The plant of each axis.
        advance: Called `TRIES` times.

    Raises:
        RecordingError: The flight is too short for two halves.
    """
    both = halves(flown)
    starts = [
        tuple(fit_axis(half, axis, model, 0.1).parameters for half in both)
        for axis, model in zip(axes, models, strict=True)
    ]
    tried: dict[float, Judged] = {}

    def judge(dead_time_s: float) -> None:
        dead_time_s = round(dead_time_s, 3)
        if dead_time_s >= 0.0 and dead_time_s not in tried:
            tried[dead_time_s] = _judged(both, axes, models, starts, dead_time_s)
        advance()

    for dead_time_s in COARSE_S:
        judge(dead_time_s)
    near_s = min(tried.values(), key=lambda one: one.error_m).dead_time_s
    for dead_time_s in (near_s - FINE_S, near_s + FINE_S):
        judge(dead_time_s)
    curve = tuple(tried[key] for key in sorted(tried))
    best = min(curve, key=lambda one: one.error_m)
    alike = [one.dead_time_s for one in curve if not is_worse(one, best)]
    fits = tuple(
        fit_axis(flown, axis, model, best.dead_time_s, start[0])
        for axis, model, start in zip(axes, models, starts, strict=True)
    )
    advance()
    return Chosen(curve, best, (min(alike), max(alike)), fits)


def is_worse(one: Judged, other: Judged) -> bool:
    """Whether an error is larger beyond two standard errors of the difference (jackknife over groups of 4 s)."""
    difference = one.scores() - other.scores()
    without, whole = difference[:-1], difference[-1]
    count = len(without)
    spread = np.sqrt((count - 1) / count * np.sum((without - without.mean()) ** 2))
    return bool(whole > _CERTAIN * spread and whole > 0.0)


def halves(flown: Sequence[Stretch]) -> tuple[tuple[Stretch, ...], tuple[Stretch, ...]]:
    """Blocks of each stretch in turn.

    Raises:
        RecordingError: There are no two blocks.
    """
    blocks: list[Stretch] = []
    for stretch in flown:
        count = max(round(stretch.length_s / BLOCK_S), 1 if len(flown) > 1 else 2)
        edges = np.linspace(stretch.times_s[0], stretch.times_s[-1] + 1e-6, count + 1)
        for begin, end in pairwise(edges):
            held = (stretch.times_s >= begin) & (stretch.times_s < end)
            if held.sum() >= LEAST_SAMPLES:
                blocks.append(replace(stretch, times_s=stretch.times_s[held], positions_m=stretch.positions_m[held]))
    if len(blocks) < 2:
        raise RecordingError(
            f"the flight has {len(blocks)} block of {BLOCK_S:g} s with {LEAST_SAMPLES} positions: a fit to one half "
            "cannot be judged by the other. Fly for longer, or with more positions"
        )
    return tuple(blocks[::2]), tuple(blocks[1::2])


def _judged(
    both: tuple[tuple[Stretch, ...], tuple[Stretch, ...]],
    axes: Sequence[int],
    models: Sequence[AxisModel],
    starts: list[tuple[tuple[float, ...], ...]],
    dead_time_s: float,
) -> Judged:
    sums = []
    for place, (axis, model) in enumerate(zip(axes, models, strict=True)):
        fits = [
            fit_axis(half, axis, model, dead_time_s, start) for half, start in zip(both, starts[place], strict=True)
        ]
        starts[place] = tuple(fit.parameters for fit in fits)
        found = [predict_ahead(other, axis, fit) for fit, other in zip(fits, both[::-1], strict=True)]
        sums.append(
            [
                (np.concatenate([a.times_s, b.times_s]), np.concatenate([a.errors_m, b.errors_m]))
                for a, b in zip(*found, strict=True)
            ]
        )
    begin = min(block.times_s[0] for half in both for block in half)
    groups = 1 + int((max(block.times_s[-1] for half in both for block in half) - begin) / _GROUP_S)
    squares, counts = np.zeros((groups, len(axes), len(sums[0]))), np.zeros((groups, len(axes), len(sums[0])))
    for i, of_axis in enumerate(sums):
        for j, (times_s, errors_m) in enumerate(of_axis):
            group = ((times_s - begin) / _GROUP_S).astype(np.int64)
            squares[:, i, j] = np.bincount(group, weights=errors_m**2, minlength=groups)
            counts[:, i, j] = np.bincount(group, minlength=groups)
    flown = counts.sum(axis=(1, 2)) > 0
    return Judged(dead_time_s, squares[flown], counts[flown])
