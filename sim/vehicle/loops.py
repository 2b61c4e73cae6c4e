"""Outer loops of the cascade: setpoint, reference that follows it, and the acceleration that holds the vehicle on it.

A reference (position, velocity, acceleration) moves within limits towards what is asked; a proportional position loop
and a proportional-integral velocity loop hold the vehicle on it. What distinguishes the autopilots is what an
acceleration setpoint does: ArduPilot moves the reference with it, so zero keeps the velocity and rejects wind; PX4
flies it open loop, so wind, drag and the error of its hover thrust show.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from enum import Enum, auto
from typing import Literal, NamedTuple

from sim.vehicle.rigid_body import GRAVITY_MPS2, Airframe, BodyState, Quaternion
from uavctl.records import Vec3

# Inner loops of the cascade: from a wanted acceleration to thrust and attitude, to body rates, to torque.


# Gains of the rate loop for a Crazyflie. With the derivative gain D the motors' lag of 65 ms acts like 65/(1 + D) ms.
RATE_GAIN_1PS = 110.0
RATE_DERIVATIVE = 3.0
RATE_INTEGRAL_1PS2 = 200.0
YAW_RATE_GAIN_1PS = 6.0
YAW_INTEGRAL_1PS2 = 6.0
DERIVATIVE_LAG_S = 0.004
MAX_RATE_RPS = math.radians(220.0)
MAX_YAW_RATE_RPS = math.radians(90.0)
MIN_UP_MPS2 = 1.0  # thrust asked for is never less than this much upward: the lean stays defined


@dataclass(frozen=True)
class AttitudeSetpoint:
    """Thrust per mass, and the attitude that points it."""

    force_mps2: Vec3  # specific force wanted of the rotors, NED
    attitude: Quaternion  # that points the rotors along it with the wanted heading
    is_tilt_limited: bool  # whether the largest tilt kept the horizontal part below the wanted one
    is_dive_limited: bool  # whether a dive was wanted in which no thrust would be left to lean


def compute_attitude_setpoint(accel_mps2: Vec3, yaw_rad: float, tilt_limit_rad: float) -> AttitudeSetpoint:
    """Return the lean that gives an acceleration in still air; where the tilt is limited, height has priority."""
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

    def _compute_rate_torque(self, rates: Vec3, wanted: Vec3, integrate: bool) -> Vec3:
        (lp, lq, lr), (sp, sq, sr), (ip, iq, ir) = self._last_rates_rps, self._rate_derivative, self._integral
        p, q, r = rates
        filter_gain = self._filter_gain
        per_step = 1.0 / self._step_s
        sp += filter_gain * ((p - lp) * per_step - sp)
        sq += filter_gain * ((q - lq) * per_step - sq)
        sr += filter_gain * ((r - lr) * per_step - sr)
        ep, eq, er = wanted[0] - p, wanted[1] - q, wanted[2] - r
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


# Simple laws by which the simulated vehicle moves itself, on its true state; gains in 1/s.


BRAKE_MPS2 = 2.5  # as recorded of ArduCopter after its setpoint timeout
BRAKE_GAIN = 2.0
LAND_MPS = 0.5  # LAND_SPEED of the recorded ArduCopter
CLIMB_MPS = 1.0
CLIMB_GAIN = 0.8
CRUISE_MPS = 5.0


def compute_brake_accel(velocity_mps: Vec3, limit_mps2: float) -> Vec3:
    """Return the acceleration against the velocity [m/s²]: proportional to it, its norm at most the limit."""
    speed = math.hypot(*velocity_mps)
    gain = min(BRAKE_GAIN, limit_mps2 / speed) if speed > 0.0 else 0.0
    north, east, down = velocity_mps
    return -gain * north, -gain * east, -gain * down


def compute_descent_accel(down_mps: float) -> float:
    """Return the downward acceleration that settles at the landing speed [m/s²]."""
    return BRAKE_GAIN * (LAND_MPS - down_mps)


def compute_climb_accel(down_m: float, down_mps: float, to_m: float) -> float:
    """Return the downward acceleration towards the height `to_m` (NED down) [m/s²], at most at the climbing speed."""
    velocity_mps = min(max(CLIMB_GAIN * (to_m - down_m), -CLIMB_MPS), CLIMB_MPS)
    return BRAKE_GAIN * (velocity_mps - down_mps)


def compute_approach_velocity(position_m: Vec3, target_m: Vec3) -> Vec3:
    """Return the velocity towards a position [m/s]: proportional to the distance, at most cruise and climb speed."""
    north, east, down = (
        CLIMB_GAIN * (target - position) for position, target in zip(position_m, target_m, strict=True)
    )
    horizontal = math.hypot(north, east)
    scale = CRUISE_MPS / horizontal if horizontal > CRUISE_MPS else 1.0
    return scale * north, scale * east, min(max(down, -CLIMB_MPS), CLIMB_MPS)


ZERO: Vec3 = (0.0, 0.0, 0.0)
# Reference: within these limits a velocity is reached with a gain such that the jerk limit is met by itself.
REFERENCE_ACCEL_MPS2 = BRAKE_MPS2  # WPNAV_ACCEL of the recorded ArduCopter: what it brakes with
REFERENCE_GAIN_1PS = 2.0
REFERENCE_POSITION_1PS = 0.5  # a quarter of the former: no overshoot
CRAWL_HEIGHT_M = 1.0  # PX4's MPC_LAND_ALT3
EXTRAPOLATION_S = 3.0  # ArduPilot moves a position on with its velocity for so long (GUID_TIMEOUT), then it stays


@dataclass(frozen=True)
class Tuning:
    """Gains and limits by which an autopilot flies."""

    is_open_loop: bool  # whether an acceleration setpoint is flown as it comes
    dead_time_s: float  # from taking an acceleration setpoint, or one of a position that moves, to acting on it
    tilt_limit_rad: float  # largest lean
    jerk_mps3: float  # limit of the change of an acceleration setpoint; infinite is none
    attitude_gain_1ps: float  # of the attitude loop
    position_1ps: float  # gain of the position loop, horizontal
    position_down_1ps: float  # the same, vertical
    velocity_1ps: float  # gain of the velocity loop, horizontal
    velocity_down_1ps: float  # the same, vertical
    integral_1ps2: float  # integral gain of the velocity loop, horizontal
    integral_down_1ps2: float  # the same, vertical
    hover_error: float  # relative error of the thrust that the autopilot takes for hovering
    # of a loop that holds the vertical acceleration by the thrust; 0 is none, and the thrust that is reckoned for an
    # acceleration is given at once
    thrust_gain: float = 0.0
    thrust_integral_1ps: float = 0.0  # integral gain of that loop
    land_mps: float = LAND_MPS  # with which it sinks to land
    crawl_mps: float = LAND_MPS  # the same near the floor
    climb_mps: float = CLIMB_MPS  # with which it takes off, at most
    # speed of a take-off per metre that is left; more than half a metre a second overshoots
    climb_1ps: float = REFERENCE_POSITION_1PS


# ArduPilot gives throttle for the error of the vertical acceleration alone: PSC_ACCZ_P 0.5 and PSC_ACCZ_I 1, a
# thousandth of it for 1 cm/s2, on a vehicle that hovers at a throttle of 0.39 (MOT_THST_HOVER as recorded).
THROTTLE_MPS2 = GRAVITY_MPS2 / 0.39
# Outer gains are the autopilots' defaults (PSC_POSXY_P, PSC_VELXY_P and so on; MPC_XY_P, MPC_XY_VEL_P_ACC and so on);
# dead time, attitude gain and hover error are fitted to the recorded flights, see docs/vehicle.md.
TUNINGS = {
    "ardupilot": Tuning(
        is_open_loop=False,
        dead_time_s=0.0,
        tilt_limit_rad=math.radians(30.0),
        jerk_mps3=5.0,
        attitude_gain_1ps=7.0,
        position_1ps=1.0,
        position_down_1ps=1.0,
        velocity_1ps=2.0,
        velocity_down_1ps=5.0,
        integral_1ps2=1.0,
        integral_down_1ps2=0.0,
        hover_error=0.0,
        thrust_gain=0.05 * THROTTLE_MPS2,
        thrust_integral_1ps=0.1 * THROTTLE_MPS2,
        climb_mps=1.7,  # as recorded, to 1.2, 2 and 5 m; overshoots by a tenth of a metre
        climb_1ps=1.0,
    ),
    "px4": Tuning(
        is_open_loop=True,
        dead_time_s=0.08,
        tilt_limit_rad=math.radians(45.0),
        jerk_mps3=math.inf,
        attitude_gain_1ps=5.0,
        position_1ps=0.95,
        position_down_1ps=1.0,
        velocity_1ps=1.8,
        velocity_down_1ps=4.0,
        integral_1ps2=0.4,
        integral_down_1ps2=2.0,
        hover_error=0.0153,
        land_mps=0.7,  # MPC_LAND_SPEED and MPC_LAND_CRWL, as recorded
        crawl_mps=0.3,
        climb_mps=1.1,  # as recorded, to 1.2 and 5 m
        climb_1ps=0.53,
    ),
}


class LoopDemand(Enum):
    """Motion that the loops are asked for."""

    ACCELERATION = auto()
    VELOCITY = auto()
    POSITION = auto()
    MOTION = auto()
    CLIMB = auto()
    LANDING = auto()


class _PendingSetpoint(NamedTuple):
    """A setpoint that waits for the dead time to pass; a motion has position, velocity and acceleration."""

    due_step: int  # step in which it acts
    demand: LoopDemand
    setpoint: Vec3
    velocity: Vec3 = ZERO
    accel: Vec3 = ZERO


class Cascade:
    """Outer loops from a setpoint to a lean, once per step.

    Attributes:
        yaw_rad: heading to hold.
    """

    def __init__(self, autopilot: Literal["px4", "ardupilot"], step_s: float) -> None:
        self.tuning = TUNINGS[autopilot]
        self.yaw_rad = 0.0
        self._step_s = step_s
        self._dead_steps = round(self.tuning.dead_time_s / step_s)
        self._steps = 0
        self._pending: deque[_PendingSetpoint] = deque()  # taken, and not acting yet
        self._extrapolated_steps = 0  # for which a position has moved on by itself
        self._demand = LoopDemand.ACCELERATION
        self._setpoint: Vec3 = ZERO
        self._position: Vec3 = ZERO
        self._velocity: Vec3 = ZERO
        self._accel: Vec3 = ZERO
        self._integral: Vec3 = ZERO
        self._thrust_integral_mps2 = 0.0  # integral of the loop on the vertical acceleration

    def reset(self, motion: BodyState) -> None:
        """Start anew from this motion, with zero acceleration."""
        self._pending.clear()
        self._demand, self._setpoint = LoopDemand.ACCELERATION, ZERO
        self._accel = self._integral = ZERO
        self._thrust_integral_mps2 = 0.0
        self._set_reference(motion)

    def accelerate(self, accel_mps2: Vec3) -> None:
        """Fly this acceleration (NED) [m/s²], after the autopilot's dead time."""
        self._queue_setpoint(_PendingSetpoint(self._steps + self._dead_steps, LoopDemand.ACCELERATION, accel_mps2))

    def follow(self, position_m: Vec3, velocity_mps: Vec3, accel_mps2: Vec3) -> None:
        """Hold a position (NED) [m] that moves with this velocity and acceleration, after the dead time.

        PX4 takes each for what it is, until the next comes; ArduPilot moves it on in between.
        """
        due_step = self._steps + self._dead_steps
        self._queue_setpoint(_PendingSetpoint(due_step, LoopDemand.MOTION, position_m, velocity_mps, accel_mps2))

    def _queue_setpoint(self, setpoint: _PendingSetpoint) -> None:
        if self._pending and self._pending[-1].due_step == setpoint.due_step:
            self._pending.pop()
        self._pending.append(setpoint)

    def fly(self, velocity_mps: Vec3) -> None:
        """Fly this velocity (NED) [m/s]; zero stops, and stays where that ends."""
        self._pending.clear()
        self._demand, self._setpoint = LoopDemand.VELOCITY, velocity_mps

    def go_to(self, position_m: Vec3) -> None:
        """Fly to this position (NED) [m] and stay."""
        self._pending.clear()
        self._demand, self._setpoint = LoopDemand.POSITION, position_m

    def take_off(self, height_m: float) -> None:
        """Climb to this height above the origin [m], over the present place."""
        self._pending.clear()
        self._demand, self._setpoint = LoopDemand.CLIMB, (self._position[0], self._position[1], -height_m)

    def land(self) -> None:
        """Sink at the landing speed, over the present place."""
        self._pending.clear()
        self._demand, self._setpoint = LoopDemand.LANDING, (0.0, 0.0, self.tuning.land_mps)

    def apply_due_setpoint(self) -> None:
        """Begin a step: a setpoint whose dead time has passed acts from now on."""
        if self._pending and self._pending[0].due_step <= self._steps:
            _, self._demand, self._setpoint, velocity, accel = self._pending.popleft()
            if self._demand is LoopDemand.MOTION:
                self._position, self._velocity, self._accel = self._setpoint, velocity, accel
                self._extrapolated_steps = 0
        self._steps += 1

    @property
    def is_leaving_floor(self) -> bool:
        """Whether the setpoint leads up from the floor."""
        return self._setpoint[2] < 0.0

    def step_on_floor(self, motion: BodyState) -> None:
        """Take a step on the floor: the reference stays with the vehicle, and the flight before is forgotten."""
        self._accel = self._integral = ZERO
        self._thrust_integral_mps2 = 0.0
        self._set_reference(motion)

    def step(self, motion: BodyState, *, thrust_limited: bool, down_accel_mps2: float = 0.0) -> AttitudeSetpoint:
        """Take a step in the air; return the lean to take now.

        Args:
            motion: motion of the vehicle, as its loops see it.
            thrust_limited: whether the rotors could not give the thrust of the last step.
            fall_mps2: downward acceleration in the last step, as accelerometers feel it.
        """
        if self._demand is LoopDemand.ACCELERATION:
            self._follow_acceleration()
            if self.tuning.is_open_loop:
                self._set_reference(motion)
                north, east, down = self._accel
                return self._compute_attitude((north, east, down - self.tuning.hover_error * GRAVITY_MPS2))
        elif self._demand is LoopDemand.VELOCITY:
            self._follow_velocity(self._setpoint)
        elif self._demand is LoopDemand.LANDING:
            is_near_floor = -motion.position_m[2] < CRAWL_HEIGHT_M
            self._follow_velocity((0.0, 0.0, self.tuning.crawl_mps if is_near_floor else self.tuning.land_mps))
        elif self._demand is LoopDemand.POSITION:
            self._follow_position(REFERENCE_POSITION_1PS, CLIMB_MPS)
        elif self._demand is LoopDemand.CLIMB:
            self._follow_position(self.tuning.climb_1ps, self.tuning.climb_mps)
        else:
            self._extrapolate_position()
            return self._track_reference(motion, thrust_limited, down_accel_mps2)
        self._move_reference()
        return self._track_reference(motion, thrust_limited, down_accel_mps2)

    def _compute_attitude(self, accel: Vec3) -> AttitudeSetpoint:
        return compute_attitude_setpoint(accel, self.yaw_rad, self.tuning.tilt_limit_rad)

    # The reference

    def _set_reference(self, motion: BodyState) -> None:
        self._position, self._velocity = motion.position_m, motion.velocity_mps

    def _follow_acceleration(self) -> None:
        """Change the reference acceleration within the jerk limit, and within what the tilt limit can give."""
        north, east, down = self._setpoint
        max_horizontal = GRAVITY_MPS2 * math.tan(self.tuning.tilt_limit_rad)
        horizontal = math.sqrt(north * north + east * east)
        if horizontal > max_horizontal:
            north, east = north * max_horizontal / horizontal, east * max_horizontal / horizontal
        max_change = self.tuning.jerk_mps3 * self._step_s
        dn, de, dd = north - self._accel[0], east - self._accel[1], down - self._accel[2]
        horizontal = math.sqrt(dn * dn + de * de)
        if horizontal > max_change:
            north, east = self._accel[0] + dn * max_change / horizontal, self._accel[1] + de * max_change / horizontal
        self._accel = (north, east, self._accel[2] + min(max(dd, -max_change), max_change))

    def _follow_velocity(self, velocity_mps: Vec3) -> None:
        vn, ve, vd = self._velocity
        north, east = REFERENCE_GAIN_1PS * (velocity_mps[0] - vn), REFERENCE_GAIN_1PS * (velocity_mps[1] - ve)
        down = REFERENCE_GAIN_1PS * (velocity_mps[2] - vd)
        horizontal = math.sqrt(north * north + east * east)
        if horizontal > REFERENCE_ACCEL_MPS2:
            north, east = north * REFERENCE_ACCEL_MPS2 / horizontal, east * REFERENCE_ACCEL_MPS2 / horizontal
        self._accel = (north, east, min(max(down, -REFERENCE_ACCEL_MPS2), REFERENCE_ACCEL_MPS2))

    def _follow_position(self, down_1ps: float, climb_mps: float) -> None:
        dn, de = self._setpoint[0] - self._position[0], self._setpoint[1] - self._position[1]
        dd = self._setpoint[2] - self._position[2]
        distance_m = math.sqrt(dn * dn + de * de)
        speed = (
            _compute_approach_speed(distance_m, CRUISE_MPS, REFERENCE_POSITION_1PS) / distance_m
            if distance_m > 0.0
            else 0.0
        )
        down = math.copysign(_compute_approach_speed(abs(dd), climb_mps, down_1ps), dd)
        self._follow_velocity((speed * dn, speed * de, down))

    def _extrapolate_position(self) -> None:
        """Move a position setpoint on with its velocity, where the autopilot does so."""
        if self.tuning.is_open_loop:
            return
        if self._extrapolated_steps * self._step_s >= EXTRAPOLATION_S:
            self._velocity = self._accel = ZERO
        self._move_reference()
        self._extrapolated_steps += 1

    def _move_reference(self) -> None:
        h = self._step_s
        (pn, pe, pd), (vn, ve, vd), (an, ae, ad) = self._position, self._velocity, self._accel
        self._position = (pn + h * (vn + 0.5 * h * an), pe + h * (ve + 0.5 * h * ae), pd + h * (vd + 0.5 * h * ad))
        self._velocity = (vn + h * an, ve + h * ae, vd + h * ad)

    # The loops on it

    def _track_reference(self, motion: BodyState, thrust_limited: bool, down_accel_mps2: float) -> AttitudeSetpoint:
        """Hold the vehicle on the reference, which must not run away from a vehicle that cannot follow."""
        t = self.tuning
        (pn, pe, pd), (vn, ve, vd) = motion.position_m, motion.velocity_mps
        en = self._velocity[0] - vn + t.position_1ps * (self._position[0] - pn)
        ee = self._velocity[1] - ve + t.position_1ps * (self._position[1] - pe)
        ed = self._velocity[2] - vd + t.position_down_1ps * (self._position[2] - pd)
        (an, ae, ad), (jn, je, jd) = self._accel, self._integral
        down = ad + t.velocity_down_1ps * ed + jd - t.hover_error * GRAVITY_MPS2
        accel_error = down - down_accel_mps2
        if t.thrust_gain > 0.0:  # a loop on the acceleration gives the thrust for it
            down = t.thrust_gain * accel_error + self._thrust_integral_mps2
        result = self._compute_attitude((an + t.velocity_1ps * en + jn, ae + t.velocity_1ps * ee + je, down))
        if result.is_tilt_limited:
            self._position, self._velocity = (pn, pe, self._position[2]), (vn, ve, self._velocity[2])
        else:
            gain = t.integral_1ps2 * self._step_s
            jn, je = jn + gain * en, je + gain * ee
        if thrust_limited or result.is_dive_limited:
            self._position, self._velocity = (*self._position[:2], pd), (*self._velocity[:2], vd)
        else:
            jd += t.integral_down_1ps2 * self._step_s * ed
            self._thrust_integral_mps2 += t.thrust_integral_1ps * self._step_s * accel_error
        self._integral = (jn, je, jd)
        return result


def _compute_approach_speed(distance_m: float, limit_mps: float, gain_1ps: float) -> float:
    """Return the approach speed [m/s]: proportional when near, else such that a stop takes half of the limit."""
    linear_m = REFERENCE_ACCEL_MPS2 / (2.0 * gain_1ps**2)
    if distance_m <= linear_m:
        return min(gain_1ps * distance_m, limit_mps)
    braking = math.sqrt(REFERENCE_ACCEL_MPS2 * (distance_m - 0.5 * linear_m))
    return min(braking, limit_mps)
