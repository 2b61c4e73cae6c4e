"""A table with more columns than a terminal has room for: several below each other."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from rich.cells import cell_len
from rich.console import Console, ConsoleOptions, JustifyMethod
from rich.table import Table

_BETWEEN = 3  # a border and a blank on either side


@dataclass(frozen=True)
class Column:
    """A heading, and what stands below it row by row."""

    heading: str
    cells: Sequence[str]
    justify: JustifyMethod = "right"

    @property
    def width(self) -> int:
        """Characters that it takes, with its border."""
        return max(map(cell_len, (self.heading, *self.cells))) + _BETWEEN


@dataclass(frozen=True)
class WideTable:
    """Columns that are cut into as many tables as the width asks for, each beginning with the same one.

    Attributes:
        first: Column that names the rows, in every table.
        groups: Columns that stay together where there is room for them.
        sections: Rows that a line is drawn below.
    """

    first: Column
    groups: Sequence[Sequence[Column]]
    sections: frozenset[int] = frozenset()

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[Table]:
        del console
        for columns in self._cut(options.max_width - 1 - self.first.width):
            table = Table()
            for column in (self.first, *columns):
                table.add_column(column.heading, justify=column.justify, no_wrap=True)
            rows = zip(self.first.cells, *(column.cells for column in columns), strict=True)
            for number, row in enumerate(rows):
                table.add_row(*row, end_section=number in self.sections)
            yield table

    def _cut(self, room: int) -> list[list[Column]]:
        """The columns table by table, of `room` characters each beside the first column."""
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
