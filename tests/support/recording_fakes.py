"""Small recordings, and disks that fail, for the tests of `logs`."""

from __future__ import annotations

import errno
from collections.abc import Callable, Sequence
from io import BytesIO
from pathlib import Path

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Chunk
from mcap.stream_reader import MAGIC_SIZE
from zstandard import ZstdDecompressor

from logs.recording.disk import DiskFile, OutputFile
from logs.recording.recorder import SyncRecorder
from logs.recording.topics import round_plan
from uavctl.config.types import LogConfig
from uavctl.records import Datagram, Event, Header, Plan, Record, Setpoint, SetpointSource, Severity, raw_topic

HEADER = Header(
    started_ns=5,
    started_utc="2026-01-02T03:04:05Z",
    seed=7,
    command="uavctl loopback",
    config_toml='name = "room-hahn-stursberg"\nduration_s = 40.0\n',
    design_id="d1",
    design={"gamma_x": [1.0, 0.5]},
    versions={"uavctl": "0.1"},
    cpu="x86-64",
)
Item = tuple[str, int, Record]


def round_records(items: Sequence[Item]) -> list[Item]:
    """Return records as a recording gives them back: of a plan's matrices it has four digits."""
    return [
        (topic, at_ns, round_plan(record) if isinstance(record, Plan) else record) for topic, at_ns, record in items
    ]


def stored_byte(path: Path, needle: bytes) -> int:
    """Offset of a byte in the middle of the stored content of the first chunk that holds `needle`."""
    data = path.read_bytes()
    return next(begin + length // 2 for begin, length, content in stored_chunks(data) if needle in content)


def stored_chunks(data: bytes) -> list[tuple[int, int, bytes]]:
    """Offset and length of each chunk's stored content, and that content, by the format's own reader."""
    result, at = [], MAGIC_SIZE
    while at + 9 <= len(data) and data[at] != Opcode.DATA_END:
        length = int.from_bytes(data[at + 1 : at + 9], "little")
        if data[at] == Opcode.CHUNK:
            chunk = Chunk.read(ReadDataStream(BytesIO(data[at + 9 : at + 9 + length])))
            content = ZstdDecompressor().decompress(chunk.data) if chunk.compression else chunk.data
            result.append((at + 9 + length - len(chunk.data), len(chunk.data), content))
        at += 9 + length
    return result


def flight(count: int) -> list[Item]:
    """Header and then `count` records of three topics, 10 ms apart, no two alike."""
    items: list[Item] = [("/uavctl/header", 5, HEADER)]
    for index in range(count):
        at_ns = 1_000_000_000 + index * 10_000_000
        kind = index % 3
        if kind == 0:
            data = index.to_bytes(4, "big") * 10
            raw = Datagram(at_ns=at_ns, link="vehicle", outgoing=index % 2 == 0, data=data)
            items.append((raw_topic("vehicle", outgoing=raw.outgoing), at_ns, raw))
        elif kind == 1:
            accel = (index / 3, -0.0, 1e-300 * index)
            items.append(
                ("/uavctl/setpoint", at_ns, Setpoint(at_ns=at_ns, accel_mps2=accel, source=SetpointSource.PLAN))
            )
        else:
            text = f"number {index}"
            items.append(("/uavctl/event", at_ns, Event(at_ns=at_ns, severity=Severity.INFO, code="count", text=text)))
    return items


def drop_recorder_notes(items: list[Item]) -> list[Item]:
    """Without the recorder's own notes."""
    return [item for item in items if item[0] != "/uavctl/recorder"]


class Clock:
    """Wall time that goes on by `step_s` each time it is asked."""

    def __init__(self, step_s: float = 0.0) -> None:
        self.now_s = 0.0
        self.step_s = step_s

    def __call__(self) -> float:
        self.now_s += self.step_s
        return self.now_s


class Disk:
    """Opens files whose operations (open, write, truncate, sync, close) fail where `fails` says so.

    `fails(number)` is asked once an operation; the numbers run over all files. A failing write
    leaves a part of its bytes behind, as a full disk does.
    """

    def __init__(self, fails: Callable[[int], bool] = lambda _: False) -> None:
        self._fails = fails
        self.operations = 0

    def open(self, path: Path) -> OutputFile:
        self.check()
        return _File(self, DiskFile(path))

    def check(self) -> None:
        self.operations += 1
        if self._fails(self.operations - 1):
            raise OSError(errno.ENOSPC, "No space left on device")


class _File:
    def __init__(self, disk: Disk, file: DiskFile) -> None:
        self._disk = disk
        self._file = file

    def write(self, data: bytes) -> None:
        try:
            self._disk.check()
        except OSError:
            self._file.write(data[: len(data) // 3])
            raise
        self._file.write(data)

    def truncate(self, size: int) -> None:
        self._disk.check()
        self._file.truncate(size)

    def sync(self) -> None:
        self._disk.check()

    def close(self) -> None:
        self._file.close()
        self._disk.check()


def record_flight(path: Path, count: int, chunk_bytes: int = 1024) -> list[Item]:
    """A finished recording of `flight(count)`; returns what was put."""
    items = flight(count)
    recorder = SyncRecorder(path, LogConfig(chunk_bytes=chunk_bytes), clock=Clock())
    for topic, at_ns, record in items:
        recorder.put(topic, at_ns, record)
    status = recorder.close()
    assert status.ok
    return items


def write_two_segments(path: Path) -> None:
    """`flight(100)` on a disk whose seventh operation fails: the second file begins in the middle."""
    clock = Clock()
    recorder = SyncRecorder(
        path, LogConfig(chunk_bytes=1024), open_file=Disk(lambda number: number == 6).open, clock=clock
    )
    for topic, at_ns, record in flight(100):
        clock.now_s += 0.1
        recorder.put(topic, at_ns, record)
    recorder.close()
