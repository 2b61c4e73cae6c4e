from __future__ import annotations

import struct
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from logs.recording.tlog import read_tlog
from uavctl.errors import RecordingError

EPOCH_US = 1_780_000_000_000_000


def packet(system: int, count: int, version: int = 2) -> bytes:
    """A heartbeat made by pymavlink."""
    mav = mavlink.MAVLink(None, srcSystem=system, srcComponent=1)
    mav.seq = count % 256
    return bytes(mavlink.MAVLink_heartbeat_message(2, 3, 81, count, 4, 3).pack(mav, force_mavlink1=version == 1))


def stamped(packets: list[bytes]) -> bytes:
    return b"".join(struct.pack(">Q", EPOCH_US + 1000 * number) + data for number, data in enumerate(packets))


def test_packets_times_and_directions(tmp_path: Path) -> None:
    packets = [packet(system, number, 1 + number % 2) for number, system in enumerate((1, 255, 245, 17))]
    path = tmp_path / "a.tlog"
    path.write_bytes(stamped(packets))
    tlog = read_tlog(path)
    assert [one.data for one in tlog] == packets
    assert [one.outgoing for one in tlog] == [False, True, True, False]
    assert [one.at_ns for one in tlog] == [(EPOCH_US + 1000 * number) * 1000 for number in range(4)]
    assert (tlog.torn_bytes, tlog.skipped_bytes) == (0, 0)


def test_signed_packet_is_longer(tmp_path: Path) -> None:
    mav = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    mav.signing.secret_key = b"k" * 32
    mav.signing.sign_outgoing = True
    signed = bytes(mavlink.MAVLink_heartbeat_message(2, 3, 81, 0, 4, 3).pack(mav))
    assert signed[2] & 1
    path = tmp_path / "a.tlog"
    path.write_bytes(stamped([signed, packet(1, 1)]))
    assert [one.data for one in read_tlog(path)] == [signed, packet(1, 1)]


def test_cut_anywhere_all_whole_packets_are_there(tmp_path: Path) -> None:
    packets = [packet(1, number) for number in range(4)]
    data = stamped(packets)
    path = tmp_path / "a.tlog"
    size = len(data) // 4
    for cut in range(size, len(data) + 1):
        path.write_bytes(data[:cut])
        tlog = read_tlog(path)
        assert [one.data for one in tlog] == packets[: cut // size]
        assert tlog.torn_bytes == cut % size


def test_garbage_between_packets_is_skipped_and_counted(tmp_path: Path) -> None:
    packets = [packet(1, number) for number in range(3)]
    parts = [struct.pack(">Q", EPOCH_US + number) + data for number, data in enumerate(packets)]
    garbage = b"Init ArduCopter \xfd\xfe\xfd" * 3
    path = tmp_path / "a.tlog"
    path.write_bytes(parts[0] + garbage + parts[1] + parts[2])
    tlog = read_tlog(path)
    assert [one.data for one in tlog] == packets
    assert tlog.skipped_bytes == len(garbage)


def test_no_tlog(tmp_path: Path) -> None:
    path = tmp_path / "a.tlog"
    path.write_bytes(b"not a recording of packets" * 10)
    with pytest.raises(RecordingError, match=r"is it a \.tlog"):
        read_tlog(path)
    with pytest.raises(RecordingError, match=r"b\.tlog: No such file"):
        read_tlog(tmp_path / "b.tlog")
