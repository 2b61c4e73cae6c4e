"""Page of a campaign of fleets: one complete HTML file."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from markupsafe import Markup

from logs.recording.summary import count
from logs.report.findings import Banner
from logs.report.page import PageSection, Part, render_list, render_page, render_table
from uavctl.cause import BAD
from uavctl.lab.campaign.fleets import VALUE, FleetCampaignRecord, FleetSummary, summarise_fleets
from uavctl.lab.campaign.page import render_specification, write_html

HEADINGS = ("vehicles", "byte/s", "schedule", "cost", "value: cost", "out %", "fallback %", "mean age s", "oldest s")
NOTE = (
    "Cost: of a step of a vehicle. “value: cost”: that of schedule `value` less this one's, run against run. Out: "
    "steps with a state beyond a limit. Intervals are at 95 %."
)


def write_fleet_report(folder: Path) -> tuple[Path, list[FleetSummary]]:
    """Write the page of a campaign into its folder; return its path, and the figures of every cell.

    Raises:
        UavctlError: The results cannot be read, or the page not be written.
    """
    record, cells = summarise_fleets(folder)
    subtitle = f"{count(len(cells), 'cell')} · seed {record.master} · uavctl {record.uavctl_version}"
    view = _FleetView(cells, render_specification(folder))
    page = render_page(f"Campaign “{record.name}”", subtitle, _SECTIONS, view, _judge(record, cells))
    return write_html(folder, page), cells


class _FleetView(NamedTuple):
    cells: Sequence[FleetSummary]
    specification: Markup


def _judge(record: FleetCampaignRecord, cells: Sequence[FleetSummary]) -> Banner | None:
    failed = sum(cell.failed for cell in cells)
    if not failed:
        return None
    return Banner(BAD, "Runs failed", f"{failed} of {count(record.runs * len(cells), 'run')}; they are in no figure.")


def describe_gains(cells: Sequence[FleetSummary]) -> Iterator[str]:
    """Yield a sentence for each cell that is compared with schedule `value`."""
    for cell in cells:
        if cell.value_gain is None:
            continue
        mean, low, high = cell.value_gain
        if low <= 0.0 <= high:
            verdict = f"costs as much as {cell.schedule}"
        else:
            verdict = f"costs {100 * abs(mean):.1f} % {'less' if mean < 0.0 else 'more'} than {cell.schedule}"
        yield f"{cell.vehicles} vehicles, {cell.bytes_per_s:g} byte/s: {VALUE} {verdict}."


def format_cell(cell: FleetSummary) -> tuple[str, ...]:
    """Return the row of a cell, in order of `HEADINGS`."""
    names = (str(cell.vehicles), f"{cell.bytes_per_s:g}", cell.schedule)
    if cell.cost is None or cell.cost_ci is None or cell.outside is None or cell.outside_ci is None:
        return (*names, "refused" if cell.refused else "failed", *[""] * (len(HEADINGS) - 4))
    gain = ""
    if cell.value_gain is not None:
        gain = "{:+.1f} % ({:+.1f} to {:+.1f})".format(*(100 * share for share in cell.value_gain))
    return (
        *names,
        f"{cell.cost:.4g} ± {(cell.cost_ci[1] - cell.cost_ci[0]) / 2:.2g}",
        gain,
        f"{100 * cell.outside:.3g} ({100 * cell.outside_ci[0]:.3g}–{100 * cell.outside_ci[1]:.3g})",
        f"{100 * (cell.fallbacks or 0.0):.3g}",
        f"{cell.mean_age_s:.3f}",
        f"{cell.max_age_s:.2f}",
    )


def _show_cells(view: _FleetView) -> Iterator[Part]:
    yield render_table(HEADINGS, [format_cell(cell) for cell in view.cells], frozenset({0, 1}), kind="dense")
    yield view.specification


def _show_failures(view: _FleetView) -> Iterator[Part]:
    rows = [
        (str(cell.vehicles), cell.schedule, reason)
        for cell in view.cells
        for reason in ([cell.refused] if cell.refused else cell.errors)
    ]
    if rows:
        yield render_table(("vehicles", "schedule", "why"), rows, frozenset({0}))


_SECTIONS: tuple[PageSection[_FleetView], ...] = (
    PageSection("Result", lambda view: [render_list(describe_gains(view.cells))]),
    PageSection("Cells", _show_cells, note=NOTE),
    PageSection("Not flown, or failed", _show_failures, empty_text="None."),
)
