"""The least settled cost that anything can have within the input limits: dynamic programming on what is known.

For one axis. With the newest state known exactly and a steps old, the state is N(m, C_a) with C_a the sum of
A^i E W E' A^i' over i < a, whatever was done. With y = A m + B u, news comes with p and makes m ~ N(y, C_{a+1}), a = 0;
else m = y, and a grows by 1:

    V_a(m) + λ = m'Q m + tr(Q C_a) + min_u { u'R u + p E V_0(y + n) + q V_{a+1}(y) },   n ~ N(0, C_{a+1})

State limits are left out: λ is a lower bound for what keeps them too. V_a is m'P m, with the P of LQG, plus a remainder
on a grid, cubic in between; with the limits open, the remainder is 0 and λ the LQG bound.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates, spline_filter
from scipy.special import roots_hermitenorm

from uavctl.errors import UavctlError
from uavctl.smpc.lqg_bound import lqr
from uavctl.smpc.plant import Plant
from uavctl.smpc.sets import Polytope

Array = NDArray[np.float64]

_OLDEST = 7  # older information counts as this old: 0.3^8 of the time
_NODES = 7  # of the Gaussian quadrature, each direction
_REACH = np.array([40.0, 12.0])  # half-widths of the grid, in standard deviations of the disturbance of one step
_SETTLED = 1e-6
_MOST = 200


@dataclass(frozen=True)
class Fineness:
    """Points of the grid in each state, and of the inputs tried."""

    states: int = 65
    inputs: int = 61


class _Grid:
    """Functions of (position, velocity), cubic between the points of a grid, constant beyond it."""

    def __init__(self, reach: Array, points: int) -> None:
        self._reach, self._shape = reach, (points, points)
        axes = [np.linspace(-side, side, points) for side in reach]
        self.points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
        self.home = len(self.points) // 2

    def coefficients(self, values: Array) -> Array:
        """Of the spline through values (G,)."""
        return np.asarray(spline_filter(values.reshape(self._shape), 3, mode="nearest"), dtype=np.float64)

    def at(self, coefficients: Array, points: Array) -> Array:
        """Values (…) at points (…, 2)."""
        place = (np.clip(points, -self._reach, self._reach) + self._reach) / (2 * self._reach) * (self._shape[0] - 1)
        return np.asarray(
            map_coordinates(coefficients, np.moveaxis(place, -1, 0), order=3, prefilter=False, mode="nearest"),
            dtype=np.float64,
        )


def least_settled_cost(
    plant: Plant, input_set: Polytope, q_x: Array, q_u: Array, loss: float, fineness: Fineness = Fineness()
) -> float:
    """λ, the least mean stage cost of a plant with one axis and one input.

    Args:
        plant: Two states and one input.
        input_set: U.
        q_x: Q_x (2, 2).
        q_u: Q_u (1, 1).
        loss: q = 1 - p.
        fineness: Of the grid.

    Raises:
        UavctlError: The plant has another shape, or the iteration does not settle.
    """
    if (plant.n_x, plant.n_u) != (2, 1):
        raise UavctlError(f"a plant of {plant.n_x} states and {plant.n_u} inputs is not one axis; take one apart")
    p, noise = lqr(plant, q_x, q_u).p, plant.e @ plant.w @ plant.e.T
    unknown = _growing(plant.a, noise)
    grid = _Grid(_REACH * np.sqrt(np.diagonal(noise)), fineness.states)
    low, high = _sides(input_set)
    inputs = np.linspace(low, high, fineness.inputs)
    ahead = (grid.points @ plant.a.T)[:, None] + inputs[:, None] * plant.b.T  # y (G, U, 2)
    known = _square(grid.points, q_x - p)
    priced = q_u[0, 0] * inputs**2 + _square(ahead, p)
    rest = np.zeros((_OLDEST + 1, len(grid.points)))
    for _ in range(_MOST):
        fresh = grid.coefficients(rest[0])
        new = np.empty_like(rest)
        for age in range(_OLDEST + 1):
            nodes, weights = _normal(unknown[age + 1])
            after_news = sum(w * grid.at(fresh, grid.points + node) for node, w in zip(nodes, weights, strict=True))
            mean = (1 - loss) * (after_news + np.sum(p * unknown[age + 1])) + loss * rest[min(age + 1, _OLDEST)]
            to_go = priced + grid.at(grid.coefficients(mean), ahead)
            new[age] = known + np.sum(q_x * unknown[age]) + _least(to_go)
        change = new - rest
        rest = new - new[0, grid.home]
        if np.ptp(change) < _SETTLED:
            return float(change[0, grid.home])
    raise UavctlError(f"the least settled cost is not found within {_MOST} iterations")


def _growing(a: Array, noise: Array) -> list[Array]:
    """C_0 … C_{oldest+1}."""
    found = [np.zeros_like(noise)]
    for _ in range(_OLDEST + 1):
        found.append(noise + a @ found[-1] @ a.T)
    return found


def _normal(covariance: Array) -> tuple[Array, Array]:
    """Nodes (n, 2) and weights (n,) of a normal distribution."""
    nodes, weights = roots_hermitenorm(_NODES)
    pairs = np.stack(np.meshgrid(nodes, nodes, indexing="ij"), axis=-1).reshape(-1, 2)
    values, vectors = np.linalg.eigh(covariance)
    share = weights / weights.sum()
    return pairs @ (vectors * np.sqrt(np.maximum(values, 0.0))).T, np.outer(share, share).ravel()


def _least(values: Array) -> Array:
    """Minimum of each row (G,), by a parabola through the least value and its neighbours."""
    rows, at = np.arange(len(values)), np.clip(values.argmin(axis=1), 1, values.shape[1] - 2)
    before, here, after = values[rows, at - 1], values[rows, at], values[rows, at + 1]
    step = np.clip(0.5 * (before - after) / (before - 2 * here + after), -1.0, 1.0)
    least: Array = here - 0.5 * (before - after) * step + 0.5 * (before - 2 * here + after) * step**2
    return least


def _square(points: Array, weight: Array) -> Array:
    """x'W x of points (…, 2)."""
    return np.asarray(np.einsum("...i,ij,...j->...", points, weight, points), dtype=np.float64)


def _sides(limits: Polytope) -> tuple[float, float]:
    rows = limits.c[:, 0]
    return float((limits.b[rows < 0] / rows[rows < 0]).max()), float((limits.b[rows > 0] / rows[rows > 0]).min())
