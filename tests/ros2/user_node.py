"""Program of a user: a node that publishes what simulated cameras see, and gives a flight the orders of its input.

`python user_node.py PORT POSE_TOPIC NAMESPACE`: an order is a line, as `hold` or `goto EAST NORTH UP`; its answer is a
line of JSON. With the end of the input it ends.
"""

from __future__ import annotations

import json
import socket
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from rclpy.qos import qos_profile_sensor_data
from std_srvs.srv import Trigger

SERVICES = ("hold", "resume", "land")
LIMIT_S = 60.0  # a busy machine may be slow


def make_pose(east_m: float, north_m: float, up_m: float) -> Any:
    """A position in frame `map`."""
    message = PoseStamped()
    message.header.frame_id = "map"
    message.pose.position.x, message.pose.position.y, message.pose.position.z = east_m, north_m, up_m
    return message


def drive(port: int, publisher: Any) -> None:
    """Publish each position that the cameras send to a port."""
    parser = mavlink.MAVLink(None)
    with socket.socket(type=socket.SOCK_DGRAM) as cameras:
        cameras.bind(("127.0.0.1", port))
        while True:
            for seen in parser.parse_buffer(cameras.recv(2048)) or ():
                message = make_pose(float(seen.y), float(seen.x), float(-seen.z))
                message.header.stamp.sec, message.header.stamp.nanosec = divmod(seen.usec * 1000, 10**9)
                publisher.publish(message)


class OrderClient:
    """The orders of a flight below a namespace."""

    def __init__(self, node: Any, namespace: str) -> None:
        self._node, self._namespace = node, namespace
        self._goals = node.create_publisher(PoseStamped, f"/{namespace}/goto", 10)
        self._clients = {name: node.create_client(Trigger, f"/{namespace}/{name}") for name in SERVICES}
        self._last_order = ""
        node.create_subscription(DiagnosticArray, "/diagnostics", self._note, 10)

    def give(self, line: str) -> tuple[bool, str]:
        """Give an order; return whether it is accepted, and the answer."""
        name, *place_m = line.split()
        if name == "goto":
            return self._go_to(*map(float, place_m))
        self._clients[name].wait_for_service(LIMIT_S)
        future = self._clients[name].call_async(Trigger.Request())
        rclpy.spin_until_future_complete(self._node, future, timeout_sec=LIMIT_S)
        answer = future.result()
        return (False, "no answer") if answer is None else (answer.success, answer.message)

    def _go_to(self, *place_m: float) -> tuple[bool, str]:
        self._spin_until(lambda: self._goals.get_subscription_count() > 0)
        self._last_order = ""
        self._goals.publish(make_pose(*place_m))
        self._spin_until(lambda: self._last_order.startswith("goto"))
        return self._last_order.startswith("goto accepted"), self._last_order

    def _spin_until(self, condition: Callable[[], bool]) -> None:
        end_s = time.monotonic() + LIMIT_S
        while not condition() and time.monotonic() < end_s:
            rclpy.spin_once(self._node, timeout_sec=0.1)

    def _note(self, message: Any) -> None:
        for status in message.status:
            for entry in status.values:
                if entry.key == "last order" and status.hardware_id == self._namespace:
                    self._last_order = entry.value


def main(port: str, topic: str, namespace: str) -> None:
    """Give the orders of standard input."""
    rclpy.init()
    node = rclpy.create_node("user")
    publisher = node.create_publisher(PoseStamped, topic, qos_profile_sensor_data)
    threading.Thread(target=drive, args=(int(port), publisher), daemon=True).start()
    orders = OrderClient(node, namespace)
    for line in sys.stdin:
        is_accepted, text = orders.give(line)
        sys.stdout.write(json.dumps({"ok": is_accepted, "text": text}) + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main(*sys.argv[1:])
