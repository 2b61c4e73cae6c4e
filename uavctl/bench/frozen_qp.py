"""The QP of a frozen policy, one axis, in two solvers: DAQP, which flies, and Clarabel."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

import clarabel
import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from uavctl.bench.result import QpTimes
from uavctl.bench.timing import quiet
from uavctl.smpc.components import Component
from uavctl.smpc.design import Design
from uavctl.smpc.horizon import horizon_of
from uavctl.smpc.library import PartLibrary
from uavctl.smpc.meanqp import MeanProblem
from uavctl.smpc.qp import EQUAL, OPEN, SOFT, QuadraticProgram

Array = NDArray[np.float64]

_TOLERANCE = 1e-9


class FrozenProgram:
    """The mean QP of a component under the first policy of its library.

    Attributes:
        daqp: It in DAQP.
        clarabel: It in Clarabel.
        variables: Their number, without slacks.
        rows: Their number, two-sided.
    """

    def __init__(self, design: Design, component: Component, library: PartLibrary) -> None:
        problem = MeanProblem(design, horizon_of(design, component))
        policy = library.policies(problem)[0]
        self._problem, self._part = problem, component
        self.rows, self.variables = problem.a.shape
        self._backoff = problem.backoff.copy()
        self._backoff[problem.links] = policy.backoff
        self._soft = np.isfinite(problem.price)
        # Rows whose room the policy takes whole.
        self._pins = problem.links[(policy.slope > 0.0) & ~self._soft[problem.links]]
        self._price = np.where(self._soft, problem.price, 0.0)
        sense = np.where(self._soft, SOFT, 0).astype(np.int32)
        sense[self._pins] = EQUAL
        self.daqp = QuadraticProgram(problem.h, problem.a, sense, self._price, problem.curve)
        self.clarabel = ClarabelProgram(problem, self._pins)

    def question(self, x: Array, target: Array) -> tuple[Array, Array, Array]:
        """f, upper and lower sides for the whole plant's state and target."""
        question = self._problem.question(x[self._part.states], target[self._part.states])
        upper = np.minimum(question.upper - question.offset - self._backoff, OPEN)
        lower = np.maximum(question.lower - question.offset + self._backoff, -OPEN)
        middle = 0.5 * (upper[self._pins] + lower[self._pins])
        upper[self._pins] = lower[self._pins] = middle
        return question.f, upper, lower

    def cost(self, q: Array, f: Array, upper: Array, lower: Array) -> float:
        """Objective of a mean q, soft rows paid for."""
        problem, value = self._problem, self._problem.a @ q
        beyond = np.maximum(np.maximum(value - upper, lower - value), 0.0)
        quadratic = 0.5 * float(q @ problem.h @ q) + float(f @ q)
        return quadratic + float(self._price @ beyond + problem.curve @ beyond**2)


class ClarabelProgram:
    """The same program with a slack for each soft row; set up once, then only vectors are updated."""

    def __init__(self, problem: MeanProblem, pins: NDArray[np.intp]) -> None:
        (soft,) = np.nonzero(np.isfinite(problem.price))
        free = np.ones(len(problem.rows), dtype=bool)
        free[pins] = False
        self._n_q, self._pins = problem.h.shape[0], pins
        (self._above,) = np.nonzero(free & np.isfinite(problem.upper))
        (self._below,) = np.nonzero(free & np.isfinite(problem.lower))
        give = np.zeros((len(problem.rows), soft.size))
        give[soft, range(soft.size)] = -1.0
        rows = np.block(
            [
                [problem.a[pins], give[pins]],
                [problem.a[self._above], give[self._above]],
                [-problem.a[self._below], give[self._below]],
                [np.zeros((soft.size, self._n_q)), -np.eye(soft.size)],
            ]
        )
        hessian = np.zeros((rows.shape[1], rows.shape[1]))
        hessian[: self._n_q, : self._n_q] = problem.h
        hessian[self._n_q :, self._n_q :] = 2.0 * np.diag(problem.curve[soft])
        self._linear = np.concatenate([np.zeros(self._n_q), problem.price[soft]])
        self._right = np.zeros(rows.shape[0])
        cones: list[clarabel.Cone] = [clarabel.NonnegativeConeT(rows.shape[0] - pins.size)]
        if pins.size:
            cones.insert(0, clarabel.ZeroConeT(pins.size))
        settings = clarabel.DefaultSettings()
        settings.verbose = False
        settings.max_threads = 1
        settings.direct_solve_method = "qdldl"
        settings.presolve_enable = False  # it would change the shape of what update() replaces
        settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = _TOLERANCE
        p, a = sparse.csc_array(np.triu(hessian)), sparse.csc_array(rows)
        self._solver = clarabel.DefaultSolver(p, self._linear, a, self._right, cones, settings)

    def solve(self, f: Array, upper: Array, lower: Array) -> Array:
        """Minimiser (n_q,)."""
        linear, right = self._linear.copy(), self._right.copy()
        linear[: self._n_q] = f
        sides = np.concatenate([upper[self._pins], upper[self._above], -lower[self._below]])
        right[: sides.size] = sides
        self._solver.update(q=linear, b=right)
        return np.array(self._solver.solve().x[: self._n_q])


def time_frozen_qp(
    design: Design, component: Component, library: PartLibrary, points: Sequence[Array], runs: int
) -> QpTimes:
    """Time both solvers on the questions that states (n_x,) bring, where the QP has an optimum."""
    both = FrozenProgram(design, component, library)
    asked, differences = [], []
    for x in (design.target, *points):
        question = both.question(x, design.target)
        solved = both.daqp.solve(*question)
        if solved is None:
            continue  # the frozen policy leaves this state no plan
        one, other = both.cost(solved[0], *question), both.cost(both.clarabel.solve(*question), *question)
        asked.append(question)
        differences.append(abs(one - other) / max(1.0, abs(one)))
    return QpTimes(
        daqp=_median_us(both.daqp.solve, asked, runs),
        clarabel=_median_us(both.clarabel.solve, asked, runs),
        variables=both.variables,
        rows=both.rows,
        cost_difference=max(differences),
    )


def _median_us(
    solve: Callable[[Array, Array, Array], object], asked: Sequence[tuple[Array, Array, Array]], runs: int
) -> float:
    us = np.zeros((runs, len(asked)))
    with quiet():
        for run in range(runs):
            for i, question in enumerate(asked):
                start = time.perf_counter()
                solve(*question)
                us[run, i] = (time.perf_counter() - start) * 1e6
    return float(np.median(us))
