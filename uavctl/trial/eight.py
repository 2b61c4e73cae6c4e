"""A figure of eight with a given mean and largest speed, from rest to rest, as a trajectory of the configuration.

Speeds and rounds are those of J. A. Preiss, W. Hönig, G. S. Sukhatme and N. Ayanian, "Crazyswarm: A large
nano-quadcopter swarm", ICRA 2017: three times around, 0.76 m/s in the mean, 1.5 m/s at most. The curve is our own:
(a sin θ, b sin θ cos θ), and θ runs faster through the crossing than around the tips.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from uavctl.config.mission import TrajectoryConfig
from uavctl.data import Vec3

Array = NDArray[np.float64]

MEAN_MPS, LARGEST_MPS, ROUNDS = 0.76, 1.5, 3
CENTRE_M: Vec3 = (0.0, 0.0, -1.2)
HALF_M, WIDTH_M = 1.0, 1.0  # a and b: 2 m long, 1 m wide
RAMP_S = 2.0  # from rest to full speed, and back
_FINE = 20_000  # points of a round by which its length and time are found
_SAMPLE_S = 0.05


@lru_cache(maxsize=1)
def eight() -> TrajectoryConfig:
    """The figure of eight, sampled, with its velocities."""
    times, positions, velocities = motion(_SAMPLE_S)
    return TrajectoryConfig(
        times_s=tuple(times.tolist()),
        positions_m=tuple(_vec3(row) for row in positions),
        velocities_mps=tuple(_vec3(row) for row in velocities),
    )


def motion(step_s: float) -> tuple[Array, Array, Array]:
    """Times (n,), positions (n, 3) and velocities (n, 3) of the whole motion, the last one its end."""
    angle, rate, over_s = _schedule()
    times = np.append(np.arange(0.0, over_s, step_s), over_s)
    done = np.interp(times, *angle)
    speed = _speed(done, rate) * _eased(times, over_s)
    north, east = HALF_M * np.sin(done), 0.5 * WIDTH_M * np.sin(2.0 * done)
    ahead = np.column_stack([HALF_M * np.cos(done), WIDTH_M * np.cos(2.0 * done), np.zeros_like(done)])
    positions = np.column_stack([north, east, np.zeros_like(done)]) + np.array(CENTRE_M)
    return times, positions, ahead * speed[:, None]


def _speed(angle: Array, rate: tuple[float, float]) -> Array:
    """θ' at full speed [1/s]: the mean rate and how much faster the crossing is flown."""
    base, faster = rate
    return np.asarray(base * (1.0 + faster * np.cos(2.0 * angle)))


def _eased(times: Array, over_s: float) -> Array:
    """Share of the full speed: smooth from 0 to 1 and back."""
    near = np.clip(np.minimum(times, over_s - times) / RAMP_S, 0.0, 1.0)
    return np.asarray(near * near * near * (10.0 - 15.0 * near + 6.0 * near * near))


def _schedule() -> tuple[tuple[Array, Array], tuple[float, float], float]:
    """θ over time, the rate, and the length of the motion [s]."""
    fastest = math.hypot(HALF_M, WIDTH_M)

    def made(faster: float) -> tuple[tuple[Array, Array], tuple[float, float], float]:
        rate = (LARGEST_MPS / (fastest * (1.0 + faster)), faster)
        angle = np.linspace(0.0, 2.0 * math.pi * ROUNDS, ROUNDS * _FINE + 1)
        # Time at full speed; easing in and out takes RAMP_S longer in all, half of it at each end.
        slow = 1.0 / _speed(angle, rate)
        full = np.concatenate([[0.0], np.cumsum(0.5 * (slow[1:] + slow[:-1]) * np.diff(angle))])
        over_s = float(full[-1]) + RAMP_S
        times = np.linspace(0.0, over_s, 4 * _FINE)
        eased = _eased(times, over_s)
        flown = np.concatenate([[0.0], np.cumsum(0.5 * (eased[1:] + eased[:-1]) * np.diff(times))])
        return (times, np.interp(flown * (full[-1] / flown[-1]), full, angle)), rate, over_s

    def missed(faster: float) -> float:
        return _length() * ROUNDS / made(faster)[2] - MEAN_MPS

    return made(float(brentq(missed, -0.5, 0.8, xtol=1e-6)))


def _length() -> float:
    """Length of one round [m]."""
    angle = np.linspace(0.0, 2.0 * math.pi, _FINE + 1)
    points = np.column_stack([HALF_M * np.sin(angle), 0.5 * WIDTH_M * np.sin(2.0 * angle)])
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())


def _vec3(row: Array) -> Vec3:
    north, east, down = row.tolist()
    return north, east, down
