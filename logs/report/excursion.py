"""Excursions: where and when the vehicle was beyond a limit of its position, and by how much.

Judged over all that was recorded of the vehicle in the air, its own climb and landing too: by the truth where that is
known, else by the estimate, until its newest position is as old as plans reach.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from logs.recording.design_view import AXIS_NUMBER
from logs.recording.flight import FLOWN, FlightData
from logs.recording.summary import BLIND_S, RELATIVE_TOLERANCE, compute_box
from uavctl.arrays import Array, Flags
from uavctl.records import Estimate

GRAVE_M = 0.05  # beyond a limit: further than the promised probability explains
_WALL_NAMES = {
    ("north", 1): "north wall",
    ("north", 0): "south wall",
    ("east", 1): "east wall",
    ("east", 0): "west wall",
    ("down", 1): "floor",
    ("down", 0): "ceiling",
}
_MIN_RETURN_S = 1.0  # back inside for less than this, it is still the same excursion


@dataclass(frozen=True)
class Excursion:
    """One stay beyond one limit of the position; times on the report's axis [s], places in local NED [m]."""

    wall: str  # as a person calls it, e.g. "north wall"
    axis: str
    outwards: float  # sign of the axis that leads out
    exit_s: float
    worst_s: float
    return_s: float | None  # None if it did not come back while it was recorded
    beyond_m: float  # at the worst
    exit_m: tuple[float, ...]
    worst_m: tuple[float, ...]

    @property
    def passage(self) -> str:
        """Return which way it went, e.g. "through the north wall"."""
        return "below the floor" if self.wall == "floor" else f"through the {self.wall}"


@dataclass(frozen=True, eq=False)
class Clearance:
    """Distance from each limit of the position over the time in the air; negative beyond it."""

    t_s: Array  # (n,)
    position_m: Array  # (n, 3)
    walls: tuple[tuple[str, str, int], ...]  # name, axis, and 1 for the upper side, else 0
    free_m: Array  # (n, walls), infinite where the limit does not count

    @classmethod
    def of(cls, flight: FlightData) -> Clearance:
        """Measure a flight; without rows where nothing was flown."""
        design = flight.design
        t_s, position_m, flown = _collect_airborne_positions(flight)
        lower, upper = compute_box(flight, t_s)
        box, walls, free = design.state_box, [], []

        def measure(name: str, axis: str, side: int, bound: Array) -> None:
            walls.append((name, axis, side))
            at_m = position_m[:, AXIS_NUMBER[axis]]
            free.append(bound - at_m if side else at_m - bound)

        for axis, state in zip(design.axes, design.position_index, strict=True):
            for side, limit, constant in ((0, lower[:, state], box.lower), (1, upper[:, state], box.upper)):
                if not np.isfinite(wall := constant[state]):
                    continue
                name, never = _WALL_NAMES[axis, side], np.inf if side else -np.inf
                # A vehicle starts and lands on the floor; plans keep within a fence.
                measure(name, axis, side, np.where(flown, wall, never if name == "floor" else wall))
                if np.any(limit != wall):
                    measure(f"{name.removesuffix(' wall')} fence", axis, side, np.where(flown, limit, never))
        return cls(t_s, position_m, tuple(walls), np.array(free).reshape(len(walls), len(t_s)).T)

    def find_nearest(self) -> tuple[str, float, float] | None:
        """Return the wall that it was nearest to, how near [m], and when [s]; None without a limit or a flight.

        The floor is left out: to be near it is no danger.
        """
        columns = [place for place, (name, _, _) in enumerate(self.walls) if name != "floor"]
        free_m = self.free_m[:, columns]
        if not free_m.size or not np.isfinite(free_m).any():
            return None
        row, column = np.unravel_index(int(np.where(np.isfinite(free_m), free_m, np.inf).argmin()), free_m.shape)
        return self.walls[columns[column]][0], float(free_m[row, column]), float(self.t_s[row])


def find_excursions(flight: FlightData) -> tuple[Excursion, ...]:
    """Return all excursions of a flight, the furthest first."""
    clearance = Clearance.of(flight)
    return tuple(sorted(_iterate_excursions(clearance), key=lambda excursion: -excursion.beyond_m))


def _iterate_excursions(clearance: Clearance) -> Iterator[Excursion]:
    for column, (wall, axis, side) in enumerate(clearance.walls):
        free_m = clearance.free_m[:, column]
        limit_m = np.abs(clearance.position_m[:, AXIS_NUMBER[axis]] + np.where(np.isfinite(free_m), free_m, 0.0))
        is_outside = free_m < -RELATIVE_TOLERANCE * np.maximum(1.0, limit_m)
        for begin, end in _find_runs(is_outside, clearance.t_s):
            worst = begin + int(free_m[begin:end].argmin())
            yield Excursion(
                wall=wall,
                axis=axis,
                outwards=1.0 if side else -1.0,
                exit_s=float(clearance.t_s[begin]),
                worst_s=float(clearance.t_s[worst]),
                return_s=float(clearance.t_s[end]) if end < len(clearance.t_s) else None,
                beyond_m=float(-free_m[worst]),
                exit_m=tuple(clearance.position_m[begin].tolist()),
                worst_m=tuple(clearance.position_m[worst].tolist()),
            )


def _find_runs(outside: Flags, t_s: Array) -> list[tuple[int, int]]:
    """Return the first index of each run outside, and the one after it; runs close to each other are one."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], outside, [False]]).astype(np.int8)))
    runs: list[tuple[int, int]] = []
    for begin, end in edges.reshape(-1, 2).tolist():
        if runs and t_s[begin] - t_s[runs[-1][1]] < _MIN_RETURN_S:
            runs[-1] = runs[-1][0], end
        else:
            runs.append((begin, end))
    return runs


def select_trusted_estimates(flight: FlightData) -> tuple[Estimate, ...]:
    """Return the estimates with a position recent enough for plans."""
    reach_s = flight.design.horizon * flight.design.dt_s
    return tuple(estimate for estimate in flight.estimates if estimate.age_s <= reach_s)


def _collect_airborne_positions(flight: FlightData) -> tuple[Array, Array, Flags]:
    """Return times (n,) [s] and places (n, 3) [m] in the air, and at which of them the controller flew (n,)."""
    records = flight.truths or flight.estimates
    positions = [t.position_m for t in flight.truths] or [flight.design.position_of(e.mean) for e in flight.estimates]
    t_s = flight.seconds([record.at_ns for record in records])
    position_m = np.array(positions, dtype=np.float64).reshape(-1, 3)
    flown = np.zeros(len(t_s), dtype=np.bool_)
    for begun_s, ended_s in flight.spans(FLOWN):
        flown |= (t_s >= begun_s) & (t_s < ended_s)
    is_kept = (t_s >= _find_airborne_s(flight)) & np.isfinite(position_m).all(axis=1)
    if not flight.truths:
        age_s = np.array([estimate.age_s for estimate in flight.estimates])
        is_kept &= (flown & (age_s <= flight.design.horizon * flight.design.dt_s)) | (age_s <= BLIND_S)
    return t_s[is_kept], position_m[is_kept], flown[is_kept]


def _find_airborne_s(flight: FlightData) -> float:
    """Return when the vehicle was flown, or reported armed and not on the ground, for the first time [s]."""
    airborne_ns = [status.at_ns for status in flight.vehicles if status.armed and status.landed is False]
    engaged_s = [begun_s for begun_s, _ in flight.spans(FLOWN)[:1]]
    return min([*engaged_s, *flight.seconds(airborne_ns[:1]).tolist()], default=np.inf)
