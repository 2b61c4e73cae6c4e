"""No command puts anything else where a recording is."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from loopback_rig import lockstep

from logs.recording.file_kind import MAGIC
from logs.recording.output_files import refuse_recording_path
from logs.recording.reader import explain_missing_end
from logs.recording.recorder import SyncRecorder
from uavctl.cli.app import run
from uavctl.errors import RecordingError, UsageError


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("spared") / "flight.mcap"
    recorder = SyncRecorder(path)
    for entry in lockstep("room-hahn-stursberg", 2.0, "solver.method=exact").entries:
        recorder.put(*entry)
    assert recorder.close().ok
    return path


@pytest.mark.parametrize(
    "words",
    [
        ("report", "FLIGHT", "--out", "FLIGHT"),
        ("report", "FLIGHT", "--svg", "FLIGHT"),
        ("export", "FLIGHT", "--to", "tlog", "--force", "--out", "FLIGHT"),
        ("compare", "FLIGHT", "FLIGHT", "--out", "FLIGHT"),
    ],
)
def test_a_slip_does_not_cost_the_flight(
    words: tuple[str, ...], recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flight = Path(shutil.copy(recorded, tmp_path / "flight.mcap"))
    before = flight.read_bytes()
    assert run(["log", *(str(flight) if word == "FLIGHT" else word for word in words)]) == 2
    assert "would be lost" in capsys.readouterr().err
    assert flight.read_bytes() == before


def test_a_recording_of_any_name_is_known_by_its_first_bytes(tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    refuse_recording_path(page)
    page.write_text("<p>an old page", encoding="utf-8")
    refuse_recording_path(page)
    page.write_bytes(MAGIC + b"rest")
    with pytest.raises(UsageError, match="would be lost"):
        refuse_recording_path(page)


def test_a_file_is_finished_with_its_whole_index_only(recorded: Path, tmp_path: Path) -> None:
    data = recorded.read_bytes()
    assert not explain_missing_end(recorded)
    cut = tmp_path / "cut.mcap"
    for size in (0, 5, len(data) // 2, len(data) - 30, len(data) - 1):
        cut.write_bytes(data[:size])
        assert explain_missing_end(cut), size
    with pytest.raises(RecordingError, match="no such recording"):
        explain_missing_end(tmp_path / "missing.mcap")
