"""Records as rows of tables: nested values spread over columns, whose number the recording's own values tell.

A field keeps its name, and with it its unit. What it holds follows it:

* three numbers of a place: `position_m_x`, `_y`, `_z` (local NED: north, east, down);
* a list: `mean_0`, `mean_1` ...; a matrix: `cov_0_0`, `cov_0_1` ...; as many as the longest has;
* a record or a mapping within: `vehicle.armed`, `bad.crc`;
* a list of records: a table of its own, one row each; the field's own column counts them.

A missing value, and a place beyond a shorter list's end, is an empty cell.
"""

from __future__ import annotations

import types
import typing
from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum, StrEnum
from typing import Any, Protocol

import msgspec

from uavctl.data import Record, Vec3

Cell = int | float | bool | str | bytes | None
_AXES = ("x", "y", "z")


class Kind(Enum):
    """What a column holds."""

    INTEGER = "integer"
    FLOAT = "float"
    BOOLEAN = "boolean"
    TEXT = "text"
    BYTES = "bytes"


@dataclass(frozen=True)
class Column:
    """One column of a table."""

    name: str
    kind: Kind


class _Form(Protocol):
    """How values of one type stand in columns; told all values first, then asked for the cells of each."""

    def learn(self, value: Any) -> None:
        """See how many columns a value needs."""
        ...

    def columns(self, name: str) -> Iterator[Column]:
        """The columns that all values need, each beginning with `name`."""
        ...

    def put(self, value: Any, row: list[Cell]) -> None:
        """Append a value's cells, one for each column."""
        ...


class _Leaf:
    """One column."""

    def __init__(self, kind: Kind) -> None:
        self._kind = kind

    def learn(self, value: Any) -> None:
        """Nothing depends on the value."""

    def columns(self, name: str) -> Iterator[Column]:
        yield Column(name, self._kind)

    def put(self, value: Any, row: list[Cell]) -> None:
        row.append(value)


class _Choice(_Leaf):
    """An enumeration, by its values."""

    def put(self, value: Any, row: list[Cell]) -> None:
        row.append(None if value is None else value.value)


class _Json(_Leaf):
    """Anything, as JSON text."""

    def put(self, value: Any, row: list[Cell]) -> None:
        row.append(None if value is None else msgspec.json.encode(value).decode())


class _Count(_Leaf):
    """How many records a list has; they stand in a table of their own."""

    def put(self, value: Any, row: list[Cell]) -> None:
        row.append(None if value is None else len(value))


class _Place:
    """Three numbers: one each axis."""

    def learn(self, value: Any) -> None:
        """Nothing depends on the value."""

    def columns(self, name: str) -> Iterator[Column]:
        yield from (Column(f"{name}_{axis}", Kind.FLOAT) for axis in _AXES)

    def put(self, value: Any, row: list[Cell]) -> None:
        row.extend((None,) * len(_AXES) if value is None else value)


class _List:
    """As many as the longest has."""

    def __init__(self, item: type) -> None:
        self._item = item
        self._forms: list[_Form] = []

    def learn(self, value: Any) -> None:
        for place, one in enumerate(value or ()):
            if place == len(self._forms):
                self._forms.append(_form(self._item))
            self._forms[place].learn(one)

    def columns(self, name: str) -> Iterator[Column]:
        for place, form in enumerate(self._forms):
            yield from form.columns(f"{name}_{place}")

    def put(self, value: Any, row: list[Cell]) -> None:
        held = value or ()
        for place, form in enumerate(self._forms):
            form.put(held[place] if place < len(held) else None, row)


class _Mapping:
    """One each key that any of them has, in the keys' order."""

    def __init__(self, item: type) -> None:
        self._item = item
        self._forms: dict[str, _Form] = {}

    def learn(self, value: Any) -> None:
        for key, one in (value or {}).items():
            if key not in self._forms:
                self._forms = dict(sorted([*self._forms.items(), (key, _form(self._item))]))
            self._forms[key].learn(one)

    def columns(self, name: str) -> Iterator[Column]:
        for key, form in self._forms.items():
            yield from form.columns(f"{name}.{key}")

    def put(self, value: Any, row: list[Cell]) -> None:
        held = value or {}
        for key, form in self._forms.items():
            form.put(held.get(key), row)


class _Fields:
    """A record, field by field."""

    def __init__(self, kind: type[msgspec.Struct]) -> None:
        self._forms = {field.name: _form(field.type) for field in msgspec.structs.fields(kind)}

    def learn(self, value: Any) -> None:
        if value is not None:
            for name, form in self._forms.items():
                form.learn(getattr(value, name))

    def columns(self, name: str) -> Iterator[Column]:
        for field, form in self._forms.items():
            yield from form.columns(f"{name}.{field}" if name else field)

    def put(self, value: Any, row: list[Cell]) -> None:
        for name, form in self._forms.items():
            form.put(None if value is None else getattr(value, name), row)


_LEAVES = {int: Kind.INTEGER, float: Kind.FLOAT, bool: Kind.BOOLEAN, str: Kind.TEXT, bytes: Kind.BYTES}


def _form(kind: Any) -> _Form:
    """The form of a field's type; None is an empty cell of any type.

    Raises:
        TypeError: no table has a place for such values.
    """
    kind = _present(kind)
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if kind in _LEAVES:
        return _Leaf(_LEAVES[kind])
    if kind == Vec3:
        return _Place()
    if origin is tuple and arguments[-1] is Ellipsis:
        return _Count(Kind.INTEGER) if _is_record(arguments[0]) else _List(arguments[0])
    if origin is dict:
        return _Json(Kind.TEXT) if arguments[1] is object else _Mapping(arguments[1])
    if isinstance(kind, type) and issubclass(kind, StrEnum):
        return _Choice(Kind.TEXT)
    if _is_record(kind):
        return _Fields(kind)
    raise TypeError(f"no column can hold {kind}")


def _present(kind: Any) -> Any:
    """The type without None."""
    if isinstance(kind, types.UnionType) or typing.get_origin(kind) is typing.Union:
        (rest,) = (one for one in typing.get_args(kind) if one is not types.NoneType)
        return rest
    return kind


def _is_record(kind: Any) -> bool:
    return isinstance(kind, type) and issubclass(kind, msgspec.Struct)


class _Table:
    """Columns and rows of one type of record, after columns of its own."""

    def __init__(self, lead: tuple[str, ...], kind: type[msgspec.Struct]) -> None:
        self._lead = lead
        self._form = _Fields(kind)
        self.lists = tuple(_lists(kind))
        self.rows = 0

    def learn(self, record: msgspec.Struct) -> None:
        self._form.learn(record)

    def columns(self) -> tuple[Column, ...]:
        return (*(Column(name, Kind.INTEGER) for name in self._lead), *self._form.columns(""))

    def row(self, lead: tuple[int, ...], record: msgspec.Struct) -> list[Cell]:
        self.rows += 1
        row: list[Cell] = [*lead]
        self._form.put(record, row)
        return row


def _lists(kind: type[msgspec.Struct]) -> Iterator[tuple[str, type[msgspec.Struct]]]:
    """Fields that are lists of records, and what the records are."""
    for field in msgspec.structs.fields(kind):
        arguments = typing.get_args(_present(field.type))
        if arguments and arguments[-1] is Ellipsis and _is_record(arguments[0]):
            yield field.name, arguments[0]


class Tables:
    """The tables of a recording, by topic; a list of records within has the name `<topic>.<field>`.

    Each table begins with `log_time_ns`. That of a list goes on with `row`, the row (from 0) of the topic's table that
    the list belongs to, and `place`, the place in the list (from 0).
    """

    def __init__(self) -> None:
        self._tables: dict[str, _Table] = {}

    def learn(self, topic: str, record: Record) -> None:
        """See what columns a record needs. All records are seen before the first row is asked for."""
        table = self._table(topic, ("log_time_ns",), type(record))
        table.learn(record)
        for field, kind in table.lists:
            for one in getattr(record, field):
                self._table(f"{topic}.{field}", ("log_time_ns", "row", "place"), kind).learn(one)

    def columns(self) -> dict[str, tuple[Column, ...]]:
        """Columns of each table, by its name."""
        return {name: self._tables[name].columns() for name in sorted(self._tables)}

    def rows(self, topic: str, at_ns: int, record: Record) -> Iterator[tuple[str, list[Cell]]]:
        """A record's rows, each with its table's name; records come in the order of the recording."""
        table = self._tables[topic]
        number = table.rows
        yield topic, table.row((at_ns,), record)
        for field, _ in table.lists:
            name = f"{topic}.{field}"
            for place, one in enumerate(getattr(record, field)):
                yield name, self._tables[name].row((at_ns, number, place), one)

    def _table(self, name: str, lead: tuple[str, ...], kind: type[msgspec.Struct]) -> _Table:
        if name not in self._tables:
            self._tables[name] = _Table(lead, kind)
        return self._tables[name]
