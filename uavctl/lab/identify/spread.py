"""Spread of the positions ahead against the standard deviation that a configuration gives them.

1. From each position of a flight the model predicts the positions 0.25 to 2 s later, with the setpoints known. With the
   filter's covariance P after that position, the transition Φ over the time ahead, its noise N and the noise R of a
   position, the deviation of such a position from its prediction is

       σ² = c'(Φ P Φ' + N)c + R

   Back-offs are multiples of this σ without R.
2. The spread is the rms of (position - prediction) / σ. It is 1 where σ grows as the flight did. Above 1 back-offs were
   too small in this flight, below 1 they were larger than it needed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import msgspec
import numpy as np

from uavctl.arrays import Array
from uavctl.config import Config
from uavctl.lab.identify.fit import AHEAD_S, predict_positions
from uavctl.lab.identify.history import Stretch
from uavctl.lab.identify.response import (
    DRAG_LAG,
    AxisModel,
    DragLagAxis,
    ReferenceAxis,
    get_noise_variance,
    make_parameters,
    make_timeline,
    run_filter,
)

# Least spread that is a warning: with it 9.4 % are beyond a back-off for 5 %, Φ(-1.645 / 1.25)
WARNED_SPREAD = 1.25
_CERTAIN_STDS = 3.0  # standard errors of the spread beyond 1 that a warning needs in addition


class Spread(msgspec.Struct, frozen=True, kw_only=True):
    """Spread of the positions of one axis some time ahead."""

    axis: str
    ahead_s: float
    std_m: float  # median standard deviation by the identified configuration [m]
    spread: float  # rms error over the standard deviation by the identified configuration
    configured: float | None  # the same by the configuration before; None where it has another kind of plant


def measure_spreads(
    flown: Sequence[Stretch],
    axis: int,
    model: AxisModel,
    parameters: Sequence[float] | Array,
    dead_time_s: float,
    ahead_s: Sequence[float] = AHEAD_S,
) -> tuple[tuple[Array, Array], ...]:
    """Measure the errors of predicted positions, and their standard deviations, for some times ahead [m].

    Args:
        axis: 0 north, 1 east, 2 down.
        parameters: On the scale of the search, see `make_parameters`.
    """
    parts = [_measure_stretch(stretch, axis, model, np.array(parameters), dead_time_s, ahead_s) for stretch in flown]
    return tuple(
        (np.concatenate([part[i][0] for part in parts]), np.concatenate([part[i][1] for part in parts]))
        for i in range(len(ahead_s))
    )


def _measure_stretch(
    stretch: Stretch, axis: int, model: AxisModel, parameters: Array, dead_time_s: float, ahead_s: Sequence[float]
) -> list[tuple[Array, Array]]:
    timeline = make_timeline(stretch, (axis,), dead_time_s)
    result = run_filter(timeline, model, parameters)
    noise_m2 = float(get_noise_variance(model, parameters[None])[0])
    pairs = []
    for time_s in ahead_s:
        ahead = predict_positions(timeline, result, model, parameters, time_s)
        # σ² = c'(Φ P Φ' + N)c + R
        variance_m2 = np.einsum("kn,knm,km->k", ahead.rows, result.covs[ahead.begins], ahead.rows) + noise_m2
        variance_m2 += ahead.noise_m2
        pairs.append((timeline.positions_m[ahead.later, 0] - ahead.predicted_m, np.sqrt(variance_m2)))
    return pairs


def compute_spread(errors_m: Array, stds_m: Array) -> float:
    """Compute the rms of errors over their standard deviations; 0 without any."""
    return float(np.sqrt(np.mean(np.square(errors_m / stds_m)))) if len(errors_m) else 0.0


def make_spreads(
    flown: Sequence[Stretch], axes: Sequence[int], identified: Config, before: Config, ramp_s: float
) -> tuple[Spread, ...]:
    """Measure the spread of each axis and time ahead, by the identified configuration and by the one before.

    Args:
        axes: 0 north, 1 east, 2 down, as the configurations have them.
        ramp_s: By which configured dead times are longer than those of the ramped setpoints.
    """
    spreads = []
    for row, axis in enumerate(axes):
        pairs = measure_configuration(flown, axis, identified, row, ramp_s)
        old_pairs: Sequence[tuple[Array, Array] | None] = [None] * len(pairs)
        if before.plant.model == identified.plant.model:
            old_pairs = measure_configuration(flown, axis, before, row, ramp_s)
        spreads += [
            Spread(
                axis=identified.plant.axes[row],
                ahead_s=time_s,
                std_m=float(np.median(pair[1])) if len(pair[1]) else 0.0,
                spread=compute_spread(*pair),
                configured=None if old_pair is None else compute_spread(*old_pair),
            )
            for time_s, pair, old_pair in zip(AHEAD_S, pairs, old_pairs, strict=True)
        ]
    return tuple(spreads)


def measure_configuration(
    flown: Sequence[Stretch], axis: int, config: Config, row: int, ramp_s: float
) -> tuple[tuple[Array, Array], ...]:
    """Measure errors and standard deviations of the positions that a configuration predicts, see `measure_spreads`."""
    model, values = get_configured_axis(config, row)
    dead_time_s = max(0.0, config.plant.dead_time_s - ramp_s)
    return measure_spreads(flown, axis, model, make_parameters(model, values), dead_time_s)


def get_configured_axis(config: Config, row: int) -> tuple[AxisModel, dict[str, float]]:
    """Return the plant of an axis as a configuration has it, and the values of its parameters.

    Args:
        config: Configuration with one of the plants of `uavctl.lab.identify.response`.
        row: Index of the axis in it.
    """
    plant, estimator, root_s = config.plant, config.estimator, math.sqrt(config.plant.dt_s)
    # A disturbance held over Δt with deviation s has the density s √Δt.
    values = {
        "lag_s": plant.lag_s[row],
        "drag_1ps": plant.drag_1ps[row],
        "wind_mps2_rts": plant.wind_std_mps2[row] * root_s,
        "noise_m": estimator.position_std_m,
    }
    if plant.model == DRAG_LAG:
        gain = plant.gain[row] if plant.gain else 1.0
        values |= {"gain": gain, "drift_mps2_rts": estimator.bias_drift * gain}
        has_gusts = bool(plant.gust_mps2) and plant.gust_mps2[row] > 0.0
        if has_gusts:
            values |= {"gust_mps2": plant.gust_mps2[row], "gust_s": plant.gust_s[row]}
        configured: AxisModel = DragLagAxis(drifts=estimator.bias_drift > 0.0, has_gusts=has_gusts)
    else:
        values |= {
            "input_mps2_rts": plant.input_std_mps2[row] * root_s,
            "drift_mps2_rts": plant.force_drift_mps2_rts[row],
        }
        configured = ReferenceAxis(plant.position_1ps[row], plant.velocity_1ps[row], plant.integral_1ps2[row])
    return configured, values


def describe_wide_spreads(spreads: Sequence[Spread], flown_s: float, key: str) -> list[str]:
    """Describe each axis whose positions spread further than the identified configuration states, beyond chance.

    Args:
        key: Key of the configuration that widens the standard deviations.
    """
    texts = []
    for axis in dict.fromkeys(spread.axis for spread in spreads):
        wide = [
            spread
            for spread in spreads
            # n independent errors: the rms of a standard normal has the deviation 1 / √(2 n)
            if spread.axis == axis
            and spread.spread
            > max(WARNED_SPREAD, 1.0 + _CERTAIN_STDS / math.sqrt(2.0 * max(1.0, flown_s / spread.ahead_s)))
        ]
        if wide:
            worst = max(wide, key=lambda spread: spread.spread)
            texts.append(
                f"{axis}: positions {worst.ahead_s:g} s ahead spread {worst.spread:.1f} times as far as the identified "
                f"configuration states; raise {key}, else plans come too near to limits"
            )
    return texts
