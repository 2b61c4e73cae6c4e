"""Logs of other programs as people have them: without stamps or positions, of several vehicles, under any name."""

from __future__ import annotations

import json
import math
import random
import struct
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from ulog_writer import UlogWriter, message

from logs.recording.file_kind import FileKind, detect_kind
from logs.recording.mavlink_flight import read_flight
from logs.recording.senders import LogSender
from logs.recording.tlog import read_tlog
from logs.recording.ulog import read_ulog
from uavctl.cli.app import run
from uavctl.errors import RecordingError, UsageError
from uavctl.mavlink.message_layout import strip_escapes

BEGIN_US = 1_764_000_000_000_000
OFFBOARD = 6 << 16
START_US = 5_000_000


class Log:
    """Frames of several senders, each with its time."""

    def __init__(self) -> None:
        self.frames: list[tuple[int, bytes]] = []
        self._senders: dict[tuple[int, int], Any] = {}

    def put(self, at_s: float, system: int, component: int, told: Any) -> None:
        sender = self._senders.setdefault((system, component), mavlink.MAVLink(None, system, component))
        self.frames.append((BEGIN_US + round(at_s * 1e6), bytes(told.pack(sender))))
        sender.seq = (sender.seq + 1) % 256

    def save(self, path: Path, order: str = ">") -> Path:
        path.write_bytes(b"".join(struct.pack(f"{order}Q", at_us) + data for at_us, data in self.frames))
        return path


def beat(kind: int = 2, autopilot: int = 12, armed: bool = True, mode: int = OFFBOARD) -> Any:
    return mavlink.MAVLink_heartbeat_message(kind, autopilot, 128 * armed + 1, mode, 4, 3)


def place(at_s: float, *xyz: float) -> Any:
    return mavlink.MAVLink_local_position_ned_message(round(at_s * 1e3), *xyz, 0.0, 0.0, 0.0)


def setpoint(system: int, *xyz: float) -> Any:
    return mavlink.MAVLink_set_position_target_local_ned_message(0, system, 1, 1, 0xDF8, *xyz, *[0.0] * 8)


def two_vehicles() -> Log:
    log = Log()
    for step in range(40):
        at_s = step / 10
        if step % 10 == 0:
            log.put(at_s, 1, 154, beat(kind=26, autopilot=3, mode=0))  # a gimbal, heard before the autopilot
            log.put(at_s, 1, 1, beat())
            log.put(at_s, 2, 1, beat(armed=False, autopilot=3, mode=4))
        log.put(at_s, 1, 1, place(at_s, 1.0, 0.0, -1.0))
        log.put(at_s, 2, 1, place(at_s, 5.0, 5.0, -2.0))
        log.put(at_s, 245, 25, setpoint(1, 1.0, 0.0, -1.0))
        if step % 2:
            log.put(at_s, 245, 25, setpoint(2, 5.0, 5.0, -2.0))
        log.put(at_s, 2, 1, mavlink.MAVLink_statustext_message(4, b"of the second"))
    return log


@pytest.mark.parametrize(
    ("system", "autopilot", "setpoints", "north_m", "modes", "texts"),
    [
        (None, "px4", 40, 1.0, [("OFFBOARD", True)], 0),
        (1, "px4", 40, 1.0, [("OFFBOARD", True)], 0),
        (2, "ardupilot", 20, 5.0, [("GUIDED", False)], 40),
    ],
)
def test_a_log_is_read_for_one_vehicle(
    tmp_path: Path, system: int | None, autopilot: str, setpoints: int, north_m: float, modes: list[Any], texts: int
) -> None:
    found = read_flight(two_vehicles().save(tmp_path / "two.tlog"), system)
    info = found.info
    assert (info.autopilot, info.vehicle_system, info.setpoints, len(info.texts)) == (
        autopilot, system or 1, setpoints, texts,
    )  # fmt: skip
    assert [(one.mode, one.armed) for one in info.modes] == modes
    assert set(found.own.position_m[:, 0]) == {north_m}
    other = 1 if system == 2 else 2
    assert any(f"system {other}" in note for note in info.notes)


def test_a_system_that_is_not_in_it_is_refused(tmp_path: Path) -> None:
    path = two_vehicles().save(tmp_path / "two.tlog")
    with pytest.raises(UsageError, match="1, 2, 245"):
        read_flight(path, 7)
    assert run(["log", "report", str(path), "--system", "7"]) == 2


def test_numbers_that_are_missing_are_counted_by_sender(tmp_path: Path) -> None:
    log = two_vehicles()
    del log.frames[30:40]
    whole = {
        (one.system, one.component): one for one in read_flight(two_vehicles().save(tmp_path / "a.tlog")).info.senders
    }
    found = {(one.system, one.component): one for one in read_flight(log.save(tmp_path / "b.tlog")).info.senders}
    assert all(one.missing == 0 for one in whole.values())
    assert sum(one.missing for one in found.values()) == 10
    assert found[1, 154].kind == "gimbal"


def find_sender(path: Path, system: int) -> LogSender:
    return next(one for one in read_flight(path).info.senders if one.system == system)


@pytest.mark.parametrize("unknown", [0x0123FF, 410])
def test_messages_of_unknown_ids_are_not_missing(tmp_path: Path, unknown: int) -> None:
    """Every third frame of the autopilot is of an id that the dialect does not have."""
    assert unknown not in mavlink.mavlink_map
    log = Log()
    log.put(0.0, 1, 1, beat())
    for step in range(600):
        log.put(0.1 * step, 1, 1, place(0.1 * step, 1.0, 0.0, -1.0))
        if step % 3 == 0:
            at_us, frame = log.frames[-1]
            log.frames[-1] = at_us, frame[:7] + unknown.to_bytes(3, "little") + frame[10:]
    sender = find_sender(log.save(tmp_path / "a.tlog"), 1)
    assert (sender.messages, sender.missing, sender.disorder) == (601, 0, False)


def test_messages_that_come_late_are_not_missing(tmp_path: Path) -> None:
    log = Log()
    for step in range(900):
        log.put(0.1 * step, 1, 1, beat())
    del log.frames[500:520]
    stamps = [at_us for at_us, _ in log.frames]
    for at, back in ((50, 1), (255, 2), (600, 12), (700, 30)):
        log.frames.insert(at, log.frames.pop(at - back))
    log.frames = [(at_us, frame) for at_us, (_, frame) in zip(stamps, log.frames, strict=True)]
    sender = find_sender(log.save(tmp_path / "a.tlog"), 1)
    assert (sender.messages, sender.missing, sender.disorder) == (880, 20, False)


def test_a_sender_with_two_sequences_has_no_number_of_losses(tmp_path: Path) -> None:
    """One program on two connections numbers the messages of each."""
    first, second, whole = Log(), Log(), Log()
    for step in range(600):
        first.put(0.1 * step, 1, 1, beat())
        if step % 3 == 0:
            second.put(0.1 * step, 1, 1, beat())
    whole.frames = sorted(first.frames + second.frames, key=lambda frame: frame[0])
    sender = find_sender(whole.save(tmp_path / "a.tlog"), 1)
    assert (sender.messages, sender.missing, sender.disorder) == (800, 0, True)


def test_a_sender_that_starts_anew_is_one_sequence(tmp_path: Path) -> None:
    log = Log()
    for step in range(100):
        log.put(0.1 * step, 1, 1, beat())
    log.frames += [(at_us + 20_000_000, frame) for at_us, frame in log.frames]
    sender = find_sender(log.save(tmp_path / "a.tlog"), 1)
    assert (sender.messages, sender.missing, sender.disorder) == (200, 0, False)


def test_stamps_that_are_missing_or_all_the_same_are_refused(tmp_path: Path) -> None:
    log = two_vehicles()
    raw = tmp_path / "raw.tlog"
    raw.write_bytes(b"".join(data for _, data in log.frames))
    log.frames = [(BEGIN_US, data) for _, data in log.frames * 2]
    for path in (raw, log.save(tmp_path / "same.tlog")):
        with pytest.raises(RecordingError, match="stamps"):
            read_tlog(path)


def test_little_endian_stamps_are_read_and_noted(tmp_path: Path) -> None:
    log = two_vehicles()
    found, old = (read_tlog(log.save(tmp_path / f"{order}.tlog", order)) for order in "><")
    assert found.packets == old.packets and len(old.notes) == len(found.notes) + 1


@pytest.mark.parametrize("name", ["FLIGHT.TLOG", "flight.Tlog", "flight.log", "flight"])
def test_a_tlog_is_known_by_its_name_in_any_case_and_by_its_bytes(tmp_path: Path, name: str) -> None:
    path = two_vehicles().save(tmp_path / name)
    assert detect_kind(path) is FileKind.TLOG
    assert run(["log", "info", str(path)]) == 0
    assert run(["log", "compare", str(path), str(path)]) == 1
    assert run(["log", "whatif", str(path)]) == 2


def test_a_ulog_is_known_by_its_bytes_whatever_it_is_called(tmp_path: Path) -> None:
    log = UlogWriter(START_US)
    log.text(4, START_US, "hello")
    for name in ("A.ULG", "a.tlog", "a"):
        (tmp_path / name).write_bytes(log.file)
        assert detect_kind(tmp_path / name) is FileKind.ULOG
        assert [one.text for one in read_ulog(tmp_path / name).info.texts] == ["hello"]
        assert run(["log", "info", str(tmp_path / name)]) == 0


def test_what_is_there_is_shown_where_parts_are_missing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = Log()
    for step in range(20):
        log.put(step, 1, 1, mavlink.MAVLink_attitude_message(1000 * step, 0.0, 0.0, math.radians(step), 0, 0, 0))
        log.put(step, 1, 1, mavlink.MAVLink_sys_status_message(0, 0, 0, 0, 12_600 - 10 * step, 0, 0, 0, 0, 0, 0, 0, 0))
    path = log.save(tmp_path / "a.tlog")
    assert run(["log", "report", str(path), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["battery_v"] == pytest.approx([12.6, 12.41]) and found["vehicle_system"] is None
    assert {"positions of its own", "modes and arming"} <= set(found["missing"])
    assert not {"attitude", "battery"} & set(found["missing"])
    assert found["rates_hz"] == {"ATTITUDE of system 1": pytest.approx(1), "SYS_STATUS of system 1": pytest.approx(1)}
    assert read_flight(path).attitude_deg[:, 2] == pytest.approx(range(20))


def ulog(*, local: bool = False, gps: bool = False) -> UlogWriter:
    log = UlogWriter(START_US)
    attitude = log.topic("vehicle_attitude", ["float[4] q"])
    own = log.topic("vehicle_local_position", ["float x", "float y", "float z", "bool xy_valid", "bool z_valid"])
    globe = log.topic("vehicle_gps_position", ["int32_t lat", "int32_t lon", "int32_t alt", "uint8_t fix_type"])
    for step in range(10):
        at_us = START_US + 100_000 * step
        log.data(attitude, at_us, 1.0, 0.0, 0.0, 0.0)
        if local:
            log.data(own, at_us, 0.0, 0.0, -0.5 * step, False, True)
        if gps:
            log.data(globe, at_us, 473_977_420 + 10 * step, 85_455_940, 500_000 + 1000 * step, 3 if step else 0)
    return log


def test_a_ulog_without_a_place_shows_the_rest(tmp_path: Path) -> None:
    (tmp_path / "a.ulg").write_bytes(ulog(local=True).file)
    found = read_ulog(tmp_path / "a.ulg")
    assert found.info.own_positions == 0 and "positions of its own" in found.info.missing
    assert found.height_m.tolist() == [0.5 * step for step in range(10)]
    assert len(found.attitude_t_s) == 10
    assert run(["log", "report", str(tmp_path / "a.ulg")]) == 0


def test_a_ulog_with_a_gps_alone_shows_its_places(tmp_path: Path) -> None:
    (tmp_path / "a.ulg").write_bytes(ulog(gps=True).file)
    found = read_ulog(tmp_path / "a.ulg")
    assert found.info.own_source == "vehicle_gps_position"
    # a millionth of a degree of latitude is 0.111 m
    assert found.own.position_m[:, 0] == pytest.approx([0.1112 * step for step in range(9)], abs=1e-3)
    assert found.own.position_m[:, 2] == pytest.approx([-1.0 * step for step in range(9)])


def test_a_stamp_of_another_time_is_left_out(tmp_path: Path) -> None:
    log = ulog()
    log.data(0, 2**62, 1.0, 0.0, 0.0, 0.0)
    (tmp_path / "a.ulg").write_bytes(log.file)
    info = read_ulog(tmp_path / "a.ulg").info
    assert info.duration_s == pytest.approx(0.9) and list(info.bad.values()) == [1]


@pytest.mark.parametrize("kind", "DLCAOPQIM")
def test_a_message_without_content_does_not_end_a_ulog(tmp_path: Path, kind: str) -> None:
    log, whole = ulog(), ulog()
    half = whole.definitions_bytes + (len(whole.file) - whole.definitions_bytes) // 2
    data, at = whole.file, 16
    while at < half:  # a border of messages
        at += 3 + int.from_bytes(data[at : at + 2], "little")
    (tmp_path / "a.ulg").write_bytes(log.file[:at] + message(kind, b"") + log.file[at:])
    assert len(read_ulog(tmp_path / "a.ulg").attitude_t_s) == 10


def test_damage_that_pyulog_reads_without_end_ends(tmp_path: Path) -> None:
    whole = ulog()
    at = whole.definitions_bytes
    # a type that is not known, and longer than the rest of the file
    (tmp_path / "a.ulg").write_bytes(whole.file[:at] + struct.pack("<Hc", 60_000, b"x") + whole.file[at:])
    try:
        assert read_ulog(tmp_path / "a.ulg").info.notes
    except RecordingError as error:
        assert "a.ulg" in str(error)


@pytest.mark.parametrize(
    ("text", "plain"),
    [
        ("\x1b[32mReady\x1b[0m", "Ready"),
        ("\x1b]0;title\x07low", "low"),
        ("\x1b[2J\x1b[1;31mx", "x"),
        ("bell\x07", "bell?"),
        ("21 °C", "21 °C"),
        ("\x9b31mred", "red"),
        ("\u202eback", "?back"),
        ("\x1bcreset", "reset"),
    ],
)
def test_no_text_acts_on_the_terminal(tmp_path: Path, text: str, plain: str) -> None:
    assert strip_escapes(text) == plain
    log = UlogWriter(START_US)
    log.text(4, START_US, text)
    (tmp_path / "a.ulg").write_bytes(log.file)
    assert [one.text for one in read_ulog(tmp_path / "a.ulg").info.texts] == [plain]


@pytest.mark.parametrize("seed", range(12))
def test_damage_is_read_around_or_refused(tmp_path: Path, seed: int) -> None:
    rng = random.Random(seed)
    data = bytearray(two_vehicles().save(tmp_path / "a.tlog").read_bytes())
    for _ in range(30):
        data[rng.randrange(len(data))] = rng.randrange(256)
    cut = rng.randrange(len(data))
    (tmp_path / "a.tlog").write_bytes(data[:cut] + rng.randbytes(rng.randrange(200)) + data[cut:])
    assert read_flight(tmp_path / "a.tlog").info.vehicle_system == 1
