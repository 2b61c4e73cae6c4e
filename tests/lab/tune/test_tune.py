"""The parts of a tuning run: the excitation in its box, what a flight changes, what a folder remembers."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import msgspec
import numpy as np
import pytest
from loopback_rig import lockstep

from logs.recording.flight import FlightData
from uavctl.config import Config, load_config
from uavctl.errors import UsageError
from uavctl.lab.identify.history import read_recorded_history
from uavctl.lab.identify.response import DragLagAxis, make_parameters
from uavctl.lab.identify.result import Identification, identify
from uavctl.lab.tune.change import (
    MAX_DEAD_TIME_RANGE_S,
    Change,
    PinnedAxisModel,
    TunedResult,
    check_tunable,
    tune_config,
)
from uavctl.lab.tune.excitation import MIN_STEP_M, SafeBox, add_excitation, check_start, parse_box
from uavctl.lab.tune.run_folder import (
    STATE_FILE,
    TuneFolder,
    TuneSettings,
    compute_flight_figures,
    compute_plan_errors_m,
)
from uavctl.wiring.controller import build_flight_design

BOX = parse_box("-1.5,-1.4,-2,1.5,1.4,-0.4")
ASKED = TuneSettings(box="b", flight="", simulated=True, take_off_m=None)


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


def test_a_pinned_axis_moves_as_its_model_with_these_values() -> None:
    model = DragLagAxis(drifts=True)
    values = {
        "lag_s": 0.2,
        "drag_1ps": 0.3,
        "gain": 0.9,
        "wind_mps2_rts": 0.05,
        "noise_m": 0.01,
        "drift_mps2_rts": 0.02,
    }
    pinned = PinnedAxisModel(model, {"lag_s": 0.2, "gain": 0.9, "unknown": 1.0})
    all_parameters, fitted = make_parameters(model, values)[None], make_parameters(pinned, values)[None]
    assert fitted.shape[1] == all_parameters.shape[1] - 2
    for one, other in zip(model.motion(all_parameters), pinned.motion(fitted), strict=True):
        assert one == pytest.approx(other)


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


def rows(tuned_result: TunedResult, key: str) -> list[Change]:
    return [change for change in tuned_result.changes if change.key == key]


@pytest.mark.slow
def test_a_flight_changes_the_values_that_it_determines_and_predicts_better(
    flight: tuple[Config, FlightData, Identification],
) -> None:
    config, _, identification = flight
    tuned = tune_config(config, identification)
    tuned_result = tuned.result
    assert tuned_result.new_errors.overall_m < 0.6 * tuned_result.old_errors.overall_m
    for row in rows(tuned_result, "plant.lag_s")[:2] + rows(tuned_result, "plant.drag_1ps"):
        assert row.is_changed and row.new == row.flight
    assert tuned.config.plant.drag_1ps == tuple(change.new for change in rows(tuned_result, "plant.drag_1ps"))
    assert tuned.config.plant.drag_1ps[0] == pytest.approx(0.25, abs=0.05)
    # A calm half minute lowers no noise, and a link that was as believed stays so.
    assert tuned.config.plant.wind_std_mps2 == config.plant.wind_std_mps2
    assert tuned.config.link == config.link
    assert msgspec.structs.replace(tuned.config, name="", plant=config.plant, cost=config.cost) == (
        msgspec.structs.replace(config, name="")
    )


@pytest.mark.slow
def test_an_axis_that_is_not_predicted_is_kept_with_the_reason(
    flight: tuple[Config, FlightData, Identification],
) -> None:
    config, _, identification = flight
    north, *other_axes = identification.result.response
    doubtful = (msgspec.structs.replace(north, r2=0.3), *other_axes)
    result = msgspec.structs.replace(identification.result, response=doubtful)
    tuned = tune_config(config, dataclasses.replace(identification, result=result))
    for key in ("plant.lag_s", "plant.drag_1ps", "plant.gain"):
        row = rows(tuned.result, key)[0]
        assert not row.is_changed and "30 %" in row.reason
        assert rows(tuned.result, key)[1].reason != row.reason


@pytest.mark.slow
def test_an_undetermined_dead_time_is_kept(flight: tuple[Config, FlightData, Identification]) -> None:
    config, _, identification = flight
    flat = msgspec.structs.replace(
        identification.result.candidates[0], dead_time_range_s=(0.02, 0.021 + MAX_DEAD_TIME_RANGE_S)
    )
    result = msgspec.structs.replace(identification.result, candidates=(flat,))
    tuned = tune_config(config, dataclasses.replace(identification, result=result))
    assert tuned.config.plant.dead_time_s == config.plant.dead_time_s
    assert tuned.config.plant.drag_1ps != config.plant.drag_1ps


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
    tuned = tune_config(hopeful, identification).config
    assert tuned.plant.wind_std_mps2 == identification.config.plant.wind_std_mps2
    assert tuned.estimator.position_std_m == identification.config.estimator.position_std_m
    assert tuned.link.loss == pytest.approx(0.3, abs=0.08)
    assert tuned.link.jitter_s == pytest.approx(0.04, abs=0.005)


@pytest.mark.slow
def test_a_halt_of_a_computer_does_not_change_the_link(flight: tuple[Config, FlightData, Identification]) -> None:
    config, _, identification = flight
    stalled = dataclasses.replace(identification, link=dataclasses.replace(identification.link, jitter_s=3.0))
    delayed = dataclasses.replace(identification, link=dataclasses.replace(identification.link, jitter_s=0.1))
    assert tune_config(config, stalled).config.link.jitter_s == config.link.jitter_s
    assert "stood still" in rows(tune_config(config, stalled).result, "link.jitter_s")[0].reason
    assert tune_config(config, delayed).config.link.jitter_s == pytest.approx(0.1, abs=0.005)


@pytest.mark.slow
def test_a_model_that_predicts_no_better_changes_nothing(flight: tuple[Config, FlightData, Identification]) -> None:
    config, _, identification = flight
    fitted = msgspec.structs.replace(config, plant=identification.config.plant)
    tuned_result = tune_config(fitted, identification).result
    assert tuned_result.new_errors.overall_m <= tuned_result.old_errors.overall_m
    assert tuned_result.new_errors.overall_m == pytest.approx(tuned_result.old_errors.overall_m, rel=0.05)


@pytest.mark.slow
def test_the_hold_is_judged_where_the_vehicle_truly_was(flight: tuple[Config, FlightData, Identification]) -> None:
    _, flown, _ = flight
    figures = compute_flight_figures(flown, "flight", 0, BOX)
    assert figures.judged_by == "truth"
    assert figures.hold_s > 2.0
    assert figures.hold_rms_m is not None and 0.0 < figures.hold_rms_m < 0.1
    truth = np.array([sample.state for sample in flown.truths])[:, list(flown.design.position_index)]
    inside = np.minimum(truth - np.array(BOX.lower), np.array(BOX.upper) - truth).min()
    assert figures.beyond_box_m == pytest.approx(-inside, abs=0.03)
    wrong = compute_plan_errors_m(flown)
    assert len(wrong) > 300 and 0.001 < float(np.median(wrong)) < 0.1


def test_a_folder_goes_on_and_refuses_other_runs(tmp_path: Path) -> None:
    folder = TuneFolder.open(tmp_path / "run", room(), ASKED)
    folder.save_progress(before="before/flight.mcap")
    reopened = TuneFolder.open(tmp_path / "run", room(), ASKED)
    assert reopened.progress.before == "before/flight.mcap"
    with pytest.raises(UsageError, match=r"link\.loss = 0\.3 there, 0\.4 here"):
        TuneFolder.open(tmp_path / "run", room("link.loss=0.4"), ASKED)
    with pytest.raises(UsageError, match="--box=b"):
        TuneFolder.open(tmp_path / "run", room(), msgspec.structs.replace(ASKED, box="other"))
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "notes.txt").write_text("mine")
    with pytest.raises(UsageError, match="no run"):
        TuneFolder.open(tmp_path / "other", room(), ASKED)
    (tmp_path / "run" / STATE_FILE).write_text('{"more":' + "[" * 100_000)
    with pytest.raises(UsageError, match="cannot be read"):
        TuneFolder.open(tmp_path / "run", room(), ASKED)
    (tmp_path / "run" / STATE_FILE).write_text("{")
    with pytest.raises(UsageError, match="cannot be read"):
        TuneFolder.open(tmp_path / "run", room(), ASKED)


def test_each_attempt_has_a_separate_folder(tmp_path: Path) -> None:
    folder = TuneFolder.open(tmp_path, room(), ASKED)
    folder.find_free_folder("before").mkdir()
    assert folder.find_free_folder("before").name == "before-2"
    assert folder.make_relative(tmp_path / "before" / "flight.mcap") == "before/flight.mcap"
    assert folder.get_recording_path("before/flight.mcap") == tmp_path / "before" / "flight.mcap"
    assert folder.get_recording_path("/else/flight.mcap") == Path("/else/flight.mcap")
