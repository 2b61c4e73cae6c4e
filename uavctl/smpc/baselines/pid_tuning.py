"""Gains of the cascaded PID, tuned on the very scene that they fly in: plant, weights, limits, start and link.

A coarse grid, the same for all axes, then a cross-entropy search (Rubinstein 1999) over the logarithms of all gains:
each generation is drawn around the best of the one before. Every candidate meets the same noise and losses, and the
draws have a seed of their own: the same arguments give the same gains.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import product

import numpy as np
from numpy.typing import NDArray

from uavctl.smpc.baselines.pid import CascadedPid, PidGains
from uavctl.smpc.baselines.problem import Problem
from uavctl.smpc.batch import Counts, News

Array = NDArray[np.float64]
Cost = Callable[[Array], Array]

# First guesses: rates in 1/Δt, the integral in shares of the product of both loops' gains.
_POSITION = (0.03, 0.06, 0.12, 0.25, 0.5)
_VELOCITY = (0.05, 0.1, 0.2, 0.4, 0.8)
_INTEGRAL, _DERIVATIVE, _SPEED = (0.01, 0.1), 0.02, (0.6, 1.0)
_GENERATIONS, _CANDIDATES, _KEPT = 25, 40, 8
_WIDTH = 0.8  # standard deviation of the first generation's logarithms
_MEMORY = 0.3  # share of the last generation's width that the next one has, beside that of the best
_SEED = 0


def tune(problem: Problem, start: Array, newest: Counts, disturbances: Array) -> PidGains:
    """Gains of least mean summed stage cost, state limits at the price of their slack.

    Args:
        problem: The problem.
        start: x(0) (n_x,).
        newest: Capture step of the newest position known in each step (N, T) of N runs to tune on.
        disturbances: w (N, T, n_w) of these runs.
    """
    axes = len(problem.plant.axes)

    def cost(candidates: Array) -> Array:
        return _costs(problem, candidates.reshape(-1, 5, axes), start, newest, disturbances)

    return _gains(_searched(_guess(problem.plant.dt_s, axes, cost), cost).reshape(5, axes))


def _guess(dt_s: float, axes: int, cost: Cost) -> Array:
    """The best of the grid (5 n_axes,)."""
    grid = np.array(
        [
            [p / dt_s, v / dt_s, share * p * v / dt_s**2, _DERIVATIVE, speed]
            for p, v, share, speed in product(_POSITION, _VELOCITY, _INTEGRAL, _SPEED)
        ]
    )
    candidates = np.repeat(grid, axes, axis=1)
    best: Array = candidates[np.argmin(cost(candidates))]
    return best


def _searched(best: Array, cost: Cost) -> Array:
    """The best point (n,) found from `best` on."""
    rng = np.random.default_rng(_SEED)
    least = float(cost(best[np.newaxis])[0])
    mean, width = np.log(best), np.full(best.size, _WIDTH)
    for _ in range(_GENERATIONS):
        drawn = mean + width * rng.standard_normal((_CANDIDATES, best.size))
        found = cost(np.exp(drawn))
        kept = drawn[np.argsort(found, kind="stable")[:_KEPT]]
        if found.min() < least:
            least, best = float(found.min()), np.exp(kept[0])
        mean, width = kept.mean(axis=0), _MEMORY * width + (1.0 - _MEMORY) * kept.std(axis=0)
    return best


def _costs(problem: Problem, candidates: Array, start: Array, newest: Counts, disturbances: Array) -> Array:
    """Mean cost (G,) of candidates (G, 5, n_axes); inf where a run leaves all bounds."""
    plant, (runs, steps), count = problem.plant, newest.shape, len(candidates)
    pid = CascadedPid(problem, _gains(np.repeat(candidates, runs, axis=0).swapaxes(0, 1)))
    pid.begin(count * runs)
    known, noise = np.tile(newest, (count, 1)), np.tile(disturbances @ plant.e.T, (count, 1, 1))
    every = np.arange(count * runs)
    states, inputs = np.zeros((every.size, steps + 1, plant.n_x)), np.zeros((every.size, steps, plant.n_u))
    states[:, 0] = start
    total = np.zeros(every.size)
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(steps):
            inputs[:, k] = pid.act(News(k, known[:, k], states[every, known[:, k]], inputs[:, :k]))
            states[:, k + 1] = states[:, k] @ plant.a.T + inputs[:, k] @ plant.b.T + noise[:, k]
            total += _stage(problem, states[:, k], inputs[:, k], states[:, k + 1])
    mean = total.reshape(count, runs).mean(axis=1)
    return np.where(np.isfinite(mean), mean, np.inf)


def _stage(problem: Problem, x: Array, u: Array, then: Array) -> Array:
    """Stage cost (M,), and the price of what the next state is beyond its limits."""
    off_x, off_u = x - problem.target, u - problem.u_target
    beyond = np.maximum(then @ problem.state_set.c.T - problem.state_set.b, 0.0)
    slack = problem.slack_linear * beyond + problem.slack_quadratic * beyond**2
    cost: Array = np.sum(off_x @ problem.q_x * off_x, axis=1) + np.sum(off_u @ problem.q_u * off_u, axis=1)
    return np.asarray(cost + slack.sum(axis=1), dtype=np.float64)


def _gains(values: Array) -> PidGains:
    """Gains from (5, …) in the order of the fields."""
    position, velocity, integral, derivative, speed = values
    return PidGains(position, velocity, integral, derivative, speed)
