"""UDP: an allow-list and a rate cap come before anything that looks into a datagram."""

from __future__ import annotations

import socket
from abc import abstractmethod
from collections.abc import Callable
from contextlib import suppress

from uavctl.errors import ConnectionSpecError
from uavctl.transport.base import Base
from uavctl.transport.rules import NOT_LISTED, SILENCE_NS, TOO_MANY, Address, AllowList, RateCap, Rules

PEER_SILENCE_NS = SILENCE_NS
SECOND_ADDRESS = "second-address"
LARGEST = 8192  # bytes that are read of a datagram; none of MAVLink is as long
BUFFER_BYTES = 2**20  # of the kernel; what floods must not push out what counts while the loop decides
_MAVLINK = (0xFD, 0xFE)


class Socket(Base):
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


class _Udp(Socket):
    """Datagrams within the rules."""

    def __init__(
        self, url: str, family: socket.AddressFamily, address: Address, now: Callable[[], int], rules: Rules
    ) -> None:
        super().__init__(url, family, socket.SOCK_DGRAM, now)
        self._allow, self._cap = AllowList(rules.allow), RateCap(rules.max_per_s)
        self._senders: list[Address] = []
        with suppress(OSError):  # the system may grant less
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER_BYTES)
        self._join(address)
        self._socket.setblocking(False)

    @abstractmethod
    def _join(self, address: Address) -> None:
        """Bind or connect."""

    @abstractmethod
    def _read_from(self) -> tuple[bytes, Address]:
        """Read once."""

    def _read(self) -> bytes | None:
        data, sender = self._read_from()
        if not self._allow.lets_in(sender[0]):
            self.refused[NOT_LISTED] += 1
            return None
        if not data:
            return None
        self._senders.append(sender)
        return data

    def receive(self) -> list[tuple[bytes, int]]:
        """See `Connection`; more than the cap allows is dropped, the oldest first."""
        self._senders.clear()
        arrived = super().receive()
        taken = self._cap.take(self._senders, self._now())
        if all(taken):
            return arrived
        self.refused[TOO_MANY] += taken.count(False)
        self._senders = [sender for sender, fits in zip(self._senders, taken, strict=True) if fits]
        return [one for one, fits in zip(arrived, taken, strict=True) if fits]


class UdpIn(_Udp):
    """Bound UDP socket. It answers the peer that it was told to, and until then the first one that speaks MAVLink.

    What others send is handed on too: cameras and vehicle may share a port. Only a peer that has fallen silent is
    followed by another one, so that nobody draws the setpoints to himself while it speaks.
    """

    def _join(self, address: Address) -> None:
        self._peer: Address | None = None
        self._chosen = False
        self._heard_ns = 0
        self._attempt(
            self._socket.bind, address, "is another program on this port? end it, or take another port or address"
        )

    def _read_from(self) -> tuple[bytes, Address]:
        data, sender = self._socket.recvfrom(LARGEST)
        if self._peer == sender and not self._chosen:
            self._heard_ns = self._now()
        return data, sender

    def receive(self) -> list[tuple[bytes, int]]:
        """See `Connection`."""
        arrived = super().receive()
        for (data, at_ns), sender in zip(arrived, self._senders, strict=True):
            silent = at_ns - self._heard_ns > PEER_SILENCE_NS and not self._chosen
            if data[0] in _MAVLINK and (self._peer is None or silent):
                self._peer, self._heard_ns = sender, at_ns
        return arrived

    def answer(self, index: int) -> None:
        """See `Connection`; another peer than the one that was told before only when that has fallen silent."""
        sender = self._senders[index]
        if self._chosen and sender != self._peer and self._now() - self._heard_ns <= PEER_SILENCE_NS:
            self.refused[SECOND_ADDRESS] += 1
            return
        # Only the vehicle's own words keep its place: noise, forgeries and replays from an address do not.
        self._peer, self._chosen, self._heard_ns = sender, True, self._now()

    def send(self, data: bytes) -> None:
        """See `Connection`; without a peer there is nobody to send to, which is no error."""
        if self._peer is None:
            return
        try:
            self._socket.sendto(data, self._peer)
        except OSError:
            self.send_errors += 1


class UdpOut(_Udp):
    """Connected UDP socket: the system hands on what its one peer sends."""

    def _join(self, address: Address) -> None:
        self._to = address
        self._attempt(self._socket.connect, address, "check host, port and network")

    def _read_from(self) -> tuple[bytes, Address]:
        return self._socket.recv(LARGEST), self._to

    def send(self, data: bytes) -> None:
        """See `Connection`; a peer that is not there yet shows as an error."""
        try:
            self._socket.send(data)
        except OSError:
            self.send_errors += 1
