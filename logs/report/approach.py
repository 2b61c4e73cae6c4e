"""Closest approach of two vehicles whose positions were recorded at times of their own.

Between two records a vehicle moves straight. So both move straight between two neighbouring times of either, and the
distance there has its least value in closed form.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uavctl.arrays import SECOND_NS, Array, Flags

Times = NDArray[np.int64]

MAX_GAP_NS = SECOND_NS // 2  # between two positions; at 2 m/s a vehicle moves 1 m, and the way between is not known


@dataclass(frozen=True, eq=False)
class Track:
    """Positions of a vehicle over time."""

    name: str
    at_ns: Times  # (n,) UTC, strictly ascending
    position_m: Array  # (n, 3), local NED
    is_true: bool  # by a simulator, else by the vehicle's own estimate

    def interpolate(self, at_ns: Times) -> Array:
        """Return the positions (m, 3) at times within those of the track."""
        begin_ns = self.at_ns[0]
        seconds, known_s = (at_ns - begin_ns) * 1e-9, (self.at_ns - begin_ns) * 1e-9
        return np.column_stack([np.interp(seconds, known_s, column) for column in self.position_m.T])

    def covers(self, at_ns: Times) -> Flags:
        """Return for each time (m,) whether positions right before and after it are known."""
        after = np.clip(np.searchsorted(self.at_ns, at_ns, side="right"), 1, len(self.at_ns) - 1)
        is_within = (self.at_ns[0] <= at_ns) & (at_ns <= self.at_ns[-1])
        return np.asarray(is_within & (self.at_ns[after] - self.at_ns[after - 1] <= MAX_GAP_NS), dtype=np.bool_)


@dataclass(frozen=True)
class LeastDistance:
    """Closest approach of two vehicles."""

    names: tuple[str, str]
    at_ns: int  # UTC
    distance_m: float
    horizontal_m: float
    height_m: float  # of the second above the first
    is_true: bool  # both positions are a simulator's


def find_closest_approach(first: Track, second: Track) -> LeastDistance | None:
    """Return the closest approach of two vehicles; None where there is no time at which both positions are known."""
    if min(len(first.at_ns), len(second.at_ns)) < 2:
        return None
    times_ns = np.union1d(first.at_ns, second.at_ns)
    begin_ns, end_ns = max(first.at_ns[0], second.at_ns[0]), min(first.at_ns[-1], second.at_ns[-1])
    times_ns = times_ns[(begin_ns <= times_ns) & (times_ns <= end_ns)]
    middle_ns = times_ns[:-1] + np.diff(times_ns) // 2
    is_known = first.covers(middle_ns) & second.covers(middle_ns)
    if not is_known.any():
        return None
    offset_m = second.interpolate(times_ns) - first.interpolate(times_ns)
    begin_m, change_m = offset_m[:-1][is_known], np.diff(offset_m, axis=0)[is_known]
    # r(s) = r₀ + s d, 0 <= s <= 1; |r|² is least at s = -r₀·d / |d|²
    length_m2 = np.einsum("ij,ij->i", change_m, change_m)
    share = -np.einsum("ij,ij->i", begin_m, change_m) / np.where(length_m2 > 0.0, length_m2, 1.0)
    share = np.clip(share, 0.0, 1.0)
    nearest_m = begin_m + share[:, None] * change_m
    index = int(np.linalg.norm(nearest_m, axis=1).argmin())
    north_m, east_m, down_m = nearest_m[index].tolist()
    at_ns = times_ns[:-1][is_known][index] + round(share[index] * np.diff(times_ns)[is_known][index])
    return LeastDistance(
        names=(first.name, second.name),
        at_ns=int(at_ns),
        distance_m=float(np.linalg.norm(nearest_m[index])),
        horizontal_m=float(np.hypot(north_m, east_m)),
        height_m=-down_m,
        is_true=first.is_true and second.is_true,
    )


def compute_distances_m(first: Track, second: Track, at_ns: Times) -> Array:
    """Return the distance of two vehicles at given times (n,) [m]; NaN where a position is not known."""
    distance_m = np.full(len(at_ns), np.nan)
    if min(len(first.at_ns), len(second.at_ns)) < 2:
        return distance_m
    is_known = first.covers(at_ns) & second.covers(at_ns)
    offset_m = second.interpolate(at_ns[is_known]) - first.interpolate(at_ns[is_known])
    distance_m[is_known] = np.linalg.norm(offset_m, axis=1)
    return distance_m
