"""Polynomials of `uav_trajectories` as a mission's file, against `numpy.polynomial`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.polynomial import Polynomial
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline

from uavctl.config import load
from uavctl.config.mission import TrajectoryConfig
from uavctl.config.polynomials import HEADINGS, find_roots
from uavctl.errors import ConfigError

HEADER = ",".join(HEADINGS)
REST = (0.0,) * 8
# From rest to rest: 35 s⁴ - 84 s⁵ + 70 s⁶ - 20 s⁷ goes from 0 to 1 within s = 0 … 1.
STEP = (0.0, 0.0, 0.0, 0.0, 35.0, -84.0, 70.0, -20.0)
HEIGHT = (1.0, *REST[1:])


def scale(coefficients: Sequence[float], size: float, duration_s: float) -> list[float]:
    return [size * c / duration_s**power for power, c in enumerate(coefficients)]


def row(duration_s: float, x: Sequence[float], y: Sequence[float] = REST, z: Sequence[float] = HEIGHT) -> str:
    return ",".join(map(repr, (duration_s, *x, *y, *z, *REST)))


def read(folder: Path, *lines: str) -> TrajectoryConfig:
    path = folder / str(len(list(folder.iterdir()))) / "way.csv"  # a test run loads each configuration once
    path.parent.mkdir()
    path.write_text("\n".join(lines) + "\n")
    return load("room", [f"mission.trajectory.file={path}"]).config.mission.trajectory


def reasons(folder: Path, *lines: str) -> list[str]:
    with pytest.raises(ConfigError) as raised:
        read(folder, *lines)
    return [line.split("way.csv:")[-1] for line in str(raised.value).splitlines()]


def spline(trajectory: TrajectoryConfig) -> CubicHermiteSpline:
    return CubicHermiteSpline(trajectory.times_s, trajectory.positions_m, trajectory.velocities_mps)


def test_samples_follow_pieces_in_local_ned(tmp_path: Path) -> None:
    east, north, up = scale(STEP, 1.5, 4.0), scale(STEP, -0.8, 4.0), scale(STEP, 0.3, 4.0)
    up[0] = 1.0
    back = scale(STEP, -1.5, 5.0)
    back[0] = 1.5
    ends = [-0.8, *REST[1:]], [1.3, *REST[1:]]
    found = spline(read(tmp_path, HEADER, row(4.0, east, north, up), row(5.0, back, *ends)))
    for begin_s, end_s, axes in ((0.0, 4.0, (north, east, up)), (4.0, 9.0, (ends[0], back, ends[1]))):
        times_s: NDArray[np.float64] = np.linspace(begin_s, end_s, 2001)
        wanted = np.array([Polynomial(axis)(times_s - begin_s) for axis in axes]).T * (1.0, 1.0, -1.0)
        np.testing.assert_allclose(found(times_s), wanted, rtol=0.0, atol=1e-4)


@given(st.lists(st.floats(-1.0, 1.0), min_size=2, max_size=8), st.floats(0.1, 3.0))
def test_roots_are_those_of_numpy(coefficients: list[float], end: float) -> None:
    """A sign that changes between two places has a root there, and each root found is one."""
    polynomial = Polynomial(coefficients)
    found = find_roots(tuple(coefficients), end)
    for place in found:
        slack = 1e-13 * sum(abs(c) * end**power for power, c in enumerate(coefficients))
        slope = max(abs(Polynomial(coefficients).deriv()(at)) for at in np.linspace(0, end, 9))
        assert abs(polynomial(place)) <= slack + slope * 1e-15
    places = np.linspace(0.0, end, 201)
    signs = np.sign(polynomial(places))
    for low, high, before, after in zip(places, places[1:], signs, signs[1:], strict=False):
        if before * after < 0:
            assert any(low - 1e-9 <= place <= high + 1e-9 for place in found)


# A bump of x = 4 h t (T - t) / T² that lasts between two samples of any fixed grid, and reaches h at its middle.
def bump(height_m: float, duration_s: float) -> list[float]:
    return [0.0, 4.0 * height_m / duration_s, -4.0 * height_m / duration_s**2, 0.0, 0.0, 0.0, 0.0, 0.0]


@pytest.mark.parametrize(("height_m", "is_inside"), [(2.5 - 1e-9, True), (2.5 + 1e-9, False)])
def test_walls_are_checked_at_extremes_to_a_nanometre(tmp_path: Path, height_m: float, is_inside: bool) -> None:
    lines = HEADER, row(17.3, bump(height_m, 17.3))
    if is_inside:
        assert max(place[1] for place in read(tmp_path, *lines).positions_m) == pytest.approx(height_m, abs=1e-12)
    else:
        (reason,) = reasons(tmp_path, *lines)
        assert reason.startswith("2: mission.trajectory.positions_m[") and "east 2.5 m is outside" in reason


def test_speeds_are_checked_at_their_extremes(tmp_path: Path) -> None:
    """The largest speed of the step is 35/16 of its mean one, in the middle."""
    limit_mps = load("room", []).config.sets.state_upper[4]
    duration_s = 35.0 / 16.0 * 2.0 / limit_mps
    read(tmp_path, HEADER, row(duration_s * (1 + 1e-9), scale(STEP, 2.0, duration_s * (1 + 1e-9))))
    (reason,) = reasons(tmp_path, HEADER, row(duration_s * (1 - 1e-6), scale(STEP, 2.0, duration_s * (1 - 1e-6))))
    assert reason.startswith("2: mission.trajectory.velocities_mps[")


def round_six(coefficients: Sequence[float]) -> list[float]:
    return [round(coefficient, 6) for coefficient in coefficients]


def sum_rounding(duration_s: float) -> float:
    """The most by which coefficients that are rounded to six decimals move the end of a piece [m]."""
    return float(0.5e-6 * Polynomial([1.0] * 8)(duration_s))


@pytest.mark.parametrize("duration_s", [3.0, 6.0, 8.0])
def test_long_pieces_of_six_decimals_meet(tmp_path: Path, duration_s: float) -> None:
    exact = scale(STEP, 2.0, duration_s)
    back = scale(STEP, -2.0, duration_s)
    back[0] = 2.0
    ways = [round_six(way) for way in (exact, back)]
    # What rounding alone moves the end by is seen, and the motion stays that of the file within it.
    found = spline(read(tmp_path, HEADER, *(row(duration_s, way) for way in ways)))
    times_s: NDArray[np.float64] = np.linspace(0.0, 2.0 * duration_s, 20_001)
    wanted = np.where(
        times_s < duration_s, Polynomial(exact)(times_s), Polynomial(back)(np.maximum(times_s - duration_s, 0.0))
    )
    found_m = found(times_s)[:, 1]
    assert abs(found_m - wanted).max() <= 2.0 * sum_rounding(duration_s) + 1e-4
    fastest_mps = abs(Polynomial(exact).deriv()(times_s[times_s <= duration_s])).max()
    slack_mps = 2.0 * 0.5e-6 * Polynomial([1.0] * 8).deriv()(duration_s)
    steps_m = abs(np.diff(found_m)).max()
    assert steps_m <= 1.05 * (fastest_mps + slack_mps) * times_s[1]  # no jump where pieces meet


@pytest.mark.parametrize("duration_s", [1.0, 6.0, 8.0])
@pytest.mark.parametrize(("share", "is_refused"), [(0.99, False), (1.01, True)])
def test_jumps_up_to_the_rounding_are_taken_off_and_larger_ones_are_refused(
    tmp_path: Path, duration_s: float, share: float, is_refused: bool
) -> None:
    # Not counted: the six decimals of the next piece's own begin
    jump_m = share * max(0.02, sum_rounding(duration_s) + 0.5e-6)
    lines = HEADER, row(duration_s, REST), row(2.0, (jump_m, *REST[1:]))
    if is_refused:
        assert reasons(tmp_path, *lines)[0].startswith("3: column 2, x^0: begins")
    else:
        found = spline(read(tmp_path, *lines))
        assert found(duration_s)[1] == pytest.approx(jump_m, abs=1e-12) and found(0.0)[1] == 0.0
        times_s = np.linspace(0.0, duration_s + 2.0, 10_001)
        assert abs(np.diff(found(times_s)[:, 1])).max() < 10.0 * jump_m / duration_s * times_s[1]


@pytest.mark.parametrize("before_end_s", [0.0, 1e-9, 4e-7, 1e-6, 2e-6, 1e-4, 0.01])
@pytest.mark.parametrize("jump_m", [0.0, 0.015])
def test_an_extreme_near_an_inner_end_counts_once_and_is_never_missed(
    tmp_path: Path, before_end_s: float, jump_m: float
) -> None:
    """x rises to its extreme shortly before the end of the first piece; the second one goes back to rest."""
    end_s, height_m = 4.0, 1.0
    top_s = end_s - before_end_s
    rise = Polynomial([0.0, 2.0 * height_m / top_s, -height_m / top_s**2])
    begin_m, begin_mps = float(rise(end_s)) - jump_m, float(rise.deriv()(end_s))
    back = Polynomial([begin_m, begin_mps, -0.05])
    rows = [row(end_s, [*rise.coef.tolist(), *REST[3:]]), row(2.0, [*back.coef.tolist(), *REST[3:]])]
    trajectory = read(tmp_path, HEADER, *rows)
    times_s, east_m = np.array(trajectory.times_s), np.array(trajectory.positions_m)[:, 1]
    # The joint is at the begin of the second piece; a small jump bends the end of the first one.
    a = -jump_m * 7.0 / end_s**6
    b = jump_m * 6.0 / end_s**7
    flown = rise + Polynomial([0.0] * 6 + [a, b])
    dense: NDArray[np.float64] = np.concatenate(
        [np.linspace(0.0, end_s, 40_001), np.linspace(end_s - 0.05, end_s, 50_001)]
    )
    largest_m = max(flown(dense).max(), back(np.linspace(0.0, 2.0, 10_001)).max())
    assert east_m.max() == pytest.approx(largest_m, abs=1e-10)
    assert np.diff(times_s).min() > 0.9e-6
    if not jump_m:
        assert np.sum(abs(times_s - top_s) < 1.1e-6) == 1


@pytest.mark.parametrize(
    ("lines", "told"),
    [
        ([HEADER.replace("x^1", "x1"), row(4.0, REST)], '1: column 3, "x1"'),
        ([HEADER + ",more", row(4.0, REST)], "1: has 34 columns"),
        ([HEADER, row(4.0, REST) + ",1"], "2: has 34 columns"),
        ([HEADER, row(4.0, REST).replace("4.0", "four")], '2: column 1, duration: "four"'),
        ([HEADER, row(0.0, REST)], "2: column 1, duration: 0 s"),
        ([HEADER, row(4.0, (0.0, float("nan"), *REST[2:]))], '2: column 3, x^1: "nan"'),
        ([HEADER, row(4.0, REST, (*REST[:7], 1e9))], "2: column 17, y^7: 1e+09"),
        ([HEADER, row(4.0, REST)[:-3] + "0.5"], "2: column 33, yaw^7: 0.5"),
        ([HEADER, row(4.0, REST), row(4.0, (0.5, *REST[1:]))], "3: column 2, x^0: begins 0.5 m"),
        ([HEADER, row(4.0, REST), row(4.0, REST, (0.0, 0.2, *REST[2:]))], "3: column 11, y^1: begins 0.2 m/s"),
        ([HEADER, row(900.0, (0.0, 0.0, 0.0, 0.0, 1e7, *REST[5:]))], "2: the file needs more than"),
    ],
)
def test_what_is_wrong_is_told_with_its_line_and_column(tmp_path: Path, lines: list[str], told: str) -> None:
    assert reasons(tmp_path, *lines)[0].startswith(told)


def test_a_comma_at_the_end_of_lines_is_no_column(tmp_path: Path) -> None:
    lines = [HEADER, row(4.0, scale(STEP, 1.0, 4.0))]
    assert read(tmp_path, *(line + "," for line in lines)) == read(tmp_path, *lines)


def test_a_file_without_pieces_is_told(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"way\.csv: has no pieces"):
        read(tmp_path, HEADER)
