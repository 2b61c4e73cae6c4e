"""Command `uavctl init`: a short configuration for a room, with the keys that matter by name."""

from __future__ import annotations

import math
import re
import sys
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from cyclopts import Parameter

from uavctl.build.controller import LEAST_OUTSIDE_M, design_of, resting
from uavctl.build.mission import resting_places
from uavctl.check.parameters import compute_max_accel_mps2
from uavctl.cli.common import print_message
from uavctl.config import parse
from uavctl.errors import UsageError

WALL_M = LEAST_OUTSIDE_M  # between a wall and the limit of the vehicle's centre: so far the envelope lets it go
TIMEOUT_S = 0.7  # COM_OF_LOSS_T and GUID_TIMEOUT of docs/first-flight.md: so long the last acceleration may go on
MOST_MPS2 = {"px4": 4.0, "ardupilot": 2.0}  # of the presets
SIMULATED_VEHICLES = {"px4": "udpin://0.0.0.0:14540", "ardupilot": "tcp://127.0.0.1:5760"}  # as of `uavctl sim`
LEAST_MPS2 = 1.0  # holds the wind that the presets count on (0.6 m/s²), and leaves something to fly with
LEAST_M = 0.2  # between the places to rest in, so that there is somewhere to fly to
LARGEST_M = 1000.0
_WIDE_M = 3.0
_STEP_M = 0.1  # that a smallest size is rounded up to
_AXES = ("length", "width", "height")

_TEXT = """\
# A room of {length:g} x {width:g} x {height:g} m (north x east x up), and a vehicle under {autopilot}.
# `uavctl design --config {file}` says what it allows,
# `uavctl loopback --config {file}` flies it in simulation.
# Every other key is that of the base; `uavctl docs configuration` has them all.
base = "{base}"

[room]
# Where the vehicle's centre may be, from the origin in the middle of the floor: {wall:g} m from walls and ceiling.
north_m = [{north[0]:g}, {north[1]:g}]
east_m = [{east[0]:g}, {east[1]:g}]
height_m = [0.0, {top:g}]
# Largest acceleration north, and east. If setpoints stop, the vehicle keeps the last one until its own timeout:
# from rest in the middle, with {timeout:g} s (COM_OF_LOSS_T or GUID_TIMEOUT), it stands before the limits with this.
accel_mps2 = {accel:g}
# Largest speed north and east, and up and down.
speed_mps = 1.5
climb_mps = 1.0
# Where it flies to.
target_north_m = 0.0
target_east_m = 0.0
target_height_m = {target:g}

[envelope]
# How far beyond these limits it may be before it lands: to the walls.
outside_m = {wall:g}

[link]
# Share of positions that are lost, and how long the others take: from delay_s to delay_s + jitter_s.
loss = 0.3
delay_s = 0.03
jitter_s = 0.04

[daemon]
# Where the vehicle and the cameras are heard: the simulated ones of `uavctl sim`.
vehicle = "{vehicle}"
mocap = "udpin://0.0.0.0:14560"
"""


def init(
    *,
    autopilot: Annotated[Literal["px4", "ardupilot"], Parameter(help="what the vehicle flies under")] = "px4",
    room: Annotated[
        str,
        Parameter(
            allow_leading_hyphen=True, help="length (north), width (east) and height of the room [m]", metavar="LxWxH"
        ),
    ] = "6x5x2.5",
    out: Annotated[
        str,
        Parameter(allow_leading_hyphen=True, help="file to write, which must not exist; - writes to standard output"),
    ] = ("my-room.toml"),
) -> int:
    """Write a short configuration for a room: the keys that matter, by name; everything else has its default."""
    sizes = read_sizes(room)
    name = "my-room.toml" if out == "-" else out
    text = room_text(sizes, autopilot, name)
    _check_fits(sizes, autopilot)
    if out == "-":
        sys.stdout.write(text)
        return 0
    try:
        with Path(out).open("x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError as error:
        raise UsageError(f"{out}: is there already; give another file with --out, or remove it") from error
    except OSError as error:
        raise UsageError(f"{out}: cannot be written ({error.strerror}); give another file with --out") from error
    print_message(f"wrote {out}: limits {WALL_M:g} m from walls and ceiling; next: uavctl design --config {out}")
    return 0


def read_sizes(room: str) -> tuple[float, float, float]:
    """Length, width and height [m] of a room as it is typed.

    Raises:
        UsageError: They are not three lengths.
    """
    try:
        sizes = [float(part) for part in re.split("[x×X*]", room)]
    except ValueError:
        sizes = []
    if len(sizes) != len(_AXES) or not all(0.0 < size <= LARGEST_M for size in sizes):
        raise UsageError(
            f"--room {room}: is no room; give length x width x height in metres, each above 0 and at most "
            f"{LARGEST_M:g}, as in 6x5x2.5"
        )
    length, width, height = sizes
    return length, width, height


def room_text(sizes: tuple[float, float, float], autopilot: str, file: str) -> str:
    """The configuration of a room of these sizes [m]."""
    length, width, height = sizes
    top = round(height - WALL_M, 3)
    north, east = (round(0.5 * size - WALL_M, 3) for size in (length, width))
    allowed_mps2 = math.floor(compute_max_accel_mps2(max(min(north, east), 0.0), TIMEOUT_S) * 10.0) / 10.0
    return _TEXT.format(
        length=length,
        width=width,
        height=height,
        autopilot={"px4": "PX4", "ardupilot": "ArduPilot"}[autopilot],
        file=file,
        base=f"room-{autopilot}",
        wall=WALL_M,
        timeout=TIMEOUT_S,
        accel=max(min(allowed_mps2, MOST_MPS2[autopilot]), LEAST_MPS2),
        north=(-north, north),
        east=(-east, east),
        top=top,
        target=round(0.5 * top, 2),
        vehicle=SIMULATED_VEHICLES[autopilot],
    )


def _check_fits(sizes: tuple[float, float, float], autopilot: str) -> None:
    """See that plans may rest in a room, and somewhere to fly to is left.

    Raises:
        UsageError: A side is too short; the shortest possible one is told.
    """
    length, width, height = (max(size, _WIDE_M) for size in sizes)  # where there is a design in any case
    config = parse(room_text((length, width, height), autopilot, "room"), "room").config
    design = design_of(config)
    least, most = resting_places(design.plant, design.state_set, resting(design))
    needed = np.array((length, width, height)) - (most - least) + LEAST_M
    short = [
        f"a {name} of {size:g} m (at least {math.ceil(need / _STEP_M) * _STEP_M:.1f} m)"
        for name, size, need in zip(_AXES, sizes, needed.tolist(), strict=True)
        if size < need
    ]
    if short:
        raise UsageError(
            f"--room: {', '.join(short)} leaves no place to fly to, {WALL_M:g} m from walls and ceiling and with room "
            "to stop"
        )
