"""MCAP files of other programs: raw MAVLink frames out of whatever topics hold them.

There is no agreed name for such a topic, nor for its encoding, so the bytes decide. The file is read from its front
to its end, so it needs neither chunks nor a summary.
"""

from __future__ import annotations

import struct
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO, NamedTuple

import zstandard
from mcap.exceptions import EndOfFile, McapError
from mcap.records import Channel, Message
from mcap.stream_reader import StreamReader

from logs.segment import MAGIC
from logs.tlog import MARKERS, TlogPacket, frame_length, packet_of
from uavctl.errors import RecordingError, UsageError
from uavctl.mavlink.framing import scan

_OURS = "/uavctl/"
_TOLD = 12  # topics that an error names
# What the library raises on bytes that are no MCAP: its own, and those of the formats within.
_DAMAGE = (McapError, ValueError, OverflowError, RuntimeError, struct.error, zstandard.ZstdError)


@dataclass(frozen=True)
class ForeignMcap:
    """MAVLink of an MCAP.

    Attributes:
        packets: In order of arrival, which is the log time; one frame each.
        topics: Those that hold them.
        torn: The file ends in the middle of a record; what was before is here.
    """

    packets: tuple[TlogPacket, ...]
    topics: tuple[str, ...]
    torn: bool


class _Piece(NamedTuple):
    """A message that begins as a frame does."""

    at_ns: int
    data: bytes


@dataclass
class _Topic:
    """One topic's messages."""

    encodings: Counter[str] = field(default_factory=Counter)
    pieces: list[_Piece] = field(default_factory=list)
    checked: bool = False  # one frame had the right checksum

    @property
    def is_mavlink(self) -> bool:
        """Whether a frame of it was right, and most messages begin as one."""
        return self.checked and 2 * len(self.pieces) > sum(self.encodings.values())

    def take(self, encoding: str, at_ns: int, data: bytes) -> None:
        """Count a message, and keep it if it may hold frames."""
        self.encodings[encoding] += 1
        if data[:1] and data[0] in MARKERS:
            self.pieces.append(_Piece(at_ns, data))
            self.checked = self.checked or bool(scan(data, final=True).frames)


def is_foreign(path: Path) -> bool:
    """Whether a file is an MCAP with messages and none of ours among its topics.

    What cannot be read up to its first topic is left to the reader of our recordings, which says what is wrong.

    Raises:
        RecordingError: It cannot be read.
    """
    found = False
    try:
        with path.open("rb") as file:
            if file.read(len(MAGIC)) != MAGIC:
                return False
            file.seek(0)
            for record in _records(file, path.stat().st_size):
                if isinstance(record, Channel):
                    found = True
                    if record.topic.startswith(_OURS):
                        return False
    except (FileNotFoundError, IsADirectoryError):
        return False  # a recording of ours may have later segments only; of a folder its reader knows what to do
    except OSError as error:
        raise RecordingError(f"{path}: {error.strerror}") from error
    except _DAMAGE:
        return found
    return found


def read_mcap(path: Path, topics: Sequence[str] = ()) -> ForeignMcap:
    """All MAVLink packets of an MCAP: raw frames, one or more a message.

    Args:
        path: The file; chunks may be stored, or packed with lz4 or zstd.
        topics: The topics to take; those that hold MAVLink if none is named.

    Raises:
        RecordingError: Damaged, or nothing in it is MAVLink; the message lists what is.
        UsageError: There is no such topic.
    """
    found: defaultdict[str, _Topic] = defaultdict(_Topic)
    channels: dict[int, Channel] = {}
    try:
        with path.open("rb") as file:
            torn = _collect(file, path.stat().st_size, topics, channels, found)
    except OSError as error:
        raise RecordingError(f"{path}: {error.strerror}") from error
    except _DAMAGE as error:
        raise RecordingError(f"{path}: damaged, or no MCAP ({error}); mcap's own tool may recover it") from error
    _check_names(path, topics, channels)
    taken = tuple(name for name, topic in found.items() if topic.is_mavlink)
    if not taken:
        raise RecordingError(f"{path}: no raw MAVLink in it; {_listed(channels, found)}")
    pieces = sorted((piece for name in taken for piece in found[name].pieces), key=lambda piece: piece.at_ns)
    packets = tuple(packet for piece in pieces for packet in _packets(piece))
    return ForeignMcap(packets=packets, topics=taken, torn=torn)


def _collect(
    file: BinaryIO, size: int, topics: Sequence[str], channels: dict[int, Channel], found: defaultdict[str, _Topic]
) -> bool:
    """Take all channels and the messages of these topics, or of all if there are none; whether the file is torn."""
    try:
        for record in _records(file, size):
            if isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, Message) and record.channel_id in channels:
                channel = channels[record.channel_id]
                if not topics or channel.topic in topics:
                    found[channel.topic].take(channel.message_encoding, record.log_time, record.data)
    except (EndOfFile, struct.error):
        if file.read(1):
            raise
        return True
    return False


def _records(file: BinaryIO, size: int) -> Iterator[object]:
    """Channels and messages of a file in file order, each chunk by its checksum if it has one."""
    # A damaged length must not ask for more memory than the file has bytes.
    yield from StreamReader(file, validate_crcs=True, record_size_limit=size).records


def _packets(piece: _Piece) -> Iterator[TlogPacket]:
    """The frames of a message; what does not end as one goes to the parser as it is, which counts it."""
    at = 0
    while at < len(piece.data):
        length = frame_length(piece.data, at) or len(piece.data) - at
        yield packet_of(piece.at_ns, piece.data[at : at + length])
        at += length


def _check_names(path: Path, topics: Sequence[str], channels: dict[int, Channel]) -> None:
    there = {channel.topic for channel in channels.values()}
    for topic in topics:
        if topic not in there:
            raise UsageError(f"--topic {topic}: {path} has none of this name; {_names(sorted(there))}")


def _listed(channels: dict[int, Channel], found: dict[str, _Topic]) -> str:
    """What a file holds instead."""
    encodings = {channel.topic: channel.message_encoding for channel in channels.values()}
    return _names(
        [
            f"{topic} ({encoding or 'no encoding'}, {sum(found[topic].encodings.values()) if topic in found else 0})"
            for topic, encoding in sorted(encodings.items())
        ]
    )


def _names(names: list[str]) -> str:
    if not names:
        return "it has no topic at all"
    more = f", and {len(names) - _TOLD} more" if len(names) > _TOLD else ""
    return f"it has: {', '.join(names[:_TOLD])}{more}"
