"""Admissible sets (2a), (2b), equilibria, and scaling of units.

1. Units do not matter: ranks are decided, and programs solved, in numbers of similar size.
2. Equilibria are the states with (I - A) x_s = B u_s. They have coordinates y: the values of chosen states.
3. A `Polytope` is an admissible set C x <= b; `find_pairs` groups its rows ±c, which share a back-off.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from uavctl.arrays import Array

# Singular values below this share of the largest, in equilibrated units, count as 0.
RANK_TOLERANCE = 1e-10

_SWEEPS = 20  # sweeps over rows and columns that bring both close to 1
_ACCURATE_SIZES = 10.0  # natural sizes up to which a solver is accurate by itself
_ROUNDING_DEVIATION = 1e-7  # deviations below this share of the natural size are rounding


def equilibrate(matrix: Array) -> tuple[Array, Array]:
    """Return factors of rows (m,) and columns (n,) that bring the largest entry of each to 1; 1 for empty ones."""
    rows, columns = np.ones(matrix.shape[0]), np.ones(matrix.shape[1])
    for _ in range(_SWEEPS):
        scaled = np.abs(matrix) * np.outer(rows, columns)
        rows /= np.sqrt(_replace_zeros(scaled.max(axis=1, initial=0.0)))
        columns /= np.sqrt(_replace_zeros(scaled.max(axis=0, initial=0.0)))
    return rows, columns


def _replace_zeros(sizes: Array) -> Array:
    return np.where(sizes > 0.0, sizes, 1.0)


@dataclass(frozen=True, eq=False)
class NaturalSizes:
    """Natural sizes of one component's numbers, each in its own unit; all are positive."""

    state: Array  # size of a state after N steps of inputs of their size (n_x,)
    input: Array  # half of the range between an input's limits (n_u,); without limits its stationary deviation
    state_std: Array  # stationary deviation of a state under the terminal law (n_x,), `state` where it is rounding
    input_std: Array  # the same of an input (n_u,)
    cost: float  # stage cost of a state and an input of their sizes

    @classmethod
    def from_component(
        cls, a: Array, b: Array, q_x: Array, q_u: Array, c_u: Array, b_u: Array, sigma_x: Array, k: Array, free: int
    ) -> NaturalSizes:
        """Compute the sizes from the matrices of a component, for N = `free`."""
        # std u = diag(K Σ_x K')^½
        input_std = np.sqrt(np.maximum(np.diagonal(k @ sigma_x @ k.T), 0.0))
        weight = np.diagonal(q_u)
        unlimited = np.where(input_std > 0.0, input_std, 1.0 / np.sqrt(_replace_zeros(weight)))
        size_u = _find_half_ranges(c_u, b_u, unlimited)
        # size x² = Σ_{i<N} Σ_j (A^i B)²_j size u_j²
        reach, power = np.zeros(len(a)), b * size_u
        for _ in range(free):
            reach += np.sum(power**2, axis=1)
            power = a @ power
        size_x = np.sqrt(_replace_zeros(reach))
        state_std = np.sqrt(np.maximum(np.diagonal(sigma_x), 0.0))
        # cost = Σ Q_x,ii size x_i² + Σ Q_u,jj size u_j²
        cost = float(np.diagonal(q_x) @ size_x**2 + weight @ size_u**2)
        return cls(
            state=size_x,
            input=size_u,
            state_std=np.where(state_std > _ROUNDING_DEVIATION * size_x, state_std, size_x),
            input_std=np.where(input_std > _ROUNDING_DEVIATION * size_u, input_std, size_u),
            cost=cost if cost > 0.0 else 1.0,
        )


def _find_half_ranges(c: Array, b: Array, default: Array) -> Array:
    """Return half the range of each variable in {z | c z <= b}: from opposite rows, or a single one."""
    half_range = np.full(c.shape[1], np.inf)
    for row, side in zip(c, b, strict=True):
        opposite = np.flatnonzero(np.all(c == -row, axis=1))
        margin = (side + float(b[opposite].min())) / 2.0 if opposite.size else abs(side)
        used = row != 0.0
        if margin > 0.0:
            half_range[used] = np.minimum(half_range[used], margin / np.abs(row[used]))
    return np.where(np.isfinite(half_range), half_range, default)


@dataclass(frozen=True, eq=False)
class Scale:
    """Natural sizes of a program's variables (n,) and of its cost, all positive."""

    variables: Array
    cost: float

    def compute_excess(self, point: Array) -> Array:
        """Return the part of a point (n,) beyond `_ACCURATE_SIZES`, in natural sizes."""
        point = point / self.variables
        return point - np.clip(point, -_ACCURATE_SIZES, _ACCURATE_SIZES)


Index = NDArray[np.intp]

# A state that the chosen ones determine up to this share is no further coordinate.
_MIN_INDEPENDENT = 1e-6

_ROUNDING = 1e-12  # smaller shares are rounding


@dataclass(frozen=True, eq=False)
class Equilibria:
    """x_s = x_eq y, u_s = u_eq y, for y the values of the states `held`."""

    held: Index  # indices of the states whose values are y (n_y,); positions as far as they can be chosen freely
    # (n_y, n_x): y of any state: its values. Where several positions depend on one y: y of the equilibrium with the
    # nearest positions, weighted as in the stage cost
    coordinates: Array
    x_eq: Array  # (n_x, n_y)
    u_eq: Array  # (n_u, n_y): of several inputs that hold a state, the cheapest


def find_equilibria(a: Array, b: Array, q_x: Array, q_u: Array, positions: Index) -> Equilibria:
    """Find the equilibria of a plant.

    Args:
        a: A (n_x, n_x).
        b: B (n_x, n_u).
        q_x: State weight (n_x, n_x).
        q_u: Input weight (n_u, n_u).
        positions: Indices of the positions among the states.
    """
    n_x = len(a)
    basis, unit_x = _find_equilibrium_basis(a, b)
    held = _choose_held(basis, positions)
    x_eq = basis @ np.linalg.inv(basis[held])
    x_eq[np.abs(x_eq) < RANK_TOLERANCE] = 0.0  # rounding, in units of similar size
    x_eq *= np.outer(unit_x, 1.0 / unit_x[held])
    x_eq[held] = np.eye(len(held))
    coordinates = np.eye(n_x)[held]
    if len(held) < len(positions):
        x_positions, weight = x_eq[positions], q_x[np.ix_(positions, positions)]
        # min_y |X_p y - p|²_Q:  y = (X_p' Q X_p)⁻¹ X_p' Q p
        normal = x_positions.T @ weight @ x_positions
        if np.linalg.matrix_rank(normal) == len(held):
            coordinates = np.linalg.solve(normal, x_positions.T @ weight) @ np.eye(n_x)[positions]
    # B u_eq = (I - A) x_eq
    pull = x_eq - a @ x_eq
    pull[np.abs(pull) < _ROUNDING * (np.abs(x_eq) + np.abs(a) @ np.abs(x_eq))] = 0.0
    return Equilibria(held, coordinates, x_eq, find_holding_inputs(b, q_u, pull))


def _find_equilibrium_basis(a: Array, b: Array) -> tuple[Array, Array]:
    """Return a basis (n_x, n_y) of {x | (I - A) x in range B}, and the units (n_x,) of its rows."""
    # L' B = 0:  the null space of L' (I - A)
    unit_x, unit_u = equilibrate(b)
    left, singular, _ = np.linalg.svd(unit_x[:, None] * b * unit_u)
    rank = int(np.sum(singular > RANK_TOLERANCE * singular.max(initial=0.0)))
    left_null, identity = left[:, rank:].T, np.eye(len(a))
    drift = left_null @ (unit_x[:, None] * (identity - a))
    terms = np.abs(left_null) @ (unit_x[:, None] * (identity + np.abs(a)))
    drift[np.abs(drift) < _ROUNDING * terms] = 0.0
    rows, columns = equilibrate(drift)
    _, singular, right = np.linalg.svd(drift * np.outer(rows, columns))
    drift_rank = int(np.sum(singular > RANK_TOLERANCE * singular.max(initial=0.0)))
    return right[drift_rank:].T, columns


def _choose_held(basis: Array, positions: Index) -> Index:
    """Choose states whose values determine a point of the span: positions first, then by pivots as in QR."""
    rest = basis.copy()
    chosen: list[int] = []
    remaining = np.setdiff1d(np.arange(len(basis)), positions)
    for candidates in (positions, remaining):
        while len(chosen) < basis.shape[1] and candidates.size:
            size = np.linalg.norm(rest[candidates], axis=1)
            best = int(np.argmax(size))
            if size[best] <= _MIN_INDEPENDENT:
                break
            row = int(candidates[best])
            chosen.append(row)
            along = rest[row] / size[best]
            rest = rest - np.outer(rest @ along, along)
    return np.array(sorted(chosen), dtype=np.intp)


def find_equilibrium_input(a: Array, b: Array, q_u: Array, x: Array) -> Array:
    """Return the input (n_u,) of a plan at rest in the equilibrium `x` (n_x,): of several the cheapest."""
    return find_holding_inputs(b, q_u, (x - a @ x)[:, None])[:, 0]


def find_holding_inputs(b: Array, q_u: Array, pull: Array) -> Array:
    """Return inputs (n_u, n_y) with B u = `pull` (n_x, n_y); of several the cheapest by Q_u, then the smallest."""
    # u = B⁺ pull;  u <- u - Z (Z' Q_u Z)⁺ Z' Q_u u  with B Z = 0
    rows, columns = equilibrate(b)
    left, singular, right = np.linalg.svd(b * np.outer(rows, columns))
    rank = int(np.sum(singular > RANK_TOLERANCE * singular.max(initial=0.0)))
    particular = right[:rank].T @ ((left[:, :rank].T @ (rows[:, None] * pull)) / singular[:rank, None])
    u = columns[:, None] * particular
    null = columns[:, None] * right[rank:].T
    u -= null @ np.linalg.pinv(null.T @ q_u @ null) @ null.T @ q_u @ u
    return np.asarray(u)


@dataclass(frozen=True, eq=False)
class Polytope:
    """{x | C x <= b} with C (m, n) and b (m,)."""

    c: Array
    b: Array

    @classmethod
    def from_box(cls, lower: Sequence[float], upper: Sequence[float]) -> Self:
        """Make a box, open where a limit is infinite; the rows of a two-sided limit are adjacent, + then -."""
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
        """Limits of each variable (n,), (n,), from the rows of that variable alone; infinite without such a row."""
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
        """Return b - C x (m,): negative where a limit is broken."""
        margin: Array = self.b - self.c @ x
        return margin


@dataclass(frozen=True)
class Pair:
    """Rows of one set with the same direction up to sign: c z <= upper, -c z <= lower."""

    c: tuple[float, ...]
    sides: tuple[tuple[float, int], ...]  # (sign, row)


def find_pairs(c: Array) -> tuple[Pair, ...]:
    """Group rows by their direction; a pair shares its back-off and its slack."""
    groups: dict[tuple[float, ...], list[tuple[float, int]]] = {}
    for i, row in enumerate(c):
        sign = 1.0 if row[np.flatnonzero(row)[0]] > 0 else -1.0
        groups.setdefault(tuple((sign * row).tolist()), []).append((sign, i))
    return tuple(Pair(direction, tuple(sides)) for direction, sides in groups.items())
