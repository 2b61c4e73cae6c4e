"""Inertial data of the flight that might have been: what its sensors would have said, as a flight then really shows."""

from __future__ import annotations

import math
from collections import Counter

import numpy as np
import pytest
from loopback_rig import MemorySink
from whatif_rig import Case, fly_again, fly_case, history, load_case_config

from logs.recording.topics import encode
from uavctl.arrays import Array
from uavctl.lab.whatif.comparison import fit_model
from uavctl.lab.whatif.flight import SimulatedLink, VehicleResponse, make_response
from uavctl.records import Datagram, Decision, Event, Plan, Setpoint, StepInput, Truth, Vec3

HOLDS_FROM_NS = 10_000_000_000
PX4: Case = ("room-px4", 15.0, ())
ARDUPILOT: Case = ("room-ardupilot", 15.0, ())
LINEAR: Case = ("room", 10.0, ())
LINEAR_ARDUPILOT: Case = ("room", 10.0, ("sim.autopilot=ardupilot",))
TARGET: Vec3 = (0.5, 0.5, -1.0)
ELSEWHERE = "target.position_m=[0.5, 0.5, -1.0]"


@pytest.mark.slow
@pytest.mark.parametrize("case", [PX4, ARDUPILOT], ids=["px4", "ardupilot"])
def test_nothing_changed_is_the_recorded_flight_bit_for_bit(case: Case) -> None:
    memory, course = fly_again(case)
    for kind in (StepInput, Decision, Plan, Setpoint, Datagram, Truth):
        reproduced, recorded = memory.of(kind), fly_case(case).of(kind)
        assert len(reproduced) == len(recorded) > 0
        assert [encode(record) for record in reproduced] == [encode(record) for record in recorded]
    assert sum(len(step_input.inertial) for step_input in memory.of(StepInput)) > 500
    assert course.deviation.first_acting_ns is None


@pytest.mark.long
@pytest.mark.parametrize(
    ("case", "change"),
    [(LINEAR, ELSEWHERE), (LINEAR_ARDUPILOT, "cost.input=[3.0, 3.0, 3.0]")],
    ids=["px4-target", "ardupilot-cost"],
)
def test_on_the_linear_plant_moved_inertial_data_equal_those_of_a_flight(case: Case, change: str) -> None:
    memory, _ = fly_again(case, change)
    real = fly_case(case, change)
    feels, truly, recorded = (felt(side) for side in (memory, real, fly_case(case)))
    assert feels.shape == truly.shape == recorded.shape
    assert np.abs(recorded - truly).max() > 0.25  # the recorded ones would have been wrong
    # The attitude that is told errs by a few thousandths, and RAW_IMU is rounded twice, to 0.01 m/s². Plans are made of
    # that in each step from the first on, and where they all but tie they go another way for a few ticks.
    off = np.abs(feels - truly).max(axis=1)
    assert np.quantile(off, 0.9) < 0.035
    predicted, truly_own = (velocities(side) for side in (memory, real))
    assert len(predicted) > 100 and np.abs(predicted - truly_own).max() < 0.04
    assert largest_m(memory, real) < 0.02


@pytest.mark.long
@pytest.mark.parametrize(
    ("case", "change", "target"),
    [
        (PX4, ELSEWHERE, TARGET),
        (ARDUPILOT, ELSEWHERE, TARGET),
        (PX4, "cost.input=[3.0, 3.0, 3.0]", None),
        (ARDUPILOT, "link.loss=0.6", None),
    ],
    ids=["px4-target", "ardupilot-target", "px4-cost", "ardupilot-loss"],
)
def test_the_what_if_of_a_quadrotor_holds_as_a_flight_does(case: Case, change: str, target: Vec3 | None) -> None:
    max_error_m = 0.05  # 0.01 to 0.043 m, as the level of the budgets changes a few steps earlier or later
    other = None
    if change.startswith("link."):
        before = load_case_config(case).sim
        other = SimulatedLink(
            history(case), load_case_config(case, change).link, before.seed, before.camera.noise_std_m
        )
    memory, _ = fly_again(case, change, other_link=other)
    real = fly_case(case, change)
    place = target or load_case_config(case).target.position_m
    assert not inertial_events(real) and not inertial_events(memory)
    assert 0.9 < hold_m(memory, place) / hold_m(real, place) < 1.1
    assert hold_m(memory, place) < 0.02
    assert largest_m(memory, real) < max_error_m < largest_m(real, fly_case(case)) + max_error_m
    assert felt(memory).shape == felt(fly_case(case)).shape and len(felt(memory)) > 500


@pytest.mark.slow
@pytest.mark.parametrize("case", [PX4, ARDUPILOT], ids=["px4", "ardupilot"])
def test_the_dead_time_belongs_to_the_model(case: Case) -> None:
    response = make_response(history(case), load_case_config(case).plant)
    assert response.dead_time_ns == round(load_case_config(case).plant.dead_time_s * 1e9) > 0
    delayed, at_once = (
        fit_model(history(case), candidate, "own") for candidate in (response, VehicleResponse(response.model))
    )
    assert delayed.rms_m is not None and at_once.rms_m is not None
    assert delayed.rms_m < at_once.rms_m and delayed.moves > 250
    assert make_response(history(LINEAR), load_case_config(LINEAR).plant).dead_time_ns == 0


def inertial_events(memory: MemorySink) -> Counter[str]:
    return Counter(event.code for event in memory.of(Event) if event.code.startswith("inertial-"))


def felt(memory: MemorySink) -> Array:
    """Accelerations (n, 3) that the controller read of inertial data."""
    return np.array([sample.accel_mps2 for step_input in memory.of(StepInput) for sample in step_input.inertial])


def velocities(memory: MemorySink) -> Array:
    """The vehicle's own velocities (n, 3), as ticks knew them."""
    return np.array(
        [
            step_input.motion.velocity_mps
            for step_input in memory.of(StepInput)
            if step_input.motion and step_input.motion.velocity_mps
        ]
    )


def hold_m(memory: MemorySink, place: Vec3) -> float:
    """Distance of the true positions from a place, root mean square."""
    positions = [truth.position_m for truth in memory.of(Truth) if truth.at_ns >= HOLDS_FROM_NS]
    return float(np.sqrt(np.mean(np.sum(np.square(np.array(positions) - np.array(place)), axis=1))))


def largest_m(first_memory: MemorySink, other_memory: MemorySink) -> float:
    """Largest distance of the true positions."""
    return max(
        math.dist(a.position_m, b.position_m)
        for a, b in zip(first_memory.of(Truth), other_memory.of(Truth), strict=True)
    )
