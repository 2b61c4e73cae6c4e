"""Intervals of figures of many runs.

The runs of a cell are independent, the steps of one run are not. So a share of runs has the exact interval (Clopper and
Pearson, 1934). Figures of steps are means over runs, with the bootstrap over runs. All cells use the same draws: two
controllers are compared by the differences of each pair of runs, which vary much less.
"""

from __future__ import annotations

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from logs.report.statistics import exact_interval
from uavctl.arrays import Array
from uavctl.errors import UsageError

Interval = tuple[float, float]
RUNS_LEVEL = 0.95
RESAMPLES = 2000

# From here on the mean's skewness (that of a value over the root of their number) moves the percentiles by less than
# a tenth of a standard error for a skewness up to 3, and both intervals agree.
MAX_BOOTSTRAP_VALUES = 2000
_MAX_DRAWS = 1_000_000  # draws held at once

# Fewer runs than this with a violation are too few to resample: a bootstrap of none at all has no width.
MIN_RESAMPLED_RUNS = 20


class PairedDifference(msgspec.Struct, frozen=True, kw_only=True):
    """Mean difference of a figure between two controllers on the same draws, with its interval."""

    mean: float
    low: float
    high: float
    runs: int  # pairs

    @property
    def sign(self) -> int:
        """-1 or 1 where the interval lies on one side of zero, else 0."""
        return int(self.low > 0.0) - int(self.high < 0.0)


def clopper_pearson(hits: int, trials: int, level: float = RUNS_LEVEL) -> Interval:
    """Return the exact interval of a probability (Clopper and Pearson, 1934), by quantiles of the beta distribution.

    Args:
        hits: Number of independent trials in which it happened.
        level: Confidence that it covers the probability, at least.

    Raises:
        UsageError: There are no trials, or more hits than trials.
    """
    if not 0 <= hits <= trials or trials == 0:
        raise UsageError(f"{hits} of {trials} is no share; count at least one trial, and no more hits than trials")
    return exact_interval(hits, trials, 0.5 * (1.0 - level))


def max_step_rate(hits: NDArray[np.int64], runs: int, steps: int, level: float = RUNS_LEVEL) -> tuple[float, Interval]:
    """Return the highest rate of any step, with an interval that holds for all steps at once.

    The worst step is chosen by the same runs, so that an interval of its own would be too narrow: each step has the
    exact one at the level 1 - (1 - `level`) / T (Bonferroni), and the worst one's is reported.

    Args:
        hits: Runs in which it happened, by step (K,), K <= T; none in those that follow.
        level: Confidence that all T intervals cover their probabilities at least.
    """
    max_hits = int(hits.max(initial=0))
    return max_hits / runs, clopper_pearson(max_hits, runs, 1.0 - (1.0 - level) / steps)


def bootstrap_mean(values: Array, level: float = RUNS_LEVEL, seed: int = 0) -> Interval:
    """Return the interval of a mean by the bootstrap, beyond `BOOTSTRAP_UP_TO` values by the normal distribution.

    Args:
        values: Independent values (N,).
        seed: Seed of the resampling; the same values give the same interval.

    Raises:
        UsageError: There are no values.
    """
    values = np.asarray(values, dtype=np.float64)
    n = values.size
    if n == 0:
        raise UsageError("the mean of no values has no interval; fly at least one run")
    mean = float(values.mean())
    tail = 0.5 * (1.0 - level)
    if n == 1:
        return mean, mean
    if n > MAX_BOOTSTRAP_VALUES:
        reach = float(ndtri(1.0 - tail)) * float(values.std(ddof=1)) / n**0.5
        return mean - reach, mean + reach
    rng = np.random.default_rng(seed)
    means = np.empty(RESAMPLES)
    rows = max(1, _MAX_DRAWS // n)
    for first in range(0, RESAMPLES, rows):
        chunk = means[first : first + rows]
        chunk[:] = values[rng.integers(0, n, (chunk.size, n))].mean(axis=1)
    low, high = np.quantile(means, [tail, 1.0 - tail])
    return float(low), float(high)


def paired_difference(a: Array, b: Array, level: float = RUNS_LEVEL) -> PairedDifference:
    """Return the mean of a - b (N,), run against run on the same draws, with its interval.

    Raises:
        UsageError: There are no pairs, or runs without a partner.
    """
    if a.shape != b.shape:
        raise UsageError(f"{a.size} runs cannot be paired with {b.size}; compare the same runs")
    difference = np.asarray(a - b, dtype=np.float64)
    low, high = bootstrap_mean(difference, level)
    return PairedDifference(mean=float(difference.mean()), low=low, high=high, runs=difference.size)


def step_rate(hits: Array, steps: int, level: float = RUNS_LEVEL) -> tuple[float, Interval]:
    """Return the share of steps in which something happened, with its interval over runs.

    Where it happened in few runs, these are counted exactly instead of resampled: the share of such runs times what a
    run of them has on average; the whole share of runs (the rate can be no more) where there was none.

    Args:
        hits: Number of steps in which it happened, by run (N,).
    """
    share = hits / steps
    rate = float(share.mean())
    (runs_hit,) = np.nonzero(hits)
    if runs_hit.size >= MIN_RESAMPLED_RUNS:
        return rate, bootstrap_mean(share, level)
    low, high = clopper_pearson(runs_hit.size, hits.size, level)
    mean_share = float(share[runs_hit].mean()) if runs_hit.size else 1.0
    return rate, (low * mean_share, high * mean_share)
