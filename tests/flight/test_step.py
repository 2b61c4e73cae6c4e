"""The control tick: who flies when, what is held, and that the same inputs give the same bits."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest
from flight_rig import (
    DT_NS,
    HORIZON,
    MS,
    START_NS,
    TICK_NS,
    TICKS,
    StubSolver,
    boundary_ns,
    list_modes,
    make_controller,
    make_inputs,
    make_step_samples,
    run,
    sample,
    small_plant,
    stub_inputs,
    vehicle,
)
from msgspec import structs

from uavctl.flight.mission import Waypoint
from uavctl.records import ControlMode, SetpointSource, SolveStatus, VehicleStatus

WAIT, TRACK, BRAKE = ControlMode.WAIT, ControlMode.TRACK, ControlMode.BRAKE


def test_plans_at_the_first_boundary_with_a_position_and_holds_the_input_until_the_next() -> None:
    controller = make_controller()
    outputs = run(controller, make_inputs(range(2 * TICKS), make_step_samples()))
    assert list_modes(outputs) == [TRACK] * 2 * TICKS
    for tick, output in enumerate(outputs):
        number = tick // TICKS
        decision, setpoint = output.decision, output.setpoint
        assert setpoint is not None
        assert decision.boundary == (tick % TICKS == 0)
        assert (decision.step, decision.plan_seq, decision.plan_index) == (number, number, 0)
        assert decision.input == tuple(stub_inputs(number, HORIZON, 1)[0])
        assert setpoint.accel_mps2 == (decision.input[0], 0.0, 0.0)
        assert (setpoint.source, setpoint.limited, setpoint.at_ns) == (SetpointSource.PLAN, (), decision.at_ns)
        assert (output.plan is not None) == decision.news == decision.boundary
        assert decision.solve is (SolveStatus.OPTIMAL if decision.boundary else None)
        assert output.estimate is not None
        assert output.estimate.at_ns == decision.at_ns == START_NS + tick * TICK_NS


def test_a_plan_starts_from_the_estimate_at_the_boundary_and_says_where_it_comes_from() -> None:
    solver = StubSolver(small_plant())
    output = run(make_controller(solver), make_inputs(range(1), make_step_samples()))[0]
    plan, estimate = output.plan, output.estimate
    assert plan is not None
    assert estimate is not None
    assert solver.asked[0][1].tolist() == list(estimate.mean) == list(plan.states[0])
    assert (plan.base_ns, plan.captured_ns) == (START_NS, START_NS - 50 * MS)
    assert (plan.design_id, plan.method) == ("stub", "stub")
    assert plan.inputs.tolist() == [[0.0], [0.01], [0.02], [0.03]]


def test_nothing_is_sent_before_the_first_position() -> None:
    outputs = run(make_controller(), make_inputs(range(TICKS), []))
    assert list_modes(outputs) == [WAIT] * TICKS
    for output in outputs:
        decision = output.decision
        assert (output.setpoint, output.estimate, decision.input, decision.age_steps) == (None, None, None, None)


@pytest.mark.parametrize("status", [None, vehicle(armed=False), vehicle(external=False)])
def test_a_vehicle_that_takes_no_setpoints_gets_a_neutral_stream(status: VehicleStatus | None) -> None:
    solver = StubSolver(small_plant())
    outputs = run(
        make_controller(solver), make_inputs(range(3 * TICKS), make_step_samples(), status=lambda tick: status)
    )
    assert list_modes(outputs) == [WAIT] * 3 * TICKS
    for output in outputs:
        assert output.setpoint is not None
        assert (output.setpoint.accel_mps2, output.setpoint.source) == ((0.0, 0.0, 0.0), SetpointSource.HOLD)
    assert solver.asked == []


def test_engages_at_a_boundary_and_lets_go_at_once() -> None:
    external = range(2, 2 * TICKS + 1)
    outputs = run(
        make_controller(),
        make_inputs(range(3 * TICKS), make_step_samples(), status=lambda tick: vehicle(external=tick in external)),
    )
    want = [WAIT] * TICKS + [TRACK] * (TICKS + 1) + [WAIT] * (TICKS - 1)
    assert list_modes(outputs) == want
    assert [event.code for event in outputs[2 * TICKS + 1].events] == ["disengaged"]


def test_a_missed_boundary_is_decided_in_the_next_tick_as_it_would_have_been_then() -> None:
    solver = StubSolver(small_plant())
    punctual, late = make_controller(), make_controller(solver)
    after_the_boundary = sample(boundary_ns(2) + 10 * MS, position_m=(0.01, 0.0, 0.0))
    samples = [*make_step_samples(), after_the_boundary]
    missing = [tick for tick in range(3 * TICKS) if tick != 2 * TICKS]
    on_time = run(punctual, make_inputs(range(3 * TICKS), samples))
    outputs = {output.decision.tick: output for output in run(late, make_inputs(missing, samples))}
    output, other = outputs[2 * TICKS + 1], on_time[2 * TICKS]
    assert output.decision.boundary
    assert output.plan is not None
    assert other.plan is not None
    # The sample from after the boundary, and the input of step 2 that came a tick late, change nothing.
    assert output.plan == other.plan
    assert output.decision.missed_ticks == 1
    assert not outputs[2 * TICKS + 2].decision.boundary
    assert [seq for seq, _ in solver.asked] == [0, 1, 2]


def test_a_flight_may_begin_between_boundaries() -> None:
    first = 5 * TICKS + 1
    samples = [sample(START_NS + first * TICK_NS - 10 * MS), *make_step_samples()]
    outputs = run(make_controller(), make_inputs(range(first, first + TICKS), [samples[0], *samples[7:]]))
    assert list_modes(outputs) == [WAIT] * (TICKS - 1) + [TRACK]


def test_the_estimator_knows_the_input_after_the_last_gate() -> None:
    solver = StubSolver(
        small_plant(), faults={0: lambda answer: structs.replace(answer, inputs=answer.inputs * 0.0 + 50.0)}
    )
    outputs = run(make_controller(solver), make_inputs(range(TICKS + 1), [sample(START_NS, velocity_mps=(0, 0, 0))]))
    begin, end = outputs[0].estimate, outputs[TICKS].estimate
    assert begin is not None
    assert end is not None
    plant = small_plant()
    want = plant.a @ np.array(begin.mean) + plant.b @ np.array([2.0])
    np.testing.assert_allclose(end.mean, want, rtol=0, atol=1e-9)


def test_the_same_inputs_give_the_same_bits_from_a_rebuilt_controller_too() -> None:
    rng = np.random.default_rng(5)
    samples = [
        sample(
            boundary_ns(n) - int(rng.integers(0, 150)) * MS,
            boundary_ns(n) + int(rng.integers(0, 300)) * MS,
            position_m=(float(rng.normal()), float(rng.normal()), 0.0),
        )
        for n in range(60)
        if rng.random() < 0.5
    ]
    inputs = make_inputs(range(60 * TICKS), samples)
    solver = StubSolver(small_plant(("north", "east")))
    controller = make_controller(solver, land=False)
    rebuilt = pickle.loads(pickle.dumps(controller))
    once, again, other = run(controller, inputs), run(controller, inputs), run(rebuilt, inputs)
    assert once == again == other
    assert {TRACK, BRAKE} <= set(list_modes(once))


def test_ticks_must_divide_the_step_and_the_target_must_fit() -> None:
    controller = make_controller()
    with pytest.raises(ValueError, match="does not divide"):
        replace(controller, tick_ns=DT_NS // 3)
    with pytest.raises(ValueError, match="target"):
        replace(controller, mission=replace(controller.mission, waypoints=(Waypoint(np.zeros(2), 0),)))
