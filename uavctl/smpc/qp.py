"""Quadratic programs in DAQP, a guess of their active rows, and the layout of a program's variables.

1. min ½ z'Hz + f'z, lower <= A z <= upper, with soft rows at a linear and a quadratic price.
2. DAQP starts from the state of its rows, and keeps that of the last solve if an update does not name one. Here each
   update names it, so the same question gives the same bits after any other question.
3. `FirstRows` guesses the active rows. An active-set method ends at the same optimum from any rows, after fewer
   iterations the nearer they are to the active ones. Plans in transit are alike: the input changes at the slew limit
   until a state row can just be kept, changes back as fast, and the plan then follows that row. Where even the fastest
   inputs leave a state row, that row is relaxed for certain.
4. `find_pairs` groups rows ±c, which share a back-off; `VariableLayout` is the order of a conic program's variables.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from math import isfinite

import daqp
import numpy as np
from numpy.typing import NDArray

from uavctl.arrays import Array

Sense = NDArray[np.int32]

OPEN = 1e30  # DAQP's infinity
SOFT, EQUAL = 8, 5
ACTIVE, BELOW = 1, 3  # a first active row, at its upper or its lower side; a soft one is relaxed at first
KEEPS_LIMIT = 32  # added to a soft first row that is kept at first
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
        self, upper: Array, lower: Array, first_rows: Sense | None = None, reuse_rows: bool = False
    ) -> Array | None:
        """Return the minimiser (n,) for the last f, zero without one; None without an optimum.

        Args:
            upper: Upper sides (m,).
            lower: Lower sides (m,).
            first_rows: `sense` with ACTIVE or BELOW (and KEEPS_LIMIT) added to the first active rows; None: none.
            reuse_rows: Start from the active rows of the last solve, and their factors. The last bits of the result
                depend on that solve: only for the same question.
        """
        sense = self.sense if first_rows is None else first_rows
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


Flags = NDArray[np.bool_]

_ROW_SPACING = 2  # active stages along a state row: with each one, more would have to be removed than added
_EXTRA_SHARE = (
    1.0 / 3.0
)  # extra time on a state row, as a share of the stages in which a plan without state rows is beyond it


class FirstRows:
    """Guess of the active rows of a part with one input and one slew row. Not for concurrent use.

    It uses the state rows of one direction: that which the input moves first (a speed, before a position).

    Args:
        of_x: State rows (H, d, n) by z.
        of_u: Rows (H, k, n) of a stage by z: those of the input set, then the slew row.
        sense: DAQP's state of all rows: all of `x_rows`, stage after stage, then all of `u_rows`.
    """

    def __init__(self, x_rows: Array, u_rows: Array, sense: Sense) -> None:
        self._sense, self._steps = sense, len(x_rows)
        width, last = u_rows.shape[1], x_rows.shape[0] * x_rows.shape[1]
        inverse = np.linalg.inv(u_rows[:, -1])
        by_slew = np.einsum("tdn,nk->dtk", x_rows, inverse)
        direction = int(np.argmax(by_slew[:, 0, 0] / np.abs(by_slew[:, -1, 0])))
        self._states = slice(direction, last, x_rows.shape[1])
        self._slews = slice(last + width - 1, None, width)
        # Factor from the unit of the input set's rows to that of the slew row
        self._inputs = slice(last, None, width) if width > 1 else None
        self._unit = u_rows[0, -1, 0] / u_rows[0, 0, 0]
        self._soft, self._hard = int(sense[0]), int(sense[last])
        tops = np.zeros(self._steps + 1)
        self._top, self._before = tops[1:], tops[:-1]  # largest input in each stage, and in the one before
        z_rows = np.asfortranarray(x_rows[:, direction])
        self._z, self._reach = inverse, np.ascontiguousarray(by_slew[direction])
        # Their first columns, by number: a product with a part of a matrix would copy it first.
        counts = range(len(x_rows) + 1)
        self._z_columns = [np.ascontiguousarray(z_rows[:, :count]) for count in counts[:-1]] + [z_rows]
        self._reached = [np.ascontiguousarray(self._reach[:, :count]) for count in counts]

    @staticmethod
    def is_suitable(x_rows: Array, u_rows: Array, slews: int) -> bool:
        """Return whether there is one slew row and one input, and all rows move in the input's direction."""
        if slews != 1 or not x_rows.shape[1] or u_rows.shape[0] != u_rows.shape[2] or u_rows.shape[1] > 2:
            return False
        reach = np.einsum("tdn,nk->dtk", x_rows, np.linalg.inv(u_rows[:, -1]))
        return bool((u_rows[0, :, 0] > 0.0).all() and (reach[:, -1, 0] != 0.0).all() and (reach[:, 0, 0] > 0.0).any())

    def guess(self, upper: Array, lower: Array) -> Sense | None:
        """Return `sense` with the first active rows, from the sides (m,) of all rows; None: no first rows."""
        fast, slow = upper[self._slews], lower[self._slews]
        braked = self._reach.dot(slow)
        over = braked > upper[self._states]
        if np.count_nonzero(over):
            return self._build_guess(upper, lower, braked, over, ACTIVE, BELOW)
        pushed = self._reach.dot(fast)
        under = pushed < lower[self._states]
        if np.count_nonzero(under):
            return self._build_guess(-lower, -upper, -pushed, under, BELOW, ACTIVE)
        if fast[0] < 0.0:
            return self._build_guess(upper, lower, braked, None, ACTIVE, BELOW)
        if slow[0] > 0.0:
            return self._build_guess(-lower, -upper, -pushed, None, BELOW, ACTIVE)
        return None

    def _build_guess(
        self, upper: Array, lower: Array, braked: Array, over: Flags | None, towards: int, against: int
    ) -> Sense:
        """Guess the rows of a plan that goes up, after it has braked while state rows are relaxed.

        Args:
            upper: Upper sides of all rows (m,).
            lower: Lower sides (m,).
            braked: State rows (H,) by the lower sides of the slew rows.
            over: State rows that are relaxed (H,); None: none.
            towards: DAQP's state of a row at its upper side.
        """
        fast, slow, high = upper[self._slews], lower[self._slews], upper[self._states]
        first_rows, since = self._sense.copy(), 0
        slews, states = first_rows[self._slews], first_rows[self._states]
        if over is not None:
            since = _find_last(over) + 1
            states[over] = self._soft + towards
            slews[:since] = self._hard + against
            if since == self._steps:
                return first_rows
            fast = np.concatenate([slow[:since], fast[since:]])
        # Up to the stage where the regulator needs no more: z_t >= 0 with z = S⁻¹ fast
        z = self._z.dot(fast)
        is_reached = z[since:] >= 0.0
        if is_reached[0]:
            return first_rows
        count = since + (int(is_reached.argmax()) or is_reached.size)
        leaves_row = self._z_columns[count][since:].dot(z[:count]) > high[since:]
        if not np.count_nonzero(leaves_row):
            slews[since:count] = self._hard + towards
            return first_rows
        # If that leaves a state row: as long as the row can still be kept, then back.
        ramp = np.add.accumulate(fast)
        top = self._top
        if self._inputs is None:
            top[:] = ramp
        else:
            np.minimum(ramp, upper[self._inputs] * self._unit, out=top)
        gain = top - slow
        gain -= self._before
        room, used = (high - braked)[since:], None
        # Bisection over the last stage, from the one where the regulator needs no more
        middle, count, infeasible = count, since, self._steps + 1
        while infeasible - count > 1:
            of_gain = self._reached[middle]
            tried = (of_gain[since:] if since else of_gain).dot(gain[:middle])
            if np.count_nonzero(tried > room):
                infeasible = middle
            else:
                count, used = middle, tried
            middle = (count + infeasible) // 2
        if used is None:
            used = self._reached[since][since:].dot(gain[:since])
        nearest = since + int((room - used).argmin())
        slews[since:count] = self._hard + towards
        if self._inputs is not None:
            capped = ramp[since:count] > top[since:count]
            if np.count_nonzero(capped):
                slews[since:count][capped] = self._hard
                first_rows[self._inputs][since:count][capped] = self._hard + towards
        slews[count + 1 : nearest + 1] = self._hard + against
        # The plan stays on the row for longer than a free plan is beyond it.
        end = since + _find_last(leaves_row) + 1
        end += int(_EXTRA_SHARE * (end - nearest))
        states[nearest + 1 : end : _ROW_SPACING] = self._soft + towards + KEEPS_LIMIT
        return first_rows


def _find_last(flags: Flags) -> int:
    return int(flags.size - 1 - flags[::-1].argmax())


@dataclass(frozen=True)
class Pair:
    """Rows of one set with the same direction up to sign: c z <= upper, -c z <= lower."""

    c: tuple[float, ...]
    sides: tuple[tuple[float, int], ...]  # (sign, row)


def find_pairs(c: Array) -> tuple[Pair, ...]:
    """Group rows by their direction; a pair shares its back-off and its slack."""
    groups: dict[tuple[float, ...], list[tuple[float, int]]] = {}
    for i, row in enumerate(c):
        sign = 1.0 if row[np.flatnonzero(row)[0]] > 0 else -1.0
        groups.setdefault(tuple((sign * row).tolist()), []).append((sign, i))
    return tuple(Pair(direction, tuple(sides)) for direction, sides in groups.items())


@dataclass(frozen=True)
class VariableLayout:
    """Slices of each kind of variable in the vector of all variables."""

    v: slice
    theta: slice
    y: slice
    offset: slice
    slack: slice
    miss: slice
    outside: slice
    backoff: slice

    @property
    def size(self) -> int:
        """Number of variables."""
        return int(self.backoff.stop)

    @classmethod
    def make(cls, v: int, theta: int, y: int, slack: int, miss: int, outside: int, backoff: int) -> VariableLayout:
        """Place the given numbers of variables one after another."""
        ends = np.cumsum([0, v, theta, y, y, slack, miss, outside, backoff]).tolist()
        return cls(*(slice(i, j) for i, j in pairwise(ends)))
