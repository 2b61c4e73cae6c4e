"""Storage faults: the numbers are the rows of the fault table."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from recording_fakes import Clock, Disk, Item, flight, own, record_flight

from logs.chunks import Damage, Message, scan
from logs.disk import DiskFile, OutputFile
from logs.info import info
from logs.reader import read, records
from logs.recorder import Recorder, SyncRecorder
from logs.recover import recover
from logs.topics import RecorderNote
from uavctl.data import Event
from uavctl.errors import RecordingError

COUNT = 60


def fly(recorder: SyncRecorder, clock: Clock, items: list[Item]) -> None:
    for topic, at_ns, record in items:
        clock.now_s += 0.1
        recorder.put(topic, at_ns, record)


def test_29_disk_full_at_every_operation_loses_nothing(tmp_path: Path) -> None:
    items = flight(COUNT)
    number = 0
    while True:
        path = tmp_path / f"at{number}" / "flight.mcap"
        clock, disk = Clock(), Disk(lambda operation, number=number: operation == number)  # type: ignore[misc]  # bound now
        recorder = SyncRecorder(path, 1024, open_file=disk.open, clock=clock)
        fly(recorder, clock, items)
        status = recorder.close()
        assert own(list(read(path))) == items, number
        if disk.operations <= number:
            break  # every operation has had its turn
        assert status.failures == 1
        assert "No space left" in status.reason
        assert (status.waiting, status.dropped) == (0, 0)
        assert status.ok  # it came back and nothing is lost
        number += 1
    assert number > 20


def test_29_disk_stays_full_then_has_room_again(tmp_path: Path) -> None:
    items = flight(COUNT)
    room = Disk()
    fly(recorder := SyncRecorder(tmp_path / "all.mcap", 1024, open_file=room.open, clock=(clock := Clock())), clock, items)
    recorder.close()
    for first in range(room.operations):
        path = tmp_path / f"from{first}" / "flight.mcap"
        clock, full = Clock(), {"from": first}
        disk = Disk(lambda operation, full=full: operation >= full["from"])  # type: ignore[misc]  # bound now
        recorder = SyncRecorder(path, 1024, open_file=disk.open, clock=clock)
        fly(recorder, clock, items)
        on_disk = own(list(read(path))) if list(path.parent.iterdir()) else []
        assert on_disk == items[: len(on_disk)]  # all that was written is readable
        status = recorder.status()
        if status.failures:
            assert not status.ok
            assert status.waiting > 0
            assert len(on_disk) + status.waiting >= len(items)
        full["from"] = sys.maxsize
        clock.now_s += 10.0
        late = Event(at_ns=9 * 10**9, severity=items[3][2].severity, code="late", text="") if isinstance(items[3][2], Event) else items[2][2]
        recorder.put(items[2][0], 9 * 10**9, items[2][2])
        assert recorder.close().ok, (first, late)
        assert own(list(read(path))) == [*items, (items[2][0], 9 * 10**9, items[2][2])]


