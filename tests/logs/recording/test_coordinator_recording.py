"""Recording of a coordinator: a replay gives each cell again, and finds a changed report; no disk delays a cycle."""

from __future__ import annotations

import threading
from pathlib import Path

import msgspec
import numpy as np
import pytest
from patience import wait_until

import logs.recording.recorder
from logs.recording.coordinator import CoordinatorRecording
from logs.recording.disk import DiskFile
from logs.recording.fleet_replay import replay_coordinator
from logs.recording.reader import read
from logs.recording.recorder import SyncRecorder
from logs.recording.topics import ISSUED, TAKEN
from uavctl.config import load_config
from uavctl.errors import RecordingError
from uavctl.fleet.cell import NO_CHOICE, PlannedPath, Report, decide_cell, format_report, parse_cell
from uavctl.fleet_records import CoordinatorCycle, IssuedCell, TakenReport
from uavctl.records import CellMessage, Conduct
from uavctl.wiring.cells import CYCLE_NS, Coordinator, build_cell_parameters

CONFIG = load_config("room-px4", ["mission.cells=true"])
PARAMETERS = build_cell_parameters([CONFIG], 0.35)
NAMES = ("east", "west")
STARTS_M = np.array([[0.0, 1.5, -1.2], [0.0, -1.5, -1.2]])
BEGIN_NS, ZERO_UTC_NS = 70 * 10**9, 10**18
CYCLES = 40


def record_cycles(recording: CoordinatorRecording, cycles: int = CYCLES) -> int:
    """Two vehicles fly at each other, with reports and cells lost; return how many cells they were issued."""
    rng, coordinator = np.random.default_rng(5), Coordinator(PARAMETERS, len(NAMES))
    choices, dt_ns = [NO_CHOICE, NO_CHOICE], round(PARAMETERS.dt_s * 1e9)
    ahead_s = PARAMETERS.dt_s * np.arange(PARAMETERS.stages)[:, None]
    for cycle in range(cycles):
        at_ns = BEGIN_NS + cycle * CYCLE_NS
        step = at_ns // dt_ns
        for number, start_m in enumerate(STARTS_M):
            velocity_mps = np.array([0.0, -0.3 * np.sign(start_m[1]), 0.0])
            place_m = start_m + 0.1 * cycle * velocity_mps + rng.normal(0.0, 0.01, 3)
            plan = PlannedPath(step, place_m + ahead_s * velocity_mps, np.full((PARAMETERS.stages, 3), 0.08))
            choice = choices[number]
            report = Report(
                plan,
                velocity_mps,
                in_use=0 if choice.cell is None else choice.cell.number,
                decided=choice.decided,
                conduct=Conduct.REST if choice.cell is None else Conduct.CELL,
                exits=choice.exits,
                goal_m=-start_m,
                reach_mps2=np.full(3, 0.5),
            )
            if cycle == 0 or rng.random() > 0.3:
                coordinator.receive(number, format_report(report))
            choices[number] = choice
        for number, message in coordinator.update(at_ns).items():
            if rng.random() > 0.3:
                plan = coordinator.taken[number].plan if number in coordinator.taken else plan
                choices[number] = decide_cell(choices[number], parse_cell(message), step, plan)
        recording.add(at_ns, coordinator)
    assert coordinator.state is not None
    return sum(cell.number for cell in coordinator.state.newest)


def make_recording(path: Path) -> CoordinatorRecording:
    return CoordinatorRecording(path, NAMES, PARAMETERS, start_ns=BEGIN_NS, zero_utc_ns=ZERO_UTC_NS)


def test_a_replay_of_the_reports_gives_each_cell_again(tmp_path: Path) -> None:
    path = tmp_path / "new" / "coordinator.mcap"
    with make_recording(path) as recording:
        issued = record_cycles(recording)
    assert recording.failure == ""
    records = list(read(path))
    cells = [record for _, _, record in records if isinstance(record, IssuedCell)]
    cycles = [record for _, _, record in records if isinstance(record, CoordinatorCycle)]
    assert len(cells) == issued > 30 and {cell.vehicle for cell in cells} == set(NAMES)
    assert [cycle.at_ns for cycle in cycles] == [BEGIN_NS + number * CYCLE_NS for number in range(CYCLES)]
    result = replay_coordinator(path)
    assert (result.identical, result.decisions, result.compared) == (True, CYCLES, issued + CYCLES)
    assert not result.lacks_end


def test_a_replay_finds_the_first_cell_that_a_changed_report_gives(tmp_path: Path) -> None:
    path, changed = tmp_path / "coordinator.mcap", tmp_path / "changed.mcap"
    with make_recording(path) as recording:
        record_cycles(recording)
    recorder, reports = SyncRecorder(changed), 0
    for topic, at_ns, record in read(path):
        if topic == TAKEN:
            assert isinstance(record, TakenReport)
            reports += 1
            if reports == 20:
                report = msgspec.structs.replace(record.report, goal_m=(1.0, 0.0, -1.2))
                record = msgspec.structs.replace(record, report=report)
                moved_ns = at_ns
        if topic != "/uavctl/recorder":
            recorder.put(topic, at_ns, record)
    assert recorder.close().ok
    result = replay_coordinator(changed)
    assert not result.identical and result.first_difference is not None
    assert result.first_difference.at_ns == moved_ns and result.first_difference.topic == ISSUED


def test_a_recording_of_another_kind_is_refused(tmp_path: Path) -> None:
    recorder = SyncRecorder(tmp_path / "other.mcap")
    cell = CellMessage(exits=0, number=1, step=0, lower_m=((0.0,) * 3,), upper_m=((1.0,) * 3,), goal_m=(0.0,) * 3)
    recorder.put(ISSUED, 0, IssuedCell(vehicle="a", cell=cell))
    recorder.close()
    with pytest.raises(RecordingError, match="no header"):
        replay_coordinator(tmp_path / "other.mcap")


def test_a_disk_that_hangs_holds_up_no_cycle(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    goes_on, is_reached, write = threading.Event(), threading.Event(), DiskFile.write

    def hang(self: DiskFile, data: bytes) -> None:
        is_reached.set()
        goes_on.wait()
        write(self, data)

    monkeypatch.setattr(DiskFile, "write", hang)
    recording = make_recording(tmp_path / "coordinator.mcap")
    record_cycles(recording)
    wait_until(is_reached.is_set, "the disk hangs")
    record_cycles(recording, 3)  # no call waits for the disk
    monkeypatch.setattr(logs.recording.recorder, "LATE_S", 0.0)
    assert "last written" in recording.failure
    goes_on.set()
    recording.__exit__(None, None, None)
    wait_until(lambda: recording.failure == "", "all is written")
