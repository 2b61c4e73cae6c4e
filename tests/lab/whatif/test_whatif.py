"""What might have been, beside what then really was: flights of the simulator with one seed are the oracle."""

from __future__ import annotations

import dataclasses
import math

import msgspec
import numpy as np
import pytest
from loopback_rig import MemorySink, flight, header, make_loop, share_flight
from whatif_rig import (
    EXACT,
    PAPER,
    QUADROTOR,
    ROOM,
    WIRE,
    Case,
    compute_differences,
    fly_again,
    fly_case,
    history,
    load_case_config,
    strip_recording,
)

from logs.recording.replay import replay
from logs.recording.topics import encode
from sim.vehicle.linear import LinearVehicle, make_linear_model
from uavctl.account import make_ending
from uavctl.cause import CAUSES, Cause
from uavctl.errors import RecordingError
from uavctl.lab.whatif.comparison import compare_reproduction, compute_max_distance_m, cut_entries, fit_model
from uavctl.lab.whatif.flight import (
    Deviation,
    SimulatedLink,
    VehicleResponse,
    find_captures,
    make_recorded_flight,
    make_response,
    refly,
)
from uavctl.records import Datagram, Decision, Plan, Record, Setpoint, StepInput, Truth
from uavctl.wiring.controller import build_controller, build_design


@pytest.mark.slow
@pytest.mark.parametrize("case", [PAPER, ROOM, QUADROTOR], ids=["paper", "room", "quadrotor"])
def test_nothing_changed_is_the_recorded_flight_bit_for_bit(case: Case) -> None:
    memory, course = fly_again(case)
    for kind in (StepInput, Decision, Plan, Setpoint, Datagram, Truth):
        reproduced, recorded = memory.of(kind), fly_case(case).of(kind)
        assert len(reproduced) == len(recorded) > 0
        assert [encode(record) for record in reproduced] == [encode(record) for record in recorded]
    assert course.deviation.first_acting_ns is None and course.ended == "the recording ends"
    result = compare_reproduction(flight(fly_case(case)), flight(memory))
    assert result.identical and result.largest_state == result.largest_input == 0.0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("case", "changes", "min_difference"),
    [
        (PAPER, ("target.position_m=[3.0, 1.0, 0.0]",), 1.0),
        (PAPER, ("cost.input=[20.0, 20.0]",), 1.0),
        (PAPER, ("schedule.delays=4", "smpc.delta_x=0.9"), 0.01),
        (ROOM, ("target.position_m=[0.5, 0.5, -1.0]",), 0.5),
    ],
    ids=["paper-target", "paper-cost", "paper-schedule", "room-target"],
)
def test_the_what_if_equals_a_flight_with_the_changed_configuration(
    case: Case, changes: tuple[str, ...], min_difference: float
) -> None:
    memory, _ = fly_again(case, *changes)
    real = fly_case(case, *changes)
    assert compute_differences(memory, fly_case(case)) > min_difference  # it is another flight than the recorded one
    assert compute_differences(memory, real) < WIRE
    ages = [[decision.age_steps for decision in side.of(Decision)] for side in (memory, real)]
    assert ages[0] == ages[1]


@pytest.mark.slow
def test_another_link_loses_the_same_positions_as_in_a_flight() -> None:
    changes = ("link.loss=0.1", "schedule.delays=5")
    other = SimulatedLink(history(PAPER), load_case_config(PAPER, *changes).link, load_case_config(PAPER).sim.seed, 0.0)
    memory, _ = fly_again(PAPER, *changes, other_link=other)
    real = fly_case(PAPER, *changes)
    assert memory.of(Truth)[-1].lost == real.of(Truth)[-1].lost != fly_case(PAPER).of(Truth)[-1].lost
    assert memory.of(Truth)[-1].sent == real.of(Truth)[-1].sent
    ages = [[decision.age_steps for decision in side.of(Decision)] for side in (memory, real)]
    assert ages[0] == ages[1]
    assert (
        compute_differences(memory, real) < WIRE
    )  # the cameras of `paper` see at the boundaries, where the truth is recorded


def test_a_what_if_replays_from_its_own_inputs() -> None:
    changes = ("target.position_m=[0.5, 0.5, -1.0]", "link.loss=0.1")
    config = load_case_config(ROOM, *changes)
    memory, _ = fly_again(ROOM, *changes, other_link=SimulatedLink(history(ROOM), config.link, 1, 0.005))
    assert replay(memory.entries, lambda sink: make_loop(config, sink), moved_inputs=True).identical
    assert not replay(memory.entries, lambda sink: make_loop(config, sink)).identical


@pytest.mark.slow
def test_another_link_restores_lost_positions_between_the_boundaries_to_a_millimetre() -> None:
    quiet: Case = ("room-hahn-stursberg", 8.0, (*EXACT, "sim.camera.noise_std_m=0.0"))
    change = "link.loss=0.1"
    other = SimulatedLink(history(quiet), load_case_config(quiet, change).link, load_case_config(quiet).sim.seed, 0.0)
    memory, _ = fly_again(quiet, change, other_link=other)
    real = fly_case(quiet, change)
    assert memory.of(Truth)[-1].lost == real.of(Truth)[-1].lost < fly_case(quiet).of(Truth)[-1].lost
    assert compute_differences(memory, fly_case(quiet)) > 0.05
    assert compute_differences(memory, real) < 2e-3


def test_lost_positions_are_restored_in_order() -> None:
    recorded = history(ROOM)
    camera = recorded.config.sim.camera
    result = find_captures(recorded, lambda: np.zeros(3))
    # All but those after the last that came, which nobody knows of; the last truth is from before the last capture.
    assert -1 <= recorded.flight.truths[-1].sent - len(result) < 5
    assert [recorded.get_capture_ns(sample) for sample in result] == [
        round((camera.phase_s + i / camera.rate_hz) * 1e9) for i in range(len(result))
    ]
    assert [sample for sample in result if sample in recorded.samples] == list(recorded.samples)
    assert len(result) - len(recorded.samples) > 5


@pytest.mark.parametrize(
    ("effect", "share"),
    [({"corrupt": 1.0}, 0), ({"truncate": 1.0}, 0), ({"duplicate": 1.0}, 1), ({"oversize": 1.0}, 1)],
)
def test_a_damaged_position_is_lost_and_a_doubled_one_counts_once(effect: dict[str, float], share: int) -> None:
    link = msgspec.structs.replace(load_case_config(ROOM).link, loss=0.0, **effect)
    other = SimulatedLink(history(ROOM), link, 1, 0.0)
    arrived = list(other.pop_due(100_000_000_000, lambda sample: sample))
    captures = find_captures(history(ROOM), lambda: np.zeros(3))
    assert other.counts == (len(captures), 0)
    places = sorted(sample.position_m for sample in arrived)
    assert places == sorted(sample.position_m for sample in captures) * share


def test_a_link_that_loses_all_ends_in_the_fallback() -> None:
    link = msgspec.structs.replace(load_case_config(ROOM).link, blackout=((1.0, 100.0),))
    memory, course = fly_again(ROOM, other_link=SimulatedLink(history(ROOM), link, 1, 0.0))
    assert {decision.mode.value for decision in memory.of(Decision)} >= {"track", "brake"}
    assert "landing" in course.ended or course.ended == "the recording ends"
    assert memory.of(Truth)[-1].lost > 0


@pytest.mark.slow
def test_the_fit_shows_the_model_error_of_a_quadrotor() -> None:
    change = "target.position_m=[0.5, 0.5, -1.0]"
    memory, _ = fly_again(QUADROTOR, change)
    real = flight(fly_case(QUADROTOR, change))
    moved = compute_max_distance_m(flight(fly_case(QUADROTOR)), real)
    wrong = compute_max_distance_m(flight(memory), real)
    assert moved > 0.5 and 1e-3 < wrong < 0.2 * moved
    fits = [
        fit_model(history(case), make_response(history(case), load_case_config(case).plant), "own")
        for case in (ROOM, QUADROTOR)
    ]
    assert all(fit.r2 is not None and fit.moves > 20 for fit in fits)
    assert (fits[0].r2 or 0.0) > (fits[1].r2 or 1.0) > 0.8
    assert (fits[0].rms_m or 1.0) < (fits[1].rms_m or 0.0)


def test_the_deviation_is_the_difference_of_two_vehicles_in_the_same_wind() -> None:
    config = load_case_config(ROOM)
    one, other = (LinearVehicle(config, np.random.SeedSequence(3), 0) for _ in range(2))
    departure = Deviation(VehicleResponse(one.model))
    assert departure.first_acting_ns is None
    rng = np.random.default_rng(1)
    for tick in range(40):
        at_ns = tick * 50_000_000
        one.advance(at_ns)
        other.advance(at_ns)
        accel = rng.normal(size=3)
        apart = rng.normal(size=3) if tick >= 10 else np.zeros(3)
        one.accelerate((accel[0], accel[1], accel[2]))
        other.accelerate(tuple((accel + apart).tolist()))
        departure.steer(at_ns, tuple(apart.tolist()))
    assert departure.first_acting_ns == 500_000_000
    at_ns = 2_013_000_000
    one.advance(at_ns)
    other.advance(at_ns)
    np.testing.assert_allclose(departure.get_state(at_ns), other.state - one.state, atol=1e-12)
    np.testing.assert_allclose(
        departure.get_position_m(at_ns), np.subtract(other.position_m, one.position_m), atol=1e-12
    )
    np.testing.assert_allclose(
        departure.get_velocity_mps(at_ns), np.subtract(other.velocity_mps, one.velocity_mps), atol=1e-12
    )
    np.testing.assert_allclose(
        departure.get_acceleration_mps2(at_ns), np.subtract(other.acceleration_mps2, one.acceleration_mps2), atol=1e-12
    )
    assert not departure.get_state(400_000_000).any() and departure.get_acceleration_mps2(400_000_000) == (
        0.0,
        0.0,
        0.0,
    )


def test_a_setpoint_acts_after_the_dead_time() -> None:
    model = make_linear_model(load_case_config(ROOM).plant)
    at_once, delayed = Deviation(VehicleResponse(model)), Deviation(VehicleResponse(model, 120_000_000))
    for at_ns, accel in ((0, (1.0, -0.5, 0.2)), (50_000_000, (0.3, 0.0, -0.1)), (900_000_000, (0.0, 0.0, 0.0))):
        at_once.steer(at_ns, accel)
        delayed.steer(at_ns, accel)
        np.testing.assert_array_equal(delayed.get_input(at_ns), at_once.get_input(at_ns))  # it is sent all the same
    assert delayed.first_acting_ns == 120_000_000
    for at_ns in (0, 33_000_000, 50_000_000, 700_000_000, 2_000_000_000):
        then_ns = at_ns + 120_000_000
        np.testing.assert_allclose(delayed.get_state(then_ns), at_once.get_state(at_ns), atol=1e-15)
        np.testing.assert_allclose(
            delayed.get_acceleration_mps2(then_ns), at_once.get_acceleration_mps2(at_ns), atol=1e-15
        )
    assert delayed.get_acceleration_mps2(119_999_999) == (0.0, 0.0, 0.0)


def test_too_few_positions_and_no_setpoints_are_refused() -> None:
    def blind(record: Record) -> Record:
        return msgspec.structs.replace(record, samples=()) if isinstance(record, StepInput) else record

    nothing = [(topic, at_ns, blind(record)) for topic, at_ns, record in fly_case(PAPER).entries]
    with pytest.raises(RecordingError, match=r"^a: .* 0 positions.* at least 2"):
        make_recorded_flight(nothing, load_case_config(PAPER), "a")
    with pytest.raises(RecordingError, match="never took a setpoint"):
        make_recorded_flight(strip_recording(PAPER, Setpoint), load_case_config(PAPER), "a")
    with pytest.raises(RecordingError, match="no decision"):
        make_recorded_flight(strip_recording(PAPER, Decision), load_case_config(PAPER), "a")


def test_a_recorded_flight_that_ends_early_ends_the_comparison() -> None:
    end_ns = 12_000_000_000
    cut = [entry for entry in fly_case(PAPER).entries if not (isinstance(entry[2], Setpoint) and entry[1] > end_ns)]
    memory = MemorySink()
    config = load_case_config(PAPER)
    shortened = make_recorded_flight(cut, config, "x")
    response = make_response(shortened, config.plant)
    course = refly(shortened, config, build_controller(config), response, memory, lambda: 0)
    assert course.end_ns == end_ns and "no more setpoints" in course.ended
    assert memory.entries[-1][1] < end_ns + 1_000_000_000
    assert max(at_ns for _, at_ns, _ in cut_entries(memory.entries, end_ns)) == end_ns


def test_captures_know_the_simulated_cameras_clock() -> None:
    recorded = history(ROOM)
    assert len(recorded.samples) > 10
    delays_s = [(sample.captured_ns % 200_000_000 - 100_000_000) * 1e-9 for sample in recorded.samples]
    assert min(delays_s) > 0.025  # the controller, which knows no shortest delay, takes them for newer than they are
    assert all(recorded.get_capture_ns(sample) % 200_000_000 == 100_000_000 for sample in recorded.samples)


@pytest.mark.slow
def test_without_the_truth_estimates_and_a_spline_take_its_place() -> None:
    config = load_case_config(ROOM)
    blind = make_recorded_flight(strip_recording(ROOM, Truth), config, "x")
    controller, response = build_controller(config), make_response(blind, config.plant)
    same, other = MemorySink(), MemorySink()
    refly(blind, config, controller, response, same, lambda: 0)
    assert [encode(decision) for decision in same.of(Decision)] == [
        encode(decision) for decision in fly_case(ROOM).of(Decision)
    ]
    link = msgspec.structs.replace(config.link, loss=0.0)
    refly(blind, config, controller, response, other, lambda: 0, SimulatedLink(blind, link, 2, 0.005))
    for memory in (same, other):
        memory.put("/uavctl/header", 0, header(config, build_design(config)))
    assert not other.of(Truth)
    assert 0.001 < compute_max_distance_m(flight(same), flight(other)) < 0.5
    assert (
        sum(decision.accepted for decision in other.of(Decision))
        > sum(decision.accepted for decision in same.of(Decision)) + 5
    )
    fit = fit_model(blind, response, "own")
    assert fit.moves > 20 and fit.r2 is not None and fit.r2 > 0.8
    put_back, known = (
        [sample for sample in find_captures(flown, lambda: np.zeros(3)) if sample not in flown.samples]
        for flown in (blind, history(ROOM))
    )
    assert [sample.captured_ns for sample in put_back] == [sample.captured_ns for sample in known]
    assert (
        len(put_back) > 5
        and max(math.dist(a.position_m, b.position_m) for a, b in zip(put_back, known, strict=True)) < 0.1
    )


@pytest.mark.slow
@pytest.mark.parametrize("ending", [Cause.PILOT, Cause.ENDED_BY_OPERATOR])
def test_a_comparison_ends_where_the_pilot_takes_over(ending: Cause) -> None:
    """The vehicle takes no setpoint from 4 s on, as the recording tells."""
    whole = history(ROOM)
    taken_ns = whole.flight.origin_ns + 4_000_000_000
    taken = dataclasses.replace(
        whole,
        takes_setpoints={at_ns: takes and at_ns < taken_ns for at_ns, takes in whole.takes_setpoints.items()},
        flight=dataclasses.replace(whole.flight, endings=(make_ending(ending, ""),)),
    )
    config, memory = load_case_config(ROOM), MemorySink()
    design, controller = share_flight(config)
    memory.put("/uavctl/header", 0, header(config, design))
    course = refly(taken, config, controller, make_response(taken, config.plant), memory, lambda: 0)
    assert 0 < taken_ns - course.end_ns <= whole.flight.tick_ns
    assert (course.ended == CAUSES[Cause.PILOT].phrase) == (ending is Cause.PILOT)
