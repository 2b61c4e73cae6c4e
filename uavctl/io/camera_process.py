"""Connection to the process that listens to a camera system."""

from __future__ import annotations

import json
import socket
import subprocess
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from importlib.util import find_spec

from uavctl.config.connections import get_camera_system
from uavctl.errors import ConnectionSpecError, ExtraMissingError
from uavctl.event_codes import EventCode
from uavctl.io.admission import AdmissionRules, AllowList, RateLimiter
from uavctl.io.base import BaseConnection, Connection
from uavctl.io.camera import ANSWER_S, COUNTS, FAILED, LARGEST, READY, REFUSED, UNREACHABLE
from uavctl.io.camera_url import parse_camera_url
from uavctl.io.helper_process import MAX_RESTARTS, HelperProcess
from uavctl.io.ros2_url import SCHEME, parse_ros2_url

_MAVLINK = (0xFD, 0xFE)
_START_S = 60.0  # for the interpreter of the process, on a busy computer
_EXIT_CODE_S = 0.02  # for the exit code of a process that has closed its end
PROCESS_ENDED = f"{EventCode.PROCESS_ENDED}: "  # begin of a reason of a loss; its cause follows


class CameraProcessConnection(BaseConnection):
    """A process that gives MAVLink; see `uavctl.io.sources`. Implements `uavctl.io.base.Connection`.

    A process that ends is reported with its cause, and started again `MAX_RESTARTS` times; then the connection shows as
    `closed`. While only the server is gone the process asks on, and nothing comes.

    Args:
        arguments: of the process, without the pipe.
        advice: possible reasons why the server does not answer.
        now: clock for the times of arrival [ns].
        rules: how many messages a second are taken.
        module: the process's.
    """

    def __init__(
        self,
        url: str,
        arguments: list[str],
        advice: str,
        now: Callable[[], int],
        rules: AdmissionRules,
        module: str = "uavctl.io.camera_host",
    ) -> None:
        super().__init__(url, now)
        self._advice = advice
        self._refused_here: Counter[str] = Counter()
        self._rate_limiter, self._sender = RateLimiter(rules, self._refused_here), (url, 0)
        self._rate_limiter.trust_sender(self._sender, now())
        self._refused_there: Counter[str] = Counter()  # what the process counted
        self._refused_before: Counter[str] = Counter()  # what earlier processes counted
        self._restarts = 0
        self._cause = ""  # last words of the process
        self._module, self._arguments = module, arguments
        try:
            self._start()
        except OSError as error:  # no memory, or too many processes
            raise ConnectionSpecError(f"connection {url!r}: its process cannot be started ({error})") from error

    def _start(self) -> None:
        """Start the process.

        Raises:
            OSError: The system does not allow that now.
        """
        self._helper = HelperProcess(self._module, self._arguments)
        self._socket, self._process = self._helper.socket, self._helper.process

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

    def receive(self, *, read_all: bool = False) -> list[tuple[bytes, int]]:
        """See `Connection`; more than the rules allow is dropped, the oldest first."""
        arrived = super().receive(read_all=read_all)
        taken = self._rate_limiter.admit([self._sender] * len(arrived), [data for data, _ in arrived], self._now())
        self.refused = self._refused_before + self._refused_there + self._refused_here
        return [item for item, fits in zip(arrived, taken, strict=True) if fits]

    def send(self, data: bytes) -> None:
        """See `Connection`; only time requests reach the cameras."""
        try:
            self._socket.send(data)
        except OSError:
            self.send_errors += 1

    def close(self) -> None:
        """See `Connection`; the process ends."""
        self.closed = True
        self._helper.close()

    def _read(self) -> bytes | None:
        data = self._socket.recv(LARGEST)
        if not data:
            self._restart()
        elif data[0] in _MAVLINK:
            return data
        elif data[:1] == COUNTS:
            self._refused_there = Counter(json.loads(data[1:]))
        elif data[:1] in (REFUSED, UNREACHABLE, FAILED):
            self._cause = data[1:].decode(errors="replace")
        return None

    def _restart(self) -> None:
        """Start a process in place of one that has ended, and count its cause as a reason of a loss."""
        cause = self._cause or self._describe_exit()
        self._socket.close()
        self._refused_before += self._refused_there
        self._refused_there, self._cause = Counter(), ""
        if self._restarts >= MAX_RESTARTS:
            self._give_up(f"{cause}; it is not started again")
            return
        self._restarts += 1
        try:
            self._start()
        except OSError as error:
            self._give_up(f"{cause}; it cannot be started again ({error.strerror})")
            return
        self._socket.setblocking(False)
        self._refused_here[f"{PROCESS_ENDED}{cause}; it is started again ({self._restarts} of {MAX_RESTARTS})"] += 1

    def _give_up(self, text: str) -> None:
        self.closed = True
        self._refused_here[f"{PROCESS_ENDED}{text}"] += 1

    def _describe_exit(self) -> str:
        """Return how the process has ended, in words; a process that has only closed its end is killed."""
        try:
            code = self._process.wait(_EXIT_CODE_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            return "it has closed its connection"
        return f"signal {-code}" if code < 0 else f"exit code {code}"


def _open_camera(urls: Sequence[str], now: Callable[[], int], rules: AdmissionRules) -> Connection:
    """Open the bodies of one server of a camera system; see `open_bodies`.

    Raises:
        ConnectionSpecError: the URL, the server or a body is not as it has to be.
        ExtraMissingError: the camera system's package is not installed.
    """
    url, camera_url = urls[0], parse_camera_url(urls[0])
    bodies = [parse_camera_url(each).body for each in urls]
    system = get_camera_system(camera_url.system)
    if system.package and find_spec(system.package) is None:  # not imported: the camera has a process of its own
        raise ExtraMissingError(system.package, system.extra)
    try:
        address = socket.gethostbyname(camera_url.host)
    except OSError as error:
        raise ConnectionSpecError(
            f"connection {url!r}: host {camera_url.host!r} is unknown ({error}); check the name"
        ) from error
    if not AllowList(rules.allow).allows(address):
        raise ConnectionSpecError(f"connection {url!r}: {address} is not in security.allow; add it there")
    arguments = [system.camera, address, str(camera_url.port), camera_url.up, camera_url.interface, *bodies]
    return _wait_for(CameraProcessConnection(url, arguments, system.advice, now, rules))


def _open_topic(url: str, now: Callable[[], int], rules: AdmissionRules) -> Connection:
    """Open a topic of ROS 2; see `open_source`.

    Raises:
        ConnectionSpecError: the URL or the topic is not as it has to be.
        ExtraMissingError: a package of ROS 2 is not installed.
    """
    ros2_url, system = parse_ros2_url(url), get_camera_system(SCHEME)
    for package in (system.package, "geometry_msgs", "nav_msgs"):
        if find_spec(package) is None:
            raise ExtraMissingError(package, system.extra)
    arguments = [ros2_url.topic, ros2_url.frame, ros2_url.child, ros2_url.clock]
    return _wait_for(CameraProcessConnection(url, arguments, system.advice, now, rules, "uavctl.io.ros2_host"))


def _wait_for(connection: CameraProcessConnection) -> CameraProcessConnection:
    """Return a connection once it is ready; close it if it does not get so."""
    with ExitStack() as stack:
        stack.callback(connection.close)
        connection.wait_until_ready()
        stack.pop_all()
    return connection
