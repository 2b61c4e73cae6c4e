"""A node that publishes, subscribes and calls services."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import rclpy
from patience import LIMIT_S, wait_until
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from std_srvs.srv import Trigger

PERIOD_S = 0.01
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


@contextmanager
def own_domain() -> Iterator[None]:
    """A domain of the tests' own on this machine, for child processes too."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        patch.setenv("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
        yield


@contextmanager
def make_node() -> Iterator[Any]:
    """A node of the tests' own process, in a domain of its own."""
    with own_domain():
        rclpy.init(args=["--ros-args", "--disable-external-lib-logs"])
        yield rclpy.create_node("driver")
        rclpy.shutdown()


@contextmanager
def published(
    node: Any, topic: str, kind: Any, make: Callable[[], Any], qos: Any = qos_profile_sensor_data
) -> Iterator[None]:
    """Publish a message again and again, in a thread of its own."""
    publisher, is_over = node.create_publisher(kind, topic, qos), threading.Event()

    def publish() -> None:
        while not is_over.wait(PERIOD_S):
            publisher.publish(make())

    thread = threading.Thread(target=publish)
    thread.start()
    try:
        yield
    finally:
        is_over.set()
        thread.join()
        node.destroy_publisher(publisher)


@contextmanager
def spinning(node: Any) -> Iterator[None]:
    """Call the node back in a thread of its own."""
    executor, is_over = SingleThreadedExecutor(), threading.Event()
    executor.add_node(node)

    def spin() -> None:
        while not is_over.is_set():
            executor.spin_once(timeout_sec=0.05)

    thread = threading.Thread(target=spin)
    thread.start()
    try:
        yield
    finally:
        is_over.set()
        thread.join()
        executor.remove_node(node)


def call(node: Any, name: str) -> Any:
    """The answer of a service."""
    client = node.create_client(Trigger, name)
    assert client.wait_for_service(LIMIT_S)
    future = client.call_async(Trigger.Request())
    wait_until(future.done, name)
    return future.result()


def subscribe(node: Any, kind: Any, topic: str, qos: Any = 10) -> list[Any]:
    """The messages of a topic."""
    messages: list[Any] = []
    node.create_subscription(kind, topic, messages.append, qos)
    return messages
