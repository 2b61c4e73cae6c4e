"""States at which a plant can rest, (I - A) x_s = B u_s, and coordinates of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uavctl.smpc.scaling import RANK_TOLERANCE, equilibrated

Array = NDArray[np.float64]
Index = NDArray[np.intp]

# A state whose value is determined by those already chosen, up to this share, tells nothing new of an equilibrium.
_NEW = 1e-6

_ROUNDING = 1e-12


@dataclass(frozen=True, eq=False)
class Equilibria:
    """x_s = x_eq y, u_s = u_eq y, for y the values of the states `held`.

    Attributes:
        held: Indices of the states whose values are y (n_y,); positions as far as they can be chosen freely.
        coordinates: (n_y, n_x): y of any state: its values, or where several positions depend on one y, that of the
            equilibrium whose positions are nearest, weighted as in the stage cost.
        x_eq: (n_x, n_y).
        u_eq: (n_u, n_y): where several inputs hold the same state, the one of least cost.
    """

    held: Index
    coordinates: Array
    x_eq: Array
    u_eq: Array


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
