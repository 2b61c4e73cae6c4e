"""`uavctl sim`: the simulated vehicle and cameras alone, for any MAVLink client."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from cyclopts import Parameter

from sim.server import Ready, Seat, serve_all
from uavctl.cli.common import DEFAULTS, POSITIVE, Common
from uavctl.cli.flying import stop_on_signals
from uavctl.config.fault_file import with_faults
from uavctl.data import Truth

VEHICLES = {
    "px4": "udpout://127.0.0.1:14540,udpout://127.0.0.1:14550",
    "ardupilot": "tcpin://127.0.0.1:5760",
}


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
        float | None, Parameter(help="end after this simulated time [s]; else on Ctrl-C", validator=POSITIVE)
    ] = None,
    speed: Annotated[float, Parameter(help="simulated time per real time", validator=POSITIVE)] = 1.0,
    faults: Annotated[
        Path | None, Parameter(help="TOML file of what happens, as [[fault]] tables with the keys of [[sim.fault]]")
    ] = None,
) -> int:
    """Serve the simulated vehicle; one line says when the ports are open."""
    overrides = () if autopilot is None else (f'sim.autopilot="{autopilot}"',)
    config = common.with_overrides(overrides).load().config
    if faults is not None:
        config = with_faults(config, faults)

    def ready(ports: Ready) -> None:
        document = {"vehicle": ports.vehicle, "mocap": ports.mocap}
        line = (
            msgspec.json.encode(document).decode() if common.json else " ".join(f"{k} {v}" for k, v in document.items())
        )
        sys.stdout.write(line + "\n")
        sys.stdout.flush()

    def forget(truth: Truth) -> None:
        del truth

    with stop_on_signals() as stopped:
        serve_all(
            (Seat(config, vehicle or VEHICLES[config.sim.autopilot], mocap, forget),),
            duration_s=duration,
            airborne=airborne,
            on_ready=ready,
            stop=stopped,
            speed=speed,
        )
    return 0
