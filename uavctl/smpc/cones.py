"""Conic programs with constant matrices: only the linear term and the right side follow the parameters.

minimise ½ zᵀPz + q(p)ᵀz + c(p)  subject to  E z + F p + g in a product of cones, for Clarabel.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TypeVar

import clarabel
import numpy as np
from numpy.typing import NDArray
from scipy import sparse

Array = NDArray[np.float64]
Result = TypeVar("Result")

# The optimum is to be right to 1e-7. With a smaller gap the linear algebra may run out of digits before the end.
GAP_TOLERANCE = 1e-8
RESIDUAL_TOLERANCE = 1e-8


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


def join(*parts: Expression) -> Expression:
    """Expressions below one another."""
    return Expression(
        np.vstack([part.var for part in parts]),
        np.vstack([part.par for part in parts]),
        np.concatenate([part.const for part in parts]),
    )


@dataclass(eq=False)
class ProgramBuilder:
    """Collects rows and cost terms over `n_var` variables and `n_par` parameters."""

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
        """The variables of a slice."""
        rows = range(*where.indices(self.n_var))
        return Expression(np.eye(self.n_var)[where], np.zeros((len(rows), self.n_par)), np.zeros(len(rows)))

    def parameter(self, where: slice) -> Expression:
        """The parameters of a slice."""
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

    def build(self, max_iterations: int) -> ConicProgram:
        """Set the solver up."""
        squares = join(*self._squares) if self._squares else self.variable(slice(0, 0))
        p = self._p + 2.0 * squares.var.T @ squares.var
        groups: list[tuple[Expression, clarabel.Cone]] = []
        if self._zero:
            zero = join(*self._zero)
            groups.append((zero, clarabel.ZeroConeT(zero.const.size)))
        if self._nonneg:
            nonneg = join(*self._nonneg)
            groups.append((nonneg, clarabel.NonnegativeConeT(nonneg.const.size)))
        groups += self._cones
        rows = join(*(expression for expression, _ in groups))
        return ConicProgram(p, self._q, self._c, squares, rows, [cone for _, cone in groups], max_iterations)


BREAKDOWN = "Breakdown"  # the numbers overflow, or the solver panics


@dataclass(frozen=True, eq=False)
class Solution:
    """What the solver gave back.

    Attributes:
        status: Name of Clarabel's status, or BREAKDOWN.
        variables: (n,), not necessarily finite.
        cost: Primal objective with the constant.
        cost_lower: Dual objective with the constant.
        iterations: Interior-point iterations.
    """

    status: str
    variables: Array
    cost: float
    cost_lower: float
    iterations: int


def unless_panic(call: Callable[[], Result]) -> Result | None:
    """What `call` returns, None if Clarabel panics in it; everything else that is raised passes."""
    try:
        return call()
    except BaseException as error:
        # A panic of the solver's own code is no Exception, and its class cannot be imported.
        if type(error).__name__ != "PanicException":
            raise
        return None


class ConicProgram:
    """A program that is set up once and solved for many parameters."""

    def __init__(
        self,
        p: Array,
        q: Array,
        c: float,
        squares: Expression,
        rows: Expression,
        cones: list[clarabel.Cone],
        max_iterations: int,
    ) -> None:
        self._c = c
        self._q_par = 2.0 * squares.var.T @ squares.par
        self._q_const = q + 2.0 * squares.var.T @ squares.const
        self._square_par, self._square_const = squares.par, squares.const
        self._b_par, self._b_const = rows.par, rows.const
        self._p = sparse.csc_array(np.triu(p))
        self._a = sparse.csc_array(-rows.var)
        self._cones = cones
        self._max_iterations = max_iterations
        self._solver = self._set_up()

    def solve(self, parameters: Array) -> Solution:
        """Solve for `parameters` (n_p,); the same parameters give the same bits, whatever was solved before."""
        with np.errstate(over="ignore", invalid="ignore"):
            residual = self._square_par @ parameters + self._square_const
            constant = self._c + float(residual @ residual)
            q = self._q_const + self._q_par @ parameters
            b = self._b_const + self._b_par @ parameters
        if not (np.isfinite(constant) and np.all(np.isfinite(q)) and np.all(np.isfinite(b))):
            return self._breakdown()

        def run() -> clarabel.DefaultSolution:
            self._solver.update(q=q, b=b)
            return self._solver.solve()

        result = unless_panic(run)
        if result is None:
            self._solver = self._set_up()
            return self._breakdown()
        return Solution(
            status=str(result.status),
            variables=np.array(result.x),
            cost=result.obj_val + constant,
            cost_lower=result.obj_val_dual + constant,
            iterations=result.iterations,
        )

    def _breakdown(self) -> Solution:
        return Solution(BREAKDOWN, np.full(self._q_const.size, np.nan), np.nan, np.nan, 0)

    def _set_up(self) -> clarabel.DefaultSolver:
        settings = clarabel.DefaultSettings()
        settings.verbose = False
        settings.max_iter = self._max_iterations
        settings.max_threads = 1
        settings.direct_solve_method = "qdldl"
        # Both would change the shape of the data that update() replaces.
        settings.presolve_enable = False
        settings.chordal_decomposition_enable = False
        settings.tol_gap_abs = settings.tol_gap_rel = GAP_TOLERANCE
        settings.tol_feas = RESIDUAL_TOLERANCE
        # The first numbers fix the scaling, so they are the program's, not a question's.
        return clarabel.DefaultSolver(self._p, self._q_const, self._a, self._b_const, self._cones, settings)
