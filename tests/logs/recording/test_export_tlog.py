"""The raw MAVLink of a recording as a `.tlog` that other programs and our own replay read."""

from __future__ import annotations

import json
import random
import subprocess
import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import msgspec
import pytest
import view_rig
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from recording_fakes import HEADER, record_flight

from logs.recording.recorder import SyncRecorder
from logs.recording.tlog import export_tlog, read_tlog
from uavctl.cli.app import run
from uavctl.errors import RecordingError, UsageError
from uavctl.records import Datagram, Header, raw_topic

STARTED_US = 1_767_323_045_000_000  # 2026-01-02T03:04:05Z


def packet(number: int, version: int = 2) -> bytes:
    mav = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    mav.seq = number % 256
    message = mavlink.MAVLink_local_position_ned_message(number, 1.0, 2.0, 3.0, 0.1, 0.2, 0.3)
    return bytes(message.pack(mav, force_mavlink1=version == 1))


def write(path: Path, datagrams: Sequence[tuple[int, str, bool, bytes]], header: Header = HEADER) -> None:
    recorder = SyncRecorder(path)
    recorder.put("/uavctl/header", header.started_ns, header)
    for at_ns, link, outgoing, data in datagrams:
        raw = Datagram(at_ns=at_ns, link=link, outgoing=outgoing, data=data)
        recorder.put(raw_topic(link, outgoing=outgoing), at_ns, raw)
    assert recorder.close().ok


def incoming(packets: Sequence[bytes], link: str = "vehicle") -> list[tuple[int, str, bool, bytes]]:
    return [(1_000_000 * number, link, False, data) for number, data in enumerate(packets)]


@pytest.mark.slow
def test_mavlogdump_finds_every_packet(tmp_path: Path) -> None:
    flight = view_rig.record(tmp_path / "flight.mcap")
    exported = export_tlog(flight, tmp_path / "a.tlog")
    sent = [(record.link, record.outgoing) for record in view_rig.fly_view().of(Datagram)]
    assert exported.packets == dict(sorted(Counter(raw_topic(link, outgoing=out) for link, out in sent).items()))
    assert exported.left_out_bytes == 0
    dumped = subprocess.run(
        [sys.executable, "-m", "pymavlink.tools.mavlogdump", "--format", "json", str(tmp_path / "a.tlog")],
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    lines = [json.loads(line) for line in dumped.stdout.splitlines()]
    assert len(lines) == len(sent) > 200
    wanted: Counter[str] = Counter()
    for record in view_rig.fly_view().of(Datagram):
        (message,) = mavlink.MAVLink(None).parse_buffer(record.data) or []
        wanted[message.get_type()] += 1
    assert Counter(line["meta"]["type"] for line in lines) == wanted
    stamps = [line["meta"]["timestamp"] for line in lines]
    assert stamps == sorted(stamps)


def test_our_own_replay_takes_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    flight = view_rig.record(tmp_path / "flight.mcap")
    assert run(["log", "export", str(flight), "--to", "tlog", "--json"]) == 0
    capsys.readouterr()
    assert run(["log", "replay", str(tmp_path / "flight.tlog"), "--set", "solver.method=exact", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    came = [record for record in view_rig.fly_view().of(Datagram) if not record.outgoing]
    assert found["datagrams"] == len(came)
    assert found["positions"] == sum(record.link == "mocap" for record in came)


def test_times_are_utc_by_the_header(tmp_path: Path) -> None:
    header = msgspec.structs.replace(HEADER, started_ns=7_000_000_000)
    flight = tmp_path / "flight.mcap"
    write(
        flight, [(at_ns, "vehicle", True, packet(1)) for at_ns in (7_000_000_000, 7_000_001_999, 8_500_000_000)], header
    )
    export_tlog(flight, tmp_path / "a.tlog")
    assert [one.at_ns // 1000 - STARTED_US for one in read_tlog(tmp_path / "a.tlog")] == [0, 1, 1_500_000]


@pytest.mark.parametrize("started", ["2026-01-02T03:04:05", "2026-01-02T05:04:05+02:00"])
def test_start_times_in_other_words(started: str, tmp_path: Path) -> None:
    flight = tmp_path / "flight.mcap"
    write(flight, incoming([packet(1)]), msgspec.structs.replace(HEADER, started_ns=0, started_utc=started))
    export_tlog(flight, tmp_path / "a.tlog")
    assert [one.at_ns // 1000 for one in read_tlog(tmp_path / "a.tlog")] == [STARTED_US]


def test_a_start_time_that_is_none(tmp_path: Path) -> None:
    flight = tmp_path / "flight.mcap"
    write(flight, incoming([packet(1)]), msgspec.structs.replace(HEADER, started_utc="yesterday"))
    with pytest.raises(RecordingError, match="no usable start time"):
        export_tlog(flight, tmp_path / "a.tlog")


def test_one_connection_alone(tmp_path: Path) -> None:
    flight = tmp_path / "flight.mcap"
    write(flight, [*incoming([packet(1), packet(2)]), *incoming([packet(3)], "mocap")])
    assert export_tlog(flight, tmp_path / "a.tlog", link="mocap").packets == {"/raw/mocap/in": 1}
    assert [one.data for one in read_tlog(tmp_path / "a.tlog")] == [packet(3)]
    with pytest.raises(UsageError, match="no bytes of a connection 'radio' in it; it has mocap, vehicle"):
        export_tlog(flight, tmp_path / "b.tlog", link="radio")
    assert sorted(file.name for file in tmp_path.iterdir()) == ["a.tlog", "flight.mcap"]


def test_packets_of_one_datagram_are_parted(tmp_path: Path) -> None:
    flight = tmp_path / "flight.mcap"
    bad = bytearray(packet(4))
    bad[-1] ^= 0xFF
    unknown = bytearray(packet(5))
    unknown[7:10] = b"\xff\xff\xff"
    whole = [packet(1), packet(2, 1), bytes(bad), bytes(unknown), packet(3)]
    write(flight, incoming([b"".join(whole)]))
    assert export_tlog(flight, tmp_path / "a.tlog").left_out_bytes == 0
    assert [one.data for one in read_tlog(tmp_path / "a.tlog")] == whole


def test_what_is_no_packet_is_left_out_and_counted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    flight = tmp_path / "flight.mcap"
    garbage, torn = b"Init ArduCopter \xfd\xfe", packet(9)[:-3]
    write(flight, incoming([garbage, packet(1) + garbage, garbage + packet(2), torn, packet(3), b"\xfd"]))
    assert run(["log", "export", str(flight), "--to", "tlog"]) == 0
    assert [one.data for one in read_tlog(tmp_path / "flight.tlog")] == [packet(1), packet(2), packet(3)]
    left_out = 3 * len(garbage) + len(torn) + 1
    assert f"left out: {left_out} bytes that are no whole MAVLink packet" in capsys.readouterr().err.replace("\n", " ")


@pytest.mark.parametrize("seed", range(5))
def test_packets_of_a_stream_are_put_together(seed: int, tmp_path: Path) -> None:
    rng = random.Random(seed)
    packets = [packet(number) for number in range(60)]
    data, chunks = b"".join(packets), []
    while data:
        size = rng.randint(1, 90)
        chunks.append(data[:size])
        data = data[size:]
    config = '[daemon]\nvehicle = "tcp://127.0.0.1:5760"\nmocap = "udpin://0.0.0.0:14560"\n'
    flight = tmp_path / "flight.mcap"
    write(flight, incoming(chunks), msgspec.structs.replace(HEADER, config_toml=config))
    assert export_tlog(flight, tmp_path / "a.tlog").left_out_bytes == 0
    assert [one.data for one in read_tlog(tmp_path / "a.tlog")] == packets


def test_in_order_of_time(tmp_path: Path) -> None:
    flight = tmp_path / "flight.mcap"
    times = [5_000_000, 3_000_000, 3_000_000, 900_000_000, 4_000_000, 6_000_000_000, 5_500_000_000]
    write(flight, [(at_ns, "vehicle", False, packet(number)) for number, at_ns in enumerate(times)])
    export_tlog(flight, tmp_path / "a.tlog")
    order = sorted(range(len(times)), key=lambda number: times[number])
    assert [one.data for one in read_tlog(tmp_path / "a.tlog")] == [packet(number) for number in order]


def test_torn_in_flight(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    flight = tmp_path / "flight.mcap"
    packets = [packet(number) for number in range(10_000)]
    write(flight, incoming(packets))
    flight.write_bytes(flight.read_bytes()[: flight.stat().st_size // 2])
    assert run(["log", "export", str(flight), "--to", "tlog", "--out", str(tmp_path)]) == 0
    assert "exported up to there" in capsys.readouterr().err
    found = [one.data for one in read_tlog(tmp_path / "flight.tlog")]
    assert 100 < len(found) < 10_000 and found == packets[: len(found)]


def test_nothing_to_export(tmp_path: Path) -> None:
    flight = tmp_path / "flight.mcap"
    record_flight(flight, 9)  # its raw bytes are no packets
    with pytest.raises(RecordingError, match="no MAVLink packet in it"):
        export_tlog(flight, tmp_path / "a.tlog")
    assert [file.name for file in tmp_path.iterdir()] == ["flight.mcap"]
