"""Command `uavctl sim`."""

from __future__ import annotations

import math
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter, validators
from rich.console import Console, Group, RenderableType
from rich.live import Live

from sim.faults import find_fault_problems
from sim.fleet import make_fleet
from sim.ports import Port
from sim.server import PortWrapper, Ready, VehicleSetup, serve_all
from sim.simulation import VehicleSnapshot
from uavctl.build.rest import check_axes
from uavctl.cli.common import (
    DEFAULTS,
    Column,
    Common,
    WideTable,
    locate_design_errors,
    make_message_console,
    write_document,
)
from uavctl.cli.flying import stop_on_signals
from uavctl.clock import monotonic_ns
from uavctl.config import Config
from uavctl.config.checks import get_position_limits_m
from uavctl.config.connections import MOCAP_LINK, SecurityConfig
from uavctl.config.load import add_faults
from uavctl.io.key_file import read_key
from uavctl.mavlink.connection import MOCAP
from uavctl.mavlink.framing import scan_frames
from uavctl.mavlink.signing import FrameAuthenticator, FrameSigner, SigningKey, SigningTimestamps
from uavctl.records import Truth, Vec3
from uavctl.smpc.plant import AXES

if TYPE_CHECKING:
    from logs.live import Level, LiveScene

# The simulated peers behind a door of their own, so that signing can be tried without a vehicle.


LINK_ID = 100  # of the simulated vehicle; its cameras' is one more


class SignedPort:
    """Port whose frames are signed both ways; implements `sim.server.Port`."""

    def __init__(self, inner: Port, gate: FrameAuthenticator) -> None:
        self._inner, self._gate = inner, gate

    @property
    def url(self) -> str:
        """See `Port`."""
        return self._inner.url

    def sockets(self) -> tuple[socket.socket, ...]:
        """See `Port`."""
        return self._inner.sockets()

    def read(self) -> list[bytes]:
        """See `Port`; bytes without a verified frame are dropped."""
        at_ns = monotonic_ns()
        admitted = (self._gate.verify_frames(data, at_ns) for data in self._inner.read())
        return [data for data in admitted if data]

    def write(self, data: bytes) -> None:
        """See `Port`; what the channel has damaged goes out damaged."""
        found = scan_frames(data, final=True)
        if found.frames and not found.bad:
            at_ns = monotonic_ns()
            data = b"".join(self._gate.sign_frame(frame.data, at_ns) for frame in found.frames)
        self._inner.write(data)

    def close(self) -> None:
        """See `Port`."""
        self._inner.close()


def make_door(security: SecurityConfig) -> PortWrapper | None:
    """Return a function that signs ports as `[security]` asks of the daemon; None if it asks for nothing.

    Raises:
        KeyFileError: the key cannot be used.
    """
    if not security.key_file:
        return None
    read_key(Path(security.key_file).expanduser())  # an error belongs to the caller, not to a child process
    return partial(_behind_door, security)


def _behind_door(security: SecurityConfig, name: str, port: Port) -> Port:
    if name not in security.require:
        return port
    key: SigningKey = read_key(Path(security.key_file).expanduser())
    link_id = LINK_ID + (MOCAP_LINK if name == MOCAP else 0)
    signing = FrameSigner(key, link_id, SigningTimestamps(), time.time_ns() - monotonic_ns())
    return SignedPort(port, FrameAuthenticator(signing, stream=False))


# `uavctl sim --view`: what the simulated vehicles do, while they do it.


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

Looks = Sequence[VehicleSnapshot]


def view(looks: Looks) -> RenderableType:
    """Return a table with a row for each vehicle; cut into several where the terminal is narrow."""
    rows = zip(*(_cells(one) for one in looks), strict=True)
    columns = [Column(heading, row) for heading, row in zip(HEADINGS, rows, strict=True)]
    time_s = max(one.time_s for one in looks)
    return Group(f"simulated time {time_s:.1f} s", WideTable(columns[0], [[column] for column in columns[1:]]))


def _cells(one: VehicleSnapshot) -> tuple[str, ...]:
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
    return " ".join(f"{component:+z.2f}" for component in vector)


def _setpoint(one: VehicleSnapshot) -> str:
    if one.setpoint_source is None or one.setpoint_age_s is None:
        return "-"
    system, component = one.setpoint_source
    return f"{system}/{component}, {one.setpoint_age_s:.2f} s ago"


def line(one: VehicleSnapshot) -> str:
    """Return the state of one vehicle as a line of plain text."""
    names = ("mode", "armed", "landed", "position", "velocity", "battery", "setpoint", "sent", "lost", "faults", "text")
    told = "  ".join(f"{name} {cell}" for name, cell in zip(names, _cells(one)[1:], strict=True))
    return f"{one.time_s:.1f} s  vehicle {one.system_id}  {told}"


@contextmanager
def watching(console: Console, config: Config) -> Iterator[Callable[[tuple[VehicleSnapshot, ...]], None]]:
    """Show snapshots of vehicles given to the yielded function: a live table, or a line each second without a terminal.

    The same is on a page for browsers on this machine. A thread of its own draws, so whoever tells never waits, not
    even for a terminal that has stopped.
    """
    from logs.live import serve_live_page  # nobody looks: nothing of it is loaded

    latest: list[tuple[VehicleSnapshot, ...]] = []
    done = threading.Event()

    def tell(looks: tuple[VehicleSnapshot, ...]) -> None:
        latest[:] = [looks]

    draw = _draw if console.is_terminal else _write
    if not console.is_terminal:
        console.print("--view: no terminal to draw in, so a line a second", soft_wrap=True)
    with serve_live_page(lambda: scene_of(latest[0], config) if latest else None, 0) as address:
        thread = threading.Thread(target=draw, args=(console, address, latest, done), name="view", daemon=True)
        thread.start()
        try:
            yield tell
        finally:
            done.set()
            thread.join(END_S)


def scene_of(looks: Looks, config: Config) -> LiveScene:
    """Return what a live page shows of simulated vehicles, and the limits of the room they fly in."""
    from logs.live import LiveScene, SceneBody, SceneBox, SceneEvent, SceneFigure

    limits = get_position_limits_m(config)
    walls = [[side if math.isfinite(side) else None for side in limits.get(axis, (math.inf,) * 2)] for axis in AXES]
    lower_m, upper_m = zip(*walls, strict=True)
    figures, events = [], []
    for one in looks:
        level: Level = "warn" if one.faults else "plain"
        cells = zip(HEADINGS[4:-1], _cells(one)[4:-1], strict=True)
        name = f"{one.system_id}: " if len(looks) > 1 else ""
        figures += [SceneFigure(f"{name}{heading}", cell, level) for heading, cell in cells]
        if one.text:
            events.append(SceneEvent(one.time_s, "plain", f"{name}{one.text}"))
    told = [f"{one.mode}, {'armed' if one.armed else 'disarmed'}, {LANDED[one.phase]}" for one in looks]
    return LiveScene(
        title=f"uavctl sim: {config.name}",
        time_s=max(one.time_s for one in looks),
        headline=told[0] if len(told) == 1 else f"{len(told)} vehicles",
        level="plain",
        bodies=tuple(SceneBody(f"vehicle {one.system_id}", one.position_m) for one in looks),
        box=SceneBox(lower_m, upper_m),
        figures=tuple(figures),
        events=tuple(events),
    )


Latest = list[tuple[VehicleSnapshot, ...]]


def _draw(console: Console, address: str, latest: Latest, done: threading.Event) -> None:
    # Standard output stays what it is: the line that says that the ports are open may go to another program.
    with Live(console=console, auto_refresh=False, redirect_stdout=False, redirect_stderr=False) as live:
        ended = False
        while not ended:
            ended = done.wait(REFRESH_S)
            for looks in latest:
                live.update(Group(f"live page: {address}", view(looks)), refresh=True)


def _write(console: Console, address: str, latest: Latest, done: threading.Event) -> None:
    console.print(f"live page: {address}", soft_wrap=True)
    ended = False
    while not ended:
        ended = done.wait(LINE_S)
        for looks in latest:
            for one in looks:
                console.print(line(one), highlight=False, soft_wrap=True)


# `uavctl sim`: the simulated vehicle and cameras alone, for any MAVLink client.


VEHICLES = {"px4": "udpout://127.0.0.1:14540,udpout://127.0.0.1:14550", "ardupilot": "tcpin://127.0.0.1:5760"}
MOST_VEHICLES = 10
FASTEST = 1000.0
LONGEST_S = 1e6


def sim(
    *,
    common: Common = DEFAULTS,
    vehicle: Annotated[
        str | None,
        Parameter(
            help="udpout://host:port, udpin or tcpin; several, separated by commas, are one link. As the real ones do: "
            "PX4 sends to udpout://127.0.0.1:14540 and 14550, ArduPilot listens at tcpin://127.0.0.1:5760"
        ),
    ] = None,
    mocap: Annotated[
        str,
        Parameter(
            help="the same for the cameras; an equal URL is one connection. natnet://127.0.0.1/drone lets them be an "
            "OptiTrack server whose body is the vehicle"
        ),
    ] = "udpout://127.0.0.1:14560",
    autopilot: Annotated[
        Literal["px4", "ardupilot"] | None, Parameter(help="whose behaviour it shows; else sim.autopilot")
    ] = None,
    airborne: Annotated[bool, Parameter(negative=(), help="start flying in OFFBOARD or GUIDED")] = False,
    duration: Annotated[
        float | None,
        Parameter(
            help="end after this simulated time [s], at most 1e6; else on Ctrl-C",
            validator=validators.Number(gt=0, lte=LONGEST_S),
        ),
    ] = None,
    speed: Annotated[
        float,
        Parameter(help="simulated time per real time, at most 1000", validator=validators.Number(gt=0, lte=FASTEST)),
    ] = 1.0,
    faults: Annotated[
        Path | None, Parameter(help="TOML file of what happens, as [[fault]] tables with the keys of [[sim.fault]]")
    ] = None,
    vehicles: Annotated[
        int,
        Parameter(
            help="how many at once, 1 to 10. Each has the system id and the seed of the one before plus one, starts "
            "1 m from it, and its ports lie 1 (UDP) or 10 (TCP) higher",
            validator=validators.Number(gte=1, lte=MOST_VEHICLES),
        ),
    ] = 1,
    view: Annotated[
        bool,
        Parameter(
            negative=(),
            help="show what happens on standard error, without a terminal a line a second, and in a browser",
        ),
    ] = False,
) -> int:
    """Serve simulated vehicles; a line for each (one document with --json) says when all ports are open."""
    overrides = () if autopilot is None else (f'sim.autopilot="{autopilot}"',)
    loaded = common.with_overrides(overrides).load()
    config = loaded.config
    with locate_design_errors(loaded):
        check_axes(config)
    if faults is not None:
        config = add_faults(config, faults, find_fault_problems)

    def forget(truth: Truth) -> None:
        del truth

    seats = make_fleet(config, VEHICLES[config.sim.autopilot] if vehicle is None else vehicle, mocap, vehicles, forget)
    opened: list[Ready] = []

    def ready(ports: Ready) -> None:
        opened.append(ports)
        if len(opened) == len(seats):
            _announce(seats, opened, as_json=common.json)

    watch = watching(make_message_console(), config) if view else nullcontext()
    with stop_on_signals() as stopped, watch as on_look:
        serve_all(
            seats,
            duration_s=duration,
            airborne=airborne,
            on_ready=ready,
            stop=stopped,
            speed=speed,
            on_snapshot=on_look,
            wrap_port=make_door(config.security),
        )
    return 0


def _announce(seats: Sequence[VehicleSetup], opened: Sequence[Ready], *, as_json: bool) -> None:
    listed = [
        {"system_id": seat.config.sim.system_id, "vehicle": ports.vehicle, "mocap": ports.mocap}
        for seat, ports in zip(seats, opened, strict=True)
    ]
    if as_json:
        write_document("sim", {"vehicles": listed})
        return
    for one in listed:
        sys.stdout.write(" ".join(f"{key} {value}" for key, value in one.items()) + "\n")
    sys.stdout.flush()
