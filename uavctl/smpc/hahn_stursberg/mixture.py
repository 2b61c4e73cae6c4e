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
from uavctl.smpc.hahn_stursberg.mean import MeanProblem, Question, RowKind
from uavctl.smpc.hahn_stursberg.policies import Policy
from uavctl.smpc.qp import OPEN, SOFT, QuadraticProgram

# A lower bound of one component's optimum: the mean's QP with φ replaced by the library's cuts.
#
# The bound is the Lagrangian's value at the multipliers that the QP solver found, with the cuts mixed alike: whatever
# its error, the value is a bound.


Array = NDArray[np.float64]

# Curvature, relative to the covariance cost, of variables that have none: DAQP wants a definite Hessian. The bound is
# evaluated without it.
_CUT_CURVATURE = 1e-4
# The QP is degenerate, and its answer only a guess of the multipliers: a finer tolerance makes it cycle.
TOLERANCE = 1e-7


class RowOrder:
    """Rows of a mean QP in the order: those that no gain moves, links from above, links from below.

    Attributes:
        up: Where the links from above are.
        low: Where the links from below are.
    """

    def __init__(self, problem: MeanProblem) -> None:
        self._problem = problem
        links = problem.links
        self.static = np.setdiff1d(np.arange(len(problem.rows)), links)  # rows that no gain moves
        self.origin = np.concatenate([self.static, links, links])  # row of the mean problem that each of them is
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
    """Lower bound of the optimum that the cuts give for a question."""

    bound: float  # lower bound of the optimum
    weights: Array  # weights of the cuts (K,), of sum 1
    room: Array  # what the bound leaves to each link's back-off (n_l,)
    sides: tuple[Array, Array]  # sides of the rows in order


class Cuts:
    """Lower bounds by the cuts of a component's policies.

    Variables: q, the room r that is left to each link's back-off, and ϑ above every cut; r and ϑ count from the first
    policy's back-offs and cost, in units of the largest.

    Args:
        problem: The mean half of the component's problem.
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
            plus: Multipliers >= 0 of the rows' upper sides (m,); where a price or the cut asks for others, those are
                taken.
            minus: Those of the lower sides (m,).
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
        """Return how far the bound's φ is above each cut (K,)."""
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
        h[range(n_q, size), range(n_q, size)] = _CUT_CURVATURE * self._cost_unit
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
    """A plan under a convex mixture of policies."""

    q: Array  # mean in the coordinates of the QP (n_q,)
    policies: NDArray[np.intp]  # which policies are mixed
    weights: Array  # their weights, >= 0, of sum 1
    backoff: Array  # back-off of every row (m,)
    covariance: float  # J_cov of the mixture
    cost: float  # cost of the plan, an upper bound of the optimum
    lower: float  # lower bound of the optimum
    slack: float  # sum of the state rows' slacks


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
        self._is_state = np.array([float(row.kind is RowKind.STATE) for row in problem.rows])
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
