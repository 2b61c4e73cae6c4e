"""Reachable sets against motions at the limits, and closed forms."""

import numpy as np

from uavctl.fleet.obstacles import find_reach

ACCEL, SPEED = np.array([2.0, 1.0, 1.5]), np.array([1.5, 1.5, 1.0])


def test_every_motion_within_the_limits_stays_inside_and_one_touches_each_side() -> None:
    rng = np.random.default_rng(0)
    dt_s, steps = 0.02, 100
    begin_m, begin_mps = np.array([1.0, -2.0, -1.0]), np.array([1.2, -0.5, 0.0])
    lower_m, upper_m = find_reach(begin_m, begin_mps, ACCEL, SPEED, np.linspace(0.0, dt_s * steps, steps + 1))
    highest_m = np.full((steps + 1, 3), -np.inf)
    for run in range(200):
        position_m, velocity_mps = begin_m, begin_mps
        directions = np.ones((steps, 3)) if run == 0 else rng.choice([-1.0, 1.0], (steps, 3))
        for k in range(steps + 1):
            assert (position_m >= lower_m[k] - 1e-9).all()
            assert (position_m <= upper_m[k] + 1e-9).all()
            highest_m[k] = np.maximum(highest_m[k], position_m)
            if k < steps:
                after = np.clip(velocity_mps + dt_s * ACCEL * directions[k], -SPEED, SPEED)
                position_m, velocity_mps = position_m + 0.5 * dt_s * (velocity_mps + after), after
    # A step in which the speed limit is reached loses at most a dt² / 2
    assert (upper_m - highest_m).max() <= 0.5 * ACCEL.max() * dt_s**2 + 1e-9


def test_a_vehicle_at_rest_without_acceleration_stays() -> None:
    place_m = np.array([1.0, -2.0, 0.0])
    for side_m in find_reach(place_m, np.zeros(3), np.zeros(3), SPEED, np.array([0.0, 2.0, 600.0])):
        np.testing.assert_array_equal(side_m, np.tile(place_m, (3, 1)))


def test_a_vehicle_faster_than_the_limit_keeps_its_speed() -> None:
    _, upper_m = find_reach(np.zeros(3), np.array([3.0, 0.0, 0.0]), ACCEL, SPEED, np.array([0.0, 2.0]))
    np.testing.assert_allclose(upper_m[:, 0], [0.0, 6.0])
