"""The flight's end of a process that shows the records sent to it, and never delays the flight.

Messages go through a pair of sockets that keeps message bounds. While the process does not read, they are dropped.
"""

from __future__ import annotations

import io
import socket
import subprocess
import threading
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from contextlib import suppress

from logs.live.feed import LARGEST, pack
from logs.recording.topics import parse_raw_topic
from uavctl.errors import UsageError
from uavctl.io.helper_process import MAX_RESTARTS, HelperProcess


class FeedProcess(ABC):
    """Process that gets all messages of a flight.

    It ends when its pair of sockets is closed: by `close`, or by the system once the flight's process has gone. One
    that ends before is started again, at most `MAX_RESTARTS` times, and gets the newest message of each topic.

    Args:
        on_death: Called, from a thread of its own, with the reason and the effect, each time that the process ends
            before `close`.

    Attributes:
        name: What the process is, for errors.
        dropped: Number of messages that the process did not take.

    Raises:
        UsageError: The process cannot be started.
    """

    name: str

    def __init__(self, on_death: Callable[[str], None]) -> None:
        self.dropped = 0
        self._on_death, self._is_closed, self._restarts = on_death, False, 0
        self._newest: dict[str, bytes] = {}  # packed message of each topic
        self._lock = threading.Lock()  # of a restart and the end
        try:
            self._helper = self._start()
        except OSError as error:  # no memory, no descriptor, or too many processes
            raise UsageError(f"{self.name}: its process cannot be started ({error.strerror})") from error
        threading.Thread(target=self._watch, name=f"{self.name}'s end", daemon=True).start()

    @abstractmethod
    def _make_helper(self) -> HelperProcess:
        """Start a process, whose standard error is a pipe.

        Raises:
            OSError: The system does not allow that now.
            UsageError: It cannot serve.
        """

    def _list_first_words(self) -> list[bytes]:
        """Return what a process gets before the flight's messages."""
        return []

    def send(self, topic: str, at_ns: int, data: bytes) -> None:
        """Send a message, or drop it; returns at once and raises nothing. Raw bytes are not shown.

        Args:
            at_ns: Log time in UTC [ns].
        """
        if parse_raw_topic(topic) is not None:
            return
        self._newest[topic] = message = pack(topic, at_ns, data)
        try:
            self._helper.socket.send(message)
        except OSError:  # the process is slow, stopped or gone, or the message is too long
            self.dropped += 1

    def close(self) -> None:
        """End the process."""
        with self._lock:
            self._is_closed = True
        self._helper.close()

    def _start(self) -> HelperProcess:
        """Start a process, and give it the known records.

        Raises:
            OSError: The system does not allow that now.
            UsageError: It cannot serve.
        """
        helper = self._make_helper()
        helper.socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, LARGEST)
        helper.socket.setblocking(False)
        with suppress(OSError):  # of a process that has died already
            for message in (*self._list_first_words(), *list(self._newest.values())):
                helper.socket.send(message)
        return helper

    def _watch(self) -> None:
        """Wait for the end of each process in turn."""
        is_served = True
        while is_served:
            reason = _wait_for_end(self._helper.process)
            with self._lock:
                if self._is_closed:
                    return
                is_served, outcome = self._restart()
            self._on_death(f"{reason}; {outcome}")

    def _restart(self) -> tuple[bool, str]:
        """Start a process again, if that is still allowed; return whether one serves, and the event in words."""
        self._helper.socket.close()
        outcome = "it is not started again"
        if self._restarts < MAX_RESTARTS:
            self._restarts += 1
            try:
                self._helper = self._start()
            except (OSError, UsageError) as error:
                outcome = f"it cannot be started again ({error})"
            else:
                return True, f"it is started again ({self._restarts} of {MAX_RESTARTS})"
        return False, outcome


def _wait_for_end(process: subprocess.Popen[bytes]) -> str:
    """Wait for the end of a process; return its cause."""
    with process.stderr or io.BytesIO() as errors:
        last_words = b"".join(deque(errors, maxlen=1)).decode(errors="replace").strip()
    code = process.wait()
    return f"signal {-code}" if code < 0 else last_words or f"exit code {code}"
