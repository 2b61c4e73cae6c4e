"""Inertial messages of the simulated autopilots: asked for, stamped, scaled, and true where no errors are wanted."""

from __future__ import annotations

import math

import numpy as np
import pytest
from inertial_rig import (
    ATTITUDE,
    FIRST,
    HIGHRES,
    NAMES,
    PERIOD_S,
    QUADROTOR,
    QUATERNION,
    RAW,
    SECOND,
    G,
    convert_to_si,
    make_velocity_wave,
    record_flight,
    request_streams,
)
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from sim_rig import INTERVAL, SimRig, make_rig

from sim.autopilot.telemetry import convert_to_milli
from sim.vehicle.quadrotor import Quadrotor
from uavctl.arrays import SECOND_NS

REQUEST, GET_INTERVAL, DENIED = 512, 510, 2
EXACT = "sim.inertial.errors=0"
BOTH = pytest.mark.parametrize("name", ["px4", "ardupilot"])
PLANTS = pytest.mark.parametrize("plant", ["sim.plant=linear", QUADROTOR])
OWN = {"px4": (HIGHRES,), "ardupilot": (RAW, SECOND)}


def times(one: SimRig, kind: int) -> list[int]:
    """Arrival times of a message [ns]."""
    return [at_ns for at_ns, msg in one.seen if msg.get_type() == NAMES[kind]]


@BOTH
@PLANTS
def test_inertial_messages_come_when_asked_for_and_at_that_rate(name: str, plant: str) -> None:
    one = make_rig(name, plant)
    one.wait(3.0)
    for kind in OWN[name]:
        assert times(one, kind) == []
        for rate_hz in (50, 100):
            request_streams(one, kind, period_s=1.0 / rate_hz)
            before = len(times(one, kind))
            one.wait(1.0)
            spacing = set(np.diff(times(one, kind)[before:]))
            assert len(times(one, kind)) - before in (rate_hz, rate_hz + 1)
            assert spacing == {SECOND_NS // rate_hz}
            assert one.ask(GET_INTERVAL, kind) == 0
            assert one.of("MESSAGE_INTERVAL")[-1].interval_us == 1_000_000 // rate_hz
        assert one.ask(INTERVAL, kind, -1) == 0
        before = len(times(one, kind))
        one.wait(1.0)
        assert one.ask(INTERVAL, kind, 0) == 0  # its usual interval, which is none
        one.wait(1.0)
        assert len(times(one, kind)) == before


@BOTH
def test_attitude_comes_as_often_as_asked_for(name: str) -> None:
    one = make_rig(name, QUADROTOR)
    request_streams(one, ATTITUDE, QUATERNION, period_s=0.01)
    before = len(one.seen)
    one.wait(1.0)
    kinds = [msg.get_type() for _, msg in one.seen[before:]]
    assert kinds.count("ATTITUDE") == pytest.approx(100, abs=1)
    assert kinds.count("ATTITUDE_QUATERNION") == pytest.approx(100, abs=1)


@BOTH
def test_single_measurements_are_told_on_request_by_the_autopilot_that_has_them(name: str) -> None:
    one = make_rig(name)
    for kind in (HIGHRES, RAW, SECOND):
        there = kind in OWN[name]
        assert one.ask(REQUEST, kind) == (0 if there else DENIED)
        assert len(times(one, kind)) == there
        assert (one.ask(INTERVAL, kind, 20_000) == 0) == there


def test_ardupilot_streams_both_units_with_the_group_of_raw_sensors() -> None:
    one = make_rig("ardupilot")
    one.send(one.client.pack(mavlink.MAVLink_request_data_stream_message(1, 1, 1, 20, 1)))
    one.wait(2.0)
    for kind in (RAW, SECOND):
        assert len(times(one, kind)) == pytest.approx(40, abs=1)


@BOTH
@PLANTS
def test_at_rest_and_level_the_specific_force_is_minus_gravity(name: str, plant: str) -> None:
    one = make_rig(name, plant, EXACT, airborne=False)
    for kind in OWN[name]:
        assert one.ask(REQUEST, kind) == 0
        msg = one.of(NAMES[kind])[-1]
        assert convert_to_si(msg) == pytest.approx((0.0, 0.0, -G, 0.0, 0.0, 0.0), abs=1e-6)
    if name == "px4":
        assert msg.fields_updated == 63  # accelerometer and gyroscope, nothing else
    else:
        assert (msg.xacc, msg.yacc, msg.zacc) == (0, 0, -1000)  # thousandths of g


@BOTH
def test_stamps_are_of_the_moment_of_measuring(name: str) -> None:
    """On the linear plant that of sending, on the quadrotor the last step of its physics, at most 2.5 ms before."""
    for plant, age_us in (("sim.plant=linear", 0), (QUADROTOR, 1700)):
        one = make_rig(name, plant)
        one.wait(0.5017)
        for kind in OWN[name]:
            assert one.ask(REQUEST, kind) == 0
            msg = one.of(NAMES[kind])[-1]
            measured_us = 20_501_700 - age_us
            if kind == SECOND:
                assert msg.time_boot_ms == measured_us // 1000
            else:
                assert msg.time_usec == measured_us


@BOTH
def test_the_acceleration_told_is_that_of_the_quadrotor(name: str) -> None:
    """Velocities differentiated numerically are the oracle; RAW_IMU is cut to thousandths of g."""
    one = make_rig(name, QUADROTOR, EXACT)
    one.send(one.client.velocity(*make_velocity_wave(0.0)))
    record = record_flight(one, name, 15.0)
    off = record.acceleration[1:-1] - record.true_acceleration
    assert np.abs(record.true_acceleration).max() > 1.0
    cut = 0.0 if name == "px4" else 1e-3 * G
    assert np.abs(off).max() < 0.015 + 2.0 * cut
    assert np.sqrt(np.mean(off**2)) < 0.001 + cut
    assert np.abs(record.attitude_error).max() < 1e-6
    assert record.time_s == pytest.approx(PERIOD_S * np.arange(len(record.time_s)), abs=1e-9)


@BOTH
def test_the_acceleration_told_is_that_of_the_linear_plant(name: str) -> None:
    """v' = a - c v of its state, level; RAW_IMU is cut to thousandths of g."""
    drag = np.array([0.3, 0.2, 0.5])
    one = make_rig(name, EXACT, "plant.drag_1ps=[0.3,0.2,0.5]")
    for accel in ((1.0, -0.5, 0.2), (-0.5, 0.8, -0.3)):
        one.stream(0.35, *accel, period_s=0.05)
        assert one.ask(REQUEST, FIRST[name]) == 0
        state = np.array(one.peers.read_truth().state).reshape(3, 3)
        wanted = state[:, 2] - drag * state[:, 1] - [0.0, 0.0, G]
        assert np.abs(wanted[:2]).max() > 0.3
        told = np.array(convert_to_si(one.of(NAMES[FIRST[name]])[-1]))
        assert told[:3] == pytest.approx(wanted, abs=1e-6 if name == "px4" else 1.0001e-3 * G)
        assert not told[3:].any()


def test_in_free_fall_there_is_no_specific_force_but_drag() -> None:
    one = make_rig("px4", QUADROTOR, EXACT, "sim.start_position_m=[0.0,0.0,-40.0]", "sim.quadrotor.charge=0.0001")
    one.wait(0.6)
    assert one.ask(REQUEST, HIGHRES) == 0
    force = np.array(convert_to_si(one.of("HIGHRES_IMU")[-1])[:3])
    speed = math.hypot(*one.peers.vehicle.velocity_mps)
    assert speed > 3.0
    assert np.linalg.norm(force) < 0.2 * G


@BOTH
def test_rates_are_those_of_the_body(name: str) -> None:
    one = make_rig(name, QUADROTOR, EXACT)
    one.wait(0.1)
    one.send(one.client.velocity(2.0, -2.0, 0.0))
    one.wait(0.2)
    vehicle = one.peers.vehicle
    assert isinstance(vehicle, Quadrotor)
    assert min(map(abs, vehicle.rates_rps[:2])) > 0.1
    for kind in OWN[name]:
        assert one.ask(REQUEST, kind) == 0
        assert convert_to_si(one.of(NAMES[kind])[-1])[3:] == pytest.approx(
            vehicle.rates_rps, abs=1e-6 if name == "px4" else 1e-3
        )
    for kind in (ATTITUDE, QUATERNION):
        assert one.ask(REQUEST, kind) == 0
    for msg in (one.of("ATTITUDE")[-1], one.of("ATTITUDE_QUATERNION")[-1]):
        assert (msg.rollspeed, msg.pitchspeed, msg.yawspeed) == pytest.approx(vehicle.rates_rps, abs=1e-6)


def test_ardupilot_cuts_towards_zero_and_to_16_bits() -> None:
    g = 9.80665
    assert convert_to_milli((0.0019 * g, -0.0019 * g, -9.80664), (0.0019, -0.0019, 0.0)) == (1, -1, -999, 1, -1, 0)
    assert convert_to_milli((1e9, -1e9, math.inf), (0.0, 0.0, -math.inf)) == (32767, -32768, 32767, 0, 0, -32768)
