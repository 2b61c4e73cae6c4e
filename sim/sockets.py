"""The simulator's own sockets: datagrams in and out over UDP or one TCP client; nothing blocks."""

from __future__ import annotations

import socket
from collections.abc import Callable
from contextlib import suppress
from typing import Protocol
from urllib.parse import urlsplit

from uavctl.errors import ConnectionSpecError

LARGEST_DATAGRAM = 65535
LARGEST_BACKLOG = 1 << 16  # a TCP client that leaves more unread is dropped [bytes]
V1, V2 = 0xFE, 0xFD
SIGNED = 0x01
# What a peer that is not there, or not there any more, does to a socket.
GONE = (ConnectionRefusedError, ConnectionResetError, BrokenPipeError)


class Port(Protocol):
    """One end of a connection."""

    @property
    def url(self) -> str:
        """The URL with the port number that is really used."""
        ...

    def sockets(self) -> tuple[socket.socket, ...]:
        """What to wait for."""
        ...

    def read(self) -> list[bytes]:
        """Everything that has come, one MAVLink datagram or frame each."""
        ...

    def write(self, data: bytes) -> None:
        """Send one datagram; lost if nobody is there."""
        ...

    def close(self) -> None:
        """Close every socket."""
        ...


class UdpPort:
    """UDP: `udpout` sends to an address, `udpin` to whoever spoke last."""

    def __init__(self, scheme: str, address: tuple[str, int]) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._peer: tuple[str, int] | None = None
        self._scheme = scheme
        if scheme == "udpout":
            self._peer = address
        try:
            self._socket.bind(("", 0) if scheme == "udpout" else address)
        except OSError:
            self._socket.close()
            raise
        self._address = self._peer or self._socket.getsockname()

    @property
    def url(self) -> str:
        """The URL with the port number that is really used."""
        return f"{self._scheme}://{self._address[0]}:{self._address[1]}"

    def sockets(self) -> tuple[socket.socket, ...]:
        """What to wait for."""
        return (self._socket,)

    def read(self) -> list[bytes]:
        """Everything that has come."""
        taken = []
        with suppress(BlockingIOError):
            while True:
                with suppress(*GONE):
                    data, sender = self._socket.recvfrom(LARGEST_DATAGRAM)
                    if self._scheme == "udpin":
                        self._peer = sender
                    taken.append(data)
        return taken

    def write(self, data: bytes) -> None:
        """Send one datagram."""
        if self._peer is not None:
            with suppress(BlockingIOError, *GONE):
                self._socket.sendto(data, self._peer)

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class TcpPort:
    """A listening TCP socket with one client at a time, as ArduPilot's simulator has on port 5760."""

    def __init__(self, address: tuple[str, int]) -> None:
        self._listener = socket.create_server(address, backlog=1)
        self._listener.setblocking(False)
        self._client: socket.socket | None = None
        self._stream = bytearray()
        self._backlog = bytearray()

    @property
    def url(self) -> str:
        """The URL with the port number that is really used."""
        host, port = self._listener.getsockname()
        return f"tcpin://{host}:{port}"

    def sockets(self) -> tuple[socket.socket, ...]:
        """What to wait for."""
        return (self._listener,) if self._client is None else (self._client,)

    def read(self) -> list[bytes]:
        """Accept a client if there is none; then every whole frame that has come."""
        with suppress(BlockingIOError):
            if self._client is None:
                self._client, _ = self._listener.accept()
                self._client.setblocking(False)
                self._client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            while self._client is not None:
                self._take(self._client)
        return cut_frames(self._stream)

    def _take(self, client: socket.socket) -> None:
        try:
            data = client.recv(LARGEST_DATAGRAM)
        except GONE:
            data = b""
        if data:
            self._stream += data
        else:
            self._drop()

    def write(self, data: bytes) -> None:
        """Send to the client, in order; what the socket does not take at once waits for the next call."""
        if self._client is None:
            return
        self._backlog += data
        try:
            del self._backlog[: self._client.send(self._backlog)]
        except BlockingIOError:
            if len(self._backlog) > LARGEST_BACKLOG:
                self._drop()
        except GONE:
            self._drop()

    def _drop(self) -> None:
        if self._client is not None:
            self._client.close()
        self._client = None
        self._stream.clear()
        self._backlog.clear()

    def close(self) -> None:
        """Close the client and the listening socket."""
        self._drop()
        self._listener.close()


def cut_frames(stream: bytearray) -> list[bytes]:
    """Take the whole MAVLink frames off a stream's front; bytes before a start mark are passed over."""
    frames = []
    while stream:
        if stream[0] not in (V1, V2):
            del stream[0]
            continue
        if len(stream) < 3:
            break
        length = stream[1] + (8 if stream[0] == V1 else 12)
        if stream[0] == V2 and stream[2] & SIGNED:
            length += 13
        if len(stream) < length:
            break
        frames.append(bytes(stream[:length]))
        del stream[:length]
    return frames


def open_port(url: str) -> Port:
    """Open a port from its URL.

    Raises:
        ConnectionSpecError: not a URL of a kind that the simulator has, or it cannot be opened.
    """
    kinds: dict[str, Callable[[tuple[str, int]], Port]] = {
        "udpout": lambda address: UdpPort("udpout", address),
        "udpin": lambda address: UdpPort("udpin", address),
        "tcpin": TcpPort,
    }
    try:
        parts = urlsplit(url)
        host, port = parts.hostname, parts.port
    except ValueError as error:
        raise ConnectionSpecError(f"{url}: {error}; write udpout://127.0.0.1:14540") from error
    if parts.scheme not in kinds or host is None or port is None:
        raise ConnectionSpecError(f"{url}: the simulator speaks {', '.join(kinds)}; write udpout://127.0.0.1:14540")
    try:
        return kinds[parts.scheme]((host, port))
    except OSError as error:
        raise ConnectionSpecError(
            f"{url}: cannot be opened ({error.strerror or error}); choose another port"
        ) from error
