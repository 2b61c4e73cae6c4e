"""Several bodies over one connection: servers on loopback, one process, and to whom each position belongs."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest
from natnet_server import UPTIME_S, Body, Server
from patience import wait_until
from qtm_server import QtmBody, QtmServer

from uavctl.config.connections import CAMERA_SYSTEM_ID
from uavctl.errors import ConnectionSpecError
from uavctl.io.base import Connection
from uavctl.io.camera_host import COMPONENT_ID
from uavctl.io.shared_sources import find_shared_sources, split_source_url
from uavctl.io.sources import open_bodies
from uavctl.mavlink.codec import decode
from uavctl.mavlink.encoder import Encoder
from uavctl.mavlink.messages import Position, TimeSync
from uavctl.records import Vec3

NAMES = ("drone 1", "drone 2", "drone 3", "drone 4")
PLACES: tuple[Vec3, ...] = ((1.0, 1.5, 2.0), (-1.0, 1.5, 2.5), (0.25, 0.5, -2.0), (3.0, 2.0, 1.0))
CONNECT = 0


def make_urls(scheme: str, port: int, count: int) -> list[str]:
    return [f"{scheme}://127.0.0.1:{port}/{name.replace(' ', '%20')}" for name in NAMES[:count]]


def count_children() -> int:
    return len(Path(f"/proc/{os.getpid()}/task/{os.getpid()}/children").read_text().split())


def read_places(connection: Connection, done: Callable[[dict[int, Vec3]], bool]) -> dict[int, Vec3]:
    """Newest position by the component of its sender."""
    places: dict[int, Vec3] = {}

    def read() -> bool:
        for data, _ in connection.receive():
            for message in decode(data).messages:
                if isinstance(message, Position):
                    assert message.system == CAMERA_SYSTEM_ID
                    places[message.component] = message.position_m
        return done(places)

    wait_until(read, "the positions that are waited for")
    return places


@pytest.mark.parametrize("count", [2, 4])
def test_bodies_of_optitrack_come_over_one_connection_with_one_clock(count: int) -> None:
    bodies = [Body(20 - i, name, place) for i, (name, place) in enumerate(zip(NAMES, PLACES, strict=True))]
    with Server(bodies) as server:
        (source,) = find_shared_sources(make_urls("natnet", server.port, count))
        children = count_children()
        with closing(open_bodies(source.urls)) as connection:
            assert count_children() == children + 1
            places = read_places(connection, lambda places: len(places) == count)
            connection.send(Encoder(245, 25).encode_timesync(0, 77))
            answers: dict[int, TimeSync] = {}

            def hear() -> bool:
                for data, _ in connection.receive():
                    for message in decode(data).messages:
                        if isinstance(message, TimeSync):
                            answers[message.component] = message
                return len(answers) == count

            wait_until(hear, "an answer for each body")
        assert (server.heard.count(CONNECT), server.echo_answers) == (1, 1)
    for number in range(count):
        forward, up, right = PLACES[number]  # Y is up
        assert places[source.addresses[number][1]] == pytest.approx((forward, right, -up))
    for message in answers.values():
        assert message.ts1_ns == 77
        assert message.tc1_ns == pytest.approx(time.monotonic_ns() + UPTIME_S * 1e9, abs=1e9)


@pytest.mark.parametrize("count", [2, 4])
def test_bodies_of_qualisys_come_over_one_connection(count: int) -> None:
    bodies = [QtmBody(name, place) for name, place in zip(NAMES, PLACES, strict=True)]
    with QtmServer(bodies[::-1]) as server:
        (source,) = find_shared_sources(make_urls("qualisys", server.port, count))
        with closing(open_bodies(source.urls)) as connection:
            read_places(connection, lambda places: len(places) == count)
            server.hang_up()
            wait_until(lambda: server.connections == 2, "one connection again")
            wait_until(lambda: server.heard.count("StreamFrames AllFrames 6D") == 2, "its stream is asked for again")
            places = read_places(connection, lambda places: len(places) == count)
        assert server.connections == 2
        assert sum(command.startswith("StreamFrames") for command in server.heard) == 2
    for number in range(count):
        forward, left, up = PLACES[number]
        assert places[COMPONENT_ID + number] == pytest.approx((forward, -left, -up))


def test_a_body_that_is_not_tracked_is_named_and_the_others_go_on() -> None:
    bodies = [Body(i, name, place) for i, (name, place) in enumerate(zip(NAMES[:2], PLACES[:2], strict=True))]
    with Server(bodies) as server, closing(open_bodies(make_urls("natnet", server.port, 2))) as connection:
        read_places(connection, lambda places: len(places) == 2)
        bodies[0].tracked = False
        read_places(connection, lambda _: connection.refused[f"{NAMES[0]}: untracked"] > 10)
        after = read_places(connection, lambda places: COMPONENT_ID + 1 in places)
        assert COMPONENT_ID not in after
        assert f"{NAMES[1]}: untracked" not in connection.refused


def test_a_body_that_is_not_there_is_named() -> None:
    with (
        Server([Body(1, NAMES[0]), Body(2, NAMES[1])]) as server,
        pytest.raises(ConnectionSpecError, match="no rigid body 'drone 3'; it has: 'drone 1', 'drone 2'"),
    ):
        open_bodies(make_urls("natnet", server.port, 3))
    with (
        QtmServer([QtmBody(NAMES[0])]) as qtm,
        pytest.raises(ConnectionSpecError, match="no rigid body 'drone 2'; it has: 'drone 1'"),
    ):
        open_bodies(make_urls("qualisys", qtm.port, 2))


def test_any_class_serves_several_bodies(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "many.py").write_text(
        "from collections import Counter\n"
        "from uavctl.io.camera import BodyPose\n"
        "class Many:\n"
        "    ready, awaits, group = False, 'answer', None\n"
        "    def __init__(self, body, up):\n"
        "        self.body, self.dropped = body, Counter()\n"
        "    def receive(self, data, at_ns):\n"
        "        self.ready = True\n"
        "        return (BodyPose(at_ns, (float(self.body), 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)),)\n"
        "    def due(self, at_ns):\n"
        "        return (b'hello',)\n"
        "    def ask_time(self, token):\n"
        "        return b'time'\n"
    )
    monkeypatch.chdir(tmp_path)
    with Server([]) as server:
        server.bodies, server._answer = [], lambda data, sender: server._socket.sendto(b"x", sender)  # type: ignore[method-assign, assignment]
        urls = [f"many:Many://127.0.0.1:{server.port}/{number}" for number in (7, 9)]
        assert len(find_shared_sources(urls)) == 1
        with closing(open_bodies(urls)) as connection:
            places = read_places(connection, lambda places: len(places) == 2)
    assert [places[COMPONENT_ID + i][0] for i in range(2)] == [7.0, 9.0]


def test_one_port_of_mavlink_has_a_body_for_each_system_id() -> None:
    urls = ["udpin://0.0.0.0:14660/11", "udpin://0.0.0.0:14661", "udpin://0.0.0.0:14660/12"]
    first, second = find_shared_sources(urls)
    assert (first.url, first.addresses) == ("udpin://0.0.0.0:14660", {0: (11, 0), 2: (12, 0)})
    assert (second.url, second.addresses) == ("udpin://0.0.0.0:14661", {1: (0, 0)})
    assert split_source_url("serial:///dev/ttyUSB0:921600/3") == ("serial:///dev/ttyUSB0:921600", "3")
    assert split_source_url("serial:///dev/ttyUSB0:921600") == ("serial:///dev/ttyUSB0:921600", "")


@pytest.mark.parametrize("body", ["0", "256", "drone", "", "1/2", "-1"])
def test_a_body_of_mavlink_that_is_no_system_id_is_refused(body: str) -> None:
    with pytest.raises(ConnectionSpecError, match="is no MAVLink system id"):
        split_source_url(f"udpin://0.0.0.0:14660/{body}")


def test_other_servers_axes_or_interfaces_are_other_connections() -> None:
    urls = [
        "natnet://10.0.0.5/a",
        "natnet://10.0.0.5:1510/b",
        "natnet://10.0.0.5/c?up=z",
        "natnet://10.0.0.6/d",
        "qualisys://10.0.0.5/e",
    ]
    sources = find_shared_sources(urls)
    assert [list(source.addresses) for source in sources] == [[0, 1], [2], [3], [4]]
