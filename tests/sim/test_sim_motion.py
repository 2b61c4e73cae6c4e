"""Setpoints of a position that moves: what of them is taken, and how it is flown."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from autopilot_rig import Flight, Name
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from quadrotor_rig import quadrotor, run

from sim.autopilot.profile import SIMULATED
from sim.autopilot.setpoints import IGNORE_ACCEL, IGNORE_VELOCITY, ParsedSetpoint, SetpointKind, parse_setpoint
from sim.vehicle.interface import LEVEL
from sim.vehicle.quadrotor import Quadrotor
from uavctl.arrays import SECOND_NS
from uavctl.lab.position_loop import EXTERNAL_ONLY
from uavctl.records import Vec3

BOTH = pytest.mark.parametrize("name", ["px4", "ardupilot"])
HERE: Vec3 = (1.0, 2.0, -3.0)
AHEAD: Vec3 = (0.5, -0.25, 0.125)
CHANGE: Vec3 = (0.25, 0.5, -0.5)


def told(name: str, mask: int, velocity: Vec3 = AHEAD, accel: Vec3 = CHANGE) -> ParsedSetpoint:
    message = mavlink.MAVLink_set_position_target_local_ned_message(
        0, 1, 1, 1, mask, *HERE, *velocity, *accel, 0.0, 0.0
    )
    return parse_setpoint(SIMULATED[name], message, (0.0, 0.0, 0.0), LEVEL)


@BOTH
def test_a_position_alone_is_a_place_and_with_a_velocity_it_moves(name: str) -> None:
    place = told(name, IGNORE_VELOCITY | IGNORE_ACCEL)
    assert (place.kind, place.vector, place.velocity_mps) == (SetpointKind.POSITION, HERE, None)
    moving = told(name, IGNORE_ACCEL)
    assert (moving.kind, moving.vector) == (SetpointKind.POSITION, HERE)
    assert (moving.velocity_mps, moving.accel_mps2) == (AHEAD, (0.0, 0.0, 0.0))
    assert told(name, 0).accel_mps2 == CHANGE


def test_a_velocity_that_is_no_number_is_left_out_by_px4_and_kills_ardupilot() -> None:
    broken = (math.nan, 0.0, 0.0)
    assert told("px4", IGNORE_ACCEL, velocity=broken).velocity_mps is None
    assert told("ardupilot", IGNORE_ACCEL, velocity=broken).kind is SetpointKind.FATAL


def orbit(time_s: float) -> tuple[Vec3, Vec3, Vec3]:
    """A circle of 1 m in 8 s, from its westernmost point."""
    rate = math.tau / 8.0
    north, east = math.cos(rate * time_s), math.sin(rate * time_s)
    return ((north, east, -5.0), (-rate * east, rate * north, 0.0), (-rate * rate * north, -rate * rate * east, 0.0))


@BOTH
def test_a_circle_is_followed_by_its_dead_time_late_and_no_more(name: Name) -> None:
    """With velocity and acceleration ahead, loops that see the truth lag by what the setpoints do."""
    vehicle = quadrotor(name, at=(1.0, 0.0, -5.0), speed=orbit(0.0)[1])
    dead_s = vehicle.cascade.tuning.dead_time_s + (0.025 if name == "px4" else 0.0)  # and half a period between two

    off: list[float] = []

    def look(one: Quadrotor) -> None:
        time_s = one.now_ns * 1e-9
        if time_s > 8.0:
            off.append(math.dist(one.position_m, orbit(time_s - dead_s)[0]))

    for k in range(320):
        vehicle.follow(*orbit(0.05 * k))
        run(vehicle, 0.05, look)
    assert max(off) < 0.08
    assert math.dist(orbit(0.0)[0], orbit(0.2)[0]) > 0.15  # what 0.2 s of lag would be


def carried(name: Name) -> list[float]:
    """Places along the way of a vehicle that was told of a motion once, each 2.5 ms."""
    vehicle = quadrotor(name, at=(0.0, 0.0, -5.0), speed=(0.5, 0.0, 0.0))
    vehicle.follow((0.0, 0.0, -5.0), (0.5, 0.0, 0.0), (0.0, 0.0, 0.0))
    places: list[float] = []
    run(vehicle, 20.0, lambda one: places.append(one.position_m[0]))
    return places


def test_ardupilot_carries_a_motion_on_for_three_seconds_and_px4_does_not() -> None:
    assert carried("ardupilot")[-1] == pytest.approx(1.5, abs=0.02)
    # PX4 goes on asking for that velocity at that place: it stands where its position loop undoes the velocity.
    ends = carried("px4")[-400:]
    assert ends[-1] == pytest.approx(0.5 / 0.95, abs=0.02)
    assert all(abs(b - a) < 0.01 for a, b in pairwise(ends))


@BOTH
def test_who_begins_in_the_air_may_count_as_aligned_and_flies_on_external_positions_at_once(name: Name) -> None:
    one = Flight(name)
    one.set(**EXTERNAL_ONLY[name])
    assert not one.autopilot.estimator.is_position_valid
    one.autopilot.estimator.start_in_flight()
    one.external, one.external_hz = "VISION_POSITION_ESTIMATE", 4.0  # PX4 would not begin on so few
    before = one.mode
    one.wait(5.0)
    assert one.mode == before and one.autopilot.estimator.is_position_valid
    off = np.subtract(one.autopilot.estimator.position_m, one.vehicle.position_m)
    assert 0.0 < np.linalg.norm(off) < 0.02
    one.external = None
    one.wait(8.0)
    assert not one.autopilot.estimator.is_position_valid and one.now_ns > 13 * SECOND_NS - 1
