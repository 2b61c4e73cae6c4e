"""Inner loops of the cascade: from a wanted acceleration to thrust and attitude, to body rates, to torque."""

from __future__ import annotations

import math
from dataclasses import dataclass

from sim.airframe import GRAVITY_MPS2, Airframe
from sim.rigid_body import Motion, Quaternion
from uavctl.data import Vec3

# Gains of the rate loop for a Crazyflie. With the derivative gain D the motors' lag of 65 ms acts like 65/(1 + D) ms.
RATE_GAIN_1PS = 110.0
RATE_DERIVATIVE = 3.0
RATE_INTEGRAL_1PS2 = 200.0
YAW_RATE_GAIN_1PS = 6.0
YAW_INTEGRAL_1PS2 = 6.0
DERIVATIVE_LAG_S = 0.004
MAX_RATE_RPS = math.radians(220.0)
MAX_YAW_RATE_RPS = math.radians(90.0)
LEAST_UP_MPS2 = 1.0  # thrust asked for is never less than this much upward: the lean stays defined


@dataclass(frozen=True)
class Lean:
    """A wanted thrust per mass and the attitude that points it.

    Attributes:
        force_mps2: specific force wanted of the rotors, NED.
        attitude: that points the rotors along it with the wanted heading.
        limited: whether the largest tilt kept the horizontal part below the wanted one.
        dive_limited: whether a dive was wanted in which no thrust would be left to lean.
    """

    force_mps2: Vec3
    attitude: Quaternion
    limited: bool
    dive_limited: bool


def lean(accel_mps2: Vec3, yaw_rad: float, tilt_limit_rad: float) -> Lean:
    """The lean that gives an acceleration in still air; height comes before way where the tilt is limited."""
    north, east = accel_mps2[0], accel_mps2[1]
    wanted_up = GRAVITY_MPS2 - accel_mps2[2]
    up = max(wanted_up, LEAST_UP_MPS2)
    level = math.sqrt(north * north + east * east)
    most = up * math.tan(tilt_limit_rad)
    limited = level > most
    if limited:
        north, east = north * most / level, east * most / level
    norm = math.sqrt(north * north + east * east + up * up)
    # Body-down is against the force; half-angle formula of the shortest turn from down to there, then the heading.
    bx, by, bz = -north / norm, -east / norm, up / norm
    w = math.sqrt(0.5 * (1.0 + bz))
    x, y = -0.5 * by / w, 0.5 * bx / w
    c, s = math.cos(0.5 * yaw_rad), math.sin(0.5 * yaw_rad)
    attitude = (w * c, x * c + y * s, y * c - x * s, w * s)
    return Lean((north, east, -up), attitude, limited, up != wanted_up)


class AttitudeLoop:
    """Attitude error to rates, proportional; rates to torque with proportional, integral and derivative parts.

    Args:
        airframe: its inertia turns angular accelerations into torques.
        attitude_gain_1ps: rate per angle of roll and pitch; yaw has a quarter of it.
        step_s: period of the loop.
    """

    def __init__(self, airframe: Airframe, attitude_gain_1ps: float, step_s: float) -> None:
        self._inertia = airframe.inertia_kgm2
        self._gain = attitude_gain_1ps
        self._step_s = step_s
        self._smooth = 1.0 - math.exp(-step_s / DERIVATIVE_LAG_S)
        self.reset((0.0, 0.0, 0.0))

    def reset(self, rates_rps: Vec3) -> None:
        """Forget the past; the body turns at these rates."""
        self._last = rates_rps
        self._slope: Vec3 = (0.0, 0.0, 0.0)
        self._integral: Vec3 = (0.0, 0.0, 0.0)

    def torque(self, motion: Motion, attitude: Quaternion, *, integrate: bool) -> Vec3:
        """Torque [N m] that turns the body towards an attitude; `integrate` is false at the rotors' limits."""
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
        return self._rate_loop(motion.rates_rps, (p, q, r), integrate)

    def _rate_loop(self, rates: Vec3, wanted: Vec3, integrate: bool) -> Vec3:
        (lp, lq, lr), (sp, sq, sr), (ip, iq, ir) = self._last, self._slope, self._integral
        p, q, r = rates
        smooth = self._smooth
        per_step = 1.0 / self._step_s
        sp += smooth * ((p - lp) * per_step - sp)
        sq += smooth * ((q - lq) * per_step - sq)
        sr += smooth * ((r - lr) * per_step - sr)
        ep, eq, er = wanted[0] - p, wanted[1] - q, wanted[2] - r
        if integrate:
            tilting, turning = RATE_INTEGRAL_1PS2 * self._step_s, YAW_INTEGRAL_1PS2 * self._step_s
            ip, iq, ir = ip + tilting * ep, iq + tilting * eq, ir + turning * er
        self._last, self._slope, self._integral = rates, (sp, sq, sr), (ip, iq, ir)
        jx, jy, jz = self._inertia
        return (
            jx * (RATE_GAIN_1PS * ep + ip - RATE_DERIVATIVE * sp),
            jy * (RATE_GAIN_1PS * eq + iq - RATE_DERIVATIVE * sq),
            jz * (YAW_RATE_GAIN_1PS * er + ir),
        )
