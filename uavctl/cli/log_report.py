"""Commands `uavctl log report` and `uavctl log compare`, which draw pages.

A report is of our recording, of a fleet's folder, a `.tlog` of any ground station, or a ULog of PX4.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import msgspec
from cyclopts import Parameter
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from logs.recording.file_kind import FileKind
from logs.recording.flight import FlightData
from logs.recording.foreign import read_foreign_flight
from logs.recording.mavlink_flight import MavlinkFlight, list_facts
from logs.recording.output_files import refuse_recording_path, write_atomically
from logs.recording.reader import explain_missing_end, read
from logs.recording.summary import make_summary_table, make_value_table, summarise
from logs.recording.ulog import is_ulog
from logs.report.compare import ComparedFlight, FlightComparison, compare_flights, load_flights
from logs.report.compare_page import write_comparison_page
from logs.report.compare_text import (
    convert_to_display_unit,
    describe_match,
    format_difference,
    format_label,
    format_parameter,
    format_value,
)
from logs.report.evidence import FlightEvidence
from logs.report.figures import draw_overview
from logs.report.findings import Headline
from logs.report.fleet import PAGE, is_fleet_folder, read_fleet
from logs.report.fleet_page import derive_banner, write_fleet_page
from logs.report.flight_page import write_report
from logs.report.headline import derive_headline
from logs.report.paper_figure import Width, check_figure_path, draw_flight, make_figure
from logs.report.tlog_headline import derive_tlog_headline
from logs.report.tlog_page import write_tlog_page
from logs.report.verdict_sections import make_verdict_rows
from logs.report.verdicts import judge_flight, read_flown_config
from uavctl.cli.common import Common, Flight, Json, System, check_readable, make_progress
from uavctl.cli.flight_risk import Rehearsals, compute_flight_risk
from uavctl.cli.output import Column, WideTable, make_headline_text, make_pair_table, make_table, warn
from uavctl.errors import DesignError, UsageError


def compare_command(
    first: Annotated[Path, Parameter(help="the recording that the others are compared with", validator=check_readable)],
    second: Annotated[Path, Parameter(help="another one", validator=check_readable)],
    /,
    *more: Annotated[Path, Parameter(help="and more", validator=check_readable)],
    out: Annotated[Path | None, Parameter(help="also write a page (HTML) with the flights in one drawing")] = None,
    json: Json = False,
) -> int:
    """Compare flights: parameters that differ, figures, and the first difference."""
    with make_progress() as progress:
        paths = (first, second, *more)
        task = progress.add_task("reading", total=len(paths))
        loaded = load_flights(paths, lambda: progress.advance(task))
        progress.update(task, description="comparing")
        comparison = compare_flights(loaded)
    if out is not None:
        write_comparison_page(comparison, loaded, out)
    Common(json=json).show("log/compare", comparison, lambda: render_terminal_comparison(comparison))
    return 0


def render_terminal_comparison(comparison: FlightComparison) -> RenderableType:
    """Return the comparison for a terminal: flights, their agreement, parameters, figures, notes."""
    parts: list[RenderableType] = [_render_sides(comparison.recordings)]
    first = comparison.recordings[0].name
    parts += [Text(describe_match(match, first)) for match in comparison.likenesses]
    parts.append(_make_parameter_table(comparison) if comparison.parameters else Text("No parameter differs."))
    parts.append(_make_figure_table(comparison))
    parts += [Text(f"Mind: {text}.", style="yellow") for text in comparison.notes]
    return Group(*parts)


def _render_sides(sides: tuple[ComparedFlight, ...]) -> RenderableType:
    def describe(flight: ComparedFlight) -> str:
        state = "" if flight.finished else ", torn"
        facts = f"config {flight.config}, seed {flight.seed}, {flight.started_utc}; {flight.ended}{state}"
        return f"{flight.recording}\n{facts}"

    return make_value_table((flight.name, describe(flight)) for flight in sides)


def _make_parameter_table(comparison: FlightComparison) -> Table:
    headings = ("", *(parameter.name for parameter in comparison.recordings))
    rows = (
        (Text(parameter.key), *(Text(format_parameter(value)) for value in parameter.values))
        for parameter in comparison.parameters
    )
    return make_table("Parameters that differ", headings, rows, headings, fold=True)


def _make_figure_table(comparison: FlightComparison) -> WideTable:
    rows = list(map(convert_to_display_unit, comparison.figures))
    first, *other_names = (flight.name for flight in comparison.recordings)
    groups = [[Column(first, [format_value(row.values[0]) for row in rows])]]
    for index, name in enumerate(other_names):
        groups.append(
            [
                Column(name, [format_value(row.values[index + 1]) for row in rows]),
                Column(f"{name} − {first}", [format_difference(row.differences[index]) for row in rows]),
                Column(f"{name} / {first}", [format_value(row.ratios[index]) for row in rows]),
            ]
        )
    section_ends = frozenset(index for index in range(len(rows) - 1) if rows[index].group != rows[index + 1].group)
    return WideTable(Column("figure", list(map(format_label, rows)), "left"), groups, section_ends)


def report(
    flight: Flight,
    /,
    *,
    out: Annotated[Path | None, Parameter(help="page to write; else beside the recording")] = None,
    svg: Annotated[Path | None, Parameter(help="also write a small picture of the flight")] = None,
    figure: Annotated[
        Path | None, Parameter(help="also write the path as a figure for a paper: .pdf, .svg, .eps or .png")
    ] = None,
    width: Annotated[
        Width | None, Parameter(help="with --figure: 3.5 in (column) or 7.16 in; else column", show_default=False)
    ] = None,
    system: System = None,
    rehearsals: Rehearsals = None,
    json: Json = False,
) -> int:
    """Write the page of a recording, fleet's folder, .tlog, or ULog of PX4: one HTML file that needs nothing else.

    The page has the probability that such a flight leaves the room, by rehearsals, beside the observed share.
    """
    if width is not None and figure is None:
        raise UsageError("--width is that of --figure; name its file, too")
    picture = next((name for name, path in (("--svg", svg), ("--figure", figure)) if path is not None), None)
    if is_fleet_folder(flight):
        return _report_fleet(flight, out, picture, Common(json=json))
    page = out if out is not None else flight.with_suffix(".html")
    for target in (page, *(() if svg is None else (svg,))):
        refuse_recording_path(target)
    if figure is not None:
        check_figure_path(figure)
    foreign = read_foreign_flight(flight, system)
    if foreign is not None:
        return _report_foreign(flight, foreign, page, picture, Common(json=json))
    data = FlightData.from_records(read(flight), flight)
    dropped = max((note.dropped for note in data.notes), default=0)
    summary = summarise(data, wall_s=None, recording=str(flight), report=str(page), recorder_dropped=dropped)
    verdicts = judge_flight(data, _rehearse_flown(data, rehearsals))
    if svg is not None:
        write_atomically(svg, draw_overview(data))
    if figure is not None:
        make_figure(lambda sheet: draw_flight(sheet, data), width or "column", figure)
    write_report(data, summary, page, verdicts)
    if cut := explain_missing_end(flight):
        warn(f"{cut}: shown up to there")
    headline = derive_headline(FlightEvidence(data, summary, verdicts))
    document = {**msgspec.structs.asdict(summary), "verdicts": verdicts.verdicts, "headline": headline.document()}
    Common(json=json).show(
        "log/report",
        document,
        lambda: _render_report(headline, make_summary_table(summary, make_verdict_rows(verdicts.verdicts))),
    )
    return 0


def _report_fleet(folder: Path, out: Path | None, picture: str | None, common: Common) -> int:
    """Write the page of a fleet's folder."""
    if picture is not None:
        raise UsageError(f"{picture} draws one flight; {folder} is the folder of a fleet, and of it there is the page")
    page = out if out is not None else folder / PAGE
    refuse_recording_path(page)
    fleet = read_fleet(folder)
    figures = write_fleet_page(fleet, page)
    for note in figures.notes:
        warn(note)
    common.show("log/report-fleet", figures, lambda: Group(make_headline_text(derive_banner(fleet)), f"page: {page}"))
    return 0


def _rehearse_flown(flight: FlightData, rehearsals: int | None) -> str | None:
    """Rehearse the recorded configuration, each time for as long as was flown; return the result in words."""
    config = read_flown_config(flight)
    if config is None or not flight.steps:
        return None
    replace, check = msgspec.structs.replace, config.check
    if rehearsals is not None:
        check = replace(check, rehearsals=rehearsals)
    try:
        risk = compute_flight_risk(replace(config, check=check, duration_s=len(flight.steps) * flight.design.dt_s))
    except DesignError:  # this version refuses the older configuration
        return None
    return None if risk is None else risk.sentence


def _render_report(headline: Headline, summary: RenderableType) -> Group:
    """Return the report for a terminal: the first line of the page with its reasons, then the figures."""
    return Group(make_headline_text(headline), *(Text(f"  {sentence}") for sentence in headline.reasons), summary)


def _report_foreign(flight: Path, foreign: MavlinkFlight, out: Path, picture: str | None, common: Common) -> int:
    if picture is not None:
        raise UsageError(f"{picture} needs a recording of uavctl; {flight} is another one, and has the page only")
    write_tlog_page(foreign, out)
    for note in foreign.info.notes:
        warn(note)
    headline = derive_tlog_headline(foreign)
    document = {**msgspec.to_builtins(foreign.info), "report": str(out), "headline": headline.document()}
    kind = FileKind.ULOG if is_ulog(flight) else FileKind.TLOG
    facts: list[tuple[str, object]] = [*list_facts(foreign.info), ("page", str(out))]
    common.show(f"log/report-{kind}", document, lambda: _render_report(headline, make_pair_table("", facts)))
    return 0
