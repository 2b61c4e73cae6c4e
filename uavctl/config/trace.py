"""A measured trace of losses and delays from a CSV file."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import msgspec

from uavctl.config.data_file import DataFileError, read_lines, refuse
from uavctl.config.link import LONGEST_TRACE, LinkConfig
from uavctl.config.problem import Problem
from uavctl.config.section import Floats

_COLUMN = "delay_s"


def read_trace(link: LinkConfig, folder: Path, found: list[Problem]) -> tuple[LinkConfig, dict[str, str]]:
    """The delays of `link.trace_file` in its place, so that the configuration is complete in itself.

    Args:
        link: As it was decoded.
        folder: Where a relative name starts from.
        found: What is wrong with the file is added here.

    Returns:
        The link, and where the keys that come from the file stand: `file:line`, or the file for the whole list.
    """
    key = "link.trace_file"
    if not link.trace_file:
        return link, {}
    if link.trace_s:
        found.append(Problem(key, "there are delays in link.trace_s as well", "keep the file or the list"))
        return link, {}
    path = folder / link.trace_file
    try:
        delays = _delays(path)
    except DataFileError as error:
        found.extend(Problem(key, reason, "mend the file") for reason in error.reasons)
        return link, {}
    return msgspec.structs.replace(link, trace_file="", trace_s=delays), {"link.trace_s": str(path)}


def _delays(path: Path) -> Floats:
    """Delay of each packet [s], infinite for a lost one."""
    rows = [(number, line.split(",")) for number, line in enumerate(read_lines(path), 1)]
    column, width = 0, 1
    if rows and any(cell.strip() == _COLUMN for cell in rows[0][1]):
        names = [cell.strip() for cell in rows[0][1]]
        column, width = names.index(_COLUMN), len(names)
        rows = rows[1:]
    if not rows:
        raise DataFileError((f"{path}: has no packets",))
    if len(rows) > LONGEST_TRACE:
        raise DataFileError((f"{path}: has {len(rows)} packets, more than {LONGEST_TRACE}",))
    refuse(path, [f"{path}:{number}: {reason}" for number, cells in rows for reason in _wrong(cells, column, width)])
    return tuple(_delay(cells[column]) for _, cells in rows)


def _wrong(cells: list[str], column: int, width: int) -> Iterator[str]:
    """What is wrong with a line, if anything."""
    if len(cells) != width:
        yield f"has {len(cells)} columns; give {'as many as the header' if width > 1 else 'one, or a header'}"
        return
    try:
        delay = _delay(cells[column])
    except ValueError:
        yield f'"{cells[column].strip()[:40]}" is not a number'
        return
    if not delay >= 0.0:
        yield f"{delay:g} is not a delay in s"


def _delay(cell: str) -> float:
    return float(cell) if cell.strip() else math.inf
