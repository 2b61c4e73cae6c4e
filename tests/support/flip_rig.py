"""One flipped byte in a small recording: the permitted results of its readers."""

from __future__ import annotations

import contextlib
from collections import Counter
from pathlib import Path
from unittest import mock

import msgspec
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from recording_fakes import HEADER, Clock, Item, drop_recorder_notes, flight

from logs.recording.file_scan import RecordedMessage, scan_file
from logs.recording.info import RecordingInfo, read_info
from logs.recording.reader import read, read_header
from logs.recording.recorder import SyncRecorder
from logs.recording.recover import recover
from logs.recording.topics import get_definition
from uavctl.config.types import LogConfig
from uavctl.errors import RecordingError

DATA_END = b"\x0f\x04\0\0\0\0\0\0\0"


class FlipTest:
    """A small recording whose bytes are flipped one by one; each method raises AssertionError where a reader errs.

    Args:
        folder: for files.
        finished: with end of data, index and footer; else as a killed process leaves it.

    Attributes:
        data: The undamaged file.
    """

    def __init__(self, folder: Path, *, finished: bool) -> None:
        self._path, self._out = folder / "flight.mcap", folder / "out.mcap"
        self._finished = finished
        self._items: list[Item] = [item for item in flight(15) if item[0] != "/uavctl/setpoint"]
        # A layout of many bytes that all are of one attachment would make most of the file.
        with mock.patch("logs.recording.attachments.make_layout_text", lambda: '{"layout": 0}'):
            recorder = SyncRecorder(self._path, LogConfig(chunk_bytes=1024), clock=Clock())
            for item in self._items:
                recorder.put(*item)
            recorder.close()
        self.data = self._path.read_bytes()
        if not finished:
            self.data = self.data[: self.data.rindex(DATA_END)]
            self._path.write_bytes(self.data)
        offsets = [item.offset for item in scan_file(self._path) if isinstance(item, RecordedMessage)]
        self._most = max(Counter(offsets).values())  # messages in one chunk
        self._info = read_info(self._path)
        assert drop_recorder_notes(list(read(self._path))) == self._items and len(set(offsets)) > 3

    def flip(self, position: int, mask: int) -> None:
        """Write the recording with one byte changed."""
        data = bytearray(self.data)
        data[position] ^= mask
        self._path.write_bytes(data)

    def read(self) -> bool:
        """Read: the truth up to a refusal, which is returned; a finished file is always refused."""
        got: list[Item] = []
        refused = False
        try:
            for item in read(self._path):
                got.append(item)  # kept when it raises
        except RecordingError as error:
            assert str(self._path) in str(error)
            refused = True
        got = drop_recorder_notes(got)
        assert got == self._items[: len(got)]
        if self._finished:
            assert refused
        elif not refused:  # it ends too early, or what was hit says nothing
            assert len(self._items) - len(got) <= self._most
        return refused

    def look(self) -> None:
        """Header and info: the truth, or nothing, and damage is told."""
        with contextlib.suppress(RecordingError):
            assert read_header(self._path) == HEADER
        result = read_info(self._path)
        assert result.origin in (self._info.origin, None)
        assert result.start_ns >= self._info.start_ns and result.end_ns <= self._info.end_ns
        if self._finished:
            assert result.damage
        lost = set(self._info.attachments) - set(result.attachments)
        assert set(result.attachments) <= set(self._info.attachments) and (result.damage or not lost)
        if result.messages == self._info.messages:
            assert _without_state(result) == _without_state(self._info)
        else:
            assert result.damage and self._info.messages - result.messages <= self._most

    def recover(self) -> None:
        """Recover: all but one chunk, losses told, and a file that is right in every part."""
        self._out.unlink(missing_ok=True)
        result = recover(self._path, self._out)
        entries = list(read(self._out))
        kept = drop_recorder_notes(entries)
        assert kept == [item for item in self._items if item in kept]
        assert len(self._items) - len(kept) <= self._most
        assert len(kept) == len(self._items) or not result.lossless
        assert bool(result.damage) or not self._finished
        _check_parts(self._out, entries)


def _without_state(result: RecordingInfo) -> RecordingInfo:
    segments = tuple(msgspec.structs.replace(segment, finished=False) for segment in result.segments)
    return msgspec.structs.replace(result, finished=False, damage=(), segments=segments, attachments=())


def _check_parts(path: Path, entries: list[Item]) -> None:
    """Statistics, channels, schemas and index of a file, by the format's own readers, are those of its messages."""
    with path.open("rb") as file:
        linear = [
            record for record in StreamReader(file, validate_crcs=True).records if type(record).__name__ == "Message"
        ]
        file.seek(0)
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        indexed = list(reader.iter_messages(log_time_order=False))
    assert summary is not None and summary.statistics is not None
    statistics = summary.statistics
    times = [at_ns for _, at_ns, _ in entries]
    assert statistics.message_count == len(linear) == len(indexed) == len(entries)
    assert (statistics.message_start_time, statistics.message_end_time) == (min(times), max(times))
    assert (statistics.chunk_count, statistics.channel_count) == (len(summary.chunk_indexes), len(summary.channels))
    topics = Counter(topic for topic, _, _ in entries)
    assert {summary.channels[key].topic: n for key, n in statistics.channel_message_counts.items()} == topics
    assert [(channel.topic, message.log_time) for _, channel, message in indexed] == [entry[:2] for entry in entries]
    for schema, channel, _ in indexed:
        wanted = get_definition(channel.topic)
        assert channel.message_encoding == wanted.encoding
        assert (b"" if schema is None else schema.data) == wanted.schema
