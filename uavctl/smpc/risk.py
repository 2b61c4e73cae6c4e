"""Risk allocation: how a likelihood becomes the factor of a back-off."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from scipy.special import gammaincinv, ndtri

Allocation = Literal["ellipsoid", "halfspace"]


def kappa(gamma: float, n: int, rows: int, allocation: Allocation) -> float:
    """κ: how many standard deviations a row keeps away from its limit.

    Args:
        gamma: Likelihood that the whole vector has to be inside with.
        n: Dimension of the vector.
        rows: Number of limits.
        allocation: `ellipsoid`: sqrt of the χ² quantile with n degrees of freedom, as printed; `halfspace`: Boole's
            inequality, the same share of the risk for each row, with Gaussian quantiles.
    """
    if allocation == "ellipsoid":
        return _chi(gamma, n)
    return float(-ndtri((1.0 - gamma) / max(1, rows)))


def component_kappa(gamma: float, sizes: Sequence[int]) -> float:
    """κ of an ellipsoid for each of m independent parts: each holds with γ^(1/m), so that all hold with γ.

    Args:
        gamma: Likelihood that the whole vector has to be inside with.
        sizes: Dimension of each part; the largest decides.
    """
    return _chi(gamma ** (1.0 / len(sizes)), max(sizes))


def _chi(gamma: float, n: int) -> float:
    """Root of the χ² quantile with n degrees of freedom."""
    return float(np.sqrt(2.0 * gammaincinv(0.5 * n, gamma)))
