"""Bounds of one component's optimum from a library of policies, by a few small QPs.

From below: the mean with φ replaced by the library's cuts. The bound is the Lagrangian's value at the multipliers
found, so no error of the QP solver can make it wrong. From above: the mean under the policy of the heaviest cut; where
that leaves a gap, a choice of policies that are worth mixing, and the mean together with their convex weights. Both
plans can be flown. No number depends on what was solved before: the state of every row is given to the QP solver anew.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uavctl.smpc.answer import relative_gap
from uavctl.smpc.cuts import TOLERANCE, Below, Cuts, RowOrder
from uavctl.smpc.meanqp import Kind, MeanProblem, Question
from uavctl.smpc.policies import Policy
from uavctl.smpc.qp import OPEN, SOFT, QuadraticProgram

Array = NDArray[np.float64]

_ALL = np.ones(1)

# Curvature of the choice's variables, which have none: DAQP wants a definite Hessian, and it is only a choice.
_CURVATURE = 1e-6
# Steepest price of a back-off in the choice, in covariance costs per typical back-off.
_STEEPEST = 30.0
# Multipliers below this do not choose a policy; and so many policies with the highest cuts are mixed in any case.
_ACTIVE = 1e-6
_HIGHEST = 6
# A gap that a single policy may leave: fewer calls are worth more than a better plan there.
_GOOD = 1e-4
# Programs for mixtures of up to so many policies are set up in advance.
_MIXED = 12


@dataclass(frozen=True, eq=False)
class Mixed:
    """A plan under a convex mixture of policies.

    Attributes:
        q: Mean in the coordinates of the QP (n_q,).
        policies: Which policies are mixed.
        weights: Their weights, >= 0, of sum 1.
        backoff: Back-off of every row (m,).
        covariance: J_cov of the mixture.
        cost: Cost of the plan, an upper bound of the optimum.
        lower: Lower bound of the optimum.
        slack: Sum of the state rows' slacks.
    """

    q: Array
    policies: NDArray[np.intp]
    weights: Array
    backoff: Array
    covariance: float
    cost: float
    lower: float
    slack: float


@dataclass(frozen=True, eq=False)
class _Mixer:
    """Program of a mixture of a certain number of policies; h and a are its own to write to."""

    program: QuadraticProgram
    h: Array
    a: Array
    upper: Array
    lower: Array


class Mixture:
    """The library of one component, ready to be asked.

    Args:
        problem: The mean half of the component's problem.
        policies: The library; the first is the cheapest policy.
    """

    def __init__(self, problem: MeanProblem, policies: Sequence[Policy]) -> None:
        self.problem, self.first = problem, policies[0]
        horizon = problem.horizon
        self.theta = np.array([policy.theta for policy in policies])
        self.backoff = np.array([policy.backoff for policy in policies])
        self.cost = np.array([policy.cost for policy in policies])
        self._hessian = self.theta @ horizon.p @ self.theta.T
        self._linear = self.theta @ horizon.q
        soft = np.isfinite(problem.price)
        self._price = np.where(soft, problem.price, 0.0)
        self._of_q = np.vstack([0.5 * problem.h, problem.a])
        self._is_state = np.array([float(row.kind is Kind.STATE) for row in problem.rows])
        self._state_curve = problem.curve * self._is_state
        self._order = RowOrder(problem)
        self.cuts = Cuts(problem, policies, self._order)
        self._choice = self._choice_program()
        sense = np.where(soft, SOFT, 0).astype(np.int32)
        self._single = QuadraticProgram(problem.h, problem.a, sense, self._price, problem.curve)
        self._full = np.tile(problem.backoff, (self.cost.size, 1))
        self._full[:, problem.links] = self.backoff
        self._mixers: dict[int, _Mixer] = {}
        for k in range(_MIXED):
            self._mixer(k)

    def bounds(self, question: Question) -> tuple[float, Mixed | None]:
        """Lower bound of the optimum, and the plan that the library has; -inf and None where a QP fails."""
        below = self.cuts.ask(question)
        if below is None:
            return -np.inf, None
        best = self._alone(question, below.bound, int(np.argmax(below.weights)))
        for choose in (self._highest, self._choose):
            if best is not None and relative_gap(best.cost, below.bound) <= _GOOD:
                break
            mixed = self._mix(question, below, choose(below))
            if best is None or (mixed is not None and mixed.cost < best.cost):
                best = mixed
        return below.bound, best

    def cost_of(self, question: Question, q: Array, backoff: Array, covariance: float) -> tuple[float, float]:
        """Cost of a mean q under back-offs (m,) and a covariance cost, and the sum of its state slacks."""
        n_q = question.f.size
        of_q = self._of_q @ q
        value = of_q[n_q:] + question.offset
        beyond = np.maximum(np.maximum(value - question.upper, question.lower - value) + backoff, 0.0)
        cost = question.constant + covariance + float(q @ (of_q[:n_q] + question.f) + self._price @ beyond)
        slack = float(self._is_state @ beyond)
        if slack:
            cost += float(self._state_curve @ (beyond * beyond))
        return cost, slack

    def _choice_program(self) -> QuadraticProgram:
        """Dual of min Σλ_k J_k s.t. Σλ_k β_k <= room: variables are the prices of the back-offs, and ϑ."""
        n_l, k = self.problem.links.size, self.cost.size
        largest = self.backoff.max(axis=0)
        self._unit = np.where(largest > 0.0, largest, 1.0)
        a = np.zeros((n_l + k, n_l + 1))
        a[:n_l, :n_l] = np.eye(n_l)
        a[n_l:, :n_l], a[n_l:, -1] = -self.backoff / self._unit, 1.0
        dearer = (self.cost - self.cost.min()) / (self.cost.max() or 1.0)
        self._choice_upper = np.concatenate([np.full(n_l, _STEEPEST), dearer])
        self._choice_lower = np.concatenate([np.zeros(n_l), np.full(k, -OPEN)])
        rest = np.zeros(n_l + k)
        return QuadraticProgram(_CURVATURE * np.eye(n_l + 1), a, rest.astype(np.int32), rest, rest, TOLERANCE)

    def _highest(self, below: Below) -> NDArray[np.intp]:
        """Policies with the highest cuts: nearly always enough to mix."""
        chosen = below.weights > _ACTIVE
        height = self.cuts.height(below)
        chosen[np.argpartition(height, min(_HIGHEST, height.size) - 1)[:_HIGHEST]] = True
        return np.flatnonzero(chosen)

    def _choose(self, below: Below) -> NDArray[np.intp]:
        """Policies worth mixing: with the highest cuts, and those that fit the room at the least cost."""
        chosen = np.zeros(below.weights.size, dtype=bool)
        chosen[self._highest(below)] = True
        f = np.append(below.room / self._unit, -1.0)
        solved = self._choice.solve(f, self._choice_upper, self._choice_lower)
        if solved is not None:
            chosen |= solved[1][below.room.size :] > _ACTIVE
        return np.flatnonzero(chosen)

    def _alone(self, question: Question, bound: float, k: int) -> Mixed | None:
        """The mean under policy k alone."""
        backoff = self._full[k]
        upper, lower = question.upper - question.offset - backoff, question.lower - question.offset + backoff
        solved = self._single.solve(question.f, upper, lower)
        if solved is None:
            return None
        cost, slack = self.cost_of(question, solved[0], backoff, float(self.cost[k]))
        return Mixed(solved[0], np.array([k]), _ALL, backoff, float(self.cost[k]), cost, bound, slack)

    def _mix(self, question: Question, below: Below, chosen: NDArray[np.intp]) -> Mixed | None:
        """The mean and the weights of the chosen policies together; the last one's weight is what the others leave."""
        order, n_q = self._order, question.f.size
        mixer = self._mixer(chosen.size - 1)
        backoff, hessian, linear = self.backoff[chosen], self._hessian[chosen][:, chosen], self._linear[chosen]
        difference = hessian[:-1] - hessian[-1]
        apart = (backoff[:-1] - backoff[-1]).T
        # These entries are written each time, all others never.
        mixer.h[n_q:, n_q:] = difference[:, :-1] - difference[:, -1:]
        mixer.a[order.up, n_q:] = apart
        mixer.a[order.low, n_q:] = -apart
        f = np.concatenate([question.f, difference[:, -1] + linear[:-1] - linear[-1]])
        upper, lower = np.concatenate([below.sides[0], mixer.upper]), np.concatenate([below.sides[1], mixer.lower])
        upper[order.up] -= backoff[-1]
        lower[order.low] += backoff[-1]
        solved = mixer.program.solve_anew(mixer.h, f, mixer.a, upper, lower)
        if solved is None:
            return None
        q, others = solved[0][:n_q], np.maximum(solved[0][n_q:], 0.0)
        weights = np.append(others, max(0.0, 1.0 - float(others.sum())))
        weights /= weights.sum()
        full = self.problem.backoff.copy()
        full[self.problem.links] = weights @ backoff
        covariance = float(weights @ (0.5 * (hessian @ weights) + linear)) + self.problem.horizon.c_0
        cost, slack = self.cost_of(question, q, full, covariance)
        return Mixed(q, chosen, weights, full, covariance, cost, below.bound, slack)

    def _mixer(self, k: int) -> _Mixer:
        """Program of a mixture of k + 1 policies, with all that no question changes."""
        if k not in self._mixers:
            problem, order = self.problem, self._order
            n_q, m = problem.h.shape[0], order.origin.size
            h, a = np.eye(n_q + k), np.zeros((m + k + 1, n_q + k))
            h[:n_q, :n_q] = problem.h
            a[:m, :n_q] = problem.a[order.origin]
            a[m:-1, n_q:] = np.eye(k)
            a[-1, n_q:] = 1.0
            upper, lower = np.append(np.full(k, OPEN), 1.0), np.append(np.zeros(k), -OPEN)
            self._mixers[k] = _Mixer(QuadraticProgram(h, a, *order.softness(k + 1)), h, a, upper, lower)
        return self._mixers[k]
