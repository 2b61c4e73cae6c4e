"""The exact decision problem, component by component, in Clarabel.

Problem (19) with its terminal condition reduced, state constraints softened by exact penalties, and an artificial
reference: the plan ends in the equilibrium nearest to the target that can be reached. Where no equilibrium is within
reach of N steps, a second program lets the terminal equality give way, and the answer says so.
"""

from __future__ import annotations

from dataclasses import dataclass

import clarabel
import numpy as np
from numpy.typing import NDArray

from uavctl.data import SolveStatus
from uavctl.smpc.answer import Answer, relative_gap
from uavctl.smpc.components import Component, decompose
from uavctl.smpc.cones import Solution
from uavctl.smpc.design import Design
from uavctl.smpc.horizon import Affine, Horizon
from uavctl.smpc.program import Program

Array = NDArray[np.float64]

METHOD = "exact"

# A mean input may pass a hard limit by this much before it is cut back [input units]; more is not an optimum.
INPUT_TOLERANCE = 1e-6

# What each ending of the solver means for a flight; anything that is not here is a failure.
_STATUS = {
    str(clarabel.SolverStatus.Solved): SolveStatus.OPTIMAL,
    str(clarabel.SolverStatus.AlmostSolved): SolveStatus.INACCURATE,
    str(clarabel.SolverStatus.InsufficientProgress): SolveStatus.INACCURATE,
    str(clarabel.SolverStatus.PrimalInfeasible): SolveStatus.INFEASIBLE,
    str(clarabel.SolverStatus.AlmostPrimalInfeasible): SolveStatus.INFEASIBLE,
    str(clarabel.SolverStatus.MaxIterations): SolveStatus.ITERATION_LIMIT,
    str(clarabel.SolverStatus.MaxTime): SolveStatus.FAILED,
    str(clarabel.SolverStatus.DualInfeasible): SolveStatus.FAILED,
    str(clarabel.SolverStatus.AlmostDualInfeasible): SolveStatus.FAILED,
    str(clarabel.SolverStatus.NumericalError): SolveStatus.FAILED,
    str(clarabel.SolverStatus.CallbackTerminated): SolveStatus.FAILED,
    str(clarabel.SolverStatus.Unsolved): SolveStatus.FAILED,
}

# The worst of several components' endings is the plan's: the later in this list, the worse.
_ORDER = (
    SolveStatus.OPTIMAL,
    SolveStatus.INACCURATE,
    SolveStatus.ITERATION_LIMIT,
    SolveStatus.INFEASIBLE,
    SolveStatus.FAILED,
)


@dataclass(frozen=True, eq=False)
class _PartAnswer:
    """A component's share of an answer, in its own coordinates and rows."""

    status: SolveStatus
    iterations: int
    inputs: Array
    backoff_x: Array
    backoff_u: Array
    reference: Array
    slack: float
    offset: float
    terminal_miss: float
    cost: float
    cost_lower: float


class ConicSolver:
    """Solves the decision problem of a design; built once, then only right sides change.

    The same question gives the same bits whatever was asked before. Not for concurrent use.
    """

    def __init__(self, design: Design) -> None:
        """Build the programs of every component.

        Raises:
            DesignError: The design cannot be decomposed, or its schedule does not fit its terminal law.
        """
        self._design = design
        self._parts = tuple(_PartSolver(design, component) for component in decompose(design))

    def solve(self, seq: int, x: Array, target: Array) -> Answer:
        """Plan from `x` (n_x,) towards the equilibrium `target` (n_x,).

        Numbers that are not finite give an answer FAILED, as does a solver that breaks down; nothing is raised.
        """
        design = self._design
        if not (np.all(np.isfinite(x)) and np.all(np.isfinite(target))):
            return Answer.failed(seq, SolveStatus.FAILED, METHOD)
        parts = [part.solve(x, target) for part in self._parts]
        status = max((part.status for part in parts), key=_ORDER.index)
        iterations = sum(part.iterations for part in parts)
        if status not in (SolveStatus.OPTIMAL, SolveStatus.INACCURATE):
            return Answer.failed(seq, status, METHOD, iterations)
        inputs = np.zeros((design.horizon, design.plant.n_u))
        backoff_x = np.zeros((design.horizon + 1, design.state_set.b.size))
        backoff_u = np.zeros((design.horizon, design.input_set.b.size))
        reference = np.zeros(design.plant.n_x)
        for solver, part in zip(self._parts, parts, strict=True):
            where = solver.component
            inputs[:, where.inputs] = part.inputs
            backoff_x[:, where.rows_x] = part.backoff_x
            backoff_u[:, where.rows_u] = part.backoff_u
            reference[where.states] = part.reference
        cost, cost_lower = sum(part.cost for part in parts), sum(part.cost_lower for part in parts)
        return Answer(
            seq=seq,
            status=status,
            method=METHOD,
            inputs=inputs,
            states=_predict(design, x, inputs),
            backoff_x=backoff_x,
            backoff_u=backoff_u,
            reference=reference,
            slack=sum(part.slack for part in parts),
            offset=sum(part.offset for part in parts),
            terminal_miss=sum(part.terminal_miss for part in parts),
            cost=cost,
            cost_lower=cost_lower,
            gap=relative_gap(cost, cost_lower),
            iterations=iterations,
        )


class _PartSolver:
    """The two programs of one component, and how their solutions are read."""

    def __init__(self, design: Design, component: Component) -> None:
        self.component = component
        self._design = design
        self._horizon = Horizon(component, design.horizon, design.terminal.tau, design.schedule)
        self._exact = Program(design, self._horizon, soft_terminal=False)
        self._missing = Program(design, self._horizon, soft_terminal=True)
        self._noise_x = [self._horizon.state_noise(t, component.c_x) for t in range(design.horizon + 1)]
        self._noise_u = [self._horizon.input_noise(t, component.c_u) for t in range(design.horizon)]

    def solve(self, x: Array, target: Array) -> _PartAnswer:
        """Solve for the whole plant's state and target."""
        x, target = x[self.component.states], target[self.component.states]
        program = self._exact
        solution = program.conic.solve(program.parameters(x, target))
        status, iterations = _STATUS.get(str(solution.status), SolveStatus.FAILED), solution.iterations
        if status not in (SolveStatus.OPTIMAL, SolveStatus.ITERATION_LIMIT):
            program = self._missing
            solution = program.conic.solve(program.parameters(x, target))
            status = _STATUS.get(str(solution.status), SolveStatus.FAILED)
            iterations += solution.iterations
        if not (np.all(np.isfinite(solution.variables)) and np.isfinite(solution.cost)):
            status = SolveStatus.FAILED
        return self._read(program, solution, status, iterations, x, target)

    def _read(
        self, program: Program, solution: Solution, status: SolveStatus, iterations: int, x: Array, target: Array
    ) -> _PartAnswer:
        part, horizon, layout, values = self.component, self._horizon, program.layout, solution.variables
        here = x[part.positions]
        y = here + values[layout.y]
        wanted = np.repeat((part.u_eq @ y)[None], horizon.steps, axis=0)
        wanted[: horizon.free] = values[layout.v].reshape(horizon.free, -1) + part.u_eq @ here
        inputs = _inside(wanted, part.c_u, part.b_u)
        if np.max(np.abs(inputs - wanted), initial=0.0) > INPUT_TOLERANCE and status is SolveStatus.OPTIMAL:
            status = SolveStatus.INACCURATE
        theta = values[layout.theta]
        return _PartAnswer(
            status=status,
            iterations=iterations,
            inputs=inputs,
            backoff_x=_backoff(self._noise_x, theta, self._design.kappa_x, part.b_x.size),
            backoff_u=_backoff(self._noise_u, theta, self._design.kappa_u, part.b_u.size),
            reference=part.x_eq @ y,
            slack=_total(values[layout.slack]),
            offset=float(np.sum(np.abs(y - target[part.positions]))),
            terminal_miss=_total(values[layout.miss]),
            cost=solution.cost,
            cost_lower=solution.cost_lower,
        )


def _total(values: Array) -> float:
    return float(np.sum(np.maximum(values, 0.0)))


def _backoff(noise: list[Affine], theta: Array, kappa: Array, rows: int) -> Array:
    """κ_t ‖·‖ of every row and stage (stages, rows)."""
    norms = [np.linalg.norm(stage.at(theta).reshape(rows, -1), axis=1) for stage in noise]
    return np.asarray(kappa)[:, None] * np.array(norms)


def _inside(inputs: Array, c: Array, b: Array) -> Array:
    """Inputs (H, n_u) cut back to c u <= b; a row of one entry exactly, others along the row."""
    inside = inputs.copy()
    for row, side in zip(c, b, strict=True):
        (used,) = np.nonzero(row)
        excess = np.maximum(inside @ row - side, 0.0)
        inside -= np.outer(excess, row / (row @ row))
        if used.size == 1:
            limit = side / row[used[0]]
            clip = np.minimum if row[used[0]] > 0 else np.maximum
            inside[:, used[0]] = clip(inside[:, used[0]], limit)
    return inside


def _predict(design: Design, x: Array, inputs: Array) -> Array:
    states = [x]
    for u in inputs:
        states.append(design.plant.a @ states[-1] + design.plant.b @ u)
    return np.array(states)
