"""Connections by URL: the only sockets and serial ports.

    udpin://HOST:PORT         bind; send to the peer that is heard
    udpout://HOST:PORT        send to HOST:PORT, hear its answers
    tcp://HOST:PORT           connect
    serial:///dev/NAME:BAUD   open a serial port

Nothing here raises once a connection is open: errors are counted, a lost connection shows as `closed`.
"""

from __future__ import annotations

import os
import selectors
import socket
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Protocol, cast
from urllib.parse import urlsplit

import serial

from uavctl.errors import ConnectionSpecError

FORMS = "udpin://HOST:PORT, udpout://HOST:PORT, tcp://HOST:PORT or serial:///dev/NAME:BAUD"
PEER_SILENCE_NS = 5_000_000_000
MAX_READS = 256  # datagrams or chunks of one call, so that a flood cannot hold the loop
CONNECT_TIMEOUT_S = 5.0
_LARGEST = 65_536
_PENDING_LIMIT = 4096  # bytes that wait for a stream that does not drain
_MAVLINK = (0xFD, 0xFE)


class Connection(Protocol):
    """What the daemon needs of a connection."""

    url: str
    closed: bool  # nothing will come any more
    send_errors: int
    receive_errors: int

    def fileno(self) -> int:
        """File descriptor to wait for."""
        ...

    def receive(self) -> list[tuple[bytes, int]]:
        """All that has arrived: (data, monotonic time of reading [ns]); empty if nothing has."""
        ...

    def answer(self, index: int) -> None:
        """Send to the sender of the `index`-th datagram of the last `receive`, where a connection has several peers."""
        ...

    def send(self, data: bytes) -> None:
        """Send, or drop and count; never blocks, never raises."""
        ...

    def close(self) -> None:
        """Release the socket or port."""
        ...


def open_connection(url: str, now: Callable[[], int] = time.monotonic_ns) -> Connection:
    """Open a connection.

    Args:
        url: see the module's page.
        now: clock for the times of arrival [ns].

    Raises:
        ConnectionSpecError: the URL cannot be understood or opened; says what to do.
    """
    scheme, separator, rest = url.partition("://")
    if not separator or scheme not in ("udpin", "udpout", "tcp", "serial"):
        raise ConnectionSpecError(f"connection {url!r} has no known form; write {FORMS}")
    if scheme == "serial":
        return _SerialConnection(url, *_device_and_baud(url, rest), now)
    kind = socket.SOCK_STREAM if scheme == "tcp" else socket.SOCK_DGRAM
    family, address = _resolve(url, kind)
    if scheme == "udpin":
        return _UdpIn(url, family, address, now)
    if scheme == "udpout":
        return _UdpOut(url, family, address, now)
    return _Tcp(url, family, address, now)


def wait(
    connections: Mapping[str, Connection], deadline_ns: int, now: Callable[[], int] = time.monotonic_ns
) -> list[str]:
    """Sleep until something can be read or the deadline has come.

    Args:
        connections: open connections by name; closed ones are passed over.
        deadline_ns: absolute monotonic time.
        now: the clock [ns].

    Returns:
        Names of the connections to read, none if the deadline came first.
    """
    # select() takes microseconds; epoll would round the deadline up to a millisecond.
    with selectors.SelectSelector() as selector:
        for name, connection in connections.items():
            if not connection.closed:
                selector.register(connection, selectors.EVENT_READ, name)
        ready = selector.select(max(0.0, (deadline_ns - now()) * 1e-9))
    return [str(key.data) for key, _ in ready]


Address = tuple[str, int] | tuple[str, int, int, int]


def _resolve(url: str, kind: socket.SocketKind) -> tuple[socket.AddressFamily, Address]:
    try:
        parts = urlsplit(url)
        host, port = parts.hostname, parts.port
    except ValueError as error:
        raise ConnectionSpecError(f"connection {url!r}: {error}; write {FORMS}") from error
    if not host or port is None or parts.path or parts.query or parts.fragment:
        raise ConnectionSpecError(f"connection {url!r} needs a host and a port and nothing else; write {FORMS}")
    try:
        family, _, _, _, address = socket.getaddrinfo(host, port, type=kind)[0]
    except OSError as error:
        raise ConnectionSpecError(f"connection {url!r}: host {host!r} is unknown ({error}); check the name") from error
    return family, cast(Address, address)  # (int, bytes) only for families that were not asked for


def _device_and_baud(url: str, rest: str) -> tuple[str, int]:
    device, separator, baud = rest.rpartition(":")
    if not separator or not device.startswith("/") or not baud.isdecimal() or int(baud) == 0:
        raise ConnectionSpecError(
            f"connection {url!r} needs a device and a baud rate; write serial:///dev/ttyUSB0:921600"
        )
    return device, int(baud)


class _Base(ABC):
    """Counters and clock of every connection."""

    def __init__(self, url: str, now: Callable[[], int]) -> None:
        self.url = url
        self.closed = False
        self.send_errors = 0
        self.receive_errors = 0
        self._now = now

    def receive(self) -> list[tuple[bytes, int]]:
        """See `Connection`."""
        arrived: list[tuple[bytes, int]] = []
        for _ in range(MAX_READS):
            if self.closed:
                break
            try:
                data = self._read()
            except BlockingIOError:
                break
            except OSError:
                self.receive_errors += 1
                if self._ends_on_error:
                    self.closed = True
                continue
            if data is not None:
                arrived.append((data, self._now()))
        return arrived

    def answer(self, index: int) -> None:
        """See `Connection`."""
        del index  # there is only one peer

    _ends_on_error = False

    @abstractmethod
    def _read(self) -> bytes | None:
        """Read once; None if what came is not to be handed on. BlockingIOError if nothing is there."""


class _Socket(_Base):
    """A connection on a socket."""

    def __init__(self, url: str, family: socket.AddressFamily, kind: socket.SocketKind, now: Callable[[], int]) -> None:
        super().__init__(url, now)
        self._socket = socket.socket(family, kind)

    def fileno(self) -> int:
        """See `Connection`."""
        return self._socket.fileno()

    def close(self) -> None:
        """See `Connection`."""
        self.closed = True
        self._socket.close()

    def _attempt(self, action: Callable[[Address], None], address: Address, advice: str) -> None:
        try:
            action(address)
        except OSError as error:
            self.close()
            raise ConnectionSpecError(f"connection {self.url!r}: {error.strerror or error}; {advice}") from error


class _UdpIn(_Socket):
    """Bound UDP socket. It answers the peer that it was told to, and until then the first one that speaks MAVLink.

    What others send is handed on too: cameras and vehicle may share a port. A first speaker that falls silent is
    followed by another one; who was chosen by `answer` stays until another one is.
    """

    def __init__(self, url: str, family: socket.AddressFamily, address: Address, now: Callable[[], int]) -> None:
        super().__init__(url, family, socket.SOCK_DGRAM, now)
        self._peer: Address | None = None
        self._chosen = False
        self._senders: list[Address] = []
        self._heard_ns = 0
        self._attempt(
            self._socket.bind, address, "is another program on this port? end it, or take another port or address"
        )
        self._socket.setblocking(False)

    def _read(self) -> bytes | None:
        data, peer = self._socket.recvfrom(_LARGEST)
        now_ns = self._now()
        if data[:1] and data[0] in _MAVLINK:
            silent = now_ns - self._heard_ns > PEER_SILENCE_NS
            if self._peer is None or (silent and not self._chosen):
                self._peer = peer
            if peer == self._peer:
                self._heard_ns = now_ns
        if not data:
            return None
        self._senders.append(peer)
        return data

    def receive(self) -> list[tuple[bytes, int]]:
        """See `Connection`."""
        self._senders.clear()
        return super().receive()

    def answer(self, index: int) -> None:
        """See `Connection`."""
        self._peer, self._chosen = self._senders[index], True

    def send(self, data: bytes) -> None:
        """See `Connection`; without a peer there is nobody to send to, which is no error."""
        if self._peer is None:
            return
        try:
            self._socket.sendto(data, self._peer)
        except OSError:
            self.send_errors += 1


class _UdpOut(_Socket):
    """Connected UDP socket."""

    def __init__(self, url: str, family: socket.AddressFamily, address: Address, now: Callable[[], int]) -> None:
        super().__init__(url, family, socket.SOCK_DGRAM, now)
        self._attempt(self._socket.connect, address, "check host, port and network")
        self._socket.setblocking(False)

    def _read(self) -> bytes | None:
        return self._socket.recv(_LARGEST) or None

    def send(self, data: bytes) -> None:
        """See `Connection`; a peer that is not there yet shows as an error."""
        try:
            self._socket.send(data)
        except OSError:
            self.send_errors += 1


class _Pending:
    """Bytes of whole frames that a stream has not taken yet; a frame is never cut by dropping."""

    def __init__(self) -> None:
        self._rest = b""

    def push(self, data: bytes, write: Callable[[bytes], int]) -> bool:
        """Write what waits, then the data; False if the data had to be dropped whole."""
        dropped = len(self._rest) + len(data) > _PENDING_LIMIT
        self._rest += b"" if dropped else data
        with suppress(BlockingIOError):  # full: what waits is written with the next frame
            self._rest = self._rest[write(self._rest) :]
        return not dropped


class _Tcp(_Socket):
    """TCP client; not connected again once the peer has gone."""

    _ends_on_error = True

    def __init__(self, url: str, family: socket.AddressFamily, address: Address, now: Callable[[], int]) -> None:
        super().__init__(url, family, socket.SOCK_STREAM, now)
        self._pending = _Pending()
        self._socket.settimeout(CONNECT_TIMEOUT_S)
        self._attempt(self._socket.connect, address, "is the vehicle or simulator running and listening there?")
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket.setblocking(False)

    def _read(self) -> bytes | None:
        data = self._socket.recv(_LARGEST)
        self.closed = not data
        return data or None

    def send(self, data: bytes) -> None:
        """See `Connection`."""
        try:
            self.send_errors += not self._pending.push(data, self._socket.send)
        except OSError:
            self.send_errors += 1


class _SerialConnection(_Base):
    """Serial port, 8N1, without flow control."""

    _ends_on_error = True

    def __init__(self, url: str, device: str, baud: int, now: Callable[[], int]) -> None:
        super().__init__(url, now)
        self._pending = _Pending()
        try:
            self._port = serial.Serial(device, baud, timeout=0, write_timeout=0, exclusive=True)
        except (OSError, ValueError) as error:  # SerialException is an OSError
            raise ConnectionSpecError(
                f"connection {url!r}: {error}; check the device, its permissions (group dialout) and the rate"
            ) from error

    def fileno(self) -> int:
        """See `Connection`."""
        return self._port.fileno()

    def close(self) -> None:
        """See `Connection`."""
        self.closed = True
        self._port.close()

    def _read(self) -> bytes | None:
        data = self._port.read(_LARGEST)
        if not data:
            raise BlockingIOError
        return data

    def send(self, data: bytes) -> None:
        """See `Connection`."""
        try:
            self.send_errors += not self._pending.push(data, self._write)
        except OSError:
            self.send_errors += 1

    def _write(self, data: bytes) -> int:
        return os.write(self._port.fileno(), data)  # Serial.write spins while the port is full
