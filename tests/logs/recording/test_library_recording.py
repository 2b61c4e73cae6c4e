"""Recordings of version 0.1 and 0.2 that were flown with a policy library: they read, and are decided anew only."""

from __future__ import annotations

import json
import lzma
from pathlib import Path
from typing import Any

import pytest
from places import DATA
from recording_fakes import flight

from logs.recording.info import read_info
from logs.recording.reader import read, read_kind
from logs.recording.recorder import SyncRecorder
from uavctl.cli.app import run
from uavctl.records import Header, Plan, PolicyLibrary


@pytest.fixture(scope="module")
def old(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A flight of version 0.1 in preset `room-hahn-stursberg`."""
    path = tmp_path_factory.mktemp("old") / "flight.mcap"
    path.write_bytes(lzma.decompress((DATA / "policy-library.mcap.xz").read_bytes()))
    return path


def document(capsys: pytest.CaptureFixture[str], *arguments: str, code: int = 0) -> dict[str, Any]:
    assert run([*arguments, "--json"]) == code
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def test_it_reads_and_says_which_library_it_carries(old: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (header,), (carried,) = list(read_kind(old, Header)), list(read_kind(old, PolicyLibrary))
    assert header.library_id == carried.library_id
    found = document(capsys, "log", "info", str(old))
    assert found["library"] == {"library_id": carried.library_id, "bytes": len(carried.data)}
    assert found["origin"]["library_id"] == carried.library_id
    assert "mixture" in {plan.method for plan in read_kind(old, Plan)}
    both = document(capsys, "log", "compare", str(old), str(old))
    assert not both["parameters"]


def test_a_replay_names_the_version_that_can(old: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["log", "replay", str(old)]) == 1
    told = capsys.readouterr().err
    assert "policy library" in told and "uavctl 0.2.0, commit" in told and "solver.method=exact" in told


@pytest.mark.slow
def test_with_the_exact_program_it_is_decided_anew(old: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The first plans that differ do so by no more than the library's certified gap let them."""
    found = document(capsys, "log", "replay", str(old), "--set", "solver.method=exact", code=1)
    assert found["decisions"] > 200 and not found["identical"]
    assert found["first_difference"]["topic"] == "/uavctl/plan"
    assert found["context"]["records_before"] > 0


def test_a_flight_of_today_carries_none(tmp_path: Path) -> None:
    recorder = SyncRecorder(tmp_path / "flight.mcap")
    for item in flight(5):
        recorder.put(*item)
    assert recorder.close().ok
    assert read_info(tmp_path / "flight.mcap").library is None
    assert not any(isinstance(record, PolicyLibrary) for _, _, record in read(tmp_path / "flight.mcap"))
