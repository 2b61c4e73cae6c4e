"""Simulated quadrotor at 400 Hz: rigid body, rotors, battery, air and floor, and the loops that fly it."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np

from sim.vehicle.airframe import CRAZYFLIE_2, GRAVITY_MPS2, Airframe
from sim.vehicle.attitude_loop import AttitudeLoop
from sim.vehicle.battery import BatteryModel
from sim.vehicle.linear import MAX_ACCEL_MPS2, LinearModel
from sim.vehicle.loops import Cascade
from sim.vehicle.rigid_body import (
    LEVEL,
    Body,
    BodyState,
    Quaternion,
    compute_acceleration,
    integrate_step,
    reduce_tilt,
    rotate_attitude,
)
from sim.vehicle.rotors import Rotors
from sim.wind import Wind
from uavctl.arrays import Array
from uavctl.records import Vec3

STEP_NS = 2_500_000
STEP_S = STEP_NS * 1e-9
# A vehicle that touches the floor leaning is put upright by its legs: its tilt shrinks with this time constant.
RIGHTING_S = 0.05
LANDED_NS = 500_000_000  # contact without a break for this time counts as landed
ZERO: Vec3 = (0.0, 0.0, 0.0)


class Quadrotor:
    """Quadrotor in the air or on the floor z = 0; takes the place of `LinearVehicle`.

    The physics moves on the grid start_ns + k 2.5 ms; a request takes effect at the next grid point.
    Positions between two points follow from the last point, its velocity and its acceleration. So further stops
    change no bit.

    Args:
        model: the simulator's model of the controller's plant; defines `state` and `input`.
        wind: the air, stepped with the physics.

    Attributes:
        is_wrecked: whether a collision broke its rotors.
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
        self._body = Body.from_airframe(airframe)
        self._rotors = Rotors(airframe, STEP_S)
        self._attitude_loop = AttitudeLoop(airframe, self.cascade.tuning.attitude_gain_1ps, STEP_S)
        self.wind = wind
        self._motion = BodyState(position_m, velocity_mps, LEVEL, ZERO)
        self._grid_ns = start_ns
        self._touched_ns: int | None = None
        self._grounded = False
        self.is_wrecked = False
        self._downwash_mps2 = 0.0
        self._accel: Vec3 = ZERO
        self._estimate_errors: tuple[Vec3, Vec3] | None = None
        self._down_accel_mps2 = 0.0  # downward acceleration in the last step
        self._attitude_error_rad: Vec3 | None = None  # of the loops' attitude, about body axes
        hover_rps = airframe.hover_rps
        self._rotors.commands_rps = (hover_rps, hover_rps, hover_rps, hover_rps)
        self._rotors.set_speeds(self._rotors.commands_rps)
        self.cascade.reset(self._motion)

    @property
    def has_down(self) -> bool:
        """Whether it can climb and descend: always, also with a plant without this axis."""
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
        motion, wrench = self._motion, self._rotors.wrench
        return compute_acceleration(
            self._body, motion.attitude, motion.velocity_mps, wrench, self.wind.velocity_mps, self._down_mps2
        )

    @property
    def _down_mps2(self) -> float:
        return GRAVITY_MPS2 + self._downwash_mps2

    @property
    def has_downwash(self) -> bool:
        """Whether its rotors carry it in the air."""
        return not (self._grounded or self.is_wrecked or self.battery.is_empty) and self._touched_ns is None

    @property
    def landed(self) -> bool:
        """Whether it has stood on the floor for a while."""
        return self._grounded or (self._touched_ns is not None and self.now_ns - self._touched_ns >= LANDED_NS)

    @property
    def state(self) -> Array:
        """State x (n_x,) of the controller's plant: positions, velocities, acceleration by thrust and gravity."""
        x = np.zeros(self.model.a.shape[0])
        position, velocity, thrust_accel = self.position_m, self.velocity_mps, self._compute_thrust_accel()
        for axis, p, v in zip(self.model.axes, self.model.position_index, self.model.velocity_index, strict=True):
            x[p], x[v] = position[axis], velocity[axis]
            if x.size == 3 * len(self.model.axes):  # drag and lag: an acceleration follows each velocity
                x[v + 1] = thrust_accel[axis]
        return x

    @property
    def input(self) -> Array:
        """Input u (n_u,) of the controller's plant: the acceleration setpoint, in the plant's units; else zero."""
        return np.array([self._accel[axis] for axis in self.model.axes]) / self.model.accel_per_input

    def _compute_thrust_accel(self) -> Vec3:
        """Return the acceleration by thrust and gravity alone [m/s²]: the effect of the input in the plant."""
        if self._touched_ns is not None or self._grounded:
            return ZERO
        w, x, y, z = self._motion.attitude
        thrust_mps2 = self._rotors.wrench.thrust_n / self._airframe.mass_kg
        return (
            -2.0 * (x * z + w * y) * thrust_mps2,
            -2.0 * (y * z - w * x) * thrust_mps2,
            GRAVITY_MPS2 - (1.0 - 2.0 * (x * x + y * y)) * thrust_mps2,
        )

    def accelerate(self, accel_mps2: Vec3) -> None:
        """Hold this acceleration setpoint (NED) [m/s²] from now on."""
        north, east, down = (min(max(a, -MAX_ACCEL_MPS2), MAX_ACCEL_MPS2) for a in accel_mps2)
        self._accel = (north, east, down)
        self.cascade.accelerate(self._accel)

    def brake(self) -> None:
        """Stop and hold position."""
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
        """Sink at the landing speed until the next order; `landed` turns true on the floor."""
        self._accel = ZERO
        self.cascade.land()

    def set_heading(self, yaw_rad: float) -> None:
        """Turn the nose to this heading, clockwise from north [rad]."""
        self.cascade.yaw_rad = yaw_rad

    def set_estimate_error(self, position_error_m: Vec3, velocity_error_mps: Vec3) -> None:
        """Set the error of position and velocity in its loops."""
        is_zero = position_error_m == velocity_error_mps == ZERO
        self._estimate_errors = None if is_zero else (position_error_m, velocity_error_mps)

    def set_attitude_error(self, error_rad: Vec3) -> None:
        """Set the attitude error of its loops about body axes [rad]."""
        self._attitude_error_rad = None if error_rad == ZERO else error_rad

    def set_downwash(self, accel_mps2: float) -> None:
        """Set the downward acceleration by the downwash of others [m/s²]."""
        self._downwash_mps2 = accel_mps2

    def wreck(self) -> None:
        """Break its rotors: it falls, and flies no more."""
        self.is_wrecked = True

    def stand_on_floor(self) -> None:
        """Stand on the floor, rotors off, until `grounded` is cleared."""
        north, east, _ = self.position_m
        self._motion = BodyState((north, east, 0.0), ZERO, reduce_tilt(self._motion.attitude, 0.0), ZERO)
        self._accel = ZERO
        self._rotors.stop()
        self._grounded = True

    @property
    def grounded(self) -> bool:
        """Whether it stands on the floor with its rotors off; cleared, they idle, and the loops restart."""
        return self._grounded

    @grounded.setter
    def grounded(self, grounded: bool) -> None:
        if grounded:
            self.stand_on_floor()
        elif self._grounded:
            self._grounded = False
            self._touched_ns = self.now_ns
            self.cascade.reset(self._motion)
            self._attitude_loop.reset(ZERO)

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
        estimate = motion if self._estimate_errors is None else _add_errors(motion, *self._estimate_errors)
        if self._attitude_error_rad is not None:
            estimate = estimate._replace(attitude=rotate_attitude(motion.attitude, self._attitude_error_rad))
        self._control(estimate)
        wrenches = self._rotors.step()
        self._motion = integrate_step(self._body, motion, wrenches, self.wind.velocity_mps, STEP_S, self._down_mps2)
        self.battery.drain(wrenches[0].thrust_n, STEP_S)
        self._down_accel_mps2 = (self._motion.velocity_mps[2] - motion.velocity_mps[2]) / STEP_S
        self._handle_floor_contact(motion)

    def _control(self, motion: BodyState) -> None:
        """Command the rotors; on the floor they idle until a setpoint leads off it."""
        self.cascade.apply_due_setpoint()
        is_idle = self._touched_ns is not None and not self.cascade.is_leaving_floor
        if is_idle or self.is_wrecked or self.battery.is_empty:
            self.cascade.step_on_floor(motion)
            self._down_accel_mps2 = 0.0
            self._attitude_loop.reset(motion.rates_rps)
            self._rotors.command(0.0, ZERO, self.battery.max_rps)
            if self.is_wrecked or self.battery.is_empty:
                self._rotors.stop()
            return
        setpoint = self.cascade.step(
            motion, thrust_limited=self._rotors.is_thrust_limited, down_accel_mps2=self._down_accel_mps2
        )
        w, x, y, z = motion.attitude
        fn, fe, fd = setpoint.force_mps2
        force = fn * (x * z + w * y) * 2.0 + fe * (y * z - w * x) * 2.0 + fd * (1.0 - 2.0 * (x * x + y * y))
        thrust = self._airframe.mass_kg * max(-force, 0.0)
        torque = self._attitude_loop.compute_torque(
            motion, setpoint.attitude, integrate=not self._rotors.is_torque_limited
        )
        self._rotors.command(thrust, torque, self.battery.max_rps)

    def _handle_floor_contact(self, before: BodyState) -> None:
        """Stop at the floor: impact without bounce, Coulomb friction from its impulse, legs that right the body."""
        (north, east, down), (vn, ve, vd), attitude, _ = self._motion
        if down < 0.0:
            self._touched_ns = None
            return
        impact_mps = max(vd, 0.0)
        slip_mps = math.sqrt(vn * vn + ve * ve)
        friction_factor = max(1.0 - self._airframe.friction * impact_mps / slip_mps, 0.0) if slip_mps > 0.0 else 0.0
        if self._touched_ns is None:
            self._touched_ns = self._grid_ns
        elif friction_factor == 0.0:  # sticks where it stood
            north, east, _ = before.position_m
        attitude_after = reduce_tilt(attitude, math.exp(-STEP_S / RIGHTING_S))
        self._motion = BodyState(
            (north, east, 0.0), (friction_factor * vn, friction_factor * ve, min(vd, 0.0)), attitude_after, ZERO
        )


def _add_errors(motion: BodyState, position_error_m: Vec3, velocity_error_mps: Vec3) -> BodyState:
    (pn, pe, pd), (vn, ve, vd), attitude, rates = motion
    (en, ee, ed), (fn, fe, fd) = position_error_m, velocity_error_mps
    return BodyState((pn + en, pe + ee, pd + ed), (vn + fn, ve + fe, vd + fd), attitude, rates)
