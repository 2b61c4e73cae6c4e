"""Pages of campaigns, in the linear world and of quadrotor trials; each is one complete HTML file."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from markupsafe import Markup

from logs.recording.summary import count
from logs.report import page
from logs.report.excursion import GRAVE_M
from logs.report.page import Mark, PageSection
from logs.report.run_statistics import Interval
from uavctl.errors import UavctlError
from uavctl.lab.campaign import plots
from uavctl.lab.campaign.plots import Looks
from uavctl.lab.campaign.results import (
    SMPC,
    CampaignVerdict,
    CellSummary,
    Group,
    Results,
    brief,
    cell_summary,
    exceeds,
    group_of,
    grouped,
    in_words,
    percent,
    read_results,
    verdicts,
    word_of,
)
from uavctl.lab.campaign.store import SPECIFICATION
from uavctl.lab.campaign.trials import ToldTrial, TrialSummary, summarise_trial
from uavctl.lab.trial import BEYOND, MEANING, SHOWN

_WHAT = ("link", "disturbance", "plant")


@dataclass(frozen=True, eq=False)
class CampaignView:
    """A campaign with everything worked out that its page shows."""

    results: Results  # the campaign
    cells: list[CellSummary]  # the figures of its cells
    groups: dict[Group, list[CellSummary]]  # cells by link, disturbance and plant
    verdicts: list[CampaignVerdict]  # each SMPC against the baselines of its group
    looks: Looks  # how controllers are drawn

    @classmethod
    def of(cls, results: Results) -> Self:
        """Work out the figures of a campaign."""
        cells = [cell_summary(results, cell) for cell in results.cells]
        groups = grouped(cells)
        first = [cell.controller for cell in cells if cell.kind == SMPC]
        looks = Looks(tuple(dict.fromkeys([*first, *(cell.controller for cell in cells)])))
        return cls(results, cells, groups, list(verdicts(results, groups)), looks)

    def place(self, group: Group) -> str:
        """Return the name of a group: its link, and what else is not the same for all groups."""
        names = list(group[:1])
        for which in (1, 2):
            if len({other[which] for other in self.groups}) > 1:
                names.append(f"{_WHAT[which]} {group[which]}")
        return ", ".join(names)

    @property
    def scenes(self) -> dict[tuple[str, str], list[CellSummary]]:
        """Cells by disturbance and plant."""
        scenes: dict[tuple[str, str], list[CellSummary]] = {}
        for cell in self.cells:
            scenes.setdefault((cell.disturbance, cell.plant), []).append(cell)
        return scenes


def story(view: CampaignView) -> Iterator[str]:
    """Yield sentences on the outcome of a campaign, made from its figures."""
    results, cells = view.results, view.cells
    refused = sum(bool(cell.refused) for cell in cells)
    failed = sum(cell.failed for cell in cells)
    flown = sum(cell.runs for cell in cells)
    yield (
        f"{count(flown, 'run')} of {count(results.steps, 'step')} were flown: {count(results.planned, 'run')} for each "
        f"of {count(len(cells) - refused, 'cell')}, all cells on the same disturbances and losses."
    )
    if refused:
        yield f"{count(refused, 'cell')} had no design and were not flown; the reasons are below."
    yield f"{count(failed, 'run')} failed; they are listed below." if failed else "No run failed."
    judged = [verdict for verdict in view.verdicts if verdict.comparisons]
    if judged:
        yield _outcome(judged)
    yield from _step_by_step(view)


def _outcome(judged: Sequence[CampaignVerdict]) -> str:
    """Return a sentence on how often the SMPC beat all baselines, and how often a baseline beat it."""
    holds, beaten = sum(v.holds for v in judged), sum(v.beaten for v in judged)
    outright = sum(v.outright for v in judged)
    text = (
        f"In {holds} of {count(len(judged), 'case')} no baseline is as cheap as the SMPC at equal or lower violation "
        f"rates; in {outright} of these each one costs more and keeps limits no better. In {beaten} a baseline costs "
        "less and breaks limits no more often."
    )
    left = len(judged) - holds - beaten
    return f"{text} In {left} the costs of such a baseline and the SMPC cannot be told apart." if left else text


def _judged(view: CampaignView) -> tuple[list[CellSummary], list[CellSummary], list[CellSummary]]:
    """Return the cells with a promise, those that broke it, and of these the ones beyond chance."""
    kept = [cell for cell in view.cells if cell.promised_x is not None and cell.violation_ci is not None]
    above = [cell for cell in kept if exceeds(cell.violation_rate or 0.0, cell.promised_x or 0.0)]
    over = [c for c in above if c.violation_ci is not None and c.violation_ci[0] > (c.promised_x or 0.0)]
    return kept, above, over


def _main(view: CampaignView) -> Markup:
    """Return the line on what matters most as HTML: failures, and whether promises were kept."""
    failed, flown = sum(cell.failed for cell in view.cells), sum(cell.runs for cell in view.cells)
    promise = _promise(view)
    if failed:
        why = () if promise is None else (f"{promise[1]}: {promise[2]}",)
        return page.render_banner(
            "bad", "Runs failed", f"{failed} of {count(flown, 'run')}; they are in no figure.", why
        )
    return page.NOTHING if promise is None else page.render_banner(*promise, ())


def _promise(view: CampaignView) -> tuple[str, str, str] | None:
    """Return whether the promised risk was kept: tone, word and text; None where nothing was promised."""
    kept, above, over = _judged(view)
    if not kept:
        return None
    worst = max(kept, key=lambda cell: (cell.violation_rate or 0.0) / (cell.promised_x or 1.0))
    most = (
        f"the most was {percent(worst.violation_rate)} of steps where {percent(worst.promised_x)} are allowed "
        f"({worst.controller}, {view.place(group_of(worst))})"
    )
    cells = count(len(kept), "cell")
    if over:
        more = f", and {len(above) - len(over)} within chance" if len(above) > len(over) else ""
        return "bad", "Promise broken", f"by {len(over)} of {cells}, beyond chance{more}; {most}."
    if above:
        return "mind", "Perhaps too often", f"in {len(above)} of {cells}, within chance; {most}."
    return "good", "Promise kept", f"by all of {cells}; {most}."


def _step_by_step(view: CampaignView) -> Iterator[str]:
    """Yield a sentence on whether the promised risk was kept in each step."""
    kept, _, _ = _judged(view)
    stepped = [c for c in kept if c.worst_step_rate is not None and c.worst_step_ci is not None]
    if stepped:
        broke = sum(1 for c in stepped if c.worst_step_ci and c.worst_step_ci[0] > (c.promised_x or 0.0))
        highest = max(stepped, key=lambda cell: cell.worst_step_rate or 0.0)
        yield (
            f"Step by step, {count(broke, 'cell')} of {len(stepped)} left the limits more often than allowed in some "
            f"step, beyond chance; the worst step of all had {percent(highest.worst_step_rate)} "
            f"({highest.controller}, {view.place(group_of(highest))})."
        )


PAGE = "report.html"
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
    return _write(folder, report_html(read_results(folder)))


def _write(folder: Path, text: str) -> Path:
    path = folder / PAGE
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise UavctlError(f"{path}: cannot be written ({error.strerror}); make room or choose another place") from error
    return path


def _specification(folder: Path) -> Markup:
    """Return the campaign's file as folded HTML; empty where it is missing."""
    try:
        return page.render_folded("Specification", (folder / SPECIFICATION).read_text(encoding="utf-8"))
    except OSError:
        return page.NOTHING


def report_html(results: Results) -> str:
    """Return the page of a campaign as HTML."""
    view = CampaignView.of(results)
    subtitle = f"{count(len(view.cells), 'cell')} · seed {results.master} · uavctl {results.version}"
    return page.render_page(f"Campaign “{results.name}”", subtitle, story(view), _sections(view), top=_main(view))


def _sections(view: CampaignView) -> Iterator[PageSection]:
    yield _compared_section(view)
    yield _verdict_section(view)
    yield _difference_section(view)
    for place, (scene, cells) in enumerate(view.scenes.items()):
        yield from _scene_section(view, scene, cells, f"s{place}")
    yield from _ways_section(view)
    yield _age_section(view)
    yield _cells_section(view)
    yield _failures_section(view)


def _compared_section(view: CampaignView) -> PageSection:
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
    return PageSection("What was compared", "", page.render_facts(rows) + _specification(results.folder))


def _verdict_section(view: CampaignView) -> PageSection:
    if not view.verdicts:
        return PageSection(_QUESTION, "", page.render_paragraph("No SMPC was flown."))
    baselines = dict.fromkeys(one.baseline.controller for v in view.verdicts for one in v.comparisons)
    rows, words = [], []
    for verdict in view.verdicts:
        name = _name(view, verdict)
        said = {one.baseline.controller: brief(one) for one in verdict.comparisons}
        if verdict.comparisons:
            rows.append((name, word_of(verdict), *(said.get(baseline, "–") for baseline in baselines)))
        words += [page.render_strong(name), page.render_list(in_words(verdict))]
    folded = page.render_folded("In words, with figures and reasons", page.join(words))
    if not rows:
        return PageSection(_QUESTION, _VERDICT, folded)
    columns = ("", "best at its rate", *baselines)
    return PageSection(_QUESTION, _VERDICT, page.render_table(columns, rows, frozenset(), kind="dense") + folded)


def _name(view: CampaignView, verdict: CampaignVerdict) -> str:
    place = view.place(verdict.group)
    several = len({cell.controller for cell in view.cells if cell.kind == SMPC}) > 1
    return f"{verdict.smpc.controller}, {place}" if several else place


def _scene_section(
    view: CampaignView, scene: tuple[str, str], cells: Sequence[CellSummary], key: str
) -> Iterator[PageSection]:
    losses = {
        cell.link: cell.link_loss for cell in view.results.cells if cell.link_loss is not None and not cell.refused
    }
    drawings = list(plots.compared(cells, losses, view.looks, key))
    if drawings:
        note = "" if key != "s0" else _HOW_SURE + " An arrow stands at the upper end of the interval of a rate of zero."
        flown = {cell.controller for cell in cells if cell.cost is not None}
        body = page.render_legend([*view.looks.entries(flown), Mark("dashed", "limit", _PROMISED)]) + page.render_grid(
            drawings
        )
        yield PageSection(f"Costs and limits{_suffix(view, scene)}", note, body)


def _difference_section(view: CampaignView) -> PageSection:
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
        return PageSection(_DIFFERENCE, "", page.render_paragraph("There is nothing to compare."))
    who = {one.baseline.controller for one in compared}
    marks = [*view.looks.entries(who)]
    if not all(one.as_safe for one in compared):
        marks.append(Mark("cross", "ink", "the SMPC breaks limits more often"))
    body = page.render_legend(marks) + page.render_grid(drawings)
    return PageSection(_DIFFERENCE, _DIFFERENCES, body)


def _suffix(view: CampaignView, scene: tuple[str, str]) -> str:
    """Return the scene's name to follow a title; empty where there is one scene only."""
    where = view.place(("", *scene)).removeprefix(", ")
    return f": {where}" if where else ""


def _age_section(view: CampaignView) -> PageSection:
    note = "Every controller meets the same losses, so the ages are those of the link."
    if not any(cell.ages for cell in view.cells):
        return PageSection("Age of information", "", page.render_paragraph("No run ended in order."))
    figures = page.render_grid([plots.ages(view.cells, view.results)])
    return PageSection("Age of information", note, page.render_legend(plots.age_entries(view.cells)) + figures)


def _ways_section(view: CampaignView) -> Iterator[PageSection]:
    """Return the section on ways through a room; none for a box of other units, which has no walls."""
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
    yield PageSection("Through the room", note, page.render_table(columns, rows, frozenset(range(2, 7)), kind="dense"))


_COLUMNS = (
    "cell", "controller", "cost of a run", "settled, a step", "states outside", "worst step", "runs with any",
    "inputs outside", "mean square input", "no plan left", "no plan found", "limits eased", "oldest", "failed",
)  # fmt: skip


def _cells_section(view: CampaignView) -> PageSection:
    tables = []
    for group, cells in view.groups.items():
        rows = [_row(cell) for cell in cells if not cell.refused]
        refused = [f"{cell.index} {cell.controller}: no design; {cell.refused}" for cell in cells if cell.refused]
        body = page.render_table(_COLUMNS, rows, frozenset(range(len(_COLUMNS))) - {1}, refused, kind="dense")
        tables.append(page.render_folded(view.place(group), body))
    note = (
        "States and inputs outside: share of steps. Worst step: share of runs with a state outside in the step with "
        "the most, its exact interval for all steps at once (Bonferroni). Runs with any: share of runs with a state "
        "outside. No plan left: steps in which the SMPC braked. No plan found, limits eased: decisions. Oldest: "
        "largest age in steps."
    )
    return PageSection("All figures", note, page.join(tables))


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


def _mean(value: float | None, interval: Interval | None) -> str:
    return "–" if value is None or interval is None else f"{value:.5g} {_whole(interval, 5)}"


def _rate(value: float | None, interval: Interval | None) -> str:
    if value is None or interval is None:
        return "–"
    return f"{percent(value)} {_whole((100 * interval[0], 100 * interval[1]), 3)}"


def _whole(interval: Interval, digits: int) -> str:
    """Return an interval as text that no line break splits."""
    return f"({interval[0]:.{digits}g} to {interval[1]:.{digits}g})".replace(" ", "\N{NO-BREAK SPACE}")


def _failures_section(view: CampaignView) -> PageSection:
    failed = [
        (str(cell.index), cell.controller, view.place(group_of(cell)), str(run), error)
        for cell in view.cells
        for run, error in view.results.runs[cell.index].failed
    ]
    shown = failed[:_SHOWN_FAILURES]
    columns = ("cell", "controller", "where", "run", "what ended it")
    body = (
        page.render_table(columns, shown, frozenset({0, 3}), kind="dense")
        if shown
        else page.render_paragraph("There were none.")
    )
    note = "" if len(shown) == len(failed) else f"The first {len(shown)} of {len(failed)}; runs.parquet has all."
    return PageSection("Runs that failed", note, body)


_TITLES = {
    "hold": "Flying to a place and holding it",
    "eight": "Following a figure of eight",
    "blackout": "Four seconds without any position",
}
_OWN = (
    "`own-loop` is the vehicle's own position loop: its estimator gets the very positions that the others get on the "
    "same flight, and nothing else, and it is told where to be, or along a motion position, velocity and acceleration. "
    "The simulated vehicle's inertial sensors are nearly perfect (a constant bias, no noise, attitude without error), "
    "so what it does without positions is better than a real one's."
)


def write_trial_report(folder: Path) -> Path:
    """Write the page of a campaign into its folder.

    Returns:
        Its path.

    Raises:
        UavctlError: The results cannot be read, or the page not be written.
    """
    return _write(folder, trial_html(*summarise_trial(folder), _specification(folder)))


def trial_html(told: ToldTrial, cells: Sequence[TrialSummary], specification: Markup = page.NOTHING) -> str:
    """Return the page of a campaign of trials as HTML."""
    subtitle = f"{count(len(cells), 'cell')} · seed {told.master} · uavctl {told.uavctl_version}"
    title, sections = f"Campaign “{told.name}”", _trial_sections(told, cells, specification)
    return page.render_page(title, subtitle, _story(cells), sections, top=_trial_main(cells))


def _trial_main(cells: Sequence[TrialSummary]) -> Markup:
    """Return the line on what matters most as HTML: failures, else the furthest beyond a wall that any flight was."""
    failed = sum(cell.failed for cell in cells)
    runs = sum(cell.runs for cell in cells)
    if failed:
        return page.render_banner(
            "bad", "Flights failed", f"{failed} of {count(runs, 'flight')}; they are in no figure.", ()
        )
    beyond = [
        (value, cell)
        for cell in cells
        for value in cell.values.get("blackout_beyond_m" if cell.place.scenario == "blackout" else BEYOND.key, ())
        if math.isfinite(value)
    ]
    if not beyond:
        return page.NOTHING
    worst_m, worst = max(beyond, key=lambda one: one[0])
    where = f"{worst.place.controller}, {_TITLES[worst.place.scenario].lower()}, {', '.join(_where(worst))}"
    left = sum(value > 0.0 for value, _ in beyond)
    if not left:
        text = f"{count(len(beyond), 'flight')}, of which the nearest to a wall had {-worst_m:.2f} m left ({where})."
        return page.render_banner("good", "All inside", text, ())
    text = f"{left} of {count(len(beyond), 'flight')}, the furthest by {worst_m:.2f} m ({where})."
    return page.render_banner("bad" if worst_m >= GRAVE_M else "mind", "Left their limits", text, ())


def _story(cells: Sequence[TrialSummary]) -> Iterator[str]:
    flown = [cell for cell in cells if not cell.place.refused]
    yield f"{count(sum(cell.runs for cell in flown), 'flight')} of the true quadrotor, judged on the truth."
    for scenario, shown in SHOWN.items():
        mine = [cell for cell in flown if cell.place.scenario == scenario]
        best = _best(mine, shown[0].key)
        if best:
            places = len({_where(cell) for cell in mine})
            wins = ", ".join(f"{name} in {number}" for name, number in best.items())
            yield f"{_TITLES[scenario]}, {shown[0].heading}: of {places} places the least (median) was that of {wins}."
    if any(cell.failed for cell in flown):
        yield f"{count(sum(cell.failed for cell in flown), 'flight')} failed, and are in no figure."


def _best(cells: Sequence[TrialSummary], key: str) -> dict[str, int]:
    """Return how often each controller had the least median of a figure."""
    wins: dict[str, int] = {}
    for where in dict.fromkeys(map(_where, cells)):
        found = {c.place.controller: c.median[key] for c in cells if _where(c) == where}
        known = {name: value for name, value in found.items() if value is not None}
        if known:
            name = min(known, key=lambda one: known[one])
            wins[name] = wins.get(name, 0) + 1
    return wins


def _where(cell: TrialSummary) -> tuple[str, ...]:
    place = cell.place
    return place.autopilot, f"{place.rate_hz:g} Hz", place.link, place.air


def _trial_sections(told: ToldTrial, cells: Sequence[TrialSummary], specification: Markup) -> Iterator[PageSection]:
    rows = [
        ("Flights of a cell", str(told.runs)),
        ("Seed", f"{told.master}; flight i of every cell has the draws of (seed, i)"),
    ]
    rooms = {c.place.controller: c.place.usable_room for c in cells if c.place.usable_room is not None}
    rows += [
        (f"Usable room, {name}", f"{100 * share:.0f} % of it is where a plan may rest") for name, share in rooms.items()
    ]
    yield PageSection("What was compared", _OWN, page.render_facts(rows) + specification)
    for number, (scenario, shown) in enumerate(SHOWN.items()):
        mine = [cell for cell in cells if cell.place.scenario == scenario and not cell.place.refused]
        if not mine:
            continue
        columns = ("vehicle", "cameras", "link", "air", "controller", *(one.heading for one in shown), "ended in")
        table = [
            (
                *(*_where(cell), cell.place.controller),
                *(one.told(cell.values[one.key]) for one in shown),
                ", ".join(f"{mode} {number}" for mode, number in cell.modes.items()),
            )
            for cell in mine
        ]
        body = page.render_table(columns, table, frozenset(range(5, 5 + len(shown))), kind="dense")
        yield PageSection(_TITLES[scenario], MEANING if number == 0 else "", body)
    yield _amiss(cells)


def _amiss(cells: Sequence[TrialSummary]) -> PageSection:
    rows = [
        (str(cell.place.index), cell.place.controller, ", ".join(_where(cell)), why)
        for cell in cells
        for why in ([cell.place.refused] if cell.place.refused else cell.errors)
    ]
    body = (
        page.render_table(("cell", "controller", "where", "why"), rows, frozenset({0}))
        if rows
        else page.render_paragraph("None.")
    )
    return PageSection("Not flown, or failed", "", body)
