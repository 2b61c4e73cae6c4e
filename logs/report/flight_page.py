"""Page of a flight: one HTML file, complete in itself."""

from __future__ import annotations

import math
import pickle
import sys
from collections.abc import Iterator
from pathlib import Path

from logs.recording.design_view import get_config_name
from logs.recording.flight import FlightData
from logs.recording.output_files import write_atomically
from logs.recording.reader import read
from logs.recording.summary import FlightSummary, find_input_violations, find_state_violations, list_summary_rows
from logs.report import figures, link_figures, origin_sections, plan_figures, plots, verdict_sections
from logs.report.cursor import render_cursor_script
from logs.report.evidence import FlightEvidence
from logs.report.headline import derive_headline
from logs.report.page import Mark, PageSection, Part, render_facts, render_list, render_note, render_page, render_table
from logs.report.path_3d import can_draw_path_3d, draw_path_3d
from logs.report.summary_text import describe_flight, describe_part_begin
from logs.report.timeline import describe_lanes, draw_timeline, list_hidden_texts
from logs.report.verdicts import Judgement, judge_flight
from uavctl.errors import UavctlError
from uavctl.event_codes import EventCode
from uavctl.number_text import format_number
from uavctl.records import Event

_TRUTH = Mark("line", "truth", "true state", when=lambda e: e.flight.truths)
_ESTIMATE = Mark("line", "estimate", "estimate")
_TARGET = Mark("dotted", "target", "target")
_LIMIT = Mark("dashed", "limit", "limit")
_FALLBACK = Mark("band", "fallback", "fallback", when=lambda e: e.flight.fallback_spans)
_HORIZON = Mark("dotted", "muted", "horizon H")
_NO_PLAN = "No plan was flown."

# Events of which each distinct text gets a row of its own: texts of the vehicle, changes of control.
_VERBATIM_EVENTS = frozenset({EventCode.VEHICLE_TEXT, EventCode.COMMAND_ACK, EventCode.HAND_OVER})


def write_report(flight: FlightData, summary: FlightSummary, path: Path, judged: Judgement | None = None) -> None:
    """Write the page; `judged` are the flight's verdicts, if they are there already.

    Raises:
        RecordingError: the file cannot be written.
    """
    write_atomically(path, render_report(flight, summary, judged))


def render_report(flight: FlightData, summary: FlightSummary, judged: Judgement | None = None) -> str:
    """Return the page of a flight as HTML."""
    evidence = FlightEvidence(flight, summary, judge_flight(flight) if judged is None else judged)
    header, headline = flight.header, derive_headline(evidence)
    name = get_config_name(header)
    title = f"Flight “{name}”" if name else "Flight"
    return render_page(
        f"{title}, a part" if describe_part_begin(flight) else title,
        f"{header.started_utc} · {header.command} · seed {header.seed}",
        SECTIONS,
        evidence,
        headline,
        render_cursor_script(flight, headline.at_s),
    )


def _show_timeline(e: FlightEvidence) -> Iterator[Part]:
    yield from draw_timeline(e.flight)
    yield render_note(describe_lanes(e.flight))


def _draw_paths(e: FlightEvidence) -> Iterator[Part]:
    yield from plots.draw_path_views(e.flight)
    yield from draw_path_3d(e.flight)


def _draw_ages(e: FlightEvidence) -> Iterator[Part]:
    yield figures.draw_age_figure(e.flight)
    yield from link_figures.draw_link_in_flight(e.flight, e.judged.verdicts.link)


def _explain_age(e: FlightEvidence) -> str:
    return (
        f"The age of the newest position, in steps. A plan lasts H = {e.flight.design.horizon} steps; at age H the "
        "fallback takes over."
    )


def _show_link(e: FlightEvidence) -> Iterator[Part]:
    verdict = e.judged.verdicts.link
    yield verdict.text
    yield from link_figures.draw_link_ages(e.flight, verdict)


def _explain_link(e: FlightEvidence) -> str:
    """Return how to read the link's figures; delays are relative where only the quickest one is known."""
    note = "The dashed line shows the design's assumption, from the link of the configuration."
    delay = e.judged.verdicts.link.delay
    if delay is None or not delay.from_quickest:
        return note
    if delay.latency_ms:
        return (
            f"{note} The shortest delay is assumed to be {format_number(delay.latency_ms)} ms (clock.latency_s): the "
            "sender's clock is only known from the quickest arrivals."
        )
    return (
        f"{note} Delays are relative to the quickest one: the sender's clock is only known from the quickest arrivals."
    )


def _draw_plans(e: FlightEvidence) -> Iterator[Part]:
    yield from plots.draw_plans_against_flown(e.flight)
    yield from figures.draw_plan_indices(e.flight)


def _explain_certificates(e: FlightEvidence) -> str:
    slack_text = (
        "Slack is the amount by which state limits were relaxed (light). A plan may also miss its terminal equality "
        "(dark)."
        if plan_figures.select_relaxed_plans(e.flight)
        else "Slack is the amount by which state limits are relaxed where no plan keeps them all. No flown plan "
        "relaxed a constraint."
    )
    bound_text = (
        "Plans have a lower bound of the optimal cost: the gap between cost and bound is certified. "
        if any(math.isfinite(plan.gap) for plan in e.flight.plans)
        else ""
    )
    return f"{bound_text}{plan_figures.describe_methods(e.flight)}{slack_text}"


def _explain_timing(e: FlightEvidence) -> str:
    lateness_text = (
        "in virtual time no tick is late"
        if e.flight.virtual_time
        else "lateness is from a tick's deadline to its start"
    )
    return f"Decision time is the time of the control core at ticks that solve; {lateness_text}."


def _show_events(e: FlightEvidence) -> Iterator[Part]:
    """Return a table of the events by kind, with the first text of each."""
    events_by_kind: dict[tuple[str, str, str], list[Event]] = {}
    for event in e.flight.events:
        text = event.text if event.code in _VERBATIM_EVENTS else ""
        events_by_kind.setdefault((event.severity.value, event.code, text), []).append(event)
    rows = [
        (
            f"{e.to_seconds(events[0].at_ns):.2f}",
            severity,
            code,
            str(sum(event.count for event in events)),
            events[0].text,
        )
        for (severity, code, _), events in events_by_kind.items()
    ]
    if rows:
        yield render_table(("first at [s]", "severity", "event", "times", "first text"), rows, frozenset({0, 3}))


def _show_summary(e: FlightEvidence) -> Iterator[Part]:
    yield render_list(describe_flight(e.flight, e.summary))
    verdict_rows = verdict_sections.make_verdict_rows(e.judged.verdicts)
    yield render_facts([*list_summary_rows(e.summary), *verdict_rows])


SECTIONS: tuple[PageSection[FlightEvidence], ...] = (
    PageSection("Timeline", _show_timeline, legend=lambda e: list_hidden_texts(e.flight)),
    PageSection(
        "Path",
        _draw_paths,
        legend=(
            _TRUTH,
            _ESTIMATE,
            Mark(
                "planned", "plan", "plan, with its back-offs as ellipsoids", when=lambda e: can_draw_path_3d(e.flight)
            ),
            Mark("dot", "sample", "position used"),
            Mark("ring", "truth", "start"),
            Mark("dotted", "target", "target", when=lambda e: e.flight.moving_target),
            Mark("star", "target", "target", when=lambda e: not e.flight.moving_target),
            _LIMIT,
            Mark("band", "limit", "space closed by a fence", when=lambda e: plots.find_moving_limits(e.flight)),
            Mark("ring", "limit", "limit left here", when=lambda e: e.excursions),
            Mark("cross", "limit", "furthest outside", when=lambda e: e.excursions),
        ),
    ),
    PageSection(
        "Each axis against its limits",
        lambda e: plots.draw_axes_over_time(e.flight),
        note="The band along a limit is the largest back-off of the plan at that time.",
        legend=(
            _TRUTH,
            _ESTIMATE,
            _TARGET,
            _LIMIT,
            Mark("band", "limit", "back-off"),
            Mark("cross", "limit", "outside", when=lambda e: find_state_violations(e.flight).any()),
            _FALLBACK,
        ),
    ),
    PageSection(
        "Inputs",
        lambda e: figures.draw_inputs(e.flight),
        note="The colour shows the index within the plan that gave the input: from blue, the first step of a plan, to "
        "orange, its last.",
        legend=(
            _LIMIT,
            Mark("cross", "limit", "outside", when=lambda e: find_input_violations(e.flight).any()),
            _FALLBACK,
        ),
    ),
    PageSection(
        "Age of information",
        _draw_ages,
        note=_explain_age,
        legend=(
            Mark("line", "estimate", "measured"),
            Mark("thin", "estimate", "lower bound in flight", when=lambda e: e.flight.link_estimates),
            Mark("dashed", "limit", "horizon H; share of steps with a new position that the design counts on"),
            Mark("band", "limit", "delay configured", when=lambda e: e.judged.verdicts.link.delay is not None),
            Mark("tick", "lost", "position lost", when=lambda e: e.flight.truths),
            _FALLBACK,
        ),
    ),
    PageSection(
        "The link, measured against promised",
        _show_link,
        note=_explain_link,
        legend=(Mark("line", "estimate", "measured"), Mark("dashed", "limit", "promised"), _HORIZON),
        is_closed=True,
    ),
    PageSection(
        "Plans against the flight",
        _draw_plans,
        note="A few plans on the way to the target, each with its back-off from the limits at each stage.",
        legend=(
            Mark("line", "truth", "flown", when=lambda e: e.flight.truths),
            Mark("line", "truth", "flown (estimate)", when=lambda e: not e.flight.truths),
            Mark("planned", "plan", "plan, from its first state"),
            Mark("band", "plan", "back-off of the plan"),
        ),
        empty_text=_NO_PLAN,
        is_closed=True,
    ),
    PageSection(
        "Certificates and slack",
        lambda e: plan_figures.draw_certificates(e.flight),
        note=_explain_certificates,
        legend=lambda e: (Mark("dot", role, name) for name, role in plan_figures.list_methods(e.flight)),
        empty_text="No plan has a certified gap, and no flown plan has slack.",
        is_closed=True,
    ),
    PageSection(
        "Time taken",
        lambda e: figures.draw_timing(e.flight),
        note=_explain_timing,
        empty_text="No times were measured in this flight.",
        is_closed=True,
    ),
    *verdict_sections.SECTIONS,
    *origin_sections.SECTIONS,
    PageSection("Events", _show_events, empty_text="There were no events."),
    PageSection("Summary", _show_summary),
)


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
