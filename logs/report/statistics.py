"""Statistical tests of one flight against the promises of its design; exact where exact tests exist."""

from __future__ import annotations

import math

import msgspec
import numpy as np
from scipy.special import bdtrc, betaincinv, chdtrc, chdtri, ndtr, ndtri

from uavctl.arrays import Array

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


def estimate_share(hits: int, trials: int, tests: int = 1, trial_weight: float = 1.0) -> Share:
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
    low, high = exact_interval(trial_weight * hits, trial_weight * trials, 0.5 * (1.0 - LEVEL) / tests)
    return Share(hits=hits, trials=trials, low=low, high=high)


def replace_infinite(value: float) -> float | None:
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


def binomial_p_value(hits: int, trials: int, probability: float) -> float:
    """Return P(X >= hits) for X binomial: the p-value of so many hits if each has `probability` at most."""
    return float(bdtrc(hits - 1, trials, probability))


def two_sided_p_value(z: float) -> float:
    """Return P(|Z| >= |z|) for Z standard normal."""
    return float(2.0 * ndtr(-abs(z)))


def two_sided_quantile(tests: int = 1) -> float:
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


def autocorrelation(values: Array, lags: int) -> Array:
    """Return the autocorrelation of a sequence (n,) at 1 … `lags` (lags,); 0 where nothing varies."""
    centred = values - values.mean() if len(values) else values
    size = float(centred @ centred)
    if size == 0.0:
        return np.zeros(lags)
    return np.array(
        [float(centred[lag:] @ centred[:-lag]) / size if lag < len(values) else 0.0 for lag in range(1, lags + 1)]
    )


def ljung_box(correlation: Array, count: int) -> tuple[float, float]:
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
