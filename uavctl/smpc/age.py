"""Age of information (Sec. 4.1): what its distribution mu says, mu[t, j] = P(a(k+t) = j)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def at_most(mu: Array, t: int, age: int) -> float:
    """P(a(k+t) <= age)."""
    return float(mu[t, : max(0, age + 1)].sum())


def information_probability(mu: Array, t: int, r: int) -> float:
    """p_{t,r}: probability that w(k+r) is available at stage t."""
    return at_most(mu, t, t - r - 1)
