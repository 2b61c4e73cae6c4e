"""Frames of reference: the only file that flips a sign.

Everything behind this file is local NED (north, east, down). A frame is a right-handed axis
convention, a heading and an origin. Each of the three is a proper rotation or a shift, so a mirrored
or left-handed result cannot be configured.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

from uavctl.data import Vec3

Convention = Literal["ned", "enu", "flu"]
Quaternion = tuple[float, float, float, float]

# Each map is its own inverse and has determinant +1.
_SWAP: dict[Convention, Callable[[Vec3], Vec3]] = {
    "ned": lambda v: v,  # also FRD: forward, right, down
    "enu": lambda v: (v[1], v[0], -v[2]),
    "flu": lambda v: (v[0], -v[1], -v[2]),
}
_QUADRANTS = {0.0: (1.0, 0.0), 90.0: (0.0, 1.0), 180.0: (-1.0, 0.0), 270.0: (0.0, -1.0)}
_UNIT_TOLERANCE = 0.1


def _cos_sin(yaw_deg: float) -> tuple[float, float]:
    """Cosine and sine, exact at quarter turns."""
    turn = yaw_deg % 360.0
    return _QUADRANTS.get(turn) or (math.cos(math.radians(turn)), math.sin(math.radians(turn)))


@dataclass(frozen=True)
class Frame:
    """A frame fixed in the room, and its place in local NED.

    Attributes:
        convention: its axes: `ned` (or forward, right, down), `enu`, `flu` (forward, left, up).
        origin_m: position of its origin in local NED [m].
        yaw_deg: heading of its first axis after conversion to down-pointing axes, clockwise seen
            from above [deg].

    Raises:
        ValueError: an unknown convention, or a number that is not finite.
    """

    convention: Convention = "ned"
    origin_m: Vec3 = (0.0, 0.0, 0.0)
    yaw_deg: float = 0.0
    _rotation: tuple[float, float] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if self.convention not in _SWAP:
            raise ValueError(f"convention {self.convention!r} is none of {', '.join(_SWAP)}")
        if len(self.origin_m) != 3 or not all(map(math.isfinite, (*self.origin_m, self.yaw_deg))):
            raise ValueError(
                f"origin_m {self.origin_m} and yaw_deg {self.yaw_deg} must be three and one finite numbers"
            )
        object.__setattr__(self, "_rotation", _cos_sin(self.yaw_deg))

    def to_ned(self, position_m: Vec3) -> Vec3:
        """A position in this frame [m] as a position in local NED [m]."""
        n, e, d = self.velocity_to_ned(position_m)
        return (n + self.origin_m[0], e + self.origin_m[1], d + self.origin_m[2])

    def from_ned(self, position_m: Vec3) -> Vec3:
        """A position in local NED [m] as a position in this frame [m]; inverse of `to_ned`."""
        n, e, d = position_m
        return self.velocity_from_ned((n - self.origin_m[0], e - self.origin_m[1], d - self.origin_m[2]))

    def velocity_to_ned(self, velocity_mps: Vec3) -> Vec3:
        """A free vector (velocity, acceleration) of this frame in local NED."""
        x, y, z = _SWAP[self.convention](velocity_mps)
        cos, sin = self._rotation
        return (cos * x - sin * y, sin * x + cos * y, z)

    def velocity_from_ned(self, velocity_mps: Vec3) -> Vec3:
        """A free vector of local NED in this frame; inverse of `velocity_to_ned`."""
        n, e, d = velocity_mps
        cos, sin = self._rotation
        return _SWAP[self.convention]((cos * n + sin * e, cos * e - sin * n, d))


def rotate(q: Quaternion, vector: Vec3) -> Vec3 | None:
    """Rotate a vector by a quaternion (w, x, y, z): body axes to the axes that q refers to.

    Args:
        q: quaternion; its length is normalised.
        vector: vector in body axes.

    Returns:
        The vector in reference axes, or None if q is no rotation (not finite, or its length is not near 1).
    """
    w, x, y, z = q
    length = math.sqrt(w * w + x * x + y * y + z * z)
    if not abs(length - 1.0) <= _UNIT_TOLERANCE:  # also false for NaN
        return None
    w, x, y, z = w / length, x / length, y / length, z / length
    a, b, c = vector
    # v + 2 w (u × v) + 2 u × (u × v), u = (x, y, z)
    tx, ty, tz = 2 * (y * c - z * b), 2 * (z * a - x * c), 2 * (x * b - y * a)
    return (
        a + w * tx + y * tz - z * ty,
        b + w * ty + z * tx - x * tz,
        c + w * tz + x * ty - y * tx,
    )
