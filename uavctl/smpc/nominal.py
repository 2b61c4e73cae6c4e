"""Constrained MPC without disturbances, for many states at once; its regulator and its parts.

1. `lqr` solves the Riccati equation: gain K, terminal cost P.
2. With u_t = K x_t + c_t and P as the terminal cost, the cost is x'Px + Σ_t c_t'(R + B'PB)c_t. Where the regulator's
   plan keeps every row, c = 0 is the optimum without a program. Elsewhere c is the shortest vector that keeps the rows;
   state rows are soft.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import solve_discrete_are

from uavctl.arrays import Array
from uavctl.errors import DesignError
from uavctl.smpc.plant import Plant
from uavctl.smpc.qp import OPEN, SOFT, QuadraticProgram
from uavctl.smpc.sets import Polytope


@dataclass(frozen=True, eq=False)
class Lqr:
    """The infinite-horizon regulator u = K x."""

    p: Array  # cost to go x'Px (n_x, n_x)
    k: Array  # gain K (n_u, n_x)
    weight: Array  # R + B'PB (n_u, n_u): leaving u = K x by c costs c'(R + B'PB)c


def lqr(plant: Plant, q_x: Array, q_u: Array) -> Lqr:
    """Solve for the regulator of least Σ x'Q_x x + u'Q_u u.

    Args:
        q_x: Q_x (n_x, n_x).
        q_u: Q_u (n_u, n_u), positive definite.

    Raises:
        DesignError: There is none: a state with a cost cannot be brought to rest.
    """
    # P = Q_x + A'PA - A'PB (Q_u + B'PB)⁻¹ B'PA,  K = -(Q_u + B'PB)⁻¹ B'PA
    try:
        p = np.asarray(solve_discrete_are(plant.a, plant.b, q_x, q_u), dtype=np.float64)
    except (np.linalg.LinAlgError, ValueError) as error:
        raise DesignError(
            "cost.state",
            f"the Riccati equation has no stabilising solution ({error})",
            "give every mode that is not stable an input and a cost, and every input a cost above 0",
        ) from error
    weight = q_u + plant.b.T @ p @ plant.b
    k = -np.linalg.solve(weight, plant.b.T @ p @ plant.a)
    return Lqr(p, np.asarray(k, dtype=np.float64), weight)


Index = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class ControlProblem:
    """A control problem with a target: plant, limits and weights of the SMPC and of every baseline."""

    plant: Plant  # plant of the predictions
    state_set: Polytope  # X
    input_set: Polytope  # U
    q_x: Array  # Q_x (n_x, n_x)
    q_u: Array  # Q_u (n_u, n_u), positive definite
    target: Array  # equilibrium to go to (n_x,)
    u_target: Array  # its input (n_u,)
    horizon: int  # H [steps]
    slack_linear: float  # exact penalty of leaving a state row
    slack_quadratic: float  # its quadratic part


@dataclass(frozen=True, eq=False)
class Part:
    """Indices of states, inputs and rows of the sets that are independent of all others."""

    states: Index
    inputs: Index
    rows_x: Index
    rows_u: Index


def find_parts(problem: ControlProblem, extra_rows: Array | None = None) -> tuple[Part, ...]:
    """Find the independent parts of a problem without disturbances; those without an input are left out.

    Args:
        extra_rows: Further rows (m, n_u) that couple inputs.
    """
    plant, c_x, c_u = problem.plant, problem.state_set.c, problem.input_set.c
    if extra_rows is not None:
        c_u = np.vstack([c_u, extra_rows])
    edges = np.block(
        [
            [(plant.a != 0) | (problem.q_x != 0) | (np.abs(c_x.T) @ np.abs(c_x) != 0), plant.b != 0],
            [np.zeros((plant.n_u, plant.n_x), dtype=bool), (problem.q_u != 0) | (np.abs(c_u.T) @ np.abs(c_u) != 0)],
        ]
    )
    from scipy.sparse.csgraph import connected_components  # slow to import, needed for a design only

    _, label = connected_components(sparse.csr_array(edges), directed=False)
    label_x, label_u = label[: plant.n_x], label[plant.n_x :]
    return tuple(
        Part(
            states=np.flatnonzero(label_x == i),
            inputs=np.flatnonzero(label_u == i),
            rows_x=_rows(problem.state_set, label_x == i),
            rows_u=_rows(problem.input_set, label_u == i),
        )
        for i in dict.fromkeys(label_u.tolist())
    )


def _rows(limits: Polytope, variables: NDArray[np.bool_]) -> Index:
    return np.flatnonzero(np.any(limits.c[:, variables] != 0, axis=1) & np.isfinite(limits.b))


def row_deviations(limits: Polytope, covariance: Array) -> Array:
    """Return the standard deviation along each row (m,)."""
    # σ_i = (c_i' Σ c_i)^½
    variance = np.einsum("mi,ij,mj->m", limits.c, covariance, limits.c)
    along: Array = np.sqrt(np.maximum(variance, 0.0))
    return along


def propagate_covariance(plant: Plant, steps: int, cov: Array | None = None) -> Array:
    """Return the covariance (steps+1, n_x, n_x) of a prediction over 0, 1 … `steps` steps.

    Args:
        cov: Covariance (n_x, n_x) of the first state; None: it is exact.
    """
    # P_{t+1} = A P_t A' + E W E'
    noise = plant.e @ plant.w @ plant.e.T
    covs = [np.zeros_like(noise) if cov is None else cov]
    for _ in range(steps):
        covs.append(plant.a @ covs[-1] @ plant.a.T + noise)
    return np.array(covs)


class BatchMpc:
    """Plans of H steps from many states; inputs within their limits, state limits soft.

    Args:
        backoff_x: Back-offs of the state rows in the stages 0 … H (H+1, m_x); none by default.
        backoff_u: The same of the input rows (H, m_u).

    Raises:
        DesignError: The plant has no regulator.
    """

    def __init__(self, problem: ControlProblem, backoff_x: Array | None = None, backoff_u: Array | None = None) -> None:
        self._problem = problem
        law = lqr(problem.plant, problem.q_x, problem.q_u)
        margin_x = problem.state_set.margin(problem.target) - (0.0 if backoff_x is None else backoff_x)
        margin_u = problem.input_set.margin(problem.u_target) - (0.0 if backoff_u is None else backoff_u)
        sides_x = np.broadcast_to(margin_x, (problem.horizon + 1, problem.state_set.b.size))
        sides_u = np.broadcast_to(margin_u, (problem.horizon, problem.input_set.b.size))
        self._parts = [_PartMpc(problem, law, part, sides_x, sides_u) for part in find_parts(problem)]

    def compute_plans(self, x: Array) -> Array:
        """Return inputs (M, H, n_u) from states (M, n_x); NaN for a state that is not finite, or without an optimum."""
        problem = self._problem
        plans = np.empty((len(x), problem.horizon, problem.plant.n_u))
        plans[:] = problem.u_target
        for part in self._parts:
            plans[:, :, part.inputs] += part.compute_plans(x[:, part.states] - problem.target[part.states])
        return plans


class _PartMpc:
    """One independent part, in deviations from the target: min |z|², X x + Z z <= margin.

    X and Z are `_x_rows` and `_z_rows`.
    """

    def __init__(self, problem: ControlProblem, law: Lqr, part: Part, sides_x: Array, sides_u: Array) -> None:
        self.states, self.inputs, self._steps = part.states, part.inputs, problem.horizon
        x_maps, u_maps = predict_regulated(problem, law, part)
        n_x = part.states.size
        x_rows = np.einsum("mi,tij->tmj", problem.state_set.c[np.ix_(part.rows_x, part.states)], x_maps[1:])
        u_rows = np.einsum("mi,tij->tmj", problem.input_set.c[np.ix_(part.rows_u, part.inputs)], u_maps)
        rows = np.concatenate([x_rows.reshape(-1, x_rows.shape[2]), u_rows.reshape(-1, u_rows.shape[2])])
        self._x_rows, self._z_rows = rows[:, :n_x], rows[:, n_x:]
        self._margin = np.concatenate([sides_x[1:, part.rows_x].ravel(), sides_u[:, part.rows_u].ravel()])
        self._plan_x, self._plan_z = np.split(u_maps.reshape(-1, rows.shape[1]), [n_x], axis=1)
        soft = np.arange(len(rows)) < problem.horizon * part.rows_x.size
        self._open = np.full(len(rows), -OPEN)
        low, high = problem.input_set.bounds
        self._low, self._high = ((side - problem.u_target)[part.inputs] for side in (low, high))
        self._program = QuadraticProgram(
            2.0 * np.eye(self._z_rows.shape[1]),
            np.ascontiguousarray(self._z_rows),
            np.where(soft, SOFT, 0).astype(np.int32),
            np.where(soft, problem.slack_linear, 0.0),
            np.where(soft, problem.slack_quadratic, 0.0),
        )

    def compute_plans(self, x: Array) -> Array:
        """Return the deviations of the inputs (M, H, n_u) from states (M, n_x)."""
        plans = x @ self._plan_x.T
        margin = self._margin - x @ self._x_rows.T
        for i in np.flatnonzero(~np.all(margin >= 0.0, axis=1)):
            plans[i] += self._plan_z @ self._solve_program(margin[i])
        # The clip removes the program's tolerance only.
        return np.clip(plans.reshape(len(x), self._steps, self.inputs.size), self._low, self._high)

    def _solve_program(self, margin: Array) -> Array:
        """Solve for z; NaN without an optimum."""
        no_optimum = np.full(self._z_rows.shape[1], np.nan)
        if not np.isfinite(margin).all():
            return no_optimum
        solved = self._program.solve(np.zeros_like(no_optimum), margin, self._open)
        return no_optimum if solved is None else solved[0]


def predict_regulated(problem: ControlProblem, law: Lqr, part: Part) -> tuple[Array, Array]:
    """Predict x_t (H+1, n_x, n_x + H n_u) and u_t (H, n_u, …) under the regulator, as maps of (x, z), z = L'c.

    L L' = R + B'PB, and c is added to the regulator's inputs.
    """
    plant, steps = problem.plant, problem.horizon
    n_x, n_u = part.states.size, part.inputs.size
    a, b = plant.a[np.ix_(part.states, part.states)], plant.b[np.ix_(part.states, part.inputs)]
    k = law.k[np.ix_(part.inputs, part.states)]
    input_of_z = np.linalg.inv(np.linalg.cholesky(law.weight[np.ix_(part.inputs, part.inputs)])).T
    states, inputs = np.zeros((steps + 1, n_x, n_x + steps * n_u)), np.zeros((steps, n_u, n_x + steps * n_u))
    states[0, :, :n_x] = np.eye(n_x)
    # u_t = K x_t + L'⁻¹ z_t,  x_{t+1} = A x_t + B u_t
    for t in range(steps):
        columns = slice(n_x + t * n_u, n_x + (t + 1) * n_u)
        inputs[t] = k @ states[t]
        inputs[t, :, columns] += input_of_z
        states[t + 1] = a @ states[t] + b @ inputs[t]
    return states, inputs
