"""Disturbances of many runs: each kind a transform of the same standard normal draws."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, stdtrit

from uavctl.campaign.spec import DisturbanceSpec

Array = NDArray[np.float64]

_DEGREES = 4.0  # of Student's t; its variance is degrees / (degrees - 2)


def disturbances(spec: DisturbanceSpec, w: Array, normal: Array) -> Array:
    """w(k) of every run (N, T, n_w).

    Args:
        spec: The kind; all have mean `bias` and covariance scale² W, gusts as they are once they have long blown.
        w: W (n_w, n_w).
        normal: Standard normal draws (N, T, n_w), see `Chances.normal`.
    """
    shaped = spec.scale * _shaped(spec, normal) @ _root(w)
    return np.asarray(shaped + spec.bias * np.sqrt(np.diag(w)), dtype=np.float64)


def _shaped(spec: DisturbanceSpec, normal: Array) -> Array:
    """Draws of mean 0 and covariance I."""
    if spec.kind == "uniform":
        return np.asarray(np.sqrt(3.0) * (2.0 * ndtr(normal) - 1.0), dtype=np.float64)
    if spec.kind == "heavy":
        # By the lower tail on either side: the upper one's probability would be rounded to 1.
        tail = stdtrit(_DEGREES, ndtr(-np.abs(normal)))
        return np.asarray(-np.sign(normal) * tail * np.sqrt((_DEGREES - 2.0) / _DEGREES), dtype=np.float64)
    if spec.kind == "gusts":
        gusts = normal.copy()
        for k in range(1, normal.shape[1]):
            gusts[:, k] = spec.memory * gusts[:, k - 1] + np.sqrt(1.0 - spec.memory**2) * normal[:, k]
        return gusts
    return normal


def _root(w: Array) -> Array:
    """The symmetric root of W: there is one, and it is unique, for every covariance."""
    values, vectors = np.linalg.eigh(w)
    return np.asarray((vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T, dtype=np.float64)
