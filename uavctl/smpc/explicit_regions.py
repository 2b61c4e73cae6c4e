"""The solution of a parametric QP as a piecewise affine map: its critical regions, found from facet to facet.

On the set of parameters that have the same rows active, minimiser and multipliers are affine, and that set is a
polytope (theory 5.3). The search starts in the region of one parameter and steps across every facet; it draws nothing,
so the same program gives the same regions.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linprog
from scipy.spatial import HalfspaceIntersection, QhullError

from uavctl.smpc.qp import EQUAL, LEAST_CURVE, OPEN, SOFT, QuadraticProgram

Array = NDArray[np.float64]
State = NDArray[np.int8]

# State of a row: free, held at its upper (+) or lower (-) side, or left beyond it at its price.
FREE, HELD, LEFT = 0, 1, 2

# A soft row that is passed by more than this is left [the row's unit]; less is the QP solver's tolerance.
_PASSED = 1e-8
# Active rows that depend on each other: their multipliers are not determined well enough for a map.
_DEPENDENT = 1e-11
# In the box scaled to -1 … 1: the step across a facet, the least radius of a region, and the width of its border.
_STEP, _THIN, _BORDER = 1e-5, 1e-7, 1e-9
# A facet may have several regions behind it: steps go from its middle, and from near so many of its corners.
_CORNERS = 6
# Beyond, a table would take longer to build than it saves; what is farther from the start is not in it.
_MOST_REGIONS = 1500


@dataclass(frozen=True, eq=False)
class Parametric:
    """min ½ zᵀHz + f(x)ᵀz, lower(x) <= A z <= upper(x): f and the sides are affine, given as maps of (1, x).

    Attributes:
        h: H (n_z, n_z), positive definite.
        a: A (m, n_z).
        sense: State of each row as DAQP has it (m,): 0, SOFT, EQUAL.
        price: Linear price of a soft row (m,).
        curve: Its quadratic price (m,).
        f: (n_z, 1 + n).
        upper: (m, 1 + n), OPEN in the first column where there is no limit.
        lower: (m, 1 + n) alike.
    """

    h: Array
    a: Array
    sense: NDArray[np.int32]
    price: Array
    curve: Array
    f: Array
    upper: Array
    lower: Array


@dataclass(frozen=True, eq=False)
class Critical:
    """One critical region and the solution on it; all maps are of (1, x).

    Attributes:
        state: State of each row (m,).
        z: Minimiser (n_z, 1 + n).
        multipliers: (m, 1 + n), positive at an upper side.
        facets: (k, 1 + n): x is in the region where no value is positive.
    """

    state: State
    z: Array
    multipliers: Array
    facets: Array


def critical_regions(program: Parametric, low: Array, high: Array, start: Array) -> tuple[Critical, ...]:
    """Critical regions within the box low … high (n,), those near `start` (n,) first.

    Parameters for which the program has no optimum are in no region. Neighbours share their border.
    """
    return tuple(_Search(program, low, high).run(start))


class _Search:
    """Steps from region to region, in coordinates ξ in which the box is -1 … 1."""

    def __init__(self, program: Parametric, low: Array, high: Array) -> None:
        n = low.size
        self._program = program
        self._solver = QuadraticProgram(program.h, program.a, program.sense, program.price, program.curve)
        self._middle, self._half = 0.5 * (low + high), 0.5 * (high - low)
        self._to_x = np.eye(n + 1)
        self._to_x[1:, 0], self._to_x[1:, 1:] = self._middle, np.diag(self._half)
        self._to_xi = np.linalg.inv(self._to_x)
        self._box = np.hstack([-np.ones((2 * n, 1)), np.vstack([np.eye(n), -np.eye(n)])])
        self._soft = program.sense == SOFT
        self._has_upper, self._has_lower = program.upper[:, 0] < 0.5 * OPEN, program.lower[:, 0] > -0.5 * OPEN
        # Both sides in one: there is no other state than held, whatever the multiplier's sign.
        self._equal = (program.sense == EQUAL) | (program.upper == program.lower).all(axis=1)
        self._yields = 0.5 / np.maximum(program.curve, LEAST_CURVE * np.abs(np.diagonal(program.h)).max())
        self._by_row = np.linalg.solve(program.h, program.a.T)  # H⁻¹Aᵀ
        self._gram = program.a @ self._by_row
        self._alone = -np.linalg.solve(program.h, program.f)
        self._known: set[bytes] = set()
        self._ahead: deque[State] = deque()

    def run(self, start: Array) -> Iterator[Critical]:
        """All regions that can be reached from `start`, breadth first."""
        self._visit((start - self._middle) / self._half)
        found = 0
        while self._ahead and found < _MOST_REGIONS:
            state = self._ahead.popleft()
            region = self._region(state)
            if region is not None:
                found += 1
                yield region

    def _visit(self, xi: Array) -> None:
        """Look which rows are active at a point, and note the state if it is new."""
        x1 = self._to_x @ np.concatenate([[1.0], xi])
        program = self._program
        upper, lower = program.upper @ x1, program.lower @ x1
        solved = self._solver.solve(program.f @ x1, upper, lower)
        if solved is None:
            return
        z, multipliers = solved
        value = program.a @ z
        state = np.sign(multipliers).astype(np.int8) * HELD
        state[self._equal] = HELD
        state[self._soft & self._has_upper & (value > upper + _PASSED)] = LEFT
        state[self._soft & self._has_lower & (value < lower - _PASSED)] = -LEFT
        key = state.tobytes()
        if key not in self._known:
            self._known.add(key)
            self._ahead.append(state)

    def _region(self, state: State) -> Critical | None:
        """The region of a state, whose neighbours are visited; None where it is empty, thin or degenerate."""
        solution = self._solution(state)
        if solution is None:
            return None
        z, multipliers = solution
        rows = np.vstack([self._conditions(state, z, multipliers) @ self._to_x, self._box])
        slope = np.linalg.norm(rows[:, 1:], axis=1)
        flat = slope <= _DEPENDENT * np.abs(rows[:, 0]) + np.finfo(np.float64).tiny
        if (rows[flat, 0] > 0.0).any():
            return None
        rows = rows[~flat] / slope[~flat, None]
        corners = _corners(rows)
        if corners is None:
            return None
        for facet in sorted(corners):
            self._cross(rows[facet, 1:], corners[facet])
        border = rows[sorted(corners)]
        border[:, 0] -= _BORDER
        return Critical(state, z, multipliers, border @ self._to_xi)

    def _cross(self, outwards: Array, corners: list[Array]) -> None:
        """Visit what is behind a facet."""
        middle = np.mean(corners, axis=0)
        for point in [middle, *(0.9 * corner + 0.1 * middle for corner in corners[:_CORNERS])]:
            behind = point + _STEP * outwards
            if (np.abs(behind) <= 1.0).all():
                self._visit(behind)

    def _solution(self, state: State) -> tuple[Array, Array] | None:
        """Minimiser and multipliers as maps of (1, x); None where the active rows depend on each other.

        H z + f + Aᵀλ = 0. A row that is held is at its side; one that is left is (|λ| - price) / (2 curve) beyond.
        """
        program = self._program
        (active,) = np.nonzero(state)
        sign, left = np.sign(state[active]), np.abs(state[active]) == LEFT
        yields = np.where(left, self._yields[active], 0.0)
        side = np.where((sign > 0)[:, None], program.upper[active], program.lower[active])
        right = program.a[active] @ self._alone - side
        right[:, 0] += yields * sign * program.price[active]
        matrix = self._gram[np.ix_(active, active)] + np.diag(yields)
        scale = 1.0 / np.sqrt(np.diagonal(matrix))
        matrix = matrix * scale[:, None] * scale
        if active.size and np.linalg.eigvalsh(matrix)[0] < _DEPENDENT:
            return None
        multipliers = np.zeros(program.upper.shape)
        multipliers[active] = scale[:, None] * np.linalg.solve(matrix, scale[:, None] * right)
        return self._alone - self._by_row @ multipliers, multipliers

    def _conditions(self, state: State, z: Array, multipliers: Array) -> Array:
        """Maps of (1, x) that are nowhere positive in the region: rows kept, multipliers of the right sign and size."""
        program = self._program
        value, size = program.a @ z, np.sign(state)[:, None] * multipliers
        price = np.zeros_like(value)
        price[:, 0] = program.price
        held, left = np.abs(state) == HELD, np.abs(state) == LEFT
        kept = ~left & ~self._equal
        return np.vstack(
            [
                (value - program.upper)[kept & (state != HELD) & self._has_upper],
                (program.lower - value)[kept & (state != -HELD) & self._has_lower],
                -size[held & ~self._equal],
                (size - price)[held & self._soft],
                (-size - price)[held & self._soft & self._equal],
                (price - size)[left],
            ]
        )


def _corners(rows: Array) -> dict[int, list[Array]] | None:
    """Corners of the polytope rows (1, ξ) <= 0, of unit normals, on each row that is a facet; None if it is thin."""
    n = rows.shape[1] - 1
    # The largest ball within: every row is kept by its radius.
    matrix = np.hstack([rows[:, 1:], np.ones((len(rows), 1))])
    ball = linprog(np.append(np.zeros(n), -1.0), A_ub=matrix, b_ub=-rows[:, 0], bounds=(None, None))
    if ball.status != 0:
        return None
    middle = np.asarray(ball.x, dtype=np.float64)
    if middle[n] < _THIN:
        return None
    if n == 1:  # no dimension for Qhull
        ends = -rows[:, 0] * rows[:, 1]
        last = [np.where(rows[:, 1] * side > 0.0, side * ends, np.inf).argmin() for side in (1.0, -1.0)]
        return {int(i): [ends[i : i + 1]] for i in last}
    try:
        polytope = HalfspaceIntersection(np.hstack([rows[:, 1:], rows[:, :1]]), middle[:n])
    except QhullError:
        return None
    corners: dict[int, list[Array]] = {}
    for corner, facets in zip(polytope.intersections, polytope.dual_facets, strict=True):
        for facet in facets:
            corners.setdefault(int(facet), []).append(corner)
    return corners
