"""Choices of a recorded sender again, and those of round-robin from the same positions at the same times."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from logs.recording.sender import GoodPart
from uavctl.arrays import Array
from uavctl.errors import DesignError, RecordingError
from uavctl.fleet_records import OfferedPosition, ReportedPosition, ScheduleWeights, SenderHeader, SentPosition
from uavctl.records import Record
from uavctl.schedule.cost import MessageAccount
from uavctl.schedule.scheduler import SCHEDULES, ScheduleName
from uavctl.wiring.radio import PlacedSchedule, ScheduleParameters

ROUND_ROBIN: ScheduleName = "round-robin"


def parse_schedule(header: SenderHeader) -> ScheduleParameters:
    """Return the constants of a recorded schedule.

    Raises:
        RecordingError: This version has no such schedule, or a vehicle has no costs.
    """
    name = next((one for one in SCHEDULES if one == header.schedule), None)
    if name is None or not all(0 <= vehicle.kind < len(header.costs) for vehicle in header.vehicles):
        raise RecordingError(f"schedule {header.schedule!r} is not known to this version, or a vehicle has no costs")
    return ScheduleParameters(
        schedule=name,
        slot_ns=header.slot_ns,
        max_wait_slots=header.max_wait_slots,
        loss=header.loss,
        feedback_ns=header.feedback_ns,
        costs=header.costs,
        vehicles=header.vehicles,
    )


class RepeatedSender:
    """Sender that gets recorded inputs."""

    def __init__(self, header: SenderHeader) -> None:
        self._names = header.names
        self._numbers = {name: number for number, name in enumerate(header.names)}
        self._schedule = PlacedSchedule(parse_schedule(header), header.spacing_m, header.start_ns)

    def take(self, at_ns: int, record: Record) -> None:
        """Take an input."""
        if isinstance(record, OfferedPosition):
            self._schedule.add_position(self._numbers[record.vehicle], record.captured_ns, record.position_m)
        elif isinstance(record, ReportedPosition):
            self._schedule.scheduler.add_feedback(self._numbers[record.vehicle], record.captured_ns, at_ns)

    def repeat_weights(self) -> ScheduleWeights:
        """Return the weights by the positions so far."""
        self._schedule.update_placed_weights()
        return ScheduleWeights(weights=dict(zip(self._names, self._schedule.weights, strict=True)))

    def repeat_message(self, at_ns: int, recorded: SentPosition) -> SentPosition | None:
        """Return the message of now, with the recorded length; None if there is none."""
        scheduler = self._schedule.scheduler
        number = scheduler.choose(at_ns)
        if number is None:
            return None
        captured_ns = scheduler.vehicles[number].sent_ns
        assert captured_ns is not None
        ages_s = dict(zip(self._names, scheduler.ages_s, strict=True))
        return msgspec.structs.replace(recorded, vehicle=self._names[number], captured_ns=captured_ns, ages_s=ages_s)


@dataclass(frozen=True, eq=False)
class ScheduleComparison:
    """Believed costs and ages of a flown schedule and of round-robin: means over the times of the messages."""

    schedule: str
    names: tuple[str, ...]
    messages: int
    costs: Array  # of each vehicle (N,)
    ages_s: Array  # (N,)
    round_robin_costs: Array  # (N,)
    round_robin_ages_s: Array  # (N,)

    @property
    def change(self) -> float | None:
        """Cost over that of round-robin, less one; None where that costs nothing."""
        total = float(self.round_robin_costs.sum())
        return float(self.costs.sum()) / total - 1.0 if total > 0.0 else None


class _Course:
    """Messages of one schedule so far, and the sums of their costs and ages."""

    def __init__(self, parameters: ScheduleParameters, start_ns: int) -> None:
        costs = [np.array(parameters.costs[vehicle.kind]) for vehicle in parameters.vehicles]
        self._account = MessageAccount(costs, parameters.slot_ns, parameters.loss, start_ns)
        self.costs, self.ages_s = np.zeros(len(costs)), np.zeros(len(costs))

    def add_costs(self, at_ns: int, weights: list[float]) -> None:
        """Add the costs and ages at a time."""
        self.costs += self._account.compute_costs(at_ns, weights)
        self.ages_s += self._account.compute_ages_s(at_ns)

    def add_message(self, at_ns: int, number: int, captured_ns: int) -> None:
        """Note a message."""
        self._account.add_message(number, captured_ns, at_ns)


class RoundRobinComparison:
    """Comparison of a recorded sender with round-robin: the same positions, times of messages and weights.

    Args:
        begin_ns: UTC from which messages count [ns].
        end_ns: UTC of the last one [ns].
    """

    def __init__(self, header: SenderHeader, begin_ns: int, end_ns: int) -> None:
        self._first_ns, self._last_ns = begin_ns - header.zero_utc_ns, end_ns - header.zero_utc_ns
        parameters = parse_schedule(header)
        self._header, self._weights = header, [1.0] * len(header.names)
        self._numbers = {name: number for number, name in enumerate(header.names)}
        self._flown, self._other = (_Course(parameters, header.start_ns) for _ in range(2))
        other = msgspec.structs.replace(parameters, schedule=ROUND_ROBIN, feedback_ns=0)
        self._scheduler = PlacedSchedule(other, header.spacing_m, header.start_ns).scheduler
        self._messages, self._has_positions = 0, False

    def take(self, at_ns: int, record: Record) -> None:
        """Take a record."""
        if isinstance(record, OfferedPosition):
            self._has_positions |= self._scheduler.add_position(self._numbers[record.vehicle], record.captured_ns)
        elif isinstance(record, ScheduleWeights):
            self._weights = [record.weights[name] for name in self._header.names]
        elif isinstance(record, SentPosition):
            if self._first_ns <= at_ns <= self._last_ns:
                self._messages += 1
                self._flown.add_costs(at_ns, self._weights)
                self._other.add_costs(at_ns, self._weights)
            self._flown.add_message(at_ns, self._numbers[record.vehicle], record.captured_ns)
            number = self._scheduler.choose(at_ns)
            if number is not None and (captured_ns := self._scheduler.vehicles[number].sent_ns) is not None:
                self._other.add_message(at_ns, number, captured_ns)

    def make_result(self) -> ScheduleComparison | None:
        """Make the result; None without a message, or without the positions that were there to send."""
        if not self._messages or not self._has_positions:
            return None
        return ScheduleComparison(
            schedule=self._header.schedule,
            names=self._header.names,
            messages=self._messages,
            costs=self._flown.costs / self._messages,
            ages_s=self._flown.ages_s / self._messages,
            round_robin_costs=self._other.costs / self._messages,
            round_robin_ages_s=self._other.ages_s / self._messages,
        )


def compare_with_round_robin(path: Path, begin_ns: int, end_ns: int) -> ScheduleComparison | None:
    """Compare a recorded sender with round-robin over the messages of a span of UTC [ns].

    Returns:
        None for a recording of version 1, and without a message in the span.

    Raises:
        RecordingError: It cannot be read, or is not understood.
    """
    comparison: RoundRobinComparison | None = None
    try:
        for _, at_ns, record in GoodPart(path):
            if isinstance(record, SenderHeader):
                comparison = RoundRobinComparison(record, begin_ns, end_ns)
            elif comparison is not None:
                comparison.take(at_ns, record)
    except (LookupError, ValueError, DesignError) as error:  # it was written so
        raise RecordingError(f"{path}: is not understood ({type(error).__name__}: {error})") from error
    return None if comparison is None else comparison.make_result()
