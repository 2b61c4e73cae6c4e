"""The process of a topic of ROS 2, with a node that is played: its messages to the daemon, and its errors."""

from __future__ import annotations

import json
import math
import re
import socket
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from types import SimpleNamespace
from typing import Any, cast

import pytest
from mavlink_rig import make_link
from patience import wait_until
from ros2_messages import make_message

from uavctl.arrays import SECOND_NS
from uavctl.errors import ExtraMissingError
from uavctl.event_codes import EventCode
from uavctl.io import ros2_host
from uavctl.io.camera import COUNTS, LARGEST, READY, CameraError
from uavctl.io.ros2_host import NO_PUBLISHER, SEVERAL_PUBLISHERS, SILENT, Ros2Host
from uavctl.io.ros2_node import Ros2Node
from uavctl.io.ros2_pose import POSE_TYPES, Publisher
from uavctl.io.ros2_url import Ros2Url, StampClock
from uavctl.io.sources import open_source
from uavctl.mavlink.codec import decode
from uavctl.mavlink.encoder import Encoder
from uavctl.mavlink.messages import Position, TimeSync
from uavctl.records import Severity

POSE = POSE_TYPES[0]
DRIVER, OTHER = Publisher("/driver", POSE, b"1"), Publisher("/bag/player", POSE, b"2")


class PlayedNode:
    """A node whose messages the test gives."""

    def __init__(self, publishers: list[Publisher]) -> None:
        self.publishers = publishers
        self.receivers: dict[str, Callable[..., None]] = {}
        self.messages: list[tuple[Any, ...]] = []  # topic, message, and of a pose the publisher's identifier

    def spin(self, timeout_s: float) -> None:
        if self.messages:
            topic, *message = self.messages.pop(0)
            self.receivers[topic](*message)
        else:
            time.sleep(0.001)

    def subscribe(self, kind: str, topic: str, receive: Callable[[Any], None]) -> None:
        self.receivers[topic] = receive

    def subscribe_with_gid(self, kind: str, topic: str, receive: Callable[[Any, bytes], None]) -> None:
        self.receivers[topic] = receive

    def list_publishers(self, topic: str) -> list[Publisher]:
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
    node = PlayedNode([DRIVER])
    node.messages = [("/drone/pose", make_message("PoseStamped", stamp=(100, 5000 + 1000 * i)), b"1") for i in range(3)]
    with running(node) as ours:
        assert receive(ours) == READY
        poses = [receive(ours) for _ in range(3)]
    assert [pose.stamp_us for pose in poses] == [100_000_005, 100_000_006, 100_000_007]
    assert all(isinstance(pose, Position) and pose.position_m == (2.0, 1.0, -3.0) for pose in poses)


def test_the_system_clock_answers_time_requests_itself_and_that_of_a_simulation_by_its_next_message() -> None:
    request = Encoder(245, 25).encode_timesync(0, 7_000)
    first = ("/drone/pose", make_message("PoseStamped"), b"1")
    node = PlayedNode([DRIVER])
    node.messages = [first]
    with running(node, "system") as ours:
        assert receive(ours) == READY and isinstance(receive(ours), Position)
        before_ns = time.time_ns()
        ours.send(request)
        answer = receive(ours)
        assert isinstance(answer, TimeSync)
        assert answer.ts1_ns == 7_000 and before_ns <= answer.tc1_ns <= time.time_ns()
    node = PlayedNode([DRIVER])
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


@pytest.mark.parametrize(("publishers", "reason"), [([DRIVER], SILENT), ([], NO_PUBLISHER)])
def test_a_topic_that_is_silent_in_flight_is_counted(
    publishers: list[Publisher], reason: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ros2_host, "_WATCH_S", 0.01)
    monkeypatch.setattr(ros2_host, "_SILENT_S", 0.01)
    node = PlayedNode([DRIVER])
    node.messages = [("/drone/pose", make_message("PoseStamped"), b"1")]
    with running(node) as ours:
        assert receive(ours) == READY
        node.publishers = publishers
        wait_until(lambda: reason.encode() in ours.recv(LARGEST), "it is counted", pause_s=0.0)


def read_until_told(ours: socket.socket, told: Callable[[Counter[str]], bool]) -> tuple[list[float], Counter[str]]:
    """The east of the positions until the counts tell something, and these."""
    east_m, counts = list[float](), Counter[str]()
    while not told(counts):
        data = ours.recv(LARGEST)
        if data[:1] == COUNTS:
            counts = Counter(json.loads(data[1:]))
        elif data != READY:
            (position,) = decode(data).messages
            assert isinstance(position, Position)
            east_m.append(position.position_m[1])
    return east_m, counts


def name_publishers(counts: Counter[str]) -> str:
    """What is told of several publishers: an event, not a count."""
    link = make_link(("mocap",))
    (event,) = [e for e in link.add_refusals(counts, SECOND_NS) if e.code == EventCode.SEVERAL_PUBLISHERS]
    assert event.severity is Severity.ERROR
    return event.text


def make_poses(gid: bytes, east_m: float, count: int = 5) -> list[tuple[Any, ...]]:
    return [("/drone/pose", make_message("PoseStamped", (east_m, 0.0, 1.0)), gid) for _ in range(count)]


@pytest.mark.fault(106)
def test_106_positions_of_a_second_publisher_do_not_count_and_both_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ros2_host, "_SILENT_S", math.inf)
    node = PlayedNode([DRIVER])
    node.messages = make_poses(b"1", 1.0)
    with running(node) as ours:
        assert receive(ours) == READY
        node.publishers = [DRIVER, OTHER]
        node.messages += [pose for _ in range(5) for gid in (b"2", b"1") for pose in make_poses(gid, int(gid), 1)]
        east_m, counts = read_until_told(ours, lambda counts: counts[SEVERAL_PUBLISHERS] == 5)
    assert set(east_m) == {1.0}
    text = name_publishers(counts)
    assert text.index("/driver") < text.index("/bag/player")  # the one that is used comes first


@pytest.mark.fault(106)
def test_106_the_second_publisher_takes_the_place_of_a_silent_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ros2_host, "_SILENT_S", 0.0)
    node = PlayedNode([DRIVER])
    node.messages = make_poses(b"1", 1.0)
    with running(node) as ours:
        assert receive(ours) == READY
        node.publishers = [DRIVER, OTHER]
        node.messages += make_poses(b"2", 2.0)
        east_m, counts = read_until_told(ours, lambda counts: any(": " in reason for reason in counts))
    assert east_m == sorted(east_m) and set(east_m) == {1.0, 2.0}
    text = name_publishers(counts)
    assert text.index("/bag/player") < text.index("/driver")


def receive_pose(node: PlayedNode, ours: socket.socket, gid: bytes, east_m: float) -> Position | None:
    """The position of a pose, if it counts."""
    node.messages += make_poses(gid, east_m, 1)
    ours.settimeout(0.05)
    try:
        message = receive(ours)
    except TimeoutError:
        return None
    finally:
        ours.settimeout(10.0)
    return message if isinstance(message, Position) and message.position_m[1] == east_m else None


@pytest.mark.fault(106)
def test_106_without_identifiers_no_position_of_several_publishers_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ros2_host, "_WATCH_S", 0.0)
    node = PlayedNode([DRIVER])
    node.messages = make_poses(b"", 1.0)
    with running(node) as ours:
        assert receive(ours) == READY
        wait_until(lambda: not node.messages, "the poses of the only publisher are read")
        node.publishers = [DRIVER, OTHER]
        _, counts = read_until_told(ours, lambda counts: bool(counts))
        assert {"/driver", "/bag/player"} <= set(re.findall(r"[/\w]+", name_publishers(counts)))
        node.messages += make_poses(b"", 2.0)
        east_m, _ = read_until_told(ours, lambda counts: counts[SEVERAL_PUBLISHERS] == 5)
        assert not east_m
        node.publishers = [DRIVER]
        wait_until(lambda: receive_pose(node, ours, b"", 3.0) is not None, "positions count again", pause_s=0.0)


@pytest.mark.fault(106)
def test_106_a_driver_that_starts_again_is_no_second_publisher(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ros2_host, "_SILENT_S", 0.01)
    node = PlayedNode([DRIVER])
    node.messages = make_poses(b"1", 1.0)
    with running(node) as ours:
        assert receive(ours) == READY
        node.publishers = [DRIVER._replace(gid=b"3")]
        wait_until(lambda: receive_pose(node, ours, b"3", 2.0) is not None, "it counts", pause_s=0.0)
        node.publishers = []
        _, counts = read_until_told(ours, lambda counts: counts[NO_PUBLISHER] > 0)
    assert not [reason for reason in counts if ": " in reason]


@pytest.mark.parametrize(
    ("publishers", "messages", "error", "reason"),
    [
        ([], [], TimeoutError, "no publisher of /drone/pose .*: /other/pose"),
        ([DRIVER], [], TimeoutError, "no message on /drone/pose"),
        ([Publisher("driver", "sensor_msgs/msg/Imu")], [], CameraError, "of driver has sensor_msgs/msg/Imu"),
        ([DRIVER], [make_message("PoseStamped", frame="odom")], CameraError, "in frame 'odom', not 'map'"),
    ],
)
def test_a_topic_that_cannot_be_used_is_an_error_at_the_start(
    publishers: list[Publisher],
    messages: list[Any],
    error: type[Exception],
    reason: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    node = PlayedNode(publishers)
    node.messages = [("/drone/pose", message, b"1") for message in messages]
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
