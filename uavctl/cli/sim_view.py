"""View of `uavctl sim --view`: the state of the simulated vehicles on a console and on a live page."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

import msgspec
from rich.console import Console, Group, RenderableType
from rich.live import Live

from sim.simulation import VehicleSnapshot
from uavctl.cli.flying import report_dead_view
from uavctl.cli.output import Column, WideTable
from uavctl.config import Config
from uavctl.config.checks import get_position_limits_m
from uavctl.records import Vec3
from uavctl.smpc.plant import AXES

if TYPE_CHECKING:
    from logs.live.process import LiveProcess
    from logs.live.scene import Level, LiveScene

REFRESH_PERIOD_S = 0.25


PAGE_PERIOD_S = 0.1


LINE_PERIOD_S = 1.0  # between two lines, without a terminal


END_LIMIT_S = 1.0  # longest wait for a terminal that takes nothing any more


PHASE_TEXTS = {"ground": "on the floor", "air": "in the air", "climb": "taking off", "descent": "landing"}


HEADINGS = (
    "id",
    "mode",
    "armed",
    "landed",
    "position NED [m]",
    "velocity [m/s]",
    "battery",
    "setpoint",
    "sent",
    "lost",
    "faults",
    "last text",
)


Snapshots = Sequence[VehicleSnapshot]


def render_view(snapshots: Snapshots) -> RenderableType:
    """Return a table with a row for each vehicle; cut into several where the terminal is narrow."""
    rows = zip(*(_format_cells(snapshot) for snapshot in snapshots), strict=True)
    columns = [Column(heading, row) for heading, row in zip(HEADINGS, rows, strict=True)]
    time_s = max(snapshot.time_s for snapshot in snapshots)
    return Group(f"simulated time {time_s:.1f} s", WideTable(columns[0], [[column] for column in columns[1:]]))


def _format_cells(snapshot: VehicleSnapshot) -> tuple[str, ...]:
    return (
        str(snapshot.system_id),
        snapshot.mode,
        "yes" if snapshot.armed else "no",
        PHASE_TEXTS[snapshot.phase],
        _format_vector(snapshot.position_m),
        _format_vector(snapshot.velocity_mps),
        f"{snapshot.battery:.0%}",
        _format_setpoint(snapshot),
        str(snapshot.sent),
        str(snapshot.lost),
        ", ".join(snapshot.faults) or "-",
        snapshot.text or "-",
    )


def _format_vector(vector: Vec3) -> str:
    return " ".join(f"{component:+z.2f}" for component in vector)


def _format_setpoint(snapshot: VehicleSnapshot) -> str:
    if snapshot.setpoint_source is None or snapshot.setpoint_age_s is None:
        return "-"
    system, component = snapshot.setpoint_source
    return f"{system}/{component}, {snapshot.setpoint_age_s:.2f} s ago"


def format_line(snapshot: VehicleSnapshot) -> str:
    """Return the state of one vehicle as a line of plain text."""
    names = ("mode", "armed", "landed", "position", "velocity", "battery", "setpoint", "sent", "lost", "faults", "text")
    texts = "  ".join(f"{name} {cell}" for name, cell in zip(names, _format_cells(snapshot)[1:], strict=True))
    return f"{snapshot.time_s:.1f} s  vehicle {snapshot.system_id}  {texts}"


@contextmanager
def show_view(console: Console, config: Config) -> Iterator[Callable[[tuple[VehicleSnapshot, ...]], None]]:
    """Show snapshots of vehicles: a live table, or a line each second without a terminal, and a page for browsers.

    The yielded function takes the snapshots. A thread of its own draws, so the caller never waits for a terminal.
    """
    from logs.live.process import LiveProcess  # loaded only for a view

    latest: list[tuple[VehicleSnapshot, ...]] = []
    done = threading.Event()

    def update(snapshots: tuple[VehicleSnapshot, ...]) -> None:
        latest[:] = [snapshots]

    draw = _draw_table if console.is_terminal else _write_lines
    if not console.is_terminal:
        console.print("--view: no terminal to draw in, so a line a second", soft_wrap=True)
    live = LiveProcess(0, report_dead_view)
    address = f"http://localhost:{live.port}/"
    threads = (
        threading.Thread(target=draw, args=(console, address, latest, done), name="view", daemon=True),
        threading.Thread(target=_feed_page, args=(live, config, latest, done), name="live page", daemon=True),
    )
    for thread in threads:
        thread.start()
    try:
        yield update
    finally:
        done.set()
        for thread in threads:
            thread.join(END_LIMIT_S)
        live.close()


def _feed_page(live: LiveProcess, config: Config, latest: LatestSnapshots, done: threading.Event) -> None:
    """Send the newest state to the live page, ten times a second."""
    from logs.live.feed import SCENE

    while not done.wait(PAGE_PERIOD_S):
        for snapshots in latest:
            live.send(SCENE, 0, msgspec.json.encode(make_scene(snapshots, config)))


def make_scene(snapshots: Snapshots, config: Config) -> LiveScene:
    """Return the scene of a live page: simulated vehicles and the limits of their room."""
    from logs.live.scene import LiveScene, SceneBody, SceneBox, SceneEvent, SceneFigure

    limits = get_position_limits_m(config)
    walls = [[side if math.isfinite(side) else None for side in limits.get(axis, (math.inf,) * 2)] for axis in AXES]
    lower_m, upper_m = zip(*walls, strict=True)
    figures, events = [], []
    for snapshot in snapshots:
        level: Level = "warn" if snapshot.faults else "plain"
        cells = zip(HEADINGS[4:-1], _format_cells(snapshot)[4:-1], strict=True)
        name = f"{snapshot.system_id}: " if len(snapshots) > 1 else ""
        figures += [SceneFigure(f"{name}{heading}", cell, level) for heading, cell in cells]
        if snapshot.text:
            events.append(SceneEvent(snapshot.time_s, "plain", f"{name}{snapshot.text}"))
    texts = [
        f"{snapshot.mode}, {'armed' if snapshot.armed else 'disarmed'}, {PHASE_TEXTS[snapshot.phase]}"
        for snapshot in snapshots
    ]
    return LiveScene(
        title=f"uavctl sim: {config.name}",
        time_s=max(snapshot.time_s for snapshot in snapshots),
        headline=texts[0] if len(texts) == 1 else f"{len(texts)} vehicles",
        level="plain",
        bodies=tuple(SceneBody(f"vehicle {snapshot.system_id}", snapshot.position_m) for snapshot in snapshots),
        box=SceneBox(lower_m, upper_m),
        figures=tuple(figures),
        events=tuple(events),
    )


LatestSnapshots = list[tuple[VehicleSnapshot, ...]]


def _draw_table(console: Console, address: str, latest: LatestSnapshots, done: threading.Event) -> None:
    # Standard output is not redirected: another program may read the line with the open ports.
    with Live(console=console, auto_refresh=False, redirect_stdout=False, redirect_stderr=False) as live:
        ended = False
        while not ended:
            ended = done.wait(REFRESH_PERIOD_S)
            for snapshots in latest:
                live.update(Group(f"live page: {address}", render_view(snapshots)), refresh=True)


def _write_lines(console: Console, address: str, latest: LatestSnapshots, done: threading.Event) -> None:
    console.print(f"live page: {address}", soft_wrap=True)
    ended = False
    while not ended:
        ended = done.wait(LINE_PERIOD_S)
        for snapshots in latest:
            for snapshot in snapshots:
                console.print(format_line(snapshot), highlight=False, soft_wrap=True)
