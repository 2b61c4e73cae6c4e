"""Simulated quadrotor at 400 Hz: rigid body, rotors, battery, air and floor, and the loops that fly it."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from sim.vehicle.linear import MAX_ACCEL_MPS2, LinearModel
from sim.vehicle.loops import AttitudeLoop, Cascade
from sim.vehicle.rigid_body import (
    CRAZYFLIE_2,
    GRAVITY_MPS2,
    LEVEL,
    Airframe,
    BatteryModel,
    Body,
    BodyState,
    Quaternion,
    Rotors,
    acceleration,
    step,
    turned,
    uprighted,
)
from sim.wind import Wind
from uavctl.records import Vec3

STEP_NS = 2_500_000
STEP_S = STEP_NS * 1e-9
# A vehicle that touches the floor leaning is put upright by its legs: its tilt shrinks with this time constant.
RIGHTING_S = 0.05
LANDED_NS = 500_000_000  # on the floor without a break for so long is landed
ZERO: Vec3 = (0.0, 0.0, 0.0)


class Quadrotor:
    """Quadrotor in the air or on the floor z = 0; takes the place of `LinearVehicle`.

    The physics moves on the grid start_ns + k 2.5 ms; what is asked takes effect at the next point of it, and
    positions between two points are read from the last one and its velocity and acceleration. So stops on the
    way change no bit.

    Args:
        model: the controller's plant as the simulator sees it; says what `state` and `input` hold.
        wind: the air, stepped with the physics.
    """

    def __init__(
        self,
        model: LinearModel,
        autopilot: Literal["px4", "ardupilot"],
        wind: Wind,
        start_ns: int,
        *,
        position_m: Vec3 = ZERO,
        velocity_mps: Vec3 = ZERO,
        airframe: Airframe = CRAZYFLIE_2,
        charge: float = 1.0,
    ) -> None:
        self.model = model
        self.battery = BatteryModel(airframe, charge=charge)
        self.cascade = Cascade(autopilot, STEP_S)
        self.now_ns = start_ns
        self._airframe = airframe
        self._body = Body.of(airframe)
        self._rotors = Rotors(airframe, STEP_S)
        self._loop = AttitudeLoop(airframe, self.cascade.tuning.attitude_gain_1ps, STEP_S)
        self.wind = wind
        self._motion = BodyState(position_m, velocity_mps, LEVEL, ZERO)
        self._grid_ns = start_ns
        self._touched_ns: int | None = None
        self._grounded = False
        self._accel: Vec3 = ZERO
        self._errors: tuple[Vec3, Vec3] | None = None
        self._fall_mps2 = 0.0  # downward acceleration in the last step
        self._turn: Vec3 | None = None  # of the attitude that the loops believe
        hover = airframe.hover_rps
        self._rotors.speeds_rps = self._rotors.commands_rps = (hover, hover, hover, hover)
        self.cascade.begin(self._motion)

    # What it is doing

    @property
    def has_down(self) -> bool:
        """Whether it can climb and descend: always, whatever the controller's plant has."""
        return True

    @property
    def position_m(self) -> Vec3:
        """Position in NED [m]."""
        t = (self.now_ns - self._grid_ns) * 1e-9
        p, v = self._motion.position_m, self._motion.velocity_mps
        if t == 0.0:
            return p
        a = self.acceleration_mps2
        north, east = p[0] + t * (v[0] + 0.5 * t * a[0]), p[1] + t * (v[1] + 0.5 * t * a[1])
        return north, east, min(p[2] + t * (v[2] + 0.5 * t * a[2]), 0.0)

    @property
    def velocity_mps(self) -> Vec3:
        """Velocity in NED [m/s]."""
        t = (self.now_ns - self._grid_ns) * 1e-9
        v = self._motion.velocity_mps
        if t == 0.0:
            return v
        a = self.acceleration_mps2
        return v[0] + t * a[0], v[1] + t * a[1], v[2] + t * a[2]

    @property
    def attitude(self) -> Quaternion:
        """Attitude (w, x, y, z): turns body axes FRD into NED."""
        return self._motion.attitude

    @property
    def rates_rps(self) -> Vec3:
        """Body rates about front, right, down [rad/s]."""
        return self._motion.rates_rps

    @property
    def rotor_speeds_rps(self) -> tuple[float, float, float, float]:
        """Speeds of the rotors, see `Rotors` for their order."""
        return self._rotors.speeds_rps

    @property
    def wind_mps(self) -> Vec3:
        """Velocity of the air in NED [m/s]."""
        return self.wind.velocity_mps

    @property
    def measured_ns(self) -> int:
        """Time of attitude, rates and acceleration: the last point of the grid."""
        return self._grid_ns

    @property
    def acceleration_mps2(self) -> Vec3:
        """Acceleration in NED at the last point of the grid [m/s²]; zero on the floor."""
        if self._touched_ns is not None or self._grounded:
            return ZERO
        wrench = self._rotors.wrench(self._rotors.speeds_rps)
        motion = self._motion
        return acceleration(self._body, motion.attitude, motion.velocity_mps, wrench, self.wind.velocity_mps)

    @property
    def landed(self) -> bool:
        """Whether it has stood on the floor for a while."""
        return self._grounded or (self._touched_ns is not None and self.now_ns - self._touched_ns >= LANDED_NS)

    @property
    def state(self) -> NDArray[np.float64]:
        """State x (n_x,) of the controller's plant: positions, velocities, and what thrust and gravity accelerate."""
        x = np.zeros(self.model.a.shape[0])
        place, speed, pull = self.position_m, self.velocity_mps, self._pull()
        for axis, p, v in zip(self.model.axes, self.model.position_index, self.model.velocity_index, strict=True):
            x[p], x[v] = place[axis], speed[axis]
            if x.size == 3 * len(self.model.axes):  # drag and lag: an acceleration follows each velocity
                x[v + 1] = pull[axis]
        return x

    @property
    def input(self) -> NDArray[np.float64]:
        """Input u (n_u,) of the controller's plant: the acceleration setpoint, in the plant's units; else zero."""
        return np.array([self._accel[axis] for axis in self.model.axes]) / self.model.accel_per_input

    def _pull(self) -> Vec3:
        """Return the acceleration by thrust and gravity alone [m/s²]: what the input does in the plant."""
        if self._touched_ns is not None or self._grounded:
            return ZERO
        w, x, y, z = self._motion.attitude
        each = self._rotors.wrench(self._rotors.speeds_rps).thrust_n / self._airframe.mass_kg
        return (
            -2.0 * (x * z + w * y) * each,
            -2.0 * (y * z - w * x) * each,
            GRAVITY_MPS2 - (1.0 - 2.0 * (x * x + y * y)) * each,
        )

    # What it is asked

    def accelerate(self, accel_mps2: Vec3) -> None:
        """Hold this acceleration setpoint (NED) [m/s²] from now on."""
        north, east, down = (min(max(a, -MAX_ACCEL_MPS2), MAX_ACCEL_MPS2) for a in accel_mps2)
        self._accel = (north, east, down)
        self.cascade.accelerate(self._accel)

    def brake(self) -> None:
        """Stop, and stay where that ends."""
        self.fly(ZERO)

    def fly(self, velocity_mps: Vec3) -> None:
        """Fly this velocity (NED) [m/s]."""
        self._accel = ZERO
        self.cascade.fly(velocity_mps)

    def go_to(self, position_m: Vec3) -> None:
        """Fly to this position (NED) [m] and stay."""
        self._accel = ZERO
        self.cascade.go_to(position_m)

    def follow(self, position_m: Vec3, velocity_mps: Vec3, accel_mps2: Vec3) -> None:
        """Hold a position (NED) [m] that moves with this velocity and acceleration."""
        self._accel = ZERO
        self.cascade.follow(position_m, velocity_mps, accel_mps2)

    def take_off(self, height_m: float) -> None:
        """Climb to this height above the floor [m], over the present place."""
        self._accel = ZERO
        self.cascade.take_off(height_m)

    def land(self) -> None:
        """Sink at the landing speed until told otherwise; `landed` says when the floor is reached."""
        self._accel = ZERO
        self.cascade.land()

    def face(self, yaw_rad: float) -> None:
        """Turn the nose to this heading, clockwise from north [rad]."""
        self.cascade.yaw_rad = yaw_rad

    def mislead(self, position_error_m: Vec3, velocity_error_mps: Vec3) -> None:
        """Add an error to position and velocity as its own loops see them, from now on."""
        right = position_error_m == velocity_error_mps == ZERO
        self._errors = None if right else (position_error_m, velocity_error_mps)

    def mislead_attitude(self, error_rad: Vec3) -> None:
        """Turn the attitude that its own loops see by so much about body axes [rad], from now on."""
        self._turn = None if error_rad == ZERO else error_rad

    def rest(self) -> None:
        """Stand on the floor, rotors off, until `grounded` is cleared."""
        north, east, _ = self.position_m
        self._motion = BodyState((north, east, 0.0), ZERO, uprighted(self._motion.attitude, 0.0), ZERO)
        self._accel = ZERO
        self._rotors.stop()
        self._grounded = True

    @property
    def grounded(self) -> bool:
        """Whether it stands on the floor with its rotors off; cleared, they idle, and the loops begin anew."""
        return self._grounded

    @grounded.setter
    def grounded(self, grounded: bool) -> None:
        if grounded:
            self.rest()
        elif self._grounded:
            self._grounded = False
            self._touched_ns = self.now_ns
            self.cascade.begin(self._motion)
            self._loop.reset(ZERO)

    # Its motion

    def advance(self, to_ns: int) -> None:
        """Move on to `to_ns`, through every point of the grid up to and including it."""
        if to_ns < self.now_ns:
            raise ValueError(f"time cannot go back from {self.now_ns} to {to_ns} ns")
        while self._grid_ns + STEP_NS <= to_ns:
            self._grid_ns += STEP_NS
            self.wind.step()
            if self._grounded:
                self._rotors.step()
                self.battery.drain(0.0, STEP_S)
            else:
                self._step()
        self.now_ns = to_ns

    def _step(self) -> None:
        motion = self._motion
        believed = motion if self._errors is None else _mistaken(motion, *self._errors)
        if self._turn is not None:
            believed = believed._replace(attitude=turned(motion.attitude, self._turn))
        self._control(believed)
        wrenches = self._rotors.step()
        self._motion = step(self._body, motion, wrenches, self.wind.velocity_mps, STEP_S)
        self.battery.drain(wrenches[0].thrust_n, STEP_S)
        self._fall_mps2 = (self._motion.velocity_mps[2] - motion.velocity_mps[2]) / STEP_S
        self._meet_the_floor(motion)

    def _control(self, motion: BodyState) -> None:
        """Command the rotors; on the floor they idle until a setpoint leads off it."""
        self.cascade.listen()
        idles = self._touched_ns is not None and not self.cascade.climbs
        if idles or self.battery.empty:
            self.cascade.stand(motion)
            self._fall_mps2 = 0.0
            self._loop.reset(motion.rates_rps)
            self._rotors.command(0.0, ZERO, self.battery.largest_rps)
            if self.battery.empty:
                self._rotors.stop()
            return
        wanted = self.cascade.step(motion, thrust_limited=self._rotors.thrust_limited, fall_mps2=self._fall_mps2)
        w, x, y, z = motion.attitude
        fn, fe, fd = wanted.force_mps2
        along = fn * (x * z + w * y) * 2.0 + fe * (y * z - w * x) * 2.0 + fd * (1.0 - 2.0 * (x * x + y * y))
        thrust = self._airframe.mass_kg * max(-along, 0.0)
        torque = self._loop.torque(motion, wanted.attitude, integrate=not self._rotors.torque_limited)
        self._rotors.command(thrust, torque, self.battery.largest_rps)

    def _meet_the_floor(self, before: BodyState) -> None:
        """Stop at the floor: impact without bounce, Coulomb friction from its impulse, legs that right the body."""
        (north, east, down), (vn, ve, vd), attitude, _ = self._motion
        if down < 0.0:
            self._touched_ns = None
            return
        into = max(vd, 0.0)
        slip = math.sqrt(vn * vn + ve * ve)
        keep = max(1.0 - self._airframe.friction * into / slip, 0.0) if slip > 0.0 else 0.0
        if self._touched_ns is None:
            self._touched_ns = self._grid_ns
        elif keep == 0.0:  # sticks where it stood
            north, east, _ = before.position_m
        upright = uprighted(attitude, math.exp(-STEP_S / RIGHTING_S))
        self._motion = BodyState((north, east, 0.0), (keep * vn, keep * ve, min(vd, 0.0)), upright, ZERO)


def _mistaken(motion: BodyState, position_error_m: Vec3, velocity_error_mps: Vec3) -> BodyState:
    (pn, pe, pd), (vn, ve, vd), attitude, rates = motion
    (en, ee, ed), (fn, fe, fd) = position_error_m, velocity_error_mps
    return BodyState((pn + en, pe + ee, pd + ed), (vn + fn, ve + fe, vd + fd), attitude, rates)
