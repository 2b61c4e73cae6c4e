"""Colour of the gusts of a flight: strength and time constant, where the positions show them.

1. An axis of the identified plant `drag-lag` is fitted again with a gust of first order, at the same dead time.
2. A flight without gusts lowers the deviance by chance: two parameters more, one of them without effect at a strength
   of zero. A fall beyond `MIN_FALL` is a colour.
3. A gust that is shorter than a step is the plant's own disturbance; one at the longest time constant is a drift of the
   bias. Neither is a colour.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from uavctl.lab.identify.fit import AxisFit, fit_axes
from uavctl.lab.identify.history import Stretch
from uavctl.lab.identify.response import DragLagAxis, get_values, make_parameters

# χ² of 4 degrees is above it in one of a thousand flights: the time constant is searched for, so 2 would be too few
MIN_FALL = 18.5
_LONGEST_SHARE = 0.95  # share of the largest time constant of the search; beyond it the fit is at its bound
_STARTS = ({"gust_mps2": 0.1, "gust_s": 0.3}, {"gust_mps2": 0.2, "gust_s": 2.0})


@dataclass(frozen=True)
class GustFit:
    """An axis with a gust."""

    fit: AxisFit
    fall: float  # of the deviance, beside the axis without a gust
    is_shown: bool  # whether the flight shows the gust's colour


def fit_gusts(flown: Sequence[Stretch], axes: Sequence[int], fits: Sequence[AxisFit], dt_s: float) -> list[GustFit]:
    """Fit each axis of plant `drag-lag` again, with a gust.

    Args:
        axes: 0 north, 1 east, 2 down.
        fits: The axes without gusts.
        dt_s: Δt [s].
    """
    models = [replace(fit.model, has_gusts=True) for fit in fits if isinstance(fit.model, DragLagAxis)]
    best: list[AxisFit] = []
    for gust in _STARTS:
        starts = [
            make_parameters(model, get_values(fit.model, fit.parameters) | gust).tolist()
            for model, fit in zip(models, fits, strict=True)
        ]
        found = fit_axes(flown, axes, models, fits[0].dead_time_s, starts)
        best = [min(pair, key=lambda fit: fit.deviance) for pair in zip(best or found, found, strict=True)]
    longest_s = next(free.upper for free in models[0].free if free.name == "gust_s")
    return [
        GustFit(
            gusty,
            fall=plain.deviance - gusty.deviance,
            is_shown=plain.deviance - gusty.deviance > MIN_FALL
            and dt_s < gusty.value("gust_s") < _LONGEST_SHARE * longest_s,
        )
        for plain, gusty in zip(fits, best, strict=True)
    ]
