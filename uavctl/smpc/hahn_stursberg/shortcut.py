"""Decisions by the exact program, and by a frozen policy where its KKT conditions prove that it gives the same.

1. The frozen policy has fixed gains. So its back-offs do not depend on the question, and a small QP of the mean
   remains. A row in which they take the whole distance between both limits is pinned to the middle.
2. The joint problem's KKT conditions hold if the pinned QP has an optimum, the multipliers of the pinned rows are at
   most those of the policy, and no other gain row has a multiplier (theory notes, D). A row with slack has its price as
   multiplier: such an answer is refused too.
3. An accepted answer has a proof: the Lagrangian's value at its multipliers is a lower bound of the optimum.
4. Other questions go to sequential quadratic programming, if that is asked for, and what is left to the exact program,
   component by component.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from uavctl.arrays import Array
from uavctl.records import SolveStatus
from uavctl.smpc.answer import NOMINAL, Answer, Preview, relative_gap
from uavctl.smpc.batch import Decisions
from uavctl.smpc.hahn_stursberg.components import Component, decompose
from uavctl.smpc.hahn_stursberg.design import Design
from uavctl.smpc.hahn_stursberg.exact import METHOD, PartAnswer, PartSolver, assemble
from uavctl.smpc.hahn_stursberg.mean import MAX_GAP, MeanProblem, RowKind, dot_rows, multiply_rows
from uavctl.smpc.hahn_stursberg.policy import Policy, cheapest_policy
from uavctl.smpc.hahn_stursberg.sequential import SequentialProgram, make_sequential_program
from uavctl.smpc.qp import EQUAL, SOFT, QuadraticProgram

FROZEN = "frozen"  # method of an answer without an exact program

SEQUENTIAL = "sequential"  # method of an answer by sequential quadratic programming

_METHODS = (FROZEN, SEQUENTIAL, METHOD)  # the method of a plan is that of the component latest in this list

# A multiplier below this share of a typical cost counts as 0.
_ZERO_SHARE = 1e-11

# Squares of larger numbers, and of what follows from them, may overflow.
_MAX_NUMBER = 1e150


class Shortcut:
    """Solver with the frozen policy of one component."""

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
        backoff_x.flags.writeable = backoff_u.flags.writeable = False  # shared by all answers
        kinds = np.array([row.kind for row in problem.rows])
        soft, gain_rows = np.isfinite(problem.price), problem.gain_rows
        slope = np.zeros(soft.size)
        slope[gain_rows] = policy.slope
        self._pins = np.flatnonzero(slope > 0.0)
        self._backoff = problem.backoff.copy()
        self._backoff[gain_rows] = policy.backoff
        self._largest = _largest_multipliers(problem, policy, slope, kinds)
        offset = kinds == RowKind.OFFSET
        self._price = problem.price[offset]
        self._clip = np.where(offset, problem.price, np.inf)  # the offset's multipliers; see `QuadraticProgram`
        sense = np.where(soft, SOFT, 0).astype(np.int32)
        sense[self._pins] = EQUAL
        price = np.where(soft, problem.price, 0.0)
        self._program = QuadraticProgram(problem.h, problem.a, sense, price, problem.curve)
        self._h_inverse = np.asarray(np.linalg.inv(problem.h), dtype=np.float64)
        # Both sides of a pinned row have multipliers: their difference is the QP's, their sum the policy's μ.
        half_distance = 0.5 * (problem.upper - problem.lower)[self._pins]
        self._level = policy.level - float(slope[self._pins] @ half_distance)

    def solve(self, x: Array, target: Array, preview: Preview) -> list[PartAnswer | None]:
        """Solve for states (M, n_x) of the whole plant, with one target (n_x,) and preview.

        None where the policy is not proven optimal.
        """
        problem, part = self._problem, self._problem.horizon.component
        qp = problem.question(x[:, part.states], target[part.states], preview)
        above, below = (qp.upper - qp.offset - self._backoff, qp.lower - qp.offset + self._backoff)
        above[:, self._pins] = below[:, self._pins] = 0.5 * (above + below)[:, self._pins]
        q, net = (np.full_like(qp.f, np.nan), np.full_like(qp.offset, np.nan))  # NaN where there is no optimum
        for i, sides in enumerate(zip(qp.f, above, below, strict=True)):
            solved = self._program.solve(*sides)
            if solved is not None:
                q[i], net[i] = solved
        net = np.clip(net, -self._clip, self._clip)
        # cost = c + J_cov + ½ q'Hq + f'q + price · |offset|
        plan = problem.read_plan(qp, q)
        cost = qp.constant + self._covariance + dot_rows(q, multiply_rows(0.5 * q, problem.h) + qp.f)
        cost += dot_rows(plan.off_target, self._price)
        # lower = c + D - μ · distance/2 - ½ g'H⁻¹g - λ⁺ · above + λ⁻ · below, with g = f + A'(λ⁺ - λ⁻)
        g, plus = qp.f + multiply_rows(net, problem.a), np.maximum(net, 0.0)
        bound = (
            0.5 * dot_rows(multiply_rows(g, self._h_inverse), g) + dot_rows(plus, above) + dot_rows(net - plus, below)
        )
        cost_lower = qp.constant + self._level - bound
        is_optimal: NDArray[np.bool_] = np.all(np.abs(net) <= self._largest, axis=1)
        return [
            PartAnswer.proven(plan, i, (self._backoff_x, self._backoff_u), cost[i], cost_lower[i])
            if is_optimal[i] and relative_gap(cost[i], cost_lower[i]) <= MAX_GAP
            else None
            for i in range(len(x))
        ]


def _is_answerable(x: Array, target: Array, preview: Preview) -> NDArray[np.bool_]:
    """Return which questions (M,) are finite, with squares that do not overflow."""
    arrays = [target] if preview.limits is None else [target, preview.limits]
    if preview.path is not None:
        arrays += [preview.path.states, preview.path.inputs]
    common = all(bool((np.abs(values) < _MAX_NUMBER).all()) for values in arrays)
    is_small: NDArray[np.bool_] = np.all(np.abs(x) < _MAX_NUMBER, axis=1)
    return is_small & common


def _largest_multipliers(problem: MeanProblem, policy: Policy, slope: Array, kinds: Array) -> Array:
    """Return the largest multiplier of each row (m,) in an accepted answer."""
    soft, gain_rows, pinned = np.isfinite(problem.price), problem.gain_rows, slope > 0.0
    # A multiplier at a state row's price means slack.
    largest = np.where(kinds == RowKind.STATE, problem.price * (1.0 - 1e-9), np.inf)
    largest[gain_rows] = _ZERO_SHARE * policy.cost
    # The price of a pinned soft row is no bound: such a policy gives no answers.
    largest[pinned] = np.where(soft, -1.0, slope)[pinned]
    return largest


class MethodAnswer(NamedTuple):
    """Answer of a component and its method."""

    method: str  # FROZEN, or the exact program's
    answer: PartAnswer


class _ComponentSolver:
    """Solver of one component: frozen policy first, then the exact program."""

    def __init__(self, design: Design, component: Component, *, sequential: bool) -> None:
        self.exact = PartSolver(design, component)
        problem = MeanProblem(design, self.exact.horizon)
        policy = cheapest_policy(problem, design.max_iterations)
        self._programs: list[tuple[str, Shortcut | SequentialProgram]] = []  # empty where there is no frozen policy
        if policy is None:
            return
        self._programs.append((FROZEN, Shortcut(problem, policy, *self.exact.backoffs(policy.theta))))
        program = make_sequential_program(problem, policy, self.exact.backoffs) if sequential else None
        if program is not None:
            self._programs.append((SEQUENTIAL, program))

    def solve(self, x: Array, target: Array, preview: Preview) -> list[MethodAnswer]:
        """Solve for states (M, n_x) of the whole plant."""
        if not len(x):
            return []
        answers: list[MethodAnswer | None] = [None] * len(x)
        for method, program in self._programs:
            left = [i for i, answer in enumerate(answers) if answer is None]
            if not left:
                break
            for i, answer in zip(left, program.solve(x[left], target, preview), strict=True):
                answers[i] = None if answer is None else MethodAnswer(method, answer)
        return [
            MethodAnswer(METHOD, self.exact.solve(state, target, preview)) if answer is None else answer
            for state, answer in zip(x, answers, strict=True)
        ]


class ShortcutSolver:
    """Solves the decision problem of a design exactly: by frozen policies where these are optimal, else in Clarabel.

    All programs are built at the start, those for late positions too: no decision waits for one.
    The same question gives the same bits after any other questions. Not for concurrent use.
    """

    def __init__(self, design: Design, *, sequential: bool = False) -> None:
        """Build the programs of every component.

        Args:
            design: Design, with those for late positions.
            sequential: Answer by SQP what the frozen policy does not. A flight does not: a recording of an earlier
                version must replay with the same bits.

        Raises:
            DesignError: The design cannot be decomposed, or its schedule does not fit its terminal law.
        """
        self._variants = tuple(
            (
                variant,
                tuple(_ComponentSolver(variant, component, sequential=sequential) for component in decompose(variant)),
            )
            for variant in (design, *design.late)
        )

    def solve(self, seq: int, x: Array, target: Array, preview: Preview = NOMINAL) -> Answer:
        """Plan from `x` (n_x,) to the equilibrium `target` (n_x,), with a preview.

        Numbers that are not finite or extremely large give an answer FAILED, as does a solver that breaks down; nothing
        is raised.
        """
        design, shares = self.solve_components(x[None], target, preview)
        method = max((share.method for _, (share,) in shares), key=_METHODS.index)
        return assemble(design, seq, method, x, [(part, share.answer) for part, (share,) in shares], preview)

    def solve_components(
        self, x: Array, target: Array, preview: Preview
    ) -> tuple[Design, list[tuple[Component, list[MethodAnswer]]]]:
        """Return the answers of each component from states (M, n_x), with their design."""
        is_known = 0 <= preview.age < len(self._variants)
        design, parts = self._variants[preview.age if is_known else 0]
        answerable = _is_answerable(x, target, preview) & is_known
        shares = []
        for part in parts:
            answers = iter(part.solve(x[answerable], target, preview))
            failed = MethodAnswer(METHOD, PartAnswer.failed(SolveStatus.FAILED))
            shares.append((part.exact.component, [next(answers) if is_asked else failed for is_asked in answerable]))
        return design, shares


class ShortcutDecider:
    """Decisions of many runs towards one target; equal states are solved once. Implements `uavctl.smpc.batch.Decider`.

    They are the solver's, without data that only a flight needs.
    """

    def __init__(self, solver: ShortcutSolver, target: Array) -> None:
        self._solver, self._target = solver, target

    def decide(self, x: Array, age: int, cov: Array | None = None) -> Decisions:  # noqa: ARG002 a design has its own
        """See `Decider`."""
        states, index = np.unique(x, axis=0, return_inverse=True)  # runs begin in one state
        design, shares = self._solver.solve_components(states, self._target, Preview(age=age))
        solved = np.ones(len(states), dtype=np.bool_)
        inputs = np.zeros((len(states), design.horizon, design.plant.n_u))
        slack, cost, cost_lower = np.zeros((3, len(states)))
        for part, part_answers in shares:
            answers = [share.answer for share in part_answers]
            optimal = np.array([answer.status is SolveStatus.OPTIMAL for answer in answers], dtype=np.bool_)
            for i in np.flatnonzero(optimal):
                inputs[i][:, part.inputs] = answers[i].inputs
            solved &= optimal
            slack += [answer.slack for answer in answers]
            cost += [answer.cost for answer in answers]
            cost_lower += [answer.cost_lower for answer in answers]
        inputs[~solved], cost[~solved], cost_lower[~solved] = 0.0, np.inf, -np.inf
        gap = np.full(len(states), np.inf)
        gap[solved] = list(map(relative_gap, cost[solved], cost_lower[solved]))
        index = index.reshape(-1)
        return Decisions(solved[index], inputs[index], slack[index], cost[index], gap[index])
