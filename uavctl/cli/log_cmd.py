"""`uavctl log`: what is in a recording, its repair, its replay, its page."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated

import msgspec
from cyclopts import App, Parameter
from rich.markup import escape
from rich.table import Table

from logs.flight_data import FlightData
from logs.info import RecordingInfo
from logs.info import info as recording_info
from logs.reader import header, read
from logs.recover import RecoverResult
from logs.recover import recover as restore
from logs.replay import ReplayResult, recorded_library
from logs.replay import replay as replay_recording
from logs.replay_tlog import ForeignReplay, replay_tlog
from logs.report import picture, write_report
from logs.summary import render, summarise
from logs.tlog import read_tlog
from uavctl.build import build_controller, build_design
from uavctl.cli.common import DEFAULTS, Common, located, messages
from uavctl.cli.flying import cpu, versions
from uavctl.cli.prepare import prepare
from uavctl.config import Config
from uavctl.config.load import parse
from uavctl.data import Header, Sink
from uavctl.errors import LibraryError, RecordingError, UsageError
from uavctl.flight.controller import Controller
from uavctl.library_bytes import check_fits, decode
from uavctl.loop import VEHICLE, ControlLoop

RECOVERED_WITH_LOSS = 3
log_app = App(name="log", help="Recordings: info, recover, replay, report.")
Flight = Annotated[Path, Parameter(help="the recording")]
Json = Annotated[bool, Parameter(negative=(), help="one JSON document on standard output, nothing else")]


@log_app.command
def info(flight: Flight, /, *, json: Json = False) -> int:
    """Say what a recording holds: topics, rates, gaps, losses, and how it was made."""
    found = recording_info(flight)
    Common(json=json).show(found, lambda: _info_table(found))
    return 0


@log_app.command
def recover(flight: Flight, out: Annotated[Path, Parameter(help="file to write")], /, *, json: Json = False) -> int:
    """Restore what a torn or damaged recording still holds. Exit code 3: with loss."""
    result = restore(flight, out)
    Common(json=json).show(result, lambda: _recover_table(result, out))
    return 0 if result.lossless else RECOVERED_WITH_LOSS


@log_app.command
def replay(
    flight: Flight,
    /,
    *,
    common: Common = DEFAULTS,
    tolerance: Annotated[
        float, Parameter(help="largest relative difference that counts as none; for another CPU type")
    ] = 0.0,
) -> int:
    """Drive the recorded inputs through the same control loop and compare all that it decides.

    A `.tlog` of somebody else's flight goes through parser, clock offset, estimator and controller of `--config`.
    """
    if flight.suffix == ".tlog":
        return _replay_foreign(flight, common)
    if common.overrides or common.config != DEFAULTS.config:
        raise UsageError(
            "--config and --set are for a .tlog: a recording of ours is replayed with its own configuration"
        )
    recorded = header(flight)
    others = _other_versions(recorded)
    for text in others:
        messages().print(f"{text}: decisions may differ", style="yellow", markup=False)
    config = parse(recorded.config_toml, f"{flight} (configuration)").config
    whole = recording_info(flight)
    make_loop = _loop_maker(config, _recorded_controller(flight, config))
    result = replay_recording(read(flight), make_loop, tolerance, finished=whole.finished)
    if whole.missing or whole.dropped:
        text = (
            f"{whole.missing + whole.dropped} records are missing in the recording: what came after cannot be compared"
        )
        messages().print(text, style="yellow", markup=False)
    if not whole.finished:
        messages().print("the recording is torn: compared up to its end", style="yellow", markup=False)
    document = {**msgspec.structs.asdict(result), "other_versions": others}
    common.show(document, lambda: _replay_table(result, others))
    return 0 if result.identical else 1


@log_app.command
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
    data = FlightData.from_records(read(flight))
    summary = summarise(data, wall_s=None, recording=str(flight), report=str(page))
    write_report(data, summary, page)
    if svg is not None:
        try:
            svg.write_text(picture(data), encoding="utf-8")
        except OSError as error:
            raise UsageError(f"{svg}: cannot be written ({error.strerror}); choose another place") from error
    Common(json=json).show(summary, lambda: render(summary))
    return 0


def _recorded_controller(flight: Path, config: Config) -> Controller:
    """The controller of a recording: with the policy library that it carries, whatever the cache holds.

    Raises:
        RecordingError: It carries none, or one that does not fit.
    """
    design = build_design(config)
    if config.solver.method != "library":
        return build_controller(config, design)
    try:
        library = decode(recorded_library(flight).data).library
        check_fits(library, design)
    except LibraryError as error:
        raise RecordingError(
            f"{flight}: {error.reason}; replay it with the version that recorded it (`uavctl log info` tells)"
        ) from error
    return build_controller(config, design, library)


def _loop_maker(config: Config, controller: Controller) -> Callable[[Sink], ControlLoop]:
    return lambda sink: ControlLoop(config, controller, sink, lambda: 0)


def _replay_foreign(flight: Path, common: Common) -> int:
    loaded = common.with_overrides(("daemon.mocap=tlog", "daemon.vehicle=tlog")).load()
    config = loaded.config
    with located(loaded):
        make_loop = _loop_maker(config, prepare(config, build_design(config)).controller)
    packets = ((packet.at_ns, packet.data) for packet in read_tlog(flight) if not packet.outgoing)
    tick_ns = round(config.daemon.tick_s * 1e9)
    result = replay_tlog(packets, make_loop, link=VEHICLE, tick_ns=tick_ns)
    if not result.positions:
        raise UsageError(f"{flight}: no external position in it (source.messages says which messages count)")
    common.show(result, lambda: _foreign_table(result, config.smpc.horizon))
    return 0


def _other_versions(recorded: Header) -> list[str]:
    """What decides a flight's last bits and is not what the recording was made with: code, libraries, CPU type."""
    here = {**versions(), "cpu": cpu()}
    there = {**recorded.versions, "cpu": recorded.cpu}
    return [
        f"recorded with {name} {there.get(name, 'unknown')}, here is {here.get(name, 'none')}"
        for name in sorted(here.keys() | there.keys())
        if here.get(name) != there.get(name)
    ]


def _two_columns(title: str, rows: list[tuple[str, object]]) -> Table:
    table = Table(title=title, show_header=False, title_justify="left")
    for name, value in rows:
        table.add_row(escape(name), escape(str(value)))
    return table


def _counts(counts: Mapping[str, int]) -> str:
    """Counts in words, as in "126 track, 20 hold"."""
    return ", ".join(f"{count} {name}" for name, count in counts.items()) or "none"


def _ages(ages: Mapping[str, int], horizon: int) -> str:
    """Ages at decisions, in a few classes."""
    classes: dict[str, int] = {}
    for age, count in ages.items():
        steps = int(age)
        name = age if steps < 2 else f"2 to {horizon - 1}" if steps < horizon else f"{horizon} and more"
        classes[name] = classes.get(name, 0) + count
    return ", ".join(f"{name}: {count}" for name, count in classes.items())


def _replay_table(result: ReplayResult, others: list[str]) -> Table:
    rows: list[tuple[str, object]] = [
        ("decisions", result.decisions),
        ("records compared", result.compared),
        ("identical, bit for bit", "yes" if result.identical else "no"),
    ]
    first = result.first_difference
    if first is not None:
        rows += [
            ("first difference", f"{first.topic} at {first.at_ns} ns, {first.field}"),
            ("recorded", first.recorded),
            ("replayed", first.replayed),
            *(("made otherwise", text) for text in others),
        ]
    return _two_columns("Replay", rows)


def _recover_table(result: RecoverResult, out: Path) -> Table:
    lost = str(result.messages_lost)
    if not result.finished:
        lost += " known; those after the last restored one cannot be counted"
    return _two_columns(
        "Recovered",
        [
            ("written to", out),
            ("messages", result.messages),
            ("messages lost", lost),
            ("bytes lost", result.lost_bytes),
            *(("damage", text) for text in result.damage),
        ],
    )


def _info_table(found: RecordingInfo) -> Table:
    title = f"{', '.join(found.files)}: {found.duration_s:.1f} s, {found.bytes:,} bytes"
    table = Table(title=escape(title), title_justify="left", caption_justify="left")
    for column in ("topic", "messages", "rate", "longest gap"):
        table.add_column(column, justify="left" if column == "topic" else "right")
    for topic in found.topics:
        several = topic.messages > 1
        rate, gap = (f"{topic.rate_hz:.1f}/s", f"{topic.longest_gap_s:.3f} s") if several else ("", "")
        table.add_row(topic.topic, str(topic.messages), rate, gap)
    state = "closed in order" if found.finished else "not closed: `uavctl log recover` makes a clean file"
    caption = [state, f"{found.dropped} dropped, {found.missing} missing", *found.damage]
    if found.origin is not None:
        caption.append(f"{found.origin.command} ({found.origin.started_utc}, seed {found.origin.seed})")
    if found.library is not None:
        caption.append(f"policy library {found.library.library_id}, {found.library.bytes:,} bytes")
    table.caption = escape("\n".join(caption))
    return table


def _foreign_table(result: ForeignReplay, horizon: int) -> Table:
    ages = result.age_ms
    rows: list[tuple[str, object]] = [
        ("datagrams", result.datagrams),
        ("positions", result.positions),
        ("out of order", result.out_of_order),
        ("accepted / refused", f"{result.accepted} / {result.rejected}"),
        ("ticks / decisions", f"{result.ticks} / {result.decisions}"),
        ("solves", _counts(result.solves)),
        ("ticks by mode", _counts(result.modes)),
        ("decisions by age in steps", _ages(result.age_steps, horizon)),
    ]
    if ages is not None:
        spread = f"{ages.min:.0f}, {ages.p05:.0f}, {ages.p50:.0f}, {ages.p95:.0f}, {ages.max:.0f}"
        rows.append(("capture to arrival, ms: min, 5 %, median, 95 %, max", spread))
    return _two_columns("Foreign recording through our controller", rows)
