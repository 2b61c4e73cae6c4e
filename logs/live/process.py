"""The flight's end of its live view: a process that shows the records sent to it, on one port of this machine."""

from __future__ import annotations

import secrets
import socket
import subprocess
from collections.abc import Callable, Mapping
from pathlib import Path

import msgspec

from logs.live.feed_process import FeedProcess
from logs.live.request import LiveAccess
from uavctl.errors import UsageError
from uavctl.io.helper_process import HelperProcess

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
            f"live view: port {port} cannot be used ({error.strerror}); choose another with --live-port, or 0 for one "
            "that is free"
        ) from error
    return listener


class LiveProcess(FeedProcess):
    """Process that serves the live view on one port of this machine; see `FeedProcess`.

    Args:
        port: TCP port; 0 takes one that is free.
        sockets: Control socket by name of the vehicle, for pages with the token; empty: no orders are taken.

    Attributes:
        port: Port that is served.
        token: Path with which pages of other sites may open the WebSocket.
        order_token: Token of pages that may give orders.

    Raises:
        UsageError: The port cannot be had, or the process cannot be started.
    """

    name = "live view"

    def __init__(self, port: int, on_death: Callable[[str], None], sockets: Mapping[str, Path] | None = None) -> None:
        self.token, self.port = secrets.token_urlsafe(12), port
        self.order_token = secrets.token_urlsafe(16)
        self._sockets = {name: str(path) for name, path in (sockets or {}).items()}
        super().__init__(on_death)

    @property
    def page_url(self) -> str:
        """Address of the page; its fragment, which no browser sends, permits orders."""
        return f"http://localhost:{self.port}/{f'#{self.order_token}' if self._sockets else ''}"

    def _make_helper(self) -> HelperProcess:
        with open_port(self.port) as listener:
            self.port, number = listener.getsockname()[1], listener.fileno()
            # Standard error is read by the thread that waits for the end.
            return HelperProcess("logs.live.host", [str(number)], descriptors=(number,), stderr=subprocess.PIPE)

    def _list_first_words(self) -> list[bytes]:
        # Other users can read the arguments of a process
        return [msgspec.json.encode(LiveAccess(self.token, self.order_token, self._sockets))]
