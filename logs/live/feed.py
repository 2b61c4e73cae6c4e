"""Messages from a flight to the process of its live view."""

from __future__ import annotations

import struct

LARGEST = 4 * 2**20  # bytes; a pair of sockets takes less where the system's limit is lower
SCENE = ""  # topic of a whole scene as JSON: a simulator has no records
_HEAD = struct.Struct("<QH")  # log time [ns], length of the topic


def pack(topic: str, at_ns: int, data: bytes) -> bytes:
    """Return the datagram of a message."""
    name = topic.encode()
    return _HEAD.pack(at_ns, len(name)) + name + data


def unpack(datagram: bytes) -> tuple[str, int, bytes]:
    """Return topic, log time [ns] and bytes of a message."""
    at_ns, length = _HEAD.unpack_from(datagram)
    end = _HEAD.size + length
    return datagram[_HEAD.size : end].decode(), at_ns, datagram[end:]
