"""Where a replay parts from its recording: found in the right tick, told with units, and followed from there on."""

from __future__ import annotations

import json
import math
from functools import partial
from pathlib import Path

import msgspec
import pytest
from loopback_rig import MemorySink, lockstep, make_loop, shared_loop
from recording_fakes import stored_chunks
from report_rig import omit_pages

from logs.recording.reader import explain_missing_end, find_segments, read_kind
from logs.recording.replay import MAKERS, FieldNames, ReplayResult, find_different_leaves, replay
from uavctl.cli.app import run
from uavctl.config import load_config
from uavctl.flight.limits import LimitsParameters, limit_setpoint
from uavctl.records import Decision, Event, LinkStats, Setpoint, SetpointSource, StepInput, Vec3
from uavctl.wiring.controller import build_plant

TICK = 57  # in which the rule of a test changes


@pytest.fixture(scope="module")
def flown() -> MemorySink:
    return lockstep("paper", 12.0)


def replayed(flown: MemorySink, *overrides: str) -> ReplayResult:
    config = load_config("paper", overrides)
    return replay(flown.entries, partial(shared_loop, config), ignored=MAKERS)


@pytest.mark.slow
def test_a_changed_rule_is_found_in_its_tick_and_followed(flown: MemorySink, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = 0

    def pushed(want: Vec3, before: Vec3, tick_s: float, limits: LimitsParameters) -> tuple[Vec3, tuple[str, ...]]:
        nonlocal calls
        calls += 1
        accel, limited = limit_setpoint(want, before, tick_s, limits)
        return (accel[0] + (0.25 if calls > of_setpoints else 0.0), *accel[1:]), limited

    ticks = [one.at_ns for one in flown.of(Setpoint)]
    of_setpoints = ticks.index(flown.of(Decision)[TICK].at_ns)
    monkeypatch.setattr("uavctl.flight.act.limit_setpoint", pushed)
    result = replayed(flown)
    first, context = result.first_difference, result.context
    assert first is not None and context is not None and first == result.first_decision
    assert (first.topic, first.tick, first.field) == ("/uavctl/decision", TICK, "input[0]")
    assert first.meaning == "north input" and first.unit == ""  # the paper's inputs are no accelerations
    assert first.flight_s == pytest.approx(5.7) and first.at_ns == flown.of(Decision)[TICK].at_ns
    assert first.change == pytest.approx(0.25 / 0.49429632181478)
    assert float(first.replayed) - float(first.recorded) == first.change
    assert "a rule of the decision" in first.stage
    assert (context.decisions_before, result.decisions) == (TICK, 120)
    assert context.recorded is not None and context.recorded == context.replayed  # mode, age and plan are the same
    assert context.recorded.mode == "track" and context.vehicle == "OFFBOARD, armed"
    assert result.decisions_differing == 120 - TICK
    course = {(one.topic, one.field): one for one in result.course}
    setpoint = course["/uavctl/setpoint", "accel_mps2"]
    assert (setpoint.entry, setpoint.unit) == ("north", "m/s²")
    assert setpoint.differing == setpoint.records == 120 - TICK
    assert setpoint.first_s == first.flight_s and setpoint.largest is not None and setpoint.largest >= 0.25
    assert course["/uavctl/estimate", "mean"].first_s == pytest.approx(5.8)  # it knows what was sent a tick later
    assert next(iter(course)) == ("/uavctl/decision", "input")


@pytest.mark.slow
def test_a_changed_back_off_is_found_in_the_first_plan_that_differs() -> None:
    result = replayed(lockstep("paper", 12.0), "smpc.delta_x=0.949")
    first, decision = result.first_difference, result.first_decision
    assert first is not None and decision is not None
    assert first.topic == "/uavctl/plan" and "design, target or solver" in first.stage
    assert first.at_ns <= decision.at_ns and decision.topic == "/uavctl/decision"
    backoff = next(one for one in result.course if one.field == "backoff_x")
    assert backoff.differing == backoff.records > 3
    assert not {"design_id", "method"} & {one.field for one in result.course}


@pytest.mark.slow
def test_of_another_solver_what_it_decides_is_compared_and_not_its_name(flown: MemorySink) -> None:
    config = load_config("paper", ["solver.method=printed"])
    named = replay(flown.entries, partial(make_loop, config)).first_difference
    result = replayed(flown, "solver.method=printed")
    unnamed = result.first_difference
    assert named is not None and unnamed is not None
    assert {named.topic, unnamed.topic} == {"/uavctl/plan"}
    assert "method" not in {one.field for one in result.course}


def test_what_does_not_reach_the_loop_changes_nothing(flown: MemorySink) -> None:
    assert replayed(flown, "sim.seed=99", "log.queue=100").identical


def test_another_reading_of_the_same_bytes_is_told_as_that(flown: MemorySink) -> None:
    first = replayed(flown, "frame.yaw_deg=90").first_difference
    assert first is not None and first.topic == "/uavctl/step_input" and first.unit == "m"
    assert first.field == "samples[0].position_m[0]" and first.meaning == "north"
    assert "parser, clock or frame" in first.stage


def test_a_record_on_one_side_is_named(flown: MemorySink) -> None:
    entries = [entry for entry in flown.entries if not isinstance(entry[2], Event)]
    result = replay(entries, partial(make_loop, load_config("paper")))
    first = result.first_difference
    assert first is not None and (first.topic, first.field) == ("/uavctl/event", "")
    assert first.recorded == "nothing" and first.replayed.startswith(f"{flown.of(Event)[0].code}: ")
    assert result.first_decision is None and result.decisions_differing == 0
    assert [(one.field, one.largest) for one in result.course] == [("", None)]


@pytest.mark.parametrize(
    ("left", "right", "differs"),
    [
        (0.0, -0.0, True),
        (math.nan, math.nan, False),
        (math.nan, math.inf, True),
        (math.nan, None, True),
        (1.0, math.nextafter(1.0, 2.0), True),
        (0.1, 0.1, False),
    ],
)
def test_every_bit_of_a_number_counts(left: float, right: float | None, differs: bool) -> None:
    def setpoint(yaw_rad: float | None) -> Setpoint:
        return Setpoint(at_ns=1, accel_mps2=(0.0, 0.0, 0.0), yaw_rad=yaw_rad, source=SetpointSource.HOLD)

    found = find_different_leaves(setpoint(left), setpoint(right))
    assert [path for path, _, _ in found] == (["yaw_rad"] if differs else [])


def test_counts_in_another_order_are_the_same_counts() -> None:
    def stats(bad: dict[str, int]) -> LinkStats:
        return LinkStats(
            at_ns=1, link="v", datagrams=1, messages=1, samples=0, bad=bad, clock_offset_ns=None, clock_source="none"
        )

    assert not find_different_leaves(stats({"a": 1, "b": 2}), stats({"b": 2, "a": 1}))
    assert [path for path, _, _ in find_different_leaves(stats({"a": 1}), stats({"a": 1, "b": 2}))] == ["bad.b"]


def test_fields_have_names_and_units() -> None:
    places = FieldNames(build_plant(load_config("room-hahn-stursberg")))
    told = {
        ("/uavctl/estimate", "mean[0]"): ("north position", "m"),
        ("/uavctl/plan", "states[3][4]"): ("east velocity in stage 3", "m/s"),
        ("/uavctl/plan", "inputs[0][2]"): ("down input in stage 0", "m/s²"),
        ("/uavctl/setpoint", "accel_mps2[1]"): ("east", "m/s²"),
        ("/uavctl/setpoint", "yaw_rad"): ("", "rad"),
        ("/uavctl/decision", "age_steps"): ("", ""),
        ("/uavctl/step_input", "samples[1].captured_ns"): ("", "ns"),
        ("/uavctl/plan", "backoff_x[2][5]"): ("", ""),
    }
    assert {key: places.meaning(*key) for key in told} == told


SMALL = ("--config", "paper", "--set", "log.segment_bytes=100000")


@pytest.fixture(scope="module")
def rotated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("rotated")
    with omit_pages():
        assert run(["loopback", *SMALL, "--duration", "25", "--out", str(folder), "--json"]) == 0
    assert len(find_segments(folder / "flight.mcap")) > 2
    return folder


@pytest.mark.slow
def test_a_flight_in_several_files_is_replayed_from_the_first(
    rotated: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flight = rotated / "flight.mcap"
    assert run(["log", "replay", str(flight), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["texts_compared"]
    assert found["identical"] and found["decisions"] == sum(1 for _ in read_kind(flight, Decision)) == 250
    assert (found["first_difference"], found["context"], found["course"], found["changed"]) == (None, None, [], [])


def test_a_later_file_and_a_folder_are_refused_with_what_to_give(
    rotated: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flight = rotated / "flight.mcap"
    assert run(["log", "replay", str(rotated / "flight-2.mcap")]) == 1
    told = " ".join(capsys.readouterr().err.split())
    assert "is file 2 of a recording" in told and f"give the first one, {flight}," in told
    assert run(["log", "replay", str(rotated)]) == 1
    assert f"is a folder; give the recording in it: {flight}" in capsys.readouterr().err


def test_a_recording_without_its_first_file_is_refused(
    rotated: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for file in find_segments(rotated / "flight.mcap")[1:]:
        (tmp_path / file.name).write_bytes(file.read_bytes())
    assert run(["log", "replay", str(tmp_path / "flight.mcap")]) == 1
    told = capsys.readouterr().err
    assert str(tmp_path / "flight.mcap") in told.replace("\n", "") and "is missing" in told


def test_a_recording_without_its_last_file_is_alike_up_to_there_and_says_so(
    rotated: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flight = tmp_path / "flight.mcap"
    for file in find_segments(rotated / "flight.mcap")[:-1]:
        (tmp_path / file.name).write_bytes(file.read_bytes())
    last = find_segments(flight)[-1].name
    assert explain_missing_end(flight) and not explain_missing_end(rotated / "flight.mcap")
    assert run(["log", "replay", str(flight), "--json"]) == 0
    told = capsys.readouterr()
    assert 100 < json.loads(told.out)["decisions"] < 250
    assert f"continues after {last}" in told.err and "missing" in told.err


def test_a_hole_in_a_recovered_recording_is_told(
    rotated: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = bytearray((rotated / "flight.mcap").read_bytes())
    holding = [begin for begin, _, content in stored_chunks(bytes(data)) if b"/uavctl/decision" in content]
    data[holding[len(holding) // 2] + 100] ^= 1
    (tmp_path / "flight.mcap").write_bytes(data)
    for file in find_segments(rotated / "flight.mcap")[1:]:
        (tmp_path / file.name).write_bytes(file.read_bytes())
    whole = tmp_path / "whole.mcap"
    assert run(["log", "recover", str(tmp_path / "flight.mcap"), str(whole)]) == 3
    capsys.readouterr()
    assert run(["log", "replay", str(whole)]) == 1
    told = capsys.readouterr()
    assert "recovered from flight.mcap: " in told.err
    for heading in ("from [s]", "at [s]"):
        assert heading in told.out


def test_a_changed_configuration_is_shown_with_what_it_changes(
    rotated: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["log", "replay", str(rotated / "flight.mcap"), "--set", "limits.slew_mps3=1.0"]
    assert run([*command, "--json"]) == 1
    found = json.loads(capsys.readouterr().out)
    assert found["changed"] == [{"key": "limits.slew_mps3", "recorded": "100.0", "replayed": "1.0"}]
    result = msgspec.convert({key: found[key] for key in ReplayResult.__struct_fields__}, ReplayResult)
    first, context = result.first_difference, result.context
    assert first is not None and context is not None and context.decisions_before == first.tick
    inputs = {one.tick: one for one in read_kind(rotated / "flight.mcap", StepInput)}
    assert context.positions == len(inputs[context.decisions_before].samples)
    assert run(command) == 1
    told = capsys.readouterr().out
    for text in (
        "limits.slew_mps3: 100.0 -> 1.0",
        f"{first.flight_s:.3f} s into the flight, tick {first.tick}",
        f"/uavctl/decision {first.field} ({first.meaning})",
        f"recorded {first.recorded}, replayed {first.replayed}",
        f"{context.decisions_before} decisions, {context.records_before} records",
        f"{result.decisions_differing} of {result.decisions - context.decisions_before}",
        "/uavctl/estimate mean",
    ):
        assert text in told, text


@pytest.mark.parametrize(
    ("override", "text"),
    [
        ("daemon.mocap=udpin://0.0.0.0:14540", "daemon.mocap"),
        ("smpc.horizonn=3", 'nearest valid name "horizon"'),
        ("smpc.delta_x=0.9999999", "delta_x"),
    ],
)
def test_a_change_that_cannot_be_replayed_is_refused(
    rotated: Path, override: str, text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["log", "replay", str(rotated / "flight.mcap"), "--set", override]) == 2
    assert text in " ".join(capsys.readouterr().err.split())
