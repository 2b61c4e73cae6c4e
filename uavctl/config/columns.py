"""Columns of a CSV file by the names and units that its header states; what it states and is not known is refused."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple

# Words for a quantity, as headers have them: the axis of local NED, and its sign.
_AXIS = {
    **dict.fromkeys(("x", "north", "n"), ("x", 1.0)),
    **dict.fromkeys(("y", "east", "e"), ("y", 1.0)),
    **dict.fromkeys(("z", "down", "d"), ("z", 1.0)),
    **dict.fromkeys(("height", "up", "altitude", "alt", "h"), ("z", -1.0)),
}
_TIME = ("t", "time", "times", "stamp", "timestamp")
_POSITION, _VELOCITY = ("", "p", "pos", "position"), ("v", "vel", "velocity", "speed")
_SECONDS = {"s": 1.0, "sec": 1.0, "seconds": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9, "min": 60.0}
_METRES = {"m": 1.0, "metres": 1.0, "meters": 1.0, "dm": 0.1, "cm": 0.01, "mm": 0.001, "km": 1000.0}
_SPEEDS = {
    **{unit + form: size for unit, size in _METRES.items() for form in ("ps", "/s")},
    **dict.fromkeys(("kmh", "km/h", "kmph"), 1.0 / 3.6),
}
TRAJECTORY_UNITS: Mapping[str, Mapping[str, float]] = {
    "t": _SECONDS,
    **dict.fromkeys("xyz", _METRES),
    **dict.fromkeys(("vx", "vy", "vz"), _SPEEDS),
}
# No two parts next to each other match the same characters, so that no blank is looked at again and again.
_NAME = re.compile(r"^(?P<name>[^\[(]*)(?:[\[(](?P<unit>[^\])]*)[\])])?$")


class StatedColumn(NamedTuple):
    """Place of a quantity in the rows, and what a number there is multiplied by."""

    column: int
    factor: float


def parse_heading(cell: str) -> tuple[str, float, str] | None:
    """What a heading names: `t`, `x`, `vx` …, its sign, and its unit (empty where it states none); None if nothing."""
    match = _NAME.match(cell.strip().strip("\"'").lower())
    if match is None:
        return None
    words = [word for word in re.split(r"[_\s.\-]+", match["name"]) if word]
    unit = (match["unit"] or "").strip()
    known_units = (*_SECONDS, *_METRES, *_SPEEDS)
    if not unit and len(words) > 1 and words[-1] in known_units:
        unit = words.pop()
    if len(words) == 1 and words[0] in _TIME:
        return "t", 1.0, unit
    kinds = [word for word in words if word in (*_POSITION, *_VELOCITY)]
    axes = [word for word in words if word in _AXIS]
    if len(words) == 1 and len(words[0]) == 2 and words[0][0] in "pv" and words[0][1] in _AXIS:
        kinds, axes = [words[0][0]], [words[0][1]]
    elif len(kinds) + len(axes) != len(words):
        return None
    if len(axes) != 1 or len(kinds) > 1:
        return None
    name, sign = _AXIS[axes[0]]
    return ("v" if kinds and kinds[0] in _VELOCITY else "") + name, sign, unit


def read_header(
    cells: Sequence[str], unit_cells: Sequence[str] | None, known_units: Mapping[str, Mapping[str, float]]
) -> tuple[dict[str, StatedColumn], list[str]]:
    """The columns of a header by quantity, and what is wrong with it.

    Args:
        cells: The headings.
        units: A row of units below them; None if there is none.
        wanted: Factor of each unit of each quantity that may be there; the first one is that of no statement.
    """
    columns: dict[str, StatedColumn] = {}
    problems: list[str] = []
    for index, cell in enumerate(cells):
        parsed, label = parse_heading(cell), f'column {index + 1}, "{cell.strip()[:40]}"'
        name, sign, unit = parsed or ("", 1.0, "")
        if name not in known_units:
            problems.append(f"{label}, is not a quantity that is known here; rename or remove the column")
            continue
        if unit_cells is not None and not unit:
            unit = unit_cells[index].strip().strip("[]()").lower() if index < len(unit_cells) else ""
        if unit and unit not in known_units[name]:
            problems.append(f'{label}: "{unit}" is not a unit of it; give one of {", ".join(known_units[name])}')
            continue
        if name in columns:
            problems.append(f"{label}, means the same as column {columns[name].column + 1}; keep one of them")
            continue
        columns[name] = StatedColumn(index, sign * (known_units[name][unit] if unit else 1.0))
    return columns, problems
