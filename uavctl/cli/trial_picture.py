"""A campaign of flights of the quadrotor, as tables for the terminal."""

from __future__ import annotations

import msgspec
from rich.console import Group, RenderableType
from rich.markup import escape
from rich.table import Table

from uavctl.campaign.trial_results import TrialSummary
from uavctl.trial.figures import COUNTS, MEANING, SHOWN

_NAMES = ("autopilot", "rate_hz", "link", "air")


class TrialResult(msgspec.Struct, frozen=True, kw_only=True):
    """What a campaign of flights came to."""

    name: str
    runs_file: str
    report: str
    wall_s: float
    cells: list[TrialSummary]


def trial_picture(result: TrialResult) -> RenderableType:
    """A table for each scenario."""
    # What is the same in all cells needs no column, and of what only tells of ours the page has more.
    lists = [name for name in _NAMES if len({getattr(cell.place, name) for cell in result.cells}) > 1]
    tables: list[RenderableType] = []
    for scenario, every in SHOWN.items():
        shown = [one for one in every if one not in COUNTS]
        cells = [cell for cell in result.cells if cell.place.scenario == scenario]
        if not cells:
            continue
        table = Table(title=f"Campaign {escape(result.name)}: {scenario}", title_justify="left")
        for heading in (*lists, "controller"):
            table.add_column(heading.replace("rate_hz", "Hz"))
        for one in shown:
            table.add_column(one.heading, justify="right")
        for cell in cells:
            names = [_text(getattr(cell.place, name)) for name in (*lists, "controller")]
            told = ["refused"] if cell.place.refused else [one.told(cell.values[one.key]) for one in shown]
            table.add_row(*map(escape, names), *told)
        tables.append(table)
    refusals = dict.fromkeys(
        f"{cell.place.controller}, {cell.place.link}: {cell.place.refused}"
        for cell in result.cells
        if cell.place.refused
    )
    remarks = [f"Refused: {escape(text)}" for text in refusals]
    failed = sum(cell.failed for cell in result.cells)
    if failed:
        remarks.append(f"{failed} flights failed; runs.parquet says why")
    files = f"{escape(result.runs_file)}\n{escape(result.report)}\n{result.wall_s:.1f} s"
    return Group(*tables, *remarks, MEANING, files)


def _text(value: object) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)
