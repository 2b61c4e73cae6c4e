"""`uavctl log report`: the page of a recording."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import msgspec
from cyclopts import Parameter

from logs.flight_data import FlightData
from logs.outputs import spare_recording, write_whole
from logs.reader import lacks_end, read
from logs.report import picture, write_report
from logs.report_verdicts import verdict_rows
from logs.summary import render, summarise
from logs.verdicts import judge
from uavctl.cli.common import Common, Flight, Json, warn


def report(
    flight: Flight,
    /,
    *,
    out: Annotated[Path | None, Parameter(help="page to write; else beside the recording")] = None,
    svg: Annotated[Path | None, Parameter(help="also write a small picture of the flight")] = None,
    json: Json = False,
) -> int:
    """Write the page of a recording: one HTML file that needs nothing else."""
    page = out if out is not None else flight.with_suffix(".html")
    for target in (page, *(() if svg is None else (svg,))):
        spare_recording(target)
    data = FlightData.from_records(read(flight), flight)
    dropped = max((note.dropped for note in data.notes), default=0)
    summary = summarise(data, wall_s=None, recording=str(flight), report=str(page), recorder_dropped=dropped)
    judged = judge(data)
    if svg is not None:
        write_whole(svg, picture(data))
    write_report(data, summary, page, judged)
    if cut := lacks_end(flight):
        warn(f"{cut}: shown up to there")
    document = {**msgspec.structs.asdict(summary), "verdicts": judged.verdicts}
    Common(json=json).show(document, lambda: render(summary, verdict_rows(judged.verdicts)))
    return 0
