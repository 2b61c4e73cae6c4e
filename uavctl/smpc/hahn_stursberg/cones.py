"""Conic programs for Clarabel with constant matrices; the linear term and the right side depend on parameters.

1. min ½ z'Pz + q(p)'z + c(p)  subject to  E z + F p + g in a product of cones.
2. `ProgramBuilder` collects rows and cost terms as expressions affine in variables z and parameters p.
3. `ConicProgram` is set up once. Clarabel gets the variables in units of their natural size, relative to an origin that
   depends on the parameters, the cost in units of its size, and rows with a largest entry of 1. So its tolerances mean
   the same in any units, and an unusual question still has an answer in small numbers.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TypeVar

import clarabel
import numpy as np
from scipy import sparse

from uavctl.arrays import Array
from uavctl.smpc.sets import Scale

# For an optimum accurate to 1e-7. With a smaller gap the linear algebra may lose all digits before the end.
GAP_TOLERANCE = 1e-8
RESIDUAL_TOLERANCE = 1e-8

# Rows from which a factorisation by blocks is faster: at H = 40 it takes a third of the time.
_MANY_ROWS = 900


def conic_settings(max_iterations: int, rows: int) -> clarabel.DefaultSettings:
    """Return settings for a program with `rows` rows: one thread, and no change of the problem's shape."""
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.max_iter = max_iterations
    settings.max_threads = 1
    settings.direct_solve_method = "faer" if rows > _MANY_ROWS else "qdldl"
    # Both would change the shape of the data in update(), and of the multipliers.
    settings.presolve_enable = False
    settings.chordal_decomposition_enable = False
    settings.tol_gap_abs = settings.tol_gap_rel = GAP_TOLERANCE
    settings.tol_feas = RESIDUAL_TOLERANCE
    return settings


Result = TypeVar("Result")

# A linear cost above _MAX_SLOPE, as far outside the limits, looks like an unbounded problem: it becomes _SCALED_SLOPE.
_MAX_SLOPE = 1e8
_SCALED_SLOPE = 1e3

# Larger origins, in natural sizes, leave less than half of the digits to the answer.
_MAX_ORIGIN = 1e8


@dataclass(frozen=True, eq=False)
class Expression:
    """var z + par p + const: (m,) numbers affine in variables z (n,) and parameters p (n_p,)."""

    var: Array
    par: Array
    const: Array

    def __add__(self, other: Expression) -> Expression:
        return Expression(self.var + other.var, self.par + other.par, self.const + other.const)

    def __sub__(self, other: Expression) -> Expression:
        return self + (-1.0) * other

    def __rmul__(self, factor: float) -> Expression:
        return Expression(factor * self.var, factor * self.par, factor * self.const)

    def __rmatmul__(self, matrix: Array) -> Expression:
        return Expression(matrix @ self.var, matrix @ self.par, matrix @ self.const)

    __array_ufunc__ = None  # matrix @ expression is ours, not numpy's

    def plus(self, constant: Array | float) -> Expression:
        """Add a constant."""
        return Expression(self.var, self.par, self.const + constant)


def join_rows(*parts: Expression) -> Expression:
    """Stack expressions."""
    return Expression(
        np.vstack([part.var for part in parts]),
        np.vstack([part.par for part in parts]),
        np.concatenate([part.const for part in parts]),
    )


Origin = Callable[[Array], Array]


@dataclass(eq=False)
class ProgramBuilder:
    """Builder of a program with `n_var` variables and `n_par` parameters, from rows and cost terms."""

    n_var: int
    n_par: int
    _nonneg: list[Expression] = field(default_factory=list)
    _zero: list[Expression] = field(default_factory=list)
    _cones: list[tuple[Expression, clarabel.Cone]] = field(default_factory=list)
    _squares: list[Expression] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._p = np.zeros((self.n_var, self.n_var))
        self._q = np.zeros(self.n_var)
        self._c = 0.0

    def variable(self, where: slice) -> Expression:
        """Return the variables of a slice as an expression."""
        rows = range(*where.indices(self.n_var))
        return Expression(np.eye(self.n_var)[where], np.zeros((len(rows), self.n_par)), np.zeros(len(rows)))

    def parameter(self, where: slice) -> Expression:
        """Return the parameters of a slice as an expression."""
        rows = range(*where.indices(self.n_par))
        return Expression(np.zeros((len(rows), self.n_var)), np.eye(self.n_par)[where], np.zeros(len(rows)))

    def nonnegative(self, expression: Expression) -> None:
        """Constrain every entry to be >= 0."""
        self._nonneg.append(expression)

    def zero(self, expression: Expression) -> None:
        """Constrain every entry to be 0."""
        self._zero.append(expression)

    def second_order(self, expression: Expression) -> None:
        """Constrain entry 0 to be at least the norm of the others."""
        self._cones.append((expression, clarabel.SecondOrderConeT(expression.const.size)))

    def semidefinite(self, triangle: Expression, size: int) -> None:
        """Constrain a symmetric matrix, given as upper triangle column by column (off-diagonals unscaled)."""
        column = np.repeat(np.arange(size), np.arange(1, size + 1))
        row = np.concatenate([np.arange(j + 1) for j in range(size)])
        scale = np.where(row == column, 1.0, np.sqrt(2.0))
        scaled = Expression(scale[:, None] * triangle.var, scale[:, None] * triangle.par, scale * triangle.const)
        self._cones.append((scaled, clarabel.PSDTriangleConeT(size)))

    def square(self, expression: Expression) -> None:
        """Add the sum of squares of the entries to the cost."""
        self._squares.append(expression)

    def quadratic(self, where: slice, p: Array, q: Array, constant: float = 0.0) -> None:
        """Add ½ zᵀpz + qᵀz + constant in the variables of a slice."""
        self._p[where, where] += p
        self._q[where] += q
        self._c += constant

    def build(self, max_iterations: int, scale: Scale | None = None, origin: Origin | None = None) -> ConicProgram:
        """Set the solver up.

        Args:
            max_iterations: Bound of the interior-point method.
            scale: Natural sizes; None: 1.
            origin: Point (n_var,) near the solution for given parameters (n_par,); None: 0.
        """
        scale = Scale(np.ones(self.n_var), 1.0) if scale is None else scale
        d, root = scale.variables, np.sqrt(scale.cost)
        squares = join_rows(*self._squares) if self._squares else self.variable(slice(0, 0))
        squares = Expression(squares.var * d / root, squares.par / root, squares.const / root)
        groups: list[tuple[Expression, clarabel.Cone]] = []
        if self._zero:
            zero = _scale_rows(join_rows(*self._zero), d)
            groups.append((zero, clarabel.ZeroConeT(zero.const.size)))
        if self._nonneg:
            nonneg = _scale_rows(join_rows(*self._nonneg), d)
            groups.append((nonneg, clarabel.NonnegativeConeT(nonneg.const.size)))
        groups += [(_scale_block(expression, d), cone) for expression, cone in self._cones]
        return ConicProgram(
            p=self._p * np.outer(d, d) / scale.cost + 2.0 * squares.var.T @ squares.var,
            q=self._q * d / scale.cost,
            c=self._c / scale.cost,
            squares=squares,
            rows=join_rows(*(expression for expression, _ in groups)),
            cones=[cone for _, cone in groups],
            max_iterations=max_iterations,
            scale=scale,
            origin=origin,
        )


def _scale_rows(rows: Expression, sizes: Array) -> Expression:
    """Scale rows to variables in units of `sizes`, each row to a largest coefficient of 1."""
    var = rows.var * sizes
    largest = np.abs(var).max(axis=1, initial=0.0)
    factor = 1.0 / np.where(largest > 0.0, largest, 1.0)
    return Expression(factor[:, None] * var, factor[:, None] * rows.par, factor * rows.const)


def _scale_block(block: Expression, sizes: Array) -> Expression:
    """Scale the rows of a cone alike, with one factor for all of them."""
    var = block.var * sizes
    largest = float(np.abs(var).max(initial=0.0))
    factor = 1.0 / largest if largest > 0.0 else 1.0
    return Expression(factor * var, factor * block.par, factor * block.const)


BREAKDOWN = "Breakdown"  # the numbers overflow, or the solver panics


@dataclass(frozen=True, eq=False)
class Solution:
    """Result of the solver."""

    status: str  # name of Clarabel's status, or BREAKDOWN
    variables: Array  # (n,), not necessarily finite
    cost: float  # primal objective with the constant
    cost_lower: float  # dual objective with the constant
    iterations: int  # interior-point iterations


def catch_panic(call: Callable[[], Result]) -> Result | None:
    """Return the result of `call`, None if Clarabel panics; other exceptions pass."""
    try:
        return call()
    except BaseException as error:
        # A panic of the solver's Rust code is no Exception, and its class cannot be imported.
        if type(error).__name__ != "PanicException":
            raise
        return None


class ConicProgram:
    """Program that is set up once and solved for many parameters."""

    def __init__(
        self,
        *,
        p: Array,
        q: Array,
        c: float,
        squares: Expression,
        rows: Expression,
        cones: list[clarabel.Cone],
        max_iterations: int,
        scale: Scale,
        origin: Origin | None,
    ) -> None:
        """All numbers are in units of `scale`, parameters are in their own."""
        self._scale, self._origin = scale, origin
        self._c = c
        self._q_par = 2.0 * squares.var.T @ squares.par
        self._q_const = q + 2.0 * squares.var.T @ squares.const
        self._square_par, self._square_const = squares.par, squares.const
        self._b_par, self._b_const = rows.par, rows.const
        self._p = sparse.csc_array(p)
        self._a = sparse.csc_array(-rows.var)
        self._cones = cones
        self._max_iterations = max_iterations
        # The first numbers fix the solver's scaling: they must not depend on a question.
        self._solver = self._set_up(self._q_const, self._b_const)

    def solve(self, parameters: Array) -> Solution:
        """Solve for `parameters` (n_p,); the same parameters give the same bits, after any other solves."""
        with np.errstate(over="ignore", invalid="ignore"):
            # c = c_0 + |r(p)|²,  q(p) = q_0 + Q p,  b(p) = b_0 + F p
            residual = self._square_par @ parameters + self._square_const
            constant = self._c + float(residual @ residual)
            q = self._q_const + self._q_par @ parameters
            b = self._b_const + self._b_par @ parameters
            origin = np.zeros(q.size)
            if self._origin is not None:
                origin = self._scale.compute_excess(self._origin(parameters))
                # z = z_0 + δ:  c += ½ z_0'P z_0 + q'z_0,  q += P z_0,  b -= A z_0
                slope = self._p @ origin
                constant += float((q + 0.5 * slope) @ origin)
                q, b = q + slope, b - self._a @ origin
        is_finite = np.isfinite(constant) and np.all(np.isfinite(q)) and np.all(np.isfinite(b))
        if not is_finite or np.abs(origin).max(initial=0.0) > _MAX_ORIGIN:
            return self._make_breakdown()
        max_slope = float(np.abs(q).max(initial=0.0))
        cost = max_slope / _SCALED_SLOPE if max_slope > _MAX_SLOPE else 1.0

        def run() -> clarabel.DefaultSolution:
            if cost != 1.0:
                return self._set_up(q / cost, b, cost).solve()
            self._solver.update(q=q, b=b)
            return self._solver.solve()

        result = catch_panic(run)
        if result is None:
            self._solver = self._set_up(self._q_const, self._b_const)
            return self._make_breakdown()
        return Solution(
            status=str(result.status),
            variables=(np.array(result.x) + origin) * self._scale.variables,
            cost=(result.obj_val * cost + constant) * self._scale.cost,
            cost_lower=(result.obj_val_dual * cost + constant) * self._scale.cost,
            iterations=result.iterations,
        )

    def _make_breakdown(self) -> Solution:
        return Solution(BREAKDOWN, np.full(self._q_const.size, np.nan), np.nan, np.nan, 0)

    def _set_up(self, q: Array, b: Array, cost: float = 1.0) -> clarabel.DefaultSolver:
        settings = conic_settings(self._max_iterations, b.size)
        # Where the terminal condition has a thin interior, Clarabel's defaults lose all digits before the end.
        settings.static_regularization_constant = 1e-9
        settings.max_step_fraction = 0.97
        p = sparse.triu(self._p / cost, format="csc")
        return clarabel.DefaultSolver(p, q, self._a, b, self._cones, settings)
