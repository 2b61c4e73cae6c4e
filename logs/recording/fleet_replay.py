"""Replays of a sender and of a coordinator: the recorded inputs give each choice, and each cell, again.

Every record that comes out must be the recorded one, bit for bit. The first difference is reported.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from logs.recording.coordinator import list_cycle_records
from logs.recording.file_scan import RecordedMessage
from logs.recording.reader import explain_missing_end, read, read_last_note, scan_recording
from logs.recording.replay import find_different_leaves
from logs.recording.sender_choices import RepeatedSender
from logs.recording.topics import COORDINATOR_HEADER, CYCLE, ISSUED, SENDER_HEADER, SENT, are_identical
from uavctl.arrays import SECOND_NS
from uavctl.errors import RecordingError
from uavctl.fleet.coordinator import CellParameters
from uavctl.fleet_records import (
    CoordinatorCycle,
    CoordinatorHeader,
    IssuedCell,
    ScheduleWeights,
    SenderHeader,
    SentPosition,
    TakenReport,
)
from uavctl.records import CellReport, Record
from uavctl.wiring.cells import Coordinator

FleetHeader = SenderHeader | CoordinatorHeader
NOTHING = "nothing"
# By the topic of the first message; of version 1, that of the only one.
KINDS = {SENDER_HEADER: "sender", SENT: "sender", COORDINATOR_HEADER: "coordinator", CYCLE: "coordinator"}


class FleetDifference(msgspec.Struct, frozen=True, kw_only=True):
    """First difference of recording and replay."""

    topic: str
    at_ns: int  # log time
    at_s: float  # since the begin of the recording
    field: str  # path in the record; empty if there is a record on one side only
    recorded: str
    replayed: str


class FleetReplay(msgspec.Struct, frozen=True, kw_only=True):
    """Result of the replay of a sender or a coordinator."""

    kind: str  # "sender" or "coordinator"
    decisions: int  # choices of a sender; cycles of a coordinator
    compared: int  # records
    identical: bool
    first_difference: FleetDifference | None
    lacks_end: str  # why the end of the recording is missing; empty if it is there


class _Comparison:
    """Comparison of records with those of a replay."""

    def __init__(self, start_ns: int) -> None:
        self._start_ns = start_ns
        self.compared = 0
        self.first: FleetDifference | None = None

    def compare(self, topic: str, at_ns: int, recorded: Record | None, replayed: Record | None) -> None:
        """Compare two records; None is a record that is not there."""
        self.compared += 1
        if self.first is not None:
            return
        field, values = "", tuple(NOTHING if one is None else str(one) for one in (recorded, replayed))
        if recorded is not None and replayed is not None:
            if are_identical(recorded, replayed) or not (leaves := find_different_leaves(recorded, replayed)):
                return
            field, *leaf = leaves[0]
            values = tuple(map(str, leaf))
        self.first = FleetDifference(
            topic=topic,
            at_ns=at_ns,
            at_s=(at_ns - self._start_ns) / SECOND_NS,
            field=field,
            recorded=values[0],
            replayed=values[1],
        )

    def make_result(self, kind: str, decisions: int, path: Path) -> FleetReplay:
        """Make the result."""
        return FleetReplay(
            kind=kind,
            decisions=decisions,
            compared=self.compared,
            identical=self.first is None,
            first_difference=self.first,
            lacks_end=explain_missing_end(path),
        )


def parse_parameters(values: Mapping[str, Any]) -> CellParameters:
    """Return the constants of a coordinator from plain values.

    Raises:
        TypeError: They are of another version.
    """
    fields: dict[str, Any] = {name: np.array(one) if isinstance(one, list) else one for name, one in values.items()}
    return CellParameters(**fields)


def replay_coordinator(path: Path) -> FleetReplay:
    """Give a coordinator the recorded reports; compare its cells and the state of each cycle.

    Raises:
        RecordingError: It cannot be read, has no header (version 1), or lacks records.
    """
    header = read_fleet_header(path)
    if not isinstance(header, CoordinatorHeader):
        raise RecordingError(f"{path}: is not of a coordinator")
    numbers = {name: number for number, name in enumerate(header.names)}
    try:
        coordinator = Coordinator(parse_parameters(header.parameters), len(numbers))
    except TypeError as error:
        raise RecordingError(f"{path}: its constants are of another version ({error})") from error
    reports: dict[int, CellReport] = {}
    cells: list[IssuedCell] = []
    cycles, comparison = 0, _Comparison(0)
    for _, at_ns, record in read(path):
        if isinstance(record, TakenReport):
            reports[numbers[record.vehicle]] = record.report
        elif isinstance(record, IssuedCell):
            cells.append(record)
        elif isinstance(record, CoordinatorCycle):
            if not cycles:
                comparison = _Comparison(at_ns)
            cycles += 1
            coordinator.update(record.at_ns, reports)
            recorded = [*cells, record]
            for topic, one, other in _pair(recorded, list_cycle_records(record.at_ns, coordinator, header.names)):
                comparison.compare(topic, at_ns, one, other)
            reports, cells = {}, []
    return comparison.make_result("coordinator", cycles, path)


def replay_sender(path: Path) -> FleetReplay:
    """Give a sender the recorded positions and reports; compare its weights, and whom it serves when.

    Raises:
        RecordingError: It cannot be read, has no header (version 1), or lacks records.
    """
    header = read_fleet_header(path)
    if not isinstance(header, SenderHeader):
        raise RecordingError(f"{path}: is not of a sender")
    try:
        sender = RepeatedSender(header)
    except RecordingError as error:
        raise RecordingError(f"{path}: {error}") from error
    choices, comparison = 0, _Comparison(header.start_ns)
    for topic, at_ns, record in read(path):
        if isinstance(record, ScheduleWeights):
            comparison.compare(topic, at_ns, record, sender.repeat_weights())
        elif isinstance(record, SentPosition):
            choices += 1
            comparison.compare(topic, at_ns, record, sender.repeat_message(at_ns, record))
        else:
            sender.take(at_ns, record)
    return comparison.make_result("sender", choices, path)


def read_fleet_header(path: Path) -> FleetHeader:
    """Read the header of a recording that can be replayed.

    Raises:
        RecordingError: It does not begin with one, or lacks records.
    """
    if _find_first_topic(path) not in (SENDER_HEADER, COORDINATOR_HEADER):
        raise RecordingError(
            f"{path}: has no header, and nothing to replay: it is of an earlier version, or its begin is lost"
        )
    note = read_last_note(path)
    if note is not None and (note.lacks_records or note.dropped or note.refused):
        raise RecordingError(f"{path}: lacks records ({note.text}), so what comes after cannot be replayed")
    _, _, header = next(read(path))
    assert isinstance(header, SenderHeader | CoordinatorHeader)  # the topic's type
    return header


def _find_first_topic(path: Path) -> str:
    messages = (item for item in scan_recording(path) if isinstance(item, RecordedMessage))
    return next((message.definition.topic for message in messages), "")


def find_fleet_kind(path: Path) -> str:
    """Return "sender" or "coordinator"; empty for a recording of another kind, or one that cannot be read."""
    with suppress(RecordingError):
        return KINDS.get(_find_first_topic(path), "")
    return ""


def _pair(
    recorded: Sequence[Record], replayed: Sequence[tuple[str, Record]]
) -> Iterator[tuple[str, Record | None, Record | None]]:
    """Pair the cells of each vehicle, and the cycles."""

    def key(record: Record) -> str:
        return record.vehicle if isinstance(record, IssuedCell) else ""

    topic_by_key = {key(record): topic for topic, record in replayed}
    ours, others = {key(record): record for record in recorded}, {key(record): record for _, record in replayed}
    for name in dict.fromkeys([*ours, *others]):
        yield topic_by_key.get(name, ISSUED), ours.get(name), others.get(name)


REPLAYS = {"sender": replay_sender, "coordinator": replay_coordinator}  # by kind
