"""One question to the solver, and the part of its answer that may fly.

1. The solver gets the estimate at the time at which an input begins to act, the target, and what is known ahead.
2. An answer flies if it is to this question, optimal, finite and complete. Else the old plan is flown on.
3. The estimated bias is taken off the inputs, as it acts without us.
"""

from __future__ import annotations

import msgspec
import numpy as np

from uavctl.arrays import Array
from uavctl.errors import in_words
from uavctl.records import Estimate, Plan, SolveStatus
from uavctl.smpc.answer import Answer, Preview, Solver, are_finite

# Errors that arithmetic and the solvers' bindings raise; anything else is a programming error and must be seen.
SOLVER_ERRORS = (ArithmeticError, ValueError, RuntimeError, np.linalg.LinAlgError)


class SolveOutcome(msgspec.Struct, frozen=True):
    """Outcome of a solve; `plan` is there only if it may fly."""

    status: SolveStatus
    plan: Plan | None
    text: str
    fault: str = ""  # why the solver is not to be asked again


def ask_solver(
    solver: Solver, seq: int, base: Estimate, target: Array, preview: Preview, shape: tuple[int, int], design_id: str
) -> SolveOutcome:
    """Ask for a plan from the estimate at a boundary; never raises on numbers.

    Args:
        target: Equilibrium to go to (n_x,).
        shape: (H, n_u) of the inputs that an answer must have.
    """
    try:
        answer = solver.solve(seq, np.array(base.mean), target, preview)
    except SOLVER_ERRORS as error:
        return SolveOutcome(SolveStatus.FAILED, None, f"the solver raised {in_words(error)}")
    if answer.seq != seq:
        return SolveOutcome(SolveStatus.LATE, None, f"the answer is for step {answer.seq}, not for step {seq}")
    if answer.status is not SolveStatus.OPTIMAL:
        text = "" if answer.fault else f"the solve ended as {answer.status.value}"
        return SolveOutcome(answer.status, None, text, answer.fault)
    if not _is_complete(answer, shape, len(base.mean)):
        return SolveOutcome(SolveStatus.FAILED, None, "the answer is not finite, or has the wrong shape")
    # u_sent = u_plan - d: the solver plans what acts on the plant in all, and the bias acts without us.
    inputs = answer.inputs - np.array(base.bias) if base.bias else answer.inputs
    return SolveOutcome(SolveStatus.OPTIMAL, _make_plan(answer, inputs, base, design_id), "")


def _is_complete(answer: Answer, shape: tuple[int, int], n_x: int) -> bool:
    return (
        answer.inputs.shape == shape
        and answer.states.shape == (shape[0] + 1, n_x)
        and are_finite((answer.inputs, answer.states, answer.reference))
    )


def _make_plan(answer: Answer, inputs: Array, base: Estimate, design_id: str) -> Plan:
    return Plan(
        seq=answer.seq,
        base_ns=base.at_ns,
        captured_ns=base.captured_ns,
        status=answer.status,
        method=answer.method,
        inputs=_copy(inputs),
        states=_copy(answer.states),
        backoff_x=_copy(answer.backoff_x),
        backoff_u=_copy(answer.backoff_u),
        reference=tuple(answer.reference.tolist()),
        slack=float(answer.slack),
        offset=float(answer.offset),
        terminal_miss=float(answer.terminal_miss),
        cost=float(answer.cost),
        cost_lower=float(answer.cost_lower),
        gap=float(answer.gap),
        iterations=int(answer.iterations),
        design_id=design_id,
        gave_way=answer.relaxed,
        bias=base.bias,
    )


def _copy(values: Array) -> Array:
    """Copy an array that the solver may use again; the copy cannot be written."""
    copy = values.copy()  # row by row, whatever the order in memory was
    copy.setflags(write=False)
    return copy
