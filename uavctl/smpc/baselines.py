"""Baseline controllers on the same plant, weights, limits, noise and losses as the SMPC.

1. On receipt: constrained MPC plans from each new position. In silence it plays the plan out, holds its first input, or
   sends u_target. `MeanQp` adds open-loop back-offs.
2. Worst-case delay: the mean x̂ is always predicted over d steps. Its error is S = Σ_{i<d} A^i N A'^i, and A^d E w(k-d)
   moves it in each step. Under u = mean + K_ρ (x̂ - mean), stage t of a plan has the covariance S + Z_t and its input
   K_ρ Z_t K_ρ', with

       Z_{t+1} = (A + B K_ρ) Z_t (A + B K_ρ)' + A^d N A'^d,   Z_0 = 0

   Rows keep κ σ. K_ρ is the regulator for the input weight ρ R, with the least ρ whose covariance at the target takes
   `_MAX_SHARE` of the margin; the full gain needs more input than there is.
3. Governor: the regulator on the predicted mean, whose next mean keeps a margin from the state limits.
4. LQG: the regulator on the predicted mean, without limits.
"""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_discrete_lyapunov

from uavctl.arrays import Array
from uavctl.errors import DesignError
from uavctl.smpc.batch import Information, predict
from uavctl.smpc.nominal import BatchMpc, ControlProblem, Part, find_parts, lqr, propagate_covariance, row_deviations
from uavctl.smpc.qp import SOFT, QuadraticProgram

Index = NDArray[np.intp]


class _OnReceipt(ABC):
    """Makes a new plan from each newer position; a late one is predicted to now first.

    Args:
        margin: Distance of plans from the state limits, in standard deviations of one step's disturbance.

    Raises:
        DesignError: The plant has no regulator.
    """

    def __init__(self, problem: ControlProblem, margin: float = 0.0) -> None:
        self._problem = problem
        self._mpc = self._make_planner(margin)
        self.begin(0)

    def _make_planner(self, margin: float) -> BatchMpc:
        """Make the planner, its limits tightened by `margin` standard deviations."""
        plant = self._problem.plant
        step = plant.e @ plant.w @ plant.e.T
        return BatchMpc(self._problem, margin * row_deviations(self._problem.state_set, step))

    def begin(self, runs: int) -> None:
        """See `BatchController`."""
        self._plans = np.zeros((runs, self._problem.horizon, self._problem.plant.n_u))
        self._plan_step = np.zeros(runs, dtype=np.intp)
        self._captured = np.full(runs, -1, dtype=np.intp)

    def act(self, information: Information) -> Array:
        """See `BatchController`."""
        (has_new,) = np.nonzero(information.newest > self._captured)
        # x(0) is always known, so each run has a plan from the first step on.
        self._plans[has_new] = self._mpc.compute_plans(predict(self._problem.plant, information)[has_new])
        self._plan_step[has_new] = information.step
        self._captured[has_new] = information.newest[has_new]
        return self._select_inputs(information.step - self._plan_step)

    @abstractmethod
    def _select_inputs(self, index: Index, /) -> Array:
        """Return the inputs (N, n_u) of plans that were made `index` (N,) steps ago."""


class PacketisedPredictive(_OnReceipt):
    """Certainty-equivalent packetised predictive control: plays the plan out, then sends u_target.

    The receiver's buffer of Quevedo and Nešić (2011, Input-to-state stability of packetized predictive control over
    unreliable networks), with the losses before the controller instead of after it.
    """

    def _select_inputs(self, index: Index, /) -> Array:
        steps = self._problem.horizon
        inputs = self._plans[np.arange(index.size), np.minimum(index, steps - 1)]
        return np.where((index < steps)[:, None], inputs, self._problem.u_target)


class HoldLast(_OnReceipt):
    """Holds the plan's first input until the next position arrives."""

    def _select_inputs(self, _index: Index, /) -> Array:
        return self._plans[:, 0].copy()


class ZeroOnLoss(_OnReceipt):
    """Sends the plan's first input for one step, then u_target until the next position arrives."""

    def _select_inputs(self, index: Index, /) -> Array:
        return np.where((index == 0)[:, None], self._plans[:, 0], self._problem.u_target)


class MeanQp(PacketisedPredictive):
    """Packetised predictive control with open-loop back-offs: stage t keeps κ σ_t from the state limits.

    σ_t is the standard deviation of a prediction over t steps; κ is the same for every age.

    Args:
        cov: Covariance (n_x, n_x) of the newest known state in a filter without losses; None: it is exact.

    Raises:
        DesignError: The plant has no regulator.
    """

    def __init__(self, problem: ControlProblem, margin: float, cov: Array | None = None) -> None:
        self._cov = cov
        super().__init__(problem, margin)

    def _make_planner(self, margin: float) -> BatchMpc:
        problem = self._problem
        state_covs = propagate_covariance(problem.plant, problem.horizon, self._cov)
        return BatchMpc(problem, margin * np.array([row_deviations(problem.state_set, cov) for cov in state_covs]))


_MAX_SHARE = 0.5  # share of the margin that κ σ at the target may take
_INPUT_WEIGHTS = 2.0 ** np.arange(0, 21)


class WorstCaseDelay:
    """Holds positions back until they are `delay` steps old, predicts the mean from there, and plans in each step.

    Args:
        delay: d >= 1 [steps].
        kappa_x: κ of the state rows, see `hahn_stursberg.design.kappa`.

    Raises:
        DesignError: The covariance leaves no margin around the target, or the plant has no regulator.
    """

    def __init__(self, problem: ControlProblem, delay: int, kappa_x: float, kappa_u: float) -> None:
        if delay < 1:
            raise DesignError("smpc.tau", f"{delay} is no delay", "give at least 1 step")
        self._problem, self._delay = problem, delay
        self._mpc = BatchMpc(problem, *_backoffs(problem, delay, kappa_x, kappa_u))
        self.begin(0)

    def begin(self, runs: int) -> None:
        """See `BatchController`."""
        n_x = self._problem.plant.n_x
        # Positions that are not old enough yet, by their capture step modulo the length
        self._waiting = np.full((runs, self._delay + 1), -1, dtype=np.intp)
        self._states = np.zeros((runs, self._delay + 1, n_x))
        self._used, self._state = np.zeros(runs, dtype=np.intp), np.zeros((runs, n_x))

    def act(self, information: Information) -> Array:
        """See `BatchController`."""
        self._update_used(information)
        x = predict(self._problem.plant, Information(information.step, self._used, self._state, information.inputs))
        first: Array = self._mpc.compute_plans(x)[:, 0]
        return first

    def _update_used(self, information: Information) -> None:
        """Use the newest position that is old enough; x(0) is known at first."""
        runs, slot = np.arange(len(information.newest)), information.newest % (self._delay + 1)
        self._waiting[runs, slot], self._states[runs, slot] = information.newest, information.state
        if information.step == 0:
            self._state = information.state.copy()
            return
        due = information.step - self._delay
        old = np.where((self._waiting >= 0) & (self._waiting <= due), self._waiting, -1)
        best = old.argmax(axis=1)
        newer = np.flatnonzero(old[runs, best] > self._used)
        self._used[newer] = old[newer, best[newer]]
        self._state[newer] = self._states[newer, best[newer]]


def _backoffs(problem: ControlProblem, delay: int, kappa_x: float, kappa_u: float) -> tuple[Array, Array]:
    """Return the back-offs of the rows: states (H+1, m_x), inputs (H, m_u)."""
    plant = problem.plant
    step = plant.e @ plant.w @ plant.e.T
    # S = Σ_{i<d} A^i N A'^i,  step = A^d N A'^d
    error = np.zeros_like(step)
    for _ in range(delay):
        error, step = error + step, plant.a @ step @ plant.a.T
    k = _prediction_gain(problem, error, step, kappa_x, kappa_u)
    loop, state_cov = plant.a + plant.b @ k, np.zeros_like(step)
    # κ_x (c'(S + Z_t)c)^½,  κ_u (c'K_ρ Z_t K_ρ'c)^½
    backoff_x, backoff_u = [], []
    for _ in range(problem.horizon + 1):
        backoff_x.append(kappa_x * row_deviations(problem.state_set, error + state_cov))
        backoff_u.append(kappa_u * row_deviations(problem.input_set, k @ state_cov @ k.T))
        state_cov = loop @ state_cov @ loop.T + step
    return np.array(backoff_x), np.array(backoff_u[:-1])


def _prediction_gain(problem: ControlProblem, error: Array, step: Array, kappa_x: float, kappa_u: float) -> Array:
    """Return K_ρ; if no ρ leaves enough margin, the one that leaves most."""
    plant, best = problem.plant, (np.inf, np.zeros((problem.plant.n_u, problem.plant.n_x)))
    margin_x, margin_u = problem.state_set.margin(problem.target), problem.input_set.margin(problem.u_target)
    for weight in _INPUT_WEIGHTS:
        k = lqr(plant, problem.q_x, weight * problem.q_u).k
        # Z = (A + B K_ρ) Z (A + B K_ρ)' + A^d N A'^d
        state_cov = solve_discrete_lyapunov(plant.a + plant.b @ k, step)
        share = max(
            _find_largest_share(kappa_x * row_deviations(problem.state_set, error + state_cov), margin_x),
            _find_largest_share(kappa_u * row_deviations(problem.input_set, k @ state_cov @ k.T), margin_u),
        )
        if share < best[0]:
            best = (share, k)
        if share <= _MAX_SHARE:
            break
    if best[0] >= 1.0:
        raise DesignError(
            "smpc.tau",
            f"a constant delay needs {best[0]:.3g} times the margin that the limits leave at the target",
            "take a shorter smpc.tau, or wider limits",
        )
    return best[1]


def _find_largest_share(backoff: Array, margin: Array) -> float:
    """Return the largest share of the margin that a back-off takes."""
    shares = np.divide(backoff, margin, out=np.full(margin.size, np.inf), where=margin > 0.0)
    return float(shares.max(initial=0.0))


class Governor:
    """Sends the input nearest to the regulator's for which the mean of the next state keeps a margin.

    The margin is a number of standard deviations of a prediction one step longer than the age. State rows are soft.

    Args:
        cov: Covariance (n_x, n_x) of the newest known state in a filter without losses; None: it is exact.

    Raises:
        DesignError: The plant has no regulator.
    """

    def __init__(self, problem: ControlProblem, margin: float, cov: Array | None = None) -> None:
        self._problem, self._margin, self._cov = problem, margin, cov
        self._law = lqr(problem.plant, problem.q_x, problem.q_u)
        self._parts = [_PartStep(problem, part) for part in find_parts(problem)]
        self._low, self._high = problem.input_set.bounds
        self._backoffs = np.zeros((1, problem.state_set.b.size))

    def begin(self, runs: int) -> None:
        """See `BatchController`."""

    def act(self, information: Information) -> Array:
        """See `BatchController`."""
        problem = self._problem
        plant, x = problem.plant, predict(problem.plant, information)
        # u = u_s + K (x̂ - x_s);  c'(A x̂ + B u) + margin σ_{a+1} <= b
        inputs = np.clip(problem.u_target + (x - problem.target) @ self._law.k.T, self._low, self._high)
        backoff = self._extend_backoffs(int(information.age.max(initial=0)) + 1)[information.age + 1]
        drift = x @ plant.a.T @ problem.state_set.c.T
        margin = problem.state_set.b - backoff - drift
        violated = inputs @ (problem.state_set.c @ plant.b).T > margin
        for i in np.flatnonzero(violated.any(axis=1) & np.isfinite(x).all(axis=1)):
            for part in self._parts:
                part.move(inputs[i], margin[i])
        return inputs

    def _extend_backoffs(self, age: int) -> Array:
        """Return the margins (…, m_x) of means that are 0, 1 … `age` steps old or more."""
        if len(self._backoffs) <= age:
            limits, state_covs = self._problem.state_set, propagate_covariance(self._problem.plant, 2 * age, self._cov)
            self._backoffs = self._margin * np.array([row_deviations(limits, cov) for cov in state_covs])
        return self._backoffs


class _PartStep:
    """One independent part of one step."""

    def __init__(self, problem: ControlProblem, part: Part) -> None:
        self._part = part
        u_rows = (
            problem.state_set.c[np.ix_(part.rows_x, part.states)] @ problem.plant.b[np.ix_(part.states, part.inputs)]
        )
        (used,) = np.nonzero(np.any(u_rows != 0.0, axis=1))
        self._rows, hard = part.rows_x[used], problem.input_set.c[np.ix_(part.rows_u, part.inputs)]
        rows, self._sides = np.vstack([u_rows[used], hard]), problem.input_set.b[part.rows_u]
        soft = np.arange(len(rows)) < used.size
        self._program = QuadraticProgram(
            2.0 * np.eye(part.inputs.size),
            np.ascontiguousarray(rows),
            np.where(soft, SOFT, 0).astype(np.int32),
            np.where(soft, problem.slack_linear, 0.0),
            np.where(soft, problem.slack_quadratic, 0.0),
        )

    def move(self, inputs: Array, margin: Array) -> None:
        """Move the part's inputs in `inputs` (n_u,) until the rows keep `margin` (m_x,)."""
        sides = np.concatenate([margin[self._rows], self._sides])
        u = inputs[self._part.inputs]
        solved = self._program.solve(-2.0 * u, sides, np.full(sides.size, -np.inf))
        inputs[self._part.inputs] = np.nan if solved is None else solved[0]


class Lqg:
    """Infinite-horizon LQG; the newest state is exact, so the Kalman filter is the prediction from it.

    Without limits no controller costs less (see `stationary_bound`). Its inputs are not clipped.

    Raises:
        DesignError: The plant has no regulator.
    """

    def __init__(self, problem: ControlProblem) -> None:
        self._problem = problem
        self._k = lqr(problem.plant, problem.q_x, problem.q_u).k

    def begin(self, runs: int) -> None:
        """See `BatchController`."""

    def act(self, information: Information) -> Array:
        """See `BatchController`."""
        deviation = predict(self._problem.plant, information) - self._problem.target
        inputs: Array = self._problem.u_target + deviation @ self._k.T
        return inputs
