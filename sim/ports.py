"""Sockets of the simulator: datagrams in and out over UDP or TCP; nothing blocks."""

from __future__ import annotations

import socket
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Protocol
from urllib.parse import urlsplit

from sim.natnet import SCHEME, NatNetPort
from uavctl.errors import ConnectionSpecError

MAX_DATAGRAM_BYTES = 65535
MAX_BACKLOG_BYTES = 1 << 16  # a TCP client that leaves more unread is dropped [bytes]
MAX_CLIENTS = 8  # of a TCP port
V1, V2 = 0xFE, 0xFD
SIGNED = 0x01
Greeting = tuple[bytes, ...]
# Errors of a socket whose peer is absent or gone.
DISCONNECT_ERRORS = (ConnectionRefusedError, ConnectionResetError, BrokenPipeError)


class Port(Protocol):
    """Interface of one end of a connection."""

    @property
    def url(self) -> str:
        """The URL with the port number that is really used."""
        ...

    def sockets(self) -> tuple[socket.socket, ...]:
        """Return the sockets to wait for."""
        ...

    def read(self) -> list[bytes]:
        """Return everything that has come, one MAVLink datagram or frame each."""
        ...

    def write(self, data: bytes) -> None:
        """Send one datagram; it is lost without a receiver."""
        ...

    def close(self) -> None:
        """Close every socket."""
        ...


class UdpPort:
    """UDP: `udpout` sends to an address, `udpin` to the last sender."""

    def __init__(self, scheme: str, address: tuple[str, int]) -> None:
        self._peer: tuple[str, int] | None = None
        self._scheme = scheme
        if scheme == "udpout":  # an unknown host raises here
            self._peer = socket.gethostbyname(address[0]), address[1]
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        try:
            self._socket.bind(("", 0) if scheme == "udpout" else address)
        except OSError:
            self._socket.close()
            raise
        self._address = address if scheme == "udpout" else self._socket.getsockname()

    @property
    def url(self) -> str:
        """The URL with the port number that is really used."""
        return f"{self._scheme}://{self._address[0]}:{self._address[1]}"

    def sockets(self) -> tuple[socket.socket, ...]:
        """Return the sockets to wait for."""
        return (self._socket,)

    def read(self) -> list[bytes]:
        """Return everything that has come."""
        datagrams = []
        with suppress(BlockingIOError):
            while True:
                with suppress(*DISCONNECT_ERRORS):
                    data, sender = self._socket.recvfrom(MAX_DATAGRAM_BYTES)
                    if self._scheme == "udpin":
                        self._peer = sender
                    datagrams.append(data)
        return datagrams

    def write(self, data: bytes) -> None:
        """Send one datagram."""
        if self._peer is not None:
            with suppress(OSError):  # no way there, or no room: lost, as on a radio
                self._socket.sendto(data, self._peer)

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


@dataclass
class _TcpClient:
    """One client of a `TcpPort`."""

    socket: socket.socket
    greeting: list[bytes]  # what of it is still to come
    received: bytearray = field(default_factory=bytearray)  # come, not yet a whole frame
    backlog: bytearray = field(default_factory=bytearray)  # to go

    def read(self) -> bool:
        """Take everything that has come; return False when the client is gone."""
        try:
            while data := self.socket.recv(MAX_DATAGRAM_BYTES):
                self.received += data
        except BlockingIOError:
            return True
        except DISCONNECT_ERRORS:
            pass
        return False

    def write(self, data: bytes) -> bool:
        """Send in order as much as the socket takes; return False if the client is gone or leaves too much unread."""
        if self.greeting:
            self.backlog += self.greeting.pop(0)
        self.backlog += data
        try:
            del self.backlog[: self.socket.send(self.backlog)]
        except BlockingIOError:
            return len(self.backlog) <= MAX_BACKLOG_BYTES
        except DISCONNECT_ERRORS:
            return False
        return True


class TcpPort:
    """A listening TCP socket, as ArduPilot's simulator has on port 5760; every client gets everything.

    Args:
        greeting: text for each client, whose parts go before its first, second, ... packet.
    """

    def __init__(self, address: tuple[str, int], greeting: Greeting = ()) -> None:
        self._greeting = greeting
        self._listener = socket.create_server(address, backlog=MAX_CLIENTS)
        self._listener.setblocking(False)
        self._clients: list[_TcpClient] = []

    @property
    def url(self) -> str:
        """The URL with the port number that is really used."""
        host, port = self._listener.getsockname()
        return f"tcpin://{host}:{port}"

    def sockets(self) -> tuple[socket.socket, ...]:
        """Return the sockets to wait for."""
        return self._listener, *(client.socket for client in self._clients)

    def read(self) -> list[bytes]:
        """Accept new clients, then return every whole frame that has come."""
        with suppress(BlockingIOError):
            while True:
                self._accept()
        frames = []
        for client in self._clients.copy():
            is_connected = client.read()
            frames += split_frames(client.received)
            if not is_connected:
                self._drop(client)
        return frames

    def _accept(self) -> None:
        connection, _ = self._listener.accept()
        if len(self._clients) >= MAX_CLIENTS:
            connection.close()
            return
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._clients.append(_TcpClient(connection, list(self._greeting)))

    def write(self, data: bytes) -> None:
        """Send to every client."""
        for client in self._clients.copy():
            if not client.write(data):
                self._drop(client)

    def _drop(self, client: _TcpClient) -> None:
        client.socket.close()
        self._clients.remove(client)

    def close(self) -> None:
        """Close the clients and the listening socket."""
        for client in self._clients.copy():
            self._drop(client)
        self._listener.close()


class Ports:
    """Several ports as one: every datagram is sent at all of them."""

    def __init__(self, ports: list[Port]) -> None:
        self._ports = ports

    @property
    def url(self) -> str:
        """URLs of the ports, separated by commas."""
        return ",".join(port.url for port in self._ports)

    def sockets(self) -> tuple[socket.socket, ...]:
        """Return the sockets to wait for."""
        return tuple(sock for port in self._ports for sock in port.sockets())

    def read(self) -> list[bytes]:
        """Return everything that has come, at any port."""
        return [data for port in self._ports for data in port.read()]

    def write(self, data: bytes) -> None:
        """Send one datagram at every port."""
        for port in self._ports:
            port.write(data)

    def close(self) -> None:
        """Close every port."""
        for port in self._ports:
            port.close()


def split_frames(stream: bytearray) -> list[bytes]:
    """Take the whole MAVLink frames off a stream's front; bytes before a start mark are skipped."""
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


def open_port(url: str, greeting: Greeting = ()) -> Port:
    """Open a port from its URL, or several from URLs separated by commas; a TCP port greets each client.

    Raises:
        ConnectionSpecError: not a URL of a kind that the simulator has, or it cannot be opened.
    """
    urls = [single_url.strip() for single_url in url.split(",")]
    if len(urls) > 1 and any(single_url.startswith(f"{SCHEME}:") for single_url in urls):
        raise ConnectionSpecError(f"{url}: NatNet is no MAVLink, so it stands alone; give one of them")
    opened: list[Port] = []
    try:
        for single_url in urls:
            opened.append(_open_single(single_url, greeting))
    except ConnectionSpecError:
        Ports(opened).close()
        raise
    return opened[0] if len(opened) == 1 else Ports(opened)


def _open_single(url: str, greeting: Greeting) -> Port:
    kinds: dict[str, Callable[[tuple[str, int]], Port]] = {
        "udpout": lambda address: UdpPort("udpout", address),
        "udpin": lambda address: UdpPort("udpin", address),
        "tcpin": lambda address: TcpPort(address, greeting),
    }
    if url.startswith(f"{SCHEME}:"):
        return _try_open(url, lambda: NatNetPort(url))
    try:
        parts = urlsplit(url)
        host, port = parts.hostname, parts.port
    except ValueError as error:
        raise ConnectionSpecError(f"{url}: {error}; write udpout://127.0.0.1:14540") from error
    if port == 0 and parts.scheme == "udpout":
        raise ConnectionSpecError(f"{url}: port 0 is no address to send to; write udpout://127.0.0.1:14540")
    if parts.scheme not in kinds or host is None or port is None:
        raise ConnectionSpecError(f'"{url}": the simulator speaks {", ".join(kinds)}; write udpout://127.0.0.1:14540')
    address = host, port
    return _try_open(url, lambda: kinds[parts.scheme](address))


def _try_open(url: str, open_it: Callable[[], Port]) -> Port:
    try:
        return open_it()
    except socket.gaierror as error:
        raise ConnectionSpecError(f"{url}: no such host ({error.strerror}); check its name") from error
    except OSError as error:
        raise ConnectionSpecError(
            f"{url}: cannot be opened ({error.strerror or error}); choose another port"
        ) from error
