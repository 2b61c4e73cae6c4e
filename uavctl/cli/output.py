"""Output of commands: documents, consoles, messages and tables.

A string is never markup: paths, units and texts of vehicles have brackets. Styles are those of `rich.text.Text`.
Help and refusals of the command line need this file, so it loads neither numpy nor the configuration.
"""

from __future__ import annotations

import sys
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout
from contextvars import ContextVar
from dataclasses import dataclass
from typing import TYPE_CHECKING, TextIO

from rich.cells import cell_len
from rich.console import Console, ConsoleOptions, JustifyMethod, RenderableType
from rich.table import Table
from rich.text import Text

if TYPE_CHECKING:
    import msgspec

    from logs.report.findings import Banner

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
_VERSIONS: dict[str, int] = {"bench": 2, "log/whatif": 2, "tune": 2}


def write_document(name: str, document: Mapping[str, object] | msgspec.Struct) -> None:
    """Write a JSON document, on one line, to standard output; its first key names the document and its version."""
    import msgspec

    fields = msgspec.to_builtins(document)
    text = msgspec.json.encode({"schema": f"uavctl/{name}/{_VERSIONS.get(name, 1)}", **fields}).decode()
    out = _DOCUMENT_STREAM.get() or sys.stdout
    out.write(text + "\n")
    out.flush()


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


def make_headline_text(headline: Banner) -> Text:
    """Return the first line of a recording's page, in its colour."""
    return Text.assemble((f"{headline.word}: ", _STYLES[headline.tone]), headline.text)


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
