"""One HTML page about a flight, complete in itself."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from pathlib import Path

from logs import page, plots, plots_control, plots_link, plots_solver
from logs.digits import number
from logs.flight_data import FlightData
from logs.outputs import write_whole
from logs.page import Mark, Section
from logs.path3d import path_3d
from logs.plots_control import picture
from logs.report_origin import origin_sections
from logs.report_verdicts import verdict_rows, verdict_sections
from logs.summary import FlightSummary, rows
from logs.timeline import timeline
from logs.verdict_link import DelayVerdict, LinkVerdict
from logs.verdicts import Judged, judge
from logs.words import part_begins, story
from uavctl.data import Event

__all__ = ["picture", "report_html", "write_report"]

_LIMIT = Mark("dashed", "limit", "limit")
_TARGET = Mark("dotted", "target", "target")
_ESTIMATE = Mark("line", "estimate", "estimate")
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
    """The page as text."""
    judged = judge(flight) if judged is None else judged
    header = flight.header
    name = _config_name(header.config_toml)
    title = f"Flight “{name}”" if name else "Flight"
    title += ", a part" if part_begins(flight) else ""
    subtitle = f"{header.started_utc} · {header.command} · seed {header.seed}"
    return page.page(title, subtitle, story(flight, summary), _sections(flight, summary, judged))


def _sections(flight: FlightData, summary: FlightSummary, judged: Judged) -> Iterator[Section]:
    begins = part_begins(flight)
    part = [("Part of a flight", f"begins at {begins}")] if begins else []
    yield Section("Summary", "", page.facts([*part, *rows(summary), *verdict_rows(judged.verdicts)]))
    yield _timeline_section(flight)
    yield _path_section(flight)
    yield _axes_section(flight)
    yield _age_section(flight)
    yield _link_section(flight, judged.verdicts.link)
    yield _inputs_section(flight)
    yield _plans_section(flight)
    yield _certificates_section(flight)
    yield _timing_section(flight)
    yield _events_section(flight)
    yield from verdict_sections(flight, judged)
    yield from origin_sections(flight)


def _timeline_section(flight: FlightData) -> Section:
    wide, narrow, marks = timeline(flight)
    return Section("Timeline", "", page.wide_or_narrow(wide, narrow), marks)


def _path_section(flight: FlightData) -> Section:
    deep = path_3d(flight)
    return Section(
        "Path",
        "",
        ("" if deep is None else page.wide_or_narrow(*deep)) + page.grid(list(plots.path(flight))),
        (
            *_truth_mark(flight),
            _ESTIMATE,
            *((Mark("planned", "plan", "plan, with its back-offs as ellipsoids"),) if deep is not None else ()),
            Mark("dot", "sample", "position used"),
            Mark("ring", "truth", "start"),
            _TARGET if flight.moving_target else Mark("star", "target", "target"),
            _LIMIT,
        ),
    )


def _axes_section(flight: FlightData) -> Section:
    return Section(
        "Each axis against its limits",
        "The band along a limit is the largest reserve that the plan of the moment kept from it.",
        page.grid(list(plots.axes_over_time(flight))),
        (
            *_truth_mark(flight),
            _ESTIMATE,
            _TARGET,
            _LIMIT,
            Mark("band", "limit", "reserve kept"),
            Mark("cross", "limit", "outside"),
            *_fallback_mark(flight),
        ),
    )


def _age_section(flight: FlightData) -> Section:
    lost = (Mark("tick", "lost", "position lost"),) if flight.truths else ()
    return Section(
        "Age of information",
        "How many steps old the newest position was. A plan lasts H steps; at age H the fallback takes over.",
        page.wide_or_narrow(*plots_control.age(flight)),
        (
            Mark("line", "estimate", "age"),
            Mark("dashed", "limit", f"horizon H = {flight.design.horizon}"),
            *lost,
            *_fallback_mark(flight),
        ),
    )


def _link_section(flight: FlightData, verdict: LinkVerdict) -> Section:
    drawings = list(plots_link.link(flight, verdict))
    bound = (Mark("thin", "estimate", "lower bound in flight"),) if flight.link_estimates else ()
    horizon = (Mark("dotted", "muted", f"horizon H = {flight.design.horizon}"),) if verdict.ages else ()
    note = "The dashed line is what the design counts on, by the link of the configuration."
    if verdict.delay is not None and verdict.delay.from_quickest:
        note += _quickest(verdict.delay)
    return Section(
        "The link, estimated against promised",
        note,
        page.paragraph(verdict.text) + (page.grid(drawings) if drawings else ""),
        (
            Mark("line", "estimate", "measured"),
            *bound,
            Mark("dashed", "limit", "promised"),
            *horizon,
            Mark("band", "limit", "delay configured"),
        )
        if drawings
        else (),
    )


def _quickest(delay: DelayVerdict) -> str:
    """What is known of delays where the sender's clock is only known by the quickest arrival."""
    if delay.latency_ms:
        return (
            f" The shortest delay is taken to be {number(delay.latency_ms)} ms (clock.latency_s), as the sender's "
            "clock is only known by it."
        )
    return " Delays are short of the quickest one, as the sender's clock is only known by it."


def _certificates_section(flight: FlightData) -> Section:
    drawings = list(plots_solver.certificates(flight))
    marks = [Mark("dot", role, name) for name, role in plots_solver.methods(flight)]
    gave = any(drawing.key == "plan-slack" for drawing in drawings)
    told = (
        "Slack is what state limits gave way by (light); the rest at the end of a plan may be missed, too (dark)."
        if gave
        else (
            "Slack is what state limits give way by, so that there is a plan at all. No plan that was flown gave way "
            "anywhere."
        )
    )
    return Section(
        "Certificates and slack",
        f"Each plan comes with a bound of the least cost there is: the gap between them is certified. "
        f"{plots_solver.ways(flight)}{told}",
        page.grid(drawings) if drawings else page.paragraph(_NO_PLAN),
        tuple(marks) if drawings else (),
    )


def _inputs_section(flight: FlightData) -> Section:
    return Section(
        "Inputs",
        "The colour tells how far into its plan the controller was when it gave the input, as in the first figure.",
        page.grid(list(plots_control.inputs(flight))),
        (_LIMIT, Mark("cross", "limit", "outside"), *_fallback_mark(flight)),
    )


def _plans_section(flight: FlightData) -> Section:
    drawings = list(plots.plans_against_flown(flight))
    flown = Mark("line", "truth", "flown" if flight.truths else "flown (estimate)")
    marks = (flown, Mark("planned", "plan", "plan, from its first state"), Mark("band", "plan", "back-off of the plan"))
    return Section(
        "Plans against what was flown",
        "A few plans on the way to the target, each with the back-off that it keeps from a limit at that stage.",
        page.grid(drawings) if drawings else page.paragraph(_NO_PLAN),
        marks if drawings else (),
    )


def _timing_section(flight: FlightData) -> Section:
    drawings = list(plots_control.timing(flight))
    late = "in virtual time no tick is late" if flight.virtual_time else _LATENESS
    return Section(
        "Time taken",
        f"Decision time is spent in the core at ticks that solve; {late}.",
        page.grid(drawings) if drawings else page.paragraph(_NO_TIMING),
    )


def _events_section(flight: FlightData) -> Section:
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
    return Section("Events", "", body)


def _truth_mark(flight: FlightData) -> tuple[Mark, ...]:
    return (Mark("line", "truth", "true state"),) if flight.truths else ()


def _fallback_mark(flight: FlightData) -> tuple[Mark, ...]:
    return (_FALLBACK,) if flight.fallback_spans else ()


def _config_name(config_toml: str) -> str | None:
    """Name in the configuration; a damaged one is shown as it is, further down."""
    try:
        name = tomllib.loads(config_toml).get("name")
    except tomllib.TOMLDecodeError:
        return None
    return name if isinstance(name, str) else None
