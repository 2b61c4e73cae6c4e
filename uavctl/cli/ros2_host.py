"""Process of a flight's node of ROS 2.

The flight starts it as `python -m uavctl.cli.ros2_host FEED NAMESPACE [FOLDER NAME]`.

1. Take the flight's messages from FEED, the number of a socket, and publish what `logs.live.ros2_view` makes of them.
2. Pass orders on to the control socket of daemon NAME in FOLDER, if these are given.
3. End when the flight has closed its end, or has died.
"""

from __future__ import annotations

import os
import socket
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, Literal

from logs.live.feed import LARGEST, unpack
from logs.live.ros2_view import ENU, FRAME, OUTPUTS, Fields, Ros2View
from logs.recording.topics import decode, is_view
from uavctl.cli.ctl import send_request
from uavctl.cli.ros2_process import TRIGGER
from uavctl.daemon.control_socket import ControlRequest, Reply
from uavctl.errors import RecordingError, UavctlError
from uavctl.io.camera import CameraError
from uavctl.io.ros2_node import Ros2Node, load_types, open_node

GOTO_KIND = "geometry_msgs/msg/PoseStamped"
ServiceName = Literal["hold", "land", "resume"]
SERVICES: tuple[ServiceName, ...] = ("hold", "land", "resume")
Send = Callable[[ControlRequest], Reply]
_NICENESS = 10  # the flight comes first; lower, orders would not come through on a busy computer
_OOM_SCORE = Path("/proc/self/oom_score_adj")
_POLL_S = 0.1


class Orders:
    """Orders of other nodes to the daemon; the newest answer goes into the view's diagnostics.

    Args:
        send: Sends a request to the daemon, and returns its answer.
    """

    def __init__(self, view: Ros2View, send: Send) -> None:
        self._view, self._send = view, send

    def give(self, request: ControlRequest) -> tuple[bool, str]:
        """Send an order; return whether it was accepted, and the answer in words."""
        try:
            reply = self._send(request)
        except UavctlError as error:
            reply = Reply(ok=False, text=str(error))
        self._view.last_order = f"{request.ask} {'accepted' if reply.ok else 'refused'}: {reply.text}"
        return reply.ok, reply.text

    def go_to(self, message: Any) -> None:
        """Order a flight to the position of a PoseStamped; its attitude does not count."""
        frame, position = message.header.frame_id, message.pose.position
        if frame != FRAME:
            self._view.last_order = f"goto refused: its frame is {frame!r}; give the position in {FRAME!r}"
            return
        place = ENU.to_ned((position.x, position.y, position.z))
        request = ControlRequest(ask="goto", position_m=place)
        problem = request.find_problem()
        if problem:
            self._view.last_order = f"goto refused: {problem}"
        else:
            self.give(request)


class FlightNode:
    """Publishes a flight.

    Args:
        node: Our node.
        namespace: Of the outputs.
    """

    def __init__(self, node: Ros2Node, namespace: str) -> None:
        self.view = Ros2View(namespace)
        self._publish: dict[str, Callable[[Fields], None]] = {
            name: node.advertise(output.kind, resolve_name(namespace, name), is_latched=output.is_latched)
            for name, output in OUTPUTS.items()
        }

    def publish_message(self, datagram: bytes) -> None:
        """Publish what follows from a message of the flight."""
        topic, utc_ns, data = unpack(datagram)
        if is_view(topic):
            return
        with suppress(RecordingError):
            for name, fields in self.view.make_messages(decode(topic, data, utc_ns), utc_ns):
                self._publish[name](fields)

    def run(self, feed: socket.socket, on_end: Callable[[], None]) -> None:
        """Publish until the flight has gone."""
        buffer = bytearray(LARGEST)
        try:
            while size := feed.recv_into(buffer):
                self.publish_message(bytes(memoryview(buffer)[:size]))
        except OSError:
            pass  # the flight has gone
        finally:
            on_end()


def resolve_name(namespace: str, name: str) -> str:
    """Return the absolute name of a topic or a service."""
    return name if name.startswith("/") else f"/{namespace}/{name}"


def serve_orders(node: Ros2Node, namespace: str, orders: Orders) -> None:
    """Offer the services and the topic of orders."""
    for name in SERVICES:
        request = ControlRequest(ask=name)
        node.serve_trigger(TRIGGER, resolve_name(namespace, name), partial(orders.give, request))
    node.subscribe(GOTO_KIND, resolve_name(namespace, "goto"), orders.go_to, is_reliable=True)


def main(arguments: list[str]) -> int:
    """Publish for the flight that started this process."""
    number, namespace, *control = arguments
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))  # never beside the control loop of a --realtime daemon
    load_types([GOTO_KIND, TRIGGER, *(output.kind for output in OUTPUTS.values())])  # takes seconds at low priority
    os.nice(_NICENESS)
    with suppress(OSError):  # not every container permits it
        _OOM_SCORE.write_text("1000")  # a computer without memory ends this process first
    has_ended = threading.Event()
    try:
        with socket.socket(fileno=int(number)) as feed, open_node("uavctl_flight") as node:
            flight = FlightNode(node, namespace)
            if control:
                folder, name = control
                send = partial(send_request, folder=Path(folder), vehicle=name)
                serve_orders(node, namespace, Orders(flight.view, send))
            threading.Thread(target=flight.run, args=(feed, has_ended.set), name="feed", daemon=True).start()
            while not has_ended.is_set():
                node.spin(_POLL_S)
    except CameraError as error:
        sys.stderr.write(f"{error}\n")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
