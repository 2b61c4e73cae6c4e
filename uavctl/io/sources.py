"""Registry of position sources; the daemon's end of a camera process."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack
from importlib.util import find_spec

from uavctl.config.connections import get_camera_system, parse_camera_scheme
from uavctl.errors import ConnectionSpecError, ExtraMissingError
from uavctl.io.admission import AllowList, Budgets, Rules
from uavctl.io.base import Base, Connection
from uavctl.io.camera import ANSWER_S, COUNTS, LARGEST, READY, REFUSED, parse
from uavctl.io.transport import ANYBODY, open_connection

# The daemon's end of a process that listens to cameras.


_MAVLINK = (0xFD, 0xFE)
_START_S = 60.0  # for the interpreter of the process, on a busy computer
_END_S = 2.0


class Piped(Base):
    """A process that gives MAVLink; see `uavctl.io.sources`. Implements `uavctl.io.transport.Connection`.

    When the process ends, the connection shows as `closed`; while only its server is gone it asks on, and nothing
    comes.

    Args:
        arguments: of `uavctl.io.camera_host`, without the pipe.
        advice: what may be amiss where the server does not answer.
        now: clock for the times of arrival [ns].
        rules: how many messages a second are taken.
    """

    def __init__(self, url: str, arguments: list[str], advice: str, now: Callable[[], int], rules: Rules) -> None:
        super().__init__(url, now)
        self._advice = advice
        self._over: Counter[str] = Counter()
        self._budgets, self._sender = Budgets(rules, self._over), (url, 0)
        self._budgets.trust(self._sender, now())
        self._theirs: Counter[str] = Counter()  # what the process counted
        self._socket, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            command = [sys.executable, "-P", "-m", "uavctl.io.camera_host", str(theirs.fileno()), *arguments]
            try:
                self._process = subprocess.Popen(
                    command,
                    pass_fds=(theirs.fileno(),),
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    start_new_session=True,  # an interrupt is for the daemon; this process ends with the pipe
                )
            except OSError as error:  # no memory, or too many processes
                self._socket.close()
                raise ConnectionSpecError(f"connection {url!r}: its process cannot be started ({error})") from error

    def wait_until_ready(self) -> None:
        """Wait, for a bounded time, until the cameras have answered and know the body.

        Raises:
            ConnectionSpecError: they did not; its cause is an OSError where the server cannot be reached.
        """
        self._socket.settimeout(_START_S + ANSWER_S)
        try:
            while (first := self._socket.recv(LARGEST))[:1] == COUNTS:
                pass
        except OSError as error:
            raise ConnectionSpecError(f"connection {self.url!r}: its process does not start ({error})") from error
        self._socket.setblocking(False)
        kind, text = first[:1], first[1:].decode()
        if kind == REFUSED:
            raise ConnectionSpecError(f"connection {self.url!r}: {text}")
        if kind != READY:
            raise ConnectionSpecError(
                f"connection {self.url!r}: {text or 'its process has ended'}; {self._advice}"
            ) from TimeoutError(text)

    def fileno(self) -> int:
        """See `Connection`."""
        return self._socket.fileno()

    def receive(self, *, everything: bool = False) -> list[tuple[bytes, int]]:
        """See `Connection`; more than the rules allow is dropped, the oldest first."""
        arrived = super().receive(everything=everything)
        taken = self._budgets.take([self._sender] * len(arrived), [data for data, _ in arrived], self._now())
        self.refused = self._theirs + self._over
        return [one for one, fits in zip(arrived, taken, strict=True) if fits]

    def send(self, data: bytes) -> None:
        """See `Connection`; only questions for the time go on to the cameras."""
        try:
            self._socket.send(data)
        except OSError:
            self.send_errors += 1

    def close(self) -> None:
        """See `Connection`; the process ends."""
        self.closed = True
        self._socket.close()
        try:
            self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _read(self) -> bytes | None:
        data = self._socket.recv(LARGEST)
        if not data:
            self.closed = True
        elif data[0] in _MAVLINK:
            return data
        elif data[:1] == COUNTS:
            self._theirs = Counter(json.loads(data[1:]))
        return None


def _open_camera(url: str, now: Callable[[], int], rules: Rules) -> Connection:
    """Open a body of a camera system; see `open_source`.

    Raises:
        ConnectionSpecError: the URL, the server or the body is not as it has to be.
        ExtraMissingError: the camera system's package is not installed.
    """
    place = parse(url)
    system = get_camera_system(place.system)
    if system.package and find_spec(system.package) is None:  # not imported: the camera has a process of its own
        raise ExtraMissingError(system.package, system.extra)
    try:
        address = socket.gethostbyname(place.host)
    except OSError as error:
        raise ConnectionSpecError(
            f"connection {url!r}: host {place.host!r} is unknown ({error}); check the name"
        ) from error
    if not AllowList(rules.allow).lets_in(address):
        raise ConnectionSpecError(f"connection {url!r}: {address} is not in security.allow; add it there")
    arguments = [system.camera, address, str(place.port), place.body, place.up, place.interface]
    piped = Piped(url, arguments, system.advice, now, rules)
    with ExitStack() as stack:
        stack.callback(piped.close)
        piped.wait_until_ready()
        stack.pop_all()
    return piped


# Sources of positions: MAVLink as it is, or a camera system whose messages are turned into MAVLink at the edge.
#
# A source is whatever implements `uavctl.io.transport.Connection` and hands on MAVLink. Camera systems speak protocols
# of their own, so a process of ours (`uavctl.io.camera_host`) listens to one and gives the daemon ODOMETRY, stamped
# with the time of exposure in the cameras' clock, and answers to TIMESYNC. Why this edge, and not samples or another
# kind of link:
#
# * Recording, replay, check, relay and the rules for stamps and clocks see one language. What reaches the controller is
#   recorded as the bytes that it was, and a replay needs neither cameras nor their package.
# * Another camera system is one class (`uavctl.io.camera.Camera`): ours (`uavctl.config.connections.CAMERA_SYSTEMS`) or
#   that of another package, by its entry point `uavctl.sources` or as `module:Class`.
#
# Why a process and not a thread: a decoder in Python would hold the interpreter's lock when a tick is due, and a
# malformed frame can make it reserve gigabytes. The process has its own memory limit; when it ends, positions are
# lost, which the controller knows how to bear, and nothing else happens.


def open_source(url: str, now: Callable[[], int] = time.monotonic_ns, rules: Rules = ANYBODY) -> Connection:
    """Open a source of positions.

    Args:
        url: a camera system's, as natnet://SERVER[:PORT]/BODY, or what `uavctl.io.transport.open_connection` takes.
        now: clock for the times of arrival [ns].

    Raises:
        ConnectionSpecError: the URL cannot be understood or opened, or the cameras cannot be used; says what to do.
    """
    opener = _open_camera if parse_camera_scheme(url) else open_connection
    return opener(url, now, rules)
