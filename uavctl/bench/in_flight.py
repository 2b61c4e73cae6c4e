"""The decision of scheme `age-conditioned` as a flight asks for it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from uavctl.smpc.answer import NOMINAL, Answer, Outlook
from uavctl.smpc.conditioned import ConditionedSolver

Array = NDArray[np.float64]

_COVARIANCES = 7  # in turns: a filter's is hardly ever the last one's


class InFlight:
    """A solver whose every question has a covariance other than the last one's, and a setpoint sent before it.

    What was sent is the target's own input, so a state in transit has all of its way to slew.

    Args:
        solver: The solver.
    """

    def __init__(self, solver: ConditionedSolver) -> None:
        self._solver, plant = solver, solver.problem.plant
        noise = plant.e @ plant.w @ plant.e.T
        shares = np.linspace(0.1, 0.5, _COVARIANCES)
        self._outlooks = [Outlook(cov=share * noise, sent=solver.problem.u_target) for share in shares]
        self._asked = 0

    def solve(self, seq: int, x: Array, target: Array, outlook: Outlook = NOMINAL) -> Answer:  # noqa: ARG002
        """See `Solver`; the outlook is its own."""
        self._asked = (self._asked + 1) % _COVARIANCES
        return self._solver.solve(seq, x, target, self._outlooks[self._asked])
