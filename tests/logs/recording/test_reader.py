from __future__ import annotations

from pathlib import Path

import pytest
from recording_fakes import (
    HEADER,
    Clock,
    Disk,
    Item,
    drop_recorder_notes,
    flight,
    record_flight,
    stored_byte,
    write_two_segments,
)

from logs.recording.disk import DiskFile
from logs.recording.reader import find_segments, read, read_header, read_kind
from logs.recording.recorder import SyncRecorder
from logs.recording.segment import QueuedMessage, Segment
from logs.recording.topics import encode, get_definition
from uavctl.config.types import LogConfig
from uavctl.errors import RecordingError
from uavctl.records import Datagram, Event, Record, Setpoint, Severity


def test_records_of_one_type(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    items = record_flight(path, 50)
    for kind in (Datagram, Setpoint, Event, Record):
        wanted = [record for _, _, record in items if isinstance(record, kind)]
        got = [record for record in read_kind(path, kind) if type(record).__name__ != "RecorderNote"]
        assert got == wanted
    assert read_header(path) == HEADER


@pytest.mark.parametrize("name", ["missing.mcap", "text.mcap"])
def test_no_recording(tmp_path: Path, name: str) -> None:
    (tmp_path / "text.mcap").write_text("name = 'room'\n" * 100)
    with pytest.raises(RecordingError, match=name):
        list(read(tmp_path / name))
    with pytest.raises(RecordingError):
        list(read(tmp_path))


def test_recording_without_header_says_so(tmp_path: Path) -> None:
    path = tmp_path / "empty.mcap"
    path.touch()
    assert list(read(path)) == []
    with pytest.raises(RecordingError, match="no header"):
        read_header(path)


@pytest.mark.slow
def test_cut_anywhere_it_reads_to_the_last_whole_chunk(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    items = record_flight(path, 20)
    data = path.read_bytes()
    cut = tmp_path / "cut.mcap"
    counts = []
    for size in range(len(data)):
        cut.write_bytes(data[:size])
        got = drop_recorder_notes(list(read(cut)))
        assert got == items[: len(got)]
        counts.append(len(got))
    assert counts == sorted(counts)
    assert counts[-1] == len(items)
    assert len(set(counts)) > 4


def test_segments_read_as_one(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    write_two_segments(path)
    assert [file.name for file in find_segments(path)] == ["flight.mcap", "flight-2.mcap"]
    assert drop_recorder_notes(list(read(path))) == flight(100)
    # the second alone has the header too
    assert read_header(tmp_path / "flight-2.mcap") == HEADER


def test_missing_segment_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    disk = Disk(lambda number: number in (6, 30))
    clock = Clock()
    recorder = SyncRecorder(path, LogConfig(chunk_bytes=1024), open_file=disk.open, clock=clock)
    for topic, at_ns, record in flight(200):
        clock.now_s += 0.1
        recorder.put(topic, at_ns, record)
    recorder.close()
    assert drop_recorder_notes(list(read(path))) == flight(200)
    (tmp_path / "flight-2.mcap").unlink()
    with pytest.raises(RecordingError, match="is a segment file gone"):
        list(read(path))


@pytest.mark.parametrize("lacks", ["/view/estimate", "/uavctl/event"])
def test_a_missing_message_is_noticed_also_one_for_viewers(lacks: str, tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    event = encode(Event(at_ns=7, severity=Severity.INFO, code="code", text="text"))
    messages = [
        QueuedMessage(get_definition(topic), 1 + n, n, event)
        for n, topic in enumerate(["/uavctl/event", "/view/estimate"] * 9)
    ]
    at = next(n for n, one in enumerate(messages) if n > 5 and one.definition.topic == lacks)
    for entries, good in ((messages, True), (messages[:at] + messages[at + 1 :], False)):
        path.unlink(missing_ok=True)
        segment = Segment(DiskFile(path), chunk_bytes=512)
        for entry in entries:
            segment.add(entry)
        segment.finish()
        if good:
            assert [topic for topic, _, _ in read(path)] == ["/uavctl/event"] * 9
        else:
            got: list[Item] = []
            with pytest.raises(RecordingError, match=f"message {at + 2} where {at + 1} should be"):
                got.extend(read(path))
            assert len(got) == sum(one.definition.topic == "/uavctl/event" for one in entries[:at])


def test_other_recording_with_such_a_name_is_not_taken_in(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    items = record_flight(path, 10)
    record_flight(tmp_path / "flight-2.mcap", 20)
    assert find_segments(path) == (path,)
    assert drop_recorder_notes(list(read(path))) == items


def test_damaged_chunk_is_named_and_refused(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    record_flight(path, 60)
    data = bytearray(path.read_bytes())
    at = stored_byte(path, b"number 29")
    data[at] ^= 1
    path.write_bytes(data)
    got: list[Item] = []
    with pytest.raises(RecordingError, match=r"flight\.mcap, offset \d+: .*checksum.*uavctl log recover") as caught:
        got.extend(read(path))
        pytest.fail("not refused")
    start = int(str(caught.value).split("offset ")[1].split(":")[0])
    assert data[start] == 6
    assert start < at < start + 9 + int.from_bytes(data[start + 1 : start + 9], "little")
