"""Export of records as rows of tables, nested values spread over columns.

A field keeps its name, and with it its unit. What it holds follows it:

* three numbers of a place: `position_m_x`, `_y`, `_z` (local NED: north, east, down);
* a list: `mean_0`, `mean_1` ...; a matrix: `cov_0_0`, `cov_0_1` ...; as many as the longest has;
* a record or a mapping within: `vehicle.armed`, `bad.crc`;
* a list of records: a table of its own, one row each; the field's own column counts them.

A missing value, and a place beyond a shorter list's end, is an empty cell.
"""

from __future__ import annotations

import csv
import types
import typing
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from enum import StrEnum
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import msgspec

from logs.recording.file_scan import RecordedMessage, count_by_topic
from logs.recording.output_files import refuse_existing_files, remove_on_error, write_temporary_files
from logs.recording.reader import explain_missing_end, find_segments, read_messages
from logs.recording.topics import HEADER, LIBRARY, decode, get_record_type, is_known, is_view
from uavctl.arrays import Array
from uavctl.config.load import find_nearest
from uavctl.errors import RecordingError, need
from uavctl.records import Record, Vec3, Vector

if TYPE_CHECKING:
    import pyarrow as pa

Cell = int | float | bool | str | bytes | None
_AXES = ("x", "y", "z")
_UTC = "utc"


class Instant(int):
    """Time in UTC [ns since 1970], which a table shows as a date."""


@dataclass(frozen=True)
class TableColumn:
    """One column of a table."""

    name: str
    kind: type  # of its cells: int, float, bool, str, bytes or `Instant`


Place = tuple[int | str, ...]  # of a column: numbers of fields and entries, and keys, which sort the columns
Spread = list[tuple[Place, str, type, Cell]]  # place, name, type and cell of each column
_LEAVES = (int, float, bool, str, bytes)


def spread(columns: Spread, value: Any, kind: Any, name: str = "", place: Place = ()) -> None:
    """Append the columns that a value's type or its length asks for; None makes empty cells.

    Raises:
        TypeError: no column can hold such values.
    """
    kind, origin, arguments = _take_apart(kind)
    if kind in _LEAVES:
        columns.append((place, name, kind, value))
    elif kind == Vec3:
        for index, axis in enumerate(_AXES):
            columns.append(((*place, index), f"{name}_{axis}", float, None if value is None else value[index]))
    elif kind == Array:
        spread(columns, None if value is None else value.tolist(), tuple[Vector, ...], name, place)
    elif origin is tuple and _is_record(arguments[0]):  # they stand in a table of their own
        columns.append((place, name, int, None if value is None else len(value)))
    elif origin is tuple and arguments[0] in _LEAVES:
        for index, item in enumerate(value or ()):
            columns.append(((*place, index), f"{name}_{index}", arguments[0], item))
    elif origin is tuple and arguments[-1] is Ellipsis:
        for index, item in enumerate(value or ()):
            spread(columns, item, arguments[0], f"{name}_{index}", (*place, index))
    elif origin is dict and arguments[1] is object:
        columns.append((place, name, str, None if value is None else msgspec.json.encode(value).decode()))
    elif origin is dict:
        for key, item in (value or {}).items():
            spread(columns, item, arguments[1], f"{name}.{key}", (*place, key))
    elif _is_record(kind):
        for index, field in enumerate(_list_fields(kind)):
            field_name = f"{name}.{field.name}" if name else field.name
            part = None if value is None else getattr(value, field.name)
            spread(columns, part, field.type, field_name, (*place, index))
    elif isinstance(kind, type) and issubclass(kind, StrEnum):
        columns.append((place, name, str, None if value is None else value.value))
    else:
        raise TypeError(f"no column can hold {kind}")


@cache
def _list_fields(kind: type[msgspec.Struct]) -> tuple[msgspec.structs.FieldInfo, ...]:
    return msgspec.structs.fields(kind)


@cache
def _take_apart(kind: Any) -> tuple[Any, Any, tuple[Any, ...]]:
    """Return a type without None, its origin (`tuple` of `tuple[int, ...]`), and the origin's arguments."""
    if isinstance(kind, types.UnionType) or typing.get_origin(kind) is typing.Union:
        (kind,) = (member for member in typing.get_args(kind) if member is not types.NoneType)
    return kind, typing.get_origin(kind), typing.get_args(kind)


def _is_record(kind: Any) -> bool:
    return isinstance(kind, type) and issubclass(kind, msgspec.Struct)


class _Table:
    """Columns and rows of one type of record, after columns that the table adds."""

    def __init__(self, lead: tuple[str, ...], kind: type[msgspec.Struct]) -> None:
        self._lead, self._kind = lead, kind
        self._columns: dict[Place, TableColumn] = {}
        self._places: list[Place] = []
        self.lists = tuple(_find_record_lists(kind))
        self.rows = 0
        self.learn(None)

    def learn(self, record: msgspec.Struct | None) -> None:
        """Add the columns that a record needs; None: those that all records of the type have."""
        columns: Spread = []
        spread(columns, record, self._kind)
        for place, name, kind, _ in columns:
            if place not in self._columns:
                self._columns[place] = TableColumn(name, kind)

    def columns(self) -> tuple[TableColumn, ...]:
        self._places = sorted(self._columns)
        lead = (TableColumn(name, Instant if name == _UTC else int) for name in self._lead)
        return (*lead, *(self._columns[place] for place in self._places))

    def row(self, lead: tuple[int, ...], record: msgspec.Struct) -> list[Cell]:
        self.rows += 1
        columns: Spread = []
        spread(columns, record, self._kind)
        cells = {place: cell for place, _, _, cell in columns}
        return [*lead, *map(cells.get, self._places)]


def _find_record_lists(kind: type[msgspec.Struct]) -> Iterator[tuple[str, type[msgspec.Struct]]]:
    """Return the fields that are lists of records, with the type of those records."""
    for field in _list_fields(kind):
        _, _, arguments = _take_apart(field.type)
        if arguments and arguments[-1] is Ellipsis and _is_record(arguments[0]):
            yield field.name, arguments[0]


class Tables:
    """Tables of a recording, by topic; a list of records within has the table `<topic>.<field>`.

    Each table begins with `log_time_ns`, the time by our clock, and `utc`, if the recording knows it. That of a list
    goes on with `row`, the row (from 0) of the topic's table that the list belongs to, and `place`, the place in the
    list (from 0).
    """

    def __init__(self) -> None:
        self._tables: dict[str, _Table] = {}
        self.zero_utc_ns = 0  # UTC of time 0 [ns since 1970]; 0: not known

    def declare(self, topic: str) -> None:
        """Make the tables of a topic, whether there are rows for them or not."""
        times = ("log_time_ns", _UTC) if self.zero_utc_ns else ("log_time_ns",)
        for field, kind in self._table(topic, times, get_record_type(topic)).lists:
            self._table(f"{topic}.{field}", (*times, "row", "place"), kind)

    def learn(self, topic: str, record: Record) -> None:
        """Look at a record to find the columns that it needs; all records come before the first row is asked for."""
        times = ("log_time_ns", _UTC) if self.zero_utc_ns else ("log_time_ns",)
        table = self._table(topic, times, type(record))
        table.learn(record)
        for field, kind in table.lists:
            for item in getattr(record, field):
                self._table(f"{topic}.{field}", (*times, "row", "place"), kind).learn(item)

    def columns(self) -> dict[str, tuple[TableColumn, ...]]:
        """Return the columns of each table, by its name."""
        return {name: self._tables[name].columns() for name in sorted(self._tables)}

    def rows(self, topic: str, at_ns: int, record: Record) -> Iterator[tuple[str, list[Cell]]]:
        """Return the rows of a record, each with its table's name; records come in the order of the recording."""
        table = self._tables[topic]
        number = table.rows
        times = (at_ns, at_ns + self.zero_utc_ns) if self.zero_utc_ns else (at_ns,)
        yield topic, table.row(times, record)
        for field, _ in table.lists:
            name = f"{topic}.{field}"
            for index, item in enumerate(getattr(record, field)):
                yield name, self._tables[name].row((*times, number, index), item)

    def _table(self, name: str, lead: tuple[str, ...], kind: type[msgspec.Struct]) -> _Table:
        if name not in self._tables:
            self._tables[name] = _Table(lead, kind)
        return self._tables[name]


_BATCH_ROWS = 4096  # kept in memory for each Parquet table
CSV_ENCODING = "utf-8"


class TableFormat(StrEnum):
    """Formats of tables; the values are the files' suffixes."""

    CSV = "csv"
    PARQUET = "parquet"


class ExportedTable(msgspec.Struct, frozen=True, kw_only=True):
    """One table file that was written."""

    file: str
    topic: str  # with the field's name after a dot: a list of records within
    rows: int
    columns: int


class Exported(msgspec.Struct, frozen=True, kw_only=True):
    """Result of an export."""

    tables: tuple[ExportedTable, ...]
    unknown: dict[str, int]  # records left out, by topics that this version does not know


Watch = Callable[[Iterable[RecordedMessage], int | None, str], Iterable[RecordedMessage]]
"""Looks at messages as they go by, for a progress bar: given them, their number if it is known, and the number done."""


def ignore_progress(messages: Iterable[RecordedMessage], _total: int | None, _what: str) -> Iterable[RecordedMessage]:
    """Ignore progress."""
    return messages


def count_messages(flight: Path) -> int | None:
    """Return how many messages `read_messages` will yield, by the recording's statistics; None if it is torn.

    Raises:
        RecordingError: There is no such recording.
    """
    if explain_missing_end(flight):
        return None
    number = 0
    for index, path in enumerate(find_segments(flight)):
        left_out = {HEADER, LIBRARY} if index else set()  # which later files repeat
        counts = count_by_topic(path)
        if counts is None:
            return None  # whoever reads on will say what is wrong
        number += sum(messages for topic, messages in counts.items() if not is_view(topic) and topic not in left_out)
    return number


def export_tables(
    flight: Path, folder: Path, kind: TableFormat, *, force: bool = False, watch: Watch = ignore_progress
) -> Exported:
    """Write the tables of a recording into a folder.

    The recording is read twice: first to see what columns its values need. Where the export does not come to its end,
    nothing new is left behind.

    Raises:
        RecordingError: It cannot be read, holds no record, or the files cannot be written.
        ExtraMissingError: `pyarrow` is not there.
        UsageError: A file exists and is not to be overwritten, or the folder cannot be made.
    """
    begin = _choose_writer(kind)
    tables, unknown, total = _find_columns(flight, watch)
    columns = tables.columns()
    if not columns:
        raise RecordingError(f"{flight}: no record of this version in it, so there is nothing to export")
    files = {name: folder / f"{make_file_stem(name)}.{kind.value}" for name in columns}
    targets = list(files.values())
    refuse_existing_files(targets, force=force)
    rows: Counter[str] = Counter()
    with remove_on_error(targets), write_temporary_files(targets) as parts, ExitStack() as stack:
        writers = {name: stack.enter_context(begin(parts[files[name]], columns[name])) for name in columns}
        for topic, at_ns, record in _decode_messages(watch(read_messages(flight), total, "writing")):
            for name, row in tables.rows(topic, at_ns, record):
                writers[name](row)
                rows[name] += 1
    return Exported(
        tables=tuple(
            ExportedTable(file=str(files[name]), topic=name, rows=rows[name], columns=len(columns[name]))
            for name in columns
        ),
        unknown=dict(sorted(unknown.items())),
    )


def make_file_stem(table: str) -> str:
    """Return the file name of a table without its suffix; no two tables share one."""
    return ".".join(quote(part, safe="") for part in table.strip("/").split("/"))


def _find_columns(flight: Path, watch: Watch) -> tuple[Tables, Counter[str], int]:
    """Return the columns of all tables, the number of records of unknown topics, and the number of messages."""
    tables, unknown = Tables(), Counter[str]()
    total = 0

    def counted() -> Iterator[RecordedMessage]:
        nonlocal total
        for message in read_messages(flight):
            total += 1
            tables.zero_utc_ns = message.zero_utc_ns
            if not is_known(message.definition.topic):
                unknown[message.definition.topic] += 1
            yield message

    for topic, _, record in _decode_messages(watch(counted(), count_messages(flight), "reading")):
        tables.learn(topic, record)
    return tables, unknown, total


def _decode_messages(messages: Iterable[RecordedMessage]) -> Iterator[tuple[str, int, Record]]:
    for message in messages:
        topic = message.definition.topic
        if is_known(topic):
            yield topic, message.at_ns, decode(topic, message.data, message.at_ns)


_Write = Callable[[list[Cell]], None]  # appends a row to a table
_Writer = Callable[[Path, tuple[TableColumn, ...]], AbstractContextManager[_Write]]


def _choose_writer(kind: TableFormat) -> _Writer:
    """Return the writer of a table format.

    Raises:
        ExtraMissingError: `pyarrow` is not there.
    """
    if kind is TableFormat.CSV:
        return _write_csv
    need("pyarrow", "parquet")  # before anything is read or written
    return _write_parquet


def _format_date(utc_ns: Cell) -> str:
    """Return a time in UTC [ns since 1970] as ISO 8601 has it, with all its digits."""
    seconds, ns = divmod(int(utc_ns or 0), 1_000_000_000)
    return f"{datetime.fromtimestamp(seconds, UTC):%Y-%m-%dT%H:%M:%S}.{ns:09d}Z"


@contextmanager
def _write_csv(path: Path, columns: tuple[TableColumn, ...]) -> Iterator[_Write]:
    """CSV (RFC 4180) with a line of names; floats are written so that they read back exactly, bytes in hexadecimal."""
    in_bytes = tuple(index for index, column in enumerate(columns) if column.kind is bytes)
    instants = tuple(index for index, column in enumerate(columns) if column.kind is Instant)
    with path.open("w", newline="", encoding=CSV_ENCODING) as file:
        rows = csv.writer(file)
        rows.writerow([column.name for column in columns])

        def write(row: list[Cell]) -> None:
            for index in in_bytes:
                value = row[index]
                row[index] = value.hex() if isinstance(value, bytes) else None
            for index in instants:
                row[index] = _format_date(row[index])
            rows.writerow(row)

        yield write


def make_arrow_table(columns: Sequence[TableColumn], rows: Sequence[Sequence[Cell]]) -> pa.Table:
    """Return rows as an Arrow table: NaN stays NaN, a missing value is null, bytes are bytes.

    Raises:
        RecordingError: A value has no place in it.
    """
    import pyarrow as pa

    fields, arrays = _make_arrow_fields(columns), []
    for place, (name, kind) in enumerate(fields):
        try:
            arrays.append(pa.array([row[place] for row in rows], type=kind))
        except (OverflowError, pa.ArrowInvalid) as error:
            raise RecordingError(f"column {name}: Arrow has no place for one of its values ({error})") from error
    return pa.Table.from_arrays(arrays, schema=pa.schema(fields))


def _make_arrow_fields(columns: Sequence[TableColumn]) -> list[tuple[str, pa.DataType]]:
    import pyarrow as pa

    types = {int: pa.int64(), float: pa.float64(), bool: pa.bool_(), str: pa.string(), bytes: pa.binary()}
    types[Instant] = pa.timestamp("ns", tz="UTC")
    return [(column.name, types[column.kind]) for column in columns]


@contextmanager
def _write_parquet(path: Path, columns: tuple[TableColumn, ...]) -> Iterator[_Write]:
    """Parquet with one row group for each batch; NaN stays NaN, a missing value is null, bytes are bytes."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    schema = pa.schema(_make_arrow_fields(columns))
    rows: list[list[Cell]] = []

    def flush() -> None:
        writer.write_table(make_arrow_table(columns, rows))
        rows.clear()

    def write(row: list[Cell]) -> None:
        rows.append(row)
        if len(rows) == _BATCH_ROWS:
            flush()

    with pq.ParquetWriter(path, schema, compression="zstd") as writer:
        yield write
        flush()


def list_tables(flight: Path) -> tuple[str, ...]:
    """Return the tables that a recording can be had as: its topics of records, and the lists of records within.

    Raises:
        RecordingError: It cannot be read.
    """
    topics = {message.definition.topic for message in read_messages(flight)}
    known_topics = sorted(filter(is_known, topics))
    return tuple(
        name
        for table in known_topics
        for name in (table, *(f"{table}.{field}" for field, _ in _find_record_lists(get_record_type(table))))
    )


def read_table(flight: Path, name: str) -> pa.Table:
    """Return one table of a recording as Arrow, with `time_s`, the time since the first record [s], as second column.

    Raises:
        RecordingError: The recording cannot be read, or has no such table.
    """
    import pyarrow as pa

    topic = name if is_known(name) else name.rpartition(".")[0]
    tables = Tables()
    records: list[tuple[int, Record]] = []
    first_ns = None
    for message in read_messages(flight):
        first_ns = message.at_ns if first_ns is None else first_ns
        tables.zero_utc_ns = message.zero_utc_ns
        if message.definition.topic == topic and is_known(topic):
            records.append((message.at_ns, decode(topic, message.data, message.at_ns)))
    if records:
        tables.declare(topic)
    if name not in tables.columns():
        names, why = list_tables(flight), "was made for viewers" if is_view(name) else "is not in it"
        raise RecordingError(f"{flight}: topic {name} {why}{find_nearest(name, names)}; there are {', '.join(names)}")
    for _, record in records:
        tables.learn(topic, record)
    columns = tables.columns()[name]
    table_rows = (row for at_ns, record in records for row in tables.rows(topic, at_ns, record))
    rows = [row for table, row in table_rows if table == name]
    table = make_arrow_table(columns, rows)
    times_ns = [int(row[0] or 0) for row in rows]
    seconds = pa.array([(at_ns - (first_ns or 0)) / 1e9 for at_ns in times_ns], type=pa.float64())
    return table.add_column(1, "time_s", seconds)
