"""The flight's end of its live view: a process that shows what is sent to it, and never holds the flight up.

Messages go through a pair of sockets that keeps message bounds. While the process does not read, they are dropped.
"""

from __future__ import annotations

import io
import secrets
import socket
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Callable
from contextlib import ExitStack

from logs.live.feed import LARGEST, pack
from logs.recording.topics import parse_raw_topic
from uavctl.errors import UsageError

HOST = "127.0.0.1"
BACKLOG = 16  # connections that wait until the process accepts them
BUFFER_BYTES = 262_144  # of the system for each connection and direction; by itself it takes megabytes
_END_S = 2.0  # for the process to end by itself


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

    It ends when its pair of sockets is closed: by `close`, or by the system once the flight's process has gone.

    Args:
        port: TCP port; 0 takes one that is free.
        on_death: Called once, from a thread of its own, with the reason if the process ends before `close`.

    Attributes:
        port: Port that is served.
        token: Path with which pages of other sites may open the WebSocket.
        dropped: Number of messages that the process did not take.

    Raises:
        UsageError: The port cannot be had, or the process cannot be started.
    """

    def __init__(self, port: int, on_death: Callable[[str], None]) -> None:
        self.token, self.dropped = secrets.token_urlsafe(12), 0
        self._on_death, self._is_closed = on_death, False
        with open_port(port) as listener:
            self.port: int = listener.getsockname()[1]
            try:
                self._socket, self._process = _start(listener, self.token)
            except OSError as error:  # no memory, no descriptor, or too many processes
                raise UsageError(f"live view: its process cannot be started ({error.strerror})") from error
        threading.Thread(target=self._wait_for_end, name="live view's end", daemon=True).start()

    def send(self, topic: str, at_ns: int, data: bytes) -> None:
        """Send a message, or drop it; returns at once and raises nothing. Raw bytes are not shown.

        Args:
            at_ns: Log time in UTC [ns].
        """
        if parse_raw_topic(topic) is not None:
            return
        try:
            self._socket.send(pack(topic, at_ns, data))
        except OSError:  # the process is slow, stopped or gone, or the message is too long
            self.dropped += 1

    def close(self) -> None:
        """End the process."""
        self._is_closed = True
        self._socket.close()
        try:
            self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _wait_for_end(self) -> None:
        with self._process.stderr or io.BytesIO() as errors:
            last_words = b"".join(deque(errors, maxlen=1)).decode(errors="replace").strip()
        code = self._process.wait()
        if not self._is_closed:
            self._on_death(f"signal {-code}" if code < 0 else last_words or f"exit code {code}")


def _start(listener: socket.socket, token: str) -> tuple[socket.socket, subprocess.Popen[bytes]]:
    """Start the process; return the flight's end of the pair of sockets and the process.

    Raises:
        OSError: The system does not allow that now.
    """
    own, peer = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ExitStack() as stack:
        stack.callback(own.close)
        stack.enter_context(peer)
        own.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, LARGEST)
        own.setblocking(False)
        own.send(token.encode())  # other users can read the arguments of a process
        numbers = (peer.fileno(), listener.fileno())
        process = subprocess.Popen(
            [sys.executable, "-P", "-m", "logs.live.host", *map(str, numbers)],
            pass_fds=numbers,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,  # read by the thread that waits for the end
            start_new_session=True,  # an interrupt is for the flight
        )
        peer.close()
        stack.pop_all()
    return own, process
