"""A recording that is not being written, or is no longer there, is told while flying and in the end."""

from __future__ import annotations

import os
import shutil
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from patience import wait_until
from recording_fakes import Clock, drop_recorder_notes, flight

from logs.recording.disk import DiskFile, OutputFile
from logs.recording.reader import read
from logs.recording.recorder import LATE_S, Recorder, RecorderStatus, SyncRecorder
from uavctl.cli.services import make_recorder_health
from uavctl.config.types import LogConfig

ITEMS = flight(400)


class Hanging:
    """A disk on which one operation hangs until it is let go."""

    def __init__(self, operation: str) -> None:
        self.operation = operation
        self.armed, self.reached, self.released = threading.Event(), threading.Event(), threading.Event()

    def open(self, path: Path) -> OutputFile:
        self.check("open")
        return _HangingFile(path, self)

    def free(self, folder: Path) -> int:
        self.check("free")
        return 10**12

    def check(self, operation: str) -> None:
        if operation == self.operation and self.armed.is_set():
            self.reached.set()
            self.released.wait()


class _HangingFile(DiskFile):
    def __init__(self, path: Path, disk: Hanging) -> None:
        super().__init__(path)
        self._disk = disk

    def write(self, data: bytes) -> None:
        self._disk.check("write")
        super().write(data)

    def sync(self) -> None:
        self._disk.check("sync")


@pytest.fixture(params=["open", "write", "sync", "free"])
def disk(request: pytest.FixtureRequest) -> Iterator[Hanging]:
    found = Hanging(request.param)
    yield found
    found.released.set()  # its thread ends


def hung(path: Path, disk: Hanging, clock: Clock) -> Recorder:
    """A recorder whose thread hangs, at 2 s."""
    if disk.operation == "open":
        disk.armed.set()
    recorder = Recorder(path, open_file=disk.open, free=disk.free, clock=clock)
    recorder.put(*ITEMS[0])
    if disk.operation != "open":
        wait_until(lambda: recorder.status().written > 0, "the header is written")
        disk.armed.set()
    clock.now_s = 2.0
    for item in ITEMS[1:]:
        recorder.put(*item)
    disk.reached.wait()
    return recorder


@pytest.mark.fault(54)
def test_a_disk_that_hangs_is_told_by_the_age_of_the_last_completed_write(tmp_path: Path, disk: Hanging) -> None:
    clock = Clock()
    recorder = hung(tmp_path / "flight.mcap", disk, clock)
    assert recorder.status().ok  # two seconds are no news: one is between two looks
    clock.now_s = LATE_S
    assert recorder.status().ok
    clock.now_s = 12.3
    status = recorder.status()
    assert (status.ok, status.dropped, status.unwritten_s) == (False, 0, 12.3)
    assert "last written 12.3 s ago" in status.reason
    told = make_recorder_health(status, tmp_path)
    assert (told.ok, told.reason, told.unwritten_s) == (False, status.reason, 12.3)
    disk.released.set()

    def well() -> bool:
        clock.now_s += 1.0
        recorder.put(*ITEMS[-1])
        return recorder.status().ok

    wait_until(well, "what waited is written")
    assert recorder.close(60.0).ok


@pytest.mark.fault(54)
def test_an_end_that_does_not_reach_the_disk_is_told(tmp_path: Path, disk: Hanging) -> None:
    clock = Clock()
    recorder = hung(tmp_path / "flight.mcap", disk, clock)
    clock.now_s = 2.5  # however short it was
    status = recorder.close(0.0)
    assert not status.ok and "last written 2.5 s ago" in status.reason


def removed(path: Path) -> None:
    path.unlink()


def folder_removed(path: Path) -> None:
    shutil.rmtree(path.parent)


def folder_moved(path: Path) -> None:
    path.parent.rename(path.parent.with_name("elsewhere"))


def replaced(path: Path) -> None:
    other = path.with_name("other")
    other.write_bytes(bytes(1_000_000))
    other.replace(path)


def emptied(path: Path) -> None:
    os.truncate(path, 0)


@pytest.mark.parametrize("harm", [removed, folder_removed, folder_moved, replaced, emptied])
@pytest.mark.fault(55)
def test_a_file_that_is_taken_away_is_told_and_another_one_begun(tmp_path: Path, harm: Callable[[Path], None]) -> None:
    path = tmp_path / "flights" / "flight.mcap"
    clock = Clock()
    recorder = SyncRecorder(path, LogConfig(chunk_bytes=1024), clock=clock)
    seen: list[RecorderStatus] = []
    for number, item in enumerate(ITEMS):
        clock.now_s += 0.1
        recorder.put(*item)
        if number == 200:
            assert recorder.status().ok
            harm(path)
        seen.append(recorder.status())
    assert [one.ok for one in seen[:201]] == [True] * 201
    assert not any(one.ok for one in seen[212:])  # it is looked at once a second
    final = recorder.close()
    assert not final.ok and final.reason == "flight.mcap deleted, moved or replaced"
    assert final.segments == (str(path.with_name("flight-2.mcap")),)
    kept = drop_recorder_notes(list(read(path.with_name("flight-2.mcap"))))[1:]  # its header is the flight's
    assert kept == ITEMS[-len(kept) :] and len(kept) > 180
    lost = len(ITEMS) - len(kept)
    assert lost < final.gone <= lost + 2  # and the recorder's own notes
    assert make_recorder_health(final, path).dropped == final.gone


@pytest.mark.fault(55)
def test_a_closed_file_that_is_taken_away_is_told_too(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    clock = Clock()
    recorder = SyncRecorder(path, LogConfig(segment_bytes=20_000, chunk_bytes=4096), clock=clock)
    for item in flight(2000):
        clock.now_s += 0.01
        recorder.put(*item)
    assert recorder.status().ok and len(recorder.status().segments) > 2
    path.with_name("flight-2.mcap").unlink()
    clock.now_s += 1.0
    recorder.put(*ITEMS[-1])
    status = recorder.status()
    assert not status.ok and status.reason == "flight-2.mcap deleted, moved or replaced" and status.gone > 100
    assert recorder.close().gone == status.gone


@pytest.mark.fault(55)
def test_a_file_that_is_taken_away_just_before_the_end_is_told(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    recorder = SyncRecorder(path, clock=Clock())
    for item in ITEMS:
        recorder.put(*item)
    path.unlink()
    status = recorder.close()
    assert not status.ok and status.gone >= len(ITEMS) and status.segments == ()
