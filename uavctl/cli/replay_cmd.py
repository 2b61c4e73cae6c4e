"""`uavctl log replay`: the recorded inputs through the same control loop."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import msgspec
from cyclopts import Parameter
from rich.table import Table

from logs.replay_tlog import ForeignReplay, replay_tlog
from logs.summary import count
from logs.tlog import TlogPacket
from uavctl.build import design_of
from uavctl.cli.common import DEFAULTS, Common, Flight, located, two_columns, warn
from uavctl.cli.prepare import prepare
from uavctl.cli.replay_table import replay_table
from uavctl.cli.replaying import foreign_packets, replay_flight
from uavctl.config import Config
from uavctl.data import Sink
from uavctl.errors import UsageError
from uavctl.flight.controller import Controller
from uavctl.loop import VEHICLE, ControlLoop


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
    """Drive the recorded inputs through the same control loop and compare all that it decides."""
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
    if replayed.holes:
        warn(f"{replayed.holes}: where messages are missing, what came after cannot be compared")
    if replayed.lacks_end:
        compared = "compared up to there" if result.decisions else "before its first decision, so nothing was compared"
        warn(f"{replayed.lacks_end}: {compared}")
    document = {
        **msgspec.structs.asdict(result),
        "changed": replayed.changed,
        "other_versions": replayed.other_versions,
    }
    common.show(document, lambda: replay_table(replayed))
    return 0 if result.identical else 1


def _loop_maker(config: Config, controller: Controller) -> Callable[[Sink], ControlLoop]:
    return lambda sink: ControlLoop(config, controller, sink, lambda: 0)


def _replay_foreign(flight: Path, recorded: tuple[TlogPacket, ...], common: Common) -> int:
    loaded = common.with_overrides(("daemon.mocap=tlog", "daemon.vehicle=tlog")).load()
    config = loaded.config
    with located(loaded):
        controller = prepare(config, design_of(config)).controller
        # Somebody else's setpoints flew it, so what it did is none of ours and would be found to be impossible.
        make_loop = _loop_maker(config, replace(controller, envelope=None))
    packets = ((packet.at_ns, packet.data) for packet in recorded if not packet.outgoing)
    tick_ns = round(config.daemon.tick_s * 1e9)
    result = replay_tlog(packets, make_loop, link=VEHICLE, tick_ns=tick_ns)
    if not result.positions:
        raise UsageError(f"{flight}: no external position in it (source.messages says which messages count)")
    common.show(result, lambda: _foreign_table(result, config.smpc.horizon))
    return 0


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
    return two_columns("Foreign recording through our controller", rows)
