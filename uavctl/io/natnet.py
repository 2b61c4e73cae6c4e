"""OptiTrack: a rigid body out of NatNet, the protocol that Motive streams in.

The package `natnet` reads descriptions and frames, whose layout changes with the version. The conversation is held
here, not by the package's client, because that client sends a keep-alive for every datagram it gets, prints, loses
what its threads raise, and asks for the descriptions in a way that Motive 3.1 is reported to leave unanswered.

Layout of the messages: NatNetTypes.h of the public SDK (message numbers, `sSender_Server`); of the echo, which the SDK
uses to find the server's clock, open clients that fly with it. Only the server's first 283 bytes and the echo are read
here. A request for descriptions carries the mask of wanted kinds (bit 1: rigid bodies) for Motive 3, and every other
time none, for older servers.
"""

from __future__ import annotations

import math
import struct
from collections import Counter
from functools import lru_cache
from ipaddress import IPv4Address

import natnet

from uavctl.frames import Quaternion, Up, convert_pose_to_frd, normalise_quaternion
from uavctl.io.camera import BodyPose, CameraError, Echo

CONNECT, SERVER_INFO = 0, 1
REQUEST_DESCRIPTIONS, DESCRIPTIONS = 4, 5
FRAME, KEEP_ALIVE = 7, 10
ECHO_REQUEST, ECHO = 12, 13
RIGID_BODIES = 1 << 1
OLDEST, NEWEST_MAJOR = (3, 0), 4  # before 3.0 frames have no time of exposure

_HEAD = struct.Struct("<HH")
_SERVER = struct.Struct("<256s4B4BQH?4s")
_ECHO = struct.Struct("<QQ")
_RETRY_NS = 500_000_000
_SILENT_NS = _KEEP_NS = 1_000_000_000
# A restarted server answers questions of clients it does not know, but streams only to those that asked to connect.
_ALIVE = (SERVER_INFO, FRAME)
_MAX_EXPOSED_S = 1.0  # from exposure to sending; more is no frame of this version
_UNREADABLE = (struct.error, ValueError, IndexError, TypeError, AssertionError, MemoryError, natnet.NatNetError)

UNREADABLE = "unreadable"
UNTRACKED = "untracked"
MISSING = "body-missing"
NO_STAMP = "no-exposure-time"
SILENT = "server-silent"


_MAX_NAME_BYTES = 256  # MAX_NAMELENGTH of NatNet


class _BoundedBuffer(natnet.PacketBuffer):
    """Payload of which nothing is read beyond its end: the library makes room for what a count claims."""

    def read_float32_array(self, count: int) -> tuple[float, ...]:
        """Read numbers.

        Raises:
            ValueError: There are fewer.
        """
        if 4 * count > len(self.data) - self.pointer:
            raise ValueError(f"{count} numbers are more than the datagram has")
        return super().read_float32_array(count)

    def read_string(self, max_length: int | None = None, static_length: bool = False) -> str:
        """Read a text of a bounded length, of which the library copies no more.

        Raises:
            ValueError: The datagram ends before it.
        """
        if self.pointer >= len(self.data):
            raise ValueError("the datagram ends before a text")
        return super().read_string(_MAX_NAME_BYTES if max_length is None else max_length, static_length)


@lru_cache(maxsize=1)  # the cameras of several bodies read the same frame
def _read_frame(payload: bytes, version: tuple[int, ...]) -> natnet.DataFrame:
    return natnet.DataFrame.read_from_buffer(_BoundedBuffer(payload), natnet.Version(*version))


class NatNet:
    """One rigid body of one server; implements `uavctl.io.camera.Camera`.

    Args:
        up: the axis that Motive streams as up.
    """

    def __init__(self, body: str, up: Up) -> None:
        self._body, self._up = body, up
        self._version: tuple[int, ...] | None = None
        self._ticks_per_s = 0
        self._body_id: int | None = None
        self._heard_ns = self._asked_ns = self._keep_alive_ns = -_SILENT_NS
        self._requests = 0
        self._is_complete = False
        self._info = b""
        self.ready = False
        self.group: tuple[str, int] | None = None
        self.dropped: Counter[str] = Counter()

    @property
    def awaits(self) -> str:
        """See `Camera`."""
        return "answer" if self._version is None else "names of rigid bodies, though the server answers,"

    def receive(self, data: bytes, at_ns: int) -> tuple[BodyPose | Echo, ...]:
        """See `Camera`."""
        if len(data) < _HEAD.size or _HEAD.unpack_from(data)[1] != len(data) - _HEAD.size:
            self.dropped[UNREADABLE] += 1
            return ()
        kind, payload = _HEAD.unpack_from(data)[0], data[_HEAD.size :]
        if kind in _ALIVE:
            self._heard_ns = at_ns
        try:
            if kind == SERVER_INFO:
                self._handle_server_info(payload)
            elif kind == ECHO and self._ticks_per_s:
                token, ticks = _ECHO.unpack_from(payload)
                return (Echo(token, self._ticks_to_ns(ticks)),)
            elif kind == DESCRIPTIONS and self._version is not None:
                self._handle_descriptions(
                    natnet.DataDescriptions.read_from_buffer(_BoundedBuffer(payload), natnet.Version(*self._version))
                )
            elif kind == FRAME and self._version is not None and self._is_complete:
                return self._handle_frame(_read_frame(payload, self._version))
        except _UNREADABLE:
            self.dropped[UNREADABLE] += 1
        return ()

    def due(self, at_ns: int) -> tuple[bytes, ...]:
        """See `Camera`: until it answers, and again when it is silent, twice a second at most."""
        is_silent = at_ns - self._heard_ns >= _SILENT_NS
        if (is_silent or not self._is_complete) and at_ns - self._asked_ns >= _RETRY_NS:
            self._asked_ns = at_ns
            if is_silent and self.ready:
                self.dropped[SILENT] += 1
                self._is_complete = False  # another server may come back, with other numbers for its bodies
            if is_silent or self._version is None:
                return (_encode_message(CONNECT, b"Ping\0"),)
            self._requests += 1
            return (
                _encode_message(REQUEST_DESCRIPTIONS, struct.pack("<I", RIGID_BODIES) if self._requests % 2 else b""),
            )
        if self._version is not None and at_ns - self._keep_alive_ns >= _KEEP_NS:
            self._keep_alive_ns = at_ns
            return (_encode_message(KEEP_ALIVE, b""),)
        return ()

    def ask_time(self, token: int) -> bytes:
        """See `Camera`."""
        return _encode_message(ECHO_REQUEST, struct.pack("<Q", token))

    def _ticks_to_ns(self, ticks: int) -> int:
        return ticks * 1_000_000_000 // self._ticks_per_s

    def _handle_server_info(self, payload: bytes) -> None:
        """Store version, clock and group; a restarted server is asked for its bodies again."""
        if len(payload) < _SERVER.size:  # as before 3.0
            self._refuse("an older NatNet than 3.0, whose frames have no time of exposure; use Motive 2.0 or newer")
            return
        if payload == self._info and self._is_complete:  # nothing new
            return
        fields = _SERVER.unpack_from(payload)
        version, (ticks_per_s, port, multicast, group) = fields[5:9], fields[9:]
        text = ".".join(map(str, version[:2]))
        if version[:2] < OLDEST or version[0] > NEWEST_MAJOR:
            self._refuse(f"NatNet {text}, and this reads 3.0 to {NEWEST_MAJOR}.x; use Motive 2.0 to 3.x")
            return
        if not ticks_per_s:
            self._refuse(f"NatNet {text} without the rate of its clock, so the age of its frames is unknown")
            return
        self._info, self._version, self._ticks_per_s = payload, version, ticks_per_s
        self._is_complete = False
        self.group = (str(IPv4Address(group)), port) if multicast else None

    def _handle_descriptions(self, descriptions: natnet.DataDescriptions) -> None:
        bodies = {candidate.name: candidate.id_num for candidate in descriptions.rigid_bodies}
        self._body_id = bodies.get(self._body)
        if self._body_id is None:
            names = ", ".join(repr(name) for name in sorted(filter(None, bodies))) or "none"
            self._refuse(
                f"no rigid body {self._body!r}; it has: {names}. Write one of them behind the server's address"
            )
            return
        self._is_complete = self.ready = True

    def _handle_frame(self, frame: natnet.DataFrame) -> tuple[BodyPose, ...]:
        body = next((candidate for candidate in frame.rigid_bodies if candidate.id_num == self._body_id), None)
        exposed, sent = frame.suffix.stamp_camera_mid_exposure, frame.suffix.stamp_transmit
        if body is None:
            return self._count_dropped(MISSING)
        if not exposed or not sent:  # for example a recorded take
            return self._count_dropped(NO_STAMP)
        x, y, z, w = body.rot
        attitude = normalise_quaternion((w, x, y, z))
        if not 0 <= sent - exposed <= _MAX_EXPOSED_S * self._ticks_per_s:
            return self._count_dropped(UNREADABLE)
        if not body.tracking_valid or attitude is None or not all(map(math.isfinite, body.pos)):
            return self._count_dropped(UNTRACKED)
        return (self._make_pose(exposed, body.pos, attitude),)

    def _make_pose(self, exposed_ticks: int, position_m: tuple[float, float, float], attitude: Quaternion) -> BodyPose:
        return BodyPose(self._ticks_to_ns(exposed_ticks), *convert_pose_to_frd(position_m, attitude, self._up))

    def _count_dropped(self, reason: str) -> tuple[BodyPose, ...]:
        self.dropped[reason] += 1
        return ()

    def _refuse(self, text: str) -> None:
        """End the start with an error; in flight, only count."""
        if not self.ready:
            raise CameraError(f"the server has {text}")
        self.dropped[MISSING] += 1


def _encode_message(kind: int, payload: bytes) -> bytes:
    return _HEAD.pack(kind, len(payload)) + payload
