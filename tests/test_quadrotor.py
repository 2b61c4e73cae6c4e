"""The simulated quadrotor in flight and on the floor: equilibria in closed form, limits, modes, exactness in time."""

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from quadrotor_rig import MODEL, Autopilot, quadrotor, run, steady
from scipy.optimize import fsolve
from scipy.spatial.transform import Rotation

from sim.airframe import AIR_DENSITY_KGPM3, CRAZYFLIE_2, GRAVITY_MPS2
from sim.attitude import AttitudeLoop, lean
from sim.battery import Battery
from sim.cascade import CLIMB_MPS, CRUISE_MPS, LAND_MPS, REFERENCE_ACCEL_MPS2, TUNINGS
from sim.craft import Craft
from sim.quadrotor import STEP_NS, STEP_S, Quadrotor
from sim.rigid_body import LEVEL, Body, Motion, step, turned
from sim.rotors import Rotors
from sim.vehicle import Vehicle, linear_model
from sim.wind import Wind
from uavctl.config import load_config
from uavctl.data import Vec3

Array = NDArray[np.float64]

BOTH: tuple[Autopilot, ...] = ("px4", "ardupilot")


def tilt(vehicle: Quadrotor) -> float:
    _, x, y, _ = vehicle.attitude
    return math.acos(1.0 - 2.0 * (x * x + y * y))


def allowing(speed_rps: float) -> Battery:
    """A battery that allows this rotor speed."""
    return Battery(replace(CRAZYFLIE_2, speed_at_0v_rps=speed_rps, speed_per_v_rps=0.0))


def gusty(seed: int) -> Wind:
    return Wind((1.0, 0.5, 0.0), 8.0, 5.0, STEP_S, np.random.SeedSequence(seed))


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


def turn_to(angle: Vec3, seconds: float) -> Array:
    """Rates and attitude after each step of a turn from level, hovering."""
    body, rotors = Body.of(CRAZYFLIE_2), Rotors(CRAZYFLIE_2, STEP_S)
    rotors.speeds_rps = rotors.commands_rps = (CRAZYFLIE_2.hover_rps,) * 4
    loop = AttitudeLoop(CRAZYFLIE_2, 7.0, STEP_S)
    motion = Motion((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), LEVEL, (0.0, 0.0, 0.0))
    rows = []
    for _ in range(round(seconds / STEP_S)):
        rotors.command(CRAZYFLIE_2.weight_n, loop.torque(motion, turned(LEVEL, angle), integrate=True), 3000.0)
        motion = step(body, motion, rotors.step(), (0.0, 0.0, 0.0), STEP_S)
        rows.append((*motion.rates_rps, *motion.attitude))
    return np.array(rows)


@pytest.mark.parametrize("angle", [(0.2, 0.0, 0.0), (0.0, -0.3, 0.0), (0.2, 0.2, 0.0)])
def test_the_attitude_follows_a_step_quickly_without_overshoot_or_ringing(angle: Vec3) -> None:
    flown, size = turn_to(angle, 1.0), math.hypot(*angle)
    share = 2.0 * np.arccos(np.minimum(flown[:, 3], 1.0)) / size
    rise_s = STEP_S * int(np.argmax(share > 1.0 - math.exp(-1.0)))
    assert rise_s == pytest.approx(1.0 / 7.0, abs=0.05)
    assert share.max() < 1.01
    np.testing.assert_allclose(flown[-1, 3:], turned(LEVEL, angle), atol=2e-3)
    rate = flown[:, :3] @ angle / size
    assert rate.max() < size * 7.0
    assert rate.min() > -0.02 * rate.max()


def test_rates_are_limited_to_those_of_an_autopilot() -> None:
    fast = np.degrees(np.abs(turn_to((2.5, 1.0, 0.0), 1.0)[:, :3])).max()
    assert 200.0 < fast < 240.0
    turning = turn_to((0.0, 0.0, 3.0), 5.0)
    assert 80.0 < np.degrees(np.abs(turning[:, 2])).max() < 110.0
    np.testing.assert_allclose(turning[-1, 3:], turned(LEVEL, (0.0, 0.0, 3.0)), atol=0.02)


def test_an_attitude_and_its_negative_are_one() -> None:
    one, other = (AttitudeLoop(CRAZYFLIE_2, 7.0, STEP_S) for _ in range(2))
    w, x, y, z = turned(LEVEL, (0.3, -0.2, 0.4))
    motion = Motion((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), LEVEL, (0.0, 0.0, 0.0))
    first = one.torque(motion, (w, x, y, z), integrate=True)
    assert first == other.torque(motion, (-w, -x, -y, -z), integrate=True)
    assert [math.copysign(1.0, torque) for torque in first] == [1.0, -1.0, 1.0]


def test_rotors_at_their_limit_wind_nothing_up() -> None:
    """All thrust wanted, none left for yaw: the turn waits, and does not overshoot when it can begin."""
    one = quadrotor(at=(0.0, 0.0, -60.0))
    one.battery = allowing(1900.0)
    one.accelerate((0.0, 0.0, -8.0))
    run(one, 1.0)
    one.face(1.5)
    run(one, 3.0)
    assert abs(one.attitude[3]) < 0.05
    one.battery = Battery(CRAZYFLIE_2)
    one.brake()
    yaws: list[float] = []
    run(one, 6.0, lambda it: yaws.append(2.0 * math.atan2(it.attitude[3], it.attitude[0])))
    assert yaws[-1] == pytest.approx(1.5, abs=0.03)
    assert max(yaws) < 1.6


def test_thrust_points_up_even_when_a_dive_is_wanted() -> None:
    result = lean((0.5, 0.0, 50.0), 0.0, math.radians(45.0))
    assert result.force_mps2 == (0.5, 0.0, -1.0)
    assert result.dive_limited
    assert not lean((0.5, 0.0, 5.0), 0.0, 0.5).dive_limited
    assert 1.0 - 2.0 * (result.attitude[1] ** 2 + result.attitude[2] ** 2) == pytest.approx(1.0 / math.hypot(0.5, 1.0))


@pytest.mark.parametrize("yaw", [0.0, 1.0, -2.5])
def test_a_lean_points_the_thrust_along_the_wanted_acceleration(yaw: float) -> None:
    accel = (1.0, -2.0, 0.5)
    result = lean(accel, yaw, math.radians(45.0))
    w, x, y, z = result.attitude
    down = np.array([2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)])
    force = np.array([1.0, -2.0, 0.5 - GRAVITY_MPS2])
    np.testing.assert_allclose(-down, force / np.linalg.norm(force), atol=1e-12)
    np.testing.assert_allclose(result.force_mps2, force)
    assert not result.limited
    # The shortest turn from level to the lean, then the heading: without lean the nose points along yaw.
    level = lean((0.0, 0.0, 0.0), yaw, 0.5).attitude
    np.testing.assert_allclose(level, (math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)), atol=1e-15)


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


def test_a_climb_that_the_battery_denied_is_not_made_up_for() -> None:
    one = quadrotor("ardupilot", at=(0.0, 0.0, -60.0))
    one.battery = allowing(1600.0)
    one.go_to((0.0, 0.0, -61.0))
    run(one, 6.0)
    assert one.position_m[2] > -45.0
    one.battery = Battery(CRAZYFLIE_2)
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
