"""A governor: the regulator on the predicted mean, whose next mean keeps a margin from the state limits."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from uavctl.smpc.baselines.problem import Part, Problem, deviations, parts, unseen
from uavctl.smpc.batch import News, predict
from uavctl.smpc.lqg_bound import lqr
from uavctl.smpc.qp import SOFT, QuadraticProgram

Array = NDArray[np.float64]


class Governor:
    """The input nearest to the regulator's by which the next state's mean keeps a margin.

    The margin is so many standard deviations of a prediction one step older than the newest position. Where inputs do
    not reach that far, the rows give way at the price of their slack.

    Args:
        problem: The problem.
        margin: Standard deviations.
        cov: Covariance (n_x, n_x) of the newest state known, of a filter to which all comes; None: it is exact.

    Raises:
        DesignError: The plant has no regulator.
    """

    def __init__(self, problem: Problem, margin: float, cov: Array | None = None) -> None:
        self._problem, self._margin, self._cov = problem, margin, cov
        self._law = lqr(problem.plant, problem.q_x, problem.q_u)
        self._parts = [_Step(problem, part) for part in parts(problem)]
        self._low, self._high = problem.input_set.bounds
        self._backoffs = np.zeros((1, problem.state_set.b.size))

    def begin(self, runs: int) -> None:
        """See `BatchController`."""

    def act(self, news: News) -> Array:
        """See `BatchController`."""
        problem = self._problem
        plant, x = problem.plant, predict(problem.plant, news)
        asked = np.clip(problem.u_target + (x - problem.target) @ self._law.k.T, self._low, self._high)
        backoff = self._upto(int(news.age.max(initial=0)) + 1)[news.age + 1]
        drift = x @ plant.a.T @ problem.state_set.c.T
        room = problem.state_set.b - backoff - drift
        short = asked @ (problem.state_set.c @ plant.b).T > room
        for i in np.flatnonzero(short.any(axis=1) & np.isfinite(x).all(axis=1)):
            for part in self._parts:
                part.move(asked[i], room[i])
        return asked

    def _upto(self, age: int) -> Array:
        """Margins (…, m_x) of means that are 0, 1 … `age` steps old, and older."""
        if len(self._backoffs) <= age:
            limits, spread = self._problem.state_set, unseen(self._problem.plant, 2 * age, self._cov)
            self._backoffs = self._margin * np.array([deviations(limits, cov) for cov in spread])
        return self._backoffs


class _Step:
    """One independent part of one step."""

    def __init__(self, problem: Problem, part: Part) -> None:
        self._part = part
        of_u = problem.state_set.c[np.ix_(part.rows_x, part.states)] @ problem.plant.b[np.ix_(part.states, part.inputs)]
        (used,) = np.nonzero(np.any(of_u != 0.0, axis=1))
        self._rows, hard = part.rows_x[used], problem.input_set.c[np.ix_(part.rows_u, part.inputs)]
        rows, self._sides = np.vstack([of_u[used], hard]), problem.input_set.b[part.rows_u]
        soft = np.arange(len(rows)) < used.size
        self._program = QuadraticProgram(
            2.0 * np.eye(part.inputs.size),
            np.ascontiguousarray(rows),
            np.where(soft, SOFT, 0).astype(np.int32),
            np.where(soft, problem.slack_linear, 0.0),
            np.where(soft, problem.slack_quadratic, 0.0),
        )

    def move(self, asked: Array, room: Array) -> None:
        """Move the part's inputs in `asked` (n_u,) until the rows keep `room` (m_x,)."""
        sides = np.concatenate([room[self._rows], self._sides])
        u = asked[self._part.inputs]
        solved = self._program.solve(-2.0 * u, sides, np.full(sides.size, -np.inf))
        asked[self._part.inputs] = np.nan if solved is None else solved[0]
