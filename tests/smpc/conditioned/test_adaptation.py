"""Certificate, levels and loop: the risk follows the link and the disturbances as observed."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.stats import norm

from uavctl.arrays import Array
from uavctl.config.load import load_config
from uavctl.smpc.answer import Preview
from uavctl.smpc.conditioned import adaptation
from uavctl.smpc.conditioned.adaptation import AgeRecord, BudgetChoice, LoopState, charge_risk, count_age
from uavctl.smpc.conditioned.planner import ConditionedSolver, make_budget_choice
from uavctl.smpc.link import bernoulli
from uavctl.wiring.controller import build_problem

ALLOWED = 0.05
LOSS = 0.3


@pytest.fixture(scope="module")
def solver() -> ConditionedSolver:
    problem = build_problem(load_config("paper", ["smpc.scheme=age-conditioned", "target.position_m=[0, 19, 0]"]))
    return ConditionedSolver(
        problem, bernoulli(np.array([1.0 - LOSS])), ALLOWED, has_lower_levels=True, bounds_slack=False
    )


@pytest.fixture(scope="module")
def choice(solver: ConditionedSolver) -> BudgetChoice:
    return make_budget_choice(solver, ALLOWED)


def draw_ages(steps: int, loss: float, burst: float, seed: int) -> list[int]:
    """Ages, from 1 on, of a two-state link with runs of losses of a mean length."""
    rng, ages, age, is_bad = np.random.default_rng(seed), [], 1, False
    leave = 1.0 / burst if burst > 1.0 else 1.0 - loss
    enter = leave * loss / (1.0 - loss) if burst > 1.0 else loss
    for draw in rng.random(steps):
        is_bad = draw >= leave if is_bad else draw < enter
        ages.append(age)
        age = age + 1 if is_bad else 1
    return ages


def record_ages(ages: list[int], choice: BudgetChoice, record: AgeRecord | None = None) -> AgeRecord:
    record = record or AgeRecord()
    for age in ages:
        record = count_age(record, age, choice)
    return record


def test_the_certificate_keeps_the_allowed_risk_on_any_link(choice: BudgetChoice) -> None:
    for shares in np.random.default_rng(0).dirichlet(np.full(len(choice.shares), 0.3), 50):
        assert shares @ choice.budgets[0] <= ALLOWED + 1e-12


def test_each_level_keeps_the_allowed_risk_on_the_configured_link(
    solver: ConditionedSolver, choice: BudgetChoice
) -> None:
    for level in solver.levels:
        spent = level.near.risk.budgets @ choice.shares[:-1]
        assert spent <= ALLOWED * (1.0 + 1e-9)
        assert spent == pytest.approx(ALLOWED - choice.shares[-1], rel=1e-3)
    unscaled = [rank for rank, scale in enumerate(choice.scales) if scale == 1.0]
    assert [choice.levels[rank] for rank in unscaled] == [0, 1, 2]
    assert choice.budgets[unscaled] @ choice.shares == pytest.approx(ALLOWED, rel=1e-3)


def test_scaled_budgets_are_the_risk_of_rows_with_scaled_back_offs(choice: BudgetChoice) -> None:
    """However rows share a budget, they keep no more of it than one row alone."""
    rng = np.random.default_rng(1)
    for budget, scale in zip(rng.uniform(0.001, 0.5, 200), rng.uniform(1.0, 2.2, 200), strict=True):
        (left,) = adaptation.scale_budgets(np.array([budget]), scale)
        assert left == pytest.approx(norm.sf(scale * norm.isf(budget)), rel=1e-9)
        shares = rng.dirichlet(np.ones(3)) * budget
        assert norm.sf(scale * norm.isf(shares)).sum() <= left * (1.0 + 1e-9)
    assert adaptation.scale_budgets(np.array([0.7, 1.0]), 2.0).tolist() == [0.7, 1.0]


def test_higher_levels_give_old_information_more_and_cost_less(solver: ConditionedSolver, choice: BudgetChoice) -> None:
    oldest = np.array([level.near.risk.budgets[-1] for level in solver.levels])
    assert (np.diff(oldest) > 0.0).all()
    for level in (1, 2):
        ranks = [rank for rank, own in enumerate(choice.levels) if own == level]
        assert (np.diff(choice.budgets[ranks, -2]) > 0.0).all()
        assert (np.diff([choice.scales[rank] for rank in ranks]) < 0.0).all()
    state = np.array([0.0, 0.0, 17.0, 0.0])
    target = solver.problem.target
    costs = [solver.solve(0, state, target, Preview(level=level)).cost for level in range(len(solver.levels))]
    assert costs[-1] < costs[0]


def test_without_a_level_a_plan_is_that_of_the_configured_link(solver: ConditionedSolver) -> None:
    state, target = np.array([0.0, 0.0, 17.0, 0.0]), solver.problem.target
    plain = ConditionedSolver(solver.problem, bernoulli(np.array([1.0 - LOSS])), ALLOWED, bounds_slack=False)
    assert plain.solve(0, state, target).inputs.tobytes() == solver.solve(0, state, target).inputs.tobytes()


def test_no_data_are_the_certificate_and_a_long_matching_record_gives_most(choice: BudgetChoice) -> None:
    assert AgeRecord().rank == 0
    assert record_ages(draw_ages(20, LOSS, 1.0, 1), choice).rank < len(choice.budgets) - 1
    assert record_ages(draw_ages(3000, LOSS, 1.0, 1), choice).rank == len(choice.budgets) - 1


@pytest.mark.parametrize(("loss", "burst"), [(0.3, 3.0), (0.3, 10.0), (0.6, 1.0), (0.8, 10.0)])
def test_a_link_that_differs_keeps_the_allowed_risk(choice: BudgetChoice, loss: float, burst: float) -> None:
    ages = draw_ages(40_000, loss, burst, 2)
    shares = np.bincount(np.minimum(ages, len(choice.shares)) - 1, minlength=len(choice.shares)) / len(ages)
    for seed in range(5):
        rank = record_ages(draw_ages(1000, loss, burst, seed), choice).rank
        assert shares @ choice.budgets[rank] <= ALLOWED * (1.0 + adaptation.END_TOLERANCE)
        assert rank > 0


def test_a_link_that_changes_takes_the_budgets_back(choice: BudgetChoice) -> None:
    record = record_ages(draw_ages(3000, LOSS, 1.0, 3), choice)
    assert record.rank == len(choice.budgets) - 1
    record = record_ages(draw_ages(200, 0.6, 1.0, 3), choice, record)
    assert record.contradicts
    assert choice.scales[record.rank] > 1.2 or record.rank == 0
    assert not record_ages(draw_ages(3000, LOSS, 1.0, 4), choice, record).contradicts


def test_bounds_hold_the_true_shares_as_often_as_they_state(choice: BudgetChoice) -> None:
    """Each bound separately, without the configured link."""
    shares = choice.shares
    missed = np.zeros((2, 4))
    for seed in range(200):
        counts = np.bincount(draw_ages(400, LOSS, 1.0, seed), minlength=40)[1 : len(shares) + 1].astype(float)
        lower, upper = adaptation.bound_shares(counts, shares, contradicts=True)
        missed += shares[:4] < lower[:4], shares[:4] > upper[:4]
    assert (missed / 200 <= 2.0 * (1.0 - adaptation.CONFIDENCE)).all()


def simulate_loop(risk_of_widening: float, steps: int) -> tuple[LoopState, float]:
    """Run the loop against a risk that falls with f, without noise; return its state and the mean risk."""
    state, total = LoopState(), 0.0
    for _ in range(steps):
        risk = min(1.0, risk_of_widening / state.widening**3)
        total += risk
        state = charge_risk(state, risk, ALLOWED, keeps_away=True, is_behind_horizon=False)
    return state, total / steps


@pytest.mark.parametrize("risk", [0.03, 0.1, 0.3])
def test_the_loop_brings_the_mean_risk_to_the_allowed_one(risk: float) -> None:
    state, mean = simulate_loop(risk, 6000)
    span = math.log(adaptation.MAX_WIDENING / adaptation.MIN_WIDENING)
    assert mean <= ALLOWED * (adaptation.TARGET + span / (adaptation.GAIN * 6000))
    assert risk / state.widening**3 == pytest.approx(adaptation.TARGET * ALLOWED, rel=0.1)


def test_any_sequence_of_risks_keeps_the_bound_of_the_mean_below_saturation() -> None:
    rng, state = np.random.default_rng(5), LoopState(steps=10**6)
    span, total = math.log(adaptation.MAX_WIDENING / adaptation.MIN_WIDENING), 0.0
    for step in range(1, 5001):
        # The worst sequence: outside whenever the loop would not saturate by it
        risk = float(state.log_widening < 1.3 and rng.random() < 0.5)
        total += risk
        state = charge_risk(state, risk, ALLOWED, keeps_away=True, is_behind_horizon=False)
        assert not state.is_saturated
        assert total / step <= ALLOWED * (adaptation.TARGET + span / (adaptation.GAIN * step))


def test_the_loop_saturates_where_nothing_helps() -> None:
    state = LoopState()
    for _ in range(500):
        state = charge_risk(state, 0.5, ALLOWED, keeps_away=True, is_behind_horizon=False)
    assert state.is_saturated
    assert state.widening == adaptation.MAX_WIDENING


def test_scale_and_loop_together_take_little_from_the_back_offs() -> None:
    state = LoopState(steps=10**6)
    for _ in range(5000):
        state = charge_risk(state, 0.0, ALLOWED, keeps_away=True, is_behind_horizon=False)
    assert state.widening == adaptation.MIN_WIDENING
    assert adaptation.combine_widenings(1.0, state) == adaptation.MIN_TOTAL_WIDENING
    assert adaptation.combine_widenings(2.0, state) == pytest.approx(1.0)


def test_safe_steps_far_from_limits_lower_f_to_one_and_no_further() -> None:
    state = charge_risk(LoopState(), 1.0, ALLOWED, keeps_away=False, is_behind_horizon=False)
    assert state.widening > 1.0
    for _ in range(1000):
        state = charge_risk(state, 0.0, ALLOWED, keeps_away=False, is_behind_horizon=False)
    assert state.log_widening == 0.0


def test_the_loop_begins_faster_beside_a_limit_only() -> None:
    full = (1.0 / ALLOWED) - adaptation.TARGET
    for keeps_away, gain in ((False, adaptation.GAIN), (True, 1.0 / adaptation.FIRST_STEPS)):
        state = charge_risk(LoopState(), 1.0, ALLOWED, keeps_away=keeps_away, is_behind_horizon=False)
        assert state.log_widening == pytest.approx(gain * full)


@pytest.mark.parametrize("factor", [0.5, 1.0, 1.5])
def test_the_spread_follows_innovations_and_one_wrong_position_hardly_moves_it(factor: float) -> None:
    rng, state = np.random.default_rng(4), adaptation.SpreadState()
    assert state.spread == 1.0
    for _ in range(2000):
        variances = rng.choice([0.01, 0.09], size=3)
        innovations = factor * np.sqrt(variances) * rng.standard_normal(3)
        state = adaptation.count_innovation(state, innovations.tolist(), variances.tolist())
    assert state.spread == pytest.approx(factor, rel=0.1)
    after = adaptation.count_innovation(adaptation.SpreadState(1.0, 1.0), [1e6], [1.0])
    assert after.spread**2 == pytest.approx(1.0 + 15.0 * adaptation.SPREAD_GAIN)


def test_risk_in_a_silence_moves_the_end_of_plans_alone_and_is_forgotten_without_one() -> None:
    begin = LoopState()
    quiet = silent = begin
    for _ in range(50):
        quiet = charge_risk(quiet, 0.2, ALLOWED, keeps_away=True, is_behind_horizon=False)
        silent = charge_risk(silent, 0.2, ALLOWED, keeps_away=True, is_behind_horizon=True)
    assert quiet.widening == silent.widening
    assert quiet.silence_widening < begin.silence_widening < silent.silence_widening
    for _ in range(5000):
        silent = charge_risk(silent, 0.0, ALLOWED, keeps_away=True, is_behind_horizon=True)
    assert silent.silence_widening == 1.0


def test_the_end_of_a_plan_alone_keeps_away_for_a_silence(solver: ConditionedSolver) -> None:
    state, target, age = np.array([0.0, 0.0, 17.0, 0.0]), solver.problem.target, 2
    near, far = (
        solver.solve(0, state, target, Preview(level=0, age=age, silence_widening=factor)).backoff_x
        for factor in (1.0, 2.0)
    )
    begins = len(near) - 1 - age
    east = solver.problem.state_set.c[:, 2] > 0.0
    assert (far[begins:, east] > 1.5 * near[begins:, east]).all()


def test_a_wider_spread_keeps_further_away(solver: ConditionedSolver) -> None:
    state, target = np.array([0.0, 0.0, 17.0, 0.0]), solver.problem.target

    def furthest_east(widening: float) -> float:
        states: Array = solver.solve(0, state, target, Preview(widening=widening)).states
        return float(states[:, 2].max())

    assert furthest_east(1.5) < furthest_east(1.0)


def test_the_risk_of_a_step_adds_its_rows_and_counts_a_wider_spread() -> None:
    margins, variances = np.array([1.0, 2.0, np.inf]), np.ones(3)
    risk = adaptation.compute_outside_risk(margins, variances, 1.0)
    assert risk == pytest.approx(0.158655 + 0.022750, abs=1e-6)
    assert adaptation.compute_outside_risk(margins, variances, 2.0) > risk
    assert adaptation.compute_outside_risk(margins, variances, 0.8) == risk
    assert adaptation.compute_outside_risk(np.array([-1.0]), np.zeros(1), 1.0) == 1.0
