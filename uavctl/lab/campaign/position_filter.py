"""Position filter of campaigns: the flight's filter, for many runs in step."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uavctl.arrays import Array
from uavctl.smpc.batch import Counts
from uavctl.smpc.plant import Plant


@dataclass(frozen=True, eq=False)
class FilterBelief:
    """Plant and noise that a controller assumes of positions."""

    plant: Plant  # the plant that it believes in
    position_std_m: float  # standard deviation of a position, each axis [m]
    initial_std: float  # standard deviation of the states that the first position does not show, but for gusts


class PositionFilter:
    """Kalman filter of N runs, one position a step, in any order of arrival.

    A position is captured where a step begins. There the flight's filter (`uavctl.flight.kalman`) has drawn its
    new disturbance, so only x of its z = (x, w) is kept, and one step is x := A x + B u with noise E W E'. The first
    position initialises its own states; the other states begin with zero and `initial_std`. After a delayed position
    the steps since its capture are filtered again, so the result is the same as if all had arrived in order.

    Args:
        belief: Plant and noise assumed of the positions.
        known_steps: First step (N, T) that knows the position of each step, T or more where none does; the position of
            step 0 is known at once.
    """

    def __init__(self, belief: FilterBelief, known_steps: Counts) -> None:
        plant = belief.plant
        runs, steps = known_steps.shape
        self._plant, self._known_steps = plant, known_steps
        self._noise = plant.e @ plant.w @ plant.e.T
        self._index = list(plant.position_index)
        self._position_cov = np.eye(len(self._index)) * belief.position_std_m**2
        self._max_delay_steps = int((known_steps - np.arange(steps))[known_steps < steps].max(initial=0))
        variances = np.full(plant.n_x, belief.initial_std**2)
        variances[plant.gusts] = np.square(plant.gust_mps2)
        mean, cov = np.zeros((runs, plant.n_x)), np.tile(np.diag(variances), (runs, 1, 1))
        self._before = {0: (mean, cov)}  # of a step, without its own position
        self._after = mean, cov  # of the newest step, with it
        self._positions: dict[int, Array] = {}
        self._mean, self._cov = mean.copy(), cov.copy()

    def update(self, step: int, positions: Array, newest_captures: Counts, inputs: Array) -> tuple[Array, Array]:
        """Take the positions of a step; return the state (N, n_x) at the newest known capture, and its covariance.

        Args:
            step: Number of the step; call for 0, 1, … in turn.
            positions: Positions (N, n_axes) captured now, also those that never arrive.
            newest_captures: Capture step (N,) of the newest position known.
            inputs: Inputs (N, step, n_u) that have acted.
        """
        self._positions[step] = positions
        if step:
            self._before[step] = self._advance(*self._after, inputs[:, step - 1], step - 1)
        (arrived,) = np.nonzero((self._known_steps[:, : step + 1] == step).any(axis=0))
        for capture in range(int(arrived[0]) if arrived.size else step, step + 1):
            mean, cov = self._after = self._correct(capture, step)
            is_newest = newest_captures == capture
            self._mean[is_newest], self._cov[is_newest] = mean[is_newest], cov[is_newest]
            if capture < step:
                self._before[capture + 1] = self._advance(mean, cov, inputs[:, capture], capture)
        for capture in [other for other in self._before if other < step - self._max_delay_steps]:
            del self._before[capture], self._positions[capture]
        return self._mean.copy(), self._cov.copy()

    @property
    def now(self) -> tuple[Array, Array]:
        """States (N, n_x) and covariances of the newest step, from all positions that are known."""
        return self._after

    def _advance(self, mean: Array, cov: Array, u: Array, step: int) -> tuple[Array, Array]:
        """Advance beliefs over a step, with what is measured within it besides positions: here nothing."""
        del step
        return self.predict(mean, cov, u)

    def predict(self, mean: Array, cov: Array, u: Array) -> tuple[Array, Array]:
        """Predict states and covariances one step ahead, under the inputs (N, n_u)."""
        plant = self._plant
        return mean @ plant.a.T + u @ plant.b.T, plant.a @ cov @ plant.a.T + self._noise

    def _correct(self, capture: int, step: int) -> tuple[Array, Array]:
        """Correct the belief of step `capture` by its position, in the runs that know it in `step`."""
        mean, cov = (belief.copy() for belief in self._before[capture])
        index = self._index
        if not capture:
            mean[:, index] = self._positions[0]
            cov[np.ix_(range(len(cov)), index, index)] = self._position_cov
            return mean, cov
        (updated_runs,) = np.nonzero(self._known_steps[:, capture] <= step)
        prior_cov = cov[updated_runs]
        # K = P H' (H P H' + R)⁻¹
        ph = prior_cov[:, :, index]
        gain = np.linalg.solve(ph[:, index] + self._position_cov, ph.transpose(0, 2, 1)).transpose(0, 2, 1)
        innovation = self._positions[capture][updated_runs] - mean[updated_runs][:, index]
        complement = np.tile(np.eye(mean.shape[1]), (updated_runs.size, 1, 1))
        complement[:, :, index] -= gain
        mean[updated_runs] += (gain @ innovation[:, :, None])[:, :, 0]
        # Joseph's form, P := (I - K H) P (I - K H)' + K R K': symmetric and positive semidefinite in spite of rounding.
        noise_cov = gain @ self._position_cov @ gain.transpose(0, 2, 1)
        cov[updated_runs] = complement @ prior_cov @ complement.transpose(0, 2, 1) + noise_cov
        return mean, cov
