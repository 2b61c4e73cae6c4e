"""A failsafe of the vehicle's own on a flight that we began: waited for, taken up after, or landed; and the pilot."""

from __future__ import annotations

import pytest
from hand_over_rig import ACCEPTED, ENGAGE, FLY, NEUTRAL, NOTHING, SECOND, TAKE_OFF, TICK_NS, HandoverRig
from msgspec.structs import replace

from uavctl.config.connections import HandOverConfig
from uavctl.mavlink.handover import HandoverStateMachine
from uavctl.mavlink.handover_guards import LAND_PERIODS
from uavctl.mavlink.handover_states import HandoverState
from uavctl.mavlink.messages import StatusText
from uavctl.mavlink.requests import RequestKind
from uavctl.records import Severity

BOTH = pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])
WORDS = StatusText(system=1, component=1, severity=2, text="Failsafe activated")


def engaged(autopilot: str = "px4", config: HandOverConfig | None = None) -> HandoverRig:
    """A flight that we began, engaged."""
    rig = HandoverRig(autopilot, config).advance_to(HandoverState.ENGAGING)
    rig.report_status(mode="OFFBOARD" if autopilot == "px4" else "GUIDED", landed=False)
    rig.run(1.0, until=HandoverState.ENGAGED)
    return rig


@pytest.mark.fault(61)
@pytest.mark.parametrize("state", [HandoverState.ARMING, HandoverState.CLIMBING, HandoverState.ENGAGING])
def test_a_failsafe_that_ends_on_the_way_up_is_waited_for_and_the_climb_goes_on(state: HandoverState) -> None:
    rig = HandoverRig().advance_to(state)
    rig.report_status(armed=True)
    rig.tick(WORDS, estimated_height_m=0.0)
    assert rig.fail().setpoint_mode is NOTHING and rig.is_in(HandoverState.FAILSAFE)
    rig.run(1.0)
    rig.report_status(mode="AUTO.TAKEOFF", failsafe=False)
    assert rig.tick().setpoint_mode is NEUTRAL and rig.is_in(HandoverState.CLIMBING)
    rig.tick(estimated_height_m=1.9)
    assert rig.is_in(HandoverState.ENGAGING)
    rig.report_status(mode="OFFBOARD")
    assert rig.tick().setpoint_mode is FLY
    told = [event for event in rig.events if event.code == "hand-over" and "failsafe" in event.text]
    assert {event.severity for event in told} == {Severity.WARNING} and len(told) == 2


@pytest.mark.fault(25, 61)
@pytest.mark.parametrize("state", [HandoverState.CLIMBING, HandoverState.ENGAGING])
@pytest.mark.parametrize(
    ("mode", "failsafe"), [("AUTO.LAND", False), ("AUTO.RTL", False), ("POSCTL", True), ("MANUAL", True)]
)
def test_with_his_switch_or_in_a_mode_that_a_person_flies_it_is_not_waited_for(
    state: HandoverState, mode: str, failsafe: bool
) -> None:
    rig = HandoverRig().advance_to(state)
    rig.report_status(mode=mode, failsafe=failsafe, stick=not failsafe)
    assert rig.tick().setpoint_mode is NOTHING and rig.is_in(HandoverState.TAKEN_OVER)
    rig.report_status(mode="AUTO.TAKEOFF", failsafe=False)
    rig.run(60.0)
    assert rig.is_in(HandoverState.TAKEN_OVER)  # for good


@pytest.mark.fault(61)
def test_the_climb_has_one_time_however_often_a_failsafe_interrupts_it() -> None:
    rig = HandoverRig(config=HandOverConfig(climb_s=10.0)).advance_to(HandoverState.CLIMBING)
    for _ in range(20):
        if rig.is_in(HandoverState.CLIMBING, HandoverState.FAILSAFE):
            rig.fail()
            rig.run(0.5)
            rig.report_status(mode="AUTO.TAKEOFF", failsafe=False)
            rig.run(0.5)
    assert rig.is_in(HandoverState.LANDING) and rig.last_request(RequestKind.LAND) and rig.hand_over.failure
    begun_ns = next(at_ns for at_ns, ask in rig.asked if ask is RequestKind.LAND)
    assert begun_ns - rig.asked[1][0] <= 11 * SECOND


@pytest.mark.fault(61)
@BOTH
def test_a_failsafe_that_lands_is_left_to_it_and_told_of(autopilot: str) -> None:
    rig = HandoverRig(autopilot).advance_to(HandoverState.CLIMBING)
    rig.tick(WORDS)
    rig.fail()
    rig.run(30.0)
    assert (
        rig.is_in(HandoverState.FAILSAFE)
        and rig.hand_over.is_busy
        and RequestKind.LAND not in [ask for _, ask in rig.asked]
    )
    rig.report_status(armed=False, failsafe=False)
    rig.tick()
    assert rig.is_in(HandoverState.DONE)
    assert "Failsafe activated" in rig.hand_over.failure


@pytest.mark.fault(61)
@pytest.mark.parametrize(
    ("autopilot", "mode", "within_s"),
    [("px4", "AUTO.LAND", 61), ("px4", "AUTO.LOITER", 21), ("ardupilot", "LAND", 61), ("ardupilot", "BRAKE", 21)],
)
def test_what_hovers_in_a_failsafe_is_landed_in_bounded_time(autopilot: str, mode: str, within_s: float) -> None:
    rig = engaged(autopilot)
    rig.fail(mode)
    assert rig.is_in(HandoverState.FAILSAFE)
    rig.run(within_s, until=HandoverState.LANDING)
    assert rig.last_request(RequestKind.LAND) and "has not ended" in rig.hand_over.failure


@pytest.mark.fault(25, 61)
def test_a_pilot_who_takes_over_in_the_very_tick_in_which_time_is_up_is_not_landed() -> None:
    rig = engaged(config=HandOverConfig(climb_s=5.0))
    rig.fail("AUTO.LOITER")
    rig.run(4.95)
    assert rig.is_in(HandoverState.FAILSAFE)
    rig.report_status(mode="POSCTL", failsafe=False)
    rig.run(1.0)
    assert rig.is_in(HandoverState.TAKEN_OVER) and RequestKind.LAND not in [ask for _, ask in rig.asked]


@pytest.mark.fault(8, 61)
def test_an_engaged_flight_is_taken_up_again_by_order_only() -> None:
    rig = engaged()
    rig.fail("AUTO.LOITER")
    rig.run(3.0)
    rig.report_status(mode="OFFBOARD", failsafe=False)
    rig.run(3.0)
    assert rig.is_in(HandoverState.FAILSAFE)
    assert rig.tick(commands=(ENGAGE,)).setpoint_mode is NEUTRAL
    assert rig.tick().setpoint_mode is FLY


@pytest.mark.fault(61)
def test_offboard_that_is_not_given_after_a_failsafe_ends_in_a_landing() -> None:
    rig = engaged()
    rig.fail("AUTO.LOITER")
    rig.tick(commands=(ENGAGE,))
    assert rig.is_in(HandoverState.ENGAGING) and rig.last_request(RequestKind.EXTERNAL_MODE)
    rig.run(6.0, until=HandoverState.LANDING)


@pytest.mark.fault(61)
def test_px4_that_takes_its_climb_up_after_landing_was_asked_for_is_asked_again() -> None:
    rig = HandoverRig().advance_to(HandoverState.CLIMBING)
    rig.fail()
    rig.tick(is_stop_requested=True)
    rig.tick()
    assert rig.is_in(HandoverState.LANDING)  # it lands, but not for us
    rig.answer(ACCEPTED, RequestKind.LAND)
    assert rig.is_in(HandoverState.SETTLING)
    rig.report_status(mode="AUTO.TAKEOFF", failsafe=False)
    rig.run(3.0, until=HandoverState.LANDING)
    asked = [at_ns for at_ns, ask in rig.asked if ask is RequestKind.LAND]
    rig.run(20.0)
    assert (
        rig.is_in(HandoverState.LANDING)
        and len([ask for _, ask in rig.asked if ask is RequestKind.LAND]) > len(asked) + 10
    )


@pytest.mark.fault(61)
def test_ardupilot_stays_in_the_failsafe_s_mode_when_it_has_ended() -> None:
    rig = engaged("ardupilot")
    rig.fail()
    rig.report_status(failsafe=False)
    rig.run(5.0)
    assert rig.is_in(HandoverState.FAILSAFE)
    rig.report_status(mode="STABILIZE")
    rig.tick()
    assert rig.is_in(HandoverState.TAKEN_OVER)


@pytest.mark.fault(28)
@BOTH
def test_a_flight_that_the_pilot_began_is_the_pilot_s_in_a_failsafe_too(autopilot: str) -> None:
    rig = HandoverRig(autopilot).advance_to(HandoverState.ENGAGED)
    rig.fail()
    assert rig.is_in(HandoverState.TAKEN_OVER)


# While it is in the air by our positions


def over_a_relay(state: HandoverState) -> HandoverRig:
    rig = HandoverRig(config=HandOverConfig(climb_s=5.0, land_s=10.0))
    rig.hand_over = HandoverStateMachine(HandOverConfig(climb_s=5.0, land_s=10.0), waits_for_landing=True)
    rig.advance_to(state)
    rig.report_status(landed=False)
    rig.tick()
    return rig


@pytest.mark.fault(63)
def test_who_lands_by_our_positions_gets_them_when_nothing_more_is_asked_for() -> None:
    rig = over_a_relay(HandoverState.CLIMBING)
    rig.tick(is_stop_requested=True)
    rig.run(LAND_PERIODS * 10.0 + 2.0, until=HandoverState.FAILED)  # it does not land
    assert not rig.hand_over.is_finished
    rig.run(30.0)
    assert not rig.hand_over.is_finished  # it would be blind, and nobody else has it
    rig.report_status(armed=False)
    rig.tick()
    assert rig.hand_over.is_finished


@pytest.mark.fault(67)
def test_what_we_took_off_is_asked_to_land_until_it_does() -> None:
    rig = HandoverRig(config=HandOverConfig(land_s=5.0)).advance_to(HandoverState.CLIMBING)
    rig.report_status(landed=False)
    rig.tick(is_stop_requested=True)
    rig.run(30.0)  # it hears nothing
    assert rig.is_in(HandoverState.LANDING) and len(rig.asked) > 25
    assert len([text for text in rig.codes("refused") if "requested again" in text]) == 1
    rig.report_status(mode="AUTO.LAND")
    rig.run(1.0)
    assert rig.is_in(HandoverState.SETTLING) and not rig.hand_over.failure


def test_a_vehicle_that_falls_silent_is_not_asked_to_land_for_longer() -> None:
    rig = HandoverRig(config=HandOverConfig(land_s=5.0)).advance_to(HandoverState.CLIMBING)
    rig.report_status(landed=False)
    rig.tick(is_stop_requested=True)
    rig.mute = True
    rig.run(9.0)
    assert rig.is_in(HandoverState.FAILED)


@pytest.mark.fault(63)
def test_a_pilot_who_flies_by_our_positions_keeps_them_until_the_ground() -> None:
    rig = over_a_relay(HandoverState.CLIMBING)
    rig.report_status(mode="POSCTL")
    rig.tick()
    assert rig.is_in(HandoverState.TAKEN_OVER) and rig.hand_over.is_busy
    rig.report_status(landed=True)
    rig.tick()
    assert not rig.hand_over.is_busy


@pytest.mark.fault(63)
def test_a_controller_that_ends_without_a_landing_leaves_nothing_of_ours_in_the_air() -> None:
    rig = engaged()
    rig.tick(is_stop_requested=True, has_setpoint=False)
    assert rig.is_in(HandoverState.LANDING) and rig.last_request(RequestKind.LAND)
    pilots = HandoverRig().advance_to(HandoverState.ENGAGED)
    pilots.tick(is_stop_requested=True, has_setpoint=False)
    assert pilots.is_in(HandoverState.ENGAGED)


def test_orders_of_before_do_not_matter_in_a_failsafe() -> None:
    rig = HandoverRig().advance_to(HandoverState.FAILSAFE)
    rig.tick(commands=(TAKE_OFF,))
    assert rig.is_in(HandoverState.FAILSAFE) and rig.codes("order-refused")
    rig.view = replace(rig.view, at_ns=rig.view.at_ns + TICK_NS)
    assert rig.is_in(HandoverState.FAILSAFE)
