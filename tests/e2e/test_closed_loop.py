"""Closed loop over the real MAVLink bytes, in virtual time."""

from __future__ import annotations

import itertools
from functools import cache, partial

import numpy as np
import pytest
from loopback_rig import MemorySink, flight, lockstep, make_loop

from logs.recording.flight import FlightData
from logs.recording.replay import replay
from logs.recording.summary import summarise
from uavctl.config import load_config
from uavctl.records import Datagram, Decision, Plan, Setpoint, SetpointSource, SolveStatus, Truth
from uavctl.smpc.hahn_stursberg.exact import ConicSolver
from uavctl.wiring.controller import build_design

SEEDS = range(20)
LONG = 3  # seed of the flight of 200 steps; the others have 50


@cache
def paper_flight(seed: int) -> MemorySink:
    return lockstep("paper", 200.0 if seed == LONG else 50.0, f"sim.seed={seed}")


@pytest.mark.long
def test_paper_flies_without_slack() -> None:
    summaries = [summarise(flight(paper_flight(seed)), wall_s=1.0) for seed in SEEDS]
    steps = [summary.steps for summary in summaries]
    assert steps == [200 if seed == LONG else 50 for seed in SEEDS]
    for summary in summaries:
        assert summary.slack_used == 0
        assert summary.input_violations == 0
        assert summary.failed_solves == 0
        assert summary.fallbacks == 0
    assert sum(summary.state_violations for summary in summaries) < 0.01 * sum(steps)


@pytest.mark.long
def test_a_flight_of_200_steps_replays_identically() -> None:
    result = replay(paper_flight(LONG).entries, partial(make_loop, load_config("paper", [f"sim.seed={LONG}"])))
    assert result.identical, result.first_difference
    assert result.decisions == 2000


@pytest.mark.long
def test_paper_costs_what_the_paper_s_example_costs() -> None:
    # 60 runs of 50 steps: 56.2e3 on average (theory, section 7). Twenty runs scatter by a few percent.
    flights = []
    for seed in SEEDS:
        first = FlightData.from_records(entry for entry in paper_flight(seed).entries if entry[1] < 50_000_000_000)
        flights.append(summarise(first, wall_s=1.0))
    assert {flight.steps for flight in flights} == {50}
    assert np.mean([flight.cost for flight in flights]) == pytest.approx(56.2e3, rel=0.03)


def test_the_true_state_follows_the_plant_and_the_applied_inputs() -> None:
    memory = lockstep("paper", 30.0, "plant.w=[[1e-12,0.0],[0.0,1e-12]]", "solver.method=exact")
    config = load_config("paper")
    a, b = np.array(config.plant.a), np.array(config.plant.b)
    truths = memory.of(Truth)
    for now, then in itertools.pairwise(truths):
        assert then.state == pytest.approx(a @ now.state + b @ now.input, abs=1e-4)
    decided = {d.step: d.input for d in memory.of(Decision) if d.boundary}
    for step, truth in enumerate(truths):
        # float32 on the wire
        assert decided[step] == pytest.approx(truth.input, rel=1e-6, abs=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("preset", "near_m", "duration_s"), [("room-hahn-stursberg", 0.25, 40.0), ("room", 0.05, 20.0)]
)
def test_a_room_s_flight_settles_at_the_target_from_the_far_corner(
    preset: str, near_m: float, duration_s: float
) -> None:
    for seed in range(3):
        memory = lockstep(preset, duration_s, f"sim.seed={seed}")
        summary = summarise(flight(memory), wall_s=1.0)
        assert summary.state_violations == 0
        assert summary.input_violations == 0
        assert summary.failed_solves == 0
        assert summary.lost is not None and summary.lost > 30
        assert summary.settled_error_m is not None and summary.settled_error_m < near_m


def test_the_same_seed_gives_the_same_bytes_and_another_seed_others() -> None:
    def sent(seed: int) -> list[bytes]:
        memory = lockstep("room-hahn-stursberg", 4.0, f"sim.seed={seed}")
        return [d.data for d in memory.of(Datagram) if d.outgoing]

    first = sent(5)
    assert sent(5) == first
    assert sent(6) != first


@pytest.mark.slow
def test_plans_are_optimal_and_certified() -> None:
    """Each is the exact program's answer to the same question."""
    design = build_design(load_config("room-hahn-stursberg"))
    exact = ConicSolver(design)
    # All plans go to the same target.
    plans = lockstep("room-hahn-stursberg", 10.0, "sim.seed=2", "envelope.lead_s=0").of(Plan)
    assert len(plans) > 20
    for plan in plans:
        assert plan.status is SolveStatus.OPTIMAL
        assert abs(plan.gap) < 1e-6
        wanted = exact.solve(plan.seq, np.array(plan.states[0]), design.target)
        assert plan.cost == pytest.approx(wanted.cost, rel=1e-7)
        max_input = np.abs(design.input_set.b).max()
        assert np.array(plan.inputs) + plan.bias == pytest.approx(wanted.inputs, abs=2e-3 * max_input)
    assert {plan.method for plan in plans} == {"frozen", "exact"}


def test_every_setpoint_is_within_the_last_gate_s_limits() -> None:
    config = load_config("room-hahn-stursberg")
    limit = np.array(config.limits.accel_mps2)
    # Silences longer than the horizon, one after the other, in which the fallback brakes, holds, and recovers.
    setpoints = lockstep("room-hahn-stursberg", 20.0, "link.blackout=[[3, 6], [8, 12], [13, 16]]").of(Setpoint)
    assert len(setpoints) > 300
    assert {SetpointSource.PLAN, SetpointSource.HOLD} <= {setpoint.source for setpoint in setpoints}
    for setpoint in setpoints:
        assert np.all(np.abs(setpoint.accel_mps2) <= limit)
