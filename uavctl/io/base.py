"""Interface of a connection for the daemon, and the common part of all connections."""

from __future__ import annotations

import errno
import socket
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable
from typing import Protocol

from uavctl.errors import ConnectionSpecError
from uavctl.io.admission import Address

MAX_READS = 256  # datagrams of one call, so that a flood cannot hold the loop
BACKLOG_READS = 16_384  # of a call with `read_all`: more than any system buffer holds


class Connection(Protocol):
    """Interface of a connection for the daemon."""

    @property
    def url(self) -> str:
        """URL of the connection."""
        ...

    @property
    def closed(self) -> bool:
        """Whether the connection has ended."""
        ...

    @property
    def send_errors(self) -> int:
        """Number of failed sends."""
        ...

    @property
    def receive_errors(self) -> int:
        """Number of failed reads."""
        ...

    @property
    def refused(self) -> Counter[str]:
        """Counts of data that were not passed on, by reason."""
        ...

    @property
    def has_unread(self) -> bool:
        """Whether the last `receive` has left older data of the vehicle unread."""
        ...

    @property
    def has_known_sender(self) -> bool:
        """Whether the last `receive` had data of a trusted sender; True while none is known."""
        ...

    def fileno(self) -> int:
        """File descriptor of the socket or port."""
        ...

    def filenos(self) -> tuple[int, ...]:
        """File descriptors to wait for."""
        ...

    def count_lost(self) -> int:
        """Return the count of the vehicle's data that the system dropped, because its buffer was full."""
        ...

    def receive(self, *, read_all: bool = False) -> list[tuple[bytes, int]]:
        """Return the arrivals: (data, monotonic time of reading [ns]).

        Args:
            read_all: also read a long backlog of the vehicle.
        """
        ...

    def select_peer(self, index: int) -> None:
        """Send to the sender of the `index`-th datagram of the last `receive` from now on, if there are several."""
        ...

    def trust_sender(self, index: int) -> None:
        """Trust the sender of the `index`-th datagram of the last `receive`: the flight needs its data."""
        ...

    def send(self, data: bytes) -> None:
        """Send, or drop and count; never blocks, never raises."""
        ...

    def find_sender(self) -> tuple[int, Address | None]:
        """File descriptor by which `send` sends, and the address if it is not connected; -1 if there is none."""
        ...

    def encode_ahead(self, frame: bytes, ahead_ns: int) -> bytes:
        """Return the bytes that another process may send for a frame, at least so much later."""
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

    def find_sender(self) -> tuple[int, Address | None]:
        """See `Connection`."""
        return self.fileno(), None

    def encode_ahead(self, frame: bytes, ahead_ns: int) -> bytes:
        """See `Connection`."""
        del ahead_ns
        return frame

    def select_peer(self, index: int) -> None:
        """See `Connection`."""
        del index  # there is only one peer

    def trust_sender(self, index: int) -> None:
        """See `Connection`."""
        del index

    @abstractmethod
    def _read(self) -> bytes | None:
        """Read once; None if the data are not passed on. BlockingIOError without data."""


class SocketConnection(BaseConnection):
    """Connection on a socket."""

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
            if error.errno == errno.EADDRNOTAVAIL:
                advice = "it is no address of this computer; 0.0.0.0 stands for all that it has"
            raise ConnectionSpecError(f"connection {self.url!r}: {error.strerror or error}; {advice}") from error
