"""Two flights of the same mission, before and after: how well the place was held, and how well plans came true."""

from __future__ import annotations

import math

import msgspec
import numpy as np
from numpy.typing import NDArray

from logs.flight_data import FlightData
from uavctl.data import ControlMode
from uavctl.tune.excitation import SETTLES_S, SafeBox
from uavctl.tune.response import PredictionErrors

Array = NDArray[np.float64]

PLANNED_AHEAD_S = 0.5  # so much later a plan is compared with what became of it
LEAST_HOLD_S = 2.0
_SAME_M = 1e-6


class TunedFlight(msgspec.Struct, frozen=True, kw_only=True):
    """Figures of one of the two flights; None where it shows nothing of it."""

    recording: str
    judged_by: str  # "truth" where the simulator told it, else "estimate"
    flown_s: float
    hold_s: float  # that count
    hold_rms_m: float | None  # distance from the last place, three axes together
    hold_max_m: float | None
    plan_rms_m: float | None  # distance from where the plan of PLANNED_AHEAD_S before had the vehicle
    beyond_box_m: float | None  # furthest outside of the box; negative is the room that was left; None without a box
    fallbacks: int


class TuneComparison(msgspec.Struct, frozen=True, kw_only=True):
    """Both flights, and both models on the second one, which neither was fitted to."""

    before: TunedFlight
    after: TunedFlight
    old_errors: PredictionErrors
    new_errors: PredictionErrors


def figures_of(flight: FlightData, recording: str, fallbacks: int, box: SafeBox | None) -> TunedFlight:
    """Figures of a flight.

    Args:
        flight: The flight.
        recording: As a person knows it.
        fallbacks: Entries into braking, holding or landing that nobody wanted.
        box: Where it was to stay; None where nothing was said.
    """
    steps = flight.steps
    held = holding(flight)
    distances = np.linalg.norm((steps.state - steps.target)[:, list(flight.design.position_index)], axis=1)[held]
    hold_s = float(np.count_nonzero(held)) * flight.design.dt_s
    enough = hold_s >= LEAST_HOLD_S
    planned = plan_errors_m(flight)
    return TunedFlight(
        recording=recording,
        judged_by="truth" if steps.from_truth else "estimate",
        flown_s=round(len(steps) * flight.design.dt_s, 6),
        hold_s=round(hold_s, 6),
        hold_rms_m=_rms(distances) if enough else None,
        hold_max_m=float(distances.max()) if enough else None,
        plan_rms_m=_rms(planned) if len(planned) else None,
        beyond_box_m=None if box is None else _beyond(flight, box),
        fallbacks=fallbacks,
    )


def last_place(flight: FlightData) -> tuple[NDArray[np.bool_], float]:
    """Which steps were flown to the last place of the mission by plans (n,), and since when that was the place [s]."""
    steps = flight.steps
    tracked = np.array([d.mode is ControlMode.TRACK for d in steps.decisions], dtype=np.bool_)
    if not tracked.any():
        return tracked, math.inf
    index = list(flight.design.position_index)
    last = steps.target[np.flatnonzero(tracked)[-1]][index]
    there = np.linalg.norm(steps.target[:, index] - last, axis=1) <= _SAME_M
    moved = np.flatnonzero(tracked & ~there)
    begin = int(moved[-1]) + 1 if len(moved) else int(np.flatnonzero(tracked)[0])
    chosen = tracked & there & (np.arange(len(tracked)) >= begin)
    return chosen, float(steps.t_s[begin])


def holding(flight: FlightData) -> NDArray[np.bool_]:
    """Steps (n,) at which the last place was held: from `SETTLES_S` after it became the place to fly to."""
    chosen, since_s = last_place(flight)
    return np.asarray(chosen & (flight.steps.t_s >= since_s + SETTLES_S), dtype=np.bool_)


def plan_errors_m(flight: FlightData) -> Array:
    """Distance between where plans had the vehicle `PLANNED_AHEAD_S` later and where it was then (n,) [m]."""
    steps, index = flight.steps, list(flight.design.position_index)
    ahead = max(1, round(PLANNED_AHEAD_S / flight.design.dt_s))
    dt_ns = flight.design.dt_ns
    known_ns = np.array([d.at_ns for d in steps.decisions], dtype=np.int64)
    wrong = []
    for plan in flight.flown_plans.values():
        if ahead >= len(plan.states):
            continue
        place = int(np.searchsorted(known_ns, plan.base_ns + ahead * dt_ns))
        near = [one for one in (place - 1, place) if 0 <= one < len(known_ns)]
        if len(near) < 2:
            continue
        left, right = near
        span = int(known_ns[right] - known_ns[left])
        if span > 2 * dt_ns:
            continue  # nobody flew by plans in between
        share = (plan.base_ns + ahead * dt_ns - int(known_ns[left])) / span
        was = (1.0 - share) * steps.state[left][index] + share * steps.state[right][index]
        wrong.append(float(np.linalg.norm(was - np.array(plan.states[ahead])[index])))
    return np.array(wrong)


def _beyond(flight: FlightData, box: SafeBox) -> float | None:
    """Furthest outside of the box at a step flown by plans [m]."""
    steps = flight.steps
    tracked = [place for place, d in enumerate(steps.decisions) if d.mode is ControlMode.TRACK]
    if not tracked:
        return None
    positions = steps.state[tracked][:, list(flight.design.position_index)]
    axes = [("north", "east", "down").index(axis) for axis in flight.design.axes]
    lower, upper = np.array(box.lower)[axes], np.array(box.upper)[axes]
    return float(np.maximum(lower - positions, positions - upper).max())


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
