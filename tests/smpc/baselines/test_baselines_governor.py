"""The governor and the mean QP: what they keep, and where they are the regulator."""

from __future__ import annotations

import cvxpy as cp
import numpy as np
import pytest
from baseline_rig import PAPER_START, arrivals, flown, noise, problem, unlimited

from uavctl.arrays import Array
from uavctl.smpc.baselines import Governor, Lqg, MeanQp, PacketisedPredictive
from uavctl.smpc.batch import Information, predict
from uavctl.smpc.nominal import ControlProblem, lqr


def sigma(given: ControlProblem, steps: int) -> Array:
    """Standard deviation (m,) of each row after so many steps without a position."""
    plant, cov = given.plant, np.zeros((given.plant.n_x, given.plant.n_x))
    for _ in range(steps):
        cov = plant.a @ cov @ plant.a.T + plant.e @ plant.w @ plant.e.T
    return np.asarray(np.sqrt(np.diagonal(given.state_set.c @ cov @ given.state_set.c.T)))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["paper", "room-hahn-stursberg"])
def test_the_governor_keeps_the_next_mean_its_margin_and_is_as_near_to_the_regulator_as_that_allows(name: str) -> None:
    given, rng = problem(name, slack_linear=1e3, slack_quadratic=10.0), np.random.default_rng(4)
    plant, controller, margin = given.plant, Governor(given, 2.5), 2.5
    low, high = (np.where(np.isfinite(side), side, 0.0) for side in given.state_set.bounds)
    moved = 0
    for age in (0, 0, 1, 3, 0, 2, 0, 1):
        states = rng.uniform(0.95 * low, 0.95 * high, (20, plant.n_x))
        inputs = 0.1 * rng.normal(size=(20, 5, plant.n_u))
        information = Information(5, np.full(20, 5 - age), states, inputs)
        asked, x = controller.act(information), predict(plant, information)
        wanted = given.u_target + (x - given.target) @ lqr(plant, given.q_x, given.q_u).k.T
        for i in range(0, 20, 4):
            u, slack = cp.Variable(plant.n_u), cp.Variable(given.state_set.b.size, nonneg=True)
            clipped = np.clip(wanted[i], *given.input_set.bounds)
            kept = given.state_set.b - margin * sigma(given, age + 1)
            asking = cp.Problem(
                cp.Minimize(
                    cp.sum_squares(u - clipped)
                    + given.slack_linear * cp.sum(slack)
                    + given.slack_quadratic * cp.sum_squares(slack)
                ),
                [
                    given.state_set.c @ (plant.a @ x[i] + plant.b @ u) <= kept + slack,
                    given.input_set.c @ u <= given.input_set.b,
                ],
            )
            asking.solve(solver=cp.CLARABEL, tol_gap_abs=1e-9, tol_gap_rel=1e-9, tol_feas=1e-9)
            assert asked[i] == pytest.approx(u.value, abs=1e-3)
            moved += bool(np.abs(asked[i] - clipped).max() > 1e-3)
    assert moved


def test_without_limits_the_governor_is_the_regulator() -> None:
    given = unlimited(problem("paper"))
    newest, disturbances = arrivals(5, 30, 0.3, 2), noise(given, 5, 30, 3)
    ours, theirs = (flown(given, one, PAPER_START, newest, disturbances) for one in (Governor(given, 2.5), Lqg(given)))
    assert ours.states == pytest.approx(theirs.states, abs=1e-7)


def test_the_plans_of_the_mean_qp_keep_a_margin_that_grows_with_the_age() -> None:
    given, margin = problem("paper"), 2.0
    controller, plain = MeanQp(given, margin), PacketisedPredictive(given)
    information = Information(0, np.zeros(1, dtype=np.intp), PAPER_START[None], np.zeros((1, 0, 2)))
    for one in (controller, plain):
        one.begin(1)
        one.act(information)

    def left(one: PacketisedPredictive) -> Array:
        """What a plan leaves of the room of each row, in standard deviations (H, m)."""
        state, found = PAPER_START, []
        for t, u in enumerate(one._plans[0], start=1):
            state = given.plant.a @ state + given.plant.b @ u
            found.append(given.state_set.margin(state) / sigma(given, t))
        return np.array(found)

    assert left(controller).min() == pytest.approx(margin, abs=1e-6)  # a row binds
    assert left(plain).min() < 0.6 * margin


def test_a_larger_margin_breaks_fewer_limits_and_costs_more() -> None:
    given = problem("paper")
    newest, disturbances = arrivals(200, 30, 0.3, 8), noise(given, 200, 30, 9)
    for maker in (MeanQp, Governor):
        little, much = (flown(given, maker(given, one), PAPER_START, newest, disturbances) for one in (0.5, 3.0))
        assert much.state_violated.sum() < 0.3 * little.state_violated.sum()
        assert much.cost.sum() > little.cost.sum()
