"""The process of a topic of ROS 2, with a node that is played: its messages to the daemon, and its errors."""

from __future__ import annotations

import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from types import SimpleNamespace
from typing import Any, cast

import pytest
from patience import wait_until
from ros2_messages import make_message

from uavctl.errors import ExtraMissingError
from uavctl.io import ros2_host
from uavctl.io.camera import COUNTS, LARGEST, READY, CameraError
from uavctl.io.ros2_host import NO_PUBLISHER, SEVERAL_PUBLISHERS, SILENT, Ros2Host
from uavctl.io.ros2_node import Ros2Node
from uavctl.io.ros2_pose import POSE_TYPES
from uavctl.io.ros2_url import Ros2Url, StampClock
from uavctl.io.sources import open_source
from uavctl.mavlink.codec import decode
from uavctl.mavlink.encoder import Encoder
from uavctl.mavlink.messages import Position, TimeSync

POSE = POSE_TYPES[0]


class PlayedNode:
    """A node whose messages the test gives."""

    def __init__(self, publishers: list[tuple[str, str]]) -> None:
        self.publishers = publishers
        self.receivers: dict[str, Callable[[Any], None]] = {}
        self.messages: list[tuple[str, Any]] = []

    def spin(self, timeout_s: float) -> None:
        if self.messages:
            topic, message = self.messages.pop(0)
            self.receivers[topic](message)
        else:
            time.sleep(0.001)

    def subscribe(self, kind: str, topic: str, receive: Callable[[Any], None]) -> None:
        self.receivers[topic] = receive

    def list_publishers(self, topic: str) -> list[tuple[str, str]]:
        return self.publishers

    def list_topics(self) -> list[tuple[str, list[str]]]:
        return [("/other/pose", [POSE])]


def make_host(node: PlayedNode, pipe: socket.socket, url: Ros2Url) -> Ros2Host:
    return Ros2Host(url, pipe, cast(Ros2Node, node))


@contextmanager
def running(node: PlayedNode, clock: StampClock = "sender") -> Iterator[socket.socket]:
    """A host in a thread of its own; gives the daemon's end."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with theirs:
        thread = threading.Thread(target=make_host(node, theirs, Ros2Url("/drone/pose", clock=clock)).run)
        thread.start()
        ours.settimeout(10.0)
        try:
            yield ours
        finally:
            ours.close()
            thread.join()


def receive(ours: socket.socket) -> Any:
    """The next message that is no count."""
    while (data := ours.recv(LARGEST))[:1] == COUNTS:
        pass
    return READY if data == READY else decode(data).messages[0]


def run_alone(node: PlayedNode, url: Ros2Url, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ros2_host, "ANSWER_S", 0.05)
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with theirs, closing(ours):
        make_host(node, theirs, url).run()


def test_poses_follow_the_message_that_it_is_ready() -> None:
    node = PlayedNode([("driver", POSE)])
    node.messages = [("/drone/pose", make_message("PoseStamped", stamp=(100, 5000 + 1000 * i))) for i in range(3)]
    with running(node) as ours:
        assert receive(ours) == READY
        poses = [receive(ours) for _ in range(3)]
    assert [pose.stamp_us for pose in poses] == [100_000_005, 100_000_006, 100_000_007]
    assert all(isinstance(pose, Position) and pose.position_m == (2.0, 1.0, -3.0) for pose in poses)


def test_the_system_clock_answers_time_requests_itself_and_that_of_a_simulation_by_its_next_message() -> None:
    request = Encoder(245, 25).encode_timesync(0, 7_000)
    first = ("/drone/pose", make_message("PoseStamped"))
    node = PlayedNode([("driver", POSE)])
    node.messages = [first]
    with running(node, "system") as ours:
        assert receive(ours) == READY and isinstance(receive(ours), Position)
        before_ns = time.time_ns()
        ours.send(request)
        answer = receive(ours)
        assert isinstance(answer, TimeSync)
        assert answer.ts1_ns == 7_000 and before_ns <= answer.tc1_ns <= time.time_ns()
    node = PlayedNode([("driver", POSE)])
    node.messages = [first]
    with running(node, "sim") as ours:
        assert receive(ours) == READY and isinstance(receive(ours), Position)
        ours.send(request)
        while not isinstance(answer := receive_after_clock(node, ours), TimeSync):
            pass
        assert (answer.ts1_ns, answer.tc1_ns) == (7_000, 12_000_000_034)


def receive_after_clock(node: PlayedNode, ours: socket.socket) -> Any:
    """The next message after one of /clock; nothing, if the host had not read the request yet."""
    node.messages.append(("/clock", SimpleNamespace(clock=SimpleNamespace(sec=12, nanosec=34))))
    ours.settimeout(0.2)
    try:
        return receive(ours)
    except TimeoutError:
        return None


@pytest.mark.parametrize(
    ("publishers", "reason"),
    [([("driver", POSE)], SILENT), ([], NO_PUBLISHER), ([("a", POSE)] * 2, SEVERAL_PUBLISHERS)],
)
def test_a_topic_that_is_silent_or_mixed_in_flight_is_counted(
    publishers: list[tuple[str, str]], reason: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ros2_host, "_WATCH_S", 0.01)
    monkeypatch.setattr(ros2_host, "_SILENT_S", 0.01)
    node = PlayedNode([("driver", POSE)])
    node.messages = [("/drone/pose", make_message("PoseStamped"))]
    with running(node) as ours:
        assert receive(ours) == READY
        node.publishers = publishers
        wait_until(lambda: reason.encode() in ours.recv(LARGEST), "it is counted", pause_s=0.0)


@pytest.mark.parametrize(
    ("publishers", "messages", "error", "reason"),
    [
        ([], [], TimeoutError, "no publisher of /drone/pose .*: /other/pose"),
        ([("driver", POSE)], [], TimeoutError, "no message on /drone/pose"),
        ([("driver", "sensor_msgs/msg/Imu")], [], CameraError, "of driver has sensor_msgs/msg/Imu"),
        ([("driver", POSE)], [make_message("PoseStamped", frame="odom")], CameraError, "in frame 'odom', not 'map'"),
    ],
)
def test_a_topic_that_cannot_be_used_is_an_error_at_the_start(
    publishers: list[tuple[str, str]],
    messages: list[Any],
    error: type[Exception],
    reason: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    node = PlayedNode(publishers)
    node.messages = [("/drone/pose", message) for message in messages]
    with pytest.raises(error, match=reason):
        run_alone(node, Ros2Url("/drone/pose", frame="map"), monkeypatch)


@pytest.mark.parametrize("package", ["rclpy", "geometry_msgs", "nav_msgs"])
def test_a_missing_package_names_the_extra(package: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("uavctl.io.camera_process.find_spec", lambda name: None if name == package else name)
    with pytest.raises(ExtraMissingError) as caught:
        open_source("ros2://drone/pose")
    assert (caught.value.package, caught.value.extra) == (package, "ros2")


def test_ros_is_not_imported_before_a_node_is_opened() -> None:
    code = "import sys, uavctl.io.sources, uavctl.io.ros2_host; print('rclpy' in sys.modules)"
    assert subprocess.check_output([sys.executable, "-c", code], text=True).strip() == "False"
