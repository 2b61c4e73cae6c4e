"""One HTML page about a flight, complete in itself."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from pathlib import Path

from logs import page, plots, plots_control
from logs.flight_data import FALLBACK, FlightData
from logs.page import Mark, Section
from logs.plots_control import picture
from logs.summary import FlightSummary, rows
from logs.words import story
from uavctl.data import Event
from uavctl.errors import RecordingError

__all__ = ["picture", "report_html", "write_report"]

_LIMIT = Mark("dashed", "limit", "limit")
_TARGET = Mark("dotted", "target", "target")
_ESTIMATE = Mark("line", "estimate", "estimate")
_FALLBACK = Mark("band", "fallback", "fallback")
_NO_PLAN = "No plan was flown, so there is nothing to compare."
_LATENESS = "lateness is from a tick's deadline to its start"
_NO_TIMING = "No times were measured in this flight."


def write_report(flight: FlightData, summary: FlightSummary, path: Path) -> None:
    """Write the page.

    Raises:
        RecordingError: the file cannot be written.
    """
    text = report_html(flight, summary)
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise RecordingError(f"{path}: cannot be written ({error.strerror}); choose another place") from error


def report_html(flight: FlightData, summary: FlightSummary) -> str:
    """The page as text."""
    header = flight.header
    name = _config_name(header.config_toml)
    title = f"Flight “{name}”" if name else "Flight"
    subtitle = f"{header.started_utc} · {header.command} · seed {header.seed}"
    return page.page(title, subtitle, story(flight, summary), _sections(flight, summary))


def _sections(flight: FlightData, summary: FlightSummary) -> Iterator[Section]:
    yield Section("Summary", "", page.facts(rows(summary)))
    yield _path_section(flight)
    yield _age_section(flight)
    yield _axes_section(flight)
    yield _inputs_section(flight)
    yield _plans_section(flight)
    yield _timing_section(flight)
    yield _events_section(flight)
    yield _origin_section(flight)


def _path_section(flight: FlightData) -> Section:
    return Section(
        "Path",
        "",
        page.grid(list(plots.path(flight))),
        (
            *_truth_mark(flight),
            _ESTIMATE,
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
    kinds: dict[tuple[str, str], list[Event]] = {}
    for event in flight.events:
        kinds.setdefault((event.severity.value, event.code), []).append(event)
    found = [
        (f"{flight.seconds([some[0].at_ns])[0]:.2f}", severity, code, str(sum(e.count for e in some)), some[0].text)
        for (severity, code), some in kinds.items()
    ]
    columns = ("first at [s]", "severity", "event", "times", "as first told")
    body = page.table(columns, found, frozenset({0, 3})) if found else page.paragraph("There were none.")
    return Section("Events", "", body)


def _origin_section(flight: FlightData) -> Section:
    header = flight.header
    made = [("Design", header.design_id), ("Processor", header.cpu), *sorted(header.versions.items())]
    body = page.folded("Configuration", header.config_toml) + page.facts(made)
    return Section("Made with", "", body)


def _truth_mark(flight: FlightData) -> tuple[Mark, ...]:
    return (Mark("line", "truth", "true state"),) if flight.truths else ()


def _fallback_mark(flight: FlightData) -> tuple[Mark, ...]:
    return (_FALLBACK,) if flight.spans(FALLBACK) else ()


def _config_name(config_toml: str) -> str | None:
    """Name in the configuration; a damaged one is shown as it is, further down."""
    try:
        name = tomllib.loads(config_toml).get("name")
    except tomllib.TOMLDecodeError:
        return None
    return name if isinstance(name, str) else None
