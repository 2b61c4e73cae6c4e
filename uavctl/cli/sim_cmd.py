"""`uavctl sim`: the simulated vehicle and cameras alone, for any MAVLink client."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from cyclopts import Parameter, validators

from sim.faults import problems
from sim.fleet import fleet
from sim.server import Ready, Seat, serve_all
from uavctl.cli.common import DEFAULTS, Common, messages
from uavctl.cli.flying import stop_on_signals
from uavctl.cli.sim_door import make_door
from uavctl.cli.sim_view import watching
from uavctl.config.fault_file import with_faults
from uavctl.data import Truth

VEHICLES = {
    "px4": "udpout://127.0.0.1:14540,udpout://127.0.0.1:14550",
    "ardupilot": "tcpin://127.0.0.1:5760",
}
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
    mocap: Annotated[str, Parameter(help="the same for the cameras; an equal URL is one connection")] = (
        "udpout://127.0.0.1:14560"
    ),
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
        bool, Parameter(negative=(), help="show on standard error what happens; without a terminal a line a second")
    ] = False,
) -> int:
    """Serve simulated vehicles; a line for each (one document with --json) says when all ports are open."""
    overrides = () if autopilot is None else (f'sim.autopilot="{autopilot}"',)
    config = common.with_overrides(overrides).load().config
    if faults is not None:
        config = with_faults(config, faults, problems)

    def forget(truth: Truth) -> None:
        del truth

    seats = fleet(config, VEHICLES[config.sim.autopilot] if vehicle is None else vehicle, mocap, vehicles, forget)
    opened: list[Ready] = []

    def ready(ports: Ready) -> None:
        opened.append(ports)
        if len(opened) == len(seats):
            _announce(seats, opened, as_json=common.json)

    watch = watching(messages()) if view else nullcontext()
    with stop_on_signals() as stopped, watch as on_look:
        serve_all(
            seats,
            duration_s=duration,
            airborne=airborne,
            on_ready=ready,
            stop=stopped,
            speed=speed,
            on_look=on_look,
            door=make_door(config.security),
        )
    return 0


def _announce(seats: Sequence[Seat], opened: Sequence[Ready], *, as_json: bool) -> None:
    listed = [
        {"system_id": seat.config.sim.system_id, "vehicle": ports.vehicle, "mocap": ports.mocap}
        for seat, ports in zip(seats, opened, strict=True)
    ]
    lines = [" ".join(f"{key} {value}" for key, value in one.items()) for one in listed]
    text = msgspec.json.encode({"vehicles": listed}).decode() if as_json else "\n".join(lines)
    sys.stdout.write(text + "\n")
    sys.stdout.flush()
