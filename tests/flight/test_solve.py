"""The part of a solver's answer that may fly: its numbers go into the plan as they are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from uavctl.arrays import Array
from uavctl.flight.solve import ask_solver
from uavctl.records import Estimate, SolveStatus
from uavctl.smpc.answer import NOMINAL, Answer, Preview

H, N_X, N_U = 5, 4, 2


@dataclass(frozen=True)
class Known:
    answer: Answer

    def solve(self, _seq: int, _x: Array, _target: Array, _preview: Preview = NOMINAL) -> Answer:
        return self.answer


@pytest.mark.parametrize("rows_x", [0, 3])
def test_a_plan_has_the_numbers_of_the_answer_whatever_their_order_in_memory(rows_x: int) -> None:
    rng = np.random.default_rng(rows_x)
    answer = Answer(
        seq=7,
        status=SolveStatus.OPTIMAL,
        method="known",
        inputs=rng.normal(size=(N_U, H)).T,
        states=np.asfortranarray(rng.normal(size=(H + 1, N_X))),
        backoff_x=rng.normal(size=(H + 1, 2 * rows_x))[:, ::2],
        backoff_u=np.broadcast_to(rng.normal(size=3), (H, 3)),
        reference=rng.normal(size=N_X),
        slack=0.0,
        offset=0.0,
        terminal_miss=0.0,
        cost=1.0,
        cost_lower=-np.inf,
        gap=np.inf,
        iterations=1,
    )
    base = Estimate(at_ns=2, captured_ns=1, mean=(0.0,) * N_X, cov=())
    plan = ask_solver(Known(answer), 7, base, np.zeros(N_X), NOMINAL, (H, N_U), "design").plan
    assert plan is not None and plan.reference == tuple(answer.reference.tolist())
    for name in ("inputs", "states", "backoff_x", "backoff_u"):
        asked, planned = getattr(answer, name), getattr(plan, name)
        assert planned.tolist() == asked.tolist() and planned.flags.c_contiguous, name
        assert not np.shares_memory(planned, asked) and not planned.flags.writeable, name
