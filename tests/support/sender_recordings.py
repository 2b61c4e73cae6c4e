"""Recordings of a sender with known constants."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from logs.recording.recorder import Recorder, SyncRecorder
from logs.recording.sender import SenderRecording
from uavctl.fleet_records import ScheduledVehicle
from uavctl.schedule.scheduler import ScheduleName
from uavctl.wiring.radio import ScheduleParameters

SLOT_NS = 20_000_000


def make_parameters(
    costs: Sequence[Sequence[float]], schedule: ScheduleName = "value", loss: float = 0.0, feedback_ns: int = 0
) -> ScheduleParameters:
    """Constants of vehicles far from every limit, one row of costs each."""
    vehicles = [
        ScheduledVehicle(kind=kind, wait_std_m=0.1, quantile=2.0, lower_m=(-100.0,) * 3, upper_m=(100.0,) * 3)
        for kind in range(len(costs))
    ]
    return ScheduleParameters(
        schedule=schedule,
        slot_ns=SLOT_NS,
        max_wait_slots=2 * len(costs),
        loss=loss,
        feedback_ns=feedback_ns,
        costs=tuple(tuple(row) for row in costs),
        vehicles=tuple(vehicles),
    )


def open_sender_recording(
    path: Path,
    names: Sequence[str],
    zero_utc_ns: int = 0,
    parameters: ScheduleParameters | None = None,
    recorder: type[Recorder | SyncRecorder] = SyncRecorder,
) -> SenderRecording:
    """A new recording; the cost of an age is the age, unless parameters say otherwise."""
    parameters = parameters or make_parameters([[float(age) for age in range(100)]] * len(names))
    return SenderRecording(recorder(path), names, parameters, spacing_m=0.4, start_ns=0, zero_utc_ns=zero_utc_ns)
