"""A comparison in words and digits for people."""

from __future__ import annotations

import msgspec

from logs.compare import Likeness
from logs.compare_figures import Figure, Value
from logs.summary import count

_NONE = "–"


def likeness(one: Likeness) -> str:
    """How far a flight is the same as the first one."""
    where = one.parting
    if where is None:
        alike = count(one.records, "record")
        return f"{one.name} is the same flight as A: {alike} alike, bit for bit (computing times do not count)."
    if not one.records:
        return f"{one.name} is another flight than A from its first record on."
    field = f", {where.field}" if where.field else ""
    return (
        f"{one.name} is the same as A for {count(one.records, 'record')}, up to {where.flight_s:.3f} s. Then "
        f"{where.topic}{field}: {where.first} in A, {where.other} in {one.name}."
    )


def parameter(value: object) -> str:
    """A parameter's value."""
    if value is None:
        return _NONE
    return value if isinstance(value, str) else msgspec.json.encode(value).decode()


def for_people(figure: Figure) -> Figure:
    """A figure in the unit that people read it in: a share that is far below one in percent."""
    if figure.key != "largest_gap":
        return figure
    values, differences = (
        tuple(None if value is None else 100.0 * value for value in some)
        for some in (figure.values, figure.differences)
    )
    return msgspec.structs.replace(figure, unit="%", values=values, differences=differences)


def measured(value: Value) -> str:
    """A figure: four digits, and no exponent where people count without one."""
    if value is None:
        return _NONE
    return f"{value:.0f}" if isinstance(value, int) or 1e4 <= abs(value) < 1e6 else f"{value:.4g}"


def difference(value: Value) -> str:
    """A difference of figures, with its sign."""
    return f"+{measured(value)}" if value is not None and value > 0 else measured(value)


def label(figure: Figure) -> str:
    """What a figure is, with its unit."""
    return f"{figure.text}, {figure.unit}" if figure.unit else figure.text
