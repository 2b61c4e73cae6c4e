"""Long recordings: files by size, memory that stays flat, and the watch over the disk's room."""

from __future__ import annotations

import re
import tracemalloc
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
import pytest
from foxglove_schemas_protobuf.Log_pb2 import Log
from loopback_rig import header as made_header
from mcap.reader import make_reader
from recording_fakes import HEADER, Clock, Disk, Item, drop_recorder_notes, flight

from logs.recording.derived_topics import LOG
from logs.recording.disk import DiskFile
from logs.recording.file_kind import MAGIC
from logs.recording.info import read_info
from logs.recording.notes import RecorderNote
from logs.recording.reader import find_segments, read, read_header, read_kind
from logs.recording.recorder import DerivedTopics, SyncRecorder
from logs.recording.recover import recover
from logs.recording.segment import QueuedMessage, Segment
from logs.recording.topics import get_definition
from logs.recording.views import ViewBuilder
from uavctl.config import load_config
from uavctl.config.types import LogConfig
from uavctl.errors import RecordingError
from uavctl.records import Header
from uavctl.wiring.controller import build_design

SMALL = LogConfig(chunk_bytes=1024, segment_bytes=3000)
LOW = 3000


def fly(recorder: SyncRecorder, clock: Clock, items: list[Item]) -> None:
    for item in items:
        clock.now_s += 0.1
        recorder.put(*item)


def texts(path: Path) -> list[str]:
    return [note.text for note in read_kind(path, RecorderNote)]


def test_a_file_of_its_size_is_closed_and_the_next_one_goes_on(tmp_path: Path) -> None:
    path, out = tmp_path / "flight.mcap", tmp_path / "out.mcap"
    items = flight(300)
    clock = Clock()
    recorder = SyncRecorder(path, SMALL, clock=clock)
    fly(recorder, clock, items)
    status = recorder.close()
    files = find_segments(path)
    assert status.ok and (status.failures, status.reason) == (0, "")
    assert status.segments == tuple(map(str, files)) and len(files) > 4
    assert drop_recorder_notes(list(read(path))) == items
    for file in files:
        with file.open("rb") as stream:  # closed in order: the format's own reader has its index
            reader = make_reader(stream, validate_crcs=True)
            summary = reader.get_summary()
            count = sum(1 for _ in reader.iter_messages())
        assert summary is not None and summary.statistics is not None
        assert summary.statistics.message_count == count
        assert read_header(file) == HEADER
        attached = sum(one.length for one in summary.attachment_indexes)
        attached += sum(one.length for one in summary.metadata_indexes)
        # a chunk over its size, and the index
        assert file == files[-1] or 6000 < file.stat().st_size - attached < 6000 + 1024 + 6000
    assert texts(path) == [
        "begin",
        *(
            "continues in the next file" if end else f"continues after {files[i].name}"
            for i in range(len(files) - 1)
            for end in (True, False)
        ),
        "end",
    ]
    assert recover(path, out).lossless
    assert drop_recorder_notes(list(read(out))) == items
    found = read_info(path)
    assert [one.file for one in found.segments] == list(found.files)
    assert sum(one.messages for one in found.segments) == status.written
    assert all(one.finished for one in found.segments)


@pytest.mark.fault(93)
@pytest.mark.parametrize("data", [b"", b"a note of somebody's", MAGIC])
def test_93_a_name_that_somebody_has_taken_is_passed_over_without_a_loss(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "flight.mcap"
    foreign_files = [path.with_name(f"flight-{number}.mcap") for number in (2, 3, 5)]
    items = flight(300)
    clock = Clock()
    recorder = SyncRecorder(path, SMALL, clock=clock)
    for file in foreign_files:
        file.write_bytes(data)
    fly(recorder, clock, items)
    status = recorder.close()
    assert status.ok and status.dropped == 0
    assert {path.with_name(f"flight-{number}.mcap") for number in (4, 6)} <= set(find_segments(path))
    assert not set(foreign_files) & set(find_segments(path))
    assert drop_recorder_notes(list(read(path))) == items
    assert [file.read_bytes() for file in foreign_files] == [data] * 3


@pytest.mark.fault(93)
def test_93_a_file_that_somebody_adds_to_a_whole_recording_is_no_part_of_it(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    items = flight(20)
    clock = Clock()
    recorder = SyncRecorder(path, clock=clock)
    fly(recorder, clock, items)
    recorder.close()
    path.with_name("flight-2.mcap").touch()
    assert find_segments(path) == (path,) and drop_recorder_notes(list(read(path))) == items


def test_each_file_is_on_the_disk_before_the_next_is_begun(tmp_path: Path) -> None:
    class Watched(DiskFile):
        def __init__(self, path: Path) -> None:
            super().__init__(path)
            done.append(f"open {path.name}")
            self._name = path.name

        def sync(self) -> None:
            super().sync()
            done.append(f"sync {self._name}")

        def close(self) -> None:
            super().close()
            done.append(f"close {self._name}")

    done: list[str] = []
    recorder = SyncRecorder(tmp_path / "a.mcap", SMALL, open_file=Watched, clock=Clock())
    for item in flight(100):
        recorder.put(*item)
    recorder.close()
    names = [f"a{end}.mcap" for end in ("", "-2", "-3")]
    assert done[: 3 * len(names)] == [f"{word} {name}" for name in names for word in ("open", "sync", "close")]


@pytest.mark.fault(29)
def test_29_disk_full_at_every_operation_loses_nothing_when_files_change(tmp_path: Path) -> None:
    items = flight(80)
    number = 0
    while True:
        path = tmp_path / f"at{number}" / "flight.mcap"
        clock, disk = Clock(), Disk({number}.__contains__)
        recorder = SyncRecorder(path, SMALL, open_file=disk.open, clock=clock)
        fly(recorder, clock, items)
        status = recorder.close()
        if disk.operations <= number:
            break
        assert drop_recorder_notes(list(read(path))) == items, number
        assert status.ok and status.failures == 1
        number += 1
    assert number > 30


def test_what_every_file_repeats_does_not_count_to_its_size(tmp_path: Path) -> None:
    # Else a header larger than a file would make each record a file of its own.
    path = tmp_path / "flight.mcap"
    noise = np.random.default_rng(1).bytes(20_000).hex()  # which hardly can be compressed
    (topic, at_ns, header), *rest = flight(100)
    assert isinstance(header, Header)
    items = [(topic, at_ns, msgspec.structs.replace(header, config_toml=f'name = "{noise}"')), *rest]
    recorder = SyncRecorder(path, SMALL, clock=Clock())
    for item in items:
        recorder.put(*item)
    recorder.close()
    assert drop_recorder_notes(list(read(path))) == items
    assert 2 <= len(find_segments(path)) < len(items) // 5


@pytest.mark.slow
def test_memory_does_not_grow_with_the_length_of_a_flight(tmp_path: Path) -> None:
    clock = Clock()
    recorder = SyncRecorder(tmp_path / "flight.mcap", LogConfig(chunk_bytes=1024, segment_bytes=30_000), clock=clock)
    record = flight(2)[2]

    def put(count: int) -> None:
        for _ in range(count):
            recorder.put(*record)

    put(3000)  # several files
    tracemalloc.start()
    try:
        put(300)
        before, _ = tracemalloc.get_traced_memory()
        tracemalloc.reset_peak()
        put(9000)
        after, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    files = len(recorder.close().segments)
    assert files > 20
    assert after - before < 40_000  # a file's name and what its index takes, not its chunks
    assert peak - before < 200_000


def test_an_index_takes_few_bytes_of_memory(tmp_path: Path) -> None:
    segment = Segment(DiskFile(tmp_path / "a.mcap"), 1024)
    kinds = [get_definition(f"/raw/{name}/in") for name in ("a", "b", "c", "d")]
    tracemalloc.start()
    try:
        for number in range(4000):
            segment.add(QueuedMessage(kinds[number % 4], number + 1, number, bytes(400)))
        grown, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    segment.finish()
    with (tmp_path / "a.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert grown / len(summary.chunk_indexes) < 250  # and not a kilobyte of objects


@dataclass
class Room:
    """A disk whose free space is told."""

    free: int | None = 10_000

    def __call__(self, folder: Path) -> int | None:
        return self.free


def test_a_low_disk_is_a_warning_until_it_has_room_again(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    items = flight(60)
    room, clock = Room(), Clock()
    recorder = SyncRecorder(path, LogConfig(low_bytes=LOW), free=room, clock=clock)
    warnings = []
    for number, room.free in enumerate((3000, 2999, None, 3000)):
        fly(recorder, clock, items[15 * number : 15 * (number + 1)])
        assert recorder.status().ok
        warnings.append(recorder.status().warning.partition(" in ")[0])
    assert warnings == ["", "2999 bytes free", "2999 bytes free", ""]
    fly(recorder, clock, items[60:])
    assert recorder.close().ok and drop_recorder_notes(list(read(path))) == items
    notes = [one.text.partition(" in ")[0] for one in read_info(path).notes]
    assert notes == ["disk gets low: 2999 bytes free", "disk has room again: 3000 bytes free"]


@pytest.mark.fault(29)
def test_29_viewers_are_told_that_the_disk_gets_low(tmp_path: Path) -> None:
    seen: list[tuple[str, bytes]] = []
    room, clock = Room(), Clock()
    looking = DerivedTopics(ViewBuilder(), lambda topic, _, data: seen.append((topic, data)))
    log = LogConfig(low_bytes=LOW)
    recorder = SyncRecorder(tmp_path / "flight.mcap", log, free=room, clock=clock, derived_topics=looking)
    loaded = load_config("room-hahn-stursberg")
    recorder.put("/uavctl/header", 0, made_header(loaded, build_design(loaded)))
    fly(recorder, clock, flight(20)[1:])
    room.free = 2000
    fly(recorder, clock, flight(20)[1:])
    assert recorder.close().ok
    lines = [Log.FromString(data) for topic, data in seen if topic == LOG]
    assert [line.level for line in lines if "disk gets low: 2000 bytes free" in line.message] == [Log.WARNING]


@pytest.mark.slow
@pytest.mark.fault(32)
def test_32_a_flipped_byte_in_a_later_file_is_refused_or_restored(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    items = flight(120)
    recorder = SyncRecorder(path, SMALL, clock=Clock())
    for item in items:
        recorder.put(*item)
    recorder.close()
    files = find_segments(path)
    assert len(files) > 2
    for file in (files[1], files[-1]):  # each with the header again, an index and a footer
        data = file.read_bytes()
        for position in range(0, len(data), 101):
            file.write_bytes(data[:position] + bytes([data[position] ^ 1 << position % 8]) + data[position + 1 :])
            with pytest.raises(RecordingError, match=re.escape(file.name)):
                list(read(path))
            restored = tmp_path / "restored.mcap"
            result = recover(path, restored)
            left = drop_recorder_notes(list(read(restored)))
            restored.unlink()
            assert left == [item for item in items if item in left], position
            # The chunk with the repeated header has a note of the recorder too, which may be all that is lost.
            assert result.damage and (left == items or not result.lossless), position
        file.write_bytes(data)
    assert drop_recorder_notes(list(read(path))) == items
