"""Inner loops of the cascade: acceleration setpoint to thrust and attitude, to body rates, to torque."""

from __future__ import annotations

import math

import msgspec

from sim.vehicle.airframe import GRAVITY_MPS2, Airframe
from sim.vehicle.rigid_body import BodyState, Quaternion
from uavctl.records import Vec3

RATE_GAIN_1PS = 110.0
RATE_DERIVATIVE = 3.0
RATE_INTEGRAL_1PS2 = 200.0
YAW_RATE_GAIN_1PS = 6.0
YAW_INTEGRAL_1PS2 = 6.0
DERIVATIVE_LAG_S = 0.004
MAX_RATE_RPS = math.radians(220.0)
MAX_YAW_RATE_RPS = math.radians(90.0)
MIN_UP_MPS2 = 1.0  # smallest upward thrust of a setpoint: keeps its attitude defined


class AttitudeSetpoint(msgspec.Struct, frozen=True):
    """Thrust per mass, and the attitude that points it."""

    force_mps2: Vec3  # specific force wanted of the rotors, NED
    attitude: Quaternion  # that points the rotors along it with the wanted heading
    is_tilt_limited: bool  # whether the tilt limit reduced the horizontal part
    is_dive_limited: bool  # whether the requested dive would leave no thrust to tilt


def compute_attitude_setpoint(accel_mps2: Vec3, yaw_rad: float, tilt_limit_rad: float) -> AttitudeSetpoint:
    """Return the setpoint that gives an acceleration in still air; where the tilt is limited, height has priority."""
    north, east = accel_mps2[0], accel_mps2[1]
    wanted_up = GRAVITY_MPS2 - accel_mps2[2]
    up = max(wanted_up, MIN_UP_MPS2)
    horizontal = math.sqrt(north * north + east * east)
    max_horizontal = up * math.tan(tilt_limit_rad)
    is_limited = horizontal > max_horizontal
    if is_limited:
        north, east = north * max_horizontal / horizontal, east * max_horizontal / horizontal
    norm = math.sqrt(north * north + east * east + up * up)
    # Body-down is against the force; half-angle formula of the shortest turn from down to there, then the heading.
    bx, by, bz = -north / norm, -east / norm, up / norm
    w = math.sqrt(0.5 * (1.0 + bz))
    x, y = -0.5 * by / w, 0.5 * bx / w
    c, s = math.cos(0.5 * yaw_rad), math.sin(0.5 * yaw_rad)
    attitude = (w * c, x * c + y * s, y * c - x * s, w * s)
    return AttitudeSetpoint((north, east, -up), attitude, is_limited, up != wanted_up)


class AttitudeLoop:
    """Attitude controller: proportional from attitude error to rates, PID from rates to torque.

    Args:
        airframe: its inertia turns angular accelerations into torques.
        attitude_gain_1ps: rate per angle of roll and pitch; yaw has a quarter of it.
    """

    def __init__(self, airframe: Airframe, attitude_gain_1ps: float, step_s: float) -> None:
        self._inertia = airframe.inertia_kgm2
        self._gain = attitude_gain_1ps
        self._step_s = step_s
        self._filter_gain = 1.0 - math.exp(-step_s / DERIVATIVE_LAG_S)
        self.reset((0.0, 0.0, 0.0))

    def reset(self, rates_rps: Vec3) -> None:
        """Forget the past; the body turns at these rates [rad/s]."""
        self._last_rates_rps = rates_rps
        self._rate_derivative: Vec3 = (0.0, 0.0, 0.0)
        self._integral: Vec3 = (0.0, 0.0, 0.0)

    def compute_torque(self, motion: BodyState, attitude: Quaternion, *, integrate: bool) -> Vec3:
        """Return the torque that turns the body towards an attitude [N m]; do not `integrate` at the rotors' limits."""
        w, x, y, z = motion.attitude
        a, b, c, d = attitude
        ew, ex = w * a + x * b + y * c + z * d, w * b - x * a - y * d + z * c
        ey, ez = w * c + x * d - y * a - z * b, w * d - x * c + y * b - z * a
        # As the autopilots do it: the shortest turn that points the thrust first, whatever the heading still lacks.
        upright = math.sqrt(ew * ew + ez * ez)
        if upright > 0.0:
            ex, ey = (ew * ex - ey * ez) / upright, (ew * ey + ex * ez) / upright
        p, q = 2.0 * self._gain * ex, 2.0 * self._gain * ey
        r = math.copysign(0.5, ew) * self._gain * ez
        size = math.sqrt(p * p + q * q)
        if size > MAX_RATE_RPS:
            p, q = p * MAX_RATE_RPS / size, q * MAX_RATE_RPS / size
        r = min(max(r, -MAX_YAW_RATE_RPS), MAX_YAW_RATE_RPS)
        return self._compute_rate_torque(motion.rates_rps, (p, q, r), integrate)

    def _compute_rate_torque(self, rates: Vec3, target_rps: Vec3, integrate: bool) -> Vec3:
        (lp, lq, lr), (sp, sq, sr), (ip, iq, ir) = self._last_rates_rps, self._rate_derivative, self._integral
        p, q, r = rates
        filter_gain = self._filter_gain
        per_step = 1.0 / self._step_s
        sp += filter_gain * ((p - lp) * per_step - sp)
        sq += filter_gain * ((q - lq) * per_step - sq)
        sr += filter_gain * ((r - lr) * per_step - sr)
        ep, eq, er = target_rps[0] - p, target_rps[1] - q, target_rps[2] - r
        if integrate:
            tilt_gain, yaw_gain = RATE_INTEGRAL_1PS2 * self._step_s, YAW_INTEGRAL_1PS2 * self._step_s
            ip, iq, ir = ip + tilt_gain * ep, iq + tilt_gain * eq, ir + yaw_gain * er
        self._last_rates_rps, self._rate_derivative, self._integral = rates, (sp, sq, sr), (ip, iq, ir)
        jx, jy, jz = self._inertia
        return (
            jx * (RATE_GAIN_1PS * ep + ip - RATE_DERIVATIVE * sp),
            jy * (RATE_GAIN_1PS * eq + iq - RATE_DERIVATIVE * sq),
            jz * (YAW_RATE_GAIN_1PS * er + ir),
        )
