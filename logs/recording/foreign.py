"""Recordings of other programs: `.tlog`, ULog, and MAVLink out of MCAP files, whatever channels hold it.

In an MCAP there is no agreed name for such a topic, nor for its encoding, so the bytes decide: a channel is read as a
stream of frames, however it was cut into messages. ROS wraps each frame in a message of its own, which is unwrapped
first. The file is read from its front to its end, so it needs neither chunks nor a summary.
"""

from __future__ import annotations

import re
import struct
import zlib
from bisect import bisect_right
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, NamedTuple

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import InvalidMagic, McapError, UnsupportedCompressionError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, DataEnd, Schema

from logs.recording.budget import ExcessError, ReadBudget
from logs.recording.disk import MAGIC, FileKind, detect_kind
from logs.recording.mavlink_flight import MavlinkFlight, flight_in
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

ROS1, ROS2 = "ros1", "cdr"  # encodings of messages
_DEFINITIONS = {ROS1: "ros1msg", ROS2: "ros2msg"}  # and of their schemas
_NUMBERS = {
    "bool": "B",
    "byte": "B",
    "char": "B",
    "int8": "b",
    "uint8": "B",
    "int16": "h",
    "uint16": "H",
    "int32": "i",
    "uint32": "I",
    "int64": "q",
    "uint64": "Q",
    "float32": "f",
    "float64": "d",
}
_STAMPS = {"time": "I", "duration": "i", "builtin_interfaces/Time": "i", "builtin_interfaces/Duration": "i"}
_FIELD = re.compile(
    r"^(?P<type>[A-Za-z][\w/]*)(?:<=\d+)?(?P<array>\[(?:<=)?(?P<size>\d*)\])?\s+(?P<name>\w+)(?P<rest>.*)$"
)
_BORDER = re.compile(r"^=+\s*$", re.MULTILINE)
_HEAD_BYTES = 4  # of CDR
_ORDERS = {0: ">", 1: "<", 6: ">", 7: "<"}  # second byte of CDR: XCDR1 and XCDR2, plain
_ALIGNED_MOST = {0: 8, 1: 8, 6: 4, 7: 4}
# Of a message that wraps a frame, at most: a frame has 280 bytes, mavros_msgs/Mavlink 16 fields.
_MAX_WRAPPED_BYTES, _MAX_STEPS = 4096, 256
_MAX_DEPTH = 64  # of types within types
_MAX_DEFINITION_BYTES = 2**16  # of such a message; that of mavros_msgs/Mavlink has 3000
_FIELD_RATIO = 64  # bytes of memory for each byte of a definition that was parsed
_V1, _V2 = 0xFE, 0xFD
_SIGNED = 0x01
_SIGNATURE_BYTES = 13
_NEEDED = frozenset(("magic", "len", "seq", "sysid", "compid", "msgid", "checksum", "payload64"))

Value = int | float | bytes | list["Value"] | dict[str, "Value"]


class _RosField(NamedTuple):
    type: str
    name: str
    size: int | None  # of an array; 0: as many as the message says; None: no array


Definitions = dict[str, list[_RosField]]
Unwrapper = Callable[[bytes], bytes]  # the frame in a message


class UnreadableError(Exception):
    """A message or its definition is not as it should be; says why."""


def make_unwrapper(encoding: str, schema_encoding: str, name: str, definition: bytes) -> Unwrapper | None:
    """Return a function that makes a frame of each message of a channel, if they are MAVLink wrapped by ROS.

    Such messages are known by their fields, those of mavros_msgs/Mavlink, wherever they stand in the definition.

    Returns:
        None if they are something else. The function raises `UnreadableError` for a message that is damaged.
    """
    if _DEFINITIONS.get(encoding) != schema_encoding or len(definition) > _MAX_DEFINITION_BYTES:
        return None
    if not all(field.encode() in definition for field in _NEEDED):
        return None
    top = _normalise_type_name(name)
    try:
        types = _parse_definition(top, definition.decode("utf-8", errors="replace"))
    except UnreadableError:
        return None
    if not _NEEDED.issubset(field.name for field in types[top]):
        return None

    def unwrap(data: bytes) -> bytes:
        return _make_frame(_RosReader(data, types, encoding).record(top))

    return unwrap


def _normalise_type_name(name: str) -> str:
    """Return a type's name as ROS 1 has it: without `msg` between package and type."""
    return name.replace("/msg/", "/")


def _parse_definition(top: str, text: str) -> Definitions:
    """Return the fields of all types in a ROS message definition, without constants and comments."""
    types: Definitions = {}
    for number, part in enumerate(_BORDER.split(text)):
        lines = [line.partition("#")[0].strip() for line in part.splitlines()]
        lines = [line for line in lines if line]
        owner = top
        if number:
            if not lines or not lines[0].startswith("MSG:"):
                raise UnreadableError("a definition without its name")
            owner = _normalise_type_name(lines.pop(0).removeprefix("MSG:").strip())
        types[owner] = [field for line in lines if (field := _parse_field(line, owner)) is not None]
    return types


def _parse_field(line: str, owner: str) -> _RosField | None:
    """Return a field of a definition; None for a constant."""
    match = _FIELD.match(line)
    if match is None:
        raise UnreadableError(f"cannot make sense of {line!r}")
    if match["rest"].lstrip().startswith("="):
        return None
    kind = _normalise_type_name(match["type"])
    if kind == "Header":
        kind = "std_msgs/Header"
    elif "/" not in kind and kind not in _NUMBERS and kind not in _STAMPS and kind not in ("string", "wstring"):
        kind = f"{owner.rpartition('/')[0]}/{kind}"
    size = int(match["size"]) if match["array"] and match["size"] and "<=" not in match["array"] else 0
    return _RosField(kind, match["name"], size if match["array"] else None)


class _RosReader:
    """Reader of one serialised ROS message.

    A definition may nest types that have no bytes, or lists of them: the steps of reading are bounded.
    """

    def __init__(self, data: bytes, types: Mapping[str, list[_RosField]], encoding: str) -> None:
        self._types, self._cdr = types, encoding == ROS2
        self._order, self._aligned_most = "<", 1
        self._at, self._data = 0, data
        self._steps_left = _MAX_STEPS
        self._depth = 0
        if len(data) > _MAX_WRAPPED_BYTES:
            raise UnreadableError(f"it has {len(data)} bytes, which is far more than a frame has")
        if self._cdr:
            if len(data) < _HEAD_BYTES or data[0] or data[1] not in _ORDERS:
                raise UnreadableError("its first bytes are not those of CDR")
            self._order, self._aligned_most = _ORDERS[data[1]], _ALIGNED_MOST[data[1]]
            self._data = data[_HEAD_BYTES:]

    def record(self, kind: str) -> dict[str, Value]:
        """Read all fields of a type."""
        if kind not in self._types:
            raise UnreadableError(f"its definition says nothing of {kind}")
        if self._depth >= _MAX_DEPTH:
            raise UnreadableError(f"its definition nests more than {_MAX_DEPTH} deep")
        self._depth += 1
        fields = {field.name: self._field(field) for field in self._types[kind]}
        self._depth -= 1
        return fields

    def _field(self, field: _RosField) -> Value:
        self._take_step()
        if field.size is None:
            return self._read_value(field.type)
        length = field.size or self._number("I")
        letter = _NUMBERS.get(field.type)
        if letter is None:
            if length > len(self._data):
                raise UnreadableError("it is too short")
            return [self._read_value(field.type) for _ in range(length)]
        return list(self._numbers(letter, length))

    def _take_step(self) -> None:
        if self._steps_left <= 0:
            raise UnreadableError(f"it has more values, by its definition, than the {_MAX_STEPS} that are read")
        self._steps_left -= 1

    def _read_value(self, kind: str) -> Value:
        self._take_step()
        if kind in _NUMBERS:
            return self._number(_NUMBERS[kind])
        if kind in _STAMPS:
            return [self._number(_STAMPS[kind]), self._number("I")]
        if kind == "string":
            return self._take(self._number("I"))
        return self.record(kind)

    def _number(self, letter: str) -> int:
        (value,) = self._numbers(letter, 1)
        return value

    def _numbers(self, letter: str, length: int) -> tuple[int, ...]:
        size = struct.calcsize(f"<{letter}")
        if length:
            self._at += -self._at % min(size, self._aligned_most)
        return struct.unpack(f"{self._order}{length}{letter}", self._take(size * length))

    def _take(self, length: int) -> bytes:
        data = self._data[self._at : self._at + length]
        if len(data) < length:
            raise UnreadableError("it is too short")
        self._at += length
        return data


def _make_frame(fields: Mapping[str, Value]) -> bytes:
    """Return the MAVLink frame that was wrapped: https://mavlink.io/en/guide/serialization.html."""
    magic, length, message_id = _to_integer(fields, "magic"), _to_integer(fields, "len"), _to_integer(fields, "msgid")
    sender = (_to_integer(fields, "seq"), _to_integer(fields, "sysid"), _to_integer(fields, "compid"))
    signature = b""
    try:
        # The words are the payload's bytes as a little-endian computer sees them, filled up with zeros.
        payload = struct.pack(f"<{len(_to_list(fields, 'payload64'))}Q", *_to_list(fields, "payload64"))[:length]
        if magic == _V2:
            flags = (_to_integer(fields, "incompat_flags"), _to_integer(fields, "compat_flags"))
            head = struct.pack("<7B", magic, length, *flags, *sender) + struct.pack("<I", message_id)[:3]
            if flags[0] & _SIGNED:
                signature = struct.pack(f"{_SIGNATURE_BYTES}B", *_to_list(fields, "signature"))
        elif magic == _V1:
            head = struct.pack("<6B", magic, length, *sender, message_id)
        else:
            raise UnreadableError(f"it begins with {magic}, which no frame does")
        checksum = struct.pack("<H", _to_integer(fields, "checksum"))
    except struct.error as error:
        raise UnreadableError(f"a field has no place in a frame ({error})") from error
    if len(payload) < length:
        raise UnreadableError("it has less payload than it says")
    return head + payload + checksum + signature


def _to_integer(fields: Mapping[str, Value], name: str) -> int:
    value = fields.get(name)
    if not isinstance(value, int):
        raise UnreadableError(f"it has no number {name}")
    return value


def _to_list(fields: Mapping[str, Value], name: str) -> list[Value]:
    value = fields.get(name)
    if not isinstance(value, list):
        raise UnreadableError(f"it has no list {name}")
    return value


@dataclass(frozen=True)
class FrameStream:
    """Frames of a stream of bytes, and what was left out of it."""

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
    in_step = True  # what is before `at` was a frame
    while at < len(data):
        end = at + get_frame_length(data, at)
        whole = at < end <= len(data)
        checked = whole and is_frame(data[at:end])
        in_step = checked or (whole and in_step and (end == len(data) or data[end] in MARKERS))
        if not in_step:
            end = find_next_marker(data, at + 1)
            left_out += end - at
        else:
            valid_count += checked
            packets.append(make_packet(pieces[bisect_right(ends, end - 1)][0], data[at:end]))
        at = end
    return FrameStream(tuple(packets), valid_count, left_out)


_OURS = "/uavctl/"
_MAX_NAMED_CHANNELS = 12  # channels that an error names
_PIECE_BYTES = 64  # of memory for each piece of a stream, besides its bytes
_PROBED_BYTES = 65_536  # without a frame in so many a channel holds something else
# What the library raises on bytes that are no MCAP: its own, and those of the formats within.
_DAMAGE = (McapError, ValueError, OverflowError, RuntimeError, struct.error, zstandard.ZstdError)
_RECORD, _MESSAGE = struct.Struct("<BQ"), struct.Struct("<HIQQ")  # opcode, length; channel, sequence, times
_BLOCK_BYTES = 2**20  # of a record that is passed over, read at once
_LOADED = frozenset((Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE, Opcode.CHUNK, Opcode.DATA_END))


@dataclass(frozen=True)
class ForeignMcap:
    """MAVLink packets of an MCAP file of another program."""

    packets: tuple[TlogPacket, ...]  # in order of arrival, which is the log time; one frame each
    topics: tuple[str, ...]  # those that hold them
    torn: bool  # the file ends in the middle of a record; what was before is here
    notes: tuple[str, ...] = ()  # what was left out, and what was odd about the times, in sentences


class _ChannelStream:
    """One channel as a stream of bytes.

    Args:
        schema: Schema of the channel's messages, if they have one.
        unwrap: Makes a frame of each message, if they are MAVLink wrapped by ROS.
        is_requested: It was asked for, so it is read however little MAVLink is in it.
        budget: Bounds what is kept.
    """

    def __init__(
        self,
        channel: Channel,
        schema: Schema | None,
        unwrap: Unwrapper | None,
        *,
        is_requested: bool,
        budget: ReadBudget,
    ) -> None:
        self.topic, self.encoding = channel.topic, channel.message_encoding
        self.kind = "" if schema is None else schema.name
        self.messages = 0
        self._unwrap, self._budget = unwrap, budget
        self._is_requested = is_requested
        self._pieces: list[tuple[int, bytes]] = []
        self._probe: bytearray | None = None if is_requested or self._unwrap else bytearray()
        self._is_unreadable = False
        self._unreadable, self._reason = 0, ""

    def take(self, at_ns: int, data: bytes) -> None:
        """Take a message of log time `at_ns`."""
        self.messages += 1
        if self._is_unreadable:
            return
        if self._unwrap is not None:
            try:
                data = self._unwrap(data)
            except UnreadableError as error:
                self._unreadable, self._reason = self._unreadable + 1, str(error)
                return
        if not data:
            return
        self._budget.keep(_PIECE_BYTES + len(data))
        self._pieces.append((at_ns, data))
        if self._probe is not None:
            self._inspect(data)

    def packets(self) -> tuple[tuple[TlogPacket, ...], tuple[str, ...]]:
        """Return the channel's packets, none if it holds no MAVLink, and remarks on it.

        Raises:
            RecordingError: Its log times are all zero.
        """
        clock = MonotonicClock()
        pieces = [(clock.steady(at_ns), data) for at_ns, data in self._pieces]
        # A recorder of several threads writes not in order; a clock that was set back has been put right.
        stream = cut_stream(sorted(pieces, key=lambda piece: piece[0]))
        notes = []
        if self._unreadable:
            notes.append(f"{self.topic}: {count(self._unreadable, 'message')} left out: {self._reason}")
        mostly = 2 * stream.left_out_bytes < sum(len(data) for _, data in pieces)
        if stream.valid_count and not (mostly or self._is_requested):
            notes.append(f"{self.topic}: not taken, most of it is no MAVLink; `--topic {self.topic}` takes it")
        if not stream.valid_count or not (mostly or self._is_requested):
            return (), tuple(notes)
        clock.check(self.topic)
        if stream.left_out_bytes:
            notes.append(f"{self.topic}: {count(stream.left_out_bytes, 'byte')} left out that are no whole frame")
        return stream.packets, (*notes, *clock.notes(self.topic))

    def listed(self) -> str:
        """Return what the channel holds in words, for an error."""
        kind = f", {self.kind}" if self.kind else ""
        return f"{self.topic} ({self.encoding or 'no encoding'}{kind}, {self.messages})"

    def _inspect(self, data: bytes) -> None:
        """Look for a first frame; a channel without one for long is not kept."""
        assert self._probe is not None
        self._probe += data[: _PROBED_BYTES - len(self._probe)]
        if len(self._probe) < _PROBED_BYTES:
            return
        self._is_unreadable = not cut_stream([(0, bytes(self._probe))]).valid_count
        self._probe = None
        if self._is_unreadable:
            self._pieces.clear()


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
            for record in _iterate_records(file, size, ReadBudget(size)):
                if isinstance(record, Channel):
                    has_messages = True
                    if record.topic.startswith(_OURS):
                        return False
    except (FileNotFoundError, IsADirectoryError):
        return False  # a recording of ours may have later segments only; of a folder its reader knows what to do
    except OSError as error:
        raise RecordingError(f"{path}: {error.strerror}") from error
    except (*_DAMAGE, ExcessError, _TornError):
        return has_messages
    return has_messages


def read_mcap(path: Path, topics: Sequence[str] = ()) -> ForeignMcap:
    """Read all MAVLink packets of an MCAP: raw frames, cut into messages anywhere, or wrapped by ROS one by one.

    Args:
        path: The file; chunks may be stored, or packed with lz4 or zstd.
        topics: The topics to take; those that hold MAVLink if none is named.

    Raises:
        RecordingError: Damaged, nothing in it is MAVLink (the message lists what is), or it has no times.
        UsageError: There is no such topic.
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
    except _DAMAGE as error:
        raise RecordingError(f"{path}: damaged, or no MCAP ({error}); mcap's own tool may recover it") from error
    _check_names(path, topics, streams)
    packets: list[TlogPacket] = []
    used_topics: list[str] = []
    notes: list[str] = []
    for stream in streams.values():
        if topics and stream.topic not in topics:
            continue
        stream_packets, stream_notes = stream.packets()
        packets += stream_packets
        used_topics += [stream.topic] if stream_packets else []
        notes += stream_notes
    if not used_topics:
        listed = _format_names(sorted(stream.listed() for stream in streams.values()))
        raise RecordingError("; ".join([f"{path}: no raw MAVLink in it", listed, *notes]))
    return ForeignMcap(sort_packets(packets), tuple(dict.fromkeys(used_topics)), torn, tuple(notes))


class _Message(NamedTuple):
    """A message of a channel."""

    channel_id: int
    at_ns: int
    data: bytes


class _TornError(Exception):
    """The file ends within a record."""


def _collect_messages(file: BinaryIO, size: int, topics: Sequence[str], streams: dict[int, _ChannelStream]) -> bool:
    """Take the messages of some topics, or of all if none is given; return whether the file is torn.

    Raises:
        ExcessError: A record asks for more than the budget has; names its offset.
    """
    schemas: dict[int, Schema] = {}
    unwrappers: dict[int, dict[str, Unwrapper | None]] = {}  # by schema, and encoding of messages
    budget = ReadBudget(size)
    try:
        for record in _iterate_records(file, size, budget):
            if isinstance(record, _Message):
                stream = streams.get(record.channel_id)
                if stream is not None and (not topics or stream.topic in topics):
                    stream.take(record.at_ns, record.data)
            elif isinstance(record, Schema):
                if schemas.get(record.id) != record:
                    budget.keep(len(record.name) + len(record.data))
                    schemas[record.id], unwrappers[record.id] = record, {}
            elif record.id not in streams:
                budget.keep(_PIECE_BYTES + len(record.topic) + len(record.message_encoding))
                schema, encoding = schemas.get(record.schema_id), record.message_encoding
                of_schema = unwrappers.get(record.schema_id, {})
                if schema is not None and encoding not in of_schema:
                    of_schema[encoding] = make_unwrapper(encoding, schema.encoding, schema.name, schema.data)
                    if of_schema[encoding] is not None:
                        budget.keep(_FIELD_RATIO * len(schema.data))
                streams[record.id] = _ChannelStream(
                    record, schema, of_schema.get(encoding), is_requested=record.topic in topics, budget=budget
                )
    except _TornError:
        return True
    except ExcessError as error:
        raise ExcessError(f"offset {budget.offset}: a record {error}") from error
    return False


def _iterate_records(file: BinaryIO, size: int, budget: ReadBudget) -> Iterator[Schema | Channel | _Message]:
    """Yield schemas, channels and messages in file order; each chunk is checked by its checksum if it has one.

    Args:
        size: Size of the file: no length that it claims is believed beyond.

    Raises:
        _TornError: The file ends within a record.
        ExcessError: A record asks for more than the budget has.
    """
    at, checksum = len(MAGIC), zlib.crc32(MAGIC)
    if (begin := file.read(len(MAGIC))) != MAGIC:
        raise InvalidMagic(begin)
    while True:
        head = file.read(_RECORD.size)
        if len(head) < _RECORD.size:
            raise _TornError
        opcode, length = _RECORD.unpack(head)
        if length > size:
            raise McapError(f"a record at offset {at} claims {length} bytes")
        if length > size - at - _RECORD.size:
            raise _TornError
        budget.offset = at
        if opcode in _LOADED:
            budget.unpack(length)
            content = file.read(length)
            if opcode == Opcode.DATA_END:
                _check_data_end(content, checksum)
            elif opcode == Opcode.CHUNK:
                yield from _iterate_chunk(_unpack_chunk(content, budget), budget)
            else:
                yield from _parse_record(opcode, content)
            checksum = zlib.crc32(content, zlib.crc32(head, checksum))
        else:
            checksum = _pass_over(file, length, zlib.crc32(head, checksum))
        at += _RECORD.size + length
        if opcode == Opcode.FOOTER:
            if len(end := file.read(len(MAGIC))) < len(MAGIC):
                raise _TornError
            if end != MAGIC:
                raise InvalidMagic(end)
            return


def _pass_over(file: BinaryIO, length: int, checksum: int) -> int:
    """Read a record that is not used, block by block; return the checksum with it."""
    while length > 0:
        block = file.read(min(length, _BLOCK_BYTES))
        if not block:
            raise _TornError
        checksum, length = zlib.crc32(block, checksum), length - len(block)
    return checksum


def _check_data_end(content: bytes, checksum: int) -> None:
    stored = DataEnd.read(ReadDataStream(BytesIO(content))).data_section_crc
    if stored not in (0, checksum):
        raise McapError(f"the checksum of its data is {checksum}, not {stored}")


def _unpack_chunk(content: bytes, budget: ReadBudget) -> bytes:
    """Return the records of a chunk, of no more bytes than it says."""
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


def _iterate_chunk(content: bytes, budget: ReadBudget) -> Iterator[Schema | Channel | _Message]:
    at, size = 0, len(content)
    while at < size:
        budget.take_record()
        opcode, length = _RECORD.unpack_from(content, at)
        begin, at = at + _RECORD.size, at + _RECORD.size + length
        if at > size:
            raise McapError("a record goes on beyond the end of its chunk")
        if opcode == Opcode.MESSAGE:
            yield _parse_message(content, begin, at)
        elif opcode in _LOADED:
            yield from _parse_record(opcode, content[begin:at])


def _parse_record(opcode: int, content: bytes) -> Iterator[Schema | Channel | _Message]:
    """Yield the record if it is a schema, channel or message."""
    if opcode == Opcode.MESSAGE:
        yield _parse_message(content, 0, len(content))
    elif opcode == Opcode.SCHEMA:
        yield Schema.read(ReadDataStream(BytesIO(content)))
    elif opcode == Opcode.CHANNEL:
        yield Channel.read(ReadDataStream(BytesIO(content)))


def _parse_message(content: bytes, begin: int, end: int) -> _Message:
    channel_id, _, log_ns, publish_ns = _MESSAGE.unpack_from(content, begin)
    return _Message(channel_id, log_ns or publish_ns, content[begin + _MESSAGE.size : end])


def _check_names(path: Path, topics: Sequence[str], streams: dict[int, _ChannelStream]) -> None:
    there = {stream.topic for stream in streams.values()}
    for topic in topics:
        if topic not in there:
            raise UsageError(f"--topic {topic}: {path} has none of this name; {_format_names(sorted(there))}")


def _format_names(names: list[str]) -> str:
    if not names:
        return "it has no topic at all"
    more = f", and {len(names) - _MAX_NAMED_CHANNELS} more" if len(names) > _MAX_NAMED_CHANNELS else ""
    return f"it has: {', '.join(names[:_MAX_NAMED_CHANNELS])}{more}"


def read_foreign_packets(path: Path, topics: Sequence[str] = ()) -> Tlog | None:
    """Return the MAVLink packets of another program's recording, and what was odd; None if it is of no such kind.

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
        return flight_in(log, str(path), system)
    if system is not None:
        raise UsageError("--system is for another program's MAVLink: a recording of ours is of one vehicle")
    return None
