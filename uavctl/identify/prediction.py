"""How well a fitted response predicts: what one step leaves unexplained, and the motion of the next second."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uavctl.identify.fit import AxisFit
from uavctl.identify.history import Stretch
from uavctl.identify.response import filtered, timeline, transition

Array = NDArray[np.float64]

AHEAD_S = 1.0
LAGS = 20
_SETTLED = 4.0  # where a stretch begins, the filter does not know the velocity yet


@dataclass(frozen=True, eq=False)
class Prediction:
    """How one axis was predicted.

    Attributes:
        times_s: (m,), of the positions [s].
        innovations_m: (m,), position minus its prediction from the one before [m].
        stds_m: (m,), standard deviation that the fit gives them [m].
        moved_m: (k,), how far the vehicle went in the next `AHEAD_S` [m].
        predicted_m: (k,), how far it was predicted to go [m].
        correlation: (LAGS,), of innovations one, two ... positions apart.
    """

    times_s: Array
    innovations_m: Array
    stds_m: Array
    moved_m: Array
    predicted_m: Array
    correlation: Array

    @property
    def residual_std_m(self) -> float:
        """Standard deviation of an innovation [m]."""
        return float(np.std(self.innovations_m))

    @property
    def r2(self) -> float:
        """Share of the motion of the next second that was predicted; 0 where nothing moved."""
        spread = float(np.sum((self.moved_m - self.moved_m.mean()) ** 2)) if len(self.moved_m) else 0.0
        return 1.0 - float(np.sum((self.moved_m - self.predicted_m) ** 2)) / spread if spread > 0.0 else 0.0


def predict(flown: Sequence[Stretch], axis: int, fit: AxisFit) -> Prediction:
    """Predict each position of the flight from the ones before it."""
    parameters = np.array(fit.parameters)
    times, innovations, stds, moved, predicted = [], [], [], [], []
    for stretch in flown:
        cut = timeline(stretch, axis, fit.dead_time_s)
        one = filtered(cut, parameters)
        times.append(stretch.times_s[1:])
        innovations.append(one.innovations_m[1:])  # the first one's is nothing but its distance from zero
        stds.append(one.stds_m[1:])
        ends = np.cumsum(cut.lengths_s)
        (seen,) = np.nonzero(np.isfinite(cut.measured_m))
        for place, at in enumerate(seen):
            later = seen[place + 1 :][ends[seen[place + 1 :]] - ends[at] >= AHEAD_S]
            if len(later):
                moved.append(cut.measured_m[later[0]] - cut.measured_m[at])
                predicted.append(
                    _ahead(one.states[at], cut.lengths_s[at + 1 : later[0] + 1], cut.inputs_mps2[at + 1 :], parameters)
                )
    known = np.concatenate(stds)
    settled = known < _SETTLED * np.median(known)
    left = np.concatenate(innovations)[settled]
    return Prediction(
        times_s=np.concatenate(times)[settled],
        innovations_m=left,
        stds_m=known[settled],
        moved_m=np.array(moved),
        predicted_m=np.array(predicted),
        correlation=_correlation(left / known[settled]),
    )


def _ahead(state: Array, lengths_s: Array, inputs_mps2: Array, parameters: Array) -> float:
    """How far the mean moves over some parts [m]."""
    move, push = transition(lengths_s, parameters[None])
    now = state
    for index in range(len(lengths_s)):
        now = move[index, 0] @ now + push[index, 0] * inputs_mps2[index]
    return float(now[0] - state[0])


def _correlation(values: Array) -> Array:
    """Correlation of a sequence with itself, 1 to LAGS places on."""
    centred = values - values.mean()
    size = float(centred @ centred)
    lags = range(1, min(LAGS, len(values) - 1) + 1)
    return np.array([float(centred[lag:] @ centred[:-lag]) / size for lag in lags]) if size > 0 else np.zeros(len(lags))
