"""The vehicle's parameters out of the raw messages of pymavlink, and what recordings carry for other programs."""

from __future__ import annotations

import struct
from collections.abc import Iterable
from pathlib import Path

import msgspec
import pytest
from mcap.reader import make_reader
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from recording_fakes import HEADER

from logs.recording.attachments import make_layout_text
from logs.recording.info import read_info
from logs.recording.parameters import ParameterReader, VehicleParameter, make_parameter_file
from logs.recording.recorder import SyncRecorder
from logs.recording.recover import recover
from uavctl.cli.app import run
from uavctl.config.types import LogConfig
from uavctl.records import Datagram

REAL32, INT32, UINT8 = mavlink.MAV_PARAM_TYPE_REAL32, mavlink.MAV_PARAM_TYPE_INT32, mavlink.MAV_PARAM_TYPE_UINT8


def heartbeat(autopilot: int, system: int = 1) -> bytes:
    mav = mavlink.MAVLink(None, srcSystem=system, srcComponent=1)
    return bytes(mavlink.MAVLink_heartbeat_message(2, autopilot, 0, 0, 4, 3).pack(mav))


def told(name: str, value: float, kind: int, *, system: int = 1, component: int = 1, version: int = 2) -> bytes:
    mav = mavlink.MAVLink(None, srcSystem=system, srcComponent=component)
    message = mavlink.MAVLink_param_value_message(name.encode(), value, kind, 2, 0)
    return bytes(message.pack(mav, force_mavlink1=version == 1))


def read(chunks: Iterable[bytes], *, outgoing: bool = False) -> dict[str, VehicleParameter]:
    reader = ParameterReader()
    for data in chunks:
        reader.take(Datagram(at_ns=0, link="vehicle", outgoing=outgoing, data=data))
    return reader.parameters()


def as_float(value: int) -> float:
    (found,) = struct.unpack("<f", struct.pack("<i", value))
    return float(found)


def test_integers_are_read_as_the_autopilot_writes_them() -> None:
    px4 = read([heartbeat(mavlink.MAV_AUTOPILOT_PX4), told("A", as_float(7), INT32), told("B", 0.1, REAL32)])
    copter = read([told("A", 7.0, INT32), told("C", 3.0, UINT8, version=1), heartbeat(3)])
    assert (px4["A"].value, px4["A"].type, px4["B"].value) == (7, "INT32", 0.1)
    assert (copter["A"].value, copter["C"].value, copter["C"].type) == (7, 3, "UINT8")


def test_the_newest_value_of_the_vehicle_counts() -> None:
    others = [heartbeat(mavlink.MAV_AUTOPILOT_INVALID, 7), told("A", 9.0, INT32, system=7)]
    mine = [heartbeat(3), told("A", 1.0, INT32), told("A", 2.0, INT32), told("A", 5.0, INT32, component=154)]
    found = read([*others, *mine])
    assert {name: (one.value, one.system, one.component) for name, one in found.items()} == {"A": (2, 1, 1)}
    assert read(mine, outgoing=True) == {}


@pytest.mark.parametrize("size", [1, 7, 64, 1000])
def test_a_stream_is_read_however_it_is_cut(size: int) -> None:
    data = b"boot\xfd\xfe" + b"".join(
        [heartbeat(3), *(told(f"P{number}", float(number), INT32) for number in range(40))]
    )
    found = read(data[at : at + size] for at in range(0, len(data), size))
    assert {name: one.value for name, one in found.items()} == {f"P{number}": number for number in range(40)}


def test_the_rest_of_a_frame_may_look_like_another_frame() -> None:
    """Its bytes begin as those of a frame of their length, of message 16640."""
    (value,) = struct.unpack("<f", b"\xfd\x0f\x00?")
    frame = told("A", value, REAL32)
    rest = frame[10:]
    assert len(rest) == 12 + rest[1] and int.from_bytes(rest[7:10], "little") == ord("A") << 8
    assert read([heartbeat(3), frame[:10], rest])["A"].value == pytest.approx(value)


def test_what_is_damaged_tells_nothing() -> None:
    bad = bytearray(told("A", 1.0, INT32))
    bad[12] ^= 1
    assert read([bytes(bad), told("A", 1.0, INT32)[:-1]]) == {}


def test_the_file_is_one_of_qgroundcontrol() -> None:
    found = read([heartbeat(3), told("ANGLE_MAX", 3000.0, INT32), told("WPNAV_SPEED", 0.1, REAL32)])
    lines = make_parameter_file(found).splitlines()
    rows = [line.split("\t") for line in lines if not line.startswith("#")]
    assert rows == [["1", "1", "ANGLE_MAX", "3000", "6"], ["1", "1", "WPNAV_SPEED", "0.1", "9"]]


def flight(path: Path, *values: float, log: LogConfig | None = None, zero_utc_ns: int | None = None) -> Path:
    header = msgspec.structs.replace(HEADER, zero_utc_ns=zero_utc_ns, platform="Linux")
    recorder = SyncRecorder(path, log)
    recorder.put("/uavctl/header", 5, header)
    for number, data in enumerate([heartbeat(3), *(told("A", value, INT32) for value in values)]):
        raw = Datagram(at_ns=10 + number, link="vehicle", outgoing=False, data=data)
        recorder.put("/raw/vehicle/in", raw.at_ns, raw)
    assert recorder.close().ok
    return path


def beside(path: Path) -> tuple[dict[str, bytes], dict[str, dict[str, str]]]:
    """Attachments and metadata by the format's own reader."""
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None and summary.statistics is not None
        attachments = {one.name: one.data for one in reader.iter_attachments()}
        metadata = {one.name: one.metadata for one in reader.iter_metadata()}
    assert summary.statistics.attachment_count == len(summary.attachment_indexes) == len(attachments)
    assert summary.statistics.metadata_count == len(summary.metadata_indexes) == len(metadata)
    return attachments, metadata


def test_a_recording_carries_them_for_other_programs(tmp_path: Path) -> None:
    path = flight(tmp_path / "flight.mcap", 4.0, 5.0)
    attachments, metadata = beside(path)
    assert attachments["config.toml"].decode() == HEADER.config_toml
    assert attachments["foxglove-layout.json"].decode() == make_layout_text()
    assert b"1\t1\tA\t5\t6\n" in attachments["vehicle.params"]
    assert metadata["vehicle parameters"] == {"A": "5"} and metadata["vehicle parameter types"] == {"A": "INT32"}
    assert metadata["configuration"] == {"name": "room-hahn-stursberg", "duration_s": "40.0"}
    assert metadata["versions"] == {"uavctl": "0.1"}
    assert (metadata["uavctl"]["platform"], metadata["uavctl"]["seed"]) == ("Linux", "7")
    found = read_info(path)
    assert {one.name: one.bytes for one in found.attachments} == {name: len(data) for name, data in attachments.items()}
    assert found.parameters["A"].value == 5


def test_a_recovered_recording_carries_them_too(tmp_path: Path) -> None:
    path = flight(tmp_path / "flight.mcap", 4.0, 5.0)
    whole = beside(path)
    path.write_bytes(path.read_bytes()[:-400])
    recover(path, tmp_path / "out.mcap")
    assert beside(tmp_path / "out.mcap") == whole


def test_info_shows_them(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = flight(tmp_path / "flight.mcap", 4.0, zero_utc_ns=1_764_000_000 * 10**9)
    assert run(["log", "info", str(path)]) == 0
    out = capsys.readouterr().out
    assert "attached: config.toml" in out and "vehicle parameters: 1 (A 4)" in out and "2025-11-24T16:00:00" in out


@pytest.mark.parametrize("recovered", [False, True])
@pytest.mark.parametrize(("names", "complete"), [("A", "false"), ("AB", "true")])
def test_the_attachment_says_whether_the_list_is_whole(
    names: str, complete: str, recovered: bool, tmp_path: Path
) -> None:
    path = tmp_path / "flight.mcap"
    recorder = SyncRecorder(path, LogConfig())
    recorder.put("/uavctl/header", 0, HEADER)
    for data in (heartbeat(12), *(told(name, 1.0, REAL32) for name in (*names, "_HASH_CHECK"))):
        recorder.put("/raw/vehicle/in", 1, Datagram(at_ns=1, link="vehicle", outgoing=False, data=data))
    recorder.close()
    if recovered:
        recover(path, tmp_path / "again.mcap")
        path = tmp_path / "again.mcap"
    with path.open("rb") as file:
        found = {one.name: one.metadata for one in make_reader(file).iter_metadata()}["vehicle parameter list"]
    assert found == {"told": str(len(names)), "of": "2", "complete": complete}
    assert read_info(path).parameter_count == 2
