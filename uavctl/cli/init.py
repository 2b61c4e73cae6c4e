"""Command `uavctl init`: a short configuration for a room, with the keys that matter by name."""

from __future__ import annotations

import math
import re
import sys
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from cyclopts import Parameter

from uavctl.check.parameters import compute_max_accel_mps2
from uavctl.cli.output import print_message
from uavctl.config import parse
from uavctl.errors import UsageError
from uavctl.wiring.controller import MIN_OUTSIDE_M, build_flight_design, compute_reference_limits
from uavctl.wiring.mission import compute_reference_range

WALL_M = MIN_OUTSIDE_M  # from a limit of the vehicle's centre to the wall; the envelope allows as much
TIMEOUT_S = 0.7  # COM_OF_LOSS_T and GUID_TIMEOUT of docs/first-flight.md: longest time of the last acceleration
MAX_ACCEL_MPS2 = {"px4": 4.0, "ardupilot": 2.0}  # of the presets
SIMULATED_VEHICLES = {"px4": "udpin://0.0.0.0:14540", "ardupilot": "tcp://127.0.0.1:5760"}  # as of `uavctl sim`
MIN_ACCEL_MPS2 = 1.0  # the wind of the presets is 0.6 m/s²; the rest is for flight
MIN_FLIGHT_M = 0.2  # least distance between the first and the last place at rest
MAX_SIZE_M = 1000.0
_WIDE_SIDE_M = 3.0
_ROUND_UP_M = 0.1  # the smallest size in a message is rounded up to a multiple
_AXES = ("length", "width", "height")

_TEXT = """\
# A room of {length:g} x {width:g} x {height:g} m (north x east x up), and a vehicle under {autopilot}.
# `uavctl design --config {file}` shows the design,
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
    autopilot: Annotated[Literal["px4", "ardupilot"], Parameter(help="autopilot of the vehicle")] = "px4",
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
    sizes = parse_sizes(room)
    name = "my-room.toml" if out == "-" else out
    text = format_room(sizes, autopilot, name)
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


def parse_sizes(room: str) -> tuple[float, float, float]:
    """Parse length, width and height [m] of a room.

    Raises:
        UsageError: They are not three lengths.
    """
    try:
        sizes = [float(part) for part in re.split("[x×X*]", room)]
    except ValueError:
        sizes = []
    if len(sizes) != len(_AXES) or not all(0.0 < size <= MAX_SIZE_M for size in sizes):
        raise UsageError(
            f"--room {room}: is not a size; give length x width x height in metres, each above 0 and at most "
            f"{MAX_SIZE_M:g}, as in 6x5x2.5"
        )
    length, width, height = sizes
    return length, width, height


def format_room(sizes: tuple[float, float, float], autopilot: str, file: str) -> str:
    """Return the configuration of a room of these sizes [m]."""
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
        accel=max(min(allowed_mps2, MAX_ACCEL_MPS2[autopilot]), MIN_ACCEL_MPS2),
        north=(-north, north),
        east=(-east, east),
        top=top,
        target=round(0.5 * top, 2),
        vehicle=SIMULATED_VEHICLES[autopilot],
    )


def _check_fits(sizes_m: tuple[float, float, float], autopilot: str) -> None:
    """Check that plans may rest in a room, and that places at rest are far enough apart.

    Raises:
        UsageError: A side is too short; the message has the shortest possible one.
    """
    length, width, height = (max(size_m, _WIDE_SIDE_M) for size_m in sizes_m)  # a room of this size always has a design
    config = parse(format_room((length, width, height), autopilot, "room"), "room").config
    design = build_flight_design(config)
    lower_m, upper_m = compute_reference_range(design.plant, design.state_set, compute_reference_limits(design))
    needed_m = np.array((length, width, height)) - (upper_m - lower_m) + MIN_FLIGHT_M
    short_sides = [
        f"a {name} of {size_m:g} m (at least {math.ceil(need_m / _ROUND_UP_M) * _ROUND_UP_M:.1f} m)"
        for name, size_m, need_m in zip(_AXES, sizes_m, needed_m.tolist(), strict=True)
        if size_m < need_m
    ]
    if short_sides:
        raise UsageError(
            f"--room: {', '.join(short_sides)} leaves no place to fly to, {WALL_M:g} m from walls and ceiling and "
            f"with room "
            "to stop"
        )
