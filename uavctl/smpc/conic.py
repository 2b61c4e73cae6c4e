"""The exact decision problem, component by component, in Clarabel.

Problem (19) with its terminal condition reduced, state constraints softened by exact penalties, and an artificial
reference: the plan ends in the equilibrium nearest to the target that can be reached. Where no equilibrium is within
reach of N steps, a second program lets the terminal equality give way, and the answer says so.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from uavctl.data import SolveStatus
from uavctl.smpc.answer import NOMINAL, Answer, Outlook, finite, relative_gap
from uavctl.smpc.assemble import PartAnswer, assemble, inside
from uavctl.smpc.components import Component, decompose
from uavctl.smpc.cones import BREAKDOWN, Solution
from uavctl.smpc.design import Design
from uavctl.smpc.horizon import Affine, horizon_of
from uavctl.smpc.program import Program

Array = NDArray[np.float64]

METHOD = "exact"

# The solver ends when the gap is small beside its largest numbers; where prices dwarf the cost, that proves nothing.
_PROVEN = 1e-4

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
        self._parts = tuple(PartSolver(design, component) for component in decompose(design))
        self._late: dict[int, ConicSolver] = {}

    def solve(self, seq: int, x: Array, target: Array, outlook: Outlook = NOMINAL) -> Answer:
        """Plan from `x` (n_x,) towards the equilibrium `target` (n_x,), with what is known ahead.

        Numbers that are not finite give an answer FAILED, as does a solver that breaks down; nothing is raised.
        """
        if not finite(x, target, outlook) or outlook.late > len(self._design.late):
            return Answer.failed(seq, SolveStatus.FAILED, METHOD)
        if outlook.late:
            return self._of_late(outlook.late).solve(seq, x, target, replace(outlook, late=0))
        parts = [(part.component, part.solve(x, target, outlook)) for part in self._parts]
        return assemble(self._design, seq, METHOD, x, parts, outlook)

    def _of_late(self, late: int) -> ConicSolver:
        """The solver of the design for positions `late` steps old; built when it is first asked for."""
        if late not in self._late:
            self._late[late] = ConicSolver(self._design.late[late - 1])
        return self._late[late]


class PartSolver:
    """The two programs of one component, and how their solutions are read."""

    def __init__(self, design: Design, component: Component) -> None:
        self.component = component
        self._design = design
        self._horizon = horizon_of(design, component)
        self._exact = Program(design, self._horizon, soft_terminal=False)
        self._missing = Program(design, self._horizon, soft_terminal=True)
        self._unseen = np.einsum("ij,jk,ik->i", component.c_x, component.estimate_cov, component.c_x)
        self._noise_x = [self._horizon.state_noise(t, component.c_x) for t in range(design.horizon + 1)]
        self._noise_u = [self._horizon.input_noise(t, component.c_u) for t in range(design.horizon)]

    def solve(self, x: Array, target: Array, outlook: Outlook = NOMINAL) -> PartAnswer:
        """Solve for the whole plant's state, target and outlook."""
        x, target = x[self.component.states], target[self.component.states]
        program = self._exact
        solution = program.conic.solve(program.parameters(x, target, outlook))
        status, iterations = _STATUS[solution.status], solution.iterations
        if status not in (SolveStatus.OPTIMAL, SolveStatus.ITERATION_LIMIT):
            program = self._missing
            solution = program.conic.solve(program.parameters(x, target, outlook))
            status = _STATUS[solution.status]
            iterations += solution.iterations
        if not (np.all(np.isfinite(solution.variables)) and np.isfinite(solution.cost)):
            status = SolveStatus.FAILED
        return self._read(program, solution, status, iterations, x, target)

    def _read(
        self, program: Program, solution: Solution, status: SolveStatus, iterations: int, x: Array, target: Array
    ) -> PartAnswer:
        part, horizon, layout, values = self.component, self._horizon, program.layout, solution.variables
        here = part.coordinates @ x
        y = here + values[layout.y]
        wanted = np.repeat((part.u_eq @ y)[None], horizon.steps, axis=0)
        wanted[: horizon.free] = values[layout.v].reshape(horizon.free, -1) + part.u_eq @ here
        inputs, kept = inside(wanted, part.c_u, part.b_u)
        unproven = relative_gap(solution.cost, solution.cost_lower) > _PROVEN
        if (unproven or not kept) and status is SolveStatus.OPTIMAL:
            status = SolveStatus.INACCURATE
        theta = values[layout.theta]
        return PartAnswer(
            status=status,
            iterations=iterations,
            inputs=inputs,
            backoff_x=_backoff(self._noise_x, theta, self._design.kappa_x, self._unseen, horizon.width),
            backoff_u=_backoff(self._noise_u, theta, self._design.kappa_u, np.zeros(part.b_u.size), horizon.width),
            reference=part.x_eq @ y,
            slack=_total(values[layout.slack]),
            offset=float(np.sum(np.abs(y - part.coordinates @ target))),
            terminal_miss=_total(values[layout.miss]) + _total(values[layout.outside]),
            cost=solution.cost,
            cost_lower=solution.cost_lower,
        )


def _total(values: Array) -> float:
    return float(np.sum(np.maximum(values, 0.0)))


def _backoff(noise: list[Affine], theta: Array, kappa: Array, unseen: Array, width: int) -> Array:
    """κ_t (‖·‖² + unseen)^½ of every row and stage (stages, rows)."""
    squares = [np.sum(stage.at(theta).reshape(unseen.size, width) ** 2, axis=1) for stage in noise]
    backoff: Array = kappa[:, None] * np.sqrt(np.array(squares) + unseen)
    return backoff
