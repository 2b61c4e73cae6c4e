"""From the answers of independent components to the answer for the whole plant."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from uavctl.data import GaveWay, SolveStatus
from uavctl.smpc.answer import NOMINAL, Answer, Outlook, relative_gap
from uavctl.smpc.components import Component
from uavctl.smpc.design import Design
from uavctl.smpc.program import terminal_backoff_x

Array = NDArray[np.float64]

# A mean input may pass a hard limit by this much before it is cut back [input units]; more is not an optimum.
INPUT_TOLERANCE = 1e-6

# What still counts as a constraint kept (each in its own unit, or summed over a plan).
KEPT = 1e-6

# The worst of several components' endings is the plan's: the later in this list, the worse.
_ORDER = (
    SolveStatus.OPTIMAL,
    SolveStatus.INACCURATE,
    SolveStatus.ITERATION_LIMIT,
    SolveStatus.INFEASIBLE,
    SolveStatus.FAILED,
)


@dataclass(frozen=True, eq=False)
class PartAnswer:
    """A component's share of an answer, in its own coordinates and rows; the fields are those of `Answer`."""

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
        """A share without a plan."""
        empty = np.zeros((0, 0))
        return cls(status, iterations, empty, empty, empty, np.zeros(0), np.inf, np.inf, np.inf, np.inf, -np.inf)


def assemble(
    design: Design,
    seq: int,
    method: str,
    x: Array,
    parts: Sequence[tuple[Component, PartAnswer]],
    outlook: Outlook = NOMINAL,
) -> Answer:
    """Answer for the whole plant from `x` (n_x,); without a plan if a component has none."""
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
    cost, cost_lower = sum(part.cost for _, part in parts), sum(part.cost_lower for _, part in parts)
    answer = Answer(
        seq=seq,
        status=status,
        method=method,
        inputs=inputs,
        states=_predict(design, x, inputs),
        backoff_x=backoff_x,
        backoff_u=backoff_u,
        reference=reference,
        slack=sum(part.slack for _, part in parts),
        offset=sum(part.offset for _, part in parts),
        terminal_miss=sum(part.terminal_miss for _, part in parts),
        cost=cost,
        cost_lower=cost_lower,
        gap=relative_gap(cost, cost_lower),
        iterations=iterations,
    )
    return told(design, answer, [component for component, _ in parts], outlook)


def told(design: Design, answer: Answer, components: Sequence[Component], outlook: Outlook) -> Answer:
    """The answer with the names of what gave way, if anything did."""
    if max(answer.slack, answer.terminal_miss) <= KEPT and outlook.limits is None:
        return answer
    return replace(answer, gave_way=gave_way(design, answer, components, outlook))


def gave_way(design: Design, answer: Answer, components: Sequence[Component], outlook: Outlook) -> tuple[GaveWay, ...]:
    """Constraints that an answer does not keep: tightened state rows, terminal rows, the terminal equality."""
    limits = outlook.limits
    if limits is None:
        limits = np.tile(design.state_set.b, (design.horizon + 1, 1))
    free = design.horizon - design.terminal.tau
    given: list[GaveWay] = []

    def add(constraint: str, stage: int, excess: Array) -> None:
        for i in np.flatnonzero(excess > KEPT):
            given.append(GaveWay(constraint=constraint, stage=stage, index=int(i), amount=float(excess[i])))

    excess = answer.states @ design.state_set.c.T + answer.backoff_x - limits
    for t in range(1, design.horizon + 1):
        add("state", t, excess[t])
    backoff = np.zeros(design.state_set.b.size)
    for part in components:
        backoff[part.rows_x] = terminal_backoff_x(design, part)
    placed = design.state_set.c @ answer.reference
    add("terminal", free, placed + backoff - limits[free:].min(axis=0))
    add("equilibrium", free, np.abs(answer.states[free] - answer.reference))
    return tuple(given)


def inside(inputs: Array, c: Array, b: Array) -> tuple[Array, bool]:
    """Cut inputs (H, n_u) back to c u <= b: a row of one entry exactly, others along the row.

    Returns:
        The inputs, and whether they were within INPUT_TOLERANCE of the limits before.
    """
    cut = inputs.copy()
    for row, side in zip(c, b, strict=True):
        (used,) = np.nonzero(row)
        excess = np.maximum(cut @ row - side, 0.0)
        cut -= np.outer(excess, row / (row @ row))
        if used.size == 1:
            limit = side / row[used[0]]
            clip = np.minimum if row[used[0]] > 0 else np.maximum
            cut[:, used[0]] = clip(cut[:, used[0]], limit)
    return cut, bool(np.max(np.abs(cut - inputs), initial=0.0) <= INPUT_TOLERANCE)


def _predict(design: Design, x: Array, inputs: Array) -> Array:
    states = [x]
    for u in inputs:
        states.append(design.plant.a @ states[-1] + design.plant.b @ u)
    return np.array(states)
