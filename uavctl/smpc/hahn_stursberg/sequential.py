"""Decisions of one component by sequential quadratic programming (SQP), each with a proof of optimality.

1. The joint problem of the mean q and the gains θ is min ½ q'Hq + f'q + c + J_cov(θ). Gain row i keeps a_i q ± β_i(θ)
   between its sides, with β_i = ‖d_i‖ and d_i = κ_i (n_i + N_i θ). The terminal condition is T(θ) ⪰ 0, affine in θ.
2. The start is the frozen policy. Each round solves a QP with the constraints linearised at the last gains and the
   Lagrangian's curvature there: Newton's method on the KKT conditions. Three to eight rounds reach rounding.
3. T(θ) keeps the rank that it has under the frozen policy: V'T(θ)V = 0, with its null space V at the last gains.
4. An answer is accepted if it keeps the constraints and its gap is small. The Lagrangian's value at its multipliers,
   projected on the dual cones, is a lower bound of the optimum, whatever the errors of 2 and 3 (theory notes, C).
5. State rows are hard here. Questions that need slack, and all that are not accepted, are for the exact program.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uavctl.arrays import Array
from uavctl.smpc.answer import Preview, relative_gap
from uavctl.smpc.hahn_stursberg.exact import PartAnswer
from uavctl.smpc.hahn_stursberg.mean import MAX_GAP, Index, MeanProblem, Question, RowKind, dot_rows, multiply_rows
from uavctl.smpc.hahn_stursberg.policy import CovarianceProblem, Policy, unpack_triangle
from uavctl.smpc.qp import EQUAL, SOFT, QuadraticProgram

# Rounds after which a question is given up.
_MAX_ROUNDS = 10

# Largest violation of an accepted answer: of a back-off, relative to it; of T(θ), which has unit variances.
_MAX_VIOLATION = 1e-9

# An eigenvalue of T(θ) below this counts as 0 under the frozen policy: Clarabel leaves about 1e-9.
_NULL_EIGENVALUE = 1e-6

# A back-off below this share of the cheapest gains' has no slope.
_LEAST_BACKOFF = 1e-6


@dataclass(frozen=True, eq=False)
class _Step:
    """Solutions of the QPs of M questions."""

    q: Array  # means (M, n_q)
    theta: Array  # gains (M, n_θ)
    plus: Array  # multipliers of the upper sides (M, m)
    minus: Array  # multipliers of the lower sides (M, m)
    signed: Array  # multipliers of β_i (M, n_l), negative where a QP takes -β_i for β_i
    root: Array  # F (M, order, rank), with FF' the multiplier of T(θ)


@dataclass(frozen=True, eq=False)
class _Model:
    """Constraints of M questions, linearised at their gains, and the Lagrangian's curvature there."""

    theta: Array  # the gains (M, n_θ)
    backoff: Array  # β_i (M, n_l)
    constant: Array  # β_i without the part of `slope` (M, n_l)
    slope: Array  # gradient of β_i (M, n_l, n_θ)
    least_eigenvalue: Array  # of T(θ) (M,)
    null_space: Array  # V (M, order, rank)
    null_constant: Array  # V'T_0 V (M, n_pairs)
    null_slope: Array  # V'T_k V (M, n_pairs, n_θ)
    curvature: Array  # (M, n_θ, n_θ)

    def select(self, index: NDArray[Any]) -> _Model:
        """Return some of the questions."""
        return _Model(**{field.name: getattr(self, field.name)[index] for field in fields(self)})


class SequentialProgram:
    """Solver of one component's joint problem, for many questions at once. Not for concurrent use."""

    def __init__(
        self,
        problem: MeanProblem,
        policy: Policy,
        covariance: CovarianceProblem,
        backoffs: Callable[[Array], tuple[Array, Array]],
    ) -> None:
        """Prepare the matrices that no question changes.

        Args:
            problem: The mean half of the component's problem.
            policy: The frozen policy.
            covariance: Cost and constraints of the gains.
            backoffs: Function from gains to the back-offs of the component's state and input rows.
        """
        self._problem, self._backoffs, horizon = problem, backoffs, problem.horizon
        self._gain_rows = problem.gain_rows
        n_l, n_theta, order = self._gain_rows.size, horizon.n_theta, covariance.order
        width = max(noise.offset.size for noise in covariance.noises)
        self._noise, self._offset = np.zeros((n_l, width, n_theta)), np.zeros((n_l, width))  # κ_i N_i, κ_i n_i
        for i, (noise, kappa) in enumerate(zip(covariance.noises, covariance.kappa, strict=True)):
            self._noise[i, : noise.offset.size] = kappa * noise.matrix.toarray()
            self._offset[i, : noise.offset.size] = kappa * noise.offset
        self._gram = (self._noise.swapaxes(1, 2) @ self._noise).reshape(n_l, -1)  # κ_i² N_i'N_i
        self._least = np.maximum(_LEAST_BACKOFF * covariance.cheapest_backoffs, np.finfo(np.float64).tiny)
        # T(θ) = T_0 + Σ_k θ_k T_k
        self._t_0 = unpack_triangle(covariance.triangle.offset, order)
        t = np.array([unpack_triangle(column, order) for column in covariance.triangle.matrix.toarray().T])
        self._t_rows = t.reshape(n_theta, -1)  # one T_k below the other
        self._t_beside = t.swapaxes(0, 1).reshape(order, -1)  # one T_k beside the other
        terminal = self._t_0 + (policy.theta @ self._t_rows).reshape(order, order)
        self._rank = int(np.sum(np.linalg.eigvalsh(terminal) < _NULL_EIGENVALUE))
        self._pair = np.triu_indices(self._rank)  # entries of V'TV
        values, vectors = np.linalg.eigh(policy.terminal)
        root = (vectors * np.sqrt(np.maximum(values, 0.0)))[:, order - self._rank :]
        self._start = self._expand(policy.theta[None], policy.slope[None], root[None])
        # Inverse Hessians of J_cov and of the mean's cost
        self._p_inverse, self._h_inverse = (np.linalg.inv(h).astype(np.float64) for h in (horizon.p, problem.h))
        # Variables q, θ. Rows: those of the mean, with +β_i in the gain rows; the gain rows with -β_i; the pairs
        (m, n_q), n_pairs = problem.a.shape, self._pair[0].size
        self._h = np.zeros((n_q + n_theta, n_q + n_theta))
        self._h[:n_q, :n_q], self._h[n_q:, n_q:] = problem.h, horizon.p
        self._a = np.zeros((m + n_l + n_pairs, n_q + n_theta))
        self._a[:m, :n_q], self._a[m : m + n_l, :n_q] = problem.a, problem.a[self._gain_rows]
        is_offset = np.array([row.kind is RowKind.OFFSET for row in problem.rows])
        self._is_offset, self._offset_price = is_offset, np.where(is_offset, problem.price, 0.0)
        # A multiplier at a state row's price means slack.
        self._max_weight = np.where(is_offset, np.inf, problem.price * (1.0 - 1e-9))
        sense = np.concatenate([np.where(is_offset, SOFT, 0), np.zeros(n_l), np.full(n_pairs, EQUAL)])
        price = np.concatenate([self._offset_price, np.zeros(n_l + n_pairs)])
        self._program = QuadraticProgram(self._h, self._a, sense.astype(np.int32), price, np.zeros(price.size))

    def solve(self, x: Array, target: Array, preview: Preview) -> list[PartAnswer | None]:
        """Solve for states (M, n_x) of the whole plant, with one target (n_x,) and preview.

        None where there is no proof.
        """
        part = self._problem.horizon.component
        question = self._problem.question(x[:, part.states], target[part.states], preview)
        answers: list[PartAnswer | None] = [None] * len(x)
        left = np.arange(len(x))
        model = self._start.select(np.zeros_like(left))
        for _ in range(_MAX_ROUNDS):
            solved, step = self._solve_round(question, model)
            left, question, model = left[solved], question.select(solved), model.select(solved)
            if not left.size:
                break
            predicted = np.abs(model.constant + multiply_rows(step.theta, model.slope.swapaxes(1, 2)))
            model = self._expand(step.theta, step.signed, step.root)
            # β_i(θ) - |β_i linearised| and the least eigenvalue of T(θ): both are quadratic in the step
            kept = np.all(model.backoff - predicted <= _MAX_VIOLATION * model.backoff, axis=1)
            kept &= model.least_eigenvalue >= -_MAX_VIOLATION
            for i, answer in zip(left[kept], self._prove(question, step, model, kept), strict=True):
                answers[i] = answer
            left, question, model = left[~kept], question.select(~kept), model.select(~kept)
        return answers

    def _expand(self, theta: Array, signed: Array, root: Array) -> _Model:
        """Expand the constraints at gains (M, n_θ), with multipliers `signed` and `root` as in `_Step`."""
        n, (n_l, width, n_theta), order, rank = len(theta), self._noise.shape, len(self._t_0), self._rank
        d = self._offset + multiply_rows(theta, self._noise.reshape(-1, n_theta).T).reshape(n, n_l, width)
        backoff = np.sqrt(dot_rows(d, d))
        divisor = np.maximum(backoff, self._least)
        # ∇β_i = κ_i N_i'd_i / ‖d_i‖
        direction = d / divisor[:, :, None]
        slope = (direction[:, :, None, :] @ self._noise)[:, :, 0, :]
        # Σ |μ_i| ∇²β_i = Σ |μ_i|/β_i (κ_i² N_i'N_i - ∇β_i ∇β_i')
        weight = np.abs(signed) / divisor
        curvature = multiply_rows(weight, self._gram).reshape(n, n_theta, n_theta)
        curvature -= (slope * weight[:, :, None]).swapaxes(1, 2) @ slope
        terminal = self._t_0 + multiply_rows(theta, self._t_rows).reshape(n, order, order)
        eigenvalues, vectors = np.linalg.eigh(terminal)
        null_space = vectors[:, :, :rank]
        # Curvature of V'TV: 2 tr(F'T_k U Λ⁻¹ U'T_l F), with Λ, U the other eigenvalues and their vectors
        scaled = vectors[:, :, rank:] / np.sqrt(np.maximum(eigenvalues[:, None, rank:], _NULL_EIGENVALUE))
        bent = self._multiply_terminal(root, scaled).reshape(n, n_theta, rank * (order - rank))
        curvature += 2.0 * bent @ bent.swapaxes(1, 2)
        null_slope = self._multiply_terminal(null_space, null_space)[:, :, self._pair[0], self._pair[1]]
        null_constant = null_space.swapaxes(1, 2) @ self._t_0 @ null_space
        return _Model(
            theta=theta,
            backoff=backoff,
            constant=dot_rows(direction, self._offset),
            slope=slope,
            least_eigenvalue=eigenvalues[:, 0],
            null_space=null_space,
            null_constant=null_constant[:, self._pair[0], self._pair[1]],
            null_slope=null_slope.swapaxes(1, 2),
            curvature=curvature,
        )

    def _multiply_terminal(self, left: Array, right: Array) -> Array:
        """Return L'T_k R (M, n_θ, l, r) of L (M, order, l) and R (M, order, r)."""
        (n, order, n_left), n_theta = left.shape, len(self._t_rows)
        half = (left.swapaxes(1, 2) @ self._t_beside).reshape(n, n_left * n_theta, order)
        product: Array = (half @ right).reshape(n, n_left, n_theta, right.shape[2]).swapaxes(1, 2)
        return product

    def _solve_round(self, question: Question, model: _Model) -> tuple[Index, _Step]:
        """Solve the QPs of one round; return the indices of those with a solution, and the solutions."""
        n, (m, n_q), gains = len(model.theta), self._problem.a.shape, self._gain_rows
        minus_rows, pair_rows = slice(m, m + gains.size), slice(m + gains.size, None)
        # ½ θ'Pθ + p'θ + ½ (θ - θ_0)'C(θ - θ_0) with the curvature C at the gains θ_0
        h, a = np.tile(self._h, (n, 1, 1)), np.tile(self._a, (n, 1, 1))
        h[:, n_q:, n_q:] += model.curvature
        f = np.hstack([question.f, self._problem.horizon.q - multiply_rows(model.theta, model.curvature)])
        a[:, gains, n_q:], a[:, minus_rows, n_q:] = model.slope, -model.slope
        a[:, pair_rows, n_q:] = model.null_slope
        # Both signs of the linearised β_i count, as ‖d_i‖ is at least its part along any direction.
        above, below = self._find_sides(question)
        upper, lower = (
            np.hstack([side, side[:, gains] + model.constant, -model.null_constant]) for side in (above, below)
        )
        upper[:, gains] -= model.constant
        lower[:, gains] -= model.constant
        solutions = [self._program.solve_with_matrices(*numbers) for numbers in zip(h, f, a, upper, lower, strict=True)]
        solved = np.array([i for i, solution in enumerate(solutions) if solution is not None], dtype=np.intp)
        z = np.array([solution[0] for solution in solutions if solution is not None]).reshape(-1, len(self._h))
        net = np.array([solution[1] for solution in solutions if solution is not None]).reshape(-1, len(self._a))
        plus, minus = np.maximum(net, 0.0), np.maximum(-net, 0.0)
        for multipliers in (plus, minus):
            multipliers[:, gains] += multipliers[:, minus_rows]
        # S, the multiplier of V'TV, projected on the positive semi-definite matrices: F = V S^½
        s = np.zeros((len(z), self._rank, self._rank))
        s[:, self._pair[0], self._pair[1]] = -0.5 * net[:, pair_rows]
        values, vectors = np.linalg.eigh(s + s.swapaxes(1, 2))
        return solved, _Step(
            q=z[:, :n_q],
            theta=z[:, n_q:],
            plus=plus[:, :m],
            minus=minus[:, :m],
            signed=net[:, gains] - net[:, minus_rows],
            root=model.null_space[solved] @ (vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]),
        )

    def _find_sides(self, question: Question) -> tuple[Array, Array]:
        """Return the upper and lower sides of a_i q (M, m), without the back-offs that gains move."""
        backoff = self._problem.backoff
        return question.upper - question.offset - backoff, question.lower - question.offset + backoff

    def _prove(
        self, question: Question, step: _Step, model: _Model, kept: NDArray[np.bool_]
    ) -> list[PartAnswer | None]:
        """Return the answers of the steps in `kept`; None where the gap is not small, or a state row needs slack."""
        problem, horizon, q, theta = self._problem, self._problem.horizon, step.q, step.theta
        plan = problem.read_plan(question, q)
        # cost = c + ½ q'Hq + f'q + price · |offset| + ½ θ'Pθ + p'θ + c_0
        cost = question.constant + dot_rows(q, multiply_rows(0.5 * q, problem.h) + question.f)
        cost += dot_rows(plan.off_target, self._offset_price[self._is_offset])
        cost += dot_rows(theta, multiply_rows(0.5 * theta, horizon.p) + horizon.q) + horizon.c_0
        # lower = c - ½ g'H⁻¹g - λ⁺ · above + λ⁻ · below + c_0 - ½ r'P⁻¹r + Σ μ_i constant_i - tr(T_0 FF')
        # with g = f + A'(λ⁺ - λ⁻),  r = p + Σ μ_i ∇β_i - (tr(T_k FF'))_k
        most = np.where(self._is_offset, self._offset_price, np.inf)
        plus, minus = np.minimum(step.plus, most), np.minimum(step.minus, most)
        g = question.f + multiply_rows(plus - minus, problem.a)
        square = (step.root @ step.root.swapaxes(1, 2)).reshape(len(q), -1)
        r = horizon.q + multiply_rows(step.signed, model.slope) - multiply_rows(square, self._t_rows.T)
        above, below = self._find_sides(question)
        cost_lower = question.constant + horizon.c_0 - 0.5 * dot_rows(multiply_rows(g, self._h_inverse), g)
        cost_lower += dot_rows(minus, below) - dot_rows(plus, above)
        cost_lower -= 0.5 * dot_rows(multiply_rows(r, self._p_inverse), r)
        cost_lower += dot_rows(step.signed, model.constant) - dot_rows(square, self._t_0.ravel())
        needs_no_slack = np.all(step.plus + step.minus <= self._max_weight, axis=1)
        return [
            PartAnswer.proven(plan, i, self._backoffs(theta[i]), cost[i], cost_lower[i])
            if needs_no_slack[i] and relative_gap(cost[i], cost_lower[i]) <= MAX_GAP
            else None
            for i in np.flatnonzero(kept).tolist()
        ]


def make_sequential_program(
    problem: MeanProblem, policy: Policy, backoffs: Callable[[Array], tuple[Array, Array]]
) -> SequentialProgram | None:
    """Prepare the program of a component; None if its terminal condition is not of the form T(θ) ⪰ 0 alone."""
    covariance = CovarianceProblem(problem.horizon, [problem.rows[i] for i in problem.gain_rows])
    if not covariance.noises or not covariance.order or covariance.equal.offset.size:
        return None
    return SequentialProgram(problem, policy, covariance, backoffs)
