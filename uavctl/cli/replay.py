"""Command `uavctl log replay`."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import msgspec
from cyclopts import Parameter
from rich.console import Group, RenderableType
from rich.table import Table

from logs.recording.foreign import read_foreign_packets
from logs.recording.reader import good_messages, header, lacks_end, last_note, records
from logs.recording.replay import LAST_BITS, MAKERS, Chosen, Context, FieldDivergence, ReplayDifference, ReplayResult
from logs.recording.replay import replay as replay_recording
from logs.recording.senders import choose_vehicle
from logs.recording.summary import count
from logs.recording.tlog import ForeignReplay, TlogPacket, replay_tlog
from logs.recording.topics import HOLES, RECOVERED, RecorderNote
from uavctl.arithmetic import ARITHMETIC, OWN, without_choice
from uavctl.build.controller import ARITHMETIC_NAME, CONTROLLER, Prepared, cpu, design_of, prepare, versions
from uavctl.build.outside import KEY
from uavctl.cli import restart_process
from uavctl.cli.common import (
    DEFAULTS,
    Common,
    Flight,
    System,
    format_counts,
    locate_design_errors,
    make_pair_table,
    make_table,
    warn,
)
from uavctl.config import Config, LoadedConfig
from uavctl.config.load import parse_recorded
from uavctl.errors import DesignError, RecordingError, UsageError
from uavctl.loop import VEHICLE, ControlLoop, make_links
from uavctl.records import Header, StepInput

# The controller of a recording.

_WITH_LIBRARY = "uavctl 0.2.0, commit b5d416b"  # replays what it and version 0.1 have flown with a policy library


def recorded_flyer(flight: Path, config: Config) -> Prepared:
    """Return the controller that flew in a recording.

    Raises:
        RecordingError: The controller of another package that flew is not here.
    """
    try:
        return prepare(config, design_of(config))
    except DesignError as error:
        if error.key != KEY:
            raise
        flown = header(flight).versions.get(CONTROLLER, config.smpc.controller)
        raise RecordingError(
            f"{flight}: was flown by a controller of another package, {flown}, which is not here: "
            f"{error.reason}; {error.hint}"
        ) from error


def changed_flyer(loaded: LoadedConfig) -> Prepared:
    """Return a controller of a changed configuration.

    Raises:
        ConfigError: The configuration leaves no design.
    """
    with locate_design_errors(loaded):
        return prepare(loaded.config, design_of(loaded.config))


# What is replayed: a recording of ours from its file alone, as recorded or otherwise; another program's packets.


class Changed(msgspec.Struct, frozen=True, kw_only=True):
    """Key of the configuration whose value differs in the replay."""

    key: str
    recorded: str
    replayed: str


@dataclass(frozen=True)
class Replayed:
    """Result of a replay, with facts on its recording."""

    result: ReplayResult  # what it found
    lacks_end: str  # why the recording's end is not there, in words; nothing if it is
    holes: str  # from what it was recovered, and what was lost before its end, in words; nothing if that is all there
    changed: tuple[Changed, ...]  # what was asked to be different
    other_versions: tuple[str, ...]  # what decides the last bits, and is not here what the recording was made with
    tolerance: float  # largest relative difference that counts as none


def replay_flight(flight: Path, tolerance: float = 0.0, overrides: Sequence[str] = ()) -> Replayed:
    """Drive the recorded inputs through a new control loop of the recorded configuration.

    Args:
        flight: The recording, its first file if there are several.
        tolerance: See `logs.recording.replay.replay`.
        overrides: `key=value`, as for a flight: what is to be another value than in the recording.

    Raises:
        RecordingError: It cannot be read, is only a later file of one, or carries not what it was flown with.
        ConfigError: An override does not fit, or leaves no design.
        UsageError: An override changes over which connections the bytes came.
    """
    check_first(flight)
    recorded = header(flight)
    compute_as(recorded)
    name = f"{flight} (configuration)"
    config = flown = parse_recorded(recorded.config_toml, name).config
    cut, note = lacks_end(flight), last_note(flight)
    if cut and next(records(flight, StepInput), None) is None:
        nothing = ReplayResult(decisions=0, compared=0, identical=True, first_difference=None)
        return Replayed(nothing, cut, "", (), tuple(other_versions(recorded, flown.smpc.controller)), tolerance)
    if overrides:
        loaded = parse_recorded(recorded.config_toml, name, overrides)
        if make_links(loaded.config).keys() != make_links(config).keys():
            raise UsageError(
                "daemon.vehicle and daemon.mocap say over which connections the recorded bytes came; leave them as "
                "they are"
            )
        controller = changed_flyer(loaded).controller
        changed = tuple(_changes(msgspec.to_builtins(config), msgspec.to_builtins(loaded.config), ""))
        config = loaded.config
    elif recorded.library_id is not None:
        raise RecordingError(
            f"{flight}: was flown with a policy library, which this version does not have; replay it with "
            f"{_WITH_LIBRARY}, or decide it anew with --set solver.method=exact"
        )
    else:
        controller, changed = recorded_flyer(flight, config).controller, ()
    holes = note.text if note is not None and note.text.startswith(RECOVERED) and HOLES in note.text else ""
    # Before it had a name of its own, scheme `age-conditioned` flew under that of a design that decided nothing.
    ignored = MAKERS if overrides or (config.is_age_conditioned and "scheme" not in recorded.design) else frozenset()
    if tolerance:
        ignored |= LAST_BITS
    result = replay_recording(
        ((one.definition.topic, one.at_ns, one.data) for one in good_messages(flight)),
        lambda sink: ControlLoop(config, controller, sink, lambda: 0),
        tolerance,
        finished=not cut and not holes,
        ignored=ignored,
    )
    return Replayed(result, cut, holes, changed, tuple(other_versions(recorded, flown.smpc.controller)), tolerance)


def foreign_packets(flight: Path, topics: Sequence[str], system: int | None = None) -> tuple[TlogPacket, ...] | None:
    """Return the packets of another program's recording, None if it is one of ours; say what was left out.

    Args:
        topics: Topics of an MCAP to take; all that hold MAVLink if none is named.
        system: The vehicle's system id; what other vehicles sent is left out then.

    Raises:
        RecordingError: It cannot be read, or holds no MAVLink.
        UsageError: It has no such topic, or nothing of that system.
    """
    log = read_foreign_packets(flight, topics)
    if log is None:
        return None
    vehicle = choose_vehicle(log.packets, str(flight), system)
    for note in (*vehicle.notes, *log.notes):
        warn(note)
    return log.packets if system is None else tuple(one for one in log if not vehicle.of_others(one))


def check_first(flight: Path) -> None:
    """Refuse a later file of a recording: it lacks the first ticks, and the state that they left."""
    note = next(records(flight, RecorderNote), None)
    if note is None or note.segment == 1:
        return
    if not flight.exists():
        raise RecordingError(f"{flight}: is missing, and a recording can be replayed from its beginning only")
    first = flight.with_name(f"{flight.stem.removesuffix(f'-{note.segment}')}{flight.suffix}")
    raise RecordingError(
        f"{flight}: is file {note.segment} of a recording, which can be replayed from its beginning only; "
        f"give the first one, {first}, with the others beside it"
    )


def _changes(before: object, now: object, key: str) -> Iterator[Changed]:
    """Return the keys in which two configurations differ."""
    if isinstance(before, dict) and isinstance(now, dict):
        for name in dict.fromkeys([*before, *now]):
            yield from _changes(before.get(name), now.get(name), f"{key}.{name}" if key else str(name))
    elif before != now:
        yield Changed(key=key, recorded=str(before), replayed=str(now))


def compute_as(recorded: Header) -> None:
    """Start the command anew if a recording was made with all of this processor's own instructions.

    So it was where numpy was loaded before `uavctl`, or where somebody chose it.
    """
    if recorded.versions.get(ARITHMETIC_NAME) == OWN and ARITHMETIC != OWN and recorded.cpu == cpu():
        restart_process(without_choice(os.environ))


def other_versions(recorded: Header, controller: str) -> Iterator[str]:
    """Return which code, libraries and arithmetic, on which the last bits depend, differ from the recording's.

    Args:
        controller: The one of another package that flew, if one did.
    """
    try:
        found = versions(controller)
    except DesignError:  # the controller of another package is not here
        found = versions("")
    here, there = {**found, "cpu": cpu()}, {**recorded.versions, "cpu": recorded.cpu}
    if here[ARITHMETIC_NAME] != OWN and here[ARITHMETIC_NAME] == there.get(ARITHMETIC_NAME):
        there["cpu"] = here["cpu"]  # any computes alike
    for name in sorted(here.keys() | there.keys()):
        if here.get(name) != there.get(name):
            yield f"recorded with {name} {there.get(name, 'unknown')}, here is {here.get(name, 'none')}"


# A replay as a person reads it: where it parts from the recording, why that may be, and what becomes of it.


MOST_FIELDS = 12
_LONGEST = 60


def replay_table(replayed: Replayed) -> RenderableType:
    """Return the whole result for a terminal."""
    result = replayed.result
    same = "yes" if result.identical else "no"
    rows: list[tuple[str, object]] = [
        *(("changed", f"{one.key}: {_cut(one.recorded)} -> {_cut(one.replayed)}") for one in replayed.changed),
        ("decisions", result.decisions),
        ("records compared", result.compared),
        (f"the same to {replayed.tolerance:g}" if replayed.tolerance else "identical, bit for bit", same),
    ]
    first = result.first_difference
    if first is None:
        return make_pair_table("Replay", rows)
    rows += _difference("first difference", first)
    if first.stage:
        rows.append(("in question", first.stage))
    rows += [("made otherwise", text) for text in replayed.other_versions]
    if result.context is not None:
        rows += _context(result.context)
    decision = result.first_decision
    if decision is None:
        rows.append(("decisions that differ", "none"))
    else:
        since = result.decisions - (0 if result.context is None else result.context.decisions_before)
        rows.append(("decisions that differ", f"{result.decisions_differing} of {since} from then on"))
        if decision != first:
            rows += _difference("the first of them", decision)
    return Group(make_pair_table("Replay", rows), _course(result.course))


def _difference(title: str, one: ReplayDifference) -> Iterator[tuple[str, object]]:
    when = "before the first tick" if one.tick is None else f"{one.flight_s:.3f} s into the flight, tick {one.tick}"
    yield title, f"{when} (log time {one.at_ns} ns)"
    others = f", and {one.fields - 1} more fields of the record" if one.fields > 1 else ""
    named = f" ({one.meaning})" if one.meaning else ""
    yield "", f"{one.topic} {one.field}{named}".rstrip() + others
    unit = f" {one.unit}" if one.unit else ""
    change = "" if one.change is None else f", that is {one.change:+.3g}{unit}"
    yield "", f"recorded {_cut(one.recorded)}{unit}, replayed {_cut(one.replayed)}{unit}{change}"


def _context(context: Context) -> Iterator[tuple[str, object]]:
    yield "before it", f"{context.decisions_before} decisions, {context.records_before} records: all identical"
    newest = ""
    if context.position_m is not None and context.position_age_s is not None:
        place = ", ".join(f"{value:z.3f}" for value in context.position_m)
        newest = f", the newest {context.position_age_s:.3f} s old at ({place}) m"
    parts = [
        f"{context.positions} position{'' if context.positions == 1 else 's'}{newest}",
        f"vehicle {context.vehicle}" if context.vehicle else "no vehicle heard",
        *([f"orders {', '.join(context.orders)}"] if context.orders else []),
        *([f"{context.missed_ticks} ticks missed before it"] if context.missed_ticks else []),
        *(["the hand-over is asked for"] if context.stop else []),
    ]
    yield "that tick was given", "; ".join(parts)
    if context.recorded is not None and context.recorded == context.replayed:
        yield "and decided, both", _chosen(context.recorded)
        return
    yield "and decided, recorded", _chosen(context.recorded)
    yield "and decided, replayed", _chosen(context.replayed)


def _chosen(one: Chosen | None) -> str:
    if one is None:
        return "nothing"
    age = "no age yet" if one.age_steps is None else f"age {one.age_steps} steps"
    plan = "no plan" if one.plan_seq is None else f"plan {one.plan_seq}, index {one.plan_index}"
    solve = "no solve" if one.solve is None else f"solve {one.solve}"
    return f"{one.mode} ({one.reason}); {age}; {plan}; {solve}"


def _course(course: tuple[FieldDivergence, ...]) -> Table:
    """Return a table of how the difference goes on, on the recorded inputs."""
    title = "What becomes of it, on the recorded inputs"
    if len(course) > MOST_FIELDS:
        title += f" ({MOST_FIELDS} of {len(course)} fields, all with --json)"
    table = make_table(title, ("field", "from [s]", "records that differ", "largest", "at [s]"), ())
    for one in course[:MOST_FIELDS]:
        unit = f" {one.unit}" if one.unit else ""
        entry = f" ({one.entry})" if one.entry else ""
        table.add_row(
            f"{one.topic} {one.field or '(a record on one side only)'}",
            f"{one.first_s:.3f}",
            f"{one.differing} of {one.records}",
            "-" if one.largest is None else f"{one.largest:.3g}{unit}{entry}",
            "-" if one.largest_s is None else f"{one.largest_s:.3f}",
        )
    return table


def _cut(text: str) -> str:
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 3]}..."


# `uavctl log replay`: the recorded inputs through the same control loop.


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
    packets = foreign_packets(flight, topic, system)
    if packets is not None:
        return _replay_foreign(flight, packets, common)
    if common.config != DEFAULTS.config or topic or system is not None:
        raise UsageError(
            "--config, --topic and --system are for another program's recording: one of ours is replayed with its own "
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
    common.show("log/replay", document, lambda: replay_table(replayed))
    return 0 if result.identical else 1


def _replay_foreign(flight: Path, recorded: tuple[TlogPacket, ...], common: Common) -> int:
    loaded = common.with_overrides(("daemon.mocap=tlog", "daemon.vehicle=tlog")).load()
    config = loaded.config
    with locate_design_errors(loaded):
        prepared = prepare(config, design_of(config))
    # Somebody else's setpoints flew it, so what it did is none of ours and would be found to be impossible.
    controller = replace(prepared.controller, envelope=None)
    packets = ((packet.at_ns, packet.data) for packet in recorded if not packet.outgoing)
    tick_ns = round(config.daemon.tick_s * 1e9)
    result = replay_tlog(
        packets, lambda sink: ControlLoop(config, controller, sink, lambda: 0), link=VEHICLE, tick_ns=tick_ns
    )
    if not result.positions:
        raise UsageError(f"{flight}: no external position in it (source.messages says which messages count)")
    common.show("log/replay-foreign", result, lambda: _foreign_table(result, config.smpc.horizon))
    return 0


def _ages(ages: Mapping[str, int], horizon: int) -> str:
    """Return the ages at decisions, in a few classes."""
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
        ("solves", format_counts(result.solves)),
        ("ticks by mode", format_counts(result.modes)),
        *([("not taken by the connection", format_counts(result.left_out))] if result.left_out else []),
        ("decisions by age in steps", _ages(result.age_steps, horizon)),
    ]
    if ages is not None:
        spread = f"{ages.min:.0f}, {ages.p05:.0f}, {ages.p50:.0f}, {ages.p95:.0f}, {ages.max:.0f}"
        rows.append(("capture to arrival, ms: min, 5 %, median, 95 %, max", spread))
    return make_pair_table("Foreign recording through our controller", rows)
