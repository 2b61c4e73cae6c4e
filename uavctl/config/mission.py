"""Mission of a flight: waypoints or a trajectory, from keys or a CSV file, and fences that close in."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import msgspec
from msgspec import Meta

from uavctl.config.document import (
    MAX_NUMBER,
    MAX_PATH_LENGTH,
    MAX_STATES,
    MAX_TRAJECTORY_SAMPLES,
    ConfigProblem,
    DataFileError,
    Floats,
    Number,
    Position,
    Section,
    declare,
    parse_number,
    read_row_lines,
    refuse_file,
)
from uavctl.config.polynomials import has_polynomials, sample_polynomials

MAX_WAYPOINTS = 1000
Angle = Annotated[float, Meta(ge=-180, le=180)]


class TrajectoryConfig(Section, frozen=True, kw_only=True):
    """A trajectory as samples; time counts from the first decision with a vehicle that takes setpoints."""

    times_s: Annotated[
        Floats, declare("times of the samples, increasing from 0", "s", length=MAX_TRAJECTORY_SAMPLES)
    ] = ()
    positions_m: Annotated[
        tuple[Position, ...], declare("positions at these times, local NED", "m", length=MAX_TRAJECTORY_SAMPLES)
    ] = ()
    velocities_mps: Annotated[
        tuple[Position, ...],
        declare(
            "velocities at these times, local NED; default: by the positions", "m/s", length=MAX_TRAJECTORY_SAMPLES
        ),
    ] = ()
    file: Annotated[
        str,
        declare(
            "CSV file with the samples, beside this one: t, x, y, z and perhaps vx, vy, vz; or with a header, as in "
            "`time_ms`, `east_m`, `height [cm]`; or polynomials of uav_trajectories: duration, x^0 … yaw^7 (yaw 0), "
            "with x east, y north, z up",
            length=MAX_PATH_LENGTH,
        ),
    ] = ""
    interpolation: Annotated[Literal["cubic", "linear"], declare("`cubic` spline, or `linear`")] = "cubic"


class MissionConfig(Section, frozen=True, kw_only=True):
    """Waypoints, or a trajectory; with neither, `target.position_m` is held."""

    waypoints: Annotated[
        tuple[Position, ...], declare("positions to fly to, local NED", "m", length=MAX_WAYPOINTS)
    ] = ()
    file: Annotated[
        str,
        declare(
            "CSV file of waypoints, beside this one; header: x, y, z, perhaps yaw [deg], or as in `north_m`, `yaw_rad`",
            length=MAX_PATH_LENGTH,
        ),
    ] = ""
    file_axes: Annotated[Literal["ned", "enu"], declare("its x, y, z and yaw; `enu`: yaw from east to north")] = "ned"
    hold_s: Annotated[
        Number | Annotated[Floats, Meta(max_length=1000)], declare("time at each waypoint: one, or a list", "s")
    ] = 0.0
    accept_m: Annotated[float, declare("distance at which a waypoint is reached", "m", 0.001, 1e6)] = 0.3
    then: Annotated[
        Literal["hold", "land"],
        declare("at the end: `hold` the place, or `land` (brake, then the vehicle's own landing)"),
    ] = "hold"
    yaw: Annotated[
        Literal["hold", "path", "angle"],
        declare("`hold` (no yaw setpoint), `path` (along the planned motion, from 0.3 m/s on) or `angle` (yaw_deg)"),
    ] = "hold"
    yaw_deg: Annotated[
        Angle | Annotated[tuple[Angle, ...], Meta(max_length=MAX_WAYPOINTS)] | None,
        declare("clockwise from north: one, or a list", "deg"),
    ] = None
    yaw_rate_dps: Annotated[float, declare("fastest turn; ArduPilot's own limit is 60", "deg/s", 1, 360)] = 60.0
    trajectory: TrajectoryConfig = TrajectoryConfig()
    cells: Annotated[bool, declare("fly in the moving cells of a fleet's coordinator only; see `uavctl fleet`")] = False


class FenceConfig(Section, frozen=True, kw_only=True):
    """A limit of a state that changes in time, inside the constant one of `[sets]`."""

    state: Annotated[
        Annotated[str, Meta(max_length=100)] | Annotated[int, Meta(ge=0, lt=MAX_STATES)],
        declare("axis whose position is limited, or index of a state"),
    ]
    side: Annotated[Literal["lower", "upper"], declare("limit")]
    times_s: Annotated[Floats, declare("times, increasing, from the first decision", "s", length=(1, 1000))]
    values: Annotated[Floats, declare("limits at these times, linear in between", "m, m/s, m/s²", length=(1, 1000))]


_FORMAT_HINT = "give lines of t, x, y, z in s and m, or of t, x, y, z, vx, vy, vz"
_POSITION_COLUMNS, _VELOCITY_COLUMNS = 4, 7  # columns
_MAX_SHOWN = 40  # characters of a cell that is none
_LISTS = ("times_s", "positions_m", "velocities_mps")


def read_mission_file(
    mission: MissionConfig, folder: Path, problems: list[ConfigProblem]
) -> tuple[MissionConfig, dict[str, str]]:
    """Put the content of the mission's file in its place, so that the configuration is complete in itself.

    Args:
        folder: Where a relative name starts from.
        problems: Problems of the file are added here.

    Returns:
        The mission, and where the keys that come from the file stand: `file:line`, or the file for a whole list.
    """
    if mission.file:
        return _read_waypoint_file(mission, folder, problems)
    trajectory, key = mission.trajectory, "mission.trajectory.file"
    if not trajectory.file:
        return mission, {}
    if trajectory.times_s or trajectory.positions_m or trajectory.velocities_mps:
        problems.append(ConfigProblem(key, "there are samples in the table as well", "keep the file or the samples"))
        return mission, {}
    path = folder / trajectory.file
    try:
        rows = _read_rows(path)
    except DataFileError as error:
        problems.extend(ConfigProblem(key, reason, "correct the file") for reason in error.reasons)
        return mission, {}
    samples = msgspec.structs.replace(
        trajectory,
        file="",
        times_s=tuple(row[0] for _, row in rows),
        positions_m=tuple(_make_vector(row[1:4]) for _, row in rows),
        velocities_mps=tuple(_make_vector(row[4:7]) for _, row in rows if len(row) == _VELOCITY_COLUMNS),
    )
    places = {}
    for name in _LISTS:
        places[f"mission.trajectory.{name}"] = str(path)
        places |= {f"mission.trajectory.{name}[{i}]": f"{path}:{line}" for i, (line, _) in enumerate(rows)}
    return msgspec.structs.replace(mission, trajectory=samples), places


def _read_waypoint_file(
    mission: MissionConfig, folder: Path, problems: list[ConfigProblem]
) -> tuple[MissionConfig, dict[str, str]]:
    """Return the mission with the waypoints of its file, and the line of each."""
    path = folder / mission.file
    if mission.waypoints or mission.trajectory != TrajectoryConfig() or mission.yaw_deg is not None:
        reason, todo = "waypoints, a trajectory or yaw_deg are given as well", "keep the file, or write its rows there"
        problems.append(ConfigProblem("mission.file", reason, todo))
        return mission, {}
    try:
        rows = _read_waypoint_rows(path, is_enu=mission.file_axes == "enu")
    except DataFileError as error:
        problems.extend(ConfigProblem("mission.file", reason, "correct the file") for reason in error.reasons)
        return mission, {}
    yaws_deg = tuple(row[3] for _, row in rows if len(row) > len(_AXES))
    if yaws_deg and mission.yaw == "path":
        problems.append(ConfigProblem("mission.yaw", "the file has a column for yaw", "remove one of them"))
    filled = msgspec.structs.replace(
        mission,
        file="",
        file_axes="ned",
        waypoints=tuple(_make_vector(row[:3]) for _, row in rows),
        **({"yaw": "angle", "yaw_deg": yaws_deg} if yaws_deg else {}),
    )
    places = {name: str(path) for name in ("mission.waypoints", "mission.yaw_deg")}
    return filled, places | {f"mission.waypoints[{i}]": f"{path}:{line}" for i, (line, _) in enumerate(rows)}


# Quantity and sign of the words in a header, and the factors of units.
_QUANTITIES = {
    **dict.fromkeys(("t", "time", "stamp", "timestamp"), ("t", 1.0)),
    **dict.fromkeys(("x", "north", "n"), ("x", 1.0)),
    **dict.fromkeys(("y", "east", "e"), ("y", 1.0)),
    **dict.fromkeys(("z", "down", "d"), ("z", 1.0)),
    **dict.fromkeys(("height", "up", "altitude", "alt", "h"), ("z", -1.0)),
    "yaw": ("yaw", 1.0),
}
_ENU_QUANTITIES = {**_QUANTITIES, "x": ("y", 1.0), "y": ("x", 1.0), "z": ("z", -1.0)}
_SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9, "min": 60.0}
_METRES = {"m": 1.0, "dm": 0.1, "cm": 0.01, "mm": 0.001, "km": 1000.0}
_SPEEDS = {unit + form: factor for unit, factor in _METRES.items() for form in ("ps", "/s")} | {"km/h": 1.0 / 3.6}
_AXES = ("x", "y", "z")
_UNITS = {"t": _SECONDS, **dict.fromkeys(_AXES, _METRES), **dict.fromkeys(("vx", "vy", "vz"), _SPEEDS)}
_WAYPOINT_UNITS = {**dict.fromkeys(_AXES, _METRES), "yaw": {"deg": 1.0, "°": 1.0, "rad": math.degrees(1.0)}}
_MAX_YAW_DEG = 360.0
# A word for position or velocity, a quantity, and a unit after `_` or in brackets: `pos_x`, `v_north [cm/s]`.
_HEADING = re.compile(
    rf"(?:p|pos|position|(?P<velocity>v|vel|velocity|speed))?[_\s.\-]*+(?P<quantity>{'|'.join(_QUANTITIES)})"
    r"(?:(?:[_\s]++|(?=[\[(]))[\[(]?(?P<unit>[^\])]*)[\])]?)?"
)


class StatedColumn(NamedTuple):
    """Column of a quantity in the rows, and the factor of its numbers."""

    column: int
    factor: float


def parse_heading(
    cell: str, quantities: Mapping[str, tuple[str, float]] = _QUANTITIES
) -> tuple[str, float, str] | None:
    """Return the quantity of a heading (`t`, `x`, `vx` …), its sign and its unit, or empty; None for no quantity."""
    match = _HEADING.fullmatch(cell.strip(" \"'").lower())
    if match is None:
        return None
    name, sign = quantities[match["quantity"]]
    return ("v" if match["velocity"] else "") + name, sign, (match["unit"] or "").strip()


def read_header(
    cells: Sequence[str],
    units: Mapping[str, Mapping[str, float]] = _UNITS,
    quantities: Mapping[str, tuple[str, float]] = _QUANTITIES,
) -> tuple[dict[str, StatedColumn], list[str]]:
    """Return the columns of a header by quantity, and its errors.

    Args:
        units: Factors of the units of each quantity that may stand there.
        quantities: Quantity and sign of each word.
    """
    columns: dict[str, StatedColumn] = {}
    problems: list[str] = []
    for index, cell in enumerate(cells):
        label = f'column {index + 1}, "{cell.strip()[:_MAX_SHOWN]}"'
        name, sign, unit = parse_heading(cell, quantities) or ("", 1.0, "")
        if name not in units:
            problems.append(f"{label}, is not a quantity that is known here; rename or remove the column")
        elif unit and unit not in units[name]:
            problems.append(f'{label}: "{unit}" is not a unit of it; give one of {", ".join(units[name])}')
        elif name in columns:
            problems.append(f"{label}, means the same as column {columns[name].column + 1}; keep one of them")
        else:
            columns[name] = StatedColumn(index, sign * (units[name][unit] if unit else 1.0))
    return columns, problems


# A cell of a header, without separators outside of brackets. A bracket without its end extends to the end of the line:
# a pattern that fails there would begin again at every later bracket, and take quadratic time.
_HEADER_CELL = re.compile(r"(?:[^,\s\[(]|[\[(][^\])]*[\])]?)+")


def _read_rows(path: Path) -> list[tuple[int, Floats]]:
    """Line number and values of each row, as t, x, y, z and vx, vy, vz in s, m and m/s, all of the same width."""
    lines: list[tuple[int, str]] = []
    for number, line in enumerate(read_row_lines(path), 1):
        text = line.strip()
        if text.startswith("#"):  # a comment, or a header in one
            cells = _HEADER_CELL.findall(text.lstrip("# "))
            if lines or len(cells) < _POSITION_COLUMNS or not all(parse_heading(cell) for cell in cells):
                continue
            text = ",".join(cells)
        if text:
            lines.append((number, text))
    if len(lines) > MAX_TRAJECTORY_SAMPLES + 1:  # more, also if the first one names the columns
        raise DataFileError((f"{path}: has {len(lines)} rows, more than {MAX_TRAJECTORY_SAMPLES}",))
    cells = [(number, text.split(",")) for number, text in lines]
    if cells and has_polynomials(cells[0][1]):
        return sample_polynomials(path, cells)
    columns, rows = _read_columns(path, cells)
    if not rows:
        raise DataFileError((f"{path}: has no rows",))
    if len(rows) > MAX_TRAJECTORY_SAMPLES:
        raise DataFileError((f"{path}: has {len(rows)} rows, more than {MAX_TRAJECTORY_SAMPLES}",))
    width = len(rows[0][1])
    refuse_file(
        path, [f"{path}:{number}: {reason}" for number, cells in rows for reason in _find_row_problems(cells, width)]
    )
    return [
        (
            number,
            tuple(float(cells[column.column]) * column.factor for column in columns or _make_default_columns(width)),
        )
        for number, cells in rows
    ]


def _make_default_columns(width: int) -> list[StatedColumn]:
    return [StatedColumn(index, 1.0) for index in range(width)]


def _read_columns(
    path: Path, rows: list[tuple[int, list[str]]]
) -> tuple[list[StatedColumn], list[tuple[int, list[str]]]]:
    """Return the columns by a header, none without one, and the rows below it.

    Raises:
        DataFileError: The header has unknown columns, or lacks required ones.
    """
    if not rows or any(parse_number(cell) is not None for cell in rows[0][1]):
        return [], rows
    (line, cells), rows = rows[0], rows[1:]
    columns, problems = read_header(cells)
    names = list(_UNITS)
    required = names if any(name in columns for name in names[_POSITION_COLUMNS:]) else names[:_POSITION_COLUMNS]
    if not problems and (missing := [name for name in required if name not in columns]):
        problems.append(f"the header has no column for {', '.join(missing)}; {_FORMAT_HINT}")
    refuse_file(path, [f"{path}:{line}: {reason}" for reason in problems])
    return [columns[name] for name in required], rows


def _read_waypoint_rows(path: Path, *, is_enu: bool) -> list[tuple[int, Floats]]:
    """Return line number and x, y, z and perhaps yaw of each row, in local NED [m] and clockwise from north [deg].

    Args:
        is_enu: x is east, y north, z up, and yaw turns from east to north.
    """
    lines = [(number, text) for number, line in enumerate(read_row_lines(path), 1) if (text := line.strip())]
    rows = [(number, text.split(",")) for number, text in lines if not text.startswith("#")]
    if not rows or any(parse_number(cell) is not None for cell in rows[0][1]):
        raise DataFileError((f"{path}:{rows[0][0] if rows else 1}: has no header; give x, y, z and perhaps yaw",))
    if not 0 < len(rows) - 1 <= MAX_WAYPOINTS:
        raise DataFileError((f"{path}: has {len(rows) - 1} waypoints; give 1 to {MAX_WAYPOINTS}",))
    (header_line, header), rows = rows[0], rows[1:]
    columns, problems = read_header(header, _WAYPOINT_UNITS, _ENU_QUANTITIES if is_enu else _QUANTITIES)
    if not problems and (missing := [axis for axis in _AXES if axis not in columns]):
        problems.append(f"the header has no column for {', '.join(missing)} of local NED; add it")
    refuse_file(path, [f"{path}:{header_line}: {reason}" for reason in problems])
    refuse_file(
        path, [f"{path}:{line}: {reason}" for line, cells in rows for reason in _find_waypoint_problems(cells, header)]
    )
    used = [columns[name] for name in _WAYPOINT_UNITS if name in columns]
    values = [(line, [float(cells[column.column]) * column.factor for column in used]) for line, cells in rows]
    refuse_file(
        path,
        [
            f"{path}:{line}: column {columns['yaw'].column + 1}, yaw: {row[3]:g} deg is beyond a turn; give -180 to 180"
            for line, row in values
            if len(row) > len(_AXES) and abs(row[3]) > _MAX_YAW_DEG
        ],
    )
    # ψ = 90° - ψ_ENU: clockwise from north
    return [
        (line, (*row[:3], *(math.remainder(90.0 - yaw_deg if is_enu else yaw_deg, 360.0) for yaw_deg in row[3:])))
        for line, row in values
    ]


def _find_waypoint_problems(cells: list[str], header: list[str]) -> Iterator[str]:
    """Yield the errors in a row of waypoints, each with its column."""
    if len(cells) != len(header):
        yield f"has {len(cells)} columns, the header has {len(header)}; give one number for each"
        return
    for number, (cell, heading) in enumerate(zip(cells, header, strict=True), 1):
        value, label = parse_number(cell), f"column {number}, {heading.strip()[:_MAX_SHOWN]}"
        if value is None:
            yield f'{label}: "{cell.strip()[:_MAX_SHOWN]}" is not a finite number; give one'
        elif abs(value) > MAX_NUMBER:
            yield f"{label}: {value:g} is beyond {MAX_NUMBER:g}; check its unit"


def _make_vector(values: Floats) -> tuple[float, float, float]:
    x, y, z = values
    return x, y, z


def _find_row_problems(cells: list[str], width: int) -> Iterator[str]:
    """Yield the errors in a row."""
    if len(cells) not in (_POSITION_COLUMNS, _VELOCITY_COLUMNS):
        yield f"has {len(cells)} columns; {_FORMAT_HINT}"
    elif len(cells) != width:
        yield f"has {len(cells)} columns, the first row has {width}"
    for cell in cells:
        value = parse_number(cell)
        if value is None:
            yield f'"{cell.strip()[:_MAX_SHOWN]}" is not a finite number'
        elif abs(value) > MAX_NUMBER:
            yield f"{value:g} is beyond {MAX_NUMBER:g}"
