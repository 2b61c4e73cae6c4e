"""Live page of a fleet: it shows what each daemon's own live view shows, marks what is old, and refuses other sites."""

from __future__ import annotations

import json
import socket
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import msgspec
import pytest
from live_rig import ask, make_head
from patience import wait_until

from logs.live.client import SceneReader
from logs.live.feed import SCENE
from logs.live.process import LiveProcess
from logs.live.scene import Level, LiveScene, SceneBody, SceneBox, SceneEvent
from uavctl.cli.fleet_view import (
    MAX_SILENCE_S,
    ShownState,
    ShownVehicle,
    choose_ports,
    make_fleet_scene,
    show_fleet_page,
)
from uavctl.daemon.health import Health, RecorderHealth, VehicleHealth
from uavctl.errors import UsageError
from uavctl.records import ControlMode, Vec3

BOX = SceneBox((-3.0, -2.0, None), (3.0, 2.0, 0.0))
PLAN: tuple[Vec3, ...] = ((0.0, 0.0, -1.0), (0.5, 0.1, -1.1))


def make_scene(place_m: Vec3, time_s: float = 5.0, level: Level = "good", *events: SceneEvent) -> LiveScene:
    return LiveScene(
        title="uavctl: room",
        time_s=time_s,
        headline="track: newest position 0.05 s old",
        level=level,
        bodies=(SceneBody("estimate", place_m), SceneBody("truth", (9.0, 9.0, 9.0))),
        plan=PLAN,
        target_m=(1.0, 1.0, -1.0),
        box=BOX,
        age_s=0.05,
        events=events,
    )


def make_health(**changes: object) -> Health:
    vehicle = VehicleHealth(
        autopilot="px4", mode="OFFBOARD", armed=True, external=True, landed=False, battery_v=15.2, heard_s=0.1
    )
    health = Health(
        name="one",
        url="udpin://127.0.0.1:1",
        pid=1,
        running_s=5.0,
        mode=ControlMode.TRACK,
        reason="",
        age_s=0.31,
        age_steps=1,
        position_m={"north": 7.0, "east": 8.0, "down": -9.0},
        velocity_mps=None,
        target_m=None,
        waypoint=None,
        loss=0.25,
        lateness_us=0.0,
        missed_ticks=0,
        vehicle=vehicle,
        recorder=RecorderHealth(ok=True, dropped=0, reason="", path="", unwritten_s=0.0),
        who_flies="engaged",
    )
    return msgspec.structs.replace(health, **changes)


def make_state(
    name: str,
    scene: LiveScene | None,
    health: Health | None = None,
    *,
    silent_s: float = 0.0,
    exit_code: int | None = None,
) -> ShownState:
    return ShownState(name, scene, silent_s, health, exit_code)


def test_each_vehicle_has_its_place_plan_boxes_and_row() -> None:
    states = [make_state("west", make_scene((0.0, -1.0, -1.0)), make_health()), make_state("east", None)]
    scene = make_fleet_scene("duo", states)
    west, east = scene.vehicles
    assert (west.at_m, west.plan, west.target_m, west.boxes) == ((0.0, -1.0, -1.0), PLAN, (1.0, 1.0, -1.0), (BOX,))
    row = dict(zip(scene.columns, west.cells, strict=True))
    assert (row["vehicle"], row["mode"], row["battery"]) == ("west", "track", "15.2 V")
    assert "0.05" in row["age"] and "25" in row["positions lost"] and "OFFBOARD" in row["autopilot"]
    assert (east.at_m, east.plan, east.boxes) == (None, (), ())
    assert len(east.cells) == len(scene.columns)


def test_the_worst_vehicle_is_in_the_first_line() -> None:
    fine, warned = (
        make_state("a", make_scene((0.0, 0.0, 0.0))),
        make_state("b", make_scene((1.0, 0.0, 0.0), 5.0, "warn")),
    )
    let_go = make_state("c", make_scene((2.0, 0.0, 0.0)), make_health(let_go="positions jumped"))
    failed, done = make_state("d", None, exit_code=70), make_state("e", None, exit_code=0)
    for states, level, name in (
        ([fine, done], "good", ""),
        ([fine, warned], "warn", "b"),
        ([fine, warned, let_go], "bad", "c"),
        ([fine, failed, warned], "bad", "d"),
    ):
        scene = make_fleet_scene("fleet", states)
        assert scene.level == level
        assert scene.headline.startswith(f"{name}:") or not name


def test_an_old_state_is_marked_and_health_replaces_it() -> None:
    silent_s = 2.0 * MAX_SILENCE_S
    old = make_state("a", make_scene((1.0, 2.0, 3.0)), silent_s=silent_s)
    replaced = make_state("b", make_scene((1.0, 2.0, 3.0)), make_health(), silent_s=silent_s)
    shown, other = make_fleet_scene("fleet", [old, replaced]).vehicles
    assert (shown.level, shown.at_m, shown.plan) == ("bad", (1.0, 2.0, 3.0), ())
    assert (other.level, other.at_m, other.plan) == ("warn", (7.0, 8.0, -9.0), ())
    assert "0.31" in other.cells[4] and "0.05" not in " ".join(shown.cells)


def test_messages_of_all_vehicles_come_newest_first() -> None:
    states = [
        make_state(name, make_scene((0.0, 0.0, 0.0), 9.0, "good", *(SceneEvent(t, "plain", f"{t}") for t in times)))
        for name, times in (("a", (5.0, 1.0)), ("b", (7.0, 3.0)))
    ]
    events = make_fleet_scene("fleet", states).events
    assert [(event.time_s, event.text) for event in events] == [
        (7.0, "b: 7.0"),
        (5.0, "a: 5.0"),
        (3.0, "b: 3.0"),
        (1.0, "a: 1.0"),
    ]


@contextmanager
def serve_scene(port: int, scene: LiveScene) -> Iterator[LiveProcess]:
    """A daemon's live view, with one scene."""
    live = LiveProcess(port, lambda _: None)
    try:
        live.send(SCENE, 0, msgspec.json.encode(scene))
        yield live
    finally:
        live.close()


def test_a_reader_connects_late_and_anew() -> None:
    (port,) = choose_ports(1)
    reader = SceneReader(port)
    try:
        assert reader.scene is None and reader.silent_s == 0.0
        for time_s in (1.0, 2.0):
            expected = make_scene((time_s, 0.0, 0.0), time_s)
            with serve_scene(port, expected):
                wait_until(lambda expected=expected: reader.scene == expected, "the scene")  # type: ignore[misc]
        silent_s = reader.silent_s
        wait_until(lambda: reader.silent_s > silent_s, "silence")
    finally:
        reader.close()


def test_a_reader_outlives_what_is_no_live_view() -> None:
    """A server that answers nonsense, and then a view on the same port."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = int(server.getsockname()[1])
        reader = SceneReader(port)
        client, _ = server.accept()
        with client:
            client.sendall(b"HTTP/1.1 200 OK\r\nContent-Type: text/event-stream\r\n\r\ndata: [1]\n\n")
            client, _ = server.accept()  # it has come again
            client.close()
    try:
        with serve_scene(port, make_scene((1.0, 0.0, 0.0))):
            wait_until(lambda: reader.scene is not None, "the scene")
    finally:
        reader.close()


def read_scene(port: int) -> dict[str, Any]:
    """The first state that a page gets."""
    with socket.create_connection(("127.0.0.1", port), timeout=60.0) as client:
        client.sendall(make_head({"Host": "localhost"}, "/scenes"))
        data = b""
        while data.count(b"\n\n") < 1:
            some = client.recv(1 << 16)
            assert some, data
            data += some
    text = next(line for line in data.splitlines() if line.startswith(b"data: "))
    scene: dict[str, Any] = json.loads(text.removeprefix(b"data: ")) or {"vehicles": []}
    return scene


def test_one_page_shows_all_and_refuses_other_sites_and_writing() -> None:
    places: list[Vec3] = [(0.0, -1.0, -1.0), (0.0, 1.0, -1.0)]
    *ports, page_port = choose_ports(3)
    vehicles = [
        ShownVehicle(f"v{i}", port, Path(f"/nobody/v{i}.sock"), lambda: None, lambda: None)
        for i, port in enumerate(ports)
    ]
    with ExitStack() as stack:
        for port, place_m in zip(ports, places, strict=True):
            stack.enter_context(serve_scene(port, make_scene(place_m)))
        stack.enter_context(show_fleet_page("duo", page_port, vehicles))

        def are_shown() -> bool:
            return [tuple(one["at_m"] or ()) for one in read_scene(page_port)["vehicles"]] == places

        # A viewer that left counts until the next scene is sent to it, and eight are permitted
        wait_until(are_shown, "both on the page", pause_s=0.5)
        status, page = ask(page_port, make_head({"Host": "localhost"}))
        assert status == 200 and b"<script" in page
        for headers, method, refused_status in (
            ({"Host": "evil.example"}, "GET", 403),
            ({"Host": "localhost", "Origin": "http://evil.example"}, "GET", 403),
            ({"Host": "localhost", "Sec-Fetch-Site": "cross-site"}, "GET", 403),
            ({"Host": "localhost"}, "POST", 405),
        ):
            assert ask(page_port, make_head(headers, "/scenes", method))[0] == refused_status
        offer = json.loads(ask(page_port, make_head({"Host": "localhost"}, "/orders"))[1])
        assert offer == {"vehicles": ["v0", "v1"], "permitted": False}
        samples = json.loads(ask(page_port, make_head({"Host": "localhost"}, "/history"))[1])["samples"]
        assert samples[-1][3] == {f"v{i}": list(place_m) for i, place_m in enumerate(places)}


def test_a_taken_port_is_refused_before_anything_flies() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = int(taken.getsockname()[1])
        with pytest.raises(UsageError, match=str(port)), show_fleet_page("duo", port, []):
            pytest.fail("it was served")
