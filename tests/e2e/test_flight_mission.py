"""Flights of the printed scheme with a mission, over real bytes: waypoints, a trajectory, a fence that closes in."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cache, partial

import msgspec
import numpy as np
import pytest
from flight_rig import (
    MS,
    TICKS,
    StubSolver,
    list_codes,
    make_controller,
    make_inputs,
    make_step_samples,
    run,
    small_plant,
    vehicle,
)
from loopback_rig import MemorySink, flight, lockstep, make_loop
from report_rig import omit_figures
from text_numbers import find_numbers

from logs.recording.replay import replay
from logs.recording.summary import compute_box, compute_position_errors_m, list_summary_rows, summarise
from logs.report.evidence import FlightEvidence
from logs.report.flight_page import render_report
from logs.report.headline import derive_headline
from logs.report.summary_text import describe_flight
from logs.report.verdicts import judge_flight
from uavctl.arrays import Array
from uavctl.cause import Cause
from uavctl.config import load_config
from uavctl.config.load import dump_config
from uavctl.flight.mission import Waypoint
from uavctl.records import ControlMode, Decision, Event, GaveWay, Plan, Truth
from uavctl.smpc.answer import NOMINAL, Answer, Preview
from uavctl.wiring.controller import build_design

PLACES_M = ((1.5, 1.0, -1.2), (-1.0, 1.2, -0.9), (0.0, -1.0, -1.5))
HOLD_S, ACCEPT_M = 2.0, 0.3
WAYPOINTS = (f"mission.waypoints={[list(place) for place in PLACES_M]}", f"mission.hold_s={HOLD_S}")
FENCE = ('fence=[{state="north",side="upper",times_s=[5,15],values=[3.0,0.9]}]',)
SHUT_OUT = ('fence=[{state="north",side="upper",times_s=[7,7.2],values=[3.0,-0.5]}]',)


def make_circle(seconds: float) -> list[list[float]]:
    """Samples each half second: 0.9 m around the middle of the room in 10 s."""
    angle = 2 * np.pi * np.arange(0.0, seconds + 0.1, 0.5) / 10.0
    places: list[list[float]] = np.column_stack(
        [0.9 * np.cos(angle), 0.9 * np.sin(angle), np.full(len(angle), -1.2)]
    ).tolist()
    return places


def format_trajectory(seconds: float) -> tuple[str]:
    places = make_circle(seconds)
    return (f"mission.trajectory={{times_s={(0.5 * np.arange(len(places))).tolist()},positions_m={places}}}",)


def format_waypoints(seconds: float) -> tuple[str]:
    return (f"mission.waypoints={make_circle(seconds)}",)


@cache
def fly_mission(seconds: float, *overrides: str) -> MemorySink:
    return lockstep("room-hahn-stursberg", seconds, *overrides)


def list_steps(memory: MemorySink) -> list[tuple[Decision, Truth]]:
    """Decisions at boundaries with the truth of that moment."""
    truths = {truth.at_ns: truth for truth in memory.of(Truth)}
    return [
        (decision, truths[decision.at_ns])
        for decision in memory.of(Decision)
        if decision.boundary and decision.at_ns in truths
    ]


def compute_distance_m(decision: Decision, truth: Truth) -> float:
    assert decision.target is not None
    return float(np.linalg.norm(np.array(truth.state)[[0, 3, 6]] - np.array(decision.target)[[0, 3, 6]]))


def compute_excess(memory: MemorySink) -> tuple[Array, Array]:
    """How far each state was beyond each limit, and how far it may be as the plan flown to it told: mostly not at all.

    State limits share one price: a fence that shuts the vehicle out may make it faster than it should be, too. A limit
    that gives way keeps none of its chance: there the state may be off by a back-off more than the mean was moved.
    """
    room = build_design(load_config("room-hahn-stursberg")).state_set
    plans = {plan.seq: plan for plan in memory.of(Plan)}
    decided_steps = list_steps(memory)
    beyond = np.array([truth.state for _, truth in decided_steps[1:]]) @ room.c.T - room.b
    given = np.zeros_like(beyond)
    for row, (decision, _) in zip(given, decided_steps[:-1], strict=True):
        if decision.plan_seq is not None and decision.plan_index is not None:
            for relaxation in plans[decision.plan_seq].gave_way:
                if relaxation.constraint == "state" and relaxation.stage == decision.plan_index + 1:
                    backoff = plans[decision.plan_seq].backoff_x[relaxation.stage][relaxation.index]
                    row[relaxation.index] = relaxation.amount + backoff
    return beyond, given


CASES = [
    pytest.param(22.0, WAYPOINTS, id="waypoints"),
    pytest.param(22.0, format_trajectory(20.0), id="circle"),
    pytest.param(22.0, FENCE, id="fence"),
    pytest.param(12.0, SHUT_OUT, id="shut out"),
]


@pytest.mark.slow
@pytest.mark.parametrize(("seconds", "overrides"), CASES)
def test_a_mission_is_flown_and_replayed_bit_for_bit(seconds: float, overrides: tuple[str, ...]) -> None:
    memory = fly_mission(seconds, *overrides)
    summary = summarise(flight(memory), wall_s=1.0)
    assert (summary.input_violations, summary.failed_solves, summary.fallbacks) == (0, 0, 0)
    beyond, given = compute_excess(memory)
    assert (beyond <= given).all()
    assert overrides == SHUT_OUT or not given.any()
    config = load_config("room-hahn-stursberg", [f"duration_s={seconds}", *overrides])
    result = replay(memory.entries, partial(make_loop, config))
    assert result.identical, result.first_difference


def test_waypoints_are_visited_in_their_order_and_held_for_their_time() -> None:
    decided_steps = list_steps(fly_mission(22.0, *WAYPOINTS))
    numbers = [decision.waypoint for decision, _ in decided_steps if decision.target is not None]
    assert numbers == sorted(numbers, key=lambda number: -1 if number is None else number)
    assert set(numbers) == {0, 1, 2}
    for number, place in enumerate(PLACES_M):
        at_waypoint = [(d, t) for d, t in decided_steps if d.waypoint == number]
        assert all(np.array(d.target)[[0, 3, 6]].tolist() == list(place) for d, _ in at_waypoint)
        # Arrived as the estimate says, so the truth is near by what the estimate is off at most.
        arrived = next(d.at_ns for d, t in at_waypoint if compute_distance_m(d, t) < ACCEPT_M + 0.15)
        assert at_waypoint[-1][0].at_ns - arrived >= (HOLD_S - 0.4) * 1e9
        assert min(compute_distance_m(d, t) for d, t in at_waypoint) < 0.15
    assert np.mean([compute_distance_m(d, t) for d, t in decided_steps[-10:]]) < 0.2


@pytest.mark.slow
def test_a_trajectory_is_followed_far_closer_than_by_chasing_its_samples() -> None:
    """Both after 5 s, in which the vehicle comes from the corner."""
    circling, chasing = fly_mission(22.0, *format_trajectory(20.0)), fly_mission(22.0, *format_waypoints(20.0))

    def middle(memory: MemorySink) -> list[tuple[Decision, Truth]]:
        return [(d, t) for d, t in list_steps(memory) if 5e9 <= d.at_ns <= 20e9]

    wanted = {decision.at_ns: decision for decision, _ in middle(circling)}
    following = [compute_distance_m(d, t) for d, t in middle(circling)]
    behind = [compute_distance_m(wanted[d.at_ns], t) for d, t in middle(chasing) if d.at_ns in wanted]
    assert np.mean(following) < 0.15
    assert np.max(following) < 0.4
    assert np.mean(behind) > 3.0 * np.mean(following)
    assert {decision.waypoint for decision, _ in middle(circling)} == {None}


@pytest.mark.slow
def test_a_fence_that_closes_in_slowly_is_kept_by_every_plan() -> None:
    memory = fly_mission(22.0, *FENCE)
    data = flight(memory)
    assert summarise(data, wall_s=1.0).slack_used == 0
    begun_s = data.targets[0][0]
    for decision, truth in list_steps(memory):
        fence_m = np.interp(decision.at_ns * 1e-9 - begun_s, [5.0, 15.0], [3.0, 0.9])
        assert truth.state[0] <= fence_m
    # It does what it can: as near to the target as the fence and its reserve let it.
    late_positions = [truth.state[0] for decision, truth in list_steps(memory) if decision.at_ns > 18e9]
    assert 0.2 < np.mean(late_positions) < 0.9
    plan = memory.of(Plan)[-1]
    assert plan.offset > 0.5
    assert plan.gave_way == ()


def test_a_fence_that_shuts_the_vehicle_out_is_relaxed_reported_and_left() -> None:
    memory = fly_mission(12.0, *SHUT_OUT)
    given = [plan for plan in memory.of(Plan) if plan.gave_way]
    assert given
    assert {"state", "equilibrium"} <= {relaxation.constraint for plan in given for relaxation in plan.gave_way}
    events = [event for event in memory.of(Event) if event.code == "gave-way"]
    assert [event.at_ns for event in events] == [plan.base_ns for plan in given]
    assert {event.text.split(" by ")[0] for event in events} >= {"upper limit of north position was relaxed"}
    assert memory.of(Plan)[-1].gave_way == ()
    assert memory.of(Truth)[-1].state[0] < -0.5
    data = flight(memory)
    (sentence,) = [text for text in describe_flight(data, summarise(data, wall_s=1.0)) if "was relaxed" in text]
    assert "upper limit of north position" in sentence


@pytest.mark.slow
@omit_figures()
def test_the_report_shows_the_target_of_the_moment_and_the_moving_limit() -> None:
    data = flight(fly_mission(22.0, *WAYPOINTS))
    times_s, targets = data.targets
    assert len(times_s) == len(targets) == len({*times_s.tolist()})
    assert {tuple(target[[0, 3, 6]].tolist()) for target in targets} == set(PLACES_M)
    html = render_report(data, summarise(data, wall_s=1.0))
    (sentence,) = [text for text in describe_flight(data, summarise(data, wall_s=1.0)) if "flew towards" in text]
    assert find_numbers(sentence)[::2] == [2.0, 3.0]  # waypoints, each with its time
    assert sentence.replace("&", "&amp;") in html
    assert compute_position_errors_m(data)[-1] < 0.3
    fenced = flight(fly_mission(22.0, *FENCE))
    begun_s = fenced.targets[0][0]
    lower, upper = compute_box(fenced, begun_s + np.array([0.0, 10.0, 100.0]))
    assert upper[:, 0].tolist() == pytest.approx([3.0, 1.95, 0.9])
    assert lower[:, 0].tolist() == [-3.0] * 3
    assert render_report(fenced, summarise(fenced, wall_s=1.0)).startswith("<!DOCTYPE html>")
    moving = flight(fly_mission(22.0, *format_trajectory(20.0)))
    assert moving.moving_target and not data.moving_target
    summary = summarise(moving, wall_s=1.0)
    assert render_report(moving, summary).startswith("<!DOCTYPE html>")
    assert summary.trajectory and "Distance from trajectory" in dict(list_summary_rows(summary))
    assert "Distance from target" in dict(list_summary_rows(summarise(data, wall_s=1.0)))
    description = describe_flight(moving, summary)
    (sentence,) = [text for text in description if "trajectory was" in text]
    assert not any("from the target" in text or "waypoint" in text for text in description)
    # 40 chords of the circle, one a sample, of which each is cut into pieces of a step.
    length_m, begun_s, ended_s = find_numbers(sentence)
    error_m = compute_position_errors_m(moving)
    assert length_m == pytest.approx(2 * 2 * np.pi * 0.9, rel=0.01)
    assert ended_s - begun_s == pytest.approx(20.0, abs=0.5)
    assert summary.course_rms_m is not None and summary.course_worst_m is not None
    assert 0.0 < summary.course_rms_m < summary.course_worst_m == error_m[np.argmax(error_m <= 0.3) :].max()


def test_a_step_beyond_a_fence_counts_as_outside_the_limits() -> None:
    data = flight(fly_mission(22.0, *WAYPOINTS))
    assert summarise(data, wall_s=1.0).state_violations == 0
    fence = 'fence=[{state="north",side="upper",times_s=[0],values=[1.0]}]'
    header = msgspec.structs.replace(data.header, config_toml=dump_config(load_config("room-hahn-stursberg", [fence])))
    fenced = replace(data, header=header)
    beyond = fenced.steps.state[:, 0] - 1.0
    summary = summarise(fenced, wall_s=1.0)
    assert summary.state_violations == np.count_nonzero(beyond > 0) > 5
    assert derive_headline(FlightEvidence(fenced, summary, judge_flight(fenced))).cause in (
        Cause.BEYOND_LIMIT,
        Cause.LEFT_LIMITS,
    )


def test_time_counts_from_the_first_decision_with_a_vehicle_that_takes_setpoints() -> None:
    inputs = make_inputs(range(6 * TICKS), make_step_samples(), status=lambda tick: vehicle(external=tick > 2 * TICKS))
    outputs = run(make_controller(), inputs)
    begun = 3 * TICKS
    assert {(output.decision.target, output.decision.waypoint) for output in outputs[:begun]} == {(None, None)}
    assert {(output.decision.target, output.decision.waypoint) for output in outputs[begun:]} == {((0.0, 0.0, 0.0), 0)}


def test_a_mission_goes_on_where_it_was_after_the_pilot_had_the_vehicle() -> None:
    away = range(2 * TICKS, 4 * TICKS)
    controller = make_controller()
    leave_at_once = tuple(Waypoint(np.zeros(3), hold_ns=0) for _ in range(9))
    controller = replace(controller, mission=replace(controller.mission, waypoints=leave_at_once))
    inputs = make_inputs(range(6 * TICKS), make_step_samples(), status=lambda tick: vehicle(external=tick not in away))
    outputs = run(controller, inputs)
    assert {outputs[tick].decision.mode for tick in away} == {ControlMode.WAIT}
    assert [output.decision.waypoint for output in outputs[::TICKS]] == [1, 2, 2, 2, 3, 4]


def test_a_relaxed_plan_is_one_event_with_the_worst_relaxation_and_the_number_of_others() -> None:
    given = tuple(GaveWay(constraint="equilibrium", stage=3, index=i, amount=0.1 * (i + 1)) for i in range(3))
    solver = StubSolver(small_plant(), faults={1: lambda answer: msgspec.structs.replace(answer, relaxed=given)})
    outputs = run(make_controller(solver), make_inputs(range(3 * TICKS), make_step_samples()))
    relaxed_outputs = [(number, output) for number, output in enumerate(outputs) if "gave-way" in list_codes(output)]
    assert [number for number, _ in relaxed_outputs] == [TICKS]
    (event,) = [event for event in relaxed_outputs[0][1].events if event.code == "gave-way"]
    assert event.text == "rest was missed by 0.3 of state 2 in stage 3, and 2 other limits"
    plan = relaxed_outputs[0][1].plan
    assert plan is not None and plan.gave_way == given


@dataclass
class ListeningSolver(StubSolver):
    """Keeps what it was told of the time ahead."""

    told: list[Preview] = field(default_factory=list)

    def solve(self, seq: int, x: Array, target: Array, preview: Preview = NOMINAL) -> Answer:
        self.told.append(preview)
        return super().solve(seq, x, target, preview)


@pytest.mark.parametrize(("late_steps", "wanted"), [(0, 0), (1, 1), (3, 2)])
def test_a_late_position_is_reported_up_to_the_late_steps_of_the_design(late_steps: int, wanted: int) -> None:
    solver = ListeningSolver(small_plant())
    controller = replace(make_controller(solver), late_steps=late_steps)
    run(controller, make_inputs(range(8 * TICKS), make_step_samples(delay_ns=430 * MS)))
    assert {preview.age for preview in solver.told} == {wanted}
