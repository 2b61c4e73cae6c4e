"""The hand-over tick by tick: refusals, the pilot on the way, stopping, a vehicle that starts anew."""

from __future__ import annotations

from itertools import pairwise

import pytest
from hand_over_rig import (
    ACCEPTED,
    DENIED,
    FAILED,
    FLY,
    IN_PROGRESS,
    LAND,
    NOTHING,
    REJECTED,
    SECOND,
    TAKE_OFF,
    HandoverRig,
    ack,
)

from uavctl.config.connections import HandOverConfig
from uavctl.event_codes import EventCode
from uavctl.mavlink.handover_guards import GRACE_NS
from uavctl.mavlink.handover_states import HandoverState
from uavctl.mavlink.messages import StatusText
from uavctl.mavlink.requests import RequestKind
from uavctl.records import Command, Order

# Refusals


@pytest.mark.fault(26)
def test_a_temporary_refusal_is_asked_again_in_bounds_then_told_with_the_vehicle_s_words() -> None:
    rig = HandoverRig("ardupilot", HandOverConfig(ground_s=30.0, tries=4)).advance_to(HandoverState.ARMING)
    for _ in range(4):
        rig.run(2.0) if len(rig.asked) > 2 else None
        rig.answer(FAILED, RequestKind.ARM, text="PreArm: VisOdom: not healthy")
        rig.run(2.0)
    times = [at_ns for at_ns, ask in rig.asked if ask is RequestKind.ARM]
    assert len(times) == 4
    rig.run(5.0)
    assert rig.is_in(HandoverState.FAILED)
    assert "FAILED" in rig.hand_over.failure and "PreArm: VisOdom: not healthy" in rig.hand_over.failure
    assert rig.last_request(RequestKind.DISARM)  # it may have been granted after all


@pytest.mark.fault(26)
@pytest.mark.parametrize(("result", "why"), [(DENIED, "DENIED"), (3, "UNSUPPORTED")], ids=["denied", "unsupported"])
def test_a_final_refusal_is_not_asked_again(result: int, why: str) -> None:
    rig = HandoverRig().advance_to(HandoverState.MODE)
    rig.answer(result)
    assert rig.is_in(HandoverState.FAILED) and why in rig.hand_over.failure and len(rig.asked) == 1


@pytest.mark.fault(26)
def test_no_answer_is_told_as_that() -> None:
    rig = HandoverRig(config=HandOverConfig(tries=3, answer_s=1.0)).advance_to(HandoverState.MODE)
    rig.run(3.2)
    assert rig.is_in(HandoverState.FAILED) and "did not answer" in rig.hand_over.failure
    times = [at_ns for at_ns, _ in rig.asked]
    assert [b - a for a, b in pairwise(times)] == [SECOND, SECOND]


def test_accepted_but_never_done_is_told_as_that() -> None:
    rig = HandoverRig(config=HandOverConfig(ground_s=10.0)).advance_to(HandoverState.MODE)
    rig.answer(ACCEPTED)
    rig.run(2.9)
    assert len(rig.asked) == 1  # heartbeats come once a second: no hurry
    rig.run(8.0)
    assert rig.is_in(HandoverState.FAILED) and "ACCEPTED" in rig.hand_over.failure


def test_an_unknown_result_is_told_by_number() -> None:
    rig = HandoverRig(config=HandOverConfig(tries=1)).advance_to(HandoverState.MODE)
    rig.answer(77)
    rig.run(3.0)
    assert "answered 77" in rig.hand_over.failure


def test_in_progress_is_waited_for() -> None:
    rig = HandoverRig().advance_to(HandoverState.MODE)
    for _ in range(5):
        rig.answer(IN_PROGRESS)
        rig.run(1.5)
    assert len(rig.asked) == 1 and rig.is_in(HandoverState.MODE)


def test_answers_to_others_and_chatter_change_nothing() -> None:
    rig = HandoverRig().advance_to(HandoverState.MODE)
    rig.tick(ack(DENIED, RequestKind.LAND), StatusText(system=1, component=1, severity=6, text="chatter"))
    assert rig.is_in(HandoverState.MODE)
    rig = HandoverRig().advance_to(HandoverState.READY)
    rig.tick(ack(DENIED, RequestKind.ARM), commands=(TAKE_OFF,))
    assert rig.is_in(HandoverState.MODE)


@pytest.mark.fault(26)
def test_a_climb_that_does_not_come_ends_in_a_landing_and_a_failure() -> None:
    rig = HandoverRig("ardupilot", HandOverConfig(climb_s=5.0)).advance_to(HandoverState.CLIMBING)
    rig.answer(ACCEPTED)
    rig.run(5.2)
    assert rig.is_in(HandoverState.LANDING) and rig.last_request(RequestKind.LAND)
    assert [ask for _, ask in rig.asked].count(RequestKind.TAKE_OFF) == 1  # asked again, it would begin again
    rig.report_status(mode="LAND")
    rig.tick()
    rig.report_status(armed=False)
    rig.tick()
    assert rig.is_in(HandoverState.DONE) and "take-off" in rig.hand_over.failure


def test_height_counts_by_fresh_positions_only() -> None:
    rig = HandoverRig("px4").advance_to(HandoverState.CLIMBING)
    rig.tick(estimated_height_m=3.0, arming_refusal="the newest position is 2.0 s old")
    assert rig.is_in(HandoverState.CLIMBING)
    rig.tick(estimated_height_m=None, arming_refusal="")
    assert rig.is_in(HandoverState.CLIMBING)
    rig.tick(estimated_height_m=3.0)
    assert rig.is_in(HandoverState.ENGAGING)


@pytest.mark.fault(26)
def test_offboard_that_is_refused_in_the_climb_ends_in_a_landing() -> None:
    rig = HandoverRig("px4").advance_to(HandoverState.ENGAGING)
    for _ in range(20):
        rig.answer(REJECTED, RequestKind.EXTERNAL_MODE)
        rig.run(0.25)
    rig.tick()
    assert rig.is_in(HandoverState.LANDING) and "TEMPORARILY_REJECTED" in rig.hand_over.failure
    assert 5 <= [ask for _, ask in rig.asked].count(RequestKind.EXTERNAL_MODE) <= 11


@pytest.mark.fault(26)
@pytest.mark.parametrize("state", [HandoverState.CLIMBING, HandoverState.ENGAGING])
def test_a_vehicle_that_disarms_itself_on_the_way_ends_it(state: HandoverState) -> None:
    rig = HandoverRig("ardupilot" if state is HandoverState.CLIMBING else "px4").advance_to(state)
    rig.report_status(armed=False)
    rig.tick()
    assert rig.is_in(HandoverState.FAILED) and "disarmed itself" in rig.hand_over.failure


@pytest.mark.parametrize(
    ("state", "mode", "armed"),
    [
        (HandoverState.MODE, "AUTO.LOITER", True),
        (HandoverState.ARMING, "MANUAL", False),
        (HandoverState.CLIMBING, "POSCTL", True),
        (HandoverState.ENGAGING, "POSCTL", True),
        (HandoverState.LANDING, "POSCTL", True),
        (HandoverState.SETTLING, "POSCTL", True),
        (HandoverState.FAILSAFE, "POSCTL", True),
        (HandoverState.FAILSAFE, "ALTCTL", True),
    ],
)
@pytest.mark.fault(25)
def test_the_pilot_may_take_over_at_any_time(state: HandoverState, mode: str, armed: bool) -> None:
    rig = HandoverRig("px4").advance_to(state)
    rig.report_status(mode=mode, armed=armed, stick=True)
    told = rig.tick()
    assert (rig.state, told.setpoint_mode, told.request) == (HandoverState.TAKEN_OVER, NOTHING, None)


@pytest.mark.fault(25)
def test_a_heartbeat_of_before_the_grant_is_no_pilot_and_a_later_one_is() -> None:
    rig = HandoverRig("px4").advance_to(HandoverState.ENGAGING)
    rig.answer(ACCEPTED)
    granted_ns = rig.view.at_ns
    while rig.view.at_ns < granted_ns + GRACE_NS:
        assert rig.vehicle is not None and not rig.hand_over.has_left_external_mode(rig.vehicle)
        assert rig.tick().setpoint_mode is FLY
    assert rig.tick().setpoint_mode is NOTHING
    assert (
        rig.is_in(HandoverState.TAKEN_OVER)
        and rig.vehicle is not None
        and rig.hand_over.has_left_external_mode(rig.vehicle)
    )


# Stopping


@pytest.mark.fault(34)
@pytest.mark.parametrize(
    ("state", "after", "ask"),
    [
        (HandoverState.MODE, HandoverState.DONE, None),
        (HandoverState.ARMING, HandoverState.LANDING, RequestKind.LAND),
        (HandoverState.CLIMBING, HandoverState.LANDING, RequestKind.LAND),
        (HandoverState.ENGAGING, HandoverState.LANDING, RequestKind.LAND),
        (HandoverState.FAILSAFE, HandoverState.LANDING, RequestKind.LAND),
        (HandoverState.RETURNING, HandoverState.TAKEN_OVER, None),
    ],
)
@pytest.mark.parametrize("how", ["stop", "order"])
def test_the_operator_stops_on_the_way(
    state: HandoverState, after: HandoverState, ask: RequestKind | None, how: str
) -> None:
    rig = HandoverRig().advance_to(state)
    told = rig.tick(is_stop_requested=True) if how == "stop" else rig.tick(commands=(LAND,))
    assert (rig.state, told.request, told.setpoint_mode) == (after, ask, NOTHING)


def test_an_arming_that_is_stopped_is_over_when_a_later_heartbeat_says_disarmed() -> None:
    rig = HandoverRig().advance_to(HandoverState.ARMING)
    rig.mute = True
    rig.tick(is_stop_requested=True)
    rig.tick()
    assert rig.is_in(HandoverState.LANDING)  # the heartbeat is from before
    rig.mute = False
    rig.tick()
    assert rig.is_in(HandoverState.DONE)


@pytest.mark.fault(34)
def test_landing_is_asked_for_once_a_second_five_times_at_most() -> None:
    rig = HandoverRig().advance_to(HandoverState.LANDING)
    rig.run(10.0)
    times = [at_ns for at_ns, ask in rig.asked if ask is RequestKind.LAND]
    assert [b - a for a, b in pairwise(times)] == [SECOND] * 4
    assert rig.is_in(HandoverState.FAILED) and "landing" in rig.hand_over.failure


# A vehicle that starts anew


@pytest.mark.fault(20)
@pytest.mark.parametrize(
    ("state", "after"),
    [
        (HandoverState.READY, HandoverState.READY),
        (HandoverState.MODE, HandoverState.FAILED),
        (HandoverState.ARMING, HandoverState.FAILED),
        (HandoverState.CLIMBING, HandoverState.FAILED),
        (HandoverState.ENGAGING, HandoverState.FAILED),
        (HandoverState.FAILSAFE, HandoverState.FAILED),
        (HandoverState.RETURNING, HandoverState.TAKEN_OVER),
        (HandoverState.ENGAGED, HandoverState.TAKEN_OVER),
    ],
)
def test_a_reboot_disengages(state: HandoverState, after: HandoverState) -> None:
    rig = HandoverRig().advance_to(state)
    rig.report_status(boots=1)
    told = rig.tick()
    assert (rig.state, told.setpoint_mode) == (after, NOTHING)
    if after is not state:
        assert "restarted" in rig.codes("refused")[-1]
    rig.tick()
    assert rig.is_in(after)  # told once


def test_a_reboot_before_we_listened_is_none() -> None:
    rig = HandoverRig()
    rig.report_status(boots=3)
    rig.tick()
    assert rig.is_in(HandoverState.READY) and not rig.codes("refused")


@pytest.mark.parametrize(
    "state", [HandoverState.MODE, HandoverState.CLIMBING, HandoverState.ENGAGING, HandoverState.SETTLING]
)
def test_silence_on_the_way_changes_nothing_until_time_is_up(state: HandoverState) -> None:
    rig = HandoverRig(config=HandOverConfig(ground_s=8.0, climb_s=8.0, engage_s=8.0, land_s=8.0)).advance_to(state)
    rig.mute = True
    rig.run(5.0)
    assert rig.is_in(state)
    rig.run(5.0)
    assert rig.state is not state


@pytest.mark.parametrize("height_m", [None, 0.0, -1.0, float("nan")])
def test_a_climb_to_nowhere_is_refused(height_m: float | None) -> None:
    rig = HandoverRig().advance_to(HandoverState.READY)
    told = rig.tick(commands=(Command(order=Order.TAKE_OFF, height_m=height_m),))
    assert [event.code for event in told.events] == [EventCode.ORDER_REFUSED] and rig.hand_over.height_m == 0.0
    assert rig.is_in(HandoverState.READY) and not rig.hand_over.is_ordered_flight
