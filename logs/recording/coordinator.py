"""Recording of the coordinator of the cells: in each cycle the reports that it took up, its cells, and its state."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np

from logs.recording.recorder import Recorder
from logs.recording.topics import COORDINATOR_HEADER, CYCLE, ISSUED, TAKEN
from uavctl.fleet.cell import format_cell, format_report
from uavctl.fleet.coordinator import CellParameters, CoordinatorState, find_nearest_claims
from uavctl.fleet_records import CoordinatorCycle, CoordinatorHeader, IssuedCell, TakenReport, VehicleCycle
from uavctl.records import Record
from uavctl.wiring.cells import Coordinator
from uavctl.wiring.controller import collect_versions, read_cpu_model


def format_parameters(parameters: CellParameters) -> dict[str, object]:
    """Return the constants of a coordinator as plain values."""
    values = {field.name: getattr(parameters, field.name) for field in fields(parameters)}
    return {name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in values.items()}


def make_cycle(
    at_ns: int, state: CoordinatorState, parameters: CellParameters, names: Sequence[str]
) -> CoordinatorCycle:
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
    return CoordinatorCycle(at_ns=at_ns, step=state.step, vehicles=vehicles)


def list_cycle_records(at_ns: int, coordinator: Coordinator, names: Sequence[str]) -> list[tuple[str, Record]]:
    """Return topic and record of all that the last cycle decided: its cells, then its state; nothing before it."""
    state = coordinator.state
    if state is None:
        return []
    records: list[tuple[str, Record]] = [
        (ISSUED, IssuedCell(vehicle=names[i], cell=format_cell(state.newest[i])))
        for i, wait in enumerate(state.waits)
        if not wait
    ]
    return [*records, (CYCLE, make_cycle(at_ns, state, coordinator.parameters, names))]


class CoordinatorRecording:
    """Records the cycles of a coordinator from a thread of its own; a disk that fails or hangs delays none.

    Args:
        names: Of the vehicles.
        start_ns: Monotonic time of the start.
        zero_utc_ns: UTC of time 0 of the monotonic clock [ns since 1970].

    Raises:
        RecordingError: There is such a file, or its folder cannot be made.
    """

    def __init__(
        self, path: Path, names: Sequence[str], parameters: CellParameters, *, start_ns: int, zero_utc_ns: int
    ) -> None:
        self._names, self._recorder = names, Recorder(path)
        header = CoordinatorHeader(
            zero_utc_ns=zero_utc_ns,
            names=tuple(names),
            parameters=format_parameters(parameters),
            versions=collect_versions(""),
            cpu=read_cpu_model(),
        )
        self._recorder.put(COORDINATOR_HEADER, start_ns, header)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._recorder.close()

    @property
    def failure(self) -> str:
        """What is wrong; empty if the disk takes all cycles."""
        return self._recorder.status().problem

    def add(self, at_ns: int, coordinator: Coordinator) -> None:
        """Add the last cycle of a coordinator."""
        for number, report in sorted(coordinator.taken.items()):
            taken = TakenReport(vehicle=self._names[number], report=format_report(report))
            self._recorder.put(TAKEN, at_ns, taken)
        for topic, record in list_cycle_records(at_ns, coordinator, self._names):
            self._recorder.put(topic, at_ns, record)
