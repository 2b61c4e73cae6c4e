"""Braking before the limits: its distance against a simulation of its law, and the velocities that allow it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from uavctl.arrays import Array
from uavctl.smpc.braking import Braking

BRAKING = Braking(
    lower_m=np.array([-3.0, -2.5, -np.inf]),
    upper_m=np.array([3.0, 2.5, 0.0]),
    accel_mps2=np.array([2.0, 3.9, 1.5]),
    lag_s=np.array([0.2, 0.0, 0.16]),
    slew_mps3=5.0,
    gain_1ps=1.5,
)


@pytest.mark.parametrize("speed_mps", [0.1, 1.0, 4.0])
def test_the_distance_of_a_stop_is_that_of_the_law(speed_mps: float) -> None:
    at_once = replace(BRAKING, slew_mps3=np.inf)
    stop_m, step_s = at_once.compute_stop_m(np.full(3, speed_mps), np.zeros(3)), 1e-4
    for axis in range(3):
        way, speed = speed_mps * at_once.lag_s[axis], speed_mps
        for _ in range(200_000):
            way += speed * step_s
            speed -= min(at_once.gain_1ps * speed, at_once.accel_mps2[axis]) * step_s
        assert stop_m[axis] == pytest.approx(way, rel=1e-3)


def test_a_setpoint_that_accelerates_needs_more_way_and_one_that_brakes_is_no_credit() -> None:
    speed = np.full(3, 1.0)
    level, pushed, braked = (BRAKING.compute_stop_m(speed, np.full(3, accel)) for accel in (0.0, 1.0, -1.0))
    assert (pushed > level).all()
    np.testing.assert_array_equal(level, braked)


@pytest.mark.parametrize("accel", [0.0, 1.2, -1.2])
@pytest.mark.parametrize("position", [-2.9, -1.0, 0.0, 2.4, 2.99])
def test_a_velocity_at_its_limit_stops_at_the_last_position(position: float, accel: float) -> None:
    place, setpoint = np.full(3, position), np.full(3, accel)
    least, greatest = BRAKING.compute_velocity_limits(place, setpoint)

    def check(speed: Array, gains: Array, room: Array) -> None:
        for axis in np.flatnonzero(np.isfinite(room)):
            stop = BRAKING.compute_stop_m(np.maximum(speed, 0.0), gains)[axis]
            if speed[axis] > 0.0:
                assert stop == pytest.approx(room[axis], rel=1e-9)
            else:
                assert speed[axis] == 0.0
                assert stop >= room[axis] - 1e-12

    check(greatest, setpoint, BRAKING.upper_m - place)
    check(-least, -setpoint, place - BRAKING.lower_m)
    assert least[2] == -np.inf
