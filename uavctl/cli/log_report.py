"""Commands `uavctl log report` and `uavctl log compare`, which draw pages."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import msgspec
from cyclopts import Parameter
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from logs.recording.disk import FileKind, refuse_recording_path, write_atomically
from logs.recording.flight import FlightData
from logs.recording.foreign import read_foreign_flight
from logs.recording.mavlink_flight import MavlinkFlight, facts_of
from logs.recording.reader import lacks_end, read
from logs.recording.summary import make_summary_table, make_value_table, summarise
from logs.recording.ulog import is_ulog
from logs.report.causes import Headline
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
from logs.report.figures import draw_overview
from logs.report.flight_page import write_report
from logs.report.headline import derive_headline
from logs.report.tlog_headline import derive_tlog_headline
from logs.report.tlog_page import write_tlog_page
from logs.report.verdict_sections import make_verdict_rows
from logs.report.verdicts import judge_flight
from uavctl.cli.common import (
    Column,
    Common,
    Flight,
    Json,
    System,
    WideTable,
    check_readable,
    make_headline_text,
    make_pair_table,
    make_progress,
    make_table,
    warn,
)
from uavctl.errors import UsageError

# `uavctl log compare`: recordings beside each other.


def compare_command(
    first: Annotated[Path, Parameter(help="the recording that the others are compared with", validator=check_readable)],
    second: Annotated[Path, Parameter(help="another one", validator=check_readable)],
    /,
    *more: Annotated[Path, Parameter(help="and more", validator=check_readable)],
    out: Annotated[Path | None, Parameter(help="also write a page (HTML) with the flights in one drawing")] = None,
    json: Json = False,
) -> int:
    """Put flights beside each other: parameters that differ, figures, and where they part."""
    with make_progress() as progress:
        paths = (first, second, *more)
        task = progress.add_task("reading", total=len(paths))
        loaded = load_flights(paths, lambda: progress.advance(task))
        progress.update(task, description="comparing")
        found = compare_flights(loaded)
    if out is not None:
        write_comparison_page(found, loaded, out)
    Common(json=json).show("log/compare", found, lambda: comparison_picture(found))
    return 0


def comparison_picture(found: FlightComparison) -> RenderableType:
    """Return the comparison for a terminal: flights, how far they agree, parameters, figures, notes."""
    parts: list[RenderableType] = [_sides(found.recordings)]
    parts += [Text(text) for text in map(describe_match, found.likenesses)]
    parts.append(_parameters(found) if found.parameters else Text("No parameter differs."))
    parts.append(_figures(found))
    parts += [Text(f"Mind: {text}.", style="yellow") for text in found.notes]
    return Group(*parts)


def _sides(sides: tuple[ComparedFlight, ...]) -> RenderableType:
    def told(one: ComparedFlight) -> str:
        state = "" if one.finished else ", torn"
        return f"{one.recording}\nconfig {one.config}, seed {one.seed}, {one.started_utc}; {one.ended}{state}"

    return make_value_table((one.name, told(one)) for one in sides)


def _parameters(found: FlightComparison) -> Table:
    headings = ("", *(one.name for one in found.recordings))
    rows = ((Text(one.key), *(Text(format_parameter(value)) for value in one.values)) for one in found.parameters)
    return make_table("Parameters that differ", headings, rows, headings, fold=True)


def _figures(found: FlightComparison) -> WideTable:
    rows = list(map(convert_to_display_unit, found.figures))
    first, *others = (one.name for one in found.recordings)
    groups = [[Column(first, [format_value(row.values[0]) for row in rows])]]
    for place, name in enumerate(others):
        groups.append(
            [
                Column(name, [format_value(row.values[place + 1]) for row in rows]),
                Column(f"{name} − {first}", [format_difference(row.differences[place]) for row in rows]),
                Column(f"{name} / {first}", [format_value(row.ratios[place]) for row in rows]),
            ]
        )
    ends = frozenset(place for place in range(len(rows) - 1) if rows[place].group != rows[place + 1].group)
    return WideTable(Column("figure", list(map(format_label, rows)), "left"), groups, ends)


# `uavctl log report`: the page of a recording, ours, a `.tlog` of any ground station, or a ULog of PX4.


def report(
    flight: Flight,
    /,
    *,
    out: Annotated[Path | None, Parameter(help="page to write; else beside the recording")] = None,
    svg: Annotated[Path | None, Parameter(help="also write a small picture of the flight")] = None,
    system: System = None,
    json: Json = False,
) -> int:
    """Write the page of a recording, of a .tlog, or of a ULog of PX4: one HTML file that needs nothing else."""
    page = out if out is not None else flight.with_suffix(".html")
    for target in (page, *(() if svg is None else (svg,))):
        refuse_recording_path(target)
    foreign = read_foreign_flight(flight, system)
    if foreign is not None:
        return _report_foreign(flight, foreign, page, svg, Common(json=json))
    data = FlightData.from_records(read(flight), flight)
    dropped = max((note.dropped for note in data.notes), default=0)
    summary = summarise(data, wall_s=None, recording=str(flight), report=str(page), recorder_dropped=dropped)
    judged = judge_flight(data)
    if svg is not None:
        write_atomically(svg, draw_overview(data))
    write_report(data, summary, page, judged)
    if cut := lacks_end(flight):
        warn(f"{cut}: shown up to there")
    main = derive_headline(data, summary, judged)
    document = {**msgspec.structs.asdict(summary), "verdicts": judged.verdicts, "headline": main.document()}
    Common(json=json).show(
        "log/report", document, lambda: _told(main, make_summary_table(summary, make_verdict_rows(judged.verdicts)))
    )
    return 0


def _told(main: Headline, summary: RenderableType) -> Group:
    """Return what a terminal shows: the page's first line and why, then the figures."""
    return Group(make_headline_text(main), *(Text(f"  {sentence}") for sentence in main.reasons), summary)


def _report_foreign(flight: Path, found: MavlinkFlight, out: Path, svg: Path | None, common: Common) -> int:
    if svg is not None:
        raise UsageError(f"--svg draws a recording of ours; {flight} is none, and of it there is the page")
    write_tlog_page(found, out)
    for note in found.info.notes:
        warn(note)
    main = derive_tlog_headline(found)
    document = {**msgspec.to_builtins(found.info), "report": str(out), "headline": main.document()}
    kind = FileKind.ULOG if is_ulog(flight) else FileKind.TLOG
    facts: list[tuple[str, object]] = [*facts_of(found.info), ("page", str(out))]
    common.show(f"log/report-{kind}", document, lambda: _told(main, make_pair_table("", facts)))
    return 0
