"""The fast path of campaigns: its plans against the library solver's."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from library_rig import PRESETS, bounds, case, closed_loop, equilibrium, near, small, uniform
from numpy.typing import NDArray

from uavctl.build.controller import build_plant
from uavctl.config import load_config
from uavctl.lab.campaign.world import Flown, Scene, draw, fly, newest
from uavctl.records import SolveStatus
from uavctl.smpc.answer import NOMINAL, Answer, Preview
from uavctl.smpc.batch import BatchSmpc, Decider, Decisions, OneByOne, Tally
from uavctl.smpc.hahn_stursberg.design import Design
from uavctl.smpc.hahn_stursberg.explicit import ExplicitDecider
from uavctl.smpc.hahn_stursberg.frozen import FROZEN
from uavctl.smpc.hahn_stursberg.library import LibrarySolver, make_library

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

# A plan's inputs may differ by this, where 1e-6 is asked for.
SAME = 1e-9
# Costs and slacks may differ by the QP solver's rounding: a slack of 1e-7 costs 1e5 times that.
KEPT = 1e-6


@cache
def deciders(name: str) -> tuple[ExplicitDecider, OneByOne]:
    one = case(name)
    shape = (one.design.horizon, one.design.plant.n_u)
    target = one.design.target
    return ExplicitDecider(one.design, one.library, one.solver, target), OneByOne(one.solver, target, shape)


def agree(fast: Decisions, slow: Decisions) -> None:
    np.testing.assert_array_equal(fast.solved, slow.solved)
    np.testing.assert_allclose(fast.inputs, slow.inputs, rtol=0.0, atol=SAME)
    np.testing.assert_allclose(fast.slack, slow.slack, rtol=KEPT, atol=KEPT)
    np.testing.assert_allclose(fast.cost, slow.cost, rtol=KEPT)
    np.testing.assert_allclose(fast.gap, slow.gap, atol=KEPT)


def active(design: Design, x: Array, inputs: Array, answer: Answer) -> Flags:
    """Which rows of the plan are at their limits, less the answer's back-offs."""
    states = [x]
    for u in inputs:
        states.append(design.plant.a @ states[-1] + design.plant.b @ u)
    room_x = design.state_set.b - np.array(states) @ design.state_set.c.T - answer.backoff_x
    room_u = design.input_set.b - inputs @ design.input_set.c.T - answer.backoff_u
    at_limit: Flags = np.concatenate([room_x[1:].ravel(), room_u.ravel()]) < 1e-7
    return at_limit


@pytest.mark.parametrize("name", PRESETS)
def test_plans_are_the_solvers_over_the_box_with_the_same_rows_active(name: str) -> None:
    design, rng = case(name).design, np.random.default_rng(11)
    count = {"paper": 400, "room-hahn-stursberg": 60}[name]  # half of room's box asks for the exact program
    x = np.array([uniform(design, rng) if i % 2 else near(design, rng) for i in range(count)])
    fast, slow = deciders(name)
    decided = fast.decide(x, 0)
    agree(decided, slow.decide(x, 0))
    some = 0
    for state, inputs in zip(x, decided.inputs, strict=True):
        answer = case(name).solver.solve(0, state, design.target)
        rows = active(design, state, inputs, answer)
        np.testing.assert_array_equal(rows, active(design, state, answer.inputs, answer))
        some += bool(rows.any())
    assert some > count / 10


class Unasked:
    """A solver that only counts how often it is asked."""

    def __init__(self) -> None:
        self.count = 0

    def solve(self, seq: int, x: Array, target: Array, outlook: Preview = NOMINAL) -> Answer:
        self.count += 1
        return Answer.failed(seq, SolveStatus.FAILED, FROZEN)


@pytest.mark.parametrize("name", PRESETS)
def test_states_of_a_flight_are_answered_without_the_solver(name: str) -> None:
    one, rng, spy = case(name), np.random.default_rng(10), Unasked()
    fast = ExplicitDecider(one.design, one.library, spy, one.design.target)
    x = np.array([near(one.design, rng) for _ in range(300)])
    decided = fast.decide(0.5 * x + 0.5 * one.design.target, 0)
    assert spy.count == 0
    assert decided.solved.all()


@pytest.mark.parametrize("name", PRESETS)
def test_plans_are_the_solvers_along_closed_loops(name: str) -> None:
    one, rng = case(name), np.random.default_rng(12)
    start = {
        "paper": np.array([35.0, -2.0, -20.0, -4.0]),
        "room-hahn-stursberg": one.design.target + 0.3 * one.design.terminal.k[0],
    }
    x = [state for _ in range(10) for state in closed_loop(one, start[name], 0.3, 50, rng)]
    fast, slow = deciders(name)
    agree(fast.decide(np.array(x), 0), slow.decide(np.array(x), 0))


@pytest.mark.parametrize("seed", range(2))
def test_a_target_far_away_is_answered_alike(seed: int) -> None:
    one, rng = case("room-hahn-stursberg"), np.random.default_rng(seed)
    target = equilibrium(one.design, rng)
    shape = (one.design.horizon, one.design.plant.n_u)
    fast, slow = (ExplicitDecider(one.design, one.library, one.solver, target), OneByOne(one.solver, target, shape))
    rest = [equilibrium(one.design, rng) for _ in range(40)]
    away = np.array([0.7 * state + 0.3 * target for state in rest])
    agree(fast.decide(away, 0), slow.decide(away, 0))


def test_plans_are_the_solvers_where_regions_meet() -> None:
    design, rng = case("paper").design, np.random.default_rng(13)
    fast, slow = deciders("paper")
    solver = case("paper").solver
    borders: list[Array] = []

    def rows(x: Array) -> bytes:
        answer = solver.solve(0, x, design.target)
        return active(design, x, answer.inputs, answer).tobytes()

    while len(borders) < 40:
        inner, outer = near(design, rng), 3.0 * near(design, rng)
        first = rows(inner)
        if rows(outer) == first:
            continue
        for _ in range(45):
            middle = 0.5 * (inner + outer)
            inner, outer = (middle, outer) if rows(middle) == first else (inner, middle)
        borders += [inner, outer]
    found, wanted = fast.decide(np.array(borders), 0), slow.decide(np.array(borders), 0)
    np.testing.assert_array_equal(found.solved, wanted.solved)
    np.testing.assert_allclose(found.inputs, wanted.inputs, rtol=0.0, atol=1e-6)


def test_states_outside_everything_are_answered_by_the_solver_itself() -> None:
    design, rng = case("paper").design, np.random.default_rng(14)
    x = np.array([uniform(design, rng, boxes) for boxes in (1.5, 2.0, 3.0, 10.0, 100.0)])
    x = np.vstack([x, np.full(4, 1e13), np.full(4, -1e200)])
    fast, slow = deciders("paper")
    found, wanted = fast.decide(x, 0), slow.decide(x, 0)
    agree(found, wanted)
    assert found.solved[:3].all()


def test_corners_of_the_box_where_a_frozen_policy_has_no_plan_are_answered_alike() -> None:
    one = case("paper")
    low, high = bounds(one.design)
    corners = np.array(np.meshgrid(*np.stack([low, 0.5 * (low + high), high], axis=1))).reshape(4, -1).T
    fast, slow = deciders("paper")
    agree(fast.decide(corners, 0), slow.decide(corners, 0))


def test_numbers_that_are_not_finite_have_no_plan_and_disturb_no_other() -> None:
    design, rng = case("paper").design, np.random.default_rng(15)
    x = np.array([near(design, rng) for _ in range(6)])
    good = x.copy()
    x[1, 0], x[3, 2], x[4, 3] = np.nan, np.inf, -np.inf
    fast, _ = deciders("paper")
    found, wanted = fast.decide(x, 0), fast.decide(good, 0)
    np.testing.assert_array_equal(found.solved, [True, False, True, False, False, True])
    assert not found.inputs[~found.solved].any()
    assert np.isinf(found.cost[~found.solved]).all()
    np.testing.assert_allclose(found.inputs[found.solved], wanted.inputs[found.solved], atol=1e-12)


def test_no_question_at_all_has_an_empty_answer() -> None:
    found = deciders("paper")[0].decide(np.zeros((0, 4)), 0)
    assert found.inputs.shape == (0, 12, 2)


def test_a_plan_depends_on_nothing_that_was_asked_before() -> None:
    one, rng = case("paper"), np.random.default_rng(16)
    x = np.array([uniform(one.design, rng) for _ in range(60)])
    others = np.array([uniform(one.design, rng) for _ in range(60)])
    fresh = ExplicitDecider(one.design, one.library, LibrarySolver(one.design, one.library), one.design.target)
    wanted = fresh.decide(x, 0)
    fresh.decide(others, 0)
    again = fresh.decide(x, 0)
    other = ExplicitDecider(one.design, one.library, LibrarySolver(one.design, one.library), one.design.target)
    other.decide(others, 0)
    for found in (again, other.decide(x, 0)):
        for name in ("solved", "inputs", "slack", "cost", "gap"):
            np.testing.assert_array_equal(getattr(found, name), getattr(wanted, name))


def test_the_order_and_the_company_of_states_change_rounding_at_most() -> None:
    one, rng = case("paper"), np.random.default_rng(17)
    x = np.array([near(one.design, rng) for _ in range(50)])
    x = np.vstack([x, x[:10]])
    order = rng.permutation(len(x))
    fast, _ = deciders("paper")
    together, shuffled = fast.decide(x, 0), fast.decide(x[order], 0)
    np.testing.assert_allclose(shuffled.inputs, together.inputs[order], atol=1e-12)
    alone = np.vstack([fast.decide(row[None], 0).inputs for row in x])
    np.testing.assert_allclose(alone, together.inputs, atol=1e-12)


def test_frozen_plans_are_certified_to_rounding() -> None:
    one, rng = case("paper"), np.random.default_rng(18)
    x = [0.2 * near(one.design, rng) for _ in range(100)]
    frozen = np.array([s for s in x if one.solver.solve(0, s, one.design.target).method == FROZEN])
    assert len(frozen) > 50
    found = deciders("paper")[0].decide(frozen, 0)
    assert (np.abs(found.gap) < 1e-8).all()
    assert (found.slack == 0.0).all()


def test_late_positions_have_tables_of_their_own() -> None:
    design = small(late=1)
    library = make_library(design, most=12)
    solver = LibrarySolver(design, library)
    shape, rng = (design.horizon, design.plant.n_u), np.random.default_rng(19)
    fast, slow = ExplicitDecider(design, library, solver, design.target), OneByOne(solver, design.target, shape)
    x = np.array([uniform(design, rng) for _ in range(30)])
    for late in (0, 1):
        agree(fast.decide(x, late), slow.decide(x, late))
    assert not fast.decide(x, 2).solved.any()


# --- closed loop -----------------------------------------------------------------------------------------------------


def flown(decider: Decider) -> tuple[Flown, Tally]:
    """40 runs of 50 steps of the paper's example."""
    config, design = load_config("paper"), case("paper").design
    plant, runs, steps = build_plant(config), 40, 50
    chances = draw(21, 0, runs, steps, plant.n_w)
    start = np.tile([35.0, -2.0, -20.0, -4.0], (runs, 1))
    scene = Scene(plant, design.state_set, design.input_set, design.q_x, design.q_u, design.target, np.zeros(2), start)
    controller = BatchSmpc(decider, plant, design.horizon, len(design.late), 0.5)
    known = newest(config.link, config.plant.dt_s, chances.link)
    result = fly(scene, controller, known, chances.normal @ np.linalg.cholesky(plant.w).T)
    return result, controller.tally


def test_runs_fly_the_same_trajectories() -> None:
    (fast, tally), (slow, wanted) = (flown(decider) for decider in deciders("paper"))
    np.testing.assert_allclose(fast.states, slow.states, rtol=0.0, atol=1e-6)
    np.testing.assert_allclose(fast.inputs, slow.inputs, rtol=0.0, atol=1e-6)
    np.testing.assert_allclose(fast.cost.sum(axis=1), slow.cost.sum(axis=1), rtol=1e-9)
    for name in ("decisions", "infeasible", "slack_used", "fallbacks"):
        np.testing.assert_array_equal(getattr(tally, name), getattr(wanted, name))
    np.testing.assert_allclose(tally.largest_gap, wanted.largest_gap, atol=1e-8)
