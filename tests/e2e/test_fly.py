"""`uavctl fly` as a process, on real sockets, with a vehicle that shares no code with it."""

from __future__ import annotations

import json
import select
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from loopback_rig import make_loop
from operation_rig import end_process
from places import TESTS, without_pages

from logs.recording.reader import read, read_kind
from logs.recording.replay import replay
from uavctl.cli.app import run
from uavctl.config import load_config
from uavctl.config.load import parse
from uavctl.daemon.control_socket import make_daemon_name, open_listener
from uavctl.daemon.lock import find_lock_paths, lock_vehicle
from uavctl.records import ControlMode, Decision, Event, Header, Setpoint, SetpointSource

FALLBACK = (ControlMode.BRAKE, ControlMode.HOLD)
SOURCE = TESTS / "support" / "foreign_source.py"
LIMIT_S = 180.0  # for what is stuck, not for what is slow: a machine may have much else to do


@pytest.fixture
def control() -> Iterator[str]:
    with tempfile.TemporaryDirectory(prefix="uavctl-") as folder:  # short: a socket's path has 107 bytes
        yield folder


def free_port() -> int:
    with socket.socket(type=socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        return int(sock.getsockname()[1])


@contextmanager
def daemon(port: int, out: Path, *options: str) -> Iterator[subprocess.Popen[str]]:
    url = f"udpin://127.0.0.1:{port}"
    command = [sys.executable, "-m", "uavctl", "fly", "--vehicle", url, "--mocap", url, "--out", str(out), "--json"]
    process = subprocess.Popen(
        [*command, *options], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=without_pages()
    )
    with end_process(process):
        assert process.stderr is not None
        for line in process.stderr:
            if "recording to" in line:
                break
        yield process


@contextmanager
def source(port: int) -> Iterator[dict[str, Any]]:
    """What the source saw; it goes on flying as long as the block lasts."""
    target = map(str, load_config("room").target.position_m)
    command = [sys.executable, str(SOURCE), str(port), *target]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            ready, _, _ = select.select([process.stdout], [], [], LIMIT_S)
            assert ready, "the source is not at rest at the target"
            yield json.loads(process.stdout.readline())
        finally:
            process.kill()


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], dict[str, Any], int, Path]:
    """What the source saw, what the daemon summed up, its exit code, and the recording; SIGINT ends it."""
    out = tmp_path_factory.mktemp("flight")
    port = free_port()
    # It holds for as long as the pause lasts, also where the machine makes it longer.
    with (
        daemon(port, out, "--set", "fallback.hold_s=60", "--set", "fallback.blind_hold_s=60") as process,
        source(port) as observed,
    ):
        process.send_signal(signal.SIGINT)
        summary, _ = process.communicate(timeout=LIMIT_S)
        return observed, json.loads(summary), process.returncode, out / "flight.mcap"


Flown = tuple[dict[str, Any], dict[str, Any], int, Path]


@pytest.mark.slow
def test_a_foreign_source_gets_acceleration_setpoints_and_is_flown_to_the_target(flown: Flown) -> None:
    observed, summary, code, _ = flown
    assert (code, summary["ended"]) == (1, "landing has failed")  # the source knows no landing
    assert observed["setpoints"] >= 240  # a source in whose pause none came would never have got to its end
    assert observed["masks"] == [3135]  # acceleration only, vehicles.md
    assert 0.1 < observed["largest_mps2"] <= 2.0 + 1e-6
    assert observed["position_m"] == pytest.approx(load_config("room").target.position_m, abs=0.15)
    assert summary["received"] > 0.5 * observed["poses"] and summary["lost"] is None


@pytest.mark.fault(35)
def test_a_second_daemon_is_refused_before_it_makes_anything(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path, control: str
) -> None:
    monkeypatch.delattr("uavctl.cli.fly.build_flight_design")
    url = f"udpin://127.0.0.1:{free_port()}"
    arguments = ["fly", "--vehicle", url, "--control", control, "--out", str(tmp_path / "flight")]
    with lock_vehicle(url):
        assert run(arguments) == 1
    assert "already flies this vehicle" in " ".join(capsys.readouterr().err.split())
    with open_listener(Path(control), make_daemon_name(load_config("room", [f'daemon.vehicle="{url}"']))):
        assert run(arguments) == 1
    assert "is running" in " ".join(capsys.readouterr().err.split())
    assert not list(tmp_path.rglob("*.mcap")) and not any(lock_path.exists() for lock_path in find_lock_paths(url))


@pytest.mark.slow
def test_a_requested_end_leaves_no_note_for_the_next_daemon(flown: Flown) -> None:
    """The source neither lands nor disarms; yet the next one on this port is flown like any other."""
    url = next(iter(read_kind(flown[3], Header))).command.split("--vehicle ")[1].split()[0]
    assert not any(lock_path.exists() for lock_path in find_lock_paths(url))


def test_age_rises_in_the_pause_fallback_at_h_recovery_after(flown: Flown) -> None:
    """Told by the steps: a machine that stood still leaves some out, and may make more pauses than the source's."""
    every = [d for d in read_kind(flown[3], Decision) if d.boundary and d.age_steps is not None]
    asked = next(i for i, d in enumerate(every) if "operator" in d.reason)
    decisions = [(d, d.age_steps or 0) for d in every[:asked]]
    horizon = load_config("room").smpc.horizon
    for (before, age), (after, later) in pairwise(decisions):
        assert later <= age + after.step - before.step
        if not after.news and before.mode is after.mode is ControlMode.TRACK:
            assert later == age + after.step - before.step
    assert all(age < horizon for d, age in decisions if d.mode is ControlMode.TRACK)
    falls = [i for i, (d, _) in enumerate(decisions) if d.mode in FALLBACK and decisions[i - 1][0].mode not in FALLBACK]
    assert falls and len(falls) == flown[1]["fallbacks"]
    for at in falls:
        assert decisions[at - 1][1] < horizon <= decisions[at][1]
    assert any(d.mode is ControlMode.TRACK and d.news for d, _ in decisions[falls[-1] + 1 :])


def test_the_hand_over_ends_in_zero(flown: Flown) -> None:
    last = [*read_kind(flown[3], Setpoint)][-1]
    assert last.source is SetpointSource.HOLD and last.accel_mps2 == (0.0, 0.0, 0.0)
    assert ControlMode.LAND in [d.mode for d in read_kind(flown[3], Decision)][-200:]


def test_the_recording_replays_identically(flown: Flown) -> None:
    header = next(read_kind(flown[3], Header))
    config = parse(header.config_toml, "recording").config
    result = replay(read(flown[3]), lambda sink: make_loop(config, sink))
    assert result.identical, result.first_difference
    assert result.decisions > 200


@pytest.mark.slow
def test_sigterm_closes_the_recording_even_without_a_vehicle(tmp_path: Path) -> None:
    with daemon(free_port(), tmp_path) as process:
        process.send_signal(signal.SIGTERM)
        process.communicate(timeout=LIMIT_S)
        assert process.returncode == 1  # ran, but flew nothing
    assert [*read_kind(tmp_path / "flight.mcap", Decision)][-1].mode is ControlMode.STOPPED


@pytest.mark.usefixtures("no_page")
def test_a_duration_closes_the_recording_even_without_a_vehicle(tmp_path: Path, control: str) -> None:
    url = f"udpin://127.0.0.1:{free_port()}"
    places = ["--out", str(tmp_path / "flight"), "--control", control]
    assert run(["fly", "--vehicle", url, "--mocap", url, "--duration", "0.2", *places]) == 1  # ran, but flew nothing
    assert [*read_kind(tmp_path / "flight" / "flight.mcap", Decision)][-1].mode is ControlMode.STOPPED


def test_only_the_pilot_engages(flown: Flown) -> None:
    # The table itself is tested in test_mode; here: nobody but the pilot engaged.
    hand_overs = [e.text for e in read_kind(flown[3], Event) if e.code == "hand-over"]
    assert hand_overs[0].startswith("waiting -> engaged")


def test_without_room_on_the_disk_nothing_is_flown(
    tmp_path: Path, control: str, capsys: pytest.CaptureFixture[str]
) -> None:
    url = f"udpin://127.0.0.1:{free_port()}"
    places = ["--out", str(tmp_path / "f"), "--control", control]
    assert run(["fly", "--vehicle", url, "--mocap", url, "--set", f"log.free_bytes={10**15}", *places]) == 1
    output = " ".join(capsys.readouterr().err.split())
    assert "log.free_bytes" in output and "make room" in output
    assert not list(tmp_path.rglob("*.mcap"))


def test_a_port_in_use_is_refused_with_what_to_do(
    tmp_path: Path, control: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with socket.socket(type=socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        url = f"udpin://127.0.0.1:{taken.getsockname()[1]}"
        assert run(["fly", "--vehicle", url, "--out", str(tmp_path), "--control", control]) == 2
    output = capsys.readouterr().err
    assert url in output and "Traceback" not in output
    assert not list(tmp_path.iterdir())
