"""A source's end of the pair of sockets to the daemon: the newest messages in order, and counts of losses."""

from __future__ import annotations

import json
import os
import socket
import time
from collections import Counter, deque
from collections.abc import Callable

from uavctl.errors import in_words
from uavctl.io.camera import COUNTS, FAILED, READY, REFUSED, UNREACHABLE, CameraError

MAX_QUEUE = 64  # newest messages that are kept while the daemon does not read
OVERRUN = "source-queue"
_PIPE_BYTES = 8192  # small kernel buffer: newer messages cannot replace those in it
_COUNTS_PERIOD_S = 0.5


class DaemonPipe:
    """Sends messages to the daemon, without waiting.

    Args:
        pipe: our end of the pair of sockets.

    Attributes:
        is_ready: whether the daemon knows that positions come.
        dropped: counts of messages that the daemon did not take.
    """

    def __init__(self, pipe: socket.socket) -> None:
        self._pipe = pipe
        self._queue: deque[bytes] = deque()
        self._reported_counts: Counter[str] = Counter()
        self._reported_s = 0.0
        self.is_ready = False
        self.dropped: Counter[str] = Counter()
        pipe.setblocking(False)

    @property
    def has_waiting(self) -> bool:
        """Whether messages wait until the daemon reads."""
        return bool(self._queue)

    def report_ready(self) -> None:
        """Tell the daemon, once, that positions come: before any position."""
        if not self.is_ready:
            self.is_ready = True
            self.queue_message(READY)

    def queue_message(self, message: bytes) -> None:
        """Send a message, now or later; the oldest of too many are dropped."""
        if len(self._queue) >= MAX_QUEUE:
            self._queue.popleft()
            self.dropped[OVERRUN] += 1
        self._queue.append(message)
        self.flush()

    def flush(self) -> None:
        """Send the messages that wait, as far as the daemon reads."""
        while self._queue:
            try:
                self._pipe.send(self._queue[0])
            except OSError:  # full: sent later; closed: found at the next read
                return
            self._queue.popleft()

    def report_counts(self, dropped: Counter[str]) -> None:
        """Report the counts of a source and our own where they have changed, not often."""
        counts = dropped + self.dropped
        if counts != self._reported_counts and time.monotonic() - self._reported_s >= _COUNTS_PERIOD_S:
            self._reported_counts, self._reported_s = counts, time.monotonic()
            self.queue_message(COUNTS + json.dumps(counts).encode())


def serve_daemon(descriptor: int, memory_limit: int, run: Callable[[socket.socket], None]) -> None:
    """Run a source in this process until the daemon has gone; an error becomes the last message.

    Args:
        descriptor: number of our end of the pair of sockets.
        memory_limit: addresses that the process may have [bytes].
    """
    import resource

    resource.setrlimit(resource.RLIMIT_AS, (memory_limit, memory_limit))
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))  # never beside the control loop of a --realtime daemon
    with socket.socket(fileno=descriptor) as pipe:
        pipe.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _PIPE_BYTES)
        try:
            run(pipe)
        except CameraError as error:
            pipe.send(REFUSED + str(error).encode())
        except OSError as error:
            pipe.send(UNREACHABLE + str(error.strerror or error).encode())
        except Exception as error:  # noqa: BLE001 the daemon reports the cause
            pipe.send(FAILED + in_words(error).encode())
