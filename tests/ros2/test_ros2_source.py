"""A topic of real nodes over localhost as the source of positions."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from typing import Any

import pytest
import rclpy
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import Odometry
from node_rig import make_node, published
from patience import LIMIT_S, wait_until
from rclpy.duration import Duration
from rclpy.qos import qos_profile_sensor_data
from rosgraph_msgs.msg import Clock

from uavctl.config import load_config
from uavctl.errors import ConnectionSpecError
from uavctl.io.base import Connection
from uavctl.io.ros2_host import NO_PUBLISHER, SEVERAL_PUBLISHERS
from uavctl.io.sources import open_source
from uavctl.mavlink.codec import decode
from uavctl.mavlink.encoder import Encoder
from uavctl.mavlink.messages import Position, TimeSync
from uavctl.mavlink.positions import PositionDecoder

pytestmark = pytest.mark.filterwarnings("ignore:module 'sre_:DeprecationWarning")  # of a parser that rclpy imports
TOPIC = "/drone/pose"


@pytest.fixture(scope="module")
def node() -> Iterator[Any]:
    with make_node() as made:
        yield made


def make_message(kind: Any, stamp: Any) -> Any:
    """A pose at east 1, north 2, up 3 m, heading east."""
    message = kind()
    message.header.stamp, message.header.frame_id = stamp, "map"
    place = {"x": 1.0, "y": 2.0, "z": 3.0}
    if kind is TransformStamped:
        target, message.child_frame_id = message.transform.translation, "drone"
    else:
        target = message.pose.position if kind is PoseStamped else message.pose.pose.position
    for axis, value in place.items():
        setattr(target, axis, value)
    return message


def poses_of(node: Any, kind: Any) -> Callable[[], Any]:
    return lambda: make_message(kind, node.get_clock().now().to_msg())


def receive(connection: Connection, kind: type, count: int = 1) -> list[tuple[Any, int]]:
    """The next messages of a kind, each with the time of its arrival [ns]."""
    found: list[tuple[Any, int]] = []

    def look() -> bool:
        found.extend(
            (message, at_ns)
            for data, at_ns in connection.receive()
            for message in decode(data).messages
            if isinstance(message, kind)
        )
        return len(found) >= count

    wait_until(look, f"{count} {kind.__name__}", pause_s=0.001)
    return found


@pytest.mark.parametrize("kind", [PoseStamped, PoseWithCovarianceStamped, Odometry, TransformStamped])
@pytest.mark.parametrize("qos", [qos_profile_sensor_data, 10], ids=["best-effort", "reliable"])
def test_each_type_comes_as_a_position_in_ned(node: Any, kind: Any, qos: Any) -> None:
    with (
        published(node, TOPIC, kind, poses_of(node, kind), qos),
        closing(open_source("ros2://drone/pose?frame=map")) as connection,
    ):
        before_us = time.time_ns() // 1000 - int(LIMIT_S * 1e6)
        found = receive(connection, Position, 20)
    stamps = [position.stamp_us for position, _ in found]
    assert stamps == sorted(set(stamps)) and before_us < stamps[0] <= stamps[-1] <= time.time_ns() // 1000
    for position, _ in found:
        assert position.position_m == pytest.approx((2.0, 1.0, -3.0))
        assert position.attitude is not None
        assert [abs(value) for value in position.attitude] == pytest.approx([0.5**0.5, 0.0, 0.0, 0.5**0.5])


def ask_time(connection: Connection) -> tuple[TimeSync, int, int]:
    """The answer to a time request, and our times around it [ns]."""
    sent_ns = time.monotonic_ns()
    connection.send(Encoder(245, 25).encode_timesync(0, sent_ns))
    answer, received_ns = receive(connection, TimeSync)[0]
    assert answer.ts1_ns == sent_ns
    return answer, sent_ns, received_ns


def test_the_system_s_time_is_answered_where_the_stamps_are_of_it(node: Any) -> None:
    with (
        published(node, TOPIC, PoseStamped, poses_of(node, PoseStamped)),
        closing(open_source("ros2://drone/pose?clock=system")) as connection,
    ):
        begin_ns = time.time_ns()
        answer, _, _ = ask_time(connection)
        assert begin_ns <= answer.tc1_ns <= time.time_ns()


def test_the_whole_delay_is_measured_where_the_clock_is_known(node: Any) -> None:
    """A driver whose stamps are 0.2 s old: without its clock, a constant delay is not seen."""
    delay = Duration(nanoseconds=200_000_000)
    config = load_config("room")

    def make() -> Any:
        return make_message(PoseStamped, (node.get_clock().now() - delay).to_msg())

    with published(node, TOPIC, PoseStamped, make):
        for url, is_known in (("ros2://drone/pose?clock=system", True), ("ros2://drone/pose", False)):
            decoder = PositionDecoder(config.frame, config.clock, config.source, config.estimator, lambda _: None)
            with closing(open_source(url)) as connection:
                round_trip_ns = 0
                if is_known:
                    answer, sent_ns, received_ns = ask_time(connection)
                    decoder.add_timesync_answer((246, 197), sent_ns, answer.tc1_ns, received_ns)
                    round_trip_ns = received_ns - sent_ns
                samples = [decoder.make_sample(*arrived) for arrived in receive(connection, Position, 20)]
            ages_ns = [sample.received_ns - sample.captured_ns for sample in samples if sample is not None]
            assert len(ages_ns) >= 10
            if is_known:
                assert min(ages_ns) >= delay.nanoseconds - round_trip_ns // 2
            else:
                assert min(ages_ns) == pytest.approx(config.clock.latency_s * 1e9, abs=1e3)


def test_stamps_of_a_simulation_are_put_into_our_time_by_its_clock(node: Any) -> None:
    begin_ns = time.monotonic_ns()

    def simulated() -> Any:
        return rclpy.time.Time(nanoseconds=1 + time.monotonic_ns() - begin_ns).to_msg()

    with (
        published(node, "/clock", Clock, lambda: Clock(clock=simulated())),
        published(node, TOPIC, PoseStamped, lambda: make_message(PoseStamped, simulated())),
        closing(open_source("ros2://drone/pose?clock=sim")) as connection,
    ):
        answer, sent_ns, received_ns = ask_time(connection)
        # The clock was read between request and answer, or just before: a message may have been on its way.
        assert sent_ns - 1e9 < begin_ns + answer.tc1_ns <= received_ns
        position, at_ns = receive(connection, Position)[0]
        assert 0 < begin_ns + position.stamp_us * 1000 <= at_ns


def test_topics_that_cannot_be_used_are_errors_with_their_reason(node: Any) -> None:
    with published(node, "/other/pose", PoseStamped, poses_of(node, PoseStamped)):
        with pytest.raises(ConnectionSpecError, match=r"no publisher of /drone/pose within .*: /other/pose"):
            open_source("ros2://drone/pose")
        with pytest.raises(ConnectionSpecError, match="in frame 'map', not 'world'"):
            open_source("ros2://other/pose?frame=world")
    with (
        published(node, "/drone/clock", Clock, Clock),
        pytest.raises(ConnectionSpecError, match="has rosgraph_msgs/msg/Clock"),
    ):
        open_source("ros2://drone/clock")
    with (
        published(node, TOPIC, PoseStamped, poses_of(node, PoseStamped)),
        published(node, TOPIC, PoseStamped, poses_of(node, PoseStamped)),
        pytest.raises(ConnectionSpecError, match="2 publishers"),
    ):
        open_source("ros2://drone/pose")


def test_a_driver_that_starts_again_is_heard_again(node: Any) -> None:
    with closing(start_source(node)) as connection:
        receive(connection, Position)
        wait_until(lambda: not connection.receive() and connection.refused[NO_PUBLISHER] > 0, "nobody publishes")
        with published(node, TOPIC, PoseStamped, poses_of(node, PoseStamped)):
            receive(connection, Position)
        assert not connection.closed


@pytest.mark.fault(106)
def test_106_of_two_real_publishers_the_first_counts_until_it_ends(node: Any) -> None:
    def make_other() -> Any:
        message = make_message(PoseStamped, node.get_clock().now().to_msg())
        message.pose.position.x = 9.0
        return message

    other, found = rclpy.create_node("player", namespace="bag"), list[Position]()

    def look(connection: Connection, condition: Callable[[], bool]) -> bool:
        found.extend(position for position, _ in receive(connection, Position))
        return condition()

    with ExitStack() as driver:
        driver.enter_context(published(node, TOPIC, PoseStamped, poses_of(node, PoseStamped)))
        with (
            closing(open_source("ros2://drone/pose?frame=map")) as connection,
            published(other, TOPIC, PoseStamped, make_other),
        ):
            wait_until(lambda: look(connection, lambda: connection.refused[SEVERAL_PUBLISHERS] > 20), "it is refused")
            assert {position.position_m[1] for position in found} == {1.0}
            (reason,) = [reason for reason in connection.refused if ": " in reason]
            assert reason.index("/driver") < reason.index("/bag/player")  # the one that is used comes first
            driver.close()
            wait_until(lambda: look(connection, lambda: found[-1].position_m[1] == 9.0), "the other takes its place")
    other.destroy_node()


def start_source(node: Any) -> Connection:
    """A source whose driver has just ended."""
    with published(node, TOPIC, PoseStamped, poses_of(node, PoseStamped)):
        return open_source("ros2://drone/pose")
