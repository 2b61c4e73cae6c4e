"""Reachable sets of vehicles that keep to no cell: boxes that grow by the limits of speed and acceleration."""

from __future__ import annotations

import numpy as np

from uavctl.arrays import Array


def find_reach(
    position_m: Array, velocity_mps: Array, accel_mps2: Array, speed_mps: Array, times_s: Array
) -> tuple[Array, Array]:
    """Find the box (n, 3), (n, 3) that a vehicle may have reached at some times (n,) since it was seen.

    Args:
        position_m: Position when it was seen (3,).
        velocity_mps: Velocity then (3,).
        accel_mps2: Largest acceleration of each axis (3,); with zero the speed stays.
        speed_mps: Largest speed of each axis (3,); a larger one when it was seen counts instead.
    """
    upper_m = position_m + _find_way(velocity_mps, accel_mps2, speed_mps, times_s)
    lower_m = position_m - _find_way(-velocity_mps, accel_mps2, speed_mps, times_s)
    return lower_m, upper_m


def _find_way(velocity_mps: Array, accel_mps2: Array, speed_mps: Array, times_s: Array) -> Array:
    """Find the longest way (n, 3) in the positive direction [m]."""
    # s(t) = v t + a t² / 2 up to the largest speed, then at this speed
    top_mps = np.maximum(speed_mps, velocity_mps)
    longest_s = np.divide(top_mps - velocity_mps, accel_mps2, out=np.full(3, np.inf), where=accel_mps2 > 0.0)
    rise_s = np.minimum(times_s[:, None], longest_s)
    way_m: Array = velocity_mps * rise_s + 0.5 * accel_mps2 * rise_s**2 + top_mps * (times_s[:, None] - rise_s)
    return way_m
