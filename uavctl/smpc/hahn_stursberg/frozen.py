"""Decisions by the exact program, and by a frozen policy where its KKT conditions prove that it gives the same.

1. The frozen policy's back-offs do not depend on the question, so the mean alone is left: a small QP. Rows of which the
   policy takes the whole room are pinned to the middle between their limits.
2. The joint problem's KKT conditions hold if the pinned QP has an optimum, the multipliers of the pinned rows stay
   within those of the policy, and no other row that the gains move has a multiplier (theory notes, D). A row with slack
   has its price for a multiplier: such an answer is refused too.
3. An accepted answer still brings its proof: the Lagrangian's value at its multipliers is a lower bound of the optimum.
4. All other questions go to the exact program, axis by axis.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from uavctl.arrays import Array
from uavctl.records import SolveStatus
from uavctl.smpc.answer import NOMINAL, Answer, Preview, clip_inputs, relative_gap
from uavctl.smpc.batch import Decisions
from uavctl.smpc.hahn_stursberg.design import Design
from uavctl.smpc.hahn_stursberg.exact import METHOD, PartAnswer, PartSolver, assemble
from uavctl.smpc.hahn_stursberg.horizon import Component, decompose
from uavctl.smpc.hahn_stursberg.mean import MeanProblem, RowKind, by_rows, dot_rows
from uavctl.smpc.hahn_stursberg.policy import Policy, cheapest_policy
from uavctl.smpc.qp import EQUAL, SOFT, QuadraticProgram

FROZEN = "frozen"  # the method of an answer that no component needed the exact program for

# A multiplier below this share of a typical cost counts as zero.
_ZERO = 1e-11

# Beyond, squares of numbers that follow from a question's may overflow.
_ABSURD = 1e150

# Largest relative gap of an accepted answer: the exact program's own tolerance.
_PROVEN = 1e-7


class Shortcut:
    """The frozen policy of one component, ready to be asked."""

    def __init__(self, problem: MeanProblem, policy: Policy, backoff_x: Array, backoff_u: Array) -> None:
        """Prepare the pinned QP.

        Args:
            problem: The mean half of the component's problem.
            policy: The frozen policy.
            backoff_x: Its back-offs (H+1, m_x) of the component's state rows.
            backoff_u: Those (H, m_u) of the input rows.
        """
        self._problem, self._covariance = problem, policy.cost
        self._backoff_x, self._backoff_u = backoff_x, backoff_u
        backoff_x.flags.writeable = backoff_u.flags.writeable = False  # every answer has these
        kinds = np.array([row.kind for row in problem.rows])
        soft, links = np.isfinite(problem.price), problem.links
        slope = np.zeros(soft.size)
        slope[links] = policy.slope
        self._pins = np.flatnonzero(slope > 0.0)
        self._backoff = problem.backoff.copy()
        self._backoff[links] = policy.backoff
        self._largest = _largest_multipliers(problem, policy, slope, kinds)
        offset = kinds == RowKind.OFFSET
        self._offset, self._price = np.flatnonzero(offset), problem.price[offset]
        self._clip = np.where(offset, problem.price, np.inf)  # the offset's multipliers; see `QuadraticProgram`
        sense = np.where(soft, SOFT, 0).astype(np.int32)
        sense[self._pins] = EQUAL
        price = np.where(soft, problem.price, 0.0)
        self._program = QuadraticProgram(problem.h, problem.a, sense, price, problem.curve)
        self._h_inverse = np.asarray(np.linalg.inv(problem.h), dtype=np.float64)
        # Both sides of a pinned row have multipliers: their difference is the QP's, their sum the policy's μ.
        half_room = 0.5 * (problem.upper - problem.lower)[self._pins]
        self._level = policy.level - float(slope[self._pins] @ half_room)

    def solve(self, x: Array, target: Array, preview: Preview) -> list[PartAnswer | None]:
        """Answers for states (M, n_x) of the whole plant, with one target (n_x,) and preview.

        None where the policy is not proven optimal.
        """
        problem, part = self._problem, self._problem.horizon.component
        ask = problem.question(x[:, part.states], target[part.states], preview)
        above, below = ask.upper - ask.offset - self._backoff, ask.lower - ask.offset + self._backoff
        above[:, self._pins] = below[:, self._pins] = 0.5 * (above + below)[:, self._pins]
        q, net = np.full_like(ask.f, np.nan), np.full_like(ask.offset, np.nan)  # NaN where there is no optimum
        for i, sides in enumerate(zip(ask.f, above, below, strict=True)):
            solved = self._program.solve(*sides)
            if solved is not None:
                q[i], net[i] = solved
        net = np.clip(net, -self._clip, self._clip)
        # cost = c + J_cov + ½ qᵀHq + fᵀq + price · |offset|
        off_target = np.abs(by_rows(q, problem.a[self._offset].T) + ask.offset[:, self._offset])
        cost = ask.constant + self._covariance + dot_rows(q, by_rows(0.5 * q, problem.h) + ask.f)
        cost += dot_rows(off_target, self._price)
        # lower = c + D - μ · room/2 - ½ gᵀH⁻¹g - λ⁺ · above + λ⁻ · below, with g = f + Aᵀ(λ⁺ - λ⁻)
        g, plus = ask.f + by_rows(net, problem.a), np.maximum(net, 0.0)
        bound = 0.5 * dot_rows(by_rows(g, self._h_inverse), g) + dot_rows(plus, above) + dot_rows(net - plus, below)
        cost_lower = ask.constant + self._level - bound
        w, here = by_rows(q, problem.z.T) + by_rows(ask.p, problem.w.T), ask.p[:, problem.n_p - problem.n_y :]
        inputs = problem.inputs(w, here)
        inputs = clip_inputs(inputs.reshape(-1, inputs.shape[2]), part.c_u, part.b_u)[0].reshape(inputs.shape)
        reference = by_rows(w[:, problem.n_v :] + here, part.x_eq.T)
        fits: NDArray[np.bool_] = np.all(np.abs(net) <= self._largest, axis=1)
        return [
            PartAnswer(
                status=SolveStatus.OPTIMAL,
                iterations=0,
                inputs=inputs[i],
                backoff_x=self._backoff_x,
                backoff_u=self._backoff_u,
                reference=reference[i],
                slack=0.0,
                offset=float(off_target[i].sum()),
                terminal_miss=0.0,
                cost=float(cost[i]),
                cost_lower=float(cost_lower[i]),
            )
            if fits[i] and relative_gap(cost[i], cost_lower[i]) <= _PROVEN
            else None
            for i in range(len(x))
        ]


def _answerable(x: Array, target: Array, preview: Preview) -> NDArray[np.bool_]:
    """Which questions (M,) are finite, and small enough for their squares to be."""
    given = [target] if preview.limits is None else [target, preview.limits]
    if preview.path is not None:
        given += [preview.path.states, preview.path.inputs]
    common = all(bool((np.abs(values) < _ABSURD).all()) for values in given)
    which: NDArray[np.bool_] = np.all(np.abs(x) < _ABSURD, axis=1)
    return which & common


def _largest_multipliers(problem: MeanProblem, policy: Policy, slope: Array, kinds: Array) -> Array:
    """Largest multiplier of each row (m,) that an accepted answer may have."""
    soft, links, pinned = np.isfinite(problem.price), problem.links, slope > 0.0
    # A multiplier at a state row's price means slack.
    largest = np.where(kinds == RowKind.STATE, problem.price * (1.0 - 1e-9), np.inf)
    largest[links] = _ZERO * policy.cost
    # A soft row that is pinned would not be left at its price: such a policy answers nothing.
    largest[pinned] = np.where(soft, -1.0, slope)[pinned]
    return largest


class Share(NamedTuple):
    """A component's share of an answer."""

    method: str  # FROZEN, or that of the exact program
    answer: PartAnswer


class _Part:
    """Both ways to solve one component."""

    def __init__(self, design: Design, component: Component) -> None:
        self.exact = PartSolver(design, component)
        problem = MeanProblem(design, self.exact.horizon)
        policy = cheapest_policy(problem, design.max_iterations)
        # None where there is no frozen policy
        self._shortcut = None if policy is None else Shortcut(problem, policy, *self.exact.backoffs(policy.theta))

    def solve(self, x: Array, target: Array, preview: Preview) -> list[Share]:
        """Shares of the answers from the whole plant's states (M, n_x)."""
        if not len(x):
            return []
        frozen = [None] * len(x) if self._shortcut is None else self._shortcut.solve(x, target, preview)
        return [
            Share(METHOD, self.exact.solve(state, target, preview)) if answer is None else Share(FROZEN, answer)
            for state, answer in zip(x, frozen, strict=True)
        ]


class ShortcutSolver:
    """Solves the decision problem of a design exactly: by frozen policies where these are optimal, else in Clarabel.

    All programs are built at first, those for late positions too: no decision waits for one.
    The same question gives the same bits whatever was asked before. Not for concurrent use.
    """

    def __init__(self, design: Design) -> None:
        """Build the programs of every component.

        Raises:
            DesignError: The design cannot be decomposed, or its schedule does not fit its terminal law.
        """
        self._variants = tuple(
            (variant, tuple(_Part(variant, component) for component in decompose(variant)))
            for variant in (design, *design.late)
        )

    def solve(self, seq: int, x: Array, target: Array, preview: Preview = NOMINAL) -> Answer:
        """Plan from `x` (n_x,) towards the equilibrium `target` (n_x,), with what is known ahead.

        Numbers that are not finite, or absurdly large, give an answer FAILED, as does a solver that breaks down;
        nothing is raised.
        """
        design, shares = self.shares(x[None], target, preview)
        method = FROZEN if all(share.method == FROZEN for _, (share,) in shares) else METHOD
        return assemble(design, seq, method, x, [(part, share.answer) for part, (share,) in shares], preview)

    def shares(self, x: Array, target: Array, preview: Preview) -> tuple[Design, list[tuple[Component, list[Share]]]]:
        """Each component's shares of the answers from states (M, n_x), with the design that they are made by."""
        known = preview.age < len(self._variants)
        design, parts = self._variants[preview.age if known else 0]
        asked = _answerable(x, target, preview) & known
        shares = []
        for part in parts:
            found = iter(part.solve(x[asked], target, preview))
            failed = Share(METHOD, PartAnswer.failed(SolveStatus.FAILED))
            shares.append((part.exact.component, [next(found) if one else failed for one in asked]))
        return design, shares


class ShortcutDecider:
    """Decisions of many runs towards one target; equal states are solved once. Implements `uavctl.smpc.batch.Decider`.

    They are those of the solver, without what only a flight needs of them.
    """

    def __init__(self, solver: ShortcutSolver, target: Array) -> None:
        self._solver, self._target = solver, target

    def decide(self, x: Array, late: int, cov: Array | None = None) -> Decisions:  # noqa: ARG002 a design has its own
        """See `Decider`."""
        states, which = np.unique(x, axis=0, return_inverse=True)  # runs begin in one state
        design, shares = self._solver.shares(states, self._target, Preview(age=late))
        solved = np.ones(len(states), dtype=np.bool_)
        inputs = np.zeros((len(states), design.horizon, design.plant.n_u))
        slack, cost, cost_lower = np.zeros((3, len(states)))
        for part, of_part in shares:
            answers = [share.answer for share in of_part]
            found = np.array([answer.status is SolveStatus.OPTIMAL for answer in answers], dtype=np.bool_)
            for i in np.flatnonzero(found):
                inputs[i][:, part.inputs] = answers[i].inputs
            solved &= found
            slack += [answer.slack for answer in answers]
            cost += [answer.cost for answer in answers]
            cost_lower += [answer.cost_lower for answer in answers]
        inputs[~solved], cost[~solved], cost_lower[~solved] = 0.0, np.inf, -np.inf
        gap = np.full(len(states), np.inf)
        gap[solved] = list(map(relative_gap, cost[solved], cost_lower[solved]))
        which = which.reshape(-1)
        return Decisions(solved[which], inputs[which], slack[which], cost[which], gap[which])
