"""The exact program: the paper's numbers, each constraint evaluated independently, and the extensions of (19)."""

from __future__ import annotations

import clarabel
import numpy as np
import pytest
from optimisation_cases import (
    ORIGIN,
    PAPER_COST,
    PAPER_COST_X,
    PAPER_COST_Y,
    PAPER_LOWER,
    PAPER_UPPER,
    ROOM_CORNER,
    ROOM_TARGET,
    START,
    coupled,
    paper,
    paper_plant,
    room,
)

from uavctl.arrays import Array
from uavctl.records import SolveStatus
from uavctl.smpc.answer import Answer, clip_inputs
from uavctl.smpc.hahn_stursberg import exact as conic
from uavctl.smpc.hahn_stursberg.components import decompose
from uavctl.smpc.hahn_stursberg.cones import ConicProgram
from uavctl.smpc.hahn_stursberg.design import Design
from uavctl.smpc.hahn_stursberg.exact import ConicSolver
from uavctl.smpc.hahn_stursberg.horizon import Horizon
from uavctl.smpc.hahn_stursberg.printed import PrintedProblem, PrintedSolver
from uavctl.smpc.hahn_stursberg.program import Program
from uavctl.smpc.sets import Polytope


@pytest.fixture(scope="module")
def paper_design() -> Design:
    return paper()


@pytest.fixture(scope="module")
def paper_solver(paper_design: Design) -> ConicSolver:
    return ConicSolver(paper_design)


@pytest.fixture(scope="module")
def room_solver() -> ConicSolver:
    return ConicSolver(room())


def is_hard(answer: Answer) -> bool:
    return max(answer.slack, answer.offset, answer.terminal_miss) < 1e-6


def test_the_papers_cost_and_its_two_axes(paper_design: Design, paper_solver: ConicSolver) -> None:
    answer = paper_solver.solve(7, START, ORIGIN)
    assert (answer.seq, answer.status, answer.method) == (7, SolveStatus.OPTIMAL, "exact")
    assert answer.cost == pytest.approx(PAPER_COST, abs=0.01)
    assert is_hard(answer)
    assert answer.reference == pytest.approx(ORIGIN, abs=1e-6)
    # At rest in the target only the disturbance costs; the difference is the other axis' own cost.
    idle = paper_solver.solve(0, ORIGIN, ORIGIN).cost / 2
    north = paper_solver.solve(0, START * [1, 1, 0, 0], ORIGIN).cost - idle
    east = paper_solver.solve(0, START * [0, 0, 1, 1], ORIGIN).cost - idle
    assert [north, east] == pytest.approx([PAPER_COST_X, PAPER_COST_Y], abs=0.01)


def test_bounds_enclose_the_optimum(paper_solver: ConicSolver) -> None:
    answer = paper_solver.solve(0, START, ORIGIN)
    assert abs(answer.gap) < 1e-7
    assert answer.gap == pytest.approx((answer.cost - answer.cost_lower) / answer.cost)


def test_one_axis_has_36_variables_besides_reference_slacks_and_backoffs(paper_design: Design) -> None:
    component = decompose(paper_design)[0]
    layout = Program(paper_design, Horizon(component, 12, 4, paper_design.schedule), soft_terminal=False).layout
    assert layout.y.start == 36
    assert layout.size == 36 + 2 + 2 * 7 + 7


@pytest.mark.long
def test_agrees_with_the_printed_problem_on_100_feasible_states_of_an_axis(
    paper_design: Design, paper_solver: ConicSolver
) -> None:
    """50 states of the plane: the axes are independent problems."""
    rng = np.random.default_rng(4)
    problems = [PrintedProblem(paper_design, component) for component in decompose(paper_design)]
    feasible, worst = 0, 0.0
    while feasible < 50:
        x = rng.uniform(PAPER_LOWER, PAPER_UPPER)
        answer = paper_solver.solve(0, x, ORIGIN)
        if is_hard(answer):
            feasible += 1
            cost = sum(problem.solve(x, ORIGIN).cost for problem in problems)
            worst = max(worst, abs(answer.cost / cost - 1))
    assert worst < 1e-6


@pytest.mark.slow
def test_infeasible_where_the_printed_problem_is(paper_design: Design, paper_solver: ConicSolver) -> None:
    printed = PrintedSolver(paper_design)
    rng = np.random.default_rng(5)
    observed = set()
    for x in rng.uniform(PAPER_LOWER, PAPER_UPPER, size=(12, 4)):
        hard = is_hard(paper_solver.solve(0, x, ORIGIN))
        status = printed.solve(0, x, ORIGIN).status
        assert status is (SolveStatus.OPTIMAL if hard else SolveStatus.INFEASIBLE)
        observed.add(hard)
    assert observed == {True, False}


def test_coupled_axes_are_one_program_and_agree_with_the_joint_printed_problem() -> None:
    design = coupled()
    states = np.array([[4.0, -1.0, -3.0, 0.5], [-2.0, 1.0, 2.5, -1.0], [0.0, 0.0, 5.0, 0.0]])
    solver, joint = ConicSolver(design), PrintedSolver(design, joint=True)
    for x in states:
        answer = solver.solve(0, x, ORIGIN)
        assert answer.status is SolveStatus.OPTIMAL
        assert is_hard(answer)
        assert answer.cost == pytest.approx(joint.solve(0, x, ORIGIN).cost, rel=1e-6)


def test_undisturbed_axis_needs_no_feedback() -> None:
    design = paper(plant=paper_plant(w=np.diag([0.6, 0.0])))
    answer = ConicSolver(design).solve(0, START, ORIGIN)
    assert answer.status is SolveStatus.OPTIMAL
    assert np.all(answer.backoff_u[:, 2:] == 0.0)
    assert answer.backoff_u[5:, :2].min() > 0.0
    assert answer.cost == pytest.approx(PrintedSolver(design).solve(0, START, ORIGIN).cost, rel=1e-6)


def independent_rows(design: Design, solver: ConicSolver, x: Array, target: Array) -> dict[str, float]:
    """Least margin of every kind of row of (19), from the gains themselves; joint, unreduced."""
    plant, H, tau = design.plant, design.horizon, design.terminal.tau
    answer = solver.solve(0, x, target)
    gain = np.zeros((H, plant.n_u, H, plant.n_w))
    for part in solver._parts:
        where, program = part.component, part._hard
        here = x[where.states], target[where.states]
        theta = program.conic.solve(program.parameters(*here)).variables[program.layout.theta]
        for value, (t, r, i, j) in zip(theta, program.horizon.gains, strict=True):
            gain[t, where.inputs[i], r, where.disturbances[j]] = value
    mean, effect = [x], [np.zeros((plant.n_x, H * plant.n_w))]
    for t in range(H):
        enter = np.zeros((plant.n_x, H, plant.n_w))
        enter[:, t] = plant.e
        mean.append(plant.a @ mean[-1] + plant.b @ answer.inputs[t])
        effect.append(plant.a @ effect[-1] + plant.b @ gain[t].reshape(plant.n_u, -1) + enter.reshape(plant.n_x, -1))
    noise = np.kron(np.eye(H), plant.w)
    minimum = {"state": np.inf, "input": np.inf, "limit": np.inf}
    for t in range(1, H + 1):
        sigma = effect[t] @ noise @ effect[t].T
        for i, (c, b) in enumerate(zip(design.state_set.c, design.state_set.b, strict=True)):
            backoff = design.kappa_x[t] * np.sqrt(c @ sigma @ c)
            assert answer.backoff_x[t, i] == pytest.approx(backoff, rel=1e-6, abs=1e-9)
            minimum["state"] = min(minimum["state"], b - c @ mean[t] - backoff)
    for t in range(H):
        m = gain[t].reshape(plant.n_u, -1)
        for i, (c, b) in enumerate(zip(design.input_set.c, design.input_set.b, strict=True)):
            backoff = design.kappa_u[t] * np.sqrt(c @ m @ noise @ m.T @ c)
            assert answer.backoff_u[t, i] == pytest.approx(backoff, rel=1e-6, abs=1e-9)
            minimum["input"] = min(minimum["input"], b - c @ answer.inputs[t] - backoff)
            minimum["limit"] = min(minimum["limit"], b - c @ answer.inputs[t])
    xi = np.vstack(effect[H - tau :])
    minimum["lmi"] = float(np.linalg.eigvalsh(design.terminal.sigma_xi - xi @ noise @ xi.T)[0])
    minimum["terminal"] = -float(np.abs(np.array(mean[H - tau :]) - answer.reference).max())
    assert answer.states == pytest.approx(np.array(mean), abs=1e-12)
    return minimum


@pytest.mark.parametrize("x", [START, [-25.0, 3.0, 10.0, 6.0], [5.0, -6.0, 1.0, -2.0]], ids=str)
def test_solution_keeps_every_row_of_the_printed_problem(
    paper_design: Design, paper_solver: ConicSolver, x: list[float]
) -> None:
    minimum = independent_rows(paper_design, paper_solver, np.array(x), ORIGIN)
    assert minimum.pop("limit") >= 0.0
    assert {row: margin for row, margin in minimum.items() if margin < -1e-6} == {}


def test_rows_are_kept_by_a_coupled_plant_and_in_a_room(room_solver: ConicSolver) -> None:
    cross, box = coupled(), room()
    near = ROOM_TARGET + np.array([-0.3, 0, 0, 0.2, 0, 0, 0.1, 0, 0])
    for minimum in (
        independent_rows(cross, ConicSolver(cross), np.array([4.0, -1.0, -3.0, 0.5]), ORIGIN),
        independent_rows(box, room_solver, near, ROOM_TARGET),
    ):
        assert {row: margin for row, margin in minimum.items() if margin < -1e-6} == {}


def test_far_target_gives_a_reference_in_between(paper_solver: ConicSolver) -> None:
    target = np.array([1000.0, 0.0, 0.0, 0.0])
    answer = paper_solver.solve(0, ORIGIN, target)
    assert answer.status is SolveStatus.OPTIMAL
    assert 5.0 < answer.reference[0] < 50.0
    assert answer.offset == pytest.approx(1000.0 - answer.reference[0], abs=1e-5)
    assert answer.states[-1] == pytest.approx(answer.reference, abs=1e-6)
    assert (answer.slack, answer.terminal_miss) == pytest.approx((0.0, 0.0), abs=1e-6)


def test_plan_depends_on_the_difference_to_the_target_only() -> None:
    wide = Polytope.from_box([-1e4, -8.0, -1e4, -8.0], [1e4, 7.0, 1e4, 8.0])
    solver = ConicSolver(paper(state_set=wide))
    move = np.array([5000.0, 0.0, -3000.0, 0.0])
    here, there = solver.solve(0, START, ORIGIN), solver.solve(0, START + move, ORIGIN + move)
    assert there.inputs == pytest.approx(here.inputs, abs=1e-3)
    assert there.cost == pytest.approx(here.cost, rel=1e-8)


def test_a_start_outside_the_limits_uses_slack_and_reports_it(paper_solver: ConicSolver) -> None:
    answer = paper_solver.solve(0, np.array([0.0, 14.0, 0.0, 0.0]), ORIGIN)
    assert answer.status is SolveStatus.OPTIMAL
    assert answer.slack > 0.1
    worst = np.max(answer.states[1:, 1] + answer.backoff_x[1:, 2] - 7.0)
    assert 0.0 < worst <= answer.slack + 1e-6


def test_without_a_reachable_equilibrium_the_terminal_equality_is_relaxed(paper_solver: ConicSolver) -> None:
    for x in ([80.0, 60.0, 0.0, 0.0], [500.0, -100.0, -900.0, 40.0], [-3e3, 200.0, 2e3, 0.0]):
        answer = paper_solver.solve(0, np.array(x), ORIGIN)
        assert answer.status is SolveStatus.OPTIMAL
        assert answer.terminal_miss > 1.0
        assert np.abs(answer.inputs).max() <= 7.5
        miss = np.abs(answer.states[8] - answer.reference).sum()
        assert answer.terminal_miss == pytest.approx(miss, rel=1e-6)


def test_same_question_same_bits_after_any_other_questions(paper_design: Design) -> None:
    new = ConicSolver(paper_design).solve(0, START, ORIGIN)
    used = ConicSolver(paper_design)
    rng = np.random.default_rng(6)
    for x in rng.uniform(1.5 * PAPER_LOWER, 1.5 * PAPER_UPPER, size=(20, 4)):
        used.solve(0, x, ORIGIN)
    used.solve(0, np.full(4, 1e6), ORIGIN)
    used.solve(0, np.full(4, np.nan), ORIGIN)
    again = used.solve(0, START, ORIGIN)
    for name in ("inputs", "states", "backoff_x", "backoff_u", "reference"):
        assert getattr(again, name).tobytes() == getattr(new, name).tobytes()
    assert (again.cost, again.cost_lower, again.iterations) == (new.cost, new.cost_lower, new.iterations)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_numbers_that_are_not_finite_fail_without_a_plan(paper_solver: ConicSolver, bad: float) -> None:
    for x, target in ((np.array([0.0, bad, 0.0, 0.0]), ORIGIN), (START, np.array([bad, 0.0, 0.0, 0.0]))):
        answer = paper_solver.solve(3, x, target)
        assert (answer.seq, answer.status) == (3, SolveStatus.FAILED)
        assert answer.inputs.size == 0


@pytest.mark.parametrize("scale", [1e8, 1e20, 1e160, 1e300])
def test_extreme_numbers_fail_without_an_exception(paper_solver: ConicSolver, scale: float) -> None:
    assert paper_solver.solve(0, START * scale, ORIGIN).status is SolveStatus.FAILED


def test_a_panic_of_the_solver_is_a_failed_answer(paper_design: Design, monkeypatch: pytest.MonkeyPatch) -> None:
    class PanicException(BaseException):
        pass

    class Panicking:
        def update(self, **_: Array) -> None:
            raise PanicException

    solver = ConicSolver(paper_design)
    expected = solver.solve(0, START, ORIGIN)
    for part in solver._parts:
        part._hard.conic._solver = part._soft.conic._solver = Panicking()  # type: ignore[assignment]  # a stand-in
    assert solver.solve(0, START, ORIGIN).status is SolveStatus.FAILED
    assert solver.solve(0, START, ORIGIN).inputs.tobytes() == expected.inputs.tobytes()


def test_iterations_are_bounded() -> None:
    answer = ConicSolver(paper(max_iterations=3)).solve(0, START, ORIGIN)
    assert answer.status is SolveStatus.ITERATION_LIMIT
    assert answer.iterations == 6


def test_every_status_of_clarabel_is_mapped_and_only_solved_is_optimal() -> None:
    names = {str(getattr(clarabel.SolverStatus, name)) for name in dir(clarabel.SolverStatus) if name[0] != "_"}
    assert names <= set(conic._STATUS)
    assert [name for name, status in conic._STATUS.items() if status is SolveStatus.OPTIMAL] == ["Solved"]


@pytest.mark.parametrize(
    ("solver_says", "status"), [("AlmostSolved", SolveStatus.INACCURATE), ("NumericalError", SolveStatus.FAILED)]
)
def test_other_status_values_are_passed_on(
    paper_design: Design, monkeypatch: pytest.MonkeyPatch, solver_says: str, status: SolveStatus
) -> None:
    solver = ConicSolver(paper_design)
    solve = ConicProgram.solve

    def ends_otherwise(program: ConicProgram, parameters: Array) -> object:
        solution = solve(program, parameters)
        object.__setattr__(solution, "status", solver_says)
        return solution

    monkeypatch.setattr(ConicProgram, "solve", ends_otherwise)
    assert solver.solve(0, START, ORIGIN).status is status


def test_inputs_are_clipped_and_more_than_a_tolerance_is_reported() -> None:
    box = Polytope.from_box([-7.5, -1.1], [7.5, 1.1])
    wanted = np.array([[7.5 + 1e-9, -1.1 - 3e-10], [0.1, 0.2]])
    cut, kept = clip_inputs(wanted, box.c, box.b)
    assert kept
    assert cut.tolist() == [[7.5, -1.1], [0.1, 0.2]]
    cut, kept = clip_inputs(wanted + 1e-3, box.c, box.b)
    assert not kept
    assert cut[0, 0] == 7.5
    oblique, kept = clip_inputs(np.array([[1.0 + 1e-7, 1.0]]), np.array([[1.0, 1.0]]), np.array([2.0]))
    assert kept
    assert oblique.sum() == pytest.approx(2.0, abs=1e-15)


def test_room_from_the_far_corner(room_solver: ConicSolver) -> None:
    answer = room_solver.solve(0, ROOM_CORNER, ROOM_TARGET)
    assert answer.status is SolveStatus.OPTIMAL
    assert answer.terminal_miss == 0.0
    assert answer.offset > 1.0
    assert np.all(answer.inputs <= [2.0, 2.0, 1.5])
    assert answer.states[-1] == pytest.approx(answer.reference, abs=1e-6)


@pytest.mark.slow
def test_the_room_s_offset_weight_is_exact_and_a_small_one_is_not(room_solver: ConicSolver) -> None:
    """Where 3e4 brings the plan into the target without slack, the preset's 300 does so too."""
    heavy, light = ConicSolver(room(offset_weight=3e4)), ConicSolver(room(offset_weight=1.0))
    rng = np.random.default_rng(12)
    in_reach: list[Array] = []
    while len(in_reach) < 8:
        x = ROOM_TARGET + rng.uniform(-1.0, 1.0, 9) * np.tile([1.0, 0.6, 0.5], 3)
        answer = heavy.solve(0, x, ROOM_TARGET)
        if answer.status is SolveStatus.OPTIMAL and is_hard(answer):
            in_reach.append(x)
    answers = [room_solver.solve(0, x, ROOM_TARGET) for x in in_reach]
    assert {answer.status for answer in answers} == {SolveStatus.OPTIMAL}
    assert max(answer.offset for answer in answers) < 1e-5
    assert max(light.solve(0, x, ROOM_TARGET).offset for x in in_reach) > 1e-2


@pytest.mark.slow
def test_room_is_reached_by_replanning(room_solver: ConicSolver) -> None:
    design, x = room(), ROOM_CORNER
    for k in range(60):
        answer = room_solver.solve(k, x, ROOM_TARGET)
        assert answer.status is SolveStatus.OPTIMAL
        x = answer.states[1]
    assert x == pytest.approx(ROOM_TARGET, abs=0.05)
    assert design.state_set.margin(x).min() > 0
