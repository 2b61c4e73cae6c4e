"""Content of MAVLink frames: fields to bytes and back, by pymavlink's message definitions.

The results are those of pymavlink's `decode` and `pack`. Those build a header and a dozen lists for each message, and
compute the checksum again. That is several times the work, for a hundred messages a second.

1. Take the struct format and the field order of a message from pymavlink, once.
2. Unpack: pad the payload with zeros, because MAVLink 2 leaves out zeros at its end; group the array elements.
3. Pack: put the fields into wire order, remove zeros at the end, add header and checksum.
"""

from __future__ import annotations

import re
from collections import namedtuple
from collections.abc import Callable
from itertools import accumulate, pairwise
from operator import itemgetter
from typing import Any, Protocol

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from uavctl.mavlink.framing import HEADER_V1, HEADER_V2, add_checksum

_SENDER_V1, _SENDER_V2 = 3, 5  # index of the system id; the component's follows


class MessageFields(Protocol):
    """Fields of a decoded message by name; an array is a tuple, a text is bytes."""

    msgname: str
    src_system: int
    src_component: int

    def __getattr__(self, name: str) -> Any: ...


class MessageLayout:
    """Layout of one message in a frame."""

    def __init__(self, kind: Any) -> None:
        self._name, self._id = kind.msgname, kind.id.to_bytes(3, "little")
        self._struct = kind.unpacker
        self._order = [kind.orders.index(place) for place in range(len(kind.orders))]
        sender = ("msgname", "src_system", "src_component")
        # Its names are those of the definition, which no type checker knows.
        self._make: Any = namedtuple(kind.msgname, (*sender, *kind.ordered_fieldnames))._make  # type: ignore[attr-defined]
        self._grouped: Callable[[tuple[Any, ...]], tuple[Any, ...]] | None = None  # None: no arrays
        if max(kind.lengths) > 1:
            ends = accumulate((1, 1, 1, *kind.lengths), initial=0)
            self._grouped = itemgetter(*(i if j - i == 1 else slice(i, j) for i, j in pairwise(ends)))

    def unpack(self, frame: bytes) -> MessageFields:
        """Unpack the fields of a whole frame; missing bytes of its payload are 0, extra ones are dropped."""
        start, sender = (HEADER_V2, _SENDER_V2) if frame[0] == mavlink.PROTOCOL_MARKER_V2 else (HEADER_V1, _SENDER_V1)
        payload = frame[start : start + frame[1]].ljust(self._struct.size, b"\0")
        values = (self._name, frame[sender], frame[sender + 1], *self._struct.unpack_from(payload))
        fields: MessageFields = self._make(values if self._grouped is None else self._grouped(values))
        return fields

    def pack(self, address: tuple[int, int], number: int, *fields: Any) -> bytes:
        """Pack a frame of MAVLink 2.

        Args:
            address: system and component that send it.
            number: its sequence number, 0 to 255.
            fields: in the order of pymavlink's class; missing numbers at the end are 0.

        Raises:
            struct.error: a number does not fit.
        """
        given = (*fields, *(0,) * (len(self._order) - len(fields)))
        values = [given[index] for index in self._order]
        if self._grouped is not None:
            values = [part for value in values for part in (value if isinstance(value, list | tuple) else (value,))]
        payload = self._struct.pack(*values).rstrip(b"\0") or b"\0"
        header = bytes((mavlink.PROTOCOL_MARKER_V2, len(payload), 0, 0, number, *address)) + self._id
        return add_checksum(header + payload)


# Escape sequences of a terminal, ECMA-48: CSI with its parameters, OSC up to its end, and those of two characters.
_ESCAPES = re.compile(
    r"(?:\x1b\[|\x9b)[0-?]*[ -/]*[@-~]?|(?:\x1b\]|\x9d)[^\x07\x1b\x9c]*(?:\x07|\x1b\\|\x9c)?|\x1b[ -/]*[0-~]?"
)


def strip_escapes(text: str) -> str:
    """Remove everything from a foreign text that would act on a terminal.

    Escape sequences (such as PX4's colours) are removed. Other characters that are not printable become "?".
    """
    return "".join(character if character.isprintable() else "?" for character in _ESCAPES.sub("", text))


def decode_text(raw: bytes) -> str:
    """Decode a text of fixed length up to its first zero, without escape sequences."""
    return strip_escapes(raw.split(b"\0", 1)[0].decode("utf-8", errors="replace"))
