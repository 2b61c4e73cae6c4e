"""Recording of a sender: what its choices come from, and each position sent; its writer and its reader."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

import msgspec
import numpy as np
from numpy.typing import NDArray

from logs.recording.file_scan import Damage, EndOfFile, RecordedMessage
from logs.recording.reader import scan_recording
from logs.recording.recorder import Recorder, RecorderStatus, SyncRecorder
from logs.recording.topics import OFFERED, REPORTED, SENDER_HEADER, SENT, WEIGHTS, decode
from uavctl.errors import RecordingError
from uavctl.fleet_records import OfferedPosition, ReportedPosition, ScheduleWeights, SenderHeader, SentPosition
from uavctl.records import Record, Vec3
from uavctl.wiring.controller import collect_versions, read_cpu_model
from uavctl.wiring.radio import ScheduleParameters


class SenderRecording:
    """Records what a sender does; a disk that fails or hangs delays no position.

    Args:
        recorder: Recorder of a new file; with a thread of its own outside of virtual time.
        names: Names of the vehicles.
        spacing_m: Smallest distance of two vehicles [m].
        start_ns: Monotonic time of the start.
        zero_utc_ns: UTC of time 0 of the monotonic clock [ns since 1970].
    """

    def __init__(
        self,
        recorder: Recorder | SyncRecorder,
        names: Sequence[str],
        parameters: ScheduleParameters,
        *,
        spacing_m: float,
        start_ns: int,
        zero_utc_ns: int,
    ) -> None:
        self._recorder, self._names = recorder, tuple(names)
        header = SenderHeader(
            zero_utc_ns=zero_utc_ns,
            start_ns=start_ns,
            names=self._names,
            spacing_m=spacing_m,
            versions=collect_versions(""),
            cpu=read_cpu_model(),
            **msgspec.structs.asdict(parameters),
        )
        recorder.put(SENDER_HEADER, start_ns, header)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    @property
    def failure(self) -> str:
        """What is wrong; empty if the disk takes all records."""
        return self._recorder.status().problem

    def close(self) -> RecorderStatus:
        """End the recording."""
        return self._recorder.close()

    def add_position(self, at_ns: int, vehicle: int, captured_ns: int, position_m: Vec3) -> None:
        """Add a position that may be sent."""
        record = OfferedPosition(vehicle=self._names[vehicle], captured_ns=captured_ns, position_m=position_m)
        self._recorder.put(OFFERED, at_ns, record)

    def add_report(self, at_ns: int, vehicle: int, captured_ns: int) -> None:
        """Add a report of a vehicle."""
        self._recorder.put(REPORTED, at_ns, ReportedPosition(vehicle=self._names[vehicle], captured_ns=captured_ns))

    def add_weights(self, at_ns: int, weights: Sequence[float]) -> None:
        """Add the weights from now on."""
        self._recorder.put(WEIGHTS, at_ns, ScheduleWeights(weights=dict(zip(self._names, weights, strict=True))))

    def add(self, at_ns: int, vehicle: int, captured_ns: int, length: int, ages_s: Sequence[float]) -> None:
        """Add a position that was sent at `at_ns`, monotonic time."""
        record = SentPosition(
            vehicle=self._names[vehicle],
            captured_ns=captured_ns,
            bytes=length,
            ages_s=dict(zip(self._names, ages_s, strict=True)),
        )
        self._recorder.put(SENT, at_ns, record)


@dataclass(frozen=True, eq=False)
class ServedPositions:
    """Order in which a sender served its vehicles."""

    names: tuple[str, ...]  # of all its vehicles, also of those that it never served
    at_ns: NDArray[np.int64]  # (n,) UTC, ascending
    vehicles: NDArray[np.int64]  # (n,) index of the vehicle
    fault: str = ""  # why the recording is not whole; what came before is good

    def get_times_ns(self, name: str) -> NDArray[np.int64]:
        """Return the times of the messages to a vehicle."""
        return np.asarray(self.at_ns[self.vehicles == self.names.index(name)], dtype=np.int64)


class GoodPart:
    """Records of a sender's or coordinator's recording, up to its end or its first damage.

    Attributes:
        fault: Why the recording is not whole; empty as long as it is, and known once all records are read.
        zero_utc_ns: UTC of time 0 of the records' clock [ns]; 0 in recordings of version 1, whose times are UTC.
    """

    def __init__(self, path: Path) -> None:
        self._path, self.fault, self.zero_utc_ns = path, "", 0

    def __iter__(self) -> Iterator[tuple[str, int, Record]]:
        """Yield topic, log time [ns] and record.

        Raises:
            RecordingError: It cannot be read.
        """
        following = 1
        for item in scan_recording(self._path):
            if isinstance(item, RecordedMessage):
                self.zero_utc_ns = item.zero_utc_ns
                if item.sequence not in (0, following):  # version 1 counts none
                    self.fault = f"{self._path}: message {item.sequence} where {following} should be"
                    return
                following = item.sequence + 1
                topic = item.definition.topic
                try:
                    record = decode(topic, item.data, item.at_ns)
                except RecordingError as error:
                    self.fault = f"{self._path}: {error}"
                    return
                yield topic, item.at_ns, record
            elif isinstance(item, Damage):
                self.fault = str(item)
                return
            elif isinstance(item, EndOfFile) and not item.finished:
                self.fault = f"{self._path}: the recording is torn, or still written"
                return


def read_sender(path: Path) -> ServedPositions:
    """Read which vehicles a sender served, up to the end of its recording, or to its first damage.

    Raises:
        RecordingError: It cannot be read, or holds no position before the damage.
    """
    times_ns: list[int] = []
    vehicles: list[int] = []
    numbers: dict[str, int] = {}
    part = GoodPart(path)
    for _, at_ns, record in part:
        if isinstance(record, SenderHeader):
            numbers = {name: number for number, name in enumerate(record.names)}
        elif isinstance(record, SentPosition):
            for name in (*record.ages_s, record.vehicle):
                numbers.setdefault(name, len(numbers))
            times_ns.append(at_ns + part.zero_utc_ns)
            vehicles.append(numbers[record.vehicle])
    if not times_ns:
        raise RecordingError(part.fault or f"{path}: the sender sent nothing")
    order = np.argsort(np.array(times_ns, dtype=np.int64), kind="stable")
    return ServedPositions(
        tuple(numbers), np.array(times_ns, dtype=np.int64)[order], np.array(vehicles, dtype=np.int64)[order], part.fault
    )
