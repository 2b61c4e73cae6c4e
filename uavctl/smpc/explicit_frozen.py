"""The frozen answer of one component as a table: its plans, costs and lower bounds for many states at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uavctl.smpc.explicit_regions import LEFT, Critical, Parametric, critical_regions
from uavctl.smpc.frozen import Frozen
from uavctl.smpc.meanqp import Kind, MeanProblem
from uavctl.smpc.mixture import Mixture
from uavctl.smpc.qp import OPEN, SOFT
from uavctl.smpc.region import state_box

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

# A state without limits is looked up within so many standard deviations around the target.
_SPREAD = 6.0


@dataclass(frozen=True, eq=False)
class Found:
    """What the table knows of M states.

    Attributes:
        known: Whether the frozen QP is known to have a solution (M,); only then do the others mean something.
        accepted: Whether that is the joint optimum: the KKT conditions hold (M,).
        inputs: Mean inputs (M, H, n_u), before they are cut back to their limits.
        cost: Cost of the plan (M,), where it is accepted.
        lower: Lower bound of the optimum (M,): the Lagrangian's value at the multipliers.
    """

    known: Flags
    accepted: Flags
    inputs: Array
    cost: Array
    lower: Array


@dataclass(frozen=True, eq=False)
class _Piece:
    """One critical region; maps are of x1 = (1, x).

    Attributes:
        facets: (1 + n, k): x is within where no value is positive.
        multipliers: (1 + n, r): those that must be within bounds.
        allowed: Bounds (r,) of their size.
        inputs: (1 + n, H n_u).
        bounds: (monomials, 2): cost and lower bound, of the products of x1's entries.
    """

    facets: Array
    multipliers: Array
    allowed: Array
    inputs: Array
    bounds: Array


class FrozenTable:
    """The frozen answers of one component towards a fixed target.

    Args:
        mixture: The component's library.
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
        off = np.array([row.kind is Kind.OFFSET for row in problem.rows])
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
