"""MPC for the worst-case delay: all information counts as d steps old, which is what the paper argues against.

The mean x̂ predicted over d steps has the error S = Σ_{i<d} A^i N A'^i, always, and is moved by A^d E w(k-d) in each
step. Under u = mean + K_ρ(x̂ - mean) a stage t of the plan has the covariance S + Z_t, its input K_ρ Z_t K_ρ', with
Z_{t+1} = (A + B K_ρ) Z_t (A + B K_ρ)' + A^d N A'^d from Z_0 = 0: κ standard deviations are taken off the rows.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_discrete_lyapunov

from uavctl.errors import DesignError
from uavctl.smpc.baselines.mpc import BatchMpc
from uavctl.smpc.baselines.problem import Problem, deviations
from uavctl.smpc.batch import News, predict
from uavctl.smpc.lqg_bound import lqr

Array = NDArray[np.float64]

# K_ρ is the regulator's for the input weight ρ R: the least ρ by which the spread at the target takes this share of
# the room, as the full gain asks for more input than there is.
_SHARE = 0.5
_INPUT_WEIGHTS = 2.0 ** np.arange(0, 21)


class WorstCaseDelay:
    """Positions wait until they are `delay` steps old; from there the mean is predicted, and each step plans anew.

    Args:
        problem: The problem.
        delay: d >= 1 [steps].
        kappa_x: κ of the state rows, see `risk.kappa`.
        kappa_u: κ of the input rows.

    Raises:
        DesignError: The spread leaves no room around the target, or the plant has no regulator.
    """

    def __init__(self, problem: Problem, delay: int, kappa_x: float, kappa_u: float) -> None:
        if delay < 1:
            raise DesignError("smpc.tau", f"{delay} is no delay", "give at least 1 step")
        self._problem, self._delay = problem, delay
        self._mpc = BatchMpc(problem, *_backoffs(problem, delay, kappa_x, kappa_u))
        self.begin(0)

    def begin(self, runs: int) -> None:
        """See `BatchController`."""
        n_x = self._problem.plant.n_x
        # Positions that are not old enough yet, by their capture modulo the length.
        self._waiting = np.full((runs, self._delay + 1), -1, dtype=np.intp)
        self._states = np.zeros((runs, self._delay + 1, n_x))
        self._used, self._state = np.zeros(runs, dtype=np.intp), np.zeros((runs, n_x))

    def act(self, news: News) -> Array:
        """See `BatchController`."""
        self._take(news)
        x = predict(self._problem.plant, News(news.step, self._used, self._state, news.inputs))
        first: Array = self._mpc.plans(x)[:, 0]
        return first

    def _take(self, news: News) -> None:
        """Let the newest position that is old enough be the one that is used; x(0) is known at first."""
        every, slot = np.arange(len(news.newest)), news.newest % (self._delay + 1)
        self._waiting[every, slot], self._states[every, slot] = news.newest, news.state
        if news.step == 0:
            self._state = news.state.copy()
            return
        due = news.step - self._delay
        old = np.where((self._waiting >= 0) & (self._waiting <= due), self._waiting, -1)
        best = old.argmax(axis=1)
        newer = np.flatnonzero(old[every, best] > self._used)
        self._used[newer] = old[newer, best[newer]]
        self._state[newer] = self._states[newer, best[newer]]


def _backoffs(problem: Problem, delay: int, kappa_x: float, kappa_u: float) -> tuple[Array, Array]:
    """What is taken off the rows: states (H+1, m_x), inputs (H, m_u)."""
    plant = problem.plant
    step = plant.e @ plant.w @ plant.e.T
    error = np.zeros_like(step)
    for _ in range(delay):
        error, step = error + step, plant.a @ step @ plant.a.T
    k = _prediction_gain(problem, error, step, kappa_x, kappa_u)
    loop, spread = plant.a + plant.b @ k, np.zeros_like(step)
    backoff_x, backoff_u = [], []
    for _ in range(problem.horizon + 1):
        backoff_x.append(kappa_x * deviations(problem.state_set, error + spread))
        backoff_u.append(kappa_u * deviations(problem.input_set, k @ spread @ k.T))
        spread = loop @ spread @ loop.T + step
    return np.array(backoff_x), np.array(backoff_u[:-1])


def _prediction_gain(problem: Problem, error: Array, step: Array, kappa_x: float, kappa_u: float) -> Array:
    """K_ρ; where no ρ leaves enough room, the one that leaves most of it."""
    plant, best = problem.plant, (np.inf, np.zeros((problem.plant.n_u, problem.plant.n_x)))
    room_x, room_u = problem.state_set.margin(problem.target), problem.input_set.margin(problem.u_target)
    for weight in _INPUT_WEIGHTS:
        k = lqr(plant, problem.q_x, weight * problem.q_u).k
        spread = solve_discrete_lyapunov(plant.a + plant.b @ k, step)
        taken = max(
            _taken(kappa_x * deviations(problem.state_set, error + spread), room_x),
            _taken(kappa_u * deviations(problem.input_set, k @ spread @ k.T), room_u),
        )
        if taken < best[0]:
            best = (taken, k)
        if taken <= _SHARE:
            break
    if best[0] >= 1.0:
        raise DesignError(
            "smpc.tau",
            f"a constant delay spreads the state over {best[0]:.3g} times the room that the limits leave at the target",
            "take a shorter smpc.tau, or wider limits",
        )
    return best[1]


def _taken(backoff: Array, room: Array) -> float:
    """Largest share of the room that a back-off takes."""
    shares = np.divide(backoff, room, out=np.full(room.size, np.inf), where=room > 0.0)
    return float(shares.max(initial=0.0))
