"""Command `uavctl log replay`: the recorded inputs drive the same control loop, and all its records are compared."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import msgspec
from cyclopts import Parameter

from logs.recording.fleet_replay import REPLAYS, find_fleet_kind, read_fleet_header
from logs.recording.summary import count
from logs.recording.tlog import TlogPacket, replay_tlog
from uavctl.cli.common import DEFAULTS, Common, Flight, System, locate_design_errors
from uavctl.cli.output import warn
from uavctl.cli.replay_table import make_fleet_table, make_foreign_table, make_replay_table
from uavctl.cli.replays import ReplayOutcome, find_other_versions, match_arithmetic, read_foreign_vehicle, replay_flight
from uavctl.errors import UsageError
from uavctl.loop import ControlLoop
from uavctl.mavlink.connection import VEHICLE
from uavctl.wiring.controller import build_flight_design, prepare


def replay(
    flight: Flight,
    /,
    *,
    common: Common = DEFAULTS,
    tolerance: Annotated[
        float, Parameter(help="largest relative difference that counts as none; for another arithmetic")
    ] = 0.0,
    topic: Annotated[
        tuple[str, ...],
        Parameter(negative=(), help="with the MCAP of another program: take this topic alone; may be repeated"),
    ] = (),
    system: System = None,
) -> int:
    """Drive the recorded inputs through the same control loop and compare all that it decides."""
    if not 0.0 <= tolerance < 1.0:
        raise UsageError(f"--tolerance {tolerance:g}: it is a share of a number; give 0 or more, and less than 1")
    if kind := find_fleet_kind(flight):
        if unfit := [*(f"--set {override}" for override in common.overrides), *(f"--topic {name}" for name in topic)]:
            raise UsageError(f"{flight}: a {kind} has no configuration or topics to choose; leave out {unfit[0]}")
        if system is not None:
            raise UsageError(f"{flight}: is the recording of a {kind}, not of a vehicle; leave out --system {system}")
        return _replay_fleet(flight, kind, common)
    packets = read_foreign_vehicle(flight, topic, system)
    if packets is not None:
        return _replay_foreign(flight, packets, common)
    if common.config != DEFAULTS.config or topic or system is not None:
        raise UsageError(
            "--config, --topic and --system are for another program's recording. A recording of uavctl is replayed "
            "with its own configuration; --set changes a key"
        )
    replayed = replay_flight(flight, tolerance, common.overrides)
    for text in _list_warnings(replayed):
        warn(text)
    result = replayed.result
    document = {
        **msgspec.structs.asdict(result),
        "changed": replayed.changed,
        "other_versions": replayed.other_versions,
        "texts_compared": not replayed.has_other_texts,
    }
    common.show("log/replay", document, lambda: make_replay_table(replayed))
    return 0 if result.identical else 1


def _replay_fleet(flight: Path, kind: str, common: Common) -> int:
    """Replay the recording of a fleet's sender or coordinator."""
    header = read_fleet_header(flight)
    match_arithmetic(header)
    result, other_versions = REPLAYS[kind](flight), find_other_versions(header, "")
    for text in other_versions:
        warn(f"{text}: decisions may differ")
    if result.lacks_end:
        warn(f"{result.lacks_end}: compared up to there")
    document = {**msgspec.structs.asdict(result), "other_versions": other_versions}
    common.show("log/replay-fleet", document, lambda: make_fleet_table(result))
    return 0 if result.identical else 1


def _list_warnings(replayed: ReplayOutcome) -> Iterator[str]:
    """Return the limits of the comparison."""
    result = replayed.result
    yield from (f"{text}: decisions may differ" for text in replayed.other_versions)
    if replayed.has_other_texts:
        yield "texts of events and reasons are of another version, and are not compared"
    if result.dropped:
        yield f"{count(result.dropped, 'record')} missing in the recording: later ones cannot be compared"
    if replayed.holes:
        yield f"{replayed.holes}: after missing messages nothing can be compared"
    if replayed.lacks_end:
        compared = "compared up to there" if result.decisions else "before its first decision, so nothing was compared"
        yield f"{replayed.lacks_end}: {compared}"


def _replay_foreign(flight: Path, recorded: tuple[TlogPacket, ...], common: Common) -> int:
    loaded = common.with_overrides(("daemon.mocap=tlog", "daemon.vehicle=tlog")).load()
    config = loaded.config
    with locate_design_errors(loaded):
        prepared = prepare(config, build_flight_design(config))
    # The setpoints of another program flew it, so our envelope would reject its motion.
    controller = replace(prepared.controller, envelope=None)
    packets = ((packet.at_ns, packet.data) for packet in recorded if not packet.outgoing)
    tick_ns = round(config.daemon.tick_s * 1e9)
    result = replay_tlog(
        packets, lambda sink: ControlLoop(config, controller, sink, lambda: 0), link=VEHICLE, tick_ns=tick_ns
    )
    if not result.positions:
        raise UsageError(
            f"{flight}: no external position in the recording (source.messages lists the accepted messages)"
        )
    common.show("log/replay-foreign", result, lambda: make_foreign_table(result, config.smpc.horizon))
    return 0
