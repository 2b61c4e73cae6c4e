"""Braking before the position limits: distance to a stop, and velocities from which a stop ends in time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uavctl.arrays import Array


@dataclass(frozen=True, eq=False)
class Braking:
    """Braking of the fallback, with one entry for each axis (n,); vectors are local NED.

    It brakes with `gain_1ps` v, at most `accel_mps2`, as soon as the setpoint limiter and the vehicle's lag let it.
    """

    lower_m: Array  # positions in which a stop may end (n,); minus infinity without a limit
    upper_m: Array  # the same, infinity without a limit
    accel_mps2: Array  # largest deceleration (n,)
    lag_s: Array  # time from a setpoint to its acceleration (n,)
    slew_mps3: float  # largest change of the setpoint in a second
    gain_1ps: float  # deceleration per speed

    def compute_stop_m(self, speed_mps: Array, accel_mps2: Array) -> Array:
        """Compute the distance (n,) from now to the stop.

        Args:
            speed_mps: Speeds (n,) in the directions of travel, not negative.
            accel_mps2: Setpoint that acts now (n,), in these directions.
        """
        gained_mps, turn_s = self._compute_turn(accel_mps2)
        fastest, most, gain = speed_mps + gained_mps, self.accel_mps2, self.gain_1ps
        # v_g = a / g; s = v T + v / g below it, else v T + (v² - v_g²) / 2 a + v_g / g
        gentle = most / gain
        brake_m = np.where(fastest <= gentle, fastest / gain, (fastest**2 - gentle**2) / (2.0 * most) + gentle / gain)
        return np.asarray(fastest * turn_s + brake_m)

    def compute_velocity_limits(self, position_m: Array, accel_mps2: Array) -> Array:
        """Compute the least and the greatest velocity (2, n) from which a stop ends in time.

        Args:
            position_m: Positions (n,).
            accel_mps2: Setpoint that acts there (n,).
        """
        south = self._compute_fastest(position_m - self.lower_m, -accel_mps2)
        north = self._compute_fastest(self.upper_m - position_m, accel_mps2)
        return np.array([-south, north])

    def _compute_turn(self, accel_mps2: Array) -> tuple[Array, Array]:
        """Compute the speed that is gained (n,), and the time (n,), until the setpoint limiter asks for braking."""
        # a⁺ = max(a, 0); Δv = a⁺² / 2 j, T = τ + (a⁺ + ½ a_max) / j
        gains = np.maximum(accel_mps2, 0.0)
        return gains * gains / (2.0 * self.slew_mps3), self.lag_s + (gains + 0.5 * self.accel_mps2) / self.slew_mps3

    def _compute_fastest(self, room_m: Array, accel_mps2: Array) -> Array:
        """Compute the greatest speed (n,) whose stop takes at most `room_m` (n,); zero without one."""
        gained_mps, turn_s = self._compute_turn(accel_mps2)
        most, gain = self.accel_mps2, self.gain_1ps
        # Inverse of `compute_stop_m`: v = s / (T + 1/g) up to v_g, else v = -a T + √(a² T² + 2 a s - a² / g²)
        room, gentle = np.maximum(room_m, 0.0), most / gain
        slow = room / (turn_s + 1.0 / gain)
        brake = most * turn_s
        fast = np.sqrt(np.maximum(brake**2 + 2.0 * most * room - gentle**2, 0.0)) - brake
        return np.maximum(np.where(slow <= gentle, slow, fast) - gained_mps, 0.0)
