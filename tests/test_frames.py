"""Frames: known directions, inverses, handedness."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from uavctl.frames import Convention, Frame, quaternion_from_axes, rotate_vector, rotation_to_ned
from uavctl.records import Vec3

CONVENTIONS: tuple[Convention, ...] = ("ned", "enu", "flu")
metres = st.floats(-1e3, 1e3)
vectors = st.tuples(metres, metres, metres)


def determinant(a: Vec3, b: Vec3, c: Vec3) -> float:
    return a[0] * (b[1] * c[2] - b[2] * c[1]) - a[1] * (b[0] * c[2] - b[2] * c[0]) + a[2] * (b[0] * c[1] - b[1] * c[0])


@pytest.mark.parametrize(
    ("convention", "given_m", "ned_m"),
    [
        ("ned", (1.0, 2.0, 3.0), (1.0, 2.0, 3.0)),
        ("enu", (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)),  # east
        ("enu", (0.0, 1.0, 0.0), (1.0, 0.0, 0.0)),  # north
        ("enu", (0.0, 0.0, 1.0), (0.0, 0.0, -1.0)),  # up
        ("flu", (1.0, 0.0, 0.0), (1.0, 0.0, 0.0)),  # forward
        ("flu", (0.0, 1.0, 0.0), (0.0, -1.0, 0.0)),  # left
        ("flu", (0.0, 0.0, 1.0), (0.0, 0.0, -1.0)),  # up
    ],
)
def test_known_directions(convention: Convention, given_m: Vec3, ned_m: Vec3) -> None:
    assert Frame(convention).to_ned(given_m) == ned_m


@pytest.mark.parametrize("convention", ["ned", "enu", "flu"])
@pytest.mark.parametrize("euler", [False, True])
@pytest.mark.parametrize("yaw_deg", [0.0, 35.0, -160.0])
def test_an_attitude_comes_back_from_ned(convention: Convention, euler: bool, yaw_deg: float) -> None:
    frame, attitude = Frame(convention, yaw_deg=yaw_deg), (0.5, -0.1, 0.7, 0.5)
    back = frame.attitude_from_ned(frame.attitude_to_ned(attitude, euler=euler), euler=euler)
    assert abs(np.dot(back, attitude)) == pytest.approx(1.0)  # a rotation and its negative are one


def test_yaw_is_the_heading_of_the_first_axis() -> None:
    frame = Frame("ned", yaw_deg=90.0)
    assert frame.to_ned((1.0, 0.0, 0.0)) == (0.0, 1.0, 0.0)  # heading 90: the first axis points east
    assert frame.to_ned((0.0, 1.0, 0.0)) == (-1.0, 0.0, 0.0)
    assert Frame("ned", yaw_deg=30.0).to_ned((1.0, 0.0, 0.0)) == pytest.approx((math.sqrt(3) / 2, 0.5, 0.0))
    # of an ENU frame the first axis after conversion is its north
    assert Frame("enu", yaw_deg=-90.0).to_ned((0.0, 1.0, 0.0)) == (0.0, -1.0, 0.0)


def test_origin_moves_positions_and_no_velocities() -> None:
    frame = Frame("enu", (10.0, 20.0, -3.0))
    assert frame.to_ned((1.0, 2.0, 0.5)) == (12.0, 21.0, -3.5)
    assert frame.velocity_to_ned((1.0, 2.0, 0.5)) == (2.0, 1.0, -0.5)


@given(st.sampled_from(CONVENTIONS), vectors, st.floats(-180, 180), vectors)
def test_the_way_back_is_the_inverse(convention: Convention, origin_m: Vec3, yaw_deg: float, vector: Vec3) -> None:
    frame = Frame(convention, origin_m, yaw_deg)
    assert frame.from_ned(frame.to_ned(vector)) == pytest.approx(vector, abs=1e-9)
    assert frame.to_ned(frame.from_ned(vector)) == pytest.approx(vector, abs=1e-9)
    assert frame.velocity_from_ned(frame.velocity_to_ned(vector)) == pytest.approx(vector, abs=1e-9)


@given(
    st.sampled_from(CONVENTIONS), st.sampled_from((-180.0, -90.0, 0.0, 90.0, 180.0)), st.tuples(*3 * [st.integers()])
)
def test_quarter_turns_are_exact(convention: Convention, yaw_deg: float, numbers: tuple[int, int, int]) -> None:
    vector = (numbers[0] % 1000 / 8, numbers[1] % 1000 / 8, numbers[2] % 1000 / 8)
    frame = Frame(convention, (1.0, -2.0, 0.5), yaw_deg)
    assert frame.from_ned(frame.to_ned(vector)) == vector


@given(st.sampled_from(CONVENTIONS), st.floats(-180, 180))
def test_no_frame_mirrors(convention: Convention, yaw_deg: float) -> None:
    frame = Frame(convention, yaw_deg=yaw_deg)
    axes = [frame.velocity_to_ned(axis) for axis in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))]
    assert determinant(*axes) == pytest.approx(1.0)


@pytest.mark.parametrize("convention", ["nwd", "NED", ""])
def test_unknown_conventions_are_refused(convention: Convention) -> None:
    with pytest.raises(ValueError, match="none of ned, enu, flu"):
        Frame(convention)


@pytest.mark.parametrize(("origin_m", "yaw_deg"), [((math.nan, 0.0, 0.0), 0.0), ((0.0, 0.0, 0.0), math.inf)])
def test_non_finite_places_are_refused(origin_m: Vec3, yaw_deg: float) -> None:
    with pytest.raises(ValueError, match="finite"):
        Frame("ned", origin_m, yaw_deg)


unit = st.floats(-1, 1)


@given(st.tuples(unit, unit, unit, unit).filter(lambda q: math.hypot(*q) > 0.1), vectors)
def test_rotation_agrees_with_scipy(q: tuple[float, float, float, float], vector: Vec3) -> None:
    length = math.hypot(*q)
    normed = (q[0] / length, q[1] / length, q[2] / length, q[3] / length)
    want = Rotation.from_quat(normed, scalar_first=True).apply(vector)
    assert rotate_vector(normed, vector) == pytest.approx(tuple(want), abs=1e-9)


@pytest.mark.parametrize(
    "q", [(0.0, 0.0, 0.0, 0.0), (math.nan, 0.0, 0.0, 0.0), (math.inf, 0.0, 0.0, 0.0), (2.0, 0, 0, 0)]
)
def test_what_is_no_rotation_gives_none(q: tuple[float, float, float, float]) -> None:
    assert rotate_vector(q, (1.0, 0.0, 0.0)) is None


def test_a_body_at_heading_east_moves_east() -> None:
    half = math.sqrt(0.5)
    assert rotate_vector((half, 0.0, 0.0, half), (1.0, 0.0, 0.0)) == pytest.approx((0.0, 1.0, 0.0))


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_the_turn_of_a_convention_is_its_change_of_axes(convention: Convention) -> None:
    for vector in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.5, -2.0, 3.0)):
        assert rotate_vector(rotation_to_ned(convention), vector) == pytest.approx(
            Frame(convention).to_ned(vector), abs=1e-12
        )


@pytest.mark.parametrize("seed", range(40))
def test_a_turn_onto_directions_takes_the_axes_there(seed: int) -> None:
    directions = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0].T
    right_handed = np.linalg.det(directions) > 0
    turn = quaternion_from_axes(directions.tolist())
    for number, axis in enumerate(((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))):
        sign = 1.0 if right_handed or number < 2 else -1.0
        assert rotate_vector(turn, axis) == pytest.approx(tuple(sign * directions[number]), abs=1e-12)


def test_half_turns_lose_no_digits() -> None:
    assert quaternion_from_axes([(1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0)]) == (0.0, 1.0, 0.0, 0.0)
    assert quaternion_from_axes([(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)]) == (1.0, 0.0, 0.0, 0.0)
