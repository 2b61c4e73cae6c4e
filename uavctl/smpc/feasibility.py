"""Offline questions about a design: can its schedule meet the terminal condition, and at what cost is a state left?"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from uavctl.data import SolveStatus
from uavctl.errors import DesignError
from uavctl.smpc.assemble import KEPT
from uavctl.smpc.components import decompose
from uavctl.smpc.cones import Expression, ProgramBuilder
from uavctl.smpc.conic import ConicSolver
from uavctl.smpc.design import Design
from uavctl.smpc.horizon import Affine, Horizon, horizon_of
from uavctl.smpc.reduction import TerminalBound, terminal_bound

Array = NDArray[np.float64]

# Below this margin the terminal condition has no usable interior as it stands, and is reduced once more.
LEAST_MARGIN = 1e-6


def check_schedule(design: Design) -> float:
    """Margin s* of the terminal condition: max s with I - L_z⁻¹ Cov(z) L_z⁻ᵀ ⪰ s I over all gains of the schedule.

    Where that leaves no interior (s* <= 1e-6), constant directions are taken out and s* is that of the reduced
    condition, which is the one that the solver sees.

    Returns:
        s*, the least of all components.

    Raises:
        DesignError: s* < 0: the schedule feeds back later than the terminal law does.
    """
    return min(_component_margin(horizon_of(design, component)) for component in decompose(design))


def _component_margin(horizon: Horizon) -> float:
    margin = _margin(terminal_bound(horizon, move_constants=False))
    if margin <= LEAST_MARGIN:
        margin = _margin(terminal_bound(horizon))
    if margin <= LEAST_MARGIN:
        raise DesignError(
            "schedule.delays",
            f"the schedule is slower than the terminal law (s* = {margin:.2g}): no feedback keeps the terminal "
            "covariance within its bound",
            f"use at most tau + 1 = {horizon.tau + 1} from stage {horizon.tau + 1} on",
        )
    return margin


def _margin(bound: TerminalBound) -> float:
    """Max s with (1 - s) I ⪰ Y Yᵀ and `fixed` = 0; -inf where no gain meets the equalities."""
    if bound.least < -LEAST_MARGIN:
        return bound.least
    n_theta = bound.y.matrix.shape[1]
    if not n_theta:
        largest = np.linalg.norm(bound.y.offset.reshape(bound.rows, bound.columns), 2) if bound.y.offset.size else 0.0
        return float(1.0 - largest**2)
    builder = ProgramBuilder(n_theta + 1, 0)
    builder.quadratic(slice(n_theta, n_theta + 1), np.zeros((1, 1)), -np.ones(1))
    triangle = _expression(bound.triangle())
    size = bound.rows + bound.columns
    diagonal = np.cumsum(np.arange(1, size + 1)) - 1
    triangle.var[diagonal[: bound.rows], n_theta] = -1.0
    builder.semidefinite(triangle, size)
    if bound.fixed.offset.size:
        builder.zero(_expression(bound.fixed))
    solution = builder.build(max_iterations=200).solve(np.zeros(0))
    return -solution.cost if solution.status in ("Solved", "AlmostSolved") else -np.inf


def _expression(affine: Affine) -> Expression:
    """The map of θ as one of (θ, s)."""
    size = affine.offset.size
    return Expression(
        np.hstack([affine.matrix.toarray(), np.zeros((size, 1))]), np.zeros((size, 0)), affine.offset.astype(np.float64)
    )


@lru_cache(maxsize=1)
def _solver(design: Design) -> ConicSolver | None:
    """The last design's solver, None where its schedule will not do.

    A search asks for the cost of many states of one design in a row; margin and programs are the design's alone.
    """
    try:
        check_schedule(design)
    except DesignError:
        return None
    return ConicSolver(design)


def optimal_cost(design: Design, x: Array) -> float | None:
    """Optimal cost (19a) from a state (n_x,) to the design's target, None where (19) is infeasible."""
    solver = _solver(design)
    if solver is None:
        return None
    answer = solver.solve(0, x, design.target)
    if answer.status is not SolveStatus.OPTIMAL:
        return None
    return None if max(answer.slack, answer.offset, answer.terminal_miss) > KEPT else answer.cost
