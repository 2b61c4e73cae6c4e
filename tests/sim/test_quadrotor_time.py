"""The simulated quadrotor in time: the same bits whatever the stops, what lies between two steps, states, places."""

import math

import numpy as np
import pytest
from quadrotor_rig import MODEL, gusty, quadrotor, run, tilt
from scipy.spatial.transform import Rotation

from sim.vehicle.airframe import CRAZYFLIE_2, GRAVITY_MPS2
from sim.vehicle.linear import LinearVehicle, make_linear_model
from sim.vehicle.quadrotor import STEP_NS, Quadrotor
from uavctl.config import load_config
from uavctl.records import Vec3


def test_the_same_seed_gives_the_same_bits() -> None:
    def flight(seed: int) -> list[tuple[float, ...]]:
        one = quadrotor("px4", wind=gusty(seed))
        rows: list[tuple[float, ...]] = []
        for k in range(20):
            one.accelerate((math.sin(k), math.cos(k), -0.2))
            run(one, 0.1)
            rows.append((*one.position_m, *one.attitude, *one.state.tolist(), one.battery.voltage_v))
        return rows

    assert flight(1) == flight(1)
    assert flight(1) != flight(2)


def test_stops_on_the_way_change_no_bit_and_read_what_lies_between() -> None:
    straight, halting = quadrotor(wind=gusty(1)), quadrotor(wind=gusty(1))
    rng = np.random.default_rng(4)
    for k in range(30):
        end_ns = (k + 1) * 100_000_000
        accel: Vec3 = (math.sin(k), math.cos(k), -0.1)
        for one in (straight, halting):
            one.accelerate(accel)
        for at_ns in sorted(rng.integers(k * 100_000_000, end_ns, 7).tolist()):
            before = halting.position_m
            speed, passed_s = halting.velocity_mps, (at_ns - halting.now_ns) * 1e-9
            halting.advance(at_ns)
            np.testing.assert_allclose(
                halting.position_m, np.array(before) + passed_s * np.array(speed), atol=10.0 * passed_s**2 + 1e-4
            )
            assert np.isfinite(halting.state).all()
        for one in (straight, halting):
            one.advance(end_ns)
        assert straight.state.tolist() == halting.state.tolist()
        assert straight.attitude == halting.attitude
    with pytest.raises(ValueError, match="go back"):
        straight.advance(0)


def test_between_two_points_of_the_grid_the_motion_is_smooth() -> None:
    one = quadrotor(speed=(1.0, 0.0, 0.0))
    one.accelerate((2.0, 0.0, 0.0))
    run(one, 0.3)
    one.advance(one.now_ns + STEP_NS - 1)
    nearly, speed = one.position_m, one.velocity_mps
    one.advance(one.now_ns + 1)
    np.testing.assert_allclose(one.position_m, nearly, atol=1e-6)
    np.testing.assert_allclose(one.velocity_mps, speed, atol=1e-3)


def test_state_and_input_are_those_of_the_controllers_plant() -> None:
    one = quadrotor("px4", speed=(0.5, 0.0, 0.0))
    one.accelerate((1.0, -0.5, 0.25))
    run(one, 3.0)
    state, p, v = one.state, one.position_m, one.velocity_mps
    assert state.shape == (9,)
    assert state[[0, 3, 6]].tolist() == list(p)
    assert state[[1, 4, 7]].tolist() == list(v)
    w, x, y, z = one.attitude
    down = Rotation.from_quat([x, y, z, w]).as_matrix()[:, 2]
    thrust = CRAZYFLIE_2.thrust_n_s2 * sum(speed**2 for speed in one.rotor_speeds_rps)
    pull = np.array([0.0, 0.0, GRAVITY_MPS2]) - down * thrust / CRAZYFLIE_2.mass_kg
    np.testing.assert_allclose(state[[2, 5, 8]], pull, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(state[[2, 5]], (1.0, -0.5), atol=0.03)
    assert one.input.tolist() == [1.0, -0.5, 0.25]

    flat = make_linear_model(load_config("paper").plant)
    one = Quadrotor(flat, "px4", gusty(1), 0, position_m=(1.0, 2.0, -3.0), velocity_mps=(0.1, 0.2, 0.0))
    one.accelerate((0.4, -0.4, 0.0))
    assert one.state[list(flat.position_index)].tolist() == [1.0, 2.0]
    assert one.state[list(flat.velocity_index)].tolist() == [0.1, 0.2]
    np.testing.assert_allclose(one.input, np.array([0.4, -0.4]) / flat.accel_per_input)
    assert one.has_down


def test_absurd_setpoints_are_limited_and_stay_finite() -> None:
    one = quadrotor("px4", at=(0.0, 0.0, -50.0))
    one.accelerate((1e30, -1e30, -1e30))
    assert one.input.tolist() == [100.0, -100.0, -100.0]
    run(one, 3.0)
    assert np.isfinite(one.state).all()
    assert math.degrees(tilt(one)) < 50.0
    one.accelerate((-1e30, 1e30, 1e30))
    run(one, 3.0)
    assert np.isfinite(one.state).all()
    one.brake()
    run(one, 10.0)
    np.testing.assert_allclose(one.velocity_mps, 0.0, atol=0.05)


def test_it_can_take_the_place_of_the_linear_vehicle() -> None:
    config = load_config("room-hahn-stursberg")
    linear = LinearVehicle(config, np.random.SeedSequence(1), 0)
    one = quadrotor()
    for name in ("model", "now_ns", "grounded", "has_down", "state", "input", "position_m", "velocity_mps"):
        assert type(getattr(one, name)) is type(getattr(linear, name)), name
    for name in ("advance", "accelerate", "stand_on_floor"):
        assert callable(getattr(one, name))
    assert one.state.shape == linear.state.shape
    assert one.input.shape == linear.input.shape
    assert MODEL.dt_ns == one.model.dt_ns
