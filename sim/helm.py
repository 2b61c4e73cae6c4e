"""From a setpoint to what is asked of the craft, and where its nose points."""

from __future__ import annotations

import math

from sim.craft import Craft
from sim.estimator import Estimator
from sim.parameters import Parameters
from sim.personality import Personality
from sim.setpoints import Ask, Setpoint

NOSE_MPS = 0.5  # ArduPilot: the nose follows travel from this speed on


class Helm:
    """Hands setpoints to the craft.

    Attributes:
        obeyed: the setpoint that is flown, None if the vehicle flies by itself.
    """

    def __init__(
        self, kind: Personality, craft: Craft, parameters: Parameters, estimator: Estimator, obeyed: Setpoint | None
    ) -> None:
        self._ardupilot = kind.name == "ardupilot"
        self._craft = craft
        self._parameters = parameters
        self._estimator = estimator
        self.obeyed = obeyed

    def obey(self, setpoint: Setpoint) -> None:
        """Fly a setpoint; one that asks for nothing flyable stops the vehicle."""
        self.obeyed = None if setpoint.ask is Ask.STOP else setpoint
        match setpoint.ask:
            case Ask.ACCELERATION:
                self._craft.accelerate(setpoint.vector)
            case Ask.VELOCITY:
                self._craft.fly(setpoint.vector)
            case Ask.POSITION if setpoint.velocity_mps is not None:
                self._craft.follow(setpoint.vector, setpoint.velocity_mps, setpoint.accel_mps2)
            case Ask.POSITION:
                self._craft.go_to(setpoint.vector)
            case _:
                self._craft.brake()
        self._point_nose(setpoint)

    def _point_nose(self, setpoint: Setpoint) -> None:
        """To the heading asked for; without one ArduPilot looks along its way, and PX4 stays as it is."""
        north, east, _ = self._estimator.velocity_mps
        if setpoint.yaw_rad is not None:
            self._craft.face(setpoint.yaw_rad)
        elif self._ardupilot and self._parameters["WP_YAW_BEHAVIOR"] != 0 and math.hypot(north, east) > NOSE_MPS:
            self._craft.face(math.atan2(east, north))
