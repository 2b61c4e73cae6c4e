"""A trajectory's samples from a CSV file."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import msgspec

from uavctl.config.mission import MissionConfig, TrajectoryConfig
from uavctl.config.problem import Problem
from uavctl.config.section import Floats

_TOLD = 5  # bad rows that are told one by one
_WANTED = "give lines of t, x, y, z in s and m, or of t, x, y, z, vx, vy, vz"
_WITHOUT, _WITH = 4, 7  # columns


def read_samples(mission: MissionConfig, folder: Path, found: list[Problem]) -> MissionConfig:
    """The samples of `mission.trajectory.file` in its place, so that the configuration is complete in itself.

    Args:
        mission: As it was decoded.
        folder: Where a relative name starts from.
        found: What is wrong with the file is added here.
    """
    given, key = mission.trajectory, "mission.trajectory.file"
    if not given.file:
        return mission
    if given.times_s or given.positions_m or given.velocities_mps:
        found.append(Problem(key, "there are samples in the table as well", "keep the file or the samples"))
        return mission
    try:
        motion = _with_samples(given, folder)
    except _SamplesError as error:
        found.extend(Problem(key, reason, "mend the file") for reason in error.reasons)
        return mission
    return msgspec.structs.replace(mission, trajectory=motion)


class _SamplesError(Exception):
    """What is wrong with the file: one reason a line, each with file and line."""

    def __init__(self, reasons: tuple[str, ...]) -> None:
        super().__init__("\n".join(reasons))
        self.reasons = reasons


def _with_samples(given: TrajectoryConfig, folder: Path) -> TrajectoryConfig:
    path = folder / given.file
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except OSError as error:
        raise _SamplesError((f"{path}: cannot be read ({error.strerror})",)) from error
    except UnicodeDecodeError as error:
        raise _SamplesError((f"{path}: is not UTF-8 text",)) from error
    rows = [(number, line.split(",")) for number, line in enumerate(lines, 1) if line.strip()]
    if rows and not any(_number(cell) is not None for cell in rows[0][1]):
        rows = rows[1:]  # a header
    if not rows:
        raise _SamplesError((f"{path}: has no rows",))
    width = len(rows[0][1])
    wrong = [f"{path}:{number}: {reason}" for number, cells in rows for reason in _wrong(cells, width)]
    if wrong:
        more = (f"{path}: {len(wrong) - _TOLD} more",) if len(wrong) > _TOLD else ()
        raise _SamplesError((*wrong[:_TOLD], *more))
    values = [tuple(float(cell) for cell in cells) for _, cells in rows]
    return msgspec.structs.replace(
        given,
        file="",
        times_s=tuple(row[0] for row in values),
        positions_m=tuple(_three(row[1:4]) for row in values),
        velocities_mps=tuple(_three(row[4:7]) for row in values if width == _WITH),
    )


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
        if _number(cell) is None:
            yield f'"{cell.strip()}" is not a finite number'


def _number(cell: str) -> float | None:
    try:
        value = float(cell)
    except ValueError:
        return None
    return value if math.isfinite(value) else None
