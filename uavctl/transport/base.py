"""What the daemon needs of a connection, and what all connections share."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable
from typing import Protocol

MAX_READS = 256  # datagrams of one call, so that a flood cannot hold the loop


class Connection(Protocol):
    """What the daemon needs of a connection."""

    @property
    def url(self) -> str:
        """Where it goes."""
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
        """What came and was not handed on, by reason."""
        ...

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


class Base(ABC):
    """Counters and clock of every connection."""

    max_reads = MAX_READS
    ends_on_error = False

    def __init__(self, url: str, now: Callable[[], int]) -> None:
        self.url = url
        self.closed = False
        self.send_errors = 0
        self.receive_errors = 0
        self.refused: Counter[str] = Counter()
        self._now = now

    def receive(self) -> list[tuple[bytes, int]]:
        """See `Connection`."""
        arrived: list[tuple[bytes, int]] = []
        for _ in range(self.max_reads):
            if self.closed:
                break
            try:
                data = self._read()
            except BlockingIOError:
                break
            except OSError:
                self.receive_errors += 1
                if self.ends_on_error:
                    self.closed = True
                continue
            if data is not None:
                arrived.append((data, self._now()))
        return arrived

    def answer(self, index: int) -> None:
        """See `Connection`."""
        del index  # there is only one peer

    @abstractmethod
    def _read(self) -> bytes | None:
        """Read once; None if what came is not to be handed on. BlockingIOError if nothing is there."""
