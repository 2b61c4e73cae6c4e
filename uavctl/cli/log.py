"""Commands `uavctl log`: export, info, recover and layout, and the names of the other ones."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from cyclopts import App, Parameter
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from logs.recording.attachments import make_layout_text
from logs.recording.export import Exported, TableFormat, Watch, export_tables
from logs.recording.file_kind import FileKind, detect_kind
from logs.recording.file_scan import RecordedMessage
from logs.recording.foreign import read_foreign_flight
from logs.recording.info import PositionLoss, RecordingInfo, read_info
from logs.recording.mavlink_flight import MavlinkFlightInfo, format_rate, list_facts
from logs.recording.parameters import VehicleParameter, count_parameters
from logs.recording.reader import explain_missing_end
from logs.recording.recover import RecoverResult
from logs.recording.recover import recover as recover_recording
from logs.recording.summary import count
from logs.recording.tlog import ExportedTlog, export_tlog
from logs.recording.ulog import is_ulog
from logs.report.findings import Headline
from uavctl.cli.common import Common, Flight, Json, System, make_progress
from uavctl.cli.output import format_counts, make_headline_text, make_pair_table, make_table, warn
from uavctl.cli.usage import format_example
from uavctl.errors import UsageError

TLOG = "tlog"


def export(
    flight: Flight,
    /,
    *,
    to: Annotated[Literal["csv", "parquet", "tlog"], Parameter(help="format")],
    out: Annotated[
        Path | None, Parameter(help="folder of the tables, or the .tlog to write; else beside the recording")
    ] = None,
    link: Annotated[str | None, Parameter(help="with tlog: this connection alone, as in vehicle; else all")] = None,
    force: Annotated[bool, Parameter(negative=(), help="overwrite existing files")] = False,
    json: Json = False,
) -> int:
    """Write a recording as tables (CSV, or Parquet with uavctl[parquet]), or its raw MAVLink as a .tlog."""
    if to == TLOG:
        _export_tlog(flight, _choose_tlog_path(flight, out), link, force=force, common=Common(json=json))
    elif link is not None:
        raise UsageError("--link is for --to tlog: tables hold all topics, the raw bytes of each connection in its own")
    else:
        folder = out if out is not None else flight.with_name(f"{flight.stem}-{to}")
        with _show_progress() as watch:
            exported = export_tables(flight, folder, TableFormat(to), force=force, watch=watch)
        Common(json=json).show("log/export", exported, lambda: _render_tables(exported, folder))
        for topic, number in exported.unknown.items():
            warn(f"left out: {count(number, 'record')} of {topic}, which this version does not know")
    if cut := explain_missing_end(flight):
        warn(f"{cut}: exported up to there")
    return 0


def _export_tlog(flight: Path, file: Path, link: str | None, *, force: bool, common: Common) -> None:
    with _show_progress() as watch:
        exported = export_tlog(flight, file, link=link, force=force, watch=watch)
    common.show("log/export-tlog", exported, lambda: _render_tlog(exported))
    if exported.left_out_bytes:
        warn(f"left out: {count(exported.left_out_bytes, 'byte')} that are no whole MAVLink packet")


def _choose_tlog_path(flight: Path, out: Path | None) -> Path:
    if out is None:
        return flight.with_suffix(".tlog")
    return out / f"{flight.stem}.tlog" if out.is_dir() else out


@contextmanager
def _show_progress() -> Iterator[Watch]:
    with make_progress() as progress:

        def watch(records: Iterable[RecordedMessage], total: int | None, description: str) -> Iterable[RecordedMessage]:
            return progress.track(records, total=total, description=description)

        yield watch


def _render_tables(exported: Exported, folder: Path) -> RenderableType:
    rows = ((Text(Path(table.file).name), str(table.rows), str(table.columns)) for table in exported.tables)
    return Group(make_table("", ("file", "rows", "columns"), rows, fold=True), Text(f"in {folder}"))


def _render_tlog(exported: ExportedTlog) -> RenderableType:
    rows = ((Text(topic), str(packets)) for topic, packets in exported.packets.items())
    return Group(make_table("", ("topic", "packets"), rows), Text(f"in {exported.file}"))


_SHOWN_PARAMETERS = 4


def _render_tlog_info(flight_info: MavlinkFlightInfo) -> RenderableType:
    rows = ((Text(name), str(number), format_rate(flight_info, name)) for name, number in flight_info.messages.items())
    lines = [f"{name}: {value}" for name, value in list_facts(flight_info)]
    return Group(
        make_table("", ("message", "number", "rate"), rows, fold=True), *map(Text, (*lines, *flight_info.notes))
    )


def render_info(info: RecordingInfo) -> RenderableType:
    """Return a table of topics with rates and gaps, and below it further facts."""
    title = f"{info.files[0]}: {info.duration_s:.1f} s, {info.bytes:,} bytes"
    if len(info.files) > 1:
        title += f" in {len(info.files)} files"
    table = make_table("", ("topic", "messages", "rate", "longest gap", "at"), ())
    for topic in info.topics:
        rate = f"{topic.rate_hz:.1f}/s" if topic.messages > 1 else ""
        gap = (f"{topic.longest_gap_s:.3f} s", f"{topic.longest_gap_at_s:.1f} s") if topic.longest_gap_s else ("", "")
        table.add_row(Text(topic.topic), str(topic.messages), rate, *gap)
    return Group(Text(title), table, *_make_fleet_tables(info), *map(Text, _list_facts(info)))


def _make_fleet_tables(info: RecordingInfo) -> Iterator[Table]:
    """Return tables on a sender's messages, or on a coordinator's cycles."""
    if (sender := info.sender) is not None:
        rows = [
            [name, str(one.messages), _format_span(one.mean_wait_s), _format_span(one.longest_wait_s)]
            for name, one in sender.vehicles.items()
        ]
        headings = ("vehicle", "messages", "mean wait", "longest wait")
        yield make_table(f"sender, schedule {sender.schedule or 'unknown'}", headings, rows)
    if (coordinator := info.coordinator) is not None:
        reasons = sorted({reason for counts in coordinator.waits.values() for reason in counts})
        rows = [
            [name, str(coordinator.cells[name]), *(str(counts.get(reason, 0)) for reason in reasons)]
            for name, counts in coordinator.waits.items()
        ]
        title = f"coordinator: {coordinator.cycles} cycles, longest gap {coordinator.longest_gap_s:.3f} s"
        yield make_table(title, ("vehicle", "cells", *reasons), rows)


def _format_span(span_s: float | None) -> str:
    return "" if span_s is None else f"{span_s:.3f} s"


def _list_facts(info: RecordingInfo) -> Iterator[str]:
    if not info.finished and not info.messages:
        yield "not closed, and torn before its first whole chunk: nothing can be restored"
    elif not info.finished:
        yield "not closed: `uavctl log recover` makes a clean file"
    elif info.damage:
        yield "damaged: `uavctl log recover` restores the rest"
    else:
        yield "closed in order"
    yield (
        f"records lost: {info.dropped} dropped, {info.refused} refused, {info.missing} missing; "
        f"{info.failures} failed writes"
    )
    if len(info.segments) > 1:
        for segment in info.segments:
            state = "" if segment.finished else ", not closed"
            yield f"{segment.file}: {segment.messages} messages, {segment.bytes:,} bytes{state}"
    yield from info.damage
    for note in info.notes:
        yield f"{note.at_s:.1f} s: {note.text}"
    for link in info.connections:
        left_out = {reason: counts for reason, counts in (("bad", link.bad), ("refused", link.refused)) if counts}
        lost = "".join(
            f"; {reason}: {format_counts(dict(sorted(counts.items())))}" for reason, counts in left_out.items()
        )
        yield (
            f"connection {link.link}: {link.datagrams} datagrams, {link.messages} messages, "
            f"{link.samples} positions{lost}"
        )
    yield from _describe_loss(info.position_loss)
    if info.origin is not None:
        yield f"{info.origin.command} ({info.origin.started_utc}, seed {info.origin.seed})"
    if info.library is not None:
        yield f"policy library {info.library.library_id}, {info.library.bytes:,} bytes"
    if info.begin_utc is not None:
        yield f"begins at {info.begin_utc}"
    for file in info.attachments:
        yield f"attached: {file.name}, {file.bytes:,} bytes"
    if info.parameters:
        yield from _describe_parameters(info.parameters, info.parameter_count)


def _describe_parameters(parameters: Mapping[str, VehicleParameter], count: int | None) -> Iterator[str]:
    shown = ", ".join(f"{name} {parameter.value}" for name, parameter in [*parameters.items()][:_SHOWN_PARAMETERS])
    ellipsis = "" if len(parameters) <= _SHOWN_PARAMETERS else " ...; --json has all"
    number = count_parameters(parameters)
    missing = (
        "" if count is None or number >= count else f"; INCOMPLETE: {number} of the {count} that the vehicle reports"
    )
    yield f"vehicle parameters: {len(parameters)} ({shown}{ellipsis}){missing}"


def _describe_loss(loss: PositionLoss) -> Iterator[str]:
    if loss.believed is not None:
        bursts = ", lost in bursts" if loss.bursts else ""
        promise_text = ", fewer than promised" if loss.below_promise else ""
        share = f"{100 * (1.0 - loss.believed):.0f} % of the steps"
        yield f"positions: received in the step of their capture in {share}, by the last estimate{promise_text}{bursts}"
    if loss.simulated_sent:
        yield f"simulated channel: {loss.simulated_lost} of {loss.simulated_sent} positions lost"


RECOVERED_WITH_LOSS = 3
log_app = App(
    name="log",
    help="Recordings: info, recover, replay, report, compare, whatif, export; a layout.",
    help_epilogue=format_example("log"),
    help_format="markdown",
)
# A module is imported when its command runs: a replay does not load the drawing of pages.
_COMMANDS = {
    "replay": (
        "replay:replay",
        """Drive the recorded inputs through the same control loop and compare all decisions.

        Another program's flight (a `.tlog`, or an MCAP with raw MAVLink in it) goes through parser, clock offset,
        estimator and controller of `--config`. With `--set KEY=VALUE` a recording of ours is replayed with that key
        changed: the output shows the first decision that differs on the same inputs.
        """,
    ),
    "report": (
        "log_report:report",
        "Write the page of a recording, fleet's folder, .tlog, or ULog of PX4: one HTML file.",
    ),
    "compare": (
        "log_report:compare_command",
        "Compare flights: parameters that differ, figures, and the first difference.",
    ),
    "whatif": (
        "whatif:whatif",
        """Fly a recorded flight again with something changed, in the same disturbance, and compare.

        The recorded inputs of the control loop are given again at their times; positions are moved by the difference
        of the two flights, by the model. docs/what-if.md shows the limits.
        """,
    ),
    "export": (
        "log:export",
        """Write a recording as tables (CSV, or Parquet with uavctl[parquet]), or its raw MAVLink as a .tlog.

        One table for each topic of records. Topics made for viewers (/view, /plot) are left out: they hold nothing
        that the records do not. docs/recordings.md describes the columns.
        """,
    ),
}
for _name, (_path, _help) in _COMMANDS.items():
    _more = {"usage": "Usage: uavctl log compare [OPTIONS] FIRST SECOND [MORE]..."} if _name == "compare" else {}
    log_app.command(
        f"uavctl.cli.{_path}", name=_name, help=_help, help_epilogue=format_example(f"log {_name}"), **_more
    )


@log_app.command(help_epilogue=format_example("log info"))
def info(flight: Flight, /, *, system: System = None, json: Json = False) -> int:
    """Show a recording, a .tlog or a ULog: the page's first line, topics, rates, gaps, losses, origin."""
    from logs.report import headline, tlog_headline  # loads SciPy, so only for this command

    if detect_kind(flight) is not FileKind.MCAP or system is not None:
        foreign = read_foreign_flight(flight, system)
        assert foreign is not None  # None only for our own recording, which has no system id
        foreign_info, foreign_headline = foreign.info, tlog_headline.derive_tlog_headline(foreign)
        name = FileKind.ULOG if is_ulog(flight) else FileKind.TLOG
        Common(json=json).show(
            f"log/info-{name}",
            _add_headline(foreign_headline, foreign_info),
            lambda: Group(make_headline_text(foreign_headline), _render_tlog_info(foreign_info)),
        )
        return 0
    recording_info, recording_headline = read_info(flight), headline.derive_headline_of_file(flight)
    headline_text = () if recording_headline is None else (make_headline_text(recording_headline),)
    Common(json=json).show(
        "log/info",
        _add_headline(recording_headline, recording_info),
        lambda: Group(*headline_text, render_info(recording_info)),
    )
    return 0


def _add_headline(recording_headline: Headline | None, info: msgspec.Struct) -> dict[str, object]:
    """Return the document of a recording; its first key is the first line of the page."""
    return {
        "headline": None if recording_headline is None else recording_headline.document(),
        **msgspec.structs.asdict(info),
    }


@log_app.command(help_epilogue=format_example("log recover"))
def recover(flight: Flight, out: Annotated[Path, Parameter(help="file to write")], /, *, json: Json = False) -> int:
    """Restore the readable records of a torn or damaged recording. Exit code 3: with loss."""
    result = recover_recording(flight, out)
    Common(json=json).show("log/recover", result, lambda: _make_recover_table(result, out))
    return 0 if result.lossless else RECOVERED_WITH_LOSS


@log_app.command(help_epilogue=format_example("log layout"))
def layout() -> int:
    """Print the layout for Foxglove: `uavctl log layout > uavctl.json`, there "Import from file"."""
    sys.stdout.write(make_layout_text())
    return 0


def _make_recover_table(result: RecoverResult, out: Path) -> Table:
    lost = str(result.messages_lost)
    if not result.ended:
        lost += " known; those after the last restored one cannot be counted"
    return make_pair_table(
        "Recovered",
        [
            ("written to", out),
            ("messages", result.messages),
            ("messages lost", lost),
            ("bytes lost", result.lost_bytes),
            *(("damage", text) for text in result.damage),
        ],
    )
