"""What a solver of the decision problem answers, and the protocol that solvers share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from uavctl.data import SolveStatus

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Answer:
    """Optimal plan from one state, for the whole plant; one row a step Δt.

    Attributes:
        seq: Number of the question, given back as it came.
        status: How the solve ended; only OPTIMAL may fly.
        method: Which program answered.
        inputs: Mean inputs v_t (H, n_u), within the hard limits, in the plant's input units.
        states: Predicted mean states (H+1, n_x), those that follow from `inputs`.
        backoff_x: Back-off of each row of the state set (H+1, m_x), in the row's unit.
        backoff_u: Back-off of each row of the input set (H, m_u), in the row's unit.
        reference: Equilibrium x_s (n_x,) that the plan ends in.
        slack: Sum of all slacks of the state constraints.
        offset: l1 distance of the reference from the target, in equilibrium coordinates.
        terminal_miss: l1 violation of the terminal equality.
        cost: Objective: cost (18) and all penalties.
        cost_lower: Dual objective, a lower bound of the optimal cost up to the solver's tolerance; -inf if the method
            knows none.
        gap: (cost - cost_lower) / max(1, |cost|); inf if no lower bound is known.
        iterations: Interior-point iterations, summed over all programs that were run.
    """

    seq: int
    status: SolveStatus
    method: str
    inputs: Array
    states: Array
    backoff_x: Array
    backoff_u: Array
    reference: Array
    slack: float
    offset: float
    terminal_miss: float
    cost: float
    cost_lower: float
    gap: float
    iterations: int

    @classmethod
    def failed(cls, seq: int, status: SolveStatus, method: str, iterations: int = 0) -> Answer:
        """An answer without a plan: empty arrays, infinite cost.

        Args:
            seq: Number of the question.
            status: Why there is no plan.
            method: Which program was asked.
            iterations: Interior-point iterations spent.
        """
        empty = np.zeros((0, 0))
        return cls(
            seq=seq,
            status=status,
            method=method,
            inputs=empty,
            states=empty,
            backoff_x=empty,
            backoff_u=empty,
            reference=np.zeros(0),
            slack=np.inf,
            offset=np.inf,
            terminal_miss=np.inf,
            cost=np.inf,
            cost_lower=-np.inf,
            gap=np.inf,
            iterations=iterations,
        )


def relative_gap(cost: float, cost_lower: float) -> float:
    """Gap of an answer relative to its cost, or absolute where the cost is below 1."""
    return (cost - cost_lower) / max(1.0, abs(cost))


class Solver(Protocol):
    """Answers the decision problem of one step."""

    def solve(self, seq: int, x: Array, target: Array) -> Answer:
        """Plan from state `x` (n_x,) towards `target` (n_x,), an equilibrium; never raises on numbers."""
        ...
