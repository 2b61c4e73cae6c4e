"""Page of a campaign in the linear world: one complete HTML file."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from markupsafe import Markup

from logs.recording.summary import count
from logs.report.findings import Banner
from logs.report.page import (
    NOTHING,
    Mark,
    PageSection,
    Part,
    render_facts,
    render_folded,
    render_list,
    render_page,
    render_parts,
    render_strong,
    render_table,
)
from logs.report.run_statistics import Interval
from uavctl.cause import BAD, CAUTION, GOOD
from uavctl.errors import UavctlError
from uavctl.lab.campaign import plots
from uavctl.lab.campaign.plots import ControllerStyles
from uavctl.lab.campaign.results import CellSummary, Results, exceeds, format_percent, read_results, summarise_cell
from uavctl.lab.campaign.store import SPECIFICATION
from uavctl.lab.campaign.verdicts import (
    SMPC,
    CampaignVerdict,
    Group,
    describe_briefly,
    describe_verdict,
    get_group,
    get_verdict_word,
    group_cells,
    make_verdicts,
)

_GROUP_PARTS = ("link", "disturbance", "plant")


@dataclass(frozen=True, eq=False)
class CampaignView:
    """Campaign with all figures that its page shows."""

    results: Results  # the campaign
    cells: list[CellSummary]  # the figures of its cells
    groups: dict[Group, list[CellSummary]]  # cells by link, disturbance and plant
    verdicts: list[CampaignVerdict]  # each SMPC against the baselines of its group
    styles: ControllerStyles  # how controllers are drawn

    @classmethod
    def make(cls, results: Results) -> Self:
        """Compute the figures of a campaign."""
        cells = [summarise_cell(results, cell) for cell in results.record.cells]
        groups = group_cells(cells)
        smpc_names = [cell.controller for cell in cells if cell.kind == SMPC]
        styles = ControllerStyles(tuple(dict.fromkeys([*smpc_names, *(cell.controller for cell in cells)])))
        return cls(results, cells, groups, list(make_verdicts(results, groups)), styles)

    def name_group(self, group: Group) -> str:
        """Return the name of a group: its link, and its disturbance and plant if groups differ in them."""
        names = list(group[:1])
        for part in (1, 2):
            if len({group_key[part] for group_key in self.groups}) > 1:
                names.append(f"{_GROUP_PARTS[part]} {group[part]}")
        return ", ".join(names)

    @property
    def cells_by_scene(self) -> dict[tuple[str, str], list[CellSummary]]:
        """Cells by disturbance and plant."""
        scenes: dict[tuple[str, str], list[CellSummary]] = {}
        for cell in self.cells:
            scenes.setdefault((cell.disturbance, cell.plant), []).append(cell)
        return scenes


def describe_outcome(view: CampaignView) -> Iterator[str]:
    """Yield sentences on the outcome of a campaign, made from its figures."""
    record, cells = view.results.record, view.cells
    refused = sum(bool(cell.refused) for cell in cells)
    failed = sum(cell.failed for cell in cells)
    flown = sum(cell.runs for cell in cells)
    yield (
        f"{count(flown, 'run')} of {count(record.steps, 'step')} were flown: {count(record.runs, 'run')} for each "
        f"of {count(len(cells) - refused, 'cell')}, all cells on the same disturbances and losses."
    )
    if refused:
        yield f"{count(refused, 'cell')} had no design and were not flown; the reasons are below."
    yield f"{count(failed, 'run')} failed; they are listed below." if failed else "No run failed."
    judged = [verdict for verdict in view.verdicts if verdict.comparisons]
    if judged:
        yield _describe_verdicts(judged)
    yield from _describe_steps(view)


def _describe_verdicts(judged: Sequence[CampaignVerdict]) -> str:
    """Return a sentence on how often the SMPC beat all baselines, and how often a baseline beat it."""
    unmatched, beaten_count = sum(v.is_unmatched for v in judged), sum(v.is_beaten for v in judged)
    better = sum(v.is_better_than_all for v in judged)
    text = (
        f"In {unmatched} of {count(len(judged), 'case')} no baseline is as cheap as the SMPC at equal or lower "
        f"violation rates; in {better} of these each one costs more and keeps limits no better. A "
        f"baseline costs less, and breaks limits no more often, in {beaten_count}."
    )
    undecided = len(judged) - unmatched - beaten_count
    return (
        f"{text} In {undecided} the costs of such a baseline and the SMPC cannot be told apart." if undecided else text
    )


def _group_by_promise(view: CampaignView) -> tuple[list[CellSummary], list[CellSummary], list[CellSummary]]:
    """Return the cells with an allowed rate, those above it, and those above it beyond chance."""
    promising = [cell for cell in view.cells if cell.promised_x is not None and cell.violation_ci is not None]
    exceeding = [cell for cell in promising if exceeds(cell.violation_rate or 0.0, cell.promised_x or 0.0)]
    significant = [c for c in exceeding if c.violation_ci is not None and c.violation_ci[0] > (c.promised_x or 0.0)]
    return promising, exceeding, significant


def _judge_campaign(view: CampaignView) -> Banner | None:
    """Return the first line: failed runs, else whether rates stayed within the allowed ones; None without either."""
    failed, flown = sum(cell.failed for cell in view.cells), sum(cell.runs for cell in view.cells)
    promise = _judge_promise(view)
    if not failed:
        return promise
    reasons = () if promise is None else (f"{promise.word}: {promise.text}",)
    return Banner(BAD, "Runs failed", f"{failed} of {count(flown, 'run')}; they are in no figure.", reasons)


def _judge_promise(view: CampaignView) -> Banner | None:
    """Return whether rates stayed within the allowed ones; None without any allowed rate."""
    promising, exceeding, significant = _group_by_promise(view)
    if not promising:
        return None
    worst = max(promising, key=lambda cell: (cell.violation_rate or 0.0) / (cell.promised_x or 1.0))
    worst_text = (
        f"the most was {format_percent(worst.violation_rate)} of steps where {format_percent(worst.promised_x)} are "
        f"allowed ({worst.controller}, {view.name_group(get_group(worst))})"
    )
    cells = count(len(promising), "cell")
    if significant:
        others_text = (
            f", and {len(exceeding) - len(significant)} within chance" if len(exceeding) > len(significant) else ""
        )
        text = f"by {len(significant)} of {cells}, beyond chance{others_text}; {worst_text}."
        return Banner(BAD, "Promise broken", text)
    if exceeding:
        text = f"in {len(exceeding)} of {cells}, within chance; {worst_text}."
        return Banner(CAUTION, "Perhaps too often", text)
    return Banner(GOOD, "Promise kept", f"by all of {cells}; {worst_text}.")


def _describe_steps(view: CampaignView) -> Iterator[str]:
    """Yield a sentence on whether the rate of each step stayed within the allowed one."""
    promising, _, _ = _group_by_promise(view)
    judged = [c for c in promising if c.worst_step_rate is not None and c.worst_step_ci is not None]
    if judged:
        broken = sum(1 for c in judged if c.worst_step_ci and c.worst_step_ci[0] > (c.promised_x or 0.0))
        worst = max(judged, key=lambda cell: cell.worst_step_rate or 0.0)
        yield (
            f"Step by step, {count(broken, 'cell')} of {len(judged)} left the limits more often than allowed in some "
            f"step, beyond chance; the worst step of all had {format_percent(worst.worst_step_rate)} "
            f"({worst.controller}, {view.name_group(get_group(worst))})."
        )


PAGE = "report.html"
_SHOWN_FAILURES = 50
_INTERVAL_NOTE = (
    "Intervals are at 95 %. The steps of a run are not independent, so the interval of a rate of steps is a bootstrap "
    "over runs (with fewer than 20 runs concerned: the exact interval of the share of such runs, times what a run of "
    "them has on average). The exact interval (Clopper and Pearson) is that of the share of runs with any step "
    "outside. Costs have a bootstrap over runs, beyond 2000 runs its normal approximation. Runs that failed are in no "
    "figure. An arrow stands at the upper end of the interval of a rate of zero."
)


def write_report(folder: Path) -> tuple[Path, list[CellSummary]]:
    """Write the page of a campaign into its folder; return its path, and the figures of every cell.

    Raises:
        UavctlError: The results cannot be read, or the page not be written.
    """
    view = CampaignView.make(read_results(folder))
    return write_html(folder, render_report(view)), view.cells


def write_html(folder: Path, text: str) -> Path:
    """Write an HTML page into a campaign's folder; return its path.

    Raises:
        UavctlError: It cannot be written.
    """
    path = folder / PAGE
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise UavctlError(f"{path}: cannot be written ({error.strerror}); make room or choose another place") from error
    return path


def render_specification(folder: Path) -> Markup:
    """Return the campaign's file as folded HTML; empty where it is missing."""
    try:
        return render_folded("Specification", (folder / SPECIFICATION).read_text(encoding="utf-8"))
    except OSError:
        return NOTHING


def render_report(view: CampaignView) -> str:
    """Return the page of a campaign as HTML."""
    record = view.results.record
    subtitle = f"{count(len(view.cells), 'cell')} · seed {record.master} · uavctl {record.uavctl_version}"
    return render_page(f"Campaign “{record.name}”", subtitle, _list_sections(view), view, _judge_campaign(view))


def _show_compared(view: CampaignView) -> Iterator[Part]:
    cells, results = view.cells, view.results

    def join_names(values: Iterator[str]) -> str:
        return ", ".join(dict.fromkeys(values))

    rows = [
        ("Controllers", ", ".join(view.styles.controllers)),
        ("Links", join_names(cell.link for cell in cells)),
        ("Disturbances", join_names(cell.disturbance for cell in cells)),
        ("Plants", join_names(cell.plant for cell in cells)),
        ("Runs of a cell", f"{results.record.runs} of {count(results.record.steps, 'step')}"),
        ("Seed", f"{results.record.master}; run i of every cell has the draws of (seed, i)"),
    ]
    yield render_facts(rows)
    yield render_specification(results.folder)


def _show_verdicts(view: CampaignView) -> Iterator[Part]:
    """Return a table of the verdicts with a figure for each baseline, and the verdicts in words."""
    baselines = dict.fromkeys(comparison.baseline.controller for v in view.verdicts for comparison in v.comparisons)
    rows: list[tuple[str, ...]] = []
    explanations: list[Part] = []
    for verdict in view.verdicts:
        name = _name_verdict(view, verdict)
        texts = {comparison.baseline.controller: describe_briefly(comparison) for comparison in verdict.comparisons}
        if verdict.comparisons:
            rows.append((name, get_verdict_word(verdict), *(texts.get(baseline, "–") for baseline in baselines)))
        explanations += [render_strong(name), render_list(describe_verdict(verdict))]
    if rows:
        yield render_table(("", "best at its rate", *baselines), rows, frozenset(), kind="dense")
    if explanations:
        yield render_folded("In words, with figures and reasons", render_parts(explanations))


def _name_verdict(view: CampaignView, verdict: CampaignVerdict) -> str:
    group_name = view.name_group(verdict.group)
    has_several_smpcs = len({cell.controller for cell in view.cells if cell.kind == SMPC}) > 1
    return f"{verdict.smpc.controller}, {group_name}" if has_several_smpcs else group_name


def _make_scene_section(
    view: CampaignView, scene: tuple[str, str], cells: Sequence[CellSummary], index: int
) -> PageSection[CampaignView]:
    """Make the section on costs and limits in one disturbance and plant."""
    losses = {
        cell.link: cell.link_loss
        for cell in view.results.record.cells
        if cell.link_loss is not None and not cell.refused
    }
    flown = {cell.controller for cell in cells if cell.cost is not None}
    return PageSection(
        f"Costs and limits{_make_suffix(view, scene)}",
        lambda view: plots.draw_quantities(cells, losses, view.styles, f"s{index}"),
        note=_INTERVAL_NOTE if index == 0 else "",
        legend=(*view.styles.make_marks(flown), Mark("dashed", "limit", "allowed by the SMPC's design")),
    )


def _draw_differences(view: CampaignView) -> Iterator[Part]:
    """Draw the extra cost of the baselines over each SMPC, for each disturbance and plant."""
    for scene_index, scene in enumerate(view.cells_by_scene):
        for number, controller in enumerate(view.styles.controllers):
            scene_verdicts = [v for v in view.verdicts if v.smpc.controller == controller and v.group[1:] == scene]
            title = f"Beside {controller}{_make_suffix(view, scene)}"
            yield from plots.draw_differences(scene_verdicts, view.styles, title, f"s{scene_index}-{number}")


def _list_baseline_marks(view: CampaignView) -> Iterator[Mark]:
    compared = [comparison for verdict in view.verdicts for comparison in verdict.comparisons]
    yield from view.styles.make_marks({comparison.baseline.controller for comparison in compared})
    if not all(comparison.is_as_safe for comparison in compared):
        yield Mark("cross", "ink", "the SMPC breaks limits more often")


def _make_suffix(view: CampaignView, scene: tuple[str, str]) -> str:
    """Return the scene's name to follow a title; empty where there is one scene only."""
    scene_name = view.name_group(("", *scene)).removeprefix(", ")
    return f": {scene_name}" if scene_name else ""


def _show_paths(view: CampaignView) -> Iterator[Part]:
    """Return a table on the paths through the room."""
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
            view.name_group(get_group(cell)),
            *("–" if value is None else f"{value:.3g}" for value in (cell.near_s, cell.nearer_s, cell.hold_rms_m)),
            "–" if cell.beyond_m is None else f"{cell.beyond_m:.2f}",
            "–" if cell.usable_room is None else f"{format_percent(cell.usable_room)}",
        )
        for cell in view.cells
        if not cell.refused
    ]
    yield render_table(columns, rows, frozenset(range(2, 7)), kind="dense")


_CELL_COLUMNS = (
    "cell", "controller", "cost of a run", "settled, a step", "states outside", "settled, outside", "worst step",
    "runs with any", "inputs outside", "mean square input", "no plan left", "no plan found", "limits eased",
    "oldest", "failed",
)  # fmt: skip


def _show_cells(view: CampaignView) -> Iterator[Part]:
    """Return a folded table of all figures for each link, disturbance and plant."""
    for group, cells in view.groups.items():
        rows = [_make_row(cell) for cell in cells if not cell.refused]
        refused = [f"{cell.index} {cell.controller}: no design; {cell.refused}" for cell in cells if cell.refused]
        numbers = frozenset(range(len(_CELL_COLUMNS))) - {1}
        table = render_table(_CELL_COLUMNS, rows, numbers, refused, kind="dense")
        yield render_folded(view.name_group(group), table)


def _make_row(cell: CellSummary) -> tuple[str, ...]:
    has_decisions = cell.decisions > 0
    return (
        str(cell.index),
        cell.controller,
        _format_mean(cell.cost, cell.cost_ci),
        _format_mean(cell.settled_cost, cell.settled_cost_ci),
        _format_rate(cell.violation_rate, cell.violation_ci),
        format_percent(cell.settled_violation_rate),
        _format_rate(cell.worst_step_rate, cell.worst_step_ci),
        _format_rate(cell.run_violation_rate, cell.run_violation_ci),
        _format_rate(cell.input_violation_rate, cell.input_violation_ci),
        "–" if cell.mean_square_input is None else f"{cell.mean_square_input:.4g}",
        *(str(number) if has_decisions else "–" for number in (cell.fallbacks, cell.infeasible, cell.slack_used)),
        str(cell.max_age),
        str(cell.failed),
    )


def _format_mean(value: float | None, interval: Interval | None) -> str:
    return "–" if value is None or interval is None else f"{value:.5g} {_format_interval(interval, 5)}"


def _format_rate(value: float | None, interval: Interval | None) -> str:
    if value is None or interval is None:
        return "–"
    return f"{format_percent(value)} {_format_interval((100 * interval[0], 100 * interval[1]), 3)}"


def _format_interval(interval: Interval, digits: int) -> str:
    """Return an interval as text that no line break splits."""
    return f"({interval[0]:.{digits}g} to {interval[1]:.{digits}g})".replace(" ", "\N{NO-BREAK SPACE}")


def _list_failures(view: CampaignView) -> list[tuple[str, ...]]:
    """Return the failed runs: cell, controller, where, run and reason."""
    return [
        (str(cell.index), cell.controller, view.name_group(get_group(cell)), str(run), error)
        for cell in view.cells
        for run, error in view.results.runs[cell.index].failed
    ]


def _show_failures(view: CampaignView) -> Iterator[Part]:
    rows = _list_failures(view)[:_SHOWN_FAILURES]
    if rows:
        columns = ("cell", "controller", "where", "run", "reason")
        yield render_table(columns, rows, frozenset({0, 3}), kind="dense")


def _explain_failures(view: CampaignView) -> str:
    total = len(_list_failures(view))
    return "" if total <= _SHOWN_FAILURES else f"The first {_SHOWN_FAILURES} of {total}; runs.parquet has all."


def _list_sections(view: CampaignView) -> Iterator[PageSection[CampaignView]]:
    """Return the page's list; there is a section on costs and limits for each disturbance and plant."""
    yield PageSection("Result", lambda view: [render_list(describe_outcome(view))])
    yield PageSection("Compared cells", _show_compared)
    yield PageSection(
        "Does the SMPC cost less, at equal or lower violation rates?",
        _show_verdicts,
        note="“Yes” where every baseline costs more than the SMPC, or breaks state or input limits more often: none is "
        "as cheap at equal or lower rates. The columns have the cost of each baseline over the SMPC's. Less and "
        "more are judged by the intervals of the differences run by run.",
        empty_text="No SMPC was flown.",
    )
    yield PageSection(
        "Extra cost of each baseline over the SMPC",
        _draw_differences,
        note="All controllers meet the same disturbances and the same losses, so their costs are subtracted run by "
        "run; the interval is that of the mean difference, over the SMPC's mean cost. Right of zero the SMPC costs "
        "less.",
        legend=_list_baseline_marks,
        empty_text="There is nothing to compare.",
    )
    for index, (scene, cells) in enumerate(view.cells_by_scene.items()):
        yield _make_scene_section(view, scene, cells, index)
    yield PageSection(
        "Through the room",
        _show_paths,
        when=lambda view: any(cell.beyond_m is not None for cell in view.cells),  # a box of other units has no walls
        note="To 0.3 m, to 0.1 m: first time so near to the target, median of the runs. Hold: distance from it in the "
        "second half of a run, median. Beyond a wall: furthest of all runs; negative is the room that was left. Usable "
        "room: share of it in which a plan may rest.",
    )
    yield PageSection(
        "Age of information",
        lambda view: plots.draw_ages(view.cells, view.results),
        note="Every controller meets the same losses, so the ages are those of the link.",
        legend=lambda view: plots.make_age_legend(view.cells),
        empty_text="No run ended in order.",
    )
    yield PageSection(
        "All figures",
        _show_cells,
        note="States and inputs outside: share of steps. Settled: second half of the runs. Worst step: share of runs "
        "with a state outside in the step with the most, its exact interval for all steps at once (Bonferroni). Runs "
        "with any: share of runs with a state outside. No plan left: steps in which the SMPC braked. No plan found, "
        "limits eased: decisions. Oldest: largest age in steps.",
    )
    yield PageSection("Runs that failed", _show_failures, note=_explain_failures, empty_text="There were none.")
