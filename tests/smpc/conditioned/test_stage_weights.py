"""Weights of the stages: against the expected cost of a plan that positions end, and plans with them against CVXPY."""

from __future__ import annotations

import cvxpy as cp
import numpy as np
import pytest
from baseline_rig import problem

from uavctl.config.load import load_config
from uavctl.smpc.answer import Preview
from uavctl.smpc.conditioned.levels import MIN_STAGE_WEIGHT, compute_stage_weights
from uavctl.smpc.conditioned.planner import ConditionedSolver
from uavctl.smpc.conditioned.reference import find_nearest_level, get_link
from uavctl.smpc.link import bernoulli
from uavctl.smpc.nominal import lqr
from uavctl.wiring.controller import build_problem

ALLOWED = 0.05


def test_they_give_the_expected_cost_of_a_plan_that_a_position_ends() -> None:
    """From the position on the regulator flies: its cost is x'P x."""
    case, rng, link = problem("room-hahn-stursberg"), np.random.default_rng(2), (0.9, 0.97)
    plant, steps, law = case.plant, case.horizon, lqr(case.plant, case.q_x, case.q_u)
    x, inputs = rng.normal(size=plant.n_x), rng.normal(size=(steps, plant.n_u))
    z, flown_cost, expected, silence = np.zeros_like(inputs), 0.0, 0.0, 1.0
    start = x
    for stage, u in enumerate(inputs):
        z[stage] = np.linalg.cholesky(law.weight).T @ (u - law.k @ x)
        flown_cost += x @ case.q_x @ x + u @ case.q_u @ u
        x = plant.a @ x + plant.b @ u
        lost = link[0] if stage == 0 else link[1]
        ends = silence * (1.0 if stage == steps - 1 else 1.0 - lost)
        expected += ends * (flown_cost + x @ law.p @ x)
        silence *= lost
    weights = compute_stage_weights(link, steps)
    assert weights.min() > MIN_STAGE_WEIGHT
    assert start @ law.p @ start + weights @ (z**2).sum(axis=1) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("seed", [*range(2), *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(2, 6))])
def test_a_plan_beside_a_wall_of_a_room_has_the_least_weighted_cost(seed: int) -> None:
    case, rng = build_problem(load_config("room", [])), np.random.default_rng(seed)
    plant, steps, law = case.plant, case.horizon, lqr(case.plant, case.q_x, case.q_u)
    solver = ConditionedSolver(case, bernoulli(np.array([0.7])), ALLOWED, has_observed_levels=True, bounds_slack=False)
    level = find_nearest_level(*rng.uniform(0.2, 0.9, size=2))
    target = plant.equilibrium((2.95, rng.choice([0.0, 2.45]), -1.2))
    x = target.copy()
    x[list(plant.position_index)] -= rng.uniform(0.0, 0.02, size=3)
    answer = solver.solve(0, x, target, Preview(level=level))

    weights = compute_stage_weights(get_link(level), steps)
    root = np.linalg.cholesky(law.weight).T
    u, states = cp.Variable((steps, plant.n_u)), cp.Variable((steps + 1, plant.n_x))
    slack = cp.Variable((steps, case.state_set.b.size), nonneg=True)
    rules = [states[0] == x]
    cost = case.slack_linear * cp.sum(slack) + case.slack_quadratic * cp.sum_squares(slack)
    for t in range(steps):
        rules += [
            states[t + 1] == plant.a @ states[t] + plant.b @ u[t],
            case.input_set.c @ u[t] <= case.input_set.b,
            case.state_set.c @ states[t + 1] <= case.state_set.b - answer.backoff_x[t + 1] + slack[t],
        ]
        cost += weights[t] * cp.sum_squares(root @ (u[t] - law.k @ (states[t] - answer.reference)))
    cp.Problem(cp.Minimize(cost), rules).solve(solver=cp.CLARABEL)
    assert answer.iterations > 0
    np.testing.assert_allclose(answer.inputs, u.value, atol=1e-3)
