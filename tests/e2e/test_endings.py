"""How a flight ended: console, status, service manager, summary, page, recording and exit code say the same."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import pytest
from endings_rig import (
    PRESET,
    TAKE_OFF,
    DiskRecorder,
    EndingReport,
    EndingRig,
    fly_command,
    interrupt,
    is_message,
    read_page_text,
)
from places import ROOT
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from report_rig import omit_figures

from logs.recording.flight import FlightData
from logs.recording.reader import read
from logs.recording.summary import summarise
from logs.report import flight_page as report
from sim.autopilot.profile import FAILED, SIMULATED, Role
from uavctl import loop as control
from uavctl.account import FlightAccount, make_ending
from uavctl.cause import CAUSES, Cause
from uavctl.cli.app import run
from uavctl.daemon import flight_orders
from uavctl.loop import ControlLoop
from uavctl.mavlink.handover_states import HandoverState
from uavctl.records import Command, Order

RunFlight = Callable[..., EndingReport]
NO_COMMANDS = is_message("COMMAND_LONG")


@pytest.fixture
def run_flight(capsys: pytest.CaptureFixture[str]) -> RunFlight:
    """Flies, and has all places agree on one sentence."""

    def fly(rig: EndingRig, cause: Cause, *arguments: str, good: bool = False) -> EndingReport:
        report = fly_command(rig, capsys, *arguments)
        assert report.summary, report.console
        assert report.ending["code"] == cause, report.ending
        report.assert_agreement()
        assert report.code == (0 if good else 1), report.ending
        return report

    return fly


def make_order(what: Order) -> Callable[[EndingRig], None]:
    def do(rig: EndingRig) -> None:
        rig.active_loop.order(Command(order=what))

    return do


def make_switch(mode: str) -> Callable[[EndingRig], None]:
    return lambda rig: rig.switch_mode(mode)


def start_failsafe(mode: Role) -> Callable[[EndingRig], None]:
    """A failsafe of the vehicle's own."""
    return lambda rig: rig.peers.autopilot.pilot.enter_failsafe(
        SIMULATED[rig.config.sim.autopilot].get_mode_by_role(mode), rig.now_ns
    )


def drop_messages(kind: str) -> Callable[[EndingRig], None]:
    """From now on the vehicle hears no message of a kind."""

    def do(rig: EndingRig) -> None:
        is_one = is_message(kind)
        rig.is_delivered = lambda data: not is_one(data)

    return do


def deliver_messages(rig: EndingRig) -> None:
    """From now on the vehicle hears everything again."""
    rig.is_delivered = lambda data: True


# As ordered


@pytest.mark.slow
def test_the_mission_is_over(tmp_path: Path, run_flight: RunFlight) -> None:
    rig = EndingRig(tmp_path, "mission.waypoints=[[0.3,0.0,-1.2]]", "mission.hold_s=0.5", "mission.then='land'")
    report = run_flight(rig, Cause.LANDED_AFTER_MISSION, *TAKE_OFF, good=True)
    assert "landed and disarmed" in report.ending["sentence"]


@pytest.mark.slow
def test_the_operator_orders_the_landing(tmp_path: Path, run_flight: RunFlight) -> None:
    rig = EndingRig(tmp_path).add_step_in(HandoverState.ENGAGED, make_order(Order.LAND), after_s=2.0)
    run_flight(rig, Cause.LANDED_AS_ORDERED, *TAKE_OFF, good=True)


@pytest.mark.slow
def test_the_operator_hands_over_a_flight_that_the_pilot_began(tmp_path: Path, run_flight: RunFlight) -> None:
    rig = EndingRig(tmp_path, "fallback.land=false", airborne=True).add_step_in(
        HandoverState.ENGAGED, interrupt, after_s=3.0
    )
    report = run_flight(rig, Cause.ENDED_BY_OPERATOR, good=True)
    assert "in mode OFFBOARD" in report.ending["sentence"]


@pytest.mark.slow
def test_the_pilot_of_an_ardupilot_takes_over(tmp_path: Path, run_flight: RunFlight) -> None:
    rig = EndingRig(tmp_path, "sim.autopilot=ardupilot").add_step_in(
        HandoverState.ENGAGED, make_switch("LOITER"), after_s=2.0
    )
    rig.add_step_in(HandoverState.TAKEN_OVER, interrupt, after_s=3.0)
    report = run_flight(rig, Cause.PILOT, *TAKE_OFF, good=True)
    assert "in the air, in mode LOITER" in report.ending["sentence"]


@pytest.mark.slow
def test_the_pilot_takes_over_and_lands(tmp_path: Path, run_flight: RunFlight) -> None:
    rig = EndingRig(tmp_path, airborne=True).add_step_in(HandoverState.ENGAGED, make_switch("POSCTL"), after_s=2.0)
    rig.add_step_in(HandoverState.TAKEN_OVER, make_switch("AUTO.LAND"), after_s=1.0)
    run_flight(rig, Cause.PILOT_LANDED, good=True)


@pytest.mark.slow
def test_a_failsafe_that_ended_in_the_climb_is_reported_with_the_later_end(
    tmp_path: Path, run_flight: RunFlight
) -> None:
    # The vehicle's own climb is longer than ours, so that its failsafe acts before the controller is in charge.
    rig = EndingRig(tmp_path, "sim.checks.invalid=[[0.2, 1.4]]", "sim.checks.clears=true")
    report = run_flight(rig, Cause.TIME_OVER, *TAKE_OFF, "--duration", "15", good=True)
    assert "had acted and ended" in report.ending["sentence"]


# The take-off


@pytest.mark.slow
def test_the_pilot_takes_over_in_the_climb(tmp_path: Path, run_flight: RunFlight) -> None:
    rig = EndingRig(tmp_path).add_step_in(HandoverState.CLIMBING, make_switch("POSCTL"), after_s=0.6)
    rig.add_step_in(HandoverState.TAKEN_OVER, interrupt, after_s=2.0)
    report = run_flight(rig, Cause.PILOT, *TAKE_OFF)
    assert "before the controller" in report.ending["sentence"]


@pytest.mark.slow
def test_the_operator_ends_it_in_the_climb(tmp_path: Path, run_flight: RunFlight) -> None:
    run_flight(
        EndingRig(tmp_path).add_step_in(HandoverState.CLIMBING, interrupt, after_s=0.5), Cause.NOT_ENGAGED, *TAKE_OFF
    )


@pytest.mark.slow
def test_the_operator_orders_the_landing_in_the_climb(tmp_path: Path, run_flight: RunFlight) -> None:
    run_flight(
        EndingRig(tmp_path).add_step_in(HandoverState.CLIMBING, make_order(Order.LAND), after_s=0.5),
        Cause.NOT_ENGAGED,
        *TAKE_OFF,
    )


@pytest.mark.slow
def test_refused_arming_is_reported_with_the_vehicle_s_text(tmp_path: Path, run_flight: RunFlight) -> None:
    poor = ("hand_over.ground_s=4.0", "sim.plant=quadrotor", "sim.quadrotor.charge=0.1")
    report = run_flight(EndingRig(tmp_path, *poor), Cause.ARMING_REFUSED, *TAKE_OFF)
    assert "low battery" in report.ending["sentence"] and "was not armed" in report.ending["sentence"]


@pytest.mark.slow
def test_the_mode_to_take_off_in_is_refused(tmp_path: Path, run_flight: RunFlight) -> None:
    rig = EndingRig(tmp_path, "hand_over.ground_s=4.0")
    rig.is_delivered = lambda data: not NO_COMMANDS(data)
    report = run_flight(rig, Cause.MODE_REFUSED, *TAKE_OFF)
    assert "did not answer" in report.ending["sentence"]


@pytest.mark.slow
def test_the_take_off_is_refused(tmp_path: Path, run_flight: RunFlight, monkeypatch: pytest.MonkeyPatch) -> None:
    rig = EndingRig(tmp_path, "sim.autopilot=ardupilot", "hand_over.climb_s=4.0")
    monkeypatch.setattr(rig.peers.autopilot.pilot, "take_off", lambda height_m, at_ns: FAILED)
    report = run_flight(rig, Cause.TAKE_OFF_REFUSED, *TAKE_OFF)
    assert "FAILED" in report.ending["sentence"]


@pytest.mark.slow
def test_the_climb_takes_too_long(tmp_path: Path, run_flight: RunFlight) -> None:
    report = run_flight(EndingRig(tmp_path, "hand_over.climb_s=1.0"), Cause.CLIMB_TOO_LONG, *TAKE_OFF)
    assert "landed and disarmed" in report.ending["sentence"]


@pytest.mark.slow
def test_the_mode_that_takes_setpoints_is_refused(tmp_path: Path, run_flight: RunFlight) -> None:
    rig = EndingRig(tmp_path, "hand_over.engage_s=3.0")
    rig.add_step_in(HandoverState.CLIMBING, drop_messages("SET_POSITION_TARGET_LOCAL_NED"))
    report = run_flight(rig, Cause.SETPOINTS_REFUSED, *TAKE_OFF)
    assert "landed and disarmed" in report.ending["sentence"]


def test_no_positions_come(tmp_path: Path, run_flight: RunFlight) -> None:
    rig = EndingRig(tmp_path, "hand_over.ground_s=4.0", "link.blackout=[[0.0, 1000.0]]")
    run_flight(rig, Cause.POSITIONS_ABSENT, *TAKE_OFF)


@pytest.mark.slow
def test_no_heartbeat_is_received(tmp_path: Path, run_flight: RunFlight) -> None:
    rig = EndingRig(tmp_path, "hand_over.ground_s=4.0")
    rig.is_received = lambda data: False
    run_flight(rig, Cause.NO_VEHICLE, *TAKE_OFF)


@pytest.mark.slow
def test_a_second_vehicle_is_received(tmp_path: Path, run_flight: RunFlight) -> None:
    second = mavlink.MAVLink(None, srcSystem=9, srcComponent=1)
    beat = bytes(mavlink.MAVLink_heartbeat_message(2, 12, 29, 4 << 16 | 3 << 24, 3, 3).pack(second))
    rig = EndingRig(tmp_path)
    for at_s in (0.3, 0.6, 1.2):
        rig.add_step_after(at_s, lambda rig_now: rig_now.lines["vehicle"].arrived.append((beat, rig_now.now_ns)))
    run_flight(rig, Cause.SECOND_VEHICLE, *TAKE_OFF)


@pytest.mark.slow
def test_the_vehicle_is_in_the_air_already(tmp_path: Path, run_flight: RunFlight) -> None:
    rig = EndingRig(tmp_path, airborne=True)
    rig.switch_mode("POSCTL")
    report = run_flight(rig, Cause.TAKE_OFF_NOT_BEGUN, *TAKE_OFF)
    assert "already armed" in report.ending["sentence"]


@pytest.mark.slow
def test_the_pilot_never_switches_and_a_recording_without_its_last_word_has_the_same_ending(
    tmp_path: Path, run_flight: RunFlight
) -> None:
    path = run_flight(EndingRig(tmp_path).add_step_after(4.0, interrupt), Cause.NOT_FLOWN).path
    # As an older daemon left it.
    flight = replace(FlightData.from_records(read(path), path), endings=())
    summary = summarise(flight, wall_s=None)
    report.write_report(flight, summary, tmp_path / "again.html")
    assert (summary.ending.code, summary.ending.as_ordered, summary.ending.exit_code) == (Cause.WAITING, False, 1)
    assert summary.ended == CAUSES[Cause.WAITING].phrase
    assert summary.ending.sentence in read_page_text(tmp_path / "again.html")


@pytest.mark.slow
def test_a_daemon_before_has_left_it_in_flight(
    tmp_path: Path, run_flight: RunFlight, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = EndingRig(tmp_path, airborne=True)
    begin = rig.fly

    def left(loop: ControlLoop, *given: Any, **more: Any) -> bool:
        loop.order(Command(order=Order.STAND_BY, flown_ns=0))
        return begin(loop, *given, **more)

    monkeypatch.setattr(rig, "fly", left)
    rig.add_step_after(12.0, interrupt)
    report = run_flight(rig, Cause.LEFT_IN_FLIGHT)
    assert "in the air" in report.ending["sentence"]


# In flight


@pytest.mark.slow
def test_the_place_is_not_reached(tmp_path: Path, run_flight: RunFlight) -> None:
    rig = EndingRig(tmp_path)
    report = run_flight(rig, Cause.NOT_REACHED, *TAKE_OFF, "--goto", "2.2,1.2,-1.2", "--duration", "4")
    assert "2.2,1.2,-1.2" in report.ending["sentence"]


@pytest.mark.slow
def test_the_fallback_lands_it(tmp_path: Path, run_flight: RunFlight) -> None:
    report = run_flight(EndingRig(tmp_path, "link.blackout=[[8.0, 100.0]]"), Cause.FALLBACK_LANDED, *TAKE_OFF)
    assert "landed and disarmed" in report.ending["sentence"]


@pytest.mark.slow
@pytest.mark.parametrize("arguments", [TAKE_OFF, ()])
def test_the_fallback_lets_it_go(tmp_path: Path, run_flight: RunFlight, arguments: tuple[str, ...]) -> None:
    # The cameras take another body for ours: its positions are not believed, and ours do not come back.
    swapped = 'sim.fault=[{at_s=9.0,kind="swapped",for_s=100.0}]'
    rig = EndingRig(tmp_path, "fallback.land=false", swapped, airborne=not arguments)
    report = run_flight(rig, Cause.FALLBACK_STOPPED, *arguments)
    assert "jumped" in report.ending["sentence"]


@pytest.mark.slow
def test_landing_fails(tmp_path: Path, run_flight: RunFlight) -> None:
    rig = EndingRig(tmp_path, "hand_over.land_s=2.0").add_step_in(
        HandoverState.ENGAGED, drop_messages("COMMAND_LONG"), after_s=2.0
    )
    report = run_flight(rig, Cause.LANDING_FAILED, *TAKE_OFF, "--duration", "9")
    assert "in the air" in report.ending["sentence"]


@pytest.mark.slow
@pytest.mark.fault(67)
def test_a_landing_without_an_answer_is_requested_until_it_is_confirmed(tmp_path: Path, run_flight: RunFlight) -> None:
    rig = EndingRig(tmp_path, "hand_over.land_s=8.0").add_step_in(
        HandoverState.ENGAGED, drop_messages("COMMAND_LONG"), after_s=2.0
    )
    rig.add_step_in(HandoverState.LANDING, deliver_messages, after_s=12.0)
    report = run_flight(rig, Cause.TIME_OVER, *TAKE_OFF, "--duration", "9", good=True)
    assert "landed and disarmed" in report.ending["sentence"] and "requested again" in report.console


@pytest.mark.slow
def test_positions_that_jump_in_the_climb_break_it_off(tmp_path: Path, run_flight: RunFlight) -> None:
    swapped = ("sim.camera.swapped=[[1.6, 60.0]]", "sim.camera.other_body_m=[2.0, 1.5, -0.5]")
    report = run_flight(EndingRig(tmp_path, *swapped), Cause.CLIMB_ABORTED, *TAKE_OFF)
    assert "jumped" in report.ending["sentence"] and "landed and disarmed" in report.ending["sentence"]


@pytest.mark.slow
def test_it_disarms_before_it_has_left_the_ground(tmp_path: Path, run_flight: RunFlight) -> None:
    rig = EndingRig(tmp_path).add_step_in(
        HandoverState.CLIMBING, lambda rig_now: rig_now.peers.autopilot.pilot._apply_disarming(), after_s=0.0
    )
    run_flight(rig, Cause.NOT_RISEN, *TAKE_OFF)


@pytest.mark.slow
def test_it_disarms_in_flight(tmp_path: Path, run_flight: RunFlight) -> None:
    rig = EndingRig(tmp_path).add_step_in(
        HandoverState.ENGAGED, lambda rig_now: rig_now.peers.autopilot.pilot._apply_disarming(), after_s=2.0
    )
    run_flight(rig, Cause.VEHICLE_DISARMED, *TAKE_OFF)


@pytest.mark.slow
def test_the_envelope_lets_it_go(tmp_path: Path, run_flight: RunFlight) -> None:
    rig = EndingRig(tmp_path, "target.position_m=[2.0,1.0,-1.2]", peers=("frame.yaw_deg=90.0",))
    report = run_flight(rig, Cause.ENVELOPE, *TAKE_OFF)
    assert report.summary["let_go"] and report.summary["let_go"] in report.ending["sentence"]


@pytest.mark.slow
def test_a_failsafe_of_the_vehicle_s_own_lands_it(tmp_path: Path, run_flight: RunFlight) -> None:
    rig = EndingRig(tmp_path).add_step_in(HandoverState.ENGAGED, start_failsafe(Role.LAND), after_s=2.0)
    run_flight(rig, Cause.FAILSAFE_LANDED, *TAKE_OFF)


@pytest.mark.slow
def test_a_failsafe_of_the_vehicle_s_own_hovers_and_does_not_end(tmp_path: Path, run_flight: RunFlight) -> None:
    rig = EndingRig(tmp_path, "hand_over.climb_s=8.0")
    rig.add_step_in(HandoverState.ENGAGED, drop_messages("SET_POSITION_TARGET_LOCAL_NED"), after_s=2.0)
    report = run_flight(rig, Cause.VEHICLE_FAILSAFE, *TAKE_OFF)
    assert "not ended in 8 s" in report.ending["sentence"] and "landed and disarmed" in report.ending["sentence"]


@pytest.mark.slow
def test_a_failsafe_ends_a_flight_that_the_pilot_began(tmp_path: Path, run_flight: RunFlight) -> None:
    rig = EndingRig(tmp_path, airborne=True).add_step_in(HandoverState.ENGAGED, start_failsafe(Role.HOLD), after_s=2.0)
    rig.add_step_in(HandoverState.TAKEN_OVER, interrupt, after_s=2.0)
    report = run_flight(rig, Cause.VEHICLE_FAILSAFE)
    assert "in the air" in report.ending["sentence"]


@pytest.mark.slow
def test_the_vehicle_restarts(tmp_path: Path, run_flight: RunFlight) -> None:
    def young(rig: EndingRig) -> None:
        mav = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
        for boot_ms in (100, 150):
            data = bytes(mavlink.MAVLink_local_position_ned_message(boot_ms, 0, 0, 0, 0, 0, 0).pack(mav))
            rig.lines["vehicle"].arrived.append((data, rig.now_ns))

    rig = (
        EndingRig(tmp_path)
        .add_step_in(HandoverState.ENGAGED, young, after_s=2.0)
        .add_step_in(HandoverState.TAKEN_OVER, interrupt, after_s=2.0)
    )
    run_flight(rig, Cause.VEHICLE_RESTARTED, *TAKE_OFF)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "state"),
    [(TAKE_OFF, HandoverState.ENGAGED), ((), HandoverState.ENGAGED), (TAKE_OFF, HandoverState.CLIMBING)],
)
def test_the_vehicle_falls_silent(
    tmp_path: Path, run_flight: RunFlight, arguments: tuple[str, ...], state: HandoverState
) -> None:
    def silence(rig: EndingRig) -> None:
        rig.is_received = lambda data: False

    rig = EndingRig(tmp_path, "hand_over.land_s=6.0", "hand_over.climb_s=2.0", airborne=not arguments)
    rig.add_step_in(state, silence, after_s=0.0 if state is HandoverState.CLIMBING else 2.0)
    rig.add_step_in(HandoverState.ENGAGED, interrupt, after_s=12.0)
    run_flight(rig, Cause.VEHICLE_SILENT, *arguments)


@pytest.mark.slow
def test_the_connection_is_closed(tmp_path: Path, run_flight: RunFlight) -> None:
    def close(rig: EndingRig) -> None:
        rig.lines["vehicle"].closed = True

    run_flight(
        EndingRig(tmp_path).add_step_in(HandoverState.ENGAGED, close, after_s=2.0), Cause.CONNECTION_CLOSED, *TAKE_OFF
    )


@pytest.mark.fault(64)
@pytest.mark.usefixtures("control_may_fail")
def test_the_controller_fails_and_the_relay_goes_on(
    tmp_path: Path, run_flight: RunFlight, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object, **__: object) -> None:
        raise ArithmeticError("the core is broken")

    rig = EndingRig(tmp_path, "relay.enabled=true", "sim.plant=quadrotor")
    rig.add_step_in(HandoverState.ENGAGED, lambda _: monkeypatch.setattr(control, "run_tick", broken), after_s=2.0)
    report = run_flight(rig, Cause.CONTROL_FAILED, *TAKE_OFF)
    assert "the core is broken" in report.ending["sentence"] and "landed and disarmed" in report.ending["sentence"]
    assert "after the last setpoint" in report.ending["relay"] and report.ending["relay"] in report.console
    assert report.ending["relay"] in report.page
    assert report.relay is not None and report.relay.alone


@pytest.mark.slow
def test_the_operator_is_answered_while_the_relay_goes_on_alone(tmp_path: Path, run_flight: RunFlight) -> None:
    rig = EndingRig(tmp_path, "relay.enabled=true", "sim.plant=quadrotor")
    rig.add_step_in(HandoverState.ENGAGED, EndingRig.request_status, after_s=1.0).add_step_in(
        HandoverState.ENGAGED, make_switch("POSCTL"), after_s=2.0
    )
    rig.add_step_in(HandoverState.TAKEN_OVER, interrupt, after_s=1.0).add_step_in(
        HandoverState.TAKEN_OVER, EndingRig.request_status, after_s=3.0
    )
    rig.add_step_in(HandoverState.TAKEN_OVER, make_switch("AUTO.LAND"), after_s=5.0).add_step_in(
        HandoverState.TAKEN_OVER, EndingRig.request_status, after_s=6.0
    )
    report = run_flight(rig, Cause.PILOT, *TAKE_OFF, good=True)
    flying, alone, landing = rig.statuses
    assert (flying["ending"], flying["relay"]["alone"]) == ("", False)
    assert flying["relay"]["sent"] < alone["relay"]["sent"] < landing["relay"]["sent"]
    for status, mode in ((alone, "POSCTL"), (landing, "AUTO.LAND")):
        assert status["relay"]["alone"] and status["relay"]["sent_hz"] > 0.0 and status["relay"]["last_s"] < 3.0
        assert status["ending"].lower().startswith(CAUSES[Cause.PILOT].phrase)
        assert f"in the air, in mode {mode}" in status["ending"]
        assert status["who_flies"] == HandoverState.TAKEN_OVER
    assert report.relay is not None and report.relay.alone


@pytest.mark.slow
def test_the_operator_ends_it_and_is_answered_with_the_end_under_way(tmp_path: Path, run_flight: RunFlight) -> None:
    rig = (
        EndingRig(tmp_path)
        .add_step_in(HandoverState.ENGAGED, interrupt, after_s=2.0)
        .add_step_in(HandoverState.LANDING, EndingRig.request_status, after_s=0.5)
    )
    report = run_flight(rig, Cause.ENDED_BY_OPERATOR, *TAKE_OFF, good=True)
    assert "landed and disarmed" in report.ending["sentence"] and not report.is_left_in_flight
    (status,) = rig.statuses
    assert status["ending"].lower().startswith(CAUSES[Cause.ENDED_BY_OPERATOR].phrase)
    assert "in the air" in status["ending"]
    assert status["who_flies"] in (HandoverState.LANDING, HandoverState.SETTLING) and status["relay"] is None


# Ends that leave less behind


def test_a_second_signal_ends_it_at_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rig = (
        EndingRig(tmp_path)
        .add_step_in(HandoverState.ENGAGED, interrupt, after_s=2.0)
        .add_step_in(HandoverState.ENGAGED, interrupt, after_s=0.1)
    )
    report = fly_command(rig, capsys, *TAKE_OFF)
    (recorded,) = report.recorded_endings
    assert (recorded.code, recorded.exit_code) == (Cause.SIGNALLED, 130)
    assert report.code == 130 and f"ended: {recorded.sentence}" in report.console and report.status == recorded.sentence
    assert "in the air" in recorded.sentence
    page = report.path.with_name("again.html")
    with omit_figures():
        code = run(["log", "report", str(report.path), "--out", str(page), "--rehearsals", "0"])
    capsys.readouterr()
    assert code == 0 and recorded.sentence in read_page_text(page)


@pytest.mark.slow
def test_a_full_disk_is_reported_with_the_ending(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fill(_: EndingRig) -> None:
        monkeypatch.setattr(DiskRecorder, "full", True)

    rig = EndingRig(tmp_path).add_step_in(HandoverState.ENGAGED, fill, after_s=2.0)
    report = fly_command(rig, capsys, *TAKE_OFF, "--duration", "9")
    ending = report.ending
    assert ending["code"] == Cause.TIME_OVER and not ending["as_ordered"] and report.code == ending["exit_code"] == 1
    assert "the recording lacks" in ending["sentence"] and "No space left on device" in ending["sentence"]
    assert f"ended: {ending['sentence']}" in report.console and ending["sentence"] in report.page
    assert ending["sentence"].startswith(report.status.removesuffix("."))


# What the daemon has no part in


@pytest.mark.slow
def test_a_cut_off_end_is_reported_everywhere(
    tmp_path: Path, run_flight: RunFlight, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The time of a hand-over is longer than that of any request to land, so it takes a shorter one to be cut off.
    monkeypatch.setattr(flight_orders, "LANDING_S", 1.0)
    rig = EndingRig(tmp_path, airborne=True).add_step_in(HandoverState.ENGAGED, drop_messages("COMMAND_LONG"))
    report = run_flight(rig.add_step_in(HandoverState.ENGAGED, interrupt, after_s=3.0), Cause.ENDED_IN_AIR)
    assert (
        CAUSES[Cause.ENDED_BY_OPERATOR].phrase in report.ending["sentence"]
        and "in the air" in report.ending["sentence"]
    )


@pytest.mark.slow
def test_a_simulated_flight_that_is_still_flying_is_reported_everywhere(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["loopback", *PRESET, "--duration", "4", "--out", str(tmp_path), "--json"]
    code = run(arguments)
    out, err = capsys.readouterr()
    ending, path = json.loads(out)["ending"], tmp_path / "flight.mcap"
    assert (code, ending["code"], ending["exit_code"]) == (0, Cause.IN_FLIGHT, 0)
    assert f"ended: {ending['sentence']}" in " ".join(err.split())
    assert ending["sentence"] in read_page_text(path.with_suffix(".html"))
    flight = FlightData.from_records(read(path))
    assert [msgspec.to_builtins(recorded_ending) for recorded_ending in flight.endings] == [ending]
    assert summarise(flight, wall_s=None).ending.sentence == ending["sentence"]


def test_a_cut_off_end_has_its_own_cause() -> None:
    account = FlightAccount(was_engaged=True, was_controlled=True)
    account.note_requested_end(Cause.ENDED_BY_OPERATOR)
    for is_over, code, exit_code in ((False, Cause.ENDED_IN_AIR, 1), (True, Cause.ENDED_BY_OPERATOR, 0)):
        ending = account.compute_ending(is_over=is_over)
        assert (ending.code, ending.exit_code) == (code, exit_code)


def test_the_table_of_the_documentation_has_every_cause_with_its_exit_code() -> None:
    page = (ROOT / "docs" / "operation.md").read_text(encoding="utf-8")
    table = page.partition("| exit code | `code` |\n|---|---|\n")[2].partition("\n\n")[0]
    rows = [line.strip("| ").split(" | ") for line in table.splitlines()]
    codes = [(cause, title.partition(",")[0]) for title, cell in rows for cause in re.findall(r"`([a-z-]+)`", cell)]
    listed = [(cause, code) for cause, code in codes if cause in CAUSES and cause != Cause.SIGNALLED]
    ends = {cause for cause, text in CAUSES.items() if text.phrase} - {Cause.WAITING, Cause.SIGNALLED}
    assert sorted(listed) == sorted((cause, str(make_ending(cause, "").exit_code)) for cause in ends)
