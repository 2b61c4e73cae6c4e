"""The four rotors: speeds, wrench on the body, and allocation of thrust and torque.

Order: front right, rear right, rear left, front left. The first and third turn against the clock seen from above, so
their reaction torque is to the right (positive about down).
"""

from __future__ import annotations

import math

from sim.vehicle.airframe import Airframe
from sim.vehicle.rigid_body import Wrench
from uavctl.records import Vec3

RotorValues = tuple[float, float, float, float]

STOPPED: RotorValues = (0.0, 0.0, 0.0, 0.0)


class Rotors:
    """Rotors with a first-order lag of the speed, thrust k_T Ω² and reaction torque k_Q Ω².

    Attributes:
        speeds_rps: present speeds.
        wrench: force and torque at these.
        commands_rps: speeds that they tend to.
        thrust_limited: whether the last command gave more or less thrust than was wanted.
        torque_limited: whether the last command gave more or less torque than was wanted.
    """

    def __init__(self, airframe: Airframe, step_s: float) -> None:
        self._thrust_n_s2 = airframe.thrust_n_s2
        self._lever_m = airframe.arm_m * math.sqrt(0.5)
        self._torque_m = airframe.torque_m
        self._idle_n = airframe.thrust_n_s2 * airframe.idle_rps**2
        self._half_decay = math.exp(-0.5 * step_s / airframe.motor_lag_s)
        self._decay = math.exp(-step_s / airframe.motor_lag_s)
        self.commands_rps: RotorValues = STOPPED
        self.set_speeds(STOPPED)
        self.is_thrust_limited = self.is_torque_limited = False

    def compute_wrench(self, speeds_rps: RotorValues) -> Wrench:
        """Return force and torque of rotors at these speeds."""
        k, lever_m = self._thrust_n_s2, self._lever_m
        a, b, c, d = speeds_rps
        f1, f2, f3, f4 = k * a * a, k * b * b, k * c * c, k * d * d
        torque_nm = lever_m * (f3 + f4 - f1 - f2), lever_m * (f1 + f4 - f2 - f3), self._torque_m * (f1 + f3 - f2 - f4)
        return Wrench(f1 + f2 + f3 + f4, torque_nm, a + b + c + d)

    def set_speeds(self, speeds_rps: RotorValues) -> None:
        """Let the rotors turn at these speeds."""
        self.speeds_rps, self.wrench = speeds_rps, self.compute_wrench(speeds_rps)

    def step(self) -> tuple[Wrench, Wrench, Wrench]:
        """Move on by one step, exactly; return the wrenches at its start, middle and end."""
        start, middle = self.wrench, self.compute_wrench(self._compute_lagged_speeds(self._half_decay))
        self.set_speeds(self._compute_lagged_speeds(self._decay))
        return start, middle, self.wrench

    def _compute_lagged_speeds(self, decay: float) -> RotorValues:
        (a, b, c, d), (p, q, r, s) = self.speeds_rps, self.commands_rps
        return p + (a - p) * decay, q + (b - q) * decay, r + (c - r) * decay, s + (d - s) * decay

    def stop(self) -> None:
        """Switch off."""
        self.commands_rps = STOPPED

    def command(self, thrust_n: float, torque_nm: Vec3, max_rps: float) -> None:
        """Command the speeds that give this thrust and torque, as far as the rotors can.

        Where they cannot, roll and pitch come first, then the thrust, then yaw: a vehicle that keeps its
        lean keeps its way.

        Args:
            largest_rps: speed that the battery's voltage allows.
        """
        min_n = self._idle_n
        max_n = max(self._thrust_n_s2 * max_rps * max_rps, min_n)
        roll, pitch = 0.25 * torque_nm[0] / self._lever_m, 0.25 * torque_nm[1] / self._lever_m
        yaw = 0.25 * torque_nm[2] / self._torque_m
        tilt_n = abs(roll) + abs(pitch)
        half = 0.5 * (max_n - min_n)
        is_clipped = tilt_n > half
        if is_clipped:
            roll, pitch, tilt_n = roll * half / tilt_n, pitch * half / tilt_n, half
        mean_n = min(max(0.25 * thrust_n, min_n + tilt_n), max_n - tilt_n)
        yaw_margin_n = min(max_n - tilt_n - mean_n, mean_n - tilt_n - min_n)
        yaw_n = min(max(yaw, -yaw_margin_n), yaw_margin_n)
        self.is_thrust_limited = mean_n != 0.25 * thrust_n
        self.is_torque_limited = is_clipped or yaw_n != yaw
        k = self._thrust_n_s2
        self.commands_rps = (  # no thrust is below `min_n`, which is positive
            math.sqrt((mean_n - roll + pitch + yaw_n) / k),
            math.sqrt((mean_n - roll - pitch - yaw_n) / k),
            math.sqrt((mean_n + roll - pitch + yaw_n) / k),
            math.sqrt((mean_n + roll + pitch - yaw_n) / k),
        )
