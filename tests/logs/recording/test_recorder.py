from __future__ import annotations

import threading
from pathlib import Path

import msgspec
import pytest
from patience import wait_until
from recording_fakes import Clock, Disk, drop_recorder_notes, flight, round_records
from view_rig import fly_view

import logs.recording.recorder as recorder_module
from logs.recording.disk import DiskFile, OutputFile
from logs.recording.file_scan import EndOfFile, RecordedMessage, scan_file
from logs.recording.notes import RecorderNote
from logs.recording.reader import find_segments, read, read_kind
from logs.recording.recorder import DerivedTopics, Recorder, SyncRecorder, WriteQueue
from logs.recording.topics import is_view
from logs.recording.views import ViewBuilder
from uavctl.config.types import LogConfig
from uavctl.errors import RecordingError
from uavctl.records import Datagram, Event, Severity

EVENT = Event(at_ns=1, severity=Severity.INFO, code="x", text="y")


def test_thread_writes_what_was_put_in_order(tmp_path: Path) -> None:
    path = tmp_path / "new" / "flight.mcap"
    recorder = Recorder(path)
    for topic, at_ns, record in flight(500):
        recorder.put(topic, at_ns, record)
    status = recorder.close()
    assert drop_recorder_notes(list(read(path))) == flight(500)
    assert status == recorder.close()
    assert status.ok
    assert (status.written, status.waiting, status.dropped, status.refused) == (503, 0, 0, 0)
    assert status.bytes < path.stat().st_size  # the index comes on top
    assert status.segments == (str(path),)


def test_the_thread_catches_up_when_it_is_asked_to(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Right after a tick, so that its rounds are over when the next one begins; of itself it looks far more rarely."""
    monkeypatch.setattr(recorder_module, "POLL_S", 1e6)
    recorder = Recorder(tmp_path / "flight.mcap")
    for count, (topic, at_ns, record) in enumerate(flight(5), start=1):
        recorder.put(topic, at_ns, record)
        recorder.catch_up()
        wait_until(lambda: not recorder._queue, f"record {count} is taken")
    assert recorder.close().written == 5 + 3  # its notes


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
    assert drop_recorder_notes(list(read(path))) == items[:1]  # the header goes out at once
    clock.now_s = 1.0
    before = disk.operations
    recorder.put(*items[-1])
    assert drop_recorder_notes(list(read(path))) == items
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
    assert drop_recorder_notes(list(read(path))) == [("/uavctl/event", 2**64 - 1, EVENT), ("/raw/vehicle/in", 1, raw)]
    notes = list(read_kind(path, RecorderNote))
    assert notes[-1].refused == 6
    assert any("records lost" in note.text for note in notes)


@pytest.mark.parametrize("kind", [Recorder, SyncRecorder])
def test_records_after_the_end_are_dropped(tmp_path: Path, kind: type[Recorder | SyncRecorder]) -> None:
    recorder = kind(tmp_path / "flight.mcap")
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


@pytest.mark.fault(53)
def test_the_first_drop_is_noted_before_what_was_put_after_it(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    items = flight(100)
    log = LogConfig(chunk_bytes=1024)
    journal = WriteQueue(path, log, DiskFile, lambda _: None, Clock(), DerivedTopics())
    journal.queue.extend(items[:50])
    journal.drain(1)
    journal.drop()  # item 50
    journal.drain(10)
    journal.queue.extend(items[51:])
    journal.drain(100)
    found = [record for _, _, record in read(path)]  # as after a kill
    dropped = [number for number, one in enumerate(found) if isinstance(one, RecorderNote) and one.dropped == 1]
    assert len(dropped) == 1 and items[49][2] in found[dropped[0] :] and items[51][2] in found[dropped[0] :]


@pytest.mark.fault(29)
def test_29_disk_full_at_every_operation_of_the_writing_thread_loses_neither_records_nor_views(tmp_path: Path) -> None:
    items = fly_view().entries[:60]
    views: list[bytes] = []
    number = 0
    while True:
        path = tmp_path / f"at{number}" / "flight.mcap"
        disk = Disk({number - 1}.__contains__)  # none first, to know the views
        recorder = Recorder(
            path,
            LogConfig(chunk_bytes=4096),
            open_file=disk.open,
            clock=Clock(0.01),
            derived_topics=DerivedTopics(ViewBuilder()),
        )
        for item in items:
            recorder.put(*item)
        status = recorder.close(timeout_s=30.0)
        if 0 < disk.operations < number:
            break
        assert status.ok and drop_recorder_notes(list(read(path))) == round_records(items), number
        messages = [one for file in find_segments(path) for one in scan_file(file) if isinstance(one, RecordedMessage)]
        shown = [one.data for one in messages if is_view(one.definition.topic)]
        views = views or shown
        assert shown == views and len(views) > len(items) // 2, number
        assert len(find_segments(path)) <= 1 + status.failures
        number += 1
    assert number > 20


@pytest.mark.fault(87)
@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
@pytest.mark.parametrize("has_ticks", [True, False])
def test_a_thread_that_dies_costs_no_record(has_ticks: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, items, dead = tmp_path / "flight.mcap", flight(200), threading.Event()
    plain = WriteQueue.drain

    def drain(queue: WriteQueue, records: int) -> None:
        if not dead.is_set():
            dead.set()
            raise SystemExit
        plain(queue, records)

    monkeypatch.setattr(WriteQueue, "drain", drain)
    recorder = Recorder(path)
    threads = [thread for thread in threading.enumerate() if thread.name == "recorder"]
    assert dead.wait(10.0)
    for thread in threads:
        thread.join(10.0)
    for item in items:
        recorder.put(*item)
        if has_ticks:
            recorder.catch_up()
    status = recorder.close()
    assert status.ok and status.waiting == 0
    assert drop_recorder_notes(list(read(path))) == round_records(items)
    assert [one.finished for one in scan_file(path) if isinstance(one, EndOfFile)] == [True]
