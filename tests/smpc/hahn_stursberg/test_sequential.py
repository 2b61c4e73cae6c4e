"""Decisions by sequential quadratic programming: the optimum of two other solvers, and none without a proof."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from full_problem import gains, margins
from question_rig import (
    EACH_PRESET,
    KEPT_TOLERANCE,
    Asked,
    all_kinds,
    case,
    design_of,
    hard_questions,
    near,
    small,
    uniform,
)

from uavctl.arrays import Array
from uavctl.records import SolveStatus
from uavctl.smpc.answer import Answer, Preview
from uavctl.smpc.hahn_stursberg import sequential
from uavctl.smpc.hahn_stursberg.exact import ConicSolver, PartAnswer
from uavctl.smpc.hahn_stursberg.printed import PrintedSolver
from uavctl.smpc.hahn_stursberg.sequential import SequentialProgram, make_sequential_program
from uavctl.smpc.hahn_stursberg.shortcut import ShortcutSolver
from uavctl.smpc.qp import QuadraticProgram


@cache
def solver(name: str) -> ShortcutSolver:
    return ShortcutSolver(design_of(name), sequential=True)


@cache
def exact_solver(name: str) -> ConicSolver:
    return ConicSolver(design_of(name))


def assert_same_optimum(answer: Answer, exact: Answer) -> None:
    """Costs within the certified gaps of both, and inputs as close as the exact program knows them."""
    size = max(1.0, abs(exact.cost))
    assert exact.cost_lower - 1e-9 * size <= answer.cost <= exact.cost + 1e-9 * size
    assert answer.cost_lower <= exact.cost + 1e-9 * size
    assert answer.gap <= 1e-7
    assert answer.inputs == pytest.approx(exact.inputs, abs=2e-3 * np.abs(exact.inputs).max())


@pytest.mark.parametrize(
    ("name", "least"), [("paper", 20), pytest.param("room-hahn-stursberg", 5, marks=pytest.mark.slow)]
)
def test_answers_are_the_exact_program_s(name: str, least: int) -> None:
    """Random questions of every kind; what needs slack is left to the exact program."""
    methods = Counter[str]()
    for ask in all_kinds(design_of(name), 83, 10):
        answer = solver(name).solve(0, ask.x, ask.target, ask.preview)
        methods[answer.method] += 1
        if answer.method == "sequential":
            exact = exact_solver(name).solve(0, ask.x, ask.target, ask.preview)
            assert (answer.status, exact.status) == (SolveStatus.OPTIMAL, SolveStatus.OPTIMAL)
            assert max(answer.slack, answer.terminal_miss, exact.slack, exact.terminal_miss) <= KEPT_TOLERANCE
            assert_same_optimum(answer, exact)
    assert methods["sequential"] >= least
    assert methods["exact"] > 0


def test_answers_from_late_positions_are_the_exact_program_s() -> None:
    design, rng = small(late_steps=1), np.random.default_rng(89)
    tested, exact, methods = ShortcutSolver(design, sequential=True), ConicSolver(design), Counter[str]()
    for _ in range(40):
        x = uniform(design, rng)
        answer = tested.solve(0, x, design.target, Preview(age=1))
        methods[answer.method] += 1
        if answer.method == "sequential":
            assert_same_optimum(answer, exact.solve(0, x, design.target, Preview(age=1)))
    assert methods["sequential"] >= 10


@pytest.mark.slow
def test_answers_have_the_cost_of_the_problem_as_printed() -> None:
    design, rng = design_of("paper"), np.random.default_rng(97)
    printed, count = PrintedSolver(design), 0
    states = [np.array([35.0, -2.0, -20.0, -4.0]), *(near(design, rng) for _ in range(30))]
    for x in states:
        answer = solver("paper").solve(0, x, design.target)
        if answer.method == "sequential" and count < 4:
            assert answer.cost == pytest.approx(printed.solve(0, x, design.target).cost, rel=1e-6)
            count += 1
    assert count == 4


class Recorder:
    """The programs of a design's components, and the gains that their answers stand for."""

    def __init__(self, name: str) -> None:
        tested = case(name)
        self.theta = [np.zeros(0) for _ in tested.components]
        self.programs = [self._make_program(name, i) for i in range(len(tested.components))]

    def _make_program(self, name: str, i: int) -> SequentialProgram:
        tested = case(name)

        def find_backoffs(theta: Array) -> tuple[Array, Array]:
            self.theta[i] = theta
            return tested.exact[i].backoffs(theta)

        program = make_sequential_program(tested.problems[i], tested.policies[i], find_backoffs)
        assert program is not None
        return program

    def ask(self, ask: Asked) -> list[PartAnswer | None]:
        return [program.solve(ask.x[None], ask.target, ask.preview)[0] for program in self.programs]


@pytest.mark.parametrize("name", EACH_PRESET)
def test_gains_and_means_keep_every_constraint_of_the_full_problem(name: str) -> None:
    """(19) from M: tightened rows of all stages, the terminal condition with all disturbances, rest from N on."""
    design, tested, recorder, count = design_of(name), case(name), Recorder(name), 0
    for ask in all_kinds(design, 101, 12):
        answers = recorder.ask(ask)
        if any(answer is None for answer in answers):
            continue
        count += 1
        inputs, reference = np.zeros((design.horizon, design.plant.n_u)), np.zeros(design.plant.n_x)
        for part, answer in zip(tested.components, answers, strict=True):
            assert answer is not None
            inputs[:, part.inputs], reference[part.states] = answer.inputs, answer.reference
        m = gains(design, [theta[None] for theta in recorder.theta])
        result = margins(design, m, ask.x[None], inputs[None], reference[None], ask.preview.limits)
        rows = (result.inputs, result.place, result.hold, result.rest, result.state, result.lmi())
        assert min(float(row.min(initial=0.0)) for row in rows) > -1e-7
    assert count >= 5


@cache
def refused_states() -> tuple[Array, ...]:
    """States from which the frozen policy is not optimal, and sequential quadratic programming answers."""
    design, rng = design_of("paper"), np.random.default_rng(103)
    drawn = [uniform(design, rng) for _ in range(30)]
    return tuple(x for x in drawn if solver("paper").solve(0, x, design.target).method == "sequential")


@cache
def exact_answers() -> tuple[Answer, ...]:
    """The exact program's answers from the refused states."""
    return tuple(exact_solver("paper").solve(0, x, design_of("paper").target) for x in refused_states())


@pytest.mark.parametrize(
    ("constant", "value"),
    [
        pytest.param("_NULL_EIGENVALUE", 1e-30, id="without the terminal condition", marks=pytest.mark.slow),
        pytest.param("_NULL_EIGENVALUE", 0.5, id="a terminal condition of too low a rank"),
        pytest.param("_MAX_ROUNDS", 1, id="a single round"),
        pytest.param("_MAX_ROUNDS", 3, id="too few rounds"),
    ],
)
def test_a_wrong_solution_has_no_proof(constant: str, value: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Errors of the method cost answers, and make none wrong."""
    states, exact, design = refused_states(), exact_answers(), design_of("paper")
    monkeypatch.setattr(sequential, constant, value)
    wrong = ShortcutSolver(design, sequential=True)
    answers = [wrong.solve(0, x, design.target) for x in states]
    assert sum(answer.method == "sequential" for answer in answers) < 0.5 * len(states)
    for answer, expected in zip(answers, exact, strict=True):
        assert_same_optimum(answer, expected)


def test_the_optimum_of_another_cost_has_no_proof(monkeypatch: pytest.MonkeyPatch) -> None:
    """A solver that reports a feasible mean which is not the cheapest, by 1 % of its linear cost."""
    solve = QuadraticProgram.solve_with_matrices

    def solve_another(
        program: QuadraticProgram, h: Array, f: Array, a: Array, upper: Array, lower: Array
    ) -> tuple[Array, Array] | None:
        return solve(program, h, 1.01 * f, a, upper, lower)

    states, design = refused_states(), design_of("paper")
    assert states
    monkeypatch.setattr(QuadraticProgram, "solve_with_matrices", solve_another)
    assert all(solver("paper").solve(0, x, design.target).method != "sequential" for x in states)


@pytest.mark.slow
def test_where_slack_is_cheaper_than_a_detour_the_exact_program_answers() -> None:
    design, rng, methods = replace(design_of("paper"), slack_linear=5.0), np.random.default_rng(107), Counter[str]()
    tested, exact = ShortcutSolver(design, sequential=True), ConicSolver(design)
    for _ in range(30):
        x = uniform(design, rng)
        answer, expected = (program.solve(0, x, design.target) for program in (tested, exact))
        methods[answer.method] += expected.slack > 1e-3
        if answer.method == "sequential":
            assert_same_optimum(answer, expected)
    assert methods["exact"] >= 5


def test_questions_out_of_reach_end_as_with_the_exact_program() -> None:
    """Far states, fences that shut out, and numbers whose squares overflow: no exception, the same end."""
    design = design_of("paper")
    asks = hard_questions(design)
    asks += [replace(asks[0], x=np.full(4, size)) for size in (1e30, 1e100, 1e149, 1e160, np.inf, np.nan)]
    for ask in asks:
        answer = solver("paper").solve(0, ask.x, ask.target, ask.preview)
        flown = case("paper").solver.solve(0, ask.x, ask.target, ask.preview)
        assert answer.status is flown.status
        assert answer.cost == pytest.approx(flown.cost, rel=1e-6)
