"""A controller of another package in the tick: what ends it, what flies then, and that it is not asked again."""

from __future__ import annotations

from dataclasses import replace

import pytest
from flight_rig import (
    MS,
    TICK_NS,
    TICKS,
    StubSolver,
    find_boundaries,
    list_codes,
    list_modes,
    make_controller,
    make_inputs,
    make_motion_samples,
    make_step_samples,
    run,
    small_plant,
    vehicle,
)
from msgspec import structs

from uavctl.event_codes import EventCode
from uavctl.flight.controller import Controller
from uavctl.flight.monitors.external import MAX_ANSWER_NS, MAX_OVERDUE_ANSWERS
from uavctl.flight.tick import TickOutput
from uavctl.records import ControlMode, SolveStatus, StepInput
from uavctl.smpc.answer import Answer

WHY = "the controller ours raised ZeroDivisionError: no gain"
SOON, LATE = TICK_NS - MS, TICK_NS + MS


def failed(answer: Answer) -> Answer:
    return Answer.failed(answer.seq, SolveStatus.FAILED, "ours", fault=WHY)


def flown_by(solver: StubSolver) -> Controller:
    return replace(make_controller(solver), outside="ours")


def told(outputs: list[TickOutput]) -> list[str]:
    return [event.text for one in outputs for event in one.events if event.code == EventCode.CONTROLLER_FAULT]


def timed(inputs: list[StepInput], took_ns: dict[int, int]) -> list[StepInput]:
    """The same with the time of the plan of the step before, in the tick after its boundary."""
    return [structs.replace(one, answered_ns=took_ns.get(one.tick, 0)) for one in inputs]


def test_one_that_fails_is_braked_at_once_told_once_and_landed() -> None:
    solver = StubSolver(small_plant(), faults={8: failed})
    outputs = run(flown_by(solver), make_inputs(range(120), make_motion_samples(40)))
    fell = outputs[8 * TICKS]
    assert fell.decision.mode is ControlMode.BRAKE and fell.decision.reason == WHY
    assert fell.decision.solve is SolveStatus.FAILED
    assert set(list_codes(fell)) == {EventCode.CONTROLLER_FAULT, "fallback-brake"}
    assert told(outputs) == [WHY]
    after = list_modes(outputs[8 * TICKS :])
    assert ControlMode.TRACK not in after and after[-1] is ControlMode.STOPPED
    assert [one.land for one in outputs].count(True) == 1
    assert solver.asked[-1][0] == 8


def test_it_is_not_asked_again_when_the_pilot_gives_the_vehicle_back() -> None:
    solver = StubSolver(small_plant(), faults={8: failed})
    away = range(8 * TICKS + 2, 12 * TICKS)
    inputs = make_inputs(range(120), make_motion_samples(40), status=lambda tick: vehicle(external=tick not in away))
    outputs = run(flown_by(solver), inputs)
    assert outputs[away[0]].decision.mode is ControlMode.WAIT
    back = outputs[12 * TICKS]
    assert back.decision.mode is ControlMode.BRAKE and back.decision.reason == WHY
    assert told(outputs) == [WHY] and solver.asked[-1][0] == 8


def test_a_plan_of_ours_that_fails_plays_out_as_before() -> None:
    solver = StubSolver(small_plant(), faults={8: lambda one: Answer.failed(one.seq, SolveStatus.FAILED, "x")})
    outputs = run(make_controller(solver), make_inputs(range(60), make_step_samples()))
    assert set(list_modes(find_boundaries(outputs)[1:])) == {ControlMode.TRACK} and not told(outputs)
    assert solver.asked[-1][0] == 14


@pytest.mark.parametrize(
    ("took_ns", "ends_in"),
    [
        ({}, None),
        (dict.fromkeys(range(5, 60, 4), SOON), None),
        (dict.fromkeys(range(21, 60, 4), LATE), 21 + 4 * (MAX_OVERDUE_ANSWERS - 1)),
        ({21: LATE, 25: LATE, 29: SOON, 33: LATE, 37: LATE, 41: SOON}, None),
        ({21: MAX_ANSWER_NS}, None),
        ({21: MAX_ANSWER_NS + 1}, 21),
    ],
)
def test_one_that_is_late_too_often_or_far_too_late_is_braked(took_ns: dict[int, int], ends_in: int | None) -> None:
    inputs = timed(make_inputs(range(60), make_step_samples()), took_ns)
    outputs = run(flown_by(StubSolver(small_plant())), inputs)
    fell = [n for n, mode in enumerate(list_modes(outputs)) if mode is ControlMode.BRAKE]
    assert fell[:1] == ([] if ends_in is None else [ends_in])
    assert len(told(outputs)) == (0 if ends_in is None else 1)
    if ends_in is not None:
        assert outputs[ends_in].decision.reason == told(outputs)[0]
        assert ControlMode.TRACK not in list_modes(outputs[ends_in:])
