"""Excursions: where and when the vehicle was beyond a limit of its position, and by how much.

Judged over all that was recorded of the vehicle in the air, its own climb and landing too: by the truth where that is
known, else by the estimate, until its newest position is as old as plans reach.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from logs.recording.design_view import AXIS_NUMBER, Floats
from logs.recording.flight import FLOWN, FlightData
from logs.recording.summary import BLIND_S, RELATIVE_TOLERANCE, box_at
from uavctl.records import Estimate

GRAVE_M = 0.05  # beyond a limit: further than what a plan promises to keep now and then
_WALLS = {
    ("north", 1): "north wall",
    ("north", 0): "south wall",
    ("east", 1): "east wall",
    ("east", 0): "west wall",
    ("down", 1): "floor",
    ("down", 0): "ceiling",
}
_SAME_S = 1.0  # back inside for less than this, it is still the same excursion


@dataclass(frozen=True)
class Excursion:
    """One stay beyond one limit of the position; times on the report's axis [s], places in local NED [m]."""

    wall: str  # as a person calls it, e.g. "north wall"
    axis: str
    outwards: float  # sign of the axis that leads out
    left_s: float
    worst_s: float
    back_s: float | None  # None if it did not come back while it was recorded
    beyond_m: float  # at the worst
    left_m: tuple[float, ...]
    worst_m: tuple[float, ...]

    @property
    def passage(self) -> str:
        """Return which way it went, e.g. "through the north wall"."""
        return "below the floor" if self.wall == "floor" else f"through the {self.wall}"


@dataclass(frozen=True, eq=False)
class Clearance:
    """Distance from each limit of the position over the time in the air; negative beyond it."""

    t_s: Floats  # (n,)
    position_m: Floats  # (n, 3)
    walls: tuple[tuple[str, str, int], ...]  # name, axis, and 1 for the upper side, else 0
    free_m: Floats  # (n, walls), infinite where the limit does not count

    @classmethod
    def of(cls, flight: FlightData) -> Clearance:
        """Measure a flight; without rows where nothing was flown."""
        design = flight.design
        t_s, position_m, flown = _course(flight)
        lower, upper = box_at(flight, t_s)
        box, walls, free = design.state_box, [], []

        def measure(name: str, axis: str, side: int, bound: Floats) -> None:
            walls.append((name, axis, side))
            at_m = position_m[:, AXIS_NUMBER[axis]]
            free.append(bound - at_m if side else at_m - bound)

        for axis, state in zip(design.axes, design.position_index, strict=True):
            for side, limit, constant in ((0, lower[:, state], box.lower), (1, upper[:, state], box.upper)):
                if not np.isfinite(wall := constant[state]):
                    continue
                name, never = _WALLS[axis, side], np.inf if side else -np.inf
                # The floor is where a vehicle starts and lands, and a fence is what plans keep within.
                measure(name, axis, side, np.where(flown, wall, never if name == "floor" else wall))
                if np.any(limit != wall):
                    measure(f"{name.removesuffix(' wall')} fence", axis, side, np.where(flown, limit, never))
        return cls(t_s, position_m, tuple(walls), np.array(free).reshape(len(walls), len(t_s)).T)

    def nearest(self) -> tuple[str, float, float] | None:
        """Return the wall that it was nearest to, how near [m], and when [s]; None without a limit or a flight.

        The floor is left out: to be near it is no danger.
        """
        kept = [place for place, (name, _, _) in enumerate(self.walls) if name != "floor"]
        free = self.free_m[:, kept]
        if not free.size or not np.isfinite(free).any():
            return None
        row, column = np.unravel_index(int(np.where(np.isfinite(free), free, np.inf).argmin()), free.shape)
        return self.walls[kept[column]][0], float(free[row, column]), float(self.t_s[row])


def excursions(flight: FlightData) -> tuple[Excursion, ...]:
    """Return all excursions of a flight, the furthest first."""
    found = Clearance.of(flight)
    return tuple(sorted(_excursions(found), key=lambda one: -one.beyond_m))


def _excursions(found: Clearance) -> Iterator[Excursion]:
    for column, (wall, axis, side) in enumerate(found.walls):
        free = found.free_m[:, column]
        limit_m = np.abs(found.position_m[:, AXIS_NUMBER[axis]] + np.where(np.isfinite(free), free, 0.0))
        outside = free < -RELATIVE_TOLERANCE * np.maximum(1.0, limit_m)
        for begin, end in _runs(outside, found.t_s):
            worst = begin + int(free[begin:end].argmin())
            yield Excursion(
                wall=wall,
                axis=axis,
                outwards=1.0 if side else -1.0,
                left_s=float(found.t_s[begin]),
                worst_s=float(found.t_s[worst]),
                back_s=float(found.t_s[end]) if end < len(found.t_s) else None,
                beyond_m=float(-free[worst]),
                left_m=tuple(found.position_m[begin].tolist()),
                worst_m=tuple(found.position_m[worst].tolist()),
            )


def _runs(outside: NDArray[np.bool_], t_s: Floats) -> list[tuple[int, int]]:
    """Return the first index of each run outside, and the one after it; runs close to each other are one."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], outside, [False]]).astype(np.int8)))
    runs: list[tuple[int, int]] = []
    for begin, end in edges.reshape(-1, 2).tolist():
        if runs and t_s[begin] - t_s[runs[-1][1]] < _SAME_S:
            runs[-1] = runs[-1][0], end
        else:
            runs.append((begin, end))
    return runs


def trusted(flight: FlightData) -> tuple[Estimate, ...]:
    """Return the estimates that say where the vehicle is: those with a position that plans still reach from."""
    reach_s = flight.design.horizon * flight.design.dt_s
    return tuple(one for one in flight.estimates if one.age_s <= reach_s)


def _course(flight: FlightData) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Return times (n,) [s] and places (n, 3) [m] in the air, and at which of them the controller flew (n,)."""
    known = flight.truths or flight.estimates
    places = [t.position_m for t in flight.truths] or [flight.design.position_of(e.mean) for e in flight.estimates]
    t_s = flight.seconds([one.at_ns for one in known])
    position_m = np.array(places, dtype=np.float64).reshape(-1, 3)
    flown = np.zeros(len(t_s), dtype=np.bool_)
    for begun_s, ended_s in flight.spans(FLOWN):
        flown |= (t_s >= begun_s) & (t_s < ended_s)
    kept = (t_s >= _aloft_s(flight)) & np.isfinite(position_m).all(axis=1)
    if not flight.truths:
        age_s = np.array([one.age_s for one in flight.estimates])
        kept &= (flown & (age_s <= flight.design.horizon * flight.design.dt_s)) | (age_s <= BLIND_S)
    return t_s[kept], position_m[kept], flown[kept]


def _aloft_s(flight: FlightData) -> float:
    """Return when the vehicle was flown, or said to be armed and not on the ground, for the first time [s]."""
    said = [one.at_ns for one in flight.vehicles if one.armed and one.landed is False]
    begun = [begun_s for begun_s, _ in flight.spans(FLOWN)[:1]]
    return min([*begun, *flight.seconds(said[:1]).tolist()], default=np.inf)
