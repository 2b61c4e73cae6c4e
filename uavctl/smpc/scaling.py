"""Units do not matter: ranks are decided, and programs solved, in numbers of similar size."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

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
class Sizes:
    """Natural sizes of one component's numbers, each in the number's own unit; all are positive.

    Attributes:
        state: What inputs of their size make of a state in N steps (n_x,).
        input: Half of the room between an input's limits (n_u,); without limits its stationary deviation.
        state_std: Stationary deviation of a state under the terminal law (n_x,), `state` where it is but rounding.
        input_std: The same of an input (n_u,).
        cost: Stage cost of a state and an input of their sizes.
    """

    state: Array
    input: Array
    state_std: Array
    input_std: Array
    cost: float

    @classmethod
    def of(
        cls, a: Array, b: Array, q_x: Array, q_u: Array, c_u: Array, b_u: Array, sigma_x: Array, k: Array, free: int
    ) -> Sizes:
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
        """What of a point (n,) is too large for the solver to find as well by itself, in natural sizes."""
        point = point / self.variables
        return point - np.clip(point, -_USUAL, _USUAL)
