"""Slew rows: their bounds, relaxed rows, and a plan from every state."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from baseline_rig import problem

from uavctl.arrays import Array
from uavctl.constraint_names import describe_relaxed, find_worst, name_constraints
from uavctl.records import GaveWay, SolveStatus
from uavctl.smpc.answer import Preview
from uavctl.smpc.conditioned.planner import ConditionedSolver
from uavctl.smpc.conditioned.program import SlewRows
from uavctl.smpc.link import bernoulli
from uavctl.smpc.nominal import ControlProblem, find_parts
from uavctl.smpc.sets import Polytope

LINK = bernoulli(np.array([0.7]))
ROOM_MPS3 = 5.0


def solver_of(case: ControlProblem, slew_mps3: float) -> ConditionedSolver:
    return ConditionedSolver(case, LINK, 0.05, slew_mps3=slew_mps3)


def hard_states(case: ControlProblem, count: int, seed: int) -> list[tuple[Array, Array, Array]]:
    """States, targets and inputs last sent, all of them beyond limits too."""
    rng = np.random.default_rng(seed)
    low, high = (np.where(np.isfinite(side), side, 1.0) for side in case.state_set.bounds)
    u_low, u_high = case.input_set.bounds
    result = []
    for _ in range(count):
        x, there = rng.uniform(1.2 * low, 1.2 * high), rng.uniform(1.2 * low, 1.2 * high)
        places = dict(zip(case.plant.axes, there[list(case.plant.position_index)].tolist(), strict=True))
        target = case.plant.equilibrium((places["north"], places["east"], places.get("down", 0.0)))
        result.append((x, target, rng.uniform(2.0 * u_low, 2.0 * u_high)))
    return result


@pytest.mark.parametrize(
    ("name", "slew_mps3"), [("room-hahn-stursberg", ROOM_MPS3), ("room-hahn-stursberg", 0.5), ("paper", 0.9)]
)
def test_every_state_has_a_plan_within_the_slew_limit(name: str, slew_mps3: float) -> None:
    case = problem(name)
    solver, d, side = solver_of(case, slew_mps3), case.plant.accel_map, slew_mps3 * case.plant.dt_s
    low, high = case.input_set.bounds
    relaxed = 0
    for seq, (x, target, sent) in enumerate(hard_states(case, 60, 3)):
        answer = solver.solve(seq, x, target, Preview(sent=sent))
        assert answer.status is SolveStatus.OPTIMAL
        assert (answer.inputs >= low).all() and (answer.inputs <= high).all()
        assert np.abs(np.diff(answer.inputs, axis=0) @ d.T).max() <= side + 1e-8
        over = np.abs(d @ (answer.inputs[0] - sent)) - side
        reported = {item.index: item.amount for item in answer.relaxed if item.constraint == "slew"}
        needed = np.abs(d @ (np.clip(sent, low, high) - sent)) - side
        # Up to what the first rows are apart by: two sets that only touch are no program.
        assert reported == pytest.approx({i: needed[i] for i in np.flatnonzero(needed > 1e-6)}, abs=1e-7)
        assert (over <= np.maximum(needed, 0.0) + 1e-7).all()
        relaxed += bool(reported)
    assert 0 < relaxed < 60


def test_a_plan_ends_at_rest_when_the_gate_has_limited_it() -> None:
    """A plan that is played out through the gate, tick by tick, ends near its predicted velocity."""
    case = problem("room-hahn-stursberg")
    plant, ticks = case.plant, 4
    x, target = plant.equilibrium((-2.0, -1.5, -0.8)), plant.equilibrium((1.5, 1.0, -1.2))
    x[[1, 4]] = 1.2, -1.0
    a, b, _ = plant.transition(plant.dt_s / ticks)
    speeds = []
    for slew_mps3 in (np.inf, ROOM_MPS3):
        answer = solver_of(case, slew_mps3).solve(0, x, target, Preview(sent=np.zeros(3)))
        state, sent, most = x, np.zeros(3), 0.0
        for t, want in enumerate(answer.inputs):
            for _ in range(ticks):
                step = ROOM_MPS3 * plant.dt_s / ticks
                sent = np.clip(want, sent - step, sent + step)
                state = a @ state + b @ sent
            most = max(most, float(np.abs(state - answer.states[t + 1])[[1, 4, 7]].max()))
        speeds.append(most)
    assert speeds[1] < 0.6 * speeds[0]


def test_a_limit_that_never_binds_has_no_row() -> None:
    case = problem("paper")
    # The gate of the preset lets a setpoint go from one limit to the other within a step.
    assert SlewRows(case.plant, case.input_set, 100.0).axes.size == 0
    assert SlewRows(case.plant, case.input_set, np.inf).axes.size == 0
    assert SlewRows(case.plant, case.input_set, 0.9).axes.tolist() == [0, 1]


def test_without_a_last_input_the_first_one_is_free() -> None:
    case = problem("room-hahn-stursberg")
    solver = solver_of(case, 0.5)
    x, target, _ = hard_states(case, 1, 4)[0]
    free = solver.solve(0, x, target).inputs
    held = solver.solve(0, x, target, Preview(sent=np.zeros(3))).inputs
    assert np.abs(free[0]).max() > 0.2 > 0.1 + 1e-8 >= np.abs(held[0]).max()


def test_axes_that_share_inputs_are_one_part() -> None:
    case = problem("paper")
    assert len(find_parts(case)) == 2
    mixed = replace(case.plant, accel_per_input=np.array([[0.5, 0.1], [0.0, 0.5]]))
    shared = replace(case, plant=mixed)
    assert len(find_parts(shared, SlewRows(mixed, case.input_set, 0.9).d)) == 1
    sent = np.array([6.0, -9.0])
    answer = solver_of(shared, 0.9).solve(0, np.array([20.0, 2.0, -10.0, 1.0]), case.target, Preview(sent=sent))
    change = np.diff(answer.inputs, axis=0, prepend=sent[None]) @ mixed.accel_map.T
    assert answer.status is SolveStatus.OPTIMAL
    assert np.abs(change[1:]).max() <= 0.9 + 1e-8


def test_first_rows_reach_an_input_set_that_is_no_box() -> None:
    case = problem("paper")
    c = np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]])
    diamond = Polytope(c, np.full(4, 2.0))
    rows = SlewRows(case.plant, diamond, 0.1)
    at, side = rows.measure_first_step(np.array([3.0, 0.0]))
    scale = case.plant.accel_map[0, 0]
    assert at == pytest.approx([3.0 * scale, 0.0])
    assert side == pytest.approx([1.0 * scale, 0.1])
    solver = ConditionedSolver(replace(case, input_set=diamond), LINK, 0.05, slew_mps3=0.1)
    answer = solver.solve(0, np.array([20.0, 2.0, -10.0, 1.0]), case.target, Preview(sent=np.array([3.0, 0.0])))
    assert answer.status is SolveStatus.OPTIMAL
    assert answer.inputs[0] == pytest.approx([2.0, 0.0], abs=1e-6)


def test_relaxed_constraints_are_described() -> None:
    names = name_constraints(np.eye(2), 2, ("north",), (0,), (1,))
    slew = GaveWay(constraint="slew", stage=0, index=0, amount=0.4)
    state = GaveWay(constraint="state", stage=1, index=0, amount=0.01)
    text = describe_relaxed(names, slew)
    assert "north" in text and "0.4 m/s²" in text
    assert find_worst(names, (slew, state)) is state
