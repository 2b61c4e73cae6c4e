"""The governor and the mean QP: their margins, and where they equal the regulator."""

from __future__ import annotations

import cvxpy as cp
import numpy as np
import pytest
from baseline_rig import PAPER_START, arrivals, flown, noise, problem, unlimited

from uavctl.arrays import Array
from uavctl.smpc.baselines import Governor, Lqg, MeanQp, PacketisedPredictive
from uavctl.smpc.batch import Information, predict
from uavctl.smpc.nominal import ControlProblem, lqr


def sigma(case: ControlProblem, steps: int) -> Array:
    """Standard deviation (m,) of each row after so many steps without a position."""
    plant, cov = case.plant, np.zeros((case.plant.n_x, case.plant.n_x))
    for _ in range(steps):
        cov = plant.a @ cov @ plant.a.T + plant.e @ plant.w @ plant.e.T
    return np.asarray(np.sqrt(np.diagonal(case.state_set.c @ cov @ case.state_set.c.T)))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["paper", "room-hahn-stursberg"])
def test_the_governor_keeps_its_margin_nearest_to_the_regulator(name: str) -> None:
    case, rng = problem(name, slack_linear=1e3, slack_quadratic=10.0), np.random.default_rng(4)
    plant, controller, margin = case.plant, Governor(case, 2.5), 2.5
    low, high = (np.where(np.isfinite(side), side, 0.0) for side in case.state_set.bounds)
    shifted = 0
    for age in (0, 0, 1, 3, 0, 2, 0, 1):
        states = rng.uniform(0.95 * low, 0.95 * high, (20, plant.n_x))
        inputs = 0.1 * rng.normal(size=(20, 5, plant.n_u))
        information = Information(5, np.full(20, 5 - age), states, inputs)
        requested, x = controller.act(information), predict(plant, information)
        expected = case.u_target + (x - case.target) @ lqr(plant, case.q_x, case.q_u).k.T
        for i in range(0, 20, 4):
            u, slack = cp.Variable(plant.n_u), cp.Variable(case.state_set.b.size, nonneg=True)
            clipped = np.clip(expected[i], *case.input_set.bounds)
            kept = case.state_set.b - margin * sigma(case, age + 1)
            asking = cp.Problem(
                cp.Minimize(
                    cp.sum_squares(u - clipped)
                    + case.slack_linear * cp.sum(slack)
                    + case.slack_quadratic * cp.sum_squares(slack)
                ),
                [
                    case.state_set.c @ (plant.a @ x[i] + plant.b @ u) <= kept + slack,
                    case.input_set.c @ u <= case.input_set.b,
                ],
            )
            asking.solve(solver=cp.CLARABEL, tol_gap_abs=1e-9, tol_gap_rel=1e-9, tol_feas=1e-9)
            assert requested[i] == pytest.approx(u.value, abs=1e-3)
            shifted += bool(np.abs(requested[i] - clipped).max() > 1e-3)
    assert shifted


def test_without_limits_the_governor_is_the_regulator() -> None:
    case = unlimited(problem("paper"))
    newest, disturbances = arrivals(5, 30, 0.3, 2), noise(case, 5, 30, 3)
    outcome, reference = (
        flown(case, item, PAPER_START, newest, disturbances) for item in (Governor(case, 2.5), Lqg(case))
    )
    assert outcome.states == pytest.approx(reference.states, abs=1e-7)


def test_the_plans_of_the_mean_qp_keep_a_margin_that_grows_with_the_age() -> None:
    case, margin = problem("paper"), 2.0
    controller, plain = MeanQp(case, margin), PacketisedPredictive(case)
    information = Information(0, np.zeros(1, dtype=np.intp), PAPER_START[None], np.zeros((1, 0, 2)))
    for item in (controller, plain):
        item.begin(1)
        item.act(information)

    def left(item: PacketisedPredictive) -> Array:
        """What a plan leaves of the room of each row, in standard deviations (H, m)."""
        state, result = PAPER_START, []
        for t, u in enumerate(item._plans[0], start=1):
            state = case.plant.a @ state + case.plant.b @ u
            result.append(case.state_set.margin(state) / sigma(case, t))
        return np.array(result)

    assert left(controller).min() == pytest.approx(margin, abs=1e-6)  # a row binds
    assert left(plain).min() < 0.6 * margin


def test_a_larger_margin_breaks_fewer_limits_and_costs_more() -> None:
    case = problem("paper")
    newest, disturbances = arrivals(200, 30, 0.3, 8), noise(case, 200, 30, 9)
    for maker in (MeanQp, Governor):
        little, much = (flown(case, maker(case, item), PAPER_START, newest, disturbances) for item in (0.5, 3.0))
        assert much.state_violated.sum() < 0.3 * little.state_violated.sum()
        assert much.cost.sum() > little.cost.sum()
