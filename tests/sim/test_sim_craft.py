"""The linear plant made to fly by itself: the laws under take-off, positions and velocities, and what misleads them."""

from __future__ import annotations

import math

import pytest
from sim_rig import CALM, make_rig

from sim.simulation import Peers
from sim.vehicle.interface import ControlledPlant, compute_heading_rad, rotate_to_ned
from sim.vehicle.linear import LinearVehicle
from uavctl.config import load_config

AT = "sim.start_position_m=[0.0,0.0,-1.5]"
DRAG = (
    "plant.drag_1ps=[0.3,0.3,0.3]"  # holds the proportional law, of 2.0 1/s, short of what it wants by a seventh or so
)
SHORT = 2.0 / 2.3


def craft(*overrides: str) -> ControlledPlant:
    vehicle = Peers(load_config("room-hahn-stursberg", [*CALM, AT, *overrides]), 0).vehicle
    assert isinstance(vehicle, LinearVehicle)
    return ControlledPlant(vehicle)


def fly(one: ControlledPlant, seconds: float) -> None:
    end_ns = one.now_ns + round(seconds * 1e9)
    while one.next_ns is not None and one.next_ns <= end_ns:
        one._plant.advance(one.next_ns)
        one.update_control()
    one._plant.advance(end_ns)


def test_it_goes_to_a_position_and_stays() -> None:
    one = craft()
    one.go_to((1.0, -2.0, -2.0))
    fly(one, 12.0)
    assert one.position_m == pytest.approx((1.0, -2.0, -2.0), abs=0.02)
    assert math.hypot(*one.velocity_mps) < 0.02


def test_far_away_positions_are_approached_at_the_cruising_and_climbing_speeds() -> None:
    one = craft(DRAG)
    one.go_to((1e6, 0.0, -1e6))
    fly(one, 8.0)
    assert one.velocity_mps[0] == pytest.approx(5.0 * SHORT, rel=0.05)
    assert one.velocity_mps[2] == pytest.approx(-1.0 * SHORT, rel=0.05)


def test_an_error_of_what_it_believes_moves_where_it_stays() -> None:
    one = craft()
    one.set_estimate_error((0.5, 0.0, 0.0), (0.0, 0.0, 0.0))
    one.go_to((0.0, 0.0, -1.5))
    fly(one, 12.0)
    assert one.position_m == pytest.approx((-0.5, 0.0, -1.5), abs=0.02)


def test_setpoints_of_position_and_velocity_fly_the_linear_plant() -> None:
    one = make_rig("ardupilot", DRAG)
    one.send(one.client.position(1.0, 0.0, -2.0))
    one.wait(10.0)
    assert one.peers.vehicle.position_m == pytest.approx((1.0, 0.0, -2.0), abs=0.02)
    for _ in range(40):
        one.send(one.client.velocity(0.0, 0.5, 0.0))
        one.wait(0.1)
    assert one.peers.vehicle.velocity_mps[1] == pytest.approx(0.5 * SHORT, abs=0.02)


def test_quaternions_turn_as_their_rotation_does() -> None:
    half = math.sqrt(0.5)
    east = (half, 0.0, 0.0, half)  # nose to the east
    assert compute_heading_rad(east) == pytest.approx(math.pi / 2)
    assert rotate_to_ned(east, (1.0, 0.0, 0.0)) == pytest.approx((0.0, 1.0, 0.0), abs=1e-12)
    assert rotate_to_ned(east, (0.0, 1.0, 0.0)) == pytest.approx((-1.0, 0.0, 0.0), abs=1e-12)
    down = (half, 0.0, -half, 0.0)  # nose down
    assert rotate_to_ned(down, (1.0, 0.0, 0.0)) == pytest.approx((0.0, 0.0, 1.0), abs=1e-12)
    assert rotate_to_ned(down, (0.0, 0.0, 1.0)) == pytest.approx((-1.0, 0.0, 0.0), abs=1e-12)
