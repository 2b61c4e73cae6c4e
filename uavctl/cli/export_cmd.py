"""`uavctl log export`: a recording for other programs."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter
from rich.console import Group, RenderableType
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table
from rich.text import Text

from logs.chunks import Message
from logs.export import Exported, TableFormat, Watch, export_tables
from logs.export_tlog import ExportedTlog, export_tlog
from logs.reader import lacks_end
from logs.summary import count
from uavctl.cli.common import Common, Flight, Json, messages, warn
from uavctl.errors import UsageError

TLOG = "tlog"


def export(
    flight: Flight,
    /,
    *,
    to: Annotated[Literal["csv", "parquet", "tlog"], Parameter(help="format")],
    out: Annotated[
        Path | None, Parameter(help="folder of the tables, or the .tlog to write; else beside the recording")
    ] = None,
    link: Annotated[str | None, Parameter(help="with tlog: this connection alone, as in vehicle; else all")] = None,
    force: Annotated[bool, Parameter(negative=(), help="write anew the files that exist")] = False,
    json: Json = False,
) -> int:
    """Write a recording as tables (CSV, or Parquet with uavctl[parquet]), or its raw MAVLink as a .tlog."""
    if to == TLOG:
        _export_tlog(flight, _tlog_file(flight, out), link, force=force, common=Common(json=json))
    elif link is not None:
        raise UsageError("--link is for --to tlog: tables hold all topics, the raw bytes of each connection in its own")
    else:
        folder = out if out is not None else flight.with_name(f"{flight.stem}-{to}")
        with _progress() as watch:
            exported = export_tables(flight, folder, TableFormat(to), force=force, watch=watch)
        Common(json=json).show(exported, lambda: _tables_picture(exported, folder))
        for topic, number in exported.unknown.items():
            warn(f"left out: {count(number, 'record')} of {topic}, which this version does not know")
    if cut := lacks_end(flight):
        warn(f"{cut}: exported up to there")
    return 0


def _export_tlog(flight: Path, file: Path, link: str | None, *, force: bool, common: Common) -> None:
    with _progress() as watch:
        exported = export_tlog(flight, file, link=link, force=force, watch=watch)
    common.show(exported, lambda: _tlog_picture(exported))
    if exported.left_out_bytes:
        warn(f"left out: {count(exported.left_out_bytes, 'byte')} that are no whole MAVLink packet")


def _tlog_file(flight: Path, out: Path | None) -> Path:
    if out is None:
        return flight.with_suffix(".tlog")
    return out / f"{flight.stem}.tlog" if out.is_dir() else out


@contextmanager
def _progress() -> Iterator[Watch]:
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=messages(), transient=True) as progress:

        def watch(records: Iterable[Message], total: int | None, what: str) -> Iterable[Message]:
            return progress.track(records, total=total, description=what)

        yield watch


def _tables_picture(exported: Exported, folder: Path) -> RenderableType:
    table = Table()
    for column in ("file", "rows", "columns"):
        table.add_column(column, justify="left" if column == "file" else "right", overflow="fold")
    for one in exported.tables:
        table.add_row(Text(Path(one.file).name), str(one.rows), str(one.columns))
    return Group(table, Text(f"in {folder}"))


def _tlog_picture(exported: ExportedTlog) -> RenderableType:
    table = Table()
    table.add_column("topic")
    table.add_column("packets", justify="right")
    for topic, packets in exported.packets.items():
        table.add_row(Text(topic), str(packets))
    return Group(table, Text(f"in {exported.file}"))
