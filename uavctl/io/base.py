"""Interface of a connection for the daemon, and the common part of all connections."""

from __future__ import annotations

import socket
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable
from typing import Protocol

from uavctl.errors import ConnectionSpecError
from uavctl.io.admission import Address

MAX_READS = 256  # datagrams of one call, so that a flood cannot hold the loop
BACKLOG_READS = 16_384  # of a call that is to read everything: more than any buffer of the system's holds


class Connection(Protocol):
    """Connection as the daemon needs it."""

    @property
    def url(self) -> str:
        """URL of the connection."""
        ...

    @property
    def closed(self) -> bool:
        """Whether nothing will come any more."""
        ...

    @property
    def send_errors(self) -> int:
        """Sends that failed."""
        ...

    @property
    def receive_errors(self) -> int:
        """Reads that failed."""
        ...

    @property
    def refused(self) -> Counter[str]:
        """Counts of what came and was not handed on, by reason."""
        ...

    @property
    def has_unread(self) -> bool:
        """Whether the last `receive` has left something of the vehicle's behind that had come before it."""
        ...

    @property
    def has_known_sender(self) -> bool:
        """Whether the last `receive` had something of a sender that the flight needs; True while none is known."""
        ...

    def fileno(self) -> int:
        """File descriptor of the socket or port."""
        ...

    def filenos(self) -> tuple[int, ...]:
        """File descriptors to wait for."""
        ...

    def count_lost(self) -> int:
        """Return how much of the vehicle's data the system dropped, for want of room, before it could be read."""
        ...

    def receive(self, *, read_all: bool = False) -> list[tuple[bytes, int]]:
        """Return what has arrived: (data, monotonic time of reading [ns]); empty if nothing has.

        Args:
            read_all: also a long backlog of the vehicle's.
        """
        ...

    def select_peer(self, index: int) -> None:
        """Send to the sender of the `index`-th datagram of the last `receive`, where a connection has several peers."""
        ...

    def trust_sender(self, index: int) -> None:
        """Trust the sender of the `index`-th datagram of the last `receive`: the flight needs its data."""
        ...

    def send(self, data: bytes) -> None:
        """Send, or drop and count; never blocks, never raises."""
        ...

    def close(self) -> None:
        """Release the socket or port."""
        ...


class BaseConnection(ABC):
    """Counters and clock of every connection."""

    max_reads = MAX_READS
    backlog_reads = BACKLOG_READS
    ends_on_error = False

    def __init__(self, url: str, now: Callable[[], int]) -> None:
        self.url = url
        self.closed = False
        self.has_unread = False
        self.has_known_sender = True
        self.send_errors = 0
        self.receive_errors = 0
        self.refused: Counter[str] = Counter()
        self._now = now

    def receive(self, *, read_all: bool = False) -> list[tuple[bytes, int]]:
        """See `Connection`."""
        arrived: list[tuple[bytes, int]] = []
        self.has_unread = False
        for _ in range(self.backlog_reads if read_all else self.max_reads):
            if self.closed:
                return arrived
            try:
                data = self._read()
            except BlockingIOError:
                return arrived
            except OSError:
                self.receive_errors += 1
                if self.ends_on_error:
                    self.closed = True
                continue
            if data is not None:
                arrived.append((data, self._now()))
        self.has_unread = True
        return arrived

    @abstractmethod
    def fileno(self) -> int:
        """See `Connection`."""

    def filenos(self) -> tuple[int, ...]:
        """See `Connection`."""
        return (self.fileno(),)

    def count_lost(self) -> int:
        """See `Connection`."""
        return 0

    def select_peer(self, index: int) -> None:
        """See `Connection`."""
        del index  # there is only one peer

    def trust_sender(self, index: int) -> None:
        """See `Connection`."""
        del index

    @abstractmethod
    def _read(self) -> bytes | None:
        """Read once; None if what came is not to be handed on. BlockingIOError if nothing is there."""


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
