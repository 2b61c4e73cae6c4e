from __future__ import annotations

import errno
import struct
from contextlib import nullcontext
from inspect import signature
from pathlib import Path
from typing import Any

import pytest
from mcap.data_stream import RecordBuilder
from mcap.reader import NonSeekingReader, make_reader
from mcap.records import Chunk, Message
from mcap.stream_reader import StreamReader, breakup_chunk
from recording_fakes import record_flight, stored_chunks

from logs.recording.disk import DiskFile, check_free_space, find_later_segments, make_segment_path
from logs.recording.file_scan import Damage, EndOfFile, RecordedMessage, scan_file
from logs.recording.segment import QueuedMessage, Segment
from logs.recording.topics import get_definition
from uavctl.errors import RecordingError


def chunks(path: Path) -> list[Chunk]:
    with path.open("rb") as file:
        reader = StreamReader(file, emit_chunks=True, validate_crcs=True)
        return [record for record in reader.records if isinstance(record, Chunk)]


def test_the_format_s_own_readers_take_it(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    count = len(record_flight(path, 100))
    with path.open("rb") as file:
        seeking = make_reader(file, validate_crcs=True)
        summary = seeking.get_summary()
        by_time = [(channel.topic, message.log_time, message.data) for _, channel, message in seeking.iter_messages()]
        begin = "starting_at" if "starting_at" in signature(seeking.iter_messages).parameters else "start_time"  # < 1.6
        since: dict[str, Any] = {begin: 1_500_000_000}
        some = list(seeking.iter_messages(topics=["/uavctl/setpoint"], **since))
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == len(by_time) == count + 2  # and two notes
    assert summary.statistics.chunk_count == len(summary.chunk_indexes) == len(chunks(path)) > 5
    assert len(some) == 16
    assert all(schema is not None and schema.encoding == "jsonschema" for schema, _, _ in some)
    with path.open("rb") as file:
        stream = NonSeekingReader(file, validate_crcs=True).iter_messages(log_time_order=False)
        in_order = [(channel.topic, message.log_time, message.data) for _, channel, message in stream]
    assert sorted(in_order, key=lambda one: one[1]) == by_time


def test_index_points_at_the_messages(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    record_flight(path, 60)
    data = path.read_bytes()
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    # By the start of the chunk: opcode, length, and 32 bytes of fields, then the compression and the stored size.
    contents = {begin - 9 - 32 - len("zstd") - 8: content for begin, _, content in stored_chunks(data)}
    seen = 0
    for index in summary.chunk_indexes:
        content = contents[index.chunk_start_offset]
        for channel, at in index.message_index_offsets.items():
            opcode, _, named, size = struct.unpack_from("<BQHI", data, at)
            assert (opcode, named) == (7, channel)
            for log_time, offset in struct.iter_unpack("<QQ", data[at + 15 : at + 15 + size]):
                opcode, _, owner, _, message_time = struct.unpack_from("<BQHIQ", content, offset)
                assert (opcode, owner, message_time) == (5, channel, log_time)
                seen += 1
    assert seen == 63


def test_a_chunk_and_its_index_are_what_the_format_s_own_records_write(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    record_flight(path, 300, chunk_bytes=2048)
    data, found = path.read_bytes(), chunks(path)
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None and len(summary.chunk_indexes) == len(found) > 10
    for chunk, index in zip(found, summary.chunk_indexes, strict=True):
        written, place = RecordBuilder(), index.chunk_start_offset
        chunk.write(written)
        assert written.end() == data[place : place + index.chunk_length]  # type: ignore[no-untyped-call]
        index.write(written)
        assert written.end() in data  # type: ignore[no-untyped-call]


def test_chunks_stay_within_their_size(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    record_flight(path, 300, chunk_bytes=2048)
    found = chunks(path)
    sizes = [chunk.uncompressed_size for chunk in found]
    assert max(sizes) <= 2048
    assert min(sizes[1:-1]) > 1024  # the first has the header and goes out at once
    for chunk in found:  # a chunk is read without any other
        named = {
            record.id for record in breakup_chunk(chunk) if not isinstance(record, Message) and hasattr(record, "id")
        }
        assert {record.channel_id for record in breakup_chunk(chunk) if isinstance(record, Message)} <= named


def test_message_larger_than_a_chunk_has_its_own(tmp_path: Path) -> None:
    path = tmp_path / "big.mcap"
    segment = Segment(DiskFile(path), 1024)
    for number, size in enumerate((10, 5000, 10, 10), 1):
        segment.add(QueuedMessage(get_definition("/raw/vehicle/in"), number, number, bytes(size)))
    segment.finish()
    counts = [sum(isinstance(record, Message) for record in breakup_chunk(chunk)) for chunk in chunks(path)]
    assert counts == [1, 1, 2]


def test_empty_segment_is_a_valid_file(tmp_path: Path) -> None:
    path = tmp_path / "empty.mcap"
    Segment(DiskFile(path), 1024).finish()
    with path.open("rb") as file:
        assert list(make_reader(file, validate_crcs=True).iter_messages()) == []


class LimitedFile(DiskFile):
    """A file that may not grow beyond a size."""

    limit = 10**9
    size = 0

    def write(self, data: bytes) -> None:
        room = self.limit - self.size
        self.size += min(room, len(data))
        super().write(data[:room])
        if room < len(data):
            raise OSError(errno.EFBIG, "File too large")

    def truncate(self, size: int) -> None:
        super().truncate(size)
        self.size = size


@pytest.mark.fault(29)
@pytest.mark.parametrize("room", [60, 49, 0])
def test_a_file_without_room_for_its_index_is_closed_if_a_few_bytes_fit(room: int, tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    file = LimitedFile(path)
    segment = Segment(file, 1024)
    messages = [QueuedMessage(get_definition("/raw/vehicle/in"), number, number, bytes(99)) for number in range(1, 9)]
    for message in messages[:5]:
        segment.add(message)
    segment.commit()
    file.limit = segment.bytes + room
    for message in messages[5:]:
        segment.add(message)
    with pytest.raises(OSError, match="too large"):
        segment.finish()
    is_closed = room >= 50
    with nullcontext() if is_closed else pytest.raises(OSError, match="too large"):
        segment.abandon()
    items = list(scan_file(path))
    assert [item.sequence for item in items if isinstance(item, RecordedMessage)] == [1, 2, 3, 4, 5]
    assert [item.finished for item in items if isinstance(item, EndOfFile)] == [is_closed]
    assert not any(isinstance(item, Damage) for item in items)  # whole chunks only
    if is_closed:
        with path.open("rb") as opened:
            assert len(list(NonSeekingReader(opened, validate_crcs=True).iter_messages())) == 5


def test_never_overwrites(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    path.write_bytes(b"precious")
    with pytest.raises(FileExistsError):
        DiskFile(path)
    assert path.read_bytes() == b"precious"


def test_segment_names_in_numeric_order(tmp_path: Path) -> None:
    path = tmp_path / "a.b[1].mcap"
    for number in (1, 2, 3, 10, 11):
        make_segment_path(path, number).touch()
    for other in ("a.b[1]-1.mcap", "a.b[1]-02.mcap", "a.b[1]-x.mcap", "xa.b[1]-2.mcap", "a.b[1]-2.mcap.bak"):
        (tmp_path / other).touch()
    assert [one.name for one in find_later_segments(path)] == [f"a.b[1]-{number}.mcap" for number in (2, 3, 10, 11)]


@pytest.mark.fault(29)
def test_room_is_checked_before_a_flight(tmp_path: Path) -> None:
    path = tmp_path / "new" / "flight.mcap"
    assert check_free_space(path, 0) > 0
    with pytest.raises(RecordingError, match=r"bytes free, log\.free_bytes asks for"):
        check_free_space(path, 2**62)
    (tmp_path / "file").touch()
    with pytest.raises(RecordingError, match="choose another folder"):
        check_free_space(tmp_path / "file" / "flight.mcap", 0)
