"""The process of a flight's node of ROS 2, with a node that is played: orders, and what the command line refuses."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
from ros2_messages import make_pose

from logs.live.feed import pack
from logs.live.ros2_view import DIAGNOSTICS, LIMITS, OUTPUTS, Ros2View
from logs.recording.topics import encode
from uavctl.cli.app import run
from uavctl.cli.ros2_host import FlightNode, Orders, resolve_name, serve_orders
from uavctl.cli.ros2_process import Ros2Process
from uavctl.daemon.control_socket import ControlRequest, Reply
from uavctl.errors import ExtraMissingError, NotReachedError, UsageError
from uavctl.io.ros2_node import Ros2Node


class PlayedNode:
    """A node that keeps what is published, and whose services the test calls."""

    def __init__(self) -> None:
        self.published: list[tuple[str, Mapping[str, Any]]] = []
        self.services: dict[str, Callable[[], tuple[bool, str]]] = {}
        self.receivers: dict[str, Callable[[Any], None]] = {}

    def advertise(self, kind: str, topic: str, *, is_latched: bool = False) -> Callable[[Mapping[str, Any]], None]:
        return lambda fields: self.published.append((topic, fields))

    def subscribe(self, kind: str, topic: str, receive: Callable[[Any], None], *, is_reliable: bool = False) -> None:
        self.receivers[topic] = receive

    def serve_trigger(self, kind: str, name: str, act: Callable[[], tuple[bool, str]]) -> None:
        self.services[name] = act


def make_orders(answer: Reply | Exception) -> tuple[PlayedNode, Ros2View, list[ControlRequest]]:
    """A node with orders, its view, and the requests that the daemon got."""
    node, view, requests = PlayedNode(), Ros2View("drone1"), list[ControlRequest]()

    def send(request: ControlRequest) -> Reply:
        requests.append(request)
        if isinstance(answer, Exception):
            raise answer
        return answer

    serve_orders(cast(Ros2Node, node), "drone1", Orders(view, send))
    return node, view, requests


def make_goal(frame: str, position: tuple[float, ...]) -> Any:
    return SimpleNamespace(header=SimpleNamespace(frame_id=frame), pose=make_pose(position, (0.0, 0.0, 0.0, 1.0)))


@pytest.mark.parametrize("name", ["hold", "land", "resume"])
def test_a_service_gives_its_order_and_returns_the_daemon_s_answer(name: str) -> None:
    node, view, requests = make_orders(Reply(ok=True, text="as ordered"))
    assert node.services[f"/drone1/{name}"]() == (True, "as ordered")
    assert [request.ask for request in requests] == [name]
    assert view.last_order == f"{name} accepted: as ordered"


def test_a_service_says_that_no_daemon_answers() -> None:
    node, view, _ = make_orders(NotReachedError("no daemon"))
    assert node.services["/drone1/hold"]() == (False, "no daemon")
    assert view.last_order == "hold refused: no daemon"


def test_goto_takes_a_position_in_east_north_up_and_no_other() -> None:
    node, view, requests = make_orders(Reply(ok=True, text=""))
    receive = node.receivers["/drone1/goto"]
    receive(make_goal("map", (1.0, 2.0, 3.0)))
    assert requests == [ControlRequest(ask="goto", position_m=(2.0, 1.0, -3.0))]
    for goal in (make_goal("odom", (1.0, 2.0, 3.0)), make_goal("map", (1.0, float("nan"), 3.0))):
        view.last_order = ""
        receive(goal)
        assert len(requests) == 1 and view.last_order.startswith("goto refused")


def test_messages_of_a_flight_are_published_below_the_namespace() -> None:
    from view_rig import fly_view

    node = PlayedNode()
    flight = FlightNode(cast(Ros2Node, node), "drone1")
    for topic, at_ns, record in fly_view().entries:
        flight.publish_message(pack(topic, at_ns, encode(record)))
    flight.publish_message(pack("/uavctl/unknown", 0, b"{}"))
    topics = [topic for topic, _ in node.published]
    assert set(topics) == {resolve_name("drone1", name) for name in OUTPUTS}
    assert topics.index("/drone1/limits") == 0 and {LIMITS, DIAGNOSTICS} < set(OUTPUTS)


def test_what_the_command_line_refuses_before_anything_flies(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["fly", "--ros2-orders"]) == 2
    assert "--ros2 NAMESPACE" in capsys.readouterr().err
    with pytest.raises(UsageError, match="no namespace"):
        Ros2Process("/drone 1", None, print)
    monkeypatch.setattr("uavctl.cli.ros2_process.find_spec", lambda name: None if name == "std_srvs" else name)
    with pytest.raises(ExtraMissingError) as caught:
        Ros2Process("drone1", (Path(), "daemon"), print)
    assert (caught.value.package, caught.value.extra) == ("std_srvs", "ros2")
