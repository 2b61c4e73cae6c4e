"""Systems without POSIX: recordings, virtual time and the Python API work; flights in real time are refused."""

from __future__ import annotations

import fcntl
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from places import ROOT

import uavctl
from uavctl.operating_system import check_flight_platform, count_processors, find_missing_features, lock_file


@pytest.fixture(scope="module")
def other(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What a process printed from which the names of POSIX were taken away."""
    script = ROOT / "tests" / "support" / "other_system.py"
    folder = tmp_path_factory.mktemp("other")
    done = subprocess.run(
        [sys.executable, script, folder],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    document: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return document


@pytest.mark.slow
def test_every_module_is_imported_without_posix(other: dict[str, Any]) -> None:
    assert other["errors"] == {}


@pytest.mark.slow
def test_a_flight_in_virtual_time_is_the_same_without_posix(other: dict[str, Any], tmp_path: Path) -> None:
    room = uavctl.load("room", link={"loss": 0.3})
    flight = uavctl.fly(room, tmp_path, seed=7, duration_s=4)
    assert other["position_m"] == flight.position_m.tolist()
    assert other["rows"] == len(flight.recording.pandas("/uavctl/decision"))
    assert other["is_page"]


@pytest.mark.slow
def test_runs_of_a_campaign_are_the_same_without_posix(other: dict[str, Any]) -> None:
    runs = uavctl.simulate(uavctl.load("room", link={"loss": 0.3}), "smpc", runs=2, seed=1, steps=10)
    assert other["states"] == runs.states.tolist()


@pytest.mark.slow
def test_the_doctor_names_what_is_missing_without_posix(other: dict[str, Any]) -> None:
    items = {item["name"]: item for item in other["doctor"]["items"]}
    assert not other["doctor"]["ok"]
    assert items["system"]["state"] == "bad"
    assert "fcntl.flock" in items["system"]["value"]
    assert "scheduling" not in items


@pytest.mark.slow
def test_commands_of_recordings_and_of_virtual_time_work_without_posix(other: dict[str, Any]) -> None:
    assert set(other["commands"].values()) == {0}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["fly", "loopback", "ctl"])
def test_a_flight_in_real_time_is_refused_without_posix(name: str, other: dict[str, Any]) -> None:
    error = other["refused"][name]
    assert (error["type"], error["exit_code"]) == ("PlatformError", 2)
    assert "fcntl.flock" in error["message"]


def test_this_system_flies() -> None:
    assert find_missing_features() == ()
    check_flight_platform()


def test_a_locked_file_cannot_be_locked_again(tmp_path: Path) -> None:
    with (tmp_path / "lock").open("w") as one, (tmp_path / "lock").open("w") as two:
        lock_file(one.fileno())
        with pytest.raises(BlockingIOError):
            lock_file(two.fileno())
        one.close()
        lock_file(two.fileno())
        fcntl.flock(two, fcntl.LOCK_UN)


def test_processors_are_those_that_the_process_may_use() -> None:
    allowed = os.sched_getaffinity(0)
    try:
        os.sched_setaffinity(0, {min(allowed)})
        assert count_processors() == 1
    finally:
        os.sched_setaffinity(0, allowed)
    assert count_processors() == len(allowed)
