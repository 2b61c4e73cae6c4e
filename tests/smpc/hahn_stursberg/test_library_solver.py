"""Decisions from the library: certified, feasible for the full problem, the same bits, never an exception."""

from __future__ import annotations

import subprocess
import sys
from collections import Counter
from functools import cache

import numpy as np
import pytest
from full_problem import gains, margins
from library_rig import (
    EACH_PRESET,
    KEPT,
    KINDS,
    Asked,
    all_kinds,
    asked,
    case,
    closed_loop,
    flown,
    hard_questions,
    limits,
    small,
    uniform,
)
from numpy.typing import NDArray
from places import TESTS

from uavctl.records import SolveStatus
from uavctl.smpc.answer import Answer, Path, Preview
from uavctl.smpc.hahn_stursberg.design import Design
from uavctl.smpc.hahn_stursberg.exact import ConicSolver, gave_way
from uavctl.smpc.hahn_stursberg.frozen import TOLERANCE
from uavctl.smpc.hahn_stursberg.library import LibrarySolver, make_library
from uavctl.smpc.hahn_stursberg.mean import RowKind

Array = NDArray[np.float64]
OK = SolveStatus.OPTIMAL


@cache
def exact_solver(name: str) -> ConicSolver:
    return ConicSolver(case(name).design)


@cache
def answered(name: str) -> list[tuple[Asked, Answer, Answer]]:
    """Questions of every kind with the library's and the exact program's answer."""
    one, exact = case(name), exact_solver(name)
    return [
        (ask, one.solver.solve(7, ask.x, ask.target, ask.outlook), exact.solve(7, ask.x, ask.target, ask.outlook))
        for ask in all_kinds(one.design, 41, 10)
    ]


@pytest.mark.slow
@pytest.mark.parametrize("name", EACH_PRESET)
def test_the_certificate_is_never_wrong(name: str) -> None:
    methods: Counter[str] = Counter()
    for _, answer, exact in answered(name):
        assert (answer.seq, answer.status) == (7, OK)
        size = max(1.0, abs(exact.cost))
        assert answer.cost_lower <= exact.cost + 1e-7 * size
        assert answer.cost >= exact.cost_lower - 1e-7 * size
        assert answer.gap == (answer.cost - answer.cost_lower) / max(1.0, abs(answer.cost))
        assert answer.gap <= TOLERANCE
        methods[answer.method] += 1
    assert set(methods) == {"frozen", "mixture", "exact"}


@pytest.mark.slow
@pytest.mark.parametrize("name", EACH_PRESET)
def test_the_library_alone_is_certified_too_or_says_that_it_is_not(name: str) -> None:
    one = case(name)
    missed = 0
    for ask, answer, exact in answered(name):
        alone = one.alone.solve(7, ask.x, ask.target, ask.outlook)
        if alone.status is not OK:
            assert alone.status is SolveStatus.INFEASIBLE
            assert exact.terminal_miss > 0.0  # no place to rest within reach
            assert (alone.method, alone.inputs.size) == ("mixture", 0)
            missed += 1
            continue
        assert alone.method in ("frozen", "mixture")
        size = max(1.0, abs(exact.cost))
        assert alone.cost_lower <= exact.cost + 1e-7 * size
        assert alone.cost >= exact.cost_lower - 1e-7 * size
        if answer.method != "exact":
            assert alone.inputs.tobytes() == answer.inputs.tobytes()
    assert missed > 0 or name == "paper"


def independent_cost(design: Design, name: str, ask: Asked, answer: Answer, covariance: float) -> float:
    """Objective from the answer's own plan: stage costs of the means, the covariances' cost, the penalties."""
    free = design.horizon - design.terminal.tau
    rest = np.zeros(design.plant.n_u)
    path_x, path_u = np.zeros((free, design.plant.n_x)), np.zeros((free, design.plant.n_u))
    if ask.outlook.path is not None:
        path_x, path_u = ask.outlook.path.states[:free], ask.outlook.path.inputs[:free]
    cost, slacks = covariance + design.offset_weight * answer.offset, 0.0
    for t in range(free):
        x, u = answer.states[t] - answer.reference - path_x[t], answer.inputs[t] - rest - path_u[t]
        cost += float(x @ design.q_x @ x + u @ design.q_u @ u)
    limits = np.tile(design.state_set.b, (design.horizon + 1, 1)) if ask.outlook.limits is None else ask.outlook.limits
    beyond = answer.states @ design.state_set.c.T + answer.backoff_x - limits
    for problem, part in zip(case(name).problems, case(name).components, strict=True):
        for row in problem.rows:
            if row.kind is RowKind.STATE:
                sides = [beyond[row.t, part.rows_x[side]] for side in (row.upper, row.lower) if side >= 0]
                slack = max(0.0, *sides)
                cost += design.slack_linear * slack + design.slack_quadratic * slack**2
                slacks += slack
    assert answer.slack == pytest.approx(slacks, abs=1e-5)
    return cost


@pytest.mark.parametrize("name", EACH_PRESET)
def test_the_policy_flown_keeps_every_constraint_of_the_full_problem(name: str) -> None:
    """(19) from M: tightened rows of all stages, the terminal condition with all disturbances, rest from N on."""
    one = case(name)
    design, checked = one.design, Counter[str]()
    for ask, answer, exact in answered(name):
        assert (answer.terminal_miss > KEPT) == (exact.terminal_miss > KEPT)
        if answer.terminal_miss > KEPT:
            continue  # from there nothing keeps all of (19)
        thetas = flown(one, ask, answer)
        m = gains(design, [theta[None] for theta in thetas])
        found = margins(design, m, ask.x[None], answer.inputs[None], answer.reference[None], ask.outlook.limits)
        worst = {
            "input": found.inputs.min(),
            "place": found.place.min(),
            "hold": found.hold.min(),
            "rest": found.rest.min(),
            "state": -np.maximum(-found.state, 0.0).sum() + answer.slack,
            "terminal": 10.0 * found.lmi().min(),  # -1e-7 of its size
        }
        assert {row: margin for row, margin in worst.items() if margin < -KEPT} == {}
        # Back-offs that are told may be larger than the gains' own, by the mixture's convexity, and never smaller.
        # (Where a gain is zero but for rounding, the norm is that rounding's root.)
        assert np.all(answer.backoff_x >= found.backoff_x[0] - 1e-7)
        assert np.all(answer.backoff_u >= found.backoff_u[0] - 1e-7)
        assert np.all(answer.inputs @ design.input_set.c.T <= design.input_set.b)
        cost = independent_cost(design, name, ask, answer, float(found.covariance[0]))
        assert answer.cost == pytest.approx(cost, rel=1e-6)
        checked[ask.kind] += 1
    assert set(checked) == set(KINDS)
    assert checked.total() > 30  # of 70: from many states no place to rest is within the room's reach


@pytest.mark.parametrize("name", EACH_PRESET)
def test_what_the_constraints_are_held_to_can_be_missed(name: str) -> None:
    """Gains a tenth larger, or a mean that is moved, are found out."""
    one = case(name)
    ask, answer, _ = next(found for found in answered(name) if found[1].method == "mixture")
    thetas = [1.1 * theta[None] for theta in flown(one, ask, answer)]
    m = gains(one.design, thetas)
    assert margins(one.design, m, ask.x[None], answer.inputs[None], answer.reference[None]).worst()[0] < -KEPT
    moved = answer.inputs.copy()
    moved[0] += 1e-3
    m = gains(one.design, [theta / 1.1 for theta in thetas])
    assert margins(one.design, m, ask.x[None], moved[None], answer.reference[None]).rest[0] < -KEPT


# --- bits ------------------------------------------------------------------------------------------------------------


def bits(answer: Answer) -> bytes:
    arrays = (answer.inputs, answer.states, answer.backoff_x, answer.backoff_u, answer.reference)
    numbers = (answer.slack, answer.offset, answer.terminal_miss, answer.cost, answer.cost_lower, answer.gap)
    return b"".join([*(array.tobytes() for array in arrays), np.array(numbers).tobytes(), answer.method.encode()])


def bits_of(solver: LibrarySolver, asks: list[Asked]) -> list[bytes]:
    return [bits(solver.solve(0, ask.x, ask.target, ask.outlook)) for ask in asks]


@pytest.mark.slow
@pytest.mark.parametrize("name", EACH_PRESET)
def test_same_question_same_bits_whatever_came_before(name: str) -> None:
    one = case(name)
    asks = list(all_kinds(one.design, 51, 3))
    fresh = bits_of(LibrarySolver(one.design, one.library), asks)
    alone = [bits_of(LibrarySolver(one.design, one.library), [ask])[0] for ask in asks[::4]]
    assert alone == fresh[::4]
    used, rng = LibrarySolver(one.design, one.library, exact=False), np.random.default_rng(52)
    for k in range(500):
        ask = asked(one.design, KINDS[k % len(KINDS)], rng)
        used.solve(k, ask.x, ask.target, ask.outlook)
    whole = LibrarySolver(one.design, one.library)
    for solver in (used, whole):
        for scale in (np.nan, np.inf, 1e3, 1e9, 1e200):
            solver.solve(0, one.design.target + scale * np.ones(one.design.plant.n_x), one.design.target)
        solver.solve(0, asks[0].x, asks[0].target, Preview(limits=np.full_like(limits(one.design), -1.0)))
    assert bits_of(whole, asks[::-1])[::-1] == fresh
    quick = [k for k, ask in enumerate(asks) if one.solver.solve(0, ask.x, ask.target, ask.outlook).method != "exact"]
    assert bits_of(used, [asks[k] for k in quick]) == [fresh[k] for k in quick]


@pytest.mark.slow
def test_another_process_gives_the_same_bits() -> None:
    name, one = "paper", case("paper")
    asks = list(all_kinds(one.design, 53, 2))
    program = (
        "import sys\n"
        "sys.path[:0] = sys.argv[1:]\n"
        "from library_rig import all_kinds, case\n"
        "from test_library_solver import bits_of\n"
        "one = case('paper')\n"
        "print(b''.join(bits_of(one.solver, list(all_kinds(one.design, 53, 2)))).hex())\n"
    )
    places = [str(TESTS / "support"), str(TESTS / "smpc" / "hahn_stursberg")]
    done = subprocess.run(
        [sys.executable, "-c", program, *places], capture_output=True, text=True, check=True, timeout=300
    )
    assert done.stdout.strip() == b"".join(bits_of(case(name).solver, asks)).hex()


# --- what cannot be met ----------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("name", EACH_PRESET)
def test_an_answer_every_time_and_what_gave_way_is_named(name: str) -> None:
    one = case(name)
    design, kinds = one.design, Counter[str]()
    for ask in hard_questions(design):
        answer = one.solver.solve(1, ask.x, ask.target, ask.outlook)
        assert answer.status is OK, ask.kind
        assert np.all(answer.inputs @ design.input_set.c.T <= design.input_set.b)
        told = gave_way(design, answer, one.components, ask.outlook)
        if max(answer.slack, answer.terminal_miss) > KEPT:
            assert answer.gave_way == told
            assert told
            kinds.update({way.constraint for way in answer.gave_way})
            state = {(way.stage, way.index) for way in answer.gave_way if way.constraint == "state"}
            b = limits(design) if ask.outlook.limits is None else ask.outlook.limits
            over = answer.states @ design.state_set.c.T + answer.backoff_x - b
            assert state == {(int(t), int(i)) for t, i in np.argwhere(over > KEPT) if t > 0}
        else:
            assert answer.gave_way == ()
        if ask.kind == "target out of reach":
            assert answer.offset > 1.0
        if ask.kind.startswith(("fence", "no place", "100", "10.0")):
            assert answer.gave_way
    assert {"state", "equilibrium"} <= set(kinds)


@pytest.mark.parametrize("name", EACH_PRESET)
def test_without_the_exact_program_a_mixture_or_infeasible_and_never_an_exception(name: str) -> None:
    one = case(name)
    exact, seen = exact_solver(name), Counter[SolveStatus]()
    for ask in hard_questions(one.design):
        answer = one.alone.solve(1, ask.x, ask.target, ask.outlook)
        seen[answer.status] += 1
        assert answer.status in (OK, SolveStatus.INFEASIBLE)
        if answer.status is OK:
            other = exact.solve(1, ask.x, ask.target, ask.outlook)
            assert answer.cost >= other.cost_lower - 1e-7 * abs(other.cost)
            assert answer.cost_lower <= other.cost + 1e-7 * abs(other.cost)
        else:
            assert answer.gave_way == ()
    assert min(seen[OK], seen[SolveStatus.INFEASIBLE]) > 3


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e160, 1e300])
@pytest.mark.parametrize("name", EACH_PRESET)
def test_numbers_that_are_none_fail_without_a_plan(name: str, bad: float) -> None:
    one = case(name)
    design, home = one.design, one.design.target
    spoilt = home.copy()
    spoilt[1] = bad
    path = Path(np.zeros((design.horizon, design.plant.n_x)), np.full((design.horizon, design.plant.n_u), bad))
    questions = [(spoilt, home, Preview()), (home, spoilt, Preview()), (home, home, Preview(path=path))]
    if not np.isfinite(bad):
        questions.append((home, home, Preview(limits=np.full_like(limits(design), bad))))
    for solver in (one.solver, one.alone):
        for x, target, outlook in questions:
            answer = solver.solve(9, x, target, outlook)
            assert (answer.seq, answer.status) == (9, SolveStatus.FAILED)
            assert answer.inputs.size == 0


def test_a_position_later_than_the_design_knows_fails() -> None:
    one = case("paper")
    answer = one.solver.solve(0, one.design.target, one.design.target, Preview(late=1))
    assert (answer.status, answer.inputs.size) == (SolveStatus.FAILED, 0)


# --- closed loops ---------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("name", EACH_PRESET)
def test_along_closed_loops_every_answer_is_certified_and_nearly_all_to_a_tenth_of_that(name: str) -> None:
    """`tools/accept_library.py` does it with thousands of states."""
    one, rng = case(name), np.random.default_rng(81)
    exact, gaps = exact_solver(name), []
    for _ in range(3):
        start = uniform(one.design, rng)
        for x in closed_loop(one, start, 0.3, 30, rng):
            answer, wanted = (solver.solve(0, x, one.design.target) for solver in (one.solver, exact))
            size = max(1.0, abs(wanted.cost))
            assert answer.cost_lower <= wanted.cost + 1e-7 * size
            assert answer.cost >= wanted.cost_lower - 1e-7 * size
            gaps.append(answer.gap)
    assert len(gaps) > 50
    assert max(gaps) <= TOLERANCE
    assert np.mean(np.array(gaps) <= 1e-4) > 0.97


# --- late positions --------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_late_positions_have_libraries_of_their_own_that_agree_with_the_exact_program() -> None:
    design = small(late=1)
    solver, exact = LibrarySolver(design, make_library(design, most=16)), ConicSolver(design)
    rng = np.random.default_rng(71)
    costs = []
    for _ in range(40):
        x = rng.uniform([-20.0, -5.0], [30.0, 5.0])
        fresh, late = (solver.solve(0, x, design.target, Preview(late=j)) for j in (0, 1))
        wanted = exact.solve(0, x, design.target, Preview(late=1))
        size = max(1.0, wanted.cost)
        assert (late.status, wanted.status) == (OK, OK)
        assert late.cost_lower <= wanted.cost + 1e-7 * size
        assert wanted.cost_lower - 1e-7 * size <= late.cost <= wanted.cost + 1e-3 * size
        costs.append(late.cost - fresh.cost)
    assert min(costs) > 0.0  # less is known
