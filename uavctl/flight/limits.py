"""Setpoint limiter: any acceleration becomes finite, bounded and slew-limited.

A multicopter tilts by φ with tan φ = |a_h| / (g - a_down). A largest tilt couples the horizontal axes: the cone
|a_h| <= (g - a_down) tan φ_max. Plans keep the largest box inside of it that is alike for both axes, so each axis has
limits of its own, and a plan keeps the deceleration that it counts on.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from uavctl.records import Vec3

AXES = ("north", "east", "down")
NON_FINITE, TILT = "non-finite", "tilt"
GRAVITY_MPS2 = 9.81
ZERO: Vec3 = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class LimitsParameters:
    """Limits of the acceleration setpoint."""

    accel_mps2: Vec3  # largest acceleration of each axis, north, east, down [m/s²]
    slew_mps3: float  # largest change in a second, each axis [m/s³]
    tilt_rad: float = math.inf  # largest tilt that setpoints ask for [rad]; infinite: no cone

    @property
    def has_cone(self) -> bool:
        """Whether there is a largest tilt."""
        return math.isfinite(self.tilt_rad)

    @property
    def box_mps2(self) -> Vec3:
        """Largest acceleration of each axis that the others leave to it, whatever they do [m/s²]."""
        north, east, down = self.accel_mps2
        # (g - a_max) tan φ_max / √2: at least thrust, both horizontal axes alike
        each = (GRAVITY_MPS2 - down) * math.tan(self.tilt_rad) / math.sqrt(2.0) if self.has_cone else math.inf
        return min(north, each), min(east, each), down


def limit_setpoint(
    want_mps2: Vec3, previous_mps2: Vec3, tick_s: float, limits: LimitsParameters
) -> tuple[Vec3, tuple[str, ...]]:
    """Make any acceleration safe to send.

    Args:
        want_mps2: Wanted acceleration north, east, down [m/s²]; any floats, NaN and infinity too.
        previous_mps2: Last setpoint [m/s²]; taken as within the limits (zero where it is not finite).
        tick_s: Time since then [s].

    Returns:
        The acceleration to send, and the names of the changes ("non-finite", "clamp-north", "slew-down", "tilt").
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
    north, east, down = out
    # |a_h| <= (g - a_down) tan φ_max
    radius = (GRAVITY_MPS2 - down) * math.tan(limits.tilt_rad) if limits.has_cone else math.inf
    horizontal = math.hypot(north, east)
    if horizontal > radius:
        limited.append(TILT)
        north, east = north * radius / horizontal, east * radius / horizontal
    return (north, east, down), tuple(limited)


def _clamp(value: float, lower: float, upper: float) -> float:
    if value < lower:
        return lower
    return upper if value > upper else value
