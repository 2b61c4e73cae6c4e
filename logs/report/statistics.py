"""Statistical tests of a flight against what was promised, exact where they exist; confidence intervals from runs."""

from __future__ import annotations

import math

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy.special import bdtrc, betaincinv, chdtrc, chdtri, ndtr, ndtri

from logs.recording.design_view import Floats
from uavctl.errors import UsageError

# Confidence of all intervals of one table together: a right promise is called broken in one flight of a hundred.
LEVEL = 0.99


class Share(msgspec.Struct, frozen=True, kw_only=True):
    """Share of trials in which something happened, with its exact interval (Clopper and Pearson, 1934)."""

    hits: int
    trials: int
    low: float
    high: float

    @property
    def rate(self) -> float:
        """Hits over trials; 0 without trials."""
        return self.hits / self.trials if self.trials else 0.0


def share(hits: int, trials: int, tests: int = 1, worth: float = 1.0) -> Share:
    """Return a share of trials with its interval; without trials the interval is 0 to 1.

    Args:
        hits: Number of trials in which it happened.
        tests: Number of intervals that are to hold together with `LEVEL` (Bonferroni).
        worth: Independent trials that each one is worth; 1 where they are independent.

    Raises:
        ValueError: More hits than trials, or fewer than none.
    """
    if not 0 <= hits <= trials:
        raise ValueError(f"{hits} of {trials} is no share")
    low, high = exact_interval(worth * hits, worth * trials, 0.5 * (1.0 - LEVEL) / tests)
    return Share(hits=hits, trials=trials, low=low, high=high)


def finite(value: float) -> float | None:
    """A figure for a document, which has no infinity; None where it is none."""
    return value if math.isfinite(value) else None


def exact_interval(hits: float, trials: float, tail: float) -> tuple[float, float]:
    """Return the interval of a probability by quantiles of the beta distribution (Clopper and Pearson, 1934).

    Args:
        hits: Independent trials in which it happened; parts of one where a trial is worth less than one.
        tail: Probability, at most, that it lies below the interval; the same for above.
    """
    low = float(betaincinv(hits, trials - hits + 1.0, tail)) if hits else 0.0
    high = float(betaincinv(hits + 1.0, trials - hits, 1.0 - tail)) if hits < trials else 1.0
    return low, high


def at_least(hits: int, trials: int, probability: float) -> float:
    """Return P(X >= hits) for X binomial: the p-value of so many hits if each has `probability` at most."""
    return float(bdtrc(hits - 1, trials, probability))


def two_sided_normal(z: float) -> float:
    """Return P(|Z| >= |z|) for Z standard normal."""
    return float(2.0 * ndtr(-abs(z)))


def normal_reach(tests: int = 1) -> float:
    """Return z with P(|Z| > z) = (1 - LEVEL) / tests, Z standard normal."""
    return float(-ndtri(0.5 * (1.0 - LEVEL) / tests))


def variance_bounds(count: int, tests: int = 1) -> tuple[float, float]:
    """Return bounds of the mean of `count` squared standard normal numbers, by the χ² distribution."""
    tail = 0.5 * (1.0 - LEVEL) / tests
    low, high = (chi2_quantile(p, count) / count for p in (tail, 1.0 - tail))
    return low, high


def variance_p(squares: float, count: int) -> float:
    """Return the two-sided p-value of a sum of `count` squared standard normal numbers."""
    above = float(chdtrc(count, squares))
    return min(1.0, 2.0 * min(above, 1.0 - above))


def autocorrelation(values: Floats, lags: int) -> Floats:
    """Return the autocorrelation of a sequence (n,) at 1 … `lags` (lags,); 0 where nothing varies."""
    centred = values - values.mean() if len(values) else values
    size = float(centred @ centred)
    if size == 0.0:
        return np.zeros(lags)
    return np.array(
        [float(centred[lag:] @ centred[:-lag]) / size if lag < len(values) else 0.0 for lag in range(1, lags + 1)]
    )


def ljung_box(correlation: Floats, count: int) -> tuple[float, float]:
    """Return Q = n (n+2) Σ r_k² / (n-k) of Ljung and Box (1978), and its p-value: χ² with `lags` degrees of freedom.

    Args:
        correlation: r_k, k = 1 … (lags,).
        count: n, length of the sequence; longer than there are lags.
    """
    lags = np.arange(1, len(correlation) + 1)
    q = float(count * (count + 2) * np.sum(correlation**2 / (count - lags)))
    return q, float(chdtrc(len(correlation), q))


def chi2_quantile(probability: float, degrees: int) -> float:
    """Return a quantile of the χ² distribution."""
    return float(chdtri(degrees, 1.0 - probability))


Array = NDArray[np.float64]
Pair = tuple[float, float]

# Intervals from runs. The runs of a cell are independent, the steps of a run are not. So the exact interval (Clopper
# and Pearson) is that of a share of runs; figures of steps are means over runs, with the bootstrap over runs. All cells
# share their draws, so two controllers are compared by the differences of run against run, which vary far less.

RUNS_LEVEL = 0.95
RESAMPLES = 2000
# From here on the mean's skewness (that of a value over the root of their number) moves the percentiles by less than
# a tenth of a standard error for a skewness up to 3, and both intervals agree.
BOOTSTRAP_UP_TO = 2000
_CHUNK = 1_000_000  # draws held at once
# Fewer runs than this with a violation are too few to resample: a bootstrap of none at all has no width.
FEW = 20


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


def clopper_pearson(hits: int, trials: int, level: float = RUNS_LEVEL) -> Pair:
    """Return the exact interval of a probability (Clopper and Pearson, 1934), by quantiles of the beta distribution.

    Args:
        hits: Number of independent trials in which it happened.
        level: Confidence that it covers the probability at least, whatever that is.

    Raises:
        UsageError: There are no trials, or more hits than trials.
    """
    if not 0 <= hits <= trials or trials == 0:
        raise UsageError(f"{hits} of {trials} is no share; count at least one trial, and no more hits than trials")
    return exact_interval(hits, trials, 0.5 * (1.0 - level))


def worst_step(hits: NDArray[np.int64], runs: int, steps: int, level: float = RUNS_LEVEL) -> tuple[float, Pair]:
    """Return the highest rate of any step, with an interval that holds for all steps at once.

    The worst step is chosen by the same runs, so that an interval of its own would say too much: each step has the
    exact one at the level 1 - (1 - `level`) / T (Bonferroni), and the worst one's is told.

    Args:
        hits: Runs in which it happened, by step (K,), K <= T; none in those that follow.
        level: Confidence that all T intervals cover their probabilities at least.
    """
    most = int(hits.max(initial=0))
    return most / runs, clopper_pearson(most, runs, 1.0 - (1.0 - level) / steps)


def bootstrap_mean(values: Array, level: float = RUNS_LEVEL, seed: int = 0) -> Pair:
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
    if n > BOOTSTRAP_UP_TO:
        reach = float(ndtri(1.0 - tail)) * float(values.std(ddof=1)) / n**0.5
        return mean - reach, mean + reach
    rng = np.random.default_rng(seed)
    means = np.empty(RESAMPLES)
    rows = max(1, _CHUNK // n)
    for first in range(0, RESAMPLES, rows):
        some = means[first : first + rows]
        some[:] = values[rng.integers(0, n, (some.size, n))].mean(axis=1)
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


def step_rate(hits: Array, steps: int, level: float = RUNS_LEVEL) -> tuple[float, Pair]:
    """Return the share of steps in which something happened, with its interval over runs.

    Where it happened in few runs, these are counted exactly instead of resampled: the share of such runs times what a
    run of them has on average; the whole share of runs (the rate can be no more) where there was none.

    Args:
        hits: Number of steps in which it happened, by run (N,).
    """
    share = hits / steps
    rate = float(share.mean())
    (some,) = np.nonzero(hits)
    if some.size >= FEW:
        return rate, bootstrap_mean(share, level)
    low, high = clopper_pearson(some.size, hits.size, level)
    each = float(share[some].mean()) if some.size else 1.0
    return rate, (low * each, high * each)
