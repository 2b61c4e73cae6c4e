"""A program in which the solver cycles is solved from other rows, as an interior-point solver solves it."""

from __future__ import annotations

from dataclasses import replace

import cvxpy as cp
import numpy as np
import pytest

from uavctl.arrays import Array
from uavctl.config.load import load_config
from uavctl.records import SolveStatus
from uavctl.smpc.answer import Preview
from uavctl.smpc.conditioned import levels, planner
from uavctl.smpc.conditioned.backoffs import allocate_equally
from uavctl.smpc.conditioned.planner import ConditionedSolver
from uavctl.smpc.conditioned.program import PartProgram
from uavctl.smpc.link import bernoulli
from uavctl.smpc.nominal import propagate_covariance
from uavctl.smpc.qp import OPEN, QuadraticProgram, Sense
from uavctl.smpc.sets import Polytope
from uavctl.wiring.controller import build_problem

# Found among 240,000 random states, ages and spreads: in the program of the second axis DAQP cycles.
STATE = ("0x1.d9acb060ddc60p+3", "0x1.e8019fbf626b8p+3", "0x1.70433dacaca60p+3", "0x1.c6aff29e7937ep+2")
TARGET = ("0x1.3251fdc499278p+4", "0x0.0p+0", "-0x1.ae89e0f8796f3p+4", "0x0.0p+0")
AGE, WIDENING, SILENCE_WIDENING = 3, 2.5, 4.0
BUDGETS = [0.024342178991304114, 0.08150945454469351, 0.15084698675371555, 0.22829261633689882] + 8 * [0.25]


@pytest.fixture(scope="module")
def solver() -> ConditionedSolver:
    problem = replace(
        build_problem(load_config("paper", ["smpc.scheme=age-conditioned"])),
        state_set=Polytope.from_box([-60.0, -8.0, -60.0, -8.0], [20.0, 8.0, 20.0, 8.0]),
        input_set=Polytope.from_box([-7.5, -7.5], [7.5, 7.5]),
        q_x=np.diag([10.0, 0.1, 10.0, 0.1]),
        q_u=0.1 * np.eye(2),
    )
    with pytest.MonkeyPatch.context() as patch:
        risk = allocate_equally(bernoulli(np.array([0.7])), len(BUDGETS), 0.05, 2)
        patch.setattr(levels, "allocate_by_age", lambda *_: replace(risk, budgets=np.array(BUDGETS)))
        # Bounded, the widening of STATE makes another program.
        patch.setattr(planner, "find_opposite_rows", lambda c: np.zeros((0, 2), dtype=np.intp))
        return ConditionedSolver(problem, bernoulli(np.array([0.7])), 0.05)


def solve_by_interior_points(program: QuadraticProgram, rows: Array, upper: Array, lower: Array) -> Array:
    """Solve min |z|² + Σ price s + curve s² with soft rows in CVXPY; hard rows are kept."""
    z, s = cp.Variable(rows.shape[1]), cp.Variable(len(rows), nonneg=True)
    soft = program.sense != 0
    has_upper, has_lower = upper < OPEN / 2.0, lower > -OPEN / 2.0
    kept = [
        rows[has_upper] @ z <= upper[has_upper] + s[has_upper],
        rows[has_lower] @ z >= lower[has_lower] - s[has_lower],
    ]
    cost = cp.sum_squares(z) + 1e5 * cp.sum(s) + 1e3 * cp.sum_squares(s)
    cp.Problem(cp.Minimize(cost), [*kept, s[~soft] == 0.0]).solve(solver=cp.CLARABEL)
    return np.asarray(z.value)


def test_a_program_that_cycles_is_solved_from_other_rows(
    solver: ConditionedSolver, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[QuadraticProgram, Array, Array, Array | None]] = []
    rows: dict[QuadraticProgram, Array] = {}
    solve_sides = QuadraticProgram.solve_sides

    def watch(
        self: QuadraticProgram, upper: Array, lower: Array, working_set: Sense | None = None, reuse_rows: bool = False
    ) -> Array | None:
        z = solve_sides(self, upper, lower, working_set, reuse_rows)
        if not reuse_rows:
            asked.append((self, upper.copy(), lower.copy(), None if z is None else z.copy()))
        return z

    solve = PartProgram.solve

    def find_rows(self: PartProgram, margins: Array, reuse_rows: bool) -> Array | None:
        before = len(asked)
        result = solve(self, margins, reuse_rows)
        # The rows of one side, by unit vectors
        n = self.part.inputs.size * solver.problem.horizon
        width = solver.problem.state_set.b.size
        parts = []
        for unit in np.eye(n):
            used, hard = np.zeros((solver.problem.horizon, width)), np.zeros(len(margins) - 1 - used_size(solver))
            self.subtract_margin(unit, used, hard)
            parts.append(-np.concatenate([used.ravel(), hard, [0.0]]))
        by_margin = np.array(parts).T
        for program, *_ in asked[before:]:
            upper, lower = self._upper, self._lower
            is_above = (margins[upper] < OPEN / 2.0)[:, None]
            rows[program] = np.where(is_above, by_margin[upper], -by_margin[lower])
        return result

    monkeypatch.setattr(QuadraticProgram, "solve_sides", watch)
    monkeypatch.setattr(PartProgram, "solve", find_rows)
    x, target = (np.array([float.fromhex(value) for value in values]) for values in (STATE, TARGET))
    cov = propagate_covariance(solver.problem.plant, AGE)[AGE]
    preview = Preview(age=AGE, cov=cov, widening=WIDENING, silence_widening=SILENCE_WIDENING)
    answer = solver.solve(0, x, target, preview)
    assert answer.status is SolveStatus.OPTIMAL
    found = [z for *_, z in asked]
    assert [z is None for z in found] == [False, True, False]
    for program, upper, lower, z in asked:
        if z is not None:
            reference = solve_by_interior_points(program, rows[program], upper, lower)
            assert z == pytest.approx(reference, rel=1e-5, abs=1e-4)


def used_size(solver: ConditionedSolver) -> int:
    """Return the number of margins of state rows."""
    return solver.problem.horizon * solver.problem.state_set.b.size
