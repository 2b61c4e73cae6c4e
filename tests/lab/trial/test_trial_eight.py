"""The figure of eight has the speeds that were asked for, and its velocities are those of its positions."""

from __future__ import annotations

import numpy as np
import pytest

from uavctl.lab.figure_eight import (
    CENTRE_M,
    HALF_M,
    MAX_MPS,
    MEAN_MPS,
    ROUNDS,
    WIDTH_M,
    make_figure_eight,
    sample_figure_eight,
)
from uavctl.lab.trial import make_path


def test_its_mean_and_largest_speeds_are_those_of_the_paper() -> None:
    times, positions, velocities = sample_figure_eight(0.002)
    way_m = np.linalg.norm(np.diff(positions, axis=0), axis=1).sum()
    assert way_m / times[-1] == pytest.approx(MEAN_MPS, rel=1e-4)
    assert np.linalg.norm(velocities, axis=1).max() == pytest.approx(MAX_MPS, rel=1e-4)


def test_it_begins_and_ends_at_rest_in_the_centre_three_rounds_later() -> None:
    _, positions, velocities = sample_figure_eight(0.002)
    assert positions[[0, -1]] == pytest.approx(np.array([CENTRE_M, CENTRE_M]), abs=1e-9)
    assert velocities[[0, -1]] == pytest.approx(0.0)
    off = positions - np.array(CENTRE_M)
    assert np.abs(off).max(axis=0) == pytest.approx([HALF_M, 0.5 * WIDTH_M, 0.0], rel=1e-4)
    tips = (np.diff(np.sign(velocities[1:-1, 0])) != 0).sum()  # two a round
    assert tips == 2 * ROUNDS


def test_its_velocities_are_the_differences_of_its_positions() -> None:
    times, positions, velocities = sample_figure_eight(0.002)
    middle = 0.5 * (velocities[1:] + velocities[:-1])
    assert np.abs(np.diff(positions, axis=0) / np.diff(times)[:, None] - middle).max() < 1e-3


def test_what_is_sampled_is_the_motion_and_rests_outside_of_its_time() -> None:
    at, (times, positions, velocities) = make_path(make_figure_eight()), sample_figure_eight(0.013)
    for time, place, speed in zip(times[1:-1:7], positions[1:-1:7], velocities[1:-1:7], strict=True):
        point = at(float(time))
        assert point[0] == pytest.approx(place, abs=1e-3) and point[1] == pytest.approx(speed, abs=0.02)
    for time in (-1.0, float(times[-1]) + 1.0):
        place, *derivatives = at(time)
        assert place == pytest.approx(CENTRE_M) and derivatives == [(0.0, 0.0, 0.0)] * 2
