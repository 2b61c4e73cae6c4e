"""How well a fitted response predicts: what one step leaves unexplained, and the motion of the next seconds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uavctl.identify.fit import AxisFit
from uavctl.identify.history import Stretch
from uavctl.identify.response import INSTANT_S, advance, filtered, timeline

Array = NDArray[np.float64]

AHEAD_S = (0.25, 0.5, 1.0, 2.0)
SHOWN_S = 1.0
LAGS = 20
_SETTLED = 4.0  # where a stretch begins, the filter does not know the velocity yet


@dataclass(frozen=True, eq=False)
class Ahead:
    """Motion from each position to the first one at least so much later.

    Attributes:
        times_s: (k,), where it begins [s].
        moved_m: (k,), how far the vehicle went [m].
        predicted_m: (k,), how far it was predicted to go [m].
    """

    times_s: Array
    moved_m: Array
    predicted_m: Array

    @property
    def errors_m(self) -> Array:
        """What was not predicted (k,) [m]."""
        return self.moved_m - self.predicted_m


@dataclass(frozen=True, eq=False)
class Prediction:
    """How one axis was predicted.

    Attributes:
        times_s: (m,), of the positions [s].
        innovations_m: (m,), position minus its prediction from the one before [m].
        stds_m: (m,), standard deviation that the fit gives them [m].
        moved_m: (k,), how far the vehicle went in the next `SHOWN_S` [m].
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
    times, innovations, stds = [], [], []
    for stretch in flown:
        cut = timeline(stretch, (axis,), fit.dead_time_s)
        one = filtered(cut, fit.model, np.array(fit.parameters))
        times.append(stretch.times_s[0] + cut.captured[1:] * INSTANT_S)
        innovations.append(one.innovations_m[1:])  # the first one's is nothing but its distance from zero
        stds.append(one.stds_m[1:])
    known = np.concatenate(stds)
    settled = known < _SETTLED * np.median(known)
    left = np.concatenate(innovations)[settled]
    (second,) = predict_ahead(flown, axis, fit, (SHOWN_S,))
    return Prediction(
        times_s=np.concatenate(times)[settled],
        innovations_m=left,
        stds_m=known[settled],
        moved_m=second.moved_m,
        predicted_m=second.predicted_m,
        correlation=_correlation(left / known[settled]),
    )


def predict_ahead(
    flown: Sequence[Stretch], axis: int, fit: AxisFit, ahead_s: Sequence[float] = AHEAD_S
) -> tuple[Ahead, ...]:
    """Predict the motion over each of some times from every position, with the setpoints as they were sent.

    The state there is the filter's, by that position and those before; what follows is known of the setpoints alone.
    """
    parts = [_ahead(stretch, axis, fit, ahead_s) for stretch in flown]
    return tuple(
        Ahead(*(np.concatenate([getattr(part[i], key) for part in parts]) for key in Ahead.__dataclass_fields__))
        for i in range(len(ahead_s))
    )


def _ahead(stretch: Stretch, axis: int, fit: AxisFit, ahead_s: Sequence[float]) -> list[Ahead]:
    cut = timeline(stretch, (axis,), fit.dead_time_s)
    parameters = np.array(fit.parameters)
    one = filtered(cut, fit.model, parameters)
    motion = fit.model.motion(parameters[None])
    captured = cut.captured
    settled = one.stds_m < _SETTLED * np.median(one.stds_m)
    found = []
    for time_s in ahead_s:
        later = np.searchsorted(captured, captured + round(time_s / INSTANT_S))
        begins = np.flatnonzero(settled & (later < len(captured)))
        later = later[begins]
        different, which = np.unique(captured[later] - captured[begins], return_inverse=True)
        rows = advance(motion, different).move[which, 0, 0]  # of the position
        predicted = one.driven[later, 0] + np.einsum("kn,kn->k", rows, one.rest[begins])
        found.append(
            Ahead(
                times_s=stretch.times_s[0] + captured[begins] * INSTANT_S,
                moved_m=cut.positions_m[later, 0] - cut.positions_m[begins, 0],
                predicted_m=predicted - one.driven[begins, 0] - one.rest[begins, 0],
            )
        )
    return found


def _correlation(values: Array) -> Array:
    """Correlation of a sequence with itself, 1 to LAGS places on."""
    centred = values - values.mean()
    size = float(centred @ centred)
    lags = range(1, min(LAGS, len(values) - 1) + 1)
    return np.array([float(centred[lag:] @ centred[:-lag]) / size for lag in lags]) if size > 0 else np.zeros(len(lags))
