"""Inertial data of the flight that might have been: what its sensors would have said, as a flight then really shows."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np
import pytest
from inertial_rig import ATTITUDE, HIGHRES, QUATERNION
from loopback_rig import MemorySink
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from whatif_rig import Case, fly_again, fly_case, history, load_case_config

from logs.recording.topics import encode
from uavctl.arrays import Array
from uavctl.frames import Quaternion, quaternion_from_euler, rotate_vector
from uavctl.lab.whatif.comparison import fit_model
from uavctl.lab.whatif.flight import SimulatedLink, VehicleResponse, make_recorded_flight, make_response, refly
from uavctl.lab.whatif.rewrite import InertialFrames, add_acceleration
from uavctl.mavlink.codec import decode
from uavctl.mavlink.framing import RawFrame, scan_frames
from uavctl.mavlink.vehicle import VehicleMonitor
from uavctl.records import Datagram, Decision, Event, InertialSample, Plan, Setpoint, StepInput, Truth, Vec3
from uavctl.wiring.controller import build_controller

MILLI_G_MPS2 = 9.80665e-3
BY: Vec3 = (0.7, -1.3, 0.4)
LEANING: Vec3 = (0.21, -0.13, 2.4)  # roll, pitch, yaw [rad]
HOLDS_FROM_NS = 10_000_000_000
PX4: Case = ("room-px4", 15.0, ())
ARDUPILOT: Case = ("room-ardupilot", 15.0, ())
LINEAR: Case = ("room", 10.0, ())
LINEAR_ARDUPILOT: Case = ("room", 10.0, ("sim.autopilot=ardupilot",))
TARGET: Vec3 = (0.5, 0.5, -1.0)
ELSEWHERE = "target.position_m=[0.5, 0.5, -1.0]"


@dataclass
class Speaker:
    """A vehicle that says what it is told to."""

    autopilot: int = mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA
    number: int = 0

    def says(self, name: str, *fields: Any, first_version: bool = False) -> RawFrame:
        mav = mavlink.MAVLink(None, 1, 1)
        mav.seq, self.number = self.number, self.number + 1
        packed = getattr(mavlink, f"MAVLink_{name}_message")(*fields).pack(mav, force_mavlink1=first_version)
        (frame,) = scan_frames(bytes(packed), final=True).frames
        return frame

    def beat(self) -> RawFrame:
        return self.says("heartbeat", mavlink.MAV_TYPE_QUADROTOR, self.autopilot, 0, 0, 4, 3)

    def leans(self, stamp_ms: int, *, quaternion: bool, angles: Vec3 = LEANING) -> RawFrame:
        if quaternion:
            return self.says("attitude_quaternion", stamp_ms, *turn(angles), 0.0, 0.0, 0.0)
        return self.says("attitude", stamp_ms, *angles, 0.0, 0.0, 0.0)

    def feels(self, kind: str, stamp_us: int, force: Vec3, *, first_version: bool = False) -> RawFrame:
        if kind == "highres_imu":
            return self.says(kind, stamp_us, *force, *(0.01, 0.02, 0.03), *(0.0,) * 7, 63, first_version=first_version)
        milli_g = [round(component / MILLI_G_MPS2) for component in force]
        stamp = stamp_us if kind == "raw_imu" else stamp_us // 1000
        return self.says(kind, stamp, *milli_g, 1, 2, 3, 0, 0, 0, first_version=first_version)


def turn(angles: Vec3) -> Quaternion:
    attitude = quaternion_from_euler(angles)
    assert attitude is not None
    return attitude


def force_of(frame: bytes) -> Vec3:
    message: Any = mavlink.MAVLink(None).decode(bytearray(frame))
    unit = 1.0 if message.get_type() == "HIGHRES_IMU" else MILLI_G_MPS2
    return unit * message.xacc, unit * message.yacc, unit * message.zacc


@pytest.mark.parametrize("first_version", [False, True])
@pytest.mark.parametrize(
    ("kind", "resolution"), [("highres_imu", 2e-6), ("raw_imu", MILLI_G_MPS2 / 2), ("scaled_imu2", MILLI_G_MPS2 / 2)]
)
def test_a_shifted_specific_force_adds_the_acceleration(kind: str, resolution: float, first_version: bool) -> None:
    speaker, attitude = Speaker(number=200), turn(LEANING)
    frame = speaker.feels(kind, 5_000_000, (0.31, -0.42, -9.77), first_version=first_version)
    moved = add_acceleration(frame, attitude, BY)
    was, moved_force = (rotate_vector(attitude, force_of(data)) for data in (frame.data, moved))
    assert was is not None and moved_force is not None
    # The rounding of three fields, turned.
    np.testing.assert_allclose(np.subtract(moved_force, was), BY, atol=math.sqrt(3.0) * resolution)
    before, after = (mavlink.MAVLink(None).decode(bytearray(data)) for data in (frame.data, moved))
    assert moved[0] == frame.data[0] and after.get_seq() == 200 and after.get_srcSystem() == 1
    for name in set(before.fieldnames) - {"xacc", "yacc", "zacc"}:
        assert getattr(before, name) == getattr(after, name)
    assert add_acceleration(frame, attitude, (0.0, 0.0, 0.0)) == frame.data


def test_values_beyond_the_range_of_a_message_are_clipped() -> None:
    frame = Speaker().feels("raw_imu", 5_000_000, (310.0, 0.0, -310.0))
    assert force_of(add_acceleration(frame, (1.0, 0.0, 0.0, 0.0), (50.0, 0.0, -50.0))) == pytest.approx(
        (32767 * MILLI_G_MPS2, 0.0, -32768 * MILLI_G_MPS2)
    )


@pytest.mark.parametrize(
    ("autopilot", "quaternion", "kind", "resolution"),
    [
        (mavlink.MAV_AUTOPILOT_PX4, True, "highres_imu", 2e-6),
        (mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, False, "raw_imu", MILLI_G_MPS2 / 2),
    ],
    ids=["px4", "ardupilot"],
)
def test_the_controller_reads_the_added_acceleration(
    autopilot: int, quaternion: bool, kind: str, resolution: float
) -> None:
    speaker = Speaker(autopilot)
    frames = InertialFrames(load_case_config(LINEAR).daemon)
    recorded, other = (VehicleMonitor(lambda _: None, (245, 191), inertial=True) for _ in range(2))
    read: tuple[list[InertialSample], list[InertialSample]] = ([], [])
    sent_frames = [speaker.beat()]
    for i in range(20):
        sent_frames.append(speaker.leans(1000 + 20 * i, quaternion=quaternion, angles=(0.01 * i, -0.02 * i, 0.3 * i)))
        sent_frames.append(speaker.feels(kind, 1_000_000 + 20_000 * i, (0.3 + 0.1 * i, -0.1 * i, -9.8)))
    for place, frame in enumerate(sent_frames):
        at_ns = 10_000_000 * place
        data = frames.rewrite(frame, at_ns, BY)
        for bytes_of, watch, heard in ((frame.data, recorded, read[0]), (data, other, read[1])):
            for message in decode(bytes_of).messages:
                heard += [item for item in watch.handle_message(message, at_ns) if isinstance(item, InertialSample)]
    assert len(read[0]) == len(read[1]) == frames.moved == 20 and frames.dropped == 0
    more = [np.subtract(moved_force.accel_mps2, was.accel_mps2) for was, moved_force in zip(*read, strict=True)]
    np.testing.assert_allclose(more, [BY] * 20, atol=math.sqrt(3.0) * resolution)


def test_frames_that_cannot_be_rewritten_are_dropped_once_the_courses_differ() -> None:
    speaker, frames = Speaker(), InertialFrames(load_case_config(LINEAR).daemon)

    def heard(frame: RawFrame, at_ms: int, by: Vec3 | None = BY) -> bool:
        return bool(frames.rewrite(frame, at_ms * 1_000_000, by))

    assert heard(speaker.beat(), 0) and heard(speaker.feels("raw_imu", 5000, (0.1, 0.0, -9.8)), 5, None)
    assert not heard(speaker.feels("raw_imu", 10_000, (0.2, 0.0, -9.8)), 10)  # no attitude yet
    assert heard(speaker.leans(12, quaternion=False), 12)
    assert heard(speaker.feels("raw_imu", 20_000, (0.3, 0.0, -9.8)), 20)
    assert not heard(speaker.feels("raw_imu", 20_000, (0.3, 0.0, -9.8)), 25)  # said again
    assert not heard(speaker.feels("raw_imu", 45_000, (0.5, 0.0, -9.8)), 145)  # late
    assert not heard(speaker.feels("scaled_imu2", 200_000, (0.5, 0.0, -9.8)), 200)  # the attitude is old
    assert not heard(speaker.feels("highres_imu", 200_000, (0.5, 0.0, math.nan)), 200)
    assert (frames.moved, frames.dropped) == (1, 5)
    other = mavlink.MAVLink_raw_imu_message(220_000, 9, 9, 9, 0, 0, 0, 0, 0, 0).pack(mavlink.MAVLink(None, 2, 1))
    (frame,) = scan_frames(bytes(other), final=True).frames  # nobody follows that vehicle
    assert frames.rewrite(frame, 220_000_000, BY) == frame.data and (frames.moved, frames.dropped) == (1, 5)


@pytest.mark.slow
@pytest.mark.parametrize("case", [PX4, ARDUPILOT], ids=["px4", "ardupilot"])
def test_nothing_changed_is_the_recorded_flight_bit_for_bit(case: Case) -> None:
    memory, course = fly_again(case)
    for kind in (StepInput, Decision, Plan, Setpoint, Datagram, Truth):
        reproduced, recorded = memory.of(kind), fly_case(case).of(kind)
        assert len(reproduced) == len(recorded) > 0
        assert [encode(record) for record in reproduced] == [encode(record) for record in recorded]
    assert sum(len(step_input.inertial) for step_input in memory.of(StepInput)) > 500
    assert course.deviation.first_acting_ns is None and course.inertial_moved == course.inertial_dropped == 0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("case", "change"),
    [(LINEAR, ELSEWHERE), (LINEAR_ARDUPILOT, "cost.input=[3.0, 3.0, 3.0]")],
    ids=["px4-target", "ardupilot-cost"],
)
def test_on_the_linear_plant_rewritten_inertial_data_equal_those_of_a_flight(case: Case, change: str) -> None:
    memory, course = fly_again(case, change)
    real = fly_case(case, change)
    feels, truly, recorded = (felt(side) for side in (memory, real, fly_case(case)))
    assert feels.shape == truly.shape == recorded.shape and course.inertial_dropped <= 1  # one before any attitude
    assert np.abs(recorded - truly).max() > 0.25  # the recorded ones would have been wrong
    # The attitude that is told errs by a few thousandths, and RAW_IMU is rounded twice, to 0.01 m/s². Plans are made of
    # that in each step from the first on, and where they all but tie they go another way for a few ticks.
    off = np.abs(feels - truly).max(axis=1)
    assert np.quantile(off, 0.9) < 0.035
    predicted, truly_own = (velocities(side) for side in (memory, real))
    assert len(predicted) > 100 and np.abs(predicted - truly_own).max() < 0.04
    assert largest_m(memory, real) < 0.02


@pytest.mark.slow
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
    memory, course = fly_again(case, change, other_link=other)
    real = fly_case(case, change)
    place = target or load_case_config(case).target.position_m
    assert not inertial_events(real) and not inertial_events(memory)
    assert 0.9 < hold_m(memory, place) / hold_m(real, place) < 1.1
    assert hold_m(memory, place) < 0.02
    assert largest_m(memory, real) < max_error_m < largest_m(real, fly_case(case)) + max_error_m
    assert course.inertial_moved > 500 and course.inertial_dropped <= 1


@pytest.mark.slow
def test_without_an_attitude_inertial_data_are_dropped_and_positions_continue() -> None:
    def blind(data: bytes) -> bytes:
        return b"".join(
            frame.data
            for frame in scan_frames(data, final=True).frames
            if frame.message_id not in (ATTITUDE, QUATERNION)
        )

    entries = [
        (topic, at_ns, msgspec.structs.replace(one, data=blind(one.data)) if isinstance(one, Datagram) else one)
        for topic, at_ns, one in fly_case(PX4).entries
    ]
    config, memory = load_case_config(PX4, ELSEWHERE), MemorySink()
    recorded = make_recorded_flight(entries, load_case_config(PX4), "x")
    course = refly(recorded, config, build_controller(config), make_response(recorded, config.plant), memory, lambda: 0)
    assert course.inertial_moved == 0 and course.inertial_dropped > 500
    came = [
        frame
        for datagram in memory.of(Datagram)
        if not datagram.outgoing
        for frame in scan_frames(datagram.data, final=True).frames
    ]
    parted_ns = course.deviation.first_acting_ns
    assert parted_ns is not None and sum(frame.message_id == HIGHRES for frame in came) < 20
    assert not any(step_input.inertial for step_input in memory.of(StepInput))
    assert "inertial-doubted" not in inertial_events(memory) and hold_m(memory, TARGET) < 0.2


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
