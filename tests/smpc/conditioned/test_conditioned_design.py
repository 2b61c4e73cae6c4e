"""Scheme `age-conditioned` without a design of the other scheme: id, figures and start, from flight to replay."""

from __future__ import annotations

import json
from pathlib import Path

import msgspec
import numpy as np
import pytest
from loopback_rig import lockstep
from msgspec.structs import replace

from logs.recording.design_view import read_design
from logs.recording.reader import read, read_header
from logs.recording.recorder import SyncRecorder
from uavctl.cli.app import run as main
from uavctl.cli.flight_risk import compute_flight_risk
from uavctl.config import dump_config, load_config
from uavctl.config.types import ScheduleConfig, SmpcConfig
from uavctl.records import ControlMode, Decision, Header, Plan, SolveStatus, Truth
from uavctl.smpc.conditioned.planner import METHOD
from uavctl.wiring.controller import (
    build_conditioned,
    build_flight_design,
    compute_reference_limits,
    make_design_record,
)

SCHEME = "smpc.scheme=age-conditioned"
FLOWN = ("loopback", "--config", "room-hahn-stursberg", "--set", SCHEME)
QUICK = [SCHEME, "plant.dt_s=0.05", "daemon.tick_s=0.01", "source.rate_hz=50", "sim.camera.rate_hz=50"]


@pytest.fixture
def _no_other_design(monkeypatch: pytest.MonkeyPatch) -> None:
    """Making a design of scheme `hahn-stursberg` fails."""

    def refuse(*_: object) -> None:
        raise AssertionError("nothing of scheme `age-conditioned` asks for this")

    for name in ("design.make_design", "design.design_record", "design.assemble_design", "exact.check_schedule"):
        monkeypatch.setattr(f"uavctl.smpc.hahn_stursberg.{name}", refuse)
    monkeypatch.setattr("uavctl.smpc.hahn_stursberg.late.add_late_designs", refuse)
    monkeypatch.setattr("uavctl.wiring.controller.build_reference_limits", refuse)


def quick(folder: Path) -> str:
    """A file with 48 steps of 0.05 s, and none of the keys that the other scheme alone asks for."""
    config = load_config("room-hahn-stursberg", QUICK)
    smpc = SmpcConfig(scheme="age-conditioned", horizon=48, delta_x=0.95, slack_linear=1e5, slack_quadratic=1e3)
    file = folder / "quick.toml"
    file.write_text(dump_config(replace(config, smpc=smpc, schedule=ScheduleConfig())), encoding="utf-8")
    assert "k_tau" not in file.read_text(encoding="utf-8")
    return str(file)


def test_a_plant_without_axes_has_a_design(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "own.toml").write_text(
        "[plant]\na = [[1, 0.1], [0, 1]]\nb = [[0.005], [0.1]]\ne = [[0.005], [0.1]]\ndt_s = 0.1\n"
        "[sets]\nstate_lower = [-5, -2]\nstate_upper = [5, 2]\ninput_lower = [-1]\ninput_upper = [1]\n"
        "[cost]\nstate = [1, 0.1]\ninput = [0.1]\n[link]\nloss = 0.3\n"
    )
    assert main(["design", "--config", str(tmp_path / "own.toml"), "--json"]) == 0
    figures = json.loads(capsys.readouterr().out)
    # P(age = i) = (1 - p) p^i with independent losses
    assert figures["weights"][:4] == pytest.approx([0.7 * 0.3**i for i in range(4)])
    assert figures["rehearsal"] is None
    assert figures["flight_risk"] is None
    assert main(["design", "--config", str(tmp_path / "own.toml")]) == 0
    assert "upper limit of state 0" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.usefixtures("_no_other_design", "no_page")
def test_a_flight_is_flown_replayed_reported_and_compared(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config, flight = quick(tmp_path), str(tmp_path / "flight.mcap")
    assert main(["design", "--config", config, "--rehearsals", "0", "--json"]) == 0
    figures = json.loads(capsys.readouterr().out)
    assert main(["loopback", "--config", config, "--duration", "5", "--out", str(tmp_path), "--json"]) == 0
    flown = json.loads(capsys.readouterr().out)
    assert flown["steps"] > 80
    reported = read_header(Path(flight))
    assert reported.design_id == figures["design_id"] == reported.design["design_id"]
    assert {
        key: value for key, value in figures.items() if key not in ("schema", "wall_s", "rehearsal", "flight_risk")
    } == reported.design
    assert read_design(reported).horizon == 48
    assert main(["log", "replay", flight, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["identical"]
    assert main(["log", "report", flight, "--rehearsals", "3", "--json"]) == 0
    room = json.loads(capsys.readouterr().out)["verdicts"]["room"]
    flights = (f"duration_s={0.05 * room['steps']}", "check.rehearsals=3")
    risk = compute_flight_risk(load_config(config, flights))
    assert risk is not None and room["promised"] == risk.sentence and room["outside"] == 0
    assert main(["log", "report", flight, "--rehearsals", "0", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["verdicts"]["room"]["promised"] is None
    assert main(["log", "whatif", flight, "--set", "link.loss=0.4", "--out", str(tmp_path / "whatif")]) == 0
    assert main(["solve", "--config", config, "--state", "0,0,0,0,0,0,-1,0,0"]) == 0


@pytest.mark.usefixtures("_no_other_design", "no_page")
def test_places_that_the_scheme_cannot_rest_at_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["loopback", "--config", quick(tmp_path), "--duration", "1", "--out", str(tmp_path / "flight")]
    assert main([*arguments, "--goto", "2.998,0,-1.2"]) != 0
    assert "goto: " in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.usefixtures("_no_other_design")
@pytest.mark.parametrize("overrides", [["link.loss=0.6"], [*QUICK, "smpc.horizon=48", "link.loss=0.8"]])
def test_losses_that_the_other_scheme_refuses_are_flown(overrides: list[str]) -> None:
    flight = lockstep("room-hahn-stursberg", 8.0, SCHEME, *overrides)
    plans = flight.of(Plan)
    assert {(plan.method, plan.status) for plan in plans} == {(METHOD, SolveStatus.OPTIMAL)}
    assert {decision.mode for decision in flight.of(Decision)} == {ControlMode.WAIT, ControlMode.TRACK}
    target = np.array(load_config("room-hahn-stursberg").target.position_m)
    assert np.linalg.norm(np.array(flight.of(Truth)[-1].position_m) - target) < 0.5


def test_a_link_that_no_horizon_bridges_is_refused_by_the_scheme_s_own_error(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*FLOWN, "--set", "link.loss=0.9", "--out", str(tmp_path)]) == 2
    assert "smpc.horizon: positions are 12 steps old or more in 0.282 of all steps" in capsys.readouterr().err


def test_the_id_hashes_all_that_answers_depend_on() -> None:
    def name(*overrides: str) -> str:
        return build_flight_design(load_config("room-hahn-stursberg", [SCHEME, *overrides])).design_id

    same = [
        "target.position_m=[0,0,-1]",
        "smpc.tau=3",
        "schedule.delays=[1]",
        "smpc.k_tau=[[1.0]]",
        "daemon.tick_s=0.1",
    ]
    assert {name(item) for item in same} == {name()}
    others = [
        "link.loss=0.2", "link.model=gilbert-elliott", "smpc.delta_x=0.9", "smpc.horizon=13", "cost.input=[1,1,1]",
        "sets.input_upper=[2,2,2]", "plant.wind_std_mps2=[0.1,0.1,0.1]", "smpc.slack_linear=1e4", "source.rate_hz=20",
        "estimator.bias_max=0.3", "estimator.position_std_m=0.01",
    ]  # fmt: skip
    assert len({name(), *map(name, others)}) == len(others) + 1


def test_the_solver_of_rest_limits_is_the_one_that_flies() -> None:
    config = load_config("room-hahn-stursberg", [SCHEME])
    design = build_conditioned(config)
    assert compute_reference_limits(design) is design.reference_limits
    assert (
        msgspec.json.decode(msgspec.json.encode(make_design_record(design)))["rests"]
        == design.reference_limits.tolist()
    )
    exact = build_conditioned(config, for_flight=False, cov=np.zeros((9, 9)))
    assert (exact.reference_limits >= design.reference_limits).all() and (
        exact.reference_limits > design.reference_limits
    ).any()


@pytest.mark.slow
@pytest.mark.usefixtures("no_page")
def test_a_recording_under_the_name_of_the_other_design_replays(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Recordings from before the scheme had its own design."""
    assert main([*FLOWN, "--duration", "3", "--out", str(tmp_path)]) == 0
    old = tmp_path / "old.mcap"
    recorder = SyncRecorder(old, load_config("room-hahn-stursberg").log)
    for topic, at_ns, record in read(tmp_path / "flight.mcap"):
        if isinstance(record, Header):
            design = {key: value for key, value in record.design.items() if key != "scheme"}
            record = replace(record, design_id="3f1c9a", design=design)
        elif isinstance(record, Plan):
            record = replace(record, design_id="3f1c9a")
        if not topic.startswith("/view/"):
            recorder.put(topic, at_ns, record)
    assert recorder.close().ok
    capsys.readouterr()
    assert main(["log", "replay", str(old), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["identical"]
    assert main(["log", "report", str(old), "--rehearsals", "0", "--json"]) == 0
