"""Notification socket of the service manager (sd_notify): ready, watchdog, status.

Only the control loop sends the watchdog signal. If the loop hangs, the service manager sees it.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Mapping
from contextlib import suppress

from uavctl.errors import UsageError
from uavctl.records import Ticked

_WATCHDOG_SIGNALS = 4  # watchdog signals in one watchdog time
_MAX_STATUS = 2000  # characters of a status text


class Notifier:
    """Notifies the service manager, if there is one; never blocks, and never raises after its creation.

    Args:
        environ: the environment: NOTIFY_SOCKET, WATCHDOG_USEC, WATCHDOG_PID as systemd sets them.
        pid: of this process; the watchdog of another process gets no signals.

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
        self.watchdog_ns = _read_watchdog_ns(environ, os.getpid() if pid is None else pid)
        self._signalled_ns: int | None = None

    def after_tick(self, ticked: Ticked, lateness_ns: int) -> None:
        """Send `ready` after the first tick, then watchdog signals."""
        del lateness_ns
        at_ns = ticked.decision.at_ns
        if self._signalled_ns is None:
            self._send("READY=1")
        elif self.watchdog_ns is None or at_ns - self._signalled_ns < self.watchdog_ns // _WATCHDOG_SIGNALS:
            return
        self._signalled_ns = at_ns
        self._send("WATCHDOG=1")

    def send_status(self, text: str) -> None:
        """Send a line for `systemctl status`."""
        self._send("STATUS=" + text.replace("\n", " ")[:_MAX_STATUS])

    def close(self) -> None:
        """Send that the daemon stops; then the watchdog needs no signals."""
        self._send("STOPPING=1")
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _send(self, line: str) -> None:
        if self._socket is not None:
            with suppress(OSError):  # full or gone: the manager's watchdog reacts
                self._socket.sendto(line.encode(), self._address)


def _read_watchdog_ns(environ: Mapping[str, str], pid: int) -> int | None:
    """Read the watchdog time of the service manager [ns]; None if this process has no watchdog."""
    usec, owner = environ.get("WATCHDOG_USEC"), environ.get("WATCHDOG_PID")
    if usec is None or (owner is not None and owner != str(pid)):
        return None
    if not usec.isdecimal() or int(usec) == 0:
        raise UsageError(f"WATCHDOG_USEC={usec}: not a number of microseconds; unset it")
    return int(usec) * 1000
