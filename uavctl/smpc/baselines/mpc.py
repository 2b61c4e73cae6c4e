"""MPC for the worst-case delay: all information counts as d steps old, which is what the paper argues against.

The mean x̂ predicted over d steps has the error S = Σ_{i<d} A^i N A'^i, always, and is moved by A^d E w(k-d) in each
step. Under u = mean + K_ρ(x̂ - mean) a stage t of the plan has the covariance S + Z_t, its input K_ρ Z_t K_ρ', with
Z_{t+1} = (A + B K_ρ) Z_t (A + B K_ρ)' + A^d N A'^d from Z_0 = 0: κ standard deviations are taken off the rows.
"""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_discrete_lyapunov

from uavctl.errors import DesignError
from uavctl.smpc.batch import News, predict
from uavctl.smpc.bounds import lqr
from uavctl.smpc.nominal import BatchMpc, ControlProblem, deviations, unseen

# Constrained MPC on receipt, and three ways to fill the silence: play the plan out, hold, or let go.


Array = NDArray[np.float64]
Index = NDArray[np.intp]


class _OnReceipt(ABC):
    """A new plan from each position that is newer than the last one; a late one is predicted to now first.

    Args:
        margin: How far the plans keep from the state limits, in standard deviations of one step's disturbance.

    Raises:
        DesignError: The plant has no regulator.
    """

    def __init__(self, problem: ControlProblem, margin: float = 0.0) -> None:
        self._problem = problem
        self._mpc = self._planner(margin)
        self.begin(0)

    def _planner(self, margin: float) -> BatchMpc:
        """Make the planner, its limits tightened by `margin` standard deviations."""
        plant = self._problem.plant
        step = plant.e @ plant.w @ plant.e.T
        return BatchMpc(self._problem, margin * deviations(self._problem.state_set, step))

    def begin(self, runs: int) -> None:
        """See `BatchController`."""
        self._plans = np.zeros((runs, self._problem.horizon, self._problem.plant.n_u))
        self._made = np.zeros(runs, dtype=np.intp)
        self._captured = np.full(runs, -1, dtype=np.intp)

    def act(self, news: News) -> Array:
        """See `BatchController`."""
        (fresh,) = np.nonzero(news.newest > self._captured)
        # x(0) is always known: every run has a plan from the first step on.
        self._plans[fresh] = self._mpc.plans(predict(self._problem.plant, news)[fresh])
        self._made[fresh] = news.step
        self._captured[fresh] = news.newest[fresh]
        return self._played(news.step - self._made)

    @abstractmethod
    def _played(self, index: Index, /) -> Array:
        """Inputs (N, n_u) of plans that were made `index` (N,) steps ago."""


class PacketisedPredictive(_OnReceipt):
    """Certainty-equivalent packetised predictive control: the plan is played out, then u_target.

    The receiver's buffer of Quevedo and Nešić (2011, Input-to-state stability of packetized predictive control over
    unreliable networks), with the losses before the controller in place of behind it.
    """

    def _played(self, index: Index, /) -> Array:
        steps = self._problem.horizon
        inputs = self._plans[np.arange(index.size), np.minimum(index, steps - 1)]
        return np.where((index < steps)[:, None], inputs, self._problem.u_target)


class HoldLast(_OnReceipt):
    """The plan's first input, held until the next position comes."""

    def _played(self, _index: Index, /) -> Array:
        return self._plans[:, 0].copy()


class ZeroOnLoss(_OnReceipt):
    """The plan's first input for one step, and u_target until the next position comes."""

    def _played(self, index: Index, /) -> Array:
        return np.where((index == 0)[:, None], self._plans[:, 0], self._problem.u_target)


class MeanQp(PacketisedPredictive):
    """Packetised predictive control with open-loop back-offs: stage t keeps κ σ_t from the state limits.

    σ_t is the standard deviation of a prediction over t steps, and κ the same at every age, however likely it is.

    Args:
        cov: Covariance (n_x, n_x) of the newest state known, of a filter to which all comes; None: it is exact.

    Raises:
        DesignError: The plant has no regulator.
    """

    def __init__(self, problem: ControlProblem, margin: float, cov: Array | None = None) -> None:
        self._cov = cov
        super().__init__(problem, margin)

    def _planner(self, margin: float) -> BatchMpc:
        problem = self._problem
        spread = unseen(problem.plant, problem.horizon, self._cov)
        return BatchMpc(problem, margin * np.array([deviations(problem.state_set, cov) for cov in spread]))


# K_ρ is the regulator's for the input weight ρ R: the least ρ by which the spread at the target takes this share of
# the room, as the full gain asks for more input than there is.
_SHARE = 0.5
_INPUT_WEIGHTS = 2.0 ** np.arange(0, 21)


class WorstCaseDelay:
    """Positions wait until they are `delay` steps old; from there the mean is predicted, and each step plans anew.

    Args:
        delay: d >= 1 [steps].
        kappa_x: κ of the state rows, see `risk.kappa`.

    Raises:
        DesignError: The spread leaves no room around the target, or the plant has no regulator.
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


def _backoffs(problem: ControlProblem, delay: int, kappa_x: float, kappa_u: float) -> tuple[Array, Array]:
    """Return the back-offs of the rows: states (H+1, m_x), inputs (H, m_u)."""
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


def _prediction_gain(problem: ControlProblem, error: Array, step: Array, kappa_x: float, kappa_u: float) -> Array:
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
