"""A small client of the live view: enough of WebSocket and of Foxglove's protocol to subscribe and to read."""

from __future__ import annotations

import base64
import json
import os
import socket
import struct
from collections.abc import Iterator
from typing import Any, Self

LIMIT_S = 60.0
TEXT, BINARY, PING = 1, 2, 9
_DATA = struct.Struct("<BIQ")  # message data: opcode, subscription, log time


class Viewer:
    """A viewer on this machine; reads only when it is asked to."""

    def __init__(self, port: int, receive_bytes: int | None = None) -> None:
        self._socket = socket.socket()
        if receive_bytes is not None:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_bytes)
        self._socket.settimeout(LIMIT_S)
        self._socket.connect(("127.0.0.1", port))
        self._buffer = b""
        self.topics: dict[int, str] = {}
        self._socket.sendall(
            b"GET / HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            b"Sec-WebSocket-Key: " + base64.b64encode(os.urandom(16)) + b"\r\n"
            b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Protocol: foxglove.sdk.v1\r\n\r\n"
        )
        while b"\r\n\r\n" not in self._buffer:
            self._buffer += self._more()
        head, _, self._buffer = self._buffer.partition(b"\r\n\r\n")
        assert b" 101 " in head.splitlines()[0], head

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()

    def channels(self, wanted: set[str]) -> dict[str, dict[str, Any]]:
        """Read until all wanted topics are offered."""
        channels: dict[str, dict[str, Any]] = {}
        while not wanted <= channels.keys():
            opcode, data = self._frame()
            if opcode == TEXT:
                document = json.loads(data)
                if document["op"] == "advertise":
                    channels |= {channel["topic"]: channel for channel in document["channels"]}
        return channels

    def subscribe(self, channels: dict[str, dict[str, Any]]) -> None:
        """Ask for all messages of these topics."""
        wanted = [{"id": channel["id"], "channelId": channel["id"]} for channel in channels.values()]
        self.topics |= {int(channel["id"]): topic for topic, channel in channels.items()}
        self._send(json.dumps({"op": "subscribe", "subscriptions": wanted}).encode())

    def messages(self) -> Iterator[tuple[str, int, bytes]]:
        """Topic, log time [ns] and bytes of what comes."""
        while True:
            opcode, data = self._frame()
            if opcode == BINARY and data[0] == 1:
                _, subscription, at_ns = _DATA.unpack_from(data)
                yield self.topics[subscription], at_ns, data[_DATA.size :]

    def _frame(self) -> tuple[int, bytes]:
        first, second = self._take(2)
        length = second & 0x7F
        if length >= 126:
            length = int.from_bytes(self._take(2 if length == 126 else 8), "big")
        return first & 0x0F, self._take(length)

    def _send(self, data: bytes) -> None:
        mask = os.urandom(4)
        head = bytes([0x80 | TEXT, 0x80 | 126]) + len(data).to_bytes(2, "big")
        self._socket.sendall(head + mask + bytes(byte ^ mask[i % 4] for i, byte in enumerate(data)))

    def _take(self, count: int) -> bytes:
        while len(self._buffer) < count:
            self._buffer += self._more()
        taken, self._buffer = self._buffer[:count], self._buffer[count:]
        return taken

    def _more(self) -> bytes:
        data = self._socket.recv(1 << 16)
        assert data, "the server hung up"
        return data
