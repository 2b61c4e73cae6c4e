"""The SMPC of many runs: its plans against those of the flying solver, and independent runs."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from question_rig import case, near, small, uniform

from uavctl.arrays import Array
from uavctl.records import SolveStatus
from uavctl.smpc.answer import NOMINAL, Answer, Preview
from uavctl.smpc.batch import BatchSmpc, Information, SequentialDecider
from uavctl.smpc.hahn_stursberg.shortcut import FROZEN, ShortcutDecider, ShortcutSolver


@cache
def sequential_solver() -> ShortcutSolver:
    return ShortcutSolver(case("paper").design, sequential=True)


def decider(*, sequential: bool = False) -> ShortcutDecider:
    item = case("paper")
    return ShortcutDecider(sequential_solver() if sequential else item.solver, item.design.target)


@pytest.mark.parametrize("sequential", [False, True])
def test_answers_are_those_of_single_questions_bit_for_bit(sequential: bool) -> None:
    """Frozen answers, exact ones, and those where the axes have different methods."""
    item, rng = case("paper"), np.random.default_rng(11)
    solver = sequential_solver() if sequential else item.solver
    x = np.array([uniform(item.design, rng) if i % 2 else near(item.design, rng) for i in range(40)])
    result, methods = decider(sequential=sequential).decide(x, 0), []
    for i, state in enumerate(x):
        answer = solver.solve(0, state, item.design.target)
        assert result.solved[i] == (answer.status is SolveStatus.OPTIMAL)
        np.testing.assert_array_equal(result.inputs[i], answer.inputs)
        numbers = result.slack[i], result.cost[i], result.gap[i]
        assert numbers == (answer.slack, answer.cost, answer.gap)
        methods.append(answer.method)
    assert min(methods.count("frozen"), methods.count("sequential" if sequential else "exact")) > 5


class Counting:
    """Solver without a plan that counts its questions."""

    def __init__(self) -> None:
        self.count = 0

    def solve(self, seq: int, x: Array, target: Array, preview: Preview = NOMINAL) -> Answer:
        self.count += 1
        return Answer.failed(seq, SolveStatus.FAILED, FROZEN)


def test_equal_states_are_solved_once() -> None:
    counting = Counting()
    x = np.tile([[35.0, -2.0, -20.0, -4.0], [1.0, 0.0, 0.0, 0.0]], (50, 1))
    result = SequentialDecider(counting, np.zeros(4), (12, 2)).decide(x, 0)
    assert counting.count == 2
    assert result.inputs.shape == (100, 12, 2)
    assert not result.solved.any()


def test_no_questions_have_an_empty_answer() -> None:
    assert decider().decide(np.zeros((0, 4)), 0).inputs.shape == (0, 12, 2)


@pytest.mark.parametrize("sequential", [False, True])
def test_order_and_number_of_states_change_nothing(sequential: bool) -> None:
    item, rng = case("paper"), np.random.default_rng(17)
    x = np.array([near(item.design, rng) for _ in range(30)])
    x = np.vstack([x, x[:10]])
    order = rng.permutation(len(x))
    tested = decider(sequential=sequential)
    together, shuffled = tested.decide(x, 0), tested.decide(x[order], 0)
    single = np.vstack([tested.decide(row[None], 0).inputs for row in x])
    np.testing.assert_array_equal(shuffled.inputs, together.inputs[order])
    np.testing.assert_array_equal(single, together.inputs)


@pytest.mark.slow
def test_late_positions_are_answered_by_the_late_design() -> None:
    design = small(late_steps=1)
    solver = ShortcutSolver(design)
    item, rng = ShortcutDecider(solver, design.target), np.random.default_rng(19)
    x = np.array([uniform(design, rng) for _ in range(10)])
    for late in (0, 1):
        result = item.decide(x, late)
        expected = [solver.solve(0, state, design.target, Preview(age=late)) for state in x]
        np.testing.assert_array_equal(result.cost, [answer.cost for answer in expected])
    assert not item.decide(x, 2).solved.any()


def test_a_run_with_a_state_that_is_not_finite_affects_no_other() -> None:
    item, rng = case("paper"), np.random.default_rng(15)
    design = item.design
    good = np.array([near(design, rng) for _ in range(6)])
    x = good.copy()
    x[1, 0], x[3, 2], x[4, 3] = np.nan, np.inf, -np.inf
    requested = []
    for states in (x, good):
        pilot = BatchSmpc(decider(), design.plant, design.horizon, len(design.late), 0.5)
        pilot.begin(6)
        with np.errstate(invalid="ignore"):  # the brake of the three without a state
            requested.append(pilot.act(Information(0, np.zeros(6, dtype=np.intp), states, np.zeros((6, 0, 2)))))
        assert pilot.tally.decisions.sum() == np.isfinite(states).all(axis=1).sum()
    np.testing.assert_array_equal(requested[0][[0, 2, 5]], requested[1][[0, 2, 5]])
