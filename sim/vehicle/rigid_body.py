"""Motion of a rigid body with thrust, rotor drag and body drag; attitude as quaternion, axes NED and FRD.

Plain floats: at this size they are several times faster than small arrays, and the same bits everywhere.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import msgspec

from sim.vehicle.airframe import AIR_DENSITY_KGPM3, GRAVITY_MPS2, Airframe
from uavctl.records import Vec3

Quaternion = tuple[float, float, float, float]  # w, x, y, z: turns body axes into NED

LEVEL: Quaternion = (1.0, 0.0, 0.0, 0.0)


class Wrench(msgspec.Struct, frozen=True):
    """Force and torque of the rotors on the body."""

    thrust_n: float  # along -down of the body
    torque_nm: Vec3  # about front, right, down
    speeds_rps: float  # sum of the rotors' speeds; rotor drag is proportional to it


class BodyState(NamedTuple):
    """State of the body: position and velocity in NED, attitude, rates about body axes."""

    position_m: Vec3
    velocity_mps: Vec3
    attitude: Quaternion
    rates_rps: Vec3


@dataclass(frozen=True)
class Body:
    """Constants of a body in the form that the equations of motion need."""

    mass_kg: float
    inertia_kgm2: Vec3
    rotor_drag_kg: Vec3
    body_drag_kgpm: Vec3  # ½ ρ C_d A

    @classmethod
    def from_airframe(cls, airframe: Airframe) -> Body:
        """Return the body of an airframe."""
        front, right, down = (0.5 * AIR_DENSITY_KGPM3 * area for area in airframe.drag_area_m2)
        return cls(airframe.mass_kg, airframe.inertia_kgm2, airframe.rotor_drag_kg, (front, right, down))


def rotate_attitude(attitude: Quaternion, angle: Vec3) -> Quaternion:
    """Return the attitude turned further by a rotation vector [rad] in body axes; of unit norm."""
    w, x, y, z = attitude
    p, q, r = angle
    square = p * p + q * q + r * r
    norm = math.sqrt(square)
    c = math.cos(0.5 * norm)
    s = math.sin(0.5 * norm) / norm if norm > 1e-6 else 0.5 - square / 48.0
    p, q, r = s * p, s * q, s * r
    w, x, y, z = (
        w * c - x * p - y * q - z * r,
        w * p + x * c + y * r - z * q,
        w * q - x * r + y * c + z * p,
        w * r + x * q - y * p + z * c,
    )
    scale = 1.0 / math.sqrt(w * w + x * x + y * y + z * z)  # takes away rounding only
    return w * scale, x * scale, y * scale, z * scale


def reduce_tilt(attitude: Quaternion, factor: float) -> Quaternion:
    """Return the attitude with the tangent of half its tilt shrunk to the share `keep`; the heading stays."""
    w, x, y, z = attitude
    heading = math.sqrt(w * w + z * z)
    c, s = (w / heading, z / heading) if heading > 0.0 else (1.0, 0.0)
    # attitude = (heading, tx, ty, 0) ⊗ (c, 0, 0, s)
    tx, ty = factor * (x * c - y * s), factor * (y * c + x * s)
    norm = math.sqrt(heading * heading + tx * tx + ty * ty)
    heading, tx, ty = heading / norm, tx / norm, ty / norm
    return heading * c, tx * c + ty * s, ty * c - tx * s, heading * s


def compute_acceleration(
    body: Body, attitude: Quaternion, velocity: Vec3, wrench: Wrench, wind: Vec3, down_mps2: float = GRAVITY_MPS2
) -> Vec3:
    """Return the acceleration of the centre of mass in NED [m/s²], with that of gravity and downwash, `down_mps2`.

    Drag in body axes, of the velocity v relative to the air: -(d ΣΩ + ½ ρ C_d A |v|) v, each axis with its own
    coefficients.
    """
    w, x, y, z = attitude
    xx, yy, zz, xy, xz, yz, wx, wy, wz = x * x, y * y, z * z, x * y, x * z, y * z, w * x, w * y, w * z
    r11, r12, r13 = 1.0 - 2.0 * (yy + zz), 2.0 * (xy - wz), 2.0 * (xz + wy)
    r21, r22, r23 = 2.0 * (xy + wz), 1.0 - 2.0 * (xx + zz), 2.0 * (yz - wx)
    r31, r32, r33 = 2.0 * (xz - wy), 2.0 * (yz + wx), 1.0 - 2.0 * (xx + yy)
    north, east, down = velocity[0] - wind[0], velocity[1] - wind[1], velocity[2] - wind[2]
    u = r11 * north + r21 * east + r31 * down
    v = r12 * north + r22 * east + r32 * down
    s = r13 * north + r23 * east + r33 * down
    speed = math.sqrt(north * north + east * east + down * down)
    k, c, total = body.rotor_drag_kg, body.body_drag_kgpm, wrench.speeds_rps
    scale = -1.0 / body.mass_kg
    fx = scale * (k[0] * total + c[0] * speed) * u
    fy = scale * (k[1] * total + c[1] * speed) * v
    fz = scale * ((k[2] * total + c[2] * speed) * s + wrench.thrust_n)
    return (r11 * fx + r12 * fy + r13 * fz, r21 * fx + r22 * fy + r23 * fz, r31 * fx + r32 * fy + r33 * fz + down_mps2)


def _compute_angular_accel(body: Body, rates: Vec3, torque: Vec3) -> Vec3:
    """Return angular accelerations by Euler's equations: J ω' = τ - ω x J ω."""
    jx, jy, jz = body.inertia_kgm2
    p, q, r = rates
    return (
        (torque[0] - (jz - jy) * q * r) / jx,
        (torque[1] - (jx - jz) * r * p) / jy,
        (torque[2] - (jy - jx) * p * q) / jz,
    )


def _compute_rotation_vector_rate(angle: Vec3, rates: Vec3) -> Vec3:
    """Return the rate of the rotation vector: θ' = ω + ½ θ x ω + 1/12 θ x (θ x ω), enough for fourth order."""
    a, b, c = angle
    p, q, r = rates
    x, y, z = b * r - c * q, c * p - a * r, a * q - b * p
    return (
        p + 0.5 * x + (b * z - c * y) / 12.0,
        q + 0.5 * y + (c * x - a * z) / 12.0,
        r + 0.5 * z + (a * y - b * x) / 12.0,
    )


def _add_scaled(start: Vec3, slope: Vec3, h: float) -> Vec3:
    x, y, z = start
    u, v, w = slope
    return x + h * u, y + h * v, z + h * w


def _integrate_slopes(start: Vec3, a: Vec3, b: Vec3, c: Vec3, d: Vec3, h: float) -> Vec3:
    """Return the values after a step, by the weights of the classical Runge-Kutta method (Simpson's rule)."""
    return (
        start[0] + h * ((a[0] + 2.0 * (b[0] + c[0]) + d[0]) / 6.0),
        start[1] + h * ((a[1] + 2.0 * (b[1] + c[1]) + d[1]) / 6.0),
        start[2] + h * ((a[2] + 2.0 * (b[2] + c[2]) + d[2]) / 6.0),
    )


def integrate_step(
    body: Body,
    start: BodyState,
    wrenches: tuple[Wrench, Wrench, Wrench],
    wind: Vec3,
    h: float,
    down_mps2: float = GRAVITY_MPS2,
) -> BodyState:
    """Return the state after one step of Runge and Kutta's fourth-order method, after Munthe-Kaas on the rotations.

    The attitude moves by the exponential of a rotation vector that is integrated like any other variable, so it
    stays a rotation by construction and the order is kept; a method on the four numbers of the quaternion would
    need them pushed back to unit norm in every step, which is an error of the method's own size.

    Args:
        wrenches: wrenches of the rotors at the start, the middle and the end of the step.
        wind: velocity of the air in NED, held over the step [m/s].
        h: length of the step [s].
        down_mps2: downward acceleration by gravity and downwash.
    """
    first, middle, last = wrenches
    position, v1, attitude, w1 = start
    half = 0.5 * h

    a1 = compute_acceleration(body, attitude, v1, first, wind, down_mps2)
    s1 = _compute_angular_accel(body, w1, first.torque_nm)

    angle = _add_scaled((0.0, 0.0, 0.0), w1, half)
    w2 = _add_scaled(w1, s1, half)
    t2 = _compute_rotation_vector_rate(angle, w2)
    v2 = _add_scaled(v1, a1, half)
    a2 = compute_acceleration(body, rotate_attitude(attitude, angle), v2, middle, wind, down_mps2)
    s2 = _compute_angular_accel(body, w2, middle.torque_nm)

    angle = _add_scaled((0.0, 0.0, 0.0), t2, half)
    w3 = _add_scaled(w1, s2, half)
    t3 = _compute_rotation_vector_rate(angle, w3)
    v3 = _add_scaled(v1, a2, half)
    a3 = compute_acceleration(body, rotate_attitude(attitude, angle), v3, middle, wind, down_mps2)
    s3 = _compute_angular_accel(body, w3, middle.torque_nm)

    angle = _add_scaled((0.0, 0.0, 0.0), t3, h)
    w4 = _add_scaled(w1, s3, h)
    t4 = _compute_rotation_vector_rate(angle, w4)
    v4 = _add_scaled(v1, a3, h)
    a4 = compute_acceleration(body, rotate_attitude(attitude, angle), v4, last, wind, down_mps2)
    s4 = _compute_angular_accel(body, w4, last.torque_nm)

    sixth = h * h / 6.0
    return BodyState(
        (
            position[0] + h * v1[0] + sixth * (a1[0] + a2[0] + a3[0]),
            position[1] + h * v1[1] + sixth * (a1[1] + a2[1] + a3[1]),
            position[2] + h * v1[2] + sixth * (a1[2] + a2[2] + a3[2]),
        ),
        _integrate_slopes(v1, a1, a2, a3, a4, h),
        rotate_attitude(attitude, _integrate_slopes((0.0, 0.0, 0.0), w1, t2, t3, t4, h)),
        _integrate_slopes(w1, s1, s2, s3, s4, h),
    )
