"""The dead time of a plant by its likelihood, and what a plant predicts of the half of a flight it was not fitted to.

The dead time is where the deviance of the whole flight, summed over the axes, is least. Prediction tells plants apart
and not dead times: a lag stands in for one with hardly a difference at 0.25 s and more. It is judged by halves, blocks
in turn so that each has something of every manoeuvre, on the motion of the next 0.25 to 2 s; the figure is the
geometric mean of the rms errors over these times and the axes, in which each counts alike. For the fit as for the
judgement the filter goes through the whole flight, and only the innovations in a half, or the motions, count: where it
began anew in each block, they would tell how it finds the state and little of the plant.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from uavctl.errors import RecordingError
from uavctl.identify.axis_model import AxisModel
from uavctl.identify.fit import ROUGH, AxisFit, fit_axes
from uavctl.identify.history import LEAST_SAMPLES, Stretch
from uavctl.identify.prediction import AHEAD_S, predict_ahead

Array = NDArray[np.float64]

COARSE_S = tuple(round(0.04 * i, 2) for i in range(9))
FINE_S = 0.02
TRIES = len(COARSE_S) + 3  # the coarse grid, two neighbours of its best, and the halves
_RISE = 4.0  # of the deviance: two standard errors
BLOCK_S = 8.0
_GROUP_S = 4.0  # errors nearer to each other in time are not independent
_CERTAIN = 2.0  # standard errors


@dataclass(frozen=True, eq=False)
class HeldOutError:
    """What a plant predicts of the halves that it was not fitted to.

    Attributes:
        squares: Sums of squared errors by group of time, axis and time ahead (groups, axes, ahead) [m²].
        counts: How many they are, alike.
    """

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
class ChosenPlant:
    """One kind of plant with its likeliest dead time.

    Attributes:
        curve: Dead times that were tried [s], in order, and the deviance of each above the least.
        dead_time_s: The one with the least deviance [s].
        range_s: Where the deviance is less than 4 above it, between tried ones by straight lines [s].
        fits: Each axis, fitted to the whole flight with it.
        judged: What it predicts of the halves.
    """

    curve: tuple[tuple[float, float], ...]
    dead_time_s: float
    range_s: tuple[float, float]
    fits: tuple[AxisFit, ...]
    judged: HeldOutError

    @property
    def name(self) -> str:
        """Of the plant."""
        return self.fits[0].model.name


def choose_dead_time(
    flown: Sequence[Stretch], axes: Sequence[int], models: Sequence[AxisModel], advance: Callable[[], None]
) -> ChosenPlant:
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
    judged = _judged(flown, both, axes, tried[best_s])
    advance()
    return ChosenPlant(curve, best_s, _range_s(curve, best_s), tried[best_s], judged)


def _total(fits: Sequence[AxisFit]) -> float:
    return sum(fit.deviance for fit in fits)


def _range_s(curve: Sequence[tuple[float, float]], best_s: float) -> tuple[float, float]:
    """Where the deviance crosses 4 on either side of its least; the end of the curve where it does not."""
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
    """Whether an error is larger beyond two standard errors of the difference (jackknife over groups of 4 s)."""
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
    """Blocks of each stretch in turn.

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


def _judged(
    flown: Sequence[Stretch],
    both: tuple[tuple[Block, ...], tuple[Block, ...]],
    axes: Sequence[int],
    fits: Sequence[AxisFit],
) -> HeldOutError:
    begin = min(stretch.times_s[0] for stretch in flown)
    groups = 1 + int((max(stretch.times_s[-1] for stretch in flown) - begin) / _GROUP_S)
    squares, counts = np.zeros((groups, len(axes), len(AHEAD_S))), np.zeros((groups, len(axes), len(AHEAD_S)))
    models, starts = [one.model for one in fits], [one.parameters for one in fits]
    for half, other in (both, both[::-1]):
        counting = [replace(stretch, counted=_within(half, stretch.times_s)) for stretch in flown]
        for i, fit in enumerate(fit_axes(counting, axes, models, fits[0].dead_time_s, starts)):
            for j, one in enumerate(predict_ahead(flown, axes[i], fit)):
                held_out = _within(other, one.times_s, AHEAD_S[j])
                group = ((one.times_s[held_out] - begin) / _GROUP_S).astype(np.int64)
                squares[:, i, j] += np.bincount(group, weights=one.errors_m[held_out] ** 2, minlength=groups)
                counts[:, i, j] += np.bincount(group, minlength=groups)
    return HeldOutError(squares, counts)


def _within(half: Sequence[Block], times_s: Array, ahead_s: float = 0.0) -> NDArray[np.bool_]:
    """Whether a block of a half holds each of some times, and the time so much later."""
    held = [(times_s >= block.begin_s) & (times_s + ahead_s <= block.end_s) for block in half]
    return np.asarray(np.logical_or.reduce(held), dtype=np.bool_)
