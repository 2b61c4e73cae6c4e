"""`uavctl sim --view`: what the simulated vehicles do, while they do it."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.markup import escape

from sim.look import Look
from uavctl.cli.wide_table import Column, WideTable
from uavctl.data import Vec3

REFRESH_S = 0.25
LINE_S = 1.0  # between two lines, without a terminal
END_S = 1.0  # longest wait for a terminal that takes nothing any more
LANDED = {"ground": "on the floor", "air": "in the air", "climb": "taking off", "descent": "landing"}
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

Looks = Sequence[Look]


def view(looks: Looks) -> RenderableType:
    """A table, one row a vehicle and one column a quantity; several below each other where the terminal is narrow."""
    rows = zip(*(_cells(one) for one in looks), strict=True)
    # What vehicles say, and units in brackets, are no markup.
    columns = [
        Column(escape(heading), [escape(cell) for cell in row]) for heading, row in zip(HEADINGS, rows, strict=True)
    ]
    time_s = max(one.time_s for one in looks)
    return Group(f"simulated time {time_s:.1f} s", WideTable(columns[0], [[column] for column in columns[1:]]))


def _cells(one: Look) -> tuple[str, ...]:
    return (
        str(one.system_id),
        one.mode,
        "yes" if one.armed else "no",
        LANDED[one.phase],
        _vector(one.position_m),
        _vector(one.velocity_mps),
        f"{one.battery:.0%}",
        _setpoint(one),
        str(one.sent),
        str(one.lost),
        ", ".join(one.faults) or "-",
        one.text or "-",
    )


def _vector(vector: Vec3) -> str:
    return " ".join(f"{component:+.2f}" for component in vector)


def _setpoint(one: Look) -> str:
    if one.steered_by is None or one.setpoint_age_s is None:
        return "-"
    system, component = one.steered_by
    return f"{system}/{component}, {one.setpoint_age_s:.2f} s ago"


def line(one: Look) -> str:
    """The same of one vehicle in a line of plain text."""
    names = ("mode", "armed", "landed", "position", "velocity", "battery", "setpoint", "sent", "lost", "faults", "text")
    told = "  ".join(f"{name} {cell}" for name, cell in zip(names, _cells(one)[1:], strict=True))
    return f"{one.time_s:.1f} s  vehicle {one.system_id}  {told}"


@contextmanager
def watching(console: Console) -> Iterator[Callable[[tuple[Look, ...]], None]]:
    """Show what the yielded function is told: a live table, or a line a second and vehicle where there is no terminal.

    A thread of its own draws, so whoever tells never waits, not even for a terminal that has stopped.
    """
    latest: list[tuple[Look, ...]] = []
    done = threading.Event()

    def tell(looks: tuple[Look, ...]) -> None:
        latest[:] = [looks]

    draw = _draw if console.is_terminal else _write
    if not console.is_terminal:
        console.print("--view: no terminal to draw in, so a line a second", soft_wrap=True)
    thread = threading.Thread(target=draw, args=(console, latest, done), name="view", daemon=True)
    thread.start()
    try:
        yield tell
    finally:
        done.set()
        thread.join(END_S)


def _draw(console: Console, latest: list[tuple[Look, ...]], done: threading.Event) -> None:
    # Standard output stays what it is: the line that says that the ports are open may go to another program.
    with Live(console=console, auto_refresh=False, redirect_stdout=False, redirect_stderr=False) as live:
        ended = False
        while not ended:
            ended = done.wait(REFRESH_S)
            for looks in latest:
                live.update(view(looks), refresh=True)


def _write(console: Console, latest: list[tuple[Look, ...]], done: threading.Event) -> None:
    ended = False
    while not ended:
        ended = done.wait(LINE_S)
        for looks in latest:
            for one in looks:
                console.print(line(one), markup=False, highlight=False, soft_wrap=True)
