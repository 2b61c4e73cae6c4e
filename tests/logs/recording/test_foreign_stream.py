"""Recordings of other programs as they really are: bytes cut anywhere, garbage, odd clocks, torn ends."""

from __future__ import annotations

import random
import struct
from pathlib import Path

import pytest
from foreign_rig import TLOGS, Row, flown, replay_as_tlog, rows_of, write
from places import DATA
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from logs.recording.foreign import cut_stream, read_mcap
from logs.recording.tlog import TlogPacket, read_tlog
from uavctl.cli.replays import read_foreign_vehicle
from uavctl.errors import RecordingError, UsageError

S = 1_000_000_000
GARBAGE = b"Init ArduCopter \xfd\xfe\xfd\x09\x00"


def pieces_of(name: str, sizes: tuple[int, int], seed: int) -> tuple[list[tuple[int, bytes]], list[TlogPacket]]:
    """A flight's bytes in reads of random sizes, each at the time of its last byte; and the frames as they come."""
    rng = random.Random(seed)
    packets = read_tlog(DATA / name).packets
    times = [one.at_ns for one in packets for _ in one.data]
    data = b"".join(one.data for one in packets)
    pieces, at = [], 0
    while at < len(data):
        end = min(at + rng.randint(*sizes), len(data))
        pieces.append((times[end - 1], data[at:end]))
        at = end
    ends, stamps, whole = 0, [], []
    for at_ns, piece in pieces:
        stamps += [at_ns] * len(piece)
    for one in packets:
        ends += len(one.data)
        whole.append(TlogPacket(stamps[ends - 1], one.data, one.outgoing))
    return pieces, whole


@pytest.mark.slow
@pytest.mark.parametrize("sizes", [(1, 1), (1, 40), (7, 7), (100, 900), (4096, 4096)])
@pytest.mark.parametrize("name", TLOGS)
def test_reads_of_any_size_hold_the_same_frames(tmp_path: Path, name: str, sizes: tuple[int, int]) -> None:
    pieces, whole = pieces_of(name, sizes, seed=sizes[1])
    found = read_mcap(write(tmp_path / "a.mcap", [("/serial", "", at_ns, data) for at_ns, data in pieces]))
    assert list(found.packets) == whole
    assert not any("left out" in note for note in found.notes)


@pytest.mark.slow
def test_a_serial_line_flies_as_the_tlog_does(tmp_path: Path) -> None:
    pieces, _ = pieces_of(TLOGS[0], (1, 60), seed=3)
    by_pieces = flown(read_mcap(write(tmp_path / "a.mcap", [("/serial", "", at, data) for at, data in pieces])).packets)
    whole = replay_as_tlog(TLOGS[0])
    # A frame is there when its last byte is: the same positions, each where the next read begins at the latest.
    assert (by_pieces.positions, by_pieces.datagrams) == (whole.positions, whole.datagrams)
    assert by_pieces.solves["optimal"] > 20


def test_two_channels_of_one_topic_are_two_streams(tmp_path: Path) -> None:
    sides = [[one for one in read_tlog(DATA / TLOGS[0]).packets if one.outgoing is out][:60] for out in (False, True)]
    rows: list[Row] = []
    for pair in zip(*sides, strict=False):  # each frame in two reads, those of the two directions between each other
        at_ns = max(one.at_ns for one in pair)
        rows += [("/link", str(one.outgoing), at_ns, one.data[:9]) for one in pair]
        rows += [("/link", str(one.outgoing), at_ns, one.data[9:]) for one in pair]
    found = read_mcap(write(tmp_path / "a.mcap", rows))
    assert (found.topics, found.notes) == (("/link",), ())
    for out, side in zip((False, True), sides, strict=True):
        there = [one.data for one in found.packets if one.outgoing is out]
        assert there == [one.data for one in side[: len(rows) // 4]] and len(there) > 20


def test_garbage_between_frames_is_left_out_and_counted(tmp_path: Path) -> None:
    packets = read_tlog(DATA / TLOGS[0]).packets[:100]
    rows = [
        ("/serial", "", one.at_ns, (GARBAGE if number % 7 == 3 else b"") + one.data)
        for number, one in enumerate(packets)
    ]
    torn = packets[0].data[:20]
    found = read_mcap(write(tmp_path / "a.mcap", [*rows, ("/serial", "", packets[-1].at_ns, torn)]))
    assert found.packets == packets
    left_out = 14 * len(GARBAGE) + len(torn)
    assert found.notes == (f"/serial: {left_out} bytes left out that are no whole frame",)


def test_a_frame_cut_short_costs_no_other_and_no_time(tmp_path: Path) -> None:
    packets = read_tlog(DATA / TLOGS[0]).packets[:100]
    rows = rows_of(TLOGS[0])[:100]
    rows[30] = (*rows[30][:3], rows[30][3][:-4])  # lost by the line, not by the recorder
    found = read_mcap(write(tmp_path / "a.mcap", rows))
    assert found.packets == packets[:30] + packets[31:]
    assert found.notes == (f"/mavlink: {len(packets[30].data) - 4} bytes left out that are no whole frame",)


def test_a_wrong_checksum_and_an_unknown_id_are_left_to_the_parser() -> None:
    beat = mavlink.MAVLink_heartbeat_message(2, 3, 81, 0, 4, 3)
    good = bytes(beat.pack(mavlink.MAVLink(None, 1, 1)))
    wrong = good[:-1] + bytes((good[-1] ^ 1,))
    unknown = good[:7] + b"\xff\xff\x7f" + good[10:]
    found = cut_stream([(5, good + wrong + unknown + good)])
    assert [one.data for one in found.packets] == [good, wrong, unknown, good]
    assert (found.valid_count, found.left_out_bytes) == (2, 0)


def test_a_channel_that_is_mostly_something_else_is_named_and_taken_when_asked_for(tmp_path: Path) -> None:
    beat = bytes(mavlink.MAVLink_heartbeat_message(2, 3, 81, 0, 4, 3).pack(mavlink.MAVLink(None, 1, 1)))
    console = [("/console", "", at_ns, b"[ 12.3] booting, please wait" * 3) for at_ns in range(1, 40)]
    path = write(tmp_path / "a.mcap", [*console, ("/console", "", 40, beat), ("/link", "", 41, beat)])
    found = read_mcap(path)
    assert found.topics == ("/link",)
    assert found.notes == ("/console: not taken, most of it is no MAVLink; `--topic /console` takes it",)
    asked = read_mcap(path, ["/console"])
    assert [one.data for one in asked.packets] == [beat]
    assert asked.notes == (f"/console: {39 * 84} bytes left out that are no whole frame",)


def test_pictures_are_given_up_soon_but_read_when_asked_for(tmp_path: Path) -> None:
    beat = bytes(mavlink.MAVLink_heartbeat_message(2, 3, 81, 0, 4, 3).pack(mavlink.MAVLink(None, 1, 1)))
    picture = random.Random(1).randbytes(40_000)
    path = write(
        tmp_path / "a.mcap", [*(("/camera", "jpeg", at, picture) for at in (1, 2, 3)), ("/camera", "jpeg", 4, beat)]
    )
    with pytest.raises(RecordingError, match=r"no raw MAVLink in it; it has: /camera \(jpeg, 4\)$"):
        read_mcap(path)
    assert [one.data for one in read_mcap(path, ["/camera"]).packets] == [beat]


def test_an_empty_channel(tmp_path: Path) -> None:
    rows = rows_of(TLOGS[0])[:20]
    found = read_mcap(write(tmp_path / "a.mcap", [*rows, ("/empty", "", rows[0][2], b"")]))
    assert (found.topics, found.notes) == (("/mavlink",), ())
    with pytest.raises(RecordingError, match=r"it has: /empty \(no encoding, 1\), /mavlink"):
        read_mcap(tmp_path / "a.mcap", ["/empty"])


@pytest.mark.slow
def test_two_vehicles_on_one_channel(tmp_path: Path) -> None:
    rows = rows_of(TLOGS[0])
    other = mavlink.MAVLink(None, 42, 1)
    beats = [
        ("/mavlink", "", at_ns, bytes(mavlink.MAVLink_heartbeat_message(2, 3, 81, 0, 4, 3).pack(other)))
        for _, _, at_ns, _ in rows[200::60]  # the vehicle's own came before
    ]
    mixed = sorted([*rows, *beats], key=lambda row: row[2])
    result = flown(read_mcap(write(tmp_path / "a.mcap", mixed)).packets)
    assert result.positions == replay_as_tlog(TLOGS[0]).positions
    assert result.left_out["second-vehicle"] == len(beats)
    assert "second-vehicle" not in replay_as_tlog(TLOGS[0]).left_out


def test_log_times_that_go_back_a_little_are_put_in_order(tmp_path: Path) -> None:
    rows = rows_of(TLOGS[0])[:300]
    shuffled = [row for at in range(0, 300, 3) for row in reversed(rows[at : at + 3])]
    found = read_mcap(write(tmp_path / "a.mcap", shuffled))
    assert [one.at_ns for one in found.packets] == [row[2] for row in rows]
    assert sorted(one.data for one in found.packets) == sorted(row[3] for row in rows)
    assert len(found.notes) == 1 and "time stamps not in order; put in order" in found.notes[0]


@pytest.mark.slow
@pytest.mark.parametrize("leap_s", [-60, -86_400, 86_400, 40 * 365 * 86_400])
def test_a_leap_of_the_clock_is_told_and_time_goes_on(tmp_path: Path, leap_s: int) -> None:
    rows = rows_of(TLOGS[0])
    leaped = [(*row[:2], row[2] + (leap_s * S if number >= 400 else 0), row[3]) for number, row in enumerate(rows)]
    found = read_mcap(write(tmp_path / "a.mcap", leaped))
    assert [one.data for one in found.packets] == [row[3] for row in rows]
    assert found.notes == (f"/mavlink: its clock jumps (1 time, by up to {abs(leap_s)} s); the jumps are removed",)
    gap_ns = rows[400][2] - rows[399][2]
    assert [one.at_ns for one in found.packets] == [
        row[2] - (gap_ns if at >= 400 else 0) for at, row in enumerate(rows)
    ]
    assert flown(found.packets).positions == replay_as_tlog(TLOGS[0]).positions


def test_stamps_of_zero(tmp_path: Path) -> None:
    rows = rows_of(TLOGS[0])[:300]
    some = [(*row[:2], 0 if number in (100, 200) else row[2], row[3]) for number, row in enumerate(rows)]
    found = read_mcap(write(tmp_path / "a.mcap", some, publish_ns=0))
    times = [row[2] for row in rows]
    times[100], times[200] = times[99], times[199]
    assert [one.at_ns for one in found.packets] == times
    assert [one.data for one in found.packets] == [row[3] for row in rows]
    assert found.notes == ("/mavlink: 2 time stamps of zero; replaced by the time before",)
    none = [(*row[:2], 0, row[3]) for row in rows]
    with pytest.raises(RecordingError, match="/mavlink: all 300 time stamps are zero"):
        read_mcap(write(tmp_path / "b.mcap", none, publish_ns=0))


def test_the_time_of_publishing_serves_where_there_is_none_of_logging(tmp_path: Path) -> None:
    rows = [(*row[:2], 0, row[3]) for row in rows_of(TLOGS[0])[:30]]
    found = read_mcap(write(tmp_path / "a.mcap", rows, publish_ns=7 * S))
    assert [one.at_ns for one in found.packets] == [7 * S] * 30
    assert found.notes == ()


def test_a_long_silence_is_told(tmp_path: Path) -> None:
    rows = rows_of(TLOGS[0])
    later = [(*row[:2], row[2] + (1200 * S if number >= 400 else 0), row[3]) for number, row in enumerate(rows)]
    found = read_mcap(write(tmp_path / "a.mcap", later))
    assert found.notes == ("/mavlink: nothing in it for 1200 s",)
    assert [one.at_ns for one in found.packets] == [row[2] for row in later]


def stamped(rows: list[tuple[int, bytes]]) -> bytes:
    return b"".join(struct.pack(">Q", at_us) + data for at_us, data in rows)


def tlog_rows(name: str) -> list[tuple[int, bytes]]:
    return [(one.at_ns // 1000, one.data) for one in read_tlog(DATA / name).packets]


@pytest.mark.parametrize("leap_us", [-60_000_000, -86_400_000_000, 86_400_000_000, 1_700_000_000_000_000])
@pytest.mark.parametrize("name", TLOGS)
def test_a_tlog_whose_clock_leaps_loses_nothing(tmp_path: Path, name: str, leap_us: int) -> None:
    rows = [(at_us - (1_690_000_000_000_000 if leap_us > 1e15 else 0), data) for at_us, data in tlog_rows(name)]
    path = tmp_path / "a.tlog"
    path.write_bytes(
        stamped([(at + (leap_us if number >= 300 else 0), data) for number, (at, data) in enumerate(rows)])
    )
    found = read_tlog(path)
    assert [one.data for one in found] == [data for _, data in rows]
    assert (found.torn_bytes, found.skipped_bytes) == (0, 0)
    gap_us = rows[300][0] - rows[299][0]
    by_s = abs(leap_us + gap_us) * 1e-6
    assert found.notes[0] == f"a.tlog: its clock jumps (1 time, by up to {by_s:.0f} s); the jumps are removed"
    assert [one.at_ns // 1000 for one in found] == [at - (gap_us if n >= 300 else 0) for n, (at, _) in enumerate(rows)]


def test_a_tlog_with_one_wrong_stamp(tmp_path: Path) -> None:
    rows = tlog_rows(TLOGS[0])
    path = tmp_path / "a.tlog"
    for wrong_us in (0, 17, 4_000_000_000_000_000):
        path.write_bytes(stamped([(wrong_us if number == 50 else at, data) for number, (at, data) in enumerate(rows)]))
        found = read_tlog(path)
        assert [one.data for one in found] == [data for _, data in rows]
        assert [one.at_ns // 1000 for one in found] == [
            at if n != 50 else rows[49][0] for n, (at, _) in enumerate(rows)
        ]
        assert len(found.notes) == 1


def test_a_tlog_whose_stamps_are_all_zero(tmp_path: Path) -> None:
    path = tmp_path / "a.tlog"
    path.write_bytes(stamped([(0, data) for _, data in tlog_rows(TLOGS[0])]))
    with pytest.raises(RecordingError, match="all 1034 time stamps are zero"):
        read_tlog(path)


def test_a_tlog_that_begins_with_garbage_or_is_torn_says_so(tmp_path: Path) -> None:
    rows = tlog_rows(TLOGS[0])
    path = tmp_path / "a.tlog"
    path.write_bytes(GARBAGE * 5 + stamped(rows)[:-7])
    found = read_tlog(path)
    assert [one.data for one in found] == [data for _, data in rows[:-1]]
    assert found.skipped_bytes == 5 * len(GARBAGE)
    assert found.notes == (
        f"{5 * len(GARBAGE)} bytes between its packets left out: no packet with a stamp",
        f"the recording is torn within a packet: its last {8 + len(rows[-1][1]) - 7} bytes left out",
    )


def test_the_command_line_tells_what_was_left_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tlog, mcap = tmp_path / "a.tlog", tmp_path / "a.mcap"
    tlog.write_bytes(stamped(tlog_rows(TLOGS[0]))[:-7])
    packets = read_foreign_vehicle(tlog, ())
    assert packets is not None and len(packets) == 1033
    assert "torn within a packet" in capsys.readouterr().err
    write(mcap, [("/serial", "", at_ns, GARBAGE + data) for _, _, at_ns, data in rows_of(TLOGS[0])], use_chunking=False)
    mcap.write_bytes(mcap.read_bytes()[:20_000])
    found = read_foreign_vehicle(mcap, ())
    assert found is not None and 100 < len(found) < 1034
    told = capsys.readouterr().err.splitlines()
    assert told[0] == "MAVLink in /serial"
    assert told[1].startswith("/serial: ") and told[1].endswith("bytes left out that are no whole frame")
    assert told[2] == "the recording is torn: read up to its end"
    with pytest.raises(UsageError, match=r"a \.tlog has no topics"):
        read_foreign_vehicle(tlog, ("/serial",))
