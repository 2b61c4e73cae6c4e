"""The four rotors: their speeds, what they do to the body, and how a wanted thrust and torque is shared among them.

Order: front right, rear right, rear left, front left. The first and third turn against the clock seen from above, so
that their reaction torque is to the right (positive about down).
"""

from __future__ import annotations

import math

from sim.airframe import Airframe
from sim.rigid_body import Wrench
from uavctl.data import Vec3

Four = tuple[float, float, float, float]

STOPPED: Four = (0.0, 0.0, 0.0, 0.0)


class Rotors:
    """Rotors with a first-order lag of the speed, thrust k_T Ω² and reaction torque k_Q Ω².

    Attributes:
        speeds_rps: present speeds.
        commands_rps: speeds that they tend to.
        thrust_limited: whether the last command gave more or less thrust than was wanted.
        torque_limited: the same of the torque.
    """

    def __init__(self, airframe: Airframe, step_s: float) -> None:
        self._thrust_n_s2 = airframe.thrust_n_s2
        self._lever_m = airframe.arm_m * math.sqrt(0.5)
        self._torque_m = airframe.torque_m
        self._idle_n = airframe.thrust_n_s2 * airframe.idle_rps**2
        self._half_decay = math.exp(-0.5 * step_s / airframe.motor_lag_s)
        self._decay = math.exp(-step_s / airframe.motor_lag_s)
        self.speeds_rps: Four = STOPPED
        self.commands_rps: Four = STOPPED
        self.thrust_limited = self.torque_limited = False

    def wrench(self, speeds_rps: Four) -> Wrench:
        """What rotors at these speeds do to the body."""
        k = self._thrust_n_s2
        a, b, c, d = speeds_rps
        f1, f2, f3, f4 = k * a * a, k * b * b, k * c * c, k * d * d
        return Wrench(
            f1 + f2 + f3 + f4,
            (
                self._lever_m * (f3 + f4 - f1 - f2),
                self._lever_m * (f1 + f4 - f2 - f3),
                self._torque_m * (f1 + f3 - f2 - f4),
            ),
            a + b + c + d,
        )

    def step(self) -> tuple[Wrench, Wrench, Wrench]:
        """Move on by one step, exactly; returns the wrenches at its start, middle and end."""
        start = self.speeds_rps
        middle = self._lagged(self._half_decay)
        self.speeds_rps = self._lagged(self._decay)
        return self.wrench(start), self.wrench(middle), self.wrench(self.speeds_rps)

    def _lagged(self, decay: float) -> Four:
        (a, b, c, d), (p, q, r, s) = self.speeds_rps, self.commands_rps
        return p + (a - p) * decay, q + (b - q) * decay, r + (c - r) * decay, s + (d - s) * decay

    def stop(self) -> None:
        """Switch off."""
        self.commands_rps = STOPPED

    def command(self, thrust_n: float, torque_nm: Vec3, largest_rps: float) -> None:
        """Command the speeds that give this thrust and torque, as far as the rotors can.

        Where they cannot, roll and pitch come first, then the thrust, then yaw: a vehicle that keeps its
        lean keeps its way.

        Args:
            thrust_n: of all rotors together.
            torque_nm: about front, right, down.
            largest_rps: speed that the battery's voltage allows.
        """
        lowest = self._idle_n
        highest = max(self._thrust_n_s2 * largest_rps * largest_rps, lowest)
        roll, pitch = 0.25 * torque_nm[0] / self._lever_m, 0.25 * torque_nm[1] / self._lever_m
        yaw = 0.25 * torque_nm[2] / self._torque_m
        reach = abs(roll) + abs(pitch)
        half = 0.5 * (highest - lowest)
        clipped = reach > half
        if clipped:
            roll, pitch, reach = roll * half / reach, pitch * half / reach, half
        each = min(max(0.25 * thrust_n, lowest + reach), highest - reach)
        room = min(highest - reach - each, each - reach - lowest)
        turn = min(max(yaw, -room), room)
        self.thrust_limited = each != 0.25 * thrust_n
        self.torque_limited = clipped or turn != yaw
        k = self._thrust_n_s2
        self.commands_rps = (
            math.sqrt(max(each - roll + pitch + turn, 0.0) / k),
            math.sqrt(max(each - roll - pitch - turn, 0.0) / k),
            math.sqrt(max(each + roll - pitch + turn, 0.0) / k),
            math.sqrt(max(each + roll + pitch - turn, 0.0) / k),
        )
