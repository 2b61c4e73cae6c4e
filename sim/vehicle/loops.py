"""Outer loops of the cascade: setpoint, reference, and the acceleration that holds the vehicle on the reference.

1. The reference (position, velocity, acceleration) moves within limits towards the setpoint.
2. A proportional position loop and a proportional-integral velocity loop hold the vehicle on the reference.

The autopilots differ in their answer to an acceleration setpoint. ArduPilot moves the reference with it, so zero keeps
the velocity and rejects wind. PX4 flies it open loop, so wind, drag and the error of its hover thrust show.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from enum import Enum, auto
from typing import Literal, NamedTuple

from sim.vehicle.airframe import GRAVITY_MPS2
from sim.vehicle.attitude_loop import AttitudeSetpoint, compute_attitude_setpoint
from sim.vehicle.motion_laws import BRAKE_MPS2, CLIMB_MPS, CRUISE_MPS, LAND_MPS
from sim.vehicle.rigid_body import BodyState
from uavctl.records import Vec3

ZERO: Vec3 = (0.0, 0.0, 0.0)
# Reference: within these limits a velocity is reached with a gain such that the jerk limit is met by itself.
REFERENCE_ACCEL_MPS2 = BRAKE_MPS2  # WPNAV_ACCEL of the recorded ArduCopter: what it brakes with
REFERENCE_GAIN_1PS = 2.0
REFERENCE_POSITION_1PS = 0.5  # a quarter of the former: no overshoot
CRAWL_HEIGHT_M = 1.0  # PX4's MPC_LAND_ALT3
EXTRAPOLATION_S = 3.0  # ArduPilot moves a position on with its velocity for this time (GUID_TIMEOUT), then it holds it


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
    """Kind of the demanded motion."""

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
    """Outer loops from a setpoint to an attitude setpoint, once per step.

    Attributes:
        yaw_rad: heading to hold.
    """

    def __init__(self, autopilot: Literal["px4", "ardupilot"], step_s: float) -> None:
        self.tuning = TUNINGS[autopilot]
        self.yaw_rad = 0.0
        self._step_s = step_s
        self._dead_steps = round(self.tuning.dead_time_s / step_s)
        self._max_horizontal_mps2 = GRAVITY_MPS2 * math.tan(self.tuning.tilt_limit_rad)
        self._max_change_mps2 = self.tuning.jerk_mps3 * step_s
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
        """Restart from this motion, with zero acceleration."""
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
        """Take a step in the air; return the attitude setpoint.

        Args:
            motion: motion of the vehicle, as its loops estimate it.
            thrust_limited: whether the rotors could not give the thrust of the last step.
            down_accel_mps2: downward acceleration in the last step, as measured.
        """
        if self._demand is LoopDemand.ACCELERATION:
            self._follow_acceleration()
            if self.tuning.is_open_loop:
                self._set_reference(motion)
                north, east, down = self._accel
                accel = north, east, down - self.tuning.hover_error * GRAVITY_MPS2
                return compute_attitude_setpoint(accel, self.yaw_rad, self.tuning.tilt_limit_rad)
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

    def _set_reference(self, motion: BodyState) -> None:
        self._position, self._velocity = motion.position_m, motion.velocity_mps

    def _follow_acceleration(self) -> None:
        """Change the reference acceleration within the jerk limit, and within what the tilt limit can give."""
        north, east, down = self._setpoint
        max_horizontal, max_change = self._max_horizontal_mps2, self._max_change_mps2
        horizontal = math.sqrt(north * north + east * east)
        if horizontal > max_horizontal:
            north, east = north * max_horizontal / horizontal, east * max_horizontal / horizontal
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

    def _track_reference(self, motion: BodyState, thrust_limited: bool, down_accel_mps2: float) -> AttitudeSetpoint:
        """Hold the vehicle on the reference; stop the reference where the vehicle cannot follow."""
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
        accel = an + t.velocity_1ps * en + jn, ae + t.velocity_1ps * ee + je, down
        result = compute_attitude_setpoint(accel, self.yaw_rad, t.tilt_limit_rad)
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
