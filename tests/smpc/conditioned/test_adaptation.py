"""Certificate, link and loop: the risk follows the link and the disturbances as observed."""

from __future__ import annotations

import math

import numpy as np
import pytest

from uavctl.arrays import Array
from uavctl.config.load import load_config
from uavctl.smpc.answer import Preview, QuestionError
from uavctl.smpc.conditioned import adaptation
from uavctl.smpc.conditioned.adaptation import AgeRecord, LoopState, charge_risk, count_age
from uavctl.smpc.conditioned.planner import ConditionedSolver
from uavctl.smpc.conditioned.reference import CERTIFICATE_LEVEL, get_link
from uavctl.smpc.link import bernoulli
from uavctl.wiring.controller import build_problem

ALLOWED = 0.05
LOSS = 0.3


@pytest.fixture(scope="module")
def solver() -> ConditionedSolver:
    problem = build_problem(load_config("paper", ["smpc.scheme=age-conditioned", "target.position_m=[0, 19, 0]"]))
    return ConditionedSolver(
        problem, bernoulli(np.array([1.0 - LOSS])), ALLOWED, has_observed_levels=True, bounds_slack=False
    )


@pytest.fixture(scope="module")
def shares(solver: ConditionedSolver) -> Array:
    return solver.age_shares


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


def record_ages(ages: list[int], shares: Array, record: AgeRecord | None = None) -> AgeRecord:
    record = record or AgeRecord()
    for age in ages:
        record = count_age(record, age, shares)
    return record


def get_observed_link(record: AgeRecord) -> tuple[float, float]:
    return get_link(record.level)


def test_the_certificate_keeps_the_allowed_risk_on_any_link(solver: ConditionedSolver) -> None:
    budgets = solver.select_risk(solver.problem.target, Preview(level=CERTIFICATE_LEVEL)).budgets
    for shares in np.random.default_rng(0).dirichlet(np.full(len(budgets), 0.3), 50):
        assert shares @ budgets <= ALLOWED + 1e-12


def test_without_a_level_a_plan_is_that_of_the_configured_link(solver: ConditionedSolver) -> None:
    state, target = np.array([0.0, 0.0, 17.0, 0.0]), solver.problem.target
    plain = ConditionedSolver(solver.problem, bernoulli(np.array([1.0 - LOSS])), ALLOWED, bounds_slack=False)
    assert plain.solve(0, state, target).inputs.tobytes() == solver.solve(0, state, target).inputs.tobytes()
    with pytest.raises(QuestionError, match="level"):
        plain.solve(0, state, target, Preview(level=1))


def test_a_record_begins_with_the_certificate(shares: Array) -> None:
    assert AgeRecord().level == CERTIFICATE_LEVEL
    assert record_ages(draw_ages(adaptation.REVIEW_STEPS - 1, LOSS, 1.0, 1), shares).level == CERTIFICATE_LEVEL


@pytest.mark.parametrize(
    ("loss", "burst"),
    [
        *[(0.1, 1.0), (0.3, 3.0), (0.8, 10.0)],
        *(pytest.param(*link, marks=pytest.mark.slow) for link in [(0.3, 1.0), (0.6, 1.0), (0.6, 5.0)]),
    ],
)
def test_bounds_of_a_long_record_are_above_the_link_and_near_it(shares: Array, loss: float, burst: float) -> None:
    first_loss = loss if burst == 1.0 else loss / (burst * (1.0 - loss))
    continuation = loss if burst == 1.0 else 1.0 - 1.0 / burst
    bounds = np.array(
        [adaptation.bound_link(record_ages(draw_ages(1500, loss, burst, seed), shares).counts) for seed in range(30)]
    )
    for found, true in zip(bounds.T, (first_loss, continuation), strict=True):
        odds, true_odds = found / (1.0 - found), true / (1.0 - true)
        assert np.mean(found >= true) > 0.7  # one standard deviation: 84 %
        assert 1.0 < np.median(odds) / true_odds < 2.0


def test_few_steps_of_a_good_link_do_not_rule_out_long_runs(shares: Array) -> None:
    _, continuation = adaptation.bound_link(record_ages([1] * 30, shares).counts)
    assert continuation > 0.8


def test_a_record_follows_a_link_that_changes(shares: Array) -> None:
    before = record_ages(draw_ages(3000, LOSS, 1.0, 3), shares)
    after = record_ages(draw_ages(500, 0.6, 1.0, 3), shares, before)
    assert get_observed_link(before) == (0.3, 0.3)
    assert min(get_observed_link(after)) >= 0.55
    assert get_observed_link(record_ages(draw_ages(2000, LOSS, 1.0, 4), shares, after)) == (0.3, 0.3)


def test_positions_that_are_late_are_no_losses(shares: Array) -> None:
    late = [age + 2 for age in draw_ages(3000, LOSS, 1.0, 3)]
    assert get_observed_link(record_ages(late, shares)) == (0.3, 0.3)


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


def test_quiet_steps_alone_take_no_more_than_a_bounded_share_of_the_distances() -> None:
    state = LoopState(steps=10**6)
    for _ in range(5000):
        state = charge_risk(state, 0.0, ALLOWED, keeps_away=True, is_behind_horizon=False)
    assert state.widening == adaptation.MIN_WIDENING


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
    assert adaptation.compute_outside_risk(margins, variances, 0.9) < risk
    least = adaptation.compute_outside_risk(margins, variances, adaptation.MIN_SPREAD)
    assert adaptation.compute_outside_risk(margins, variances, 0.1) == least
    assert adaptation.compute_outside_risk(np.array([-1.0]), np.zeros(1), 1.0) == 1.0
