"""The rigid body against closed forms, conserved quantities and an independent integrator on rotation matrices."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from sim.vehicle.airframe import AIR_DENSITY_KGPM3, CRAZYFLIE_2, GRAVITY_MPS2
from sim.vehicle.rigid_body import (
    LEVEL,
    Body,
    BodyState,
    Wrench,
    compute_acceleration,
    integrate_step,
    reduce_tilt,
    rotate_attitude,
)
from uavctl.arrays import Array
from uavctl.records import Vec3

H = 0.0025
ZERO: Vec3 = (0.0, 0.0, 0.0)
NOTHING = Wrench(0.0, ZERO, 0.0)
FLYING = Body.from_airframe(CRAZYFLIE_2)
IN_VACUUM = replace(FLYING, rotor_drag_kg=ZERO, body_drag_kgpm=ZERO)
TUMBLING = BodyState((1.0, 2.0, -50.0), (1.5, -0.5, -2.0), rotate_attitude(LEVEL, (0.4, -0.9, 0.3)), (9.0, -6.0, 4.0))


def fly(body: Body, start: BodyState, wrench: Wrench, seconds: float, h: float = H, wind: Vec3 = ZERO) -> BodyState:
    motion = start
    for _ in range(round(seconds / h)):
        motion = integrate_step(body, motion, (wrench, wrench, wrench), wind, h)
    return motion


def matrix(motion: BodyState) -> Array:
    w, x, y, z = motion.attitude
    return np.asarray(Rotation.from_quat([x, y, z, w]).as_matrix())


def test_free_fall_is_a_parabola_and_keeps_its_energy() -> None:
    motion = fly(IN_VACUUM, TUMBLING, NOTHING, 2.0)
    np.testing.assert_allclose(motion.velocity_mps, (1.5, -0.5, -2.0 + 2.0 * GRAVITY_MPS2), rtol=1e-12)
    np.testing.assert_allclose(motion.position_m, (4.0, 1.0, -50.0 - 4.0 + 2.0 * GRAVITY_MPS2), rtol=0, atol=1e-11)

    def energy_per_mass(one: BodyState) -> float:
        return 0.5 * sum(v * v for v in one.velocity_mps) - GRAVITY_MPS2 * one.position_m[2]

    assert energy_per_mass(motion) == pytest.approx(energy_per_mass(TUMBLING), rel=1e-12)


def test_without_thrust_or_air_a_tumbling_body_keeps_its_horizontal_momentum() -> None:
    motion = TUMBLING
    for _ in range(400):
        motion = integrate_step(IN_VACUUM, motion, (NOTHING, NOTHING, NOTHING), (3.0, 4.0, 5.0), H)
        assert motion.velocity_mps[:2] == TUMBLING.velocity_mps[:2]


def test_without_torque_angular_momentum_and_energy_of_rotation_stay() -> None:
    body = replace(IN_VACUUM, inertia_kgm2=(1e-5, 2e-5, 3e-5))  # three moments: the middle axis is unstable
    inertia = np.diag(body.inertia_kgm2)
    motion = BodyState(ZERO, ZERO, TUMBLING.attitude, (0.3, 9.0, 0.2))
    momentum = matrix(motion) @ inertia @ motion.rates_rps
    energy = np.array(motion.rates_rps) @ inertia @ motion.rates_rps
    flipped = False
    for _ in range(4000):
        motion = integrate_step(body, motion, (NOTHING, NOTHING, NOTHING), ZERO, H)
        flipped |= motion.rates_rps[1] < -8.0
        assert abs(sum(number * number for number in motion.attitude) - 1.0) <= 1e-15
    assert flipped
    np.testing.assert_allclose(matrix(motion) @ inertia @ motion.rates_rps, momentum, rtol=0, atol=1e-8 * 2e-4)
    assert np.array(motion.rates_rps) @ inertia @ motion.rates_rps == pytest.approx(energy, rel=1e-8)


def test_a_steady_turn_about_an_axis_is_exact() -> None:
    rates = (0.0, 0.0, 7.0)
    motion = fly(IN_VACUUM, BodyState(ZERO, ZERO, LEVEL, rates), NOTHING, 3.0)
    np.testing.assert_allclose(motion.attitude, (math.cos(10.5), 0.0, 0.0, math.sin(10.5)), rtol=0, atol=1e-12)


def test_torque_turns_each_axis_the_right_way() -> None:
    for axis in range(3):
        torque = [0.0, 0.0, 0.0]
        torque[axis] = 1e-6
        motion = fly(
            IN_VACUUM, BodyState(ZERO, ZERO, LEVEL, ZERO), Wrench(0.0, (torque[0], torque[1], torque[2]), 0.0), 0.5
        )
        rate = 1e-6 * 0.5 / IN_VACUUM.inertia_kgm2[axis]
        np.testing.assert_allclose(np.delete(motion.rates_rps, axis), 0.0, atol=0)
        assert motion.rates_rps[axis] == pytest.approx(rate, rel=1e-12)
        assert 2.0 * math.asin(motion.attitude[axis + 1]) == pytest.approx(0.25 * rate, rel=1e-9)


def oracle(body: Body, start: BodyState, wrench: Wrench, wind: Vec3, seconds: float) -> Array:
    """Positions and velocities by an adaptive integrator of another order, on the nine numbers of the matrix."""
    inertia = np.diag(body.inertia_kgm2)

    def slope(_t: float, x: Array) -> Array:
        r, rates = x[6:15].reshape(3, 3), x[15:]
        air = r.T @ (x[3:6] - wind)
        force = (
            -(np.array(body.rotor_drag_kg) * wrench.speeds_rps + np.array(body.body_drag_kgpm) * math.hypot(*air)) * air
        )
        force[2] -= wrench.thrust_n
        cross = np.array([[0, -rates[2], rates[1]], [rates[2], 0, -rates[0]], [-rates[1], rates[0], 0]])
        spin = np.linalg.solve(inertia, wrench.torque_nm - np.cross(rates, inertia @ rates))
        down = np.array([0.0, 0.0, GRAVITY_MPS2])
        return np.concatenate([x[3:6], r @ force / body.mass_kg + down, (r @ cross).ravel(), spin])

    x0 = np.concatenate([start.position_m, start.velocity_mps, matrix(start).ravel(), start.rates_rps])
    solved = solve_ivp(slope, (0.0, seconds), x0, method="DOP853", rtol=1e-12, atol=1e-13)
    return np.asarray(solved.y[:, -1])


def test_everything_at_once_agrees_with_an_independent_integrator_to_fourth_order() -> None:
    wrench, wind = Wrench(0.31, (2e-5, -3e-5, 1e-5), 7100.0), (2.0, -1.0, 0.5)
    exact = oracle(FLYING, TUMBLING, wrench, wind, 1.0)

    def error(h: float) -> Array:
        motion = fly(FLYING, TUMBLING, wrench, 1.0, h, wind)
        reached = np.array([*motion.position_m, *motion.velocity_mps, *matrix(motion).ravel(), *motion.rates_rps])
        return np.array([np.abs(part).max() for part in np.split(reached - exact, (3, 6, 15))])

    errors = [error(h) for h in (0.02, 0.01, 0.005)]  # of position, velocity, attitude and rates
    assert errors[2].max() < 1e-6
    for coarse, fine in itertools.pairwise(errors):
        np.testing.assert_allclose(np.log2(coarse / fine), 4.0, atol=0.3)


def test_a_fall_without_rotors_ends_at_the_speed_where_drag_is_the_weight() -> None:
    area = CRAZYFLIE_2.drag_area_m2[2]
    speed = math.sqrt(2.0 * CRAZYFLIE_2.weight_n / (AIR_DENSITY_KGPM3 * area))
    motion = fly(FLYING, BodyState(ZERO, ZERO, LEVEL, ZERO), NOTHING, 20.0)
    assert motion.velocity_mps[:2] == (0.0, 0.0)
    assert motion.velocity_mps[2] == pytest.approx(speed, rel=1e-8)
    # On the way there: v = v∞ tanh(g t / v∞).
    motion = fly(FLYING, BodyState(ZERO, ZERO, LEVEL, ZERO), NOTHING, 1.0)
    assert motion.velocity_mps[2] == pytest.approx(speed * math.tanh(GRAVITY_MPS2 / speed), rel=1e-9)


def test_air_takes_a_hovering_body_along_with_the_rotors_drag() -> None:
    speeds, wind = 4.0 * CRAZYFLIE_2.hover_rps, (1.0, 0.0, 0.0)
    body = replace(FLYING, body_drag_kgpm=ZERO)
    hover = Wrench(CRAZYFLIE_2.weight_n, ZERO, speeds)
    motion = fly(body, BodyState(ZERO, ZERO, LEVEL, ZERO), hover, 3.0, wind=wind)
    drag_1ps = CRAZYFLIE_2.rotor_drag_kg[0] * speeds / CRAZYFLIE_2.mass_kg
    assert motion.velocity_mps[0] == pytest.approx(-math.expm1(-3.0 * drag_1ps), rel=1e-9)


def test_drag_acts_along_the_body_axes() -> None:
    leaning = rotate_attitude(LEVEL, (0.0, 0.5, 0.0))
    a = compute_acceleration(FLYING, leaning, (1.0, 0.0, 0.0), Wrench(0.0, ZERO, 7000.0), ZERO)
    front, down = math.cos(0.5), math.sin(0.5)
    k, c = FLYING.rotor_drag_kg, FLYING.body_drag_kgpm
    f_front, f_down = -(7000.0 * k[0] + c[0]) * front, -(7000.0 * k[2] + c[2]) * down
    north = (math.cos(0.5) * f_front + math.sin(0.5) * f_down) / FLYING.mass_kg
    south_down = (-math.sin(0.5) * f_front + math.cos(0.5) * f_down) / FLYING.mass_kg
    np.testing.assert_allclose(a, (north, 0.0, south_down + GRAVITY_MPS2), rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("heading", [0.0, 1.0, -2.5])
def test_putting_a_body_upright_keeps_its_heading_and_the_side_it_leans_to(heading: float) -> None:
    tilted = rotate_attitude(rotate_attitude(LEVEL, (0.3, -0.4, 0.0)), (0.0, 0.0, heading))
    np.testing.assert_allclose(reduce_tilt(tilted, 1.0), tilted, atol=1e-15)
    np.testing.assert_allclose(reduce_tilt(tilted, 0.0), rotate_attitude(LEVEL, (0.0, 0.0, heading)), atol=1e-15)
    angle = 2.0 * math.atan(0.5 * math.tan(0.25))  # half of the tangent of half the 0.5 rad
    halved = rotate_attitude(rotate_attitude(LEVEL, (0.6 * angle, -0.8 * angle, 0.0)), (0.0, 0.0, heading))
    np.testing.assert_allclose(reduce_tilt(tilted, 0.5), halved, atol=1e-15)
