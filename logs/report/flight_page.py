"""The page of a flight."""

from __future__ import annotations

import pickle
import sys
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

from logs.recording.design_view import config_name
from logs.recording.disk import write_whole
from logs.recording.flight import FlightData
from logs.recording.reader import read
from logs.recording.summary import FlightSummary, input_outside, rows, state_outside
from logs.report import figures, page, plots
from logs.report.excursion import excursions
from logs.report.figures import picture
from logs.report.headline import headline
from logs.report.page import Mark, PageSection
from logs.report.plots import path_3d
from logs.report.statistics import LEVEL
from logs.report.summary_text import part_begins, story
from logs.report.timeline import script, timeline
from logs.report.verdict_model import AxisVerdict, ModelOutcome, ModelVerdict
from logs.report.verdicts import ClockVerdict, DelayVerdict, Judged, LimitRisk, LinkVerdict, Verdicts, judge, plain
from uavctl.errors import UavctlError
from uavctl.records import Event, number

# The sections of a report that say what was flown with: design, vehicle, checks before arming, configuration.


# Numbers that say no more than that it hardly ever happens are told as one.
_NEGLIGIBLE = 1e-6

_DESIGN = {
    "horizon": "Horizon H [steps]",
    "dt_s": "Step Δt [s]",
    "scheme": "Scheme",
    "weights": "Shares of the ages of information",
    "budgets": "Risk of each age",
    "beyond": "Share of information older than the horizon",
    "tau": "Delay τ of the terminal law [steps]",
    "delays": "Information delays d",
    "gamma_x": "Likelihoods γ of the states",
    "gamma_u": "Likelihoods γ of the inputs",
    "spectral_radius": "Spectral radius of the terminal law",
    "stationary_cost": "Stationary cost",
}


def origin_sections(flight: FlightData) -> Iterator[PageSection]:
    """Return the sections on parameters and on how the flight was made."""
    design = list(_design(flight.header.design))
    parts = [page.facts(design)] if design else []
    assumptions = list(_assumptions(flight.header.design))
    if assumptions:
        columns = ("assumption", "value", "limit", "holds")
        parts.append(page.folded("Assumptions of the design", page.table(columns, assumptions, frozenset({1, 2}))))
    if flight.checks:
        columns = ("check before arming", "state", "found", "wanted")
        found = [(one.name, one.state, one.value, one.want) for one in flight.checks]
        parts.append(page.folded("Checked before arming", page.table(columns, found, frozenset())))
    header = flight.header
    parts.append(page.folded("Configuration", header.config_toml))
    yield PageSection("Configuration and parameters", "", page.joined(parts))
    made = [("Design", header.design_id), ("Processor", header.cpu), *sorted(header.versions.items())]
    yield PageSection("Made with", "", page.facts(made))


def _design(design: Mapping[str, object]) -> Iterator[tuple[str, str]]:
    for key, name in _DESIGN.items():
        if key in design:
            yield name, _text(design[key])


def _text(value: object) -> str:
    """Return a number, or a list of them, as text; a run of equal numbers is written once."""
    if isinstance(value, (int, float)):
        return f"{value:.4g}"
    if not isinstance(value, (list, tuple)):
        return str(value)
    runs: list[tuple[str, int]] = []
    for one in value:
        text = f"< {_NEGLIGIBLE:g}" if isinstance(one, float) and 0 < one < _NEGLIGIBLE else _text(one)
        if runs and runs[-1][0] == text:
            runs[-1] = (text, runs[-1][1] + 1)
        else:
            runs.append((text, 1))
    return ", ".join(text if times == 1 else f"{times} × {text}" for text, times in runs)


def _assumptions(design: Mapping[str, object]) -> Iterator[tuple[str, ...]]:
    found = design.get("assumptions")
    for one in found if isinstance(found, (list, tuple)) else ():
        if isinstance(one, Mapping):
            name = f"{one.get('item')}: {one.get('text')}"
            yield name, _text(one.get("value")), _text(one.get("limit")), "yes" if one.get("ok") else "no"


# The sections of a report that judge: promised risk, link, model and clocks, in words and figures.


_PREDICTED = Mark("line", "estimate", "measured")
_BAND = Mark("band", "target", f"where a right model stays with {100 * LEVEL:.0f} %")
_UNREADABLE = "The flight's configuration cannot be read by this version, so its model cannot be run again."


def verdict_rows(verdicts: Verdicts) -> list[tuple[str, str]]:
    """Return one row (name, outcome) for each verdict."""
    risk = verdicts.risk
    known = bool(risk.limits[0].measured.trials) and risk.limits[0].promised is not None
    link = verdicts.link
    return [
        ("Promised risk", _word(risk.refuted, known)),
        ("Promised link", _word(link.refuted, bool(link.news.trials) and link.promised_news is not None)),
        ("Model of the vehicle", _model_word(verdicts.model)),
    ]


def _word(refuted: bool, judged: bool) -> str:
    if not judged:
        return "too little to judge"
    return "refuted by this flight" if refuted else "nothing in this flight speaks against it"


def _model_word(model: ModelVerdict | None) -> str:
    if model is None:
        return "not known"
    if model.outcome is ModelOutcome.CAUTIOUS:
        return "cautious: errors were smaller than foretold"
    return _word(model.refuted, model.outcome is not ModelOutcome.UNKNOWN) + _departure(model)


def _departure(model: ModelVerdict) -> str:
    """Return what refutes a model, each test in a few words."""
    found = [
        *(["larger than foretold"] if any(one.larger for one in model.axes) else ()),
        *(["off on average"] if any(one.mean_refuted for one in model.axes) else ()),
        *(["telling of the next"] if any(one.telling for one in model.axes) else ()),
    ]
    if any(one.too_few for one in model.leads):
        return ": too few positions were where they were foretold"
    return f": errors were {', '.join(found)}" if found else ""


def _risk(verdicts: Verdicts) -> PageSection:
    risk = verdicts.risk
    shown = [one for place, one in enumerate(risk.limits) if place < 2 or one.outside]
    rest = len(risk.limits) - len(shown)
    columns = ("limit", "outside", "with news", "risk up to", "promised")
    body = [page.paragraph(risk.text), page.table(columns, [_risk_row(one) for one in shown], frozenset({1, 2, 3, 4}))]
    if rest:
        body.append(page.note(f"The other {rest} limits of single states were never broken."))
    if risk.unpromised:
        body.append(
            page.note(
                f"{risk.unpromised} of {risk.limits[0].steps} flown steps had no promise: it takes a plan that was "
                "flown in the step before, and in which no constraint gave way."
            )
        )
    note = (
        "“outside” counts all flown steps; “with news” those at which a position had just come, which are independent "
        f"as far as the promise goes. “risk up to” is the upper end of the exact {100 * LEVEL:.0f} % interval "
        "(Clopper and Pearson), all limits together. A promise holds for all limits of the states, or of the inputs, "
        "at once."
    )
    return PageSection("Verdict: promised risk against measured", note, page.joined(body))


def _risk_row(one: LimitRisk) -> tuple[str, ...]:
    return (
        one.name,
        f"{one.outside} of {one.steps}",
        f"{one.measured.hits} of {one.measured.trials}",
        _percent(one.measured.high),
        "unknown" if one.promised is None else f"{_percent(one.promised)}{', broken' if one.refuted else ''}",
    )


def _model(flight: FlightData, judged: Judged) -> PageSection:
    title = "Verdict: the model against what was flown"
    verdict, found = judged.verdicts.model, judged.innovations
    if verdict is None or found is None:
        return PageSection(title, "", page.paragraph(_UNREADABLE))
    drawings = [
        *(
            drawing
            for column, axis in enumerate(verdict.axes)
            for drawing in (
                figures.errors(flight, axis.axis, found.t_s, found.normalised[:, column]),
                figures.whiteness(axis),
            )
        ),
        *([figures.coverage(verdict.leads)] if verdict.leads else ()),
    ]
    columns = ("axis", "error [mm]", "× foretold", "bounds", "mean", "white")
    table = page.table(columns, [_axis_row(one) for one in verdict.axes], frozenset({1, 2, 3, 4, 5}))
    body = [page.paragraph(verdict.text)]
    if verdict.axes:
        body.append(table)
    if drawings:
        body.append(page.grid(drawings))
    if verdict.leads:
        ahead = ("time ahead", "in the ellipsoid", "share", "interval")
        rows = [
            (
                f"{one.lead_s:.3g} s",
                f"{one.inside.hits} of {one.inside.trials}",
                f"{_percent(one.inside.rate)}{_mark(one.too_few, one.refuted)}",
                f"{100 * one.inside.low:.3g} … {100 * one.inside.high:.3g} %",
            )
            for one in verdict.leads
        ]
        body.append(page.folded("Ellipsoids in figures", page.table(ahead, rows, frozenset({0, 1, 2, 3}))))
    note = (
        "The flight's filter is run again over all positions it used, in the order of capture. An error is a position "
        "minus what those before it foretell; if the model is right, errors are as large as foretold (1 ×), zero on "
        "average and say nothing of each other (white: the p-value of Ljung and Box). An ellipsoid is foretold for "
        "the inputs that were then flown. ✗ refutes the model; ○ departs from it on the cautious side."
    )
    legend = (_PREDICTED, _BAND, Mark("dashed", "limit", "promised")) if drawings else ()
    return PageSection(title, note, page.joined(body), legend)


def _axis_row(one: AxisVerdict) -> tuple[str, ...]:
    return (
        one.axis,
        f"{1e3 * one.rms_m:.3g}",
        f"{one.variance**0.5:.2f}{_mark(one.larger, one.smaller)}",
        f"{one.variance_low**0.5:.2f} … {one.variance_high**0.5:.2f}",
        f"{round(one.mean, 2) + 0.0:+.2f}{_mark(one.mean_refuted)}".replace("-", "−"),
        f"{_p(one.whiteness_p)}{_mark(one.telling, one.whiteness_refuted)}",
    )


def _mark(refuted: bool, cautious: bool = False) -> str:
    return " ✗" if refuted else " ○" if cautious else ""


def _clocks(flight: FlightData, verdicts: Verdicts) -> PageSection:
    note = "The age of information is only as true as the times of capture, which come from the clocks of others."
    sentences = [one.text for one in verdicts.clocks]
    if verdicts.stamps is not None:
        sentences.append(verdicts.stamps.text)
    if not sentences:
        return PageSection("Verdict: clocks", note, page.paragraph("No connection told anything of its clock."))
    drawings = list(figures.clocks(flight, verdicts.clocks))
    body = [page.paragraph(sentence) for sentence in sentences]
    columns = ("connection", "source", "drift [ppm]", "residual [µs]", "round trip [ms]", "refused")
    if verdicts.clocks:
        body.append(page.table(columns, [_clock_row(one) for one in verdicts.clocks], frozenset({2, 3, 4, 5})))
    if drawings:
        body.append(page.grid(drawings))
    return PageSection("Verdict: clocks", note, page.joined(body))


def _clock_row(one: ClockVerdict) -> tuple[str, ...]:
    def figure(value: float | None) -> str:
        return "–" if value is None else plain(value)

    return (
        one.link,
        one.source,
        figure(one.drift_ppm),
        "–" if one.residual_us is None else f"{one.residual_us:.0f}",
        figure(one.rtt_ms),
        str(one.rejected),
    )


def _percent(share: float) -> str:
    return f"{100 * share:.3g} %"


def _p(value: float) -> str:
    return f"{value:.2g}" if value >= 1e-4 else "< 0.0001"


# One HTML page about a flight, complete in itself.


__all__ = ["picture", "report_html", "write_report"]

_LIMIT = Mark("dashed", "limit", "limit")
_TARGET = Mark("dotted", "target", "target")
_ESTIMATE = Mark("line", "estimate", "estimate")
_OUTSIDE = Mark("cross", "limit", "outside")
_OUTSIDE_FROM = Mark("ring", "limit", "where it left its limits")
_FURTHEST = Mark("cross", "limit", "furthest outside")
_FALLBACK = Mark("band", "fallback", "fallback")
_NO_PLAN = "No plan was flown, so there is nothing to compare."
_LATENESS = "lateness is from a tick's deadline to its start"
_NO_TIMING = "No times were measured in this flight."

# Of these every other text is another matter: what the vehicle says, who flies.
_WORD_BY_WORD = frozenset({"vehicle-text", "command-ack", "hand-over"})


def write_report(flight: FlightData, summary: FlightSummary, path: Path, judged: Judged | None = None) -> None:
    """Write the page; `judged` are the flight's verdicts, if they are there already.

    Raises:
        RecordingError: the file cannot be written.
    """
    write_whole(path, report_html(flight, summary, judged))


def report_html(flight: FlightData, summary: FlightSummary, judged: Judged | None = None) -> str:
    """Return the page of a flight as HTML."""
    judged = judge(flight) if judged is None else judged
    header = flight.header
    name = config_name(header)
    title = f"Flight “{name}”" if name else "Flight"
    title += ", a part" if part_begins(flight) else ""
    subtitle = f"{header.started_utc} · {header.command} · seed {header.seed}"
    main = headline(flight, summary, judged)
    return page.page(
        title,
        subtitle,
        (),
        _sections(flight, summary, judged),
        top=page.banner(main.tone, main.word, main.text, main.why),
        script=script(flight, main.at_s),
    )


def _sections(flight: FlightData, summary: FlightSummary, judged: Judged) -> Iterator[PageSection]:
    wide, narrow, marks, meanings = timeline(flight)
    yield PageSection("Timeline", "", page.wide_or_narrow(wide, narrow) + page.note(meanings), marks)
    yield _path_section(flight)
    yield _axes_section(flight)
    yield _inputs_section(flight)
    yield _age_section(flight, judged.verdicts.link)
    for section in (
        _link_section(flight, judged.verdicts.link),
        _plans_section(flight),
        _certificates_section(flight),
        _timing_section(flight),
        _risk(judged.verdicts),
        _model(flight, judged),
        _clocks(flight, judged.verdicts),
        *origin_sections(flight),
    ):
        yield replace(section, closed=True)
    yield _events_section(flight)
    yield _summary_section(flight, summary, judged)


def _summary_section(flight: FlightData, summary: FlightSummary, judged: Judged) -> PageSection:
    facts = page.facts([*rows(summary), *verdict_rows(judged.verdicts)])
    return PageSection("Summary", "", page.listed(story(flight, summary)) + facts)


def _path_section(flight: FlightData) -> PageSection:
    deep = path_3d(flight)
    return PageSection(
        "Path",
        "",
        page.grid([*plots.path(flight), *(() if deep is None else (deep,))]),
        (
            *_truth_mark(flight),
            _ESTIMATE,
            *((Mark("planned", "plan", "plan, with its back-offs as ellipsoids"),) if deep is not None else ()),
            Mark("dot", "sample", "position used"),
            Mark("ring", "truth", "start"),
            _TARGET if flight.moving_target else Mark("star", "target", "target"),
            _LIMIT,
            *((Mark("band", "limit", "space that a fence took"),) if plots.fences(flight) else ()),
            *((_OUTSIDE_FROM, _FURTHEST) if excursions(flight) else ()),
        ),
    )


def _axes_section(flight: FlightData) -> PageSection:
    return PageSection(
        "Each axis against its limits",
        "The band along a limit is the largest reserve that the plan of the moment kept from it.",
        page.grid(list(plots.axes_over_time(flight))),
        (
            *_truth_mark(flight),
            _ESTIMATE,
            _TARGET,
            _LIMIT,
            Mark("band", "limit", "reserve kept"),
            *((_OUTSIDE,) if state_outside(flight).any() else ()),
            *_fallback_mark(flight),
        ),
    )


def _age_section(flight: FlightData, verdict: LinkVerdict) -> PageSection:
    lost = (Mark("tick", "lost", "position lost"),) if flight.truths else ()
    bound = (Mark("thin", "estimate", "lower bound in flight"),) if flight.link_estimates else ()
    return PageSection(
        "Age of information",
        "How many steps old the newest position was. A plan lasts H steps; at age H the fallback takes over.",
        page.grid([figures.age(flight), *figures.link_in_flight(flight, verdict)]),
        (
            Mark("line", "estimate", "measured"),
            *bound,
            Mark("dashed", "limit", f"horizon H = {flight.design.horizon}; share of news that the design counts on"),
            *((Mark("band", "limit", "delay configured"),) if verdict.delay is not None else ()),
            *lost,
            *_fallback_mark(flight),
        ),
    )


def _link_section(flight: FlightData, verdict: LinkVerdict) -> PageSection:
    drawings = list(figures.link_ages(flight, verdict))
    horizon = (Mark("dotted", "muted", f"horizon H = {flight.design.horizon}"),) if verdict.ages else ()
    note = "The dashed line is what the design counts on, by the link of the configuration."
    if verdict.delay is not None and verdict.delay.from_quickest:
        note += _quickest(verdict.delay)
    return PageSection(
        "The link, estimated against promised",
        note,
        page.paragraph(verdict.text) + (page.grid(drawings) if drawings else ""),
        (Mark("line", "estimate", "measured"), Mark("dashed", "limit", "promised"), *horizon) if drawings else (),
    )


def _quickest(delay: DelayVerdict) -> str:
    """Return a sentence on delays where the sender's clock is known by the quickest arrival only."""
    if delay.latency_ms:
        return (
            f" The shortest delay is taken to be {number(delay.latency_ms)} ms (clock.latency_s), as the sender's "
            "clock is only known by it."
        )
    return " Delays are short of the quickest one, as the sender's clock is only known by it."


def _certificates_section(flight: FlightData) -> PageSection:
    drawings = list(figures.certificates(flight))
    marks = [Mark("dot", role, name) for name, role in figures.methods(flight)]
    gave = any(drawing.key == "plan-slack" for drawing in drawings)
    told = (
        "Slack is what state limits gave way by (light); the rest at the end of a plan may be missed, too (dark)."
        if gave
        else (
            "Slack is what state limits give way by, so that there is a plan at all. No plan that was flown gave way "
            "anywhere."
        )
    )
    return PageSection(
        "Certificates and slack",
        f"Each plan comes with a bound of the least cost there is: the gap between them is certified. "
        f"{figures.ways(flight)}{told}",
        page.grid(drawings) if drawings else page.paragraph(_NO_PLAN),
        tuple(marks) if drawings else (),
    )


def _inputs_section(flight: FlightData) -> PageSection:
    return PageSection(
        "Inputs",
        "The colour tells how far into its plan the controller was when it gave the input: from blue, the first step "
        "of a plan, to orange, its last.",
        page.grid(list(figures.inputs(flight))),
        (_LIMIT, *((_OUTSIDE,) if input_outside(flight).any() else ()), *_fallback_mark(flight)),
    )


def _plans_section(flight: FlightData) -> PageSection:
    drawings = [*plots.plans_against_flown(flight), *figures.plan_indices(flight)]
    flown = Mark("line", "truth", "flown" if flight.truths else "flown (estimate)")
    marks = (flown, Mark("planned", "plan", "plan, from its first state"), Mark("band", "plan", "back-off of the plan"))
    return PageSection(
        "Plans against what was flown",
        "A few plans on the way to the target, each with the back-off that it keeps from a limit at that stage.",
        page.grid(drawings) if drawings else page.paragraph(_NO_PLAN),
        marks if drawings else (),
    )


def _timing_section(flight: FlightData) -> PageSection:
    drawings = list(figures.timing(flight))
    late = "in virtual time no tick is late" if flight.virtual_time else _LATENESS
    return PageSection(
        "Time taken",
        f"Decision time is spent in the core at ticks that solve; {late}.",
        page.grid(drawings) if drawings else page.paragraph(_NO_TIMING),
    )


def _events_section(flight: FlightData) -> PageSection:
    kinds: dict[tuple[str, str, str], list[Event]] = {}
    for event in flight.events:
        text = event.text if event.code in _WORD_BY_WORD else ""
        kinds.setdefault((event.severity.value, event.code, text), []).append(event)
    found = [
        (f"{flight.seconds([some[0].at_ns])[0]:.2f}", severity, code, str(sum(e.count for e in some)), some[0].text)
        for (severity, code, _), some in kinds.items()
    ]
    columns = ("first at [s]", "severity", "event", "times", "as first told")
    body = page.table(columns, found, frozenset({0, 3})) if found else page.paragraph("There were none.")
    return PageSection("Events", "", body)


def _truth_mark(flight: FlightData) -> tuple[Mark, ...]:
    return (Mark("line", "truth", "true state"),) if flight.truths else ()


def _fallback_mark(flight: FlightData) -> tuple[Mark, ...]:
    return (_FALLBACK,) if flight.fallback_spans else ()


def main() -> int:
    """Write the page; return 0, or 1 with the reason on standard error if it cannot be written."""
    recording, page = Path(sys.argv[1]), Path(sys.argv[2])
    try:
        write_report(FlightData.from_records(read(recording), recording), pickle.load(sys.stdin.buffer), page)
    except UavctlError as error:
        sys.stderr.write(f"{error}\n")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
