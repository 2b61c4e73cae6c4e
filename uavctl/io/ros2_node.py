"""Node of ROS 2, by `rclpy`: what our processes use of it. ROS is imported when a node is opened, not before.

Domain, discovery and middleware come from the environment, as for every node (ROS_DOMAIN_ID and others).
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from importlib import import_module
from typing import Any

from uavctl.errors import in_words
from uavctl.io.camera import CameraError
from uavctl.io.ros2_pose import Publisher

EXTRA = "ros2"
_RELIABLE_DEPTH = 10  # messages that wait; a number alone is a reliable subscription
# Logs go nowhere: nobody reads the console of a process, and a file of each start would stay behind.
_INIT_ARGUMENTS = ["--ros-args", "--disable-external-lib-logs", "--disable-rosout-logs", "--disable-stdout-logs"]


class Ros2Node:
    """A node and the executor that calls it back."""

    def __init__(self, node: Any, executor: Any, sensor_qos: Any) -> None:
        self._node, self._executor, self._sensor_qos = node, executor, sensor_qos

    def spin(self, timeout_s: float) -> None:
        """Handle one message or request that has come, or wait for it."""
        self._executor.spin_once(timeout_sec=timeout_s)

    def subscribe(self, kind: str, topic: str, receive: Callable[[Any], None], *, is_reliable: bool = False) -> None:
        """Subscribe, by default best-effort with a short queue, as for sensor data.

        Args:
            kind: Type of the messages, as `geometry_msgs/msg/PoseStamped`.
            is_reliable: Whether a lost message is sent again, and one waits that is sent before the writer is known.
        """
        qos = _RELIABLE_DEPTH if is_reliable else self._sensor_qos
        self._node.create_subscription(import_type(kind), topic, receive, qos)

    def subscribe_with_gid(self, kind: str, topic: str, receive: Callable[[Any, bytes], None]) -> None:
        """Subscribe best-effort; a message comes with the identifier of its publisher, empty if that is not known.

        Args:
            kind: Type of the messages.
        """

        def take(message: Any, info: Mapping[str, Any]) -> None:
            gid = info.get("publisher_gid")  # no rclpy before 9.1 gives one
            receive(message, bytes(gid["data"]) if gid else b"")

        self._node.create_subscription(import_type(kind), topic, take, self._sensor_qos)

    def advertise(self, kind: str, topic: str, *, is_latched: bool = False) -> Callable[[Mapping[str, Any]], None]:
        """Offer a topic; return the function that publishes a message by its fields.

        Args:
            is_latched: Whether who subscribes later gets the newest message.
        """
        from rclpy.qos import DurabilityPolicy, QoSProfile

        message_type = import_type(kind)
        durability = DurabilityPolicy.TRANSIENT_LOCAL if is_latched else DurabilityPolicy.VOLATILE
        publisher = self._node.create_publisher(message_type, topic, QoSProfile(depth=1, durability=durability))
        return lambda fields: publisher.publish(make_message(message_type, fields))

    def serve_trigger(self, kind: str, name: str, act: Callable[[], tuple[bool, str]]) -> None:
        """Offer a service without arguments.

        Args:
            kind: `std_srvs/srv/Trigger`.
            act: Returns success, and text for the caller.
        """

        def answer(request: Any, response: Any) -> Any:
            del request
            response.success, response.message = act()
            return response

        self._node.create_service(import_type(kind), name, answer)

    def list_publishers(self, topic: str) -> list[Publisher]:
        """Return the publishers of a topic."""
        return [
            Publisher(
                f"{publisher.node_namespace.rstrip('/')}/{publisher.node_name}",
                publisher.topic_type,
                bytes(publisher.endpoint_gid),
            )
            for publisher in self._node.get_publishers_info_by_topic(topic)
        ]

    def list_topics(self) -> list[tuple[str, list[str]]]:
        """Return the name and the types of each topic."""
        return list(self._node.get_topic_names_and_types())


def import_type(name: str) -> Any:
    """Import the type of a message or a service, as `geometry_msgs/msg/PoseStamped`."""
    package, folder, kind = name.split("/")
    return getattr(import_module(f"{package}.{folder}"), kind)


def load_types(names: Iterable[str]) -> None:
    """Import types of messages and services with all that a node needs of them."""
    from rclpy.type_support import check_for_type_support

    for name in names:
        check_for_type_support(import_type(name))


def make_message(kind: Any, fields: Mapping[str, Any]) -> Any:
    """Make a message of a mapping of its fields; others keep their defaults.

    Args:
        kind: Class of the message.
    """
    message = kind()
    for name, value in fields.items():
        current = getattr(message, name)
        if isinstance(value, Mapping):
            value = make_message(type(current), value)
        elif isinstance(current, bytes):  # the type `byte` of ROS
            value = bytes([value])
        elif isinstance(value, list) and value and isinstance(value[0], Mapping):
            package, _, part = (
                kind.get_fields_and_field_types()[name].removeprefix("sequence<").rstrip(">").partition("/")
            )
            value = [make_message(import_type(f"{package}/msg/{part}"), entry) for entry in value]
        setattr(message, name, value)
    return message


@contextmanager
def open_node(name: str) -> Iterator[Ros2Node]:
    """Open a node of this process.

    Args:
        name: Name of the node, before the number of the process.

    Raises:
        CameraError: ROS 2 cannot be started.
    """
    try:
        import rclpy
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.qos import qos_profile_sensor_data
        from rclpy.signals import SignalHandlerOptions

        rclpy.init(args=_INIT_ARGUMENTS, signal_handler_options=SignalHandlerOptions.NO)
        node = rclpy.create_node(f"{name}_{os.getpid()}", enable_rosout=False, start_parameter_services=False)
        executor = SingleThreadedExecutor()
        executor.add_node(node)
    except Exception as error:
        raise CameraError(
            f"ROS 2 cannot be started ({in_words(error)}); see RMW_IMPLEMENTATION and ROS_DOMAIN_ID, or "
            f"pip install 'uavctl[{EXTRA}]'"
        ) from error
    try:
        yield Ros2Node(node, executor, qos_profile_sensor_data)
    finally:
        rclpy.shutdown()
