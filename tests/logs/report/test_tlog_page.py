"""The page of a `.tlog`: against pymavlink's own reader, and against the flight that it was exported from."""

from __future__ import annotations

import json
import lzma
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import view_rig
from places import DATA
from pymavlink import mavutil  # type: ignore[attr-defined]
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from report_rig import omit_figures, walk_html

from logs.recording.mavlink_flight import MavlinkFlight, read_flight
from logs.recording.tlog import export_tlog
from logs.report.tlog_page import render_tlog_page
from uavctl.cli.app import run
from uavctl.errors import RecordingError
from uavctl.records import StepInput, Truth


def others_read(path: Path, *kinds: str, system: int | None = None) -> list[Any]:
    """Messages of a file by pymavlink's own reader."""
    log = mavutil.mavlogfile(str(path))
    found = []
    while (message := log.recv_match(type=list(kinds) or None)) is not None:
        if system in (None, message.get_srcSystem()):
            found.append(message)
    log.close()
    return found


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("tlog")
    export_tlog(view_rig.record(folder / "flight.mcap"), folder / "flight.tlog")
    return folder / "flight.tlog"


@pytest.fixture(scope="module")
def flight(exported: Path) -> MavlinkFlight:
    return read_flight(exported)


@pytest.fixture(scope="module")
def copter(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("tlog") / "copter.tlog"
    packed = DATA / "flights" / "arducopter-gps-guided-accel.tlog.xz"
    path.write_bytes(lzma.decompress(packed.read_bytes()))
    return path


@pytest.fixture
def no_figures() -> Iterator[None]:
    """For pages whose figures nobody looks at."""
    with omit_figures():
        yield


def test_the_path_is_that_of_the_flight(flight: MavlinkFlight) -> None:
    memory = view_rig.fly_view()
    samples = [sample for step in memory.of(StepInput) for sample in step.samples]
    (sent,) = flight.sent.values()
    # single floats on the wire, and what came after the last tick is in no record
    assert sent.position_m[: len(samples)] == pytest.approx(
        np.array([position_sample.position_m for position_sample in samples]), abs=1e-6
    )
    truths = memory.of(Truth)
    began_s = min(step.at_ns for step in memory.of(StepInput)) * 1e-9
    true_s = np.array([truth.at_ns * 1e-9 - began_s for truth in truths])
    true_m = np.array([truth.position_m for truth in truths])
    first_s = min(flight.own.t_s[0], sent.t_s[0])
    for axis in range(3):
        wanted = np.interp(flight.own.t_s - first_s, true_s - true_s[0], true_m[:, axis])
        assert flight.own.position_m[:, axis] == pytest.approx(wanted, abs=0.1)


def test_numbers_are_those_of_pymavlink(exported: Path, flight: MavlinkFlight) -> None:
    own = others_read(exported, "LOCAL_POSITION_NED")
    assert len(own) == flight.info.own_positions > 50
    assert flight.own.position_m.tolist() == [[position.x, position.y, position.z] for position in own]
    assert flight.own.velocity_mps.tolist() == [[position.vx, position.vy, position.vz] for position in own]
    stamps_s = np.array([message._timestamp for message in others_read(exported)])
    own_s = np.array([position._timestamp for position in own])
    assert flight.own.t_s == pytest.approx(own_s - stamps_s.min(), abs=1e-5)
    setpoints = others_read(exported, "SET_POSITION_TARGET_LOCAL_NED")
    assert flight.setpoint_mps2.tolist() == [[setpoint.afx, setpoint.afy, setpoint.afz] for setpoint in setpoints]
    assert np.isnan(flight.setpoint_m).all()
    counted = sum(flight.info.messages.values())
    assert counted == len(others_read(exported))


def test_what_a_real_autopilot_says(copter: Path) -> None:
    info = read_flight(copter).info
    beats = [beat for beat in others_read(copter, "HEARTBEAT", system=1) if beat.autopilot == 3]
    modes = [(mavutil.mode_string_v10(beat), bool(beat.base_mode & 128)) for beat in beats]
    changes = [mode for mode, before in zip(modes, [None, *modes], strict=False) if mode != before]
    assert [(mode.mode, mode.armed) for mode in info.modes] == changes and len(changes) > 3
    assert [text.text for text in info.texts] == [text.text for text in others_read(copter, "STATUSTEXT", system=1)]
    told = {value.param_id: value.param_value for value in others_read(copter, "PARAM_VALUE", system=1)}
    assert {name: parameter.value for name, parameter in info.parameters.items()} == pytest.approx(told)
    assert (info.autopilot, info.vehicle_system, info.notes) == ("ardupilot", 1, ())


def test_positions_that_are_sent_have_ages() -> None:
    found = read_flight(DATA / "px4-relay.tlog")
    (sent,) = found.info.sent
    positions = others_read(DATA / "px4-relay.tlog", "VISION_POSITION_ESTIMATE")
    delays_s = np.array([position._timestamp - position.usec * 1e-6 for position in positions])
    # the rig adds 10 to 40 ms, and the recorder's clock stamped them: so what is beyond the quickest is within 30 ms
    assert sent.delay_ms is not None and 0 < sent.delay_ms[0] < 1e3 * (delays_s.max() - delays_s.min()) + 1
    assert sent.delay_ms[2] < 35
    gaps_s = np.diff([position._timestamp for position in positions])
    assert sent.longest_gap_s == pytest.approx(gaps_s.max(), abs=1e-5)
    assert sent.largest_age_s is not None and gaps_s.max() <= sent.largest_age_s < gaps_s.max() + 0.04
    assert found.info.own_source == "ODOMETRY"


def packed(*messages: Any, system: int = 1) -> bytes:
    mav = mavlink.MAVLink(None, srcSystem=system, srcComponent=1)
    return b"".join(
        struct.pack(">Q", 1_764_000_000_000_000 + 200_000 * number) + message.pack(mav)
        for number, message in enumerate(messages)
    )


HEARTBEAT = mavlink.MAVLink_heartbeat_message(2, 3, 128, 4, 4, 3)


def test_a_vehicle_with_a_place_on_the_globe_alone(tmp_path: Path) -> None:
    path = tmp_path / "a.tlog"
    places = [(473_977_420, 85_455_940, 0), (473_987_420, 85_455_940, 5000), (473_977_420, 85_465_940, 10_000)]
    path.write_bytes(
        packed(
            HEARTBEAT,
            *(mavlink.MAVLink_global_position_int_message(0, lat, lon, 0, up, 0, 0, 0, 0) for lat, lon, up in places),
        )
    )
    own = read_flight(path).own.position_m
    # a thousandth of a degree is 111.2 m of latitude, and 75.3 m of longitude at 47.4 degrees
    assert own == pytest.approx(np.array([[0, 0, 0], [111.2, 0, -5], [0, 75.3, -10]]), abs=0.2)


def test_the_page_shows_what_the_vehicle_says(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "a.tlog"
    text = mavlink.MAVLink_statustext_message(3, b"<b>crash & burn</b>")
    path.write_bytes(packed(HEARTBEAT, text))
    assert run(["log", "report", str(path), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["schema"] == "uavctl/log/report-tlog/1" and found["report"] == str(tmp_path / "a.html")
    assert [(text["severity"], text["text"]) for text in found["texts"]] == [("error", "<b>crash & burn</b>")]
    seen = walk_html((tmp_path / "a.html").read_text(encoding="utf-8"))
    assert "<b>crash & burn</b>" in seen.text and "GUIDED" in seen.text
    assert run(["log", "info", str(path)]) == 0
    assert "HEARTBEAT of system 1" in capsys.readouterr().out


def test_the_page_draws_what_there_is(flight: MavlinkFlight) -> None:
    ids = set(walk_html(render_tlog_page(flight)).ids)
    axes = {f"{what}-{axis}" for what in ("position", "velocity") for axis in ("north", "east", "down")}
    assert {"path-above", "path-side", "age-0", *axes} <= ids


@pytest.mark.parametrize("data", [b"", b"\0", b"no recording", b"\xfd" * 40, b"\x89MCAP0\r\n"])
def test_what_is_none_is_refused(tmp_path: Path, data: bytes, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "a.tlog"
    path.write_bytes(data)
    with pytest.raises(RecordingError, match=r"a\.tlog"):
        read_flight(path)
    assert run(["log", "report", str(path)]) == 1
    assert not (tmp_path / "a.html").exists() and str(path) in capsys.readouterr().err.replace("\n", "")


@pytest.mark.usefixtures("no_figures")
def test_a_torn_one_is_shown_up_to_there(tmp_path: Path, exported: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "a.tlog"
    path.write_bytes(exported.read_bytes()[: exported.stat().st_size // 2])
    assert run(["log", "report", str(path), "--json"]) == 0
    told = capsys.readouterr()
    assert json.loads(told.out)["notes"] and "torn" in told.err
    for option in ("--svg", "--figure"):
        assert run(["log", "report", str(path), option, str(tmp_path / "a.svg")]) == 2
        assert f"{option} needs a recording of uavctl" in " ".join(capsys.readouterr().err.split())
        assert not (tmp_path / "a.svg").exists()


def beat(mode: int, *, armed: bool) -> Any:
    flags = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | (mavlink.MAV_MODE_FLAG_SAFETY_ARMED if armed else 0)
    return mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_QUADROTOR, 3, flags, mode, 4, 3)


def flown_with(
    tmp_path: Path, *, off_m: float = 0.0, silent: range = range(0), text: str = "", armed: bool = True
) -> Any:
    """Twelve seconds in GUIDED (4), five positions of its own and five sent a second; the sent ones begin 2 m north."""
    told = bytearray()
    own, cameras = (mavlink.MAVLink(None, srcSystem=system, srcComponent=1) for system in (1, 20))
    for number in range(60):
        north_m = 0.1 * number
        sent_m = north_m + 2.0 + (off_m if number == 40 else 0.0)
        parts = [(own, mavlink.MAVLink_local_position_ned_message(200 * number, north_m, 0, -1, 0.5, 0, 0))]
        if number not in silent:
            position = mavlink.MAVLink_vision_position_estimate_message(200_000 * number, sent_m, 0, -1, 0, 0, 0)
            parts.append((cameras, position))
        if number % 5 == 0:
            parts.append((own, beat(9 if number >= 55 else 4, armed=armed and number >= 5)))
        if number == 30 and text:
            parts.append((own, mavlink.MAVLink_statustext_message(mavlink.MAV_SEVERITY_CRITICAL, text.encode())))
        for mav, message in parts:
            told += struct.pack(">Q", 1_764_000_000_000_000 + 200_000 * number) + message.pack(mav)
    path = tmp_path / "foreign.tlog"
    path.write_bytes(told)
    return path


@pytest.mark.parametrize(
    ("given", "tone", "cause"),
    [
        ({}, "good", "nothing-found"),
        ({"silent": range(20, 35)}, "mind", "silence"),
        ({"silent": range(20, 50)}, "bad", "silence"),
        ({"off_m": 0.7}, "mind", "positions-apart"),
        ({"off_m": 1.5}, "bad", "positions-apart"),
        ({"text": "EKF variance", "off_m": 0.7}, "bad", "vehicle-position-lost"),
        ({"armed": False}, "mind", "not-armed"),
    ],
)  # fmt: skip
@pytest.mark.usefixtures("no_figures")
def test_the_main_thing_comes_first(
    given: dict[str, Any], tone: str, cause: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = flown_with(tmp_path, **given)
    assert run(["log", "report", str(path), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["headline"]["tone"], told["headline"]["cause"]) == (tone, cause)
    banner = f'<div class="banner {tone}"><p><strong>'
    assert path.with_suffix(".html").read_text(encoding="utf-8").index(banner) > 0
    assert ("positions-apart" in told["headline"]["causes"]) is ("off_m" in given)
    if given.get("armed", True):
        assert "The vehicle left GUIDED for LAND at 11.0 s." in told["headline"]["why"]
    assert run(["log", "report", str(path)]) == 0
    assert " ".join(capsys.readouterr().out.split()).startswith(told["headline"]["text"][:60])
    assert run(["log", "info", str(path), "--json"]) == 0
    info = capsys.readouterr().out
    assert json.loads(info)["headline"] == told["headline"]
    assert run(["log", "info", str(path)]) == 0
    assert " ".join(capsys.readouterr().out.split()).startswith(told["headline"]["text"][:60])
