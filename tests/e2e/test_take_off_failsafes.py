"""Take-offs by relayed positions, with checks that flicker and failsafes that end, judged on the true vehicle."""

from __future__ import annotations

import io
from collections import deque

import pytest
from loopback_rig import make_loop
from rich.console import Console
from sim_rig import decode
from soak_take_off import judge_at_limit, judge_outcome, make_troubled_rig
from take_off_rig import RELAYED, TakeOffRig

from logs.recording.replay import replay
from uavctl.cli.live_line import print_notices
from uavctl.mavlink.handover_states import HandoverState
from uavctl.records import ControlMode, Order, Severity

BOTH = pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])
SEEDS = 6


@pytest.mark.slow
@pytest.mark.fault(60, 61)
@BOTH
@pytest.mark.parametrize("seed", range(SEEDS))
def test_a_vehicle_that_took_off_is_engaged_or_landed_and_a_refusal_has_a_reason(autopilot: str, seed: int) -> None:
    flight = make_troubled_rig(autopilot, seed)
    what = judge_at_limit(flight)
    assert what != "hovers", (flight.state, flight.texts)
    assert what == "engaged" or flight.loop.failure, flight.texts
    assert not any("started anew" in text for text in flight.texts)
    assert "released" not in flight.states  # there is no pilot


@pytest.mark.slow
@pytest.mark.fault(61)
def test_px4_whose_failsafe_ends_in_the_climb_arrives_and_its_replay_agrees() -> None:
    more = ["sim.checks.invalid=[[0.2, 1.4]]", "sim.checks.clears=true", "sim.checks.flicker_s=1.0"]
    flight = TakeOffRig("px4", *RELAYED, *more).relayed()
    assert judge_at_limit(flight) == "engaged" and not flight.loop.failure
    assert "failsafe" in flight.states and flight.ticked is not None
    assert flight.ticked.decision.mode is ControlMode.TRACK
    texts = [event.text for event in flight.notices if event.code == "hand-over"]
    assert len(texts) == 2 and all("failsafe" in text for text in texts)  # in, and out again: for the console
    result = replay(flight.memory.entries, lambda sink: make_loop(flight.config, sink))
    assert result.identical, result.first_difference


@pytest.mark.fault(61)
def test_the_console_prints_the_notices_of_the_hand_over() -> None:
    flight = (
        TakeOffRig("px4", *RELAYED, "sim.checks.invalid=[[0.2, 1.4]]", "sim.checks.clears=true").relayed().take_off()
    )
    flight.run(30.0, until=HandoverState.FAILSAFE)
    flight.run(6.0)  # its rotors have spun up
    flight.stick("POSCTL")
    flight.run(3.0, until=HandoverState.TAKEN_OVER)
    console_file = io.StringIO()
    notices = deque(flight.notices)
    print_notices(notices, Console(file=console_file, width=200))
    lines = console_file.getvalue().splitlines()
    assert [line.split(" (")[0] for line in lines if line.startswith("hand-over")] == [
        "hand-over: climbing -> failsafe",
        "hand-over: failsafe -> climbing",
        "hand-over: engaged -> released",
    ]
    assert not notices


@pytest.mark.slow
@pytest.mark.fault(63)
@BOTH
@pytest.mark.parametrize("after_s", [0.6, 1.6, 3.0, 12.0])
def test_the_operator_s_end_lands_what_is_in_the_air_with_positions_until_the_ground(
    autopilot: str, after_s: float
) -> None:
    more = ["sim.checks.invalid=[[0.4, 2.0]]"] + (["sim.checks.clears=true"] if autopilot == "px4" else [])
    flight = TakeOffRig(autopilot, *RELAYED, *more).relayed().take_off()
    flight.run(30.0, until=HandoverState.CLIMBING)
    flight.run(after_s)
    for _ in range(70):
        if flight.loop.finished:
            break
        flight.run(1.0, stop=True)
    assert flight.loop.finished and judge_outcome(flight) == "landed"
    last_ns = max(at_ns for at_ns, _ in flight.sent("VISION_POSITION_ESTIMATE"))
    assert flight.now_ns - last_ns < 2_000_000_000


@pytest.mark.slow
@pytest.mark.fault(25, 63)
def test_the_pilot_s_stick_in_the_climb_is_reported_and_positions_go_on_until_the_ground() -> None:
    flight = TakeOffRig("px4", *RELAYED).relayed().take_off()
    flight.run(30.0, until=HandoverState.CLIMBING)
    flight.run(6.0)  # its rotors have spun up
    flight.stick("POSCTL")
    flight.run(3.0, until=HandoverState.TAKEN_OVER)
    assert [notice.severity for notice in flight.notices if notice.code == "hand-over"] == [Severity.WARNING]
    before = flight.commands()
    flight.run(10.0, stop=True)
    assert not flight.loop.finished and flight.commands() == before
    flight.stick("AUTO.LAND")
    flight.run(30.0, stop=True, until=HandoverState.DONE)
    assert flight.loop.finished and flight.commands() == before


@pytest.mark.fault(62)
@BOTH
def test_orders_to_fly_are_refused_unless_the_controller_is_engaged(autopilot: str) -> None:
    flight = TakeOffRig(autopilot)
    moves = (Order.GOTO, Order.HOLD, Order.RESUME)
    assert all(flight.loop.explain_refusal(order) for order in moves)
    flight.run(1.0).take_off()
    flight.run(10.0, until=HandoverState.CLIMBING)
    assert all(HandoverState.CLIMBING in flight.loop.explain_refusal(order) for order in moves)
    flight.run(10.0, until=HandoverState.ENGAGED)
    refused = [order for order in Order if flight.loop.explain_refusal(order)]
    assert refused == [Order.TAKE_OFF]  # in the air already
    flight.stick("POSCTL" if autopilot == "px4" else "LOITER")
    flight.run(3.0, until=HandoverState.TAKEN_OVER)
    assert all("uavctl ctl engage" in flight.loop.explain_refusal(order) for order in moves)
    assert not flight.loop.explain_refusal(Order.ENGAGE) and not flight.loop.explain_refusal(Order.LAND)


SET_MODE = 176


@pytest.mark.fault(25, 65)
@pytest.mark.parametrize(
    "after", [step if step % 5 == 0 else pytest.param(step, marks=pytest.mark.slow) for step in range(1, 26)]
)
def test_a_request_that_was_not_answered_is_not_repeated_after_the_pilot_s_switch(after: int) -> None:
    """Heartbeats show a mode up to a second late: a repetition meanwhile would take it from the pilot."""
    flight = TakeOffRig("px4").take_off().run(10.0, until=HandoverState.CLIMBING)
    lost: list[bytes] = []

    def hears(data: bytes) -> bool:
        asked = not lost and any(getattr(m, "command", 0) == SET_MODE for m in decode(data))
        lost.extend([data] if asked else [])
        return not asked

    flight.hears = hears
    while not lost:
        flight.run(0.05)
    flight.run(0.05 * (after - 1))
    before = flight.commands()
    flight.stick("POSCTL")
    flight.run(4.0)
    assert flight.is_in(HandoverState.TAKEN_OVER) and flight.commands() == before
    assert flight.peers.autopilot.mode_name == "POSCTL"


@pytest.mark.slow
@pytest.mark.fault(61)
@pytest.mark.parametrize(("deaf_s", "lands"), [(8.8, False), (1000.0, True)])
def test_px4_that_hovers_in_its_take_off_mode_is_engaged_from_there_or_landed(deaf_s: float, lands: bool) -> None:
    flight = TakeOffRig("px4", *RELAYED, "sim.streams=onboard").relayed()
    flight.peers.autopilot.parameters.set("MIS_TAKEOFF_ALT", 1.2)
    flight.take_off().run(30.0, until=HandoverState.CLIMBING)
    deaf_until_ns = flight.now_ns + round(deaf_s * 1e9)

    def hears(data: bytes) -> bool:
        asked = any(getattr(m, "command", 0) == SET_MODE for m in decode(data))
        return flight.now_ns >= deaf_until_ns or not asked

    flight.hears = hears
    flight.run(8.7)
    assert flight.is_in(HandoverState.ENGAGING) and flight.peers.autopilot.mode_name == "AUTO.TAKEOFF"
    assert flight.peers.vehicle.position_m[2] == pytest.approx(-1.2, abs=0.15)
    if lands:
        flight.run(50.0, until=HandoverState.DONE)
        assert judge_outcome(flight) == "landed" and "landing" in flight.states and flight.loop.failure
    else:
        flight.run(20.0, until=HandoverState.ENGAGED).run(3.0)
        assert judge_outcome(flight) == "engaged" and not flight.loop.failure
