"""A point near a question's answer, for numbers to be relative to.

The plan that rests at the place in the limits nearest to where the state would drift, with the slack that this takes.
From far outside the limits the answer differs from it by numbers of the usual size, which the solver finds with its
usual accuracy; the large ones are in the point.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from uavctl.smpc.horizon import Horizon
from uavctl.smpc.layout import Layout, Pair

Array = NDArray[np.float64]


class RestingPoint:
    """Maps the parameters of a component's program to a point in its variables.

    Args:
        horizon: The component's prediction.
        layout: The program's variables.
        pairs: Pairs of state rows.
        last: Last stage with state rows.
        placed: Which state rows the reference moves (m_x,).
        backoff: Terminal back-offs of those rows.
        size: Natural sizes of y (n_y,).
    """

    def __init__(
        self,
        horizon: Horizon,
        layout: Layout,
        pairs: tuple[Pair, ...],
        last: int,
        placed: Array,
        backoff: Array,
        size: Array,
    ) -> None:
        part = horizon.component
        self._layout = layout
        self._n_x, self._n_y, self._m_x = *part.x_eq.shape, part.b_x.size
        self._drift = part.coordinates @ horizon.phi[horizon.free]
        self._rows, self._placed, self._backoff, self._size = (part.c_x @ part.x_eq)[placed], placed, backoff, size
        self._rest = np.tile(part.u_eq, (horizon.free, 1))
        effect = horizon.gamma @ self._rest + horizon.gamma_eq  # of y, with the inputs at rest there: (H+1, n_x, n_y)
        self._end = (horizon.phi[horizon.free], effect[horizon.free] - part.x_eq)
        c = np.array([pair.c for pair in pairs]).reshape(-1, self._n_x)
        stages = slice(1, last + 1)
        self._of_x = (c @ horizon.phi[stages]).reshape(-1, self._n_x)
        self._of_y = (c @ effect[stages]).reshape(-1, self._n_y)
        self._of_here = np.tile(c @ part.x_eq, (last, 1))
        sides = np.full((2, len(pairs)), self._m_x)  # the row of +c and of -c; m_x for none
        for i, pair in enumerate(pairs):
            for sign, row in pair.sides:
                sides[0 if sign > 0 else 1, i] = row
        self._sides = sides
        self._last = last

    def __call__(self, parameters: Array) -> Array:
        """Point (n_var,) for the parameters of `Program.parameters`."""
        layout, n_x, n_y = self._layout, self._n_x, self._n_y
        x, to_target, here = np.split(parameters[: n_x + 2 * n_y], [n_x, n_x + n_y])
        limits = parameters[n_x + 2 * n_y :][: (self._last + 1) * self._m_x].reshape(self._last + 1, self._m_x)
        room = limits[-1][self._placed] - self._backoff
        y = self._within(here + self._drift @ x, room) - here
        point = np.zeros(layout.size)
        point[layout.v] = self._rest @ y
        point[layout.y] = y
        point[layout.offset] = np.abs(y - to_target)
        mean = self._of_x @ x + self._of_y @ y + self._of_here @ here
        upper, lower = np.hstack([limits[:-1], np.full((self._last, 1), np.inf)])[:, self._sides].swapaxes(0, 1)
        point[layout.slack] = np.maximum(np.maximum(mean - upper.ravel(), -lower.ravel() - mean), 0.0)
        if layout.miss.stop > layout.miss.start:
            point[layout.miss] = np.abs(self._end[0] @ x + self._end[1] @ y)
            point[layout.outside] = np.maximum(self._rows @ (here + y) - room, 0.0)
        return point

    def _within(self, place: Array, room: Array) -> Array:
        """Bring `place` (n_y,) into rows · place <= room, one row after another."""
        for row, side in zip(self._rows, room, strict=True):
            excess = float(row @ place) - side
            if excess > 0.0:
                along = self._size**2 * row
                place = place - along * (excess / float(along @ row))
        return place
