"""The fallback in the control tick: its time, the way back, silence of the vehicle, and the operator's stop."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import msgspec
import pytest
from flight_rig import (
    DT_NS,
    HORIZON,
    MS,
    START_NS,
    TICKS,
    StubSolver,
    boundary_ns,
    find_boundaries,
    list_modes,
    make_controller,
    make_inputs,
    make_motion_samples,
    make_step_samples,
    run,
    sample,
    small_plant,
    vehicle,
)

from uavctl.records import ControlMode, SetpointSource, SolveStatus, VehicleStatus

WAIT, TRACK, BRAKE, HOLD, LAND, STOPPED = ControlMode


@pytest.mark.fault(3)
def test_fallback_brakes_holds_and_lands_once_each_in_its_time() -> None:
    outputs = run(make_controller(), make_inputs(range(220), make_motion_samples(0)))
    begins = {mode: list_modes(outputs).index(mode) for mode in (TRACK, BRAKE, HOLD, LAND, STOPPED)}
    assert begins[TRACK] == 0
    assert begins[BRAKE] == HORIZON * TICKS
    assert begins[HOLD] <= begins[BRAKE] + 40  # brake_s = 2 s
    assert begins[LAND] == begins[HOLD] + 60  # hold_s = 3 s
    assert begins[STOPPED] == begins[LAND] + 1
    assert list_modes(outputs) == sorted(list_modes(outputs), key=[TRACK, BRAKE, HOLD, LAND, STOPPED].index)
    assert [tick for tick, output in enumerate(outputs) if output.land] == [begins[LAND]]
    assert all((output.setpoint is None) == (tick >= begins[LAND]) for tick, output in enumerate(outputs))


def test_braking_takes_the_predicted_velocity_to_zero() -> None:
    outputs = run(make_controller(), make_inputs(range(220), make_motion_samples(0)))
    braking = [output for output in outputs if output.decision.mode is BRAKE]
    for output in braking:
        assert output.estimate is not None
        assert output.setpoint is not None
        assert output.setpoint.accel_mps2[0] == pytest.approx(-1.5 * output.estimate.mean[1])
        assert output.setpoint.source is SetpointSource.BRAKE
    first, last = braking[0].estimate, braking[-1].estimate
    assert first is not None
    assert last is not None
    assert abs(last.mean[1]) < 0.2 * abs(first.mean[1])
    holding = [output.setpoint for output in outputs if output.decision.mode is HOLD]
    assert {None if one is None else one.accel_mps2 for one in holding} == {(0.0, 0.0, 0.0)}


@pytest.mark.fault(3)
def test_without_landing_it_holds_on_and_recovers_however_late() -> None:
    silent = range(1, 100)
    outputs = run(make_controller(land=False), make_inputs(range(105 * TICKS), make_step_samples(lost=silent)))
    assert list_modes(find_boundaries(outputs))[60:] == [HOLD] * 42 + [TRACK] * 3


@pytest.mark.fault(9)
def test_recovers_with_a_new_plan_at_the_third_fresh_sample_in_a_row() -> None:
    lost = [*range(1, 6), *range(8, 12), 13]  # four lost in a row break it, one does not
    outputs = find_boundaries(run(make_controller(), make_inputs(range(17 * TICKS), make_step_samples(lost))))
    assert list_modes(outputs) == [TRACK] * 4 + [HOLD] * 11 + [TRACK] * 2  # at rest: nothing to brake
    assert [output.decision.fresh for output in outputs[4:16]] == [0, 0, 1, 2, 2, 2, 2, 0, 1, 1, 2, 3]
    recovered = outputs[15]
    assert recovered.plan is not None
    assert (recovered.decision.plan_seq, recovered.decision.plan_index) == (15, 0)
    assert "track" in [event.code for event in recovered.events]


@pytest.mark.fault(9)
def test_a_late_sample_is_not_a_fresh_one() -> None:
    late_ns = HORIZON * DT_NS // 3
    old = [sample(boundary_ns(n) - 50 * MS, boundary_ns(n) - 50 * MS + late_ns) for n in range(6, 20)]
    samples = [*make_step_samples(steps=1), *old]
    outputs = find_boundaries(run(make_controller(land=False), make_inputs(range(20 * TICKS), samples)))
    assert TRACK not in list_modes(outputs)[4:]
    assert {output.decision.fresh for output in outputs[4:]} == {0}


def test_recovers_with_a_camera_slower_than_a_step() -> None:
    seen_ns = [START_NS + n * 333_333_333 for n in range(20) if not 3 < n < 9]  # 3 Hz; none after 1 s, until 3 s
    samples = [sample(at_ns, at_ns + 20 * MS) for at_ns in seen_ns]
    outputs = find_boundaries(run(make_controller(), make_inputs(range(30 * TICKS), samples)))
    # The third one, of 3.67 s, is there at the boundary of 3.8 s.
    assert [mode is TRACK for mode in list_modes(outputs)[1:]] == [True] * 8 + [False] * 10 + [True] * 11


# With a phase of 20 ms a tick takes the sample 230 ms after its capture.
@pytest.mark.parametrize(("phase_ms", "falls", "recovers"), [(0, 6, 12), (20, 7, 13)])
def test_recovers_over_a_link_that_is_always_one_step_late(phase_ms: int, falls: int, recovers: int) -> None:
    seen_ns = [boundary_ns(n) + phase_ms * MS for n in range(30) if not 2 < n < 9]
    samples = [sample(at_ns, at_ns + 190 * MS) for at_ns in seen_ns]
    outputs = find_boundaries(run(make_controller(), make_inputs(range(20 * TICKS), samples)))
    want = [True] * (falls - 2) + [False] * (recovers - falls) + [True] * (20 - recovers)
    assert [mode is TRACK for mode in list_modes(outputs)[2:]] == want


def silent_in(ticks: range) -> Callable[[int], VehicleStatus | None]:
    return lambda tick: None if tick in ticks else vehicle()


@pytest.mark.fault(27)
def test_a_vehicle_that_falls_silent_in_flight_is_braked_and_held_and_flown_again_when_it_is_back() -> None:
    silent = range(10, 30)
    outputs = run(make_controller(), make_inputs(range(40), make_motion_samples(60, 0.5), status=silent_in(silent)))
    assert list_modes(outputs)[:11] == [TRACK] * 10 + [BRAKE]
    assert "no vehicle" in outputs[10].decision.reason
    assert set(list_modes(outputs)[10:30]) <= {BRAKE, HOLD}
    assert all(one.setpoint is not None for one in outputs)
    assert list_modes(outputs)[-5:] == [TRACK] * 5


@pytest.mark.fault(27)
@pytest.mark.parametrize("heard_again", [160, 161, 163])  # at a boundary, and between
def test_a_vehicle_that_was_silent_for_longer_than_it_is_held_lands_though_positions_are_there(
    heard_again: int,
) -> None:
    outputs = run(
        make_controller(),
        make_inputs(range(170), make_motion_samples(60, 0.5), status=silent_in(range(10, heard_again))),
    )
    muted = next(tick for tick, one in enumerate(outputs) if one.setpoint is None)
    assert 10 + 60 <= muted <= 10 + 40 + 60 + 1  # hold_s = 3 s after at most brake_s = 2 s
    assert set(list_modes(outputs)[muted:heard_again]) == {HOLD}
    assert all(one.setpoint is None for one in outputs[muted:])
    assert list_modes(outputs)[heard_again : heard_again + 2] == [LAND, STOPPED]
    assert [tick for tick, one in enumerate(outputs) if one.land] == [heard_again]


@pytest.mark.fault(27)
@pytest.mark.parametrize(("heard_again", "lands"), [(20, 116), (100, 116), (130, 130)])
def test_the_fallback_s_time_runs_on_while_the_vehicle_is_silent(heard_again: int, lands: int) -> None:
    # The speed does not matter: a brake that is not sent does not slow down, and brake_s = 2 s ends it at tick 56.
    parameters = replace(make_controller().fallback, brake_gain_1ps=0.0)
    controller = replace(make_controller(), fallback=parameters)
    outputs = run(controller, make_inputs(range(140), make_motion_samples(0), status=silent_in(range(17, heard_again))))
    want = [TRACK] * 16 + [BRAKE] * 40 + [HOLD] * (lands - 56) + [LAND]
    assert list_modes(outputs) == want + [STOPPED] * (140 - len(want))
    assert [tick for tick, output in enumerate(outputs) if output.land] == [lands]


@pytest.mark.parametrize(
    ("silent", "recovers"), [(range(5 * TICKS, 6 * TICKS + 1), 8), (range(8 * TICKS, 8 * TICKS + 1), 9)]
)
def test_silence_of_the_vehicle_is_no_way_round_the_fresh_samples(silent: range, recovers: int) -> None:
    inputs = make_inputs(range(11 * TICKS), make_step_samples(lost=range(1, 6)), status=silent_in(silent))
    outputs = run(make_controller(), inputs)
    assert list_modes(find_boundaries(outputs)) == [TRACK] * 4 + [HOLD] * (recovers - 4) + [TRACK] * (11 - recovers)
    assert all("no vehicle" in outputs[tick].decision.reason for tick in silent)


@pytest.mark.parametrize("status", [vehicle(armed=False), vehicle(external=False)])
def test_the_pilot_ends_the_fallback(status: VehicleStatus) -> None:
    taken_over = range(5 * TICKS, 6 * TICKS)
    inputs = make_inputs(
        range(8 * TICKS),
        make_step_samples(lost=range(1, 6)),
        status=lambda tick: status if tick in taken_over else vehicle(),
    )
    assert list_modes(find_boundaries(run(make_controller(), inputs))) == [TRACK] * 4 + [HOLD, WAIT] + [TRACK] * 2


def test_without_any_plan_the_fallback_takes_over_at_once() -> None:
    solver = StubSolver(
        small_plant(), faults={0: lambda answer: msgspec.structs.replace(answer, status=SolveStatus.INFEASIBLE)}
    )
    outputs = run(make_controller(solver), make_inputs(range(1), make_motion_samples(0)))
    assert outputs[0].decision.mode is BRAKE


@pytest.mark.fault(34)
@pytest.mark.parametrize("land", [True, False])
def test_operator_stop_brakes_then_hands_over_and_never_flies_a_plan_again(land: bool) -> None:
    stop = 10
    inputs = make_inputs(range(200), make_motion_samples(49), stop_from=stop)
    # The request may be a single tick: it is remembered.
    inputs[stop + 1 :] = [msgspec.structs.replace(inp, stop=False) for inp in inputs[stop + 1 :]]
    outputs = run(make_controller(land=land), inputs)
    after = list_modes(outputs)[stop:]
    ends = after.index(LAND if land else STOPPED)
    assert list_modes(outputs)[:stop] == [TRACK] * stop
    assert after[:ends] == [BRAKE] * (ends - 1) + [HOLD]
    assert 1 < ends <= 42  # 2 s of braking, and a tick until what it left is gone
    last = outputs[stop + ends - 1].setpoint
    assert last is not None
    assert last.accel_mps2 == (0.0, 0.0, 0.0)
    assert set(after[ends + 1 :]) == {STOPPED}
    assert [tick for tick, output in enumerate(outputs) if output.land] == ([stop + ends] if land else [])
    assert all(output.setpoint is None for output in outputs[stop + ends :])


@pytest.mark.fault(34)
def test_operator_stop_without_a_vehicle_to_hand_over_only_stops() -> None:
    outputs = run(make_controller(), make_inputs(range(6), make_step_samples(), stop_from=2, status=lambda tick: None))
    assert list_modes(outputs) == [WAIT, WAIT, STOPPED, STOPPED, STOPPED, STOPPED]
    assert not any(output.land for output in outputs)
    assert [output.setpoint is None for output in outputs] == [False] * 2 + [True] * 4


@pytest.mark.fault(34)
def test_operator_stop_before_the_first_position_hands_over_in_the_next_tick() -> None:
    outputs = run(make_controller(), make_inputs(range(5), [], stop_from=2))
    assert list_modes(outputs) == [WAIT, WAIT, HOLD, LAND, STOPPED]
    assert [output.land for output in outputs] == [False, False, False, True, False]
