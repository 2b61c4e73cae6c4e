"""A server of NatNet for tests, written from the public description of the protocol (NatNetTypes.h of the SDK).

It shares nothing with the code under test: an encoder of the two layouts that it speaks (3.1 and 4.1), and a thread
that answers on loopback. Frames go where the request to connect came from, as Motive's unicast does, or to a group.
"""

from __future__ import annotations

import socket
import struct
import threading
import time
from dataclasses import dataclass, field

TICKS_PER_S = 10_000_000
UPTIME_S = 5000.0  # of its clock, so that it is never ours
TRACKED = 1
Quaternion = tuple[float, float, float, float]


@dataclass
class Body:
    """A rigid body: pose in the room's axes, quaternion as x, y, z, w."""

    number: int
    name: str
    position_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    xyzw: Quaternion = (0.0, 0.0, 0.0, 1.0)
    tracked: bool = True
    shown: bool = True
    exposed_s: float | None = None  # when it was there, on our monotonic clock; None: the server's latency ago


def message(kind: int, payload: bytes) -> bytes:
    return struct.pack("<HH", kind, len(payload)) + payload


def text(arguments: str) -> bytes:
    return arguments.encode() + b"\0"


def server_info(
    version: tuple[int, int], group: tuple[str, int] | None = None, *, rate: int = TICKS_PER_S, short: bool = False
) -> bytes:
    where, port = group or ("0.0.0.0", 1511)
    payload = b"Motive".ljust(256, b"\0") + bytes((3, 0, 0, 1)) + bytes((*version, 0, 0))
    rest = struct.pack("<QHB", rate, port, group is not None) + socket.inet_aton(where)
    return message(1, payload if short else payload + rest)


def descriptions(bodies: list[Body], version: tuple[int, int]) -> bytes:
    described = []
    for body in bodies:
        data = text(body.name) + struct.pack("<ii3f", body.number, -1, 0.0, 0.0, 0.0)
        if version >= (4, 2):
            data += struct.pack("<4f", 0.0, 0.0, 0.0, 1.0)
        data += struct.pack("<i3fi", 1, 0.01, 0.02, 0.03, 7)  # one marker: place, label
        if version >= (4, 0):
            data += text("Marker 1")
        size = struct.pack("<i", len(data)) if version >= (4, 1) else b""
        described.append(struct.pack("<i", 1) + size + data)
    return message(5, struct.pack("<i", len(described)) + b"".join(described))


def frame(
    number: int, bodies: list[Body], version: tuple[int, int], exposed_s: float, sent_s: float, *, stamped: bool = True
) -> bytes:
    def data_set(*items: bytes) -> bytes:
        size = struct.pack("<i", sum(map(len, items))) if version >= (4, 1) else b""
        return struct.pack("<i", len(items)) + size + b"".join(items)

    def rigid(body: Body) -> bytes:
        pose = struct.pack("<i7f", body.number, *body.position_m, *body.xyzw)
        return pose + struct.pack("<fh", 0.0004, TRACKED if body.tracked else 0)

    marker = struct.pack("<i3ff", (1 << 16) + 1, 0.1, 0.2, 0.3, 0.014) + struct.pack("<hf", 10, 0.0001)
    payload = struct.pack("<i", number)
    payload += data_set(text("all") + struct.pack("<i3f", 1, 0.1, 0.2, 0.3))  # marker sets
    payload += data_set(struct.pack("<3f", 1.0, 2.0, 3.0))  # markers without a label
    payload += data_set(*(rigid(body) for body in bodies if body.shown))
    payload += data_set()  # skeletons
    if version >= (4, 1):
        payload += data_set()  # assets
    payload += data_set(marker)  # markers with a label
    payload += data_set() + data_set()  # force plates, devices
    stamps = [round((UPTIME_S + at_s) * TICKS_PER_S) if stamped else 0 for at_s in (exposed_s, exposed_s, sent_s)]
    payload += struct.pack("<IId3Q", 0, 0, sent_s, *stamps)
    if version >= (4, 1):
        payload += struct.pack("<II", 0, 0)  # precision time
    return message(7, payload + struct.pack("<hi", 0, 0))


@dataclass
class Server:
    """A server that runs while it is entered."""

    bodies: list[Body]
    version: tuple[int, int] = (4, 1)
    latency_s: float = 0.004  # from exposure to sending
    group: tuple[str, int] | None = None
    needs_mask: bool = True  # answers a request for descriptions only with a mask, as Motive 3.1 does
    echoes: bool = True
    short: bool = False
    names: bool = True
    port: int = 0
    heard: list[int] = field(default_factory=list)
    echo_answers: int = 0
    frames: int = 0

    def __enter__(self) -> Server:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", self.port))
        self._socket.settimeout(0.005)
        self.port = self._socket.getsockname()[1]
        if self.group is not None:
            self._socket.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton("127.0.0.1"))
        self._client: tuple[str, int] | None = None
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()
        return self

    def __exit__(self, *what: object) -> None:
        self._over.set()
        self._thread.join()
        self._socket.close()

    def send(self, data: bytes) -> None:
        """Send a datagram to the client, as anybody can who forges the server's address."""
        assert self._client is not None
        self._socket.sendto(data, self._client)

    def _serve(self) -> None:
        next_s, last_s = time.monotonic(), 0.0
        while not self._over.is_set():
            try:
                data, sender = self._socket.recvfrom(2048)
                self._answer(data, sender)
            except TimeoutError:
                pass
            if self._client is not None and time.monotonic() >= next_s:
                next_s = time.monotonic() + 0.01
                bodies, now_s = self.bodies.copy(), time.monotonic()
                stamped = [body.exposed_s for body in bodies if body.exposed_s is not None]
                exposed_s = max(stamped, default=now_s - self.latency_s)
                if exposed_s == last_s:  # nothing new was seen
                    continue
                last_s = exposed_s
                self.frames += 1
                data = frame(self.frames, bodies, self.version, exposed_s, now_s)
                self._socket.sendto(data, self.group or self._client)

    def _answer(self, data: bytes, sender: tuple[str, int]) -> None:
        kind, size = struct.unpack_from("<HH", data)
        assert size == len(data) - 4
        self.heard.append(kind)
        if kind == 0:
            self._client = sender
            self._socket.sendto(server_info(self.version, self.group, short=self.short), sender)
        elif kind == 4 and self.names and (not self.needs_mask or data[4:] == struct.pack("<I", 2)):
            self._socket.sendto(descriptions(self.bodies, self.version), sender)
        elif kind == 12 and self.echoes:
            ticks = round((UPTIME_S + time.monotonic()) * TICKS_PER_S)
            self.echo_answers += 1
            self._socket.sendto(message(13, data[4:12] + struct.pack("<Q", ticks)), sender)
