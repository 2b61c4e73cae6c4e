"""Rows on how far the acceleration setpoint may go from one step to the next, as the last gate lets it.

Inputs are held for a step. The gate lets a setpoint move by slew · tick in each tick, so a change of up to slew · Δt
has arrived with the last tick of its step: the rows bound the change from step to step by that. While it moves, what is
sent is behind the plan by half a step in the mean.
"""

from __future__ import annotations

from operator import le

import numpy as np
from numpy.typing import NDArray

from uavctl.smpc.plant import Plant
from uavctl.smpc.qp import OPEN, QuadraticProgram
from uavctl.smpc.sets import Polytope

Array = NDArray[np.float64]
Index = NDArray[np.intp]

_APART = 1e-8  # of a setpoint: what the first row and the set of inputs have in common is wider than this


class SlewRows:
    """|D (u_t - u_(t-1))| <= side in each row that can bind.

    Attributes:
        d: D (m, n_u), change of an axis' acceleration setpoint per change of the input [m/s² per unit].
        axes: Index of the plant's axis of each row (m,).
        side: Largest change in a step [m/s²].

    Args:
        plant: The plant.
        input_set: U; a change as large as the whole of it needs no row.
        slew_mps3: Largest change in a second [m/s³]; infinite for no rows.
    """

    def __init__(self, plant: Plant, input_set: Polytope, slew_mps3: float) -> None:
        self.side = slew_mps3 * plant.dt_s
        self._set = input_set
        self._low, self._high = input_set.bounds
        self._lows, self._highs = self._low.tolist(), self._high.tolist()
        d = plant.accel_map
        with np.errstate(invalid="ignore"):  # an input without limits that an axis does not feel
            widest = np.nansum(np.abs(d) * (self._high - self._low), axis=1)
        self.axes = np.flatnonzero(np.any(d != 0.0, axis=1) & (widest > self.side))
        self.d = d[self.axes]
        self._sides = np.full(self.axes.size, self.side)
        self._box = all(np.count_nonzero(row) == 1 for row in input_set.c)
        self._nearest: QuadraticProgram | None = None
        if not self._box:
            n, m = plant.n_u, len(input_set.b)
            hard = np.zeros(m, dtype=np.int32)
            self._nearest = QuadraticProgram(np.eye(n), input_set.c.copy(), hard, np.zeros(m), np.zeros(m))

    def own(self, inputs: Index) -> Index:
        """Which rows have to do with some inputs."""
        return np.flatnonzero(np.any(self.d[:, inputs] != 0.0, axis=1))

    def first(self, sent: Array) -> tuple[Array, Array]:
        """D u_(-1) (m,) of the input sent last (n_u,), and how far the first input may be from it (m,).

        That is `side`, or as far as the nearest input in U is away: from there on every input may stay.
        """
        at = self.d @ sent
        if self._box and all(map(le, self._lows, sent.tolist())) and all(map(le, sent.tolist(), self._highs)):
            return at, self._sides
        away = np.abs(self.d @ self._within(sent) - at)
        return at, np.maximum(away + _APART * (1.0 + away), self.side)

    def _within(self, sent: Array) -> Array:
        """The input in U that is nearest (n_u,)."""
        if self._nearest is None:
            return np.minimum(np.maximum(sent, self._low), self._high)
        if (self._set.c @ sent <= self._set.b).all():
            return sent
        found = self._nearest.solve(-sent, np.minimum(self._set.b, OPEN), np.full(self._set.b.size, -OPEN))
        return sent if found is None else found[0]
