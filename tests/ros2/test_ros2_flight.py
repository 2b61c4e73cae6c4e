"""`uavctl fly --mocap ros2://...` with a real node over localhost, which publishes what the simulated cameras see."""

from __future__ import annotations

import signal
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped
from node_rig import make_node
from numpy.typing import NDArray
from operation_rig import Scene, end_process, open_scene
from patience import LIMIT_S, wait_until
from rclpy.qos import qos_profile_sensor_data
from sim_rig import decode

from logs.recording.reader import read_kind
from uavctl.records import PositionSample, StepInput

pytestmark = pytest.mark.filterwarnings("ignore:module 'sre_:DeprecationWarning")  # of a parser that rclpy imports
SAMPLES, NEAR_M = 20, 0.1


@pytest.fixture(scope="module")
def node() -> Iterator[Any]:
    with make_node() as made:
        yield made


@contextmanager
def seen_by_a_driver(air: Scene, node: Any) -> Iterator[None]:
    """A driver that publishes what the simulated cameras see; the daemon's positions are its topic."""
    publisher, is_over = node.create_publisher(PoseStamped, "/drone/pose", qos_profile_sensor_data), threading.Event()
    where = urlsplit(air.mocap)
    with socket.socket(type=socket.SOCK_DGRAM) as cameras:
        cameras.bind((where.hostname, where.port))
        cameras.settimeout(0.05)

        def publish() -> None:
            while not is_over.is_set():
                try:
                    (seen,) = decode(cameras.recv(2048))
                except TimeoutError:
                    continue
                message = PoseStamped()
                message.header.frame_id = "map"
                message.header.stamp.sec, message.header.stamp.nanosec = divmod(seen.usec * 1000, 10**9)
                position = message.pose.position
                position.x, position.y, position.z = float(seen.y), float(seen.x), float(-seen.z)
                publisher.publish(message)

        thread = threading.Thread(target=publish)
        thread.start()
        air.mocap = "ros2://drone/pose?frame=map"
        try:
            yield
        finally:
            is_over.set()
            thread.join()
            node.destroy_publisher(publisher)


def off_m(place: NDArray[np.float64], way: NDArray[np.float64]) -> float:
    """Distance of a place (3,) from the nearest of the straight lines through successive places (n, 3) [m]."""
    begin, step = way[:-1], np.diff(way, axis=0)
    length2 = np.maximum(np.sum(step**2, axis=1), 1e-12)
    part = np.clip(np.sum((place - begin) * step, axis=1) / length2, 0.0, 1.0)
    return float(np.linalg.norm(begin + part[:, None] * step - place, axis=1).min())


def test_a_daemon_s_positions_are_where_the_true_vehicle_went(node: Any) -> None:
    overrides = ("sim.camera.rate_hz=60.0", "link.loss=0.0", "link.delay_s=0.0", "link.jitter_s=0.0")
    with open_scene(*overrides) as air, seen_by_a_driver(air, node), end_process(air.fly("f")) as process:
        recording = air.folder / "f" / "flight.mcap"

        def list_samples() -> list[PositionSample]:
            return [sample for step in read_kind(recording, StepInput) for sample in step.samples]

        wait_until(recording.exists, "it records")
        wait_until(lambda: len(list_samples()) > SAMPLES, "positions come")
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=LIMIT_S)
        samples, way = list_samples(), np.array([truth.position_m for truth in air.truths])
    assert {sample.source for sample in samples} == {"ODOMETRY 246/197"}
    assert max(off_m(np.array(sample.position_m), way) for sample in samples) < NEAR_M
