"""Quadratic programs in DAQP: min ½ zᵀHz + fᵀz, lower <= A z <= upper, soft rows at a linear and a quadratic price.

DAQP starts from the state of its rows, and an update that does not name them keeps those of the last solve: here they
are named every time, so that the same question gives the same bits whatever was asked before.
"""

from __future__ import annotations

from math import isfinite

import daqp
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Sense = NDArray[np.int32]

OPEN = 1e30  # DAQP's infinity
SOFT, EQUAL = 8, 5
ACTIVE, BELOW = 1, 3  # a row to begin with, at its upper side or at its lower one; a soft one gives way at first
KEEPS = 32  # added to a soft row to begin with that is kept at first
TOLERANCE = 1e-10
_MOST_ITERATIONS = 2000
# Share of the largest curvature that a soft row has at least: without any, DAQP loses its way between equalities.
LEAST_CURVE = 1e-8
_OPTIMAL = (1, 2)  # 2: soft rows were left


class QuadraticProgram:
    """A program whose matrices are given once; f and the sides follow each question. Not for concurrent use.

    Attributes:
        sense: DAQP's state of each row (m,).
        iterations: Of the last solve.

    Args:
        h: H (n, n), positive definite.
        a: A (m, n).
        sense: DAQP's state of each row (m,): 0, SOFT, EQUAL.
        price: Linear price of a soft row (m,).
        curve: Quadratic price (m,): leaving by s costs price·s + curve·s².
        tolerance: Of feasibility, primal and dual.
        most: Iterations after which a solve gives up.
    """

    def __init__(
        self,
        h: Array,
        a: Array,
        sense: Sense,
        price: Array,
        curve: Array,
        tolerance: float = TOLERANCE,
        most: int = _MOST_ITERATIONS,
    ) -> None:
        self.sense = sense
        self.iterations = 0
        model = daqp.Model()
        sides = np.full(a.shape[0], OPEN)
        model.setup(h, np.zeros(h.shape[0]), a, sides, -sides, sense)  # the soft rows fix the workspace
        model.settings = {
            "primal_tol": tolerance,
            "dual_tol": tolerance,
            "eps_prox": 0.0,
            "iter_limit": most,
        }
        rho = 0.5 / np.maximum(curve, LEAST_CURVE * np.abs(np.diagonal(h)).max(initial=1.0))
        model.soft_weights(rho_l=rho, rho_u=rho, w_l=price, w_u=price)
        self._update, self._solve = model.update, model.solve

    def solve(self, f: Array, upper: Array, lower: Array) -> tuple[Array, Array] | None:
        """Minimiser (n,) and multipliers (m,), positive at an upper side; None without a finite optimum.

        The sides may be infinite; f and the sides that are not must be finite.
        """
        if self._update(f=f, bupper=upper, blower=lower, sense=self.sense) < 0:
            return None
        return self._read()

    def solve_sides(self, upper: Array, lower: Array, begin: Sense | None = None, again: bool = False) -> Array | None:
        """Minimiser (n,) for the f of the last question that gave one, zero without; None without an optimum.

        Args:
            upper: Upper sides (m,).
            lower: Lower sides (m,).
            begin: `sense` with ACTIVE or BELOW (and KEEPS) added to the rows to begin with; None: with none.
            again: Whether to begin with the rows, and their factors, at which the last solve ended. What comes out
                depends on that solve too, in its last bits: only where it was of the same question.
        """
        sense = self.sense if begin is None else begin
        if self._update(bupper=upper, blower=lower, sense=None if again else sense) < 0:
            return None
        found = self._read()
        return None if found is None else found[0]

    def solve_anew(self, h: Array, f: Array, a: Array, upper: Array, lower: Array) -> tuple[Array, Array] | None:
        """The same with new matrices of the same sizes."""
        if self._update(H=h, f=f, A=a, bupper=upper, blower=lower, sense=self.sense) < 0:
            return None
        return self._read()

    def _read(self) -> tuple[Array, Array] | None:
        z, value, flag, info = self._solve()
        self.iterations = info["iterations"]
        # NaN comes back as solved; the square's overflow counts as no number either (and vdot does not warn of it).
        if flag not in _OPTIMAL or not isfinite(value) or not isfinite(np.vdot(z, z)):
            return None
        return z, info["lam"]
