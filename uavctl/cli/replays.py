"""Replays of recordings: of our own recording from its file alone, as recorded or changed, and of foreign packets."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec

from logs.recording.fleet_replay import FleetHeader
from logs.recording.foreign import read_foreign_packets
from logs.recording.notes import RecorderNote
from logs.recording.reader import explain_missing_end, read_header, read_kind, read_last_note, read_messages
from logs.recording.replay import LAST_BITS, MAKERS, TEXTS, ReplayResult
from logs.recording.replay import replay as replay_recording
from logs.recording.senders import choose_vehicle
from logs.recording.tlog import TlogPacket
from uavctl.arithmetic import ARITHMETIC, OWN, without_choice
from uavctl.cli import restart_process
from uavctl.cli.common import locate_design_errors
from uavctl.cli.output import warn
from uavctl.config import Config, LoadedConfig
from uavctl.config.load import parse_recorded
from uavctl.errors import DesignError, RecordingError, UsageError
from uavctl.loop import ControlLoop
from uavctl.mavlink.connection import make_links
from uavctl.records import TEXT_VERSION, Header, StepInput
from uavctl.wiring.controller import (
    ARITHMETIC_NAME,
    CONTROLLER,
    Prepared,
    build_flight_design,
    collect_versions,
    prepare,
    read_cpu_model,
)
from uavctl.wiring.outside import CONTROLLER_KEY

_LIBRARY_VERSION = "uavctl 0.2.0, commit b5d416b"  # replays flights of version 0.1 and its own with a policy library


def make_recorded_controller(flight: Path, config: Config) -> Prepared:
    """Make the controller that flew in a recording.

    Raises:
        RecordingError: The controller of another package flew, and it is not installed.
    """
    try:
        return prepare(config, build_flight_design(config))
    except DesignError as error:
        if error.key != CONTROLLER_KEY:
            raise
        flown_controller = read_header(flight).versions.get(CONTROLLER, config.smpc.controller)
        raise RecordingError(
            f"{flight}: was flown by a controller of another package, {flown_controller}, which is not installed: "
            f"{error.reason}; {error.hint}"
        ) from error


def make_changed_controller(loaded: LoadedConfig) -> Prepared:
    """Make the controller of a changed configuration.

    Raises:
        ConfigError: The configuration leaves no design.
    """
    with locate_design_errors(loaded):
        return prepare(loaded.config, build_flight_design(loaded.config))


class ChangedKey(msgspec.Struct, frozen=True, kw_only=True):
    """Key of the configuration whose value differs in the replay."""

    key: str
    recorded: str
    replayed: str


@dataclass(frozen=True)
class ReplayOutcome:
    """Outcome of a replay, with facts on its recording."""

    result: ReplayResult  # comparison of the records
    lacks_end: str  # reason why the end of the recording is missing; empty if it is complete
    holes: str  # note of its recovery, if records before its end are lost; else empty
    changed: tuple[ChangedKey, ...]  # changed keys of the configuration
    other_versions: tuple[str, ...]  # versions that decide the last bits and differ from the recording's
    tolerance: float  # largest relative difference that counts as none
    has_other_texts: bool = False  # texts of events and reasons are of another version, and are not compared


def replay_flight(flight: Path, tolerance: float = 0.0, overrides: Sequence[str] = ()) -> ReplayOutcome:
    """Drive the recorded inputs through a new control loop of the recorded configuration.

    Args:
        flight: The recording, its first file if there are several.
        tolerance: See `logs.recording.replay.replay`.
        overrides: `key=value`, as for a flight: keys that differ from the recording.

    Raises:
        RecordingError: It cannot be read, is a later file of a recording, or lacks the controller that flew.
        ConfigError: An override does not fit, or leaves no design.
        UsageError: An override changes the connections of the recorded bytes.
    """
    check_first_file(flight)
    recorded = read_header(flight)
    match_arithmetic(recorded)
    name = f"{flight} (configuration)"
    config = flown_config = parse_recorded(recorded.config_toml, name).config
    end_problem, note = explain_missing_end(flight), read_last_note(flight)
    if end_problem and next(read_kind(flight, StepInput), None) is None:
        empty_result = ReplayResult(decisions=0, compared=0, identical=True, first_difference=None)
        return ReplayOutcome(
            empty_result, end_problem, "", (), find_other_versions(recorded, flown_config.smpc.controller), tolerance
        )
    if overrides:
        loaded = parse_recorded(recorded.config_toml, name, overrides)
        if make_links(loaded.config).keys() != make_links(config).keys():
            raise UsageError(
                "daemon.vehicle and daemon.mocap name the connections of the recorded bytes; leave them as they are"
            )
        controller = make_changed_controller(loaded).controller
        changed = tuple(_find_changes(msgspec.to_builtins(config), msgspec.to_builtins(loaded.config), ""))
        config = loaded.config
    elif recorded.library_id is not None:
        raise RecordingError(
            f"{flight}: was flown with a policy library, which this version does not have; replay it with "
            f"{_LIBRARY_VERSION}, or decide again with --set solver.method=exact"
        )
    else:
        controller, changed = make_recorded_controller(flight, config).controller, ()
    hole_text = note.text if note is not None and note.lacks_records else ""
    # Older recordings of scheme `age-conditioned` name a design that decided nothing.
    ignored = MAKERS if overrides or (config.is_age_conditioned and "scheme" not in recorded.design) else frozenset()
    if tolerance:
        ignored |= LAST_BITS
    has_other_texts = recorded.text_version != TEXT_VERSION
    if has_other_texts:
        ignored |= TEXTS
    result = replay_recording(
        ((message.definition.topic, message.at_ns, message.data) for message in read_messages(flight)),
        lambda sink: ControlLoop(config, controller, sink, lambda: 0),
        tolerance,
        finished=not end_problem and not hole_text,
        ignored=ignored,
        moved_inputs=recorded.moved_inputs,
    )
    return ReplayOutcome(
        result,
        end_problem,
        hole_text,
        changed,
        find_other_versions(recorded, flown_config.smpc.controller),
        tolerance,
        has_other_texts,
    )


def read_foreign_vehicle(
    flight: Path, topics: Sequence[str], system: int | None = None
) -> tuple[TlogPacket, ...] | None:
    """Return the packets of another program's recording, None if it is our own; print a warning on omitted packets.

    Args:
        topics: Topics of an MCAP to read; all with MAVLink if none is named.
        system: The vehicle's system id; packets of other vehicles are left out.

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
    return log.packets if system is None else tuple(packet for packet in log if not vehicle.of_others(packet))


def check_first_file(flight: Path) -> None:
    """Refuse a later file of a recording: it lacks the first ticks and their final state."""
    note = next(read_kind(flight, RecorderNote), None)
    if note is None or note.segment == 1:
        return
    if not flight.exists():
        raise RecordingError(f"{flight}: is missing, and a recording can be replayed from its beginning only")
    first = flight.with_name(f"{flight.stem.removesuffix(f'-{note.segment}')}{flight.suffix}")
    raise RecordingError(
        f"{flight}: is file {note.segment} of a recording, which can be replayed from its beginning only; "
        f"give the first one, {first}, with the others beside it"
    )


def _find_changes(recorded: object, replayed: object, key: str) -> Iterator[ChangedKey]:
    """Return the keys in which two configurations differ."""
    if isinstance(recorded, dict) and isinstance(replayed, dict):
        for name in dict.fromkeys([*recorded, *replayed]):
            yield from _find_changes(recorded.get(name), replayed.get(name), f"{key}.{name}" if key else str(name))
    elif recorded != replayed:
        yield ChangedKey(key=key, recorded=str(recorded), replayed=str(replayed))


def match_arithmetic(recorded: Header | FleetHeader) -> None:
    """Restart the process if a recording was made with all instructions of this processor.

    This is the case if numpy was loaded before `uavctl`, or if the user chose it.
    """
    if recorded.versions.get(ARITHMETIC_NAME) == OWN and ARITHMETIC != OWN and recorded.cpu == read_cpu_model():
        restart_process(without_choice(os.environ))


def find_other_versions(recorded: Header | FleetHeader, controller: str) -> tuple[str, ...]:
    """Return the versions of code, libraries and arithmetic that differ from the recording's; the last bits need them.

    Args:
        controller: Controller of another package that flew; empty if none did.
    """
    try:
        versions = collect_versions(controller)
    except DesignError:  # the controller of another package is not installed
        versions = collect_versions("")
    installed, recorded_versions = {**versions, "cpu": read_cpu_model()}, {**recorded.versions, "cpu": recorded.cpu}
    if installed[ARITHMETIC_NAME] != OWN and installed[ARITHMETIC_NAME] == recorded_versions.get(ARITHMETIC_NAME):
        recorded_versions["cpu"] = installed["cpu"]  # portable arithmetic does not depend on the processor
    return tuple(
        f"recorded with {name} {recorded_versions.get(name, 'unknown')}, here is {installed.get(name, 'none')}"
        for name in sorted(installed.keys() | recorded_versions.keys())
        if installed.get(name) != recorded_versions.get(name)
    )
