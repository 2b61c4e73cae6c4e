"""Recording of the coordinator of the cells: one MCAP file with a JSON message for each cycle."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Self

import msgspec
from mcap.writer import Writer

from uavctl.errors import RecordingError
from uavctl.fleet.coordinator import CellParameters, CoordinatorState, find_nearest_claims
from uavctl.records import Conduct, Vec3

TOPIC = "/uavctl/coordinator"
CHUNK_BYTES = 65_536  # a killed process loses the messages of the last chunk, some seconds


class VehicleCycle(msgspec.Struct, frozen=True, kw_only=True):
    """State of a vehicle in a cycle."""

    report_age_s: float  # since the step of its newest report
    conduct: Conduct
    position_m: Vec3  # as reported
    goal_m: Vec3  # place that its mission, or the operator, wants it at
    guide_m: Vec3  # place to which its newest cell leads it: its goal, or a way around others
    in_use: int  # number of its cell; 0 without one
    decided: int  # number of the newest cell that it took or refused
    newest: int  # number of its newest cell
    wait: str  # why it was issued none; empty if it was
    land: bool  # whether it is told to land
    nearest: str  # vehicle whose claim is nearest to its own; empty without one
    gap: float | None  # of these claims over the distance to keep, the least of all stages; apart: at least 1


class CycleRecord(msgspec.Struct, frozen=True, kw_only=True):
    """A cycle of the coordinator."""

    at_ns: int  # monotonic time
    step: int
    vehicles: dict[str, VehicleCycle]


def make_cycle_record(
    at_ns: int, state: CoordinatorState, parameters: CellParameters, names: Sequence[str]
) -> CycleRecord:
    """Make the record of a cycle."""
    vehicles = {}
    for i, (near, gap) in enumerate(find_nearest_claims(state, parameters)):
        report, cell = state.reports[i], state.newest[i]
        vehicles[names[i]] = VehicleCycle(
            report_age_s=round((state.step - report.plan.step) * parameters.dt_s, 3),
            conduct=report.conduct,
            position_m=tuple(report.plan.mean_m[0].tolist()),
            goal_m=tuple(state.goals_m[i].tolist()),
            guide_m=tuple(cell.goal_m.tolist()),
            in_use=report.in_use,
            decided=report.decided,
            newest=cell.number,
            wait=state.waits[i] if state.waits else "",
            land=cell.land,
            nearest="" if near == i else names[near],
            gap=None if near == i else round(gap, 4),
        )
    return CycleRecord(at_ns=at_ns, step=state.step, vehicles=vehicles)


class CoordinatorRecording:
    """Writes the cycles of a coordinator; `log_time` is UTC.

    Attributes:
        failure: Why nothing is written any more; empty as long as it is.

    Args:
        zero_utc_ns: UTC of time 0 of the monotonic clock [ns since 1970].

    Raises:
        RecordingError: There is such a file, or it cannot be made.
    """

    def __init__(self, path: Path, zero_utc_ns: int) -> None:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = path.open("xb")
        except OSError as error:
            raise RecordingError(f"{path}: cannot be written ({error.strerror}); choose another folder") from error
        self._zero_utc_ns = zero_utc_ns
        self.failure = ""
        self._writer = Writer(self._file, chunk_size=CHUNK_BYTES)
        self._writer.start(profile="", library="uavctl")
        schema = msgspec.json.encode(msgspec.json.schema(CycleRecord))
        number = self._writer.register_schema("uavctl.CycleRecord", "jsonschema", schema)
        self._channel = self._writer.register_channel(TOPIC, "json", number)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        try:
            if not self.failure:
                self._writer.finish()  # type: ignore[no-untyped-call]
            self._file.close()
        except OSError as write_error:
            self.failure = write_error.strerror or "write error"

    def add(self, record: CycleRecord) -> None:
        """Add a cycle; a write error ends the recording alone."""
        if self.failure:
            return
        time_ns = self._zero_utc_ns + record.at_ns
        try:
            self._writer.add_message(self._channel, time_ns, msgspec.json.encode(record), time_ns)
        except OSError as error:
            self.failure = error.strerror or "write error"
