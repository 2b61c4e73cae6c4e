"""Recordings of other programs: `.tlog`, ULog, and MAVLink in any channel of MCAP files.

An MCAP has no agreed name for such a topic, nor for its encoding, so the bytes decide:

1. `mcap_records` yields the messages of each channel.
2. `mavros` unwraps messages in which ROS wraps one frame each.
3. `ros_poses` makes frames of ROS's poses, where nothing holds MAVLink or their topic is asked for.
4. `cut_stream` cuts the bytes of a channel into frames, wherever its messages began.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import msgspec
from mcap.records import Channel, Schema

from logs.recording.budget import ExcessError, ReadBudget
from logs.recording.file_kind import MAGIC, FileKind, detect_kind
from logs.recording.mavlink_flight import MavlinkFlight, make_flight
from logs.recording.mavros import DEFINITION_RATIO, Definitions, UnreadableError, Unwrapper, make_unwrapper
from logs.recording.mcap_records import DAMAGE_ERRORS, ChannelMessage, TornError, read_records
from logs.recording.ros_poses import STATE_BYTES, PoseUnwrapper, parse_pose_type
from logs.recording.summary import count
from logs.recording.tlog import (
    MARKERS,
    MonotonicClock,
    Tlog,
    TlogPacket,
    find_next_marker,
    get_frame_length,
    make_packet,
    read_tlog,
    sort_packets,
)
from logs.recording.ulog import is_ulog, read_ulog
from uavctl.errors import RecordingError, UsageError
from uavctl.mavlink.framing import is_frame


@dataclass(frozen=True)
class FrameStream:
    """Frames of a stream of bytes, and counts of its omissions."""

    # Its frames in the order of the stream, each at the time of the piece that its last byte came in
    packets: tuple[TlogPacket, ...]
    valid_count: int  # those of a known id with the right checksum
    left_out_bytes: int  # bytes that are no frame: garbage, and frames that were cut


def cut_stream(pieces: list[tuple[int, bytes]]) -> FrameStream:
    """Cut a stream into frames.

    Frames with a wrong checksum or of an unknown id are kept where they stand between others: the parser counts them.

    Args:
        pieces: (time [ns], bytes) in the order of the stream.
    """
    data = b"".join(piece for _, piece in pieces)
    ends, at = [], 0
    for _, piece in pieces:
        at += len(piece)
        ends.append(at)
    packets: list[TlogPacket] = []
    at = valid_count = left_out = 0
    is_aligned = True  # the bytes before `at` were a frame
    while at < len(data):
        end = at + get_frame_length(data, at)
        is_whole = at < end <= len(data)
        is_right = is_whole and is_frame(data[at:end])
        is_aligned = is_right or (is_whole and is_aligned and (end == len(data) or data[end] in MARKERS))
        if not is_aligned:
            end = find_next_marker(data, at + 1)
            left_out += end - at
        else:
            valid_count += is_right
            packets.append(make_packet(pieces[bisect_right(ends, end - 1)][0], data[at:end]))
        at = end
    return FrameStream(tuple(packets), valid_count, left_out)


_OURS = "/uavctl/"
_MAX_NAMED_CHANNELS = 12  # channels that an error names
_PIECE_BYTES = 64  # of memory for each piece of a stream, besides its bytes
_PROBED_BYTES = 65_536  # without a frame in so many a channel holds something else


@dataclass(frozen=True)
class ForeignMcap:
    """MAVLink packets of an MCAP file of another program."""

    packets: tuple[TlogPacket, ...]  # in order of arrival, which is the log time; one frame each
    topics: tuple[str, ...]  # those that hold them
    torn: bool  # the file ends in the middle of a record; what was before is here
    notes: tuple[str, ...] = ()  # what was left out, and what was odd about the times, in sentences


class _ChannelStream(msgspec.Struct, gc=False):
    """One channel as a stream of bytes.

    A file may have a channel for every 60 bytes: it holds no dictionary, nothing that leads back to it, and no list
    before its first message, so the garbage collector is spared.

    Attributes:
        topic: Topic of the channel.
        encoding: Encoding of its messages.
        kind: Name of their schema; empty if they have none.
        unwrap: Makes a frame of each message, if they are MAVLink wrapped by ROS, or poses.
        is_requested: It was asked for, so it is read however little MAVLink is in it.
        budget: Bounds the kept bytes.
        messages: Number of messages so far.
        pieces: Log times [ns] and bytes of messages; None before any.
        probe: First bytes of a channel in which no frame was found yet; None where none is looked for.
        is_unreadable: Nothing in it is MAVLink.
        unreadable: Number of messages that cannot be unwrapped, and
        reason: why the last one cannot.
    """

    topic: str
    encoding: str
    kind: str
    unwrap: Unwrapper | PoseUnwrapper | None
    is_requested: bool
    budget: ReadBudget
    messages: int = 0
    pieces: list[tuple[int, bytes]] | None = None
    probe: bytearray | None = None
    is_unreadable: bool = False
    unreadable: int = 0
    reason: str = ""

    def add_message(self, at_ns: int, data: bytes) -> None:
        """Add a message of log time `at_ns`."""
        self.messages += 1
        if self.is_unreadable:
            return
        if self.unwrap is not None:
            try:
                data = self.unwrap(data)
            except UnreadableError as error:
                self.unreadable, self.reason = self.unreadable + 1, str(error)
                return
        if not data:
            return
        self.budget.keep(_PIECE_BYTES + len(data))
        if self.pieces is None:
            self.pieces = []
            self.probe = None if self.is_requested or self.unwrap else bytearray()
        self.pieces.append((at_ns, data))
        if self.probe is not None:
            self._probe_frames(self.probe, data)

    @property
    def has_poses(self) -> bool:
        """Whether its frames are made of poses."""
        return isinstance(self.unwrap, PoseUnwrapper)

    def make_packets(self) -> tuple[tuple[TlogPacket, ...], tuple[str, ...]]:
        """Return the channel's packets, none if it holds no MAVLink, and remarks on it.

        Raises:
            RecordingError: Its log times are all zero.
        """
        clock = MonotonicClock()
        pieces = [(clock.convert(at_ns), data) for at_ns, data in self.pieces or ()]
        # A recorder of several threads writes not in order; a clock that was set back has been put right.
        stream = cut_stream(sorted(pieces, key=lambda piece: piece[0]))
        notes = []
        if self.unreadable:
            notes.append(f"{self.topic}: {count(self.unreadable, 'message')} left out: {self.reason}")
        is_mostly_mavlink = 2 * stream.left_out_bytes < sum(len(data) for _, data in pieces)
        if stream.valid_count and not (is_mostly_mavlink or self.is_requested):
            notes.append(f"{self.topic}: not taken, most of it is no MAVLink; `--topic {self.topic}` takes it")
        if not stream.valid_count or not (is_mostly_mavlink or self.is_requested):
            return (), tuple(notes)
        clock.check(self.topic)
        if stream.left_out_bytes:
            notes.append(f"{self.topic}: {count(stream.left_out_bytes, 'byte')} left out that are no whole frame")
        return stream.packets, (*notes, *clock.describe_oddities(self.topic))

    def describe(self) -> str:
        """Describe the content of the channel, for an error."""
        kind = f", {self.kind}" if self.kind else ""
        return f"{self.topic} ({self.encoding or 'no encoding'}{kind}, {self.messages})"

    def _probe_frames(self, probe: bytearray, data: bytes) -> None:
        """Look for a first frame; drop the messages of a channel without one in `_PROBED_BYTES`."""
        probe += data[: _PROBED_BYTES - len(probe)]
        if len(probe) < _PROBED_BYTES:
            return
        self.is_unreadable = not cut_stream([(0, bytes(probe))]).valid_count
        self.probe = None
        if self.is_unreadable:
            self.pieces = []


def is_foreign(path: Path) -> bool:
    """Return whether a file is an MCAP with messages, none of them of our topics.

    What cannot be read up to its first topic is left to the reader of our recordings, which says what is wrong.

    Raises:
        RecordingError: It cannot be read.
    """
    has_messages = False
    try:
        with path.open("rb") as file:
            if file.read(len(MAGIC)) != MAGIC:
                return False
            file.seek(0)
            size = path.stat().st_size
            for record in read_records(file, size, ReadBudget(size)):
                if isinstance(record, Channel):
                    has_messages = True
                    if record.topic.startswith(_OURS):
                        return False
    except (FileNotFoundError, IsADirectoryError):
        return False  # a recording of ours may have later segments only; of a folder its reader knows what to do
    except OSError as error:
        raise RecordingError(f"{path}: {error.strerror}") from error
    except (*DAMAGE_ERRORS, ExcessError, TornError):
        return has_messages
    return has_messages


def read_mcap(path: Path, topics: Sequence[str] = ()) -> ForeignMcap:
    """Read all MAVLink packets of an MCAP: raw frames, cut into messages anywhere, or wrapped by ROS one by one.

    Poses of ROS are packets too, where their topic is named, or it is the only one and nothing is MAVLink.

    Args:
        path: The file; chunks may be stored, or packed with lz4 or zstd.
        topics: The topics to take; those that hold MAVLink if none is named.

    Raises:
        RecordingError: Damaged, nothing in it is MAVLink (the message lists what is), or it has no times.
        UsageError: There is no such topic, or poses are of several topics.
    """
    streams: dict[int, _ChannelStream] = {}
    try:
        with path.open("rb") as file:
            torn = _collect_messages(file, path.stat().st_size, topics, streams)
    except OSError as error:
        raise RecordingError(f"{path}: {error.strerror}") from error
    except ExcessError as error:
        raise RecordingError(
            f"{path}, {error}; do not trust it, or write its MAVLink alone into another file"
        ) from error
    except DAMAGE_ERRORS as error:
        raise RecordingError(f"{path}: damaged, or no MCAP ({error}); mcap's own tool may recover it") from error
    _check_topics(path, topics, streams)
    packets: list[TlogPacket] = []
    used_topics: list[str] = []
    notes: list[str] = []
    chosen = [stream for stream in streams.values() if not topics or stream.topic in topics]
    for has_poses in (False, True):
        group = [stream for stream in chosen if stream.has_poses is has_poses]
        if has_poses and used_topics and not topics:
            break
        if has_poses:
            _check_pose_topics(path, group)
        for stream in group:
            stream_packets, stream_notes = stream.make_packets()
            packets += stream_packets
            used_topics += [stream.topic] if stream_packets else []
            notes += stream_notes
    if not used_topics:
        listed = _format_names(sorted(stream.describe() for stream in streams.values()))
        raise RecordingError("; ".join([f"{path}: no raw MAVLink in it", listed, *notes]))
    return ForeignMcap(sort_packets(packets), tuple(dict.fromkeys(used_topics)), torn, tuple(notes))


def _check_pose_topics(path: Path, streams: list[_ChannelStream]) -> None:
    """Refuse poses of several topics, which may be several bodies."""
    names = sorted({stream.topic for stream in streams if stream.pieces})
    if len(names) > 1:
        raise UsageError(f"{path}: poses of several topics; choose one with --topic: {', '.join(names)}")


def _collect_messages(file: BinaryIO, size: int, topics: Sequence[str], streams: dict[int, _ChannelStream]) -> bool:
    """Take the messages of some topics, or of all if none is given; return whether the file is torn.

    Raises:
        ExcessError: A record asks for more than the budget has; names its offset.
    """
    # Contents by id: encoding, name, definition
    schemas: dict[int, tuple[str, str, bytes]] = {}
    # By the content of a schema, and the encoding of messages: a recorder may repeat a schema for each topic.
    unwrappers: dict[tuple[str, str, bytes, str], Unwrapper | None] = {}
    pose_types: dict[tuple[str, str, bytes, str], Definitions | None] = {}
    budget = ReadBudget(size)
    try:
        for record in read_records(file, size, budget):
            if isinstance(record, ChannelMessage):
                stream = streams.get(record.channel_id)
                if stream is not None and (not topics or stream.topic in topics):
                    stream.add_message(record.at_ns, record.data)
            elif isinstance(record, Schema):
                content = record.encoding, record.name, record.data
                if schemas.get(record.id) != content:
                    budget.keep(len(record.name) + len(record.data))
                    schemas[record.id] = content
            elif record.id not in streams:
                budget.keep(_PIECE_BYTES + len(record.topic) + len(record.message_encoding))
                schema = schemas.get(record.schema_id)
                schema_encoding, name, definition = schema or ("", "", b"")
                key = schema_encoding, name, definition, record.message_encoding
                if schema is None:
                    unwrappers[key] = None
                elif key not in unwrappers:
                    unwrappers[key] = make_unwrapper(record.message_encoding, schema_encoding, name, definition)
                    pose_types[key] = parse_pose_type(record.message_encoding, schema_encoding, name, definition)
                    if unwrappers[key] is not None or pose_types[key] is not None:
                        budget.keep(DEFINITION_RATIO * len(definition))
                unwrap: Unwrapper | PoseUnwrapper | None = unwrappers[key]
                types = pose_types.get(key)
                if types is not None:
                    budget.keep(STATE_BYTES)
                    unwrap = PoseUnwrapper(types, name, record.message_encoding, record.topic)
                streams[record.id] = _ChannelStream(
                    topic=record.topic,
                    encoding=record.message_encoding,
                    kind=name,
                    unwrap=unwrap,
                    is_requested=record.topic in topics,
                    budget=budget,
                )
    except TornError:
        return True
    except ExcessError as error:
        raise ExcessError(f"offset {budget.offset}: a record {error}") from error
    return False


def _check_topics(path: Path, topics: Sequence[str], streams: dict[int, _ChannelStream]) -> None:
    present = {stream.topic for stream in streams.values()}
    for topic in topics:
        if topic not in present:
            raise UsageError(f"--topic {topic}: {path} has none of this name; {_format_names(sorted(present))}")


def _format_names(names: list[str]) -> str:
    if not names:
        return "it has no topic at all"
    more = f", and {len(names) - _MAX_NAMED_CHANNELS} more" if len(names) > _MAX_NAMED_CHANNELS else ""
    return f"it has: {', '.join(names[:_MAX_NAMED_CHANNELS])}{more}"


def read_foreign_packets(path: Path, topics: Sequence[str] = ()) -> Tlog | None:
    """Return the MAVLink packets of another program's recording, and its oddities; None if it is of no such kind.

    Args:
        path: The file.
        topics: Topics of an MCAP to take; all that hold MAVLink if none is named.

    Raises:
        RecordingError: It cannot be read, or holds no MAVLink.
        UsageError: It has no such topic.
    """
    if detect_kind(path) is FileKind.TLOG and path.exists():
        if topics:
            raise UsageError("--topic is for an MCAP: a .tlog has no topics")
        return read_tlog(path)
    if detect_kind(path) is not FileKind.MCAP or not is_foreign(path):
        return None
    recording = read_mcap(path, topics)
    torn = ("the recording is torn: read up to its end",) if recording.torn else ()
    return Tlog(recording.packets, clock_notes=(f"MAVLink in {', '.join(recording.topics)}", *recording.notes, *torn))


def read_foreign_flight(path: Path, system: int | None = None) -> MavlinkFlight | None:
    """Return the flight in another program's recording; None if it is one of ours.

    Args:
        path: The file.
        system: The vehicle's system id; None for the first that is heard.

    Raises:
        RecordingError: It cannot be read, or tells nothing.
        UsageError: There is nothing of that system, or the recording is of one vehicle alone.
    """
    if is_ulog(path):
        if system is not None:
            raise UsageError("--system is for MAVLink: a ULog is of one vehicle")
        return read_ulog(path)
    log = read_tlog(path) if detect_kind(path) is FileKind.TLOG else read_foreign_packets(path)
    if log is not None:
        return make_flight(log, str(path), system)
    if system is not None:
        raise UsageError("--system is for another program's MAVLink: a recording of uavctl has one vehicle")
    return None
