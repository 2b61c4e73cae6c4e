"""The SMPC of many runs: its plans against those of the solver that flies, and runs that do not touch each other."""

from __future__ import annotations

import numpy as np
import pytest
from question_rig import case, near, small, uniform

from uavctl.arrays import Array
from uavctl.records import SolveStatus
from uavctl.smpc.answer import NOMINAL, Answer, Preview
from uavctl.smpc.batch import BatchSmpc, Information, SequentialDecider
from uavctl.smpc.hahn_stursberg.frozen import FROZEN, ShortcutDecider, ShortcutSolver


def decider() -> ShortcutDecider:
    one = case("paper")
    return ShortcutDecider(one.solver, one.design.target)


def test_answers_are_those_that_fly_bit_for_bit() -> None:
    """Frozen answers, exact ones, and those where one axis needs the exact program."""
    one, rng = case("paper"), np.random.default_rng(11)
    x = np.array([uniform(one.design, rng) if i % 2 else near(one.design, rng) for i in range(40)])
    found, methods = decider().decide(x, 0), []
    for i, state in enumerate(x):
        answer = one.solver.solve(0, state, one.design.target)
        assert found.solved[i] == (answer.status is SolveStatus.OPTIMAL)
        np.testing.assert_array_equal(found.inputs[i], answer.inputs)
        numbers = found.slack[i], found.cost[i], found.gap[i]
        assert numbers == (answer.slack, answer.cost, answer.gap)
        methods.append(answer.method)
    assert min(methods.count("frozen"), methods.count("exact")) > 5


class Counting:
    """A solver without a plan that counts how often it is asked."""

    def __init__(self) -> None:
        self.count = 0

    def solve(self, seq: int, x: Array, target: Array, preview: Preview = NOMINAL) -> Answer:
        self.count += 1
        return Answer.failed(seq, SolveStatus.FAILED, FROZEN)


def test_equal_states_are_asked_once() -> None:
    counting = Counting()
    x = np.tile([[35.0, -2.0, -20.0, -4.0], [1.0, 0.0, 0.0, 0.0]], (50, 1))
    found = SequentialDecider(counting, np.zeros(4), (12, 2)).decide(x, 0)
    assert counting.count == 2
    assert found.inputs.shape == (100, 12, 2)
    assert not found.solved.any()


def test_no_question_at_all_has_an_empty_answer() -> None:
    assert decider().decide(np.zeros((0, 4)), 0).inputs.shape == (0, 12, 2)


def test_the_order_and_the_company_of_states_change_nothing() -> None:
    one, rng = case("paper"), np.random.default_rng(17)
    x = np.array([near(one.design, rng) for _ in range(30)])
    x = np.vstack([x, x[:10]])
    order = rng.permutation(len(x))
    together, shuffled = decider().decide(x, 0), decider().decide(x[order], 0)
    alone = np.vstack([decider().decide(row[None], 0).inputs for row in x])
    np.testing.assert_array_equal(shuffled.inputs, together.inputs[order])
    np.testing.assert_array_equal(alone, together.inputs)


@pytest.mark.slow
def test_late_positions_are_answered_by_the_late_design() -> None:
    design = small(late_steps=1)
    solver = ShortcutSolver(design)
    one, rng = ShortcutDecider(solver, design.target), np.random.default_rng(19)
    x = np.array([uniform(design, rng) for _ in range(10)])
    for late in (0, 1):
        found = one.decide(x, late)
        wanted = [solver.solve(0, state, design.target, Preview(age=late)) for state in x]
        np.testing.assert_array_equal(found.cost, [answer.cost for answer in wanted])
    assert not one.decide(x, 2).solved.any()


def test_a_run_whose_state_is_not_finite_has_no_plan_and_disturbs_no_other() -> None:
    one, rng = case("paper"), np.random.default_rng(15)
    design = one.design
    good = np.array([near(design, rng) for _ in range(6)])
    x = good.copy()
    x[1, 0], x[3, 2], x[4, 3] = np.nan, np.inf, -np.inf
    asked = []
    for states in (x, good):
        pilot = BatchSmpc(decider(), design.plant, design.horizon, len(design.late), 0.5)
        pilot.begin(6)
        with np.errstate(invalid="ignore"):  # the brake of the three without a state
            asked.append(pilot.act(Information(0, np.zeros(6, dtype=np.intp), states, np.zeros((6, 0, 2)))))
        assert pilot.tally.decisions.sum() == np.isfinite(states).all(axis=1).sum()
    np.testing.assert_array_equal(asked[0][[0, 2, 5]], asked[1][[0, 2, 5]])
