"""Constrained MPC on receipt, and three ways to fill the silence: play the plan out, hold, or let go."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
from numpy.typing import NDArray

from uavctl.smpc.baselines.mpc import BatchMpc
from uavctl.smpc.baselines.problem import Problem, deviations, unseen
from uavctl.smpc.batch import News, predict

Array = NDArray[np.float64]
Index = NDArray[np.intp]


class _OnReceipt(ABC):
    """A new plan from each position that is newer than the last one; a late one is predicted to now first.

    Args:
        problem: The problem.
        margin: How far the plans keep from the state limits, in standard deviations of one step's disturbance.

    Raises:
        DesignError: The plant has no regulator.
    """

    def __init__(self, problem: Problem, margin: float = 0.0) -> None:
        self._problem = problem
        self._mpc = self._planner(margin)
        self.begin(0)

    def _planner(self, margin: float) -> BatchMpc:
        """Who plans."""
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
        problem: The problem.
        margin: κ.
        cov: Covariance (n_x, n_x) of the newest state known, of a filter to which all comes; None: it is exact.

    Raises:
        DesignError: The plant has no regulator.
    """

    def __init__(self, problem: Problem, margin: float, cov: Array | None = None) -> None:
        self._cov = cov
        super().__init__(problem, margin)

    def _planner(self, margin: float) -> BatchMpc:
        problem = self._problem
        spread = unseen(problem.plant, problem.horizon, self._cov)
        return BatchMpc(problem, margin * np.array([deviations(problem.state_set, cov) for cov in spread]))
