"""MPC of the baselines: the regulator where no row is active, the optimum of CVXPY elsewhere."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import cvxpy as cp
import numpy as np
import pytest
from baseline_rig import PAPER_START, arrivals, cube, flown, noise, problem, unlimited

from uavctl.arrays import Array
from uavctl.smpc.baselines import HoldLast, Lqg, PacketisedPredictive, ZeroOnLoss
from uavctl.smpc.nominal import BatchMpc, ControlProblem, lqr
from uavctl.smpc.sets import Polytope

GENERAL = ("coupled 1", "second input 0", "free chain 0", "lagged 0", "redundant inputs 1")


class Printed:
    """The program as one would print it, in states, inputs and slacks."""

    def __init__(self, case: ControlProblem, backoff_x: Array, backoff_u: Array) -> None:
        plant, steps = case.plant, case.horizon
        self.x0 = cp.Parameter(plant.n_x)
        self.x, self.u = cp.Variable((steps + 1, plant.n_x)), cp.Variable((steps, plant.n_u))
        slack = cp.Variable((steps, case.state_set.b.size), nonneg=True)
        root_x, root_u = np.linalg.cholesky(case.q_x).T, np.linalg.cholesky(case.q_u).T
        root_p = np.linalg.cholesky(lqr(plant, case.q_x, case.q_u).p).T
        off_x, off_u = self.x - case.target[None], self.u - case.u_target[None]
        cost = cp.sum_squares(off_x[:steps] @ root_x.T) + cp.sum_squares(off_u @ root_u.T)
        cost += cp.sum_squares(root_p @ off_x[steps])
        cost += case.slack_linear * cp.sum(slack) + case.slack_quadratic * cp.sum_squares(slack)
        rows = [self.x[0] == self.x0, self.x[1:] == self.x[:steps] @ plant.a.T + self.u @ plant.b.T]
        rows.append(self.x[1:] @ case.state_set.c.T + backoff_x[1:] <= case.state_set.b[None] + slack)
        rows.append(self.u @ case.input_set.c.T + backoff_u <= case.input_set.b[None])
        self.problem = cp.Problem(cp.Minimize(cost), rows)

    def solve(self, x0: Array) -> float:
        self.x0.value = x0
        self.problem.solve(solver=cp.CLARABEL)
        assert self.problem.status == cp.OPTIMAL
        return float(self.problem.value)


def cost_of(case: ControlProblem, backoff_x: Array, x: Array, plan: Array) -> tuple[float, float]:
    """Cost of a plan, slack and all, and the sum of the slack."""
    total, slack = 0.0, 0.0
    for t, u in enumerate(plan):
        off_x, off_u = x - case.target, u - case.u_target
        total += float(off_x @ case.q_x @ off_x + off_u @ case.q_u @ off_u)
        x = case.plant.a @ x + case.plant.b @ u
        beyond = np.maximum(backoff_x[t + 1] - case.state_set.margin(x), 0.0)
        total += float(case.slack_linear * beyond.sum() + case.slack_quadratic * beyond @ beyond)
        slack += float(beyond.sum())
    off_x = x - case.target
    return total + float(off_x @ lqr(case.plant, case.q_x, case.q_u).p @ off_x), slack


def reach(case: ControlProblem) -> Array:
    """Size (n_x,) of the states to try: the room of each state to its limits, 2 where it has none."""
    margin = case.state_set.margin(case.target)
    room = [margin[case.state_set.c[:, i] != 0].max(initial=0.0) for i in range(case.plant.n_x)]
    return np.where(np.array(room) > 0.0, room, 2.0)


def paper_with(**changes: Any) -> ControlProblem:
    return replace(problem("paper"), **changes)


def with_row(limits: Polytope, row: list[float], side: float) -> Polytope:
    return Polytope(np.vstack([limits.c, row]), np.append(limits.b, side))


PROBLEMS: dict[str, Callable[[], ControlProblem]] = {
    **{name: partial(problem, name) for name in ("paper", "room-hahn-stursberg", *GENERAL)},
    "axes that share weights of states": lambda: paper_with(
        q_x=np.diag([10.0, 0.1, 10.0, 0.1]) + 5.0 * np.eye(4)[[2, 3, 0, 1]] * [1.0, 0.0, 1.0, 0.0]
    ),
    "axes that share weights of inputs": lambda: paper_with(q_u=np.array([[0.1, 0.08], [0.08, 0.1]])),
    "axes that share a state row": lambda: paper_with(
        state_set=with_row(problem("paper").state_set, [1.0, 0.0, 1.0, 0.0], 10.0)
    ),
    "axes that share an input row": lambda: paper_with(input_set=with_row(problem("paper").input_set, [1.0, 1.0], 6.0)),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", PROBLEMS)
def test_the_plan_is_cvxpy_s_optimum(name: str) -> None:
    case = PROBLEMS[name]()
    rng = np.random.default_rng(4)
    backoff_x = np.outer(np.linspace(0.0, 0.1, case.horizon + 1), np.abs(case.state_set.b))
    backoff_u = np.outer(np.linspace(0.0, 0.2, case.horizon), np.abs(case.input_set.b))
    path = reach(case) * rng.uniform(-1.0, 1.0, (9, case.plant.n_x))
    states = case.target + np.logspace(-2, 0.4, 9)[:, None] * path
    plans = BatchMpc(case, backoff_x, backoff_u).compute_plans(states)
    printed, steered, slack = Printed(case, backoff_x, backoff_u), 0, 0.0
    k = lqr(case.plant, case.q_x, case.q_u).k
    for x, plan in zip(states, plans, strict=True):
        cost, left = cost_of(case, backoff_x, x, plan)
        assert cost == pytest.approx(printed.solve(x), rel=1e-6, abs=1e-6)
        assert np.all(plan @ case.input_set.c.T + backoff_u <= case.input_set.b + 1e-8)
        steered += bool(np.abs(plan[0] - case.u_target - k @ (x - case.target)).max() > 1e-6)
        slack = max(slack, left)
    assert 0 < steered < len(states)  # of both kinds, those that meet a row and those that do not
    assert slack > 0.0


@pytest.mark.parametrize("name", ["paper", "room-hahn-stursberg", *GENERAL])
def test_without_active_rows_the_plan_is_the_regulator_s(name: str) -> None:
    case = unlimited(problem(name))
    k = lqr(case.plant, case.q_x, case.q_u).k
    states = case.target + np.random.default_rng(5).normal(size=(6, case.plant.n_x))
    for x, plan in zip(states, BatchMpc(case).compute_plans(states), strict=True):
        now = x
        for u in plan:
            assert u == pytest.approx(case.u_target + k @ (now - case.target), rel=1e-8, abs=1e-8)
            now = case.plant.a @ now + case.plant.b @ u


@pytest.mark.parametrize("maker", [PacketisedPredictive, HoldLast, ZeroOnLoss])
@pytest.mark.parametrize("name", ["paper", "room-hahn-stursberg"])
def test_without_losses_and_limits_all_fly_as_the_regulator(
    name: str, maker: type[PacketisedPredictive | HoldLast | ZeroOnLoss]
) -> None:
    case = unlimited(problem(name))
    newest, disturbances = arrivals(3, 40, 0.0, 0), noise(case, 3, 40, 1)
    start = case.target + 1.0
    result = flown(case, maker(case), start, newest, disturbances)
    expected = flown(case, Lqg(case), start, newest, disturbances)
    assert result.states == pytest.approx(expected.states, abs=1e-8)
    assert result.inputs == pytest.approx(expected.inputs, abs=1e-8)


def test_the_program_takes_over_where_the_regulator_just_meets_a_row() -> None:
    """No jump: the plan is continuous in the state, across the line at which the program is solved at all."""
    case = problem("paper")
    k = lqr(case.plant, case.q_x, case.q_u).k
    edge = np.array([7.5 / abs(k[0, 0]), 0.0, 0.0, 0.0])
    inside, outside = BatchMpc(case).compute_plans(np.array([edge * (1 - 1e-9), edge * (1 + 1e-9)]))
    assert inside[0, 0] == pytest.approx(-7.5, abs=1e-6)
    assert outside == pytest.approx(inside, abs=1e-6)


def test_far_outside_all_limits_a_plan_keeps_the_input_limits() -> None:
    case = problem("paper")
    far = np.array([[s * 10.0**e, 50.0 * s, -s * 10.0**e, 80.0] for s in (-1.0, 1.0) for e in range(2, 6)])
    plans = BatchMpc(case).compute_plans(far)
    assert np.isfinite(plans).all()
    assert np.abs(plans).max() <= 7.5
    assert plans[:, 0, 0] == pytest.approx(-7.5 * np.sign(far[:, 0]))


def test_a_state_that_is_not_finite_affects_its_run_only() -> None:
    case = problem("paper")
    states = np.array([PAPER_START, [np.nan, 0.0, 0.0, 0.0], PAPER_START, [np.inf, 1.0, 1.0, 1.0]])
    plans = BatchMpc(case).compute_plans(states)
    assert np.isnan(plans[[1, 3]]).any(axis=(1, 2)).all()
    assert plans[[0, 2]] == pytest.approx(np.repeat(BatchMpc(case).compute_plans(states[:1]), 2, axis=0), abs=1e-9)


def test_an_axis_with_limits_and_one_without() -> None:
    case = problem("paper")
    one_sided = replace(case, state_set=cube(4, 1e9))
    single, both = BatchMpc(one_sided), BatchMpc(case)
    x = np.array([[-28.0, 6.5, 0.5, 0.2]])  # at full input the first axis would pass its 7 m/s
    assert both.compute_plans(x)[:, :, 1] == pytest.approx(single.compute_plans(x)[:, :, 1], abs=1e-12)
    assert np.abs(both.compute_plans(x)[:, :, 0] - single.compute_plans(x)[:, :, 0]).max() > 1e-3
