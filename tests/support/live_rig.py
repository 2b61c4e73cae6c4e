"""Clients of the live view: plain HTTP, and enough of WebSocket and of Foxglove's protocol to subscribe and to read."""

from __future__ import annotations

import base64
import json
import os
import socket
import struct
from collections.abc import Iterator, Mapping
from typing import Any, Self

LIMIT_S = 60.0
TEXT, BINARY, PING = 1, 2, 9
_DATA = struct.Struct("<BIQ")  # message data: opcode, subscription, log time


HANDSHAKE = {
    "Host": "localhost",
    "Upgrade": "websocket",
    "Connection": "Upgrade",
    "Sec-WebSocket-Key": base64.b64encode(bytes(16)).decode(),
    "Sec-WebSocket-Version": "13",
    "Sec-WebSocket-Protocol": "foxglove.sdk.v1",
}


def make_head(headers: Mapping[str, str], path: str = "/", method: str = "GET") -> bytes:
    """The head of a request."""
    return "\r\n".join([f"{method} {path} HTTP/1.1", *(f"{n}: {v}" for n, v in headers.items()), "", ""]).encode()


def make_frame(data: bytes, opcode: int = TEXT) -> bytes:
    """A client's frame of 126 to 65,535 bytes, or of less in the longer form."""
    mask = os.urandom(4)
    head = bytes([0x80 | opcode, 0x80 | 126]) + len(data).to_bytes(2, "big")
    return head + mask + bytes(byte ^ mask[i % 4] for i, byte in enumerate(data))


def ask(port: int, request: bytes) -> tuple[int, bytes]:
    """Status and body of the answer to a request; of an upgrade, status and nothing."""
    with socket.create_connection(("127.0.0.1", port), timeout=LIMIT_S) as client:
        client.sendall(request)
        answer = b""
        while not answer.startswith(b"HTTP/1.1 101") and (data := client.recv(1 << 16)):
            answer += data
    head, _, body = answer.partition(b"\r\n\r\n")
    return int(head.split(b" ", 2)[1]), body


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
        self._socket.sendall(make_head(HANDSHAKE))
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
            opcode, data = self.read_frame()
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

    def demand(self, data: bytes, opcode: int = TEXT) -> dict[str, Any]:
        """Send a request, and return the next answer that is no offer."""
        self._send(data, opcode)
        while True:
            opcode, answer = self.read_frame()
            if opcode == TEXT and (document := json.loads(answer))["op"] not in ("serverInfo", "advertise"):
                return dict(document)

    def messages(self) -> Iterator[tuple[str, int, bytes]]:
        """Topic, log time [ns] and bytes of what comes."""
        while True:
            opcode, data = self.read_frame()
            if opcode == BINARY and data[0] == 1:
                _, subscription, at_ns = _DATA.unpack_from(data)
                yield self.topics[subscription], at_ns, data[_DATA.size :]

    def read_frame(self) -> tuple[int, bytes]:
        first, second = self._take(2)
        length = second & 0x7F
        if length >= 126:
            length = int.from_bytes(self._take(2 if length == 126 else 8), "big")
        return first & 0x0F, self._take(length)

    def send(self, data: bytes) -> None:
        """Send bytes that need not be a frame."""
        self._socket.sendall(data)

    def _send(self, data: bytes, opcode: int = TEXT) -> None:
        self._socket.sendall(make_frame(data, opcode))

    def _take(self, count: int) -> bytes:
        while len(self._buffer) < count:
            self._buffer += self._more()
        taken, self._buffer = self._buffer[:count], self._buffer[count:]
        return taken

    def _more(self) -> bytes:
        data = self._socket.recv(1 << 16)
        assert data, "the server hung up"
        return data
