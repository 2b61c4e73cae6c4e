"""A trajectory's samples from a CSV file."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import msgspec

from uavctl.config.data_file import DataFileError, read_lines, refuse
from uavctl.config.mission import MissionConfig
from uavctl.config.problem import Problem
from uavctl.config.section import LARGEST, LONGEST_MOTION, Floats

_WANTED = "give lines of t, x, y, z in s and m, or of t, x, y, z, vx, vy, vz"
_WITHOUT, _WITH = 4, 7  # columns
_SHOWN = 40  # characters of a cell that is none
_LISTS = ("times_s", "positions_m", "velocities_mps")


def read_samples(mission: MissionConfig, folder: Path, found: list[Problem]) -> tuple[MissionConfig, dict[str, str]]:
    """The samples of `mission.trajectory.file` in its place, so that the configuration is complete in itself.

    Args:
        mission: As it was decoded.
        folder: Where a relative name starts from.
        found: What is wrong with the file is added here.

    Returns:
        The mission, and where the keys that come from the file stand: `file:line`, or the file for a whole list.
    """
    given, key = mission.trajectory, "mission.trajectory.file"
    if not given.file:
        return mission, {}
    if given.times_s or given.positions_m or given.velocities_mps:
        found.append(Problem(key, "there are samples in the table as well", "keep the file or the samples"))
        return mission, {}
    path = folder / given.file
    try:
        rows = _rows(path)
    except DataFileError as error:
        found.extend(Problem(key, reason, "mend the file") for reason in error.reasons)
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
    """Line number and values of each row, all of the same width."""
    lines = read_lines(path)
    rows = [(number, line.split(",")) for number, line in enumerate(lines, 1) if line.strip()]
    if rows and not any(_number(cell) is not None for cell in rows[0][1]):
        rows = rows[1:]  # a header
    if not rows:
        raise DataFileError((f"{path}: has no rows",))
    if len(rows) > LONGEST_MOTION:
        raise DataFileError((f"{path}: has {len(rows)} rows, more than {LONGEST_MOTION}",))
    width = len(rows[0][1])
    refuse(path, [f"{path}:{number}: {reason}" for number, cells in rows for reason in _wrong(cells, width)])
    return [(number, tuple(float(cell) for cell in cells)) for number, cells in rows]


def _three(values: Floats) -> tuple[float, float, float]:
    x, y, z = values
    return x, y, z


def _wrong(cells: list[str], width: int) -> Iterator[str]:
    """What is wrong with a row, if anything."""
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
