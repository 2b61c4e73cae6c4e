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

from uavctl.smpc.answer import LEAST_COST, Solver, inside
from uavctl.smpc.batch import Decisions, OneByOne
from uavctl.smpc.hahn_stursberg.design import Design
from uavctl.smpc.hahn_stursberg.frozen import TOLERANCE, Frozen
from uavctl.smpc.hahn_stursberg.horizon import Component, decompose, horizon_of
from uavctl.smpc.hahn_stursberg.library import Library, PartLibrary, state_box
from uavctl.smpc.hahn_stursberg.mean import MeanProblem, RowKind
from uavctl.smpc.hahn_stursberg.mixture import Mixture
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
    """min ½ zᵀHz + f(x)ᵀz, lower(x) <= A z <= upper(x): f and the sides are affine, given as maps of (1, x)."""

    h: Array  # H (n_z, n_z), positive definite
    a: Array  # A (m, n_z)
    sense: NDArray[np.int32]  # state of each row as DAQP has it (m,): 0, SOFT, EQUAL
    price: Array  # linear price of a soft row (m,)
    curve: Array  # its quadratic price (m,)
    f: Array  # (n_z, 1 + n)
    upper: Array  # (m, 1 + n), OPEN in the first column where there is no limit
    lower: Array  # (m, 1 + n) alike


@dataclass(frozen=True, eq=False)
class Critical:
    """One critical region and the solution on it; all maps are of (1, x)."""

    state: State  # state of each row (m,)
    z: Array  # minimiser (n_z, 1 + n)
    multipliers: Array  # (m, 1 + n), positive at an upper side
    facets: Array  # (k, 1 + n): x is in the region where no value is positive


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


# The frozen answer of one component as a table: its plans, costs and lower bounds for many states at once.


Flags = NDArray[np.bool_]

# A state without limits is looked up within so many standard deviations around the target.
_SPREAD = 6.0


@dataclass(frozen=True, eq=False)
class Found:
    """What the table knows of M states."""

    known: Flags  # whether the frozen QP is known to have a solution (M,); only then do the others mean something
    accepted: Flags  # whether that is the joint optimum: the KKT conditions hold (M,)
    inputs: Array  # mean inputs (M, H, n_u), before they are cut back to their limits
    cost: Array  # cost of the plan (M,), where it is accepted
    lower: Array  # lower bound of the optimum (M,): the Lagrangian's value at the multipliers


@dataclass(frozen=True, eq=False)
class _Piece:
    """One critical region; maps are of x1 = (1, x)."""

    facets: Array  # (1 + n, k): x is within where no value is positive
    multipliers: Array  # (1 + n, r): those that must be within bounds
    allowed: Array  # bounds (r,) of their size
    inputs: Array  # (1 + n, H n_u)
    bounds: Array  # (monomials, 2): cost and lower bound, of the products of x1's entries


class FrozenTable:
    """The frozen answers of one component towards a fixed target.

    Args:
        target: The component's target (n_x,), an equilibrium.
    """

    def __init__(self, mixture: Mixture, target: Array) -> None:
        self._mixture, self._problem = mixture, mixture.problem
        part = self._problem.horizon.component
        self._of_x1 = _parameters(self._problem, target)
        self._frozen = Frozen([mixture])
        self._program = self._parametric()
        self._residual = self._problem.residual_p @ self._of_x1
        self._pairs = np.triu_indices(target.size + 1)
        low, high = state_box(part, target, _SPREAD)
        self._pieces = [self._piece(region) for region in critical_regions(self._program, low, high, target)]
        self._shape = (self._problem.horizon.steps, part.b.shape[1])

    def look_up(self, x: Array) -> Found:
        """Frozen answers from states (M, n_x), which must be finite."""
        count = len(x)
        x1 = np.hstack([np.ones((count, 1)), x])
        known, accepted = np.zeros(count, dtype=np.bool_), np.zeros(count, dtype=np.bool_)
        inputs, bounds = np.zeros((count, self._shape[0] * self._shape[1])), np.zeros((count, 2))
        open_ = np.arange(count)
        for piece in self._pieces:
            within = (x1 @ piece.facets <= 0.0).all(axis=1)
            if not within.any():
                continue
            who, points = open_[within], x1[within]
            known[who] = True
            accepted[who] = (np.abs(points @ piece.multipliers) <= piece.allowed).all(axis=1)
            inputs[who] = points @ piece.inputs
            bounds[who] = (points[:, self._pairs[0]] * points[:, self._pairs[1]]) @ piece.bounds
            open_, x1 = open_[~within], x1[~within]
            if not open_.size:
                break
        return Found(known, accepted, inputs.reshape(count, *self._shape), bounds[:, 0], bounds[:, 1])

    def _parametric(self) -> Parametric:
        """The frozen QP with the state as its parameter."""
        problem, frozen = self._problem, self._frozen
        sides = frozen.sides(
            np.where(np.isfinite(problem.upper), problem.upper, OPEN),
            np.where(np.isfinite(problem.lower), problem.lower, -OPEN),
        )
        offset = problem.r @ self._of_x1
        upper, lower = -offset, -offset
        upper[:, 0] += sides[0]
        lower[:, 0] += sides[1]
        sense = frozen.programs[0].sense
        return Parametric(
            h=problem.h,
            a=problem.a,
            sense=sense,
            price=np.where(sense == SOFT, problem.price, 0.0),
            curve=problem.curve,
            f=problem.linear @ self._of_x1,
            upper=upper,
            lower=lower,
        )

    def _piece(self, region: Critical) -> _Piece:
        problem = self._problem
        off = np.array([row.kind is RowKind.OFFSET for row in problem.rows])
        left = off & (np.abs(region.state) == LEFT)
        net = region.multipliers.copy()
        # QuadraticProgram's least curvature is in the multiplier of a target out of reach; the bound wants the price.
        net[left] = 0.0
        net[left, 0] = np.sign(region.state[left]) * problem.price[left]
        judged = (region.state != 0) & np.isfinite(self._frozen.allowed)
        w, here = problem.z @ region.z + problem.w @ self._of_x1, self._of_x1[problem.n_p - problem.n_y :]
        inputs = [problem.inputs(w[:, i], here[:, i]).ravel() for i in range(w.shape[1])]
        bounds = [self._products(self._cost(region, left)), self._products(self._lower(region, net))]
        return _Piece(
            facets=region.facets.T.copy(),
            multipliers=net[judged].T.copy(),
            allowed=self._frozen.allowed[judged],
            inputs=np.array(inputs),
            bounds=np.transpose(bounds).copy(),
        )

    def _cost(self, region: Critical, left: Flags) -> Array:
        """Cost of the plan as a quadratic form of x1; state rows are kept."""
        problem, program, z = self._problem, self._program, region.z
        form = self._residual.T @ self._residual + 0.5 * z.T @ problem.h @ z + z.T @ program.f
        form[0, 0] += self._mixture.first.cost
        beyond = np.sign(region.state)[:, None] * (problem.a @ z - program.upper)
        form[0] += problem.price[left] @ beyond[left]
        return form

    def _lower(self, region: Critical, net: Array) -> Array:
        """The Lagrangian's value at the multipliers as a quadratic form of x1; see `Frozen.certify`."""
        problem, program, first = self._problem, self._program, self._mixture.first
        room = 0.5 * (problem.upper - problem.lower)[problem.links]
        pinned = first.slope > 0.0
        g = program.f + problem.a.T @ net
        side = np.where((region.state > 0)[:, None], program.upper, program.lower)
        active = region.state != 0
        form = self._residual.T @ self._residual - 0.5 * g.T @ np.linalg.solve(problem.h, g)
        form -= net[active].T @ side[active]
        form[0, 0] += first.level - first.slope[pinned] @ room[pinned]
        return form

    def _products(self, form: Array) -> Array:
        """Coefficients of the products of x1's entries that a quadratic form has."""
        i, j = self._pairs
        return np.where(i == j, form[i, j], form[i, j] + form[j, i])


def _parameters(problem: MeanProblem, target: Array) -> Array:
    """Parameters p of the mean problem as a map of x1 (n_p, 1 + n_x)."""
    origin = problem.parameters(np.zeros(target.size), target)
    return np.column_stack([origin, *(problem.parameters(unit, target) - origin for unit in np.eye(target.size))])


# Decisions for campaigns: the library solver's plans, for many states at once.
#
# Towards one fixed target and with nothing else known ahead, the frozen answer of a component is an affine function of
# its state on each of about a hundred polytopes (theory 5.3). They are found once; then the plans, costs and bounds of
# a batch are a few matrix products. Shares that the frozen policy does not answer are asked from the mixture, one by
# one, and whatever is left from the solver itself.


Index = NDArray[np.intp]

# Farther states are left to the solver: squares of such numbers may overflow.
_FAR = 1e12


class ExplicitDecider:
    """The plans of `LibrarySolver`, much faster; see `Decider`.

    A state's plan depends on nothing that was asked before. It may depend on the batch by the last bits, since matrix
    products round by their size: the same batches give the same bits.

    Args:
        solver: The library solver of both, for what the tables do not answer.
        target: The target (n_x,), an equilibrium.
    """

    def __init__(self, design: Design, library: Library, solver: Solver, target: Array) -> None:
        self._design, self._target = design, target
        self._variants = tuple(zip((design, *design.late), library.variants, strict=True))
        self._parts: dict[int, tuple[_Part, ...]] = {}
        self._solver = OneByOne(solver, target, (design.horizon, design.plant.n_u))

    def prepare(self, late: int = 0) -> None:
        """Build the tables for positions `late` steps old now, rather than in the first decision that asks."""
        self._tables(late)

    def decide(self, x: Array, late: int, cov: Array | None = None) -> Decisions:  # noqa: ARG002 a design has its own
        """See `Decider`. States that are not finite have no plan."""
        if late >= len(self._variants):
            return self._solver.decide(x, late)
        shape = (self._design.horizon, self._design.plant.n_u)
        solved = np.asarray((np.abs(x) < _FAR).all(axis=1))  # NaN is not
        decisions = Decisions(solved, np.zeros((len(x), *shape)), *np.zeros((3, len(x))))
        self._look_up(x, late, decisions)
        (left,) = np.nonzero(~decisions.solved)
        if left.size:
            states, which = np.unique(x[left], axis=0, return_inverse=True)  # equal questions are asked once
            answers = self._solver.decide(states, late)
            which = which.reshape(-1)
            for name in ("solved", "inputs", "slack", "cost", "gap"):
                getattr(decisions, name)[left] = getattr(answers, name)[which]
        return decisions

    def _look_up(self, x: Array, late: int, decisions: Decisions) -> None:
        """Enter the certified plans of the states that are to be `solved`; the others are no longer solved."""
        parts = self._tables(late)
        (who,) = np.nonzero(decisions.solved)
        shares = [part.table.look_up(x[who][:, part.component.states]) for part in parts]
        # The solver gives up every component's frozen share where one of their QPs has no optimum.
        known = np.logical_and.reduce([share.known for share in shares])
        cost, lower, slack = np.zeros((3, who.size))
        for part, share in zip(parts, shares, strict=True):
            (mix,) = np.nonzero(known & ~share.accepted)
            slack[mix] += part.mix(x[who[mix]], mix, share)
            known &= _gap(share.cost, share.lower) <= TOLERANCE
            decisions.inputs[who[:, None], :, part.component.inputs] = share.inputs.transpose(0, 2, 1)
            cost += share.cost
            lower += share.lower
        decisions.solved[who] = known
        decisions.slack[who], decisions.cost[who], decisions.gap[who] = slack, cost, _gap(cost, lower)
        self._cut_back(decisions.inputs)

    def _cut_back(self, inputs: Array) -> None:
        """Cut plans (M, H, n_u) back to the limits of the inputs; the QPs' tolerance is all that is cut."""
        limits = self._design.input_set
        (beyond,) = np.nonzero((inputs @ limits.c.T > limits.b).any(axis=(1, 2)))
        cut = inside(inputs[beyond].reshape(-1, inputs.shape[2]), limits.c, limits.b)[0]
        inputs[beyond] = cut.reshape(-1, *inputs.shape[1:])

    def _tables(self, late: int) -> tuple[_Part, ...]:
        """What answers for positions `late` steps old; built when it is first asked for."""
        if late not in self._parts:
            design, libraries = self._variants[late]
            pairs = zip(decompose(design), libraries, strict=True)
            self._parts[late] = tuple(_Part(design, part, library, self._target) for part, library in pairs)
        return self._parts[late]


class _Part:
    """One component: its table of frozen answers, and its mixture for what the table does not accept."""

    def __init__(self, design: Design, component: Component, library: PartLibrary, target: Array) -> None:
        self.component = component
        self._problem = MeanProblem(design, horizon_of(design, component))
        self._mixture = Mixture(self._problem, library.policies(self._problem))
        self._target = target[component.states]
        self.table = FrozenTable(self._mixture, self._target)

    def mix(self, x: Array, who: Index, share: Found) -> Array:
        """Enter the mixture's plans from states x (M, n_x) of the plant as shares `who`; their slacks (M,).

        Where the mixture has none, the lower bound is -inf.
        """
        states, which = np.unique(x[:, self.component.states], axis=0, return_inverse=True)
        inputs, numbers = np.zeros((len(states), *share.inputs.shape[1:])), np.zeros((len(states), 3))
        problem = self._problem
        for i, state in enumerate(states):
            question = problem.question(state, self._target)
            lower, mixed = self._mixture.bounds(question)
            if mixed is None:
                numbers[i] = 0.0, -np.inf, 0.0
                continue
            numbers[i] = mixed.cost, lower, mixed.slack
            w, here = problem.z @ mixed.q + problem.w @ question.p, question.p[problem.n_p - problem.n_y :]
            inputs[i] = problem.inputs(w, here)
        which = which.reshape(-1)
        share.inputs[who] = inputs[which]
        share.cost[who], share.lower[who] = numbers[which, 0], numbers[which, 1]
        slack: Array = numbers[which, 2]
        return slack


def _gap(cost: Array, lower: Array) -> Array:
    """See `relative_gap`."""
    gap: Array = (cost - lower) / np.maximum(LEAST_COST, np.abs(cost))
    return gap
