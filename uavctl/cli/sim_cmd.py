"""`uavctl sim`: the simulated vehicle and cameras alone, for any MAVLink client."""

from __future__ import annotations

import sys
from typing import Annotated, Literal

import msgspec
from cyclopts import Parameter

from sim.server import Ready, serve
from uavctl.cli.common import DEFAULTS, POSITIVE, Common
from uavctl.cli.flying import stop_on_signals
from uavctl.data import Truth


def sim(
    *,
    common: Common = DEFAULTS,
    vehicle: Annotated[str, Parameter(help="udpout://host:port (PX4 sends to the client), udpin or tcpin")] = (
        "udpout://127.0.0.1:14540"
    ),
    mocap: Annotated[str, Parameter(help="the same for the cameras; an equal URL is one connection")] = (
        "udpout://127.0.0.1:14560"
    ),
    autopilot: Annotated[
        Literal["px4", "ardupilot"] | None, Parameter(help="whose behaviour it shows; else sim.autopilot")
    ] = None,
    airborne: Annotated[bool, Parameter(negative=(), help="start flying in OFFBOARD or GUIDED")] = False,
    duration: Annotated[
        float | None, Parameter(help="end after this time [s]; else on Ctrl-C", validator=POSITIVE)
    ] = None,
) -> int:
    """Serve the simulated vehicle in real time; one line says when the ports are open."""
    overrides = () if autopilot is None else (f'sim.autopilot="{autopilot}"',)
    config = common.with_overrides(overrides).load().config

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
        serve(
            config,
            vehicle,
            mocap,
            duration_s=duration,
            airborne=airborne,
            on_ready=ready,
            on_truth=forget,
            stop=stopped,
        )
    return 0
