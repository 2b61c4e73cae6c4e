"""What every baseline is given: the same plant, limits and weights as the SMPC."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from uavctl.smpc.plant import Plant
from uavctl.smpc.sets import Polytope

Array = NDArray[np.float64]
Index = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Problem:
    """A control problem with a target.

    Attributes:
        plant: The plant that is predicted with.
        state_set: X.
        input_set: U.
        q_x: Q_x (n_x, n_x).
        q_u: Q_u (n_u, n_u), positive definite.
        target: Equilibrium to go to (n_x,).
        u_target: Its input (n_u,).
        horizon: H [steps].
        slack_linear: Exact penalty of leaving a state row.
        slack_quadratic: Its quadratic part.
    """

    plant: Plant
    state_set: Polytope
    input_set: Polytope
    q_x: Array
    q_u: Array
    target: Array
    u_target: Array
    horizon: int
    slack_linear: float
    slack_quadratic: float


@dataclass(frozen=True, eq=False)
class Part:
    """States, inputs and rows of the sets (their indices) that have to do with no others."""

    states: Index
    inputs: Index
    rows_x: Index
    rows_u: Index


def parts(problem: Problem, beside: Array | None = None) -> tuple[Part, ...]:
    """Independent parts of a problem without disturbances; those without an input are left out.

    Args:
        problem: The problem.
        beside: Rows (m, n_u) on inputs that tie them together beside those of the problem.
    """
    plant, c_x, c_u = problem.plant, problem.state_set.c, problem.input_set.c
    if beside is not None:
        c_u = np.vstack([c_u, beside])
    coupled = np.block(
        [
            [(plant.a != 0) | (problem.q_x != 0) | (np.abs(c_x.T) @ np.abs(c_x) != 0), plant.b != 0],
            [np.zeros((plant.n_u, plant.n_x), dtype=bool), (problem.q_u != 0) | (np.abs(c_u.T) @ np.abs(c_u) != 0)],
        ]
    )
    _, label = connected_components(sparse.csr_array(coupled), directed=False)
    of_x, of_u = label[: plant.n_x], label[plant.n_x :]
    return tuple(
        Part(
            states=np.flatnonzero(of_x == i),
            inputs=np.flatnonzero(of_u == i),
            rows_x=_rows(problem.state_set, of_x == i),
            rows_u=_rows(problem.input_set, of_u == i),
        )
        for i in dict.fromkeys(of_u.tolist())
    )


def _rows(limits: Polytope, variables: NDArray[np.bool_]) -> Index:
    return np.flatnonzero(np.any(limits.c[:, variables] != 0, axis=1) & np.isfinite(limits.b))


def deviations(limits: Polytope, covariance: Array) -> Array:
    """Standard deviation along each row (m,)."""
    variance = np.einsum("mi,ij,mj->m", limits.c, covariance, limits.c)
    along: Array = np.sqrt(np.maximum(variance, 0.0))
    return along


def unseen(plant: Plant, steps: int, cov: Array | None = None) -> Array:
    """Covariance (steps+1, n_x, n_x) of a prediction over 0, 1 … `steps` steps.

    Args:
        plant: The plant.
        steps: See above.
        cov: Covariance (n_x, n_x) of the state that it begins with; None: that was exact.
    """
    noise = plant.e @ plant.w @ plant.e.T
    spread = [np.zeros_like(noise) if cov is None else cov]
    for _ in range(steps):
        spread.append(plant.a @ spread[-1] @ plant.a.T + noise)
    return np.array(spread)
