"""Live page of `uavctl fleet fly --live`: all vehicles on one map and in one table.

Each daemon has a live view of its own, in a process of lowest priority. This page reads these views as a browser does,
so a daemon does nothing for it.
"""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from uavctl.cli.flying import report_dead_view
from uavctl.cli.output import print_message
from uavctl.daemon.health import Health
from uavctl.records import Vec3
from uavctl.smpc.plant import AXES

if TYPE_CHECKING:
    from logs.live.client import SceneReader
    from logs.live.process import LiveProcess
    from logs.live.scene import Level, LiveScene, SceneVehicle

PERIOD_S = 0.1  # between two states of the page
MAX_SILENCE_S = 1.0  # an older state is marked: it looks like a vehicle at rest
MAX_EVENTS = 12
COLUMNS = ("vehicle", "mode", "in control", "autopilot", "age", "battery", "positions lost")
_GRAVITY: tuple[Level, ...] = ("bad", "warn", "good", "plain")  # the gravest level first


@dataclass(frozen=True)
class ShownVehicle:
    """Source of a vehicle's row: its name, live view, health, and exit code once its daemon has ended."""

    name: str
    port: int
    socket: Path  # control socket of its daemon
    get_health: Callable[[], Health | None]
    get_exit_code: Callable[[], int | None]


def choose_ports(count: int) -> list[int]:
    """Choose free TCP ports of this machine; they are free until another program takes them."""
    with ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket()) for _ in range(count)]
        for one in sockets:
            one.bind(("127.0.0.1", 0))
        return [int(one.getsockname()[1]) for one in sockets]


@contextmanager
def show_fleet_page(title: str, live_port: int, vehicles: Sequence[ShownVehicle]) -> Iterator[None]:
    """Serve one page with all vehicles.

    Args:
        live_port: TCP port of the page; 0: any free one.

    Raises:
        UsageError: The page cannot be served.
    """
    from logs.live.client import SceneReader  # loaded only for a view
    from logs.live.process import LiveProcess

    sockets = {vehicle.name: vehicle.socket for vehicle in vehicles}
    live, done = LiveProcess(live_port, report_dead_view, sockets), threading.Event()
    readers = [SceneReader(vehicle.port) for vehicle in vehicles]
    rows = list(zip(vehicles, readers, strict=True))
    thread = threading.Thread(target=_feed_page, args=(live, title, rows, done), name="live page", daemon=True)
    print_message(f"live page of the fleet: {live.page_url}")
    thread.start()
    try:
        yield
    finally:
        done.set()
        for reader in readers:
            reader.close()
        thread.join(MAX_SILENCE_S)
        live.close()


def _feed_page(
    live: LiveProcess, title: str, rows: Sequence[tuple[ShownVehicle, SceneReader]], done: threading.Event
) -> None:
    """Send the newest state of all vehicles to the page, ten times a second."""
    from logs.live.feed import SCENE

    while not done.wait(PERIOD_S):
        states = [
            ShownState(
                vehicle.name, reader.scene, reader.silent_s, vehicle.get_health(), exit_code=vehicle.get_exit_code()
            )
            for vehicle, reader in rows
        ]
        live.send(SCENE, 0, msgspec.json.encode(make_fleet_scene(title, states)))


@dataclass(frozen=True)
class ShownState:
    """All that is known of a vehicle at a moment."""

    name: str
    scene: LiveScene | None
    silent_s: float  # since the scene last went on
    health: Health | None  # None where its daemon does not answer
    exit_code: int | None  # of its daemon; None while it runs

    @property
    def is_silent(self) -> bool:
        """Whether the scene is that of a moment long ago."""
        return self.silent_s > MAX_SILENCE_S

    @property
    def level(self) -> Level:
        """How well the vehicle is."""
        if self.exit_code is not None:
            return "bad" if self.exit_code else "plain"
        if self.health is not None and self.health.let_go:
            return "bad"
        if self.is_silent:
            return "bad" if self.health is None else "warn"
        return "plain" if self.scene is None else self.scene.level

    @property
    def position_m(self) -> Vec3 | None:
        """Newest estimate of its position, local NED; None if it is not known."""
        position_m = None if self.health is None else self.health.position_m
        if self.scene is None or (self.is_silent and position_m is not None):
            if position_m is None:
                return None
            north_m, east_m, down_m = (position_m.get(axis, 0.0) for axis in AXES)
            return north_m, east_m, down_m
        return next((body.at_m for body in self.scene.bodies if body.name == "estimate"), None)

    @property
    def text(self) -> str:
        """Mode of its controller and its cause, or why there is none."""
        if self.exit_code is not None:
            return f"ended, exit code {self.exit_code}"
        if self.health is not None and self.health.let_go:
            return f"let go: {self.health.let_go}"
        if self.is_silent:
            mode = None if self.health is None else self.health.mode
            return f"nothing for {self.silent_s:.0f} s" if mode is None else f"{mode.value}, live view silent"
        return "no state yet" if self.scene is None else self.scene.headline

    @property
    def mode_text(self) -> str:
        """The first words of `text`: age or cause have a place of their own."""
        return self.text.partition(":")[0]


def make_fleet_scene(title: str, states: Sequence[ShownState]) -> LiveScene:
    """Merge the scenes of all vehicles into one, with a row of the table for each."""
    from logs.live.scene import LiveScene, SceneEvent

    worst = min(states, key=lambda state: _GRAVITY.index(state.level))
    events = [
        SceneEvent(event.time_s, event.level, f"{state.name}: {event.text}")
        for state in states
        if state.scene is not None
        for event in state.scene.events
    ]
    return LiveScene(
        title=title,
        time_s=max((state.scene.time_s for state in states if state.scene is not None), default=0.0),
        headline=_make_headline(states, worst),
        level=worst.level,
        events=tuple(sorted(events, key=lambda event: -event.time_s)[:MAX_EVENTS]),
        columns=COLUMNS,
        vehicles=tuple(map(_make_vehicle, states)),
    )


def _make_headline(states: Sequence[ShownState], worst: ShownState) -> str:
    if worst.level in ("bad", "warn"):
        return f"{worst.name}: {worst.text}"
    ages = [(state.scene.age_s, state.name) for state in states if state.scene and state.scene.age_s is not None]
    oldest = max(ages, default=None)
    age_text = "" if oldest is None else f", oldest position {oldest[0]:.2f} s ({oldest[1]})"
    return f"{len(states)} vehicle{'s' if len(states) > 1 else ''}{age_text}"


def _make_vehicle(state: ShownState) -> SceneVehicle:
    from logs.live.scene import SceneVehicle

    scene, health = state.scene, state.health
    own = None if health is None else health.vehicle
    age_s = scene.age_s if scene is not None and not state.is_silent else None if health is None else health.age_s
    cells = (
        state.name,
        state.mode_text,
        "-" if health is None else health.ending or health.who_flies or "-",
        "not heard" if own is None else f"{own.mode}, {'armed' if own.armed else 'disarmed'}",
        "-" if age_s is None else f"{age_s:.2f} s",
        "-" if own is None or own.battery_v is None else f"{own.battery_v:.1f} V",
        "-" if health is None or health.loss is None else f"{health.loss:.0%}",
    )
    if scene is None or state.is_silent:
        return SceneVehicle(state.name, cells, state.level, state.position_m)
    return SceneVehicle(
        state.name,
        cells,
        state.level,
        state.position_m,
        plan=scene.plan,
        target_m=scene.target_m,
        boxes=() if scene.box is None else (scene.box,),
    )
