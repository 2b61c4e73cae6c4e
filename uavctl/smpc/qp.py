"""Quadratic programs in DAQP.

1. min ½ z'Hz + f'z, lower <= A z <= upper, with soft rows at a linear and a quadratic price.
2. DAQP starts from the state of its rows, and keeps that of the last solve if an update does not name one. Here each
   update names it, so the same question gives the same bits after any other question.
"""

from __future__ import annotations

from math import isfinite

import daqp
import numpy as np
from numpy.typing import NDArray

from uavctl.arrays import Array

Sense = NDArray[np.int32]

OPEN = 1e30  # DAQP's infinity
SOFT, EQUAL = 8, 5
ACTIVE, BELOW = 1, 3  # a row of the first working set, at its upper or lower side; a soft one is relaxed at first
KEEPS_LIMIT = 32  # added to a soft row of the first working set that is kept at first
TOLERANCE = 1e-10  # of feasibility, primal and dual: rounding of rows of size 1
_MAX_ITERATIONS = 2000
# Least quadratic price of a soft row, as a share of the largest curvature: without, DAQP cycles between equalities.
LEAST_CURVE = 1e-8
_OPTIMAL = (1, 2)  # 2: soft rows were left


class QuadraticProgram:
    """A program with constant matrices; f and the sides change with each question. Not for concurrent use.

    Args:
        h: H (n, n), positive definite.
        a: A (m, n).
        sense: DAQP's state of each row (m,): 0, SOFT, EQUAL.
        price: Linear price of a soft row (m,).
        curve: Quadratic price (m,): leaving by s costs price·s + curve·s².
        tolerance: Of feasibility, primal and dual.
        max_iterations: Iterations after which a solve stops.
        linear: Whether questions have an f. Without, f is zero and an update of the sides is cheaper.
    """

    def __init__(
        self,
        h: Array,
        a: Array,
        sense: Sense,
        price: Array,
        curve: Array,
        tolerance: float = TOLERANCE,
        max_iterations: int = _MAX_ITERATIONS,
        linear: bool = True,
    ) -> None:
        self.sense = sense  # DAQP's state of each row (m,)
        self.iterations = 0  # of the last solve
        model = daqp.Model()
        sides = np.full(a.shape[0], OPEN)
        f = np.zeros(h.shape[0]) if linear else None
        model.setup(h, f, a, sides, -sides, sense)  # the soft rows fix the workspace
        model.settings = {"primal_tol": tolerance, "dual_tol": tolerance, "eps_prox": 0.0, "iter_limit": max_iterations}
        if len(sides):
            rho = 0.5 / np.maximum(curve, LEAST_CURVE * np.abs(np.diagonal(h)).max(initial=1.0))
            model.soft_weights(rho_l=rho, rho_u=rho, w_l=price, w_u=price)
        self._update, self._solve = model.update, model.solve

    def solve(self, f: Array, upper: Array, lower: Array) -> tuple[Array, Array] | None:
        """Return minimiser (n,) and multipliers (m,), positive at an upper side; None without a finite optimum.

        The sides may be infinite; f and the sides that are not must be finite.
        """
        if self._update(f=f, bupper=upper, blower=lower, sense=self.sense) < 0:
            return None
        return self._run()

    def solve_sides(
        self, upper: Array, lower: Array, working_set: Sense | None = None, reuse_rows: bool = False
    ) -> Array | None:
        """Return the minimiser (n,) for the last f, zero without one; None without an optimum.

        Args:
            upper: Upper sides (m,).
            lower: Lower sides (m,).
            working_set: `sense` with ACTIVE or BELOW (and KEEPS_LIMIT) added to the rows to begin with; None: none.
            reuse_rows: Start from the active rows of the last solve, and their factors. The last bits of the result
                depend on that solve: only for the same question.
        """
        sense = self.sense if working_set is None else working_set
        if self._update(bupper=upper, blower=lower, sense=None if reuse_rows else sense) < 0:
            return None
        solution = self._run()
        return None if solution is None else solution[0]

    def solve_with_matrices(
        self, h: Array, f: Array, a: Array, upper: Array, lower: Array
    ) -> tuple[Array, Array] | None:
        """Solve with new matrices of the same sizes."""
        if self._update(H=h, f=f, A=a, bupper=upper, blower=lower, sense=self.sense) < 0:
            return None
        return self._run()

    def _run(self) -> tuple[Array, Array] | None:
        """Run DAQP and return minimiser and multipliers; None without a finite optimum."""
        z, value, flag, info = self._solve()
        self.iterations = info["iterations"]
        # DAQP returns NaN as solved. An overflow of the square counts as not finite too; vdot does not warn of it.
        if flag not in _OPTIMAL or not isfinite(value) or not isfinite(np.vdot(z, z)):
            return None
        return z, info["lam"]
