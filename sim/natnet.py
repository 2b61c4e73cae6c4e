"""The simulated cameras as an OptiTrack server: poses in NatNet 4.1, unicast, as Motive 3 streams them.

It takes the cameras' MAVLink, as any port of the simulator does, and answers NatNet clients: a
client that connects gets frames. While the body is hidden, the frames mark it as not tracked, as Motive's do.
"""

from __future__ import annotations

import socket
import struct
import time
from collections.abc import Callable
from contextlib import suppress
from urllib.parse import parse_qs, quote, unquote, urlsplit

import msgspec
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from uavctl.config.types import Config
from uavctl.errors import ConnectionSpecError
from uavctl.records import Vec3

SCHEME = "natnet"
PORT = 1510  # Motive's own
URL_FORMAT = "natnet://127.0.0.1[:PORT]/BODY[?up=z]"
VERSION = (4, 1, 0, 0)
TICKS_PER_US = 10
BODY_ID = 1
TRACKED = 1
MAX_CLIENTS = 8
CLIENT_TIMEOUT_S = 10.0  # a silent client gets no more frames after this time
TRACKING_TIMEOUT_S = 0.1  # the body counts as not tracked after this time without a pose
MAX_DATAGRAM_BYTES = 65535
CONNECT, SERVER_INFO, DESCRIBE, DESCRIPTIONS, FRAME, ECHO_REQUEST, ECHO = 0, 1, 4, 5, 7, 12, 13
LEVEL = 0.0, 0.0, 0.0, 1.0  # x, y, z, w
# Forward, right, down in the axes that Motive streams, by the one that is up; the first is forward.
AXES: dict[str, Callable[[Vec3], Vec3]] = {"y": lambda v: (v[0], -v[2], v[1]), "z": lambda v: (v[0], -v[1], -v[2])}


def make_motive_config(config: Config) -> Config:
    """Return the configuration with poses as NatNet needs them: whole attitudes, in axes forward, right, down."""
    replace = msgspec.structs.replace
    sim = replace(config.sim, camera=replace(config.sim.camera, message="odometry"))
    return replace(config, sim=sim, frame=replace(config.frame, convention="ned"))


class NatNetPort:
    """A NatNet server with one body; implements `sim.server.Port`.

    Attributes:
        clock_us: returns the cameras' clock now [µs]; the server sets it before the first frame.

    Raises:
        ConnectionSpecError: the URL is not of the form natnet://ADDRESS[:PORT]/BODY[?up=y|z].
        OSError: the port cannot be had.
    """

    def __init__(self, url: str) -> None:
        self._body, self._up, address = _parse_url(url)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        try:
            self._socket.bind(address)
        except OSError:
            self._socket.close()
            raise
        self._clients: dict[tuple[str, int], float] = {}  # time of each client's last message [s]
        self._sent_s = 0.0
        self._frame_count = 0
        self.clock_us: Callable[[], int] = lambda: 0

    @property
    def url(self) -> str:
        """The URL with the port number that is really used."""
        host, port = self._socket.getsockname()
        return f"{SCHEME}://{host}:{port}/{quote(self._body)}{'' if self._up == 'y' else '?up=z'}"

    def sockets(self) -> tuple[socket.socket, ...]:
        """See `Port`."""
        return (self._socket,)

    def read(self) -> list[bytes]:
        """Answer the clients; nothing of theirs is MAVLink."""
        with suppress(BlockingIOError):
            while True:
                with suppress(ConnectionError):
                    self._answer_request(*self._socket.recvfrom(MAX_DATAGRAM_BYTES))
        if self._clients and time.monotonic() - self._sent_s > TRACKING_TIMEOUT_S:
            self._send_frame(self.clock_us(), (0.0, 0.0, 0.0), LEVEL, tracked=False)
        return []

    def write(self, data: bytes) -> None:
        """Stream a frame with the pose of an ODOMETRY; a frame that the channel has damaged is lost."""
        parser = mavlink.MAVLink(None)
        parser.robust_parsing = True
        for msg in parser.parse_buffer(data) or ():
            if msg.get_type() == "ODOMETRY":
                w, *axis = msg.q
                transform = AXES[self._up]
                self._send_frame(
                    msg.time_usec, transform((msg.x, msg.y, msg.z)), (*transform((axis[0], axis[1], axis[2])), w)
                )

    def close(self) -> None:
        """See `Port`."""
        self._socket.close()

    def _answer_request(self, data: bytes, sender: tuple[str, int]) -> None:
        if len(data) < 4:
            return
        kind = int.from_bytes(data[:2], "little")
        if kind == CONNECT and (sender in self._clients or len(self._clients) < MAX_CLIENTS):
            self._clients[sender] = time.monotonic()
            self._send(SERVER_INFO, _pack_server_info(), sender)
        elif kind == DESCRIBE:
            self._send(DESCRIPTIONS, _pack_descriptions(self._body), sender)
        elif kind == ECHO_REQUEST and len(data) == 12:
            self._send(ECHO, data[4:] + struct.pack("<Q", self.clock_us() * TICKS_PER_US), sender)
        if sender in self._clients:
            self._clients[sender] = time.monotonic()

    def _send_frame(
        self, exposed_us: int, position_m: Vec3, xyzw: tuple[float, float, float, float], *, tracked: bool = True
    ) -> None:
        now_s = self._sent_s = time.monotonic()
        self._frame_count += 1
        # The cameras' clock may drift against the simulation's by less than it takes to send.
        sent_us = max(self.clock_us(), exposed_us)
        frame = _pack_frame(self._frame_count, exposed_us, sent_us, position_m, xyzw, tracked=tracked)
        for client, heard_s in list(self._clients.items()):
            if now_s - heard_s > CLIENT_TIMEOUT_S:
                del self._clients[client]
            else:
                self._send(FRAME, frame, client)

    def _send(self, kind: int, payload: bytes, to: tuple[str, int]) -> None:
        with suppress(OSError):  # no receiver, or no room: lost, as on a network
            self._socket.sendto(struct.pack("<HH", kind, len(payload)) + payload, to)


def _parse_url(url: str) -> tuple[str, str, tuple[str, int]]:
    try:
        parts = urlsplit(url)
        host, port = parts.hostname, parts.port
        query = parse_qs(parts.query, strict_parsing=bool(parts.query))
    except ValueError as error:
        raise ConnectionSpecError(f"{url}: {error}; write {URL_FORMAT}") from error
    body, up = unquote(parts.path.removeprefix("/")), query.pop("up", ["y"])[-1]
    if not host or not body or query or up not in AXES:
        raise ConnectionSpecError(f"{url}: no address, body, or axis that is up (y or z); write {URL_FORMAT}")
    return body, up, (host, PORT if port is None else port)


# Messages of NatNet 4.1 (NatNetTypes.h of the public SDK): a set is the number, the size and the bytes of its items.


def _pack_set(*items: bytes) -> bytes:
    return struct.pack("<ii", len(items), sum(map(len, items))) + b"".join(items)


def _pack_server_info() -> bytes:
    versions = bytes((3, 0, 0, 0)) + bytes(VERSION)
    clock = struct.pack("<QH?4s", TICKS_PER_US * 1_000_000, PORT + 1, False, bytes(4))  # unicast
    return b"Motive".ljust(256, b"\0") + versions + clock


def _pack_descriptions(name: str) -> bytes:
    body = name.encode() + b"\0" + struct.pack("<ii3fi", BODY_ID, -1, 0.0, 0.0, 0.0, 0)  # no parent, no markers
    return struct.pack("<iii", 1, 1, len(body)) + body


def _pack_frame(
    number: int, exposed_us: int, sent_us: int, position_m: Vec3, xyzw: tuple[float, ...], *, tracked: bool
) -> bytes:
    body = struct.pack("<i7ffh", BODY_ID, *position_m, *xyzw, 0.0, TRACKED if tracked else 0)
    # Marker sets and other markers; then skeletons, assets, markers with labels, force plates, devices
    sets = _pack_set() + _pack_set() + _pack_set(body) + _pack_set() * 5
    exposed, sent = exposed_us * TICKS_PER_US, sent_us * TICKS_PER_US
    suffix = struct.pack("<IId3QII", 0, 0, exposed_us * 1e-6, exposed, exposed, sent, 0, 0)
    return struct.pack("<i", number) + sets + suffix + struct.pack("<hi", 0, 0)
