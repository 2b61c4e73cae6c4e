"""What controllers know where positions alone are measured: the flight's filter, for many runs in step."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uavctl.smpc.batch import Counts
from uavctl.smpc.plant import Plant

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class FilterBelief:
    """What a controller believes of the positions that it is told.

    Attributes:
        plant: The plant that it believes in.
        position_std_m: Standard deviation of a position, each axis [m].
        initial_std: The same of the states that the first position does not show.
    """

    plant: Plant
    position_std_m: float
    initial_std: float


class PositionFilter:
    """Kalman filter of N runs, one position a step, in whatever order they come.

    A position is captured where a step begins. There the flight's filter (`uavctl.flight.kalman`) has drawn its
    disturbance anew, so that of its z = (x, w) nothing but x is carried on, and a step of it is A, B and E W E'. The
    first position shows itself, and the other states begin with zero and `initial_std`. After a late one the steps
    since its capture are filtered again: the numbers are the same as if all had come in order.

    Args:
        sight: What is believed of the positions.
        known: Step (N, T) that knows the position of each step first, T or more where none does; the first position of
            all is known at once.
    """

    def __init__(self, sight: FilterBelief, known: Counts) -> None:
        plant = sight.plant
        runs, steps = known.shape
        self._plant, self._known = plant, known
        self._noise = plant.e @ plant.w @ plant.e.T
        self._index = list(plant.position_index)
        self._shown = np.eye(len(self._index)) * sight.position_std_m**2
        self._latest = int((known - np.arange(steps))[known < steps].max(initial=0))
        mean, cov = np.zeros((runs, plant.n_x)), np.tile(np.eye(plant.n_x) * sight.initial_std**2, (runs, 1, 1))
        self._before = {0: (mean, cov)}  # of a step, without its own position
        self._after = mean, cov  # of the newest step, with it
        self._positions: dict[int, Array] = {}
        self._mean, self._cov = mean.copy(), cov.copy()

    def told(self, step: int, positions: Array, newest: Counts, inputs: Array) -> tuple[Array, Array]:
        """State (N, n_x) at the capture of the newest position known, by all that are known, and its covariance.

        Args:
            step: The step that begins; called for 0, 1, … in turn.
            positions: The positions (N, n_axes) that are captured now, whether they come or not.
            newest: Capture step (N,) of the newest position known.
            inputs: Inputs (N, step, n_u) that have acted.
        """
        self._positions[step] = positions
        if step:
            self._before[step] = self._moved(*self._after, inputs[:, step - 1])
        (come,) = np.nonzero((self._known[:, : step + 1] == step).any(axis=0))
        for past in range(int(come[0]) if come.size else step, step + 1):
            mean, cov = self._after = self._seen(past, step)
            own = newest == past
            self._mean[own], self._cov[own] = mean[own], cov[own]
            if past < step:
                self._before[past + 1] = self._moved(mean, cov, inputs[:, past])
        for past in [one for one in self._before if one < step - self._latest]:
            del self._before[past], self._positions[past]
        return self._mean.copy(), self._cov.copy()

    def _moved(self, mean: Array, cov: Array, u: Array) -> tuple[Array, Array]:
        """A step on, under the inputs (N, n_u)."""
        plant = self._plant
        return mean @ plant.a.T + u @ plant.b.T, plant.a @ cov @ plant.a.T + self._noise

    def _seen(self, past: int, step: int) -> tuple[Array, Array]:
        """What is known of a step by its own position too, in the runs that know it in `step`."""
        mean, cov = (one.copy() for one in self._before[past])
        index = self._index
        if not past:
            mean[:, index] = self._positions[0]
            cov[np.ix_(range(len(cov)), index, index)] = self._shown
            return mean, cov
        (who,) = np.nonzero(self._known[:, past] <= step)
        held = cov[who]
        ph = held[:, :, index]
        gain = np.linalg.solve(ph[:, index] + self._shown, ph.transpose(0, 2, 1)).transpose(0, 2, 1)
        off = self._positions[past][who] - mean[who][:, index]
        keep = np.tile(np.eye(mean.shape[1]), (who.size, 1, 1))
        keep[:, :, index] -= gain
        mean[who] += (gain @ off[:, :, None])[:, :, 0]
        # Joseph's form: symmetric and positive semidefinite whatever rounding does.
        cov[who] = keep @ held @ keep.transpose(0, 2, 1) + gain @ self._shown @ gain.transpose(0, 2, 1)
        return mean, cov
