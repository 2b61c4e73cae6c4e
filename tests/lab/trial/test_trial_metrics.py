"""Figures of a flight against closed forms on made-up motions."""

from __future__ import annotations

import math

import numpy as np
import pytest

from uavctl.lab.trial import beyond_m, distances_m, largest, mean, rms_m, settled_s

TIMES = np.arange(0.0, 20.0, 0.01)


def test_on_a_circle_about_the_target_every_distance_is_its_radius() -> None:
    target = np.array([1.0, 2.0, -1.2])
    circle = target + 0.3 * np.column_stack([np.cos(TIMES), np.sin(TIMES), np.zeros_like(TIMES)])
    off = distances_m(circle, target)
    assert rms_m(off) == pytest.approx(0.3) and largest(off) == pytest.approx(0.3) and mean(off) == pytest.approx(0.3)


def test_a_sine_has_its_amplitude_by_root_two_as_rms_and_two_by_pi_of_it_as_mean() -> None:
    make_whole_component = np.linspace(0.0, 2.0 * math.pi, 100_001)[:-1]
    wave = np.zeros((make_whole_component.size, 3))
    wave[:, 2] = 0.5 * np.sin(make_whole_component)
    off = distances_m(wave, np.zeros(3))
    assert rms_m(off) == pytest.approx(0.5 / math.sqrt(2.0), rel=1e-6)
    assert mean(off) == pytest.approx(0.5 * 2.0 / math.pi, rel=1e-6)


def test_a_target_that_moves_is_met_row_by_row() -> None:
    moving = np.column_stack([TIMES, 2.0 * TIMES, np.zeros_like(TIMES)])
    assert distances_m(moving + np.array([0.0, 0.0, 0.25]), moving) == pytest.approx(0.25)


def test_an_exponential_settles_at_its_logarithm() -> None:
    off = 3.0 * np.exp(-TIMES / 1.5)
    for radius_m in (0.3, 0.1):
        assert settled_s(TIMES, off, radius_m) == pytest.approx(1.5 * math.log(3.0 / radius_m), abs=0.011)


def test_settled_is_to_stay() -> None:
    off = np.zeros(10)
    off[[0, 1, 6]] = 1.0
    times = np.arange(10.0)
    assert settled_s(times, off, 0.5) == 7.0
    off[9] = 1.0
    assert settled_s(times, off, 0.5) == math.inf
    assert settled_s(times, np.zeros(10), 0.5) == 0.0


def test_beyond_is_of_the_nearest_wall_and_negative_inside() -> None:
    lower, upper = np.array([-3.0, -np.inf, -2.5]), np.array([3.0, np.inf, 0.0])
    where = np.array([[0.0, 1e3, -1.2], [2.9, 0.0, -1.2], [3.4, 0.0, -1.2], [0.0, 0.0, -2.7]])
    assert beyond_m(where, lower, upper) == pytest.approx([-1.2, -0.1, 0.4, 0.2])


def test_of_nothing_there_is_no_figure() -> None:
    assert all(math.isnan(figure(np.empty(0))) for figure in (rms_m, largest, mean))
