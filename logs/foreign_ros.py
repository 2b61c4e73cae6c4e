"""Messages of ROS read by the definition that their recording brings along, as far as it takes to unwrap MAVLink.

Layout of ROS 1: http://wiki.ros.org/msg#Fields, little-endian without gaps. ROS 2: CDR, each number aligned to its
size, after 4 bytes that tell the byte order (https://www.omg.org/spec/DDSI-RTPS/2.5, 10.2).
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Mapping
from typing import NamedTuple

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
_V1, _V2 = 0xFE, 0xFD
_SIGNED = 0x01
_SIGNATURE_BYTES = 13
_NEEDED = frozenset(("magic", "len", "seq", "sysid", "compid", "msgid", "checksum", "payload64"))

Value = int | float | bytes | list["Value"] | dict[str, "Value"]


class _Field(NamedTuple):
    type: str
    name: str
    size: int | None  # of an array; 0: as many as the message says; None: no array


Definitions = dict[str, list[_Field]]


class UnreadableError(Exception):
    """A message or a definition is not what it should be; says why."""


def unwrapper(encoding: str, schema_encoding: str, name: str, definition: bytes) -> Callable[[bytes], bytes] | None:
    """What makes a frame of each message of a channel, if they are MAVLink as ROS wraps it.

    Such messages are known by their fields, those of mavros_msgs/Mavlink, wherever they stand in the definition.

    Args:
        encoding: Of the messages.
        schema_encoding: Of their definition.
        name: Of their type.
        definition: All types that it needs.

    Returns:
        None if they are something else. The function raises `UnreadableError` for a message that is damaged.
    """
    if _DEFINITIONS.get(encoding) != schema_encoding:
        return None
    top = _plain(name)
    try:
        types = _parse(top, definition.decode("utf-8", errors="replace"))
    except UnreadableError:
        return None
    if not _NEEDED.issubset(field.name for field in types[top]):
        return None

    def unwrap(data: bytes) -> bytes:
        return _frame(_Reader(data, types, encoding).record(top))

    return unwrap


def _plain(name: str) -> str:
    """A type's name as ROS 1 has it: without `msg` between package and type."""
    return name.replace("/msg/", "/")


def _parse(top: str, text: str) -> Definitions:
    """Fields of all types of a definition; constants and comments are nothing to a message."""
    types: Definitions = {}
    for number, part in enumerate(_BORDER.split(text)):
        lines = [line.partition("#")[0].strip() for line in part.splitlines()]
        lines = [line for line in lines if line]
        owner = top
        if number:
            if not lines or not lines[0].startswith("MSG:"):
                raise UnreadableError("a definition without its name")
            owner = _plain(lines.pop(0).removeprefix("MSG:").strip())
        types[owner] = [field for line in lines if (field := _field(line, owner)) is not None]
    return types


def _field(line: str, owner: str) -> _Field | None:
    """A field of a definition; None for a constant."""
    found = _FIELD.match(line)
    if found is None:
        raise UnreadableError(f"cannot make sense of {line!r}")
    if found["rest"].lstrip().startswith("="):
        return None
    kind = _plain(found["type"])
    if kind == "Header":
        kind = "std_msgs/Header"
    elif "/" not in kind and kind not in _NUMBERS and kind not in _STAMPS and kind not in ("string", "wstring"):
        kind = f"{owner.rpartition('/')[0]}/{kind}"
    size = int(found["size"]) if found["array"] and found["size"] and "<=" not in found["array"] else 0
    return _Field(kind, found["name"], size if found["array"] else None)


class _Reader:
    """Reads one message."""

    def __init__(self, data: bytes, types: Mapping[str, list[_Field]], encoding: str) -> None:
        self._types, self._cdr = types, encoding == ROS2
        self._order, self._aligned_most = "<", 1
        self._at, self._data = 0, data
        if self._cdr:
            if len(data) < _HEAD_BYTES or data[0] or data[1] not in _ORDERS:
                raise UnreadableError("its first bytes are not those of CDR")
            self._order, self._aligned_most = _ORDERS[data[1]], _ALIGNED_MOST[data[1]]
            self._data = data[_HEAD_BYTES:]

    def record(self, kind: str) -> dict[str, Value]:
        """All fields of a type."""
        if kind not in self._types:
            raise UnreadableError(f"its definition says nothing of {kind}")
        return {field.name: self._field(field) for field in self._types[kind]}

    def _field(self, field: _Field) -> Value:
        if field.size is None:
            return self._one(field.type)
        length = field.size or self._number("I")
        letter = _NUMBERS.get(field.type)
        if letter is None:
            if length > len(self._data):
                raise UnreadableError("it is too short")
            return [self._one(field.type) for _ in range(length)]
        return list(self._numbers(letter, length))

    def _one(self, kind: str) -> Value:
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


def _frame(fields: Mapping[str, Value]) -> bytes:
    """The frame that was wrapped: https://mavlink.io/en/guide/serialization.html."""
    magic, length, message_id = _whole(fields, "magic"), _whole(fields, "len"), _whole(fields, "msgid")
    sender = (_whole(fields, "seq"), _whole(fields, "sysid"), _whole(fields, "compid"))
    signature = b""
    try:
        # The words are the payload's bytes as a little-endian computer sees them, filled up with zeros.
        payload = struct.pack(f"<{len(_list(fields, 'payload64'))}Q", *_list(fields, "payload64"))[:length]
        if magic == _V2:
            flags = (_whole(fields, "incompat_flags"), _whole(fields, "compat_flags"))
            head = struct.pack("<7B", magic, length, *flags, *sender) + struct.pack("<I", message_id)[:3]
            if flags[0] & _SIGNED:
                signature = struct.pack(f"{_SIGNATURE_BYTES}B", *_list(fields, "signature"))
        elif magic == _V1:
            head = struct.pack("<6B", magic, length, *sender, message_id)
        else:
            raise UnreadableError(f"it begins with {magic}, which no frame does")
        checksum = struct.pack("<H", _whole(fields, "checksum"))
    except struct.error as error:
        raise UnreadableError(f"a field has no place in a frame ({error})") from error
    if len(payload) < length:
        raise UnreadableError("it has less payload than it says")
    return head + payload + checksum + signature


def _whole(fields: Mapping[str, Value], name: str) -> int:
    value = fields.get(name)
    if not isinstance(value, int):
        raise UnreadableError(f"it has no number {name}")
    return value


def _list(fields: Mapping[str, Value], name: str) -> list[Value]:
    value = fields.get(name)
    if not isinstance(value, list):
        raise UnreadableError(f"it has no list {name}")
    return value
