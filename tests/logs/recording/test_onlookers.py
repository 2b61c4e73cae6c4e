"""Messages for viewers beside the records: they cost the records nothing, whatever happens to them."""

from __future__ import annotations

from pathlib import Path

import pytest
from recording_fakes import Clock, Disk, drop_recorder_notes, flight, round_records
from view_rig import fly_view, record

from logs.recording.derived_topics import VIEWS
from logs.recording.file_scan import RecordedMessage, scan_file
from logs.recording.info import read_info
from logs.recording.notes import RecorderNote
from logs.recording.reader import find_segments, read, read_kind
from logs.recording.recorder import DerivedTopics, Recorder, SyncRecorder
from logs.recording.recover import recover
from logs.recording.segment import QueuedMessage, Segment
from logs.recording.topics import is_view
from logs.recording.views import ViewBuilder
from uavctl.config.types import LogConfig
from uavctl.records import Estimate, Record


def test_the_records_read_back_as_if_there_were_no_views(tmp_path: Path) -> None:
    path = record(tmp_path / "flight.mcap")
    assert drop_recorder_notes(list(read(path))) == round_records(fly_view().entries)
    found = read_info(path)
    assert found.finished and not found.missing and not found.refused
    assert sum(is_view(one.topic) for one in found.topics) == len(VIEWS)


def test_a_disk_full_at_every_operation_loses_neither_records_nor_views(tmp_path: Path) -> None:
    items = fly_view().entries[:60]
    whole = tmp_path / "whole.mcap"
    recorder = SyncRecorder(whole, derived_topics=DerivedTopics(ViewBuilder()))
    for item in items:
        recorder.put(*item)
    recorder.close()
    want = [m.data for m in scan_file(whole) if isinstance(m, RecordedMessage) and is_view(m.definition.topic)]
    number = 0
    while True:
        path = tmp_path / f"at{number}" / "flight.mcap"
        clock, disk = Clock(), Disk({number}.__contains__)
        recorder = SyncRecorder(
            path,
            LogConfig(chunk_bytes=4096),
            open_file=disk.open,
            clock=clock,
            derived_topics=DerivedTopics(ViewBuilder()),
        )
        for item in items:
            clock.now_s += 0.1
            recorder.put(*item)
        status = recorder.close()
        if disk.operations <= number:
            break
        assert status.ok and drop_recorder_notes(list(read(path))) == round_records(items), number
        messages = [m for file in find_segments(path) for m in scan_file(file) if isinstance(m, RecordedMessage)]
        assert [m.data for m in messages if is_view(m.definition.topic)] == want
        number += 1
    assert number > 20


def test_a_torn_file_is_recovered_with_its_views(tmp_path: Path) -> None:
    path = record(tmp_path / "flight.mcap")
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    recover(cut, tmp_path / "again.mcap")
    views = {one.topic for one in read_info(tmp_path / "again.mcap").topics if is_view(one.topic)}
    assert len(views) > len(VIEWS) - 3
    kept = drop_recorder_notes(list(read(tmp_path / "again.mcap")))
    assert kept == round_records(fly_view().entries[: len(kept)]) and len(kept) > 100


def test_what_has_no_view_is_recorded_and_counted(tmp_path: Path) -> None:
    # This header's design lacks what a view needs.
    recorder = SyncRecorder(tmp_path / "flight.mcap", derived_topics=DerivedTopics(ViewBuilder()))
    for item in flight(30):
        recorder.put(*item)
    status = recorder.close()
    assert (status.ok, status.unseen, status.refused) == (True, 1, 0)
    assert drop_recorder_notes(list(read(tmp_path / "flight.mcap"))) == flight(30)
    last = [*read_kind(tmp_path / "flight.mcap", RecorderNote)][-1]
    assert last.text.startswith("end; 1 without views: Header: the header's design cannot be used")


@pytest.mark.parametrize("error", [ValueError, TypeError, IndexError, ZeroDivisionError])
def test_a_view_that_fails_once_is_there_again_with_the_next_record(tmp_path: Path, error: type[Exception]) -> None:
    class Failing(ViewBuilder):
        def derive(self, at_ns: int, record: Record) -> list[tuple[str, bytes]]:
            if isinstance(record, Estimate) and record.at_ns == fly_view().of(Estimate)[5].at_ns:
                raise error("no")
            return super().derive(at_ns, record)

    recorder = Recorder(tmp_path / "flight.mcap", derived_topics=DerivedTopics(Failing()))
    for item in fly_view().entries:
        recorder.put(*item)
    status = recorder.close()
    assert (status.ok, status.unseen) == (True, 1)
    counts = {one.topic: one.messages for one in read_info(tmp_path / "flight.mcap").topics}
    assert counts["/view/estimate"] == counts["/uavctl/estimate"] - 1


def test_who_watches_sees_each_message_once_in_order(tmp_path: Path) -> None:
    seen: list[tuple[str, int, bytes]] = []

    def watch(topic: str, at_ns: int, data: bytes) -> None:
        seen.append((topic, at_ns, data))

    path = tmp_path / "flight.mcap"
    recorder = SyncRecorder(path, derived_topics=DerivedTopics(ViewBuilder(), watch))
    for item in fly_view().entries:
        recorder.put(*item)
    recorder.close()
    written = [(m.definition.topic, m.at_ns, m.data) for m in scan_file(path) if isinstance(m, RecordedMessage)]
    unnoted = [one for one in written if one[0] != "/uavctl/recorder"]
    assert seen == unnoted


@pytest.mark.fault(87)
def test_87_a_viewer_that_fails_costs_no_record(tmp_path: Path) -> None:
    path, items = tmp_path / "flight.mcap", fly_view().entries[:120]

    def fail(*arguments: object) -> None:
        raise MemoryError

    recorder = Recorder(path, derived_topics=DerivedTopics(ViewBuilder(), fail))
    for item in items:
        recorder.put(*item)
    status = recorder.close()
    assert status.ok and status.unseen == len(items)
    assert drop_recorder_notes(list(read(path))) == round_records(items)


@pytest.mark.fault(87)
def test_87_a_writing_thread_without_memory_for_a_moment_goes_on_and_counts_what_is_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, items = tmp_path / "flight.mcap", flight(60)
    plain, calls = Segment.add, 0

    def add(segment: Segment, entry: QueuedMessage) -> None:
        nonlocal calls
        calls += 1
        if calls == 20:
            raise MemoryError
        plain(segment, entry)

    monkeypatch.setattr(Segment, "add", add)
    recorder = Recorder(path)
    for item in items:
        recorder.put(*item)
    status = recorder.close()
    assert not status.ok and status.dropped == 1
    kept = drop_recorder_notes(list(read(path)))
    assert len(kept) == len(items) - 1 and all(item in items for item in kept)
