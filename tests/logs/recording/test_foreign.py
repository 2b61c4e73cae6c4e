"""MAVLink in the MCAP of another program: the same flight as in a `.tlog` of the same bytes."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import pytest
from foreign_rig import TLOGS, flown, replay_as_tlog, rows_of, write
from loopback_rig import lockstep, make_loop
from mcap.writer import CompressionType
from places import DATA

from logs.recording.foreign import ForeignMcap, is_foreign, read_mcap
from logs.recording.recorder import SyncRecorder
from logs.recording.tlog import ForeignReplay, TlogPacket, get_frame_length, read_tlog, replay_tlog
from uavctl.cli.app import run
from uavctl.config import load_config
from uavctl.config.types import LogConfig
from uavctl.errors import RecordingError, UsageError
from uavctl.mavlink.connection import VEHICLE
from uavctl.records import Datagram, raw_topic


@pytest.mark.parametrize("encoding", ["mavlink", "", "x-mavlink", "application/octet-stream"])
@pytest.mark.parametrize("name", TLOGS)
def test_every_packet_is_found_whatever_the_encoding_is_called(tmp_path: Path, name: str, encoding: str) -> None:
    path = write(tmp_path / "a.mcap", rows_of(name, encoding=encoding))
    assert is_foreign(path)
    found = read_mcap(path)
    assert found == ForeignMcap(packets=read_tlog(DATA / name).packets, topics=("/mavlink",), torn=False)


@pytest.mark.parametrize("compression", list(CompressionType))
@pytest.mark.parametrize("summary", [True, False])
@pytest.mark.parametrize("chunked", [True, False])
def test_every_layout_of_the_file(tmp_path: Path, compression: CompressionType, summary: bool, chunked: bool) -> None:
    path = write(
        tmp_path / "a.mcap",
        rows_of(TLOGS[0]),
        compression=compression,
        use_chunking=chunked,
        chunk_size=10_000,
        use_statistics=summary,
        use_summary_offsets=summary,
        repeat_channels=summary,
        repeat_schemas=summary,
    )
    assert read_mcap(path).packets == read_tlog(DATA / TLOGS[0]).packets


@pytest.mark.slow
@pytest.mark.parametrize("name", TLOGS[:2])
def test_the_same_bytes_in_a_tlog_and_in_an_mcap_fly_the_same(tmp_path: Path, name: str) -> None:
    assert flown(read_mcap(write(tmp_path / "a.mcap", rows_of(name))).packets) == replay_as_tlog(name)


def test_several_frames_in_a_message_are_so_many_packets(tmp_path: Path) -> None:
    packets = read_tlog(DATA / TLOGS[0]).packets
    together = [packets[at : at + 3] for at in range(0, len(packets), 3)]
    rows = [("/link", "", some[0].at_ns, b"".join(one.data for one in some)) for some in together]
    found = read_mcap(write(tmp_path / "a.mcap", rows)).packets
    assert [one.data for one in found] == [one.data for one in packets]
    assert [one.outgoing for one in found] == [one.outgoing for one in packets]
    assert [one.at_ns for one in found] == [some[0].at_ns for some in together for _ in some]


def test_two_directions_on_two_topics_out_of_order_in_the_file_beside_others(tmp_path: Path) -> None:
    packets = read_tlog(DATA / TLOGS[2]).packets
    rows = [
        *(("/to_vehicle", "", one.at_ns, one.data) for one in packets if one.outgoing),
        *(("/imu", "json", one.at_ns, b'{"a": 1}') for one in packets),
        # Begins as a frame now and then, and is none.
        *(("/noise", "", one.at_ns, b"\xfd\xfe\x00\x07" + bytes(range(40))) for one in packets),
        *(("/from_vehicle", "", one.at_ns, one.data) for one in packets if not one.outgoing),
    ]
    path = write(tmp_path / "a.mcap", rows)
    found = read_mcap(path)
    assert set(found.topics) == {"/to_vehicle", "/from_vehicle"}
    times = [one.at_ns for one in found.packets]
    assert times == sorted(times)
    incoming = [(one.at_ns, one.data) for one in found.packets if not one.outgoing]
    assert incoming == [(one.at_ns, one.data) for one in packets if not one.outgoing]
    alone = read_mcap(path, ["/to_vehicle"])
    assert alone.topics == ("/to_vehicle",) and all(one.outgoing for one in alone.packets)


@pytest.mark.slow
def test_our_own_raw_topics_without_anything_else(tmp_path: Path) -> None:
    memory = lockstep("paper", 12.0, "solver.method=exact")
    raw = [(topic, at, one) for topic, at, one in memory.entries if isinstance(one, Datagram)]
    path = write(tmp_path / "raw.mcap", [(topic, "mavlink", at, one.data) for topic, at, one in raw])
    assert is_foreign(path)
    found = read_mcap(path)
    assert set(found.topics) == {topic for topic, _, _ in raw}
    tlog = tmp_path / "raw.tlog"
    frames = [(at // 1000, one.data) for _, at, one in sorted(raw, key=lambda entry: entry[1])]
    tlog.write_bytes(b"".join(struct.pack(">Q", at_us) + data for at_us, data in frames if data))
    config = load_config("paper", ["daemon.vehicle=tlog", "daemon.mocap=tlog", "solver.method=exact"])

    def fly(packets: tuple[TlogPacket, ...]) -> ForeignReplay:
        incoming = ((one.at_ns, one.data) for one in packets if not one.outgoing)
        return replay_tlog(incoming, lambda sink: make_loop(config, sink), link=VEHICLE, tick_ns=100_000_000)

    replayed = fly(found.packets)
    assert replayed == fly(read_tlog(tlog).packets)
    assert replayed.positions == sum(topic == raw_topic("mocap", outgoing=False) for topic, _, _ in raw)
    assert replayed.solves["optimal"] > 5


def test_a_file_cut_anywhere_gives_the_whole_messages_before(tmp_path: Path) -> None:
    rows = rows_of(TLOGS[0])[:40]
    whole = write(tmp_path / "a.mcap", rows, use_chunking=False, finish=False).read_bytes()
    path = tmp_path / "cut.mcap"
    counts = set()
    for cut in range(200, len(whole), 61):
        path.write_bytes(whole[:cut])
        found = read_mcap(path)
        assert found.torn
        assert [one.data for one in found.packets] == [row[3] for row in rows[: len(found.packets)]]
        counts.add(len(found.packets))
    assert len(counts) > 20


def test_nothing_that_is_mavlink_lists_what_is_there(tmp_path: Path) -> None:
    rows = [
        ("/camera", "ros1", 1, b"\xff\xd8image"),
        ("/imu", "json", 2, b"{}"),
        ("/bytes", "", 3, b"\xfd\x00\x00\x00\x00"),
        ("/bytes", "", 4, b"\xfe\x09\x00\x00\x00\x00" + bytes(12)),
    ]
    path = write(tmp_path / "a.mcap", rows)
    listed = r"no raw MAVLink in it; it has: /bytes \(no encoding, 2\), /camera \(ros1, 1\), /imu \(json, 1\)$"
    with pytest.raises(RecordingError, match=listed):
        read_mcap(path)
    with pytest.raises(UsageError, match=r"--topic /mavlink: .* has none of this name; it has: /bytes, /camera, /imu$"):
        read_mcap(path, ["/mavlink"])
    with pytest.raises(RecordingError, match="it has no topic at all"):
        read_mcap(write(tmp_path / "empty.mcap", []))


def test_a_flipped_byte_is_told_and_never_flown(tmp_path: Path) -> None:
    rows = rows_of(TLOGS[0])[:60]
    good = write(tmp_path / "a.mcap", rows, compression=CompressionType.NONE, enable_data_crcs=True).read_bytes()
    expected = read_mcap(tmp_path / "a.mcap").packets
    path = tmp_path / "flipped.mcap"
    refused = 0
    for at in range(8, len(good), 97):
        path.write_bytes(good[:at] + bytes([good[at] ^ 0x10]) + good[at + 1 :])
        try:
            found = read_mcap(path)
        except RecordingError:
            refused += 1
        else:
            assert found.packets == expected or found.torn
    assert refused > len(good) // 97 // 2


def test_recordings_of_ours_and_files_of_nobody_are_not_foreign(tmp_path: Path) -> None:
    ours = tmp_path / "ours.mcap"
    recorder = SyncRecorder(ours, LogConfig())
    for topic, at_ns, record in lockstep("paper", 2.0, "solver.method=exact").entries:
        recorder.put(topic, at_ns, record)
    recorder.close()
    assert not is_foreign(ours)
    ours.write_bytes(ours.read_bytes()[:3000])
    assert not is_foreign(ours)
    (tmp_path / "text.mcap").write_text("no recording")
    assert not is_foreign(tmp_path / "text.mcap")
    assert not is_foreign(tmp_path / "missing.mcap")
    assert not is_foreign(tmp_path)
    with pytest.raises(RecordingError, match="Is a directory"):
        read_mcap(tmp_path)


def test_frame_length_needs_a_head() -> None:
    assert [get_frame_length(b"\xfd\x05\x00"[:n], 0) for n in range(4)] == [0, 0, 0, 17]
    assert get_frame_length(b"\xfe\x09\x00", 0) == 17 and get_frame_length(b"abc", 0) == 0


@pytest.mark.slow
def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write(tmp_path / "a.mcap", rows_of(TLOGS[0]))
    arguments = [
        "log",
        "replay",
        str(path),
        "--json",
        "--config",
        "room-hahn-stursberg",
        "--set",
        "solver.method=exact",
    ]
    assert run(arguments) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["positions"] == replay_as_tlog(TLOGS[0]).positions
    assert document["solves"] == replay_as_tlog(TLOGS[0]).solves
    assert run([*arguments, "--topic", "/other"]) == 2
    assert "/other" in capsys.readouterr().err
    other = write(tmp_path / "b.mcap", [("/imu", "json", 1, b"{}")])
    assert run(["log", "replay", str(other)]) == 1
    assert "/imu (json, 1)" in capsys.readouterr().err
    assert run(["log", "replay", str(DATA / TLOGS[0]), "--topic", "/mavlink"]) == 2
