"""Rows that a program begins with: a guess at those that bind, by where the fastest inputs lead.

An active-set method ends at the same optimum from any rows, and takes fewer iterations the nearer they are to those
that bind there. Plans in transit are alike: as fast as the slew rows let it to where a state row still can be kept,
back as fast, and then along that row. Where even the fastest inputs leave a state row, it gives way for certain.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from math import isfinite

import daqp
import numpy as np
from numpy.typing import NDArray

from uavctl.arrays import Array

# Quadratic programs in DAQP: min ½ zᵀHz + fᵀz, lower <= A z <= upper, soft rows at a linear and a quadratic price.
#
# DAQP starts from the state of its rows, and an update that does not name them keeps those of the last solve: here
# they are named every time, so that the same question gives the same bits whatever was asked before.


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

    Args:
        h: H (n, n), positive definite.
        a: A (m, n).
        sense: DAQP's state of each row (m,): 0, SOFT, EQUAL.
        price: Linear price of a soft row (m,).
        curve: Quadratic price (m,): leaving by s costs price·s + curve·s².
        tolerance: Of feasibility, primal and dual.
        most: Iterations after which a solve gives up.
        linear: Whether questions bring an f. Where none ever does, f is zero and new sides are no product with it.
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
        linear: bool = True,
    ) -> None:
        self.sense = sense  # DAQP's state of each row (m,)
        self.iterations = 0  # of the last solve
        model = daqp.Model()
        sides = np.full(a.shape[0], OPEN)
        f = np.zeros(h.shape[0]) if linear else None
        model.setup(h, f, a, sides, -sides, sense)  # the soft rows fix the workspace
        model.settings = {"primal_tol": tolerance, "dual_tol": tolerance, "eps_prox": 0.0, "iter_limit": most}
        if len(sides):
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


Flags = NDArray[np.bool_]

_EVERY = 2  # stages along a state row: from those of every one, more would have to be taken out than put in
_LONGER = 1.0 / 3.0  # of the stages in which a plan without state rows is beyond one: how much longer it is kept to


class FirstRows:
    """Guesses for a part with one input and one slew row. Not for concurrent use.

    It looks at the direction of the state rows that the input moves the soonest (a speed, before a position).

    Args:
        of_x: State rows (H, d, n) by z.
        of_u: Rows (H, k, n) of a stage by z: those of the input set, then the slew row.
        sense: DAQP's state of all rows: those of `of_x`, stage after stage, all alike, then those of `of_u`, all alike.
    """

    def __init__(self, of_x: Array, of_u: Array, sense: Sense) -> None:
        self._sense, self._steps = sense, len(of_x)
        width, last = of_u.shape[1], of_x.shape[0] * of_x.shape[1]
        inverse = np.linalg.inv(of_u[:, -1])
        by_slew = np.einsum("tdn,nk->dtk", of_x, inverse)
        direction = int(np.argmax(by_slew[:, 0, 0] / np.abs(by_slew[:, -1, 0])))
        self._states = slice(direction, last, of_x.shape[1])
        self._slews = slice(last + width - 1, None, width)
        # From the unit of the rows of the input set to that of the slew row.
        self._inputs = slice(last, None, width) if width > 1 else None
        self._unit = of_u[0, -1, 0] / of_u[0, 0, 0]
        self._soft, self._hard = int(sense[0]), int(sense[last])
        tops = np.zeros(self._steps + 1)
        self._top, self._before = tops[1:], tops[:-1]  # how far inputs get in each stage, and in the one before
        of_z = np.asfortranarray(of_x[:, direction])
        self._z, self._reach = inverse, np.ascontiguousarray(by_slew[direction])
        # Their first columns, by how many: a product with a part of a matrix would begin with a copy of it.
        counts = range(len(of_x) + 1)
        self._of_z = [np.ascontiguousarray(of_z[:, :count]) for count in counts[:-1]] + [of_z]
        self._reached = [np.ascontiguousarray(self._reach[:, :count]) for count in counts]

    @staticmethod
    def suits(of_x: Array, of_u: Array, slews: int) -> bool:
        """Whether there is one slew row and one input, and all rows move as the input does."""
        if slews != 1 or not of_x.shape[1] or of_u.shape[0] != of_u.shape[2] or of_u.shape[1] > 2:
            return False
        reach = np.einsum("tdn,nk->dtk", of_x, np.linalg.inv(of_u[:, -1]))
        return bool((of_u[0, :, 0] > 0.0).all() and (reach[:, -1, 0] != 0.0).all() and (reach[:, 0, 0] > 0.0).any())

    def of(self, upper: Array, lower: Array) -> Sense | None:
        """`sense` with the rows to begin with, by the sides (m,) of all rows; None: with none."""
        fast, slow = upper[self._slews], lower[self._slews]
        braked = self._reach.dot(slow)
        over = braked > upper[self._states]
        if np.count_nonzero(over):
            return self._begin(upper, lower, braked, over, ACTIVE, BELOW)
        pushed = self._reach.dot(fast)
        under = pushed < lower[self._states]
        if np.count_nonzero(under):
            return self._begin(-lower, -upper, -pushed, under, BELOW, ACTIVE)
        if fast[0] < 0.0:
            return self._begin(upper, lower, braked, None, ACTIVE, BELOW)
        if slow[0] > 0.0:
            return self._begin(-lower, -upper, -pushed, None, BELOW, ACTIVE)
        return None

    def _begin(
        self, upper: Array, lower: Array, braked: Array, over: Flags | None, towards: int, against: int
    ) -> Sense:
        """Rows of a plan that goes upwards, after it has braked while state rows give way.

        Args:
            upper: Upper sides of all rows (m,).
            lower: Lower sides (m,).
            braked: State rows (H,) by the lower sides of the slew rows.
            over: Those that give way (H,); None: none does.
            towards: DAQP's state of a row at its upper side.
        """
        fast, slow, high = upper[self._slews], lower[self._slews], upper[self._states]
        begin, since = self._sense.copy(), 0
        slews, states = begin[self._slews], begin[self._states]
        if over is not None:
            since = _last(over) + 1
            states[over] = self._soft + towards
            slews[:since] = self._hard + against
            if since == self._steps:
                return begin
            fast = np.concatenate([slow[:since], fast[since:]])
        # To where the regulator asks for no more.
        z = self._z.dot(fast)
        there = z[since:] >= 0.0
        if there[0]:
            return begin
        count = since + (int(there.argmax()) or there.size)
        left = self._of_z[count][since:].dot(z[:count]) > high[since:]
        if not np.count_nonzero(left):
            slews[since:count] = self._hard + towards
            return begin
        # That leaves a state row: as long as it can still be kept, and back.
        ramp = np.add.accumulate(fast)
        top = self._top
        if self._inputs is None:
            top[:] = ramp
        else:
            np.minimum(ramp, upper[self._inputs] * self._unit, out=top)
        gain = top - slow
        gain -= self._before
        room, taken = (high - braked)[since:], None
        # Where the regulator asks for no more is a good first try.
        middle, count, beyond = count, since, self._steps + 1
        while beyond - count > 1:
            of_gain = self._reached[middle]
            tried = (of_gain[since:] if since else of_gain).dot(gain[:middle])
            if np.count_nonzero(tried > room):
                beyond = middle
            else:
                count, taken = middle, tried
            middle = (count + beyond) // 2
        if taken is None:
            taken = self._reached[since][since:].dot(gain[:since])
        nearest = since + int((room - taken).argmin())
        slews[since:count] = self._hard + towards
        if self._inputs is not None:
            capped = ramp[since:count] > top[since:count]
            if np.count_nonzero(capped):
                slews[since:count][capped] = self._hard
                begin[self._inputs][since:count][capped] = self._hard + towards
        slews[count + 1 : nearest + 1] = self._hard + against
        # Along the row it takes longer than past it.
        end = since + _last(left) + 1
        end += int(_LONGER * (end - nearest))
        states[nearest + 1 : end : _EVERY] = self._soft + towards + KEEPS
        return begin


def _last(flags: Flags) -> int:
    return int(flags.size - 1 - flags[::-1].argmax())


# Places of each kind of variable in a component's program, and the rows that share one.


@dataclass(frozen=True)
class Pair:
    """Rows of one set with the same direction up to sign: c z <= upper, -c z <= lower."""

    c: tuple[float, ...]
    sides: tuple[tuple[float, int], ...]  # (sign, row)


def pairs_of(c: Array) -> tuple[Pair, ...]:
    """Group rows by direction; a pair shares its back-off and its slack."""
    groups: dict[tuple[float, ...], list[tuple[float, int]]] = {}
    for i, row in enumerate(c):
        sign = 1.0 if row[np.flatnonzero(row)[0]] > 0 else -1.0
        groups.setdefault(tuple((sign * row).tolist()), []).append((sign, i))
    return tuple(Pair(direction, tuple(sides)) for direction, sides in groups.items())


@dataclass(frozen=True)
class VariableLayout:
    """Places of each kind of variable in the vector of all variables."""

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
    def of(cls, v: int, theta: int, y: int, slack: int, miss: int, outside: int, backoff: int) -> VariableLayout:
        """Lay the given numbers of variables out one after another."""
        ends = np.cumsum([0, v, theta, y, y, slack, miss, outside, backoff]).tolist()
        return cls(*(slice(i, j) for i, j in pairwise(ends)))
