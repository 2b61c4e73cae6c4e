"""The flight's end of its live view: a process that shows what is sent to it, and never holds the flight up.

Messages go through a pair of sockets that keeps message bounds. While the process does not read, they are dropped.
"""

from __future__ import annotations

import secrets
import socket
import subprocess
import sys
import threading
from collections.abc import Callable

from logs.live.feed import LARGEST, pack
from logs.recording.topics import parse_raw_topic
from uavctl.errors import UsageError

HOST = "127.0.0.1"
BACKLOG = 16  # connections that wait until the process accepts them
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
            self._socket, peer = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, LARGEST)
            self._socket.setblocking(False)
            numbers = (peer.fileno(), listener.fileno())
            with peer:
                try:
                    self._process = subprocess.Popen(
                        [sys.executable, "-P", "-m", "logs.live.host", *map(str, numbers)],
                        pass_fds=numbers,
                        stdin=subprocess.DEVNULL,
                        stdout=subprocess.DEVNULL,
                        stderr=subprocess.DEVNULL,  # a console that nobody reads would hold it up
                        start_new_session=True,  # an interrupt is for the flight
                    )
                except OSError as error:  # no memory, or too many processes
                    self._socket.close()
                    raise UsageError(f"live view: its process cannot be started ({error.strerror})") from error
        self._socket.send(self.token.encode())  # other users can read the arguments of a process
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
        code = self._process.wait()
        if not self._is_closed:
            self._on_death(f"signal {-code}" if code < 0 else f"exit code {code}")
