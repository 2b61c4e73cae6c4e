"""Segment: one MCAP file of a recording, written chunk by chunk.

Every chunk is one write of the operating system, so that a process killed between two of them
leaves whole chunks only. Every chunk repeats the channels that it uses, so that it can be read when
any other is damaged, and is compressed by Zstandard, outside the interpreter's lock. The CRC-32 of
its content catches each flipped byte that changes the content.

The records are those of `mcap.records`. `mcap.writer.Writer` is not used: it names a channel in one
chunk only, lets a chunk grow past its size by a message, and counts a chunk that failed to reach
the disk into the checksum of the file, which could then not be closed.
"""

from __future__ import annotations

import contextlib
import errno
import struct
import zlib
from collections import Counter, deque
from collections.abc import Callable, Sequence
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

import msgspec
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)
from mcap.records import SummaryOffset as Group
from zstandard import ZstdCompressor

from logs.recording.disk import OutputFile, make_segment_path
from logs.recording.file_kind import MAGIC
from logs.recording.topics import HEADER, Definition, get_definition
from uavctl.config.types import LogConfig

MESSAGE = struct.Struct("<BQHIQQ")  # opcode, length, channel, sequence, log time, publish time
_PREFIX_BYTES = 9  # opcode and length of a record, which its length does not count
_OPCODE = int(Opcode.MESSAGE)
INDEX = struct.Struct("<BQHI")  # opcode, length, channel, bytes of entries
COMPRESSION = b"zstd"
_LEVEL = 1  # 3 makes a flight's recording 1 % smaller for twice the time
_FOOTER = struct.Struct("<BQQQ")  # opcode, length, start of summary, start of its offsets
# Metadata of each channel: UTC of time 0 of our clock [ns since 1970], that log times are later than the records' own.
# In each chunk, as all of a channel is, and so there whatever else of the file is damaged.
ZERO_UTC = "zero_utc_ns"


class QueuedMessage(msgspec.Struct, frozen=True):
    """A message on its way to the disk."""

    definition: Definition
    sequence: int
    at_ns: int
    data: bytes


class _Channel(msgspec.Struct):
    """Channel of a topic."""

    number: int
    record: bytes
    index: list[int] = []  # log time and offset of each of its messages in the open chunk, in turn


class Segment:
    """Writer of one MCAP file.

    Args:
        chunk_bytes: largest chunk [bytes]; only a single larger message makes a larger chunk.
        zero_utc_ns: UTC of time 0 of our clock [ns since 1970]; 0 makes log times those of our clock.
    """

    def __init__(self, file: OutputFile, chunk_bytes: int, zero_utc_ns: int = 0) -> None:
        self._file = file
        self._chunk_bytes = chunk_bytes
        self._compress = ZstdCompressor(level=_LEVEL).compress
        self._zero_utc_ns = zero_utc_ns
        self._channels: dict[str, _Channel] = {}
        self._open_channels: list[_Channel] = []  # those that the open chunk has messages of
        self._schemas: dict[str, Schema] = {}
        # Of a long recording there are many chunks: what the footer says of them is kept as its bytes.
        self._chunk_indexes = bytearray()
        self._chunks = 0
        self._attached: list[AttachmentIndex | MetadataIndex] = []
        self._times_ns: tuple[int, int] | None = None  # first and last
        self._counts: Counter[int] = Counter()
        self._crc = 0
        self._size = 0
        self._begin_chunk()
        self.open_entries: list[QueuedMessage] = []  # not on the disk yet
        self.messages = 0  # on the disk
        self.bytes = 0  # on the disk
        self.attached_bytes = 0  # of these, attachments and metadata

    def add(self, entry: QueuedMessage) -> None:
        """Take a message; writes the open chunk first if it would grow too large.

        Raises:
            OSError: the chunk could not be written; its messages and this one are in `open_entries`.
        """
        data, entries = entry.data, self.open_entries
        channel, head = self._channels.get(entry.definition.topic), b""
        if channel is None:
            channel, head = self._make_channel(entry.definition)
        elif not channel.index:
            head = channel.record
        size, offset = MESSAGE.size + len(data), self._size + len(head)
        full = bool(entries) and offset + size > self._chunk_bytes
        entries.append(entry)
        if full:
            self._commit(entries[:-1])
            self.open_entries = [entry]
            head = head or channel.record
            offset = len(head)
        if head:  # its first message in the chunk
            self._open_channels.append(channel)
        utc_ns = entry.at_ns + self._zero_utc_ns
        channel.index += (utc_ns, offset)
        fields = MESSAGE.pack(_OPCODE, size - _PREFIX_BYTES, channel.number, entry.sequence, utc_ns, utc_ns)
        self._parts += (head, fields, data)
        self._size = offset + size

    def commit(self) -> None:
        """Write the open chunk, if there is anything in it.

        Raises:
            OSError: it could not be written; the file holds what it held before, or part of a chunk.
        """
        if self.open_entries:
            self._commit(self.open_entries)
            self.open_entries = []

    def attach(self, records: Sequence[Attachment | Metadata]) -> None:
        """Write the open chunk, and attachments and metadata after it.

        Raises:
            OSError: as `commit`; of what was to be attached nothing counts then.
        """
        self.commit()
        if not records:
            return
        prefix, at = self._make_prefix(), self.bytes
        block, indexes = prefix, []
        for record in records:
            data = _pack_records(record)
            indexes.append(_make_index(record, at + len(block), len(data)))
            block += data
        self._file.write(block)
        self._crc = zlib.crc32(block, self._crc)
        self.bytes += len(block)
        self.attached_bytes += len(block)
        self._attached += indexes

    def sync(self) -> None:
        """Write the open chunk and wait for the disk."""
        self.commit()
        self._file.sync()

    def finish(self) -> None:
        """Write the open chunk, the index and the footer, wait for the disk, and close the file.

        Raises:
            OSError: not all of it could be done; `abandon` does what is left.
        """
        self.commit()
        self._file.write(self._make_tail())
        self._file.sync()
        self._file.close()

    def abandon(self) -> None:
        """After a failed write: cut off its remains, end the file as well as there is room, close.

        Raises:
            OSError: not all of it could be done; the chunks written before are readable all the same.
        """
        try:
            self._file.truncate(self.bytes)
            try:
                self._file.write(self._make_tail())
            except OSError:
                self._file.truncate(self.bytes)
                self._write_short_tail()
        finally:
            self._file.close()

    def _write_short_tail(self) -> None:
        """End the file without a summary: on a full disk its last block has room for these few bytes, as a rule."""
        try:
            crc = zlib.crc32(_FOOTER.pack(Opcode.FOOTER, 20, 0, 0))
            self._file.write(_pack_records(DataEnd(self._crc), Footer(0, 0, crc)) + MAGIC)
        except OSError:
            self._file.truncate(self.bytes)
            raise

    def _make_prefix(self) -> bytes:
        """Return the bytes that the next write has to begin with: those that begin a file, or none."""
        return b"" if self.bytes else MAGIC + _pack_records(Header(profile="", library=_name_library()))

    def _begin_chunk(self) -> None:
        self._parts: list[bytes] = []
        self._size = 0
        for channel in self._open_channels:
            channel.index = []
        self._open_channels = []

    def _make_channel(self, definition: Definition) -> tuple[_Channel, bytes]:
        """Return the channel of a new topic, and the records that must stand before its first message."""
        schema = self._schemas.get(definition.schema_name)
        head = b""
        if schema is None and definition.schema_encoding != "":
            schema = Schema(
                id=len(self._schemas) + 1,
                name=definition.schema_name,
                encoding=definition.schema_encoding,
                data=definition.schema,
            )
            self._schemas[definition.schema_name] = schema
            head = _pack_records(schema)
        record = Channel(
            id=len(self._channels) + 1,
            topic=definition.topic,
            message_encoding=definition.encoding,
            schema_id=0 if schema is None else schema.id,
            metadata={ZERO_UTC: str(self._zero_utc_ns)} if self._zero_utc_ns else {},
        )
        channel = self._channels[definition.topic] = _Channel(record.id, _pack_records(record))
        return channel, head + channel.record

    def _commit(self, entries: list[QueuedMessage]) -> None:
        content = b"".join(self._parts)
        times_ns = [entry.at_ns + self._zero_utc_ns for entry in entries]
        first, last = min(times_ns), max(times_ns)
        size, stored = len(content), self._compress(content)
        chunk = _pack_records(
            Chunk(
                compression=COMPRESSION.decode(),
                data=stored,
                message_start_time=first,
                message_end_time=last,
                uncompressed_crc=zlib.crc32(content),
                uncompressed_size=size,
            )
        )
        prefix = self._make_prefix()
        start = self.bytes + len(prefix)
        at = start + len(chunk)
        offsets, indexes = {}, []
        for channel in self._open_channels:
            count = len(channel.index)
            offsets[channel.number] = at
            indexes.append(
                INDEX.pack(Opcode.MESSAGE_INDEX, 6 + 8 * count, channel.number, 8 * count)
                + struct.pack(f"<{count}Q", *channel.index)
            )
            at += len(indexes[-1])
        block = b"".join([prefix, chunk, *indexes])
        self._file.write(block)
        self._crc = zlib.crc32(block, self._crc)
        self.bytes += len(block)
        self._chunk_indexes += _pack_records(
            ChunkIndex(
                chunk_start_offset=start,
                chunk_length=len(chunk),
                compression=COMPRESSION.decode(),
                compressed_size=len(stored),
                uncompressed_size=size,
                message_start_time=first,
                message_end_time=last,
                message_index_length=at - start - len(chunk),
                message_index_offsets=offsets,
            )
        )
        self._chunks += 1
        earlier_times_ns = self._times_ns or (first, last)
        self._times_ns = min(earlier_times_ns[0], first), max(earlier_times_ns[1], last)
        self.messages += len(entries)
        self._counts.update({channel.number: len(channel.index) // 2 for channel in self._open_channels})
        self._begin_chunk()

    def _make_tail(self) -> bytes:
        """Return the bytes that end a file: end of data, summary, footer."""
        prefix = self._make_prefix()
        data_end = prefix + _pack_records(DataEnd(zlib.crc32(prefix, self._crc)))
        start = self.bytes + len(data_end)
        groups = (
            (Opcode.SCHEMA, _pack_records(*self._schemas.values())),
            (Opcode.CHANNEL, b"".join(channel.record for channel in self._channels.values())),
            (Opcode.STATISTICS, _pack_records(self._make_statistics())),
            (Opcode.CHUNK_INDEX, bytes(self._chunk_indexes)),
            (Opcode.ATTACHMENT_INDEX, _pack_records(*self._list_indexes(AttachmentIndex))),
            (Opcode.METADATA_INDEX, _pack_records(*self._list_indexes(MetadataIndex))),
        )
        summary, offsets = b"", b""
        for opcode, data in groups:
            if data:
                group = Group(group_opcode=opcode, group_start=start + len(summary), group_length=len(data))
                offsets += _pack_records(group)
            summary += data
        offset_start = start + len(summary)
        crc = zlib.crc32(summary + offsets + _FOOTER.pack(Opcode.FOOTER, 20, start, offset_start))
        footer = _pack_records(Footer(summary_start=start, summary_offset_start=offset_start, summary_crc=crc))
        return data_end + summary + offsets + footer + MAGIC

    def _list_indexes(self, kind: type[AttachmentIndex | MetadataIndex]) -> list[AttachmentIndex | MetadataIndex]:
        return [attachment for attachment in self._attached if isinstance(attachment, kind)]

    def _make_statistics(self) -> Statistics:
        first, last = self._times_ns or (0, 0)
        return Statistics(
            attachment_count=len(self._list_indexes(AttachmentIndex)),
            channel_count=len(self._channels),
            channel_message_counts=dict(self._counts),
            chunk_count=self._chunks,
            message_count=self.messages,
            message_start_time=first,
            message_end_time=last,
            metadata_count=len(self._list_indexes(MetadataIndex)),
            schema_count=len(self._schemas),
        )


def _pack_records(*records: McapRecord) -> bytes:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    data: bytes = builder.end()  # type: ignore[no-untyped-call]  # not annotated in mcap
    return data


def _make_index(record: Attachment | Metadata, offset: int, length: int) -> AttachmentIndex | MetadataIndex:
    if isinstance(record, Metadata):
        return MetadataIndex(offset=offset, length=length, name=record.name)
    return AttachmentIndex(
        offset=offset,
        length=length,
        log_time=record.log_time,
        create_time=record.create_time,
        data_size=len(record.data),
        name=record.name,
        media_type=record.media_type,
    )


@cache
def _name_library() -> str:
    return f"uavctl mcap-records-{version('mcap')}"


MAX_TAKEN_NAMES = 100  # that somebody else has taken, passed over at a time
RETRY_S = 1.0  # between tries to begin a file after a failed write


class _SegmentPart(NamedTuple):
    """A closed file with the number of messages and bytes in it."""

    path: Path
    messages: int
    bytes: int


class Rotation:
    """Writer of a recording's files, one after another.

    Args:
        clock: wall time [s].

    Attributes:
        unwritten: topic, log time [ns] and message of what goes first into the next file.
        because: why the next file is begun.
        number: number of the file that is open, or comes next.
        written: messages so far, repeated ones included.
        at_ns: log time of the newest record.
        failures: failed writes.
        reason: reason of the newest failed write.
        zero_utc_ns: UTC of time 0 of our clock [ns since 1970], for the files that are begun from now on.
    """

    def __init__(
        self, path: Path, log: LogConfig, open_file: Callable[[Path], OutputFile], clock: Callable[[], float]
    ) -> None:
        self._path, self._log, self._open_file, self._clock = path, log, open_file, clock
        self._segment: Segment | None = None
        self._preface = 0  # records at the start of this segment that only repeat
        self._header = b""  # the header record, which each segment repeats; empty before there is one
        self._header_bytes = 0  # its size in a file
        self._attachments: tuple[Attachment | Metadata, ...] = ()  # for each segment
        self._retry_s = clock()
        self._done: list[_SegmentPart] = []
        self.unwritten: deque[tuple[str, int, bytes]] = deque()
        self.zero_utc_ns = 0
        self.because = ""
        self.number = 1
        self.written = 0
        self.at_ns = 0
        self.failures = 0
        self.reason = ""

    @property
    def is_open(self) -> bool:
        """Whether there is a file to write to."""
        return self._segment is not None

    @property
    def name(self) -> str:
        """Name of the file that is open, or comes next."""
        return make_segment_path(self._path, self.number).name

    @property
    def has_chunk(self) -> bool:
        """Whether the open file has a chunk on the disk."""
        segment = self._segment  # asked beside the thread that writes
        return segment is not None and bool(segment.bytes)

    @property
    def has_room(self) -> bool:
        """Whether a file is open and has not reached its size, not counting the head of each file."""
        segment = self._segment
        if segment is None:
            return False
        return segment.bytes - segment.attached_bytes < self._log.segment_bytes + self._header_bytes

    @property
    def may_begin(self) -> bool:
        """Whether enough time has gone by since a failed write."""
        return self._clock() >= self._retry_s

    @property
    def open_messages(self) -> int:
        """Number of messages that are in memory only."""
        segment = self._segment
        return len(self.unwritten) + (0 if segment is None else len(segment.open_entries))

    def parts(self) -> list[tuple[Path, int, int]]:
        """Return the files with at least one chunk: path, messages and bytes on the disk."""
        segment, done = self._segment, [*self._done]
        if segment is not None and segment.bytes:
            done.append(self._part(segment))
        return [(file.path, file.messages, file.bytes) for file in done]

    def allow_retry(self) -> None:
        """Allow that a file is begun at once."""
        self._retry_s = self._clock()

    def begin(self, write_note: Callable[[str], object]) -> None:
        """Open the next file, under the next free name; a later one than the first repeats the header.

        Raises:
            OSError: it cannot be opened or written.
        """
        self._path.parent.mkdir(parents=True, exist_ok=True)  # somebody may have removed it with the file before
        self._segment = Segment(self._open_next(), self._log.chunk_bytes, self.zero_utc_ns)
        self._preface = 0
        if self.number > 1:
            self._preface = 1 + bool(self._header)
            if self._header:
                self.write(HEADER, self.at_ns, self._header)
            write_note(self.because)
            self._segment.attach(self._attachments)

    def _open_next(self) -> OutputFile:
        """Open a file under the next name that nobody has taken."""
        for _ in range(MAX_TAKEN_NAMES):
            try:
                return self._open_file(make_segment_path(self._path, self.number))
            except FileExistsError:
                self.number += 1
        return self._open_file(make_segment_path(self._path, self.number))

    def write(self, topic: str, at_ns: int, data: bytes) -> None:
        """Add a message to the open file.

        Raises:
            OSError: a chunk could not be written; `fail` keeps what it held, this message included.
        """
        segment = self._segment
        assert segment is not None  # who calls has asked is_open
        entry = QueuedMessage(get_definition(topic), self.written + 1, at_ns, data)
        try:
            segment.add(entry)
        finally:
            if segment.open_entries and segment.open_entries[-1] is entry:  # else it is lost, and takes no number
                self.written += 1

    def write_record(self, topic: str, at_ns: int, data: bytes) -> None:
        """Add a record's message; the header is kept for later files.

        Raises:
            OSError: as `write`.
        """
        self.at_ns = at_ns
        if topic == HEADER:
            self._header = data
            self._header_bytes = len(ZstdCompressor(level=_LEVEL).compress(data))
        self.write(topic, at_ns, data)

    def write_unwritten(self) -> None:
        """Write the messages that must go first into the new file.

        Raises:
            OSError: as `write`.
        """
        while self.unwritten:
            self.write(*self.unwritten.popleft())

    def commit(self) -> None:
        """Hand the open chunk to the operating system.

        Raises:
            OSError: it could not be written.
        """
        self._open_segment().commit()

    def attach(
        self, file_records: Sequence[Attachment | Metadata], recording_records: Sequence[Attachment | Metadata]
    ) -> None:
        """Write attachments and metadata into this file, after its chunk.

        Args:
            file_records: those of this file and all that follow.
            recording_records: those of this file alone.

        Raises:
            OSError: they could not be written.
        """
        self._attachments = tuple(file_records)
        self._open_segment().attach((*file_records, *recording_records))

    def sync(self) -> None:
        """Write the open chunk and wait until the disk has it.

        Raises:
            OSError: that could not be done, or the file is no longer where it was made.
        """
        if not make_segment_path(self._path, self.number).exists():
            raise FileNotFoundError(errno.ENOENT, "the file was deleted or moved", self.name)
        self._open_segment().sync()

    def finish(self, records: Sequence[Attachment | Metadata] = ()) -> None:
        """Close the open file with attachments and metadata that belong to its end, index and footer.

        Raises:
            OSError: not all of it could be done.
        """
        segment = self._open_segment()
        segment.attach(records)
        segment.finish()
        self._retire(segment)

    def fail(self, error: Exception) -> None:
        """Handle a failed write: keep the messages of the open chunk, and close the file as well as possible."""
        self.failures += 1
        self.reason = str(error) or type(error).__name__
        self.because = f"after a failed write: {self.reason}"
        self._retry_s = self._clock() + RETRY_S
        segment = self._segment
        if segment is None:
            return  # it could not even be opened
        self.written -= len(segment.open_entries)  # they are numbered anew
        kept_entries = segment.open_entries[max(0, self._preface - segment.messages) :]
        self.unwritten.extendleft(
            (record.definition.topic, record.at_ns, record.data) for record in reversed(kept_entries)
        )
        # what abandon cannot do is no second alarm: whole chunks are readable without it
        with contextlib.suppress(OSError):
            segment.abandon()
        self._retire(segment)

    def _open_segment(self) -> Segment:
        assert self._segment is not None  # who calls has asked is_open
        return self._segment

    def _part(self, segment: Segment) -> _SegmentPart:
        return _SegmentPart(make_segment_path(self._path, self.number), segment.messages, segment.bytes)

    def _retire(self, segment: Segment) -> None:
        part = self._part(segment)
        if segment.bytes:
            self._done.append(part)
            self.number += 1
        else:
            try:
                part.path.unlink(missing_ok=True)
            except OSError:
                self.number += 1  # the name stays taken
        self._segment = None
