"""Where a plan may rest: the equilibria of one part that keep given limits."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from uavctl.smpc.baselines.problem import Part, Problem
from uavctl.smpc.equilibria import Equilibria
from uavctl.smpc.qp import OPEN, SOFT, QuadraticProgram

Array = NDArray[np.float64]


class Places:
    """Equilibria of one part: the one nearest to a target that keeps given limits.

    Attributes:
        rows: Of each row of the part, its value (m, n_y) at an equilibrium of the whole plant.

    Args:
        problem: The problem.
        rests: Equilibria of the whole plant.
        part: The part.
    """

    def __init__(self, problem: Problem, rests: Equilibria, part: Part) -> None:
        (self._own,) = np.nonzero(np.isin(rests.held, part.states))
        self._states, self._held = part.states, rests.held[self._own]
        self._x_eq = rests.x_eq[np.ix_(part.states, self._own)]
        rows = problem.state_set.c[np.ix_(part.rows_x, part.states)] @ self._x_eq
        self.rows = np.zeros((part.rows_x.size, rests.held.size))
        self.rows[:, self._own] = rows
        (self._used,) = np.nonzero(np.any(rows != 0.0, axis=1))
        self._rows = rows[self._used]
        if self._used.size and self._own.size:
            price, curve = np.full(self._used.size, problem.slack_linear), np.full(self._used.size, 1.0)
            sense = np.full(self._used.size, SOFT, dtype=np.int32)
            self._program = QuadraticProgram(2.0 * np.eye(self._own.size), self._rows, sense, price, curve)

    def nearest(self, reference: Array, sides: Array) -> None:
        """Move the part's states of `reference` (n_x,) to the nearest equilibrium within `sides` (m,) of its rows."""
        if not self._used.size or not self._own.size:
            return
        y = reference[self._held]
        room = sides[self._used] - self._rows @ y
        if (room >= 0.0).all():
            return
        moved = self._program.solve(np.zeros(y.size), np.minimum(room, OPEN), np.full(room.size, -OPEN))
        if moved is not None:
            reference[self._states] = self._x_eq @ (y + moved[0])
