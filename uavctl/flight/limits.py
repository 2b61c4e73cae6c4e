"""Setpoint limiter: any acceleration becomes finite, bounded and slew-limited, whatever has asked for it."""

from __future__ import annotations

import math
from dataclasses import dataclass

from uavctl.records import Vec3

AXES = ("north", "east", "down")
NON_FINITE = "non-finite"
ZERO: Vec3 = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class LimitsParameters:
    """Limits of the acceleration setpoint."""

    accel_mps2: Vec3  # largest acceleration of each axis, north, east, down [m/s²]
    slew_mps3: float  # largest change in a second, each axis [m/s³]


def limit_setpoint(
    want_mps2: Vec3, previous_mps2: Vec3, tick_s: float, limits: LimitsParameters
) -> tuple[Vec3, tuple[str, ...]]:
    """Make any acceleration safe to send.

    Args:
        want_mps2: What is asked for, north, east, down [m/s²]; any floats, NaN and infinity too.
        previous_mps2: What was sent last [m/s²]; taken as within the limits (zero where it is not finite).
        tick_s: Time since then [s].

    Returns:
        The acceleration to send, and the names of what was changed ("non-finite", "clamp-north", "slew-down" ...).
    """
    limited: list[str] = []
    if not all(map(math.isfinite, want_mps2)):
        # One bad axis says that the whole vector is not to be trusted.
        want_mps2 = ZERO
        limited.append(NON_FINITE)
    step = limits.slew_mps3 * tick_s
    out = []
    for axis, want, before, bound in zip(AXES, want_mps2, previous_mps2, limits.accel_mps2, strict=True):
        clamped = _clamp(want, -bound, bound)
        if clamped != want:
            limited.append(f"clamp-{axis}")
        start = _clamp(before, -bound, bound) if math.isfinite(before) else 0.0
        slewed = _clamp(clamped, start - step, start + step)
        if slewed != clamped:
            limited.append(f"slew-{axis}")
        out.append(slewed)
    return (out[0], out[1], out[2]), tuple(limited)


def _clamp(value: float, lower: float, upper: float) -> float:
    if value < lower:
        return lower
    return upper if value > upper else value
