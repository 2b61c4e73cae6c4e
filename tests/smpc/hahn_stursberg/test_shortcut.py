"""Decisions in flight: the exact optimum, feasible for the full problem, the same bits, no exceptions."""

from __future__ import annotations

from collections import Counter
from functools import cache

import numpy as np
import pytest
from full_problem import gains, margins
from question_rig import (
    EACH_PRESET,
    KEPT_TOLERANCE,
    KINDS,
    PRESETS,
    Asked,
    all_kinds,
    case,
    flown,
    hard_questions,
    limits,
    mean_optimum,
    near,
    small,
)

from uavctl.records import SolveStatus
from uavctl.smpc.answer import Answer, Path, Preview
from uavctl.smpc.hahn_stursberg.design import Design
from uavctl.smpc.hahn_stursberg.exact import ConicSolver, find_relaxed
from uavctl.smpc.hahn_stursberg.mean import RowKind
from uavctl.smpc.hahn_stursberg.shortcut import ShortcutSolver

OK = SolveStatus.OPTIMAL


@cache
def exact_solver(name: str) -> ConicSolver:
    return ConicSolver(case(name).design)


@cache
def answered(name: str) -> list[tuple[Asked, Answer, Answer]]:
    """Questions of every kind with the answer as flown and the exact program's."""
    tested, exact = case(name), exact_solver(name)
    return [
        (ask, tested.solver.solve(7, ask.x, ask.target, ask.preview), exact.solve(7, ask.x, ask.target, ask.preview))
        for ask in all_kinds(tested.design, 41, 10)
    ]


@pytest.mark.slow
@pytest.mark.parametrize("name", EACH_PRESET)
def test_frozen_answers_are_the_exact_program_s(name: str) -> None:
    """Answers on random questions of every kind; with the frozen policy refused, they are the exact program's bits."""
    tested, methods = case(name), Counter[str]()
    for _, answer, exact in answered(name):
        assert (answer.seq, answer.status) == (7, OK)
        methods[answer.method] += 1
        size = max(1.0, abs(exact.cost))
        assert exact.cost_lower - 1e-7 * size <= answer.cost <= exact.cost + 1e-7 * size
        assert answer.cost_lower <= exact.cost + 1e-7 * size
        assert answer.gap == (answer.cost - answer.cost_lower) / max(1e-6, abs(answer.cost))
        for part in tested.components:
            most = np.abs(part.b_u).max()
            if answer.terminal_miss == 0.0:
                assert answer.inputs[:, part.inputs] == pytest.approx(exact.inputs[:, part.inputs], abs=2e-3 * most)
        if answer.method == "frozen":
            assert answer.gap < 1e-7
            assert (answer.slack, answer.terminal_miss, answer.relaxed) == (0.0, 0.0, ())
            assert answer.reference == pytest.approx(exact.reference, abs=1e-3)
    assert min(methods["frozen"], methods["exact"]) >= 10


@pytest.mark.parametrize("name", PRESETS)
def test_near_the_target_it_is_nearly_always_accepted(name: str) -> None:
    tested, rng = case(name), np.random.default_rng(32)
    # A third of a standard deviation: no limit but the pinned one is in the way.
    states = [tested.design.target + (near(tested.design, rng) - tested.design.target) / 3.0 for _ in range(50)]
    methods = [tested.solver.solve(0, x, tested.design.target).method for x in states]
    assert methods.count("frozen") == 50


@pytest.mark.long
@pytest.mark.parametrize("name", EACH_PRESET)
def test_a_refused_frozen_policy_costs_more_than_the_optimum(name: str) -> None:
    """Without the KKT test wrong answers would pass."""
    tested = case(name)
    refused = [
        result for result in answered(name) if result[1].method != "frozen" and result[2].terminal_miss < KEPT_TOLERANCE
    ]
    dearer = 0
    for ask, _, exact in refused[:25]:
        cost = 0.0
        for i, policy in enumerate(tested.policies):
            problem, backoff = tested.problems[i], tested.problems[i].backoff.copy()
            backoff[problem.gain_rows] = policy.backoff * (1.0 - 1e-9)
            question = tested.question(i, ask.x, ask.target, ask.preview)
            cost += policy.cost + mean_optimum(problem, question, backoff)
        assert cost >= exact.cost_lower - 1e-6 * max(1.0, abs(exact.cost))
        dearer += cost > exact.cost * (1.0 + 1e-5)
    assert dearer > 10


def independent_cost(design: Design, name: str, ask: Asked, answer: Answer, covariance: float) -> float:
    """Objective from the answer's own plan: stage costs of the means, the covariances' cost, the penalties."""
    free = design.horizon - design.terminal.tau
    rest = np.zeros(design.plant.n_u)
    path_x, path_u = np.zeros((free, design.plant.n_x)), np.zeros((free, design.plant.n_u))
    if ask.preview.path is not None:
        path_x, path_u = ask.preview.path.states[:free], ask.preview.path.inputs[:free]
    cost, slacks = covariance + design.offset_weight * answer.offset, 0.0
    for t in range(free):
        x, u = answer.states[t] - answer.reference - path_x[t], answer.inputs[t] - rest - path_u[t]
        cost += float(x @ design.q_x @ x + u @ design.q_u @ u)
    limits = np.tile(design.state_set.b, (design.horizon + 1, 1)) if ask.preview.limits is None else ask.preview.limits
    outside = answer.states @ design.state_set.c.T + answer.backoff_x - limits
    for problem, part in zip(case(name).problems, case(name).components, strict=True):
        for row in problem.rows:
            if row.kind is RowKind.STATE:
                sides = [outside[row.t, part.rows_x[side]] for side in (row.upper, row.lower) if side >= 0]
                slack = max(0.0, *sides)
                cost += design.slack_linear * slack + design.slack_quadratic * slack**2
                slacks += slack
    assert answer.slack == pytest.approx(slacks, abs=1e-5)
    return cost


@pytest.mark.parametrize("name", EACH_PRESET)
def test_the_policy_flown_keeps_every_constraint_of_the_full_problem(name: str) -> None:
    """(19) from M: tightened rows of all stages, the terminal condition with all disturbances, rest from N on."""
    tested = case(name)
    design, checked = tested.design, Counter[str]()
    for ask, answer, exact in answered(name):
        assert (answer.terminal_miss > KEPT_TOLERANCE) == (exact.terminal_miss > KEPT_TOLERANCE)
        if answer.terminal_miss > KEPT_TOLERANCE:
            continue  # from there nothing keeps all of (19)
        thetas = flown(tested, ask, answer)
        m = gains(design, [theta[None] for theta in thetas])
        result = margins(design, m, ask.x[None], answer.inputs[None], answer.reference[None], ask.preview.limits)
        worst = {
            "input": result.inputs.min(),
            "place": result.place.min(),
            "hold": result.hold.min(),
            "rest": result.rest.min(),
            "state": -np.maximum(-result.state, 0.0).sum() + answer.slack,
            "terminal": 10.0 * result.lmi().min(),  # -1e-7 of its size
        }
        assert {row: margin for row, margin in worst.items() if margin < -KEPT_TOLERANCE} == {}
        # Where a gain is zero but for rounding, the norm is that rounding's root.
        assert answer.backoff_x == pytest.approx(result.backoff_x[0], abs=1e-7)
        assert answer.backoff_u == pytest.approx(result.backoff_u[0], abs=1e-7)
        assert np.all(answer.inputs @ design.input_set.c.T <= design.input_set.b)
        cost = independent_cost(design, name, ask, answer, float(result.covariance[0]))
        assert answer.cost == pytest.approx(cost, rel=1e-6)
        checked[ask.kind] += 1
    assert set(checked) == set(KINDS)
    assert checked.total() > 30  # of 70: from many states no place to rest is within the room's reach


@pytest.mark.parametrize("name", EACH_PRESET)
def test_a_violated_constraint_fails_the_check(name: str) -> None:
    """Gains a tenth larger, or a shifted mean, fail the check."""
    tested = case(name)
    ask, answer, _ = next(
        result for result in answered(name) if result[1].method == "exact" and result[1].terminal_miss < KEPT_TOLERANCE
    )
    thetas = [1.1 * theta[None] for theta in flown(tested, ask, answer)]
    m = gains(tested.design, thetas)
    assert (
        margins(tested.design, m, ask.x[None], answer.inputs[None], answer.reference[None]).worst()[0] < -KEPT_TOLERANCE
    )
    shifted = answer.inputs.copy()
    shifted[0] += 1e-3
    m = gains(tested.design, [theta / 1.1 for theta in thetas])
    assert margins(tested.design, m, ask.x[None], shifted[None], answer.reference[None]).rest[0] < -KEPT_TOLERANCE


# --- bits ------------------------------------------------------------------------------------------------------------


def bits(answer: Answer) -> bytes:
    arrays = (answer.inputs, answer.states, answer.backoff_x, answer.backoff_u, answer.reference)
    numbers = (answer.slack, answer.offset, answer.terminal_miss, answer.cost, answer.cost_lower, answer.gap)
    return b"".join([*(array.tobytes() for array in arrays), np.array(numbers).tobytes(), answer.method.encode()])


def bits_of(solver: ShortcutSolver, asks: list[Asked]) -> list[bytes]:
    return [bits(solver.solve(0, ask.x, ask.target, ask.preview)) for ask in asks]


@pytest.mark.slow
def test_same_question_same_bits_after_any_other_questions() -> None:
    tested = case("paper")
    asks = list(all_kinds(tested.design, 51, 2))
    new = bits_of(ShortcutSolver(tested.design), asks)
    single = [bits_of(ShortcutSolver(tested.design), [ask])[0] for ask in asks[::4]]
    assert single == new[::4]
    used = ShortcutSolver(tested.design)
    for scale in (np.nan, np.inf, 1e3, 1e9, 1e200):
        used.solve(0, tested.design.target + scale * np.ones(tested.design.plant.n_x), tested.design.target)
    used.solve(0, asks[0].x, asks[0].target, Preview(limits=np.full_like(limits(tested.design), -1.0)))
    assert bits_of(used, asks[::-1])[::-1] == new


# --- what cannot be met ----------------------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize("name", EACH_PRESET)
def test_every_question_has_an_answer_and_relaxed_constraints_are_named(name: str) -> None:
    tested = case(name)
    design, kinds = tested.design, Counter[str]()
    for ask in hard_questions(design):
        answer = tested.solver.solve(1, ask.x, ask.target, ask.preview)
        assert answer.status is OK, ask.kind
        assert np.all(answer.inputs @ design.input_set.c.T <= design.input_set.b)
        reported = find_relaxed(design, answer, tested.components, ask.preview)
        if max(answer.slack, answer.terminal_miss) > KEPT_TOLERANCE:
            assert answer.relaxed == reported
            assert reported
            kinds.update({way.constraint for way in answer.relaxed})
            state = {(way.stage, way.index) for way in answer.relaxed if way.constraint == "state"}
            b = limits(design) if ask.preview.limits is None else ask.preview.limits
            over = answer.states @ design.state_set.c.T + answer.backoff_x - b
            assert state == {(int(t), int(i)) for t, i in np.argwhere(over > KEPT_TOLERANCE) if t > 0}
        else:
            assert answer.relaxed == ()
        if ask.kind == "target out of reach":
            assert answer.offset > 1.0
        if ask.kind.startswith(("fence", "no place", "100", "10.0")):
            assert answer.relaxed
    assert {"state", "equilibrium"} <= set(kinds)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e160, 1e300])
@pytest.mark.parametrize("name", EACH_PRESET)
def test_numbers_that_are_not_finite_give_no_plan(name: str, bad: float) -> None:
    tested = case(name)
    design, home = tested.design, tested.design.target
    spoilt = home.copy()
    spoilt[1] = bad
    path = Path(np.zeros((design.horizon, design.plant.n_x)), np.full((design.horizon, design.plant.n_u), bad))
    questions = [(spoilt, home, Preview()), (home, spoilt, Preview()), (home, home, Preview(path=path))]
    if not np.isfinite(bad):
        questions.append((home, home, Preview(limits=np.full_like(limits(design), bad))))
    for x, target, preview in questions:
        answer = tested.solver.solve(9, x, target, preview)
        assert (answer.seq, answer.status) == (9, SolveStatus.FAILED)
        assert answer.inputs.size == 0


@pytest.mark.parametrize("age", [1, -1])
def test_an_age_that_the_design_does_not_know_fails(age: int) -> None:
    tested = case("paper")
    answer = tested.solver.solve(0, tested.design.target, tested.design.target, Preview(age=age))
    assert (answer.status, answer.inputs.size) == (SolveStatus.FAILED, 0)


# --- late positions --------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_policies_of_late_positions_agree_with_the_exact_program() -> None:
    design = small(late_steps=1)
    solver, exact = ShortcutSolver(design), ConicSolver(design)
    rng = np.random.default_rng(71)
    costs, methods = [], Counter[str]()
    for _ in range(40):
        x = rng.uniform([-20.0, -5.0], [30.0, 5.0])
        new, late = (solver.solve(0, x, design.target, Preview(age=j)) for j in (0, 1))
        expected = exact.solve(0, x, design.target, Preview(age=1))
        assert (late.status, expected.status) == (OK, OK)
        assert late.cost == pytest.approx(expected.cost, rel=1e-7)
        costs.append(late.cost - new.cost)
        methods[late.method] += 1
    assert min(costs) > 0.0  # less is known
    assert min(methods["frozen"], methods["exact"]) > 0
