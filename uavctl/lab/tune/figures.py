"""Figures of a flight of `uavctl tune`: how well it held its last waypoint, and how well a model predicts it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

import msgspec
import numpy as np

from logs.recording.flight import FlightData
from logs.recording.summary import compute_position_errors_m
from uavctl.arrays import Flags
from uavctl.config import Config
from uavctl.lab.identify.history import FlightHistory
from uavctl.lab.identify.result import compute_ramp_delay_s, make_fitted_stretches
from uavctl.lab.identify.spread import measure_configuration
from uavctl.lab.trial import compute_excess_m, compute_rms_m
from uavctl.lab.tune.excitation import SETTLING_S, SafeBox
from uavctl.records import ControlMode
from uavctl.smpc.plant import AXES

MIN_HOLD_S = 2.0
_SAME_M = 1e-6
# Change of the hold that counts: two standard deviations of the difference of two flights of one configuration. Four
# simulated ones of preset `room` held within 1.36 to 1.58 cm, a standard deviation of 7 %.
_CHANCE_SHARE = 0.2


class TunedFlight(msgspec.Struct, frozen=True, kw_only=True):
    """Figures of one of the two flights; None where it does not determine them."""

    hold_rms_m: float | None  # distance from the last waypoint, all three axes
    beyond_box_m: float | None  # largest distance outside the box; negative is inside; None without a box


@dataclass(frozen=True)
class TuneFigures:
    """Figures of both flights, and errors of the old and the new model on the second one [m]."""

    before: TunedFlight
    after: TunedFlight
    old_error_m: float
    new_error_m: float


class HoldChange(StrEnum):
    """Change of the distance from the last waypoint, from the flight before to the one after."""

    BETTER = "better"
    ALIKE = "alike"
    WORSE = "worse"
    UNKNOWN = "unknown"


def compare_holds(before: TunedFlight, after: TunedFlight) -> HoldChange:
    """Return whether the flight after held its last waypoint better; small changes are chance."""
    if before.hold_rms_m is None or after.hold_rms_m is None:
        return HoldChange.UNKNOWN
    if after.hold_rms_m < before.hold_rms_m * (1.0 - _CHANCE_SHARE):
        return HoldChange.BETTER
    return HoldChange.WORSE if after.hold_rms_m > before.hold_rms_m * (1.0 + _CHANCE_SHARE) else HoldChange.ALIKE


def list_figure_rows(figures: TuneFigures) -> list[tuple[str, str, str]]:
    """Return the figures as rows of a table: name with its unit, before, after."""
    before, after = figures.before, figures.after
    rows = (
        ("distance from the last waypoint, rms [cm]", before.hold_rms_m, after.hold_rms_m),
        ("outside the box, at most [cm]", before.beyond_box_m, after.beyond_box_m),
        ("prediction of the second flight, error [cm]", figures.old_error_m, figures.new_error_m),
    )
    return [(name, _format_cm(old_m), _format_cm(new_m)) for name, old_m, new_m in rows]


def _format_cm(value_m: float | None) -> str:
    return "–" if value_m is None else f"{100 * value_m:.1f}"


def compute_flight_figures(flight: FlightData, box: SafeBox | None) -> TunedFlight:
    """Return the figures of a flight, by its true positions if they were recorded, else by the estimates."""
    is_held = find_hold_steps(flight)
    has_hold = float(np.count_nonzero(is_held)) * flight.design.dt_s >= MIN_HOLD_S
    return TunedFlight(
        hold_rms_m=compute_rms_m(compute_position_errors_m(flight)[is_held]) if has_hold else None,
        beyond_box_m=None if box is None else _compute_box_excess_m(flight, box),
    )


def find_last_waypoint_steps(flight: FlightData) -> tuple[Flags, float]:
    """Return which steps (n,) flew plans to the last waypoint, and since when that was the target [s]."""
    steps = flight.steps
    is_tracked = np.array([d.mode is ControlMode.TRACK for d in steps.decisions], dtype=np.bool_)
    if not is_tracked.any():
        return is_tracked, math.inf
    index = list(flight.design.position_index)
    last_target = steps.target[np.flatnonzero(is_tracked)[-1]][index]
    is_last_target = np.linalg.norm(steps.target[:, index] - last_target, axis=1) <= _SAME_M
    other_steps = np.flatnonzero(is_tracked & ~is_last_target)
    begin = int(other_steps[-1]) + 1 if len(other_steps) else int(np.flatnonzero(is_tracked)[0])
    is_chosen = is_tracked & is_last_target & (np.arange(len(is_tracked)) >= begin)
    return is_chosen, float(steps.t_s[begin])


def find_hold_steps(flight: FlightData) -> Flags:
    """Return the steps (n,) that held the last waypoint: from `SETTLING_S` after it became the target."""
    is_chosen, since_s = find_last_waypoint_steps(flight)
    return np.asarray(is_chosen & (flight.steps.t_s >= since_s + SETTLING_S), dtype=np.bool_)


def compute_prediction_error_m(history: FlightHistory, config: Config) -> float:
    """Return how far a flight is from the motion that the plant of a configuration predicts [m].

    It is the geometric mean of the rms errors over all axes, 0.25 to 2 s ahead.
    """
    flown, ramp_s = make_fitted_stretches(history, config), compute_ramp_delay_s(history, config)
    rms_m = [
        compute_rms_m(errors_m)
        for row, name in enumerate(config.plant.axes)
        for errors_m, _ in measure_configuration(flown, AXES.index(name), config, row, ramp_s)
    ]
    return float(np.exp(np.mean(np.log(np.maximum(rms_m, 1e-9)))))


def _compute_box_excess_m(flight: FlightData, box: SafeBox) -> float | None:
    """Return the largest distance outside the box over all steps flown by plans [m]."""
    steps = flight.steps
    tracked_steps = [step for step, d in enumerate(steps.decisions) if d.mode is ControlMode.TRACK]
    if not tracked_steps:
        return None
    positions = steps.state[tracked_steps][:, list(flight.design.position_index)]
    axes = [AXES.index(axis) for axis in flight.design.axes]
    return float(compute_excess_m(positions, np.array(box.lower)[axes], np.array(box.upper)[axes]).max())
