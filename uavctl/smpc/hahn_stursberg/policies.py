"""The covariance half of one component's decision problem.

φ(ρ) = min J_cov(M) over the policies M with back-offs at most ρ is convex and does not know the state. Each solve gives
a policy, and from its multipliers a cut φ(ρ) >= D - μᵀρ that holds for every ρ, whatever the solver's error: the
multipliers are projected on the dual cones first, and what then is left of stationarity is paid for (P ≻ 0).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import clarabel
import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from uavctl.smpc.hahn_stursberg.cones import conic_settings, unless_panic
from uavctl.smpc.hahn_stursberg.horizon import Affine, Horizon, terminal_bound
from uavctl.smpc.hahn_stursberg.mean import MeanProblem, Question, Row

Array = NDArray[np.float64]

# A multiplier that weighs less than this share of the cost is the solver's rounding.
_NOTHING = 1e-7

# Where a row has one side only, the cheapest policy's back-off there is bounded by this many usual ones.
_FAR = 1e3

# Amount by which a policy may miss the terminal condition, scaled to unit variances.
_KEPT = 1e-6

# Distance of a question on the infeasible side of another's proof, relative to that one, to count as infeasible too.
_BEYOND = 1e-3

_ENDED_WELL = ("Solved", "AlmostSolved", "InsufficientProgress")


@dataclass(frozen=True, eq=False)
class Policy:
    """One policy, and the cut that its multipliers give."""

    theta: Array  # gains (n_θ,)
    backoff: Array  # its back-off in every link row (n_l,)
    cost: float  # J_cov
    level: float  # D of the cut
    slope: Array  # μ (n_l,), >= 0


class Covariance:
    """Cost and constraints of the gains of one component, and the cut that multipliers give."""

    def __init__(self, horizon: Horizon, links: Sequence[Row]) -> None:
        self.horizon = horizon  # the component's prediction
        self.kappa = np.array([row.kappa for row in links])  # κ of the link rows (n_l,)
        self.scale = max(horizon.c_0, 1e-12)  # a typical cost
        self.noises = [_with_unseen(row) for row in links]  # noise of each link row, affine in θ
        self._values, self._vectors = np.linalg.eigh(horizon.p)
        # Back-offs (n_l,) of the gains that minimise J_cov alone
        self.usual = self.backoffs(np.asarray(-np.linalg.lstsq(horizon.p, horizon.q, rcond=None)[0], dtype=np.float64))
        reduced = terminal_bound(horizon)
        self.equal = reduced.fixed  # equalities of the reduced terminal condition
        self.order = reduced.rows + reduced.columns if reduced.rows and reduced.columns else 0  # order of its matrix
        # Its upper triangle in the solver's scaling
        self.triangle = Affine(np.zeros(0), sparse.csr_array((0, horizon.n_theta)))
        if self.order:
            triangle, weight = reduced.triangle(), _svec_weight(self.order)
            weighted = sparse.csr_array(sparse.diags_array(weight) @ triangle.matrix)
            self.triangle = Affine(weight * triangle.offset, weighted)

    def backoffs(self, theta: Array) -> Array:
        """Back-offs (n_l,) of the link rows under gains `theta`."""
        backoffs: Array = self.kappa * np.array([np.linalg.norm(noise.at(theta)) for noise in self.noises])
        return backoffs

    def cost(self, theta: Array) -> float:
        """J_cov of gains `theta`."""
        return float(0.5 * theta @ self.horizon.p @ theta + self.horizon.q @ theta + self.horizon.c_0)

    def holds(self, theta: Array) -> bool:
        """Whether gains `theta` meet the terminal condition, as far as rounding lets one tell."""
        if self.equal.offset.size and np.abs(self.equal.at(theta)).max() > _KEPT:
            return False
        if not self.order:
            return True
        matrix = _matrix(self.triangle.at(theta), self.order)
        return bool(np.linalg.eigvalsh(matrix)[0] >= -_KEPT)

    def policy(self, theta: Array, equal: Array, triangle: Array, heads: Array, tails: Sequence[Array]) -> Policy:
        """The policy of gains `theta`, with the cut of any multipliers (theory notes, C).

        Args:
            theta: Gains (n_θ,).
            triangle: Of the terminal triangle, in its scaled form.
            heads: Of the back-offs (n_l,), in units of cost per standard deviation.
            tails: Of the entries below each head.
        """
        backoff = self.backoffs(theta)
        level, residual = self.horizon.c_0, self.horizon.q - self.equal.matrix.T @ equal
        level -= float(self.equal.offset @ equal)
        if self.order:
            positive = _positive_part(triangle, self.order)
            residual = residual - self.triangle.matrix.T @ positive
            level -= float(self.triangle.offset @ positive)
        slope = np.zeros(self.kappa.size)
        for i, (noise, head, tail) in enumerate(zip(self.noises, heads, tails, strict=True)):
            if head * self.usual[i] < _NOTHING * self.scale * self.kappa[i]:
                continue
            slope[i] = max(float(head), float(np.linalg.norm(tail))) / self.kappa[i]
            residual = residual - noise.matrix.T @ tail
            level -= float(noise.offset @ tail)
        along = self._vectors.T @ residual
        # P is definite: what is not, is rounding. A curvature taken too small only loosens the cut.
        level -= 0.5 * float(np.sum(along**2 / np.maximum(self._values, 1e-16 * self._values.max(initial=0.0))))
        return Policy(theta, backoff, self.cost(theta), level, slope)


class PolicyProgram:
    """The joint decision problem of one component in the coordinates of its mean QP, for the making of policies.

    Variables: q, θ, the links' standard deviations, the slacks of the state rows, the offsets.
    """

    def __init__(self, problem: MeanProblem, max_iterations: int) -> None:
        self.problem = problem
        rows, links = problem.rows, problem.links
        self.covariance = Covariance(problem.horizon, [rows[i] for i in links])
        cov, horizon = self.covariance, problem.horizon
        self._soft = np.flatnonzero(np.isfinite(problem.price))
        n_q, n_l, n_s = problem.h.shape[0], links.size, self._soft.size
        ends = np.cumsum([0, n_q, horizon.n_theta, n_l, n_s])
        self._q, self._theta, self._t, self._s = (slice(int(i), int(j)) for i, j in pairwise(ends))
        size = int(ends[-1])
        p = np.zeros((size, size))
        p[self._q, self._q] = problem.h
        p[self._theta, self._theta] = horizon.p
        p[self._s, self._s] = 2.0 * np.diag(problem.curve[self._soft])
        self._linear = np.zeros(size)
        self._linear[self._theta] = horizon.q
        self._linear[self._s] = problem.price[self._soft]
        value = np.zeros((len(rows), size))
        value[:, self._q] = problem.a
        give = np.zeros((len(rows), size))
        give[links, range(self._t.start, self._t.stop)] = cov.kappa
        give[self._soft, range(self._s.start, self._s.stop)] = -1.0
        self._above = np.flatnonzero(np.isfinite(problem.upper))
        self._below = np.flatnonzero(np.isfinite(problem.lower))
        slack = np.zeros((n_s, size))
        slack[:, self._s] = np.eye(n_s)
        linear = np.vstack([(value + give)[self._above], (give - value)[self._below], -slack])
        blocks = [sparse.csr_array(linear)]
        cones: list[clarabel.Cone] = [clarabel.NonnegativeConeT(linear.shape[0])]
        constants = [np.zeros(linear.shape[0])]
        for part, cone in (
            (cov.equal, clarabel.ZeroConeT(cov.equal.offset.size)),
            (cov.triangle, clarabel.PSDTriangleConeT(cov.order)),
        ):
            if part.offset.size:
                blocks.append(-self._of_theta(part.matrix, size))
                constants.append(part.offset)
                cones.append(cone)
        for i, noise in enumerate(cov.noises):
            head = sparse.csr_array(([-1.0], ([0], [self._t.start + i])), shape=(1, size))
            blocks += [head, -self._of_theta(noise.matrix, size)]
            constants += [np.zeros(1), noise.offset]
            cones.append(clarabel.SecondOrderConeT(noise.offset.size + 1))
        self._p = sparse.csc_array(np.triu(p) / cov.scale)
        self._a = sparse.csc_array(sparse.vstack(blocks))
        self._constant = np.concatenate(constants)
        self._linear_rows = linear.shape[0]
        self._cones = cones
        self._settings = conic_settings(max_iterations, self._a.shape[0])
        self._proofs: list[Array] = []  # z with Aᵀz = 0 in the dual cone: bᵀz >= 0 wherever there is a policy

    def _of_theta(self, matrix: sparse.csr_array, size: int) -> sparse.csr_array:
        left = sparse.csr_array((matrix.shape[0], self._theta.start))
        right = sparse.csr_array((matrix.shape[0], size - self._theta.stop))
        return sparse.csr_array(sparse.hstack([left, matrix, right]))

    def cheapest(self) -> Policy | None:
        """The policy of least covariance cost whose back-offs take at most half the room between a row's two sides."""
        problem, links = self.problem, self.problem.links
        # With f = 0 the mean stays at q = 0: only the links' back-offs are bounded, by the room that a row leaves.
        room = 0.5 * (problem.upper - problem.lower)
        upper = np.ones(len(problem.rows))
        upper[links] = np.where(np.isfinite(room[links]), room[links], _FAR * self.covariance.usual)
        return self._solve(np.zeros(problem.h.shape[0]), upper, -upper)

    def best(self, question: Question) -> Policy | None:
        """The optimal policy of one question; None without an optimum.

        What proved that a question has none is kept: it proves the same of most others, without solving anything.
        """
        backoff = self.problem.backoff
        upper = question.upper - question.offset - backoff
        return self._solve(question.f, upper, question.lower - question.offset + backoff)

    def _solve(self, f: Array, upper: Array, lower: Array) -> Policy | None:
        cov = self.covariance
        linear = self._linear.copy()
        linear[self._q] = f
        right = self._constant.copy()
        above = self._above.size
        right[:above] = upper[self._above]
        right[above : above + self._below.size] = -lower[self._below]
        if any(proof @ right < -_BEYOND for proof in self._proofs):
            return None
        solver = clarabel.DefaultSolver(self._p, linear / cov.scale, self._a, right, self._cones, self._settings)
        solution = unless_panic(solver.solve)
        if solution is None or str(solution.status) not in _ENDED_WELL:
            if solution is not None and str(solution.status) == "PrimalInfeasible":
                proof = np.array(solution.z)
                self._proofs.append(proof / -(proof @ right))
            return None
        dual = np.array(solution.z)[self._linear_rows :] * cov.scale
        equal, triangle, rest = np.split(dual, np.cumsum([cov.equal.offset.size, cov.triangle.offset.size]))
        ends = np.cumsum([0, *(noise.offset.size + 1 for noise in cov.noises)]).tolist()
        links = [rest[i:j] for i, j in pairwise(ends)]
        theta = np.array(solution.x)[self._theta]
        heads = np.array([link[0] for link in links])
        if not cov.holds(theta):
            return None
        return cov.policy(theta, equal, triangle, heads, [link[1:] for link in links])


def _with_unseen(row: Row) -> Affine:
    """A link row's noise with the variance that no feedback sees as one more entry; empty rows left out."""
    assert row.noise is not None
    moved = np.diff(row.noise.matrix.indptr) > 0
    constant = float(np.sqrt(np.sum(row.noise.offset[~moved] ** 2) + row.unseen))
    matrix = sparse.vstack([row.noise.matrix[np.flatnonzero(moved)], sparse.csr_array((1, row.noise.matrix.shape[1]))])
    return Affine(np.append(row.noise.offset[moved], constant), sparse.csr_array(matrix))


def _svec_weight(order: int) -> Array:
    row, column = _places(order)
    return np.where(row == column, 1.0, np.sqrt(2.0))


def _positive_part(svec: Array, order: int) -> Array:
    """Project a symmetric matrix, upper triangle column by column with off-diagonals times √2, on the semidefinite."""
    values, vectors = np.linalg.eigh(_matrix(svec, order))
    positive = (vectors * np.maximum(values, 0.0)) @ vectors.T
    row, column = _places(order)
    projected: Array = _svec_weight(order) * positive[row, column]
    return projected


def _matrix(svec: Array, order: int) -> Array:
    """The symmetric matrix of such a triangle."""
    row, column = _places(order)
    matrix = np.zeros((order, order))
    matrix[row, column] = matrix[column, row] = svec / _svec_weight(order)
    return matrix


def _places(order: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows and columns of an upper triangle, column by column."""
    column = np.repeat(np.arange(order), np.arange(1, order + 1))
    row = np.concatenate([np.arange(j + 1) for j in range(order)])
    return row, column
