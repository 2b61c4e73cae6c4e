"""LQG: the regulator's gain on the mean of the state, whatever the limits are."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from uavctl.smpc.baselines.problem import Problem
from uavctl.smpc.batch import News, predict
from uavctl.smpc.lqg_bound import lqr

Array = NDArray[np.float64]


class Lqg:
    """Infinite-horizon LQG; the newest state is exact, so the Kalman filter is the prediction from it.

    Without limits nothing costs less (see `lqg_bound`). What it asks for is not clipped.

    Args:
        problem: The problem.

    Raises:
        DesignError: The plant has no regulator.
    """

    def __init__(self, problem: Problem) -> None:
        self._problem = problem
        self._k = lqr(problem.plant, problem.q_x, problem.q_u).k

    def begin(self, runs: int) -> None:
        """See `BatchController`."""

    def act(self, news: News) -> Array:
        """See `BatchController`."""
        off = predict(self._problem.plant, news) - self._problem.target
        asked: Array = self._problem.u_target + off @ self._k.T
        return asked
