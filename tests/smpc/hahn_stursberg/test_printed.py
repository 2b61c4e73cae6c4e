"""Problem (19) as printed: the paper's numbers, and status values."""

from __future__ import annotations

import json
from io import StringIO

import cvxpy as cp
import msgspec
import numpy as np
import pytest
from optimisation_cases import ORIGIN, PAPER_COST, PAPER_COST_X, PAPER_COST_Y, START, paper, room
from rich.console import Console

from uavctl.cli.design import make_solve_document, render_solution
from uavctl.config import load_config
from uavctl.records import SolveStatus
from uavctl.smpc.hahn_stursberg.components import decompose, make_whole_component
from uavctl.smpc.hahn_stursberg.design import Design
from uavctl.smpc.hahn_stursberg.printed import PrintedProblem, PrintedSolver


@pytest.fixture(scope="module")
def design() -> Design:
    return paper()


@pytest.fixture(scope="module")
def solver(design: Design) -> PrintedSolver:
    return PrintedSolver(design)


@pytest.mark.slow
def test_cost_of_each_axis(design: Design) -> None:
    north, east = (PrintedProblem(design, component).solve(START, ORIGIN) for component in decompose(design))
    assert [north.cost, east.cost] == pytest.approx([PAPER_COST_X, PAPER_COST_Y], rel=1e-6)
    assert (north.slack, north.offset, north.terminal_miss) == (0.0, 0.0, 0.0)


def test_plan_of_both_axes(solver: PrintedSolver) -> None:
    answer = solver.solve(4, START, ORIGIN)
    assert (answer.seq, answer.method) == (4, "printed")
    assert answer.status is SolveStatus.OPTIMAL
    assert answer.cost == pytest.approx(PAPER_COST, rel=1e-6)
    assert (answer.inputs.shape, answer.states.shape) == ((12, 2), (13, 4))
    assert (answer.backoff_x.shape, answer.backoff_u.shape) == ((13, 8), (12, 4))
    assert answer.states[8:] == pytest.approx(np.zeros((5, 4)), abs=1e-5)
    assert np.abs(answer.inputs).max() <= 7.5
    assert np.all(answer.backoff_u[:5] == 0.0)


def test_nothing_is_certified_and_the_text_says_so(design: Design, solver: PrintedSolver) -> None:
    answer = solver.solve(0, START, ORIGIN)
    assert (answer.status, answer.cost_lower, answer.gap) == (SolveStatus.OPTIMAL, -np.inf, np.inf)
    shown = json.loads(msgspec.json.encode(make_solve_document(answer, 1.0)))
    assert shown["cost"] == pytest.approx(PAPER_COST, rel=1e-6)
    assert (shown["cost_lower"], shown["gap"]) == (None, None)
    console = Console(file=StringIO(), width=200)
    console.print(render_solution(answer, design, load_config("paper"), 1.0))
    assert isinstance(console.file, StringIO)
    assert "(no lower bound known), slack 0" in console.file.getvalue()


@pytest.mark.slow
def test_joint_problem_has_the_cost_of_its_axes(design: Design) -> None:
    part = PrintedProblem(design, make_whole_component(design)).solve(START, ORIGIN)
    assert part.status in (SolveStatus.OPTIMAL, SolveStatus.INACCURATE)
    assert part.cost == pytest.approx(PAPER_COST, rel=2e-6)


def test_hard_constraints_make_far_states_infeasible(solver: PrintedSolver) -> None:
    answer = solver.solve(0, np.array([0.0, 60.0, 0.0, 0.0]), ORIGIN)
    assert answer.status is SolveStatus.INFEASIBLE
    assert answer.inputs.size == 0


def test_numbers_that_are_not_finite_fail(solver: PrintedSolver) -> None:
    assert solver.solve(0, np.full(4, np.nan), ORIGIN).status is SolveStatus.FAILED


@pytest.mark.parametrize("scale", [1e8, 1e20, 1e160, 1e300])
def test_extreme_numbers_give_no_plan_and_no_exception(solver: PrintedSolver, scale: float) -> None:
    answer = solver.solve(0, START * scale, ORIGIN)
    assert answer.status in (SolveStatus.FAILED, SolveStatus.INFEASIBLE)
    assert answer.inputs.size == 0
    assert solver.solve(0, START, ORIGIN).status is SolveStatus.OPTIMAL


class PanicException(BaseException):  # named as Clarabel's, whose class cannot be imported
    pass


@pytest.mark.parametrize("raised", [PanicException, cp.SolverError])
def test_a_solver_that_breaks_down_is_a_failed_answer(
    solver: PrintedSolver, monkeypatch: pytest.MonkeyPatch, raised: type[BaseException]
) -> None:
    def breaks(*_: object, **__: object) -> None:
        raise raised

    monkeypatch.setattr(cp.Problem, "solve", breaks)
    assert solver.solve(0, START, ORIGIN).status is SolveStatus.FAILED


def test_an_interrupt_is_no_breakdown(solver: PrintedSolver, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(cp.Problem, "solve", interrupted)
    with pytest.raises(KeyboardInterrupt):
        solver.solve(0, START, ORIGIN)


@pytest.mark.slow
def test_iteration_limit_is_reported() -> None:
    assert PrintedSolver(paper(max_iterations=3)).solve(0, START, ORIGIN).status is SolveStatus.ITERATION_LIMIT


@pytest.mark.slow
def test_target_takes_the_place_of_the_origin() -> None:
    design = room()
    solver = PrintedSolver(design)
    start = design.target + np.array([0.2, 0, 0, -0.1, 0, 0, 0.05, 0, 0])
    answer = solver.solve(0, start, design.target)
    assert answer.status in (SolveStatus.OPTIMAL, SolveStatus.INACCURATE)
    assert answer.states[-1] == pytest.approx(design.target, abs=1e-5)
