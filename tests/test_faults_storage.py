"""Storage faults: the numbers are the rows of the fault table."""

from __future__ import annotations

import random
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from mcap.reader import make_reader
from recording_fakes import Clock, Disk, Item, flight, own, record_flight

from logs.chunks import Damage, Message, scan
from logs.disk import DiskFile, OutputFile
from logs.encoding import encode
from logs.info import info
from logs.reader import read, records, segment_files
from logs.recorder import Recorder, SyncRecorder
from logs.recover import recover
from logs.topics import RecorderNote
from uavctl.data import Event, Severity
from uavctl.errors import RecordingError

COUNT = 60


def fly(recorder: SyncRecorder, clock: Clock, items: list[Item]) -> None:
    for topic, at_ns, record in items:
        clock.now_s += 0.1
        recorder.put(topic, at_ns, record)


class FullFrom:
    """A disk that is full from one operation on."""

    def __init__(self, first: int) -> None:
        self.first = first

    def __call__(self, operation: int) -> bool:
        return operation >= self.first


def assert_segments_begin_once(path: Path) -> None:
    """Each file has one header, and one note of why it was begun, however often that was tried."""
    for file in segment_files(path):
        found = [item for item in scan(file) if isinstance(item, Message)]
        assert [item.definition.topic for item in found].count("/uavctl/header") == 1
        assert found[0].definition.topic == "/uavctl/header"
        assert sum(b"after a failed write" in item.data for item in found) == (file != path)


@pytest.mark.parametrize("again_after", [0, 1, 2, 3, 4, 5])
def test_29_disk_full_at_every_operation_loses_nothing(tmp_path: Path, again_after: int) -> None:
    items = flight(COUNT)
    number = 0
    while True:
        path = tmp_path / f"at{number}" / "flight.mcap"
        clock, disk = Clock(), Disk({number, number + again_after}.__contains__)
        recorder = SyncRecorder(path, 1024, open_file=disk.open, clock=clock)
        fly(recorder, clock, items)
        status = recorder.close()
        if disk.operations <= number + again_after:
            break  # every operation has had its turn
        assert own(list(read(path))) == items, number
        assert_segments_begin_once(path)
        assert 1 <= status.failures <= 2
        assert "No space left" in status.reason
        assert (status.waiting, status.dropped) == (0, 0)
        assert status.ok  # it came back and nothing is lost
        number += 1
    assert number > 20


def test_29_disk_stays_full_then_has_room_again(tmp_path: Path) -> None:
    items = flight(COUNT)
    extra: Item = ("/uavctl/event", 9 * 10**9, Event(at_ns=9 * 10**9, severity=Severity.INFO, code="late", text=""))
    clock, disk = Clock(), Disk()
    fly(SyncRecorder(tmp_path / "all.mcap", 1024, open_file=disk.open, clock=clock), clock, items)
    for first in range(disk.operations):
        path = tmp_path / f"from{first}" / "flight.mcap"
        clock, full = Clock(), FullFrom(first)
        recorder = SyncRecorder(path, 1024, open_file=Disk(full).open, clock=clock)
        fly(recorder, clock, items)
        on_disk = own(list(read(path))) if list(path.parent.iterdir()) else []
        assert on_disk == items[: len(on_disk)]  # all that was written is readable meanwhile
        status = recorder.status()
        assert not status.ok
        assert status.waiting >= len(items) - len(on_disk) > 0
        full.first = sys.maxsize
        clock.now_s += 10.0
        recorder.put(*extra)
        assert recorder.close().ok
        assert own(list(read(path))) == [*items, extra]
        assert_segments_begin_once(path)


def test_29_queue_is_bounded_while_the_disk_is_full(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    items = flight(COUNT)
    clock, full = Clock(), FullFrom(4)
    recorder = SyncRecorder(path, 1024, queue=16, open_file=Disk(full).open, clock=clock)
    fly(recorder, clock, items)
    status = recorder.status()
    assert status.dropped > 0
    full.first = sys.maxsize
    clock.now_s += 10.0
    final = recorder.close()
    got = own(list(read(path)))
    assert len(got) + final.dropped == len(items)
    assert got == [item for item in items if item in got]
    assert list(records(path, RecorderNote))[-1].dropped == final.dropped == info(path).dropped


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


def test_30_slow_disk_never_holds_up_the_caller(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    items = flight(400)
    disk = SlowDisk()
    recorder = Recorder(path, queue=100, open_file=disk.open)
    recorder.put(*items[0])
    assert disk.reached.wait(30.0)  # the header's chunk hangs
    for topic, at_ns, record in items[1:]:
        recorder.put(topic, at_ns, record)  # returns, or this test never ends
    status = recorder.status()
    assert (status.ok, status.dropped) == (False, 300)
    disk.released.set()
    final = recorder.close(timeout_s=30.0)
    assert (final.waiting, final.dropped) == (0, 300)
    assert own(list(read(path))) == items[:101]
    assert info(path).dropped == 300


CHILD = """
import sys, threading
from pathlib import Path
sys.path.insert(0, sys.argv[3])
from recording_fakes import Clock, flight
from logs.recorder import Recorder, SyncRecorder
kind, path = sys.argv[1], Path(sys.argv[2])
clock = Clock()
pause = threading.Event()
recorder = {
    "full chunks": lambda: SyncRecorder(path, clock=Clock()),
    "every second": lambda: SyncRecorder(path, clock=clock),
    "thread": lambda: Recorder(path),
}[kind]()
for topic, at_ns, record in flight(20000):
    clock.now_s += 0.1 if kind == "every second" else 0.0
    recorder.put(topic, at_ns, record)
    while kind == "thread" and not recorder.status().written:
        pause.wait(0.001)  # the first record begins the flight
    if kind == "thread":
        pause.wait(0.001)
    sys.stdout.buffer.write(b".")
    sys.stdout.buffer.flush()
"""


def killed_recording(path: Path, kind: str, after: int) -> int:
    """Kill -9 a recording process once it has put `after` records; returns how many it put in all."""
    here = Path(__file__).parent
    command = [sys.executable, "-c", CHILD, kind, str(path), str(here)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, cwd=here.parent) as child:
        assert child.stdout is not None
        put = len(child.stdout.read(after))
        child.send_signal(signal.SIGKILL)
        put += len(child.stdout.read())
    assert child.returncode == -signal.SIGKILL
    return put


@pytest.mark.parametrize("kind", ["full chunks", "every second", "thread"])
def test_31_killed_process_loses_the_open_chunk_at_most(tmp_path: Path, kind: str) -> None:
    rng = random.Random(31)
    items = flight(20000)
    for number in range(7):
        path, out = tmp_path / f"{number}.mcap", tmp_path / f"{number}-out.mcap"
        put = killed_recording(path, kind, rng.randrange(1, 300))
        result = recover(path, out)
        got = own(list(read(out)))
        assert got == items[: len(got)]
        assert got == own(list(read(path)))  # readable as it is, too
        assert not result.finished
        lost = items[len(got) : put]
        lost_bytes = sum(len(encode(record)) + 31 for _, _, record in lost)
        # in a thread, what came since it last looked (20 ms) waits before the open chunk
        assert lost_bytes <= 16384 * (2 if kind == "thread" else 1)
        if kind == "every second":
            assert len(lost) <= 11  # 0.1 s apart; one may have been put and not yet counted


def flipped(data: bytes, position: int, bit: int) -> bytes:
    copy = bytearray(data)
    copy[position] ^= 1 << bit
    return bytes(copy)


def readable(path: Path) -> tuple[list[Item], bool]:
    """What `read` gives before it ends or refuses, and whether it refused."""
    got: list[Item] = []
    try:
        for item in read(path):
            got.append(item)  # kept when it raises
    except RecordingError as error:
        assert str(path) in str(error)
        return own(got), True
    return own(got), False


def largest_chunk(path: Path) -> int:
    """Most messages in one chunk."""
    offsets = [item.offset for item in scan(path) if isinstance(item, Message)]
    return max(offsets.count(one) for one in set(offsets))


@pytest.mark.parametrize("finished", [True, False])
def test_32_flipped_bit_is_never_a_wrong_value(tmp_path: Path, finished: bool) -> None:
    path, out = tmp_path / "flight.mcap", tmp_path / "out.mcap"
    items = record_flight(path, 30)
    most = largest_chunk(path)
    data = path.read_bytes()
    if not finished:  # as a killed process leaves it: no end of data, no index
        data = data[: data.rindex(b"\x0f\x04\0\0\0\0\0\0\0")]
    rng = random.Random(32)
    refused = 0
    for count, position in enumerate(rng.sample(range(len(data)), 3000)):
        path.write_bytes(flipped(data, position, count % 8))
        got, stopped = readable(path)
        refused += stopped
        assert got == items[: len(got)]
        assert stopped or len(got) == len(items) or (not finished and len(items) - len(got) <= most)
        if count % 5 == 0:
            out.unlink(missing_ok=True)
            result = recover(path, out)
            kept = own(list(read(out)))
            assert kept == [item for item in items if item in kept]
            assert len(items) - len(kept) <= most
            assert len(kept) == len(items) or not result.lossless
    assert refused > 1000


def test_32_other_chunks_stay_readable(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    record_flight(path, 60)
    whole = [item for item in scan(path) if isinstance(item, Message)]
    data = path.read_bytes()
    offsets = sorted({item.offset for item in whole})
    assert len(offsets) > 8
    for offset in offsets:
        for position in (offset, offset + 3, offset + 8, offset + 33, offset + 60):
            path.write_bytes(flipped(data, position, 4))
            found = list(scan(path))
            assert [item for item in found if isinstance(item, Message)] == [
                item for item in whole if item.offset != offset
            ]
            assert [(item.offset, item.torn) for item in found if isinstance(item, Damage)] == [(offset, False)]


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
            path.write_bytes(flipped(data, position, 4))
            got, stopped = readable(path)
            assert stopped
            assert got == items if position >= at + 15 else got == items[: len(got)]
            out.unlink(missing_ok=True)
            result = recover(path, out)
            assert own(list(read(out))) == items
            assert result.messages_lost == 0
            # after the last chunk nothing tells whether there was another one
            assert result.lossless or chunk is summary.chunk_indexes[-1]


def test_32_damaged_last_chunk_of_an_unfinished_file_is_no_torn_end(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    record_flight(path, 30)
    data = path.read_bytes()
    end = data.rindex(b"\x0f\x04\0\0\0\0\0\0\0")
    path.write_bytes(flipped(data[:end], data.rindex(b"number 29", 0, end), 0))
    got, stopped = readable(path)
    assert stopped
    assert 0 < len(got) < 31
