"""The flight's end of its live view: a process that shows the records sent to it, and never delays the flight.

Messages go through a pair of sockets that keeps message bounds. While the process does not read, they are dropped.
"""

from __future__ import annotations

import io
import secrets
import socket
import subprocess
import threading
from collections import deque
from collections.abc import Callable
from contextlib import suppress

from logs.live.feed import LARGEST, pack
from logs.recording.topics import parse_raw_topic
from uavctl.errors import UsageError
from uavctl.io.helper_process import MAX_RESTARTS, HelperProcess

HOST = "127.0.0.1"
BACKLOG = 16  # connections that wait until the process accepts them
BUFFER_BYTES = 262_144  # of the system for each connection and direction; by itself it takes megabytes


def open_port(port: int) -> socket.socket:
    """Listen on a port of this machine; 0 takes one that is free.

    Raises:
        UsageError: The port cannot be had.
    """
    if not 0 <= port <= 65535:
        raise UsageError(f"--live-port {port}: ports are 1 to 65535; 0 takes one that is free")
    listener = socket.socket()
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # after an earlier flight, at once
        for option in (socket.SO_RCVBUF, socket.SO_SNDBUF):  # accepted connections inherit them
            listener.setsockopt(socket.SOL_SOCKET, option, BUFFER_BYTES)
        listener.bind((HOST, port))
        listener.listen(BACKLOG)
    except OSError as error:
        listener.close()
        raise UsageError(
            f"live view: port {port} cannot be had ({error.strerror}); choose another with --live-port, or 0 for one "
            "that is free"
        ) from error
    return listener


class LiveProcess:
    """Process that serves the live view on one port of this machine.

    It ends when its pair of sockets is closed: by `close`, or by the system once the flight's process has gone. One
    that ends before is started again, at most `MAX_RESTARTS` times, and gets the newest message of each topic.

    Args:
        port: TCP port; 0 takes one that is free.
        on_death: Called, from a thread of its own, with the reason and the effect, each time that the process ends
            before `close`.

    Attributes:
        port: Port that is served.
        token: Path with which pages of other sites may open the WebSocket.
        dropped: Number of messages that the process did not take.

    Raises:
        UsageError: The port cannot be had, or the process cannot be started.
    """

    def __init__(self, port: int, on_death: Callable[[str], None]) -> None:
        self.token, self.dropped = secrets.token_urlsafe(12), 0
        self._on_death, self._is_closed, self._restarts = on_death, False, 0
        self._newest: dict[str, bytes] = {}  # packed message of each topic
        self._lock = threading.Lock()  # of a restart and the end
        self.port = port
        try:
            self._helper = self._start()
        except OSError as error:  # no memory, no descriptor, or too many processes
            raise UsageError(f"live view: its process cannot be started ({error.strerror})") from error
        threading.Thread(target=self._watch, name="live view's end", daemon=True).start()

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
            UsageError: The port cannot be had.
        """
        with open_port(self.port) as listener:
            self.port, number = listener.getsockname()[1], listener.fileno()
            # Standard error is read by the thread that waits for the end.
            helper = HelperProcess("logs.live.host", [str(number)], descriptors=(number,), stderr=subprocess.PIPE)
        helper.socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, LARGEST)
        helper.socket.setblocking(False)
        with suppress(OSError):  # of a process that has died already
            helper.socket.send(self.token.encode())  # other users can read the arguments of a process
            for message in list(self._newest.values()):
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
