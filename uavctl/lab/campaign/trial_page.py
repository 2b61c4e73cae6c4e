"""Page of a campaign of quadrotor trials: one complete HTML file."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

from markupsafe import Markup

from logs.recording.summary import count
from logs.report.excursion import GRAVE_M
from logs.report.findings import Banner
from logs.report.page import NOTHING, PageSection, Part, render_facts, render_list, render_page, render_table
from uavctl.cause import BAD, CAUTION, GOOD
from uavctl.lab.campaign.page import render_specification, write_html
from uavctl.lab.campaign.trials import TrialCampaignRecord, TrialSummary, summarise_trial
from uavctl.lab.trial import EXCESS_FIGURE, FIGURE_NOTE, SCENARIO_FIGURES, Scenario

_SCENARIO_TITLES = {
    "hold": "Flying to a place and holding it",
    "eight": "Following a figure of eight",
    "blackout": "Four seconds without any position",
}
_OWN_LOOP_NOTE = (
    "`own-loop` is the vehicle's own position loop. Its estimator gets the positions of the same flight, and nothing "
    "else. Its setpoint is the target, or position, velocity and acceleration of the motion. The simulated inertial "
    "sensors are nearly perfect: a constant bias, no noise, no error of attitude. So `own-loop` flies better without "
    "positions than a real vehicle."
)


def write_trial_report(folder: Path) -> tuple[Path, list[TrialSummary]]:
    """Write the page of a campaign into its folder; return its path, and the figures of every cell.

    Raises:
        UavctlError: The results cannot be read, or the page not be written.
    """
    record, cells = summarise_trial(folder)
    return write_html(folder, render_trial_report(record, cells, render_specification(folder))), cells


def render_trial_report(
    record: TrialCampaignRecord, cells: Sequence[TrialSummary], specification: Markup = NOTHING
) -> str:
    """Return the page of a campaign of trials as HTML."""
    subtitle = f"{count(len(cells), 'cell')} · seed {record.master} · uavctl {record.uavctl_version}"
    view = _TrialView(record, cells, specification)
    return render_page(f"Campaign “{record.name}”", subtitle, _SECTIONS, view, _judge_trials(cells))


class _TrialView(NamedTuple):
    """Content of the page: the campaign, the figures of its cells, and its file as HTML."""

    record: TrialCampaignRecord
    cells: Sequence[TrialSummary]
    specification: Markup

    def find_cells(self, scenario: Scenario) -> list[TrialSummary]:
        """Return the flown cells of a scenario."""
        return [cell for cell in self.cells if cell.place.scenario == scenario and not cell.place.refused]


def _judge_trials(cells: Sequence[TrialSummary]) -> Banner | None:
    """Return the first line: failed flights, else the largest distance of any flight beyond a wall."""
    failed = sum(cell.failed for cell in cells)
    runs = sum(cell.runs for cell in cells)
    if failed:
        return Banner(BAD, "Flights failed", f"{failed} of {count(runs, 'flight')}; they are in no figure.")
    beyond = [
        (value, cell)
        for cell in cells
        for value in cell.values.get(
            "blackout_beyond_m" if cell.place.scenario == "blackout" else EXCESS_FIGURE.key, ()
        )
        if math.isfinite(value)
    ]
    if not beyond:
        return None
    worst_m, worst = max(beyond, key=lambda value_and_cell: value_and_cell[0])
    place = worst.place
    description = f"{place.controller}, {_SCENARIO_TITLES[place.scenario].lower()}, {', '.join(_get_conditions(worst))}"
    outside = sum(value > 0.0 for value, _ in beyond)
    if not outside:
        text = (
            f"{count(len(beyond), 'flight')}, of which the nearest to a wall had {-worst_m:.2f} m left ({description})."
        )
        return Banner(GOOD, "All inside", text)
    text = f"{outside} of {count(len(beyond), 'flight')}, the furthest by {worst_m:.2f} m ({description})."
    return Banner(BAD if worst_m >= GRAVE_M else CAUTION, "Left their limits", text)


def _describe_trials(cells: Sequence[TrialSummary]) -> Iterator[str]:
    flown = [cell for cell in cells if not cell.place.refused]
    yield f"{count(sum(cell.runs for cell in flown), 'flight')} of the true quadrotor, judged on the truth."
    for scenario, shown in SCENARIO_FIGURES.items():
        scenario_cells = [cell for cell in flown if cell.place.scenario == scenario]
        wins = _count_wins(scenario_cells, shown[0].key)
        if wins:
            conditions = len({_get_conditions(cell) for cell in scenario_cells})
            wins_text = ", ".join(f"{name} in {number}" for name, number in wins.items())
            title = f"{_SCENARIO_TITLES[scenario]}, {shown[0].heading}"
            yield f"{title}: of {conditions} places the least (median) was that of {wins_text}."
    if any(cell.failed for cell in flown):
        yield f"{count(sum(cell.failed for cell in flown), 'flight')} failed, and are in no figure."


def _count_wins(cells: Sequence[TrialSummary], key: str) -> dict[str, int]:
    """Return how often each controller had the least median of a figure."""
    wins: dict[str, int] = {}
    for conditions in dict.fromkeys(map(_get_conditions, cells)):
        medians = {c.place.controller: c.median[key] for c in cells if _get_conditions(c) == conditions}
        finite = {name: value for name, value in medians.items() if value is not None}
        if finite:
            name = min(finite, key=lambda controller: finite[controller])
            wins[name] = wins.get(name, 0) + 1
    return wins


def _get_conditions(cell: TrialSummary) -> tuple[str, ...]:
    place = cell.place
    return place.autopilot, f"{place.rate_hz:g} Hz", place.link, place.air


def _show_compared(view: _TrialView) -> Iterator[Part]:
    record = view.record
    rooms = {c.place.controller: c.place.usable_room for c in view.cells if c.place.usable_room is not None}
    yield render_facts(
        [
            ("Flights of a cell", str(record.runs)),
            ("Seed", f"{record.master}; flight i of every cell has the draws of (seed, i)"),
            *(
                (f"Usable room, {name}", f"{100 * share:.0f} % of it is where a plan may rest")
                for name, share in rooms.items()
            ),
        ]
    )
    yield view.specification


def _show_scenario(view: _TrialView, scenario: Scenario) -> Iterator[Part]:
    """Return the figures of a scenario, a row for each cell."""
    shown = SCENARIO_FIGURES[scenario]
    columns = ("vehicle", "cameras", "link", "air", "controller", *(figure.heading for figure in shown), "ended in")
    rows = [
        (
            *(*_get_conditions(cell), cell.place.controller),
            *(figure.format_values(cell.values[figure.key]) for figure in shown),
            ", ".join(f"{mode} {number}" for mode, number in cell.modes.items()),
        )
        for cell in view.find_cells(scenario)
    ]
    if rows:
        yield render_table(columns, rows, frozenset(range(5, 5 + len(shown))), kind="dense")


def _show_failures(view: _TrialView) -> Iterator[Part]:
    rows = [
        (str(cell.place.index), cell.place.controller, ", ".join(_get_conditions(cell)), reason)
        for cell in view.cells
        for reason in ([cell.place.refused] if cell.place.refused else cell.errors)
    ]
    if rows:
        yield render_table(("cell", "controller", "where", "why"), rows, frozenset({0}))


_SECTIONS: tuple[PageSection[_TrialView], ...] = (
    PageSection("Result", lambda view: [render_list(_describe_trials(view.cells))]),
    PageSection("Compared cells", _show_compared, note=_OWN_LOOP_NOTE),
    *(
        PageSection(
            _SCENARIO_TITLES[scenario],
            partial(_show_scenario, scenario=scenario),
            note=FIGURE_NOTE if index == 0 else "",
        )
        for index, scenario in enumerate(SCENARIO_FIGURES)
    ),
    PageSection("Not flown, or failed", _show_failures, empty_text="None."),
)
