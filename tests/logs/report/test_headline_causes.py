"""What a page names first: one flight for each cause, in the simulator or made from its records, judged by the code."""

from __future__ import annotations

import dataclasses
import math
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from loopback_rig import lockstep
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from synthetic_flight import fly
from synthetic_scene import room
from text_numbers import find_numbers

from logs.recording.flight import FlightData
from logs.recording.mavlink_flight import read_flight
from logs.recording.notes import NoteKind, RecorderNote
from logs.recording.summary import compute_course_error, compute_position_errors_m, summarise
from logs.report.evidence import FlightEvidence
from logs.report.findings import Headline, sort_findings
from logs.report.headline import derive_headline
from logs.report.tlog_headline import derive_tlog_headline
from logs.report.vehicle_texts import classify_text
from logs.report.verdicts import judge_flight
from uavctl.account import make_ending
from uavctl.cause import CAUSES, CAUTION, GOOD, Cause
from uavctl.event_codes import EventCode
from uavctl.mavlink.codec import BAD_FIELD
from uavctl.records import ControlMode, Event, LinkStats, RelayStats, Severity, VehicleStatus

SECOND = 1_000_000_000
AUTOPILOTS = ("px4", "ardupilot")
PILOTS = {"px4": "POSCTL", "ardupilot": "LOITER"}


def head(flight: FlightData) -> Headline:
    return derive_headline(FlightEvidence(flight, summarise(flight, wall_s=None), judge_flight(flight)))


def flown(autopilot: str, duration_s: float, *overrides: str) -> FlightData:
    near = ("sim.seed=1", "target.position_m=[-1.5, -1.2, -1.2]")
    return FlightData.from_records(lockstep(f"room-{autopilot}", duration_s, *near, *overrides).entries)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("autopilot", "fault", "wanted"),
    [
        ("px4", '{at_s=5.0, kind="battery", charge=0.0}', Cause.BATTERY_EMPTY),
        ("ardupilot", '{at_s=4.0, kind="frozen", for_s=8.0}', Cause.POSITIONS_FROZEN),
        ("px4", '{at_s=4.0, kind="drift", velocity_mps=[-0.15, 0.0, 0.0]}', Cause.POSITIONS_DRIFTED),
        ("ardupilot", '{at_s=4.0, kind="frame", name="turned-90"}', Cause.POSITIONS_JUMPED),
        ("px4", '{at_s=4.0, kind="blackout", for_s=8.0}', Cause.FLOWN_BLIND),
    ],
)
def test_a_fault_is_named_and_never_called_wind(autopilot: str, fault: str, wanted: Cause) -> None:
    headline = head(flown(autopilot, 12.0, f"sim.fault=[{fault}]"))
    assert headline.cause is wanted
    assert Cause.WIND not in headline.causes and Cause.ALL_WELL not in headline.causes


@pytest.mark.slow
@pytest.mark.parametrize("autopilot", AUTOPILOTS)
def test_the_pilots_stick_is_named(autopilot: str) -> None:
    fault = f'{{at_s=5.0, kind="mode", name="{PILOTS[autopilot]}"}}'
    flight = flown(autopilot, 8.0, f"sim.fault=[{fault}]")
    left = next(status for status in flight.vehicles if not status.external)
    # Who switched is the ending's to say; a recording without one tells the mode alone.
    assert head(flight).cause in (Cause.PILOT, Cause.MODE_LEFT)
    ended = dataclasses.replace(flight, endings=(make_ending(Cause.PILOT, ""),))
    headline = head(ended)
    assert headline.cause is Cause.PILOT and headline.at_s == pytest.approx((left.at_ns - flight.origin_ns) * 1e-9)


# --- made from the records of one good flight ---


@pytest.fixture(scope="module")
def good() -> FlightData:
    flight = FlightData.from_records(fly(room(), 12.0))
    return dataclasses.replace(flight, endings=(make_ending(Cause.ENDED_BY_OPERATOR, ""),))


def add_event(
    flight: FlightData, at_s: float, code: str, text: str, severity: Severity, count: int = 1, subject: str = ""
) -> FlightData:
    at_ns = flight.origin_ns + round(at_s * SECOND)
    event = Event(at_ns=at_ns, severity=severity, code=code, text=text, count=count, subject=subject)
    return dataclasses.replace(flight, events=(*flight.events, event))


def with_ending(flight: FlightData, cause: Cause) -> FlightData:
    return dataclasses.replace(flight, endings=(make_ending(cause, CAUSES[cause].phrase),))


def statuses(flight: FlightData, volts: Sequence[float | None], **more: Any) -> FlightData:
    """The flight with a heartbeat each second, whose battery has these voltages."""
    kept = [
        VehicleStatus(
            at_ns=flight.origin_ns + number * SECOND, autopilot="px4", armed=True, mode="OFFBOARD", external=True,
            landed=False, battery_v=value, **more,
        )
        for number, value in enumerate(volts)
    ]  # fmt: skip
    return dataclasses.replace(flight, vehicles=tuple(kept))


@pytest.mark.parametrize(
    ("volts", "cause"),
    [
        ([4.2] * 6 + [0.0] * 6, Cause.BATTERY_EMPTY),
        ([12.6 - 0.3 * n for n in range(12)], Cause.BATTERY_LOW),
        ([4.2 - 0.02 * n for n in range(12)], None),
        ([4.2] * 5 + [0.0] + [4.2] * 6, None),  # one reading is a glitch
        ([0.0] * 12, None),  # a vehicle that measures none
        ([None] * 12, None),
    ],
)
def test_a_battery_that_falls(good: FlightData, volts: list[float | None], cause: Cause | None) -> None:
    headline = head(statuses(good, volts))
    assert {Cause.BATTERY_EMPTY, Cause.BATTERY_LOW} & set(headline.causes) == ({cause} if cause else set())
    assert cause is None or headline.cause is cause


@pytest.mark.parametrize(
    ("text", "severity", "cause"),
    [
        ("Radio Failsafe", Severity.WARNING, Cause.VEHICLE_FAILSAFE),
        ("Battery Failsafe", Severity.WARNING, Cause.BATTERY_LOW),
        ("Max Alt fence breached", Severity.INFO, Cause.VEHICLE_FENCE),
        ("EKF variance", Severity.ERROR, Cause.VEHICLE_POSITION_LOST),
        ("Crash: Disarming", Severity.ERROR, Cause.VEHICLE_ALARM),
        ("Compass error", Severity.WARNING, Cause.VEHICLE_WARNED),
        ("Fence breach cleared", Severity.INFO, None),
        ("Takeoff detected", Severity.INFO, None),
    ],
)
def test_what_the_vehicle_says(good: FlightData, text: str, severity: Severity, cause: Cause | None) -> None:
    plain = statuses(good, [4.1] * 12)
    headline = head(add_event(plain, 6.0, "vehicle-text", text, severity))
    assert headline.causes == (head(plain).causes if cause is None else (cause, *set(headline.causes) - {cause}))
    disarmed = dataclasses.replace(
        plain, vehicles=tuple(msgspec.structs.replace(status, armed=False) for status in plain.vehicles)
    )
    assert cause is None or cause not in head(add_event(disarmed, 6.0, "vehicle-text", text, severity)).causes


@pytest.mark.parametrize(
    ("ending", "cause"),
    [
        (Cause.VEHICLE_FAILSAFE, Cause.VEHICLE_FAILSAFE),
        (Cause.FAILSAFE_LANDED, Cause.VEHICLE_FAILSAFE),
        (Cause.PILOT, Cause.PILOT),
        (Cause.PILOT_LANDED, Cause.PILOT),
        (Cause.VEHICLE_SILENT, Cause.VEHICLE_SILENT),
        (Cause.CONNECTION_CLOSED, Cause.VEHICLE_SILENT),
        (Cause.VEHICLE_RESTARTED, Cause.VEHICLE_RESTARTED),
        (Cause.VEHICLE_DISARMED, Cause.VEHICLE_DISARMED),
        (Cause.CONTROL_FAILED, Cause.CONTROL_FAILED),
        (Cause.LANDING_FAILED, Cause.NOT_AS_ORDERED),
    ],
)
def test_how_it_ended(good: FlightData, ending: Cause, cause: Cause) -> None:
    assert head(with_ending(statuses(good, [4.1] * 12), ending)).cause is cause


def test_every_end_that_was_not_ordered_has_a_headline(good: FlightData) -> None:
    for cause in (cause for cause, text in CAUSES.items() if text.phrase):
        ended = with_ending(good, cause)
        assert ended.endings[0].as_ordered or head(ended).tone != GOOD


def test_a_killed_process_is_told_with_what_is_left(good: FlightData) -> None:
    note = RecorderNote(at_ns=good.decisions[-1].at_ns, text="", kind=NoteKind.RECOVERED, segment=1, written=0,
                        dropped=0, refused=0, failures=0)  # fmt: skip
    cut = dataclasses.replace(statuses(good, [4.1] * 12), endings=(), notes=(note,))
    assert head(cut).cause is Cause.RECORDING_CUT


def test_a_process_that_is_killed_in_the_vehicles_own_climb_has_cut_the_recording(good: FlightData) -> None:
    waited = tuple(msgspec.structs.replace(decision, mode=ControlMode.WAIT) for decision in good.decisions)
    begun = RecorderNote(
        at_ns=good.origin_ns, text="", kind=NoteKind.BEGIN, segment=1, written=0, dropped=0, refused=0, failures=0
    )
    cut = dataclasses.replace(statuses(good, [4.1] * 12), decisions=waited, endings=(), notes=(begun,))
    assert cut.breaks_off and head(cut).cause is Cause.RECORDING_CUT
    down = tuple(msgspec.structs.replace(status, armed=False) for status in cut.vehicles)
    assert Cause.RECORDING_CUT not in head(dataclasses.replace(cut, vehicles=down)).causes


@pytest.mark.parametrize("predicted", [True, False])
def test_a_prediction_alone_says_of_no_wall_that_it_was_passed(good: FlightData, predicted: bool) -> None:
    """Estimates from 6 s on are 20 m away: of recent positions, or of none since then."""
    last_ns = good.origin_ns + 6 * SECOND
    far = tuple(
        msgspec.structs.replace(
            estimate,
            mean=(20.0, *estimate.mean[1:]),
            captured_ns=last_ns - 90 * SECOND if predicted else estimate.captured_ns,
        )
        if estimate.at_ns > last_ns
        else estimate
        for estimate in good.estimates
    )
    aged = tuple(
        msgspec.structs.replace(decision, age_steps=1000) if predicted and decision.at_ns > last_ns else decision
        for decision in good.decisions
    )
    flight = dataclasses.replace(good, truths=(), estimates=far, decisions=aged)
    assert (Cause.LEFT_LIMITS in head(flight).causes) != predicted
    assert (summarise(flight, wall_s=None).state_violations == 0) == predicted


@pytest.mark.parametrize("ran", [True, False])
def test_a_vehicle_is_not_silent_while_we_did_not_run(good: FlightData, ran: bool) -> None:
    """Four seconds without a heartbeat, in which the process ran, or stood still."""
    begun_ns, ended_ns = (good.origin_ns + n * SECOND for n in (4, 8))
    plain = statuses(good, [4.1] * 12)
    heard = tuple(status for status in plain.vehicles if not begun_ns < status.at_ns < ended_ns)
    ticks = tuple(decision for decision in good.decisions if ran or not begun_ns < decision.at_ns < ended_ns)
    headline = head(dataclasses.replace(plain, vehicles=heard, decisions=ticks))
    assert (Cause.VEHICLE_SILENT in headline.causes) == ran and (Cause.STOOD_STILL in headline.causes) != ran
    off = tuple(msgspec.structs.replace(status, armed=False) for status in heard)
    assert Cause.VEHICLE_SILENT not in head(dataclasses.replace(plain, vehicles=off)).causes


@pytest.mark.parametrize(("missed", "is_slow"), [(0.0, False), (0.005, False), (0.03, True)])
def test_a_computer_that_misses_ticks_is_named(good: FlightData, missed: float, is_slow: bool) -> None:
    """Every so-many-th tick comes one period late; the share of the ticks missed decides."""
    period = round(1.0 / missed) if missed else len(good.decisions) + 1
    decisions = tuple(
        msgspec.structs.replace(decision, missed_ticks=1) if number % period == period - 1 else decision
        for number, decision in enumerate(good.decisions)
        if number % period != period - 2
    )
    assert (Cause.COMPUTER_SLOW in head(dataclasses.replace(good, decisions=decisions)).causes) == is_slow


@pytest.mark.parametrize("tick", [1, 3])
def test_a_flight_whose_first_ticks_were_missed_is_whole(good: FlightData, tick: int) -> None:
    first = msgspec.structs.replace(good.decisions[tick], missed_ticks=tick)
    assert first.tick == tick
    assert not dataclasses.replace(good, decisions=(first, *good.decisions[tick + 1 :])).part
    assert dataclasses.replace(good, decisions=good.decisions[tick:]).part


@pytest.mark.parametrize(
    ("code", "cause"),
    [
        ("sample-frozen", Cause.POSITIONS_FROZEN),
        ("sample-jump", Cause.POSITIONS_JUMPED),
        ("sample-future", Cause.STAMPS_UNUSABLE),
        ("sample-invalid", Cause.POSITIONS_INVALID),
        ("relay-silent", Cause.RELAY_SILENT),
        ("relay-attitude", Cause.RELAY_ATTITUDE),
        ("second-vehicle", Cause.SECOND_VEHICLE),
    ],
)
def test_what_was_refused(good: FlightData, code: str, cause: Cause) -> None:
    headline = head(add_event(good, 5.0, code, "", Severity.WARNING, count=75))
    assert cause in headline.causes and Cause.ALL_WELL not in headline.causes


def with_bad(flight: FlightData, reason: str, count: int) -> FlightData:
    """The flight on a connection that used none of so many messages."""
    stats = LinkStats(at_ns=flight.decisions[-1].at_ns, link="mocap", datagrams=200, messages=200, samples=0,
                      bad={reason: count}, clock_offset_ns=None, clock_source="none")  # fmt: skip
    return dataclasses.replace(flight, links=(stats,))


def test_stamps_without_a_time_of_capture(good: FlightData) -> None:
    assert Cause.STAMPS_UNUSABLE in head(with_bad(good, "duplicate", 200)).causes


def test_a_relay_that_stops_is_told_by_its_counters(good: FlightData) -> None:
    rows = tuple(
        RelayStats(at_ns=good.origin_ns + n * SECOND, sent=min(20 * n, 100), kept={"no-clock": max(0, 20 * (n - 5))},
                   last_ns=None, alone=False)
        for n in range(1, 12)
    )  # fmt: skip
    plain = statuses(good, [4.1] * 12)
    assert Cause.RELAY_SILENT in head(dataclasses.replace(plain, relays=rows)).causes
    whole = tuple(msgspec.structs.replace(row, sent=20 * n) for n, row in enumerate(rows))
    assert Cause.RELAY_SILENT not in head(dataclasses.replace(plain, relays=whole)).causes


@pytest.mark.parametrize(
    ("came", "unread", "cause"),
    [(False, 0, Cause.POSITIONS_ABSENT), (True, 0, Cause.POSITIONS_INVALID), (False, 90, Cause.POSITIONS_INVALID)],
)
def test_a_position_that_was_never_valid(good: FlightData, came: bool, unread: int, cause: Cause) -> None:
    """Nothing was ever estimated, as no position came, none was a number, or none could be used."""
    waited = tuple(
        msgspec.structs.replace(decision, mode=ControlMode.WAIT, accepted=0, plan_seq=None, input=None)
        for decision in good.decisions
    )
    inputs = tuple(step if came else msgspec.structs.replace(step, samples=()) for step in good.step_inputs)
    never = dataclasses.replace(good, decisions=waited, estimates=(), plans=(), step_inputs=inputs)
    assert head(with_bad(never, BAD_FIELD, unread)).cause is cause


def test_all_well_is_said_of_a_flight_in_which_nothing_is_amiss(good: FlightData) -> None:
    headline = head(good)
    assert headline.tone == GOOD and headline.cause is Cause.ALL_WELL


@pytest.mark.parametrize("off_m", [0.0, 0.36])
def test_the_whole_course_counts_and_not_its_end(good: FlightData, off_m: float) -> None:
    """A vehicle that is off its target for seconds, and stands on it at the end."""
    steps = good.steps
    state = steps.state.copy()
    state[:, good.design.position_index[0]] += off_m * ((steps.t_s > 5.0) & (steps.t_s < 9.0))
    moved = dataclasses.replace(good)
    moved.__dict__["steps"] = dataclasses.replace(steps, state=state)
    headline, error = head(moved), compute_course_error(moved)
    assert error is not None and (Cause.OFF_TRACK in headline.causes) == bool(off_m)
    assert error.worst_m == pytest.approx(compute_position_errors_m(moved)[steps.t_s >= 5.0].max()) or not off_m
    assert not off_m or 5.0 < error.worst_s < 9.0


@pytest.mark.parametrize(
    ("beyond_mps", "steps", "found"), [(0.04, 2, False), (0.2, 2, True), (0.04, 30, True), (math.nan, 1, True)]
)
def test_a_speed_slightly_beyond_its_limit_for_a_moment_is_as_promised(
    good: FlightData, beyond_mps: float, steps: int, found: bool
) -> None:
    flown = good.steps
    state, index = flown.state.copy(), good.design.velocity_index[0]
    limit_mps = float(good.design.state_box.upper[index])
    state[20 : 20 + steps, index] = limit_mps + beyond_mps
    moved = dataclasses.replace(good)
    moved.__dict__["steps"] = dataclasses.replace(flown, state=state)
    assert (Cause.BEYOND_LIMIT in head(moved).causes) == found


@pytest.mark.parametrize(
    ("beyond_m", "cause"), [(0.01, Cause.ALL_WELL), (0.03, Cause.TOUCHED_LIMIT), (0.2, Cause.LEFT_LIMITS)]
)
def test_a_wall_that_is_passed_by_less_than_a_position_is_off_is_no_headline(
    good: FlightData, beyond_m: float, cause: Cause
) -> None:
    wall_m = float(good.design.state_box.upper[good.design.position_index[0]])
    truths = list(good.truths)
    middle = len(truths) // 2
    _, *others = truths[middle].position_m
    truths[middle] = msgspec.structs.replace(truths[middle], position_m=(wall_m + beyond_m, *others))
    assert head(dataclasses.replace(good, truths=tuple(truths))).cause is cause


def test_the_gravest_comes_first_and_within_a_rank_the_earliest(good: FlightData) -> None:
    failed = add_event(statuses(good, [4.2] * 6 + [0.0] * 6), 2.0, "vehicle-text", "Radio Failsafe", Severity.INFO)
    headline = head(add_event(failed, 1.0, "vehicle-text", "Max Alt fence breached", Severity.INFO))
    assert headline.causes[:3] == (Cause.BATTERY_EMPTY, Cause.VEHICLE_FENCE, Cause.VEHICLE_FAILSAFE)
    assert sort_findings([]) == []
    assert classify_text("PreArm: Battery Failsafe", Severity.ERROR) is None


@pytest.mark.parametrize(("lets_go", "reason"), [(False, "held back"), (True, "held back"), (True, "nothing comes")])
def test_a_relay_that_is_held_back_as_the_vehicle_was_let_go_is_no_cause(
    good: FlightData, lets_go: bool, reason: str
) -> None:
    flight = add_event(good, 5.5, "relay-silent", "", Severity.WARNING)
    row = RelayStats(at_ns=good.origin_ns + 6 * SECOND, sent=100, kept={}, last_ns=good.origin_ns + 5 * SECOND,
                     alone=False, silent_for=reason)  # fmt: skip
    if lets_go:
        flight = add_event(flight, 5.0, EventCode.OUTSIDE, "the estimate leaves a limit", Severity.ERROR)
    headline = head(dataclasses.replace(flight, relays=(row,)))
    assert (Cause.RELAY_SILENT in headline.causes) != (lets_go and reason == "held back")


@pytest.mark.parametrize(("left_s", "windy"), [(None, True), (6, False), (11, True)])
def test_what_pushes_once_the_vehicle_follows_setpoints_no_more_is_no_wind(
    good: FlightData, left_s: int | None, windy: bool
) -> None:
    """The vehicle lands by itself from a time on; a push is told at 5.6 s."""
    plain = statuses(good, [4.1] * 12)
    modes = tuple(
        status
        if left_s is None or number < left_s
        else msgspec.structs.replace(status, mode="AUTO.LAND", external=False, failsafe=True)
        for number, status in enumerate(plain.vehicles)
    )
    flight = add_event(dataclasses.replace(plain, vehicles=modes), 5.6, "bias-at-bound", "", Severity.WARNING)
    assert (Cause.WIND in head(flight).causes) == windy


@pytest.mark.parametrize(
    ("landed", "moves_m", "risen"), [(True, 0.003, False), (True, 0.5, True), (False, 0.003, True)]
)
def test_a_vehicle_that_was_armed_and_stood_still_never_rose(
    good: FlightData, landed: bool, moves_m: float, risen: bool
) -> None:
    """It stands at one place from its first heartbeat on, on the ground or in the air, or moves."""
    plain = statuses(good, [4.1] * 12)
    first, *later = plain.vehicles
    vehicles = (msgspec.structs.replace(first, armed=False, landed=landed), *later)
    inputs = tuple(
        msgspec.structs.replace(
            step,
            samples=tuple(
                msgspec.structs.replace(sample, position_m=(moves_m * (number // 20 % 2), 0.0, 0.0))
                for sample in step.samples
            ),
        )
        for number, step in enumerate(plain.step_inputs)
    )
    headline = head(dataclasses.replace(plain, vehicles=vehicles, step_inputs=inputs))
    assert (Cause.NOT_RISEN in headline.causes) != risen


@pytest.mark.parametrize("order", ["COMPONENT_ARM_DISARM", "DO_SET_MODE"])
@pytest.mark.parametrize("armed", [False, True])
def test_a_vehicle_that_never_armed_refused_it(good: FlightData, order: str, armed: bool) -> None:
    grounded = statuses(good, [4.1] * 12)
    vehicles = tuple(
        msgspec.structs.replace(status, armed=armed, external=False, landed=True) for status in grounded.vehicles
    )
    waited = tuple(
        msgspec.structs.replace(decision, mode=ControlMode.WAIT, boundary=False) for decision in good.decisions
    )
    flight = dataclasses.replace(grounded, vehicles=vehicles, decisions=waited, setpoints=())
    refused = add_event(flight, 3.0, "command-ack", "", Severity.WARNING, subject=order)
    assert (head(refused).cause is Cause.BEGIN_REFUSED) != armed
    granted = add_event(refused, 5.0, "command-ack", "", Severity.INFO, subject=order)
    assert Cause.BEGIN_REFUSED not in head(granted).causes


# --- MAVLink of others ---


def written(tmp_path: Path, packets: list[tuple[float, int, Any]]) -> Headline:
    senders: dict[int, Any] = {}
    data = bytearray()
    for at_s, system, message in sorted(packets, key=lambda packet: packet[0]):
        mav = senders.setdefault(system, mavlink.MAVLink(None, srcSystem=system, srcComponent=1))
        data += struct.pack(">Q", 1_764_000_000_000_000 + round(at_s * 1e6)) + message.pack(mav)
    path = tmp_path / "a.tlog"
    path.write_bytes(data)
    return derive_tlog_headline(read_flight(path))


def beat(mode: int = 4, *, armed: bool = True) -> Any:
    flags = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | (mavlink.MAV_MODE_FLAG_SAFETY_ARMED if armed else 0)
    return mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_QUADROTOR, 3, flags, mode, 4, 3)


def course(duration_s: float = 12.0, *, system: int = 1) -> list[tuple[float, int, Any]]:
    """A vehicle in GUIDED that moves north, and cameras that see it."""
    out: list[tuple[float, int, Any]] = []
    for n in range(round(10 * duration_s)):
        t = 0.1 * n
        own = mavlink.MAVLink_local_position_ned_message(100 * n, 0.05 * n, 0.0, -1.0, 0.5, 0.0, 0.0)
        out.append((t, system, own))
        seen = mavlink.MAVLink_vision_position_estimate_message(100_000 * n, 0.05 * n, 1e-3 * (n % 7), -1.0, 0, 0, 0)
        out.append((t, 20, seen))
        if n % 10 == 0:
            out.append((t, system, beat()))
    return out


def status(at_s: float, volts: float) -> tuple[float, int, Any]:
    return at_s, 1, mavlink.MAVLink_sys_status_message(0, 0, 0, 0, round(1e3 * volts), -1, -1, 0, 0, 0, 0, 0, 0)


def spoken(at_s: float, text: bytes, severity: int) -> tuple[float, int, Any]:
    return at_s, 1, mavlink.MAVLink_statustext_message(severity, text)


def test_a_log_of_others_in_which_nothing_is_amiss(tmp_path: Path) -> None:
    assert written(tmp_path, course()).cause is Cause.NOTHING_FOUND


def frozen() -> list[tuple[float, int, Any]]:
    stuck = mavlink.MAVLink_vision_position_estimate_message(0, 1.0, 0.0, -1.0, 0, 0, 0)
    return [(t, s, stuck if s == 20 and 4.0 < t < 8.0 else m) for t, s, m in course()]


def killed() -> list[tuple[float, int, Any]]:
    return [message for message in course() if message[1] == 20 or message[0] < 6.0]


def unstamped() -> list[tuple[float, int, Any]]:
    same = mavlink.MAVLink_vision_position_estimate_message
    return [(t, s, same(12345, m.x, m.y, m.z, 0, 0, 0) if s == 20 else m) for t, s, m in course()]


@pytest.mark.parametrize(
    ("packets", "cause"),
    [
        ([*course(), spoken(5.05, b"Radio Failsafe", 4)], Cause.VEHICLE_FAILSAFE),
        ([*course(), spoken(5.05, b"Max Alt fence breached", 5)], Cause.VEHICLE_FENCE),
        ([*course(), spoken(5.05, b"EKF variance", 2)], Cause.VEHICLE_POSITION_LOST),
        ([*course(), *(status(t, 4.2 if t < 6 else 0.1) for t in range(12))], Cause.BATTERY_EMPTY),
        (frozen(), Cause.POSITIONS_FROZEN),
        (killed(), Cause.VEHICLE_SILENT),
        (unstamped(), Cause.STAMPS_UNUSABLE),
        ([m for m in course() if m[1] == 20 or isinstance(m[2], mavlink.MAVLink_heartbeat_message)],
         Cause.POSITIONS_ABSENT),
        ([message for message in course() if message[1] == 1 or not 3.0 < message[0] < 9.0], Cause.SILENCE),
        ([*course(), *((t, s, m) for t, s, m in course(system=2) if s == 2)], Cause.SECOND_VEHICLE),
    ],
)  # fmt: skip
def test_the_cause_in_a_log_of_others(tmp_path: Path, packets: list[tuple[float, int, Any]], cause: Cause) -> None:
    assert written(tmp_path, packets).cause is cause


@pytest.mark.parametrize("off_m", [0.0, 0.36])
def test_setpoints_that_were_not_followed(tmp_path: Path, off_m: float) -> None:
    def wanted(n: int) -> Any:
        north_m = 0.05 * n + (off_m if n > 20 else 0.0)
        return mavlink.MAVLink_set_position_target_local_ned_message(
            0, 1, 1, 1, 0xDF8, north_m, 0, -1, *np.zeros(8).tolist()
        )

    headline = written(tmp_path, [*course(), *((0.1 * n, 245, wanted(n)) for n in range(120))])
    assert (headline.cause is Cause.OFF_TRACK) == bool(off_m)


def send_setpoints(begin_s: float, end_s: float) -> list[tuple[float, int, Any]]:
    """A stream of acceleration setpoints at 10 Hz."""
    wanted = mavlink.MAVLink_set_position_target_local_ned_message(0, 1, 1, 1, 2111, *[0.0] * 11)
    return [(0.1 * n, 245, wanted) for n in range(round(10 * begin_s), round(10 * end_s))]


@pytest.mark.parametrize(("paused_s", "resumed_s", "silent"), [(5.0, 5.5, False), (5.0, 8.0, True), (9.0, 12.0, True)])
def test_setpoints_that_pause_under_a_mode_that_takes_them(
    tmp_path: Path, paused_s: float, resumed_s: float, silent: bool
) -> None:
    sent = [*send_setpoints(1.0, paused_s), *send_setpoints(resumed_s, 12.0)]
    headline = written(tmp_path, [*course(), *sent])
    assert (headline.cause is Cause.SETPOINTS_SILENT) == silent
    assert not silent or headline.at_s == pytest.approx(paused_s - 0.1)


def test_setpoints_of_one_moment_and_of_another_mode_do_not_pause(tmp_path: Path) -> None:
    """A single place needs no stream, and what stops as the vehicle lands was to stop."""
    assert Cause.SETPOINTS_SILENT not in written(tmp_path, [*course(), *send_setpoints(1.0, 1.1)]).causes
    landed = [(t, s, beat(9) if isinstance(m, mavlink.MAVLink_heartbeat_message) and t > 6.5 else m)
              for t, s, m in course()]  # fmt: skip
    assert Cause.SETPOINTS_SILENT not in written(tmp_path, [*landed, *send_setpoints(1.0, 6.2)]).causes


def test_the_cause_of_a_failsafe_comes_before_it(tmp_path: Path) -> None:
    """The relay stops at 4 s, and the vehicle's failsafe takes over at 7 s."""
    relayed = [(t, 245, m) for t, s, m in course() if s == 20 and t < 4.0]
    headline = written(tmp_path, [*course(), *relayed, spoken(7.0, b"Failsafe activated", 2)])
    assert headline.cause is Cause.VEHICLE_FAILSAFE
    assert headline.word == CAUSES[Cause.RELAY_SILENT].title and headline.at_s == pytest.approx(3.9)
    fence = written(tmp_path, [*course(), *relayed, spoken(7.0, b"Max Alt fence breached", 5)])
    assert fence.word == CAUSES[Cause.VEHICLE_FENCE].title


def test_how_far_it_went_under_setpoints_is_told(tmp_path: Path) -> None:
    """It moves north by 0.5 m/s, under GUIDED from 2 s to 9 s: 3.5 m, less the last tenth of a second."""
    packets = [(t, s, beat(4 if 2.0 <= t < 9.0 else 9) if isinstance(m, mavlink.MAVLink_heartbeat_message) else m)
               for t, s, m in course()]  # fmt: skip
    numbers = find_numbers(written(tmp_path, packets).line)
    assert numbers[numbers.index(8.9) - 1] == pytest.approx(0.5 * 6.9, abs=0.051)


@pytest.mark.parametrize(("armed", "tone"), [(True, CAUTION), (False, GOOD)])
def test_a_recording_that_ends_in_flight_is_not_good(tmp_path: Path, armed: bool, tone: str) -> None:
    headline = written(tmp_path, [*course(), (12.0, 1, beat(armed=armed))])
    assert (headline.cause, headline.tone) == (Cause.NOTHING_FOUND, tone)


def test_each_mode_of_the_armed_vehicle_is_told(tmp_path: Path) -> None:
    """A landing of a second after arming, then LOITER twice: times of the heartbeats."""
    modes = {0: 9, 1: 4, 5: 5, 7: 4, 9: 5}  # LAND, GUIDED, LOITER
    packets: list[tuple[float, int, Any]] = []
    mode = 9
    for t, s, m in course():
        if isinstance(m, mavlink.MAVLink_heartbeat_message):
            mode = modes.get(round(t), mode)
            m = beat(mode)
        packets.append((t, s, m))
    headline = written(tmp_path, packets)
    assert headline.cause is Cause.MODE_LEFT
    assert any(find_numbers(reason) == pytest.approx([0.0, 1.0, 5.0, 7.0, 9.0]) for reason in headline.reasons)
