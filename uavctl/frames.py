"""Frames of reference: the only file that flips a sign.

Everything behind this file is local NED (north, east, down). A frame is a right-handed axis
convention, a heading and an origin. Each of the three is a proper rotation or a shift, so a mirrored
or left-handed result cannot be configured.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Literal

from uavctl.records import Vec3

Convention = Literal["ned", "enu", "flu"]
Quaternion = tuple[float, float, float, float]


def up_hint(axis: str, value_m: float, low_m: float, high_m: float) -> str:
    """Return a hint for a height that was written as a positive "down" outside limits; empty if it was not."""
    if axis != "down" or value_m <= high_m or not low_m <= -value_m <= high_m:
        return ""
    return f"up is negative: write {-value_m:g}"


# Each map is its own inverse and has determinant +1.
_SWAP: dict[Convention, Callable[[Vec3], Vec3]] = {
    "ned": lambda v: v,  # also FRD: forward, right, down
    "enu": lambda v: (v[1], v[0], -v[2]),
    "flu": lambda v: (v[0], -v[1], -v[2]),
}
# The same as turns (w, x, y, z): half a turn about (1, 1, 0), or about the first axis.
_HALF = math.sqrt(0.5)
_SWAP_TURN: dict[Convention, Quaternion] = {
    "ned": (1.0, 0.0, 0.0, 0.0),
    "enu": (0.0, _HALF, _HALF, 0.0),
    "flu": (0.0, 1.0, 0.0, 0.0),
}
_HALF_ROLL: Quaternion = (0.0, 1.0, 0.0, 0.0)  # body axes forward, right, down to forward, left, up
_QUADRANTS = {0.0: (1.0, 0.0), 90.0: (0.0, 1.0), 180.0: (-1.0, 0.0), 270.0: (0.0, -1.0)}
_UNIT_TOLERANCE = 0.1

Up = Literal["y", "z"]
# A right-handed camera frame whose first axis lies level, to (first axis, its right-hand side, down).
_LEVEL: dict[Up, Callable[[Vec3], Vec3]] = {"y": lambda v: (v[0], v[2], -v[1]), "z": _SWAP["flu"]}


def _cos_sin(yaw_deg: float) -> tuple[float, float]:
    """Cosine and sine, exact at quarter turns."""
    turn = yaw_deg % 360.0
    return _QUADRANTS.get(turn) or (math.cos(math.radians(turn)), math.sin(math.radians(turn)))


@dataclass(frozen=True)
class Frame:
    """A frame fixed in the room, and its place in local NED.

    Raises:
        ValueError: an unknown convention, or a number that is not finite.
    """

    convention: Convention = "ned"  # its axes: `ned` (or forward, right, down), `enu`, `flu` (forward, left, up)
    origin_m: Vec3 = (0.0, 0.0, 0.0)  # position of its origin in local NED [m]
    # heading of its first axis after conversion to down-pointing axes, clockwise seen from above [deg]
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

    def attitude_to_ned(self, attitude: Quaternion, *, euler: bool) -> Quaternion:
        """A body's attitude in this frame as one in local NED, body axes forward, right, down.

        Args:
            attitude: body axes to this frame's axes (w, x, y, z).
            euler: it came as Euler angles, whose body axes point up (forward, left, up) where the frame's do.
        """
        if euler and self.convention != "ned":
            attitude = multiply(attitude, _HALF_ROLL)
        half_rad = math.radians(self.yaw_deg) / 2
        turned = multiply(_SWAP_TURN[self.convention], attitude)
        return multiply((math.cos(half_rad), 0.0, 0.0, math.sin(half_rad)), turned)

    def velocity_from_ned(self, velocity_mps: Vec3) -> Vec3:
        """A free vector of local NED in this frame; inverse of `velocity_to_ned`."""
        n, e, d = velocity_mps
        cos, sin = self._rotation
        return _SWAP[self.convention]((cos * n + sin * e, cos * e - sin * n, d))


def levelled(position_m: Vec3, attitude: Quaternion, up: Up) -> tuple[Vec3, Quaternion]:
    """A camera system's pose with both sets of axes, the room's and the body's, turned to forward, right, down.

    Args:
        position_m: in the room's axes, right-handed [m].
        attitude: the body's axes to the room's (w, x, y, z); a body that it does not turn has the room's axes.

    Returns:
        Position [m] and attitude; forward is the first axis.
    """
    w, x, y, z = attitude
    # One turn of both sets of axes turns the axis of the rotation with them, and leaves its angle.
    return _LEVEL[up](position_m), (w, *_LEVEL[up]((x, y, z)))


def axes_turn(convention: Convention) -> Quaternion:
    """The turn (w, x, y, z) between local NED and a frame of this convention with the same north; its own inverse."""
    return _SWAP_TURN[convention]


def rotate(q: Quaternion, vector: Vec3) -> Vec3 | None:
    """Rotate a vector by a quaternion (w, x, y, z): body axes to the axes that q refers to.

    Args:
        q: quaternion; its length is normalised.

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
    return (a + w * tx + y * tz - z * ty, b + w * ty + z * tx - x * tz, c + w * tz + x * ty - y * tx)


def unit(q: tuple[float, ...]) -> Quaternion | None:
    """A quaternion of length 1; None if it is no rotation (not finite, or its length is not near 1)."""
    length = math.sqrt(sum(value * value for value in q))
    if not abs(length - 1.0) <= _UNIT_TOLERANCE:  # also false for NaN
        return None
    w, x, y, z = q
    return w / length, x / length, y / length, z / length


def multiply(p: Quaternion, q: Quaternion) -> Quaternion:
    """The rotation q, then p."""
    a, b, c, d = p
    w, x, y, z = q
    return (
        a * w - b * x - c * y - d * z,
        a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x,
        a * z + b * y - c * x + d * w,
    )


def from_euler(angles_rad: Vec3) -> Quaternion | None:
    """The rotation of roll, pitch and yaw [rad], turned about z, y, x in this order; None if one is not finite."""
    if not all(map(math.isfinite, angles_rad)):
        return None
    (cr, sr), (cp, sp), (cy, sy) = ((math.cos(angle / 2), math.sin(angle / 2)) for angle in angles_rad)
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


def from_axes(axes: Sequence[Sequence[float]]) -> Quaternion:
    """The rotation that turns the coordinate axes into three orthonormal directions, each up to its sign.

    Args:
        axes: the directions; the last one is turned round where they would be a mirror image.
    """
    a, b, c = axes
    right = (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])
    if sum(x * y for x, y in zip(right, c, strict=True)) < 0.0:
        c = right
    # Four times the products of the quaternion's parts; the row of the largest one loses no digits.
    rows = (
        (1 + a[0] + b[1] + c[2], b[2] - c[1], c[0] - a[2], a[1] - b[0]),
        (b[2] - c[1], 1 + a[0] - b[1] - c[2], a[1] + b[0], c[0] + a[2]),
        (c[0] - a[2], a[1] + b[0], 1 - a[0] + b[1] - c[2], b[2] + c[1]),
        (a[1] - b[0], c[0] + a[2], b[2] + c[1], 1 - a[0] - b[1] + c[2]),
    )
    w, x, y, z = max(enumerate(rows), key=lambda row: row[1][row[0]])[1]
    length = math.sqrt(w * w + x * x + y * y + z * z)
    return w / length, x / length, y / length, z / length


def to_euler(q: Quaternion) -> Vec3:
    """Roll, pitch and yaw of a rotation [rad]."""
    w, x, y, z = q
    pitch = math.asin(min(max(2.0 * (w * y - x * z), -1.0), 1.0))
    roll = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    return roll, pitch, math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
