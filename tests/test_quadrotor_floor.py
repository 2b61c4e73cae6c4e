"""The simulated quadrotor on the floor and in time: take-off, landing, battery, exactness, places."""

import math
from dataclasses import replace

import numpy as np
import pytest
from quadrotor_rig import BOTH, MODEL, Autopilot, allowing, gusty, quadrotor, run, steady, tilt
from scipy.spatial.transform import Rotation

from sim.airframe import CRAZYFLIE_2, GRAVITY_MPS2
from sim.battery import Battery
from sim.cascade import CLIMB_MPS, CRUISE_MPS, LAND_MPS, TUNINGS
from sim.craft import Craft
from sim.quadrotor import STEP_NS, Quadrotor
from sim.rigid_body import LEVEL
from sim.vehicle import Vehicle, linear_model
from uavctl.config import load_config
from uavctl.data import Vec3


@pytest.mark.parametrize("autopilot", BOTH)
def test_it_takes_off_from_the_floor_and_lands_on_it(autopilot: Autopilot) -> None:
    one = quadrotor(autopilot, at=(1.0, 2.0, 0.0))
    one.rest()
    run(one, 1.0)
    assert one.grounded
    assert one.landed
    assert (one.position_m, one.velocity_mps, one.attitude) == ((1.0, 2.0, 0.0), (0.0, 0.0, 0.0), LEVEL)
    assert max(one.rotor_speeds_rps) < 1e-3

    one.grounded = False
    one.take_off(4.0)
    climbs: list[float] = []
    run(one, 15.0, lambda it: climbs.append(-it.velocity_mps[2]))
    np.testing.assert_allclose(one.position_m, (1.0, 2.0, -4.0), atol=0.05)
    assert max(climbs) == pytest.approx(CLIMB_MPS, abs=0.15)
    assert not one.landed

    one.land()
    sinks: list[float] = []

    def watch(it: Quadrotor) -> None:
        assert it.position_m[2] <= 0.0
        sinks.append(it.velocity_mps[2])

    run(one, 11.0, watch)
    assert max(sinks) == pytest.approx(LAND_MPS, abs=0.15)
    assert one.landed
    assert one.position_m[2] == 0.0
    assert one.velocity_mps == (0.0, 0.0, 0.0)
    assert not one.grounded  # the rotors still turn: disarming is the autopilot's
    one.rest()
    assert one.grounded


def test_a_hard_landing_neither_bounces_nor_sinks_in() -> None:
    one = quadrotor(at=(0.0, 0.0, -60.0))
    one.face(1.0)
    one.brake()
    run(one, 4.0)
    one.accelerate((3.0, 3.0, 9.0))
    touched_s: list[float] = []

    def watch(it: Quadrotor) -> None:
        for part in (0.4, 1.0):
            it.advance(it.now_ns + round(part * 1e6))
            assert it.position_m[2] <= 0.0
        if it.position_m[2] == 0.0:
            touched_s.append(it.now_ns * 1e-9)
            stood_s = touched_s[-1] - touched_s[0]  # at most 4 ms short: from the first look after the touch
            assert it.landed or stood_s < 0.5
            assert not it.landed or stood_s > 0.495

    run(one, 12.0, watch)
    assert touched_s[-1] - touched_s[0] > 1.0
    assert len(touched_s) * 1.4e-3 < touched_s[-1] - touched_s[0] + 0.01
    assert one.velocity_mps == (0.0, 0.0, 0.0)
    w, x, y, z = one.attitude
    assert 2.0 * math.atan2(z, w) == pytest.approx(1.0, abs=0.15)
    assert max(abs(x), abs(y)) < 1e-3
    north, east, _ = one.position_m
    one.take_off(2.0)  # begins from here, not from the motion before the impact
    run(one, 10.0, lambda it: None if math.dist(it.position_m[:2], (north, east)) < 0.05 else pytest.fail("ran away"))
    np.testing.assert_allclose(one.position_m, (north, east, -2.0), atol=0.05)


def test_between_two_points_of_the_grid_nobody_is_below_the_floor() -> None:
    one = quadrotor(at=(0.0, 0.0, -1e-3), speed=(0.0, 0.0, 4.0))
    one.advance(STEP_NS - 1000)
    assert one.position_m[2] == 0.0


def test_sliding_on_the_floor_ends_as_coulomb_says() -> None:
    """Without thrust the slide lasts v / (µ g)."""
    idle = replace(CRAZYFLIE_2, idle_rps=1.0, drag_area_m2=(0.0, 0.0, 0.0), rotor_drag_kg=(0.0, 0.0, 0.0))
    one = quadrotor(at=(0.0, 0.0, 0.0), speed=(2.0, 0.0, 0.0), airframe=idle)
    one.accelerate((0.0, 0.0, 100.0))
    one._rotors.speeds_rps = (1.0, 1.0, 1.0, 1.0)
    stop_s = 2.0 / (idle.friction * GRAVITY_MPS2)
    run(one, 0.5 * stop_s)
    assert one.velocity_mps[0] == pytest.approx(1.0, abs=0.02)
    run(one, 0.6 * stop_s)
    assert one.velocity_mps[0] == 0.0
    assert one.position_m[0] == pytest.approx(2.0**2 / (2.0 * idle.friction * GRAVITY_MPS2), rel=0.01)


def test_a_weak_battery_limits_the_thrust_and_a_weaker_one_cannot_lift_it() -> None:
    one = quadrotor(at=(0.0, 0.0, -60.0))
    run(one, 1.0)
    assert one.battery.current_a == pytest.approx(2.0, abs=0.2)
    one.battery = Battery(CRAZYFLIE_2, charge=0.5)
    assert one.battery.largest_rps == CRAZYFLIE_2.speed_at_0v_rps + CRAZYFLIE_2.speed_per_v_rps * 3.92
    one.accelerate((0.0, 0.0, -50.0))
    run(one, 2.5)
    power_w = CRAZYFLIE_2.electronics_w + CRAZYFLIE_2.power_per_thrust_wpn * (
        CRAZYFLIE_2.thrust_n_s2 * sum(speed**2 for speed in one.rotor_speeds_rps)
    )
    assert one.battery.voltage_v * one.battery.current_a == pytest.approx(power_w, rel=0.01)
    np.testing.assert_allclose(one.rotor_speeds_rps, one.battery.largest_rps, rtol=0.01)
    one.battery = allowing(0.9 * CRAZYFLIE_2.hover_rps)
    one.brake()
    run(one, 20.0)
    assert one.velocity_mps[2] > 1.0 or one.landed


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

    flat = linear_model(load_config("paper").plant)
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


def test_a_far_position_is_reached_at_cruising_speed_and_braked_for_in_time() -> None:
    one = quadrotor(at=(0.0, 0.0, -10.0))
    one.go_to((60.0, 0.0, -10.0))
    speeds: list[float] = []
    places: list[float] = []

    def watch(it: Quadrotor) -> None:
        speeds.append(it.velocity_mps[0])
        places.append(it.position_m[0])

    run(one, 30.0, watch)
    assert max(speeds) == pytest.approx(CRUISE_MPS, rel=0.05)
    assert max(places) < 60.3
    np.testing.assert_allclose(one.position_m, (60.0, 0.0, -10.0), atol=0.05)


@pytest.mark.parametrize("yaw", [1.5, -3.0])
def test_it_turns_its_nose_and_flies_the_same_way(yaw: float) -> None:
    one = quadrotor()
    one.face(yaw)
    one.accelerate((1.0, 0.0, 0.0))
    run(one, 6.0)
    w, _, _, z = one.attitude
    assert math.remainder(2.0 * math.atan2(z, w) - yaw, 2.0 * math.pi) == pytest.approx(0.0, abs=0.05)
    assert one.velocity_mps[0] == pytest.approx(6.0, rel=0.03)
    assert one.velocity_mps[1] == pytest.approx(0.0, abs=0.1)


def test_on_the_floor_nothing_moves_but_the_battery() -> None:
    one = quadrotor(wind=steady((3.0, 0.0, 0.0)), at=(1.0, 2.0, 0.0))
    one.grounded = True
    one.accelerate((1.0, 0.0, -5.0))
    charge = one.battery.remaining
    run(one, 10.0)
    assert one.wind_mps == (3.0, 0.0, 0.0)
    assert one.acceleration_mps2 == (0.0, 0.0, 0.0)
    assert one.state.tolist() == [1.0, 0.0, 0.0, 2.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    used_c = CRAZYFLIE_2.electronics_w / 4.2 * 10.0
    assert (charge - one.battery.remaining) * CRAZYFLIE_2.capacity_c == pytest.approx(used_c, rel=0.02)
    one.grounded = False
    one.grounded = False  # once is enough
    one.accelerate((1.0, 0.0, 0.0))  # armed but landed: ignored
    run(one, 1.0)
    np.testing.assert_allclose(one.rotor_speeds_rps, CRAZYFLIE_2.idle_rps, rtol=1e-3)
    assert one.position_m == (1.0, 2.0, 0.0)
    one.accelerate((0.0, 0.0, -1.0))
    run(one, 1.5)
    assert one.position_m[2] < -0.2


def test_misled_loops_hold_the_wrong_place() -> None:
    one: Craft = quadrotor(at=(0.0, 0.0, -5.0))
    one.go_to((1.0, 0.0, -5.0))
    one.mislead((0.4, -0.3, 0.2), (0.0, 0.0, 0.0))
    assert isinstance(one, Quadrotor)
    run(one, 20.0)
    np.testing.assert_allclose(one.position_m, (0.6, 0.3, -5.2), atol=0.01)
    # A velocity that is none is cancelled by the position loop at the distance where that asks for it.
    one.go_to((1.0, 0.0, -5.0))
    one.mislead((0.0, 0.0, 0.0), (0.2, 0.0, -0.1))
    run(one, 20.0)
    gains = TUNINGS["ardupilot"]
    wanted = (1.0 - 0.2 / gains.position_1ps, 0.0, -5.0 + 0.1 / gains.position_down_1ps)
    np.testing.assert_allclose(one.position_m, wanted, atol=0.01)
    one.mislead((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    run(one, 20.0)
    np.testing.assert_allclose(one.position_m, (1.0, 0.0, -5.0), atol=0.01)


def test_what_the_loops_learn_on_the_floor_does_not_make_it_run_at_take_off() -> None:
    one = quadrotor(at=(0.0, 0.0, -1.0))
    one.land()
    run(one, 5.0)
    one.mislead((1.0, -2.0, 0.0), (0.0, 0.0, 0.0))  # the estimator finds that it was elsewhere all the time
    run(one, 0.1)
    one.take_off(2.0)
    run(one, 10.0, lambda it: None if math.hypot(*it.position_m[:2]) < 0.05 else pytest.fail("ran away"))
    assert one.position_m[2] == pytest.approx(-2.0, abs=0.05)


def test_it_can_take_the_place_of_the_linear_vehicle() -> None:
    config = load_config("room")
    linear = Vehicle(config, np.random.SeedSequence(1), 0)
    one = quadrotor()
    for name in ("model", "now_ns", "grounded", "has_down", "state", "input", "position_m", "velocity_mps"):
        assert type(getattr(one, name)) is type(getattr(linear, name)), name
    for name in ("advance", "accelerate", "rest"):
        assert callable(getattr(one, name))
    assert one.state.shape == linear.state.shape
    assert one.input.shape == linear.input.shape
    assert MODEL.dt_ns == one.model.dt_ns
