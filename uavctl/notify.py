"""The service manager's notification socket (sd_notify): ready, alive, what goes on.

The sign of life comes from the control loop and from nowhere else: a loop that hangs is a daemon that hangs.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Mapping
from contextlib import suppress

from uavctl.clock import Due
from uavctl.errors import UsageError

_FEEDS = 4  # signs of life in one watchdog time
_LONGEST = 2000  # characters of a status


class Notifier:
    """Tells the service manager, if there is one; never blocks, never raises once it is made.

    Args:
        environ: the environment: NOTIFY_SOCKET, WATCHDOG_USEC, WATCHDOG_PID as systemd sets them.
        pid: of this process; a watchdog that is meant for another one is not fed.

    Raises:
        UsageError: one of the variables cannot be understood.
    """

    def __init__(self, environ: Mapping[str, str] = os.environ, pid: int | None = None) -> None:
        address = environ.get("NOTIFY_SOCKET", "")
        if address and address[0] not in "/@":
            raise UsageError(f"NOTIFY_SOCKET={address}: neither a path nor an abstract name; unset it")
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self._socket: socket.socket | None = None
        if address:
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
            self._socket.setblocking(False)
        self.watchdog_ns = _watchdog_ns(environ, os.getpid() if pid is None else pid)
        self._fed_ns: int | None = None

    def after_tick(self, due: Due, lateness_ns: int) -> None:
        """The control loop has run a tick: ready with the first one, then signs of life."""
        del lateness_ns
        if self._fed_ns is None:
            self._tell("READY=1")
        elif self.watchdog_ns is None or due.at_ns - self._fed_ns < self.watchdog_ns // _FEEDS:
            return
        self._fed_ns = due.at_ns
        self._tell("WATCHDOG=1")

    def status(self, text: str) -> None:
        """One line for `systemctl status`."""
        self._tell("STATUS=" + text.replace("\n", " ")[:_LONGEST])

    def close(self) -> None:
        """Say that the daemon ends, which no watchdog has to see."""
        self._tell("STOPPING=1")
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _tell(self, line: str) -> None:
        if self._socket is not None:
            with suppress(OSError):  # full or gone: the manager's own watchdog draws the conclusion
                self._socket.sendto(line.encode(), self._address)


def _watchdog_ns(environ: Mapping[str, str], pid: int) -> int | None:
    """Time within which the manager wants a sign of life [ns]; None if it wants none of this process."""
    usec, owner = environ.get("WATCHDOG_USEC"), environ.get("WATCHDOG_PID")
    if usec is None or (owner is not None and owner != str(pid)):
        return None
    if not usec.isdecimal() or int(usec) == 0:
        raise UsageError(f"WATCHDOG_USEC={usec}: not a number of microseconds; unset it")
    return int(usec) * 1000
