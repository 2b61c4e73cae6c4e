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
from uavctl.smpc.meanqp import Kind, MeanProblem, Question
from uavctl.smpc.policies import Policy
from uavctl.smpc.qp import OPEN, SOFT, QuadraticProgram

Array = NDArray[np.float64]

_ALL = np.ones(1)

# Curvature, relative to the covariance cost, of variables that have none: DAQP wants a definite Hessian. The bound is
# evaluated without it, and the choice of policies is only a choice.
_CURVATURE = 1e-4
_CHOICE_CURVATURE = 1e-6
# Steepest price of a back-off in the choice, in covariance costs per typical back-off.
_STEEPEST = 30.0
# Multipliers below this do not choose a policy; and so many policies with the highest cuts are mixed in any case.
_ACTIVE = 1e-6
_HIGHEST = 4
# A gap that a single policy may leave: fewer calls are worth more than a better plan there.
_GOOD = 5e-5
# Programs for mixtures of up to so many policies are set up in advance.
_MIXED = 12
# These two QPs are degenerate, and their answers are used as guesses: a finer tolerance only makes them cycle.
_TOLERANCE = 1e-7


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
    """Program of a mixture of a certain number of policies."""

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
        self.problem = problem
        horizon = problem.horizon
        self.theta = np.array([policy.theta for policy in policies])
        self.backoff = np.array([policy.backoff for policy in policies])
        self.cost = np.array([policy.cost for policy in policies])
        self.level = np.array([policy.level for policy in policies])
        self.slope = np.array([policy.slope for policy in policies])
        self._hessian = self.theta @ horizon.p @ self.theta.T
        self._linear = self.theta @ horizon.q
        self._h_inverse = np.linalg.inv(problem.h)
        self._soft = np.isfinite(problem.price)
        self._price = np.where(self._soft, problem.price, 0.0)
        self._state = np.array([row.kind is Kind.STATE for row in problem.rows])
        self._above, self._below = np.isfinite(problem.upper), np.isfinite(problem.lower)
        links = problem.links
        self._upper_share = np.where(self._above & self._below, 0.5, np.where(self._above, 1.0, 0.0))[links]
        self._static = np.setdiff1d(np.arange(len(problem.rows)), links)
        self._origin = np.concatenate([self._static, links, links])
        self._r_scale = self.backoff.max(axis=0)
        self._t_scale = float(self.cost.max())
        self._cuts = self._cut_program()
        self._choice = self._choice_program()
        self._single = self._single_program()
        self._full = np.tile(problem.backoff, (self.cost.size, 1))
        self._full[:, links] = self.backoff
        self._mixers: dict[int, _Mixer] = {}
        for k in range(_MIXED):
            self._mixer(k)

    def bounds(self, question: Question) -> tuple[float, Mixed | None]:
        """Lower bound of the optimum, and the plan that the library has; -inf and None where a QP fails."""
        found = self._from_below(question)
        if found is None:
            return -np.inf, None
        lower, weights, room, height = found
        alone = self._alone(question, lower, int(np.argmax(weights)))
        if alone is not None and relative_gap(alone.cost, lower) <= _GOOD:
            return lower, alone
        mixed = self._mix(question, lower, self._choose(weights, room, height))
        if mixed is None or (alone is not None and alone.cost <= mixed.cost):
            return lower, alone
        return lower, mixed

    def bound(self, question: Question, plus: Array, minus: Array, level: float, slope: Array) -> float:
        """The Lagrangian's value at any multipliers: a lower bound of the optimum (theory notes, C).

        Args:
            question: The question.
            plus: Multipliers >= 0 of the rows' upper sides (m,); of links, changed where the cut asks for more.
            minus: Those of the lower sides (m,).
            level: D of the cut.
            slope: μ of the cut (n_l,).
        """
        problem, links = self.problem, self.problem.links
        lacking = np.maximum(slope - plus[links] - minus[links], 0.0)
        plus[links] += self._upper_share * lacking
        minus[links] += (1.0 - self._upper_share) * lacking
        net, total = plus - minus, plus + minus
        g = question.f + net @ problem.a
        value = question.constant + level - 0.5 * float(g @ self._h_inverse @ g)
        value += float(net @ question.offset + total @ problem.backoff)
        value -= float(plus @ np.where(self._above, question.upper, 0.0))
        value += float(minus @ np.where(self._below, question.lower, 0.0))
        beyond = (total - self._price)[self._soft]
        if (beyond > 0.0).any():
            value -= self._excess(np.maximum(beyond, 0.0))
        return value

    def _excess(self, beyond: Array) -> float:
        """What multipliers above the slacks' prices cost the bound; without a quadratic price there is no bound."""
        curve = self.problem.curve[self._soft]
        over = beyond > 1e-9 * self._price[self._soft]
        if np.any(over & (curve == 0.0)):
            return np.inf
        return float(np.sum(np.where(over, beyond**2 / (4.0 * np.where(curve > 0.0, curve, 1.0)), 0.0)))

    def cost_of(self, question: Question, q: Array, backoff: Array, covariance: float) -> tuple[float, float]:
        """Cost of a mean q under back-offs (m,) and a covariance cost, and the sum of its state slacks."""
        problem = self.problem
        value = problem.a @ q + question.offset
        beyond = np.maximum(np.maximum(value + backoff - question.upper, question.lower + backoff - value), 0.0)
        mean = question.constant + float(q @ (0.5 * (problem.h @ q) + question.f))
        cost = mean + covariance + float(self._price @ beyond + problem.curve @ beyond**2)
        return cost, float(beyond[self._state].sum())

    # --- from below --------------------------------------------------------------------------------------------------

    def _cut_program(self) -> QuadraticProgram:
        """Variables q, the room r that is left to each link's back-off, and ϑ above every cut.

        r and ϑ count from the first policy's back-offs and cost, in units of the largest.
        """
        problem, links, static = self.problem, self.problem.links, self._static
        n_q, n_l, k = problem.h.shape[0], links.size, self.level.size
        size = n_q + n_l + 1
        h = np.zeros((size, size))
        h[:n_q, :n_q] = problem.h
        h[range(n_q, size), range(n_q, size)] = _CURVATURE * self._t_scale
        room = np.diag(self._r_scale)
        a = np.zeros((static.size + 3 * n_l + k, size))
        up, low, least, cut = self._cut_rows()
        a[: static.size, :n_q] = problem.a[static]
        a[up, :n_q] = a[low, :n_q] = problem.a[links]
        a[up, n_q:-1], a[low, n_q:-1] = room, -room
        a[least, n_q:-1] = np.eye(n_l)
        a[cut, n_q:-1], a[cut, -1] = self.slope * self._r_scale / self._t_scale, 1.0
        self._cut_f = np.zeros(size)
        self._cut_f[-1] = self._t_scale
        self._cut_lower = np.full(a.shape[0], -OPEN)
        self._cut_lower[least] = -self.backoff[0] / self._r_scale
        self._cut_lower[cut] = (self.level - self.cost[0] - self.slope @ self.backoff[0]) / self._t_scale
        self._cut_upper = np.full(a.shape[0], OPEN)
        return QuadraticProgram(h, a, *self._softness(n_l + k), _TOLERANCE)

    def _cut_rows(self) -> tuple[slice, slice, slice, slice]:
        s, n_l, k = self._static.size, self.problem.links.size, self.level.size
        return (
            slice(s, s + n_l),
            slice(s + n_l, s + 2 * n_l),
            slice(s + 2 * n_l, s + 3 * n_l),
            slice(s + 3 * n_l, s + 3 * n_l + k),
        )

    def _softness(self, others: int) -> tuple[NDArray[np.int32], Array, Array]:
        """Sense, price and curve of rows in the order static, links up, links down, and `others` that are hard."""
        rest = np.zeros(others)
        sense = np.where(self._soft[self._origin], SOFT, 0)
        return (
            np.concatenate([sense, rest]).astype(np.int32),
            np.concatenate([self._price[self._origin], rest]),
            np.concatenate([self.problem.curve[self._origin], rest]),
        )

    def _sides(self, question: Question) -> tuple[Array, Array]:
        """Sides of the rows in the order static (with back-offs), links up (without), links down (without)."""
        s, n_l = self._static.size, self.problem.links.size
        upper = (question.upper - question.offset - self.problem.backoff)[self._origin]
        lower = (question.lower - question.offset + self.problem.backoff)[self._origin]
        upper[s + n_l :] = OPEN
        lower[s : s + n_l] = -OPEN
        return upper, lower

    def _from_below(self, question: Question) -> tuple[float, Array, Array, Array] | None:
        """Lower bound; weights of the cuts (K,); room of the links (n_l,) and how far ϑ is above each cut (K,)."""
        problem, links = self.problem, self.problem.links
        s, n_q = self._static.size, question.f.size
        up, low, _, cut = self._cut_rows()
        upper, lower = self._cut_upper.copy(), self._cut_lower.copy()
        upper[: low.stop], lower[: low.stop] = self._sides(question)
        upper[up] -= self.backoff[0]
        lower[low] += self.backoff[0]
        f = self._cut_f.copy()
        f[:n_q] = question.f
        solved = self._cuts.solve(f, upper, lower)
        if solved is None:
            return None
        variables, multipliers = solved
        weights = np.maximum(-multipliers[cut], 0.0)
        total = float(weights.sum())
        if total <= 0.0:
            return None
        weights /= total
        plus, minus = np.zeros(len(problem.rows)), np.zeros(len(problem.rows))
        plus[self._static] = np.maximum(multipliers[:s], 0.0)
        minus[self._static] = np.maximum(-multipliers[:s], 0.0)
        plus[links], minus[links] = np.maximum(multipliers[up], 0.0), np.maximum(-multipliers[low], 0.0)
        bound = self.bound(question, plus, minus, float(weights @ self.level), weights @ self.slope)
        room = variables[n_q:-1] * self._r_scale + self.backoff[0]
        return bound, weights, room, self.slope @ room - self.level

    # --- from above --------------------------------------------------------------------------------------------------

    def _choice_program(self) -> QuadraticProgram:
        """Dual of min Σλ_k J_k s.t. Σλ_k β_k <= room: variables are the prices of the back-offs, and ϑ."""
        n_l, k = self.problem.links.size, self.level.size
        a = np.zeros((n_l + k, n_l + 1))
        a[:n_l, :n_l] = np.eye(n_l)
        a[n_l:, :n_l], a[n_l:, -1] = -self.backoff / self._r_scale, 1.0
        self._choice_upper = np.concatenate([np.full(n_l, _STEEPEST), (self.cost - self.cost.min()) / self._t_scale])
        self._choice_lower = np.concatenate([np.zeros(n_l), np.full(k, -OPEN)])
        h = _CHOICE_CURVATURE * np.eye(n_l + 1)
        rest = np.zeros(n_l + k)
        return QuadraticProgram(h, a, rest.astype(np.int32), rest, rest, _TOLERANCE)

    def _choose(self, weights: Array, room: Array, height: Array) -> NDArray[np.intp]:
        """Policies worth mixing: with the highest cuts, and those that fit the room at the least cost."""
        chosen = weights > _ACTIVE
        chosen[np.argsort(height, kind="stable")[:_HIGHEST]] = True
        f = np.append(room / self._r_scale, -1.0)
        solved = self._choice.solve(f, self._choice_upper, self._choice_lower)
        if solved is not None:
            chosen |= solved[1][room.size :] > _ACTIVE
        return np.flatnonzero(chosen)

    def _single_program(self) -> QuadraticProgram:
        """The mean under one policy."""
        problem = self.problem
        sense = np.where(self._soft, SOFT, 0).astype(np.int32)
        return QuadraticProgram(problem.h, problem.a, sense, self._price, problem.curve)

    def _alone(self, question: Question, bound: float, k: int) -> Mixed | None:
        """The mean under policy k alone."""
        backoff = self._full[k]
        upper, lower = question.upper - question.offset - backoff, question.lower - question.offset + backoff
        solved = self._single.solve(question.f, upper, lower)
        if solved is None:
            return None
        cost, slack = self.cost_of(question, solved[0], backoff, float(self.cost[k]))
        return Mixed(solved[0], np.array([k]), _ALL, backoff, float(self.cost[k]), cost, bound, slack)

    def _mix(self, question: Question, bound: float, chosen: NDArray[np.intp]) -> Mixed | None:
        """The mean and the weights of the chosen policies together; the last one's weight is what the others leave."""
        problem = self.problem
        n_q, k, s, n_l = question.f.size, chosen.size - 1, self._static.size, problem.links.size
        last, others = chosen[-1], chosen[:-1]
        mixer = self._mixer(k)
        h, a = mixer.h.copy(), mixer.a.copy()
        hessian = self._hessian[chosen[:, None], chosen]
        difference = hessian[:-1] - hessian[-1]
        h[n_q:, n_q:] = difference[:, :-1] - difference[:, -1:]
        f = np.concatenate([question.f, difference[:, -1] + self._linear[others] - self._linear[last]])
        backoff = (self.backoff[others] - self.backoff[last]).T
        a[s : s + n_l, n_q:] = backoff
        a[s + n_l : s + 2 * n_l, n_q:] = -backoff
        upper, lower = mixer.upper.copy(), mixer.lower.copy()
        upper[: s + 2 * n_l], lower[: s + 2 * n_l] = self._sides(question)
        upper[s : s + n_l] -= self.backoff[last]
        lower[s + n_l : s + 2 * n_l] += self.backoff[last]
        solved = mixer.program.solve_anew(h, f, a, upper, lower)
        if solved is None:
            return None
        values = solved[0]
        weights = np.zeros(k + 1)
        np.maximum(values[n_q:], 0.0, out=weights[:-1])
        weights[-1] = max(0.0, 1.0 - float(weights.sum()))
        weights /= weights.sum()
        full = problem.backoff.copy()
        full[problem.links] = weights @ self.backoff[chosen]
        covariance = float(weights @ (0.5 * (hessian @ weights) + self._linear[chosen])) + problem.horizon.c_0
        cost, slack = self.cost_of(question, values[:n_q], full, covariance)
        return Mixed(values[:n_q], chosen, weights, full, covariance, cost, bound, slack)

    def _mixer(self, k: int) -> _Mixer:
        """Program of a mixture of k + 1 policies, with all that no question changes."""
        if k not in self._mixers:
            problem, s, n_l = self.problem, self._static.size, self.problem.links.size
            n_q, m = problem.h.shape[0], s + 2 * n_l
            h, a = np.eye(n_q + k), np.zeros((m + k + 1, n_q + k))
            h[:n_q, :n_q] = problem.h
            a[:m, :n_q] = problem.a[self._origin]
            a[m:-1, n_q:] = np.eye(k)
            a[-1, n_q:] = 1.0
            upper, lower = np.full(a.shape[0], OPEN), np.full(a.shape[0], -OPEN)
            lower[m:-1] = 0.0
            upper[-1] = 1.0
            self._mixers[k] = _Mixer(QuadraticProgram(h, a, *self._softness(k + 1)), h, a, upper, lower)
        return self._mixers[k]
