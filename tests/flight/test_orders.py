"""Orders of the operator in the control tick: where they send the vehicle, when they are refused, what is told."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from flight_rig import (
    HORIZON,
    TICKS,
    StubSolver,
    assert_sound,
    find_boundaries,
    list_codes,
    list_modes,
    make_controller,
    make_inputs,
    make_motion_samples,
    make_rest_region,
    make_step_samples,
    run,
    small_plant,
    vehicle,
)

from uavctl.config import load_config
from uavctl.event_codes import EventCode
from uavctl.flight.controller import Controller
from uavctl.flight.mission import Waypoint
from uavctl.flight.tick import TickOutput
from uavctl.records import Command, ControlMode, Order, Severity, Vec3, VehicleStatus
from uavctl.wiring.controller import build_controller

WAIT, TRACK, BRAKE, HOLD, LAND, STOPPED = ControlMode
STAY, RESUME, DOWN, ENGAGE = (Command(order=order) for order in (Order.HOLD, Order.RESUME, Order.LAND, Order.ENGAGE))


def goto(*position_m: float) -> Command:
    north, east, down = position_m
    return Command(order=Order.GOTO, position_m=(north, east, down))


def places(outputs: list[TickOutput]) -> list[float | None]:
    """North of the target at each boundary."""
    return [None if one.decision.target is None else one.decision.target[0] for one in find_boundaries(outputs)]


def answers(output: TickOutput) -> list[str]:
    return [event.code for event in output.events if event.code in (EventCode.ORDER_ACCEPTED, EventCode.ORDER_REFUSED)]


def between(first_m: float, second_m: float, hold_ns: int = 0, land: bool = False) -> Controller:
    """The small plant with two waypoints; the vehicle of `make_step_samples` stays at 0."""
    controller = make_controller()
    waypoints = tuple(Waypoint(np.array([place, 0.0, 0.0]), hold_ns) for place in (first_m, second_m))
    return replace(controller, mission=replace(controller.mission, waypoints=waypoints, accept_m=0.2, land=land))


def test_goto_flies_to_a_place_and_stays_until_the_mission_is_resumed() -> None:
    commands = {6: (goto(3.0, 9.0, 9.0),), 4 * TICKS: (RESUME,)}
    outputs = run(between(1.0, 2.0), make_inputs(range(6 * TICKS), make_step_samples(), commands=commands))
    assert places(outputs) == [1.0, 1.0, 3.0, 3.0, 1.0, 1.0]
    assert [one.decision.waypoint for one in find_boundaries(outputs)] == [0, 0, None, None, 0, 0]
    assert answers(outputs[6]) == [EventCode.ORDER_ACCEPTED]  # axes that the plant has not are ignored
    assert set(list_modes(outputs)) == {TRACK}


@pytest.mark.parametrize(
    "position_m", [(5.001, 0.0, 0.0), (-7.0, 0.0, 0.0), (math.nan, 0.0, 0.0), (0.0, 0.0, math.inf), None]
)
def test_a_place_where_it_may_not_rest_is_refused_and_the_mission_goes_on(position_m: Vec3 | None) -> None:
    plain = run(between(1.0, 2.0), make_inputs(range(4 * TICKS), make_step_samples()))
    commands = {6: (Command(order=Order.GOTO, position_m=position_m),)}
    outputs = run(between(1.0, 2.0), make_inputs(range(4 * TICKS), make_step_samples(), commands=commands))
    assert answers(outputs[6]) == [EventCode.ORDER_REFUSED]
    assert outputs[6].events[0].severity is Severity.WARNING
    assert [one.decision for one in outputs] == [one.decision for one in plain]
    assert [one.setpoint for one in outputs] == [one.setpoint for one in plain]


@pytest.mark.parametrize("edge_m", [5.0, -5.0])
def test_the_edge_of_the_box_itself_is_flown_to(edge_m: float) -> None:
    outputs = run(
        between(1.0, 2.0), make_inputs(range(3 * TICKS), make_step_samples(), commands={6: (goto(edge_m, 0, 0),)})
    )
    assert places(outputs)[-1] == edge_m


def test_hold_stays_where_the_vehicle_comes_to_rest_inside_the_box() -> None:
    for speed_mps, room_m in ((1.0, 5.0), (1.0, 0.7)):
        controller = make_controller()
        inside = replace(make_rest_region(controller.plant), lower=np.array([-room_m]), upper=np.array([room_m]))
        controller = replace(controller, mission=replace(controller.mission, rest_region=inside))
        outputs = run(
            controller, make_inputs(range(5 * TICKS), make_motion_samples(5, speed_mps), commands={9: (STAY,)})
        )
        estimate = outputs[3 * TICKS].estimate
        assert estimate is not None
        # The rig's region says: half a second of the speed further.
        assert places(outputs)[3] == pytest.approx(min(estimate.mean[0] + 0.5 * estimate.mean[1], room_m))
        assert places(outputs)[3] == places(outputs)[4]
        assert places(outputs)[:3] == [0.0] * 3


def test_the_last_of_several_orders_counts_and_each_is_answered() -> None:
    commands = {5: (goto(1.0, 0, 0), goto(9.0, 0, 0), goto(2.0, 0, 0)), 6: (ENGAGE,), 7: (goto(3.0, 0, 0),)}
    outputs = run(between(0.5, 0.6), make_inputs(range(3 * TICKS), make_step_samples(), commands=commands))
    assert answers(outputs[5]) == [EventCode.ORDER_ACCEPTED, EventCode.ORDER_REFUSED, EventCode.ORDER_ACCEPTED]
    assert answers(outputs[6]) == []
    assert places(outputs) == [0.5, 0.5, 3.0]


def test_an_order_waits_for_news_and_for_the_way_back_from_the_fallback() -> None:
    lost = [2, 3]
    outputs = run(
        between(1.0, 2.0), make_inputs(range(5 * TICKS), make_step_samples(lost), commands={6: (goto(3.0, 0, 0),)})
    )
    assert places(outputs) == [1.0, 1.0, 1.0, 1.0, 3.0]
    gone = range(1, 8)
    outputs = run(
        between(1.0, 2.0), make_inputs(range(12 * TICKS), make_step_samples(gone), commands={30: (goto(3.0, 0, 0),)})
    )
    assert places(outputs) == [1.0] * 10 + [3.0] * 2
    assert list_modes(find_boundaries(outputs)) == [TRACK] * 4 + [HOLD] * 6 + [TRACK] * 2


def test_orders_before_the_flight_are_flown_from_its_first_plan_on() -> None:
    status = {True: vehicle(), False: vehicle(external=False)}
    outputs = run(
        between(1.0, 2.0),
        make_inputs(
            range(4 * TICKS),
            make_step_samples(),
            commands={0: (goto(3.0, 0, 0),)},
            status=lambda tick: status[tick >= TICKS],
        ),
    )
    assert places(outputs) == [None, 3.0, 3.0, 3.0]


def test_a_waypoint_left_half_way_is_held_for_its_whole_time_afterwards() -> None:
    hold_ns = 400_000_000  # two steps
    commands = {TICKS: (goto(3.0, 0, 0),), 4 * TICKS: (RESUME,)}
    controller = between(0.0, 2.0, hold_ns=hold_ns)
    outputs = run(controller, make_inputs(range(8 * TICKS), make_step_samples(), commands=commands))
    assert places(outputs) == [0.0, 3.0, 3.0, 3.0, 0.0, 0.0, 0.0, 2.0]


@pytest.mark.parametrize(("commands", "tick"), [({3: (RESUME,)}, 3), ({3: (STAY,), 8: (RESUME,), 13: (RESUME,)}, 13)])
def test_what_was_not_left_is_not_resumed(commands: dict[int, tuple[Command, ...]], tick: int) -> None:
    outputs = run(between(1.0, 2.0), make_inputs(range(5 * TICKS), make_step_samples(), commands=commands))
    assert answers(outputs[tick]) == [EventCode.ORDER_REFUSED]


@pytest.mark.parametrize("configured", [True, False])
def test_land_brakes_and_lands_whatever_the_fallback_is_configured_to(configured: bool) -> None:
    samples = make_motion_samples(49)
    outputs = run(make_controller(land=configured), make_inputs(range(100), samples, commands={10: (DOWN,)}))
    assert answers(outputs[10]) == [EventCode.ORDER_ACCEPTED]
    ends = list_modes(outputs).index(LAND)
    assert list_modes(outputs) == [TRACK] * 10 + [BRAKE] * (ends - 11) + [HOLD, LAND] + [STOPPED] * (99 - ends)
    assert 11 < ends <= 52  # brake_s = 2 s
    assert [tick for tick, output in enumerate(outputs) if output.land] == [ends]
    assert {event.severity for event in outputs[10].events} == {Severity.INFO}
    assert_sound(outputs)


def test_on_the_way_down_other_orders_are_refused() -> None:
    commands = {10: (DOWN,), 11: (goto(1.0, 0, 0), STAY), 12: (RESUME,), 90: (DOWN,)}
    outputs = run(make_controller(), make_inputs(range(100), make_motion_samples(49), commands=commands))
    assert answers(outputs[11]) == [EventCode.ORDER_REFUSED, EventCode.ORDER_REFUSED]
    assert answers(outputs[12]) == answers(outputs[90]) == [EventCode.ORDER_REFUSED]
    assert STOPPED in list_modes(outputs)


@pytest.mark.parametrize("status", [None, vehicle(armed=False), vehicle(external=False)])
def test_what_is_not_flown_is_not_landed(status: VehicleStatus | None) -> None:
    outputs = run(
        make_controller(), make_inputs(range(8), make_step_samples(), commands={4: (DOWN,)}, status=lambda _: status)
    )
    assert answers(outputs[4]) == [EventCode.ORDER_REFUSED]
    assert set(list_modes(outputs)) == {WAIT}


def test_a_landing_ordered_while_the_vehicle_is_silent_waits_until_it_is_heard() -> None:
    silent = range(8, 60)
    inputs = make_inputs(
        range(70),
        make_motion_samples(49),
        commands={20: (DOWN,)},
        status=lambda tick: None if tick in silent else vehicle(),
    )
    outputs = run(make_controller(land=False), inputs)
    assert answers(outputs[20]) == [EventCode.ORDER_ACCEPTED]
    assert list_modes(outputs).index(LAND) == 60
    muted = [tick for tick, one in enumerate(outputs) if one.setpoint is None]
    assert muted == list(range(muted[0], 70))  # from where landing was due on


@pytest.mark.parametrize("order", [goto(3.0, 0, 0), STAY])
def test_losing_every_position_ends_an_order_to_stay_too(order: Command) -> None:
    lost = range(6, 999)
    outputs = run(make_controller(), make_inputs(range(60 * TICKS), make_step_samples(lost), commands={9: (order,)}))
    falls = (5 + HORIZON) * TICKS
    assert list_modes(outputs)[:falls] == [TRACK] * falls
    assert list_modes(outputs)[falls] in (BRAKE, HOLD)
    assert list_modes(outputs).index(LAND) <= falls + 40 + 60  # brake_s = 2 s, hold_s = 3 s
    assert list_modes(outputs)[-1] is STOPPED


def test_a_mission_may_end_in_landing_after_the_last_waypoint_s_time() -> None:
    controller = between(0.0, 0.1, hold_ns=400_000_000, land=True)
    outputs = run(controller, make_inputs(range(9 * TICKS), make_step_samples()))
    # Arrives at once, two steps there; then a step to the next, which is as near, and two steps there.
    lands = 5 * TICKS
    assert list_modes(outputs)[:lands] == [TRACK] * lands
    assert list_modes(outputs).index(LAND) == list_modes(outputs).index(HOLD) + 1
    assert list_modes(outputs)[-1] is STOPPED
    held = run(between(0.0, 0.1, hold_ns=400_000_000), make_inputs(range(9 * TICKS), make_step_samples()))
    assert set(list_modes(held)) == {TRACK}


def test_an_order_puts_the_landing_at_the_end_off() -> None:
    controller = between(0.0, 0.1, land=True)
    commands = {1: (goto(1.0, 0, 0),), 6 * TICKS: (RESUME,)}
    outputs = run(controller, make_inputs(range(12 * TICKS), make_step_samples(), commands=commands))
    assert list_modes(outputs)[: 6 * TICKS] == [TRACK] * 6 * TICKS
    assert LAND in list_modes(outputs)


def test_a_plant_that_cannot_rest_everywhere_is_not_sent_anywhere() -> None:
    controller = make_controller()
    controller = replace(controller, mission=replace(controller.mission, rest_region=None))
    commands = {3: (goto(1.0, 0, 0), STAY)}
    outputs = run(controller, make_inputs(range(2 * TICKS), make_step_samples(), commands=commands))
    assert answers(outputs[3]) == [EventCode.ORDER_REFUSED, EventCode.ORDER_REFUSED]


def test_orders_and_their_answers_are_replayed_bit_for_bit() -> None:
    commands = {6: (goto(3.0, 0, 0),), 11: (STAY,), 17: (RESUME,), 40: (DOWN,)}
    inputs = make_inputs(range(20 * TICKS), make_motion_samples(80), commands=commands)
    assert run(make_controller(), inputs) == run(make_controller(StubSolver(small_plant())), inputs)


@pytest.mark.parametrize("preset", ["room-hahn-stursberg", "paper"])
def test_a_configured_flight_knows_where_it_may_rest(preset: str) -> None:
    config = load_config(preset, ["solver.method=exact"])
    controller = build_controller(config)
    region, plant = controller.mission.rest_region, controller.plant
    assert region is not None
    middle = (region.lower + region.upper) / 2
    for axis, (index, name) in enumerate(zip(plant.position_index, plant.axes, strict=True)):
        low, high = config.sets.state_lower[index], config.sets.state_upper[index]
        assert low < region.lower[axis] < region.upper[axis] < high
        for side, sign in ((region.lower[axis], -1.0), (region.upper[axis], 1.0)):
            place = middle.copy()
            place[axis] = side
            ned = [0.0, 0.0, 0.0]
            for value, ned_axis in zip(place, region.axes, strict=True):
                ned[ned_axis] = float(value)
            assert region.describe_refusal((ned[0], ned[1], ned[2])) == ""
            assert np.array(region.find_equilibrium((ned[0], ned[1], ned[2]))) == pytest.approx(
                plant.equilibrium((ned[0], ned[1], ned[2]))
            )
            ned[region.axes[axis]] += sign * 0.01
            assert region.describe_refusal((ned[0], ned[1], ned[2])).startswith(name)
    # From a speed it comes to rest ahead of where it is, and at rest it is where it is.
    x = np.array(region.find_equilibrium((0.0, 0.0, -1.0)))
    assert region.find_stop(tuple(x.tolist())) == pytest.approx(tuple(x.tolist()), abs=1e-9)
    x[plant.velocity_index[0]] = 1.0
    ahead = region.find_stop(tuple(x.tolist()))[plant.position_index[0]] - x[plant.position_index[0]]
    assert config.smpc.tau is not None
    assert 0.3 < ahead < (config.smpc.horizon - config.smpc.tau) * config.plant.dt_s


def test_events_of_orders_are_told_before_what_they_bring_about() -> None:
    outputs = run(make_controller(), make_inputs(range(20), make_motion_samples(9), commands={10: (DOWN,)}))
    assert list(list_codes(outputs[10])) == [EventCode.ORDER_ACCEPTED, "fallback-brake"]
