"""MCAP files of other programs: MAVLink out of whatever channels hold it.

There is no agreed name for such a topic, nor for its encoding, so the bytes decide: a channel is read as a stream of
frames, however it was cut into messages. ROS wraps each frame in a message of its own, which is unwrapped first. The
file is read from its front to its end, so it needs neither chunks nor a summary.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import zstandard
from mcap.exceptions import EndOfFile, McapError
from mcap.records import Channel, Message, Schema
from mcap.stream_reader import StreamReader

from logs.foreign_clock import SteadyClock
from logs.foreign_ros import UnreadableError, unwrapper
from logs.foreign_stream import cut
from logs.segment import MAGIC
from logs.summary import count
from logs.tlog import TlogPacket, in_order
from uavctl.errors import RecordingError, UsageError

_OURS = "/uavctl/"
_TOLD = 12  # channels that an error names
_PROBED_BYTES = 65_536  # without a frame in so many a channel holds something else
# What the library raises on bytes that are no MCAP: its own, and those of the formats within.
_DAMAGE = (McapError, ValueError, OverflowError, RuntimeError, struct.error, zstandard.ZstdError)


@dataclass(frozen=True)
class ForeignMcap:
    """MAVLink of an MCAP.

    Attributes:
        packets: In order of arrival, which is the log time; one frame each.
        topics: Those that hold them.
        torn: The file ends in the middle of a record; what was before is here.
        notes: What was left out, and what was odd about the times, in sentences.
    """

    packets: tuple[TlogPacket, ...]
    topics: tuple[str, ...]
    torn: bool
    notes: tuple[str, ...] = ()


class _Stream:
    """One channel as a stream of bytes.

    Args:
        channel: The channel.
        schema: Of its messages, if they have one.
        wanted: It was asked for, so it is read however little MAVLink is in it.
    """

    def __init__(self, channel: Channel, schema: Schema | None, *, wanted: bool) -> None:
        self.topic, self.encoding = channel.topic, channel.message_encoding
        self.kind = "" if schema is None else schema.name
        self.messages = 0
        self._unwrap: Callable[[bytes], bytes] | None = None
        if schema is not None:
            self._unwrap = unwrapper(self.encoding, schema.encoding, schema.name, schema.data)
        self._wanted = wanted
        self._pieces: list[tuple[int, bytes]] = []
        self._probe: bytearray | None = None if wanted or self._unwrap else bytearray()
        self._given_up = False
        self._unreadable, self._why = 0, ""

    def take(self, at_ns: int, data: bytes) -> None:
        """Take a message of log time `at_ns`."""
        self.messages += 1
        if self._given_up:
            return
        if self._unwrap is not None:
            try:
                data = self._unwrap(data)
            except UnreadableError as error:
                self._unreadable, self._why = self._unreadable + 1, str(error)
                return
        self._pieces.append((at_ns, data))
        if self._probe is not None:
            self._look(data)

    def packets(self) -> tuple[tuple[TlogPacket, ...], tuple[str, ...]]:
        """Its packets, none if it is no MAVLink, and what there is to say.

        Raises:
            RecordingError: Its log times are all zero.
        """
        clock = SteadyClock()
        pieces = [(clock.steady(at_ns), data) for at_ns, data in self._pieces]
        # A recorder of several threads writes not in order; a clock that was set back has been put right.
        found = cut(sorted(pieces, key=lambda piece: piece[0]))
        notes = []
        if self._unreadable:
            notes.append(f"{self.topic}: {count(self._unreadable, 'message')} left out: {self._why}")
        mostly = 2 * found.left_out_bytes < sum(len(data) for _, data in pieces)
        if found.right and not (mostly or self._wanted):
            notes.append(f"{self.topic}: not taken, most of it is no MAVLink; `--topic {self.topic}` takes it")
        if not found.right or not (mostly or self._wanted):
            return (), tuple(notes)
        clock.check(self.topic)
        if found.left_out_bytes:
            notes.append(f"{self.topic}: {count(found.left_out_bytes, 'byte')} left out that are no whole frame")
        return found.packets, (*notes, *clock.notes(self.topic))

    def listed(self) -> str:
        """What it holds, for an error."""
        kind = f", {self.kind}" if self.kind else ""
        return f"{self.topic} ({self.encoding or 'no encoding'}{kind}, {self.messages})"

    def _look(self, data: bytes) -> None:
        """Look for a first frame, and keep nothing of a channel that has none for long."""
        assert self._probe is not None
        self._probe += data[: _PROBED_BYTES - len(self._probe)]
        if len(self._probe) < _PROBED_BYTES:
            return
        self._given_up = not cut([(0, bytes(self._probe))]).right
        self._probe = None
        if self._given_up:
            self._pieces.clear()


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
    """All MAVLink packets of an MCAP: raw frames, cut into messages anywhere, or wrapped by ROS one by one.

    Args:
        path: The file; chunks may be stored, or packed with lz4 or zstd.
        topics: The topics to take; those that hold MAVLink if none is named.

    Raises:
        RecordingError: Damaged, nothing in it is MAVLink (the message lists what is), or it has no times.
        UsageError: There is no such topic.
    """
    streams: dict[int, _Stream] = {}
    try:
        with path.open("rb") as file:
            torn = _collect(file, path.stat().st_size, topics, streams)
    except OSError as error:
        raise RecordingError(f"{path}: {error.strerror}") from error
    except _DAMAGE as error:
        raise RecordingError(f"{path}: damaged, or no MCAP ({error}); mcap's own tool may recover it") from error
    _check_names(path, topics, streams)
    packets: list[TlogPacket] = []
    taken: list[str] = []
    notes: list[str] = []
    for stream in streams.values():
        if topics and stream.topic not in topics:
            continue
        found, told = stream.packets()
        packets += found
        taken += [stream.topic] if found else []
        notes += told
    if not taken:
        listed = _names(sorted(stream.listed() for stream in streams.values()))
        raise RecordingError("; ".join([f"{path}: no raw MAVLink in it", listed, *notes]))
    return ForeignMcap(in_order(packets), tuple(dict.fromkeys(taken)), torn, tuple(notes))


def _collect(file: BinaryIO, size: int, topics: Sequence[str], streams: dict[int, _Stream]) -> bool:
    """Take the messages of these topics, or of all if there are none; whether the file is torn."""
    schemas: dict[int, Schema] = {}
    try:
        for record in _records(file, size):
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel) and record.id not in streams:
                streams[record.id] = _Stream(record, schemas.get(record.schema_id), wanted=record.topic in topics)
            elif isinstance(record, Message) and record.channel_id in streams:
                stream = streams[record.channel_id]
                if not topics or stream.topic in topics:
                    stream.take(record.log_time or record.publish_time, record.data)
    except (EndOfFile, struct.error):
        if file.read(1):
            raise
        return True
    return False


def _records(file: BinaryIO, size: int) -> Iterator[object]:
    """Channels and messages of a file in file order, each chunk by its checksum if it has one."""
    # A damaged length must not ask for more memory than the file has bytes.
    yield from StreamReader(file, validate_crcs=True, record_size_limit=size).records


def _check_names(path: Path, topics: Sequence[str], streams: dict[int, _Stream]) -> None:
    there = {stream.topic for stream in streams.values()}
    for topic in topics:
        if topic not in there:
            raise UsageError(f"--topic {topic}: {path} has none of this name; {_names(sorted(there))}")


def _names(names: list[str]) -> str:
    if not names:
        return "it has no topic at all"
    more = f", and {len(names) - _TOLD} more" if len(names) > _TOLD else ""
    return f"it has: {', '.join(names[:_TOLD])}{more}"
