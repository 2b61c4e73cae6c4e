from __future__ import annotations

from pathlib import Path

import pytest
from mcap.reader import make_reader
from recording_fakes import drop_recorder_notes, flight, record_flight, stored_byte, write_two_segments

from logs.recording.disk import DiskFile
from logs.recording.info import read_info
from logs.recording.notes import RecorderNote
from logs.recording.reader import read, read_kind
from logs.recording.recover import recover
from uavctl.errors import RecordingError


def flip(path: Path, at: int) -> None:
    data = bytearray(path.read_bytes())
    data[at] ^= 0x10
    path.write_bytes(data)


def test_whole_recording_is_copied_without_loss(tmp_path: Path) -> None:
    path, out = tmp_path / "flight.mcap", tmp_path / "out.mcap"
    record_flight(path, 50)
    result = recover(path, out)
    assert result.lossless
    assert (result.messages, result.lost_bytes, result.chunks_bad, result.finished) == (53, 0, 0, True)
    assert list(read(out)) == list(read(path))


def test_segments_become_one_file(tmp_path: Path) -> None:
    path, out = tmp_path / "flight.mcap", tmp_path / "out.mcap"
    write_two_segments(path)
    result = recover(path, out)
    assert result.lossless
    assert drop_recorder_notes(list(read(out))) == flight(100)


@pytest.mark.parametrize("number", [0, 20, 56])
def test_one_bad_chunk_costs_only_its_messages(tmp_path: Path, number: int) -> None:
    path, out = tmp_path / "flight.mcap", tmp_path / "out.mcap"
    items = record_flight(path, 57)
    flip(path, stored_byte(path, b"started_utc" if number == 0 else f"number {number}".encode()))
    result = recover(path, out)
    got = drop_recorder_notes(list(read(out)))
    lost = [item for item in items if item not in got]
    assert got == [item for item in items if item not in lost]
    assert lost == items[items.index(lost[0]) :][: len(lost)]  # neighbours
    assert 0 < result.lost_bytes < 3000
    assert any("cannot be counted" in text for text in result.damage) == (number == 56)
    if number == 56:  # nothing follows that could tell
        assert result.messages_lost == 0
    else:  # a note of the recorder may be among them
        assert result.messages_lost - len(lost) in (0, 1)
    assert result.chunks_bad == 1
    assert not result.lossless
    assert "lost" in list(read_kind(out, RecorderNote))[-1].text
    assert read_info(out).damage == ()


def test_damaged_index_loses_nothing(tmp_path: Path) -> None:
    path, out = tmp_path / "flight.mcap", tmp_path / "out.mcap"
    record_flight(path, 30)
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    second = summary.chunk_indexes[1]
    flip(path, second.chunk_start_offset + second.chunk_length)
    result = recover(path, out)
    assert result.chunks_bad == 1
    assert result.lossless
    assert not any("cannot be counted" in text for text in result.damage)
    assert drop_recorder_notes(list(read(out))) == flight(30)


def test_torn_end_counts_as_loss(tmp_path: Path) -> None:
    path, out = tmp_path / "flight.mcap", tmp_path / "out.mcap"
    record_flight(path, 30)
    data = path.read_bytes()
    path.write_bytes(data[: stored_byte(path, b"number 20")])
    result = recover(path, out)
    assert (result.finished, result.lossless, result.chunks_bad) == (False, False, 1)
    assert 0 < result.lost_bytes < 1100
    assert "cannot be counted" in result.damage[-1]
    got = drop_recorder_notes(list(read(out)))
    assert got == flight(30)[: len(got)]


def test_failure_leaves_nothing_behind(tmp_path: Path) -> None:
    path, out = tmp_path / "flight.mcap", tmp_path / "out.mcap"
    path.write_bytes(b"no recording at all")
    for source in (path, tmp_path / "missing.mcap"):
        with pytest.raises(RecordingError):
            recover(source, out)
        assert not out.exists()
    path.write_bytes(b"")
    with pytest.raises(RecordingError, match="nothing can be restored"):
        recover(path, out)
    assert not out.exists()


def test_target_is_never_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    record_flight(path, 3)
    before = path.read_bytes()
    with pytest.raises(RecordingError, match="never overwritten"):
        recover(path, path)
    assert path.read_bytes() == before
    with pytest.raises(RecordingError, match="choose another place"):
        recover(path, tmp_path / "missing" / "out.mcap")


def test_full_disk_while_restoring(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, out = tmp_path / "flight.mcap", tmp_path / "out.mcap"
    record_flight(path, 3)

    def write(self: DiskFile, data: bytes) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(DiskFile, "write", write)
    with pytest.raises(RecordingError, match=r"No space left on device; .*room"):
        recover(path, out)
    assert not out.exists()
