"""Common parts of commands: options, output and wide tables.

All commands share --config, --set and --json, the place of their output, and the message of a refused design. A string
is never markup: paths, units and texts of vehicles have brackets. Styles are those of `rich.text.Text`.
"""

from __future__ import annotations

import stat
import sys
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout
from contextvars import ContextVar
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TextIO

import msgspec
from cyclopts import Parameter, validators
from rich.cells import cell_len
from rich.console import Console, ConsoleOptions, JustifyMethod, RenderableType
from rich.measure import Measurement
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, TaskID, TextColumn, TimeElapsedColumn
from rich.table import Table
from rich.text import Text

from uavctl.config import LoadedConfig, describe_design_error, load
from uavctl.config.document import MAX_DURATION_S, MAX_SEED
from uavctl.errors import ConfigError, DesignError

if TYPE_CHECKING:
    from logs.report.findings import Headline

_FILE_WIDTH, _MAX_WIDTH = 120, 10_000

Overrides = Annotated[
    tuple[str, ...],
    Parameter(
        name="--set",
        negative=(),
        show_default=False,
        metavar="KEY=VALUE",
        help="override one key, as in link.loss=0.3; may be repeated",
    ),
]


Json = Annotated[bool, Parameter(negative=(), help="one JSON document on standard output, nothing else")]
QuietJson = Annotated[Json, Parameter(show_default=False)]


@Parameter(name="*")
@dataclass(frozen=True)
class Common:
    """Options of every command that takes a configuration."""

    config: Annotated[
        str, Parameter(help="preset (paper, room, room-px4, room-ardupilot, room-hahn-stursberg) or TOML file")
    ] = "room"
    overrides: Overrides = ()
    json: QuietJson = False

    def load(self) -> LoadedConfig:
        """Load the configuration that the options ask for.

        Raises:
            ConfigError: With all problems found.
        """
        from sim.faults import check_fault_support  # a replay, which has a configuration of its own, needs no simulator

        loaded = load(self.config, self.overrides)
        check_fault_support(loaded)
        return loaded

    def with_overrides(self, extra: Sequence[str]) -> Common:
        """Return the options with further overrides, which win."""
        return replace(self, overrides=(*self.overrides, *extra))

    def show(
        self, name: str, document: Mapping[str, object] | msgspec.Struct, render: Callable[[], RenderableType]
    ) -> None:
        """Write the result to standard output, as the JSON document `name` or as a picture for people."""
        if self.json:
            write_document(name, document)
        else:
            renderable, console = render(), make_output_console()
            if not sys.stdout.isatty():
                # Files and pipes have no width; the default of 80 columns would fold tables and cut words.
                unlimited = console.options.update_width(_MAX_WIDTH)
                console.width = max(_FILE_WIDTH, Measurement.get(console, unlimited, renderable).minimum)
            console.print(renderable)


_DOCUMENT_STREAM: ContextVar[TextIO | None] = ContextVar("documents", default=None)


@contextmanager
def reserve_stdout() -> Iterator[None]:
    """Reserve standard output for documents; a print of another package's controller goes to standard error."""
    token = _DOCUMENT_STREAM.set(sys.stdout)
    try:
        with redirect_stdout(sys.stderr):
            yield
    finally:
        _DOCUMENT_STREAM.reset(token)


# Version of each document with a removed or changed key; every other document has version 1.
_VERSIONS: dict[str, int] = {"bench": 2, "tune": 2}


def write_document(name: str, document: Mapping[str, object] | msgspec.Struct) -> None:
    """Write a JSON document, on one line, to standard output; its first key names the document and its version."""
    fields = msgspec.to_builtins(document)
    text = msgspec.json.encode({"schema": f"uavctl/{name}/{_VERSIONS.get(name, 1)}", **fields}).decode()
    out = _DOCUMENT_STREAM.get() or sys.stdout
    out.write(text + "\n")
    out.flush()


def check_readable(type_: object, path: object) -> None:
    """Refuse a path that cannot be read as a recording: reading a pipe would wait, a device has no end.

    Raises:
        ValueError: The path is a pipe or a device, or a name that the system refuses.
    """
    del type_
    for name in path if isinstance(path, tuple) else (path,):
        try:
            mode = Path(str(name)).stat().st_mode
        except FileNotFoundError:
            continue  # the reader of the file reports it
        except OSError as error:
            raise ValueError(f"{error.strerror}; give a recording") from error
        if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
            raise ValueError("it is a pipe or a device; give a recording")


DEFAULTS = Common()
Flight = Annotated[Path, Parameter(help="the recording", validator=check_readable)]
System = Annotated[
    int | None,
    Parameter(
        help="with several vehicles' MAVLink: the vehicle's system id", validator=validators.Number(gte=1, lte=255)
    ),
]
SPAN_S = validators.Number(gt=0, lte=MAX_DURATION_S)
HEIGHT_M = validators.Number(gt=0, lte=1000)
SEED = validators.Number(gte=0, lte=MAX_SEED)
WORKERS = validators.Number(gte=1, lte=1024)
PORT = validators.Number(gte=1, lte=65535)
FREE_PORT = validators.Number(gte=0, lte=65535)
Mocap = Annotated[
    str | None, Parameter(help="URL of the positions; else daemon.mocap. The vehicle's own is one connection")
]
TakeOff = Annotated[
    float | None, Parameter(help="climb so far above the ground [m], then fly; needs --arm", validator=HEIGHT_M)
]


def make_key_overrides(**values_by_key: str | float | None) -> list[str]:
    """Return overrides of the keys that have a value; `__` stands for the dot in a key."""
    values = {key.replace("__", "."): value for key, value in values_by_key.items() if value is not None}
    return [f'{key}="{value}"' if isinstance(value, str) else f"{key}={value}" for key, value in values.items()]


def make_pair_table(title: str, rows: list[tuple[str, object]]) -> Table:
    """Return a table of names and values."""
    table = Table(title=title, show_header=False, title_justify="left")
    for name, value in rows:
        table.add_row(Text(name), Text(str(value)))
    return table


def make_table(
    title: str,
    headings: Sequence[str],
    rows: Iterable[Iterable[RenderableType]],
    left_headings: Collection[str] | None = None,
    *,
    fold: bool = False,
    lines: bool = False,
) -> Table:
    """Return a table with headings.

    Args:
        rows: Cells; a `Text` has a style.
        left_headings: Headings of the columns that are set flush left, the others right; the first alone if None.
        fold: Whether a cell that is too wide continues in the next line; else it is cut.
        lines: Whether a line is drawn between the rows.
    """
    table = Table(title=title or None, title_justify="left", show_lines=lines)
    for heading in headings:
        flush_left = heading in (headings[:1] if left_headings is None else left_headings)
        table.add_column(heading, justify="left" if flush_left else "right", overflow="fold" if fold else "ellipsis")
    for row in rows:
        table.add_row(*(Text(cell) if isinstance(cell, str) else cell for cell in row))
    return table


def format_counts(counts: Mapping[str, int]) -> str:
    """Return counts as text, as in "126 track, 20 hold"."""
    return ", ".join(f"{number} {name}" for name, number in counts.items()) or "none"


LINE_PERIOD_S = 5.0  # between two lines of progress where no bar can be drawn


class _ProgressLines(Progress):
    """Bars in a terminal; in a file or a pipe a line every few seconds."""

    _printed_s: float | None = None

    def advance(self, task_id: TaskID, advance: float = 1) -> None:
        """Advance a task by so many steps."""
        super().advance(task_id, advance)
        self._print_line(task_id)

    def update(self, task_id: TaskID, **changes: Any) -> None:
        """Change fields of a task, as in rich."""
        super().update(task_id, **changes)
        self._print_line(task_id)

    def _print_line(self, task_id: TaskID) -> None:
        if self.console.is_terminal:
            return
        now_s = self.get_time()
        if self._printed_s is None:
            self._printed_s = now_s
        if now_s - self._printed_s < LINE_PERIOD_S:
            return
        self._printed_s = now_s
        task = self._tasks[task_id]
        done = "" if task.total is None else f": {round(task.completed, 1):.10g} of {round(task.total, 1):.10g}"
        # Not by the bar's own console, which would draw it.
        print_message(f"{task.description or 'at work'}{done} ({task.elapsed or 0.0:.0f} s)")


def make_progress(*columns_after: ProgressColumn, auto_refresh: bool = True) -> Progress:
    """Return a progress bar on standard error, which is removed at the end.

    Without a terminal it is a line every five seconds.

    Args:
        columns_after: Columns after the bar; without any the count and the elapsed time.
        auto_refresh: A thread of its own draws.
    """
    trailing = columns_after or (MofNCompleteColumn(), TimeElapsedColumn())
    head = (TextColumn("{task.description}", markup=False), BarColumn())
    return _ProgressLines(*head, *trailing, console=make_message_console(), transient=True, auto_refresh=auto_refresh)


def make_message_console() -> Console:
    """Return the console for messages and progress: standard error.

    It counts as interactive also for a file or a pipe. So rich shows no progress there, and no empty line for a bar.
    """
    return Console(stderr=True, force_interactive=True, markup=False, emoji=False)


def make_output_console() -> Console:
    """Return the console for results that people read: standard output."""
    return Console(markup=False, emoji=False)


def print_message(content: RenderableType, *, style: str | None = None, highlight: bool | None = None) -> None:
    """Print a message on standard error; the terminal wraps its lines."""
    make_message_console().print(content, style=style, highlight=highlight, soft_wrap=True)


def label_text(label: str, text: str, style: str = "yellow") -> Text:
    """Return a message that begins with a label in a style, as in "warning: ..."."""
    return Text.assemble((f"{label}:", style), f" {text}")


def warn(text: str) -> None:
    """Write a warning on a line of its own."""
    print_message(text, style="yellow")


_STYLES = {"good": "bold green", "mind": "bold yellow", "bad": "bold red"}


def make_headline_text(headline: Headline) -> Text:
    """Return the first line of a recording's page, in its colour."""
    return Text.assemble((f"{headline.word}: ", _STYLES[headline.tone]), headline.text)


@contextmanager
def locate_design_errors(loaded: LoadedConfig) -> Iterator[None]:
    """Turn the error of a refused design into one with the file and line of its key.

    Raises:
        ConfigError: In place of the DesignError.
    """
    try:
        yield
    except DesignError as error:
        raise ConfigError((describe_design_error(loaded.source, error),)) from error


_BORDER_WIDTH = 3  # a border and a blank on either side


@dataclass(frozen=True)
class Column:
    """A column of a table: heading, cells, alignment."""

    heading: str
    cells: Sequence[str]
    justify: JustifyMethod = "right"

    @property
    def width(self) -> int:
        """Width of the column with its border [characters]."""
        return max(map(cell_len, (self.heading, *self.cells))) + _BORDER_WIDTH


@dataclass(frozen=True)
class WideTable:
    """Table that is cut into as many as the width asks for, each beginning with the first column."""

    first: Column  # column that names the rows, in every table
    groups: Sequence[Sequence[Column]]  # columns that stay together where there is room for them
    sections: frozenset[int] = frozenset()  # rows that a line is drawn below

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[Table]:
        del console
        for columns in self._split_columns(options.max_width - 1 - self.first.width):
            table = Table()
            for column in (self.first, *columns):
                table.add_column(Text(column.heading), justify=column.justify, no_wrap=True)
            rows = zip(self.first.cells, *(column.cells for column in columns), strict=True)
            for number, row in enumerate(rows):
                table.add_row(*map(Text, row), end_section=number in self.sections)
            yield table

    def _split_columns(self, width: int) -> list[list[Column]]:
        """Return the columns of each table, of `width` characters beside the first column."""
        tables: list[list[Column]] = [[]]
        for group in self.groups:
            fits = _sum_widths(group) <= width
            for piece in (list(group),) if fits else ([column] for column in group):
                if tables[-1] and _sum_widths(tables[-1]) + _sum_widths(piece) > width:
                    tables.append([])
                tables[-1] += piece
        return tables


def _sum_widths(columns: Sequence[Column]) -> int:
    return sum(column.width for column in columns)
