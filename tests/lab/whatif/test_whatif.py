"""What might have been, beside what then really was: flights of the simulator with one seed are the oracle."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from loopback_rig import Memory, flight, header
from whatif_rig import EXACT, PAPER, QUADROTOR, ROOM, WIRE, Case, again, config_of, far, flown, history, stripped

from logs.recording.topics import encode
from sim.vehicle.linear import LinearVehicle, make_linear_model
from uavctl.build.controller import build_controller, build_design
from uavctl.errors import RecordingError
from uavctl.lab.whatif.comparison import departure_m, model_fit, reproduction, until
from uavctl.lab.whatif.flight import Departure, Entry, Relinked, Response, captures, fly, history_of, response_of
from uavctl.records import Datagram, Decision, Plan, PositionSample, Record, Setpoint, StepInput, Truth


@pytest.mark.slow
@pytest.mark.parametrize("case", [PAPER, ROOM, QUADROTOR], ids=["paper", "room", "quadrotor"])
def test_nothing_changed_is_the_recorded_flight_bit_for_bit(case: Case) -> None:
    memory, course = again(case)
    for kind in (StepInput, Decision, Plan, Setpoint, Datagram, Truth):
        mine, recorded = memory.of(kind), flown(case).of(kind)
        assert len(mine) == len(recorded) > 0
        assert [encode(one) for one in mine] == [encode(one) for one in recorded]
    assert course.departure.begun_ns is None and course.ended == "the recording ends"
    found = reproduction(flight(flown(case)), flight(memory))
    assert found.identical and found.largest_state == found.largest_input == 0.0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("case", "changes", "least"),
    [
        (PAPER, ("target.position_m=[3.0, 1.0, 0.0]",), 1.0),
        (PAPER, ("cost.input=[20.0, 20.0]",), 1.0),
        (PAPER, ("schedule.delays=4", "smpc.delta_x=0.9"), 0.01),
        (ROOM, ("target.position_m=[0.5, 0.5, -1.0]",), 0.5),
    ],
    ids=["paper-target", "paper-cost", "paper-schedule", "room-target"],
)
def test_the_flight_that_might_have_been_is_the_one_that_is_then_flown(
    case: Case, changes: tuple[str, ...], least: float
) -> None:
    memory, _ = again(case, *changes)
    real = flown(case, *changes)
    assert far(memory, flown(case)) > least  # it is another flight than the recorded one
    assert far(memory, real) < WIRE
    ages = [[one.age_steps for one in side.of(Decision)] for side in (memory, real)]
    assert ages[0] == ages[1]


@pytest.mark.slow
def test_another_link_loses_what_it_would_have_lost() -> None:
    changes = ("link.loss=0.1", "schedule.delays=5")
    other = Relinked(history(PAPER), config_of(PAPER, *changes).link, config_of(PAPER).sim.seed, 0.0)
    memory, _ = again(PAPER, *changes, other=other)
    real = flown(PAPER, *changes)
    assert memory.of(Truth)[-1].lost == real.of(Truth)[-1].lost != flown(PAPER).of(Truth)[-1].lost
    assert memory.of(Truth)[-1].sent == real.of(Truth)[-1].sent
    ages = [[one.age_steps for one in side.of(Decision)] for side in (memory, real)]
    assert ages[0] == ages[1]
    assert far(memory, real) < WIRE  # the cameras of `paper` see at the boundaries, where the truth is recorded


@pytest.mark.slow
def test_another_link_between_the_boundaries_puts_lost_positions_back_to_a_millimetre() -> None:
    quiet: Case = ("room-hahn-stursberg", 8.0, (*EXACT, "sim.camera.noise_std_m=0.0"))
    change = "link.loss=0.1"
    other = Relinked(history(quiet), config_of(quiet, change).link, config_of(quiet).sim.seed, 0.0)
    memory, _ = again(quiet, change, other=other)
    real = flown(quiet, change)
    assert memory.of(Truth)[-1].lost == real.of(Truth)[-1].lost < flown(quiet).of(Truth)[-1].lost
    assert far(memory, flown(quiet)) > 0.05
    assert far(memory, real) < 2e-3


def test_positions_that_were_lost_are_put_back_in_their_places() -> None:
    recorded = history(ROOM)
    camera = recorded.config.sim.camera
    found = captures(recorded, lambda: np.zeros(3))
    # All but those after the last that came, which nobody knows of; the last truth is from before the last capture.
    assert -1 <= recorded.flight.truths[-1].sent - len(found) < 5
    expected = [round((camera.phase_s + i / camera.rate_hz) * 1e9) for i in range(len(found))]
    assert np.abs(np.array([one.at_ns for one in found]) - np.array(expected)).max() <= 1000
    assert sum(one.stamp_us is not None for one in found) > 5


def test_a_link_that_loses_all_ends_in_the_fallback() -> None:
    link = msgspec.structs.replace(config_of(ROOM).link, blackout=((1.0, 100.0),))
    memory, course = again(ROOM, other=Relinked(history(ROOM), link, 1, 0.0))
    assert {one.mode.value for one in memory.of(Decision)} >= {"track", "brake"}
    assert "landing" in course.ended or course.ended == "the recording ends"
    assert memory.of(Truth)[-1].lost > 0


@pytest.mark.slow
def test_quadrotor_and_model_disagree_and_the_fit_says_so() -> None:
    change = "target.position_m=[0.5, 0.5, -1.0]"
    memory, _ = again(QUADROTOR, change)
    real = flight(flown(QUADROTOR, change))
    moved = departure_m(flight(flown(QUADROTOR)), real)
    wrong = departure_m(flight(memory), real)
    assert moved > 0.5 and 1e-3 < wrong < 0.2 * moved
    fits = [
        model_fit(history(case), response_of(history(case), config_of(case).plant), "own") for case in (ROOM, QUADROTOR)
    ]
    assert all(fit.r2 is not None and fit.moves > 20 for fit in fits)
    assert (fits[0].r2 or 0.0) > (fits[1].r2 or 1.0) > 0.8
    assert (fits[0].rms_m or 1.0) < (fits[1].rms_m or 0.0)


def test_departure_is_the_difference_of_two_vehicles_in_the_same_wind() -> None:
    config = config_of(ROOM)
    one, other = (LinearVehicle(config, np.random.SeedSequence(3), 0) for _ in range(2))
    departure = Departure(Response(one.model))
    assert departure.begun_ns is None
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
    assert departure.begun_ns == 500_000_000
    at_ns = 2_013_000_000
    one.advance(at_ns)
    other.advance(at_ns)
    np.testing.assert_allclose(departure.state(at_ns), other.state - one.state, atol=1e-12)
    np.testing.assert_allclose(departure.position_m(at_ns), np.subtract(other.position_m, one.position_m), atol=1e-12)
    np.testing.assert_allclose(
        departure.velocity_mps(at_ns), np.subtract(other.velocity_mps, one.velocity_mps), atol=1e-12
    )
    np.testing.assert_allclose(
        departure.acceleration_mps2(at_ns), np.subtract(other.acceleration_mps2, one.acceleration_mps2), atol=1e-12
    )
    assert not departure.state(400_000_000).any() and departure.acceleration_mps2(400_000_000) == (0.0, 0.0, 0.0)


def test_what_is_sent_acts_after_the_dead_time() -> None:
    model = make_linear_model(config_of(ROOM).plant)
    at_once, late = Departure(Response(model)), Departure(Response(model, 120_000_000))
    for at_ns, accel in ((0, (1.0, -0.5, 0.2)), (50_000_000, (0.3, 0.0, -0.1)), (900_000_000, (0.0, 0.0, 0.0))):
        at_once.steer(at_ns, accel)
        late.steer(at_ns, accel)
        np.testing.assert_array_equal(late.input(at_ns), at_once.input(at_ns))  # it is sent all the same
    assert late.begun_ns == 120_000_000
    for at_ns in (0, 33_000_000, 50_000_000, 700_000_000, 2_000_000_000):
        then_ns = at_ns + 120_000_000
        np.testing.assert_allclose(late.state(then_ns), at_once.state(at_ns), atol=1e-15)
        np.testing.assert_allclose(late.acceleration_mps2(then_ns), at_once.acceleration_mps2(at_ns), atol=1e-15)
    assert late.acceleration_mps2(119_999_999) == (0.0, 0.0, 0.0)


def test_too_few_positions_and_no_setpoints_are_refused() -> None:
    def blind(record: Record) -> Record:
        return msgspec.structs.replace(record, samples=()) if isinstance(record, StepInput) else record

    nothing = [(topic, at_ns, blind(record)) for topic, at_ns, record in flown(PAPER).entries]
    with pytest.raises(RecordingError, match=r"^a: .* 0 positions .* at least 2"):
        history_of(nothing, config_of(PAPER), "a")
    with pytest.raises(RecordingError, match="never took a setpoint"):
        history_of(stripped(PAPER, Setpoint), config_of(PAPER), "a")
    with pytest.raises(RecordingError, match="no decision"):
        history_of(stripped(PAPER, Decision), config_of(PAPER), "a")


def test_a_recorded_flight_that_ends_early_ends_the_comparison() -> None:
    end_ns = 12_000_000_000
    cut = [entry for entry in flown(PAPER).entries if not (isinstance(entry[2], Setpoint) and entry[1] > end_ns)]
    memory = Memory()
    config = config_of(PAPER)
    shortened = history_of(cut, config, "x")
    response = response_of(shortened, config.plant)
    course = fly(shortened, config, build_controller(config), response, memory, lambda: 0)
    assert course.end_ns == end_ns and "no setpoint" in course.ended
    assert memory.entries[-1][1] < end_ns + 1_000_000_000
    assert max(at_ns for _, at_ns, _ in until(memory.entries, end_ns)) == end_ns


def test_bytes_of_a_stream_are_read_in_whole_frames_wherever_they_are_cut() -> None:
    config = config_of(PAPER, "daemon.mocap=tcp:127.0.0.1:1")
    cut: list[Entry] = []
    rest = b""
    for topic, at_ns, record in flown(PAPER).entries:
        if isinstance(record, Datagram) and record.link == "mocap" and not record.outgoing:
            data = rest + record.data
            cut.append((topic, at_ns, msgspec.structs.replace(record, data=data[:-7])))
            rest = data[-7:]
        else:
            cut.append((topic, at_ns, record))
    make_whole_component = [one.data for one in flown(PAPER).of(Datagram) if one.link == "mocap" and not one.outgoing]
    read = [
        one.data
        for _, _, one in history_of(cut, config, "x").entries
        if isinstance(one, Datagram) and one.link == "mocap" and not one.outgoing
    ]
    assert read[0] == b"" and read[1:] == make_whole_component[:-1]


def test_captures_know_the_simulated_cameras_clock() -> None:
    recorded = history(ROOM)
    believed: list[PositionSample] = [one for some in recorded.samples.values() for one in some]
    assert len(believed) > 10
    found = captures(recorded, lambda: np.zeros(3))
    delays_s = [(one.captured_ns % 200_000_000 - 100_000_000) * 1e-9 for one in believed]
    assert min(delays_s) > 0.025  # the controller, which knows no shortest delay, takes them for newer than they are
    assert all(abs(one.at_ns % 200_000_000 - 100_000_000) <= 1000 for one in found)


@pytest.mark.slow
def test_without_the_truth_estimates_and_a_spline_take_its_place() -> None:
    config = config_of(ROOM)
    blind = history_of(stripped(ROOM, Truth), config, "x")
    controller, response = build_controller(config), response_of(blind, config.plant)
    same, other = Memory(), Memory()
    fly(blind, config, controller, response, same, lambda: 0)
    assert [encode(one) for one in same.of(Decision)] == [encode(one) for one in flown(ROOM).of(Decision)]
    link = msgspec.structs.replace(config.link, loss=0.0)
    fly(blind, config, controller, response, other, lambda: 0, Relinked(blind, link, 2, 0.005))
    for memory in (same, other):
        memory.put("/uavctl/header", 0, header(config, build_design(config)))
    assert not other.of(Truth)
    assert 0.001 < departure_m(flight(same), flight(other)) < 0.5
    assert sum(one.accepted for one in other.of(Decision)) > sum(one.accepted for one in same.of(Decision)) + 5
    fit = model_fit(blind, response, "own")
    assert fit.moves > 20 and fit.r2 is not None and fit.r2 > 0.8
    put_back = [one for one in captures(blind, lambda: np.zeros(3)) if one.stamp_us is not None]
    known = {one.stamp_us or 0: one for one in captures(history(ROOM), lambda: np.zeros(3)) if one.stamp_us is not None}
    off_m = [
        np.linalg.norm(
            np.add(one.seen.position_m, one.by_m)
            - np.add(known[one.stamp_us or 0].seen.position_m, known[one.stamp_us or 0].by_m)
        )
        for one in put_back
    ]
    assert len(put_back) == len(known) and max(off_m) < 0.1
