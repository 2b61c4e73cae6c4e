"""The frozen policy of one component: the gains of least covariance cost within half the distance between limits.

1. J_cov(θ) = ½ θ'Pθ + q'θ + c_0 is minimised once, in Clarabel, subject to the terminal condition and to
   κ_i ‖noise_i(θ)‖ <= ρ_i, with ρ_i half the distance between the two limits of row i.
2. Its multipliers give a cut J_cov(θ) >= D - μ'β(θ), with the back-offs β. It holds for every θ that keeps the terminal
   condition, for any error of the solver: the multipliers are projected on the dual cones first, and D includes the
   residual of stationarity (P ≻ 0; theory notes, C).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import clarabel
import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from uavctl.arrays import Array
from uavctl.smpc.hahn_stursberg.cones import catch_panic, conic_settings
from uavctl.smpc.hahn_stursberg.horizon import Affine, Horizon, terminal_bound
from uavctl.smpc.hahn_stursberg.mean import MeanProblem, Row

# A multiplier with a smaller share of the cost is the solver's rounding.
_MIN_WEIGHT = 1e-7

# Bound of the back-off of a row with one side, in back-offs of the cheapest gains.
_MAX_ONE_SIDED = 1e3

# Largest violation of the terminal condition, scaled to unit variances.
_MAX_VIOLATION = 1e-6

_ACCEPTED = ("Solved", "AlmostSolved", "InsufficientProgress")


@dataclass(frozen=True, eq=False)
class Policy:
    """Gains of one component, and the cut from the multipliers of their program."""

    theta: Array  # gains (n_θ,)
    backoff: Array  # its back-offs in the gain rows (n_l,)
    cost: float  # J_cov
    level: float  # D of the cut
    slope: Array  # μ (n_l,), >= 0
    terminal: Array  # multiplier Z⁺ of the terminal matrix (order, order), positive semi-definite


class CovarianceProblem:
    """Cost and constraints of the gains of one component, and the cut from multipliers."""

    def __init__(self, horizon: Horizon, gain_rows: Sequence[Row]) -> None:
        self.horizon = horizon  # the component's prediction
        self.kappa = np.array([row.kappa for row in gain_rows])  # κ of the gain rows (n_l,)
        self.scale = max(horizon.c_0, 1e-12)  # a typical cost
        self.noises = [_add_error_variance(row) for row in gain_rows]  # noise of each gain row, affine in θ
        self._values, self._vectors = np.linalg.eigh(horizon.p)
        # Back-offs (n_l,) of the gains that minimise J_cov alone
        self.cheapest_backoffs = self.backoffs(
            np.asarray(-np.linalg.lstsq(horizon.p, horizon.q, rcond=None)[0], dtype=np.float64)
        )
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
        """Return the back-offs (n_l,) of the gain rows under gains `theta`."""
        # β_i = κ_i |noise_i(θ)|
        backoffs: Array = self.kappa * np.array([np.linalg.norm(noise.evaluate(theta)) for noise in self.noises])
        return backoffs

    def cost(self, theta: Array) -> float:
        """Return J_cov = ½ θ'Pθ + q'θ + c_0 of gains `theta`."""
        return float(0.5 * theta @ self.horizon.p @ theta + self.horizon.q @ theta + self.horizon.c_0)

    def keeps_terminal(self, theta: Array) -> bool:
        """Return whether gains `theta` meet the terminal condition, up to rounding."""
        if self.equal.offset.size and np.abs(self.equal.evaluate(theta)).max() > _MAX_VIOLATION:
            return False
        if not self.order:
            return True
        matrix = unpack_triangle(self.triangle.evaluate(theta), self.order)
        return bool(np.linalg.eigvalsh(matrix)[0] >= -_MAX_VIOLATION)

    def make_policy(self, theta: Array, equal: Array, triangle: Array, heads: Array, tails: Sequence[Array]) -> Policy:
        """Make the policy of gains `theta`, with the cut of any multipliers (theory notes, C).

        Args:
            theta: Gains (n_θ,).
            equal: Multipliers of the terminal equalities.
            triangle: Multipliers of the terminal triangle, in its scaled form.
            heads: Multipliers of the back-offs (n_l,), in cost per standard deviation.
            tails: Multipliers of the entries below each head.
        """
        # g = q - E'λ - T'Z⁺ - Σ N_i't_i,  D = c_0 - e'λ - t'Z⁺ - Σ n_i't_i - ½ g'P⁻¹g,  μ_i = max(h_i, |t_i|) / κ_i
        backoff = self.backoffs(theta)
        level, residual = self.horizon.c_0, self.horizon.q - self.equal.matrix.T @ equal
        level -= float(self.equal.offset @ equal)
        terminal = np.zeros((0, 0))
        if self.order:
            positive = _positive_part(triangle, self.order)
            terminal = unpack_triangle(positive, self.order)
            residual = residual - self.triangle.matrix.T @ positive
            level -= float(self.triangle.offset @ positive)
        slope = np.zeros(self.kappa.size)
        for i, (noise, head, tail) in enumerate(zip(self.noises, heads, tails, strict=True)):
            if head * self.cheapest_backoffs[i] < _MIN_WEIGHT * self.scale * self.kappa[i]:
                continue
            slope[i] = max(float(head), float(np.linalg.norm(tail))) / self.kappa[i]
            residual = residual - noise.matrix.T @ tail
            level -= float(noise.offset @ tail)
        along = self._vectors.T @ residual
        # P is definite; smaller eigenvalues are rounding. A curvature that is too small only loosens the cut.
        level -= 0.5 * float(np.sum(along**2 / np.maximum(self._values, 1e-16 * self._values.max(initial=0.0))))
        return Policy(theta, backoff, self.cost(theta), level, slope, terminal)


def cheapest_policy(problem: MeanProblem, max_iterations: int) -> Policy | None:
    """Return the policy of least covariance cost whose back-offs take at most half the distance between two limits.

    Variables of the program: the gains θ, and the standard deviation s_i of each gain row. None without a solution.
    """
    gain_rows = problem.gain_rows
    cov = CovarianceProblem(problem.horizon, [problem.rows[i] for i in gain_rows])
    n_theta, n_l = problem.horizon.n_theta, gain_rows.size
    # κ_i s_i <= ρ_i
    half_distance = 0.5 * (problem.upper - problem.lower)[gain_rows]
    max_backoff = np.where(np.isfinite(half_distance), half_distance, _MAX_ONE_SIDED * cov.cheapest_backoffs)
    blocks = [_join_columns(np.zeros((n_l, n_theta)), np.diag(cov.kappa))]
    constants = [max_backoff]
    cones: list[clarabel.Cone] = [clarabel.NonnegativeConeT(n_l)]
    # The reduced terminal condition: equalities, and a positive semi-definite matrix
    for part, cone in (
        (cov.equal, clarabel.ZeroConeT(cov.equal.offset.size)),
        (cov.triangle, clarabel.PSDTriangleConeT(cov.order)),
    ):
        if part.offset.size:
            blocks.append(_join_columns(-part.matrix.toarray(), np.zeros((part.offset.size, n_l))))
            constants.append(part.offset)
            cones.append(cone)
    # s_i >= ‖noise_i(θ)‖
    for noise, unit in zip(cov.noises, np.eye(n_l), strict=True):
        size = noise.offset.size
        gains = np.vstack([np.zeros(n_theta), -noise.matrix.toarray()])
        blocks.append(_join_columns(gains, np.vstack([-unit, np.zeros((size, n_l))])))
        constants.append(np.append(0.0, noise.offset))
        cones.append(clarabel.SecondOrderConeT(size + 1))
    # ½ θ'Pθ + q'θ, in units of a typical cost
    quadratic = np.zeros((n_theta + n_l, n_theta + n_l))
    quadratic[:n_theta, :n_theta] = np.triu(problem.horizon.p)
    linear = np.append(problem.horizon.q, np.zeros(n_l))
    solver = clarabel.DefaultSolver(
        sparse.csc_array(quadratic / cov.scale),
        linear / cov.scale,
        sparse.csc_array(sparse.vstack(blocks)),
        np.concatenate(constants),
        cones,
        conic_settings(max_iterations, sum(constant.size for constant in constants)),
    )
    solution = catch_panic(solver.solve)
    if solution is None or str(solution.status) not in _ACCEPTED:
        return None
    theta = np.array(solution.x)[:n_theta]
    if not cov.keeps_terminal(theta):
        return None
    dual = np.array(solution.z)[n_l:] * cov.scale
    equal, triangle, rest = np.split(dual, np.cumsum([cov.equal.offset.size, cov.triangle.offset.size]))
    ends = np.cumsum([0, *(noise.offset.size + 1 for noise in cov.noises)]).tolist()
    multipliers = [rest[i:j] for i, j in pairwise(ends)]
    heads, tails = np.array([link[0] for link in multipliers]), [link[1:] for link in multipliers]
    return cov.make_policy(theta, equal, triangle, heads, tails)


def _join_columns(of_gains: Array, of_deviations: Array) -> sparse.csr_array:
    """Return rows over all variables of the program."""
    return sparse.csr_array(np.hstack([of_gains, of_deviations]))


def _add_error_variance(row: Row) -> Affine:
    """Return a gain row's noise with the standard deviation of the constant part as one more entry."""
    assert row.noise is not None
    has_gain = np.diff(row.noise.matrix.indptr) > 0
    constant = float(np.sqrt(np.sum(row.noise.offset[~has_gain] ** 2) + row.error_variance))
    matrix = sparse.vstack(
        [row.noise.matrix[np.flatnonzero(has_gain)], sparse.csr_array((1, row.noise.matrix.shape[1]))]
    )
    return Affine(np.append(row.noise.offset[has_gain], constant), sparse.csr_array(matrix))


def _svec_weight(order: int) -> Array:
    row, column = _triangle_indices(order)
    return np.where(row == column, 1.0, np.sqrt(2.0))


def _positive_part(svec: Array, order: int) -> Array:
    """Project a symmetric matrix, upper triangle by columns with off-diagonals times √2, on the semidefinite cone."""
    values, vectors = np.linalg.eigh(unpack_triangle(svec, order))
    positive = (vectors * np.maximum(values, 0.0)) @ vectors.T
    row, column = _triangle_indices(order)
    projected: Array = _svec_weight(order) * positive[row, column]
    return projected


def unpack_triangle(svec: Array, order: int) -> Array:
    """Return the symmetric matrix of such a triangle."""
    row, column = _triangle_indices(order)
    matrix = np.zeros((order, order))
    matrix[row, column] = matrix[column, row] = svec / _svec_weight(order)
    return matrix


def _triangle_indices(order: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return rows and columns of an upper triangle, column by column."""
    column = np.repeat(np.arange(order), np.arange(1, order + 1))
    row = np.concatenate([np.arange(j + 1) for j in range(order)])
    return row, column
