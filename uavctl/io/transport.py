"""Connections by URL: UDP, TCP, serial."""

from __future__ import annotations

import errno
import os
import select
import socket
import struct
import time
from abc import abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from typing import cast
from urllib.parse import urlsplit

import serial

from uavctl.errors import ConnectionSpecError
from uavctl.io.admission import MAGIC, NOT_LISTED, SILENCE_NS, Address, AdmissionRules, AllowList, RateLimiter
from uavctl.io.base import BACKLOG_READS, MAX_READS, BaseConnection, Connection
from uavctl.mavlink.connection import CONNECTION_SILENT, HUNG_UP

# UDP: an allow-list and budgets come before anything that looks into a datagram.


PEER_SILENCE_NS = SILENCE_NS
SECOND_ADDRESS = "second-address"
LARGEST = 8192  # bytes that are read of a datagram; none of MAVLink is as long
COMMON_BUFFER_BYTES = 2**20  # of the kernel's, for all who are not known yet
PEER_BUFFER_BYTES = 2**22  # for one who is: some seconds of a vehicle's words, small ones too
COMMON_READS = 64  # datagrams of strangers in one call
MAX_PEER_SOCKETS = 8  # senders with a socket of their own
_SO_RCVBUFFORCE, _SO_MEMINFO = 33, 55  # Linux
_MEMINFO = struct.Struct("9I")


class SocketConnection(BaseConnection):
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


class _UdpConnection(SocketConnection):
    """Datagrams within the rules."""

    def __init__(
        self, url: str, family: socket.AddressFamily, address: Address, now: Callable[[], int], rules: AdmissionRules
    ) -> None:
        super().__init__(url, family, socket.SOCK_DGRAM, now)
        self._family = family
        self._allow_list, self._rate_limiter = AllowList(rules.allow), RateLimiter(rules, self.refused)
        self._senders: list[Address] = []
        self._bind_or_connect(address)
        self._socket.setblocking(False)

    @abstractmethod
    def _bind_or_connect(self, address: Address) -> None:
        """Bind or connect."""

    def _read(self) -> bytes | None:
        data, sender = self._socket.recvfrom(LARGEST)
        return self._admit_sender(data, sender)

    def _admit_sender(self, data: bytes, sender: Address) -> bytes | None:
        if not self._allow_list.allows(sender[0]):
            self.refused[NOT_LISTED] += 1
            return None
        if data:
            self._senders.append(sender)
        return data or None

    def _apply_rate_limits(self, arrived: list[tuple[bytes, int]]) -> list[tuple[bytes, int]]:
        """Drop more than the rules allow, the oldest first; `_senders` are those of what is left."""
        taken = self._rate_limiter.admit(self._senders, [data for data, _ in arrived], self._now())
        if all(taken):
            return arrived
        self._senders = [sender for sender, fits in zip(self._senders, taken, strict=True) if fits]
        return [one for one, fits in zip(arrived, taken, strict=True) if fits]

    def count_lost(self) -> int:
        """See `Connection`."""
        return _count_dropped(self._socket)


class UdpInConnection(_UdpConnection):
    """Bound UDP socket. It answers the peer that it was told to, and until then the first one that speaks MAVLink.

    What others send is handed on too: cameras and vehicle may share a port. Only a peer that has fallen silent is
    followed by another one, so that nobody can draw the setpoints to themselves while it speaks.

    Vehicle and cameras get sockets of their own once they are known, on the same port and connected to them: the system
    keeps what they send apart from what others do, and a flood fills only the buffer of the others.
    """

    def _bind_or_connect(self, address: Address) -> None:
        self._peer: Address | None = None
        self._is_peer_confirmed = False
        self._heard_ns = 0
        self._peer_sockets: dict[Address, socket.socket] = {}
        self._trusted_ns: dict[Address, int] = {}
        self._early_datagrams: list[
            tuple[bytes, Address, int]
        ] = []  # read from the common socket when an own one was made
        _set_buffer_size(self._socket, COMMON_BUFFER_BYTES)
        self._attempt(
            self._socket.bind, address, "is another program on this port? end it, or take another port or address"
        )

    def filenos(self) -> tuple[int, ...]:
        """See `Connection`."""
        return (self._socket.fileno(), *(one.fileno() for one in self._peer_sockets.values()))

    def count_lost(self) -> int:
        """See `Connection`."""
        own = None if self._peer is None else self._peer_sockets.get(self._peer)
        return _count_dropped(self._socket if own is None else own)

    def close(self) -> None:
        """See `Connection`."""
        for one in self._peer_sockets.values():
            one.close()
        super().close()

    def receive(self, *, read_all: bool = False) -> list[tuple[bytes, int]]:
        """See `Connection`; more than the rules allow is dropped, the oldest first."""
        self._senders = []
        arrived: list[tuple[bytes, int]] = []
        earlier, self._early_datagrams = self._early_datagrams, []
        for data, sender, at_ns in earlier:
            if self._admit_sender(data, sender) is not None:
                arrived.append((data, at_ns))
        has_own = self._peer in self._peer_sockets
        # Strangers get a handful of looks; whoever shares their socket is found by reading all that it can hold.
        most = BACKLOG_READS if read_all and not has_own else COMMON_READS
        self.has_unread = not self._read_socket(self._socket, most, arrived) and not has_own
        common = len(arrived)
        for sender, own in self._peer_sockets.items():
            emptied = self._read_socket(own, BACKLOG_READS if read_all else MAX_READS, arrived)
            self.has_unread = self.has_unread or (sender == self._peer and not emptied)
        self.has_known_sender = len(arrived) > common or not self._peer_sockets
        arrived = self._apply_rate_limits(arrived)
        for (data, at_ns), sender in zip(arrived, self._senders, strict=True):
            if sender == self._peer and not self._is_peer_confirmed:
                self._heard_ns = at_ns
            silent = at_ns - self._heard_ns > PEER_SILENCE_NS and not self._is_peer_confirmed
            if data[0] in MAGIC and (self._peer is None or silent):
                self._peer, self._heard_ns = sender, at_ns
        return arrived

    def _read_socket(self, one: socket.socket, most: int, arrived: list[tuple[bytes, int]]) -> bool:
        """Read a socket; whether it is empty now."""
        for _ in range(most):
            try:
                data, sender = one.recvfrom(LARGEST)
            except BlockingIOError:
                return True
            except OSError:
                self.receive_errors += 1
                continue
            if self._admit_sender(data, sender) is not None:
                arrived.append((data, self._now()))
        return False

    def select_peer(self, index: int) -> None:
        """See `Connection`; another peer than the one that was told before only when that has fallen silent."""
        sender = self._senders[index]
        now_ns = self._now()
        if self._is_peer_confirmed and sender != self._peer and now_ns - self._heard_ns <= PEER_SILENCE_NS:
            self.refused[SECOND_ADDRESS] += 1
            return
        # Only the vehicle's own words keep its place: noise, forgeries and replays from an address do not.
        self._peer, self._is_peer_confirmed, self._heard_ns = sender, True, now_ns
        self._rate_limiter.set_vehicle(sender, now_ns)
        self._open_socket_for(sender, now_ns)

    def trust_sender(self, index: int) -> None:
        """See `Connection`."""
        sender, now_ns = self._senders[index], self._now()
        self._rate_limiter.trust_sender(sender, now_ns)
        self._open_socket_for(sender, now_ns)

    def _open_socket_for(self, sender: Address, now_ns: int) -> None:
        """Give a sender a socket of its own, if there is room; a sender that has fallen silent makes room."""
        self._trusted_ns[sender] = now_ns
        if sender in self._peer_sockets:
            return
        for one, at_ns in list(self._trusted_ns.items()):
            if now_ns - at_ns > PEER_SILENCE_NS and one != self._peer:
                del self._trusted_ns[one]
                if one in self._peer_sockets:
                    self._peer_sockets.pop(one).close()
        if len(self._peer_sockets) >= MAX_PEER_SOCKETS and sender != self._peer:
            return
        own = _open_peer_socket((self._socket, *self._peer_sockets.values()), self._family, sender)
        if own is None:
            return
        self._peer_sockets[sender] = own
        # What had come before counts before what the new socket gets.
        for _ in range(BACKLOG_READS):
            try:
                self._early_datagrams.append((*self._socket.recvfrom(LARGEST), now_ns))
            except OSError:
                break

    def send(self, data: bytes) -> None:
        """See `Connection`; without a peer there is nobody to send to, which is no error."""
        if self._peer is None:
            return
        try:
            self._socket.sendto(data, self._peer)
        except OSError:
            self.send_errors += 1


class UdpOutConnection(_UdpConnection):
    """Connected UDP socket: the system hands on what its one peer sends."""

    def _bind_or_connect(self, address: Address) -> None:
        self._to = address
        _set_buffer_size(self._socket, PEER_BUFFER_BYTES)
        self._attempt(self._socket.connect, address, "check host, port and network")
        self._rate_limiter.set_vehicle(address, self._now())

    def _read(self) -> bytes | None:
        return self._admit_sender(self._socket.recv(LARGEST), self._to)

    def receive(self, *, read_all: bool = False) -> list[tuple[bytes, int]]:
        """See `Connection`; more than the rules allow is dropped, the oldest first."""
        self._senders = []
        return self._apply_rate_limits(super().receive(read_all=read_all))

    def send(self, data: bytes) -> None:
        """See `Connection`; a peer that is not there yet shows as an error."""
        try:
            self._socket.send(data)
        except OSError:
            self.send_errors += 1


def _set_buffer_size(one: socket.socket, size: int) -> None:
    """Ask for a buffer of the system's; it may grant less."""
    with suppress(OSError):
        one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, size)
    with suppress(OSError):  # whoever may, gets all of it
        one.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, size)


def _count_dropped(one: socket.socket) -> int:
    """Datagrams that the system has dropped for want of room; 0 where it does not tell."""
    try:
        told = one.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, _MEMINFO.size)
    except OSError:
        return 0
    return int(_MEMINFO.unpack(told)[-1]) if len(told) == _MEMINFO.size else 0


def _open_peer_socket(
    bound: Sequence[socket.socket], family: socket.AddressFamily, sender: Address
) -> socket.socket | None:
    """Another socket on the port of those that are bound, which gets what one sender sends; None if none can be had."""
    if not hasattr(socket, "SO_REUSEPORT"):
        return None
    own = socket.socket(family, socket.SOCK_DGRAM)
    try:
        _share_port((*bound, own), shared=True)
        _set_buffer_size(own, PEER_BUFFER_BYTES)
        own.bind(bound[0].getsockname())
        own.connect(sender)
        own.setblocking(False)
    except OSError:
        own.close()
        return None
    finally:
        _share_port(bound, shared=False)  # only for the moment: another program must not get hold of the port
    _share_port((own,), shared=False)
    return own


def _share_port(sockets: Iterable[socket.socket], *, shared: bool) -> None:
    for one in sockets:
        one.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, int(shared))


# Streams of bytes: TCP and serial ports.


CONNECT_TIMEOUT_S = 5.0
RETRY_NS = 1_000_000_000  # from the end of a connection, or of an attempt, to the next attempt
CHUNK_BYTES = 4096
MAX_CHUNKS = 4  # of one call, so that a flood cannot hold the loop; what waits is read in the next one
BACKLOG_CHUNKS = 128  # of a call that is to read everything; the other side waits, and loses nothing
PORT_BYTES = 4095  # capacity of a Linux port's buffer; a serial line does not wait
_DROP_UNSENT = struct.pack("ii", 1, 0)  # of SO_LINGER: closed at once, by a reset
_PENDING_LIMIT = 4096  # bytes that wait for a stream that does not drain


class _SendBuffer:
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


class TcpConnection(SocketConnection):
    """TCP client; a peer that has hung up or fallen silent is called again each second, and nobody waits for it."""

    max_reads = MAX_CHUNKS
    backlog_reads = BACKLOG_CHUNKS

    def __init__(self, url: str, family: socket.AddressFamily, address: Address, now: Callable[[], int]) -> None:
        super().__init__(url, family, socket.SOCK_STREAM, now)
        self._family, self._address = family, address
        self._pending = _SendBuffer()
        self._is_connected = True
        self._attempt_ns = 0  # when the last attempt began, or the connection ended
        self._heard_ns: int | None = None  # when something came last, or the connection was made again
        self._socket.settimeout(CONNECT_TIMEOUT_S)
        self._attempt(self._socket.connect, address, "is the vehicle or simulator running and listening there?")
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket.setblocking(False)

    def filenos(self) -> tuple[int, ...]:
        """See `Connection`; none while there is no connection, which would count as something to read."""
        return (self._socket.fileno(),) if self._is_connected else ()

    def _read(self) -> bytes | None:
        if not self._is_connected:
            self._connect()
        try:
            data = self._socket.recv(CHUNK_BYTES)
        except BlockingIOError:
            # A network that went and came back may have forgotten the connection, and neither end is told.
            if self._heard_ns is not None and self._now() - self._heard_ns > PEER_SILENCE_NS:
                self._disconnect(CONNECTION_SILENT)
            raise
        except OSError:
            self._disconnect(HUNG_UP)
            raise
        if not data:
            self._disconnect(HUNG_UP)
            return None
        self._heard_ns = self._now()
        return data

    def _disconnect(self, why: str) -> None:
        with suppress(OSError):  # what still waits in the system for a peer that does not answer is old by then
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _DROP_UNSENT)
        self._socket.close()
        self._is_connected, self._attempt_ns = False, self._now()
        self._pending = _SendBuffer()  # a frame of which the peer has had the beginning
        self.refused[why] += 1

    def _connect(self) -> None:
        """Begin an attempt to connect, or go on with it; BlockingIOError while there is no connection."""
        late = self._now() - self._attempt_ns >= RETRY_NS
        if self._socket.fileno() < 0:
            if not late:
                raise BlockingIOError
            self._attempt_ns, late = self._now(), False
            self._socket = socket.socket(self._family, socket.SOCK_STREAM)
            self._socket.setblocking(False)
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        state = self._socket.connect_ex(self._address)
        self._is_connected = state in (0, errno.EISCONN)
        if self._is_connected:
            self._heard_ns = self._now()
        else:
            if late or state not in (errno.EINPROGRESS, errno.EALREADY):
                self._socket.close()
            raise BlockingIOError

    def send(self, data: bytes) -> None:
        """See `Connection`."""
        try:
            self.send_errors += not self._pending.push(data, self._socket.send)
        except OSError:
            self.send_errors += 1


class SerialConnection(BaseConnection):
    """Serial port, 8N1, without flow control."""

    ends_on_error = True
    max_reads = MAX_CHUNKS
    backlog_reads = BACKLOG_CHUNKS

    def __init__(self, url: str, device: str, baud: int, now: Callable[[], int]) -> None:
        super().__init__(url, now)
        self._pending = _SendBuffer()
        self._full_reads = 0  # times that it was found full
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
        data = self._port.read(CHUNK_BYTES)
        if not data:
            raise BlockingIOError
        self._full_reads += len(data) >= PORT_BYTES
        return data

    def count_lost(self) -> int:
        """See `Connection`."""
        return self._full_reads

    def send(self, data: bytes) -> None:
        """See `Connection`."""
        try:
            self.send_errors += not self._pending.push(data, self._write)
        except OSError:
            self.send_errors += 1

    def _write(self, data: bytes) -> int:
        return os.write(self._port.fileno(), data)  # Serial.write spins while the port is full


# Connections by URL: the only sockets and serial ports.
#
#     udpin://HOST:PORT         bind; send to the peer that is heard
#     udpout://HOST:PORT        send to HOST:PORT, hear its answers
#     tcp://HOST:PORT           connect
#     serial:///dev/NAME:BAUD   open a serial port
#
# Nothing here raises once a connection is open: errors are counted, a lost serial port shows as `closed`.


FORMS = "udpin://HOST:PORT, udpout://HOST:PORT, tcp://HOST:PORT or serial:///dev/NAME:BAUD"
DEFAULT_RULES = AdmissionRules()


def open_connection(
    url: str, now: Callable[[], int] = time.monotonic_ns, rules: AdmissionRules = DEFAULT_RULES
) -> Connection:
    """Open a connection.

    Args:
        now: clock for the times of arrival [ns].
        rules: who may speak, and how much (UDP; a stream has one peer, and its flow control).

    Raises:
        ConnectionSpecError: the URL cannot be understood or opened; says what to do.
    """
    scheme, separator, rest = url.partition("://")
    if not separator or scheme not in ("udpin", "udpout", "tcp", "serial"):
        raise ConnectionSpecError(f"connection {url!r} has no known form; write {FORMS}")
    if scheme == "serial":
        return SerialConnection(url, *_device_and_baud(url, rest), now)
    kind = socket.SOCK_STREAM if scheme == "tcp" else socket.SOCK_DGRAM
    family, address = _resolve(url, kind)
    if scheme == "udpin":
        return UdpInConnection(url, family, address, now, rules)
    if scheme == "udpout":
        return UdpOutConnection(url, family, address, now, rules)
    return TcpConnection(url, family, address, now)


def wait(
    connections: Mapping[str, Connection], deadline_ns: int, now: Callable[[], int] = time.monotonic_ns
) -> list[str]:
    """Sleep until something can be read or the deadline has come.

    Args:
        connections: open connections by name; closed ones are passed over.
        now: the clock [ns].

    Returns:
        Names of the connections to read, none if the deadline came first.
    """
    names: dict[int, str] = {}
    for name, connection in connections.items():
        if not connection.closed:
            names.update(dict.fromkeys(connection.filenos(), name))
    # select() takes microseconds; epoll would round the deadline up to a millisecond.
    ready, _, _ = select.select(list(names), [], [], max(0.0, (deadline_ns - now()) * 1e-9))
    return list(dict.fromkeys(names[one] for one in ready))


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
