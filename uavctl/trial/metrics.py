"""What a flight came to, from where the vehicle truly was. Pure; lengths in metres, times in seconds."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def distances_m(positions: Array, wanted: Array) -> Array:
    """Distance (n,) of positions (n, 3) from where they were wanted, (3,) or (n, 3)."""
    return np.asarray(np.linalg.norm(positions - wanted, axis=1))


def rms_m(distances: Array) -> float:
    """Root mean square; NaN of nothing."""
    return float(np.sqrt(np.mean(distances**2))) if distances.size else math.nan


def largest(values: Array) -> float:
    """The largest; NaN of nothing."""
    return float(values.max()) if values.size else math.nan


def mean(values: Array) -> float:
    """The mean; NaN of nothing."""
    return float(values.mean()) if values.size else math.nan


def settled_s(times: Array, distances: Array, radius_m: float) -> float:
    """Time from which on the vehicle stays within a radius to the end; infinite if it is outside at the end.

    Args:
        times: (n,), increasing.
        distances: From the target at these times (n,).
        radius_m: The radius.
    """
    outside = np.flatnonzero(distances > radius_m)
    if not outside.size:
        return float(times[0])
    last = int(outside[-1])
    return math.inf if last + 1 == len(times) else float(times[last + 1])


def beyond_m(positions: Array, lower: Array, upper: Array) -> Array:
    """How far positions (n, 3) are through the nearest wall (n,); negative is the room that is left to it.

    Args:
        positions: (n, 3).
        lower: Least position in the room (3,), minus infinity where there is no wall.
        upper: Largest.
    """
    return np.asarray(np.maximum(lower - positions, positions - upper).max(axis=1))
