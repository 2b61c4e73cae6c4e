"""[mission] and sampled trajectories."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from uavctl.config.columns import TRAJECTORY, StatedColumn, quantity, read_header
from uavctl.config.document import (
    LARGEST,
    LARGEST_PLANT,
    LONGEST_MOTION,
    LONGEST_PATH,
    ConfigProblem,
    DataFileError,
    Floats,
    Number,
    Position,
    Section,
    read_lines,
    refuse,
)

# Mission of a flight: waypoints or a trajectory, and limits that close in.


class TrajectoryConfig(Section, frozen=True, kw_only=True):
    """A trajectory as samples; time counts from the first decision with a vehicle that takes setpoints."""

    times_s: Annotated[
        Floats, Meta(max_length=LONGEST_MOTION, description="times of the samples, increasing from 0 or later [s]")
    ] = ()
    positions_m: Annotated[
        tuple[Position, ...], Meta(max_length=LONGEST_MOTION, description="positions at these times, local NED [m]")
    ] = ()
    velocities_mps: Annotated[
        tuple[Position, ...],
        Meta(
            max_length=LONGEST_MOTION,
            description="velocities at these times, local NED [m/s]; without them they follow from the positions",
        ),
    ] = ()
    file: Annotated[
        str,
        Meta(
            max_length=LONGEST_PATH,
            description="CSV file with the samples instead, beside this file: columns t, x, y, z in s and m, and "
            "vx, vy, vz in m/s or none of them, in local NED; with a header line in the order that it states, by names "
            "and units as in `time_ms`, `east_m`, `height [cm]`, `v_north_mps`",
        ),
    ] = ""
    interpolation: Annotated[
        Literal["cubic", "linear"], Meta(description="between the samples: `cubic` spline, or `linear`")
    ] = "cubic"


class MissionConfig(Section, frozen=True, kw_only=True):
    """Waypoints, or a trajectory; with neither, `target.position_m` is held from start to end."""

    waypoints: Annotated[
        tuple[Position, ...],
        Meta(max_length=1000, description="positions to fly to, one after the other, local NED [m]"),
    ] = ()
    hold_s: Annotated[
        Number | Annotated[Floats, Meta(max_length=1000)],
        Meta(description="time at each waypoint, from the arrival on: one number, or one for each of them [s]"),
    ] = 0.0
    accept_m: Annotated[
        float, Meta(ge=0.001, le=1e6, description="a waypoint is reached when the estimate is this near to it [m]")
    ] = 0.3
    then: Annotated[
        Literal["hold", "land"],
        Meta(
            description="after the last waypoint's time, or the trajectory's end: `hold` that place, or `land`: brake "
            "and hand over to the vehicle's own landing"
        ),
    ] = "hold"
    trajectory: TrajectoryConfig = TrajectoryConfig()


class FenceConfig(Section, frozen=True, kw_only=True):
    """A limit of a state that changes in time, inside the constant one of `[sets]`."""

    state: Annotated[
        Annotated[str, Meta(max_length=100)] | Annotated[int, Meta(ge=0, lt=LARGEST_PLANT)],
        Meta(description="axis whose position is limited (`north`, `east`, `down`), or index of a state"),
    ]
    side: Annotated[Literal["lower", "upper"], Meta(description="which limit")]
    times_s: Annotated[
        Floats,
        Meta(min_length=1, max_length=1000, description="times, increasing; counted as those of the mission [s]"),
    ]
    values: Annotated[
        Floats,
        Meta(
            min_length=1,
            max_length=1000,
            description="limit at these times, a line in between, constant before and after [m, m/s, m/s²]",
        ),
    ]


# A trajectory's samples from a CSV file.


_WANTED = "give lines of t, x, y, z in s and m, or of t, x, y, z, vx, vy, vz"
_WITHOUT, _WITH = 4, 7  # columns
_SHOWN = 40  # characters of a cell that is none
_LISTS = ("times_s", "positions_m", "velocities_mps")


def read_samples(
    mission: MissionConfig, folder: Path, found: list[ConfigProblem]
) -> tuple[MissionConfig, dict[str, str]]:
    """The samples of `mission.trajectory.file` in its place, so that the configuration is complete in itself.

    Args:
        folder: Where a relative name starts from.
        found: What is wrong with the file is added here.

    Returns:
        The mission, and where the keys that come from the file stand: `file:line`, or the file for a whole list.
    """
    given, key = mission.trajectory, "mission.trajectory.file"
    if not given.file:
        return mission, {}
    if given.times_s or given.positions_m or given.velocities_mps:
        found.append(ConfigProblem(key, "there are samples in the table as well", "keep the file or the samples"))
        return mission, {}
    path = folder / given.file
    try:
        rows = _rows(path)
    except DataFileError as error:
        found.extend(ConfigProblem(key, reason, "mend the file") for reason in error.reasons)
        return mission, {}
    motion = msgspec.structs.replace(
        given,
        file="",
        times_s=tuple(row[0] for _, row in rows),
        positions_m=tuple(_three(row[1:4]) for _, row in rows),
        velocities_mps=tuple(_three(row[4:7]) for _, row in rows if len(row) == _WITH),
    )
    places = {}
    for name in _LISTS:
        places[f"mission.trajectory.{name}"] = str(path)
        places |= {f"mission.trajectory.{name}[{i}]": f"{path}:{line}" for i, (line, _) in enumerate(rows)}
    return msgspec.structs.replace(mission, trajectory=motion), places


def _rows(path: Path) -> list[tuple[int, Floats]]:
    """Line number and values of each row, as t, x, y, z and vx, vy, vz in s, m and m/s, all of the same width."""
    rows: list[tuple[int, list[str]]] = []
    for number, line in enumerate(read_lines(path), 1):
        text = line.strip()
        if text.startswith("#"):  # a comment, or a header in one
            cells = re.split(r"[,\s]+(?![^\[(]*[\])])", text.lstrip("# ").strip())
            if rows or len(cells) < _WITHOUT or not all(quantity(cell) for cell in cells):
                continue
            text = ",".join(cells)
        if text:
            rows.append((number, text.split(",")))
    columns, rows = _columns(path, rows)
    if not rows:
        raise DataFileError((f"{path}: has no rows",))
    if len(rows) > LONGEST_MOTION:
        raise DataFileError((f"{path}: has {len(rows)} rows, more than {LONGEST_MOTION}",))
    width = len(rows[0][1])
    refuse(path, [f"{path}:{number}: {reason}" for number, cells in rows for reason in _wrong(cells, width)])
    return [
        (number, tuple(float(cells[column.place]) * column.factor for column in columns or _in_order(width)))
        for number, cells in rows
    ]


def _in_order(width: int) -> list[StatedColumn]:
    return [StatedColumn(place, 1.0) for place in range(width)]


def _columns(path: Path, rows: list[tuple[int, list[str]]]) -> tuple[list[StatedColumn], list[tuple[int, list[str]]]]:
    """The columns by a header, none without one, and the rows below it.

    Raises:
        DataFileError: The header states what is not known, or not all that is needed.
    """
    if not rows or any(_number(cell) is not None for cell in rows[0][1]):
        return [], rows
    (line, cells), rows = rows[0], rows[1:]
    units = None
    if rows and not any(_number(cell) is not None for cell in rows[0][1]):
        units, rows = rows[0][1], rows[1:]
    found, wrong = read_header(cells, units, TRAJECTORY)
    names = list(TRAJECTORY)
    needed = names if any(name in found for name in names[_WITHOUT:]) else names[:_WITHOUT]
    if not wrong and (missing := [name for name in needed if name not in found]):
        wrong.append(f"the header has no column for {', '.join(missing)}; {_WANTED}")
    refuse(path, [f"{path}:{line}: {reason}" for reason in wrong])
    return [found[name] for name in needed], rows


def _three(values: Floats) -> tuple[float, float, float]:
    x, y, z = values
    return x, y, z


def _wrong(cells: list[str], width: int) -> Iterator[str]:
    """Yield the errors in a row."""
    if len(cells) not in (_WITHOUT, _WITH):
        yield f"has {len(cells)} columns; {_WANTED}"
    elif len(cells) != width:
        yield f"has {len(cells)} columns, the first row has {width}"
    for cell in cells:
        value = _number(cell)
        if value is None:
            yield f'"{cell.strip()[:_SHOWN]}" is not a finite number'
        elif abs(value) > LARGEST:
            yield f"{value:g} is beyond {LARGEST:g}"


def _number(cell: str) -> float | None:
    try:
        value = float(cell)
    except ValueError:
        return None
    return value if math.isfinite(value) else None
