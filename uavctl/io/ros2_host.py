"""Process that listens to a topic of ROS 2 for one daemon.

The daemon starts it as `python -m uavctl.io.ros2_host FD TOPIC FRAME CHILD CLOCK`.

1. Wait for the topic's publisher, and subscribe best-effort with a short queue, as for sensor data.
2. Encode poses of the first publisher as MAVLink, and send them to the daemon (`uavctl.io.daemon_pipe`).
3. Answer time requests where the clock of the stamps is known: by the system's time, or by the next message of /clock.
4. End when the daemon has closed its end, or has died.
"""

from __future__ import annotations

import select
import socket
import sys
import threading
import time
from collections import Counter, deque
from functools import partial
from typing import Any, cast

from uavctl.arrays import SECOND_NS
from uavctl.event_codes import EventCode
from uavctl.io.camera import ANSWER_S, LARGEST, CameraError, Echo
from uavctl.io.camera_host import CameraMessageEncoder, parse_time_requests
from uavctl.io.daemon_pipe import DaemonPipe, serve_daemon
from uavctl.io.ros2_node import Ros2Node, open_node
from uavctl.io.ros2_pose import OnePublisher, PoseReader, choose_type, describe_pose_topics, list_nodes
from uavctl.io.ros2_url import Ros2Url, StampClock

NO_PUBLISHER = "no-publisher"
SEVERAL_PUBLISHERS = EventCode.SEVERAL_PUBLISHERS.value
SILENT = "topic-silent"
_CLOCK_TYPE, _CLOCK_TOPIC = "rosgraph_msgs/msg/Clock", "/clock"
_MEMORY_LIMIT = 2**32  # addresses: Fast DDS maps shared memory, and each thread reserves some
_POLL_S = 0.05
_WATCH_S = 0.5  # between two looks at the publishers
_SILENT_S = 1.0
_MAX_REPORTS = 8  # cases of several publishers
_MAX_REQUESTS = 8  # time requests that wait for /clock


class Ros2Host:
    """Passes poses of a topic to the daemon.

    Args:
        pipe: our end of the pair of sockets.
        node: our node.
    """

    def __init__(self, url: Ros2Url, pipe: socket.socket, node: Ros2Node) -> None:
        self._url, self._pipe, self._node = url, pipe, node
        self._daemon, self._encoder = DaemonPipe(pipe), CameraMessageEncoder()
        self._lock = threading.Lock()  # of the encoder and the pipe: the thread of time requests answers by itself
        self._has_daemon_ended = threading.Event()
        self._reader: PoseReader | None = None
        self._error: CameraError | None = None
        self._requests: deque[int] = deque(maxlen=_MAX_REQUESTS)
        self._dropped: Counter[str] = Counter()
        self._heard_s = self._watched_s = time.monotonic()
        self._source, self._are_mixed = OnePublisher(_SILENT_S), False
        self._reported: set[str] = set()  # reasons that name publishers

    def run(self) -> None:
        """Run until the daemon has gone.

        Raises:
            CameraError: the topic cannot be used.
            TimeoutError: it has no publisher, or no message comes.
        """
        threading.Thread(target=self._answer_requests, name="time requests", daemon=True).start()
        self._subscribe()
        if self._url.clock == "sim":
            self._node.subscribe(_CLOCK_TYPE, _CLOCK_TOPIC, self._receive_clock)
        start_s = self._heard_s = time.monotonic()
        while self._spin():
            if not self._daemon.is_ready and time.monotonic() - start_s > ANSWER_S:
                raise TimeoutError(f"no message on {self._url.topic} within {ANSWER_S:g} s, though it has a publisher")
            self._watch_publishers()
            with self._lock:
                self._daemon.flush()
                self._daemon.report_counts(self._dropped + (self._reader.dropped if self._reader else Counter()))

    def _spin(self) -> bool:
        """Handle what has come, or wait for it; False once the daemon has gone."""
        self._node.spin(_POLL_S)
        if self._error is not None:
            raise self._error
        return not self._has_daemon_ended.is_set()

    def _subscribe(self) -> None:
        """Subscribe once the topic has a publisher; return without one if the daemon has gone."""
        start_s = time.monotonic()
        while not (publishers := self._node.list_publishers(self._url.topic)):
            if time.monotonic() - start_s > ANSWER_S:
                known = describe_pose_topics(self._node.list_topics())
                raise TimeoutError(f"no publisher of {self._url.topic} within {ANSWER_S:g} s; {known}")
            if not self._spin():
                return
        kind = choose_type(self._url.topic, publishers)
        self._reader = PoseReader(kind, self._url.topic, self._url.frame, self._url.child)
        self._node.subscribe_with_gid(kind, self._url.topic, partial(self._receive_pose, self._reader))

    def _watch_publishers(self) -> None:
        """Count times at which the topic is silent; note whether poses mix that no identifier keeps apart."""
        now_s = time.monotonic()
        if now_s - self._watched_s < _WATCH_S:
            return
        self._watched_s = now_s
        publishers = self._node.list_publishers(self._url.topic)
        self._are_mixed = len(publishers) > 1 and self._source.gid == b""
        if self._are_mixed:
            self._report_publishers(f"positions of {list_nodes(publishers)} cannot be kept apart, and none is used")
        elif now_s - self._heard_s > _SILENT_S:
            self._dropped[SILENT if publishers else NO_PUBLISHER] += 1

    def _is_used(self, gid: bytes) -> bool:
        """Return whether a pose counts, by the identifier of its publisher; report another publisher."""
        before = self._source.gid
        is_used = self._source.accepts(gid, time.monotonic()) and not self._are_mixed
        if not is_used:
            self._dropped[SEVERAL_PUBLISHERS] += 1
        publishers = [] if before in (None, gid) else self._node.list_publishers(self._url.topic)
        if before is not None and len(publishers) > 1:  # else the driver has started again
            names = {publisher.gid: publisher.node for publisher in publishers}
            used, other = (names.get(one, "a node") for one in ((gid, before) if is_used else (before, gid)))
            self._report_publishers(f"positions of {used} are used, those of {other} are not")
        return is_used

    def _report_publishers(self, effect: str) -> None:
        """Report which publishers there are, each case once."""
        reason = f"{SEVERAL_PUBLISHERS}: {self._url.topic} has several publishers: {effect}"
        if reason not in self._reported and len(self._reported) < _MAX_REPORTS:
            self._reported.add(reason)
            self._dropped[reason] += 1

    def _receive_pose(self, reader: PoseReader, message: Any, gid: bytes) -> None:
        if not self._is_used(gid):
            return
        self._heard_s = time.monotonic()
        try:
            pose = reader.read(message)
        except CameraError as error:  # raised by `_spin`: an executor may keep errors of a callback
            self._error = error
            return
        with self._lock:
            self._daemon.report_ready()
            if pose is not None:
                self._daemon.queue_message(self._encoder.encode(pose))

    def _receive_clock(self, message: Any) -> None:
        """Answer waiting time requests: the simulated time lies between request and answer."""
        clock_ns = message.clock.sec * SECOND_NS + message.clock.nanosec
        while self._requests and clock_ns > 0:
            self._answer(self._requests.popleft(), clock_ns)

    def _answer(self, token: int, clock_ns: int) -> None:
        with self._lock:
            self._daemon.queue_message(self._encoder.encode(Echo(token, clock_ns)))

    def _answer_requests(self) -> None:
        """Read time requests until the daemon has gone."""
        while True:
            try:
                select.select([self._pipe], [], [])
                data = self._pipe.recv(LARGEST)
            except BlockingIOError:
                continue
            except (OSError, ValueError):  # the pipe is closed, here or there
                data = b""
            if not data:
                self._has_daemon_ended.set()
                return
            for token in parse_time_requests(data):
                if self._url.clock == "system":
                    self._answer(token, time.time_ns())
                elif self._url.clock == "sim":
                    self._requests.append(token)


def _listen(url: Ros2Url, pipe: socket.socket) -> None:
    with open_node("uavctl_source") as node:
        Ros2Host(url, pipe, node).run()


def main(arguments: list[str]) -> int:
    """Run for the daemon that started this process."""
    descriptor, topic, frame, child, clock = arguments
    url = Ros2Url(topic, frame, child, cast(StampClock, clock))
    serve_daemon(int(descriptor), _MEMORY_LIMIT, partial(_listen, url))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
