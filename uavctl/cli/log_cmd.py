"""`uavctl log`: what is in a recording, its repair, its replay, its page."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from importlib import resources
from pathlib import Path
from typing import Annotated

import msgspec
from cyclopts import App, Parameter
from rich.markup import escape
from rich.table import Table

from logs.flight_data import FlightData
from logs.info import info as recording_info
from logs.outputs import spare_recording, write_whole
from logs.reader import finished, read
from logs.recover import RecoverResult
from logs.recover import recover as restore
from logs.replay_tlog import ForeignReplay, replay_tlog
from logs.report import picture, write_report
from logs.report_verdicts import verdict_rows
from logs.summary import count, render, summarise
from logs.tlog import TlogPacket
from logs.verdicts import judge
from uavctl.build import build_design
from uavctl.cli.common import DEFAULTS, Common, located, warn
from uavctl.cli.export_cmd import export
from uavctl.cli.info_table import info_table
from uavctl.cli.log_compare_cmd import compare_command
from uavctl.cli.prepare import prepare
from uavctl.cli.replay_table import replay_table
from uavctl.cli.replaying import foreign_packets, replay_flight
from uavctl.cli.whatif_cmd import whatif
from uavctl.config import Config
from uavctl.data import Sink
from uavctl.errors import UsageError
from uavctl.flight.controller import Controller
from uavctl.loop import VEHICLE, ControlLoop

RECOVERED_WITH_LOSS = 3
log_app = App(name="log", help="Recordings: info, recover, replay, report, compare, whatif, export; a layout.")
log_app.command(export)
log_app.command(compare_command, name="compare")
log_app.command(whatif)
Flight = Annotated[Path, Parameter(help="the recording")]
Json = Annotated[bool, Parameter(negative=(), help="one JSON document on standard output, nothing else")]


@log_app.command
def info(flight: Flight, /, *, json: Json = False) -> int:
    """Say what a recording holds: topics, rates, gaps, losses, and how it was made."""
    found = recording_info(flight)
    Common(json=json).show(found, lambda: info_table(found))
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
    topic: Annotated[
        tuple[str, ...],
        Parameter(negative=(), help="with the MCAP of another program: take this topic alone; may be repeated"),
    ] = (),
) -> int:
    """Drive the recorded inputs through the same control loop and compare all that it decides.

    Somebody else's flight (a `.tlog`, or an MCAP with raw MAVLink in it) goes through parser, clock offset, estimator
    and controller of `--config`. With `--set KEY=VALUE` a recording of ours is replayed with that key changed: what
    the changed controller would have decided of the same inputs, from the first decision that differs on.
    """
    if not 0.0 <= tolerance < 1.0:
        raise UsageError(f"--tolerance {tolerance:g}: it is a share of a number; give 0 or more, and less than 1")
    packets = foreign_packets(flight, topic)
    if packets is not None:
        return _replay_foreign(flight, packets, common)
    if common.config != DEFAULTS.config or topic:
        raise UsageError(
            "--config and --topic are for another program's recording: one of ours is replayed with its own "
            "configuration, of which --set changes a key"
        )
    replayed = replay_flight(flight, tolerance, common.overrides)
    result = replayed.result
    for text in replayed.other_versions:
        warn(f"{text}: decisions may differ")
    if result.dropped:
        text = f"{count(result.dropped, 'record')} missing in the recording: what came after cannot be compared"
        warn(text)
    if not replayed.finished:
        warn("the recording is torn: compared up to its end")
    document = {
        **msgspec.structs.asdict(result),
        "changed": replayed.changed,
        "other_versions": replayed.other_versions,
    }
    common.show(document, lambda: replay_table(replayed))
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
    for target in (page, *(() if svg is None else (svg,))):
        spare_recording(target)
    data = FlightData.from_records(read(flight), flight)
    dropped = max((note.dropped for note in data.notes), default=0)
    summary = summarise(data, wall_s=None, recording=str(flight), report=str(page), recorder_dropped=dropped)
    judged = judge(data)
    if svg is not None:
        write_whole(svg, picture(data))
    write_report(data, summary, page, judged)
    if not finished(flight):
        warn("the recording is torn: shown up to its end")
    document = {**msgspec.structs.asdict(summary), "verdicts": judged.verdicts}
    Common(json=json).show(document, lambda: render(summary, verdict_rows(judged.verdicts)))
    return 0


@log_app.command
def layout() -> int:
    """Print the layout for Foxglove: `uavctl log layout > uavctl.json`, there "Import from file"."""
    sys.stdout.write(resources.files("logs").joinpath("foxglove-layout.json").read_text(encoding="utf-8"))
    return 0


def _loop_maker(config: Config, controller: Controller) -> Callable[[Sink], ControlLoop]:
    return lambda sink: ControlLoop(config, controller, sink, lambda: 0)


def _replay_foreign(flight: Path, recorded: tuple[TlogPacket, ...], common: Common) -> int:
    loaded = common.with_overrides(("daemon.mocap=tlog", "daemon.vehicle=tlog")).load()
    config = loaded.config
    with located(loaded):
        make_loop = _loop_maker(config, prepare(config, build_design(config)).controller)
    packets = ((packet.at_ns, packet.data) for packet in recorded if not packet.outgoing)
    tick_ns = round(config.daemon.tick_s * 1e9)
    result = replay_tlog(packets, make_loop, link=VEHICLE, tick_ns=tick_ns)
    if not result.positions:
        raise UsageError(f"{flight}: no external position in it (source.messages says which messages count)")
    common.show(result, lambda: _foreign_table(result, config.smpc.horizon))
    return 0


def _two_columns(title: str, rows: list[tuple[str, object]]) -> Table:
    table = Table(title=title, show_header=False, title_justify="left")
    for name, value in rows:
        table.add_row(escape(name), escape(str(value)))
    return table


def _counts(counts: Mapping[str, int]) -> str:
    """Counts in words, as in "126 track, 20 hold"."""
    return ", ".join(f"{number} {name}" for name, number in counts.items()) or "none"


def _ages(ages: Mapping[str, int], horizon: int) -> str:
    """Ages at decisions, in a few classes."""
    classes: dict[str, int] = {}
    for age, decisions in ages.items():
        steps = int(age)
        name = age if steps < 2 else f"2 to {horizon - 1}" if steps < horizon else f"{horizon} and more"
        classes[name] = classes.get(name, 0) + decisions
    return ", ".join(f"{name}: {decisions}" for name, decisions in classes.items())


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
        *([("not taken by the connection", _counts(result.left_out))] if result.left_out else []),
        ("decisions by age in steps", _ages(result.age_steps, horizon)),
    ]
    if ages is not None:
        spread = f"{ages.min:.0f}, {ages.p05:.0f}, {ages.p50:.0f}, {ages.p95:.0f}, {ages.max:.0f}"
        rows.append(("capture to arrival, ms: min, 5 %, median, 95 %, max", spread))
    return _two_columns("Foreign recording through our controller", rows)
