"""Interface of a simulated vehicle to its autopilot, and the linear plant that implements it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum, auto
from typing import Protocol

from sim.vehicle.linear import LinearVehicle
from sim.vehicle.motion_laws import (
    BRAKE_MPS2,
    compute_approach_velocity,
    compute_brake_accel,
    compute_climb_accel,
    compute_descent_accel,
)
from uavctl.records import Vec3

Quaternion = tuple[float, float, float, float]  # w, x, y, z: turns body axes into NED

CONTROL_PERIOD_NS = 20_000_000  # period of the linear plant's own braking, climbing and landing
ZERO: Vec3 = (0.0, 0.0, 0.0)
LEVEL: Quaternion = (1.0, 0.0, 0.0, 0.0)


class BatteryState(Protocol):
    """Battery as telemetry reports it."""

    @property
    def voltage_v(self) -> float:
        """Voltage at the terminals [V]."""
        ...

    @property
    def current_a(self) -> float:
        """Current of the load [A]."""
        ...

    @property
    def remaining(self) -> float:
        """Charge left, 0 to 1."""
        ...


class Vehicle(Protocol):
    """A vehicle with the loops that fly it; all vectors are local NED."""

    grounded: bool  # stands on the floor with its rotors off

    @property
    def is_wrecked(self) -> bool:
        """Whether a collision broke its rotors."""
        ...

    @property
    def now_ns(self) -> int:
        """Present time [ns]."""
        ...

    @property
    def has_down(self) -> bool:
        """Whether it can climb and descend."""
        ...

    @property
    def position_m(self) -> Vec3:
        """True position [m]."""
        ...

    @property
    def velocity_mps(self) -> Vec3:
        """True velocity [m/s]."""
        ...

    @property
    def attitude(self) -> Quaternion:
        """True attitude (w, x, y, z): turns body axes FRD into NED."""
        ...

    @property
    def rates_rps(self) -> Vec3:
        """Body rates about front, right, down [rad/s]."""
        ...

    @property
    def acceleration_mps2(self) -> Vec3:
        """True acceleration at `measured_ns` [m/s²]; zero on the floor."""
        ...

    @property
    def measured_ns(self) -> int:
        """Time of attitude, rates and acceleration [ns]: now, or the last step of the vehicle's physics."""
        ...

    @property
    def landed(self) -> bool:
        """Whether it stands on the floor."""
        ...

    @property
    def battery(self) -> BatteryState:
        """Its battery."""
        ...

    def accelerate(self, accel_mps2: Vec3) -> None:
        """Hold this acceleration setpoint from now on [m/s²]."""

    def brake(self) -> None:
        """Stop and hold position."""

    def fly(self, velocity_mps: Vec3) -> None:
        """Fly this velocity [m/s]."""

    def go_to(self, position_m: Vec3) -> None:
        """Fly to this position and stay [m]."""

    def follow(self, position_m: Vec3, velocity_mps: Vec3, accel_mps2: Vec3) -> None:
        """Hold a position [m] that moves with this velocity [m/s] and acceleration [m/s²]."""

    def take_off(self, height_m: float) -> None:
        """Climb to this height above the floor [m], over the present position."""

    def land(self) -> None:
        """Sink at the landing speed."""

    def set_heading(self, yaw_rad: float) -> None:
        """Turn the nose to this heading, clockwise from north [rad]."""

    def stand_on_floor(self) -> None:
        """Stand on the floor, rotors off, until `grounded` is cleared."""

    def set_estimate_error(self, position_error_m: Vec3, velocity_error_mps: Vec3) -> None:
        """Set the error of position and velocity in the vehicle's loops."""

    def set_attitude_error(self, error_rad: Vec3) -> None:
        """Set the attitude error of the vehicle's loops about body axes [rad]."""


@dataclass(frozen=True)
class FullBattery:
    """A battery that never empties."""

    voltage_v: float = 4.2
    current_a: float = 0.0
    remaining: float = 1.0


class _Goal(Enum):
    """Goal that the linear plant flies to by itself."""

    NOTHING = auto()  # an acceleration setpoint acts
    VELOCITY = auto()
    POSITION = auto()
    CLIMB = auto()
    LAND = auto()


class ControlledPlant:
    """Linear plant with simple laws (`motion_laws.py`) in place of loops; always level, its nose north.

    Its laws are evaluated at `next_ns`, every 20 ms, and when something new is asked.
    """

    attitude: Quaternion = LEVEL
    rates_rps: Vec3 = ZERO
    battery: BatteryState = FullBattery()

    def __init__(self, plant: LinearVehicle) -> None:
        self._plant = plant
        self._goal = _Goal.NOTHING
        self._setpoint: Vec3 = ZERO
        self._feedforward_mps: Vec3 = ZERO  # velocity of a position that moves
        self._errors: tuple[Vec3, Vec3] = (ZERO, ZERO)
        self._control_ns = plant.now_ns

    @property
    def next_ns(self) -> int | None:
        """Time of the next evaluation of its laws [ns]; None under an acceleration setpoint, or on the floor."""
        return None if self._goal is _Goal.NOTHING or self.grounded else self._control_ns

    @property
    def is_wrecked(self) -> bool:
        """Whether a collision broke its rotors."""
        return self._plant.is_wrecked

    @property
    def now_ns(self) -> int:
        """Present time [ns]."""
        return self._plant.now_ns

    @property
    def has_down(self) -> bool:
        """Whether the plant can climb and descend."""
        return self._plant.has_down

    @property
    def position_m(self) -> Vec3:
        """True position [m]."""
        return self._plant.position_m

    @property
    def velocity_mps(self) -> Vec3:
        """True velocity [m/s]."""
        return self._plant.velocity_mps

    @property
    def acceleration_mps2(self) -> Vec3:
        """True acceleration [m/s²]; zero on the floor."""
        return self._plant.acceleration_mps2

    @property
    def measured_ns(self) -> int:
        """Time of the acceleration [ns]: now."""
        return self._plant.now_ns

    @property
    def landed(self) -> bool:
        """Whether it has reached the floor."""
        return self.grounded or (self.has_down and self.position_m[2] >= 0.0)

    @property
    def grounded(self) -> bool:
        """Whether it stands on the floor."""
        return self._plant.grounded

    @grounded.setter
    def grounded(self, grounded: bool) -> None:
        self._plant.grounded = grounded or self.is_wrecked

    def accelerate(self, accel_mps2: Vec3) -> None:
        """Hold this acceleration setpoint from now on [m/s²]."""
        self._goal = _Goal.NOTHING
        self._plant.accelerate(accel_mps2)

    def brake(self) -> None:
        """Stop."""
        self._set_goal(_Goal.VELOCITY, ZERO)

    def fly(self, velocity_mps: Vec3) -> None:
        """Fly this velocity [m/s]."""
        self._set_goal(_Goal.VELOCITY, velocity_mps)

    def go_to(self, position_m: Vec3) -> None:
        """Fly to this position [m]."""
        self._set_goal(_Goal.POSITION, position_m)

    def follow(self, position_m: Vec3, velocity_mps: Vec3, accel_mps2: Vec3) -> None:
        """Hold a position [m] that moves with this velocity [m/s]; the acceleration is not used."""
        del accel_mps2
        self._set_goal(_Goal.POSITION, position_m, velocity_mps)

    def take_off(self, height_m: float) -> None:
        """Climb to this height above the floor [m]."""
        self._set_goal(_Goal.CLIMB, (0.0, 0.0, -height_m))

    def land(self) -> None:
        """Sink at the landing speed."""
        self._set_goal(_Goal.LAND, ZERO)

    def set_heading(self, yaw_rad: float) -> None:
        """Do nothing: the nose stays north."""

    def stand_on_floor(self) -> None:
        """Stand on the floor until `grounded` is cleared."""
        self._goal = _Goal.NOTHING
        self._plant.stand_on_floor()

    def set_estimate_error(self, position_error_m: Vec3, velocity_error_mps: Vec3) -> None:
        """Set the error of position and velocity in its laws."""
        self._errors = (position_error_m, velocity_error_mps)

    def set_attitude_error(self, error_rad: Vec3) -> None:
        """Do nothing: its laws use no attitude."""

    def update_control(self) -> None:
        """Evaluate the law of the present goal, and hold its acceleration."""
        self._control_ns = self.now_ns + CONTROL_PERIOD_NS
        true_m, true_mps = self._plant.position_m, self._plant.velocity_mps
        error_m, error_mps = self._errors
        position_m = (true_m[0] + error_m[0], true_m[1] + error_m[1], true_m[2] + error_m[2])
        velocity_mps = (true_mps[0] + error_mps[0], true_mps[1] + error_mps[1], true_mps[2] + error_mps[2])
        self._plant.accelerate(self._compute_accel(position_m, velocity_mps))

    def _set_goal(self, goal: _Goal, setpoint: Vec3, feedforward_mps: Vec3 = ZERO) -> None:
        self._goal, self._setpoint, self._feedforward_mps = goal, setpoint, feedforward_mps
        if not self.grounded:
            self.update_control()

    def _compute_accel(self, position_m: Vec3, velocity_mps: Vec3) -> Vec3:
        target_mps = self._setpoint
        if self._goal is _Goal.POSITION:
            approach_mps, feedforward_mps = compute_approach_velocity(position_m, self._setpoint), self._feedforward_mps
            target_mps = (
                approach_mps[0] + feedforward_mps[0],
                approach_mps[1] + feedforward_mps[1],
                approach_mps[2] + feedforward_mps[2],
            )
        elif self._goal in (_Goal.CLIMB, _Goal.LAND):
            target_mps = ZERO
        north, east, down = compute_brake_accel(subtract(velocity_mps, target_mps), BRAKE_MPS2)
        if self._goal is _Goal.CLIMB and self.has_down:
            down = compute_climb_accel(position_m[2], velocity_mps[2], self._setpoint[2])
        elif self._goal is _Goal.LAND and self.has_down:
            down = compute_descent_accel(velocity_mps[2])
        return north, east, down


def subtract(a: Vec3, b: Vec3) -> Vec3:
    """Return the difference of two vectors."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def compute_heading_rad(attitude: Quaternion) -> float:
    """Return the heading of an attitude, clockwise from north [rad]."""
    w, x, y, z = attitude
    return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def rotate_to_ned(attitude: Quaternion, body: Vec3) -> Vec3:
    """Return a vector in body axes, turned into NED."""
    w, x, y, z = attitude
    bx, by, bz = body
    return (
        (1.0 - 2.0 * (y * y + z * z)) * bx + 2.0 * (x * y - w * z) * by + 2.0 * (x * z + w * y) * bz,
        2.0 * (x * y + w * z) * bx + (1.0 - 2.0 * (x * x + z * z)) * by + 2.0 * (y * z - w * x) * bz,
        2.0 * (x * z - w * y) * bx + 2.0 * (y * z + w * x) * by + (1.0 - 2.0 * (x * x + y * y)) * bz,
    )


def rotate_to_body(attitude: Quaternion, ned: Vec3) -> Vec3:
    """Return a vector in NED, turned into body axes."""
    w, x, y, z = attitude
    return rotate_to_ned((w, -x, -y, -z), ned)
