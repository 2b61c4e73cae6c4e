"""The attitude loop and the lean that it is asked for: steps against closed forms, limits."""

import math

import numpy as np
import pytest
from quadrotor_rig import HOVER_SUM_RPS, quadrotor, run
from scipy.linalg import expm

from sim.vehicle.airframe import CRAZYFLIE_2, GRAVITY_MPS2
from sim.vehicle.attitude_loop import YAW_INTEGRAL_1PS2, YAW_RATE_GAIN_1PS, AttitudeLoop, compute_attitude_setpoint
from sim.vehicle.quadrotor import STEP_S
from sim.vehicle.rigid_body import LEVEL, Body, BodyState, integrate_step, rotate_attitude
from sim.vehicle.rotors import Rotors
from uavctl.arrays import Array
from uavctl.records import Vec3

DRAG_1PS = CRAZYFLIE_2.rotor_drag_kg[0] * HOVER_SUM_RPS / CRAZYFLIE_2.mass_kg  # at hover


def turn_to(angle: Vec3, seconds: float) -> Array:
    """Rates and attitude after each step of a turn from level, hovering."""
    body, rotors = Body.from_airframe(CRAZYFLIE_2), Rotors(CRAZYFLIE_2, STEP_S)
    rotors.commands_rps = (CRAZYFLIE_2.hover_rps,) * 4
    rotors.set_speeds(rotors.commands_rps)
    loop = AttitudeLoop(CRAZYFLIE_2, 7.0, STEP_S)
    motion = BodyState((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), LEVEL, (0.0, 0.0, 0.0))
    rows = []
    for _ in range(round(seconds / STEP_S)):
        rotors.command(
            CRAZYFLIE_2.weight_n, loop.compute_torque(motion, rotate_attitude(LEVEL, angle), integrate=True), 3000.0
        )
        motion = integrate_step(body, motion, rotors.step(), (0.0, 0.0, 0.0), STEP_S)
        rows.append((*motion.rates_rps, *motion.attitude))
    return np.array(rows)


@pytest.mark.parametrize("angle", [(0.2, 0.0, 0.0), (0.0, -0.3, 0.0), (0.2, 0.2, 0.0)])
def test_the_attitude_follows_a_step_quickly_without_overshoot_or_ringing(angle: Vec3) -> None:
    flown, size = turn_to(angle, 1.0), math.hypot(*angle)
    share = 2.0 * np.arccos(np.minimum(flown[:, 3], 1.0)) / size
    rise_s = STEP_S * int(np.argmax(share > 1.0 - math.exp(-1.0)))
    assert rise_s == pytest.approx(1.0 / 7.0, abs=0.05)
    assert share.max() < 1.01
    np.testing.assert_allclose(flown[-1, 3:], rotate_attitude(LEVEL, angle), atol=2e-3)
    rate = flown[:, :3] @ angle / size
    assert rate.max() < size * 7.0
    assert rate.min() > -0.02 * rate.max()


def test_the_nose_turns_as_its_linear_loop_does_with_a_quarter_of_the_gain() -> None:
    lag = 1.0 / CRAZYFLIE_2.motor_lag_s
    pull, push = YAW_RATE_GAIN_1PS, YAW_INTEGRAL_1PS2
    gain = 7.0 / 4.0
    # Of heading error, rate, integral and angular acceleration: the rotors' lag of a small change is that of the speed.
    loop = np.array(
        [
            [0.0, -1.0, 0.0, 0.0],
            [0.0, 0.0, 0.0, 1.0],
            [push * gain, -push, 0.0, 0.0],
            [lag * pull * gain, -lag * pull, lag, -lag],
        ]
    )
    flown = turn_to((0.0, 0.0, 0.2), 3.0)
    for at_s in (0.25, 0.5, 1.0, 2.0, 3.0):
        error, rate, *_ = expm(loop * at_s) @ (0.2, 0.0, 0.0, 0.0)
        _, _, turning, w, _, _, z = flown[round(at_s / STEP_S) - 1]
        assert 2.0 * math.atan2(z, w) == pytest.approx(0.2 - error, abs=0.002)
        assert turning == pytest.approx(rate, abs=0.004)


def test_rates_are_limited_to_those_of_an_autopilot() -> None:
    fast = np.degrees(np.abs(turn_to((2.5, 1.0, 0.0), 1.0)[:, :3])).max()
    assert 200.0 < fast < 240.0
    turning = turn_to((0.0, 0.0, 3.0), 5.0)
    assert 80.0 < np.degrees(np.abs(turning[:, 2])).max() < 110.0
    np.testing.assert_allclose(turning[-1, 3:], rotate_attitude(LEVEL, (0.0, 0.0, 3.0)), atol=0.02)


def test_an_attitude_and_its_negative_are_one() -> None:
    one, other = (AttitudeLoop(CRAZYFLIE_2, 7.0, STEP_S) for _ in range(2))
    w, x, y, z = rotate_attitude(LEVEL, (0.3, -0.2, 0.4))
    motion = BodyState((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), LEVEL, (0.0, 0.0, 0.0))
    first = one.compute_torque(motion, (w, x, y, z), integrate=True)
    assert first == other.compute_torque(motion, (-w, -x, -y, -z), integrate=True)
    assert [math.copysign(1.0, torque) for torque in first] == [1.0, -1.0, 1.0]


def test_thrust_points_up_even_when_a_dive_is_wanted() -> None:
    result = compute_attitude_setpoint((0.5, 0.0, 50.0), 0.0, math.radians(45.0))
    assert result.force_mps2 == (0.5, 0.0, -1.0)
    assert result.is_dive_limited
    assert not compute_attitude_setpoint((0.5, 0.0, 5.0), 0.0, 0.5).is_dive_limited
    assert 1.0 - 2.0 * (result.attitude[1] ** 2 + result.attitude[2] ** 2) == pytest.approx(1.0 / math.hypot(0.5, 1.0))


@pytest.mark.parametrize("yaw", [0.0, 1.0, -2.5])
def test_a_lean_points_the_thrust_along_the_wanted_acceleration(yaw: float) -> None:
    accel = (1.0, -2.0, 0.5)
    result = compute_attitude_setpoint(accel, yaw, math.radians(45.0))
    w, x, y, z = result.attitude
    down = np.array([2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)])
    force = np.array([1.0, -2.0, 0.5 - GRAVITY_MPS2])
    np.testing.assert_allclose(-down, force / np.linalg.norm(force), atol=1e-12)
    np.testing.assert_allclose(result.force_mps2, force)
    assert not result.is_tilt_limited
    # The shortest turn from level to the lean, then the heading: without lean the nose points along yaw.
    level = compute_attitude_setpoint((0.0, 0.0, 0.0), yaw, 0.5).attitude
    np.testing.assert_allclose(level, (math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)), atol=1e-15)


def test_a_vehicle_that_takes_a_tilt_for_level_accelerates_by_it() -> None:
    """Nose 1 degree too high by its belief: it flies nose down, 9.81 tan 1° = 0.17 m/s² to the north."""
    one = quadrotor("px4")
    one.set_attitude_error((0.0, math.radians(1.0), 0.0))
    one.accelerate((0.0, 0.0, 0.0))
    run(one, 1.5)
    speed = one.velocity_mps
    pull = one.acceleration_mps2[0] + DRAG_1PS * speed[0]
    assert pull == pytest.approx(GRAVITY_MPS2 * math.tan(math.radians(1.0)), rel=0.05)
    assert abs(speed[1]) < 0.01
    one.set_attitude_error((0.0, 0.0, 0.0))
    run(one, 1.5)
    assert abs(one.acceleration_mps2[0] + DRAG_1PS * one.velocity_mps[0]) < 0.01
