"""What is replayed: a recording of ours from its file alone, as recorded or otherwise; another program's packets."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec

from logs.foreign import is_foreign, read_mcap
from logs.reader import good_messages, header, lacks_end, last_note, records
from logs.replay import MAKERS, ReplayResult
from logs.replay import replay as replay_recording
from logs.tlog import TlogPacket, read_tlog
from logs.topics import HOLES, RECOVERED, RecorderNote
from uavctl.cli.common import messages, warn
from uavctl.cli.provenance import cpu, versions
from uavctl.cli.recorded import changed_flyer, recorded_flyer
from uavctl.config.load import parse
from uavctl.data import Header, StepInput
from uavctl.errors import RecordingError, UsageError
from uavctl.loop import ControlLoop, make_links


class Changed(msgspec.Struct, frozen=True, kw_only=True):
    """A key of the configuration that is another one in the replay."""

    key: str
    recorded: str
    replayed: str


@dataclass(frozen=True)
class Replayed:
    """A replay and what has to be known of its recording.

    Attributes:
        result: What it found.
        lacks_end: Why the recording's end is not there, in words; nothing if it is.
        holes: From what it was recovered, and what was lost before its end, in words; nothing if that is all there.
        changed: What was asked to be different.
        other_versions: What decides the last bits, and is not here what the recording was made with.
    """

    result: ReplayResult
    lacks_end: str
    holes: str
    changed: tuple[Changed, ...]
    other_versions: tuple[str, ...]


def replay_flight(flight: Path, tolerance: float = 0.0, overrides: Sequence[str] = ()) -> Replayed:
    """Drive the recorded inputs through a new control loop of the recorded configuration.

    Args:
        flight: The recording, its first file if there are several.
        tolerance: See `logs.replay.replay`.
        overrides: `key=value`, as for a flight: what is to be another value than in the recording.

    Raises:
        RecordingError: It cannot be read, is only a later file of one, or carries not what it was flown with.
        ConfigError: An override does not fit, or leaves no design.
        UsageError: An override changes over which connections the bytes came.
    """
    check_first(flight)
    recorded = header(flight)
    cut, note = lacks_end(flight), last_note(flight)
    if cut and next(records(flight, StepInput), None) is None:  # so early that the policy library may be missing
        nothing = ReplayResult(decisions=0, compared=0, identical=True, first_difference=None)
        return Replayed(nothing, cut, "", (), tuple(other_versions(recorded)))
    name = f"{flight} (configuration)"
    config = parse(recorded.config_toml, name).config
    if overrides:
        loaded = parse(recorded.config_toml, name, overrides)
        if make_links(loaded.config).keys() != make_links(config).keys():
            raise UsageError(
                "daemon.vehicle and daemon.mocap say over which connections the recorded bytes came; leave them as "
                "they are"
            )
        controller = changed_flyer(flight, config, loaded).controller
        changed = tuple(_changes(msgspec.to_builtins(config), msgspec.to_builtins(loaded.config), ""))
        config = loaded.config
    else:
        controller, changed = recorded_flyer(flight, config).controller, ()
    holes = note.text if note is not None and note.text.startswith(RECOVERED) and HOLES in note.text else ""
    result = replay_recording(
        ((one.definition.topic, one.at_ns, one.data) for one in good_messages(flight)),
        lambda sink: ControlLoop(config, controller, sink, lambda: 0),
        tolerance,
        finished=not cut and not holes,
        # Before it had a name of its own, scheme `age-conditioned` flew under that of a design that decided nothing.
        ignored=MAKERS if overrides or (config.conditioned and "scheme" not in recorded.design) else frozenset(),
    )
    return Replayed(result, cut, holes, changed, tuple(other_versions(recorded)))


def foreign_packets(flight: Path, topics: Sequence[str]) -> tuple[TlogPacket, ...] | None:
    """What another program has recorded, and None if the recording is one of ours; says what was left out.

    Args:
        flight: The recording.
        topics: Of an MCAP: those to take; all that hold MAVLink if none is named.

    Raises:
        RecordingError: It cannot be read, or holds no MAVLink.
        UsageError: It has no such topic.
    """
    if flight.suffix == ".tlog":
        if topics:
            raise UsageError("--topic is for an MCAP: a .tlog has no topics")
        tlog = read_tlog(flight)
        packets, notes = tlog.packets, tlog.notes
    elif is_foreign(flight):
        found = read_mcap(flight, topics)
        messages().print(f"MAVLink in {', '.join(found.topics)}", markup=False, soft_wrap=True)
        torn = ("the recording is torn: replayed up to its end",) if found.torn else ()
        packets, notes = found.packets, (*found.notes, *torn)
    else:
        return None
    for note in notes:
        warn(note)
    return packets


def check_first(flight: Path) -> None:
    """A later file alone has neither the first ticks nor what they left behind."""
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
    """Keys of two configurations that differ."""
    if isinstance(before, dict) and isinstance(now, dict):
        for name in dict.fromkeys([*before, *now]):
            yield from _changes(before.get(name), now.get(name), f"{key}.{name}" if key else str(name))
    elif before != now:
        yield Changed(key=key, recorded=str(before), replayed=str(now))


def other_versions(recorded: Header) -> Iterator[str]:
    """What decides a flight's last bits and is not what the recording was made with: code, libraries, CPU type."""
    here = {**versions(), "cpu": cpu()}
    there = {**recorded.versions, "cpu": recorded.cpu}
    for name in sorted(here.keys() | there.keys()):
        if here.get(name) != there.get(name):
            yield f"recorded with {name} {there.get(name, 'unknown')}, here is {here.get(name, 'none')}"
