"""The simulated quadrotor between floor and target: take-off, landing, battery, misled loops."""

import math
from dataclasses import replace

import numpy as np
import pytest
from quadrotor_rig import BOTH, Autopilot, allowing, quadrotor, run, steady

from sim.vehicle.airframe import CRAZYFLIE_2, GRAVITY_MPS2
from sim.vehicle.battery import BatteryModel
from sim.vehicle.interface import Vehicle
from sim.vehicle.loops import TUNINGS
from sim.vehicle.quadrotor import STEP_NS, Quadrotor
from sim.vehicle.rigid_body import LEVEL


@pytest.mark.parametrize("autopilot", BOTH)
def test_it_takes_off_from_the_floor_and_lands_on_it(autopilot: Autopilot) -> None:
    one = quadrotor(autopilot, at=(1.0, 2.0, 0.0))
    one.stand_on_floor()
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
    assert max(climbs) == pytest.approx(1.7 if autopilot == "ardupilot" else 1.1, abs=0.15)  # as recorded
    assert not one.landed

    one.land()
    sinks: list[float] = []

    def watch(it: Quadrotor) -> None:
        assert it.position_m[2] <= 0.0
        sinks.append(it.velocity_mps[2])

    run(one, 11.0, watch)
    high, low = (0.5, 0.5) if autopilot == "ardupilot" else (0.7, 0.3)
    assert max(sinks) == pytest.approx(high, abs=0.15)
    falling = [speed for speed in sinks if speed > 0.0]
    # Recorded: ground hit at 0.4999 m/s (LAND_SPEED 50); MPC_LAND_SPEED, and MPC_LAND_CRWL below a metre.
    assert falling[-1] == pytest.approx(low, abs=0.02)
    assert one.landed
    assert one.position_m[2] == 0.0
    assert one.velocity_mps == (0.0, 0.0, 0.0)
    assert not one.grounded  # the rotors still turn: disarming is the autopilot's
    one.stand_on_floor()
    assert one.grounded


def test_a_hard_landing_neither_bounces_nor_sinks_in() -> None:
    one = quadrotor(at=(0.0, 0.0, -60.0))
    one.set_heading(1.0)
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
    one._rotors.set_speeds((1.0, 1.0, 1.0, 1.0))
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
    one.battery = BatteryModel(CRAZYFLIE_2, charge=0.5)
    assert one.battery.max_rps == CRAZYFLIE_2.speed_at_0v_rps + CRAZYFLIE_2.speed_per_v_rps * 3.92
    one.accelerate((0.0, 0.0, -50.0))
    run(one, 2.5)
    power_w = CRAZYFLIE_2.electronics_w + CRAZYFLIE_2.power_per_thrust_wpn * (
        CRAZYFLIE_2.thrust_n_s2 * sum(speed**2 for speed in one.rotor_speeds_rps)
    )
    assert one.battery.voltage_v * one.battery.current_a == pytest.approx(power_w, rel=0.01)
    np.testing.assert_allclose(one.rotor_speeds_rps, one.battery.max_rps, rtol=0.01)
    one.battery = allowing(0.9 * CRAZYFLIE_2.hover_rps)
    one.brake()
    run(one, 20.0)
    assert one.velocity_mps[2] > 1.0 or one.landed


def test_with_an_empty_battery_the_rotors_run_down_and_it_falls() -> None:
    in_vacuum = replace(CRAZYFLIE_2, drag_area_m2=(0.0, 0.0, 0.0), rotor_drag_kg=(0.0, 0.0, 0.0))
    one = quadrotor(at=(0.0, 0.0, -5.0), airframe=in_vacuum)
    run(one, 1.0)
    one.battery.set_charge(0.0)
    start_m, start_mps = one.position_m[2], one.velocity_mps[2]
    run(one, 0.5)
    # The thrust falls as the square of the speed: v' = g (1 - exp(-2 t / T)).
    lag_s = 0.5 * CRAZYFLIE_2.motor_lag_s
    gone = -math.expm1(-0.5 / lag_s)
    fallen_m = 0.5 * 0.5**2 - lag_s * (0.5 - lag_s * gone)
    assert one.velocity_mps[2] - start_mps == pytest.approx(GRAVITY_MPS2 * (0.5 - lag_s * gone), rel=1e-3)
    assert one.position_m[2] - start_m == pytest.approx(GRAVITY_MPS2 * fallen_m, rel=2e-3)
    run(one, 2.0)
    assert one.landed
    one.take_off(1.0)
    run(one, 2.0)
    assert one.position_m[2] == 0.0
    assert max(one.rotor_speeds_rps) < 1.0


def test_a_far_position_is_reached_at_cruising_speed_and_braked_for_in_time() -> None:
    one = quadrotor(at=(0.0, 0.0, -10.0))
    one.go_to((60.0, 0.0, -10.0))
    speeds: list[float] = []
    places: list[float] = []

    def watch(it: Quadrotor) -> None:
        speeds.append(it.velocity_mps[0])
        places.append(it.position_m[0])

    run(one, 30.0, watch)
    assert max(speeds) == pytest.approx(5.0, rel=0.05)
    assert max(places) < 60.1
    fast, slow = (max(k for k, speed in enumerate(speeds) if speed > at) for at in (4.0, 3.0))
    # Half of the 2.5 m/s² that it can brake with, and a little more to catch up with the lag of its reference.
    assert 1.2 < 1e9 / ((slow - fast) * STEP_NS) < 1.6
    np.testing.assert_allclose(one.position_m, (60.0, 0.0, -10.0), atol=0.05)


@pytest.mark.parametrize("yaw", [1.5, -3.0])
def test_it_turns_its_nose_and_flies_the_same_way(yaw: float) -> None:
    one = quadrotor()
    one.set_heading(yaw)
    one.accelerate((1.0, 0.0, 0.0))
    run(one, 6.0)
    w, _, _, z = one.attitude
    assert math.remainder(2.0 * math.atan2(z, w) - yaw, 2.0 * math.pi) == pytest.approx(0.0, abs=0.05)
    assert one.velocity_mps[0] == pytest.approx(6.0, rel=0.03)
    assert one.velocity_mps[1] == pytest.approx(0.0, abs=0.1)


@pytest.mark.parametrize(("height_m", "rests"), [(1.0, True), (0.1, False)])
def test_nothing_of_the_attitude_loop_of_the_flight_before_is_left_at_take_off(height_m: float, rests: bool) -> None:
    """It was turning, its yaw integral wound up, when it was put or came down; the next take-off does not turn."""
    one = quadrotor(at=(0.0, 0.0, -height_m))
    one.land()
    one.set_heading(2.5)
    run(one, 0.8)
    assert rests == (one.position_m[2] < 0.0)
    if rests:
        one.stand_on_floor()
        run(one, 1.0)  # the rotors run down, each from another speed
        one.grounded = False
    one.set_heading(2.0 * math.atan2(one.attitude[3], one.attitude[0]))
    one.take_off(2.0)
    turning: list[float] = []
    run(one, 3.0, lambda it: turning.append(math.hypot(*it.rates_rps)))
    assert one.position_m[2] < -1.0
    assert max(turning) < 1e-3


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
    one: Vehicle = quadrotor(at=(0.0, 0.0, -5.0))
    one.go_to((1.0, 0.0, -5.0))
    one.set_estimate_error((0.4, -0.3, 0.2), (0.0, 0.0, 0.0))
    assert isinstance(one, Quadrotor)
    run(one, 20.0)
    np.testing.assert_allclose(one.position_m, (0.6, 0.3, -5.2), atol=0.01)
    # A velocity that is none is cancelled by the position loop at the distance where that asks for it.
    one.go_to((1.0, 0.0, -5.0))
    one.set_estimate_error((0.0, 0.0, 0.0), (0.2, 0.0, -0.1))
    run(one, 20.0)
    gains = TUNINGS["ardupilot"]
    wanted = (1.0 - 0.2 / gains.position_1ps, 0.0, -5.0 + 0.1 / gains.position_down_1ps)
    np.testing.assert_allclose(one.position_m, wanted, atol=0.01)
    one.set_estimate_error((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    run(one, 20.0)
    np.testing.assert_allclose(one.position_m, (1.0, 0.0, -5.0), atol=0.01)


def test_what_the_loops_learn_on_the_floor_does_not_make_it_run_at_take_off() -> None:
    one = quadrotor(at=(0.0, 0.0, -1.0))
    one.land()
    run(one, 5.0)
    one.set_estimate_error((1.0, -2.0, 0.0), (0.0, 0.0, 0.0))  # the estimator finds that it was elsewhere all the time
    run(one, 0.1)
    one.take_off(2.0)
    run(one, 10.0, lambda it: None if math.hypot(*it.position_m[:2]) < 0.05 else pytest.fail("ran away"))
    assert one.position_m[2] == pytest.approx(-2.0, abs=0.05)


def test_what_the_loops_learnt_in_the_flight_before_does_not_lean_it_at_take_off() -> None:
    one = quadrotor(wind=steady((4.0, 0.0, 0.0)), at=(0.0, 0.0, -1.0))
    one.brake()
    run(one, 15.0)
    assert math.hypot(*one.velocity_mps) < 0.01  # the integral of the velocity loop holds against the wind
    one.land()
    run(one, 4.0)
    assert one.landed
    one.wind.set_mean((0.0, 0.0, 0.0))
    one.take_off(2.0)
    run(one, 0.5)
    assert abs(one.velocity_mps[0]) < 0.02
