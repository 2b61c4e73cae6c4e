"""The page of a campaign: one HTML file, complete in itself."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from html import escape
from pathlib import Path

from logs import page
from logs.page import Section
from logs.summary import count
from uavctl.campaign import plots
from uavctl.campaign.intervals import Pair
from uavctl.campaign.legend import legend
from uavctl.campaign.results import Results, read_results
from uavctl.campaign.statistics import CellSummary
from uavctl.campaign.story import story
from uavctl.campaign.verdict import SMPC, Verdict, brief, group_of, in_words, percent, word_of
from uavctl.campaign.view import View
from uavctl.errors import UavctlError

PAGE = "report.html"
_SPECIFICATION = "campaign.toml"
_SHOWN_FAILURES = 50
_PROMISED = "allowed by the SMPC's design"
_HOW_SURE = (
    "Intervals are at 95 %. The steps of a run are not independent, so the interval of a rate of steps is a bootstrap "
    "over runs (with fewer than 20 runs concerned: the exact interval of the share of such runs, times what a run of "
    "them has on average). The exact interval (Clopper and Pearson) is that of the share of runs with any step "
    "outside. Costs have a bootstrap over runs, beyond 2000 runs its normal approximation. Runs that failed are in no "
    "figure."
)
_DIFFERENCE = "What each baseline costs more than the SMPC"
_QUESTION = "Does the SMPC cost less, at equal or lower violation rates?"
_DIFFERENCES = (
    "All controllers meet the same disturbances and the same losses, so their costs are subtracted run by run; the "
    "interval is that of the mean difference, over the SMPC's mean cost. Right of zero the SMPC costs less."
)
_VERDICT = (
    "“Yes” where every baseline costs more than the SMPC, or breaks state or input limits more often: none is as cheap "
    "at equal or lower rates. The columns say what each baseline costs, over the SMPC's cost. Less and more are judged "
    "by the intervals of the differences run by run."
)


def write_report(folder: Path) -> Path:
    """Write the page of a campaign into its folder.

    Returns:
        Its path.

    Raises:
        UavctlError: The results cannot be read, or the page not be written.
    """
    path = folder / PAGE
    text = report_html(read_results(folder))
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise UavctlError(f"{path}: cannot be written ({error.strerror}); make room or choose another place") from error
    return path


def report_html(results: Results) -> str:
    """The page as text."""
    view = View.of(results)
    subtitle = f"{count(len(view.cells), 'cell')} · seed {results.master} · uavctl {results.version}"
    return page.page(f"Campaign “{results.name}”", subtitle, story(view), _sections(view))


def _sections(view: View) -> Iterator[Section]:
    yield _compared_section(view)
    yield _verdict_section(view)
    yield _difference_section(view)
    for place, (scene, cells) in enumerate(view.scenes.items()):
        yield from _scene_section(view, scene, cells, f"s{place}")
    yield from _ways_section(view)
    yield _age_section(view)
    yield _cells_section(view)
    yield _failures_section(view)
    yield _again_section(view)


def _compared_section(view: View) -> Section:
    cells, results = view.cells, view.results

    def named(values: Iterator[str]) -> str:
        return ", ".join(dict.fromkeys(values))

    rows = [
        ("Controllers", ", ".join(view.looks.controllers)),
        ("Links", named(cell.link for cell in cells)),
        ("Disturbances", named(cell.disturbance for cell in cells)),
        ("Plants", named(cell.plant for cell in cells)),
        ("Runs of a cell", f"{results.planned} of {count(results.steps, 'step')}"),
        ("Seed", f"{results.master}; run i of every cell has the draws of (seed, i)"),
    ]
    try:
        specification = page.folded("Specification", (results.folder / _SPECIFICATION).read_text(encoding="utf-8"))
    except OSError:
        specification = ""
    return Section("What was compared", "", page.facts(rows) + specification)


def _verdict_section(view: View) -> Section:
    if not view.verdicts:
        return Section(_QUESTION, "", page.paragraph("No SMPC was flown."))
    baselines = dict.fromkeys(one.baseline.controller for v in view.verdicts for one in v.comparisons)
    rows, words = [], []
    for verdict in view.verdicts:
        name = _name(view, verdict)
        said = {one.baseline.controller: brief(one) for one in verdict.comparisons}
        if verdict.comparisons:
            rows.append((name, word_of(verdict), *(said.get(baseline, "–") for baseline in baselines)))
        sentences = "".join(f"<li>{escape(sentence)}</li>" for sentence in in_words(verdict))
        words.append(f'<p><strong>{escape(name)}</strong></p><ul class="story">{sentences}</ul>')
    table = _table(("", "best at its rate", *baselines), rows, frozenset()) if rows else ""
    body = f"{table}<details><summary>In words, with figures and reasons</summary>{''.join(words)}</details>"
    return Section(_QUESTION, _VERDICT, body)


def _name(view: View, verdict: Verdict) -> str:
    place = view.place(verdict.group)
    several = sum(view.is_smpc(name) for name in view.looks.controllers) > 1
    return f"{verdict.smpc.controller}, {place}" if several else place


def _scene_section(view: View, scene: tuple[str, str], cells: Sequence[CellSummary], key: str) -> Iterator[Section]:
    losses = {
        cell.link: cell.link_loss for cell in view.results.cells if cell.link_loss is not None and not cell.refused
    }
    drawings = list(plots.compared(cells, losses, view.looks, key))
    if drawings:
        note = "" if key != "s0" else _HOW_SURE + " An arrow stands at the upper end of the interval of a rate of zero."
        flown = {cell.controller for cell in cells if cell.cost is not None}
        body = legend(view.looks.entries(flown), limit=_PROMISED) + page.grid(drawings)
        yield Section(f"Costs and limits{_suffix(view, scene)}", note, body)


def _difference_section(view: View) -> Section:
    drawings = []
    for place, scene in enumerate(view.scenes):
        for number, controller in enumerate(view.looks.controllers):
            mine = [v for v in view.verdicts if v.smpc.controller == controller and v.group[1:] == scene]
            title = f"Beside {controller}{_suffix(view, scene)}"
            drawing = plots.differences(mine, view.looks, title, f"s{place}-{number}")
            if drawing is not None:
                drawings.append(drawing)
    compared = [one for verdict in view.verdicts for one in verdict.comparisons]
    if not drawings:
        return Section(_DIFFERENCE, "", page.paragraph("There is nothing to compare."))
    who = {one.baseline.controller for one in compared}
    cross = "" if all(one.as_safe for one in compared) else "the SMPC breaks limits more often"
    body = legend(view.looks.entries(who), cross=cross) + page.grid(drawings)
    return Section(_DIFFERENCE, _DIFFERENCES, body)


def _suffix(view: View, scene: tuple[str, str]) -> str:
    """The scene's name after a title; nothing where there is one scene only."""
    where = view.place(("", *scene)).removeprefix(", ")
    return f": {where}" if where else ""


def _age_section(view: View) -> Section:
    note = "Every controller meets the same losses, so the ages are those of the link."
    if not any(cell.ages for cell in view.cells):
        return Section("Age of information", "", page.paragraph("No run ended in order."))
    figures = page.wide_or_narrow(*plots.ages(view.cells, view.results))
    return Section("Age of information", note, legend(plots.age_entries(view.cells)) + figures)


def _ways_section(view: View) -> Iterator[Section]:
    """Of a room with walls; a box of other units has none that a vehicle could touch."""
    if all(cell.beyond_m is None for cell in view.cells):
        return
    columns = (
        "controller",
        "where",
        "to 0.3 m [s]",
        "to 0.1 m [s]",
        "hold, rms [m]",
        "beyond a wall [m]",
        "usable room",
    )
    rows = [
        (
            cell.controller,
            view.place(group_of(cell)),
            *("–" if value is None else f"{value:.3g}" for value in (cell.near_s, cell.nearer_s, cell.hold_rms_m)),
            "–" if cell.beyond_m is None else f"{cell.beyond_m:.2f}",
            "–" if cell.usable_room is None else f"{percent(cell.usable_room)}",
        )
        for cell in view.cells
        if not cell.refused
    ]
    note = (
        "To 0.3 m, to 0.1 m: first time so near to the target, median of the runs. Hold: distance from it in the "
        "second half of a run, median. Beyond a wall: furthest of all runs; negative is the room that was left. Usable "
        "room: share of it in which a plan may rest."
    )
    yield Section("Through the room", note, _table(columns, rows, frozenset(range(2, 7))))


_COLUMNS = (
    "cell", "controller", "cost of a run", "settled, a step", "states outside", "worst step", "runs with any",
    "inputs outside", "mean square input", "no plan left", "no plan found", "limits eased", "oldest", "failed",
)  # fmt: skip


def _cells_section(view: View) -> Section:
    tables = []
    for group, cells in view.groups.items():
        rows = [_row(cell) for cell in cells if not cell.refused]
        refused = [f"{cell.index} {cell.controller}: no design; {cell.refused}" for cell in cells if cell.refused]
        body = _table(_COLUMNS, rows, frozenset(range(len(_COLUMNS))) - {1}, refused)
        tables.append(f"<details><summary>{escape(view.place(group))}</summary>{body}</details>")
    note = (
        "States and inputs outside: share of steps. Worst step: share of runs with a state outside in the step with "
        "the most, its exact interval for all steps at once (Bonferroni). Runs with any: share of runs with a state "
        "outside. No plan left: steps in which the SMPC braked. No plan found, limits eased: decisions. Oldest: "
        "largest age in steps."
    )
    return Section("All figures", note, "".join(tables))


def _row(cell: CellSummary) -> tuple[str, ...]:
    planned = cell.decisions > 0
    return (
        str(cell.index),
        cell.controller,
        _mean(cell.cost, cell.cost_ci),
        _mean(cell.settled_cost, cell.settled_cost_ci),
        _rate(cell.violation_rate, cell.violation_ci),
        _rate(cell.worst_step_rate, cell.worst_step_ci),
        _rate(cell.run_violation_rate, cell.run_violation_ci),
        _rate(cell.input_violation_rate, cell.input_violation_ci),
        "–" if cell.mean_square_input is None else f"{cell.mean_square_input:.4g}",
        *(str(number) if planned else "–" for number in (cell.fallbacks, cell.infeasible, cell.slack_used)),
        str(cell.max_age),
        str(cell.failed),
    )


def _mean(value: float | None, interval: Pair | None) -> str:
    return "–" if value is None or interval is None else f"{value:.5g} {_whole(interval, 5)}"


def _rate(value: float | None, interval: Pair | None) -> str:
    if value is None or interval is None:
        return "–"
    return f"{percent(value)} {_whole((100 * interval[0], 100 * interval[1]), 3)}"


def _whole(interval: Pair, digits: int) -> str:
    """An interval that no line breaks."""
    return f"({interval[0]:.{digits}g} to {interval[1]:.{digits}g})".replace(" ", "\N{NO-BREAK SPACE}")


def _failures_section(view: View) -> Section:
    failed = [
        (str(cell.index), cell.controller, view.place(group_of(cell)), str(run), error)
        for cell in view.cells
        for run, error in view.results.runs[cell.index].failed
    ]
    shown = failed[:_SHOWN_FAILURES]
    columns = ("cell", "controller", "where", "run", "what ended it")
    body = _table(columns, shown, frozenset({0, 3})) if shown else page.paragraph("There were none.")
    note = "" if len(shown) == len(failed) else f"The first {len(shown)} of {len(failed)}; runs.parquet has all."
    return Section("Runs that failed", note, body)


def _table(
    columns: Sequence[str], rows: Iterable[Sequence[str]], numbers: frozenset[int], remarks: Iterable[str] = ()
) -> str:
    """A table of many columns, set small to be seen in full, with remarks as rows of their own below."""
    text = page.table(columns, rows, numbers).replace('class="many"', 'class="many dense"', 1)
    below = "".join(f'<tr><td colspan="{len(columns)}">{escape(remark)}</td></tr>' for remark in remarks)
    return text.replace("</tbody>", f"{below}</tbody>", 1)


def _again_section(view: View) -> Section:
    """How to look at one run, by the example of the costliest of an SMPC."""
    flown = [cell for cell in view.cells if cell.kind == SMPC and cell.cost is not None]
    if not flown:
        return Section("A run again", "", page.paragraph("Runs of an SMPC can be flown again; there are none."))
    cell = max(flown, key=lambda one: one.cost or 0.0)
    runs = view.results.runs[cell.index]
    worst = int(runs.index[runs["cost"].argmax()])
    note = (
        "Any run of an SMPC can be flown again by its number, through the flight controller, MAVLink and the recorder, "
        f"with its disturbances and losses. The costliest run of cell {cell.index} ({cell.controller}, "
        f"{view.place(group_of(cell))}):"
    )
    command = f"uavctl campaign --refly {cell.index}:{worst} --out flights/cell-{cell.index}-run-{worst} FOLDER"
    return Section("A run again", note, f'<div class="card"><pre>{escape(command)}</pre></div>')
