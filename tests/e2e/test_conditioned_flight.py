"""Scheme `age-conditioned` in flights, campaigns and on the command line."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from loopback_rig import MemorySink, lockstep, make_loop

from logs.recording.replay import replay
from uavctl.cli.app import run as main
from uavctl.config import load_config
from uavctl.lab.campaign.controllers import build_from_recipe, draw_conditions
from uavctl.lab.campaign.spec import read_campaign
from uavctl.lab.campaign.tasks import describe_cell, make_cells
from uavctl.lab.campaign.world import simulate
from uavctl.records import ControlMode, Decision, Plan, Setpoint, SolveStatus, Truth
from uavctl.smpc.conditioned.planner import METHOD
from uavctl.wiring.controller import build_conditioned, build_design, compute_reference_limits

SCHEME = "smpc.scheme=age-conditioned"
FENCE = 'fence=[{state="north",side="upper",times_s=[6,14],values=[3.0,1.2]}]'


@pytest.fixture(scope="module")
def flight() -> MemorySink:
    return lockstep("room", 30.0, "sim.seed=4")


@pytest.mark.slow
def test_a_flight_arrives_on_plans_of_the_scheme(flight: MemorySink) -> None:
    plans = flight.of(Plan)
    assert {plan.method for plan in plans} == {METHOD}
    assert {plan.status for plan in plans} == {SolveStatus.OPTIMAL}
    # Most of them on the way, at the limit of speed.
    assert sum(bool(plan.gave_way) for plan in plans) <= 0.05 * len(plans)
    assert {decision.mode for decision in flight.of(Decision)} <= {ControlMode.WAIT, ControlMode.TRACK}
    target = np.array(load_config("room").target.position_m)
    assert np.linalg.norm(np.array(flight.of(Truth)[-1].position_m) - target) < 0.2


@pytest.mark.slow
def test_without_inertial_data_the_setpoints_play_the_plans_out() -> None:
    """What is decided at a boundary is the plan's input of that step.

    A plan keeps the limits of the gate to the solver's tolerance; the gate takes that rest, some 1e-11 m/s², away.
    """
    flight = lockstep("room", 20.0, "sim.seed=4", "estimator.inertial_std_mps2=0")
    plans = {plan.seq: plan for plan in flight.of(Plan)}
    played = [decision for decision in flight.of(Decision) if decision.boundary and decision.plan_index]
    assert len(played) > 10
    for decision in played:
        assert decision.plan_seq is not None and decision.plan_index is not None
        assert decision.input == pytest.approx(plans[decision.plan_seq].inputs[decision.plan_index], abs=1e-9)


def test_what_is_planned_has_arrived_by_the_end_of_its_step() -> None:
    """The gate limits setpoints within a step of several ticks; none is left behind the plan at its last tick."""
    flight = lockstep("room-hahn-stursberg", 16.0, SCHEME, "sim.seed=4")
    config = load_config("room-hahn-stursberg")
    ticks = round(config.plant.dt_s / config.daemon.tick_s)
    plans, setpoints = (
        {plan.seq: plan for plan in flight.of(Plan)},
        {setpoint.at_ns: setpoint for setpoint in flight.of(Setpoint)},
    )
    moving = 0
    for decision in flight.of(Decision):
        if decision.tick % ticks != ticks - 1 or decision.plan_seq is None or decision.plan_index is None:
            continue
        moving += bool(setpoints[decision.at_ns - round(config.daemon.tick_s * 1e9)].limited)
        planned = plans[decision.plan_seq].inputs[decision.plan_index]
        assert setpoints[decision.at_ns].accel_mps2 == pytest.approx(planned, abs=1e-6)
    assert moving > 2


@pytest.mark.slow
def test_a_flight_replays_bit_for_bit() -> None:
    config = load_config("room", ["duration_s=12.0", "sim.seed=4"])
    assert replay(lockstep("room", 12.0, "sim.seed=4").entries, lambda sink: make_loop(config, sink)).identical


@pytest.mark.slow
def test_a_fence_that_closes_in_is_kept() -> None:
    result = lockstep("room", 20.0, FENCE, "target.position_m=[1.5,1.0,-1.2]")
    assert max(truth.position_m[0] for truth in result.of(Truth) if truth.at_ns > 14e9) < 1.2
    last = result.of(Plan)[-1]
    assert last.reference[0] < 1.2  # the target itself is outside
    assert np.array(last.backoff_x)[1:4, 0].min() > 0.0


@pytest.mark.slow
def test_at_a_wall_it_settles_at_the_rest_limit_without_relaxation() -> None:
    # The limit of the design is that of the configured budgets: others rest nearer or further away.
    result = lockstep("room", 30.0, "sim.seed=4", "target.position_m=[3.0,1.0,-1.2]", "risk.budgets=configured")
    rests = compute_reference_limits(build_conditioned(load_config("room")))[0]
    settled = [plan for plan in result.of(Plan) if plan.base_ns > 12e9]
    assert [plan.reference[0] for plan in settled] == pytest.approx([rests] * len(settled), abs=0.03)
    assert sum(bool(plan.gave_way) for plan in settled) <= 0.05 * len(settled)
    places = [truth.position_m[0] for truth in result.of(Truth) if truth.at_ns > 12e9]
    assert np.mean(places) == pytest.approx(settled[-1].reference[0], abs=0.04)
    assert max(places) < 3.0


@pytest.mark.long
def test_by_default_it_settles_beside_a_wall_as_near_as_the_link_allows() -> None:
    """The promise at the wall itself: 5 % of the steps at most are outside, though some plans need slack."""
    result = lockstep("room", 60.0, "sim.seed=4", "target.position_m=[3.0,1.0,-1.2]")
    settled = [plan for plan in result.of(Plan) if plan.base_ns > 30e9]
    places = np.array([truth.position_m[0] for truth in result.of(Truth) if truth.at_ns > 12e9])
    assert np.mean(places >= 3.0) <= 0.05
    assert max(plan.reference[0] for plan in settled) < 3.0
    # Back-offs, not the reference, keep it away: it settles between both.
    assert 2.85 < np.mean(places) < np.mean([plan.reference[0] for plan in settled])


def test_a_design_may_rest_nearer_to_the_walls() -> None:
    config = load_config("room")
    conditioned, design = build_conditioned(config), build_design(load_config("room-hahn-stursberg"))
    ours, theirs = compute_reference_limits(conditioned), compute_reference_limits(design)
    rows = [int(np.flatnonzero((design.state_set.c == row).all(axis=1))[0]) for row in np.eye(9)[[0, 3, 6]]]
    assert (ours[rows] > theirs[rows] + 0.1).all()
    # What it says is where a plan rests, in the middle of the other walls.
    for row, axis in zip(rows, range(3), strict=True):
        beyond = np.zeros(9)
        beyond[3 * axis], beyond[6] = design.state_set.b[row], beyond[6] if axis == 2 else -1.2
        answer = conditioned.solver.solve(0, design.target, beyond)
        assert answer.reference[3 * axis] >= ours[row] - 0.02


CAMPAIGN = """
name = "two schemes"
config = "paper"
runs = 40
steps = 20

[[controller]]
name = "printed"
kind = "smpc"

[[controller]]
name = "ours"
kind = "smpc"
set = ["smpc.scheme=age-conditioned", "smpc.horizon=18"]

[[controller]]
name = "mean QP"
kind = "mean-qp"
margin = 2.0

[[controller]]
name = "governor"
kind = "governor"
margin = 2.0

[[link]]
name = "60 %"
set = ["link.loss=0.6"]
"""


def test_a_campaign_flies_it_where_the_printed_design_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "two.toml"
    file.write_text(CAMPAIGN, encoding="utf-8")
    printed, *others = make_cells(read_campaign(file)[0])
    assert printed.refused.startswith("smpc.delta_x")
    costs = []
    for cell in others:
        assert cell.recipe is not None and cell.recipe.design is None
        meets = draw_conditions(cell.setting, 0, 40)
        result = simulate(meets.world, build_from_recipe(cell.recipe), meets.newest_captures, meets.disturbances)
        assert not result.failed.any()
        costs.append(result.cost.sum(axis=1).mean())
    assert describe_cell(others[0]).promised_x == pytest.approx(0.05)
    assert describe_cell(others[1]).promised_x is None
    assert max(costs) < 1.03 * min(costs)


def test_a_campaign_s_links_carry_one_position_a_step(tmp_path: Path) -> None:
    file = tmp_path / "fast.toml"
    given = ["plant.dt_s=0.05", "daemon.tick_s=0.01", "source.rate_hz=50", "smpc.horizon=24"]
    text = CAMPAIGN.partition("[[controller]]")[0].replace("paper", "room")
    asked = f'{text}set = {given}\n[[controller]]\nname = "ours"\nkind = "smpc"\n'.replace("'", '"')
    file.write_text(asked, encoding="utf-8")
    (cell,) = make_cells(read_campaign(file)[0])
    assert cell.recipe is not None
    # Where positions take longer than a step, none comes in its own, and each is lost with 30 %.
    ages = draw_conditions(cell.setting, 0, 400).newest_captures[:, 12:]
    older = np.mean(np.arange(12, 12 + ages.shape[1]) - ages >= 2)
    risk = build_conditioned(cell.recipe.config).solver.risk
    assert older == pytest.approx(1.0 - risk.age_probabilities[:2].sum(), abs=0.03)


def test_design_shows_the_risk_of_each_age(capsys: pytest.CaptureFixture[str]) -> None:
    command = ["design", "--config", "paper", "--set", SCHEME, "--rehearsals", "0"]
    assert main([*command, "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["scheme"] == METHOD
    weights = np.array(document["weights"])
    for budgets in (document["budgets"], document["budgets_in_transit"]):
        assert weights @ np.array(budgets) + document["beyond"] == pytest.approx(0.05)
    assert main(command) == 0
    assert "upper limit of east position" in capsys.readouterr().out


def test_a_horizon_that_silence_outlasts_is_refused_with_its_key(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["design", "--config", "paper", "--set", SCHEME, "--set", "link.loss=0.9"]) != 0
    assert "smpc.horizon: positions are 12 steps old or more in 0.282 of all steps" in capsys.readouterr().err
