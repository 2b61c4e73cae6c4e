"""Frames of reference and quaternions. Only this file changes the sign of an axis.

All other code uses local NED (north, east, down). A frame has an axis convention, a heading and an origin:

    p_ned = R_z(yaw) A p + origin

A is a proper rotation (determinant +1) for each convention. So a mirrored frame cannot be configured.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Literal

from uavctl.records import Vec3

Convention = Literal["ned", "enu", "flu"]
Quaternion = tuple[float, float, float, float]


def suggest_height_sign(axis: str, value_m: float, low_m: float, high_m: float) -> str:
    """Return a hint if a height outside the limits was written as a positive "down"; else an empty text."""
    if axis != "down" or value_m <= high_m or not low_m <= -value_m <= high_m:
        return ""
    return f"up is negative: write {-value_m:g}"


# A of each convention. Each is its own inverse and has determinant +1.
_AXES_TO_NED: dict[Convention, Callable[[Vec3], Vec3]] = {
    "ned": lambda v: v,  # also FRD: forward, right, down
    "enu": lambda v: (v[1], v[0], -v[2]),
    "flu": lambda v: (v[0], -v[1], -v[2]),
}
# A as a quaternion (w, x, y, z): half a turn about (1, 1, 0), or about the first axis.
_SQRT_HALF = math.sqrt(0.5)
_AXES_ROTATION_TO_NED: dict[Convention, Quaternion] = {
    "ned": (1.0, 0.0, 0.0, 0.0),
    "enu": (0.0, _SQRT_HALF, _SQRT_HALF, 0.0),
    "flu": (0.0, 1.0, 0.0, 0.0),
}
_ROTATION_FLU_TO_FRD: Quaternion = (0.0, 1.0, 0.0, 0.0)  # body axes forward, right, down to forward, left, up
_QUADRANTS = {0.0: (1.0, 0.0), 90.0: (0.0, 1.0), 180.0: (-1.0, 0.0), 270.0: (0.0, -1.0)}
_UNIT_TOLERANCE = 0.1  # of a length: messages carry single precision, and a zero quaternion means "not given"

Up = Literal["y", "z"]
# A right-handed camera frame with a horizontal first axis, to forward, right, down.
_AXES_TO_FRD: dict[Up, Callable[[Vec3], Vec3]] = {"y": lambda v: (v[0], v[2], -v[1]), "z": _AXES_TO_NED["flu"]}


def _compute_cos_sin(yaw_deg: float) -> tuple[float, float]:
    """Compute cosine and sine, exact at quarter turns."""
    angle_deg = yaw_deg % 360.0
    return _QUADRANTS.get(angle_deg) or (math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg)))


@dataclass(frozen=True)
class Frame:
    """Frame that is fixed in the room, and its pose in local NED.

    Raises:
        ValueError: an unknown convention, or a number that is not finite.
    """

    convention: Convention = "ned"  # its axes: `ned` (or forward, right, down), `enu`, `flu` (forward, left, up)
    origin_m: Vec3 = (0.0, 0.0, 0.0)  # position of its origin in local NED [m]
    # heading of its first axis after conversion to down-pointing axes, clockwise seen from above [deg]
    yaw_deg: float = 0.0
    _rotation: tuple[float, float] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if self.convention not in _AXES_TO_NED:
            raise ValueError(f"convention {self.convention!r} is none of {', '.join(_AXES_TO_NED)}")
        if len(self.origin_m) != 3 or not all(map(math.isfinite, (*self.origin_m, self.yaw_deg))):
            raise ValueError(
                f"origin_m {self.origin_m} and yaw_deg {self.yaw_deg} must be three and one finite numbers"
            )
        object.__setattr__(self, "_rotation", _compute_cos_sin(self.yaw_deg))

    def to_ned(self, position_m: Vec3) -> Vec3:
        """Convert a position in this frame [m] to local NED [m]."""
        n, e, d = self.velocity_to_ned(position_m)
        return (n + self.origin_m[0], e + self.origin_m[1], d + self.origin_m[2])

    def from_ned(self, position_m: Vec3) -> Vec3:
        """Convert a position in local NED [m] to this frame [m]; the inverse of `to_ned`."""
        n, e, d = position_m
        return self.velocity_from_ned((n - self.origin_m[0], e - self.origin_m[1], d - self.origin_m[2]))

    def velocity_to_ned(self, velocity_mps: Vec3) -> Vec3:
        """Convert a free vector (velocity, acceleration) of this frame to local NED."""
        x, y, z = _AXES_TO_NED[self.convention](velocity_mps)
        cos, sin = self._rotation
        # R_z(yaw) A v
        return (cos * x - sin * y, sin * x + cos * y, z)

    def attitude_to_ned(self, attitude: Quaternion, *, euler: bool) -> Quaternion:
        """Convert a body's attitude in this frame to local NED, with body axes forward, right, down.

        Args:
            attitude: body axes to this frame's axes (w, x, y, z).
            euler: whether it came as Euler angles. Then its body axes are forward, left, up if the frame points up.
        """
        if euler and self.convention != "ned":
            attitude = multiply_quaternions(attitude, _ROTATION_FLU_TO_FRD)
        half_rad = math.radians(self.yaw_deg) / 2
        rotated = multiply_quaternions(_AXES_ROTATION_TO_NED[self.convention], attitude)
        return multiply_quaternions((math.cos(half_rad), 0.0, 0.0, math.sin(half_rad)), rotated)

    def attitude_from_ned(self, attitude: Quaternion, *, euler: bool) -> Quaternion:
        """Convert a body's attitude in local NED to this frame; the inverse of `attitude_to_ned`, up to the sign."""
        half_rad = -math.radians(self.yaw_deg) / 2
        rotated = multiply_quaternions((math.cos(half_rad), 0.0, 0.0, math.sin(half_rad)), attitude)
        # These rotations are their own inverses.
        rotated = multiply_quaternions(_AXES_ROTATION_TO_NED[self.convention], rotated)
        return multiply_quaternions(rotated, _ROTATION_FLU_TO_FRD) if euler and self.convention != "ned" else rotated

    def velocity_from_ned(self, velocity_mps: Vec3) -> Vec3:
        """Convert a free vector of local NED to this frame; the inverse of `velocity_to_ned`."""
        n, e, d = velocity_mps
        cos, sin = self._rotation
        # A⁻¹ R_z(-yaw) v
        return _AXES_TO_NED[self.convention]((cos * n + sin * e, cos * e - sin * n, d))


def convert_pose_to_frd(position_m: Vec3, attitude: Quaternion, up: Up) -> tuple[Vec3, Quaternion]:
    """Convert a camera system's pose: the axes of the room and those of the body become forward, right, down.

    Args:
        position_m: in the room's axes, right-handed [m].
        attitude: body axes to room axes (w, x, y, z); the identity if the axes are the same.

    Returns:
        Position [m] and attitude; forward is the first axis.
    """
    w, x, y, z = attitude
    # r q r⁻¹: the rotation of both sets of axes turns the axis of q and keeps its angle.
    return _AXES_TO_FRD[up](position_m), (w, *_AXES_TO_FRD[up]((x, y, z)))


def convert_covariance_to_ned(covariance: Sequence[float], convention: Convention) -> tuple[float, ...]:
    """Convert the covariance of a pose to local NED with the same north.

    Args:
        covariance: 6 x 6 by rows; position [m], then small rotations about the fixed axes [rad].

    Returns:
        The upper triangle of the converted matrix, by rows.
    """
    convert = _AXES_TO_NED[convention]

    def convert_columns(rows: Sequence[Sequence[float]]) -> list[tuple[float, ...]]:
        return [(*convert((a, b, c)), *convert((d, e, f))) for a, b, c, d, e, f in rows]

    # B C B', B = diag(A, A)
    half = convert_columns([covariance[i : i + 6] for i in range(0, 36, 6)])
    rows = convert_columns(list(zip(*half, strict=True)))
    return tuple([value for i, row in enumerate(rows) for value in row[i:]])


def rotation_to_ned(convention: Convention) -> Quaternion:
    """Return the rotation (w, x, y, z) from a convention to local NED with the same north; it is its own inverse."""
    return _AXES_ROTATION_TO_NED[convention]


def rotate_vector(q: Quaternion, vector: Vec3) -> Vec3 | None:
    """Rotate a vector by a quaternion (w, x, y, z): body axes to the axes that q refers to.

    Args:
        q: quaternion; it is normalised first.

    Returns:
        The vector in reference axes; None if q is no rotation (not finite, or its length is not near 1).
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


def normalise_quaternion(q: tuple[float, ...]) -> Quaternion | None:
    """Scale a quaternion to length 1; None if it is no rotation (not finite, or its length is not near 1)."""
    w, x, y, z = q
    length = math.sqrt(w * w + x * x + y * y + z * z)
    if not abs(length - 1.0) <= _UNIT_TOLERANCE:  # also false for NaN
        return None
    return w / length, x / length, y / length, z / length


def multiply_quaternions(p: Quaternion, q: Quaternion) -> Quaternion:
    """Return the product p q: the rotation q, then p."""
    a, b, c, d = p
    w, x, y, z = q
    return (
        a * w - b * x - c * y - d * z,
        a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x,
        a * z + b * y - c * x + d * w,
    )


def quaternion_from_euler(angles_rad: Vec3) -> Quaternion | None:
    """Convert roll, pitch and yaw [rad] (about z, then y, then x) to a quaternion; None if one is not finite."""
    if not all(map(math.isfinite, angles_rad)):
        return None
    roll, pitch, yaw = angles_rad
    cr, cp, cy = math.cos(roll / 2), math.cos(pitch / 2), math.cos(yaw / 2)
    sr, sp, sy = math.sin(roll / 2), math.sin(pitch / 2), math.sin(yaw / 2)
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


def quaternion_from_axes(axes: Sequence[Sequence[float]]) -> Quaternion:
    """Return the rotation of the coordinate axes into three orthonormal directions, each up to its sign.

    Args:
        axes: the directions; the last one is reversed if they are left-handed.
    """
    a, b, c = axes
    right = (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])
    if sum(x * y for x, y in zip(right, c, strict=True)) < 0.0:
        c = right
    # 4 q_i q_j in row i: the row of the largest q_i loses no digits.
    rows = (
        (1 + a[0] + b[1] + c[2], b[2] - c[1], c[0] - a[2], a[1] - b[0]),
        (b[2] - c[1], 1 + a[0] - b[1] - c[2], a[1] + b[0], c[0] + a[2]),
        (c[0] - a[2], a[1] + b[0], 1 - a[0] + b[1] - c[2], b[2] + c[1]),
        (a[1] - b[0], c[0] + a[2], b[2] + c[1], 1 - a[0] - b[1] + c[2]),
    )
    w, x, y, z = max(enumerate(rows), key=lambda row: row[1][row[0]])[1]
    length = math.sqrt(w * w + x * x + y * y + z * z)
    return w / length, x / length, y / length, z / length


def euler_from_quaternion(q: Quaternion) -> Vec3:
    """Convert a quaternion to roll, pitch and yaw [rad]."""
    w, x, y, z = q
    pitch = math.asin(min(max(2.0 * (w * y - x * z), -1.0), 1.0))
    roll = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    return roll, pitch, math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
