"""The process of a flight's node: a recorded flight is published to real nodes over localhost, and orders are taken."""

from __future__ import annotations

import json
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Path as PathMessage
from node_rig import LATCHED, call, make_node, spinning, subscribe
from patience import wait_until
from rclpy.qos import ReliabilityPolicy
from view_rig import fly_view
from visualization_msgs.msg import MarkerArray

from logs.recording.design_view import read_design
from logs.recording.topics import encode
from uavctl.cli.ros2_process import Ros2Process
from uavctl.daemon.control_socket import make_socket_path
from uavctl.records import Estimate, Header

pytestmark = pytest.mark.filterwarnings("ignore:module 'sre_:DeprecationWarning")  # of a parser that rclpy imports
UTC_NS = 1_700_000_000 * 10**9


@pytest.fixture(scope="module")
def node() -> Iterator[Any]:
    with make_node() as made:
        yield made


@contextmanager
def daemon(folder: Path) -> Iterator[list[dict[str, Any]]]:
    """A daemon's control socket that accepts every order; gives the requests."""
    requests: list[dict[str, Any]] = []
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(make_socket_path(folder, "daemon")))
        listener.listen()
        listener.settimeout(0.05)
        is_over = threading.Event()

        def serve() -> None:
            while not is_over.is_set():
                try:
                    connection, _ = listener.accept()
                except TimeoutError:
                    continue
                with connection, connection.makefile("rw") as lines:
                    requests.append(json.loads(lines.readline()))
                    lines.write('{"ok": true, "text": "as ordered"}\n')

        thread = threading.Thread(target=serve)
        thread.start()
        try:
            yield requests
        finally:
            is_over.set()
            thread.join()


@contextmanager
def publishing(control: tuple[Path, str] | None) -> Iterator[Ros2Process]:
    """A node that gets a flight's records again and again, until the block ends."""
    deaths: list[str] = []
    process, is_over = Ros2Process("drone1", control, deaths.append), threading.Event()

    def send() -> None:
        while not is_over.is_set():
            for topic, at_ns, record in fly_view().entries:
                process.send(topic, UTC_NS + at_ns, encode(record))
                if is_over.wait(0.002):
                    return

    thread = threading.Thread(target=send)
    thread.start()
    try:
        yield process
    finally:
        is_over.set()
        thread.join()
        process.close()
    assert not deaths


def test_nodes_get_what_the_records_say(node: Any) -> None:
    poses, plans = subscribe(node, PoseStamped, "/drone1/pose"), subscribe(node, PathMessage, "/drone1/plan")
    limits = subscribe(node, MarkerArray, "/drone1/limits", LATCHED)
    diagnostics = subscribe(node, DiagnosticArray, "/diagnostics")
    (header,) = fly_view().of(Header)
    design = read_design(header)
    places = np.array([design.position_of(estimate.mean) for estimate in fly_view().of(Estimate)])
    with spinning(node), publishing(None):
        wait_until(lambda: len(poses) > 20 and bool(plans and limits and diagnostics), "it is published")
        assert ("/drone1/hold", ["std_srvs/srv/Trigger"]) not in node.get_service_names_and_types()
    for pose in poses:
        at = pose.pose.position
        assert np.abs(places - (at.y, at.x, -at.z)).sum(axis=1).min() < 1e-9
        assert pose.header.frame_id == "map" and pose.header.stamp.sec >= UTC_NS // 10**9
    assert {len(plan.poses) for plan in plans} == {design.horizon + 1}
    assert {len(marker.points) for message in limits for marker in message.markers} == {24}
    (status,) = diagnostics[-1].status
    assert status.hardware_id == "drone1" and status.level in (b"\0", b"\1", b"\2")
    assert {"mode", "reason"} <= {entry.key for entry in status.values}


def test_orders_of_nodes_reach_the_daemon(node: Any, tmp_path: Path) -> None:
    goals = node.create_publisher(PoseStamped, "/drone1/goto", 10)
    goal = PoseStamped()
    goal.header.frame_id = "map"
    goal.pose.position.x, goal.pose.position.y, goal.pose.position.z = 1.0, 2.0, 3.0
    with daemon(tmp_path) as requests, spinning(node), publishing((tmp_path, "daemon")):
        for name in ("hold", "resume", "land"):
            answer = call(node, f"/drone1/{name}")
            assert (answer.success, answer.message) == (True, "as ordered")
        assert [request["ask"] for request in requests] == ["hold", "resume", "land"]
        wait_until(lambda: goals.get_subscription_count() > 0, "it takes positions")
        (subscription,) = node.get_subscriptions_info_by_topic("/drone1/goto")
        assert subscription.qos_profile.reliability is ReliabilityPolicy.RELIABLE  # no order is lost on a poor network
        goals.publish(goal)
        wait_until(lambda: len(requests) > 3, "the position has come")
    assert requests[3] == {"ask": "goto", "position_m": [2.0, 1.0, -3.0]}
    node.destroy_publisher(goals)
