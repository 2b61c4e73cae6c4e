"""Storage faults: the numbers are the rows of the fault table."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from flip_rig import FlipTest
from loopback_rig import MemorySink, header, make_loop
from mcap.reader import make_reader
from places import ROOT, without_pages
from recording_fakes import Clock, Disk, Item, drop_recorder_notes, flight, record_flight, stored_byte

from logs.recording.disk import DiskFile, OutputFile
from logs.recording.file_scan import Damage, RecordedMessage, scan_file
from logs.recording.info import read_info
from logs.recording.notes import RecorderNote
from logs.recording.reader import find_segments, read, read_kind
from logs.recording.recorder import Recorder, SyncRecorder
from logs.recording.recover import recover
from sim.simulation import World
from uavctl.config import load_config
from uavctl.config.types import LogConfig
from uavctl.errors import RecordingError
from uavctl.records import Event, Record, Severity
from uavctl.wiring.controller import build_design

COUNT = 60
TOOL = ROOT / "tools" / "storage.py"


def fly_to_disk(recorder: SyncRecorder, clock: Clock, items: list[Item]) -> None:
    for topic, at_ns, record in items:
        clock.now_s += 0.1
        recorder.put(topic, at_ns, record)


class FullDisk:
    """A disk that is full from one operation on."""

    def __init__(self, first: int) -> None:
        self.first = first

    def __call__(self, operation: int) -> bool:
        return operation >= self.first


def assert_segments_begin_once(path: Path) -> None:
    """Each file has one header, and one note of why it was begun, however often that was tried."""
    for file in find_segments(path):
        results = [item for item in scan_file(file) if isinstance(item, RecordedMessage)]
        assert [item.definition.topic for item in results].count("/uavctl/header") == 1
        assert results[0].definition.topic == "/uavctl/header"
        assert sum(b"after a failed write" in item.data for item in results) == (file != path)


@pytest.mark.fault(29)
@pytest.mark.parametrize("again_after", [0, 1, 2, 3, 4, 5])
def test_29_disk_full_at_every_operation_loses_nothing(tmp_path: Path, again_after: int) -> None:
    items = flight(COUNT)
    number = 0
    while True:
        path = tmp_path / f"at{number}" / "flight.mcap"
        clock, disk = Clock(), Disk({number, number + again_after}.__contains__)
        recorder = SyncRecorder(path, LogConfig(chunk_bytes=1024), open_file=disk.open, clock=clock)
        fly_to_disk(recorder, clock, items)
        status = recorder.close()
        if disk.operations <= number + again_after:
            break  # every operation has had its turn
        assert drop_recorder_notes(list(read(path))) == items, number
        assert_segments_begin_once(path)
        assert 1 <= status.failures <= 2
        assert "No space left" in status.reason
        assert (status.waiting, status.dropped) == (0, 0)
        assert status.ok  # it came back and nothing is lost
        number += 1
    assert number > 20


@pytest.mark.fault(29)
def test_29_disk_stays_full_then_has_room_again(tmp_path: Path) -> None:
    items = flight(COUNT)
    extra: Item = ("/uavctl/event", 9 * 10**9, Event(at_ns=9 * 10**9, severity=Severity.INFO, code="late", text=""))
    clock, disk = Clock(), Disk()
    fly_to_disk(
        SyncRecorder(tmp_path / "all.mcap", LogConfig(chunk_bytes=1024), open_file=disk.open, clock=clock), clock, items
    )
    for first in range(disk.operations):
        path = tmp_path / f"from{first}" / "flight.mcap"
        clock, full = Clock(), FullDisk(first)
        recorder = SyncRecorder(path, LogConfig(chunk_bytes=1024), open_file=Disk(full).open, clock=clock)
        fly_to_disk(recorder, clock, items)
        on_disk = drop_recorder_notes(list(read(path))) if list(path.parent.iterdir()) else []
        assert on_disk == items[: len(on_disk)]  # all that was written is readable meanwhile
        status = recorder.status()
        assert not status.ok
        assert status.waiting >= len(items) - len(on_disk) > 0
        full.first = sys.maxsize
        clock.now_s += 10.0
        recorder.put(*extra)
        assert recorder.close().ok
        assert drop_recorder_notes(list(read(path))) == [*items, extra]
        assert_segments_begin_once(path)


@pytest.mark.fault(29)
def test_29_queue_is_bounded_while_the_disk_is_full(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    items = flight(COUNT)
    clock, full = Clock(), FullDisk(4)
    recorder = SyncRecorder(path, LogConfig(chunk_bytes=1024, queue=16), open_file=Disk(full).open, clock=clock)
    fly_to_disk(recorder, clock, items)
    status = recorder.status()
    assert status.dropped > 0
    full.first = sys.maxsize
    clock.now_s += 10.0
    final = recorder.close()
    got = drop_recorder_notes(list(read(path)))
    assert len(got) + final.dropped == len(items)
    assert got == [item for item in items if item in got]
    assert list(read_kind(path, RecorderNote))[-1].dropped == final.dropped == read_info(path).dropped


@pytest.mark.fault(29)
def test_29_a_flight_on_a_full_disk_flies_as_without_one(tmp_path: Path) -> None:
    config = load_config("paper", ["duration_s=2.0"])
    design = build_design(config)
    memory, full = MemorySink(), MemorySink()
    recorder = SyncRecorder(tmp_path / "flight.mcap", open_file=Disk(FullDisk(3)).open)

    class Both:
        def put(self, topic: str, at_ns: int, record: Record) -> None:
            full.put(topic, at_ns, record)
            recorder.put(topic, at_ns, record)

    for sink in (memory, Both()):
        sink.put("/uavctl/header", 0, header(config, design))
        World(config, make_loop(config, sink, design)).run(2.0)
    assert not recorder.close().ok
    assert full.entries == memory.entries
    on_disk = drop_recorder_notes(list(read(tmp_path / "flight.mcap")))
    assert on_disk == memory.entries[: len(on_disk)] and on_disk


class SlowDisk:
    """A disk whose writes wait until they are let go."""

    def __init__(self) -> None:
        self.released = threading.Event()
        self.reached = threading.Event()

    def open(self, path: Path) -> OutputFile:
        return _SlowFile(path, self)


class _SlowFile(DiskFile):
    def __init__(self, path: Path, disk: SlowDisk) -> None:
        super().__init__(path)
        self._disk = disk

    def write(self, data: bytes) -> None:
        self._disk.reached.set()
        self._disk.released.wait()
        super().write(data)


@pytest.mark.fault(30)
def test_30_slow_disk_never_holds_up_the_caller(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    items = flight(400)
    disk = SlowDisk()
    recorder = Recorder(path, LogConfig(queue=100), open_file=disk.open)
    recorder.put(*items[0])
    assert disk.reached.wait(30.0)  # the header's chunk hangs
    for topic, at_ns, record in items[1:]:
        recorder.put(topic, at_ns, record)  # returns, or this test never ends
    status = recorder.status()
    assert (status.ok, status.dropped) == (False, 300)
    disk.released.set()
    final = recorder.close(timeout_s=30.0)
    assert (final.waiting, final.dropped) == (0, 300)
    assert drop_recorder_notes(list(read(path))) == items[:101]
    assert read_info(path).dropped == 300


@pytest.mark.slow
@pytest.mark.fault(31)
def test_31_killed_processes_lose_the_open_chunk_at_most() -> None:
    done = subprocess.run(
        [sys.executable, TOOL, "--scenario", "kill", "--runs", "20", "--json"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    document = json.loads(done.stdout)
    assert (document["runs"], document["wrong"]) == (20, {})
    for kind in ("sync", "thread"):
        figures = document[kind]
        assert figures["runs"] == 10 > figures["before_the_first_chunk"]
        assert figures["records_put"] >= figures["records_kept"] > 0


@pytest.mark.slow
@pytest.mark.parametrize(("scenario", "runs"), [("cuts", 2), ("killed-flight", 1)])
@pytest.mark.fault(52)
def test_what_is_left_of_a_flight_replays_alike(scenario: str, runs: int) -> None:
    done = subprocess.run(
        [sys.executable, TOOL, "--scenario", scenario, "--runs", str(runs), "--json"],
        env=without_pages(),
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    document = json.loads(done.stdout)
    assert (document["runs"], document["alike"], document["wrong"]) == (runs, runs, {})


@pytest.mark.fault(31)
def test_31_what_the_disk_lacks_is_at_most_a_second_old(tmp_path: Path) -> None:
    items = flight(300)
    for killed in range(2, 300, 7):
        path = tmp_path / f"{killed}.mcap"
        clock, synced = Clock(), [0]

        class Synced(DiskFile):
            def sync(self, path: Path = path, synced: list[int] = synced) -> None:
                synced[0] = path.stat().st_size

        recorder = SyncRecorder(path, open_file=Synced, clock=clock)
        fly_to_disk(recorder, clock, items[:killed])
        cut = tmp_path / "cut.mcap"
        cut.write_bytes(path.read_bytes()[: synced[0]])  # power fails: nothing else is there
        got = drop_recorder_notes(list(read(cut)))
        assert got == items[: len(got)]
        assert killed - len(got) <= 11  # 0.1 s apart


def flip_byte(data: bytes, position: int, bit: int) -> bytes:
    copy = bytearray(data)
    copy[position] ^= 1 << bit
    return bytes(copy)


def read_records(path: Path) -> tuple[list[Item], bool]:
    """What `read` gives before it ends or refuses, and whether it refused."""
    got: list[Item] = []
    try:
        for item in read(path):
            got.append(item)  # kept when it raises
    except RecordingError as error:
        assert str(path) in str(error)
        return drop_recorder_notes(got), True
    return drop_recorder_notes(got), False


@pytest.mark.slow
@pytest.mark.fault(32)
@pytest.mark.parametrize("finished", [True, False])
def test_32_a_flipped_byte_anywhere_is_never_a_wrong_value(tmp_path: Path, finished: bool) -> None:
    flips = FlipTest(tmp_path, finished=finished)
    refused = 0
    for position in range(len(flips.data)):
        flips.flip(position, 1 << position % 8)
        refused += flips.read()
        if position % 23 == 0:  # tools/storage.py does it at each
            flips.look()
            flips.recover()
    assert refused == len(flips.data) if finished else refused > 1000


@pytest.mark.fault(32)
def test_32_other_chunks_stay_readable(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    record_flight(path, 60)
    whole = [item for item in scan_file(path) if isinstance(item, RecordedMessage)]
    data = path.read_bytes()
    offsets = sorted({item.offset for item in whole})
    assert len(offsets) > 8
    for offset in offsets:
        for position in (offset, offset + 3, offset + 8, offset + 33, offset + 60):
            path.write_bytes(flip_byte(data, position, 4))
            result = list(scan_file(path))
            assert [item for item in result if isinstance(item, RecordedMessage)] == [
                item for item in whole if item.offset != offset
            ]
            assert [(item.offset, item.torn) for item in result if isinstance(item, Damage)] == [(offset, False)]


@pytest.mark.fault(32)
def test_32_damage_between_the_chunks_is_refused_after_all_messages(tmp_path: Path) -> None:
    path, out = tmp_path / "flight.mcap", tmp_path / "out.mcap"
    items = record_flight(path, 30)
    data = path.read_bytes()
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    for chunk in summary.chunk_indexes:
        at = chunk.chunk_start_offset + chunk.chunk_length  # the first index record after it
        for position in (at, at + 1, at + 2, at + 7, at + 12, at + 20):
            path.write_bytes(flip_byte(data, position, 4))
            got, stopped = read_records(path)
            assert stopped
            assert got == items if position >= at + 15 else got == items[: len(got)]
            out.unlink(missing_ok=True)
            result = recover(path, out)
            assert drop_recorder_notes(list(read(out))) == items
            assert result.messages_lost == 0
            # after the last chunk nothing tells whether there was another one
            assert result.lossless or chunk is summary.chunk_indexes[-1]


@pytest.mark.fault(32)
def test_32_damaged_last_chunk_of_an_unfinished_file_is_no_torn_end(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    record_flight(path, 30)
    data = path.read_bytes()
    end = data.rindex(b"\x0f\x04\0\0\0\0\0\0\0")
    path.write_bytes(flip_byte(data[:end], stored_byte(path, b"number 29"), 0))
    got, stopped = read_records(path)
    assert stopped
    assert 0 < len(got) < 31
