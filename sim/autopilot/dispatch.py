"""Dispatch of setpoints to the vehicle: motion and heading."""

from __future__ import annotations

import math

from sim.autopilot.estimator import Estimator
from sim.autopilot.parameters import Parameters
from sim.autopilot.profile import SimulatedProfile
from sim.autopilot.setpoints import ParsedSetpoint, SetpointKind
from sim.vehicle.interface import Vehicle

MIN_HEADING_SPEED_MPS = 0.5  # ArduPilot: the nose follows travel from this speed on


class SetpointDispatch:
    """Passes setpoints on to the vehicle.

    Attributes:
        active_setpoint: the setpoint that is flown, None if the vehicle flies by itself.
    """

    def __init__(
        self,
        profile: SimulatedProfile,
        vehicle: Vehicle,
        parameters: Parameters,
        estimator: Estimator,
        active_setpoint: ParsedSetpoint | None,
    ) -> None:
        self._is_ardupilot = profile.name == "ardupilot"
        self._vehicle = vehicle
        self._parameters = parameters
        self._estimator = estimator
        self.active_setpoint = active_setpoint

    def apply(self, setpoint: ParsedSetpoint) -> None:
        """Fly a setpoint; one without a flyable part stops the vehicle."""
        self.active_setpoint = None if setpoint.kind is SetpointKind.STOP else setpoint
        match setpoint.kind:
            case SetpointKind.ACCELERATION:
                self._vehicle.accelerate(setpoint.vector)
            case SetpointKind.VELOCITY:
                self._vehicle.fly(setpoint.vector)
            case SetpointKind.POSITION if setpoint.velocity_mps is not None:
                self._vehicle.follow(setpoint.vector, setpoint.velocity_mps, setpoint.accel_mps2)
            case SetpointKind.POSITION:
                self._vehicle.go_to(setpoint.vector)
            case _:
                self._vehicle.brake()
        self._update_heading(setpoint)

    def _update_heading(self, setpoint: ParsedSetpoint) -> None:
        """Turn to the setpoint's heading; without one ArduPilot turns along its velocity, and PX4 keeps its heading."""
        north, east, _ = self._estimator.velocity_mps
        if setpoint.yaw_rad is not None:
            self._vehicle.set_heading(setpoint.yaw_rad)
        elif (
            self._is_ardupilot
            and self._parameters["WP_YAW_BEHAVIOR"] != 0
            and math.hypot(north, east) > MIN_HEADING_SPEED_MPS
        ):
            self._vehicle.set_heading(math.atan2(east, north))
