"""The hand-over tick by tick: without orders, the whole way, and what is ordered."""

from __future__ import annotations

import pytest
from hand_over_rig import ACCEPTED, DENIED, ENGAGE, FLY, NEUTRAL, NOTHING, NOW, TAKE_OFF, TICK_NS, HandoverRig
from msgspec.structs import replace

from uavctl.config.connections import HandOverConfig
from uavctl.event_codes import EventCode
from uavctl.mavlink.handover_guards import HEARTBEAT_TIMEOUT_NS
from uavctl.mavlink.handover_states import HandoverState
from uavctl.mavlink.requests import RequestKind
from uavctl.records import Command, Order, Severity


@pytest.mark.parametrize("state", [s for s in HandoverState if s not in (HandoverState.DONE, HandoverState.FAILED)])
def test_the_rig_gets_everywhere(state: HandoverState) -> None:
    assert HandoverRig().advance_to(state).state is state


# Without orders


def test_nothing_is_asked_for_without_an_order() -> None:
    rig = HandoverRig()
    assert rig.tick().setpoint_mode is NEUTRAL
    rig.run(10.0)
    rig.report_status(armed=True, landed=False, mode="OFFBOARD")
    assert rig.tick().setpoint_mode is FLY
    rig.run(10.0)
    assert not rig.asked and not rig.hand_over.is_ordered_flight and not rig.hand_over.failure


def test_no_neutral_stream_before_the_controller_is_ready() -> None:
    rig = HandoverRig()
    assert rig.tick(has_setpoint=False).setpoint_mode is NOTHING
    assert rig.tick(has_setpoint=True).setpoint_mode is NEUTRAL


@pytest.mark.fault(25)
@pytest.mark.parametrize(
    ("mode", "armed", "after"), [("POSCTL", True, HandoverState.TAKEN_OVER), ("OFFBOARD", False, HandoverState.DONE)]
)
def test_the_pilot_takes_over_for_good(mode: str, armed: bool, after: HandoverState) -> None:
    rig = HandoverRig().advance_to(HandoverState.ENGAGED)
    rig.report_status(mode=mode, armed=armed)
    assert rig.tick().setpoint_mode is NOTHING and rig.is_in(after)
    assert mode in rig.codes("hand-over")[-1]
    rig.report_status(mode="OFFBOARD", armed=True)  # PX4 goes back by itself as soon as setpoints come again
    for _ in range(20):
        assert rig.tick().setpoint_mode is NOTHING
    assert not rig.asked


@pytest.mark.fault(27)
def test_silence_while_engaged_is_told_once_and_the_controller_s_braking_is_sent() -> None:
    rig = HandoverRig().advance_to(HandoverState.ENGAGED)
    rig.mute = True
    for _ in range(HEARTBEAT_TIMEOUT_NS // TICK_NS):
        assert rig.tick().setpoint_mode is FLY
    assert not rig.codes("heartbeat")
    for _ in range(20):
        assert rig.tick().setpoint_mode is FLY
        # so that it brakes and holds, then lands
        assert rig.hand_over.select_controlled_status(rig.view.at_ns, rig.vehicle) is None
    rig.mute = False
    assert rig.tick().setpoint_mode is FLY
    assert len(rig.codes("heartbeat")) == 2  # lost, and back


def test_landing_is_asked_for_in_silence_too() -> None:
    rig = HandoverRig().advance_to(HandoverState.ENGAGED)
    rig.mute = True
    rig.run(10.0)
    assert rig.tick(is_landing_requested=True).request is RequestKind.LAND


def test_what_the_controller_may_fly() -> None:
    rig = HandoverRig()
    flown = rig.hand_over.select_controlled_status
    assert flown(NOW, None) is None
    assert rig.vehicle is not None and flown(NOW, rig.vehicle) == rig.vehicle
    assert flown(NOW + HEARTBEAT_TIMEOUT_NS + 1, rig.vehicle) is None
    rig.advance_to(HandoverState.TAKEN_OVER)
    rig.report_status(mode="OFFBOARD")
    seen = flown(rig.view.at_ns, rig.vehicle)
    assert seen is not None and not seen.external and "released" in seen.mode


# The whole way


def test_px4_goes_by_its_own_climb_and_offboard() -> None:
    rig = HandoverRig("px4")
    told = rig.tick()
    told = rig.tick(commands=(TAKE_OFF,))
    assert (rig.state, told.request, told.setpoint_mode) == (HandoverState.MODE, RequestKind.TAKE_OFF_MODE, NEUTRAL)
    rig.answer(ACCEPTED)
    assert rig.is_in(HandoverState.MODE)  # the heartbeat has to show it
    rig.report_status(mode="AUTO.TAKEOFF")
    assert rig.tick().request is RequestKind.ARM
    rig.answer(ACCEPTED)
    assert rig.is_in(HandoverState.CLIMBING)  # arming starts the climb; the heartbeat may be a second behind
    rig.tick(estimated_height_m=0.5)
    rig.report_status(armed=True)
    assert rig.tick(estimated_height_m=1.0, climb_rate_mps=1.0).request is None and rig.is_in(HandoverState.CLIMBING)
    told = rig.tick(estimated_height_m=1.4, climb_rate_mps=1.0)  # 0.5 s ahead: 1.9 of 2 m
    assert (rig.state, told.request, told.setpoint_mode) == (HandoverState.ENGAGING, RequestKind.EXTERNAL_MODE, NEUTRAL)
    told = rig.answer(ACCEPTED)
    assert (rig.state, told.setpoint_mode) == (HandoverState.ENGAGED, FLY)
    seen = rig.hand_over.select_controlled_status(rig.view.at_ns, rig.vehicle)  # which still says AUTO.TAKEOFF
    assert seen is not None and seen.external and seen.armed
    rig.report_status(mode="OFFBOARD")
    rig.run(3.0)
    assert rig.is_in(HandoverState.ENGAGED) and not rig.hand_over.failure
    assert [ask for _, ask in rig.asked] == [RequestKind.TAKE_OFF_MODE, RequestKind.ARM, RequestKind.EXTERNAL_MODE]


def test_ardupilot_climbs_in_guided_and_gets_no_setpoint_before_it_is_up() -> None:
    rig = HandoverRig("ardupilot")
    rig.tick()
    sent = [rig.tick(commands=(TAKE_OFF,)).setpoint_mode]
    rig.report_status(mode="GUIDED")
    sent.append(rig.tick().setpoint_mode)
    rig.report_status(armed=True)
    told = rig.tick()
    assert told.request is RequestKind.TAKE_OFF and rig.is_in(HandoverState.CLIMBING)
    sent += [told.setpoint_mode, rig.answer(ACCEPTED).setpoint_mode]
    sent += [rig.tick(estimated_height_m=0.01 * n, climb_rate_mps=1.0).setpoint_mode for n in range(180)]
    assert rig.is_in(HandoverState.CLIMBING) and set(sent) == {NOTHING}
    seen = rig.hand_over.select_controlled_status(rig.view.at_ns, rig.vehicle)
    assert seen is not None and not seen.external  # though it is in GUIDED
    rig.tick(estimated_height_m=1.81)
    assert rig.tick().setpoint_mode is FLY and rig.is_in(HandoverState.ENGAGED)
    assert [ask for _, ask in rig.asked] == [RequestKind.TAKE_OFF_MODE, RequestKind.ARM, RequestKind.TAKE_OFF]


@pytest.mark.fault(34)
def test_after_our_own_flight_landing_ends_disarmed() -> None:
    rig = HandoverRig("px4").advance_to(HandoverState.ENGAGING)
    rig.report_status(mode="OFFBOARD", landed=False)
    rig.tick()
    assert rig.tick(is_landing_requested=True).request is RequestKind.LAND
    rig.view = replace(rig.view, is_landing_requested=False)
    rig.report_status(mode="AUTO.LAND")
    rig.run(10.0)
    assert rig.is_in(HandoverState.SETTLING) and rig.hand_over.is_busy
    rig.report_status(
        armed=False, mode="OFFBOARD", landed=True
    )  # as recorded: PX4 shows the mode of before after disarming
    rig.tick()
    assert rig.is_in(HandoverState.DONE) and rig.hand_over.is_finished and not rig.hand_over.failure


def test_a_vehicle_that_stays_armed_on_the_ground_is_disarmed() -> None:
    rig = HandoverRig("px4").advance_to(HandoverState.ENGAGING)
    rig.report_status(mode="OFFBOARD", landed=False)
    rig.tick()
    rig.tick(is_landing_requested=True)
    rig.view = replace(rig.view, is_landing_requested=False)
    rig.report_status(mode="AUTO.LAND")
    rig.run(1.0)
    rig.report_status(landed=True)
    rig.run(4.9)
    assert rig.last_request(RequestKind.LAND)
    rig.run(0.3)
    assert rig.last_request(RequestKind.DISARM)
    rig.report_status(armed=False)
    rig.tick()
    assert rig.is_in(HandoverState.DONE)


def test_a_vehicle_that_never_lands_is_told_of() -> None:
    rig = HandoverRig("px4", HandOverConfig(land_s=20.0)).advance_to(HandoverState.ENGAGING)
    rig.report_status(mode="OFFBOARD", landed=False)
    rig.tick()
    rig.tick(is_landing_requested=True)
    rig.view = replace(rig.view, is_landing_requested=False)
    rig.report_status(mode="AUTO.LAND")
    rig.run(21.0)
    assert rig.is_in(HandoverState.FAILED) and "took too long" in rig.hand_over.failure


def test_px4_that_stops_below_the_height_is_flown_from_there_and_one_that_never_rose_is_not() -> None:
    rig = HandoverRig("px4").advance_to(HandoverState.CLIMBING)
    rig.report_status(mode="AUTO.LOITER")
    rig.tick(estimated_height_m=0.4)
    assert rig.is_in(HandoverState.CLIMBING)
    rig.tick(estimated_height_m=1.0)
    assert rig.is_in(HandoverState.ENGAGING)


# Orders


@pytest.mark.parametrize(
    "state", [HandoverState.MODE, HandoverState.ENGAGED, HandoverState.TAKEN_OVER, HandoverState.LANDING]
)
def test_take_off_is_ordered_once_and_on_the_ground(state: HandoverState) -> None:
    rig = HandoverRig().advance_to(state)
    told = rig.tick(commands=(TAKE_OFF,))
    assert [event.code for event in told.events if event.code.startswith("order")] == [EventCode.ORDER_REFUSED]
    assert rig.is_in(state)


def test_an_order_before_the_vehicle_is_heard_waits_for_it() -> None:
    rig = HandoverRig()
    vehicle, rig.vehicle = rig.vehicle, None
    told = rig.tick(commands=(TAKE_OFF,))
    assert [event.code for event in told.events] == [EventCode.ORDER_ACCEPTED]
    rig.run(5.0)
    assert rig.is_in(HandoverState.WAITING)
    rig.vehicle = vehicle
    rig.run(0.2)
    assert rig.is_in(HandoverState.MODE)


@pytest.mark.fault(26)
@pytest.mark.parametrize(
    ("fields", "autopilot", "why"),
    [
        ({"armed": True, "landed": False}, "px4", "already armed"),
        ({"alone": False}, "px4", "another vehicle"),
        ({}, "unknown", "not supported"),
    ],
)
def test_a_vehicle_that_must_not_be_armed_ends_it_at_once(fields: dict[str, object], autopilot: str, why: str) -> None:
    rig = HandoverRig(autopilot).advance_to(HandoverState.READY)
    rig.report_status(**fields)
    rig.tick(commands=(TAKE_OFF,))
    assert rig.is_in(HandoverState.FAILED) and why in rig.hand_over.failure
    assert not rig.asked and rig.codes("refused") == [rig.hand_over.failure]


@pytest.mark.parametrize(
    ("vehicle", "unfit", "why"), [(False, "", "no vehicle"), (True, "positions are old", "positions are old")]
)
def test_readiness_is_waited_for_with_a_bound(vehicle: bool, unfit: str, why: str) -> None:
    rig = HandoverRig(config=HandOverConfig(ground_s=5.0))
    rig.vehicle = rig.vehicle if vehicle else None
    rig.tick(commands=(TAKE_OFF,), arming_refusal=unfit)
    rig.run(4.8)
    assert rig.is_in(HandoverState.WAITING, HandoverState.READY)
    rig.run(0.5)
    assert rig.is_in(HandoverState.FAILED) and why in rig.hand_over.failure and not rig.asked


def test_a_silent_vehicle_is_waited_for_with_a_bound() -> None:
    rig = HandoverRig(config=HandOverConfig(ground_s=5.0)).advance_to(HandoverState.READY)
    rig.mute = True
    rig.run(4.0)
    rig.tick(commands=(TAKE_OFF,))
    rig.run(5.1)
    assert rig.is_in(HandoverState.FAILED) and "silent" in rig.hand_over.failure


def test_positions_that_grow_old_hold_arming_back() -> None:
    rig = HandoverRig(config=HandOverConfig(ground_s=5.0)).advance_to(HandoverState.MODE)
    rig.view = replace(rig.view, arming_refusal="the newest position is 1.2 s old")
    rig.report_status(mode="AUTO.TAKEOFF")
    rig.run(4.9)
    assert rig.is_in(HandoverState.ARMING) and RequestKind.ARM not in [ask for _, ask in rig.asked]
    rig.run(0.3)
    assert rig.is_in(HandoverState.FAILED) and "1.2 s old" in rig.hand_over.failure


@pytest.mark.fault(16)
@pytest.mark.parametrize("state", [HandoverState.MODE, HandoverState.ARMING])
def test_a_second_vehicle_on_the_way_ends_it(state: HandoverState) -> None:
    rig = HandoverRig().advance_to(state)
    rig.report_status(alone=False)
    rig.tick()
    assert rig.is_in(HandoverState.FAILED) and "another vehicle" in rig.hand_over.failure


@pytest.mark.fault(25)
def test_engaging_again_takes_an_order_and_a_vehicle_in_the_air() -> None:
    rig = HandoverRig().advance_to(HandoverState.TAKEN_OVER)
    told = rig.tick(commands=(ENGAGE,))
    assert (rig.state, told.request, told.setpoint_mode) == (
        HandoverState.RETURNING,
        RequestKind.EXTERNAL_MODE,
        NEUTRAL,
    )
    assert [event.code for event in told.events if event.code.startswith("order")] == [EventCode.ORDER_ACCEPTED]
    rig.report_status(mode="OFFBOARD")
    assert rig.tick().setpoint_mode is FLY


def test_engaging_a_vehicle_that_is_back_by_itself_asks_for_nothing() -> None:
    rig = HandoverRig().advance_to(HandoverState.TAKEN_OVER)
    rig.report_status(mode="OFFBOARD")
    rig.tick(commands=(ENGAGE,))
    assert rig.tick().setpoint_mode is FLY and not rig.asked


@pytest.mark.parametrize(
    ("state", "fields", "view", "why"),
    [
        (HandoverState.TAKEN_OVER, {"landed": True}, {}, "not in the air"),
        (HandoverState.TAKEN_OVER, {}, {"arming_refusal": "no position"}, "no position"),
        (HandoverState.ENGAGED, {}, {}, "nothing to engage"),
        (HandoverState.READY, {}, {}, "not in the air"),
        (HandoverState.TAKEN_OVER, {"autopilot": "unknown"}, {}, "no known vehicle"),
    ],
)
def test_engaging_is_refused_with_the_reason(
    state: HandoverState, fields: dict[str, object], view: dict[str, object], why: str
) -> None:
    rig = HandoverRig().advance_to(state)
    rig.report_status(**fields)
    told = rig.tick(commands=(ENGAGE,), **view)
    (refused,) = [event for event in told.events if event.code == EventCode.ORDER_REFUSED]
    assert why in refused.text and refused.severity is Severity.WARNING
    assert rig.is_in(state)


@pytest.mark.fault(25)
@pytest.mark.parametrize(
    ("mode", "armed", "after"), [("ALTCTL", True, HandoverState.TAKEN_OVER), ("POSCTL", False, HandoverState.DONE)]
)
def test_the_pilot_may_break_off_the_return(mode: str, armed: bool, after: HandoverState) -> None:
    rig = HandoverRig().advance_to(HandoverState.RETURNING)
    rig.report_status(mode=mode, armed=armed)
    rig.tick()
    assert rig.is_in(after) and not rig.hand_over.failure


def test_a_return_that_is_refused_leaves_the_pilot_in_charge() -> None:
    rig = HandoverRig().advance_to(HandoverState.RETURNING)
    rig.answer(DENIED, text="no way")
    assert rig.is_in(HandoverState.TAKEN_OVER) and not rig.hand_over.failure and not rig.hand_over.is_finished
    assert "DENIED" in rig.codes("refused")[0] and "no way" in rig.codes("refused")[0]


def test_other_orders_are_the_controller_s() -> None:
    rig = HandoverRig().advance_to(HandoverState.ENGAGED)
    assert rig.tick(commands=(Command(order=Order.HOLD),)).events == ()
