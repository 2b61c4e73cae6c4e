"""Age of information (Sec. 4.1): its distribution for a link whose probabilities may vary in time."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from uavctl.errors import DesignError

Array = NDArray[np.float64]


def age_distribution(p: Array) -> Array:
    """Distribution of the age over the steps to come, from an age of 0: (4), (5).

    Args:
        p: Link probabilities of the steps 1 … T (T,).

    Returns:
        mu (T+1, T+1): mu[t, j] = P(a(k+t) = j).

    Raises:
        DesignError: An entry is no probability.
    """
    if not np.all((p >= 0.0) & (p <= 1.0)):
        raise DesignError("link.loss", f"the link's probabilities {p.tolist()} are not all in [0, 1]", "correct them")
    steps = len(p)
    mu = np.zeros((steps + 1, steps + 1))
    mu[0, 0] = 1.0
    for t in range(1, steps + 1):
        mu[t, 0] = p[t - 1]
        mu[t, 1:] = (1.0 - p[t - 1]) * mu[t - 1, :-1]
    return mu


def at_most(mu: Array, t: int, age: int) -> float:
    """P(a(k+t) <= age)."""
    return float(mu[t, : max(0, age + 1)].sum())


def information_probability(mu: Array, t: int, r: int) -> float:
    """p_{t,r}: probability that w(k+r) is available at stage t."""
    return at_most(mu, t, t - r - 1)
