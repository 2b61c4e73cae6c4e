"""MAVLink frames that ROS wraps one by one in messages of mavros_msgs/Mavlink: out of ROS 1 and ROS 2 bytes.

1. Parse the definition that stands beside the messages: the types and their fields.
2. Read a message by it, in the encoding of ROS 1 or as CDR; the steps and the bytes are bounded.
3. Put the frame together from the fields of mavros_msgs/Mavlink.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Mapping

import msgspec
from pymavlink.dialects.v20 import ardupilotmega as mavlink

ROS1, ROS2 = "ros1", "cdr"  # encodings of messages
DEFINITION_ENCODINGS = {ROS1: "ros1msg", ROS2: "ros2msg"}  # and of their schemas
_NUMBER_FORMATS = {
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
_TIME_FORMATS = {"time": "I", "duration": "i", "builtin_interfaces/Time": "i", "builtin_interfaces/Duration": "i"}
# An array has at most 18 digits: Python refuses to read thousands, and no message is that long.
_FIELD = re.compile(
    r"^(?P<type>[A-Za-z][\w/]*)(?:<=\d+)?(?P<array>\[(?:<=)?(?P<size>\d{0,18})\])?\s+(?P<name>\w+)(?P<rest>.*)$"
)
_SEPARATOR = re.compile(r"^=+\s*$", re.MULTILINE)
_CDR_HEADER_BYTES = 4
_BYTE_ORDERS = {0: ">", 1: "<", 6: ">", 7: "<"}  # second byte of CDR: XCDR1 and XCDR2, plain
_MAX_ALIGNMENTS = {0: 8, 1: 8, 6: 4, 7: 4}
# Of a message that wraps a frame, at most: a frame has 280 bytes, mavros_msgs/Mavlink 16 fields.
_MAX_WRAPPED_BYTES, _MAX_STEPS = 4096, 256
_MAX_DEPTH = 64  # of types within types
MAX_DEFINITION_BYTES = 2**16  # of such a message; that of mavros_msgs/Mavlink has 3000
DEFINITION_RATIO = 64  # bytes of memory for each byte of a definition that was parsed
_MAVLINK_FIELDS = frozenset(("magic", "len", "seq", "sysid", "compid", "msgid", "checksum", "payload64"))

Value = int | float | bytes | list["Value"] | dict[str, "Value"]


class _RosField(msgspec.Struct, frozen=True, gc=False):
    """Field of a type; the garbage collector passes it over, as it holds nothing but texts and a number."""

    type: str
    name: str
    size: int | None  # of an array; 0: as many as the message says; None: no array


Definitions = dict[str, tuple[_RosField, ...]]


class Unwrapper(msgspec.Struct, frozen=True, gc=False):
    """Reader of the frames in a channel's messages; no part of it leads back to it, so the garbage collector is spared.

    Attributes:
        types: Fields of each type.
        top: Type of a message.
        encoding: Encoding of messages, of ROS 1 or 2.
    """

    types: Definitions
    top: str
    encoding: str

    def __call__(self, data: bytes) -> bytes:
        """Return the frame in a message.

        Raises:
            UnreadableError: The message is damaged.
        """
        return _make_frame(RosReader(data, self.types, self.encoding).read_record(self.top))


class UnreadableError(Exception):
    """A message or its definition that cannot be read; the text is the reason."""


def make_unwrapper(encoding: str, schema_encoding: str, name: str, definition: bytes) -> Unwrapper | None:
    """Make the reader of the messages of a channel, if they are MAVLink wrapped by ROS.

    Such messages are known by their fields, those of mavros_msgs/Mavlink, wherever they stand in the definition.

    Returns:
        None if they are something else.
    """
    if DEFINITION_ENCODINGS.get(encoding) != schema_encoding or len(definition) > MAX_DEFINITION_BYTES:
        return None
    if not all(field.encode() in definition for field in _MAVLINK_FIELDS):
        return None
    top = normalise_type_name(name)
    try:
        types = parse_definition(top, definition.decode("utf-8", errors="replace"))
    except UnreadableError:
        return None
    if not _MAVLINK_FIELDS.issubset(field.name for field in types[top]):
        return None

    return Unwrapper(types, top, encoding)


def normalise_type_name(name: str) -> str:
    """Return a type's name as ROS 1 has it: without `msg` between package and type."""
    return name.replace("/msg/", "/")


def parse_definition(top: str, text: str) -> Definitions:
    """Return the fields of all types in a ROS message definition, without constants and comments."""
    types: Definitions = {}
    for number, part in enumerate(_SEPARATOR.split(text)):
        lines = [line.partition("#")[0].strip() for line in part.splitlines()]
        lines = [line for line in lines if line]
        owner = top
        if number:
            if not lines or not lines[0].startswith("MSG:"):
                raise UnreadableError("a definition without its name")
            owner = normalise_type_name(lines.pop(0).removeprefix("MSG:").strip())
        types[owner] = tuple([field for line in lines if (field := _parse_field(line, owner)) is not None])
    return types


def _parse_field(line: str, owner: str) -> _RosField | None:
    """Return a field of a definition; None for a constant."""
    match = _FIELD.match(line)
    if match is None:
        raise UnreadableError(f"cannot make sense of {line!r}")
    if match["rest"].lstrip().startswith("="):
        return None
    kind = normalise_type_name(match["type"])
    if kind == "Header":
        kind = "std_msgs/Header"
    elif "/" not in kind and kind not in (*_NUMBER_FORMATS, *_TIME_FORMATS, "string", "wstring"):
        kind = f"{owner.rpartition('/')[0]}/{kind}"
    size = int(match["size"]) if match["array"] and match["size"] and "<=" not in match["array"] else 0
    return _RosField(kind, match["name"], size if match["array"] else None)


class RosReader:
    """Reader of one serialised ROS message.

    A definition may nest types that have no bytes, or lists of them: the steps of reading are bounded.
    """

    def __init__(self, data: bytes, types: Definitions, encoding: str) -> None:
        self._types, self._cdr = types, encoding == ROS2
        self._order, self._max_alignment = "<", 1
        self._at, self._data = 0, data
        self._steps_left = _MAX_STEPS
        self._depth = 0
        if len(data) > _MAX_WRAPPED_BYTES:
            raise UnreadableError(f"it has {len(data)} bytes, which is far more than a frame has")
        if self._cdr:
            if len(data) < _CDR_HEADER_BYTES or data[0] or data[1] not in _BYTE_ORDERS:
                raise UnreadableError("its first bytes are not those of CDR")
            self._order, self._max_alignment = _BYTE_ORDERS[data[1]], _MAX_ALIGNMENTS[data[1]]
            self._data = data[_CDR_HEADER_BYTES:]

    def read_record(self, kind: str) -> dict[str, Value]:
        """Read all fields of a type."""
        if kind not in self._types:
            raise UnreadableError(f"its definition says nothing of {kind}")
        if self._depth >= _MAX_DEPTH:
            raise UnreadableError(f"its definition nests more than {_MAX_DEPTH} deep")
        self._depth += 1
        fields = {field.name: self._read_field(field) for field in self._types[kind]}
        self._depth -= 1
        return fields

    def _read_field(self, field: _RosField) -> Value:
        self._count_step()
        if field.size is None:
            return self._read_value(field.type)
        length = field.size or self._read_number("I")
        letter = _NUMBER_FORMATS.get(field.type)
        if letter is None:
            if length > len(self._data):
                raise UnreadableError("it is too short")
            return [self._read_value(field.type) for _ in range(length)]
        return list(self._read_numbers(letter, length))

    def _count_step(self) -> None:
        if self._steps_left <= 0:
            raise UnreadableError(f"it has more values, by its definition, than the {_MAX_STEPS} that are read")
        self._steps_left -= 1

    def _read_value(self, kind: str) -> Value:
        self._count_step()
        if kind in _NUMBER_FORMATS:
            return self._read_number(_NUMBER_FORMATS[kind])
        if kind in _TIME_FORMATS:
            return [self._read_number(_TIME_FORMATS[kind]), self._read_number("I")]
        if kind == "string":
            return self._read_bytes(self._read_number("I"))
        return self.read_record(kind)

    def _read_number(self, letter: str) -> int:
        (value,) = self._read_numbers(letter, 1)
        return value

    def _read_numbers(self, letter: str, length: int) -> tuple[int, ...]:
        size = struct.calcsize(f"<{letter}")
        if length:
            self._at += -self._at % min(size, self._max_alignment)
        return struct.unpack(f"{self._order}{length}{letter}", self._read_bytes(size * length))

    def _read_bytes(self, length: int) -> bytes:
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
        if magic == mavlink.PROTOCOL_MARKER_V2:
            flags = (_to_integer(fields, "incompat_flags"), _to_integer(fields, "compat_flags"))
            head = struct.pack("<7B", magic, length, *flags, *sender) + struct.pack("<I", message_id)[:3]
            if flags[0] & mavlink.MAVLINK_IFLAG_SIGNED:
                signature = struct.pack(f"{mavlink.MAVLINK_SIGNATURE_BLOCK_LEN}B", *_to_list(fields, "signature"))
        elif magic == mavlink.PROTOCOL_MARKER_V1:
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
