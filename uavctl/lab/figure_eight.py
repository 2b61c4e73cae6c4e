"""Figure of eight of trials, from rest to rest, as a trajectory of the configuration.

Speeds and rounds are those of J. A. Preiss, W. Hönig, G. S. Sukhatme and N. Ayanian, "Crazyswarm: A large
nano-quadcopter swarm", ICRA 2017: three times around, 0.76 m/s in the mean, 1.5 m/s at most. The curve is our own,
(a sin θ, b sin θ cos θ), and θ runs faster through the crossing than around the tips.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from scipy.optimize import brentq

from uavctl.arrays import Array
from uavctl.config.mission import TrajectoryConfig
from uavctl.records import Vec3

MEAN_MPS, MAX_MPS, ROUNDS = 0.76, 1.5, 3
CENTRE_M: Vec3 = (0.0, 0.0, -1.2)
HALF_M, WIDTH_M = 1.0, 1.0  # a and b: 2 m long, 1 m wide
RAMP_S = 2.0  # from rest to full speed, and back
_POINTS_PER_ROUND = 20_000  # points of a round by which its length and time are found
_SAMPLE_S = 0.05


@lru_cache(maxsize=1)
def make_figure_eight() -> TrajectoryConfig:
    """Return the figure of eight as a sampled trajectory with velocities."""
    times, positions, velocities = sample_figure_eight(_SAMPLE_S)
    return TrajectoryConfig(
        times_s=tuple(times.tolist()),
        positions_m=tuple(to_vec3(row) for row in positions),
        velocities_mps=tuple(to_vec3(row) for row in velocities),
    )


def sample_figure_eight(step_s: float) -> tuple[Array, Array, Array]:
    """Return times (n,) [s], positions (n, 3) [m] and velocities (n, 3) [m/s] of the figure of eight, its end last."""
    angle, rate, duration_s = _make_schedule()
    times = np.append(np.arange(0.0, duration_s, step_s), duration_s)
    angles = np.interp(times, *angle)
    speed = _compute_full_speed(angles, rate) * _compute_easing(times, duration_s)
    north, east = HALF_M * np.sin(angles), 0.5 * WIDTH_M * np.sin(2.0 * angles)
    tangents = np.column_stack([HALF_M * np.cos(angles), WIDTH_M * np.cos(2.0 * angles), np.zeros_like(angles)])
    positions = np.column_stack([north, east, np.zeros_like(angles)]) + np.array(CENTRE_M)
    return times, positions, tangents * speed[:, None]


def _compute_full_speed(angle: Array, rate: tuple[float, float]) -> Array:
    """Return θ' at full speed [1/s]: a mean rate, faster where the figure crosses itself."""
    base, crossing_gain = rate
    return np.asarray(base * (1.0 + crossing_gain * np.cos(2.0 * angle)))


def _compute_easing(times: Array, duration_s: float) -> Array:
    """Return the share of full speed (n,): smooth from 0 to 1 and back."""
    progress = np.clip(np.minimum(times, duration_s - times) / RAMP_S, 0.0, 1.0)
    return np.asarray(progress * progress * progress * (10.0 - 15.0 * progress + 6.0 * progress * progress))


def _make_schedule() -> tuple[tuple[Array, Array], tuple[float, float], float]:
    """Return θ over time, the rate, and the length of the motion [s]."""
    max_tangent = math.hypot(HALF_M, WIDTH_M)

    def make_schedule(crossing_gain: float) -> tuple[tuple[Array, Array], tuple[float, float], float]:
        rate = (MAX_MPS / (max_tangent * (1.0 + crossing_gain)), crossing_gain)
        angle = np.linspace(0.0, 2.0 * math.pi * ROUNDS, ROUNDS * _POINTS_PER_ROUND + 1)
        # Time at full speed; easing in and out takes RAMP_S longer in all, half of it at each end.
        seconds_per_radian = 1.0 / _compute_full_speed(angle, rate)
        full_speed_times = np.concatenate(
            [[0.0], np.cumsum(0.5 * (seconds_per_radian[1:] + seconds_per_radian[:-1]) * np.diff(angle))]
        )
        duration_s = float(full_speed_times[-1]) + RAMP_S
        times = np.linspace(0.0, duration_s, 4 * _POINTS_PER_ROUND)
        easing = _compute_easing(times, duration_s)
        eased_times = np.concatenate([[0.0], np.cumsum(0.5 * (easing[1:] + easing[:-1]) * np.diff(times))])
        return (
            (times, np.interp(eased_times * (full_speed_times[-1] / eased_times[-1]), full_speed_times, angle)),
            rate,
            duration_s,
        )

    def compute_mean_error(crossing_gain: float) -> float:
        return _compute_round_length_m() * ROUNDS / make_schedule(crossing_gain)[2] - MEAN_MPS

    return make_schedule(float(brentq(compute_mean_error, -0.5, 0.8, xtol=1e-6)))


def _compute_round_length_m() -> float:
    """Return the length of one round [m]."""
    angle = np.linspace(0.0, 2.0 * math.pi, _POINTS_PER_ROUND + 1)
    points = np.column_stack([HALF_M * np.sin(angle), 0.5 * WIDTH_M * np.sin(2.0 * angle)])
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())


def to_vec3(values: Array) -> Vec3:
    """Return three numbers as a tuple of floats."""
    north, east, down = np.asarray(values, dtype=np.float64).tolist()
    return north, east, down
