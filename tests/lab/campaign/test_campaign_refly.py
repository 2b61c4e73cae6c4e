"""A run of a campaign flown again through controller, MAVLink and recorder is the run that the campaign flew."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from loopback_rig import Memory, make_loop

from logs.recording.replay import recorded_library
from sim.simulation import World
from uavctl.build.controller import build_design, build_plant
from uavctl.build.library import library_for
from uavctl.cli.app import run
from uavctl.cli.campaign import refly_of as refly
from uavctl.config import load_config
from uavctl.config.link import LinkConfig
from uavctl.errors import UsageError
from uavctl.lab.campaign.rerun import Reflight, Rerun, agreement, delays_ns, flight_config, reflight
from uavctl.lab.campaign.world import Scene, draw, fly, newest
from uavctl.records import Decision, Truth
from uavctl.smpc.batch import BatchSmpc, OneByOne
from uavctl.smpc.hahn_stursberg.library import LibrarySolver

STEPS = 50
BASE = load_config("paper")
DESIGN = build_design(BASE)
LOSSES = LinkConfig(loss=0.3)
LATE = LinkConfig(loss=0.1, delay_s=0.5, jitter_s=1.6)
BURSTS = LinkConfig(model="gilbert-elliott", loss=0.1, burst_enter=0.1, burst_leave=0.05, burst_loss=1.0)


def flown(link: LinkConfig, number: int, *changes: str) -> Rerun:
    """One run of preset `paper`, flown by the loop in memory; `changes` are of the plant that flies."""
    true = load_config("paper", list(changes))
    plant, believed = build_plant(true), build_plant(BASE)
    chances = draw(5, number, 1, STEPS, plant.n_w)
    known = newest(link, plant.dt_s, chances.link)
    w = chances.normal @ np.linalg.cholesky(plant.w).T
    start = np.array([33.5, -2.25, -18.0, 1.5])
    scene = Scene(
        plant, DESIGN.state_set, DESIGN.input_set, DESIGN.q_x, DESIGN.q_u, DESIGN.target, np.zeros(2), start[None]
    )
    solver = LibrarySolver(DESIGN, library_for(DESIGN).library)
    controller = BatchSmpc(
        OneByOne(solver, DESIGN.target, (DESIGN.horizon, 2)), believed, DESIGN.horizon, len(DESIGN.late), 0.5
    )
    found = fly(scene, controller, known, w)
    return Rerun(BASE, true.plant, start, known[0], w[0], found, "test", 5)


def lockstep(flight: Reflight) -> Memory:
    memory = Memory()
    loop = make_loop(flight.config, memory, DESIGN, library_for(DESIGN).library)

    def record(truth: Truth) -> None:
        memory.put("/sim/truth", truth.at_ns, truth)

    World(flight.config, loop, record, script=flight.script).run(flight.config.duration_s)
    return memory


@pytest.mark.parametrize("link", [LOSSES, LATE], ids=["lost", "late"])
def test_a_flight_is_the_run_to_what_float32_leaves(link: LinkConfig) -> None:
    again = flown(link, 3)
    flight = reflight(again, "again")
    memory = lockstep(flight)
    found = agreement(flight, memory.of(Truth))
    # A position of 33 m is within 2e-6 m as float32 and the feedback multiplies that by less than 10.
    assert found.steps == STEPS
    assert max(found.largest_state, found.largest_input) < 2e-5
    assert (found.agrees, found.reason) == (True, "")
    ages = [decision.age_steps for decision in memory.of(Decision) if decision.boundary]
    assert ages == again.flown.age[0].tolist()
    assert len(memory.of(Truth)) == STEPS + 1
    last = memory.of(Truth)[-1]
    assert (last.sent, last.lost) == (STEPS, STEPS - np.unique(again.newest).size)


def test_another_run_is_no_agreement() -> None:
    flight = reflight(flown(LOSSES, 3), "again")
    other = replace(flight, flown=flown(LOSSES, 4).flown)
    assert not agreement(other, lockstep(flight).of(Truth)).agrees


def test_runs_are_compared_until_no_plan_is_left() -> None:
    again = flown(BURSTS, 6)
    (without,) = np.nonzero(again.flown.age[0] >= DESIGN.horizon)
    flight = reflight(again, "again")
    found = agreement(flight, lockstep(flight).of(Truth))
    assert 0 < found.steps == without[0] < STEPS
    assert found.agrees


def test_a_plant_that_is_not_the_designs_flies_and_is_told() -> None:
    again = flown(LOSSES, 3, "plant.b=[[0.25,0,],[0.45,0],[0,0.25],[0,0.45]]", "plant.accel_per_input=[0.6,0.6]")
    flight = reflight(again, "again")
    truths = lockstep(flight).of(Truth)
    found = agreement(flight, truths)
    assert "another one flies" in found.reason
    # The first input is planned on the exact start, whatever flies; from there on the filter believes its own plant.
    first = np.array([truths[0].input, again.flown.inputs[0, 0]])
    assert first[0] == pytest.approx(first[1], abs=1e-5)
    states = np.array([truth.state for truth in truths])
    plant = build_plant(load_config("paper", ["plant.b=[[0.25,0,],[0.45,0],[0,0.25],[0,0.45]]"]))
    moved = states[:-1] @ plant.a.T + np.array([t.input for t in truths[:-1]]) @ plant.b.T
    assert states[1:] == pytest.approx(moved + again.disturbances @ plant.e.T, abs=1e-9)


def test_the_configuration_of_the_flight_gives_the_same_design() -> None:
    room = load_config("room-hahn-stursberg", ["link.loss=0.05", "link.delay_s=0.2", "link.jitter_s=0.0"])
    assert build_design(room).late  # positions a step old have designs of their own
    for config in (BASE, room):
        changed = flight_config(config, np.zeros(build_plant(config).n_x), 10, "again", 3)
        assert changed.link == config.link
        assert build_design(changed).design_id == build_design(config).design_id


def test_positions_are_late_or_lost_as_the_newest_known_says() -> None:
    known = np.array([0, 0, 0, 1, 4, 4, 3 + 2])  # 1 is two steps late, 4 and 0 are not, 5 is one; 2, 3, 6 are lost
    assert delays_ns(known, 10) == (0, 20, None, None, 0, 10, None)


@pytest.fixture(scope="module")
def campaign(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("campaign")
    (folder / "spec.toml").write_text(
        'name = "two"\nconfig = "paper"\nsteps = 15\nruns = 3\n'
        '[[controller]]\nname = "smpc"\nkind = "smpc"\n[[controller]]\nname = "lqg"\nkind = "lqg"\n'
        '[[link]]\nname = "30 %"\nset = ["link.loss=0.3"]\n'
    )
    command = ["campaign", str(folder / "spec.toml"), "--workers", "1", "--out", str(folder / "out"), "--json"]
    assert run(command) == 0
    return folder / "out"


def test_a_run_of_a_campaign_is_recorded_and_replayed_alike(
    campaign: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = refly(campaign, "0:2", tmp_path)
    assert found.agreement.agrees
    assert found.summary.steps == found.agreement.steps == 15
    recording = tmp_path / "flight.mcap"
    assert recorded_library(recording).design_id == DESIGN.design_id
    capsys.readouterr()
    assert run(["log", "replay", str(recording), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["identical"]
    assert (tmp_path / "flight.html").exists()
    told = pq.read_table(campaign / "runs.parquet").to_pylist()[2]
    assert (told["cell"], told["run"]) == (0, 2)
    assert found.summary.cost == pytest.approx(told["cost"], rel=1e-6)
    assert (found.summary.max_age, found.summary.state_violations) == (told["max_age"], told["state_violations"])


def test_a_baseline_has_nothing_to_fly_again(campaign: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"lqg \(lqg\), a baseline without a flight controller"):
        refly(campaign, "1:0", tmp_path)


@pytest.mark.parametrize(("which", "said"), [("1", "CELL:RUN"), ("0:9", "runs 0 to 2"), ("7:0", "cells 0 to 1")])
def test_a_run_that_is_not_there_is_told(which: str, said: str, campaign: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=said):
        refly(campaign, which, tmp_path)
