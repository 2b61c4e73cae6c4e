"""The distances by age of `tools/reference_by_age.py`, against a simulation of their regulator."""

from __future__ import annotations

import math

import numpy as np
import pytest
from other_links import WALL_M, Cell, draw_run, make_problem
from reference_by_age import find_distances

from uavctl.arrays import Array
from uavctl.smpc.nominal import lqr

ALLOWED, SETTLED, RUNS, STEPS = 0.05, 100, 60, 1100


def fly(distances_m: Array, arrived: Array, noise: Array) -> tuple[Array, float]:
    """Fly the regulator with a reference of each age, without limits; return shares outside (runs,) and mean cost."""
    problem = make_problem(1)
    plant, k = problem.plant, lqr(problem.plant, problem.q_x, problem.q_u).k
    x = np.tile([WALL_M - distances_m[0], 0.0], (RUNS, 1))
    mean, age = x.copy(), np.zeros(RUNS, dtype=np.intp)
    outside, cost = np.zeros(RUNS), 0.0
    for step in range(STEPS):
        is_new = arrived[:, step] > 0.0
        mean[is_new], age = x[is_new], np.where(is_new, 0, age + 1)
        off = mean.copy()
        off[:, 0] -= WALL_M - distances_m[np.minimum(age, distances_m.size - 1)]
        u = off @ k.T
        if step >= SETTLED:
            from_wall = x - [WALL_M, 0.0]
            cost += float(np.einsum("ri,ij,rj->", from_wall, problem.q_x, from_wall) + problem.q_u[0, 0] * (u**2).sum())
        x = x @ plant.a.T + u @ plant.b.T + noise[:, step] @ plant.e.T
        mean = mean @ plant.a.T + u @ plant.b.T
        outside += (x[:, 0] > WALL_M) & (step >= SETTLED)
    return outside / (STEPS - SETTLED), cost


@pytest.mark.parametrize("loss", [0.3, 0.6])
def test_its_regulator_is_outside_as_often_as_allowed_and_costs_less_than_one_distance(loss: float) -> None:
    problem = make_problem(1)
    (wall,) = np.flatnonzero(problem.state_set.c[:, 0] > 0.0)
    distances_m = find_distances(problem, np.power(loss, np.arange(40.0)), int(wall), ALLOWED)
    draws = [draw_run(Cell("", loss), STEPS, problem, np.random.default_rng([5, run])) for run in range(RUNS)]
    arrived, noise = (np.array(values) for values in zip(*draws, strict=True))
    outside, cost = fly(distances_m, arrived, noise)
    assert abs(outside.mean() - ALLOWED) < 3.0 * outside.std() / math.sqrt(RUNS) + 0.1 * ALLOWED
    # One distance that is outside as often costs more
    low_m, high_m = 1.0, 6.0
    for _ in range(12):
        middle_m = 0.5 * (low_m + high_m)
        one, one_cost = fly(np.array([middle_m]), arrived, noise)
        low_m, high_m = (low_m, middle_m) if one.mean() <= outside.mean() else (middle_m, high_m)
    assert cost < (0.97 if loss < 0.5 else 0.92) * one_cost
