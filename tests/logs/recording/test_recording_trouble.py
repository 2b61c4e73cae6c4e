"""A recording that is not being written, or is no longer there, is told while flying and in the end."""

from __future__ import annotations

import shutil
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from patience import wait_until
from recording_fakes import Clock, drop_recorder_notes, flight

from logs.recording.disk import DiskFile, OutputFile
from logs.recording.ends import describe_ending, find_missing_files
from logs.recording.info import read_info
from logs.recording.reader import find_segments, read
from logs.recording.recorder import LATE_S, Recorder, SyncRecorder
from uavctl.account import make_ending
from uavctl.cause import Cause
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


def remove_file(path: Path) -> None:
    path.unlink()


def remove_folder(path: Path) -> None:
    shutil.rmtree(path.parent)


def move_folder(path: Path) -> None:
    path.parent.rename(path.parent.with_name("elsewhere"))


@pytest.mark.parametrize("harm", [remove_file, remove_folder, move_folder])
@pytest.mark.fault(55)
def test_a_file_that_is_taken_away_is_reported_and_another_one_begun(
    tmp_path: Path, harm: Callable[[Path], None]
) -> None:
    path = tmp_path / "flights" / "flight.mcap"
    clock = Clock()
    recorder = SyncRecorder(path, LogConfig(chunk_bytes=1024), clock=clock)
    is_in_trouble = []
    for number, item in enumerate(ITEMS):
        clock.now_s += 0.1
        recorder.put(*item)
        if number == 200:
            harm(path)
        is_in_trouble.append(not recorder.status().ok)
    assert not any(is_in_trouble[:201]) and any(is_in_trouble[201:212])  # the recorder looks once a second
    assert not any(is_in_trouble[225:])  # the next file is written
    final = recorder.close()
    assert final.failures == 1 and "deleted or moved" in final.reason
    assert find_missing_files(final) == (str(path),)
    ending = describe_ending(make_ending(Cause.ENDED_IN_AIR, ""), final)
    assert str(path) in ending.sentence and "lost" not in ending.sentence and ending.exit_code == 1
    later = path.with_name("flight-2.mcap")
    assert find_segments(path) == (later,)
    kept = drop_recorder_notes(list(read(path)))[1:]  # its header is the flight's
    assert kept == ITEMS[-len(kept) :] and len(kept) > 180
    lost = len(ITEMS) - len(kept)
    assert lost <= read_info(path).missing <= lost + 2  # and the recorder's own notes
