"""The simulated quadrotor in flight: equilibria in closed form, limits, what each autopilot does with a setpoint."""

import math
from dataclasses import replace

import numpy as np
import pytest
from quadrotor_rig import BOTH, Autopilot, allowing, gusty, quadrotor, run, steady, tilt
from scipy.optimize import fsolve

from sim.vehicle.airframe import AIR_DENSITY_KGPM3, CRAZYFLIE_2, GRAVITY_MPS2
from sim.vehicle.battery import BatteryModel
from sim.vehicle.loops import REFERENCE_ACCEL_MPS2, TUNINGS
from sim.vehicle.quadrotor import STEP_NS, STEP_S
from uavctl.arrays import Array


@pytest.mark.parametrize("autopilot", BOTH)
def test_hovering_is_the_weight_at_the_rotor_speed_of_the_closed_form(autopilot: Autopilot) -> None:
    one = quadrotor(autopilot)
    one.brake()
    run(one, 20.0)
    speed = math.sqrt(CRAZYFLIE_2.mass_kg * GRAVITY_MPS2 / (4.0 * CRAZYFLIE_2.thrust_n_s2))
    np.testing.assert_allclose(one.rotor_speeds_rps, speed, rtol=1e-6)
    np.testing.assert_allclose(one.position_m, (0.0, 0.0, -5.0), atol=0.03)
    np.testing.assert_allclose(one.velocity_mps, 0.0, atol=1e-3)


def test_in_steady_wind_it_hovers_at_the_lean_where_drag_is_the_weights_share() -> None:
    wind = 3.0
    one = quadrotor(wind=steady((wind, 0.0, 0.0)))
    one.brake()
    run(one, 30.0)
    mass, k, area = CRAZYFLIE_2.mass_kg, CRAZYFLIE_2.rotor_drag_kg, CRAZYFLIE_2.drag_area_m2
    body = [0.5 * AIR_DENSITY_KGPM3 * a * wind for a in area]

    def balance(unknown: Array, /) -> list[float]:
        angle, speed = unknown.tolist()  # of leaning back into a wind from behind: down turns to the north
        front, down = wind * math.cos(angle), wind * math.sin(angle)
        drag_front = (4.0 * speed * k[0] + body[0]) * front
        drag_down = (4.0 * speed * k[2] + body[2]) * down
        thrust = 4.0 * CRAZYFLIE_2.thrust_n_s2 * speed**2
        north = drag_front * math.cos(angle) + (drag_down - thrust) * math.sin(angle)
        vertical = (drag_down - thrust) * math.cos(angle) - drag_front * math.sin(angle)
        return [north / mass, vertical / mass + GRAVITY_MPS2]

    angle, speed = fsolve(balance, (0.1, CRAZYFLIE_2.hover_rps), xtol=1e-12)
    assert tilt(one) == pytest.approx(angle, rel=1e-3)
    assert 0.05 < angle < 0.15
    np.testing.assert_allclose(one.rotor_speeds_rps, speed, rtol=1e-4)
    np.testing.assert_allclose(one.velocity_mps, 0.0, atol=1e-3)
    assert math.hypot(*one.position_m[:2]) < 0.02  # the integrator has taken the wind over


def test_rotors_at_their_limit_wind_nothing_up() -> None:
    """All thrust wanted, none left for yaw: the turn waits, and does not overshoot when it can begin."""
    one = quadrotor(at=(0.0, 0.0, -60.0))
    one.battery = allowing(1900.0)
    one.accelerate((0.0, 0.0, -8.0))
    run(one, 1.0)
    one.set_heading(1.5)
    run(one, 3.0)
    assert abs(one.attitude[3]) < 0.05
    one.battery = BatteryModel(CRAZYFLIE_2)
    one.brake()
    yaws: list[float] = []
    run(one, 6.0, lambda it: yaws.append(2.0 * math.atan2(it.attitude[3], it.attitude[0])))
    assert yaws[-1] == pytest.approx(1.5, abs=0.03)
    assert max(yaws) < 1.6


@pytest.mark.parametrize(("autopilot", "limit_deg"), [("ardupilot", 30.0), ("px4", 45.0)])
def test_20_mps2_leans_as_far_as_each_autopilot_lets_it_and_keeps_the_height(
    autopilot: Autopilot, limit_deg: float
) -> None:
    one = quadrotor(autopilot, at=(0.0, 0.0, -50.0))
    one.accelerate((0.0, 20.0, 0.0))
    run(one, 2.5)
    assert math.degrees(tilt(one)) == pytest.approx(limit_deg, abs=1.5)
    assert one.position_m[2] == pytest.approx(-50.0, abs=1.0)
    assert one.velocity_mps[1] > 5.0


def test_after_more_than_it_can_give_the_reference_is_where_the_vehicle_is() -> None:
    smooth = replace(CRAZYFLIE_2, drag_area_m2=(0.0, 0.0, 0.0), rotor_drag_kg=(0.0, 0.0, 0.0))
    one = quadrotor("ardupilot", at=(0.0, 0.0, -50.0), airframe=smooth)
    one.accelerate((0.0, 20.0, 0.0))
    run(one, 4.0)
    reached = one.velocity_mps[1]
    one.accelerate((0.0, 0.0, 0.0))
    run(one, 5.0)
    # The acceleration of the largest lean, taken back at the jerk limit, adds a²/2j and no more.
    most = GRAVITY_MPS2 * math.tan(math.radians(30.0))
    gained = most**2 / (2.0 * TUNINGS["ardupilot"].jerk_mps3)
    assert one.velocity_mps[1] - reached == pytest.approx(gained, rel=0.2)


def test_a_speed_that_the_air_denied_is_not_made_up_for() -> None:
    draggy = replace(CRAZYFLIE_2, drag_area_m2=(0.02, 0.02, 0.02))
    one = quadrotor("ardupilot", at=(0.0, 0.0, -50.0), airframe=draggy)
    one.accelerate((0.0, 20.0, 0.0))
    run(one, 8.0)
    reached = one.velocity_mps[1]
    assert abs(one.acceleration_mps2[1]) < 0.3  # it goes as fast as the largest lean makes it
    one.brake()
    run(one, 2.0)
    assert one.velocity_mps[1] < reached - 2.0  # at once, not when a reference far ahead has come down to it


def test_a_climb_that_the_battery_denied_is_not_made_up_for() -> None:
    one = quadrotor("ardupilot", at=(0.0, 0.0, -60.0))
    one.battery = allowing(1600.0)
    one.go_to((0.0, 0.0, -61.0))
    run(one, 6.0)
    assert one.position_m[2] > -45.0
    one.battery = BatteryModel(CRAZYFLIE_2)
    climbs: list[float] = []
    run(one, 25.0, lambda it: climbs.append(-it.velocity_mps[2]))
    np.testing.assert_allclose(one.position_m, (0.0, 0.0, -61.0), atol=0.2)


def test_a_dive_that_was_denied_is_not_made_up_for() -> None:
    one = quadrotor("ardupilot", at=(0.0, 0.0, -90.0))
    one.accelerate((0.0, 0.0, 12.0))
    run(one, 3.0)
    one.brake()
    sinking = one.velocity_mps[2]
    depths: list[float] = []
    run(one, 12.0, lambda it: depths.append(it.velocity_mps[2]))
    assert max(depths) < sinking + 1.0
    assert min(depths) > -0.5
    assert depths[-1] == pytest.approx(0.0, abs=0.02)


def test_px4_learns_its_error_of_the_hover_thrust_where_it_holds_the_height() -> None:
    one = quadrotor("px4")
    one.brake()
    heights: list[float] = []
    run(one, 15.0, lambda it: heights.append(-it.position_m[2] - 5.0))
    assert 0.005 < max(heights) < 0.05
    assert abs(heights[-1]) < 0.001


def test_zero_acceleration_keeps_the_velocity_with_ardupilot_and_loses_it_with_px4() -> None:
    drag_1ps = CRAZYFLIE_2.rotor_drag_kg[0] * 4.0 * CRAZYFLIE_2.hover_rps / CRAZYFLIE_2.mass_kg
    left_of: dict[Autopilot, float] = {"ardupilot": 1.0, "px4": math.exp(-4.0 * drag_1ps)}
    for autopilot, left in left_of.items():
        one = quadrotor(autopilot, speed=(1.0, 0.0, 0.0), airframe=replace(CRAZYFLIE_2, drag_area_m2=(0.0, 0.0, 0.0)))
        one.accelerate((0.0, 0.0, 0.0))
        run(one, 4.0)
        assert one.velocity_mps[0] == pytest.approx(left, abs=0.06)


def test_zero_acceleration_rejects_wind_with_ardupilot_and_drifts_with_px4() -> None:
    drag_1ps = CRAZYFLIE_2.rotor_drag_kg[0] * 4.0 * CRAZYFLIE_2.hover_rps / CRAZYFLIE_2.mass_kg
    speed_of: dict[Autopilot, float] = {"ardupilot": 0.0, "px4": 2.0 * -math.expm1(-20.0 * drag_1ps)}
    for autopilot, speed in speed_of.items():
        one = quadrotor(autopilot, wind=steady((2.0, 0.0, 0.0)), at=(0.0, 0.0, -30.0))
        one.accelerate((0.0, 0.0, 0.0))
        run(one, 20.0)
        assert one.velocity_mps[0] == pytest.approx(speed, abs=0.03)


def test_an_acceleration_acts_after_the_dead_time_and_the_newest_counts() -> None:
    one = quadrotor("px4")
    for north in (-1.0, 5.0, 1.0):
        one.accelerate((north, 0.0, 0.0))
    dead = round(TUNINGS["px4"].dead_time_s / STEP_S)
    for _ in range(dead + 1):
        assert one.rates_rps == (0.0, 0.0, 0.0)
        one.advance(one.now_ns + STEP_NS)
    run(one, 1.0)
    # Leaning by atan(a/g), less what the hover error adds to the vertical part.
    assert math.tan(tilt(one)) == pytest.approx(1.0 / (GRAVITY_MPS2 * (1.0 + TUNINGS["px4"].hover_error)), rel=0.01)
    one.accelerate((5.0, 0.0, 0.0))
    one.brake()  # a manoeuvre of its own makes what was still to come void
    run(one, 4.0)
    np.testing.assert_allclose(one.velocity_mps, 0.0, atol=0.03)
    one.accelerate((5.0, 0.0, 0.0))
    one.go_to(one.position_m)
    run(one, 4.0)
    np.testing.assert_allclose(one.velocity_mps, 0.0, atol=0.03)


def test_a_flood_of_setpoints_does_not_queue() -> None:
    one = quadrotor("px4")
    for _ in range(1000):
        one.accelerate((-2.0, 0.0, 0.0))
    one.accelerate((2.0, 0.0, 0.0))
    run(one, 1.0)
    assert one.velocity_mps[0] > 1.0


@pytest.mark.parametrize("autopilot", BOTH)
def test_it_brakes_at_2_5_mps2_and_stays(autopilot: Autopilot) -> None:
    one = quadrotor(autopilot, at=(0.0, 0.0, -10.0))
    one.fly((3.0, -4.0, 0.0))
    run(one, 12.0)
    one.brake()
    run(one, 0.5)
    fast = math.hypot(*one.velocity_mps[:2])
    run(one, 0.75)
    slow = math.hypot(*one.velocity_mps[:2])
    assert (fast - slow) / 0.75 == pytest.approx(REFERENCE_ACCEL_MPS2, rel=0.1)
    run(one, 20.0)  # the integrals of the velocity loops take the drag of 5 m/s back slowly
    where = one.position_m
    run(one, 3.0)
    np.testing.assert_allclose(one.position_m, where, atol=0.02)
    assert where[2] == pytest.approx(-10.0, abs=0.1)


@pytest.mark.parametrize("autopilot", BOTH)
def test_it_flies_velocities_and_positions(autopilot: Autopilot) -> None:
    one = quadrotor(autopilot, wind=gusty(3))
    one.fly((1.0, -0.5, -0.3))
    run(one, 8.0)
    np.testing.assert_allclose(one.velocity_mps, (1.0, -0.5, -0.3), atol=0.25)
    one = quadrotor(autopilot)
    one.go_to((2.0, -1.0, -6.0))
    farthest = [0.0]
    run(one, 14.0, lambda it: farthest.append(it.position_m[0]))
    np.testing.assert_allclose(one.position_m, (2.0, -1.0, -6.0), atol=0.03)
    assert max(farthest) < 2.1
