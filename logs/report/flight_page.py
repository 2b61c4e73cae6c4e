"""Page of a flight: one HTML file, complete in itself."""

from __future__ import annotations

import pickle
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from logs.recording.design_view import get_config_name
from logs.recording.flight import FlightData
from logs.recording.output_files import write_atomically
from logs.recording.reader import read
from logs.recording.summary import FlightSummary, find_input_violations, find_state_violations, list_summary_rows
from logs.report import figures, link_figures, page, plan_figures, plots
from logs.report.cursor import render_cursor_script
from logs.report.excursion import find_excursions
from logs.report.headline import derive_headline
from logs.report.origin_sections import make_origin_sections
from logs.report.page import Mark, PageSection
from logs.report.path_3d import draw_path_3d
from logs.report.summary_text import describe_flight, describe_part_begin
from logs.report.timeline import draw_timeline
from logs.report.verdict_link import DelayVerdict, LinkVerdict
from logs.report.verdict_sections import make_clocks_section, make_model_section, make_risk_section, make_verdict_rows
from logs.report.verdicts import Judgement, judge_flight
from uavctl.errors import UavctlError
from uavctl.event_codes import EventCode
from uavctl.number_text import format_number
from uavctl.records import Event

_LIMIT = Mark("dashed", "limit", "limit")
_TARGET = Mark("dotted", "target", "target")
_ESTIMATE = Mark("line", "estimate", "estimate")
_OUTSIDE = Mark("cross", "limit", "outside")
_EXIT = Mark("ring", "limit", "where it left its limits")
_FURTHEST = Mark("cross", "limit", "furthest outside")
_FALLBACK = Mark("band", "fallback", "fallback")
_NO_PLAN = "No plan was flown, so there is nothing to compare."
_LATENESS = "lateness is from a tick's deadline to its start"
_NO_TIMING = "No times were measured in this flight."

# Of these every other text is another matter: what the vehicle says, who flies.
_VERBATIM_EVENTS = frozenset({EventCode.VEHICLE_TEXT, EventCode.COMMAND_ACK, EventCode.HAND_OVER})


def write_report(flight: FlightData, summary: FlightSummary, path: Path, judged: Judgement | None = None) -> None:
    """Write the page; `judged` are the flight's verdicts, if they are there already.

    Raises:
        RecordingError: the file cannot be written.
    """
    write_atomically(path, render_report(flight, summary, judged))


def render_report(flight: FlightData, summary: FlightSummary, judged: Judgement | None = None) -> str:
    """Return the page of a flight as HTML."""
    judged = judge_flight(flight) if judged is None else judged
    header = flight.header
    name = get_config_name(header)
    title = f"Flight “{name}”" if name else "Flight"
    title += ", a part" if describe_part_begin(flight) else ""
    subtitle = f"{header.started_utc} · {header.command} · seed {header.seed}"
    headline = derive_headline(flight, summary, judged)
    return page.render_page(
        title,
        subtitle,
        (),
        _make_sections(flight, summary, judged),
        top=page.render_banner(headline.tone, headline.word, headline.text, headline.reasons),
        script=render_cursor_script(flight, headline.at_s),
    )


def _make_sections(flight: FlightData, summary: FlightSummary, judged: Judgement) -> Iterator[PageSection]:
    wide, narrow, marks, meanings = draw_timeline(flight)
    yield PageSection("Timeline", "", page.render_wide_or_narrow(wide, narrow) + page.render_note(meanings), marks)
    yield _make_path_section(flight)
    yield _make_axes_section(flight)
    yield _make_inputs_section(flight)
    yield _make_age_section(flight, judged.verdicts.link)
    for section in (
        _make_link_section(flight, judged.verdicts.link),
        _make_plans_section(flight),
        _make_certificates_section(flight),
        _make_timing_section(flight),
        make_risk_section(judged.verdicts),
        make_model_section(flight, judged),
        make_clocks_section(flight, judged.verdicts),
        *make_origin_sections(flight),
    ):
        yield replace(section, closed=True)
    yield _make_events_section(flight)
    yield _make_summary_section(flight, summary, judged)


def _make_summary_section(flight: FlightData, summary: FlightSummary, judged: Judgement) -> PageSection:
    facts = page.render_facts([*list_summary_rows(summary), *make_verdict_rows(judged.verdicts)])
    return PageSection("Summary", "", page.render_list(describe_flight(flight, summary)) + facts)


def _make_path_section(flight: FlightData) -> PageSection:
    drawing_3d = draw_path_3d(flight)
    return PageSection(
        "Path",
        "",
        page.render_grid([*plots.draw_path_views(flight), *(() if drawing_3d is None else (drawing_3d,))]),
        (
            *_make_truth_mark(flight),
            _ESTIMATE,
            *((Mark("planned", "plan", "plan, with its back-offs as ellipsoids"),) if drawing_3d is not None else ()),
            Mark("dot", "sample", "position used"),
            Mark("ring", "truth", "start"),
            _TARGET if flight.moving_target else Mark("star", "target", "target"),
            _LIMIT,
            *((Mark("band", "limit", "space that a fence took"),) if plots.find_moving_limits(flight) else ()),
            *((_EXIT, _FURTHEST) if find_excursions(flight) else ()),
        ),
    )


def _make_axes_section(flight: FlightData) -> PageSection:
    return PageSection(
        "Each axis against its limits",
        "The band along a limit is the largest reserve that the plan of the moment kept from it.",
        page.render_grid(list(plots.draw_axes_over_time(flight))),
        (
            *_make_truth_mark(flight),
            _ESTIMATE,
            _TARGET,
            _LIMIT,
            Mark("band", "limit", "reserve kept"),
            *((_OUTSIDE,) if find_state_violations(flight).any() else ()),
            *_make_fallback_mark(flight),
        ),
    )


def _make_age_section(flight: FlightData, verdict: LinkVerdict) -> PageSection:
    lost = (Mark("tick", "lost", "position lost"),) if flight.truths else ()
    bound = (Mark("thin", "estimate", "lower bound in flight"),) if flight.link_estimates else ()
    return PageSection(
        "Age of information",
        "How many steps old the newest position was. A plan lasts H steps; at age H the fallback takes over.",
        page.render_grid([figures.draw_age_figure(flight), *link_figures.draw_link_in_flight(flight, verdict)]),
        (
            Mark("line", "estimate", "measured"),
            *bound,
            Mark("dashed", "limit", f"horizon H = {flight.design.horizon}; share of news that the design counts on"),
            *((Mark("band", "limit", "delay configured"),) if verdict.delay is not None else ()),
            *lost,
            *_make_fallback_mark(flight),
        ),
    )


def _make_link_section(flight: FlightData, verdict: LinkVerdict) -> PageSection:
    drawings = list(link_figures.draw_link_ages(flight, verdict))
    horizon = (Mark("dotted", "muted", f"horizon H = {flight.design.horizon}"),) if verdict.ages else ()
    note = "The dashed line is what the design counts on, by the link of the configuration."
    if verdict.delay is not None and verdict.delay.from_quickest:
        note += _describe_quickest(verdict.delay)
    return PageSection(
        "The link, estimated against promised",
        note,
        page.render_paragraph(verdict.text) + (page.render_grid(drawings) if drawings else ""),
        (Mark("line", "estimate", "measured"), Mark("dashed", "limit", "promised"), *horizon) if drawings else (),
    )


def _describe_quickest(delay: DelayVerdict) -> str:
    """Return a sentence on delays where the sender's clock is known by the quickest arrival only."""
    if delay.latency_ms:
        return (
            f" The shortest delay is taken to be {format_number(delay.latency_ms)} ms (clock.latency_s), as the "
            "sender's clock is only known by it."
        )
    return " Delays are short of the quickest one, as the sender's clock is only known by it."


def _make_certificates_section(flight: FlightData) -> PageSection:
    drawings = list(plan_figures.draw_certificates(flight))
    marks = [Mark("dot", role, name) for name, role in plan_figures.list_methods(flight)]
    has_relaxed = any(drawing.key == "plan-slack" for drawing in drawings)
    slack_text = (
        "Slack is what state limits gave way by (light); the rest at the end of a plan may be missed, too (dark)."
        if has_relaxed
        else (
            "Slack is what state limits give way by, so that there is a plan at all. No plan that was flown gave way "
            "anywhere."
        )
    )
    return PageSection(
        "Certificates and slack",
        f"Each plan comes with a bound of the least cost there is: the gap between them is certified. "
        f"{plan_figures.describe_methods(flight)}{slack_text}",
        page.render_grid(drawings) if drawings else page.render_paragraph(_NO_PLAN),
        tuple(marks) if drawings else (),
    )


def _make_inputs_section(flight: FlightData) -> PageSection:
    return PageSection(
        "Inputs",
        "The colour tells how far into its plan the controller was when it gave the input: from blue, the first step "
        "of a plan, to orange, its last.",
        page.render_grid(list(figures.draw_inputs(flight))),
        (_LIMIT, *((_OUTSIDE,) if find_input_violations(flight).any() else ()), *_make_fallback_mark(flight)),
    )


def _make_plans_section(flight: FlightData) -> PageSection:
    drawings = [*plots.draw_plans_against_flown(flight), *figures.draw_plan_indices(flight)]
    flown = Mark("line", "truth", "flown" if flight.truths else "flown (estimate)")
    marks = (flown, Mark("planned", "plan", "plan, from its first state"), Mark("band", "plan", "back-off of the plan"))
    return PageSection(
        "Plans against what was flown",
        "A few plans on the way to the target, each with the back-off that it keeps from a limit at that stage.",
        page.render_grid(drawings) if drawings else page.render_paragraph(_NO_PLAN),
        marks if drawings else (),
    )


def _make_timing_section(flight: FlightData) -> PageSection:
    drawings = list(figures.draw_timing(flight))
    lateness_text = "in virtual time no tick is late" if flight.virtual_time else _LATENESS
    return PageSection(
        "Time taken",
        f"Decision time is spent in the core at ticks that solve; {lateness_text}.",
        page.render_grid(drawings) if drawings else page.render_paragraph(_NO_TIMING),
    )


def _make_events_section(flight: FlightData) -> PageSection:
    events_by_kind: dict[tuple[str, str, str], list[Event]] = {}
    for event in flight.events:
        text = event.text if event.code in _VERBATIM_EVENTS else ""
        events_by_kind.setdefault((event.severity.value, event.code, text), []).append(event)
    event_rows = [
        (
            f"{flight.seconds([events[0].at_ns])[0]:.2f}",
            severity,
            code,
            str(sum(e.count for e in events)),
            events[0].text,
        )
        for (severity, code, _), events in events_by_kind.items()
    ]
    columns = ("first at [s]", "severity", "event", "times", "as first told")
    body = (
        page.render_table(columns, event_rows, frozenset({0, 3}))
        if event_rows
        else page.render_paragraph("There were none.")
    )
    return PageSection("Events", "", body)


def _make_truth_mark(flight: FlightData) -> tuple[Mark, ...]:
    return (Mark("line", "truth", "true state"),) if flight.truths else ()


def _make_fallback_mark(flight: FlightData) -> tuple[Mark, ...]:
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
