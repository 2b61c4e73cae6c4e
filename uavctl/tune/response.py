"""How a vehicle answers by one configuration and by another, and which of the two tells a flight better.

Each plant is judged on the halves of the flight that it was not fitted to. What a configuration believes of dead time,
lag, drag and gain is pinned; noises are fitted for each, so that the filter of neither is fed what suits the other.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np
from numpy.typing import NDArray

from uavctl.config import Config
from uavctl.identify.axis_model import AxisModel, Free, LinearMotion
from uavctl.identify.dead_time import Block, halves
from uavctl.identify.fit import ROUGH, fit_axes
from uavctl.identify.history import Stretch
from uavctl.identify.prediction import predict_ahead

Array = NDArray[np.float64]

AHEAD_S = (0.25, 0.5, 1.0, 2.0)


class PredictionErrors(msgspec.Struct, frozen=True, kw_only=True):
    """Root mean square error of the predicted motion, by axis and time ahead."""

    axes: tuple[str, ...]
    ahead_s: tuple[float, ...]  # the first is one step
    rms_m: tuple[tuple[float, ...], ...]  # each axis, each time ahead

    @property
    def overall_m(self) -> float:
        """Geometric mean over axes and the times after the first step [m]."""
        several = np.array(self.rms_m)[:, 1:]
        return float(np.exp(np.mean(np.log(np.maximum(several, 1e-9)))))


@dataclass(frozen=True)
class PinnedAxis:
    """A plant of an axis of which some values are given, and only the others fitted.

    Attributes:
        model: The plant.
        given: Values by name; what the model has not is passed over.
    """

    model: AxisModel
    given: Mapping[str, float]

    @property
    def name(self) -> str:
        """See `AxisModel`."""
        return self.model.name

    @property
    def free(self) -> tuple[Free, ...]:
        """See `AxisModel`: those that are not given."""
        return tuple(one for one in self.model.free if one.name not in self.given)

    @property
    def start_std(self) -> tuple[float, ...]:
        """See `AxisModel`."""
        return self.model.start_std

    @property
    def starts(self) -> tuple[dict[str, float], ...]:
        """See `AxisModel`."""
        return self.model.starts[:1]

    def motion(self, parameters: Array) -> LinearMotion:
        """See `AxisModel`."""
        whole = np.empty((len(parameters), len(self.model.free)))
        fitted = iter(parameters.T)
        for column, one in enumerate(self.model.free):
            whole[:, column] = one.inside(self.given[one.name]) if one.name in self.given else next(fitted)
        return self.model.motion(whole)


@dataclass(frozen=True)
class Believed:
    """Response of a configuration.

    Attributes:
        dead_time_s: As a fit has it: without the ramp that the configured one holds [s].
        axes: Lag, drag and gain of each axis by name.
    """

    dead_time_s: float
    axes: tuple[Mapping[str, float], ...]


def believed(config: Config, ramp_s: float) -> Believed:
    """What a configuration believes.

    Args:
        config: The configuration.
        ramp_s: Part of its dead time that is the ramp of a setpoint, which the fitted inputs have already [s].
    """
    plant = config.plant
    gains = plant.gain or (1.0,) * len(plant.axes)
    return Believed(
        max(0.0, plant.dead_time_s - ramp_s),
        tuple(
            {"lag_s": lag, "drag_1ps": drag, "gain": gain}
            for lag, drag, gain in zip(plant.lag_s, plant.drag_1ps, gains, strict=True)
        ),
    )


def held_out_errors(
    flown: Sequence[Stretch],
    axes: Sequence[str],
    places: Sequence[int],
    models: Sequence[AxisModel],
    dead_time_s: float,
    dt_s: float,
) -> PredictionErrors:
    """Errors on each half of a flight by plants that were fitted to the other.

    Args:
        flown: Stretches of the flight.
        axes: Names of the axes.
        places: 0 north, 1 east, 2 down.
        models: The plant of each; what is pinned is not fitted.
        dead_time_s: As a fit has it [s].
        dt_s: One step [s].
    """
    times, both = (dt_s, *AHEAD_S), halves(flown)
    squares, counts = np.zeros((len(axes), len(times))), np.zeros((len(axes), len(times)))
    for half, other in (both, both[::-1]):
        counting = [replace(stretch, counted=_within(half, stretch.times_s)) for stretch in flown]
        fits = fit_axes(counting, places, models, dead_time_s, [None] * len(models), ROUGH)
        for row, (place, fit) in enumerate(zip(places, fits, strict=True)):
            for column, ahead in enumerate(predict_ahead(flown, place, fit, times)):
                wrong = ahead.errors_m[_within(other, ahead.times_s, times[column])]
                squares[row, column] += float(np.sum(wrong**2))
                counts[row, column] += len(wrong)
    rms = np.sqrt(squares / np.maximum(counts, 1.0))
    return PredictionErrors(axes=tuple(axes), ahead_s=times, rms_m=tuple(map(tuple, rms.tolist())))


def _within(blocks: Sequence[Block], times_s: Array, ahead_s: float = 0.0) -> NDArray[np.bool_]:
    """Whether one of some blocks holds each time, and the time so much later."""
    held = [(times_s >= block.begin_s) & (times_s + ahead_s <= block.end_s) for block in blocks]
    return np.asarray(np.logical_or.reduce(held), dtype=np.bool_)
