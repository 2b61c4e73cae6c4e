"""Problem (19) as printed: the paper's numbers, and honest endings."""

from __future__ import annotations

import numpy as np
import pytest
from optimisation_cases import ORIGIN, PAPER_COST, PAPER_COST_X, PAPER_COST_Y, START, paper, room

from uavctl.data import SolveStatus
from uavctl.smpc.components import decompose, whole
from uavctl.smpc.design import Design
from uavctl.smpc.printed import PrintedProblem, PrintedSolver


@pytest.fixture(scope="module")
def design() -> Design:
    return paper()


@pytest.fixture(scope="module")
def solver(design: Design) -> PrintedSolver:
    return PrintedSolver(design)


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


def test_joint_problem_has_the_cost_of_its_axes(design: Design) -> None:
    part = PrintedProblem(design, whole(design)).solve(START, ORIGIN)
    assert part.status in (SolveStatus.OPTIMAL, SolveStatus.INACCURATE)
    assert part.cost == pytest.approx(PAPER_COST, rel=2e-6)


def test_hard_constraints_make_far_states_infeasible(solver: PrintedSolver) -> None:
    answer = solver.solve(0, np.array([0.0, 60.0, 0.0, 0.0]), ORIGIN)
    assert answer.status is SolveStatus.INFEASIBLE
    assert answer.inputs.size == 0


def test_numbers_that_are_not_finite_fail(solver: PrintedSolver) -> None:
    assert solver.solve(0, np.full(4, np.nan), ORIGIN).status is SolveStatus.FAILED


def test_iteration_limit_is_told() -> None:
    assert PrintedSolver(paper(max_iterations=3)).solve(0, START, ORIGIN).status is SolveStatus.ITERATION_LIMIT


def test_target_takes_the_place_of_the_origin() -> None:
    design = room()
    solver = PrintedSolver(design)
    start = design.target + np.array([0.2, 0, 0, -0.1, 0, 0, 0.05, 0, 0])
    answer = solver.solve(0, start, design.target)
    assert answer.status in (SolveStatus.OPTIMAL, SolveStatus.INACCURATE)
    assert answer.states[-1] == pytest.approx(design.target, abs=1e-5)
