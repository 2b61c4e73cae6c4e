"""Contents of the recordings of a sender and of a coordinator: whom it served, why cycles issued no cell."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import msgspec

from uavctl.fleet_records import CoordinatorCycle, CoordinatorHeader, SenderHeader, SentPosition
from uavctl.records import Record


class ServedVehicle(msgspec.Struct, frozen=True, kw_only=True):
    """Messages of a sender to one vehicle."""

    messages: int
    mean_wait_s: float | None  # between two messages; None with less than two
    longest_wait_s: float | None


class SenderInfo(msgspec.Struct, frozen=True, kw_only=True):
    """Recording of a sender."""

    schedule: str | None  # None in version 1
    vehicles: dict[str, ServedVehicle]


class CoordinatorInfo(msgspec.Struct, frozen=True, kw_only=True):
    """Recording of a coordinator."""

    cycles: int
    longest_gap_s: float  # between two cycles
    cells: dict[str, int]  # cycles in which a vehicle was issued a cell
    waits: dict[str, dict[str, int]]  # cycles in which it was not, by reason


@dataclass
class _Times:
    """Times of messages or cycles [ns], taken one by one."""

    count: int = 0
    first_ns: int = 0
    last_ns: int = 0
    longest_ns: int = 0

    def add(self, at_ns: int) -> None:
        if self.count:
            self.longest_ns = max(self.longest_ns, at_ns - self.last_ns)
        else:
            self.first_ns = at_ns
        self.count, self.last_ns = self.count + 1, at_ns

    def make_served(self) -> ServedVehicle:
        """Return the figures of a vehicle's messages."""
        if self.count < 2:
            return ServedVehicle(messages=self.count, mean_wait_s=None, longest_wait_s=None)
        mean_s = 1e-9 * (self.last_ns - self.first_ns) / (self.count - 1)
        return ServedVehicle(messages=self.count, mean_wait_s=mean_s, longest_wait_s=1e-9 * self.longest_ns)


class FleetAccount:
    """Figures of a sender's or coordinator's records, taken one by one."""

    def __init__(self) -> None:
        self._schedule: str | None = None
        self._served: dict[str, _Times] = {}
        self._cycles = _Times()
        self._waits: dict[str, Counter[str]] = {}
        self._is_of_coordinator = False

    def add(self, at_ns: int, record: Record) -> None:
        """Take a record; those of other kinds change nothing."""
        if isinstance(record, SenderHeader):
            self._schedule = record.schedule
            self._served = {name: _Times() for name in record.names}
        elif isinstance(record, SentPosition):
            self._served.setdefault(record.vehicle, _Times()).add(at_ns)
        elif isinstance(record, CoordinatorHeader):
            self._waits, self._is_of_coordinator = {name: Counter() for name in record.names}, True
        elif isinstance(record, CoordinatorCycle):
            self._cycles.add(at_ns)
            for name, vehicle in record.vehicles.items():
                self._waits.setdefault(name, Counter())[vehicle.wait] += 1

    def make_sender(self) -> SenderInfo | None:
        """Return the summary of a sender; None if the recording is of none."""
        if not self._served:
            return None
        vehicles = {name: times.make_served() for name, times in self._served.items()}
        return SenderInfo(schedule=self._schedule, vehicles=vehicles)

    def make_coordinator(self) -> CoordinatorInfo | None:
        """Return the summary of a coordinator; None if the recording is of none."""
        if not self._waits and not self._is_of_coordinator:
            return None
        return CoordinatorInfo(
            cycles=self._cycles.count,
            longest_gap_s=1e-9 * self._cycles.longest_ns,
            cells={name: counts[""] for name, counts in self._waits.items()},
            waits={name: {why: n for why, n in counts.items() if why} for name, counts in self._waits.items()},
        )
