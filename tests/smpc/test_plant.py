"""Plant and sets: closed forms, the semigroup of sub-steps, and refusals."""

from __future__ import annotations

from dataclasses import replace
from math import exp
from typing import Any

import numpy as np
import pytest
from design_rig import one_axis, paper_plant, room_plant
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from uavctl.errors import DesignError
from uavctl.smpc.plant import Plant, count_reach_steps, digest, drag_lag
from uavctl.smpc.sets import Polytope

DRAG, LAG, GAIN, DT = 0.3, 0.25, 0.9, 0.2


def lagged(**changes: Any) -> Plant:
    given: dict[str, Any] = {
        "drag_1ps": [DRAG],
        "lag_s": [LAG],
        "gain": [GAIN],
        "wind_std_mps2": [0.15],
        "dt_s": DT,
        "axes": ("down",),
    }
    return drag_lag(**(given | changes))


def test_drag_lag_is_the_exact_solution_of_its_equations() -> None:
    # p' = v, v' = a - c v + w, T a' = g u - a, solved by partial fractions with r = 1/T.
    c, r = DRAG, 1.0 / LAG
    ec, er = exp(-c * DT), exp(-r * DT)
    velocity_of_accel = (er - ec) / (c - r)
    position_of_velocity = (1.0 - ec) / c
    position_of_accel = ((1.0 - er) / r - (1.0 - ec) / c) / (c - r)
    # The integral of the response to a(0) = 1 is the response to a unit of g u, weighted by r.
    velocity_of_input = ((1.0 - er) / r - (1.0 - ec) / c) / (c - r) * r
    position_of_input = ((DT - (1.0 - er) / r) / r - (DT - (1.0 - ec) / c) / c) / (c - r) * r
    plant = lagged()
    expected_a = [[1.0, position_of_velocity, position_of_accel], [0.0, ec, velocity_of_accel], [0.0, 0.0, er]]
    np.testing.assert_allclose(plant.a, expected_a, rtol=1e-12, atol=1e-16)
    expected_b = [[GAIN * position_of_input], [GAIN * velocity_of_input], [GAIN * (1.0 - er)]]
    np.testing.assert_allclose(plant.b, expected_b, rtol=1e-11)
    np.testing.assert_allclose(plant.e, [[(DT - position_of_velocity) / c], [(1.0 - ec) / c], [0.0]], rtol=1e-11)
    np.testing.assert_allclose(plant.w, [[0.15**2]])


@pytest.mark.parametrize("drag", [0.0, 1.0 / LAG], ids=["no drag", "drag equals lag"])
def test_drag_lag_where_partial_fractions_break_down(drag: float) -> None:
    near = lagged(drag_1ps=[drag + 1e-7])
    plant = lagged(drag_1ps=[drag])
    for exact, close in ((plant.a, near.a), (plant.b, near.b), (plant.e, near.e)):
        np.testing.assert_allclose(exact, close, atol=1e-7)
    assert np.isfinite(plant.transition(DT / 3)[0]).all()


def test_axes_of_a_drag_lag_plant_are_independent() -> None:
    plant = room_plant()
    assert (plant.n_x, plant.n_u, plant.n_w) == (9, 3, 3)
    assert plant.position_index == (0, 3, 6)
    assert plant.velocity_index == (1, 4, 7)
    coupled = plant.a.copy()
    for i in range(3):
        coupled[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = 0.0
    assert not coupled.any()


@pytest.mark.parametrize("share", [0.05, 0.25, 0.5, 0.9])
def test_part_of_a_step_of_the_printed_plant_is_a_first_order_lag(share: float) -> None:
    # Δt = 1 s, 0.61 = exp(-c): the velocity of a part is exp(-c dt) v + (1 - exp(-c dt)) u.
    a, b, _ = one_axis(paper_plant()).transition(share)
    decay = 0.61**share
    np.testing.assert_allclose(a[1], [0.0, decay], atol=1e-12)
    np.testing.assert_allclose(b[1], [1.0 - decay], atol=1e-12)
    # The printed 0.79 is the position's coupling after a whole step: p' = h v with h = 0.79 c / (1 - 0.61).
    np.testing.assert_allclose(a[0], [1.0, 0.79 * (1.0 - decay) / 0.39], atol=1e-12)


def test_part_of_a_drag_lag_step_is_the_plant_of_that_step() -> None:
    whole, part = lagged(), lagged(dt_s=0.07)
    for result, reference in zip(whole.transition(0.07), (part.a, part.b, part.e), strict=True):
        np.testing.assert_allclose(result, reference, atol=1e-12)


def test_whole_step_gives_the_matrices_bit_for_bit() -> None:
    plant = paper_plant()
    for result, reference in zip(plant.transition(plant.dt_s), (plant.a, plant.b, plant.e), strict=True):
        assert np.array_equal(result, reference)


@given(first=st.floats(0.01, 0.99), share=st.floats(0.01, 0.99))
def test_parts_of_a_step_compose(first: float, share: float) -> None:
    plant = paper_plant()
    second = (1.0 - first) * share
    a1, b1, e1 = plant.transition(first)
    a2, b2, e2 = plant.transition(second)
    a, b, e = plant.transition(first + second)
    np.testing.assert_allclose(a2 @ a1, a, atol=1e-11)
    np.testing.assert_allclose(a2 @ b1 + b2, b, atol=1e-11)
    np.testing.assert_allclose(a2 @ e1 + e2, e, atol=1e-11)


@given(
    drag=st.floats(0.0, 3.0),
    lag=st.floats(0.05, 2.0),
    dt_s=st.floats(0.02, 0.5),
    share=st.floats(0.0, 1.0, exclude_max=True),
)
def test_part_of_any_drag_lag_step_follows_the_exponential(drag: float, lag: float, dt_s: float, share: float) -> None:
    plant = lagged(drag_1ps=[drag], lag_s=[lag], gain=[1.0], dt_s=dt_s)
    generator = np.zeros((5, 5))
    generator[0, 1] = 1.0
    generator[1] = [0.0, -drag, 1.0, 0.0, 1.0]
    generator[2, 2:4] = [-1.0 / lag, 1.0 / lag]
    # In this order it is not triangular: scipy is inaccurate where the diagonal of a triangular matrix nearly repeats.
    order = np.array([1, 0, 4, 2, 3])
    back = np.argsort(order)
    expected = expm(generator[np.ix_(order, order)] * share * dt_s)[np.ix_(back, back)][:3]
    np.testing.assert_allclose(np.hstack(plant.transition(share * dt_s)), expected, atol=1e-9)


@pytest.mark.parametrize("drag", [0.0, 1e-308, 1e-16, 1e-15, 1e-12, 1e-8, 1e-4])
def test_little_drag_changes_little(drag: float) -> None:
    plant = lagged(drag_1ps=[drag], lag_s=[0.0625], gain=[1.0], dt_s=0.5)
    for dt_s in (0.5, 0.25, 0.4):
        a, _, e = plant.transition(dt_s)
        # To first order in c: p = (dt - c dt²/2) v; with w held, v = (dt - c dt²/2) w and p = (dt²/2 - c dt³/6) w.
        reach = dt_s - drag * dt_s**2 / 2
        assert a[0, 1] == pytest.approx(reach, abs=1e-9)
        np.testing.assert_allclose(e[:, 0], [dt_s**2 / 2 - drag * dt_s**3 / 6, reach, 0.0], atol=1e-9)


@pytest.mark.parametrize("dt_s", [-0.01, 1.01, float("nan")])
def test_time_outside_the_step_is_an_error(dt_s: float) -> None:
    with pytest.raises(ValueError, match="within a step"):
        paper_plant().transition(dt_s)


def test_arrays_are_copied_and_read_only() -> None:
    a = np.eye(2) + np.diag([0.1], 1)
    plant = replace(one_axis(paper_plant()), a=a)
    a[0, 1] = 7.0
    assert plant.a[0, 1] == 0.1
    with pytest.raises(ValueError, match="read-only"):
        plant.a[0, 0] = 2.0


def test_inputs_and_acceleration_setpoints() -> None:
    plant = paper_plant()
    north, east, down = plant.to_accel(np.array([2.0, -1.0]))
    # v' = -0.494 (v - u), as -ln 0.61 = 0.494
    assert north == pytest.approx(2.0 * 0.49429632181478)
    assert east == pytest.approx(-0.49429632181478)
    assert down == 0.0
    np.testing.assert_allclose(plant.to_input((north, east, 5.0)), [2.0, -1.0])


def test_an_axis_goes_to_its_own_component() -> None:
    plant = lagged()
    assert plant.to_accel(np.array([1.5])) == (0.0, 0.0, 1.5)
    assert plant.to_input((1.0, 2.0, 3.0)).tolist() == [3.0]


def test_equilibrium_is_at_rest_at_the_position() -> None:
    plant = room_plant()
    state = plant.equilibrium((1.5, 1.0, -1.2))
    assert state.tolist() == [1.5, 0.0, 0.0, 1.0, 0.0, 0.0, -1.2, 0.0, 0.0]
    np.testing.assert_allclose(plant.a @ state, state, atol=1e-12)


def test_equilibrium_that_needs_an_input() -> None:
    # A spring: x = (p, v), p = 2 is held by an input only.
    base = one_axis(paper_plant())
    plant = replace(base, a=np.array([[0.9, 0.5], [-0.3, 0.5]]), b=np.array([[0.0], [1.0]]))
    state = plant.equilibrium((2.0, 0.0, 0.0))
    # 0.1 p = 0.5 v, from the first row
    np.testing.assert_allclose(state, [2.0, 0.4], atol=1e-12)


def test_a_place_without_rest_is_refused() -> None:
    plant = replace(one_axis(paper_plant()), a=np.diag([0.9, 0.61]), b=np.array([[0.0], [0.39]]))
    with pytest.raises(DesignError, match=r"target\.position_m: .*cannot rest"):
        plant.equilibrium((1.0, 0.0, 0.0))


def test_steps_to_reach_any_state() -> None:
    assert count_reach_steps(paper_plant()) == 2
    assert count_reach_steps(room_plant()) == 3


def test_a_state_that_no_input_moves_is_refused() -> None:
    plant = replace(one_axis(paper_plant()), a=np.diag([0.9, 0.61]), b=np.array([[0.0], [0.39]]))
    with pytest.raises(DesignError, match=r"plant\.b: the inputs reach 1 of 2 states"):
        count_reach_steps(plant)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"a": np.ones((2, 3))}, r"plant\.a: shape \(2, 3\) is not \(2, 2\)"),
        ({"a": np.array([[1.0, np.nan], [0.0, 0.6]])}, r"plant\.a: entry \[0, 1\] is not finite"),
        ({"a": np.array([[1.0, 0.8], [0.0, 0.0]])}, r"plant\.a: A has no real logarithm \(eigenvalues .*0"),
        ({"a": np.array([[1.0, 0.8], [0.0, -0.5]])}, r"plant\.a: A has no real logarithm \(eigenvalues .*-0\.5"),
        ({"b": np.ones((2, 2))}, r"plant\.b: shape \(2, 2\) is not \(2, 1\)"),
        ({"e": np.ones((3, 1))}, r"plant\.e: shape \(3, 1\) is not \(2, 1\)"),
        ({"w": np.eye(2)}, r"plant\.w: shape \(2, 2\) is not \(1, 1\)"),
        ({"w": np.array([[-0.6]])}, r"plant\.w: W is not positive semidefinite \(smallest eigenvalue -0\.6\)"),
        ({"w": np.array([[np.inf]])}, r"plant\.w: entry \[0, 0\] is not finite"),
        ({"dt_s": 0.0}, r"plant\.dt_s: 0 s"),
        ({"dt_s": float("inf")}, r"plant\.dt_s: inf s"),
        ({"axes": ("up",)}, r"plant\.axes: \['up'\]"),
        ({"position_index": (2,)}, r"plant\.position_index: \[2\] does not name one state of 2"),
        ({"velocity_index": (-1,)}, r"plant\.velocity_index: \[-1\]"),
        ({"accel_per_input": np.zeros(1)}, r"plant\.accel_per_input: is 0"),
        ({"accel_per_input": np.ones(2)}, r"plant\.accel_per_input: shape \(2,\) is not \(1,\)"),
    ],
)
def test_an_invalid_plant_is_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(DesignError, match=message):
        replace(one_axis(paper_plant()), **changes)


@pytest.mark.parametrize(
    ("w", "message"),
    [
        ([[0.6, 0.1], [0.0, 0.6]], r"plant\.w: W is not symmetric"),
        ([[0.6, 0.7], [0.7, 0.6]], r"plant\.w: W is not positive semidefinite \(smallest eigenvalue -0\.1\)"),
    ],
)
def test_a_matrix_that_is_no_covariance_is_refused(w: list[list[float]], message: str) -> None:
    with pytest.raises(DesignError, match=message):
        replace(paper_plant(), w=np.array(w))


def test_a_singular_covariance_is_taken() -> None:
    assert replace(paper_plant(), w=np.full((2, 2), 0.6)).w[0, 1] == 0.6


def test_axes_in_another_order_are_refused() -> None:
    with pytest.raises(DesignError, match=r"plant\.axes"):
        replace(paper_plant(), axes=("east", "north"))


def test_complex_eigenvalues_have_a_real_logarithm() -> None:
    turn = np.array([[np.cos(2.0), -np.sin(2.0)], [np.sin(2.0), np.cos(2.0)]])
    plant = replace(one_axis(paper_plant()), a=0.9 * turn)
    half = plant.transition(0.5)[0]
    np.testing.assert_allclose(half @ half, plant.a, atol=1e-12)


@pytest.mark.parametrize(
    ("changes", "message"),
    [({"lag_s": [0.0]}, r"plant\.lag_s"), ({"gain": [1.0, 1.0]}, r"plant\.gain: 2 numbers for 1 axes")],
)
def test_drag_lag_refuses(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(DesignError, match=message):
        lagged(**changes)


def test_box_rows_are_adjacent_pairs_and_open_sides_are_left_out() -> None:
    box = Polytope.from_box([-3.0, -np.inf, -1.0], [2.0, np.inf, np.inf])
    assert box.c.tolist() == [[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]
    assert box.b.tolist() == [2.0, 3.0, 1.0]
    assert box.margin(np.array([1.0, 99.0, -1.5])).tolist() == [1.0, 4.0, -0.5]


def test_box_without_limits_has_no_rows() -> None:
    box = Polytope.from_box([-np.inf, -np.inf], [np.inf, np.inf])
    assert box.c.shape == (0, 2)
    assert box.margin(np.zeros(2)).shape == (0,)


def test_names_of_states_do_not_change_the_digest() -> None:
    plant = drag_lag([0.3], [0.2], [1.0], [0.1], 0.2, ("north",))
    assert digest(replace(plant, extra_states=(("something", "m"),))) == digest(plant)
    assert digest(replace(plant, dt_s=0.2000001)) != digest(plant)
