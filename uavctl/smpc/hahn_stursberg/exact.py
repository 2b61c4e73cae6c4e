"""The exact decision problem, component by component, in Clarabel.

1. Problem (19) with a reduced terminal condition, state constraints softened by exact penalties, and an artificial
   reference: the plan ends in the equilibrium nearest to the target that can be reached.
2. Where N steps reach no equilibrium, a second program softens the terminal equality; the answer lists it as relaxed.
3. `assemble` joins the answers of the components to the answer for the plant.
4. `check_schedule` is the margin of the terminal condition; `optimal_cost` the cost of a state.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from msgspec import structs

from uavctl.arrays import Array, sum_in_order
from uavctl.errors import DesignError
from uavctl.records import GaveWay, SolveStatus
from uavctl.smpc.answer import KEPT_TOLERANCE, NOMINAL, Answer, Preview, clip_inputs, is_finite, relative_gap
from uavctl.smpc.hahn_stursberg.components import Component, decompose
from uavctl.smpc.hahn_stursberg.cones import BREAKDOWN, Expression, ProgramBuilder, Solution
from uavctl.smpc.hahn_stursberg.design import Design
from uavctl.smpc.hahn_stursberg.horizon import Affine, Horizon, TerminalBound, make_horizon, stack_rows, terminal_bound
from uavctl.smpc.hahn_stursberg.mean import MeanPlan
from uavctl.smpc.hahn_stursberg.program import Program, terminal_backoff_x

# Status of a plan: the worst of its components, the later in this list.
_ORDER = (
    SolveStatus.OPTIMAL,
    SolveStatus.INACCURATE,
    SolveStatus.ITERATION_LIMIT,
    SolveStatus.INFEASIBLE,
    SolveStatus.FAILED,
)


@dataclass(frozen=True, eq=False)
class PartAnswer:
    """Answer of a component, in its coordinates and rows; the fields are those of `Answer`."""

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

    @classmethod
    def failed(cls, status: SolveStatus, iterations: int = 0) -> PartAnswer:
        """Return an answer without a plan."""
        empty = np.zeros((0, 0))
        return cls(status, iterations, empty, empty, empty, np.zeros(0), np.inf, np.inf, np.inf, np.inf, -np.inf)

    @classmethod
    def proven(
        cls, plan: MeanPlan, i: int, backoffs: tuple[Array, Array], cost: np.float64, cost_lower: np.float64
    ) -> PartAnswer:
        """Return plan `i` as the optimum, without slack, with the back-offs of its state and input rows."""
        return cls(
            status=SolveStatus.OPTIMAL,
            iterations=0,
            inputs=plan.inputs[i],
            backoff_x=backoffs[0],
            backoff_u=backoffs[1],
            reference=plan.reference[i],
            slack=0.0,
            offset=float(plan.off_target[i].sum()),
            terminal_miss=0.0,
            cost=float(cost),
            cost_lower=float(cost_lower),
        )


def assemble(
    design: Design,
    seq: int,
    method: str,
    x: Array,
    parts: Sequence[tuple[Component, PartAnswer]],
    preview: Preview = NOMINAL,
) -> Answer:
    """Assemble the answer for the plant from `x` (n_x,); without a plan if a component has none."""
    status = max((part.status for _, part in parts), key=_ORDER.index)
    iterations = sum(part.iterations for _, part in parts)
    if status not in (SolveStatus.OPTIMAL, SolveStatus.INACCURATE):
        return Answer.failed(seq, status, method, iterations)
    inputs = np.zeros((design.horizon, design.plant.n_u))
    backoff_x = np.zeros((design.horizon + 1, design.state_set.b.size))
    backoff_u = np.zeros((design.horizon, design.input_set.b.size))
    reference = np.zeros(design.plant.n_x)
    for where, part in parts:
        inputs[:, where.inputs] = part.inputs
        backoff_x[:, where.rows_x] = part.backoff_x
        backoff_u[:, where.rows_u] = part.backoff_u
        reference[where.states] = part.reference
    cost, cost_lower = sum_in_order(part.cost for _, part in parts), sum_in_order(part.cost_lower for _, part in parts)
    answer = Answer(
        seq=seq,
        status=status,
        method=method,
        inputs=inputs,
        states=_predict(design, x, inputs),
        backoff_x=backoff_x,
        backoff_u=backoff_u,
        reference=reference,
        slack=sum_in_order(part.slack for _, part in parts),
        offset=sum_in_order(part.offset for _, part in parts),
        terminal_miss=sum_in_order(part.terminal_miss for _, part in parts),
        cost=cost,
        cost_lower=cost_lower,
        gap=relative_gap(cost, cost_lower),
        iterations=iterations,
    )
    return add_relaxed(design, answer, [component for component, _ in parts], preview)


def add_relaxed(design: Design, answer: Answer, components: Sequence[Component], preview: Preview) -> Answer:
    """Add the relaxed constraints to an answer, if there are any."""
    if max(answer.slack, answer.terminal_miss) <= KEPT_TOLERANCE and preview.limits is None:
        return answer
    return structs.replace(answer, relaxed=find_relaxed(design, answer, components, preview))


def find_relaxed(
    design: Design, answer: Answer, components: Sequence[Component], preview: Preview
) -> tuple[GaveWay, ...]:
    """Return the relaxed constraints of an answer: tightened state rows, terminal rows, the terminal equality."""
    limits = preview.limits
    if limits is None:
        limits = np.tile(design.state_set.b, (design.horizon + 1, 1))
    free = design.horizon - design.terminal.tau
    relaxed: list[GaveWay] = []

    def add(constraint: str, stage: int, excess: Array) -> None:
        for i in np.flatnonzero(excess > KEPT_TOLERANCE):
            relaxed.append(GaveWay(constraint=constraint, stage=stage, index=int(i), amount=float(excess[i])))

    # C x̄_t + β_t - b_t,  C x_s + β_terminal - min_{t>=N} b_t,  |x̄_N - x_s|
    excess = answer.states @ design.state_set.c.T + answer.backoff_x - limits
    for t in range(1, design.horizon + 1):
        add("state", t, excess[t])
    backoff = np.zeros(design.state_set.b.size)
    for part in components:
        backoff[part.rows_x] = terminal_backoff_x(design, part)
    reference_values = design.state_set.c @ answer.reference
    add("terminal", free, reference_values + backoff - limits[free:].min(axis=0))
    add("equilibrium", free, np.abs(answer.states[free] - answer.reference))
    return tuple(relaxed)


def _predict(design: Design, x: Array, inputs: Array) -> Array:
    """Predict the mean states (H+1, n_x)."""
    # x̄_{t+1} = A x̄_t + B u_t
    states = [x]
    for u in inputs:
        states.append(design.plant.a @ states[-1] + design.plant.b @ u)
    return np.array(states)


METHOD = "exact"

# Largest relative gap of an optimal answer. Clarabel's gap is relative to its largest numbers, which may be prices.
_MAX_GAP = 1e-4

# Clarabel's status as a `SolveStatus`; a test checks that the table is complete.
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

    The same question gives the same bits after any other questions. Not for concurrent use.
    """

    def __init__(self, design: Design) -> None:
        """Build the programs of every component.

        Raises:
            DesignError: The design cannot be decomposed, or its schedule does not fit its terminal law.
        """
        self._design = design
        self._parts = tuple(PartSolver(design, component) for component in decompose(design))
        self._late: dict[int, ConicSolver] = {}

    def solve(self, seq: int, x: Array, target: Array, preview: Preview = NOMINAL) -> Answer:
        """Plan from `x` (n_x,) to the equilibrium `target` (n_x,), with a preview.

        Numbers that are not finite give an answer FAILED, as does a solver that breaks down; nothing is raised.
        """
        if not is_finite(x, target, preview) or not 0 <= preview.age <= len(self._design.late):
            return Answer.failed(seq, SolveStatus.FAILED, METHOD)
        if preview.age:
            return self._find_late_solver(preview.age).solve(seq, x, target, structs.replace(preview, age=0))
        parts = [(part.component, part.solve(x, target, preview)) for part in self._parts]
        return assemble(self._design, seq, METHOD, x, parts, preview)

    def _find_late_solver(self, late: int) -> ConicSolver:
        """Return the solver for positions `late` steps old; it is built at its first use."""
        if late not in self._late:
            self._late[late] = ConicSolver(self._design.late[late - 1])
        return self._late[late]


class PartSolver:
    """Solver of one component: the program with a hard terminal equality, then the soft one."""

    def __init__(self, design: Design, component: Component) -> None:
        self.component = component
        self.design = design
        self.horizon = make_horizon(design, component)
        self._hard = Program(design, self.horizon, soft_terminal=False)
        self._soft = Program(design, self.horizon, soft_terminal=True)
        self._error_variance = np.einsum("ij,jk,ik->i", component.c_x, component.estimate_cov, component.c_x)
        self._noise_x = stack_rows([self.horizon.state_noise(t, component.c_x) for t in range(design.horizon + 1)])
        self._noise_u = stack_rows([self.horizon.input_noise(t, component.c_u) for t in range(design.horizon)])

    def solve(self, x: Array, target: Array, preview: Preview = NOMINAL) -> PartAnswer:
        """Solve for the plant's state, target and preview."""
        x, target = x[self.component.states], target[self.component.states]
        program = self._hard
        solution = program.conic.solve(program.parameters(x, target, preview))
        status, iterations = _STATUS[solution.status], solution.iterations
        if status not in (SolveStatus.OPTIMAL, SolveStatus.ITERATION_LIMIT):
            program = self._soft
            solution = program.conic.solve(program.parameters(x, target, preview))
            status = _STATUS[solution.status]
            iterations += solution.iterations
        if not (np.all(np.isfinite(solution.variables)) and np.isfinite(solution.cost)):
            status = SolveStatus.FAILED
        return self._read_solution(program, solution, status, iterations, x, target)

    def backoffs(self, theta: Array) -> tuple[Array, Array]:
        """Return the back-offs of the state rows (H+1, m_x) and of the input rows (H, m_u) under gains `theta`."""
        # β_t = κ_t (‖noise_t(θ)‖² + c'Pc)^½, P the covariance of the estimate's error
        part, steps, width = self.component, self.horizon.steps, self.horizon.width
        noise_x = self._noise_x.evaluate(theta).reshape(steps + 1, part.b_x.size, width)
        noise_u = self._noise_u.evaluate(theta).reshape(steps, part.b_u.size, width)
        backoff_x: Array = self.design.kappa_x[:, None] * np.sqrt((noise_x**2).sum(axis=2) + self._error_variance)
        backoff_u: Array = self.design.kappa_u[:, None] * np.sqrt((noise_u**2).sum(axis=2))
        return backoff_x, backoff_u

    def _read_solution(
        self, program: Program, solution: Solution, status: SolveStatus, iterations: int, x: Array, target: Array
    ) -> PartAnswer:
        part, horizon, layout, values = self.component, self.horizon, program.layout, solution.variables
        y_now = part.coordinates @ x
        y = y_now + values[layout.y]
        unclipped = np.repeat((part.u_eq @ y)[None], horizon.steps, axis=0)
        unclipped[: horizon.free] = values[layout.v].reshape(horizon.free, -1) + part.u_eq @ y_now
        inputs, kept = clip_inputs(unclipped, part.c_u, part.b_u)
        unproven = relative_gap(solution.cost, solution.cost_lower) > _MAX_GAP
        if (unproven or not kept) and status is SolveStatus.OPTIMAL:
            status = SolveStatus.INACCURATE
        backoff_x, backoff_u = self.backoffs(values[layout.theta])
        return PartAnswer(
            status=status,
            iterations=iterations,
            inputs=inputs,
            backoff_x=backoff_x,
            backoff_u=backoff_u,
            reference=part.x_eq @ y,
            slack=_sum_positive(values[layout.slack]),
            offset=float(np.sum(np.abs(y - part.coordinates @ target))),
            terminal_miss=_sum_positive(values[layout.miss]) + _sum_positive(values[layout.outside]),
            cost=solution.cost,
            cost_lower=solution.cost_lower,
        )


def _sum_positive(values: Array) -> float:
    return float(np.sum(np.maximum(values, 0.0)))


# Below this margin the terminal condition has no usable interior, and constant directions are removed.
MIN_MARGIN = 1e-6


def check_schedule(design: Design) -> float:
    """Return the margin s* of the terminal condition: max s with I - L_z⁻¹ Cov(z) L_z⁻ᵀ ⪰ s I over all gains.

    Without an interior (s* <= 1e-6), constant directions are removed, and s* is that of the reduced condition, which is
    the solver's.

    Returns:
        s*, the least of all components.

    Raises:
        DesignError: s* < 0: the schedule feeds back later than the terminal law does.
    """
    return min(_component_margin(make_horizon(design, component)) for component in decompose(design))


def _component_margin(horizon: Horizon) -> float:
    margin = _margin(terminal_bound(horizon, move_constants=False))
    if margin <= MIN_MARGIN:
        margin = _margin(terminal_bound(horizon))
    if margin <= MIN_MARGIN:
        raise DesignError(
            "schedule.delays",
            f"the schedule is slower than the terminal law (s* = {margin:.2g}): no feedback keeps the terminal "
            "covariance within its bound",
            f"use at most tau + 1 = {horizon.tau + 1} from stage {horizon.tau + 1} on",
        )
    return margin


def _margin(bound: TerminalBound) -> float:
    """Return max s with (1 - s) I ⪰ Y Y' and `fixed` = 0; -inf where no gain meets the equalities."""
    if bound.least_eigenvalue < -MIN_MARGIN:
        return bound.least_eigenvalue
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
    """Return the map of θ as a map of (θ, s)."""
    size = affine.offset.size
    return Expression(
        np.hstack([affine.matrix.toarray(), np.zeros((size, 1))]), np.zeros((size, 0)), affine.offset.astype(np.float64)
    )


@lru_cache(maxsize=1)
def _find_solver(design: Design) -> ConicSolver | None:
    """Return the solver of the last design, None if its schedule is infeasible.

    A search asks for the costs of many states of one design in a row; margin and programs depend on the design alone.
    """
    try:
        check_schedule(design)
    except DesignError:
        return None
    return ConicSolver(design)


def optimal_cost(design: Design, x: Array) -> float | None:
    """Return the optimal cost (19a) from a state (n_x,) to the design's target, None where (19) is infeasible."""
    solver = _find_solver(design)
    if solver is None:
        return None
    answer = solver.solve(0, x, design.target)
    if answer.status is not SolveStatus.OPTIMAL:
        return None
    return None if max(answer.slack, answer.offset, answer.terminal_miss) > KEPT_TOLERANCE else answer.cost
