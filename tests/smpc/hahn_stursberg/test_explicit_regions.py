"""Critical regions of a quadratic program: closed forms, and the QP solver's own answers."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from uavctl.smpc.hahn_stursberg.explicit import Critical, Parametric, critical_regions
from uavctl.smpc.qp import OPEN, SOFT, QuadraticProgram

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]


def towards(upper: float, lower: float, soft: bool, price: float = 0.0, curve: float = 0.0) -> Parametric:
    """min ½(z - x)², lower <= z <= upper."""
    return Parametric(
        h=np.eye(1),
        a=np.eye(1),
        sense=np.array([SOFT if soft else 0], dtype=np.int32),
        price=np.array([price]),
        curve=np.array([curve]),
        f=np.array([[0.0, -1.0]]),
        upper=np.array([[upper, 0.0]]),
        lower=np.array([[lower, 0.0]]),
    )


def at(regions: tuple[Critical, ...], x: Array) -> list[Critical]:
    x1 = np.concatenate([[1.0], x])
    return [region for region in regions if (region.facets @ x1 <= 0.0).all()]


def evaluated(regions: tuple[Critical, ...], x: Array) -> tuple[Array, Array]:
    """Minimiser and multipliers from the first region that x is in."""
    found, x1 = at(regions, x)[0], np.concatenate([[1.0], x])
    return found.z @ x1, found.multipliers @ x1


def test_a_clipped_value_has_three_regions() -> None:
    regions = critical_regions(towards(1.0, -2.0, soft=False), np.array([-5.0]), np.array([5.0]), np.zeros(1))
    assert len(regions) == 3
    assert not regions[0].state.any()  # that of the start comes first
    for x in np.linspace(-5.0, 5.0, 101):
        z, multipliers = evaluated(regions, np.array([x]))
        assert z[0] == pytest.approx(np.clip(x, -2.0, 1.0), abs=1e-12)
        assert multipliers[0] == pytest.approx(x - np.clip(x, -2.0, 1.0), abs=1e-12)


def test_a_soft_row_is_kept_up_to_its_price_and_left_beyond() -> None:
    price, curve = 2.0, 0.25
    program = towards(1.0, -OPEN, soft=True, price=price, curve=curve)
    regions = critical_regions(program, np.array([-5.0]), np.array([9.0]), np.zeros(1))
    assert len(regions) == 3
    for x in np.linspace(-5.0, 9.0, 141):
        # z - x + price + 2 curve (z - 1) = 0 once the price is paid
        left = (x - price + 2.0 * curve) / (1.0 + 2.0 * curve)
        wanted = x if x <= 1.0 else max(1.0, left)
        assert evaluated(regions, np.array([x]))[0][0] == pytest.approx(wanted, abs=1e-10)


def test_a_value_wanted_exactly_has_one_region_until_its_price_is_too_low() -> None:
    program = towards(0.5, 0.5, soft=True, price=1.0, curve=0.5)
    regions = critical_regions(program, np.array([-4.0]), np.array([4.0]), np.zeros(1))
    assert len(regions) == 3  # not two for the signs of its multiplier
    for x in np.linspace(-4.0, 4.0, 81):
        away = x - 0.5
        # Beyond the price 1, z - x + (1 + s) = 0 with s = z - 1/2: half of what is beyond.
        wanted = 0.5 + np.sign(away) * max(0.0, abs(away) - 1.0) / 2.0
        assert evaluated(regions, np.array([x]))[0][0] == pytest.approx(wanted, abs=1e-10)


def test_parameters_without_a_solution_are_in_no_region() -> None:
    base = towards(1.0, -OPEN, soft=False)
    program = Parametric(
        h=base.h,
        a=np.ones((2, 1)),
        sense=np.zeros(2, dtype=np.int32),
        price=np.zeros(2),
        curve=np.zeros(2),
        f=base.f,
        upper=np.array([[1.0, 0.0], [OPEN, 0.0]]),
        lower=np.array([[-OPEN, 0.0], [0.0, 0.5]]),  # x / 2 <= z <= 1
    )
    regions = critical_regions(program, np.array([-4.0]), np.array([4.0]), np.zeros(1))
    for x in np.linspace(-3.95, 3.95, 80):
        inside = at(regions, np.array([x]))
        assert bool(inside) == (x <= 2.0)
        if inside:
            assert evaluated(regions, np.array([x]))[0][0] == pytest.approx(np.clip(x, 0.5 * x, 1.0), abs=1e-12)


@pytest.mark.parametrize("seed", range(6))
def test_regions_cover_the_box_and_have_the_qp_solvers_answers_and_active_rows(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n, n_z, m = 2 + seed % 2, 4, 7
    root, a = rng.normal(size=(n_z, n_z)), rng.normal(size=(m, n_z))
    soft = rng.random(m) < 0.4
    program = Parametric(
        h=root @ root.T + 0.5 * np.eye(n_z),
        a=a,
        sense=np.where(soft, SOFT, 0).astype(np.int32),
        price=np.where(soft, 0.5, 0.0),
        curve=np.where(soft, 0.1, 0.0),
        f=np.hstack([np.zeros((n_z, 1)), rng.normal(size=(n_z, n))]),
        upper=np.hstack([rng.uniform(0.2, 1.0, (m, 1)), 0.05 * rng.normal(size=(m, n))]),
        lower=np.hstack([rng.uniform(-1.0, -0.2, (m, 1)), 0.05 * rng.normal(size=(m, n))]),
    )
    regions = critical_regions(program, np.full(n, -2.0), np.full(n, 2.0), np.zeros(n))
    assert len(regions) > 10
    solver = QuadraticProgram(program.h, a, program.sense, program.price, program.curve)
    for x in rng.uniform(-2.0, 2.0, (300, n)):
        x1 = np.concatenate([[1.0], x])
        solved = solver.solve(program.f @ x1, program.upper @ x1, program.lower @ x1)
        assert bool(at(regions, x)) == (solved is not None)
        if solved is None:
            continue
        z, multipliers = evaluated(regions, x)
        np.testing.assert_allclose(z, solved[0], atol=1e-8)
        np.testing.assert_allclose(multipliers, solved[1], atol=1e-7)
        clear = np.abs(solved[1]) > 1e-6
        np.testing.assert_array_equal(at(regions, x)[0].state[clear] != 0, True)
        np.testing.assert_array_equal(np.sign(multipliers[clear]), np.sign(solved[1][clear]))


def test_neighbours_agree_on_their_border() -> None:
    program = Parametric(
        h=np.array([[2.0, 0.5], [0.5, 1.0]]),
        a=np.array([[1.0, 0.0], [0.0, 1.0], [1.0, 1.0]]),
        sense=np.zeros(3, dtype=np.int32),
        price=np.zeros(3),
        curve=np.zeros(3),
        f=np.hstack([np.zeros((2, 1)), -np.eye(2)]),
        upper=np.hstack([np.array([[0.4], [0.6], [0.7]]), np.zeros((3, 2))]),
        lower=np.hstack([np.array([[-0.4], [-0.6], [-OPEN]]), np.zeros((3, 2))]),
    )
    regions = critical_regions(program, np.full(2, -3.0), np.full(2, 3.0), np.zeros(2))
    rng, met = np.random.default_rng(4), 0
    for _ in range(200):
        inner, outer = rng.uniform(-3.0, 3.0, (2, 2))
        first = at(regions, inner)[0]
        if first in at(regions, outer):
            continue
        for _ in range(60):
            middle = 0.5 * (inner + outer)
            inner, outer = (middle, outer) if first in at(regions, middle) else (inner, middle)
        both = at(regions, inner)
        met += len(both) > 1
        x1 = np.concatenate([[1.0], inner])
        for region in both:
            np.testing.assert_allclose(region.z @ x1, first.z @ x1, atol=1e-7)
    assert met > 50
