"""MPC for the worst-case delay: its information and its back-offs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from baseline_rig import PAPER_START, Fed, arrivals, cube, flown, noise, problem, unlimited
from numpy.typing import NDArray

from uavctl.arrays import Array
from uavctl.errors import DesignError
from uavctl.smpc.baselines import Lqg, WorstCaseDelay, _backoffs, _prediction_gain
from uavctl.smpc.batch import Information
from uavctl.smpc.nominal import ControlProblem, lqr

DELAY = 4


def asked_in(case: ControlProblem, states: Array, newest: NDArray[np.intp], inputs: Array) -> Array:
    """Return the inputs of each step (T, n_u) along a given trajectory."""
    controller = WorstCaseDelay(case, DELAY, 1.0, 1.0)
    controller.begin(1)
    return np.array(
        [
            controller.act(Information(k, newest[k : k + 1], states[newest[k]][None].copy(), inputs[None, :k]))[0]
            for k in range(len(newest))
        ]
    )


def test_only_positions_older_than_the_delay_have_an_effect() -> None:
    case, rng = replace(problem("paper"), input_set=cube(2, 100.0)), np.random.default_rng(1)
    steps, newest = 12, arrivals(1, 12, 0.3, 2)[0]
    states, inputs = 3.0 * rng.normal(size=(steps, 4)), rng.normal(size=(steps, 2))
    known = asked_in(case, states, newest, inputs)
    for k in range(steps):
        other = states.copy()
        other[max(1, k - DELAY + 1) :] += 1.0  # younger than the delay in step k; x(0) is known from the start
        assert asked_in(case, other, newest, inputs)[k].tobytes() == known[k].tobytes()
        used = int(newest[: k + 1][newest[: k + 1] <= max(0, k - DELAY)].max())
        other = states.copy()
        other[used] += 0.1
        assert np.abs(asked_in(case, other, newest, inputs)[k] - known[k]).max() > 1e-6


def test_without_limits_it_is_the_regulator_on_the_delayed_prediction() -> None:
    """With all positions at once it flies like an LQG that gets them `DELAY` steps late."""
    case = unlimited(problem("paper"))
    steps, disturbances = 40, noise(case, 5, 40, 3)
    at_once = np.tile(np.arange(steps), (5, 1))
    late = np.maximum(at_once - DELAY, 0)
    result = flown(case, WorstCaseDelay(case, DELAY, 1.0, 1.0), PAPER_START, at_once, disturbances)
    expected = flown(case, Lqg(case), PAPER_START, late, disturbances)
    assert result.states == pytest.approx(expected.states, abs=1e-7)


def test_a_link_that_is_worse_gives_older_information() -> None:
    """A position that comes older than the delay is used at once."""
    case = unlimited(problem("paper"))
    k = lqr(case.plant, case.q_x, case.q_u).k
    fed = Fed(case, WorstCaseDelay(case, 2, 1.0, 1.0), PAPER_START)
    fed.step(0)
    fed.states[1] = np.ones(4)  # not where the prediction says it was: news, once it comes
    for newest in (0, 0, 0, 0, 1):
        requested = fed.step(newest)
    x = np.ones(4)
    for u in fed.inputs[0, 1:5]:
        x = case.plant.a @ x + case.plant.b @ u
    assert requested == pytest.approx(k @ x, abs=1e-9)


def test_back_offs_are_the_spread_of_the_delayed_loop() -> None:
    """Simulated: 40,000 plans of the same mean, each with its own unknown past."""
    case, runs, rng = problem("paper"), 40_000, np.random.default_rng(9)
    plant = case.plant
    backoff_x, backoff_u = _backoffs(case, DELAY, 1.0, 1.0)
    error = sum(power @ plant.e @ plant.w @ plant.e.T @ power.T for power in powers(plant.a, DELAY))
    step = np.linalg.matrix_power(plant.a, DELAY) @ plant.e
    k = _prediction_gain(case, np.asarray(error), step @ plant.w @ step.T, 1.0, 1.0)
    w = np.sqrt(0.6) * rng.standard_normal((DELAY + case.horizon, runs, 2))
    x, mean = np.zeros((runs, 4)), np.zeros((runs, 4))
    for past in w[:DELAY]:
        x = x @ plant.a.T + past @ plant.e.T
    for t in range(case.horizon):
        u = mean @ k.T
        assert backoff_x[t] == pytest.approx((x @ case.state_set.c.T).std(axis=0), rel=0.02)
        assert backoff_u[t] == pytest.approx((u @ case.input_set.c.T).std(axis=0), rel=0.02, abs=1e-12)
        x = x @ plant.a.T + u @ plant.b.T + w[DELAY + t] @ plant.e.T
        mean = mean @ plant.a.T + u @ plant.b.T + w[t] @ step.T
    assert np.all(np.diff(backoff_x, axis=0) >= 0.0)


def powers(a: Array, count: int) -> list[Array]:
    return [np.linalg.matrix_power(a, i) for i in range(count)]


def test_plans_keep_more_distance_from_the_limits_than_without_back_offs() -> None:
    case, runs = problem("paper"), 200
    newest, disturbances = arrivals(runs, 50, 0.3, 1), noise(case, runs, 50, 2)
    cautious, bold = (
        flown(case, WorstCaseDelay(case, DELAY, kappa, kappa), PAPER_START, newest, disturbances)
        for kappa in (2.5, 1e-9)
    )
    assert not cautious.input_violated.any()
    assert cautious.state_violated.mean() < 0.2 * bold.state_violated.mean()


@pytest.mark.parametrize(("state", "control"), [(2.0, 7.5), (20.0, 0.05)])
def test_a_delay_without_a_margin_is_refused(state: float, control: float) -> None:
    tight = replace(problem("paper"), state_set=cube(4, state), input_set=cube(2, control))
    with pytest.raises(DesignError, match="margin") as refused:
        WorstCaseDelay(tight, DELAY, 3.0, 2.0)
    assert refused.value.key == "smpc.tau"


@pytest.mark.parametrize("position_m", [50.0, 60.0])
def test_a_target_at_a_limit_or_beyond_leaves_no_margin(position_m: float) -> None:
    case = problem("paper")
    with pytest.raises(DesignError, match="margin"):
        WorstCaseDelay(replace(case, target=np.array([position_m, 0.0, 0.0, 0.0])), DELAY, 1.0, 1.0)


def test_no_delay_is_refused() -> None:
    with pytest.raises(DesignError, match="no delay"):
        WorstCaseDelay(problem("paper"), 0, 1.0, 1.0)
