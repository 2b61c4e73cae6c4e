"""`uavctl check` as it is typed, and the check before arming: bounded, on real sockets and in virtual time."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
from loopback_rig import MemorySink
from patience import LIMIT_S
from transport_rig import IdleConnection

from logs.recording.info import read_info
from logs.recording.parameters import ParameterReader
from logs.recording.recorder import SyncRecorder
from sim.simulation import Peers
from uavctl.check.findings import ItemState, make_item
from uavctl.cli.app import run
from uavctl.cli.check import make_disk_items, record_items, record_parameters, run_preflight
from uavctl.config import load_config
from uavctl.io.base import Connection
from uavctl.records import Checked, Event

# What is rightly found amiss where the machine stood still for a while; how it is judged is in test_check_items.
OF_TIME = frozenset(
    {"vehicle", "position rate", "position age", "longest gap", "position loss", "vehicle clock", "source clock"}
)
NO_REHEARSALS = ("--rehearsals", "0")  # they take seconds, and are tested by themselves


def accept(*names: str) -> list[str]:
    """Options that let items fail, those of time too."""
    return ["--set", f"check.accept={json.dumps(sorted(OF_TIME.union(names)))}"]


def free_port() -> int:
    with socket.socket(type=socket.SOCK_DGRAM) as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


@pytest.fixture(scope="module")
def urls() -> Iterator[list[str]]:
    """Options that name a simulated vehicle on the floor, which runs while the tests of this file do."""
    vehicle, mocap = free_port(), free_port()
    out = [f"udpout://127.0.0.1:{port}" for port in (vehicle, mocap)]
    command = [sys.executable, "-m", "uavctl", "sim", "--vehicle", out[0], "--mocap", out[1], "--duration", "1800"]
    # Many positions: those of a part of a second are enough to judge by.
    lively = ["--set", "link.loss=0.0", "--set", "sim.camera.rate_hz=50.0"]
    process = subprocess.Popen([*command, *lively], stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None and "system_id" in process.stdout.readline()
        yield ["--vehicle", f"udpin://127.0.0.1:{vehicle}", "--mocap", f"udpin://127.0.0.1:{mocap}"]
    finally:
        process.kill()
        process.wait()
        if process.stdout is not None:
            process.stdout.close()


def checked(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, dict[str, Any]]:
    code = run(["check", "--json", "--seconds", "4", "--set", "check.wait_s=5", *NO_REHEARSALS, *arguments])
    out = capsys.readouterr().out
    assert out.count("\n") == 1
    document: dict[str, Any] = json.loads(out)
    return code, document


@pytest.mark.slow
def test_a_right_set_up_is_ready(capsys: pytest.CaptureFixture[str], urls: list[str]) -> None:
    code, document = checked(capsys, *urls, *accept())
    assert (code, document["ok"]) == (0, True), [one for one in document["items"] if not one["ok"]]
    assert all({"name", "ok", "value", "want", "hint"} <= one.keys() for one in document["items"])
    names = {one["name"] for one in document["items"]}
    wanted = {"vehicle", "position rate", "position age", "axes", "vehicle clock", "COM_OBL_RC_ACT", "disk room"}
    assert wanted <= names


@pytest.mark.slow
@pytest.mark.fault(15)
def test_a_wrong_frame_is_not(capsys: pytest.CaptureFixture[str], urls: list[str]) -> None:
    code, document = checked(capsys, *urls, "--set", "frame.convention=enu")
    assert (code, document["ok"]) == (1, False)
    assert {one["name"] for one in document["items"] if not one["ok"]} - OF_TIME == {"axes"}
    code, document = checked(capsys, *urls, "--set", "frame.convention=enu", *accept("axes"))
    assert (code, document["ok"]) == (0, True)


@pytest.mark.slow
def test_people_get_problems_first_and_a_line_for_what_is_good(
    capsys: pytest.CaptureFixture[str], urls: list[str]
) -> None:
    assert run(["check", "--seconds", "4", *urls, *NO_REHEARSALS, "--set", "frame.yaw_deg=90"]) == 1
    blocks = capsys.readouterr().out.split("\n\n")
    assert blocks[0].startswith("check: not ready (")
    states = [block.split()[0] for block in blocks[1:]]
    assert states[0] == "bad" and states[-1] == "good"
    assert states == sorted(states, key=lambda state: {"bad": 0, "good": 2}.get(state, 1))
    assert any(block.startswith("bad") and "axes:" in block for block in blocks)
    assert all(line.split()[0] == "good" for line in blocks[-1].splitlines())
    assert max(len(line) for block in blocks for line in block.splitlines()) <= 80


@pytest.mark.slow
@pytest.mark.fault(15)
def test_fly_does_not_arm_with_a_wrong_frame(urls: list[str], tmp_path: Path) -> None:
    out = tmp_path / "flight"
    options = ["--arm", "--takeoff", "1", "--set", "frame.convention=enu", "--set", "check.seconds=4"]
    command = [sys.executable, "-m", "uavctl", "fly", *urls, "--out", str(out), *options]
    done = subprocess.run(command, capture_output=True, text=True, timeout=3 * LIMIT_S, check=False)
    assert done.returncode == 1
    told = " ".join(done.stderr.split())
    assert "not armed, because the check failed" in told and "axes" in told
    assert not (out / "flight.mcap").exists()


# --- what cannot even be begun ----------------------------------------------------------------


def test_a_url_that_is_none_is_a_usage_error(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["check", "--vehicle", "nowhere"]) == 2
    assert "no known form" in capsys.readouterr().err


def test_a_port_that_cannot_be_opened_is_an_item(capsys: pytest.CaptureFixture[str]) -> None:
    code, document = checked(capsys, "--vehicle", "serial:///dev/uavctl-none:57600")
    (bad,) = [one for one in document["items"] if not one["ok"]]
    assert (code, bad["name"]) == (1, "connections") and "dialout" in bad["hint"]


def test_a_port_that_somebody_else_has_is_an_item(capsys: pytest.CaptureFixture[str]) -> None:
    with socket.socket(type=socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        code, document = checked(capsys, "--vehicle", f"udpin://127.0.0.1:{other.getsockname()[1]}")
    assert code == 1 and [one["name"] for one in document["items"] if not one["ok"]] == ["connections"]


@pytest.mark.parametrize("seconds", ["0", "-1", "1000"])
def test_a_time_that_is_none_is_refused(seconds: str) -> None:
    assert run(["check", "--seconds", seconds]) == 2


@pytest.mark.fault(29)
def test_no_room_and_no_folder_are_items(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    good = make_disk_items(tmp_path / "a" / "b", 1)
    assert [one.state for one in good] == [ItemState.GOOD, ItemState.GOOD]
    assert not (tmp_path / "a").exists()  # nothing is made
    assert make_disk_items(tmp_path, 2**62)[1].state is ItemState.BAD
    (tmp_path / "file").write_text("")
    assert make_disk_items(tmp_path / "file" / "flights", 1)[0].state is ItemState.BAD
    monkeypatch.setattr(os, "access", lambda *_: False)  # root may write anywhere
    assert make_disk_items(tmp_path, 1)[0].state is ItemState.BAD


# --- the runner, in virtual time ----------------------------------------------------------------


class Wire(IdleConnection):
    """A connection to simulated peers in virtual time."""

    def __init__(self, bench: Bench, name: str) -> None:
        super().__init__(name)
        self._bench, self._name = bench, name

    def receive(self, *, read_all: bool = False) -> list[tuple[bytes, int]]:
        taken, self._bench.arrived[self._name] = self._bench.arrived[self._name], []
        return taken

    def send(self, data: bytes) -> None:
        self._bench.peers.receive(self._name, data, self._bench.now_ns)


class Bench:
    """Virtual time."""

    def __init__(self, *overrides: str) -> None:
        self.config = load_config("room-hahn-stursberg", ["link.loss=0.0", *overrides])
        self.now_ns = 1
        self.peers = Peers(self.config, 200_000_000, airborne=False)
        self.arrived: dict[str, list[tuple[bytes, int]]] = {"vehicle": [], "mocap": []}
        self.wires = {name: Wire(self, name) for name in self.arrived}

    def wait(self, connections: Mapping[str, Connection], deadline_ns: int) -> list[str]:
        self.now_ns = max(self.now_ns, deadline_ns)
        if self.now_ns >= self.peers.now_ns:
            for at_ns, link, data in self.peers.advance(self.now_ns):
                self.arrived[link].append((data, at_ns))
        return [name for name, waiting in self.arrived.items() if waiting]

    def run(self, seconds: float, **more: Any) -> dict[str, ItemState]:
        items = run_preflight(self.config, self.wires, seconds, wait_for=self.wait, now=lambda: self.now_ns, **more)
        return {one.name: one.state for one in items}


def test_the_runner_is_bounded_and_answers_the_vehicle() -> None:
    bench = Bench()
    found = bench.run(4.0)
    assert bench.now_ns == pytest.approx(4.2e9, abs=2e8)
    assert ItemState.BAD not in found.values() and len(bench.wires["vehicle"].answered) > 3


def test_it_waits_for_an_estimator_that_is_starting_but_not_for_ever() -> None:
    bench = Bench("sim.autopilot=ardupilot", "check.wait_s=3.0")
    for name, value in {"GPS1_TYPE": 0, "EK3_SRC1_POSXY": 6, "VISO_TYPE": 1}.items():
        bench.peers.autopilot.parameters.set(name, value)
    found = bench.run(2.0)
    assert bench.now_ns == pytest.approx(5.2e9, abs=2e8)
    assert found["own position"] is ItemState.UNDETERMINED


def test_a_stop_and_a_closed_connection_end_it() -> None:
    bench = Bench()
    bench.run(60.0, stop=lambda: bench.now_ns > 1e9)
    assert bench.now_ns < 1.2e9
    for wire in bench.wires.values():
        wire.close()
    begun_ns = bench.now_ns
    bench.run(60.0)
    assert bench.now_ns - begun_ns < 1e9


def test_prompts_are_told_once_each_and_the_guided_check_ends_too() -> None:
    bench, told = Bench("check.wait_s=0.0"), list[str]()
    found = bench.run(2.0, move=True, prompt=told.append)
    assert found["movements"] is ItemState.BAD  # nobody moved it
    assert told[0].startswith("lift the body") and len(told) <= 6
    assert bench.now_ns < 125e9


def test_what_was_found_goes_into_the_recording() -> None:
    memory = MemorySink()
    items = [make_item(each, each, "value", "want", "hint") for each in ItemState]
    record_items(memory, items, 7)
    assert [(one.at_ns, one.name, one.state) for one in memory.of(Checked)] == [(7, each, each) for each in ItemState]
    assert not memory.of(Event)  # a replay compares events, and knows nothing of a check


@pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])
def test_parameters_that_were_told_go_into_the_recording(autopilot: str, tmp_path: Path) -> None:
    bench, told = Bench(f"sim.autopilot={autopilot}"), ParameterReader()
    bench.run(4.0, parameters=told)
    recorder = SyncRecorder(tmp_path / "flight.mcap")
    record_parameters(recorder, told, 7)
    recorder.close()
    held = bench.peers.autopilot.parameters
    found = read_info(tmp_path / "flight.mcap").parameters
    assert len(found) > 5
    assert {name: one.value for name, one in found.items()} == pytest.approx({name: held[name] for name in found})
    assert found == told.parameters()
