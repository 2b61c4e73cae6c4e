"""Distances of resting plans from a limit: against drawn starts of new plans, and in closed loop."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import campaign_rig as rig
import numpy as np
import pytest
from baseline_rig import problem
from scipy.stats import norm

from uavctl.arrays import Array
from uavctl.lab.campaign.tasks import Cell, make_tasks
from uavctl.smpc.conditioned.backoffs import SLACK_SHARE, RestingRows, allocate_by_age, compute_quantile
from uavctl.smpc.conditioned.planner import ConditionedSolver
from uavctl.smpc.conditioned.program import SlewRows
from uavctl.smpc.estimate import innovation_form
from uavctl.smpc.link import AgeModel, bernoulli, gilbert_elliott
from uavctl.smpc.nominal import propagate_covariance

ALLOWED = 0.05
EAST = np.array([[0.0, 0.0, 1.0, 0.0]])  # its upper limit


def steps_for(loss: float) -> int:
    return 56 if loss > 0.8 else 24


def distances(
    link: AgeModel,
    steps: int,
    cov: Array | None = None,
    slew_mps3: float = np.inf,
    most: int = 1,
    *,
    bounds_slack: bool = True,
) -> Array:
    case = replace(problem("paper"), horizon=steps)
    deviations = np.sqrt([EAST[0] @ item @ EAST[0] for item in propagate_covariance(case.plant, steps)[1:]])
    risk = allocate_by_age(link, deviations, ALLOWED, n_binding=2)
    slew = SlewRows(case.plant, case.input_set, slew_mps3)
    return RestingRows(case, slew, EAST, cov).find_distances(risk, ALLOWED, most, bounds_slack=bounds_slack)


@pytest.mark.parametrize("loss", [0.1, 0.3, 0.6, 0.9])
@pytest.mark.parametrize("noisy", [False, True])
def test_the_share_of_new_plans_with_slack_is_the_design_share(loss: float, noisy: bool) -> None:
    """Gaps, positions and a full brake are drawn and simulated, and each stage is compared with its back-off."""
    steps, rng, draws = steps_for(loss), np.random.default_rng(8), 40_000
    case = replace(problem("paper"), horizon=steps)
    plant = case.plant
    cov = innovation_form(plant, 0.1, 0.0, 0).estimate_cov if noisy else np.zeros((4, 4))
    (d,) = distances(bernoulli(np.array([1.0 - loss])), steps, cov)[0]
    risk = allocate_by_age(bernoulli(np.array([1.0 - loss])), sigma(steps, np.zeros((4, 4))), ALLOWED, n_binding=2)
    backoff = compute_quantile(risk.row_budgets) * sigma(steps, cov)
    gap = np.minimum(rng.geometric(1.0 - loss, draws), steps)
    spread = propagate_covariance(plant, steps, cov) - cov
    state = np.zeros((draws, 4))
    for t in np.unique(gap):
        values, vectors = np.linalg.eigh(spread[t])
        selected = gap == t
        state[selected] = (rng.normal(size=(selected.sum(), 4)) * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
    room = np.maximum(d, backoff[gap - 1])
    over = np.zeros(draws, dtype=bool)
    for s in range(steps):
        state = state @ plant.a.T + np.array([0.0, case.input_set.bounds[0][1]]) @ plant.b.T
        over |= state[:, 2] > room - backoff[s]
    share = over.mean()
    error = 5.0 * np.sqrt(share / draws)
    resting = float(risk.age_probabilities @ norm.cdf(-d / sigma(steps, cov)))
    if resting < 0.99 * (ALLOWED - risk.older_probability):  # it is the slack that asks for the distance
        # Stages together leave more often than the worst of each gap alone, by a little.
        assert SLACK_SHARE * ALLOWED - error < share < 1.15 * SLACK_SHARE * ALLOWED + error
    else:
        assert resting == pytest.approx(ALLOWED - risk.older_probability, rel=1e-6)
        assert share < SLACK_SHARE * ALLOWED + error


def sigma(steps: int, cov: Array) -> Array:
    """Deviations (H,) of the row in the stages of a plan."""
    return np.sqrt([EAST[0] @ item @ EAST[0] for item in propagate_covariance(problem("paper").plant, steps, cov)[1:]])


def test_in_bursts_rest_at_all_ages_is_outside_as_often_as_allowed() -> None:
    link = gilbert_elliott(enter=1.0 / 7.0, leave=1.0 / 3.0, good_loss=0.0, bad_loss=1.0)
    (d,) = distances(link, 20)[0]
    risk = allocate_by_age(link, sigma(20, np.zeros((4, 4))), ALLOWED, n_binding=2)
    assert risk.age_probabilities @ norm.cdf(-d / sigma(20, np.zeros((4, 4)))) == pytest.approx(
        ALLOWED - risk.older_probability, rel=1e-6
    )


@pytest.mark.parametrize("loss", [0.3, 0.6])
def test_without_a_bound_on_slack_only_rest_at_all_ages_counts(loss: float) -> None:
    link, steps = bernoulli(np.array([1.0 - loss])), steps_for(loss)
    (d,) = distances(link, steps, bounds_slack=False)[0]
    risk = allocate_by_age(link, sigma(steps, np.zeros((4, 4))), ALLOWED, n_binding=2)
    outside = float(risk.age_probabilities @ norm.cdf(-d / sigma(steps, np.zeros((4, 4)))))
    assert outside == pytest.approx(ALLOWED - risk.older_probability, rel=1e-6)
    assert d < distances(link, steps)[0, 0]


def test_sharing_estimate_errors_and_a_slow_gate_need_more_distance() -> None:
    link, plant = bernoulli(np.array([0.7])), problem("paper").plant
    (single,), (shared,) = distances(link, 16, most=2)
    (unsure,) = distances(link, 16, innovation_form(plant, 0.1, 0.0, 0).estimate_cov)[0]
    (slow,) = distances(link, 16, slew_mps3=0.9)[0]
    assert shared > single + 0.3
    assert unsure > single + 0.2
    assert slow > single + 0.1


def test_late_positions_are_counted_from_their_capture() -> None:
    """With positions always a step late, a plan starts from the state of the step before."""
    case = problem("paper")

    class Late:
        """A link on which every position is known one step later; 30 % are lost."""

        def __init__(self) -> None:
            self._on_time = bernoulli(np.array([0.7]))

        def outage(self, age: int) -> float:
            return self._on_time.outage(age - 1) if age else 1.0

    risk = allocate_by_age(Late(), sigma(case.horizon, np.zeros((4, 4))), ALLOWED, n_binding=2)
    rows = RestingRows(case, SlewRows(case.plant, case.input_set, np.inf), EAST, None)
    late = rows.find_distances(risk, ALLOWED, 1)[0, 0]
    on_time = distances(bernoulli(np.array([0.7])), case.horizon)[0, 0]
    assert on_time + 0.5 < late < on_time + 3.0


def test_both_sides_of_a_box_are_equal_and_undisturbed_rows_need_no_distance() -> None:
    case = problem("paper")
    solver = ConditionedSolver(case, bernoulli(np.array([0.7])), ALLOWED)
    positions = np.any(case.state_set.c[:, [0, 2]] != 0.0, axis=1)
    kept = (case.state_set.b - solver.compute_reference_limits())[positions]
    assert kept == pytest.approx(kept[0], rel=1e-9) and kept[0] > 1.0
    still = replace(case, plant=replace(case.plant, w=np.zeros((2, 2))))
    calm = ConditionedSolver(still, bernoulli(np.array([0.7])), ALLOWED)
    assert calm.compute_reference_limits() == pytest.approx(case.state_set.b)


CORNER = 'set = ["target.position_m=[49, 19, 0]"]\nruns = 300\nsteps = 50\nstart = [46, 0, 17, 0]\n'


def corner(tmp_path: Path, loss: float, steps: int) -> Cell:
    outcome = rig.controller("smpc", f'set = ["smpc.scheme=age-conditioned", "smpc.horizon={steps}"]')
    (made,) = rig.cells(tmp_path, CORNER, outcome, rig.table("link", "lossy", f'set = ["link.loss={loss}"]'))
    return made


@pytest.mark.long
@pytest.mark.parametrize(("loss", "steps"), [(0.1, 12), (0.8, 32), (0.9, 56)])
def test_a_corner_uses_at_least_half_of_the_allowed_risk(tmp_path: Path, loss: float, steps: int) -> None:
    """Settled steps outside, by their mean over runs and four of its standard errors; and plans with slack."""
    (task,) = make_tasks([corner(tmp_path, loss, steps)])
    result = task.fly()
    assert not any(result["error"])
    rate = np.asarray(result["outside"])[:, 25:].mean(axis=1)
    error = 4.0 * rate.std() / np.sqrt(len(rate))
    assert rate.mean() - error < ALLOWED
    assert rate.mean() + error > 0.5 * ALLOWED
    assert rate.mean() > 0.4 * ALLOWED
    assert result["slack_used"].sum() < ALLOWED * result["decisions"].sum()
