from __future__ import annotations

import threading
from pathlib import Path

import msgspec
import pytest
from recording_fakes import Clock, Disk, flight, own

from logs.disk import DiskFile, OutputFile
from logs.reader import read, records
from logs.recorder import BATCH, Recorder, SyncRecorder, portion
from logs.topics import RecorderNote
from uavctl.config.log import LogConfig
from uavctl.data import Datagram, Event, Severity
from uavctl.errors import RecordingError

EVENT = Event(at_ns=1, severity=Severity.INFO, code="x", text="y")


def test_thread_writes_what_was_put_in_order(tmp_path: Path) -> None:
    path = tmp_path / "new" / "flight.mcap"
    recorder = Recorder(path)
    for topic, at_ns, record in flight(500):
        recorder.put(topic, at_ns, record)
    status = recorder.close()
    assert own(list(read(path))) == flight(500)
    assert status == recorder.close()
    assert status.ok
    assert (status.written, status.waiting, status.dropped, status.refused) == (503, 0, 0, 0)
    assert status.bytes < path.stat().st_size  # the index comes on top
    assert status.segments == (str(path),)


def test_name_that_is_taken_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.mcap").touch()
    with pytest.raises(RecordingError, match=r"a\.mcap exists"):
        Recorder(tmp_path / "a.mcap")
    (tmp_path / "b-2.mcap").touch()
    with pytest.raises(RecordingError, match=r"b-2\.mcap exists"):
        SyncRecorder(tmp_path / "b.mcap")
    with pytest.raises(RecordingError, match="choose another folder"):
        SyncRecorder(tmp_path / "a.mcap" / "c.mcap")


def test_disk_has_everything_after_each_second(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    clock = Clock()
    disk = Disk()
    recorder = SyncRecorder(path, open_file=disk.open, clock=clock)
    items = flight(30)
    for topic, at_ns, record in items[:-1]:
        recorder.put(topic, at_ns, record)
    assert own(list(read(path))) == items[:1]  # the header goes out at once
    clock.now_s = 1.0
    before = disk.operations
    recorder.put(*items[-1])
    assert own(list(read(path))) == items
    assert disk.operations == before + 2  # one write, one sync
    assert recorder.status().waiting == 0
    recorder.close()


def test_refused_records_are_counted_and_told(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    recorder = SyncRecorder(path, clock=Clock(0.3))
    raw = Datagram(at_ns=1, link="vehicle", outgoing=False, data=b"")
    recorder.put("/uavctl/nothing", 1, EVENT)
    recorder.put("/uavctl/setpoint", 1, EVENT)
    recorder.put("/raw/vehicle/out", 1, raw)
    recorder.put("/uavctl/event", -1, EVENT)
    recorder.put("/uavctl/event", 2**64, EVENT)
    recorder.put("/uavctl/event", 1, msgspec.structs.replace(EVENT, text="\ud800"))
    recorder.put("/uavctl/event", 2**64 - 1, EVENT)
    recorder.put("/raw/vehicle/in", 5, raw)
    status = recorder.close()
    assert not status.ok
    assert status.refused == 6
    assert "Event" in status.refusal
    assert own(list(read(path))) == [("/uavctl/event", 2**64 - 1, EVENT), ("/raw/vehicle/in", 1, raw)]
    notes = list(records(path, RecorderNote))
    assert notes[-1].refused == 6
    assert any("records lost" in note.text for note in notes)


def test_records_after_the_end_are_dropped(tmp_path: Path) -> None:
    recorder = SyncRecorder(tmp_path / "flight.mcap")
    recorder.put("/uavctl/event", 1, EVENT)
    assert recorder.close().ok
    recorder.put("/uavctl/event", 2, EVENT)
    status = recorder.close()
    assert (status.ok, status.dropped, status.written) == (False, 1, 2)


def test_nothing_put_makes_no_file(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "flight.mcap")
    assert recorder.close().ok
    assert list(tmp_path.iterdir()) == []


def test_close_gives_up_on_a_disk_that_hangs(tmp_path: Path) -> None:
    release = threading.Event()

    def open_file(path: Path) -> OutputFile:
        release.wait()
        return DiskFile(path)

    recorder = Recorder(tmp_path / "flight.mcap", open_file=open_file)
    recorder.put("/uavctl/event", 1, EVENT)
    status = recorder.close(timeout_s=0.05)
    assert (status.ok, status.waiting) == (False, 1)
    release.set()
    assert recorder.close(timeout_s=30.0).ok


def test_status_may_be_asked_while_it_writes(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "flight.mcap", LogConfig(chunk_bytes=1024))
    seen = []
    for topic, at_ns, record in flight(3000):
        recorder.put(topic, at_ns, record)
        seen.append(recorder.status().written)
    assert recorder.close().ok
    assert seen == sorted(seen)


def test_a_backlog_that_a_busy_computer_left_is_written_soon() -> None:
    waiting, rounds = 192, 0
    while waiting > BATCH:
        waiting += 24 - portion(waiting)  # 24 more come in the time of a round, 1200 a second
        rounds += 1
    assert rounds <= 8  # 160 ms
    assert portion(0) == portion(2 * BATCH) == BATCH
    assert portion(1000) == 128  # of more than that a tick would notice
    assert portion(8000) == 1000  # unless the queue gets full
