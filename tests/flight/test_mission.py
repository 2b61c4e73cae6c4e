"""Missions: waypoints in their order, motions the plant can make, limits that move."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from flight_rig import make_rest_region, small_plant

from uavctl.config import load_config
from uavctl.config.types import Config
from uavctl.constraint_names import describe_all_relaxed, describe_relaxed, name_constraints
from uavctl.errors import ConfigError, DesignError
from uavctl.flight.mission import (
    Fence,
    Mission,
    MissionState,
    RestRegion,
    Trajectory,
    Waypoint,
    advance_mission,
    find_target,
    is_led,
    is_over,
    lead_with_one_axis,
    make_question,
    resume,
    stay_at,
)
from uavctl.records import GaveWay, Vec3
from uavctl.smpc.hahn_stursberg.design import Design
from uavctl.wiring.controller import build_controller, build_design
from uavctl.wiring.mission import build_mission, build_reference_limits, build_trajectory

DT_NS = 200_000_000
SECOND_NS = 1_000_000_000
ROOM = Path("uavctl/presets/room-hahn-stursberg.toml").read_text(encoding="utf-8")


def on_a_line(*places_m: float, hold_s: float = 1.0, fences: tuple[Fence, ...] = ()) -> Mission:
    """Waypoints of one axis with states (p, v) and limits p <= 5, -p <= 5."""
    return Mission(
        waypoints=tuple(Waypoint(np.array([place, 0.0]), round(hold_s * SECOND_NS)) for place in places_m),
        accept_m=0.2,
        position_index=(0,),
        limits=np.array([5.0, 5.0]),
        horizon=4,
        dt_ns=DT_NS,
        rest_region=RestRegion((0,), np.array([-4.0]), np.array([4.0]), np.array([[1.0, 0.0]]), np.array([[1.0, 0.5]])),
        fences=fences,
    )


def walk(mission: Mission, positions_m: list[float]) -> list[MissionState]:
    """The mission's states with the vehicle at these places, one a Δt from 7 s on."""
    state, states = None, []
    for step, position in enumerate(positions_m):
        state = advance_mission(mission, state, (position, 0.0), 7 * SECOND_NS + step * DT_NS)
        states.append(state)
    return states


def test_waypoints_are_left_after_their_time_and_the_last_one_never() -> None:
    mission = on_a_line(0.0, 1.0, hold_s=0.6)
    states = walk(mission, [0.5, 0.15, 0.0, 0.0, 0.0, 0.5, 0.9, 1.0] + [1.0] * 10)
    assert [state.waypoint for state in states] == [0, 0, 0, 0, 1, 1, 1, 1] + [1] * 10
    assert states[1].arrived_ns == 7 * SECOND_NS + DT_NS
    assert states[4].arrived_ns is None
    assert states[6].arrived_ns == states[-1].arrived_ns == 7 * SECOND_NS + 6 * DT_NS
    assert {state.start_ns for state in states} == {7 * SECOND_NS}


def test_a_gust_out_of_the_circle_does_not_start_the_time_anew() -> None:
    states = walk(on_a_line(0.0, 1.0, hold_s=0.6), [0.0, 0.5, 0.5, 0.5])
    assert [state.waypoint for state in states] == [0, 0, 0, 1]


def test_an_estimate_that_is_no_number_reaches_nothing() -> None:
    assert walk(on_a_line(0.0, 1.0, hold_s=0.0), [float("nan")] * 3)[-1].waypoint == 0


def test_the_target_is_the_waypoint_and_what_is_wanted() -> None:
    mission = on_a_line(0.3, 1.0)
    target, preview = make_question(mission, MissionState(start_ns=0, waypoint=1), DT_NS)
    assert target.tolist() == [1.0, 0.0]
    assert preview.nominal
    assert find_target(mission, MissionState(start_ns=0, waypoint=1), DT_NS) == (1.0, 0.0)


@pytest.mark.parametrize(
    ("begins", "ends", "first"),
    [
        ((-2.0, -1.5, -1.0), (2.0, 2.0, -2.0), (-2.0, 2.0, -2.0)),  # north has the longer way; down is no matter
        ((-2.0, 1.5, -1.0), (1.0, -2.0, -2.0), (1.0, 1.5, -2.0)),
        ((-2.0, -2.0, -1.0), (2.0, 2.0, -1.0), (-2.0, 2.0, -1.0)),  # alike: north follows
        ((-2.0, -5.2, -1.0), (0.0, 0.0, -1.0), (0.0, -5.0, -1.0)),  # east has to come in by little: it waits there
        ((-2.0, -5.4, -1.0), (0.0, 0.0, -1.0), (-2.0, 0.0, -1.0)),  # by much: it does not wait
        ((-5.4, -5.5, -1.0), (0.0, 0.5, -1.0), (0.0, -5.0, -1.0)),  # both
        ((-2.0, 0.6, -1.0), (2.0, 0.2, -1.0), None),  # one way is short
        ((1.0, 1.0, -1.0), (1.0, 1.0, -2.0), None),
    ],
)
def test_the_longer_horizontal_way_follows_unless_the_vehicle_may_not_rest_there(
    begins: Vec3, ends: Vec3, first: Vec3 | None
) -> None:
    region = make_rest_region(small_plant(("north", "east", "down")))
    found = region.find_leading_target(region.find_equilibrium(begins), region.find_equilibrium(ends))
    if first is None:
        assert found is None
    else:
        assert found == pytest.approx(region.find_equilibrium(first), abs=1e-9)


def test_no_axis_leads_where_there_is_one_or_where_one_goes_up() -> None:
    for axes in (("north",), ("north", "down")):
        region = make_rest_region(small_plant(axes))
        assert (
            region.find_leading_target(
                region.find_equilibrium((0.0, 0.0, 0.0)), region.find_equilibrium((3.0, 3.0, 3.0))
            )
            is None
        )


def test_one_axis_leads_for_a_time_where_the_first_motion_begins_and_never_again() -> None:
    region = make_rest_region(small_plant(("north", "east")))
    begin, end, back = (
        region.find_equilibrium(place) for place in ((0.0, 0.0, 0.0), (3.0, 2.0, 0.0), (-3.0, -2.0, 0.0))
    )
    mission = replace(on_a_line(0.0), rest_region=region, lead_ns=2 * DT_NS)
    at_rest = lead_with_one_axis(mission, stay_at(MissionState(start_ns=0), begin, 0), begin, 0)
    assert at_rest.lead is None  # there is no way to go
    led = lead_with_one_axis(mission, stay_at(at_rest, end, 3 * DT_NS), begin, 3 * DT_NS)
    targets = [make_question(mission, led, number * DT_NS)[0].tolist() for number in (3, 4, 5)]
    assert targets == [list(region.find_equilibrium((0.0, 2.0, 0.0)))] * 2 + [list(end)]
    assert [is_led(mission, led, number * DT_NS) for number in (3, 4, 5)] == [True, True, False]
    assert not is_led(mission, at_rest, 3 * DT_NS)
    assert find_target(mission, led, 3 * DT_NS) == end
    ordered = stay_at(led, back, 4 * DT_NS)
    assert lead_with_one_axis(mission, ordered, begin, 4 * DT_NS) == ordered
    assert not is_led(mission, ordered, 4 * DT_NS)
    assert make_question(mission, ordered, 4 * DT_NS)[0].tolist() == list(back)  # an order is obeyed at once
    assert make_question(replace(mission, lead_ns=0), led, 3 * DT_NS)[0].tolist() == list(end)


def test_no_axis_leads_on_a_trajectory_or_without_a_room() -> None:
    state = MissionState(start_ns=0)
    assert lead_with_one_axis(moving_north(8), state, (0.0, 0.0), 0) == state
    assert lead_with_one_axis(on_a_line(1.0), state, (0.0, 0.0), 0) == state


def test_a_fence_is_a_line_between_its_samples_and_constant_outside() -> None:
    fence = Fence(row=1, times_ns=np.array([1.0, 2.0]) * SECOND_NS, values=np.array([4.0, 2.0]))
    mission = on_a_line(0.0, fences=(fence,))
    _, preview = make_question(mission, MissionState(start_ns=7 * SECOND_NS), 8 * SECOND_NS)
    assert preview.limits is not None
    assert preview.limits[:, 0].tolist() == [5.0] * 5
    assert preview.limits[:, 1] == pytest.approx([4.0, 3.6, 3.2, 2.8, 2.4])
    _, preview = make_question(mission, MissionState(start_ns=7 * SECOND_NS), 20 * SECOND_NS)
    assert preview.limits is not None
    assert preview.limits[:, 1].tolist() == [2.0] * 5


def test_a_fence_that_is_no_closer_than_the_limits_is_none_and_of_several_the_closest_counts() -> None:
    wide = Fence(row=0, times_ns=np.array([0.0]), values=np.array([9.0]))
    _, preview = make_question(on_a_line(0.0, fences=(wide,)), MissionState(start_ns=0), 0)
    assert preview.limits is None
    near, nearer = (Fence(row=0, times_ns=np.array([0.0]), values=np.array([side])) for side in (3.0, 2.5))
    _, preview = make_question(on_a_line(0.0, fences=(near, wide, nearer)), MissionState(start_ns=0), 0)
    assert preview.limits is not None
    assert preview.limits[:, 0].tolist() == [2.5] * 5


def moving_north(rows: int) -> Mission:
    """A metre a Δt for some rows, then a horizon (4 rows) of rest."""
    north = np.minimum(np.arange(rows + 4, dtype=np.float64), rows - 1)
    states = np.column_stack([north, np.zeros(rows + 4)])
    still = np.zeros((rows + 4, 4, 2))
    motion = Trajectory(states=states, anchors=states, path_states=still, path_inputs=still[:, :, :1])
    fence = Fence(row=0, times_ns=np.array([0.0, 10.0]) * SECOND_NS, values=np.array([5.0, 0.0]))
    return replace(on_a_line(0.0, fences=(fence,)), trajectory=motion)


def test_a_trajectory_stands_still_for_an_order_and_a_fence_does_not() -> None:
    mission, state = moving_north(8), MissionState(start_ns=0)
    assert find_target(mission, state, 3 * DT_NS) == (3.0, 0.0)
    left = stay_at(stay_at(state, (0.5, 0.0), 3 * DT_NS), (0.7, 0.0), 4 * DT_NS)
    assert find_target(mission, left, 5 * DT_NS) == (0.7, 0.0)
    assert advance_mission(mission, left, (0.0, 0.0), 5 * DT_NS) == left
    target, preview = make_question(mission, left, 5 * DT_NS)
    assert target.tolist() == [0.7, 0.0]
    assert preview.path is None
    assert preview.limits is not None
    assert preview.limits[0, 0] == pytest.approx(4.5)  # after 1 s of its own time
    again = resume(left, 8 * DT_NS)
    assert [find_target(mission, again, n * DT_NS)[0] for n in (8, 9, 12, 13)] == [3.0, 4.0, 7.0, 7.0]
    _, preview = make_question(mission, again, 10 * DT_NS)
    assert preview.limits is not None
    assert preview.limits[0, 0] == pytest.approx(4.0)
    assert resume(again, 9 * DT_NS) == again


def test_a_mission_is_over_where_its_trajectory_ends_and_after_its_last_waypoint_s_time() -> None:
    mission, state = moving_north(8), MissionState(start_ns=0)
    assert [is_over(mission, state, n * DT_NS) for n in (0, 6, 7, 8, 30)] == [False, False, True, True, True]
    assert not is_over(mission, stay_at(state, (0.0, 0.0), 7 * DT_NS), 8 * DT_NS)
    line = on_a_line(0.0, 1.0, hold_s=0.4)
    arrived = MissionState(start_ns=0, waypoint=1, arrived_ns=5 * DT_NS)
    assert [is_over(line, arrived, n * DT_NS) for n in (5, 6, 7, 8)] == [False, False, True, True]
    assert not is_over(line, replace(arrived, waypoint=0), 8 * DT_NS)
    assert not is_over(line, replace(arrived, arrived_ns=None), 8 * DT_NS)


def test_the_end_of_a_mission_is_configured_and_needs_something_that_ends() -> None:
    config, design = room_with("mission.waypoints=[[1,1,-1]]", "mission.then=land")
    assert build_mission(config, design, build_reference_limits(design)).land
    assert not build_mission(load_config("room-hahn-stursberg"), design, build_reference_limits(design)).land
    with pytest.raises(ConfigError, match=r"mission\.then.*no end to come after"):
        load_config("room-hahn-stursberg", ["mission.then=land"])
    with pytest.raises(ConfigError, match=r"mission\.then"):
        load_config("room-hahn-stursberg", ["mission.waypoints=[[1,1,-1]]", "mission.then=loiter"])


def test_a_configured_trajectory_is_over_at_its_last_sample() -> None:
    motion = "times_s=[1.0,5.0],positions_m=[[0,0,-1],[1,0.5,-1]]"
    config, design = room_with(f"mission={{trajectory={{{motion}}},then='land'}}")
    mission, state = build_mission(config, design, build_reference_limits(design)), MissionState(start_ns=0)
    ends = [n for n in range(40) if is_over(mission, state, n * DT_NS)]
    assert ends[0] == 25  # 5 s


def circle(seconds: float = 12.0, radius_m: float = 0.9, turn_s: float = 10.0) -> tuple[list[float], list[list[float]]]:
    t = np.arange(0.0, seconds + 1e-9, 0.5)
    angle = 2 * np.pi * t / turn_s
    places = np.column_stack([radius_m * np.cos(angle), radius_m * np.sin(angle), np.full(len(t), -1.2)])
    return t.tolist(), places.tolist()


def room_with(*overrides: str) -> tuple[Config, Design]:
    config = load_config("room-hahn-stursberg", list(overrides))
    return config, build_design(config)


@pytest.fixture(scope="module")
def flown_circle() -> tuple[Config, Design]:
    times_s, places = circle()
    return room_with(f"mission.trajectory={{times_s={times_s},positions_m={places}}}")


def test_a_trajectory_is_a_motion_of_the_plant_near_the_samples(flown_circle: tuple[Config, Design]) -> None:
    config, design = flown_circle
    states = build_trajectory(config.mission.trajectory, design, build_reference_limits(design)).states
    t = config.plant.dt_s * np.arange(61)
    wanted_m = np.column_stack([0.9 * np.cos(2 * np.pi * t / 10), 0.9 * np.sin(2 * np.pi * t / 10)])
    assert np.abs(states[:55, [0, 3]] - wanted_m[:55]).max() < 2e-3
    # There are inputs that make it: what A leaves over is in the range of B.
    over = states[1:] - states[:-1] @ design.plant.a.T
    u = np.linalg.lstsq(design.plant.b, over.T, rcond=None)[0]
    assert np.abs(design.plant.b @ u - over.T).max() < 1e-9
    # It ends at rest where the samples end.
    assert states[-1] == pytest.approx([*wanted_m[60, :1], 0, 0, wanted_m[60, 1], 0, 0, -1.2, 0, 0], abs=5e-3)


def test_plans_along_a_trajectory_are_motions_that_leave_it_late_and_end_at_rest(
    flown_circle: tuple[Config, Design],
) -> None:
    config, design = flown_circle
    plant, rest = design.plant, design.horizon - design.terminal.tau
    trajectory = build_trajectory(config.mission.trajectory, design, build_reference_limits(design))
    for row in (0, 7, 31):
        x = trajectory.path_states[row] + trajectory.anchors[row]
        u = trajectory.path_inputs[row]
        assert x[0] == pytest.approx(trajectory.states[row])
        for t in range(design.horizon - 1):
            assert x[t + 1] == pytest.approx(plant.a @ x[t] + plant.b @ u[t], abs=1e-9)
        assert x[rest] == pytest.approx(trajectory.anchors[row], abs=1e-9)
        assert plant.a @ x[rest] == pytest.approx(x[rest], abs=1e-9)
        assert np.abs(x[1:4] - trajectory.states[row + 1 : row + 4])[:, [0, 3, 6]].max() < 0.02


def test_a_trajectory_towards_a_wall_turns_to_rest_before_it() -> None:
    t = np.arange(0.0, 8.1, 0.5)
    north = 1.35 - 1.25 * np.cos(2 * np.pi * t / 8.0)  # to 2.6 m at up to 1 m/s; the limit is 3 m
    places = np.column_stack([north, 0 * t, 0 * t - 1.2]).tolist()
    config, design = room_with(f"mission.trajectory={{times_s={t.tolist()},positions_m={places}}}")
    anchors = build_trajectory(config.mission.trajectory, design, build_reference_limits(design)).anchors
    room_m = 3.0 - design.kappa_x_terminal * np.sqrt((design.terminal.sigma_x + design.estimate_cov)[0, 0])
    assert anchors[:, 0].max() == pytest.approx(room_m)


def test_samples_need_not_begin_at_zero_and_may_be_joined_by_lines() -> None:
    config, design = room_with(
        "mission.trajectory={times_s=[1.0,5.0],positions_m=[[0,0,-1],[1,0.5,-1]],interpolation='linear'}"
    )
    trajectory = build_trajectory(config.mission.trajectory, design, build_reference_limits(design))
    assert trajectory.states[15, [0, 3, 6]] == pytest.approx([0.5, 0.25, -1.0], abs=5e-3)
    assert trajectory.states[0, [0, 3, 6]] == pytest.approx([0.0, 0.0, -1.0], abs=5e-3)
    assert len(trajectory.states) == 26 + config.smpc.horizon


def test_given_velocities_are_flown() -> None:
    config, design = room_with(
        "mission.trajectory={times_s=[0,4],positions_m=[[0,0,-1],[1,0,-1]],velocities_mps=[[0,0,0],[0,0,0]]}"
    )
    trajectory = build_trajectory(config.mission.trajectory, design, build_reference_limits(design))
    t = config.plant.dt_s * np.arange(21) / 4.0
    assert trajectory.states[:21, 0] == pytest.approx(3 * t**2 - 2 * t**3, abs=5e-3)


def test_too_fast_a_motion_is_refused_with_the_figures() -> None:
    config, design = room_with("mission.trajectory={times_s=[0,1],positions_m=[[-2,0,-1],[2,0,-1]]}")
    with pytest.raises(DesignError, match=r"[23]\.\d+ m/s beyond the upper limit of north velocity at 0\.") as raised:
        build_mission(config, design, build_reference_limits(design))
    assert raised.value.key == "mission.trajectory"


def test_without_a_mission_the_target_is_held() -> None:
    config, design = room_with()
    mission = build_controller(config, design).mission
    target, preview = make_question(mission, MissionState(start_ns=0), 0)
    assert target.tolist() == design.target.tolist()
    assert preview.nominal


def test_a_fence_becomes_a_row_of_the_state_set() -> None:
    config, design = room_with('fence=[{state="down",side="lower",times_s=[0,9],values=[-2.5,-1.5]}]')
    (fence,) = build_mission(config, design, build_reference_limits(design)).fences
    assert design.state_set.c[fence.row].tolist() == [0, 0, 0, 0, 0, 0, -1, 0, 0]
    assert fence.values.tolist() == [2.5, 1.5]
    assert fence.times_ns.tolist() == [0.0, 9e9]


@pytest.mark.parametrize(
    ("fence", "key", "words"),
    [
        ('state=2,side="upper",times_s=[0],values=[1]', "fence[0].side", "has no limit that could close in"),
        ('state=1,side="upper",times_s=[0],values=[0.1]', "fence[0].values", "plans keep from it at rest"),
    ],
)
def test_a_fence_that_the_design_cannot_take_is_refused(fence: str, key: str, words: str) -> None:
    config, design = room_with(f"fence=[{{{fence}}}]")
    with pytest.raises(DesignError, match=words) as raised:
        build_mission(config, design, build_reference_limits(design))
    assert raised.value.key == key


def test_what_gave_way_is_told_in_words() -> None:
    names = name_constraints([[2.0, 0.0], [0.0, -1.0], [1.0, 1.0]], 2, ("north",), (0,), (1,))
    upper = GaveWay(constraint="state", stage=3, index=0, amount=0.24)
    speed = GaveWay(constraint="terminal", stage=8, index=1, amount=0.05)
    mixed = GaveWay(constraint="state", stage=1, index=2, amount=0.01)
    rest = GaveWay(constraint="equilibrium", stage=8, index=1, amount=0.5)
    assert describe_relaxed(names, upper) == "upper limit of north position was relaxed by 0.12 m in stage 3"
    assert describe_relaxed(names, speed) == (
        "lower limit of north velocity was relaxed by 0.05 m/s where the plan rests, from stage 8 on"
    )
    assert describe_relaxed(names, mixed) == "row 2 of the state limits was relaxed by 0.01 in stage 1"
    assert describe_relaxed(names, rest) == "rest was missed by 0.5 m/s of north velocity in stage 8"
    assert describe_all_relaxed(names, (upper,)) == describe_relaxed(names, upper)
    assert describe_all_relaxed(names, (speed, upper, rest)) == describe_relaxed(names, upper) + ", and 2 other limits"
