"""The parts of a tuning run: the excitation in its box, what a flight changes, its figures."""

from __future__ import annotations

import dataclasses
import re

import msgspec
import numpy as np
import pytest
from loopback_rig import lockstep

from logs.recording.flight import FlightData
from uavctl.config import Config, load_config
from uavctl.errors import UsageError
from uavctl.lab.identify.history import read_recorded_history
from uavctl.lab.identify.result import Identification, identify
from uavctl.lab.tune.change import check_tunable, tune_config
from uavctl.lab.tune.excitation import MIN_STEP_M, SafeBox, add_excitation, check_start, parse_box
from uavctl.lab.tune.figures import HoldChange, TunedFlight, compare_holds, compute_flight_figures
from uavctl.wiring.controller import build_flight_design

BOX = parse_box("-1.5,-1.4,-2,1.5,1.4,-0.4")


def room(*overrides: str) -> Config:
    return load_config("room", ("sim.plant=quadrotor", *overrides))


def test_any_two_opposite_corners_make_the_box() -> None:
    assert parse_box("1.5,-1.4,-0.4,-1.5,1.4,-2") == SafeBox((-1.5, -1.4, -2.0), (1.5, 1.4, -0.4)) == BOX


@pytest.mark.parametrize("text", ["1,2,3", "a,b,c,d,e,f", "1,2,3,4,5,nan", ""])
def test_an_invalid_box_is_refused(text: str) -> None:
    with pytest.raises(UsageError, match="--box"):
        parse_box(text)


@pytest.mark.parametrize("preset", ["room", "room-px4", "room-ardupilot"])
def test_each_axis_is_stepped_by_itself_well_inside_the_box(preset: str) -> None:
    config = load_config(preset, ("sim.plant=quadrotor",))
    tuned = add_excitation(config, build_flight_design(config), BOX, lands=False)
    points = np.array(tuned.mission.waypoints)
    assert np.all(points > np.array(BOX.lower) + 0.1) and np.all(points < np.array(BOX.upper) - 0.1)
    steps = np.abs(np.diff(points, axis=0))
    for axis, least_m in enumerate(MIN_STEP_M):
        is_single_axis = (steps[:, axis] >= least_m) & (np.delete(steps, axis, axis=1).max(axis=1) == 0.0)
        assert np.count_nonzero(is_single_axis) >= 3
    assert tuple(points[-1]) == BOX.centre
    assert {(fence.state, fence.side): fence.values[0] for fence in tuned.fence} == {
        (name, side): values[axis]
        for axis, name in enumerate(("north", "east", "down"))
        for side, values in (("lower", BOX.lower), ("upper", BOX.upper))
    }


def test_a_box_outside_the_room_is_refused_by_its_axis() -> None:
    config = room()
    with pytest.raises(UsageError, match=r"east: .* -2\.5 to 2\.5 m") as refused:
        add_excitation(config, build_flight_design(config), parse_box("-1,-3,-2,1,1,-0.4"), lands=False)
    assert "north" not in str(refused.value)


def test_a_fence_of_the_configuration_counts_as_a_wall() -> None:
    config = room('fence=[{state="north",side="upper",times_s=[0.0,5.0],values=[2.0,1.0]}]')
    with pytest.raises(UsageError, match=r"north: .* to 1 m"):
        add_excitation(config, build_flight_design(config), BOX, lands=False)


def test_a_box_that_is_too_small_says_how_large_it_must_be() -> None:
    config = room()
    design = build_flight_design(config)
    with pytest.raises(UsageError) as refused:
        add_excitation(config, design, parse_box("-0.2,-1,-2,0.2,1,-0.4"), lands=False)
    identification = re.search(r"north: .* at least ([\d.]+) m", str(refused.value))
    assert identification is not None
    half = float(identification[1]) / 2.0
    add_excitation(config, design, parse_box(f"{-half},-1,-2,{half},1,-0.4"), lands=False)
    with pytest.raises(UsageError):
        add_excitation(config, design, parse_box(f"{-half + 0.02},-1,-2,{half - 0.02},1,-0.4"), lands=False)


def test_a_start_outside_the_box_is_refused() -> None:
    check_start(BOX, (0.0, 0.0, -1.0), "start")
    check_start(BOX, (0.0, 0.0, 0.0), "start", (0, 1))  # on the floor, below the box
    with pytest.raises(UsageError, match=r"north -2\.40 m"):
        check_start(BOX, (-2.4, 0.0, -1.0), "start")


def test_a_plant_without_a_lag_is_refused() -> None:
    with pytest.raises(UsageError, match="matrices"):
        check_tunable(load_config("paper"))


@pytest.fixture(scope="module")
def flight() -> tuple[Config, FlightData, Identification]:
    """Half a minute of waypoints on the quadrotor."""
    overrides = (
        "sim.plant=quadrotor",
        "sim.start_position_m=[0.0,0.0,-1.2]",
        "mission.waypoints=[[1.0,0.8,-0.7],[-1.0,-0.8,-1.6],[1.0,-0.8,-0.8],[-1.0,0.8,-1.5],[0.0,0.0,-1.2]]",
    )
    memory = lockstep("room", 30.0, *overrides)
    config = load_config("room", overrides)
    identification = identify(read_recorded_history(memory.entries), config, lambda: None)
    return config, FlightData.from_records(memory.entries), identification


@pytest.mark.slow
def test_a_flight_changes_the_response_and_nothing_that_was_calmer(
    flight: tuple[Config, FlightData, Identification],
) -> None:
    config, _, identification = flight
    tuned, changes = tune_config(config, identification)
    assert tuned.plant.drag_1ps[0] == pytest.approx(0.25, abs=0.05)  # the quadrotor's
    assert {change.key for change in changes} >= {"plant.lag_s", "plant.drag_1ps"}
    assert tuned.plant.dead_time_s == identification.config.plant.dead_time_s
    # A calm half minute lowers no noise, and a link that was as believed stays so.
    assert tuned.plant.wind_std_mps2 == config.plant.wind_std_mps2
    assert tuned.link == config.link
    assert msgspec.structs.replace(tuned, name="", plant=config.plant, cost=config.cost) == (
        msgspec.structs.replace(config, name="")
    )


def doubt(identification: Identification, *rows: int) -> Identification:
    """The identification with axes of which little is predicted."""
    response = tuple(
        msgspec.structs.replace(one, r2=0.3) if row in rows else one
        for row, one in enumerate(identification.result.response)
    )
    return dataclasses.replace(identification, result=msgspec.structs.replace(identification.result, response=response))


@pytest.mark.slow
def test_an_axis_that_is_not_predicted_keeps_its_delay_and_drag(
    flight: tuple[Config, FlightData, Identification],
) -> None:
    config, _, identification = flight
    tuned, changes = tune_config(config, doubt(identification, 0))
    old, new = config.plant, tuned.plant
    assert new.dead_time_s + new.lag_s[0] == pytest.approx(old.dead_time_s + old.lag_s[0], abs=1e-3)
    assert new.drag_1ps[0] == old.drag_1ps[0] and new.drag_1ps[1] == identification.config.plant.drag_1ps[1]
    assert any("30 %" in change.reason for change in changes)


@pytest.mark.slow
def test_a_flight_that_shows_no_axis_keeps_the_response(flight: tuple[Config, FlightData, Identification]) -> None:
    config, _, identification = flight
    tuned, _ = tune_config(config, doubt(identification, 0, 1, 2))
    assert tuned.plant == config.plant


@pytest.mark.slow
def test_noise_and_losses_that_were_worse_are_raised(flight: tuple[Config, FlightData, Identification]) -> None:
    config, _, identification = flight
    replace = msgspec.structs.replace
    hopeful = replace(
        config,
        plant=replace(config.plant, wind_std_mps2=(1e-4,) * 3),
        link=replace(config.link, loss=0.1, jitter_s=0.0),
        estimator=replace(config.estimator, position_std_m=1e-4),
    )
    tuned, _ = tune_config(hopeful, identification)
    assert tuned.plant.wind_std_mps2 == identification.config.plant.wind_std_mps2
    assert tuned.estimator.position_std_m == identification.config.estimator.position_std_m
    assert tuned.link.loss == pytest.approx(0.3, abs=0.08)
    assert tuned.link.jitter_s == pytest.approx(0.04, abs=0.005)


@pytest.mark.slow
def test_a_halt_of_a_computer_does_not_change_the_link(flight: tuple[Config, FlightData, Identification]) -> None:
    config, _, identification = flight
    stalled = dataclasses.replace(identification, link=dataclasses.replace(identification.link, jitter_s=3.0))
    delayed = dataclasses.replace(identification, link=dataclasses.replace(identification.link, jitter_s=0.1))
    assert tune_config(config, stalled)[0].link.jitter_s == config.link.jitter_s
    assert tune_config(config, delayed)[0].link.jitter_s == pytest.approx(0.1, abs=0.005)


@pytest.mark.slow
def test_the_hold_is_judged_where_the_vehicle_truly_was(flight: tuple[Config, FlightData, Identification]) -> None:
    _, flown, _ = flight
    figures = compute_flight_figures(flown, BOX)
    assert figures.hold_rms_m is not None and 0.0 < figures.hold_rms_m < 0.1
    truth = np.array([sample.state for sample in flown.truths])[:, list(flown.design.position_index)]
    inside = np.minimum(truth - np.array(BOX.lower), np.array(BOX.upper) - truth).min()
    assert figures.beyond_box_m == pytest.approx(-inside, abs=0.03)


@pytest.mark.parametrize(
    ("before_m", "after_m", "change"),
    [
        (0.03, 0.02, HoldChange.BETTER),
        (0.02, 0.03, HoldChange.WORSE),
        (0.0200, 0.0235, HoldChange.ALIKE),
        (0.0200, 0.0165, HoldChange.ALIKE),
        (None, 0.02, HoldChange.UNKNOWN),
        (0.02, None, HoldChange.UNKNOWN),
    ],
)
def test_the_better_flight_is_the_one_nearer_to_its_last_waypoint(
    before_m: float | None, after_m: float | None, change: HoldChange
) -> None:
    before, after = (TunedFlight(hold_rms_m=value, beyond_box_m=None) for value in (before_m, after_m))
    assert compare_holds(before, after) is change
