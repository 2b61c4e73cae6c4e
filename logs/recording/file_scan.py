"""Scan of one file of a recording: messages of whole chunks, attachments, and where the file is damaged.

Nothing of a chunk is used before its checksum was right. After damage the search goes on byte by byte for the next
whole chunk, since a flipped length would lead astray. A budget bounds that search, and what chunks unpack to.
"""

from __future__ import annotations

import mmap
import re
import struct
import zlib
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Schema, Statistics
from zstandard import ZstdDecompressor, ZstdError, get_frame_parameters

from logs.recording.budget import ExcessError, ReadBudget
from logs.recording.file_kind import MAGIC, describe_kind_error
from logs.recording.segment import COMPRESSION, INDEX, MESSAGE, ZERO_UTC
from logs.recording.topics import Definition, get_definition
from uavctl.errors import RecordingError

_RECORD = struct.Struct("<BQ")  # opcode, length
_IS_MESSAGE = int(Opcode.MESSAGE)  # a plain number: compared for every record


class RecordedMessage(NamedTuple):
    """A message whose chunk has the right checksum."""

    definition: Definition
    sequence: int
    at_ns: int
    data: bytes
    offset: int  # offset of its chunk in the file
    repeated: bool = False  # header or library, once more, at the start of a later segment
    zero_utc_ns: int = 0  # its log time in the file is so much later than `at_ns`, which is by our clock


@dataclass
class ReadingOrder:
    """Place of a reader that wants all of a recording or nothing; kept from file to file."""

    path: Path  # the recording, for the error
    following: int | None = None  # number that the next message has; None before the first

    def make_error(self, sequence: int) -> RecordingError:
        """Return the error of a message that does not follow the last one."""
        return RecordingError(
            f"{self.path}: message {sequence} where {self.following} should be (is a segment file gone?); "
            f"`uavctl log recover {self.path} OUT` restores the rest"
        )


class ChunkReader:
    """Reader of the messages in chunks; remembers the schemas seen so far."""

    def __init__(self, budget: ReadBudget) -> None:
        self._budget = budget
        self._schemas: dict[int, Schema] = {}
        self._definitions: dict[bytes, tuple[int, Definition, int]] = {}
        # Each of our chunks names its channels; those of other writers may lie in an earlier one.
        self._channels: dict[int, tuple[Definition, int]] = {}

    def read_messages(
        self, content: bytes, offset: int, order: ReadingOrder | None = None
    ) -> Iterator[RecordedMessage]:
        """Read the messages of one chunk whose checksum is right.

        Args:
            order: place of the reader, moved on. With it, messages for viewers are left out: half of a recording.

        Raises:
            RecordingError: a message is missing that the order wants.
            _BadRecordError: it holds something other than whole records; what came before is good.
            ExcessError: there are too many.
        """
        try:
            yield from self._read_messages(content, offset, order)
        except (McapError, LookupError, ValueError, struct.error) as error:  # it was written so
            raise _BadRecordError("is no chunk of a recording, though its checksum is right") from error

    def _read_messages(self, content: bytes, offset: int, order: ReadingOrder | None) -> Iterator[RecordedMessage]:
        channels = self._channels
        at = 0
        size = len(content)
        take_record = self._budget.take_record
        while at < size:
            take_record()
            if content[at] != _IS_MESSAGE:
                at = self._add_definition(content, at)
                continue
            _, length, channel, sequence, at_ns, _ = MESSAGE.unpack_from(content, at)
            begin, at = at + MESSAGE.size, at + _RECORD.size + length
            if at > size:
                raise _BadRecordError("has a message that is longer than the chunk")
            definition, zero_utc_ns = channels[channel]
            if order is not None:
                if sequence != order.following and order.following is not None:
                    raise order.make_error(sequence)
                order.following = sequence + 1
                if definition.for_viewers:
                    continue
            data = content[begin:at]
            yield RecordedMessage(definition, sequence, at_ns - zero_utc_ns, data, offset, zero_utc_ns=zero_utc_ns)

    def _add_definition(self, content: bytes, at: int) -> int:
        """Add a channel or schema; return the offset after it."""
        opcode, length = _RECORD.unpack_from(content, at)
        at += _RECORD.size
        if opcode == Opcode.CHANNEL:
            channel, definition, zero_utc_ns = self._read_channel(content[at : at + length])
            self._channels[channel] = definition, zero_utc_ns
        elif opcode == Opcode.SCHEMA:
            schema = Schema.read(ReadDataStream(BytesIO(content[at : at + length])))
            if self._schemas.get(schema.id) != schema:
                self._budget.keep(length)
                self._schemas[schema.id] = schema
        return int(at + length)

    def _read_channel(self, record: bytes) -> tuple[int, Definition, int]:
        if record not in self._definitions:
            self._budget.keep(len(record))
            channel = Channel.read(ReadDataStream(BytesIO(record)))
            schema = self._schemas.get(channel.schema_id)
            self._definitions[record] = channel.id, _make_definition(channel, schema), _read_zero_utc_ns(channel)
        return self._definitions[record]


def _read_zero_utc_ns(channel: Channel) -> int:
    """Return how much later log times are than those of our clock [ns]; 0 in recordings of before."""
    zero_text = channel.metadata.get(ZERO_UTC, "0")
    if not (zero_text.isascii() and zero_text.isdigit()):
        raise RecordingError(f"topic {channel.topic}: {ZERO_UTC} of its channel is {zero_text!r}, which is no time")
    return int(zero_text)


def _make_definition(channel: Channel, schema: Schema | None) -> Definition:
    if schema is not None:
        return Definition(channel.topic, channel.message_encoding, schema.name, schema.encoding, schema.data)
    try:
        return get_definition(channel.topic)  # the chunk with its schema is damaged
    except KeyError:
        return Definition(channel.topic, channel.message_encoding)


# Opcode, length, first time, last time, size, CRC-32, length of the compression's name; then name and stored size.
_CHUNK = struct.Struct("<BQQQQII")
_STORED_SIZE = struct.Struct("<Q")
_CHUNK_FIELDS = 40  # least length: that of an empty chunk without compression
_FOOTER = struct.Struct("<BQQQI")  # opcode, length, start of summary, start of its offsets, crc
_DATA_END = struct.Struct("<BQI")
_CHUNK_INDEX = struct.Struct("<BQQQQQ")  # opcode, length, start, end, offset and length of the chunk
_ATTACHMENT_FIELDS = 36  # bytes besides name, type and data
_TIMES_BYTES = 16  # at the begin of an attachment
_TEXT_LENGTH, _CHECKSUM = struct.Struct("<I"), struct.Struct("<I")
_DECOMPRESSOR = ZstdDecompressor()
# A chunk by its head: opcode, numbers, and the name of the compression; fixed in length, so it is searched in one pass.
_CHUNK_HEAD = re.compile(b"%c.{36}(?:\0{4}|\4\0{3}%s)" % (Opcode.CHUNK, COMPRESSION), re.DOTALL)
_IS_INDEX = int(Opcode.MESSAGE_INDEX)  # a plain number: compared for every record


@dataclass(frozen=True)
class Damage:
    """Bytes of a file that cannot be trusted."""

    path: Path
    offset: int
    length: int
    reason: str
    torn: bool = False  # the file just ends too early

    def __str__(self) -> str:
        return f"{self.path}, offset {self.offset}: {self.reason}"


@dataclass(frozen=True)
class AttachedFile:
    """An attachment whose checksum is right."""

    name: str
    media_type: str
    bytes: int


@dataclass(frozen=True)
class EndOfFile:
    """End of a file."""

    finished: bool  # it has its index and footer
    complete: bool  # the end of the data was there: no chunk is missing after the last one


class _BadRecordError(Exception):
    """Bytes that are not the expected record."""


class _TornRecordError(_BadRecordError):
    """A record goes on beyond the end of the file."""


_UNUSABLE = (_BadRecordError, ExcessError)

Buffer = bytes | mmap.mmap
Scanned = RecordedMessage | AttachedFile | Damage | EndOfFile


def scan_file(path: Path, order: ReadingOrder | None = None) -> Iterator[Scanned]:
    """Yield messages, attachments and damage of one file in file order, then its `EndOfFile`.

    Args:
        order: place of the reader, moved on. With it, messages for viewers are counted and left out.

    Raises:
        RecordingError: the file cannot be read, is no recording at all, or lacks a message that the order wants.
    """
    with _map_file(path) as data:
        if data:
            yield from _scan_records(path, data, order)
        else:  # ended between creating and first writing
            yield EndOfFile(finished=False, complete=False)


@contextmanager
def _map_file(path: Path) -> Iterator[Buffer]:
    """Map the bytes of a file; the system reads them on access.

    Raises:
        RecordingError: the file cannot be read.
    """
    try:
        with path.open("rb") as file:
            if path.stat().st_size == 0:
                yield b""
                return
            with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
                yield data
    except OSError as error:
        raise RecordingError(f"{path}: {error.strerror}") from error


def read_last_chunk(path: Path) -> list[RecordedMessage] | None:
    """Return the messages of a file's last chunk, found by its index; the others are not read.

    Returns:
        None if the file does not end with an index and footer that are whole; nothing if the chunk is not.

    Raises:
        RecordingError: the file cannot be read.
    """
    with _map_file(path) as data:
        end = _find_data_end(data)
        return None if end is None else _read_last_chunk(data, end + _DATA_END.size)


def _read_last_chunk(data: Buffer, at: int) -> list[RecordedMessage]:
    """Return the messages of the last chunk by the summary at `at`, whose checksum is right."""
    offset = length = 0
    try:
        for opcode, begin, _ in _iterate_summary(data, at):
            if opcode == Opcode.CHUNK_INDEX:
                *_, offset, length = _CHUNK_INDEX.unpack_from(data, begin - _RECORD.size)
        if not length or _measure_record(data, offset) != length:
            return []
        budget = ReadBudget(len(data))
        return list(ChunkReader(budget).read_messages(_read_chunk(data, offset, length, budget), offset))
    except (*_UNUSABLE, struct.error):  # the summary was written so
        return []


def count_by_topic(path: Path) -> dict[str, int] | None:
    """Return the number of messages of each topic in a file, by the statistics in its summary.

    Returns:
        None if the file does not end with a summary that is whole and has statistics.

    Raises:
        RecordingError: the file cannot be read.
    """
    with _map_file(path) as data:
        end = _find_data_end(data)
        try:
            return None if end is None else _count_by_topic(data, end + _DATA_END.size)
        except (_BadRecordError, McapError, ValueError, struct.error):  # the summary was written so
            return None


def _count_by_topic(data: Buffer, at: int) -> dict[str, int] | None:
    topics: dict[int, str] = {}
    counts: dict[int, int] | None = None
    for opcode, begin, end in _iterate_summary(data, at):
        if opcode == Opcode.CHANNEL:
            channel = Channel.read(ReadDataStream(BytesIO(data[begin:end])))
            topics[channel.id] = channel.topic
        elif opcode == Opcode.STATISTICS:
            counts = Statistics.read(ReadDataStream(BytesIO(data[begin:end]))).channel_message_counts
    if counts is None:
        return None
    of_topics: Counter[str] = Counter()
    for channel, number in counts.items():
        of_topics[topics.get(channel, "")] += number
    return of_topics


def _iterate_summary(data: Buffer, at: int) -> Iterator[tuple[int, int, int]]:
    """Yield opcode, begin and end of the content of each record of a summary, without the footer."""
    while True:
        if at + _RECORD.size > len(data):
            raise _TornRecordError("is torn")
        opcode, length = _RECORD.unpack_from(data, at)
        if opcode == Opcode.FOOTER:
            return
        begin, at = at + _RECORD.size, at + _RECORD.size + length
        if at > len(data):
            raise _TornRecordError("is torn")
        yield opcode, begin, at


def _scan_records(path: Path, data: Buffer, order: ReadingOrder | None) -> Iterator[Scanned]:
    size, budget = len(data), ReadBudget(len(data))
    at = len(MAGIC)
    damaged = False
    if data[:at] != MAGIC:
        if MAGIC.startswith(data[:at]):
            yield Damage(path, 0, size, "torn in the first bytes", torn=True)
            yield EndOfFile(finished=False, complete=False)
            return
        first = _find_next_chunk(data, 0, budget)
        if first is None:
            raise RecordingError(f"{path}: not a recording (no MCAP magic, no whole chunk){describe_kind_error(path)}")
        yield Damage(path, 0, first, "damaged before the first whole chunk")
        at, damaged = first, True
    chunk_reader = ChunkReader(budget)
    while at < size:
        opcode = data[at]
        try:
            length = _measure_record(data, at)
            if opcode == Opcode.CHUNK:
                yield from chunk_reader.read_messages(_read_chunk(data, at, length, budget), at, order)
            if opcode == Opcode.ATTACHMENT:
                yield _read_attachment(data, at, length, budget)
            if opcode == Opcode.DATA_END:
                stored = _DATA_END.unpack_from(data, at)[2]
                if not damaged and stored and stored != _compute_crc(data, at):  # 0: not computed
                    yield Damage(path, at, 0, "every chunk is whole, but something between them is damaged")
                finished = _is_summary_right(data, at + length)
                if not finished:
                    yield Damage(path, at + length, 0, "no record is lost, but the index is damaged", _is_torn(data))
                yield EndOfFile(finished=finished, complete=True)
                return
            at += length
        except _UNUSABLE as error:
            later = _find_next_chunk(data, at + 1, budget)
            if later is None:
                later = _find_data_end(data)
            if later is not None and later < at:
                later = None  # the footer points back, to bytes that were read
            if later == at:
                yield Damage(path, at, 0, "no record is lost, but the end of the data is damaged")
                yield EndOfFile(finished=False, complete=True)
                return
            torn = later is None and isinstance(error, _TornRecordError)
            later = size if later is None else later
            yield Damage(path, at, later - at, f"chunk or index {error}", torn=torn)
            at, damaged = later, True
    yield EndOfFile(finished=False, complete=False)


def _measure_record(data: Buffer, at: int) -> int:
    """Return the length of the record at `at` with its head, if it may stand between chunks and is not torn."""
    if at + _RECORD.size > len(data):
        raise _TornRecordError("is torn")
    opcode, length = _RECORD.unpack_from(data, at)
    if at + _RECORD.size + length > len(data):
        raise _TornRecordError("is torn")
    inner = at + _RECORD.size
    if opcode == _IS_INDEX:  # of each topic in each chunk, so most of all
        is_complete = length >= 6 and INDEX.unpack_from(data, at)[3] == length - 6
    elif opcode == Opcode.CHUNK:
        is_complete = length >= _CHUNK_FIELDS
    elif opcode == Opcode.DATA_END:
        is_complete = length == _DATA_END.size - _RECORD.size
    elif opcode == Opcode.ATTACHMENT:
        is_complete = length >= _ATTACHMENT_FIELDS
    elif opcode == Opcode.METADATA:
        is_complete = _measure_pair(data, inner, length) == length
    elif opcode == Opcode.HEADER:
        is_complete = at == len(MAGIC) and _measure_pair(data, inner, length) == length
    else:
        is_complete = False
    if not is_complete:
        raise _BadRecordError("is damaged")
    return int(_RECORD.size + length)


def _read_attachment(data: Buffer, at: int, length: int, budget: ReadBudget) -> AttachedFile:
    """Return the attachment at `at`, if its checksum is right; its data are not copied."""
    budget.look(length)
    end = at + length - _CHECKSUM.size
    if _compute_crc(data, end, at + _RECORD.size) != _CHECKSUM.unpack_from(data, end)[0]:
        raise _BadRecordError("has a wrong checksum")
    name, begin = _read_text(data, at + _RECORD.size + _TIMES_BYTES, end)
    media_type, begin = _read_text(data, begin, end)
    data_bytes = end - begin - _STORED_SIZE.size
    if data_bytes < 0 or data_bytes != _STORED_SIZE.unpack_from(data, begin)[0]:
        raise _BadRecordError("is no attachment")
    return AttachedFile(name, media_type, data_bytes)


def _read_text(data: Buffer, at: int, end: int) -> tuple[str, int]:
    """Return the text at `at` in a record that ends at `end`, and the offset after it."""
    begin = at + _TEXT_LENGTH.size
    if begin > end or begin + _TEXT_LENGTH.unpack_from(data, at)[0] > end:
        raise _BadRecordError("is no attachment")
    later = begin + _TEXT_LENGTH.unpack_from(data, at)[0]
    try:
        return data[begin:later].decode("utf-8"), later
    except UnicodeDecodeError as error:
        raise _BadRecordError("is no attachment") from error


def _measure_pair(data: Buffer, inner: int, length: int) -> int:
    """Return the length of a header or metadata record by those of its two fields; -1 if they do not fit."""
    if length < 8:
        return -1
    (first,) = struct.unpack_from("<I", data, inner)
    if first > length - 8:
        return -1
    return int(8 + first + struct.unpack_from("<I", data, inner + 4 + first)[0])


def _read_chunk(data: Buffer, at: int, length: int, budget: ReadBudget) -> bytes:
    """Return the content of the chunk at `at`, if its checksum is right.

    Raises:
        _BadRecordError: it is not, or the chunk is damaged otherwise.
        ExcessError: it asks for more than the budget has.
    """
    _, _, first, last, size, crc, name_length = _CHUNK.unpack_from(data, at)
    name_at = at + _CHUNK.size
    begin = name_at + name_length + _STORED_SIZE.size
    if name_length not in (0, len(COMPRESSION)) or begin > at + length or first > last:
        raise _BadRecordError("has a damaged head")
    name, (stored,) = data[name_at : name_at + name_length], _STORED_SIZE.unpack_from(data, name_at + name_length)
    if stored != at + length - begin or (size != stored and not name) or name not in (b"", COMPRESSION):
        raise _BadRecordError("has a damaged head (or a compression that no recording of uavctl has)")
    budget.look(length)
    budget.unpack(size)
    content = data[begin : at + length]
    if name:
        try:
            # The frame's own size is what would be allocated.
            content = _DECOMPRESSOR.decompress(content) if get_frame_parameters(content).content_size == size else b""
        except ZstdError as error:
            raise _BadRecordError("cannot be decompressed") from error
    if len(content) != size or zlib.crc32(content) != crc:
        raise _BadRecordError("has a wrong checksum")
    return content


def _find_next_chunk(data: Buffer, start: int, budget: ReadBudget) -> int | None:
    """Return the offset of the next whole chunk from `start` on."""
    while (head := _CHUNK_HEAD.search(data, start)) is not None:
        at = head.start()
        try:
            _read_chunk(data, at, _measure_record(data, at), budget)
        except _UNUSABLE:
            start = at + 1
        else:
            return at
    return None


def _find_data_end(data: Buffer) -> int | None:
    """Return the offset of the end of data by the footer, if the footer and what it points to are whole."""
    at = len(data) - len(MAGIC) - _FOOTER.size
    if at < 0:
        return None
    opcode, _, start, _, _ = _FOOTER.unpack_from(data, at)
    end = start - _DATA_END.size
    if opcode != Opcode.FOOTER or not len(MAGIC) <= end < at or data[end] != Opcode.DATA_END:
        return None
    return int(end) if _is_summary_right(data, start) else None


def _compute_crc(data: Buffer, end: int, begin: int = 0) -> int:
    """Return the CRC-32 of everything from `begin` to before `end`, which are not copied."""
    with memoryview(data) as view, view[begin:end] as part:
        return zlib.crc32(part)


def _is_summary_right(data: Buffer, start: int) -> bool:
    """Return whether the bytes from `start` on are a summary, or none, with the right checksum, footer and magic."""
    at = len(data) - len(MAGIC) - _FOOTER.size
    if at < start or data[at + _FOOTER.size :] != MAGIC:
        return False
    opcode, length, summary_start, _, crc = _FOOTER.unpack_from(data, at)
    is_footer = opcode == Opcode.FOOTER and length == 20 and summary_start == (start if at > start else 0)
    return bool(is_footer and crc == _compute_crc(data, at + _FOOTER.size - _CHECKSUM.size, start))


def _is_torn(data: Buffer) -> bool:
    """Return whether a file without a good summary was cut short: it has neither footer nor magic at its end."""
    at = len(data) - len(MAGIC) - _FOOTER.size
    if at < 0:
        return True
    return data[at + _FOOTER.size :] != MAGIC and _RECORD.unpack_from(data, at) != (Opcode.FOOTER, 20)
