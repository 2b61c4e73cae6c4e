"""Records of an MCAP file of another program, read from its front to its end: it needs neither chunks nor a summary.

No length in the file is believed: a `ReadBudget` bounds what is read and unpacked. Checksums are compared where the
file has them.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from io import BytesIO
from typing import BinaryIO, NamedTuple

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import InvalidMagic, McapError, UnsupportedCompressionError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, DataEnd, Schema

from logs.recording.budget import ReadBudget
from logs.recording.file_kind import MAGIC

# Errors of the library, and of the formats within, on bytes that are no MCAP.
DAMAGE_ERRORS = (McapError, ValueError, OverflowError, RuntimeError, struct.error, zstandard.ZstdError)
_RECORD, _MESSAGE = struct.Struct("<BQ"), struct.Struct("<HIQQ")  # opcode, length; channel, sequence, times
_BLOCK_BYTES = 2**20  # of a skipped record, read at once
_LOADED = frozenset((Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE, Opcode.CHUNK, Opcode.DATA_END))


class ChannelMessage(NamedTuple):
    """A message of a channel."""

    channel_id: int
    at_ns: int
    data: bytes


class TornError(Exception):
    """The file ends within a record."""


def read_records(file: BinaryIO, size: int, budget: ReadBudget) -> Iterator[Schema | Channel | ChannelMessage]:
    """Yield schemas, channels and messages in file order; each chunk is checked by its checksum if it has one.

    Args:
        size: Size of the file [bytes].

    Raises:
        TornError: The file ends within a record.
        ExcessError: A record asks for more than the budget has.
    """
    at, checksum = len(MAGIC), zlib.crc32(MAGIC)
    if (begin := file.read(len(MAGIC))) != MAGIC:
        raise InvalidMagic(begin)
    while True:
        head = file.read(_RECORD.size)
        if len(head) < _RECORD.size:
            raise TornError
        opcode, length = _RECORD.unpack(head)
        if length > size:
            raise McapError(f"a record at offset {at} claims {length} bytes")
        if length > size - at - _RECORD.size:
            raise TornError
        budget.offset = at
        if opcode in _LOADED:
            budget.unpack(length)
            content = file.read(length)
            if opcode == Opcode.DATA_END:
                _check_data_end(content, checksum)
            elif opcode == Opcode.CHUNK:
                yield from _read_chunk(_unpack_chunk(content, budget), budget)
            else:
                yield from _parse_record(opcode, content)
            checksum = zlib.crc32(content, zlib.crc32(head, checksum))
        else:
            checksum = _skip_record(file, length, zlib.crc32(head, checksum))
        at += _RECORD.size + length
        if opcode == Opcode.FOOTER:
            if len(end := file.read(len(MAGIC))) < len(MAGIC):
                raise TornError
            if end != MAGIC:
                raise InvalidMagic(end)
            return


def _skip_record(file: BinaryIO, length: int, checksum: int) -> int:
    """Skip a record, block by block; return the checksum of all bytes so far."""
    while length > 0:
        block = file.read(min(length, _BLOCK_BYTES))
        if not block:
            raise TornError
        checksum, length = zlib.crc32(block, checksum), length - len(block)
    return checksum


def _check_data_end(content: bytes, checksum: int) -> None:
    stored = DataEnd.read(ReadDataStream(BytesIO(content))).data_section_crc
    if stored not in (0, checksum):
        raise McapError(f"the checksum of its data is {checksum}, not {stored}")


def _unpack_chunk(content: bytes, budget: ReadBudget) -> bytes:
    """Unpack the records of a chunk; more bytes than it claims are an error."""
    chunk = Chunk.read(ReadDataStream(BytesIO(content)))
    data: bytes = chunk.data
    size = chunk.uncompressed_size
    budget.unpack(size)
    if chunk.compression == "zstd":
        # Not in one call: that allocates what the frame says, which may be anything.
        with zstandard.ZstdDecompressor().stream_reader(data, read_across_frames=True) as frames:
            data = frames.read(size + 1)
    elif chunk.compression == "lz4":
        decompressor = lz4.frame.LZ4FrameDecompressor()
        data = decompressor.decompress(data, max_length=size + 1)
        if not decompressor.eof and len(data) <= size:
            raise McapError("a chunk is cut")
    elif chunk.compression:
        raise UnsupportedCompressionError(chunk.compression)
    if len(data) > size:
        raise McapError(f"a chunk unpacks to more than its {size} bytes")
    if chunk.uncompressed_crc not in (0, zlib.crc32(data)):
        raise McapError("a chunk has a wrong checksum")
    return data


def _read_chunk(content: bytes, budget: ReadBudget) -> Iterator[Schema | Channel | ChannelMessage]:
    at, size = 0, len(content)
    while at < size:
        budget.take_record()
        opcode, length = _RECORD.unpack_from(content, at)
        begin, at = at + _RECORD.size, at + _RECORD.size + length
        if at > size:
            raise McapError("a record is longer than its chunk")
        if opcode == Opcode.MESSAGE:
            yield _parse_message(content, begin, at)
        elif opcode in _LOADED:
            yield from _parse_record(opcode, content[begin:at])


def _parse_record(opcode: int, content: bytes) -> Iterator[Schema | Channel | ChannelMessage]:
    """Yield the record if it is a schema, channel or message."""
    if opcode == Opcode.MESSAGE:
        yield _parse_message(content, 0, len(content))
    elif opcode == Opcode.SCHEMA:
        yield Schema.read(ReadDataStream(BytesIO(content)))
    elif opcode == Opcode.CHANNEL:
        yield Channel.read(ReadDataStream(BytesIO(content)))


def _parse_message(content: bytes, begin: int, end: int) -> ChannelMessage:
    channel_id, _, log_ns, publish_ns = _MESSAGE.unpack_from(content, begin)
    return ChannelMessage(channel_id, log_ns or publish_ns, content[begin + _MESSAGE.size : end])
