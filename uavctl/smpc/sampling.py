"""Sampled and continuous plants: matrix exponential and logarithm of [[A, B, E], [0, I]], in balanced units."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import matrix_balance, sqrtm

Array = NDArray[np.float64]


def exponential(matrix: Array) -> Array:
    """Matrix exponential by scaling, series and squaring.

    scipy's `expm` divides differences of nearly equal diagonal entries of a triangular matrix (SciPy 1.17: an error
    of 0.05 for drags of 1e-15), and plants with an integrator and little drag are just that.
    """
    norm = float(np.abs(matrix).sum(axis=1).max())
    halvings = max(0, math.ceil(math.log2(max(norm, 0.25) / 0.25)))
    scaled = matrix / 2.0**halvings
    term = result = np.eye(len(matrix))
    for order in range(1, 15):  # 0.25^15 / 15! is below 1e-21
        term = term @ scaled / order
        result = result + term
    for _ in range(halvings):
        result = result @ result
    return result


def logarithm(matrix: Array) -> Array:
    """Principal matrix logarithm by square roots and series.

    scipy's `logm` judges itself by its `expm` and warns in vain.
    """
    identity = np.eye(len(matrix))
    root, halvings = matrix, 0
    while np.abs(root - identity).sum(axis=1).max() > 0.1 and halvings < 60:
        root, halvings = np.real(sqrtm(root)), halvings + 1
    # log R = 2 artanh Z with Z = (R + I)⁻¹ (R - I); |Z| <= 0.053, so that |Z|^17 is below 1e-21
    z = np.linalg.solve(root + identity, root - identity)
    square = z @ z
    power = total = z
    for order in range(3, 17, 2):
        power = power @ square
        total = total + power / order
    return np.asarray(2.0 ** (halvings + 1) * total, dtype=np.float64)


def balanced_units(a: Array, b: Array, e: Array) -> Array:
    """Units (n_x + n_u + n_w,), powers of 2, in which the entries of A, B and E are of similar size.

    A plant in metres and one in millimetres are the same numbers in these units, up to a factor of 2.
    """
    _, (unit_x, _) = matrix_balance(a, permute=False, separate=True)
    reach = np.abs(np.hstack([b, e]) / unit_x[:, None]).max(axis=0, initial=0.0)
    unit_u = np.exp2(-np.round(np.log2(np.where(reach > 0.0, reach, 1.0))))
    return np.concatenate([unit_x, unit_u])
