"""A flight that never begins leaves no folder behind, and takes none that was there before."""

from __future__ import annotations

import resource
import socket
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from logs.recording.ends import create_recording
from uavctl.cli.app import run
from uavctl.config.types import LogConfig
from uavctl.errors import RecordingError

FULL, EMPTY = LogConfig(free_bytes=10**15), LogConfig(free_bytes=0)
EXACT = ("--config", "paper", "--set", "solver.method=exact")


@pytest.fixture
def taken_port() -> Iterator[int]:
    """A port that a viewer cannot be served on."""
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        yield taken.getsockname()[1]


@pytest.fixture
def short_folder() -> Iterator[str]:
    """A socket's path has 107 bytes."""
    with tempfile.TemporaryDirectory(prefix="uavctl-") as folder:
        yield folder


def free_port() -> int:
    with socket.socket(type=socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


@pytest.mark.parametrize("command", ["loopback", "fly"])
def test_a_taken_port_of_the_live_view_leaves_no_folder(
    command: str,
    taken_port: int,
    short_folder: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("UAVCTL_CONTROL", short_folder)
    options = ("--udp",) if command == "loopback" else ("--vehicle", f"udpin://127.0.0.1:{free_port()}")
    out = tmp_path / "flights" / "one"
    assert run([command, *options, *EXACT, "--live", "--live-port", str(taken_port), "--out", str(out)]) == 2
    assert f"port {taken_port} cannot be used" in capsys.readouterr().err
    assert not (tmp_path / "flights").exists()


def test_a_height_that_is_outside_the_limits_leaves_no_folder(tmp_path: Path) -> None:
    out = tmp_path / "flights" / "one"
    assert run(["loopback", "--config", "room", "--arm", "--takeoff", "99", "--out", str(out)]) == 2
    assert not (tmp_path / "flights").exists()


def test_a_full_disk_leaves_no_folder(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"log\.free_bytes"), create_recording(tmp_path / "a", "room", FULL):
        pass
    assert list(tmp_path.iterdir()) == []


@pytest.mark.fault(29)
def test_files_that_may_not_grow_enough_begin_no_recording(tmp_path: Path) -> None:
    _, hard = limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    log = LogConfig(segment_bytes=1_000_000, free_bytes=0)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (1_000_000, hard))
        with pytest.raises(RecordingError, match=r"log\.segment_bytes"), create_recording(tmp_path / "a", "room", log):
            pass
        resource.setrlimit(resource.RLIMIT_FSIZE, (1_500_000, hard))
        with create_recording(tmp_path / "a", "room", log) as path:
            assert path.parent == tmp_path / "a"
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_was_there_stays(taken_port: int, tmp_path: Path) -> None:
    out = tmp_path / "mine"
    out.mkdir()
    assert run(["loopback", "--udp", *EXACT, "--live", "--live-port", str(taken_port), "--out", str(out)]) == 2
    assert list(out.iterdir()) == []


def test_a_recording_that_was_begun_stays(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt), create_recording(tmp_path / "a" / "b", "room", EMPTY) as path:
        path.write_bytes(b"the first records")
        raise KeyboardInterrupt
    assert path.read_bytes() == b"the first records"


def test_of_nested_folders_only_those_made_and_empty_go(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt), create_recording(tmp_path / "a" / "b", "room", EMPTY):
        (tmp_path / "a" / "another").mkdir()
        raise KeyboardInterrupt
    assert [one.name for one in (tmp_path / "a").iterdir()] == ["another"]
