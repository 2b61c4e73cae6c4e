"""One question to the solver, and what may fly of its answer."""

from __future__ import annotations

import msgspec
import numpy as np

from uavctl.data import Estimate, Matrix, Plan, SolveStatus, Vector
from uavctl.flight.kalman import Array
from uavctl.smpc.answer import Answer, Outlook, Solver, all_finite

# What arithmetic and the solvers' bindings raise; anything else is a programming error and must be seen.
SOLVER_ERRORS = (ArithmeticError, ValueError, RuntimeError, np.linalg.LinAlgError)


class Asked(msgspec.Struct, frozen=True):
    """How a solve ended; `plan` is there only if it may fly."""

    status: SolveStatus
    plan: Plan | None
    text: str


def ask(
    solver: Solver,
    seq: int,
    base: Estimate,
    target: Array,
    outlook: Outlook,
    shape: tuple[int, int],
    design_id: str,
) -> Asked:
    """Plan from the estimate at a boundary; never raises on numbers.

    Args:
        solver: Who answers.
        seq: Number of the step that asks.
        base: The estimate at the boundary.
        target: Equilibrium to go to (n_x,).
        outlook: What is known ahead.
        shape: (H, n_u) of the inputs that an answer must have.
        design_id: Goes into the plan.
    """
    try:
        answer = solver.solve(seq, np.array(base.mean), target, outlook)
    except SOLVER_ERRORS as error:
        return Asked(SolveStatus.FAILED, None, f"the solver raised {type(error).__name__}: {error}")
    if answer.seq != seq:
        return Asked(SolveStatus.LATE, None, f"the answer is to step {answer.seq}, asked was step {seq}")
    if answer.status is not SolveStatus.OPTIMAL:
        return Asked(answer.status, None, f"the solve ended as {answer.status.value}")
    if not _complete(answer, shape, len(base.mean)):
        return Asked(SolveStatus.FAILED, None, "the answer is not finite, or has the wrong shape")
    # The solver plans what acts on the plant in all: the part of it that is there without us is not asked for again.
    inputs = answer.inputs - np.array(base.bias) if base.bias else answer.inputs
    return Asked(SolveStatus.OPTIMAL, _plan(answer, inputs, base, design_id), "")


def _complete(answer: Answer, shape: tuple[int, int], n_x: int) -> bool:
    return (
        answer.inputs.shape == shape
        and answer.states.shape == (shape[0] + 1, n_x)
        and all_finite((answer.inputs, answer.states, answer.reference))
    )


def _plan(answer: Answer, inputs: Array, base: Estimate, design_id: str) -> Plan:
    return Plan(
        seq=answer.seq,
        base_ns=base.at_ns,
        captured_ns=base.captured_ns,
        status=answer.status,
        method=answer.method,
        inputs=_rows(inputs),
        states=_rows(answer.states),
        backoff_x=_rows(answer.backoff_x),
        backoff_u=_rows(answer.backoff_u),
        reference=_row(answer.reference),
        slack=float(answer.slack),
        offset=float(answer.offset),
        terminal_miss=float(answer.terminal_miss),
        cost=float(answer.cost),
        cost_lower=float(answer.cost_lower),
        gap=float(answer.gap),
        iterations=int(answer.iterations),
        design_id=design_id,
        gave_way=answer.gave_way,
        bias=base.bias,
    )


def _row(values: Array) -> Vector:
    return tuple(values.tolist())


def _rows(values: Array) -> Matrix:
    if len(values) and not np.count_nonzero(values) and not np.signbit(values).any():
        return (tuple(values[0].tolist()),) * len(values)  # what the inputs of an open-loop plan keep
    return tuple(map(tuple, values.tolist()))
