"""Speed of one decision on this machine: the exact program beside the problem as printed, in one run.

All methods answer the same seeded states, one after the other, each warmed up first: building and compiling are
paid once in a flight and are not counted.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from statistics import median

import msgspec
import numpy as np
from numpy.typing import NDArray

from uavctl.data import SolveStatus
from uavctl.errors import UavctlError
from uavctl.smpc.answer import Solver
from uavctl.smpc.components import decompose
from uavctl.smpc.conic import ConicSolver
from uavctl.smpc.design import Design
from uavctl.smpc.printed import SOLVERS_OWN, PrintedSolver

Array = NDArray[np.float64]

# The joint problem as printed, under the solver's own settings, does not end well: a few solves are enough to say so.
JOINT_STATES = 3
_TRIES_PER_STATE = 50
_SHARE = 0.6  # of the way from the target to the limits: most such states can meet hard constraints
_KEPT = 1e-6


class BenchResult(msgspec.Struct, frozen=True, kw_only=True):
    """Medians in milliseconds, and ratios of them."""

    states: int
    components: int  # independent axes
    printed_ms: float  # the joint problem as printed, CVXPY
    printed_status: str  # how that ended; several endings are joined by commas
    printed_optimal: int  # how many of printed_states were solved
    printed_states: int
    cvxpy_axis_ms: float  # as printed, one axis, CVXPY with the problem compiled once
    exact_axis_ms: float  # the exact program, one axis
    exact_ms: float  # all axes
    ratio_cvxpy_exact: float  # as printed axis by axis / exact
    ratio_printed_exact: float  # as printed jointly / exact
    cost_difference: float  # largest relative difference of the two optimal costs


def run_bench(design: Design, states: int, seed: int, advance: Callable[[str], None]) -> BenchResult:
    """Time all methods on the same states.

    Args:
        design: What is decided.
        states: Number of states.
        seed: Of the states.
        advance: Told what is done next, `states` times for each of two methods and `joint_states(states)` times
            for the joint problem.

    Raises:
        UavctlError: No state from which the printed problem is feasible was found.
    """
    exact = ConicSolver(design)
    points = feasible_states(design, exact, states, seed)
    components = len(decompose(design))
    exact_ms, exact_cost, _ = _time(exact, points, design.target, lambda: advance("exact"))
    axes = PrintedSolver(design)
    axes_ms, axes_cost, _ = _time(axes, points, design.target, lambda: advance("printed, axis by axis"))
    joint = PrintedSolver(design, joint=True, regularization=SOLVERS_OWN)
    few = points[: joint_states(states)]
    joint_ms, _, endings = _time(joint, few, design.target, lambda: advance("printed, jointly"))
    differences = [abs(one / other - 1.0) for one, other in zip(axes_cost, exact_cost, strict=True)]
    return BenchResult(
        states=len(points),
        components=components,
        printed_ms=median(joint_ms),
        printed_status=", ".join(sorted(set(endings))),
        printed_optimal=endings.count(SolveStatus.OPTIMAL),
        printed_states=len(few),
        cvxpy_axis_ms=median(axes_ms) / components,
        exact_axis_ms=median(exact_ms) / components,
        exact_ms=median(exact_ms),
        ratio_cvxpy_exact=median(axes_ms) / median(exact_ms),
        ratio_printed_exact=median(joint_ms) / median(exact_ms),
        cost_difference=max(differences),
    )


def joint_states(states: int) -> int:
    """On how many of the states the joint problem is tried."""
    return min(states, JOINT_STATES)


def feasible_states(design: Design, exact: Solver, states: int, seed: int) -> list[Array]:
    """Seeded states (n_x,) around the target from which every hard constraint can be kept.

    Raises:
        UavctlError: None was found.
    """
    rng = np.random.default_rng(seed)
    limits = _box(design)
    found: list[Array] = []
    for _ in range(_TRIES_PER_STATE * states):
        x = design.target + _SHARE * (rng.uniform(*limits) - design.target)
        answer = exact.solve(0, x, design.target)
        misses = answer.slack + answer.offset + answer.terminal_miss
        if answer.status is SolveStatus.OPTIMAL and misses < _KEPT:
            found.append(x)
        if len(found) == states:
            return found
    if not found:
        raise UavctlError("no state was found from which the constraints can be kept; widen the limits in [sets]")
    return found


def _box(design: Design) -> tuple[Array, Array]:
    """Bounding box of the state set; a state without limits stays at the target's."""
    lower, upper = design.target.copy(), design.target.copy()
    for row, side in zip(design.state_set.c, design.state_set.b, strict=True):
        (used,) = np.nonzero(row)
        if used.size == 1:
            (upper if row[used[0]] > 0 else lower)[used[0]] = side / row[used[0]]
    return lower, upper


def _time(
    solver: Solver, points: list[Array], target: Array, advance: Callable[[], None]
) -> tuple[list[float], list[float], list[SolveStatus]]:
    """Milliseconds, costs and endings, one a state."""
    solver.solve(0, points[0], target)
    times, costs, endings = [], [], []
    for x in points:
        advance()
        start = time.perf_counter()
        answer = solver.solve(0, x, target)
        times.append((time.perf_counter() - start) * 1e3)
        costs.append(answer.cost)
        endings.append(answer.status)
    return times, costs, endings
