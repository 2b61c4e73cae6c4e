"""Qualisys: a rigid body out of QTM's real-time protocol, over TCP.

The package `qtm_rt` reads the frames. The conversation is held here: a welcome, the version, the names of the bodies
(XML), then frames until the connection ends. Layout: QTM's real-time server protocol, little-endian; a packet is its
size, its kind, and what it holds. Places are in millimetres, turns are matrices by columns, and both are NaN while the
body is not seen. A stamp counts microseconds from the start of the measurement; nobody can ask for that clock.
"""

from __future__ import annotations

import math
import struct
from collections import Counter
from functools import lru_cache
from typing import Any
from xml.etree import ElementTree

from qtm_rt.packet import QRTComponentType, QRTPacket

from uavctl.frames import Quaternion, Up, convert_pose_to_frd, normalise_quaternion
from uavctl.io.camera import BodyPose, CameraError, Echo
from uavctl.records import Vec3

ERROR, COMMAND, XML, DATA, NO_DATA, EVENT = 0, 1, 2, 3, 4, 6
VERSION = "1.25"
WELCOME = b"QTM RT Interface connected"
# Events after which the bodies may be others: connected, capture started, playing a file started, settings changed
CHANGED = (1, 3, 8, 11)
LARGEST = 1 << 22  # more is no packet of ours [bytes]

UNREADABLE = "unreadable"
UNTRACKED = "untracked"
MISSING = "body-missing"
NO_MEASUREMENT = "no-measurement"
SILENT = "server-silent"

_HEAD = struct.Struct("<II")
_COMPONENTS, _COMPONENTS_AT = struct.Struct("<I"), 12  # their number, in a frame
_MAX_COMPONENTS = 64  # a frame has one of each type, and there are some twenty types
_SILENT_NS = 1_000_000_000
_UNREADABLE = (struct.error, ValueError, IndexError, TypeError, KeyError, ElementTree.ParseError)
_TOLERANCE = 1e-3


@lru_cache(maxsize=1)  # the cameras of several bodies read the same frame
def _read_frame(payload: bytes) -> tuple[int, list[Any] | None]:
    """Return the stamp of a frame [µs], and place and turn of its bodies; None without any."""
    frame = QRTPacket(payload)
    return frame.timestamp, frame.get_6d()[1] if QRTComponentType.Component6d in frame.components else None


class Qualisys:
    """One rigid body of one server; implements `uavctl.io.camera.Camera` on a stream.

    Args:
        up: the axis that QTM calls up.
    """

    stream = True

    def __init__(self, body: str, up: Up) -> None:
        self._body, self._up = body, up
        self._body_index: int | None = None  # of the body among those of a frame
        self._buffer = bytearray()
        self._outgoing: list[bytes] = []
        self._heard_ns = 0
        self.ready, self.awaits = False, "answer"
        self.group: tuple[str, int] | None = None
        self.dropped: Counter[str] = Counter()

    def receive(self, data: bytes, at_ns: int) -> tuple[BodyPose | Echo, ...]:
        """See `Camera`; no bytes at all are a connection that begins."""
        self._heard_ns = at_ns
        if not data:
            self._buffer.clear()
            self._outgoing.clear()
            self._body_index = None
            return ()
        self._buffer += data
        results: list[BodyPose | Echo] = []
        while len(self._buffer) >= _HEAD.size:
            size, kind = _HEAD.unpack_from(self._buffer)
            if not _HEAD.size <= size <= LARGEST:  # the stream is out of step: it has to restart
                self.dropped[UNREADABLE] += 1
                self._buffer.clear()
                self._outgoing.append(_encode_command("Quit"))
                break
            if len(self._buffer) < size:
                break
            payload = bytes(self._buffer[_HEAD.size : size])
            del self._buffer[:size]
            try:
                results += self._handle_packet(kind, payload)
            except _UNREADABLE:
                self.dropped[UNREADABLE] += 1
        return tuple(results)

    def due(self, at_ns: int) -> tuple[bytes, ...]:
        """See `Camera`: queued commands, and a request for frames after one second without any."""
        if self._body_index is not None and at_ns - self._heard_ns >= _SILENT_NS:
            self._heard_ns = at_ns
            self.dropped[SILENT] += 1
            self._request_bodies()
        outgoing = tuple(self._outgoing)
        self._outgoing.clear()
        return outgoing

    def ask_time(self, token: int) -> bytes:
        """See `Camera`: QTM sends its time only with frames."""
        del token
        return b""

    def _request_bodies(self) -> None:
        self._outgoing.append(_encode_command("GetParameters 6D"))

    def _handle_packet(self, kind: int, payload: bytes) -> tuple[BodyPose, ...]:
        if kind == COMMAND and payload.startswith(WELCOME):
            self._outgoing.append(_encode_command(f"Version {VERSION}"))
        elif kind == COMMAND and payload.startswith(b"Version set"):
            self.awaits = "names of rigid bodies, though the server answers,"
            self._request_bodies()
        elif kind == ERROR:
            self._refuse(f"refused a request: {payload.rstrip(bytes(1)).decode(errors='replace')}")
        elif kind == XML:
            self._handle_bodies(payload.rstrip(b"\0"))
        elif kind == EVENT and payload and payload[0] in CHANGED and self._body_index is not None:
            self._request_bodies()
        elif kind == NO_DATA:
            self.dropped[NO_MEASUREMENT] += 1
        elif kind == DATA and self._body_index is not None:
            (components,) = _COMPONENTS.unpack_from(payload, _COMPONENTS_AT)
            if components > _MAX_COMPONENTS:  # the library counts them out, though each may have no bytes
                return self._count_dropped(UNREADABLE)
            return self._handle_frame(*_read_frame(payload))
        return ()

    def _handle_bodies(self, text: bytes) -> None:
        names = [(name.text or "").strip() for name in ElementTree.fromstring(text).iterfind("./The_6D/Body/Name")]
        if self._body not in names:
            self._body_index = None
            names_text = ", ".join(map(repr, sorted(names))) or "none"
            self._refuse(
                f"has no rigid body {self._body!r}; it has: {names_text}. Write one of them behind its address"
            )
            return
        self._body_index, self.ready = names.index(self._body), True
        self._outgoing.append(_encode_command("StreamFrames AllFrames 6D"))

    def _handle_frame(self, timestamp_us: int, bodies: list[Any] | None) -> tuple[BodyPose, ...]:
        if bodies is None:
            return self._count_dropped(NO_MEASUREMENT)
        if self._body_index is None or self._body_index >= len(bodies):
            return self._count_dropped(MISSING)
        place, rotation = bodies[self._body_index]
        attitude = _quaternion_from_matrix(rotation.matrix)
        if attitude is None or not all(map(math.isfinite, place)):
            return self._count_dropped(UNTRACKED)
        position_m: Vec3 = (place.x * 1e-3, place.y * 1e-3, place.z * 1e-3)
        return (BodyPose(timestamp_us * 1000, *convert_pose_to_frd(position_m, attitude, self._up)),)

    def _count_dropped(self, reason: str) -> tuple[BodyPose, ...]:
        self.dropped[reason] += 1
        return ()

    def _refuse(self, text: str) -> None:
        """End the start with an error; in flight, only count."""
        if not self.ready:
            raise CameraError(f"the server {text}")
        self.dropped[MISSING] += 1


def _encode_command(command: str) -> bytes:
    payload = command.encode() + b"\0"
    return _HEAD.pack(_HEAD.size + len(payload), COMMAND) + payload


def _quaternion_from_matrix(columns: tuple[float, ...]) -> Quaternion | None:
    """Return the quaternion (w, x, y, z) of a rotation matrix given by columns; None if it is none."""
    a, d, g, b, e, h, c, f, i = columns  # rows are a b c, d e f, g h i
    squares = 1.0 + a + e + i, 1.0 + a - e - i, 1.0 - a + e - i, 1.0 - a - e + i
    if not all(map(math.isfinite, columns)) or abs(sum(value * value for value in columns) - 3.0) > _TOLERANCE:
        return None
    largest = max(range(4), key=squares.__getitem__)
    two = 2.0 * math.sqrt(squares[largest])
    rows = (
        (squares[0], h - f, c - g, d - b),
        (h - f, squares[1], b + d, c + g),
        (c - g, b + d, squares[2], f + h),
        (d - b, c + g, f + h, squares[3]),
    )
    return normalise_quaternion(tuple(value / two for value in rows[largest]))
