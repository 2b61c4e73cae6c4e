"""Command `uavctl sim`: the simulated vehicle and cameras alone, for any MAVLink client."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter, validators

from sim.faults import find_fault_problems
from sim.fleet import make_fleet
from sim.server import Encounters, Ready, VehicleSetup, serve_all
from uavctl.cli.common import DEFAULTS, Common, locate_design_errors
from uavctl.cli.output import make_message_console, write_document
from uavctl.cli.signals import stop_on_signals
from uavctl.cli.signed_port import make_port_wrapper
from uavctl.cli.sim_view import show_view
from uavctl.config.load import add_faults
from uavctl.records import ClosestApproach, Collision, Truth
from uavctl.wiring.rest import check_axes

if TYPE_CHECKING:
    pass


DEFAULT_VEHICLE_URLS = {
    "px4": "udpout://127.0.0.1:14540,udpout://127.0.0.1:14550",
    "ardupilot": "tcpin://127.0.0.1:5760",
}
MAX_VEHICLES = 10
MAX_SPEED = 1000.0
MAX_DURATION_S = 1e6


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
        Literal["px4", "ardupilot"] | None, Parameter(help="autopilot that it simulates; else sim.autopilot")
    ] = None,
    airborne: Annotated[bool, Parameter(negative=(), help="start flying in OFFBOARD or GUIDED")] = False,
    duration: Annotated[
        float | None,
        Parameter(
            help="end after this simulated time [s], at most 1e6; else on Ctrl-C",
            validator=validators.Number(gt=0, lte=MAX_DURATION_S),
        ),
    ] = None,
    speed: Annotated[
        float,
        Parameter(help="simulated time per real time, at most 1000", validator=validators.Number(gt=0, lte=MAX_SPEED)),
    ] = 1.0,
    faults: Annotated[
        Path | None, Parameter(help="TOML file of faults: [[fault]] tables with the keys of [[sim.fault]]")
    ] = None,
    vehicles: Annotated[
        int,
        Parameter(
            help="number of vehicles, 1 to 10. Each has the system id and the seed of the one before plus one, starts "
            "1 m from it, and its ports lie 1 (UDP) or 10 (TCP) higher",
            validator=validators.Number(gte=1, lte=MAX_VEHICLES),
        ),
    ] = 1,
    view: Annotated[
        bool,
        Parameter(
            negative=(), help="show the flight on standard error (without a terminal a line a second), and in a browser"
        ),
    ] = False,
) -> int:
    """Serve simulated vehicles; a line for each (one document with --json) appears when all ports are open.

    Several vehicles share one world: they collide, and push lower ones down. At the end a line for each collision and
    for the closest approach of each pair (a second document with --json) appears.
    """
    overrides = () if autopilot is None else (f'sim.autopilot="{autopilot}"',)
    loaded = common.with_overrides(overrides).load()
    config = loaded.config
    with locate_design_errors(loaded):
        check_axes(config)
    if faults is not None:
        config = add_faults(config, faults, find_fault_problems)

    def discard(truth: Truth) -> None:
        del truth

    vehicle_setups = make_fleet(
        config, DEFAULT_VEHICLE_URLS[config.sim.autopilot] if vehicle is None else vehicle, mocap, vehicles, discard
    )
    opened: list[Ready] = []

    def on_ready(ports: Ready) -> None:
        opened.append(ports)
        if len(opened) == len(vehicle_setups):
            _print_ports(vehicle_setups, opened, as_json=common.json)

    viewer = show_view(make_message_console(), config) if view else nullcontext()
    with stop_on_signals() as stopped, viewer as on_snapshot:
        encounters = serve_all(
            vehicle_setups,
            duration_s=duration,
            airborne=airborne,
            on_ready=on_ready,
            stop=stopped,
            speed=speed,
            on_snapshot=on_snapshot,
            wrap_port=make_port_wrapper(config.security),
        )
    if vehicles > 1:
        _print_encounters(encounters, as_json=common.json)
    return 0


def _print_encounters(encounters: Encounters, *, as_json: bool) -> None:
    """Print collisions and the closest approach of each pair; times are since the start."""

    def list_fields(met: Collision | ClosestApproach) -> dict[str, object]:
        fields: dict[str, object] = {
            "time_s": round((met.at_ns - encounters.start_ns) * 1e-9, 3),
            "vehicles": met.vehicles,
            "distance_m": met.distance_m,
        }
        return fields | ({"speed_mps": met.speed_mps} if isinstance(met, Collision) else {})

    document = {
        "collisions": [list_fields(collision) for collision in encounters.collisions],
        "closest": [list_fields(approach) for approach in encounters.closest_approaches],
    }
    if as_json:
        write_document("sim_encounters", document)
        return
    for collision in encounters.collisions:
        sys.stdout.write(f"collision of {_describe(collision, encounters)} at {collision.speed_mps:.2f} m/s\n")
    for approach in encounters.closest_approaches:
        sys.stdout.write(f"closest {_describe(approach, encounters)}: {approach.distance_m:.3f} m\n")
    sys.stdout.flush()


def _describe(met: Collision | ClosestApproach, encounters: Encounters) -> str:
    first, second = met.vehicles
    return f"{first} and {second} after {(met.at_ns - encounters.start_ns) * 1e-9:.2f} s"


def _print_ports(vehicle_setups: Sequence[VehicleSetup], opened: Sequence[Ready], *, as_json: bool) -> None:
    vehicles = [
        {"system_id": setup.config.sim.system_id, "vehicle": ports.vehicle, "mocap": ports.mocap}
        for setup, ports in zip(vehicle_setups, opened, strict=True)
    ]
    if as_json:
        write_document("sim", {"vehicles": vehicles})
        return
    for vehicle in vehicles:
        sys.stdout.write(" ".join(f"{key} {value}" for key, value in vehicle.items()) + "\n")
    sys.stdout.flush()
