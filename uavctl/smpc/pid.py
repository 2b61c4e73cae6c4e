"""Cascaded PID as a baseline: position P, velocity PID, each axis alone, on the newest measurement, as in autopilots.

The gains are tuned on the scene that they fly in:

1. A coarse grid, the same for all axes.
2. A cross-entropy search (Rubinstein 1999) over the logarithms of all gains: each generation lies around the elite of
   the last one. Every candidate has the same noise and losses, and the draws have their own seed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from uavctl.arrays import Array
from uavctl.smpc.batch import Counts, Information
from uavctl.smpc.nominal import ControlProblem

Flags = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class PidGains:
    """Gains of each axis (n_axes,), or of each axis of each run (N, n_axes)."""

    position_1ps: Array  # speed setpoint per distance to the target [1/s]
    velocity_1ps: Array  # acceleration per error of the speed [1/s]
    integral_1ps2: Array  # acceleration per integral of this error [1/s²]
    derivative: Array  # acceleration subtracted per measured acceleration
    speed: Array  # largest speed setpoint, as a share of the velocity limits


class CascadedPid:
    """Position and velocity loops as in an autopilot; outputs saturate at the input limits.

    A lost position changes neither measurement nor integral. The integral also stops while the output is at a limit and
    the error would drive it further.

    Args:
        problem: The problem; axes and accelerations are those of its plant.
        gains: The gains, see `tune`.
    """

    def __init__(self, problem: ControlProblem, gains: PidGains) -> None:
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

    def act(self, information: Information) -> Array:
        """See `BatchController`."""
        gains, target, dt_s = self._gains, self._problem.target, self._problem.plant.dt_s
        has_new = (information.newest > self._captured)[:, None]
        position, velocity = information.state[:, self._position], information.state[:, self._velocity]
        self._differentiate(information, velocity, has_new)
        speed = gains.position_1ps * (target[self._position] - position)
        # v_set = clip(kp (p_s - p), ± share of the limits); an infinite limit clips nothing
        speed = np.clip(speed, gains.speed * self._slowest, gains.speed * self._fastest)
        error = target[self._velocity] + speed - velocity
        next_integral = self._integral + np.where(has_new, gains.integral_1ps2 * error * dt_s, 0.0)
        proportional = gains.velocity_1ps * error - gains.derivative * self._accel
        saturation = proportional + next_integral - self._saturate_accel(proportional + next_integral)
        winds_up = saturation * error > 0.0
        self._integral = np.where(winds_up, self._integral, next_integral)
        return self._saturate_input(proportional + self._integral)

    def _differentiate(self, information: Information, velocity: Array, has_new: Flags) -> None:
        """Update the acceleration from the two newest velocities."""
        span_s = np.maximum(information.newest - self._captured, 1)[:, None] * self._problem.plant.dt_s
        has_two = has_new & (self._captured >= 0)[:, None]
        self._accel = np.where(has_two, (velocity - self._last) / span_s, self._accel)
        self._last = np.where(has_new, velocity, self._last)
        self._captured = np.maximum(self._captured, information.newest)

    def _saturate_input(self, accel: Array) -> Array:
        """Return the input (N, n_u) of an acceleration (N, n_axes), clipped to its limits."""
        return np.clip(self._problem.u_target + accel @ self._input_of_accel.T, self._low, self._high)

    def _saturate_accel(self, accel: Array) -> Array:
        """Return the acceleration that the limits leave; a part that no input can produce counts as produced."""
        inputs = self._problem.u_target + accel @ self._input_of_accel.T
        lost: Array = (inputs - np.clip(inputs, self._low, self._high)) @ self._accel_of_input.T
        return accel - lost


Cost = Callable[[Array], Array]


# Grid: rates in 1/Δt, the integral as shares of the product of both loops' gains
_POSITION = (0.03, 0.06, 0.12, 0.25, 0.5)


_VELOCITY = (0.05, 0.1, 0.2, 0.4, 0.8)


_INTEGRAL, _DERIVATIVE, _SPEED = (0.01, 0.1), 0.02, (0.6, 1.0)


_GENERATIONS, _CANDIDATES, _ELITE = 25, 40, 8


_WIDTH = 0.8  # standard deviation of the first generation's logarithms


_SMOOTHING = 0.3  # weight of the last generation's width in the next one; the rest is that of the elite


_SEED = 0


def tune(problem: ControlProblem, start: Array, newest: Counts, disturbances: Array) -> PidGains:
    """Tune the gains for the least mean summed stage cost, with soft state limits.

    Args:
        start: x(0) (n_x,).
        newest: Capture step of the newest position known in each step (N, T) of N runs to tune on.
        disturbances: w (N, T, n_w) of these runs.
    """
    axes = len(problem.plant.axes)

    def cost(candidates: Array) -> Array:
        return _evaluate(problem, candidates.reshape(-1, 5, axes), start, newest, disturbances)

    return _make_gains(_search(_search_grid(problem.plant.dt_s, axes, cost), cost).reshape(5, axes))


def _search_grid(dt_s: float, axes: int, cost: Cost) -> Array:
    """Return the best gains of the grid (5 n_axes,)."""
    grid = np.array(
        [
            [p / dt_s, v / dt_s, share * p * v / dt_s**2, _DERIVATIVE, speed]
            for p, v, share, speed in product(_POSITION, _VELOCITY, _INTEGRAL, _SPEED)
        ]
    )
    candidates = np.repeat(grid, axes, axis=1)
    best: Array = candidates[np.argmin(cost(candidates))]
    return best


def _search(best: Array, cost: Cost) -> Array:
    """Search from `best` (n,) on and return the best point."""
    rng = np.random.default_rng(_SEED)
    lowest_cost = float(cost(best[np.newaxis])[0])
    mean, width = np.log(best), np.full(best.size, _WIDTH)
    for _ in range(_GENERATIONS):
        samples = mean + width * rng.standard_normal((_CANDIDATES, best.size))
        costs = cost(np.exp(samples))
        elite = samples[np.argsort(costs, kind="stable")[:_ELITE]]
        if costs.min() < lowest_cost:
            lowest_cost, best = float(costs.min()), np.exp(elite[0])
        mean, width = elite.mean(axis=0), _SMOOTHING * width + (1.0 - _SMOOTHING) * elite.std(axis=0)
    return best


def _evaluate(problem: ControlProblem, candidates: Array, start: Array, newest: Counts, disturbances: Array) -> Array:
    """Return the mean cost (G,) of candidates (G, 5, n_axes); inf where a run diverges."""
    plant, (runs, steps), count = problem.plant, newest.shape, len(candidates)
    pid = CascadedPid(problem, _make_gains(np.repeat(candidates, runs, axis=0).swapaxes(0, 1)))
    pid.begin(count * runs)
    all_newest, noise = np.tile(newest, (count, 1)), np.tile(disturbances @ plant.e.T, (count, 1, 1))
    all_runs = np.arange(count * runs)
    states, inputs = np.zeros((all_runs.size, steps + 1, plant.n_x)), np.zeros((all_runs.size, steps, plant.n_u))
    states[:, 0] = start
    total = np.zeros(all_runs.size)
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(steps):
            inputs[:, k] = pid.act(Information(k, all_newest[:, k], states[all_runs, all_newest[:, k]], inputs[:, :k]))
            states[:, k + 1] = states[:, k] @ plant.a.T + inputs[:, k] @ plant.b.T + noise[:, k]
            total += _stage_cost(problem, states[:, k], inputs[:, k], states[:, k + 1])
    mean = total.reshape(count, runs).mean(axis=1)
    return np.where(np.isfinite(mean), mean, np.inf)


def _stage_cost(problem: ControlProblem, x: Array, u: Array, x_next: Array) -> Array:
    """Return the stage cost (M,) and the price of the next state's excess over its limits."""
    # (x - x_s)'Q_x(x - x_s) + (u - u_s)'Q_u(u - u_s) + Σ (ρ_1 s + ρ_2 s²),  s = max(C x⁺ - b, 0)
    off_x, off_u = x - problem.target, u - problem.u_target
    excess = np.maximum(x_next @ problem.state_set.c.T - problem.state_set.b, 0.0)
    slack = problem.slack_linear * excess + problem.slack_quadratic * excess**2
    cost: Array = np.sum(off_x @ problem.q_x * off_x, axis=1) + np.sum(off_u @ problem.q_u * off_u, axis=1)
    return np.asarray(cost + slack.sum(axis=1), dtype=np.float64)


def _make_gains(values: Array) -> PidGains:
    """Make gains from (5, …) in the order of the fields."""
    position, velocity, integral, derivative, speed = values
    return PidGains(position, velocity, integral, derivative, speed)
