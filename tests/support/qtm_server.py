"""A server of Qualisys' real-time protocol for tests: packets built by hand, a thread that answers on loopback."""

from __future__ import annotations

import math
import socket
import struct
import threading
import time
from dataclasses import dataclass, field

IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
UPTIME_US = 70_000_000


def packet(kind: int, payload: bytes) -> bytes:
    return struct.pack("<II", 8 + len(payload), kind) + payload


def command(arguments: str, kind: int = 1) -> bytes:
    return packet(kind, arguments.encode() + b"\0")


def parameters(names: list[str]) -> bytes:
    bodies = "".join(f"<Body><Name>{name}</Name><Enabled>true</Enabled></Body>" for name in names)
    text = f"<QTM_Parameters_Ver_1.25><The_6D><Bodies>{len(names)}</Bodies>{bodies}</The_6D></QTM_Parameters_Ver_1.25>"
    return command(text, 2)


@dataclass
class QtmBody:
    """A rigid body: place [m] and turn, a matrix by columns."""

    name: str
    position_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    columns: tuple[float, ...] = IDENTITY
    seen: bool = True

    def packed(self) -> bytes:
        numbers = (*(1000.0 * value for value in self.position_m), *self.columns)
        return struct.pack("<12f", *(numbers if self.seen else (math.nan,) * 12))


def frame(number: int, at_us: int, bodies: list[QtmBody]) -> bytes:
    component = struct.pack("<ihh", len(bodies), 0, 0) + b"".join(body.packed() for body in bodies)
    time_code = struct.pack("<IIi", 12, 17, 0)  # a time code of no entries goes before
    component = struct.pack("<II", 8 + len(component), 5) + component
    return packet(3, struct.pack("<qII", at_us, number, 2) + time_code + component)


@dataclass
class QtmServer:
    """A server that runs while it is entered; it takes one client at a time."""

    bodies: list[QtmBody]
    refuses: str = ""  # text with which it refuses the version
    port: int = 0
    heard: list[str] = field(default_factory=list)
    connections: int = 0

    def __enter__(self) -> QtmServer:
        self._listener = socket.create_server(("127.0.0.1", self.port))
        self._listener.settimeout(0.02)
        self.port = self._listener.getsockname()[1]
        self._over, self._hang_up = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()
        return self

    def __exit__(self, *what: object) -> None:
        self._over.set()
        self._thread.join()
        self._listener.close()

    def hang_up(self) -> None:
        """End the connection that there is."""
        self._hang_up.set()

    def _serve(self) -> None:
        while not self._over.is_set():
            try:
                client, _ = self._listener.accept()
            except TimeoutError:
                continue
            self.connections += 1
            self._hang_up.clear()
            with client:
                client.settimeout(0.01)
                try:
                    self._talk(client)
                except ConnectionError:
                    continue

    def _talk(self, client: socket.socket) -> None:
        client.sendall(command("QTM RT Interface connected"))
        rest, streams, number = b"", False, 0
        while not (self._over.is_set() or self._hang_up.is_set()):
            try:
                data = client.recv(4096)
                if not data:
                    return
                rest += data
            except TimeoutError:
                pass
            while len(rest) >= 8 and len(rest) >= (size := int.from_bytes(rest[:4], "little")):
                arguments, rest = rest[8:size].rstrip(b"\0").decode(), rest[size:]
                self.heard.append(arguments)
                streams = streams or arguments == "StreamFrames AllFrames 6D"
                client.sendall(self._answer(arguments))
            if streams:
                number += 1
                at_us = UPTIME_US + time.monotonic_ns() // 1000
                whole = frame(number, at_us, self.bodies)
                client.sendall(whole[:31])  # in pieces
                client.sendall(whole[31:])

    def _answer(self, arguments: str) -> bytes:
        if arguments.startswith("Version"):
            return command(self.refuses, 0) if self.refuses else command("Version set to 1.25")
        return parameters([body.name for body in self.bodies]) if arguments == "GetParameters 6D" else b""
