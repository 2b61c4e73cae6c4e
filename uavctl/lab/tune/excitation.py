"""Excitation to learn the vehicle's response: waypoints in a box, each axis by itself and then all together.

The controller of the configuration flies them, within its limits of speed and acceleration. The box is a fence for it.
The waypoints keep the distance from the fence that a resting plan keeps, and a reserve for gusts.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import msgspec

from uavctl.config import Config
from uavctl.config.mission import FenceConfig, MissionConfig
from uavctl.config.types import CostConfig
from uavctl.errors import UsageError
from uavctl.lab.trial import get_room_limits
from uavctl.records import Vec3
from uavctl.smpc.conditioned.design import AnyDesign
from uavctl.smpc.plant import AXES
from uavctl.wiring.controller import compute_reference_limits
from uavctl.wiring.mission import compute_reference_range

DOWN = 2
RESERVE_M = 0.15  # between the fence's reserve and a waypoint: gusts
# Share of the longest step that is kept as a further margin: an unknown plant overshoots more after a longer motion. A
# drag of 1.0 1/s where 0.24 is assumed came within 0.07 m of the box without it.
OVERSHOOT_SHARE = 0.2
MIN_STEP_M = (0.6, 0.6, 0.4)  # between two waypoints; on a shorter step an axis hardly moves
MAX_STEP_M = (2.4, 2.4, 1.2)  # a longer step takes time and shows no more
STEP_SIZES = (0.5, 0.5, 1.0, 1.0)  # of the range, steps of each axis by itself: small ones first
PAUSE_S = 0.5  # at a waypoint: the vehicle stops, which shows its braking
HOLD_S = 20.0  # at the end, to measure how well the position is held
SETTLING_S = 5.0  # part of HOLD_S that does not count
ACCEPT_M = 0.15
# Least cost of an input, as a share of the largest one of a state. The vehicle's answer is not known yet: with cheaper
# inputs one that comes 0.15 s later than the plant's leaves the box where this one is still caught.
MIN_INPUT_COST_SHARE = 0.03
_DURATION_FACTOR = 1.2  # over the shortest time within the limits, which plans do not use fully
_ARRIVAL_S = 0.5  # extra time to arrive at a waypoint


@dataclass(frozen=True)
class SafeBox:
    """Part of the room in which the vehicle may be excited."""

    lower: Vec3  # least north, east and down, local NED [m]
    upper: Vec3  # largest

    @property
    def centre(self) -> Vec3:
        """Centre of the box [m]."""
        north, east, down = ((low + high) / 2.0 for low, high in zip(self.lower, self.upper, strict=True))
        return round(north, 3), round(east, 3), round(down, 3)

    def describe_outside(self, position_m: Sequence[float], axes: Sequence[int] = (0, 1, 2)) -> str:
        """Describe the first axis along which a position is outside; empty if it is inside."""
        for axis in axes:
            if not self.lower[axis] <= position_m[axis] <= self.upper[axis]:
                return (
                    f"{AXES[axis]} {position_m[axis]:.2f} m is outside [{self.lower[axis]:g}, {self.upper[axis]:g}] m"
                )
        return ""


class WaypointRange(NamedTuple):
    """Axis of the box, with the range of waypoints [m]."""

    axis: int
    low_m: float
    high_m: float


def parse_box(text: str) -> SafeBox:
    """Parse a box: two opposite corners, north, east and down of each [m].

    Raises:
        UsageError: They are not six numbers.
    """
    try:
        numbers = [float(number) for number in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != 6 or not all(map(math.isfinite, numbers)):
        raise UsageError(
            f"--box={text}: give two opposite corners in local NED [m], north,east,down of each, as in "
            "--box=-1.5,-1.4,-2,1.5,1.4,-0.4 (up is < 0)"
        )
    intervals = [sorted((numbers[axis], numbers[axis + 3])) for axis in range(3)]
    (north, east, down), (northmost, eastmost, lowest) = zip(*intervals, strict=True)
    return SafeBox((north, east, down), (northmost, eastmost, lowest))


def add_excitation(config: Config, design: AnyDesign, box: SafeBox, *, lands: bool) -> Config:
    """Return the configuration with the excitation as its mission, and the box as its fences.

    Args:
        config: The configuration; its own mission and fences are dropped.
        lands: Whether the mission ends with a landing; else the last position is held until `duration_s`.

    Raises:
        UsageError: The box is not in the room, or too small; the text has the missing length.
    """
    ranges = _find_ranges(config, design, box)
    centre = box.centre
    waypoints = [*_make_waypoints(ranges, centre), centre]
    pauses = (*(PAUSE_S for _ in waypoints[:-1]), HOLD_S)
    duration_s = _estimate_duration_s(config, waypoints, ranges) + HOLD_S
    mission = MissionConfig(
        waypoints=tuple(waypoints), hold_s=pauses, accept_m=ACCEPT_M, then="land" if lands else "hold"
    )
    return msgspec.structs.replace(
        config,
        cost=_make_cautious_cost(config.cost),
        mission=mission,
        fence=tuple(_make_fences(config, box)),
        target=msgspec.structs.replace(config.target, position_m=centre),
        duration_s=float(math.ceil(duration_s)),
    )


def _make_cautious_cost(cost: CostConfig) -> CostConfig:
    """Return the weights with inputs that are not cheap."""
    least = MIN_INPUT_COST_SHARE * max(cost.state)
    return msgspec.structs.replace(cost, input=tuple(max(weight, least) for weight in cost.input))


def check_start(
    box: SafeBox, start: Sequence[float], name: str, axes: Sequence[int] = (0, 1, 2), hint: str = "begin inside"
) -> None:
    """Refuse a flight that would begin outside the box.

    Raises:
        UsageError: It would.
    """
    reason = box.describe_outside(start, axes)
    if reason:
        raise UsageError(f"--box: {name} is not inside: {reason}; {hint}, or give another box")


def _find_ranges(config: Config, design: AnyDesign, box: SafeBox) -> list[WaypointRange]:
    """Return the range of waypoints of each axis of the plant."""
    plant = config.plant
    if set(plant.axes) != set(AXES):
        raise UsageError(f"plant.axes = {list(plant.axes)}: a box has three axes, and so must the plant that is tuned")
    lower, upper = get_room_limits(config)
    tight_lower, tight_upper = _apply_fences(config, lower.tolist(), upper.tolist())
    rest_lower, rest_upper = compute_reference_range(design.plant, design.state_set, compute_reference_limits(design))
    problems, ranges = [], []
    for row, name in enumerate(plant.axes):
        axis = AXES.index(name)
        low, high, wall_low, wall_high = box.lower[axis], box.upper[axis], tight_lower[axis], tight_upper[axis]
        if low < wall_low or high > wall_high:
            problems.append(
                f"{name}: the box goes from {low:g} to {high:g} m, the configuration's limits from {wall_low:g} to "
                f"{wall_high:g} m; give a box inside"
            )
            continue
        # A resting plan keeps the same distance from a fence as from a wall.
        low_margin_m = max(0.0, float(rest_lower[row]) - float(lower[axis])) + RESERVE_M
        high_margin_m = max(0.0, float(upper[axis]) - float(rest_upper[row])) + RESERVE_M
        min_length_m = (1.0 + 2.0 * OVERSHOOT_SHARE) * MIN_STEP_M[axis]
        if high - low < low_margin_m + high_margin_m + min_length_m:
            needed_m = math.ceil(100.0 * (low_margin_m + high_margin_m + min_length_m)) / 100.0
            problems.append(
                f"{name}: the box is {high - low:.2f} m long and must be at least {needed_m:.2f} m: "
                f"{min_length_m:.2g} m of way and overshoot, {low_margin_m:.2f} and {high_margin_m:.2f} m "
                "that are kept from its sides"
            )
            continue
        # A step that overshoots by its share still ends inside: step + 2 OVERSHOOT_SHARE step = room.
        middle, half_length = (
            (low + low_margin_m + high - high_margin_m) / 2.0,
            (high - high_margin_m - low - low_margin_m) / (2.0 * (1.0 + 2.0 * OVERSHOOT_SHARE)),
        )
        half_length = min(half_length, MAX_STEP_M[axis] / 2.0)
        ranges.append(WaypointRange(axis, middle - half_length, middle + half_length))
    if problems:
        raise UsageError("\n".join(f"--box: {problem}" for problem in problems))
    return ranges


def _apply_fences(config: Config, lower: list[float], upper: list[float]) -> tuple[list[float], list[float]]:
    """Return the room, tightened by the least upper and the largest lower bounds of the configuration's fences."""
    for fence in config.fence:
        if fence.state in AXES:
            axis = AXES.index(str(fence.state))
            if fence.side == "lower":
                lower[axis] = max(lower[axis], *fence.values)
            else:
                upper[axis] = min(upper[axis], *fence.values)
    return lower, upper


def _make_waypoints(ranges: Sequence[WaypointRange], centre: Vec3) -> Iterator[Vec3]:
    """Return steps of each axis to both ends, then of all axes together."""
    for axis_range in ranges:
        for step, size in enumerate(STEP_SIZES):
            yield _make_waypoint(centre, [(_scale_range(axis_range, size), step % 2 == 0)])
    for signs in ((1, 1, 1), (0, 0, 0), (1, 0, 1), (0, 1, 0), (1, 1, 0), (0, 0, 1)):
        yield _make_waypoint(centre, list(zip(ranges, map(bool, signs), strict=True)))


def _scale_range(axis_range: WaypointRange, size: float) -> WaypointRange:
    middle, half_length = (
        0.5 * (axis_range.low_m + axis_range.high_m),
        0.5 * size * (axis_range.high_m - axis_range.low_m),
    )
    return WaypointRange(axis_range.axis, middle - half_length, middle + half_length)


def _make_waypoint(centre: Vec3, ends: Sequence[tuple[WaypointRange, bool]]) -> Vec3:
    position = list(centre)
    for axis_range, high in ends:
        position[axis_range.axis] = round(axis_range.high_m if high else axis_range.low_m, 3)
    return position[0], position[1], position[2]


def _make_fences(config: Config, box: SafeBox) -> Iterator[FenceConfig]:
    """Return the sides of the box that are tighter than the room, as fences."""
    lower, upper = get_room_limits(config)
    for name in config.plant.axes:
        axis = AXES.index(name)
        if box.lower[axis] > lower[axis]:
            yield FenceConfig(state=name, side="lower", times_s=(0.0,), values=(box.lower[axis],))
        if box.upper[axis] < upper[axis]:
            yield FenceConfig(state=name, side="upper", times_s=(0.0,), values=(box.upper[axis],))


def _estimate_duration_s(config: Config, waypoints: Sequence[Vec3], ranges: Sequence[WaypointRange]) -> float:
    """Return the longest expected duration of all steps [s]."""
    limits = config.limits.accel_mps2
    size = config.plant.states_per_axis
    total_s, start = 0.0, waypoints[-1]
    for waypoint in waypoints:
        durations_s = []
        for row, axis_range in enumerate(ranges):
            distance_m = abs(waypoint[axis_range.axis] - start[axis_range.axis])
            speed_mps = min(config.sets.state_upper[size * row + 1], 2.0)
            accel_mps2 = 0.5 * limits[axis_range.axis]
            durations_s.append(
                distance_m / speed_mps + min(speed_mps / accel_mps2, 2.0 * math.sqrt(distance_m / accel_mps2))
            )
        total_s += _DURATION_FACTOR * max(durations_s) + PAUSE_S + _ARRIVAL_S
        start = waypoint
    return total_s
