"""A recording as tables: CSV, or Parquet with the extra `parquet`.

One file for each topic of records (and one for each list of records within); what was made for viewers is left out.
"""

from __future__ import annotations

import csv
import struct
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from enum import StrEnum
from pathlib import Path
from typing import Any, Protocol, Self
from urllib.parse import quote

import msgspec
from mcap.exceptions import McapError
from mcap.reader import make_reader

from logs.chunks import Message
from logs.encoding import decode
from logs.flat import Cell, Column, Kind, Tables
from logs.made_folders import all_or_none
from logs.outputs import check_free, unfinished
from logs.reader import finished, good_messages, segment_files
from logs.topics import HEADER, LIBRARY, is_view, record_type
from uavctl.data import Record
from uavctl.errors import RecordingError, UsageError

_BATCH_ROWS = 4096  # kept in memory for each Parquet table
CSV_ENCODING = "utf-8"


class TableFormat(StrEnum):
    """Formats of tables; the values are the files' suffixes."""

    CSV = "csv"
    PARQUET = "parquet"


class ExportedTable(msgspec.Struct, frozen=True, kw_only=True):
    """One file that was written."""

    file: str
    topic: str  # with the field's name after a dot: a list of records within
    rows: int
    columns: int


class Exported(msgspec.Struct, frozen=True, kw_only=True):
    """What was written of a recording."""

    tables: tuple[ExportedTable, ...]
    unknown: dict[str, int]  # records left out, by topics that this version does not know


Watch = Callable[[Iterable[Message], int | None, str], Iterable[Message]]
"""Looks at messages as they go by, for a progress bar: given them, their number if it is known, and what is done."""


def unwatched(messages: Iterable[Message], _total: int | None, _what: str) -> Iterable[Message]:
    """Nobody looks."""
    return messages


def known_number(flight: Path) -> int | None:
    """How many messages `good_messages` will give, by the recording's own statistics; None of a torn recording.

    Raises:
        RecordingError: There is no such recording.
    """
    if not finished(flight):
        return None
    number = 0
    for place, path in enumerate(segment_files(flight)):
        left_out = {HEADER, LIBRARY} if place else set()  # which later files repeat
        try:
            with path.open("rb") as file:
                summary = make_reader(file).get_summary()
        except (OSError, McapError, ValueError, struct.error):
            return None  # whoever reads on will say what is wrong
        if summary is None or summary.statistics is None:
            return None
        for channel, messages in summary.statistics.channel_message_counts.items():
            topic = summary.channels[channel].topic if channel in summary.channels else ""
            if not is_view(topic) and topic not in left_out:
                number += messages
    return number


def export_tables(
    flight: Path, folder: Path, kind: TableFormat, *, force: bool = False, watch: Watch = unwatched
) -> Exported:
    """Write the tables of a recording into a folder.

    The recording is read twice: first to see what columns its values need. Where the export does not come to its end,
    nothing new is left behind.

    Raises:
        RecordingError: It cannot be read, holds no record, or the files cannot be written.
        UsageError: A file exists and is not to be overwritten, the folder cannot be made, or `pyarrow` is not there.
    """
    begin = _writer(kind)
    tables, unknown, total = _survey(flight, watch)
    columns = tables.columns()
    if not columns:
        raise RecordingError(f"{flight}: no record of this version in it, so there is nothing to export")
    files = {name: folder / f"{file_stem(name)}.{kind.value}" for name in columns}
    targets = list(files.values())
    check_free(targets, force=force)
    rows: Counter[str] = Counter()
    with all_or_none(targets), unfinished(targets) as parts, ExitStack() as stack:
        writers = {name: stack.enter_context(begin(parts[files[name]], columns[name])) for name in columns}
        for topic, at_ns, record in _decoded(watch(good_messages(flight), total, "writing")):
            for name, row in tables.rows(topic, at_ns, record):
                writers[name].write(row)
                rows[name] += 1
    return Exported(
        tables=tuple(
            ExportedTable(file=str(files[name]), topic=name, rows=rows[name], columns=len(columns[name]))
            for name in columns
        ),
        unknown=dict(sorted(unknown.items())),
    )


def file_stem(table: str) -> str:
    """File name of a table, without its suffix; two tables never share one."""
    return ".".join(quote(part, safe="") for part in table.strip("/").split("/"))


def _survey(flight: Path, watch: Watch) -> tuple[Tables, Counter[str], int]:
    """Columns of all tables; records of unknown topics, counted; and the number of messages."""
    tables, unknown = Tables(), Counter[str]()
    total = 0

    def counted() -> Iterator[Message]:
        nonlocal total
        for message in good_messages(flight):
            total += 1
            if not _is_known(message.definition.topic):
                unknown[message.definition.topic] += 1
            yield message

    for topic, _, record in _decoded(watch(counted(), known_number(flight), "reading")):
        tables.learn(topic, record)
    return tables, unknown, total


def _decoded(messages: Iterable[Message]) -> Iterator[tuple[str, int, Record]]:
    for message in messages:
        topic = message.definition.topic
        if _is_known(topic):
            yield topic, message.at_ns, decode(topic, message.data, message.at_ns)


def _is_known(topic: str) -> bool:
    try:
        record_type(topic)
    except KeyError:
        return False
    return True


class _Writer(Protocol):
    """Writes one table."""

    def __enter__(self) -> Self: ...

    def __exit__(self, failed: type[BaseException] | None, *_: object) -> None: ...

    def write(self, row: list[Cell]) -> None:
        """Append a row."""
        ...


def _writer(kind: TableFormat) -> Callable[[Path, tuple[Column, ...]], _Writer]:
    """What writes a table of a format.

    Raises:
        UsageError: `pyarrow` is not there.
    """
    if kind is TableFormat.CSV:
        return _CsvFile
    try:
        import pyarrow  # noqa: F401 before anything is read or written
    except ImportError as missing:
        raise UsageError(
            "Parquet is written by pyarrow, which is not there; install uavctl[parquet], or take --to csv"
        ) from missing
    return _ParquetFile


class _CsvFile:
    """RFC 4180 with a line of names; floats with the digits that give the same float back; bytes in hexadecimal."""

    def __init__(self, path: Path, columns: tuple[Column, ...]) -> None:
        self._file = path.open("w", newline="", encoding=CSV_ENCODING)
        self._csv = csv.writer(self._file)
        self._bytes = tuple(place for place, column in enumerate(columns) if column.kind is Kind.BYTES)
        self._csv.writerow([column.name for column in columns])

    def __enter__(self) -> Self:
        return self

    def __exit__(self, failed: type[BaseException] | None, *_: object) -> None:
        self._file.close()

    def write(self, row: list[Cell]) -> None:
        for place in self._bytes:
            held = row[place]
            row[place] = held.hex() if isinstance(held, bytes) else None
        self._csv.writerow(row)


class _ParquetFile:
    """One row group for each batch; NaN stays NaN, a missing value is null, bytes are bytes."""

    def __init__(self, path: Path, columns: tuple[Column, ...]) -> None:
        import pyarrow as pa
        import pyarrow.parquet as pq

        types = {
            Kind.INTEGER: pa.int64(),
            Kind.FLOAT: pa.float64(),
            Kind.BOOLEAN: pa.bool_(),
            Kind.TEXT: pa.string(),
            Kind.BYTES: pa.binary(),
        }
        self._arrow: Any = pa
        self._columns = tuple((column.name, types[column.kind]) for column in columns)
        self._schema = pa.schema(self._columns)
        self._rows: list[list[Cell]] = []
        self._writer = pq.ParquetWriter(path, self._schema, compression="zstd")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, failed: type[BaseException] | None, *_: object) -> None:
        try:
            if failed is None:
                self._flush()
        finally:
            self._writer.close()

    def write(self, row: list[Cell]) -> None:
        self._rows.append(row)
        if len(self._rows) == _BATCH_ROWS:
            self._flush()

    def _flush(self) -> None:
        pa = self._arrow
        arrays = []
        for place, (name, kind) in enumerate(self._columns):
            try:
                arrays.append(pa.array([row[place] for row in self._rows], type=kind))
            except (OverflowError, pa.ArrowInvalid) as error:
                raise RecordingError(f"column {name}: Parquet has no place for one of its values ({error})") from error
        self._writer.write_table(pa.Table.from_arrays(arrays, schema=self._schema))
        self._rows.clear()
