"""Admissible sets, equilibria, scaling of units."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from uavctl.arrays import Array

# Units do not matter: ranks are decided, and programs solved, in numbers of similar size.


# Singular values below this share of the largest, in equilibrated units, count as 0.
RANK_TOLERANCE = 1e-10

_SWEEPS = 20
_USUAL = 10.0
_NO_NOISE = 1e-7


def equilibrated(matrix: Array) -> tuple[Array, Array]:
    """Factors of rows (m,) and columns (n,) that bring the largest entry of each to 1; 1 for empty ones."""
    rows, columns = np.ones(matrix.shape[0]), np.ones(matrix.shape[1])
    for _ in range(_SWEEPS):
        scaled = np.abs(matrix) * np.outer(rows, columns)
        rows /= np.sqrt(_or_one(scaled.max(axis=1, initial=0.0)))
        columns /= np.sqrt(_or_one(scaled.max(axis=0, initial=0.0)))
    return rows, columns


def _or_one(sizes: Array) -> Array:
    return np.where(sizes > 0.0, sizes, 1.0)


@dataclass(frozen=True, eq=False)
class NaturalSizes:
    """Natural sizes of one component's numbers, each in the number's own unit; all are positive."""

    state: Array  # what inputs of their size make of a state in N steps (n_x,)
    input: Array  # half of the room between an input's limits (n_u,); without limits its stationary deviation
    state_std: Array  # stationary deviation of a state under the terminal law (n_x,), `state` where it is but rounding
    input_std: Array  # the same of an input (n_u,)
    cost: float  # stage cost of a state and an input of their sizes

    @classmethod
    def of(
        cls, a: Array, b: Array, q_x: Array, q_u: Array, c_u: Array, b_u: Array, sigma_x: Array, k: Array, free: int
    ) -> NaturalSizes:
        """Sizes of a component, whose matrices have the names that they have there, for N = `free`."""
        input_std = np.sqrt(np.maximum(np.diagonal(k @ sigma_x @ k.T), 0.0))
        weight = np.diagonal(q_u)
        unlimited = np.where(input_std > 0.0, input_std, 1.0 / np.sqrt(_or_one(weight)))
        size_u = _room(c_u, b_u, unlimited)
        reach, power = np.zeros(len(a)), b * size_u
        for _ in range(free):
            reach += np.sum(power**2, axis=1)
            power = a @ power
        size_x = np.sqrt(_or_one(reach))
        state_std = np.sqrt(np.maximum(np.diagonal(sigma_x), 0.0))
        cost = float(np.diagonal(q_x) @ size_x**2 + weight @ size_u**2)
        return cls(
            state=size_x,
            input=size_u,
            state_std=np.where(state_std > _NO_NOISE * size_x, state_std, size_x),
            input_std=np.where(input_std > _NO_NOISE * size_u, input_std, size_u),
            cost=cost if cost > 0.0 else 1.0,
        )


def _room(c: Array, b: Array, otherwise: Array) -> Array:
    """Size of each variable of {z | c z <= b}: half the way between two opposite rows, or to the only one."""
    least = np.full(c.shape[1], np.inf)
    for row, side in zip(c, b, strict=True):
        opposite = np.flatnonzero(np.all(c == -row, axis=1))
        room = (side + float(b[opposite].min())) / 2.0 if opposite.size else abs(side)
        used = row != 0.0
        if room > 0.0:
            least[used] = np.minimum(least[used], room / np.abs(row[used]))
    return np.where(np.isfinite(least), least, otherwise)


@dataclass(frozen=True, eq=False)
class Scale:
    """Natural sizes of a program's variables (n,) and of its cost, all positive."""

    variables: Array
    cost: float

    def beyond_usual(self, point: Array) -> Array:
        """Return the part of a point (n,) too large for the solver to be as accurate by itself, in natural sizes."""
        point = point / self.variables
        return point - np.clip(point, -_USUAL, _USUAL)


# States at which a plant can rest, (I - A) x_s = B u_s, and coordinates of them.


Index = NDArray[np.intp]

# A state whose value is determined by those already chosen, up to this share, tells nothing new of an equilibrium.
_NEW = 1e-6

_ROUNDING = 1e-12


@dataclass(frozen=True, eq=False)
class Equilibria:
    """x_s = x_eq y, u_s = u_eq y, for y the values of the states `held`."""

    held: Index  # indices of the states whose values are y (n_y,); positions as far as they can be chosen freely
    # (n_y, n_x): y of any state: its values, or where several positions depend on one y, that of the equilibrium whose
    # positions are nearest, weighted as in the stage cost
    coordinates: Array
    x_eq: Array  # (n_x, n_y)
    u_eq: Array  # (n_u, n_y): where several inputs hold the same state, the one of least cost


def equilibria(a: Array, b: Array, q_x: Array, q_u: Array, positions: Index) -> Equilibria:
    """The equilibria of a plant.

    Args:
        a: A (n_x, n_x).
        b: B (n_x, n_u).
        q_x: State weight (n_x, n_x).
        q_u: Input weight (n_u, n_u).
        positions: Indices of the positions among the states.
    """
    n_x = len(a)
    basis, unit_x = _resting(a, b)
    held = _held(basis, positions)
    x_eq = basis @ np.linalg.inv(basis[held])
    x_eq[np.abs(x_eq) < RANK_TOLERANCE] = 0.0  # rounding, in units of similar size
    x_eq *= np.outer(unit_x, 1.0 / unit_x[held])
    x_eq[held] = np.eye(len(held))
    coordinates = np.eye(n_x)[held]
    if len(held) < len(positions):
        at, weight = x_eq[positions], q_x[np.ix_(positions, positions)]
        normal = at.T @ weight @ at
        if np.linalg.matrix_rank(normal) == len(held):
            coordinates = np.linalg.solve(normal, at.T @ weight) @ np.eye(n_x)[positions]
    pull = x_eq - a @ x_eq
    pull[np.abs(pull) < _ROUNDING * (np.abs(x_eq) + np.abs(a) @ np.abs(x_eq))] = 0.0
    return Equilibria(held, coordinates, x_eq, holding(b, q_u, pull))


def _resting(a: Array, b: Array) -> tuple[Array, Array]:
    """Basis (n_x, n_y) of {x | (I - A) x in range B}, and the units (n_x,) that its rows are in."""
    unit_x, unit_u = equilibrated(b)
    left, singular, _ = np.linalg.svd(unit_x[:, None] * b * unit_u)
    rank = int(np.sum(singular > RANK_TOLERANCE * singular.max(initial=0.0)))
    beside, identity = left[:, rank:].T, np.eye(len(a))
    drift = beside @ (unit_x[:, None] * (identity - a))
    terms = np.abs(beside) @ (unit_x[:, None] * (identity + np.abs(a)))
    drift[np.abs(drift) < _ROUNDING * terms] = 0.0
    rows, columns = equilibrated(drift)
    _, singular, right = np.linalg.svd(drift * np.outer(rows, columns))
    kept = int(np.sum(singular > RANK_TOLERANCE * singular.max(initial=0.0)))
    return right[kept:].T, columns


def _held(basis: Array, positions: Index) -> Index:
    """States whose values determine a point of the basis' span: positions first, then the ones that tell most."""
    rest = basis.copy()
    chosen: list[int] = []
    others = np.setdiff1d(np.arange(len(basis)), positions)
    for candidates in (positions, others):
        while len(chosen) < basis.shape[1] and candidates.size:
            size = np.linalg.norm(rest[candidates], axis=1)
            best = int(np.argmax(size))
            if size[best] <= _NEW:
                break
            row = int(candidates[best])
            chosen.append(row)
            along = rest[row] / size[best]
            rest = rest - np.outer(rest @ along, along)
    return np.array(sorted(chosen), dtype=np.intp)


def rest_input(a: Array, b: Array, q_u: Array, x: Array) -> Array:
    """The input (n_u,) that plans rest with in the equilibrium `x` (n_x,): of several the one of least cost."""
    return holding(b, q_u, (x - a @ x)[:, None])[:, 0]


def holding(b: Array, q_u: Array, pull: Array) -> Array:
    """Inputs (n_u, n_y) with B u = `pull` (n_x, n_y); of several the cheapest by Q_u, and of those the smallest."""
    rows, columns = equilibrated(b)
    left, singular, right = np.linalg.svd(b * np.outer(rows, columns))
    rank = int(np.sum(singular > RANK_TOLERANCE * singular.max(initial=0.0)))
    particular = right[:rank].T @ ((left[:, :rank].T @ (rows[:, None] * pull)) / singular[:rank, None])
    u = columns[:, None] * particular
    null = columns[:, None] * right[rank:].T
    u -= null @ np.linalg.pinv(null.T @ q_u @ null) @ null.T @ q_u @ u
    return np.asarray(u)


# Polytopic admissible sets (2a), (2b).


@dataclass(frozen=True, eq=False)
class Polytope:
    """{x | C x <= b} with C (m, n) and b (m,)."""

    c: Array
    b: Array

    @classmethod
    def from_box(cls, lower: Sequence[float], upper: Sequence[float]) -> Self:
        """Box with open sides where a limit is infinite; the rows of a two-sided limit are adjacent, + then -."""
        rows: list[Array] = []
        limits: list[float] = []
        for i, (low, high) in enumerate(zip(lower, upper, strict=True)):
            unit = np.eye(len(lower))[i]
            if np.isfinite(high):
                rows.append(unit)
                limits.append(high)
            if np.isfinite(low):
                rows.append(-unit)
                limits.append(-low)
        return cls(np.array(rows).reshape(-1, len(lower)), np.array(limits))

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Limits of each variable (n,), (n,), by the rows of that variable alone; infinite where there is none."""
        low, high = np.full(self.c.shape[1], -np.inf), np.full(self.c.shape[1], np.inf)
        for row, side in zip(self.c, self.b, strict=True):
            (used,) = np.nonzero(row)
            if used.size != 1:
                continue
            (i,) = used
            if row[i] > 0:
                high[i] = min(high[i], side / row[i])
            else:
                low[i] = max(low[i], side / row[i])
        return low, high

    def margin(self, x: Array) -> Array:
        """b - C x (m,): negative where a limit is broken."""
        margin: Array = self.b - self.c @ x
        return margin
