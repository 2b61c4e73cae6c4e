"""UDP connections. The allow-list and the rate limits come before anything decodes a datagram."""

from __future__ import annotations

import socket
import struct
from abc import abstractmethod
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress

from uavctl.io.admission import MAGIC, NOT_LISTED, SILENCE_NS, Address, AdmissionRules, AllowList, RateLimiter
from uavctl.io.base import BACKLOG_READS, MAX_READS, SocketConnection

PEER_SILENCE_NS = SILENCE_NS
SECOND_ADDRESS = "second-address"
LARGEST = 8192  # bytes read of a datagram; MAVLink needs fewer
COMMON_BUFFER_BYTES = 2**20  # kernel buffer for all unknown senders
PEER_BUFFER_BYTES = 2**22  # for a known one: some seconds of a vehicle's messages
COMMON_READS = 64  # datagrams of strangers in one call
MAX_PEER_SOCKETS = 8  # senders with a socket of their own
_SO_RCVBUFFORCE, _SO_MEMINFO = 33, 55  # Linux
_MEMINFO = struct.Struct("9I")


class _UdpConnection(SocketConnection):
    """UDP connection with admission rules."""

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
        """Drop datagrams beyond the limits, the oldest first, with their entries in `_senders`."""
        admitted = self._rate_limiter.admit(self._senders, [data for data, _ in arrived], self._now())
        if all(admitted):
            return arrived
        self._senders = [sender for sender, fits in zip(self._senders, admitted, strict=True) if fits]
        return [sock for sock, fits in zip(arrived, admitted, strict=True) if fits]

    def count_lost(self) -> int:
        """See `Connection`."""
        return _count_dropped(self._socket)


class UdpInConnection(_UdpConnection):
    """Bound UDP socket. It sends to the selected peer; before that, to the first sender of MAVLink.

    Data of other senders is passed on too: cameras and vehicle may share a port. Another peer replaces only one
    that is silent or has closed its port, so nobody can take the setpoints of an active peer.

    Once known, vehicle and cameras get connected sockets of their own on the same port. The system separates their data
    from others, so a flood fills only the buffer of the common socket.
    """

    def _bind_or_connect(self, address: Address) -> None:
        self._peer: Address | None = None
        self._is_peer_confirmed = False
        self._has_peer_left = False  # its computer has answered since that nobody listens there
        self._heard_ns = 0
        self._peer_sockets: dict[Address, socket.socket] = {}
        self._trusted_ns: dict[Address, int] = {}
        self._early_datagrams: list[
            tuple[bytes, Address, int]
        ] = []  # read from the common socket when an own one was made
        _set_buffer_size(self._socket, COMMON_BUFFER_BYTES)
        self._attempt(
            self._socket.bind, address, "if another program uses this port, end it; else choose another port or address"
        )

    @property
    def _peer_socket(self) -> socket.socket | None:
        """The peer's own socket, if there is one."""
        return None if self._peer is None else self._peer_sockets.get(self._peer)

    def filenos(self) -> tuple[int, ...]:
        """See `Connection`."""
        return (self._socket.fileno(), *(sock.fileno() for sock in self._peer_sockets.values()))

    def count_lost(self) -> int:
        """See `Connection`."""
        return _count_dropped(self._peer_socket or self._socket)

    def close(self) -> None:
        """See `Connection`."""
        for sock in self._peer_sockets.values():
            sock.close()
        super().close()

    def receive(self, *, read_all: bool = False) -> list[tuple[bytes, int]]:
        """See `Connection`; more than the rules allow is dropped, the oldest first."""
        self._senders = []
        arrived: list[tuple[bytes, int]] = []
        early, self._early_datagrams = self._early_datagrams, []
        for data, sender, at_ns in early:
            if self._admit_sender(data, sender) is not None:
                arrived.append((data, at_ns))
        has_peer_socket = self._peer in self._peer_sockets
        # Few datagrams of strangers are read. A vehicle on the common socket is found by reading its whole backlog.
        max_reads = BACKLOG_READS if read_all and not has_peer_socket else COMMON_READS
        self.has_unread = not self._read_socket(self._socket, max_reads, arrived) and not has_peer_socket
        common_count = len(arrived)
        for sender, peer_socket in self._peer_sockets.items():
            is_empty = self._read_socket(peer_socket, BACKLOG_READS if read_all else MAX_READS, arrived)
            self.has_unread = self.has_unread or (sender == self._peer and not is_empty)
        self.has_known_sender = len(arrived) > common_count or not self._peer_sockets
        arrived = self._apply_rate_limits(arrived)
        for (data, at_ns), sender in zip(arrived, self._senders, strict=True):
            if sender == self._peer and not self._is_peer_confirmed:
                self._heard_ns = at_ns
            is_silent = at_ns - self._heard_ns > PEER_SILENCE_NS and not self._is_peer_confirmed
            if data[0] in MAGIC and (self._peer is None or is_silent):
                self._peer, self._heard_ns = sender, at_ns
        return arrived

    def _read_socket(self, sock: socket.socket, max_reads: int, arrived: list[tuple[bytes, int]]) -> bool:
        """Read a socket; return whether it is empty now."""
        for _ in range(max_reads):
            try:
                data, sender = sock.recvfrom(LARGEST)
            except BlockingIOError:
                return True
            except OSError as error:
                self.receive_errors += 1
                if isinstance(error, ConnectionRefusedError) and sock is self._peer_socket:
                    self._has_peer_left = True
                continue
            if self._admit_sender(data, sender) is not None:
                arrived.append((data, self._now()))
        return False

    def select_peer(self, index: int) -> None:
        """See `Connection`; another peer replaces the present one only after its silence, or if its port is closed."""
        sender = self._senders[index]
        now_ns = self._now()
        is_peer_active = now_ns - self._heard_ns <= PEER_SILENCE_NS and not self._has_peer_left
        if self._is_peer_confirmed and sender != self._peer and is_peer_active:
            self.refused[SECOND_ADDRESS] += 1
            return
        # Only messages of the vehicle itself keep its place; noise, forgeries and replays do not.
        self._peer, self._is_peer_confirmed, self._heard_ns, self._has_peer_left = sender, True, now_ns, False
        self._rate_limiter.set_vehicle(sender, now_ns)
        self._open_socket_for(sender, now_ns)

    def trust_sender(self, index: int) -> None:
        """See `Connection`."""
        sender, now_ns = self._senders[index], self._now()
        self._rate_limiter.trust_sender(sender, now_ns)
        self._open_socket_for(sender, now_ns)

    def _open_socket_for(self, sender: Address, now_ns: int) -> None:
        """Open a socket for a sender, if there is room; close those of silent senders."""
        self._trusted_ns[sender] = now_ns
        if sender in self._peer_sockets:
            return
        for sock, at_ns in list(self._trusted_ns.items()):
            if now_ns - at_ns > PEER_SILENCE_NS and sock != self._peer:
                del self._trusted_ns[sock]
                if sock in self._peer_sockets:
                    self._peer_sockets.pop(sock).close()
        if len(self._peer_sockets) >= MAX_PEER_SOCKETS and sender != self._peer:
            return
        peer_socket = _open_peer_socket((self._socket, *self._peer_sockets.values()), self._family, sender)
        if peer_socket is None:
            return
        self._peer_sockets[sender] = peer_socket
        # Earlier data come before those of the new socket.
        for _ in range(BACKLOG_READS):
            try:
                self._early_datagrams.append((*self._socket.recvfrom(LARGEST), now_ns))
            except OSError:
                break

    def find_sender(self) -> tuple[int, Address | None]:
        """See `Connection`; the vehicle's own socket, which also receives its data, if there is one."""
        if self._peer is None:
            return -1, None
        peer_socket = self._peer_socket
        return (self._socket.fileno(), self._peer) if peer_socket is None else (peer_socket.fileno(), None)

    def send(self, data: bytes) -> None:
        """See `Connection`; without a peer nothing is sent, which is no error."""
        if self._peer is None:
            return
        try:
            self._socket.sendto(data, self._peer)
        except OSError:
            self.send_errors += 1


class UdpOutConnection(_UdpConnection):
    """Connected UDP socket: the system passes on only the data of its peer."""

    def _bind_or_connect(self, address: Address) -> None:
        self._peer_address = address
        _set_buffer_size(self._socket, PEER_BUFFER_BYTES)
        self._attempt(self._socket.connect, address, "check host, port and network")
        self._rate_limiter.set_vehicle(address, self._now())

    def _read(self) -> bytes | None:
        return self._admit_sender(self._socket.recv(LARGEST), self._peer_address)

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


def _set_buffer_size(sock: socket.socket, size: int) -> None:
    """Request a system buffer; the system may grant less."""
    with suppress(OSError):
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, size)
    with suppress(OSError):  # with permission, the whole size
        sock.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, size)


def _count_dropped(sock: socket.socket) -> int:
    """Return the number of datagrams that the system has dropped; 0 if unknown."""
    try:
        raw = sock.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, _MEMINFO.size)
    except OSError:
        return 0
    return int(_MEMINFO.unpack(raw)[-1]) if len(raw) == _MEMINFO.size else 0


def _open_peer_socket(
    bound: Sequence[socket.socket], family: socket.AddressFamily, sender: Address
) -> socket.socket | None:
    """Open another socket on the same port, connected to one sender; None if that is not possible."""
    if not hasattr(socket, "SO_REUSEPORT"):
        return None
    peer_socket = None
    try:
        peer_socket = socket.socket(family, socket.SOCK_DGRAM)  # fails where no descriptor is left
        _share_port((*bound, peer_socket), is_shared=True)
        _set_buffer_size(peer_socket, PEER_BUFFER_BYTES)
        peer_socket.bind(bound[0].getsockname())
        peer_socket.connect(sender)
        peer_socket.setblocking(False)
        _share_port((peer_socket,), is_shared=False)
    except OSError:
        if peer_socket is not None:
            peer_socket.close()
        return None
    finally:
        with suppress(OSError):
            _share_port(bound, is_shared=False)  # only briefly: no other program may use the port
    return peer_socket


def _share_port(sockets: Iterable[socket.socket], *, is_shared: bool) -> None:
    for sock in sockets:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, int(is_shared))
