"""The pilot's switch at moments in which a mode of ours is asked for, or just shown: it is the pilot's all the same."""

from __future__ import annotations

import pytest
from hand_over_rig import ACCEPTED, DENIED, LAND, SECOND, HandoverRig

from uavctl.mavlink.handover_states import HandoverState
from uavctl.mavlink.requests import RequestKind

LANDING_MODE = {"px4": "AUTO.LAND", "ardupilot": "LAND"}


def settling(autopilot: str, *, failing: bool = False) -> HandoverRig:
    """A flight of ours that lands, its landing shown."""
    rig = HandoverRig(autopilot).advance_to(HandoverState.CLIMBING)
    rig.report_status(landed=False)
    rig.tick(commands=(LAND,))
    rig.answer(ACCEPTED)
    rig.report_status(mode=LANDING_MODE[autopilot], failsafe=failing)
    rig.tick()
    assert rig.is_in(HandoverState.SETTLING)
    return rig


@pytest.mark.fault(68)
@pytest.mark.parametrize(
    ("autopilot", "mode"),
    [
        ("px4", "AUTO.LOITER"),
        ("px4", "AUTO.TAKEOFF"),
        ("px4", "OFFBOARD"),
        ("px4", "POSCTL"),
        ("ardupilot", "GUIDED"),
        ("ardupilot", "LOITER"),
    ],
)
def test_once_a_landing_is_shown_any_other_mode_is_the_pilot_s(autopilot: str, mode: str) -> None:
    rig = settling(autopilot)
    asked = len(rig.asked)
    rig.run(0.3)
    rig.report_status(mode=mode)
    rig.run(70.0)
    assert rig.is_in(HandoverState.TAKEN_OVER) and len(rig.asked) == asked


def test_a_failsafe_that_only_seemed_to_land_for_us_is_asked_again() -> None:
    rig = settling("px4", failing=True)
    rig.report_status(mode="AUTO.TAKEOFF", failsafe=False)
    rig.run(3.0)
    assert rig.is_in(HandoverState.LANDING) and rig.last_request(RequestKind.LAND)


def engaged(autopilot: str) -> HandoverRig:
    """A flight of ours in the mode that takes setpoints."""
    rig = HandoverRig(autopilot)
    rig.advance_to(HandoverState.CLIMBING).report_status(landed=False)
    rig.tick(estimated_height_m=1.9)
    rig.report_status(mode="OFFBOARD" if autopilot == "px4" else "GUIDED")
    rig.run(1.0, until=HandoverState.ENGAGED)
    return rig


def landing(autopilot: str) -> HandoverRig:
    """A flight of ours that is asked to land, from the mode that takes setpoints."""
    rig = engaged(autopilot)
    rig.tick(is_landing_requested=True)
    rig.tick(is_landing_requested=False)
    assert rig.is_in(HandoverState.LANDING) and rig.last_request(RequestKind.LAND)
    return rig


@pytest.mark.fault(68)
@pytest.mark.parametrize(("autopilot", "mode"), [("px4", "AUTO.LOITER"), ("px4", "POSCTL"), ("ardupilot", "LOITER")])
def test_after_landing_was_granted_another_mode_is_the_pilot_s(autopilot: str, mode: str) -> None:
    rig = landing(autopilot)
    rig.answer(ACCEPTED)
    asked = len(rig.asked)
    rig.run(0.4)  # heartbeats of before may still be under way
    assert rig.is_in(HandoverState.LANDING)
    rig.report_status(mode=mode)
    rig.run(10.0)
    assert rig.is_in(HandoverState.TAKEN_OVER) and len(rig.asked) == asked


@pytest.mark.fault(68)
def test_the_mode_of_before_is_the_pilot_s_once_landing_would_have_shown() -> None:
    rig = landing("ardupilot")
    rig.answer(ACCEPTED)
    asked = len(rig.asked)
    rig.run(1.9)  # a vehicle may be slow
    assert rig.is_in(HandoverState.LANDING)
    rig.run(10.0)
    assert rig.is_in(HandoverState.TAKEN_OVER) and len(rig.asked) == asked


@pytest.mark.fault(68)
def test_a_mode_that_was_granted_and_is_not_there_is_not_asked_for_over_the_pilot() -> None:
    rig = HandoverRig("px4").advance_to(HandoverState.MODE)
    rig.answer(ACCEPTED)
    rig.run(10.0)
    assert rig.is_in(HandoverState.FAILED) and len(rig.asked) == 1


@pytest.mark.fault(68)
def test_px4_s_hold_while_it_stands_armed_is_the_pilot_s() -> None:
    rig = HandoverRig("px4").advance_to(HandoverState.CLIMBING)
    rig.report_status(mode="AUTO.LOITER", stick=True)
    rig.tick()
    assert rig.is_in(HandoverState.TAKEN_OVER)


@pytest.mark.fault(68)
@pytest.mark.parametrize(("autopilot", "mode"), [("px4", "POSCTL"), ("ardupilot", "LOITER")])
def test_the_pilot_s_mode_before_arming_ends_the_take_off_on_the_ground(autopilot: str, mode: str) -> None:
    rig = HandoverRig(autopilot).advance_to(HandoverState.MODE)
    rig.report_status(mode=mode)
    rig.run(10.0)
    assert rig.is_in(HandoverState.DONE) and "-> released" in rig.codes("hand-over")[-2]
    assert {ask for _, ask in rig.asked} == {RequestKind.TAKE_OFF_MODE}


@pytest.mark.fault(68)
def test_px4_s_hold_on_the_ground_is_no_end_of_a_climb() -> None:
    rig = HandoverRig().advance_to(HandoverState.ARMING)
    rig.report_status(mode="AUTO.LOITER", stick=True)
    rig.tick()
    assert rig.is_in(HandoverState.TAKEN_OVER)
    rig.report_status(armed=True)
    rig.run(30.0)
    assert rig.is_in(HandoverState.TAKEN_OVER)


@pytest.mark.fault(66)
@pytest.mark.parametrize("state", [HandoverState.CLIMBING, HandoverState.ENGAGING])
def test_a_climb_by_positions_that_cannot_be_is_broken_off(state: HandoverState) -> None:
    rig = HandoverRig("ardupilot").advance_to(state)
    assert rig.is_in(state)
    rig.tick(climb_hazard="it is 0.7 m beyond the lower limit")
    assert rig.is_in(HandoverState.LANDING) and rig.last_request(RequestKind.LAND)
    assert len(rig.codes("refused")) == 1


def test_nothing_is_broken_off_while_nothing_climbs() -> None:
    rig = HandoverRig().advance_to(HandoverState.ENGAGED)
    rig.tick(climb_hazard="it is 0.7 m beyond the lower limit")
    assert rig.is_in(HandoverState.ENGAGED) and not rig.codes("refused")


@pytest.mark.fault(25, 68)
@pytest.mark.parametrize(("autopilot", "mode"), [("px4", "POSCTL"), ("px4", "AUTO.LOITER"), ("ardupilot", "STABILIZE")])
@pytest.mark.parametrize("end", ["controller", "time", "order"])
@pytest.mark.parametrize("state", [HandoverState.CLIMBING, HandoverState.ENGAGING, HandoverState.ENGAGED])
def test_an_end_that_comes_with_the_pilot_s_switch_asks_for_nothing(
    autopilot: str, mode: str, end: str, state: HandoverState
) -> None:
    if state is not HandoverState.ENGAGED and mode == "AUTO.LOITER":
        mode = "ALTCTL"  # PX4's hold is where its climb ends
    rig = HandoverRig(autopilot).advance_to(HandoverState.CLIMBING)
    rig.report_status(landed=False)
    if state is not HandoverState.CLIMBING:
        rig.tick(estimated_height_m=1.9)
    if state is HandoverState.ENGAGED:
        rig.report_status(mode="OFFBOARD" if autopilot == "px4" else "GUIDED")
        rig.run(1.0, until=HandoverState.ENGAGED)
    assert rig.is_in(state)
    rig.run(0.5)
    asked = len(rig.asked)
    rig.report_status(mode=mode, stick=True)
    if end == "controller":
        rig.tick(is_landing_requested=True, has_setpoint=False)
    elif end == "time":
        rig.tick(is_stop_requested=True, has_setpoint=False)
    else:
        rig.tick(commands=(LAND,))
    rig.run(5.0)
    assert rig.is_in(HandoverState.TAKEN_OVER) and len(rig.asked) == asked


@pytest.mark.fault(67)
@pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])
def test_what_is_armed_for_a_take_off_is_asked_to_land_until_it_is_disarmed(autopilot: str) -> None:
    """It refuses, on the ground, and would climb by itself once nobody asks any more."""
    rig = HandoverRig(autopilot).advance_to(HandoverState.CLIMBING)
    rig.tick(commands=(LAND,))
    for _ in range(100):
        rig.answer(DENIED, RequestKind.LAND)
        rig.run(0.3)
    assert rig.is_in(HandoverState.LANDING) and not rig.hand_over.is_finished
    assert rig.asked[-1][0] > rig.view.at_ns - 2 * SECOND
    rig.report_status(armed=False)
    rig.run(1.0)
    assert rig.is_in(HandoverState.DONE)


@pytest.mark.parametrize("ours", [True, False])
def test_a_climb_that_is_told_late_does_not_keep_the_controller_from_watching_what_it_flies(ours: bool) -> None:
    rig = HandoverRig("ardupilot").advance_to(HandoverState.CLIMBING if ours else HandoverState.READY)
    if ours:
        rig.tick(estimated_height_m=1.9)
    rig.report_status(mode="GUIDED", armed=True, landed=False, own_climb=True)
    rig.run(1.0, until=HandoverState.ENGAGED)
    flown = rig.hand_over.select_controlled_status(rig.view.at_ns, rig.vehicle)
    assert flown is not None and flown.own_climb is not ours  # of another one's climb nobody knows when it ends


@pytest.mark.fault(8)
@pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])
def test_a_landing_waits_for_the_first_word_after_a_lost_connection_and_no_longer(autopilot: str) -> None:
    rig = engaged(autopilot)
    asked = len(rig.asked)
    rig.tick(is_landing_requested=True, may_have_lost_messages=True)
    rig.run(3.2)
    assert rig.is_in(HandoverState.LANDING) and len(rig.asked) == asked
    rig.tick(may_have_lost_messages=False)
    assert rig.asked[asked:] == [(rig.view.at_ns, RequestKind.LAND)]
