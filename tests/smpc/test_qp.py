"""Quadratic programs against CVXPY, and their bits."""

from __future__ import annotations

import cvxpy as cp
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from uavctl.arrays import Array
from uavctl.smpc.qp import EQUAL, LEAST_CURVE, OPEN, SOFT, QuadraticProgram


class Drawn:
    """A program of hard, soft and pinned rows that has an optimum; some sides are open."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        n, m = int(rng.integers(2, 8)), int(rng.integers(4, 20))
        root = rng.normal(size=(n, n))
        self.h = root.T @ root + 0.1 * np.eye(n)
        self.f = 5.0 * rng.normal(size=n)
        self.a = rng.normal(size=(m, n))
        inside = self.a @ rng.normal(size=n)
        self.sense = rng.choice([0, SOFT], m).astype(np.int32)
        self.sense[0] = EQUAL
        soft = self.sense == SOFT
        # Soft rows may be impossible to keep, hard ones leave a point.
        self.upper = inside + np.where(soft, rng.uniform(-2.0, 1.0, m), rng.uniform(0.01, 1.0, m))
        self.lower = self.upper - rng.uniform(2.0, 4.0, m)
        self.lower[0] = self.upper[0] = inside[0]
        self.upper[1], self.lower[2] = OPEN, -OPEN
        self.price = np.where(soft, rng.uniform(0.1, 20.0, m), 0.0)
        self.curve = np.where(soft, rng.choice([0.0, 1.0, 10.0], m), 0.0)

    def program(self) -> QuadraticProgram:
        return QuadraticProgram(self.h, self.a, self.sense, self.price, self.curve)

    def cost(self, z: Array) -> float:
        value = self.a @ z
        outside = np.maximum(np.maximum(value - self.upper, self.lower - value), 0.0)
        return float(0.5 * z @ self.h @ z + self.f @ z + self.price @ outside + self.curve @ outside**2)

    def optimum(self) -> float:
        z, outside = cp.Variable(self.f.size), cp.Variable(len(self.a), nonneg=True)
        cost = 0.5 * cp.sum_squares(np.linalg.cholesky(self.h).T @ z) + self.f @ z + self.price @ outside
        cost += self.curve @ cp.square(outside)
        above, below = np.flatnonzero(self.upper < OPEN), np.flatnonzero(self.lower > -OPEN)
        rows = [(self.a @ z - outside)[above] <= self.upper[above], (self.a @ z + outside)[below] >= self.lower[below]]
        rows.append(outside[np.flatnonzero(self.sense != SOFT)] == 0.0)
        problem = cp.Problem(cp.Minimize(cost), rows)
        problem.solve(solver=cp.CLARABEL)
        assert problem.status == cp.OPTIMAL
        return float(problem.value)


@pytest.mark.parametrize("seed", range(25))
def test_the_optimum_is_cvxpy_s(seed: int) -> None:
    drawn = Drawn(seed)
    solved = drawn.program().solve(drawn.f, drawn.upper, drawn.lower)
    assert solved is not None
    z, _ = solved
    assert drawn.cost(z) == pytest.approx(drawn.optimum(), rel=1e-6, abs=1e-6)
    value, hard = drawn.a @ z, drawn.sense != SOFT
    assert np.all(value[hard] <= drawn.upper[hard] + 1e-8)
    assert np.all(value[hard] >= drawn.lower[hard] - 1e-8)


@given(st.integers(0, 10_000))
@example(17)  # a row without a curve is left by 4.7, where the least curve shows
@settings(max_examples=60, derandomize=True)
def test_multipliers_are_those_of_the_optimum(seed: int) -> None:
    """Stationary, of the sign of the side that is met, 0 inside, and at most a soft row's slope."""
    drawn = Drawn(seed)
    solved = drawn.program().solve(drawn.f, drawn.upper, drawn.lower)
    assert solved is not None
    z, net = solved
    assert drawn.h @ z + drawn.f + drawn.a.T @ net == pytest.approx(np.zeros(z.size), abs=1e-7)
    value = drawn.a @ z
    over, under = value - drawn.upper, drawn.lower - value
    hard = drawn.sense == 0
    assert np.all(np.abs(over[hard & (net > 1e-7)]) < 1e-7)
    assert np.all(np.abs(under[hard & (net < -1e-7)]) < 1e-7)
    soft = drawn.sense == SOFT
    outside = np.maximum(np.maximum(over, under), 0.0)
    # The program that is solved gives every soft row a least curve.
    curve = np.maximum(drawn.curve, LEAST_CURVE * np.abs(np.diagonal(drawn.h)).max(initial=1.0))
    slope = drawn.price + 2.0 * curve * outside
    assert np.all(np.abs(net)[soft] <= slope[soft] + 1e-6)
    left = soft & (outside > 1e-6)
    assert np.abs(net)[left] == pytest.approx(slope[left], rel=1e-5, abs=1e-6)
    inside = soft & (over < -1e-6) & (under < -1e-6)
    assert np.abs(net)[inside] == pytest.approx(np.zeros(inside.sum()), abs=1e-8)


def test_one_variable_by_hand() -> None:
    """min z² - 10 z: 5 without limits, 3 at a hard limit of 3 (multiplier 4), 4 beyond a soft one of price 2."""
    h, f, a = np.array([[2.0]]), np.array([-10.0]), np.array([[1.0]])
    zero = np.zeros(1)
    hard = QuadraticProgram(h, a, np.zeros(1, dtype=np.int32), zero, zero)
    for side, z, multiplier in ((OPEN, 5.0, 0.0), (np.inf, 5.0, 0.0), (3.0, 3.0, 4.0)):
        solved = hard.solve(f, np.array([side]), np.array([-OPEN]))
        assert solved is not None
        assert (solved[0][0], solved[1][0]) == pytest.approx((z, multiplier), abs=1e-9)
    soft = QuadraticProgram(h, a, np.array([SOFT], dtype=np.int32), np.array([2.0]), zero)
    solved = soft.solve(f, np.array([3.0]), np.array([-OPEN]))
    assert solved is not None
    assert (solved[0][0], solved[1][0]) == pytest.approx((4.0, 2.0), abs=1e-7)
    curved = QuadraticProgram(h, a, np.array([SOFT], dtype=np.int32), np.array([2.0]), np.array([1.0]))
    solved = curved.solve(f, np.array([3.0]), np.array([-OPEN]))  # 2 z - 10 + 2 + 2 (z - 3) = 0
    assert solved is not None
    assert (solved[0][0], solved[1][0]) == pytest.approx((3.5, 3.0), abs=1e-9)


def test_without_an_optimum_there_is_no_answer() -> None:
    program = QuadraticProgram(np.eye(1), np.ones((2, 1)), np.zeros(2, dtype=np.int32), np.zeros(2), np.zeros(2))
    sides = np.array([1.0, 5.0]), np.array([-OPEN, 3.0])  # z <= 1 and z >= 3
    assert program.solve(np.zeros(1), *sides) is None
    assert program.solve(np.array([np.nan]), np.array([1.0, 5.0]), np.array([-1.0, -5.0])) is None
    # And none of it is remembered.
    again = program.solve(np.array([-3.0]), np.array([1.0, 5.0]), np.array([-1.0, -5.0]))
    assert again is not None
    assert again[0][0] == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_same_question_same_bits_after_any_other_questions(seed: int) -> None:
    drawn = Drawn(seed)
    new = drawn.program().solve(drawn.f, drawn.upper, drawn.lower)
    assert new is not None
    used, rng = drawn.program(), np.random.default_rng(seed)
    for _ in range(100):
        shift = rng.normal(size=drawn.upper.size)
        used.solve(10.0 * rng.normal(size=drawn.f.size), drawn.upper + shift, drawn.lower + shift)
    used.solve(np.full(drawn.f.size, np.nan), drawn.upper, drawn.lower)
    used.solve(drawn.f, drawn.lower, drawn.upper)
    again = used.solve(drawn.f, drawn.upper, drawn.lower)
    assert again is not None
    assert [part.tobytes() for part in again] == [part.tobytes() for part in new]
    repeated = used.solve_with_matrices(drawn.h, drawn.f, drawn.a, drawn.upper, drawn.lower)
    assert repeated is not None
    assert [part.tobytes() for part in repeated] == [part.tobytes() for part in new]


@pytest.mark.parametrize("seed", range(5))
def test_without_a_linear_term_it_is_zero_to_the_last_bit(seed: int) -> None:
    drawn = Drawn(seed)
    without = QuadraticProgram(drawn.h, drawn.a, drawn.sense, drawn.price, drawn.curve, linear=False)
    z = without.solve_sides(drawn.upper, drawn.lower)
    zero = drawn.program().solve(np.zeros(drawn.f.size), drawn.upper, drawn.lower)
    assert z is not None
    assert zero is not None
    assert z.tobytes() == zero[0].tobytes()
    assert without.solve_sides(np.full_like(drawn.upper, np.nan), drawn.lower) is None


def test_new_matrices_are_a_new_program() -> None:
    rng = np.random.default_rng(8)
    drawn = Drawn(8)
    used = drawn.program()
    other = Drawn(8)
    other.h, other.a = other.h + np.eye(other.f.size), other.a * rng.uniform(0.9, 1.1, (len(other.a), 1))
    other.upper[0] = other.lower[0] = 0.0
    repeated = used.solve_with_matrices(other.h, other.f, other.a, other.upper, other.lower)
    assert repeated is not None
    assert other.cost(repeated[0]) == pytest.approx(other.optimum(), rel=1e-6)
    new = other.program().solve(other.f, other.upper, other.lower)
    assert new is not None
    assert repeated[0].tobytes() == new[0].tobytes()
