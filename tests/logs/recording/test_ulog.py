"""ULog files: numbers that were written by the format's definition are those of the page and of the document."""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path

import numpy as np
import pytest
from report_rig import walk_html
from ulog_writer import MAGIC, UlogWriter

from logs.recording.ulog import read_ulog
from uavctl.cli.app import run
from uavctl.errors import ExtraMissingError, RecordingError

START_US = 5_000_000
GPS_US = 1_764_000_002_500_000  # at 7.5 s of the vehicle's clock
LOCAL = [f"float {name}" for name in ("x", "y", "z", "vx", "vy", "vz")]
VALID = ["bool xy_valid", "bool z_valid", "bool v_xy_valid", "bool v_z_valid"]
ODOMETRY = ["uint64_t timestamp_sample", "uint8_t pose_frame", "float[3] position"]
STEPS = 40


def stamp(step: int) -> int:
    return START_US + 100_000 * step


def flown(*, own: bool = True, sent: bool = True, pose_frame: int = 1) -> UlogWriter:
    log = UlogWriter(START_US)
    log.info("sys_name", "PX4")
    log.parameter("int32_t", "MAV_SYS_ID", 7)
    log.parameter("float", "MPC_XY_P", 0.75)
    local = log.topic("vehicle_local_position", [*LOCAL, *VALID])
    odometry = log.topic("vehicle_visual_odometry", ODOMETRY)
    asked = log.topic("trajectory_setpoint", ["float[3] position", "float[3] velocity", "float[3] acceleration"])
    attitude = log.topic("vehicle_attitude", ["float[4] q"])
    status = log.topic("vehicle_status", ["uint8_t nav_state", "uint8_t arming_state"])
    gps = log.topic("sensor_gps", ["uint64_t time_utc_usec"])
    log.data(status, START_US - 1_000_000, 2, 1)  # what held when the log began
    for step in range(STEPS):
        at_us = stamp(step)
        if own:
            log.data(local, at_us, 0.5 * step, -1.0, -2.25, 5.0, 0.0, 0.125, step > 1, True, True, step > 3)
        if sent:
            late_us = 10_000 if step % 2 else 30_000
            log.data(odometry, at_us, at_us - late_us, pose_frame, 0.5 * step, -1.5, -2.0)
        log.data(asked, at_us, 0.25 * step, *[math.nan] * 5, 0.0, 0.5, -0.25)
        half = math.radians(1.5 * step)  # of a yaw of three degrees a step
        log.data(attitude, at_us, math.cos(half), 0.0, 0.0, math.sin(half))
    log.data(status, stamp(10), 14, 2)
    log.data(status, stamp(20), 14, 2)
    log.data(gps, stamp(20), 0)
    log.data(gps, stamp(25), GPS_US)
    log.text(4, stamp(12), "<b>low & slow</b>")
    log.dropout(120)
    log.dropout(80)
    log.parameter("float", "MPC_XY_P", 1.5, later=True)
    return log


@pytest.fixture
def path(tmp_path: Path) -> Path:
    (tmp_path / "a.ulg").write_bytes(flown().file)
    return tmp_path / "a.ulg"


def test_numbers_are_those_that_were_written(path: Path) -> None:
    found = read_ulog(path)
    steps = np.arange(STEPS)
    # the first two have no valid position, the next two no valid climb
    assert found.own.t_s == pytest.approx(0.1 * steps[2:])
    assert found.own.position_m.tolist() == [[0.5 * step, -1.0, -2.25] for step in steps[2:]]
    assert found.own.velocity_mps[2:].tolist() == [[5.0, 0.0, 0.125]] * (STEPS - 4)
    assert np.isnan(found.own.velocity_mps[:2, 2]).all() and found.own.velocity_mps[:2, 0].tolist() == [5.0, 5.0]
    assert found.sent["vehicle_visual_odometry"].position_m.tolist() == [[0.5 * step, -1.5, -2.0] for step in steps]
    assert found.setpoint_m[:, 0].tolist() == (0.25 * steps).tolist() and np.isnan(found.setpoint_mps).all()
    assert found.setpoint_mps2.tolist() == [[0.0, 0.5, -0.25]] * STEPS
    assert found.attitude_deg == pytest.approx(np.column_stack((0 * steps, 0 * steps, 3.0 * steps)), abs=1e-4)


def test_each_turn_has_its_own_axis(tmp_path: Path) -> None:
    axes = UlogWriter(START_US)
    local, attitude = axes.topic("vehicle_local_position", LOCAL), axes.topic("vehicle_attitude", ["float[4] q"])
    half = math.radians(10)
    for axis in range(3):
        axes.data(local, stamp(axis), *[0.0] * 6)
        axes.data(attitude, stamp(axis), math.cos(half), *(math.sin(half) * (axis == one) for one in range(3)))
    (tmp_path / "a.ulg").write_bytes(axes.file)
    assert read_ulog(tmp_path / "a.ulg").attitude_deg == pytest.approx(20 * np.eye(3), abs=1e-4)


def test_the_document_and_the_page_tell_them(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["log", "report", str(path), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["schema"] == "uavctl/log/report-ulog/1" and found["report"] == str(path.with_suffix(".html"))
    assert (found["autopilot"], found["vehicle_system"], found["own_source"]) == ("px4", 7, "vehicle_local_position")
    assert (found["own_positions"], found["setpoints"], list(found["bad"].values())) == (STEPS - 2, STEPS, [2])
    assert found["duration_s"] == pytest.approx(0.1 * (STEPS - 1))
    assert found["begin_utc"] == "2025-11-24T16:00:00.000+00:00"
    (sent,) = found["sent"]
    assert (sent["positions"], sent["rate_hz"]) == (STEPS, pytest.approx(10))
    # late by 30 and 10 ms in turn: the quickest counts as none, and the first comes before a quick one did
    assert sent["delay_ms"][2] == pytest.approx(20) and sent["longest_gap_s"] == pytest.approx(0.1)
    assert found["modes"] == [
        {"at_s": 0, "mode": "POSCTL", "armed": False}, {"at_s": pytest.approx(1.0), "mode": "OFFBOARD", "armed": True},
    ]  # fmt: skip
    assert found["texts"] == [{"at_s": pytest.approx(1.2), "severity": "warning", "text": "<b>low & slow</b>"}]
    told = {name: (one["value"], one["type"]) for name, one in found["parameters"].items()}
    assert told == {"MAV_SYS_ID": (7, "INT32"), "MPC_XY_P": (0.75, "REAL32")}
    assert any("0.20 s" in note and "0.12 s" in note for note in found["notes"])
    assert any("MPC_XY_P" in note and "1.5" in note for note in found["notes"])
    assert found["messages"]["vehicle_status"] == 3
    seen = walk_html(path.with_suffix(".html").read_text(encoding="utf-8"))
    assert {"path-above", "attitude-yaw", "age-0"} <= set(seen.ids)
    assert "<b>low & slow</b>" in seen.text and "OFFBOARD" in seen.text and "0.75" in seen.text


def test_info_tells_the_same(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["log", "info", str(path), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["schema"] == "uavctl/log/info-ulog/1" and found["own_positions"] == STEPS - 2


@pytest.mark.parametrize("frame", [0, 2])
def test_axes_that_are_not_north_east_down_are_told(tmp_path: Path, frame: int) -> None:
    (tmp_path / "a.ulg").write_bytes(flown(pose_frame=frame).file)
    assert any("vehicle_visual_odometry" in note for note in read_ulog(tmp_path / "a.ulg").info.notes)


def test_the_fields_of_older_versions(tmp_path: Path) -> None:
    log = UlogWriter(START_US)
    mocap = log.topic("vehicle_mocap_odometry", ["uint64_t timestamp_sample", "uint8_t local_frame", *LOCAL[:3]])
    asked = log.topic("trajectory_setpoint", [*LOCAL, "float[3] acceleration"])
    log.data(mocap, stamp(1), stamp(1), 0, 1.0, 2.0, 3.0)
    log.data(asked, stamp(1), *map(float, range(9)))
    (tmp_path / "a.ulg").write_bytes(log.file)
    found = read_ulog(tmp_path / "a.ulg")
    assert found.sent["vehicle_mocap_odometry"].position_m.tolist() == [[1, 2, 3]] and not found.info.notes
    assert np.hstack((found.setpoint_m, found.setpoint_mps, found.setpoint_mps2)).tolist() == [[*range(9)]]
    assert found.info.begin_utc == "" and found.info.own_source == ""


def test_a_torn_one_is_shown_up_to_there(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) * 3 // 4])
    assert run(["log", "report", str(path), "--json"]) == 0
    told = capsys.readouterr()
    assert 0 < json.loads(told.out)["own_positions"] < STEPS - 2 and "torn" in told.err


@pytest.mark.parametrize(
    "data",
    [
        b"", b"no recording", MAGIC, MAGIC + bytes(8), MAGIC + bytes(9), MAGIC[:-1] + b"\x36" + bytes(60),
        UlogWriter(START_US).file, flown().file[: flown().definitions_bytes], flown().file[:80],
        flown().file[:27] + b"\x02" + flown().file[28:],  # a flag that no reader may pass over
    ],
)  # fmt: skip
def test_what_holds_no_flight_is_refused(path: Path, data: bytes, capsys: pytest.CaptureFixture[str]) -> None:
    path.write_bytes(data)
    with pytest.raises(RecordingError, match=r"a\.ulg"):
        read_ulog(path)
    assert run(["log", "report", str(path), "--json"]) == 1
    assert json.loads(capsys.readouterr().out)["type"] == "RecordingError" and not path.with_suffix(".html").exists()


@pytest.mark.parametrize("seed", range(20))
def test_damage_is_told_or_refused(path: Path, seed: int) -> None:
    rng = np.random.default_rng(seed)
    data = bytearray(path.read_bytes())
    for place in rng.integers(16, len(data), 10):
        data[place] = rng.integers(256)
    path.write_bytes(data)
    try:
        read_ulog(path)
    except RecordingError as error:
        assert str(path) in str(error)


def test_without_pyulog_the_extra_is_named(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyulog", None)
    with pytest.raises(ExtraMissingError) as refused:
        read_ulog(path)
    assert (refused.value.package, refused.value.extra) == ("pyulog", "ulog")
    assert run(["log", "report", str(path)]) == 2


def test_stamps_of_the_last_bit_are_times_as_others(tmp_path: Path) -> None:
    begin_us = 2**63 + 5
    writer = UlogWriter(begin_us)
    topic = writer.topic(
        "vehicle_local_position", ["float x", "float y", "float z", "float vx", "float vy", "float vz"]
    )
    for index in range(5):
        writer.data(topic, begin_us + index * 100_000, 1.0, 2.0, -3.0, 0.0, 0.0, 0.0)
    path = tmp_path / "last.ulg"
    path.write_bytes(writer.file)
    assert read_ulog(path).height_t_s.tolist() == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4])
