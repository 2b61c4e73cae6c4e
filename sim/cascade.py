"""Outer loops of the cascade: what is asked of the vehicle, the reference that it follows, the acceleration it wants.

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

from sim.airframe import GRAVITY_MPS2
from sim.attitude import Lean, lean
from sim.rigid_body import Motion
from sim.steering import BRAKE_MPS2, CLIMB_MPS, CRUISE_MPS, LAND_MPS
from uavctl.data import Vec3

ZERO: Vec3 = (0.0, 0.0, 0.0)
# Reference: within these limits a velocity is reached with a gain such that the jerk limit is met by itself.
REFERENCE_ACCEL_MPS2 = BRAKE_MPS2  # WPNAV_ACCEL of the recorded ArduCopter: what it brakes with
REFERENCE_GAIN_1PS = 2.0
REFERENCE_POSITION_1PS = 0.5  # a quarter of the former: no overshoot
CRAWL_BELOW_M = 1.0  # PX4's MPC_LAND_ALT3
CARRIED_S = 3.0  # ArduPilot moves a position on with its velocity for so long (GUID_TIMEOUT), then it stays


@dataclass(frozen=True)
class Tuning:
    """How an autopilot flies.

    Attributes:
        open_loop: whether an acceleration setpoint is flown as it comes.
        dead_time_s: from taking an acceleration setpoint, or one of a position that moves, to acting on it.
        tilt_limit_rad: largest lean.
        jerk_mps3: limit of the change of an acceleration setpoint; infinite is none.
        attitude_gain_1ps: of the attitude loop.
        position_1ps: gain of the position loop, horizontal.
        position_down_1ps: the same, vertical.
        velocity_1ps: gain of the velocity loop, horizontal.
        velocity_down_1ps: the same, vertical.
        integral_1ps2: integral gain of the velocity loop, horizontal.
        integral_down_1ps2: the same, vertical.
        hover_error: relative error of the thrust that the autopilot takes for hovering.
        thrust_gain: of a loop that holds the vertical acceleration by the thrust; 0 is none, and the thrust that is
            reckoned for an acceleration is given at once.
        thrust_integral_1ps: integral gain of that loop.
        land_mps: with which it sinks to land.
        crawl_mps: the same near the floor.
        climb_mps: with which it takes off, at most.
        climb_1ps: speed of a take-off per metre that is left; more than half a metre a second overshoots.
    """

    open_loop: bool
    dead_time_s: float
    tilt_limit_rad: float
    jerk_mps3: float
    attitude_gain_1ps: float
    position_1ps: float
    position_down_1ps: float
    velocity_1ps: float
    velocity_down_1ps: float
    integral_1ps2: float
    integral_down_1ps2: float
    hover_error: float
    thrust_gain: float = 0.0
    thrust_integral_1ps: float = 0.0
    land_mps: float = LAND_MPS
    crawl_mps: float = LAND_MPS
    climb_mps: float = CLIMB_MPS
    climb_1ps: float = REFERENCE_POSITION_1PS


# ArduPilot gives throttle for the error of the vertical acceleration alone: PSC_ACCZ_P 0.5 and PSC_ACCZ_I 1, a
# thousandth of it for 1 cm/s2, on a vehicle that hovers at a throttle of 0.39 (MOT_THST_HOVER as recorded).
THROTTLE_MPS2 = GRAVITY_MPS2 / 0.39
# Outer gains are the autopilots' defaults (PSC_POSXY_P, PSC_VELXY_P and so on; MPC_XY_P, MPC_XY_VEL_P_ACC and so on);
# dead time, attitude gain and hover error are fitted to the recorded flights, see docs/vehicle.md.
TUNINGS = {
    "ardupilot": Tuning(
        open_loop=False,
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
        open_loop=True,
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


class Demand(Enum):
    """What is asked of the vehicle."""

    ACCELERATION = auto()
    VELOCITY = auto()
    POSITION = auto()
    MOTION = auto()
    CLIMB = auto()
    LANDING = auto()


class _Asked(NamedTuple):
    """A setpoint that waits out the dead time; a motion has a position, a velocity and an acceleration."""

    due: int  # step in which it acts
    demand: Demand
    wanted: Vec3
    velocity: Vec3 = ZERO
    accel: Vec3 = ZERO


class Cascade:
    """From what is asked to a lean, once per step.

    Attributes:
        yaw_rad: heading to hold.
    """

    def __init__(self, autopilot: Literal["px4", "ardupilot"], step_s: float) -> None:
        self.tuning = TUNINGS[autopilot]
        self.yaw_rad = 0.0
        self._step_s = step_s
        self._dead_steps = round(self.tuning.dead_time_s / step_s)
        self._steps = 0
        self._coming: deque[_Asked] = deque()  # taken, and not acting yet
        self._carried_steps = 0  # for which a position has moved on by itself
        self._demand = Demand.ACCELERATION
        self._wanted: Vec3 = ZERO
        self._position: Vec3 = ZERO
        self._velocity: Vec3 = ZERO
        self._accel: Vec3 = ZERO
        self._integral: Vec3 = ZERO
        self._thrust_mps2 = 0.0  # integral of the loop on the vertical acceleration

    def begin(self, motion: Motion) -> None:
        """Begin anew from this motion, with zero acceleration."""
        self._coming.clear()
        self._demand, self._wanted = Demand.ACCELERATION, ZERO
        self._accel = self._integral = ZERO
        self._thrust_mps2 = 0.0
        self._carry(motion)

    def accelerate(self, accel_mps2: Vec3) -> None:
        """Fly this acceleration (NED), after the autopilot's dead time."""
        self._take(_Asked(self._steps + self._dead_steps, Demand.ACCELERATION, accel_mps2))

    def follow(self, position_m: Vec3, velocity_mps: Vec3, accel_mps2: Vec3) -> None:
        """Be at this position (NED), which moves with this velocity and acceleration, after the dead time.

        PX4 takes each for what it is, until the next comes; ArduPilot moves it on in between.
        """
        due = self._steps + self._dead_steps
        self._take(_Asked(due, Demand.MOTION, position_m, velocity_mps, accel_mps2))

    def _take(self, asked: _Asked) -> None:
        if self._coming and self._coming[-1].due == asked.due:
            self._coming.pop()
        self._coming.append(asked)

    def fly(self, velocity_mps: Vec3) -> None:
        """Fly this velocity (NED); zero stops, and stays where that ends."""
        self._coming.clear()
        self._demand, self._wanted = Demand.VELOCITY, velocity_mps

    def go_to(self, position_m: Vec3) -> None:
        """Fly to this position (NED) and stay."""
        self._coming.clear()
        self._demand, self._wanted = Demand.POSITION, position_m

    def take_off(self, height_m: float) -> None:
        """Climb to this height above the origin, over the present place."""
        self._coming.clear()
        self._demand, self._wanted = Demand.CLIMB, (self._position[0], self._position[1], -height_m)

    def land(self) -> None:
        """Sink at the landing speed, over the present place."""
        self._coming.clear()
        self._demand, self._wanted = Demand.LANDING, (0.0, 0.0, self.tuning.land_mps)

    def listen(self) -> None:
        """Begin a step: what has waited out the dead time is asked from now on."""
        if self._coming and self._coming[0].due <= self._steps:
            _, self._demand, self._wanted, velocity, accel = self._coming.popleft()
            if self._demand is Demand.MOTION:
                self._position, self._velocity, self._accel = self._wanted, velocity, accel
                self._carried_steps = 0
        self._steps += 1

    @property
    def climbs(self) -> bool:
        """Whether what is asked leads up from the floor."""
        return self._wanted[2] < 0.0

    def stand(self, motion: Motion) -> None:
        """A step on the floor: the reference stays with the vehicle, and nothing is left of the flight before."""
        self._accel = self._integral = ZERO
        self._thrust_mps2 = 0.0
        self._carry(motion)

    def step(self, motion: Motion, *, thrust_limited: bool, fall_mps2: float = 0.0) -> Lean:
        """A step in the air: the lean to take now.

        Args:
            motion: of the vehicle, as its loops see it.
            thrust_limited: whether the rotors could not give the thrust of the last step.
            fall_mps2: downward acceleration in the last step, as accelerometers feel it.
        """
        if self._demand is Demand.ACCELERATION:
            self._follow_acceleration()
            if self.tuning.open_loop:
                self._carry(motion)
                north, east, down = self._accel
                return self._lean((north, east, down - self.tuning.hover_error * GRAVITY_MPS2))
        elif self._demand is Demand.VELOCITY:
            self._follow_velocity(self._wanted)
        elif self._demand is Demand.LANDING:
            near = -motion.position_m[2] < CRAWL_BELOW_M
            self._follow_velocity((0.0, 0.0, self.tuning.crawl_mps if near else self.tuning.land_mps))
        elif self._demand is Demand.POSITION:
            self._follow_position(REFERENCE_POSITION_1PS, CLIMB_MPS)
        elif self._demand is Demand.CLIMB:
            self._follow_position(self.tuning.climb_1ps, self.tuning.climb_mps)
        else:
            self._carry_on()
            return self._track(motion, thrust_limited, fall_mps2)
        self._move_reference()
        return self._track(motion, thrust_limited, fall_mps2)

    def _lean(self, accel: Vec3) -> Lean:
        return lean(accel, self.yaw_rad, self.tuning.tilt_limit_rad)

    # The reference

    def _carry(self, motion: Motion) -> None:
        self._position, self._velocity = motion.position_m, motion.velocity_mps

    def _follow_acceleration(self) -> None:
        """Change the reference acceleration within the jerk limit; no more than the tilt limit can give."""
        north, east, down = self._wanted
        most = GRAVITY_MPS2 * math.tan(self.tuning.tilt_limit_rad)
        level = math.sqrt(north * north + east * east)
        if level > most:
            north, east = north * most / level, east * most / level
        change = self.tuning.jerk_mps3 * self._step_s
        dn, de, dd = north - self._accel[0], east - self._accel[1], down - self._accel[2]
        level = math.sqrt(dn * dn + de * de)
        if level > change:
            north, east = self._accel[0] + dn * change / level, self._accel[1] + de * change / level
        self._accel = (north, east, self._accel[2] + min(max(dd, -change), change))

    def _follow_velocity(self, wanted: Vec3) -> None:
        vn, ve, vd = self._velocity
        north, east = REFERENCE_GAIN_1PS * (wanted[0] - vn), REFERENCE_GAIN_1PS * (wanted[1] - ve)
        down = REFERENCE_GAIN_1PS * (wanted[2] - vd)
        level = math.sqrt(north * north + east * east)
        if level > REFERENCE_ACCEL_MPS2:
            north, east = north * REFERENCE_ACCEL_MPS2 / level, east * REFERENCE_ACCEL_MPS2 / level
        self._accel = (north, east, min(max(down, -REFERENCE_ACCEL_MPS2), REFERENCE_ACCEL_MPS2))

    def _follow_position(self, down_1ps: float, climb_mps: float) -> None:
        dn, de = self._wanted[0] - self._position[0], self._wanted[1] - self._position[1]
        dd = self._wanted[2] - self._position[2]
        far = math.sqrt(dn * dn + de * de)
        speed = _approach(far, CRUISE_MPS, REFERENCE_POSITION_1PS) / far if far > 0.0 else 0.0
        down = math.copysign(_approach(abs(dd), climb_mps, down_1ps), dd)
        self._follow_velocity((speed * dn, speed * de, down))

    def _carry_on(self) -> None:
        """Move a position on with its velocity, where the autopilot does so."""
        if self.tuning.open_loop:
            return
        if self._carried_steps * self._step_s >= CARRIED_S:
            self._velocity = self._accel = ZERO
        self._move_reference()
        self._carried_steps += 1

    def _move_reference(self) -> None:
        h = self._step_s
        (pn, pe, pd), (vn, ve, vd), (an, ae, ad) = self._position, self._velocity, self._accel
        self._position = (
            pn + h * (vn + 0.5 * h * an),
            pe + h * (ve + 0.5 * h * ae),
            pd + h * (vd + 0.5 * h * ad),
        )
        self._velocity = (vn + h * an, ve + h * ae, vd + h * ad)

    # The loops on it

    def _track(self, motion: Motion, thrust_limited: bool, fall_mps2: float) -> Lean:
        """Hold the vehicle on the reference, which must not run away from a vehicle that cannot follow."""
        t = self.tuning
        (pn, pe, pd), (vn, ve, vd) = motion.position_m, motion.velocity_mps
        en = self._velocity[0] - vn + t.position_1ps * (self._position[0] - pn)
        ee = self._velocity[1] - ve + t.position_1ps * (self._position[1] - pe)
        ed = self._velocity[2] - vd + t.position_down_1ps * (self._position[2] - pd)
        (an, ae, ad), (jn, je, jd) = self._accel, self._integral
        down = ad + t.velocity_down_1ps * ed + jd - t.hover_error * GRAVITY_MPS2
        lack = down - fall_mps2
        if t.thrust_gain > 0.0:  # a loop on the acceleration gives the thrust for it
            down = t.thrust_gain * lack + self._thrust_mps2
        result = self._lean((an + t.velocity_1ps * en + jn, ae + t.velocity_1ps * ee + je, down))
        if result.limited:
            self._position, self._velocity = (pn, pe, self._position[2]), (vn, ve, self._velocity[2])
        else:
            gain = t.integral_1ps2 * self._step_s
            jn, je = jn + gain * en, je + gain * ee
        if thrust_limited or result.dive_limited:
            self._position, self._velocity = (*self._position[:2], pd), (*self._velocity[:2], vd)
        else:
            jd += t.integral_down_1ps2 * self._step_s * ed
            self._thrust_mps2 += t.thrust_integral_1ps * self._step_s * lack
        self._integral = (jn, je, jd)
        return result


def _approach(distance_m: float, limit_mps: float, gain_1ps: float) -> float:
    """Speed at a distance from which a stop takes half of the limit: proportional when near, a parabola when far."""
    near = REFERENCE_ACCEL_MPS2 / (2.0 * gain_1ps**2)
    if distance_m <= near:
        return min(gain_1ps * distance_m, limit_mps)
    braking = math.sqrt(REFERENCE_ACCEL_MPS2 * (distance_m - 0.5 * near))
    return min(braking, limit_mps)
