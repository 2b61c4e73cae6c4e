"""Constrained MPC without disturbances, for many states at once; its regulator, and the cost that bounds it below.

With u_t = K x_t + c_t, K the regulator's gain and its Riccati solution as the terminal cost, the cost is
x'Px + Σ_t c_t'(R + B'PB)c_t: where the regulator's own plan keeps every row, c = 0 is the optimum, and no program has
to be solved. Elsewhere c is the shortest vector that keeps the rows; state rows give way at the price of their slack.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import solve_discrete_are

from uavctl.arrays import Array
from uavctl.errors import DesignError
from uavctl.smpc.link import LinkModel
from uavctl.smpc.plant import Plant
from uavctl.smpc.qp import OPEN, SOFT, QuadraticProgram
from uavctl.smpc.sets import Polytope

# The series over the ages is cut where a whole state's number of terms is below this share of the sum.
_NEGLIGIBLE = 1e-15
_LONGEST_AGE = 20_000
# Ages by which the link's long runs of losses have settled to a constant rate.
_EARLY, _LATE = 60, 120


@dataclass(frozen=True, eq=False)
class Lqr:
    """The infinite-horizon regulator u = K x."""

    p: Array  # cost to go x'Px (n_x, n_x)
    k: Array  # gain K (n_u, n_x)
    weight: Array  # R + B'PB (n_u, n_u): leaving u = K x by c costs c'(R + B'PB)c


def lqr(plant: Plant, q_x: Array, q_u: Array) -> Lqr:
    """The regulator of least Σ x'Q_x x + u'Q_u u.

    Args:
        q_x: Q_x (n_x, n_x).
        q_u: Q_u (n_u, n_u), positive definite.

    Raises:
        DesignError: There is none: a state that costs cannot be brought to rest.
    """
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


# Cost that no controller can beat: the expected quadratic cost with lost or late positions, and nothing limited. The
# state is known exactly at its capture, and neither losses nor delays depend on the inputs: certainty equivalence holds
# (Schenato et al. 2007, Foundations of control and estimation over lossy networks, TCP-like case). The best input is
# the LQR's of the mean of the state, and the cost is that of the known state plus what the error of the mean costs:
# x_0'P_0 x_0 + Σ_t tr(P_{t+1} N) + Σ_t tr(M_t S_t), with N = E W E', M_t = K_t'(R + B'P_{t+1} B)K_t and the error's
# covariance S_t = Σ_i P(a(t) > i) A^i N A'^i. Limits, of inputs or states, only add to it.


def stationary_bound(plant: Plant, q_x: Array, q_u: Array, link: LinkModel) -> float:
    """Least mean stage cost in the long run.

    Args:
        q_x: Q_x (n_x, n_x).
        q_u: Q_u (n_u, n_u).
        link: Model of the link; `bernoulli` for independent losses.

    Raises:
        DesignError: The cost grows without end: r ρ(A)² >= 1, with ρ(A) the spectral radius and r the rate by which
            P(a > i) falls off, which is the loss where losses are independent; or no regulator exists.
    """
    best = lqr(plant, q_x, q_u)
    noise = plant.e @ plant.w @ plant.e.T
    price = best.k.T @ best.weight @ best.k
    return float(np.trace(best.p @ noise)) + _ignorance(plant, noise, price, link)


def _ignorance(plant: Plant, noise: Array, price: Array, link: LinkModel) -> float:
    """Σ_i P(a > i) tr(M A^i N A'^i) for M = `price`."""
    _check_decay(plant, link)
    total, small, grown = 0.0, 0, noise
    for age in range(_LONGEST_AGE):
        term = link.outage(age + 1) * float(np.sum(price * grown))
        total += term
        # As many terms of nothing as there are states: by Cayley and Hamilton, nothing follows.
        small = small + 1 if term <= _NEGLIGIBLE * total else 0
        if small > plant.n_x:
            return total
        grown = plant.a @ grown @ plant.a.T
    raise _endless(f"the sum over the ages has not settled at an age of {_LONGEST_AGE} steps")


def _check_decay(plant: Plant, link: LinkModel) -> None:
    early, late = link.outage(_EARLY), link.outage(_LATE)
    if late <= 0.0:
        return
    radius = float(np.abs(np.linalg.eigvals(plant.a)).max())
    rate = (late / early) ** (1.0 / (_LATE - _EARLY))
    if rate * radius**2 >= 1.0 - 1e-9:
        raise _endless(f"P(a > i) falls by {rate:.6g} a step, and A's spectral radius is {radius:.6g}")


def _endless(reason: str) -> DesignError:
    return DesignError("link.loss", f"the mean cost has no bound: {reason}", "lower the losses")


# Problem that every baseline is given: the same plant, limits and weights as the SMPC.


Index = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class ControlProblem:
    """A control problem with a target."""

    plant: Plant  # the plant that is predicted with
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
    """States, inputs and rows of the sets (their indices) that have to do with no others."""

    states: Index
    inputs: Index
    rows_x: Index
    rows_u: Index


def parts(problem: ControlProblem, beside: Array | None = None) -> tuple[Part, ...]:
    """Independent parts of a problem without disturbances; those without an input are left out.

    Args:
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
    from scipy.sparse.csgraph import connected_components  # loaded where a design is made, for it takes long

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
        cov: Covariance (n_x, n_x) of the state that it begins with; None: that was exact.
    """
    noise = plant.e @ plant.w @ plant.e.T
    spread = [np.zeros_like(noise) if cov is None else cov]
    for _ in range(steps):
        spread.append(plant.a @ spread[-1] @ plant.a.T + noise)
    return np.array(spread)


class BatchMpc:
    """Plans of H steps from many states; inputs within their limits, state limits soft.

    Args:
        backoff_x: What is taken off the state rows in the stages 0 … H (H+1, m_x); nothing by default.
        backoff_u: The same of the input rows (H, m_u).

    Raises:
        DesignError: The plant has no regulator.
    """

    def __init__(self, problem: ControlProblem, backoff_x: Array | None = None, backoff_u: Array | None = None) -> None:
        self._problem = problem
        law = lqr(problem.plant, problem.q_x, problem.q_u)
        room_x = problem.state_set.margin(problem.target) - (0.0 if backoff_x is None else backoff_x)
        room_u = problem.input_set.margin(problem.u_target) - (0.0 if backoff_u is None else backoff_u)
        sides_x = np.broadcast_to(room_x, (problem.horizon + 1, problem.state_set.b.size))
        sides_u = np.broadcast_to(room_u, (problem.horizon, problem.input_set.b.size))
        self._parts = [_PartMpc(problem, law, part, sides_x, sides_u) for part in parts(problem)]

    def plans(self, x: Array) -> Array:
        """Inputs (M, H, n_u) from states (M, n_x); NaN where the state is not finite or a program found no optimum."""
        problem = self._problem
        plans = np.empty((len(x), problem.horizon, problem.plant.n_u))
        plans[:] = problem.u_target
        for part in self._parts:
            plans[:, :, part.inputs] += part.plans(x[:, part.states] - problem.target[part.states])
        return plans


class _PartMpc:
    """One independent part, in deviations from the target: rows of_x x + of_z z <= room, cost |z|²."""

    def __init__(self, problem: ControlProblem, law: Lqr, part: Part, sides_x: Array, sides_u: Array) -> None:
        self.states, self.inputs, self._steps = part.states, part.inputs, problem.horizon
        states_of, inputs_of = regulated(problem, law, part)
        n_x = part.states.size
        of_x = np.einsum("mi,tij->tmj", problem.state_set.c[np.ix_(part.rows_x, part.states)], states_of[1:])
        of_u = np.einsum("mi,tij->tmj", problem.input_set.c[np.ix_(part.rows_u, part.inputs)], inputs_of)
        rows = np.concatenate([of_x.reshape(-1, of_x.shape[2]), of_u.reshape(-1, of_u.shape[2])])
        self._of_x, self._of_z = rows[:, :n_x], rows[:, n_x:]
        self._room = np.concatenate([sides_x[1:, part.rows_x].ravel(), sides_u[:, part.rows_u].ravel()])
        self._plan_x, self._plan_z = np.split(inputs_of.reshape(-1, rows.shape[1]), [n_x], axis=1)
        soft = np.arange(len(rows)) < problem.horizon * part.rows_x.size
        self._open = np.full(len(rows), -OPEN)
        low, high = problem.input_set.bounds
        self._low, self._high = ((side - problem.u_target)[part.inputs] for side in (low, high))
        self._program = QuadraticProgram(
            2.0 * np.eye(self._of_z.shape[1]),
            np.ascontiguousarray(self._of_z),
            np.where(soft, SOFT, 0).astype(np.int32),
            np.where(soft, problem.slack_linear, 0.0),
            np.where(soft, problem.slack_quadratic, 0.0),
        )

    def plans(self, x: Array) -> Array:
        """Deviations of the inputs (M, H, n_u) from states (M, n_x)."""
        plans = x @ self._plan_x.T
        room = self._room - x @ self._of_x.T
        for i in np.flatnonzero(~np.all(room >= 0.0, axis=1)):
            plans[i] += self._plan_z @ self._steered(room[i])
        # All that is cut is the program's tolerance.
        return np.clip(plans.reshape(len(x), self._steps, self.inputs.size), self._low, self._high)

    def _steered(self, room: Array) -> Array:
        """z, NaN without an optimum."""
        nothing = np.full(self._of_z.shape[1], np.nan)
        if not np.isfinite(room).all():
            return nothing
        solved = self._program.solve(np.zeros_like(nothing), room, self._open)
        return nothing if solved is None else solved[0]


def regulated(problem: ControlProblem, law: Lqr, part: Part) -> tuple[Array, Array]:
    """Regulated predictions: x_t (H+1, n_x, n_x + H n_u) and u_t (H, n_u, …) as maps of (x, z), z = L'c.

    L L' = R + B'PB, and c is what is added to the regulator's inputs.
    """
    plant, steps = problem.plant, problem.horizon
    n_x, n_u = part.states.size, part.inputs.size
    a, b = plant.a[np.ix_(part.states, part.states)], plant.b[np.ix_(part.states, part.inputs)]
    k = law.k[np.ix_(part.inputs, part.states)]
    of_z = np.linalg.inv(np.linalg.cholesky(law.weight[np.ix_(part.inputs, part.inputs)])).T
    states, inputs = np.zeros((steps + 1, n_x, n_x + steps * n_u)), np.zeros((steps, n_u, n_x + steps * n_u))
    states[0, :, :n_x] = np.eye(n_x)
    for t in range(steps):
        own = slice(n_x + t * n_u, n_x + (t + 1) * n_u)
        inputs[t] = k @ states[t]
        inputs[t, :, own] += of_z
        states[t + 1] = a @ states[t] + b @ inputs[t]
    return states, inputs
