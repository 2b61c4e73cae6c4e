"""Common parts of commands: options, output, wide tables."""

from __future__ import annotations

import os
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

# What all commands share: --config, --set and --json, where output goes, and how a bad design is told.
# A string is never markup: paths, units and what vehicles say have brackets. Styles are those of `rich.text.Text`.


_FILE_WIDTH, _WIDEST = 120, 10_000

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

    def with_overrides(self, more: Sequence[str]) -> Common:
        """Return the options with further overrides of a command's own, which win."""
        return replace(self, overrides=(*self.overrides, *more))

    def show(
        self, name: str, document: Mapping[str, object] | msgspec.Struct, picture: Callable[[], RenderableType]
    ) -> None:
        """Write the result to standard output, as the JSON document `name` or as a picture for people."""
        if self.json:
            write_document(name, document)
        else:
            shown, console = picture(), pictures()
            if not sys.stdout.isatty():
                # Files and pipes have no width of their own; the usual 80 columns would fold tables and cut words.
                anything = console.options.update_width(_WIDEST)
                console.width = max(_FILE_WIDTH, Measurement.get(console, anything, shown).minimum)
            console.print(shown)


_DOCUMENTS: ContextVar[TextIO | None] = ContextVar("documents", default=None)


@contextmanager
def documents_alone() -> Iterator[None]:
    """Keep standard output for documents: what a controller of another package prints goes to standard error."""
    kept = _DOCUMENTS.set(sys.stdout)
    try:
        with redirect_stdout(sys.stderr):
            yield
    finally:
        _DOCUMENTS.reset(kept)


# Documents of which a key has gone, or means something else, since the first version; the others have version 1.
_VERSIONS: dict[str, int] = {}


def write_document(name: str, document: Mapping[str, object] | msgspec.Struct) -> None:
    """Write a JSON document, on one line, to standard output; its first key says which one it is, of which version."""
    fields = msgspec.to_builtins(document)
    text = msgspec.json.encode({"schema": f"uavctl/{name}/{_VERSIONS.get(name, 1)}", **fields}).decode()
    out = _DOCUMENTS.get() or sys.stdout
    out.write(text + "\n")
    out.flush()


def can_be_read(type_: object, path: object) -> None:
    """Refuse a path that cannot be read as a recording: reading a pipe would wait, a device has no end.

    Raises:
        ValueError: It is one, or a name that the system does not take.
    """
    del type_
    for one in path if isinstance(path, tuple) else (path,):
        try:
            mode = Path(str(one)).stat().st_mode
        except FileNotFoundError:
            continue  # told by who reads it
        except OSError as error:
            raise ValueError(f"{error.strerror}; give a recording") from error
        if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
            raise ValueError("it is a pipe or a device; give a recording")


DEFAULTS = Common()
Flight = Annotated[Path, Parameter(help="the recording", validator=can_be_read)]
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


def given_keys(**given: str | float | None) -> list[str]:
    """Overrides of those keys that a command's own options give; `__` stands for the dot in a key."""
    values = {key.replace("__", "."): value for key, value in given.items() if value is not None}
    return [f'{key}="{value}"' if isinstance(value, str) else f"{key}={value}" for key, value in values.items()]


def two_columns(title: str, rows: list[tuple[str, object]]) -> Table:
    """Return a table of names and values."""
    table = Table(title=title, show_header=False, title_justify="left")
    for name, value in rows:
        table.add_row(Text(name), Text(str(value)))
    return table


def columns(
    title: str,
    headings: Sequence[str],
    rows: Iterable[Iterable[RenderableType]],
    left: Collection[str] | None = None,
    *,
    fold: bool = False,
    lines: bool = False,
) -> Table:
    """A table with headings.

    Args:
        rows: Cells; a `Text` has a style.
        left: Headings of the columns that are set flush left, the others right; the first alone if None.
        fold: Go on in the next line where a column is too narrow, else cut.
        lines: Draw one between the rows.
    """
    table = Table(title=title or None, title_justify="left", show_lines=lines)
    for heading in headings:
        flush_left = heading in (headings[:1] if left is None else left)
        table.add_column(heading, justify="left" if flush_left else "right", overflow="fold" if fold else "ellipsis")
    for row in rows:
        table.add_row(*(Text(cell) if isinstance(cell, str) else cell for cell in row))
    return table


def counted(counts: Mapping[str, int]) -> str:
    """Counts in words, as in "126 track, 20 hold"."""
    return ", ".join(f"{number} {name}" for name, number in counts.items()) or "none"


LINE_S = 5.0  # between two lines of progress where no bar can be drawn


class _Bars(Progress):
    """Bars in a terminal; in a file or a pipe a line now and then, so that one who reads it sees that it goes on."""

    _told_s: float | None = None

    def advance(self, task_id: TaskID, advance: float = 1) -> None:
        """Go on by so many."""
        super().advance(task_id, advance)
        self._tell(task_id)

    def update(self, task_id: TaskID, **changes: Any) -> None:
        """Change what rich's own takes, by name."""
        super().update(task_id, **changes)
        self._tell(task_id)

    def _tell(self, task_id: TaskID) -> None:
        if self.console.is_terminal:
            return
        now_s = self.get_time()
        if self._told_s is None:
            self._told_s = now_s
        if now_s - self._told_s < LINE_S:
            return
        self._told_s = now_s
        task = self._tasks[task_id]
        done = "" if task.total is None else f": {round(task.completed, 1):.10g} of {round(task.total, 1):.10g}"
        # Not by the bar's own console, which would draw it.
        messages().print(f"{task.description or 'at work'}{done} ({task.elapsed or 0.0:.0f} s)", soft_wrap=True)


def bars(*more: ProgressColumn, auto_refresh: bool = True) -> Progress:
    """Progress among the messages, gone in the end: what is done, a bar, and `more`; else how many of all, and time.

    Where there is no terminal it is a line every five seconds.
    """
    counted = more or (MofNCompleteColumn(), TimeElapsedColumn())
    head = (TextColumn("{task.description}", markup=False), BarColumn())
    return _Bars(*head, *counted, console=messages(), transient=True, auto_refresh=auto_refresh)


class _Messages(Console):
    """Standard error, which may be gone: a flight does not end because nobody reads its messages any more."""

    def on_broken_pipe(self) -> None:
        """Send what comes to nobody, where rich would end the program."""
        with open(os.devnull, "w") as nobody:  # noqa: PTH123 (a name of the system's, not a path)
            os.dup2(nobody.fileno(), sys.stderr.fileno())


def messages() -> Console:
    """Return the console for messages and progress: standard error.

    Called interactive also where it is a file or a pipe: there rich shows no progress, but else would leave an empty
    line where the bar would have been.
    """
    return _Messages(stderr=True, force_interactive=True, markup=False, emoji=False)


def pictures() -> Console:
    """Return the console for results that people read: standard output."""
    return Console(markup=False, emoji=False)


def labelled(label: str, text: str, style: str = "yellow") -> Text:
    """Return a message that begins with a label in a style, as in "warning: ..."."""
    return Text.assemble((f"{label}:", style), f" {text}")


def warn(text: str) -> None:
    """Write a warning on a line of its own."""
    messages().print(text, style="yellow", soft_wrap=True)


_STYLES = {"good": "bold green", "mind": "bold yellow", "bad": "bold red"}


def first_line(main: Headline) -> Text:
    """Return the first line of a recording's page, in its colour."""
    return Text.assemble((f"{main.word}: ", _STYLES[main.tone]), main.text)


@contextmanager
def located(loaded: LoadedConfig) -> Iterator[None]:
    """Turn the error of a refused design into one with the file and line of the key to blame.

    Raises:
        ConfigError: In place of the DesignError.
    """
    try:
        yield
    except DesignError as error:
        raise ConfigError((describe_design_error(loaded.source, error),)) from error


# A table with more columns than a terminal has room for: several below each other.


_BETWEEN = 3  # a border and a blank on either side


@dataclass(frozen=True)
class Column:
    """A column of a table: heading, cells, alignment."""

    heading: str
    cells: Sequence[str]
    justify: JustifyMethod = "right"

    @property
    def width(self) -> int:
        """Width of the column with its border [characters]."""
        return max(map(cell_len, (self.heading, *self.cells))) + _BETWEEN


@dataclass(frozen=True)
class WideTable:
    """Table that is cut into as many as the width asks for, each beginning with the first column."""

    first: Column  # column that names the rows, in every table
    groups: Sequence[Sequence[Column]]  # columns that stay together where there is room for them
    sections: frozenset[int] = frozenset()  # rows that a line is drawn below

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[Table]:
        del console
        for columns in self._cut(options.max_width - 1 - self.first.width):
            table = Table()
            for column in (self.first, *columns):
                table.add_column(Text(column.heading), justify=column.justify, no_wrap=True)
            rows = zip(self.first.cells, *(column.cells for column in columns), strict=True)
            for number, row in enumerate(rows):
                table.add_row(*map(Text, row), end_section=number in self.sections)
            yield table

    def _cut(self, room: int) -> list[list[Column]]:
        """Return the columns of each table, of `room` characters beside the first column."""
        tables: list[list[Column]] = [[]]
        for group in self.groups:
            together = _width(group) <= room
            for piece in (list(group),) if together else ([column] for column in group):
                if tables[-1] and _width(tables[-1]) + _width(piece) > room:
                    tables.append([])
                tables[-1] += piece
        return tables


def _width(columns: Sequence[Column]) -> int:
    return sum(column.width for column in columns)
