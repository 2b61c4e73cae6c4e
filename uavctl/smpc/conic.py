"""The exact decision problem, component by component, in Clarabel.

Problem (19) with its terminal condition reduced, state constraints softened by exact penalties, and an artificial
reference: the plan ends in the equilibrium nearest to the target that can be reached. Where no equilibrium is within
reach of N steps, a second program lets the terminal equality give way, and the answer says so.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from uavctl.data import SolveStatus
from uavctl.smpc.answer import Answer
from uavctl.smpc.assemble import PartAnswer, assemble, inside
from uavctl.smpc.components import Component, decompose
from uavctl.smpc.cones import BREAKDOWN, Solution
from uavctl.smpc.design import Design
from uavctl.smpc.horizon import Affine, Horizon
from uavctl.smpc.program import Program

Array = NDArray[np.float64]

METHOD = "exact"

# What each ending of the solver means for a flight; a test holds the table complete.
_STATUS = {
    "Solved": SolveStatus.OPTIMAL,
    "AlmostSolved": SolveStatus.INACCURATE,
    "InsufficientProgress": SolveStatus.INACCURATE,
    "PrimalInfeasible": SolveStatus.INFEASIBLE,
    "AlmostPrimalInfeasible": SolveStatus.INFEASIBLE,
    "MaxIterations": SolveStatus.ITERATION_LIMIT,
    "MaxTime": SolveStatus.FAILED,
    "DualInfeasible": SolveStatus.FAILED,
    "AlmostDualInfeasible": SolveStatus.FAILED,
    "NumericalError": SolveStatus.FAILED,
    "CallbackTerminated": SolveStatus.FAILED,
    "Unsolved": SolveStatus.FAILED,
    BREAKDOWN: SolveStatus.FAILED,
}


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
        parts = [(part.component, part.solve(x, target)) for part in self._parts]
        return assemble(design, seq, METHOD, x, parts)


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

    def solve(self, x: Array, target: Array) -> PartAnswer:
        """Solve for the whole plant's state and target."""
        x, target = x[self.component.states], target[self.component.states]
        program = self._exact
        solution = program.conic.solve(program.parameters(x, target))
        status, iterations = _STATUS[solution.status], solution.iterations
        if status not in (SolveStatus.OPTIMAL, SolveStatus.ITERATION_LIMIT):
            program = self._missing
            solution = program.conic.solve(program.parameters(x, target))
            status = _STATUS[solution.status]
            iterations += solution.iterations
        if not (np.all(np.isfinite(solution.variables)) and np.isfinite(solution.cost)):
            status = SolveStatus.FAILED
        return self._read(program, solution, status, iterations, x, target)

    def _read(
        self, program: Program, solution: Solution, status: SolveStatus, iterations: int, x: Array, target: Array
    ) -> PartAnswer:
        part, horizon, layout, values = self.component, self._horizon, program.layout, solution.variables
        here = x[part.positions]
        y = here + values[layout.y]
        wanted = np.repeat((part.u_eq @ y)[None], horizon.steps, axis=0)
        wanted[: horizon.free] = values[layout.v].reshape(horizon.free, -1) + part.u_eq @ here
        inputs, kept = inside(wanted, part.c_u, part.b_u)
        if not kept and status is SolveStatus.OPTIMAL:
            status = SolveStatus.INACCURATE
        theta = values[layout.theta]
        return PartAnswer(
            status=status,
            iterations=iterations,
            inputs=inputs,
            backoff_x=_backoff(self._noise_x, theta, self._design.kappa_x, part.b_x.size, horizon.width),
            backoff_u=_backoff(self._noise_u, theta, self._design.kappa_u, part.b_u.size, horizon.width),
            reference=part.x_eq @ y,
            slack=_total(values[layout.slack]),
            offset=float(np.sum(np.abs(y - target[part.positions]))),
            terminal_miss=_total(values[layout.miss]),
            cost=solution.cost,
            cost_lower=solution.cost_lower,
        )


def _total(values: Array) -> float:
    return float(np.sum(np.maximum(values, 0.0)))


def _backoff(noise: list[Affine], theta: Array, kappa: Array, rows: int, width: int) -> Array:
    """κ_t ‖·‖ of every row and stage (stages, rows)."""
    norms = [np.linalg.norm(stage.at(theta).reshape(rows, width), axis=1) for stage in noise]
    backoff: Array = kappa[:, None] * np.array(norms)
    return backoff
