"""What a recording's file still holds: whole chunks, and where it is damaged.

Nothing of a chunk is used before its checksum was right. After damage the search goes on byte by
byte for the next whole chunk, since a flipped length would lead astray.
"""

from __future__ import annotations

import mmap
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from mcap.opcode import Opcode

from logs.contents import Contents, Message, Order
from logs.segment import MAGIC
from uavctl.errors import RecordingError

__all__ = ["Damage", "End", "Message", "Order", "last_chunk", "scan"]

_RECORD = struct.Struct("<BQ")  # opcode, length
_CHUNK = struct.Struct("<BQQQQIIQ")  # opcode, length, start, end, size, crc, length of compression name (0), length
_CHUNK_FIELDS = _CHUNK.size - _RECORD.size
_INDEX = struct.Struct("<BQHI")  # opcode, length, channel, length of its entries
_FOOTER = struct.Struct("<BQQQI")  # opcode, length, start of summary, start of its offsets, crc
_DATA_END = struct.Struct("<BQI")
_CHUNK_INDEX = struct.Struct("<BQQQQQ")  # opcode, length, start, end, offset and length of the chunk
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
class End:
    """The file is read."""

    finished: bool  # it has its index and footer
    complete: bool  # the end of the data was there: no chunk is missing after the last one


class _BadRecordError(Exception):
    """What stands here is not the record that it should be."""


class _TornRecordError(_BadRecordError):
    """The record goes on beyond the end of the file."""


Buffer = bytes | mmap.mmap


def scan(path: Path, order: Order | None = None) -> Iterator[Message | Damage | End]:
    """Messages and damage of one file in file order, and then its `End`.

    Args:
        path: the file.
        order: where the reader is, moved on; what was made for viewers is then looked at for its number only.

    Raises:
        RecordingError: the file cannot be read, is no recording at all, or lacks a message that the order wants.
    """
    try:
        with path.open("rb") as file:
            if path.stat().st_size == 0:  # ended between creating and first writing
                yield End(finished=False, complete=False)
                return
            with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
                yield from _scan(path, data, order)
    except OSError as error:
        raise RecordingError(f"{path}: {error.strerror}") from error


def last_chunk(path: Path) -> list[Message] | None:
    """Messages of a file's last chunk as its index tells; the others are not looked at.

    Returns:
        None if the file does not end with an index and footer that are whole; nothing if the chunk is not.

    Raises:
        RecordingError: the file cannot be read.
    """
    try:
        with path.open("rb") as file:
            if path.stat().st_size == 0:
                return None
            with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
                end = _data_end(data)
                return None if end is None else _last_chunk(data, end + _DATA_END.size)
    except OSError as error:
        raise RecordingError(f"{path}: {error.strerror}") from error


def _last_chunk(data: Buffer, at: int) -> list[Message]:
    """The same, by the summary at `at`, whose checksum is right."""
    offset = length = 0
    while data[at] != Opcode.FOOTER:
        if data[at] == Opcode.CHUNK_INDEX:
            *_, offset, length = _CHUNK_INDEX.unpack_from(data, at)
        at += _RECORD.size + _RECORD.unpack_from(data, at)[1]
    try:
        return list(Contents().messages(_chunk(data, offset, length), offset)) if length else []
    except _BadRecordError:
        return []


def _scan(path: Path, data: Buffer, order: Order | None) -> Iterator[Message | Damage | End]:
    size = len(data)
    at = len(MAGIC)
    damaged = False
    if data[:at] != MAGIC:
        if MAGIC.startswith(data[:at]):
            yield Damage(path, 0, size, "torn in the first bytes", torn=True)
            yield End(finished=False, complete=False)
            return
        first = _next_chunk(data, 0)
        if first is None:
            raise RecordingError(f"{path}: not a recording (no MCAP magic, no whole chunk){_hint(path)}")
        yield Damage(path, 0, first, "damaged before the first whole chunk")
        at, damaged = first, True
    contents = Contents()
    while at < size:
        opcode = data[at]
        try:
            length = _whole(data, at)
            if opcode == Opcode.CHUNK:
                yield from contents.messages(_chunk(data, at, length), at, order)
            if opcode == Opcode.DATA_END:
                stored = _DATA_END.unpack_from(data, at)[2]
                if not damaged and stored != _crc(data, at):
                    yield Damage(path, at, 0, "every chunk is whole, but something between them is damaged")
                finished = _summary_ok(data, at + length)
                if not finished:
                    yield Damage(path, at + length, 0, "no record is lost, but the index is damaged", _is_torn(data))
                yield End(finished=finished, complete=True)
                return
            at += length
        except _BadRecordError as error:
            later = _next_chunk(data, at + 1)
            if later is None:
                later = _data_end(data)
            if later == at:
                yield Damage(path, at, 0, "no record is lost, but the end of the data is damaged")
                yield End(finished=False, complete=True)
                return
            torn = later is None and isinstance(error, _TornRecordError)
            later = size if later is None else later
            yield Damage(path, at, later - at, f"chunk or index {error}", torn=torn)
            at, damaged = later, True
    yield End(finished=False, complete=False)


def _hint(path: Path) -> str:
    return "; `uavctl log replay` and `uavctl identify` read a .tlog" if path.suffix == ".tlog" else ""


def _whole(data: Buffer, at: int) -> int:
    """Length of the record at `at`, its head included, if it may stand between chunks and is not torn."""
    if at + _RECORD.size > len(data):
        raise _TornRecordError("is torn")
    opcode, length = _RECORD.unpack_from(data, at)
    if at + _RECORD.size + length > len(data):
        raise _TornRecordError("is torn")
    inner = at + _RECORD.size
    if opcode == _IS_INDEX:  # of each topic in each chunk, so most of all
        good = length >= 6 and _INDEX.unpack_from(data, at)[3] == length - 6
    elif opcode == Opcode.CHUNK:
        good = length >= _CHUNK_FIELDS
    elif opcode == Opcode.DATA_END:
        good = length == _DATA_END.size - _RECORD.size
    elif opcode == Opcode.HEADER:
        good = at == len(MAGIC) and _header_length(data, inner, length) == length
    else:
        good = False
    if not good:
        raise _BadRecordError("is damaged")
    return int(_RECORD.size + length)


def _header_length(data: Buffer, inner: int, length: int) -> int:
    """Length of a header record as its two strings tell; -1 if they do not fit."""
    if length < 8:
        return -1
    (profile,) = struct.unpack_from("<I", data, inner)
    if profile > length - 8:
        return -1
    return int(8 + profile + struct.unpack_from("<I", data, inner + 4 + profile)[0])


def _chunk(data: Buffer, at: int, length: int) -> bytes:
    """Content of the chunk at `at`, if its checksum is right."""
    _, _, first, last, size, crc, name, inner = _CHUNK.unpack_from(data, at)
    if name != 0 or inner != length - _CHUNK.size or size != inner or first > last:
        raise _BadRecordError("has a damaged head (or is compressed, as no recording of uavctl is)")
    content = data[at + _CHUNK.size : at + length]
    if zlib.crc32(content) != crc:
        raise _BadRecordError("has a wrong checksum")
    return content


def _next_chunk(data: Buffer, start: int) -> int | None:
    """Offset of the next whole chunk from `start` on."""
    at = data.find(bytes([Opcode.CHUNK]), start)
    while 0 <= at <= len(data) - _CHUNK.size:
        try:
            _chunk(data, at, _whole(data, at))
        except _BadRecordError:
            at = data.find(bytes([Opcode.CHUNK]), at + 1)
        else:
            return at
    return None


def _data_end(data: Buffer) -> int | None:
    """Offset of the end of data as the footer tells, if the footer and what it points to are whole."""
    at = len(data) - len(MAGIC) - _FOOTER.size
    if at < 0:
        return None
    opcode, _, start, _, _ = _FOOTER.unpack_from(data, at)
    end = start - _DATA_END.size
    if opcode != Opcode.FOOTER or not len(MAGIC) <= end < at or data[end] != Opcode.DATA_END:
        return None
    return int(end) if _summary_ok(data, start) else None


def _crc(data: Buffer, end: int) -> int:
    """CRC-32 of everything before `end`."""
    with memoryview(data) as view:
        return zlib.crc32(view[:end])


def _summary_ok(data: Buffer, start: int) -> bool:
    """Whether all from `start` to the end is a summary with the right checksum, footer and magic."""
    at = len(data) - len(MAGIC) - _FOOTER.size
    if at < start or data[at + _FOOTER.size :] != MAGIC:
        return False
    opcode, length, summary_start, _, crc = _FOOTER.unpack_from(data, at)
    covered = data[start : at + _FOOTER.size - 4]
    return bool(opcode == Opcode.FOOTER and length == 20 and summary_start == start and crc == zlib.crc32(covered))


def _is_torn(data: Buffer) -> bool:
    """Whether a file without a good summary just ends too early: neither footer nor magic is where it should be."""
    at = len(data) - len(MAGIC) - _FOOTER.size
    return data[at + _FOOTER.size :] != MAGIC and _RECORD.unpack_from(data, at) != (Opcode.FOOTER, 20)
