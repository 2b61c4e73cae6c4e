"""What `uavctl tune` shows on the terminal: the changes, and both flights beside each other."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from rich.console import Group, RenderableType
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from uavctl.tune.change import TunedResult
from uavctl.tune.run_folder import PAGE, TUNED, TuneProgress
from uavctl.tune.words import CHANGE_COLUMNS, FIGURE_COLUMNS, change_rows, error_columns, error_rows, figure_rows, story


def changes_picture(told: TunedResult) -> RenderableType:
    """Old and new values, and how well both models predict what they were not fitted to."""
    columns = error_columns(told.old_errors)
    return Group(
        _table("Configuration", CHANGE_COLUMNS, change_rows(told), frozenset({1, 2, 3})),
        _table(
            "Prediction on halves of the flight not fitted to, rms",
            columns,
            error_rows(told.old_errors, told.new_errors),
            frozenset(range(2, len(columns))),
        ),
        *(Text(f"{one}.", style="yellow") for one in told.warnings),
    )


def comparison_picture(progress: TuneProgress, folder: Path) -> RenderableType:
    """How far the run has come."""
    parts: list[RenderableType] = []
    if progress.tuned is not None:
        parts += [Text(one) for one in story(progress.tuned, progress.comparison)]
    if progress.comparison is not None:
        rows = figure_rows(progress.comparison)
        parts.append(_table("Both flights", FIGURE_COLUMNS, rows, frozenset({1, 2, 3})))
    if progress.tuned is not None:
        parts.append(Text(f"configuration: {folder / TUNED}"))
    if progress.comparison is not None:
        parts.append(Text(f"page: {folder / PAGE}"))
    return Group(*parts)


def _table(title: str, columns: Sequence[str], rows: Iterable[Sequence[str]], numbers: frozenset[int]) -> Table:
    table = Table(title=title, title_justify="left")
    for place, name in enumerate(columns):
        table.add_column(escape(name), justify="right" if place in numbers else "left", overflow="fold")
    for row in rows:
        table.add_row(*map(escape, row))
    return table
