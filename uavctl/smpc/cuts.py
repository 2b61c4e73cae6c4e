"""A lower bound of one component's optimum: the mean's QP with φ replaced by the library's cuts.

The bound is the Lagrangian's value at the multipliers that the QP solver found, with the cuts mixed alike: whatever its
error, the value is a bound.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uavctl.smpc.meanqp import MeanProblem, Question
from uavctl.smpc.policies import Policy
from uavctl.smpc.qp import OPEN, SOFT, QuadraticProgram

Array = NDArray[np.float64]

# Curvature, relative to the covariance cost, of variables that have none: DAQP wants a definite Hessian. The bound is
# evaluated without it.
_CURVATURE = 1e-4
# The QP is degenerate, and its answer only a guess of the multipliers: a finer tolerance makes it cycle.
TOLERANCE = 1e-7


class RowOrder:
    """Rows of a mean QP in the order: those that no gain moves, links from above, links from below.

    Attributes:
        static: Rows that no gain moves.
        origin: Row of the mean problem that each of them is.
        up: Where the links from above are.
        low: Where the links from below are.
    """

    def __init__(self, problem: MeanProblem) -> None:
        self._problem = problem
        links = problem.links
        self.static = np.setdiff1d(np.arange(len(problem.rows)), links)
        self.origin = np.concatenate([self.static, links, links])
        s, n_l = self.static.size, links.size
        self.up, self.low = slice(s, s + n_l), slice(s + n_l, s + 2 * n_l)
        self._soft = np.isfinite(problem.price[self.origin])
        self._above, self._below = problem.backoff[self.origin], problem.backoff[self.origin]
        self._above[self.low], self._below[self.up] = -OPEN, -OPEN

    def softness(self, others: int) -> tuple[NDArray[np.int32], Array, Array]:
        """Sense, price and curve of these rows and `others` more that are hard."""
        rest = np.zeros(others)
        price = np.where(self._soft, self._problem.price[self.origin], 0.0)
        return (
            np.concatenate([np.where(self._soft, SOFT, 0), rest]).astype(np.int32),
            np.concatenate([price, rest]),
            np.concatenate([self._problem.curve[self.origin], rest]),
        )

    def sides(self, question: Question) -> tuple[Array, Array]:
        """Right and left sides: of static rows with their back-offs, of links without."""
        upper, lower = question.upper - question.offset, question.lower - question.offset
        return upper[self.origin] - self._above, lower[self.origin] + self._below


@dataclass(frozen=True, eq=False)
class Below:
    """What the cuts say of a question.

    Attributes:
        bound: Lower bound of the optimum.
        weights: Weights of the cuts (K,), of sum 1.
        room: What the bound leaves to each link's back-off (n_l,).
        sides: Sides of the rows in order.
    """

    bound: float
    weights: Array
    room: Array
    sides: tuple[Array, Array]


class Cuts:
    """Lower bounds by the cuts of a component's policies.

    Variables: q, the room r that is left to each link's back-off, and ϑ above every cut; r and ϑ count from the first
    policy's back-offs and cost, in units of the largest.

    Args:
        problem: The mean half of the component's problem.
        policies: The library.
        order: Its rows in order.
    """

    def __init__(self, problem: MeanProblem, policies: Sequence[Policy], order: RowOrder) -> None:
        self._problem, self._order = problem, order
        self._level = np.array([policy.level for policy in policies])
        self._slope = np.array([policy.slope for policy in policies])
        self._first = policies[0]
        largest = np.max([policy.backoff for policy in policies], axis=0)
        self._unit = np.where(largest > 0.0, largest, 1.0)
        self._cost_unit = max(policy.cost for policy in policies) or 1.0
        self._h_inverse = np.linalg.inv(problem.h)
        self._a = problem.a[order.origin]
        # A multiplier above a price costs the bound by the slack's quadratic price, and both sides of a row share one
        # slack; where there is no quadratic price, the multiplier is cut.
        curved = problem.curve > 0.0
        slack = np.flatnonzero(curved)
        self._pairing = (slack[:, None] == order.origin).astype(np.float64)
        self._price, self._per_curve = problem.price[slack], 0.25 / problem.curve[slack]
        self._most = np.where(curved, np.inf, problem.price)[order.origin]
        above, below = np.isfinite(problem.upper), np.isfinite(problem.lower)
        self._share = np.where(above & below, 0.5, np.where(above, 1.0, 0.0))[problem.links]
        self._rest = 1.0 - self._share
        self._program = self._set_up()

    def bound(self, question: Question, plus: Array, minus: Array, level: float, slope: Array) -> float:
        """The Lagrangian's value at any multipliers: a lower bound of the optimum (theory notes, C).

        Args:
            question: The question.
            plus: Multipliers >= 0 of the rows' upper sides (m,); where a price or the cut asks for others, those are
                taken.
            minus: Those of the lower sides (m,).
            level: D of the cut.
            slope: μ of the cut (n_l,).
        """
        order = self._order
        plus, minus = plus[order.origin], minus[order.origin]
        plus[order.low] = minus[order.up] = 0.0
        return self._value(question, order.sides(question), plus, minus, level, slope)

    def _value(
        self, question: Question, sides: tuple[Array, Array], plus: Array, minus: Array, level: float, slope: Array
    ) -> float:
        """The same for rows in order; `plus` and `minus` are changed to multipliers that bound something."""
        up, low = self._order.up, self._order.low
        np.minimum(plus, self._most, out=plus)
        np.minimum(minus, self._most - plus, out=minus)
        lacking = np.maximum(slope - plus[up] - minus[low], 0.0)
        plus[up] += self._share * lacking
        minus[low] += self._rest * lacking
        g = question.f + (plus - minus) @ self._a
        value = question.constant + level - 0.5 * float(g @ (self._h_inverse @ g))
        value -= float(plus @ sides[0] - minus @ sides[1])
        beyond = np.maximum(self._pairing @ (plus + minus) - self._price, 0.0)
        return value - float(self._per_curve @ (beyond * beyond))

    def ask(self, question: Question) -> Below | None:
        """The bound; None where the QP fails."""
        n_q, m = question.f.size, self._order.low.stop
        sides = self._order.sides(question)
        upper = np.concatenate([sides[0] - self._first_above, self._upper])
        lower = np.concatenate([sides[1] + self._first_below, self._lower])
        solved = self._program.solve(np.concatenate([question.f, self._f]), upper, lower)
        if solved is None:
            return None
        variables, multipliers = solved
        weights = np.maximum(-multipliers[self._cut], 0.0)
        total = float(weights.sum())
        if total <= 0.0:
            return None
        weights /= total
        plus = np.maximum(multipliers[:m], 0.0)
        minus = plus - multipliers[:m]
        bound = self._value(question, sides, plus, minus, float(weights @ self._level), weights @ self._slope)
        room = variables[n_q:-1] * self._unit + self._first.backoff
        return Below(bound, weights, room, sides)

    def height(self, below: Below) -> Array:
        """How far the bound's φ is above each cut (K,)."""
        height: Array = self._slope @ below.room - self._level
        return height

    def _set_up(self) -> QuadraticProgram:
        problem, order, first = self._problem, self._order, self._first
        n_q, n_l, k = problem.h.shape[0], problem.links.size, self._level.size
        m = order.origin.size
        least, self._cut = slice(m, m + n_l), slice(m + n_l, m + n_l + k)
        size = n_q + n_l + 1
        h = np.zeros((size, size))
        h[:n_q, :n_q] = problem.h
        h[range(n_q, size), range(n_q, size)] = _CURVATURE * self._cost_unit
        a = np.zeros((m + n_l + k, size))
        a[:m, :n_q] = problem.a[order.origin]
        a[order.up, n_q:-1], a[order.low, n_q:-1] = np.diag(self._unit), -np.diag(self._unit)
        a[least, n_q:-1] = np.eye(n_l)
        a[self._cut, n_q:-1], a[self._cut, -1] = self._slope * self._unit / self._cost_unit, 1.0
        self._f = np.zeros(size - n_q)
        self._f[-1] = self._cost_unit
        self._first_above, self._first_below = np.zeros(m), np.zeros(m)
        self._first_above[order.up] = self._first_below[order.low] = first.backoff
        least_cost = (self._level - first.cost - self._slope @ first.backoff) / self._cost_unit
        self._upper = np.full(n_l + k, OPEN)
        self._lower = np.concatenate([-first.backoff / self._unit, least_cost])
        return QuadraticProgram(h, a, *order.softness(n_l + k), TOLERANCE)
