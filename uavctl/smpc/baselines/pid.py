"""Cascaded PID: position P, velocity PID, each axis by itself, on what was measured last: the usual autopilot."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uavctl.smpc.baselines.problem import Problem
from uavctl.smpc.batch import News

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class PidGains:
    """Gains of each axis (n_axes,), or of each axis of each run (N, n_axes).

    Attributes:
        position_1ps: Wanted speed per distance to the target [1/s].
        velocity_1ps: Acceleration per error of the speed [1/s].
        integral_1ps2: Acceleration per integral of this error [1/s²].
        derivative: Acceleration taken back per measured acceleration.
        speed: Share of the velocity limits that is wanted at most.
    """

    position_1ps: Array
    velocity_1ps: Array
    integral_1ps2: Array
    derivative: Array
    speed: Array


class CascadedPid:
    """Position and velocity loops as an autopilot has them; outputs saturate at the input limits.

    A lost position leaves the measurement as it was, and the integral too. The integral also stops while the output is
    at a limit and the error would drive it on.

    Args:
        problem: The problem; axes and accelerations are those of its plant.
        gains: The gains, see `pid_tuning.tune`.
    """

    def __init__(self, problem: Problem, gains: PidGains) -> None:
        plant = problem.plant
        self._problem, self._gains = problem, gains
        self._position, self._velocity = list(plant.position_index), list(plant.velocity_index)
        low, high = problem.state_set.bounds
        self._slowest, self._fastest = np.minimum(low[self._velocity], 0.0), np.maximum(high[self._velocity], 0.0)
        self._accel_of_input, self._input_of_accel = plant.accel_map, np.linalg.pinv(plant.accel_map)
        self._low, self._high = problem.input_set.bounds
        self.begin(0)

    def begin(self, runs: int) -> None:
        """See `BatchController`."""
        axes = len(self._position)
        self._integral, self._accel, self._last = np.zeros((3, runs, axes))
        self._captured = np.full(runs, -1, dtype=np.intp)

    def act(self, news: News) -> Array:
        """See `BatchController`."""
        gains, target, dt_s = self._gains, self._problem.target, self._problem.plant.dt_s
        fresh = (news.newest > self._captured)[:, None]
        position, velocity = news.state[:, self._position], news.state[:, self._velocity]
        self._differentiate(news, velocity, fresh)
        wanted = gains.position_1ps * (target[self._position] - position)
        # No limit, no share of it: 0 · inf is no number.
        wanted = np.clip(wanted, gains.speed * self._slowest, gains.speed * self._fastest)
        error = target[self._velocity] + wanted - velocity
        grown = self._integral + np.where(fresh, gains.integral_1ps2 * error * dt_s, 0.0)
        rest = gains.velocity_1ps * error - gains.derivative * self._accel
        beyond = rest + grown - self._accel_within(rest + grown)
        winding = beyond * error > 0.0
        self._integral = np.where(winding, self._integral, grown)
        return self._within(rest + self._integral)

    def _differentiate(self, news: News, velocity: Array, fresh: Flags) -> None:
        """Acceleration between the two newest velocities known."""
        span_s = np.maximum(news.newest - self._captured, 1)[:, None] * self._problem.plant.dt_s
        seen = fresh & (self._captured >= 0)[:, None]
        self._accel = np.where(seen, (velocity - self._last) / span_s, self._accel)
        self._last = np.where(fresh, velocity, self._last)
        self._captured = np.maximum(self._captured, news.newest)

    def _within(self, accel: Array) -> Array:
        """Input (N, n_u) of an acceleration (N, n_axes), at most at its limits."""
        return np.clip(self._problem.u_target + accel @ self._input_of_accel.T, self._low, self._high)

    def _accel_within(self, accel: Array) -> Array:
        """The acceleration that the limits leave of one; what no input can do counts as done."""
        asked = self._problem.u_target + accel @ self._input_of_accel.T
        lost: Array = (asked - np.clip(asked, self._low, self._high)) @ self._accel_of_input.T
        return accel - lost
