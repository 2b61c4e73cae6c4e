"""`--arm`, `--takeoff`, `--goto` as people type them: what is refused before anything is sent, and the exit codes."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from logs.recording.reader import read_kind
from uavctl.cli.app import run
from uavctl.records import Event

pytestmark = pytest.mark.usefixtures("no_page")
FLOOR = ["--set", "sim.start_position_m=[0.0,0.0,-0.7]"]


def run_loopback(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str, str]:
    code = run(list(arguments))
    out, err = capsys.readouterr()
    return code, out, " ".join(err.split())


@pytest.mark.fault(33)
@pytest.mark.parametrize("command", ["fly", "loopback"])
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--arm"], "--arm needs --takeoff"),
        (["--takeoff", "1.2"], "--takeoff needs --arm"),
        (["--arm", "--takeoff", "-1"], "takeoff"),
        (["--goto", "1,2"], "--goto 1,2: give north, east and down"),
        (["--goto", "1,2,up"], "give north, east and down"),
        (["--goto", "1,2,nan"], "give north, east and down"),
        (["--goto", "9,0,-1"], "north 9 m is outside"),
        # In the room, but nearer to its ceiling than a plan may rest.
        (["--goto", "0,0,-2.499"], "goto: down -2.499 m is outside"),
        (["--arm", "--takeoff", "2.499"], "may not rest"),
        (["--config", "paper", "--arm", "--takeoff", "1"], "no vertical axis"),
    ],
)
def test_what_cannot_be_is_refused_before_anything_is_made_or_sent(
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    command: str,
    arguments: list[str],
    message: str,
) -> None:
    monkeypatch.delattr("uavctl.wiring.controller.build_solver")
    code, out, err = run_loopback(capsys, command, *arguments, "--out", str(tmp_path / "flight"))
    assert code == 2 and message in err and not out
    assert not list(tmp_path.rglob("*.mcap"))


@pytest.mark.slow
def test_a_flight_from_the_ground_to_a_place_and_back(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    arguments = [
        "--arm",
        "--takeoff",
        "1.2",
        "--goto",
        "1.5,1,-1.2",
        "--duration",
        "12",
        "--json",
        "--out",
        str(tmp_path),
    ]
    code, out, err = run_loopback(capsys, "loopback", *arguments, *FLOOR)
    assert code == 0, err
    assert json.loads(out)["steps"] > 30
    texts = [event.text for event in read_kind(tmp_path / "flight.mcap", Event) if event.code == "hand-over"]
    assert texts[-1].startswith("settling -> done")
    code, out, _ = run_loopback(capsys, "log", "replay", str(tmp_path / "flight.mcap"), "--json")
    assert code == 0 and json.loads(out)["identical"]


def test_an_unreached_target_has_its_exit_code(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    code, _, err = run_loopback(capsys, "loopback", "--goto=-1,-1,-1", "--duration", "1", "--out", str(tmp_path))
    assert code == 1 and "--goto -1,-1,-1 was not reached" in err


@pytest.mark.fault(26)
def test_a_refused_take_off_is_reported_with_the_vehicle_s_reason(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    poor = ["--set", "sim.plant=quadrotor", "--set", "sim.quadrotor.charge=0.1", "--set", "hand_over.ground_s=4"]
    arguments = ["--arm", "--takeoff", "1.2", "--duration", "20", "--out", str(tmp_path), *poor, *FLOOR]
    code, _, err = run_loopback(capsys, "loopback", *arguments)
    assert code == 1 and "low battery" in err and "TEMPORARILY_REJECTED" in err


@pytest.mark.slow
def test_the_same_way_over_real_sockets(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    arguments = ["--udp", "--arm", "--takeoff", "1", "--goto", "0.3,0.3,-1", "--duration", "9", "--out", str(tmp_path)]
    code, _, err = run_loopback(capsys, "loopback", *arguments, *FLOOR)
    assert code == 0, err
    texts = [event.text for event in read_kind(tmp_path / "flight.mcap", Event) if event.code == "hand-over"]
    assert texts[-1].startswith("settling -> done")
