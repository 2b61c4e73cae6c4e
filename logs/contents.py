"""Messages of a chunk, and whether they follow each other without a gap."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Schema

from logs.topics import Definition, definition
from uavctl.errors import RecordingError

_RECORD = struct.Struct("<BQ")  # opcode, length
_MESSAGE = struct.Struct("<BQHIQQ")  # opcode, length, channel, sequence, log time, publish time
_IS_MESSAGE = int(Opcode.MESSAGE)  # a plain number: compared for every record


class Message(NamedTuple):
    """A message whose chunk has the right checksum."""

    definition: Definition
    sequence: int
    at_ns: int
    data: bytes
    offset: int  # of its chunk in the file
    repeated: bool = False  # header or library, once more, at the start of a later segment


@dataclass
class Order:
    """Where a reader is that wants all of a recording or none; goes from file to file with it.

    Attributes:
        path: the recording, for the error.
        following: number that the next message has; None before the first.
    """

    path: Path
    following: int | None = None

    def broken(self, sequence: int) -> RecordingError:
        """The error of a message that does not follow."""
        return RecordingError(
            f"{self.path}: message {sequence} where {self.following} should be (is a segment file gone?); "
            f"`uavctl log recover {self.path} OUT` restores the rest"
        )


class Contents:
    """Messages of chunks; remembers the schemas that it has seen."""

    def __init__(self) -> None:
        self._schemas: dict[int, Schema] = {}
        self._known: dict[bytes, tuple[int, Definition]] = {}

    def messages(self, content: bytes, offset: int, order: Order | None = None) -> Iterator[Message]:
        """Messages of one chunk, whose checksum is right.

        Args:
            content: the chunk.
            offset: its place in the file.
            order: where the reader is, moved on; then without those for viewers, which are half of a recording.

        Raises:
            RecordingError: a message is missing that the order wants.
        """
        channels: dict[int, Definition] = {}
        at = 0
        size = len(content)
        while at < size:
            if content[at] != _IS_MESSAGE:
                at = self._define(content, at, channels)
                continue
            _, length, channel, sequence, at_ns, _ = _MESSAGE.unpack_from(content, at)
            begin, at = at + _MESSAGE.size, at + _RECORD.size + length
            definition = channels[channel]
            if order is not None:
                if sequence != order.following and order.following is not None:
                    raise order.broken(sequence)
                order.following = sequence + 1
                if definition.for_viewers:
                    continue
            yield Message(definition, sequence, at_ns, content[begin:at], offset)

    def _define(self, content: bytes, at: int, channels: dict[int, Definition]) -> int:
        """Take a channel or schema; the place after it."""
        opcode, length = _RECORD.unpack_from(content, at)
        at += _RECORD.size
        if opcode == Opcode.CHANNEL:
            channel, channels[channel] = self._channel(content[at : at + length])
        elif opcode == Opcode.SCHEMA:
            schema = Schema.read(ReadDataStream(BytesIO(content[at : at + length])))
            self._schemas[schema.id] = schema
        return int(at + length)

    def _channel(self, record: bytes) -> tuple[int, Definition]:
        if record not in self._known:
            channel = Channel.read(ReadDataStream(BytesIO(record)))
            schema = self._schemas.get(channel.schema_id)
            self._known[record] = (channel.id, _definition(channel, schema))
        return self._known[record]


def _definition(channel: Channel, schema: Schema | None) -> Definition:
    if schema is not None:
        return Definition(channel.topic, channel.message_encoding, schema.name, schema.encoding, schema.data)
    try:
        return definition(channel.topic)  # the chunk with its schema is damaged
    except KeyError:
        return Definition(channel.topic, channel.message_encoding)
