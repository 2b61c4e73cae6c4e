"""Excitation to learn the vehicle's response: waypoints in a box, each axis by itself and then all together.

The controller of the configuration flies them, so its own limits of speed and acceleration hold. The box is a fence to
it, and the waypoints stay as far inside as a plan has to that rests there, and a reserve for what it cannot plan.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import msgspec

from uavctl.build.controller import compute_rest_limits
from uavctl.build.mission import compute_rest_range
from uavctl.config import Config
from uavctl.config.mission import FenceConfig, MissionConfig
from uavctl.errors import UsageError
from uavctl.lab.trial import room_of
from uavctl.records import Vec3
from uavctl.smpc.conditioned.planner import AnyDesign
from uavctl.smpc.plant import AXES

DOWN = 2
RESERVE_M = 0.15  # between the fence's reserve and a waypoint: gusts
# Share of the longest way that is kept as well: an unknown plant overshoots by more, the longer it has moved. A drag of
# 1.0 1/s where 0.24 is assumed came within 0.07 m of the box without it.
OVERSHOOT = 0.2
LEAST_WAY_M = (0.6, 0.6, 0.4)  # between two waypoints; on a shorter one an axis hardly gets to move
MOST_WAY_M = (2.4, 2.4, 1.2)  # a longer one takes time and tells no more
SIZES = (0.5, 0.5, 1.0, 1.0)  # of the range, steps of each axis by itself: small ones first
PAUSE_S = 0.5  # at a waypoint: the vehicle stops, and so its braking is seen
HOLD_S = 20.0  # in the end, where it is seen how well the place is held
SETTLES_S = 5.0  # of that, which does not count
ACCEPT_M = 0.15
_SLOWER = 1.2  # times as long as limits of speed and acceleration allow: plans do not use them up
_LEG_S = 0.5  # that arriving takes beside the way


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

    def outside(self, place: Sequence[float], axes: Sequence[int] = (0, 1, 2)) -> str:
        """Return along which axis a place is outside, in words; empty if it is inside."""
        for axis in axes:
            if not self.lower[axis] <= place[axis] <= self.upper[axis]:
                return f"{AXES[axis]} {place[axis]:.2f} m is outside [{self.lower[axis]:g}, {self.upper[axis]:g}] m"
        return ""


class BoxAxis(NamedTuple):
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
        numbers = [float(one) for one in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != 6 or not all(map(math.isfinite, numbers)):
        raise UsageError(
            f"--box={text}: give two opposite corners in local NED [m], north,east,down of each, as in "
            "--box=-1.5,-1.4,-2,1.5,1.4,-0.4 (up is < 0)"
        )
    sides = [sorted((numbers[axis], numbers[axis + 3])) for axis in range(3)]
    (north, east, down), (northmost, eastmost, lowest) = zip(*sides, strict=True)
    return SafeBox((north, east, down), (northmost, eastmost, lowest))


def excited(config: Config, design: AnyDesign, box: SafeBox, *, lands: bool) -> Config:
    """Return the configuration with the excitation as its mission, and the box as its fences.

    Args:
        config: The configuration; its own mission and fences are left out.
        lands: Whether it is asked to land in the end; else it holds its last place for `duration_s`.

    Raises:
        UsageError: The box is not in the room, or too small; says by how much.
    """
    sides = _sides(config, design, box)
    centre = box.centre
    waypoints = [*_waypoints(sides, centre), centre]
    pauses = (*(PAUSE_S for _ in waypoints[:-1]), HOLD_S)
    duration_s = _length_s(config, waypoints, sides) + HOLD_S
    mission = MissionConfig(
        waypoints=tuple(waypoints), hold_s=pauses, accept_m=ACCEPT_M, then="land" if lands else "hold"
    )
    return msgspec.structs.replace(
        config,
        mission=mission,
        fence=tuple(_fences(config, box)),
        target=msgspec.structs.replace(config.target, position_m=centre),
        duration_s=float(math.ceil(duration_s)),
    )


def check_start(
    box: SafeBox, start: Sequence[float], what: str, axes: Sequence[int] = (0, 1, 2), hint: str = "begin inside"
) -> None:
    """Refuse a flight that would begin outside the box.

    Raises:
        UsageError: It would.
    """
    why = box.outside(start, axes)
    if why:
        raise UsageError(f"--box: {what} is not inside: {why}; {hint}, or give another box")


def _sides(config: Config, design: AnyDesign, box: SafeBox) -> list[BoxAxis]:
    """Return the range of waypoints of each axis of the plant."""
    plant = config.plant
    if set(plant.axes) != set(AXES):
        raise UsageError(f"plant.axes = {list(plant.axes)}: a box has three axes, and so must the plant that is tuned")
    lower, upper = room_of(config)
    tight_lower, tight_upper = _fenced(config, lower.tolist(), upper.tolist())
    least, most = compute_rest_range(design.plant, design.state_set, compute_rest_limits(design))
    problems, sides = [], []
    for place, name in enumerate(plant.axes):
        axis = AXES.index(name)
        low, high, wall_low, wall_high = box.lower[axis], box.upper[axis], tight_lower[axis], tight_upper[axis]
        if low < wall_low or high > wall_high:
            problems.append(
                f"{name}: the box goes from {low:g} to {high:g} m, the configuration's limits from {wall_low:g} to "
                f"{wall_high:g} m; give a box inside"
            )
            continue
        # What a plan that rests keeps from a wall it keeps from a fence, too.
        below = max(0.0, float(least[place]) - float(lower[axis])) + RESERVE_M
        above = max(0.0, float(upper[axis]) - float(most[place])) + RESERVE_M
        least_m = (1.0 + 2.0 * OVERSHOOT) * LEAST_WAY_M[axis]
        if high - low < below + above + least_m:
            needed_m = math.ceil(100.0 * (below + above + least_m)) / 100.0
            problems.append(
                f"{name}: the box is {high - low:.2f} m long and must be at least {needed_m:.2f} m: "
                f"{least_m:.2g} m of way and overshoot, {below:.2f} and {above:.2f} m that are kept from its sides"
            )
            continue
        # A step of `way` that overshoots by its share still ends as far inside: way + 2 OVERSHOOT way = room.
        middle, half = (
            (low + below + high - above) / 2.0,
            (high - above - low - below) / (2.0 * (1.0 + 2.0 * OVERSHOOT)),
        )
        half = min(half, MOST_WAY_M[axis] / 2.0)
        sides.append(BoxAxis(axis, middle - half, middle + half))
    if problems:
        raise UsageError("\n".join(f"--box: {one}" for one in problems))
    return sides


def _fenced(config: Config, lower: list[float], upper: list[float]) -> tuple[list[float], list[float]]:
    """Return the room where the configuration's own fences on positions are tightest."""
    for one in config.fence:
        if one.state in AXES:
            axis = AXES.index(str(one.state))
            if one.side == "lower":
                lower[axis] = max(lower[axis], *one.values)
            else:
                upper[axis] = min(upper[axis], *one.values)
    return lower, upper


def _waypoints(sides: Sequence[BoxAxis], centre: Vec3) -> Iterator[Vec3]:
    """Return steps of each axis there and back, then of all axes together."""
    for side in sides:
        for step, size in enumerate(SIZES):
            yield _moved(centre, [(_shrunk(side, size), step % 2 == 0)])
    for signs in ((1, 1, 1), (0, 0, 0), (1, 0, 1), (0, 1, 0), (1, 1, 0), (0, 0, 1)):
        yield _moved(centre, list(zip(sides, map(bool, signs), strict=True)))


def _shrunk(side: BoxAxis, size: float) -> BoxAxis:
    middle, half = 0.5 * (side.low_m + side.high_m), 0.5 * size * (side.high_m - side.low_m)
    return BoxAxis(side.axis, middle - half, middle + half)


def _moved(centre: Vec3, ends: Sequence[tuple[BoxAxis, bool]]) -> Vec3:
    place = list(centre)
    for side, high in ends:
        place[side.axis] = round(side.high_m if high else side.low_m, 3)
    return place[0], place[1], place[2]


def _fences(config: Config, box: SafeBox) -> Iterator[FenceConfig]:
    """Return the sides of the box that are tighter than the room, as fences."""
    lower, upper = room_of(config)
    for name in config.plant.axes:
        axis = AXES.index(name)
        if box.lower[axis] > lower[axis]:
            yield FenceConfig(state=name, side="lower", times_s=(0.0,), values=(box.lower[axis],))
        if box.upper[axis] < upper[axis]:
            yield FenceConfig(state=name, side="upper", times_s=(0.0,), values=(box.upper[axis],))


def _length_s(config: Config, waypoints: Sequence[Vec3], sides: Sequence[BoxAxis]) -> float:
    """Return how long the ways take at most, if nothing is in the way [s]."""
    limits = config.limits.accel_mps2
    size = config.plant.states_per_axis
    total_s, at = 0.0, waypoints[-1]
    for place in waypoints:
        legs = []
        for number, side in enumerate(sides):
            way_m = abs(place[side.axis] - at[side.axis])
            speed_mps = min(config.sets.state_upper[size * number + 1], 2.0)
            accel_mps2 = 0.5 * limits[side.axis]
            legs.append(way_m / speed_mps + min(speed_mps / accel_mps2, 2.0 * math.sqrt(way_m / accel_mps2)))
        total_s += _SLOWER * max(legs) + PAUSE_S + _LEG_S
        at = place
    return total_s
