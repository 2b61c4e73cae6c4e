"""Boxes in time, and separating planes between the boxes of all pairs of vehicles.

1. A box of stage s contains a vehicle from step k + s to step k + s + 1; the last one holds for all later steps.
2. Two boxes are apart if the gap between them is at least d, north or east. Height does not count: the lower vehicle
   would fly in the downwash of the upper one, and two that land above each other would meet on the floor.
3. A pair may be divided along any axis where the boxes that both may use already (the claims) are apart. Of these the
   axis is selected where the plans are furthest apart relative to their margins. So a plane never cuts a claim.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from uavctl.arrays import Array, Flags

LEVEL = slice(0, 2)  # north and east
ROUNDING_M = 1e-9  # a gap smaller than a distance by less than this is rounding


@dataclass(frozen=True, eq=False)
class Boxes:
    """Boxes of N vehicles in S stages, local NED [m]; a vehicle without a box has an empty one, see `make_empty`."""

    lower_m: Array  # (N, S, 3)
    upper_m: Array  # (N, S, 3)

    @classmethod
    def make_empty(cls, vehicles: int, stages: int) -> Self:
        """Make boxes that contain nothing; the hull of an empty box and another one is the other one."""
        shape = vehicles, stages, 3
        return cls(np.full(shape, np.inf), np.full(shape, -np.inf))

    @property
    def is_empty(self) -> Flags:
        """Whether a vehicle has no box (N,)."""
        return np.asarray((self.lower_m > self.upper_m).any(axis=(1, 2)))

    def take(self, vehicles: Flags, other: Boxes) -> Boxes:
        """Return these boxes for the vehicles with a flag (N,), else those of `other`."""
        chosen = vehicles[:, None, None]
        return Boxes(np.where(chosen, self.lower_m, other.lower_m), np.where(chosen, self.upper_m, other.upper_m))

    def take_level(self) -> Boxes:
        """Return the sides north and east alone (N, S, 2)."""
        return Boxes(self.lower_m[..., LEVEL], self.upper_m[..., LEVEL])

    def cover(self, other: Boxes) -> Boxes:
        """Return the hull of these boxes and those of `other`."""
        return Boxes(np.minimum(self.lower_m, other.lower_m), np.maximum(self.upper_m, other.upper_m))

    def clip_to(self, other: Boxes) -> Boxes:
        """Return the nearest boxes inside of those of `other`."""
        return Boxes(
            np.clip(self.lower_m, other.lower_m, other.upper_m), np.clip(self.upper_m, other.lower_m, other.upper_m)
        )

    def advance(self, steps: int) -> Boxes:
        """Return the boxes from a later step on."""
        stages = self.lower_m.shape[1]
        index = np.minimum(np.arange(stages) + steps, stages - 1)
        return Boxes(self.lower_m[:, index], self.upper_m[:, index])


@dataclass(frozen=True, eq=False)
class Bounds:
    """Sides of all planes that concern a vehicle: the tightest of each axis (N, S, 3) [m]."""

    lower_m: Array
    upper_m: Array
    is_divided: Flags  # whether a plane divides the vehicle from each other one, in all stages (N,)


def divide_pairs(claims: Boxes, plans: Boxes, distance_m: float) -> Bounds:
    """Divide each pair by one plane in each stage, normal to north or east, and return the sides of the planes.

    Args:
        claims: Boxes that the vehicles may use already. A plane is outside of them by half of the distance. An empty
            claim needs no plane.
        plans: Mean plans with their margins, inside of the claims.
        distance_m: Distance d that the pairs keep, north or east.
    """
    first, second = np.triu_indices(len(claims.lower_m), 1)
    present = ~claims.is_empty
    is_pair = present[first] & present[second]
    first, second = first[is_pair], second[is_pair]
    plans, level_claims = plans.take_level(), claims.take_level()
    middle, half = 0.5 * (plans.lower_m + plans.upper_m), 0.5 * (plans.upper_m - plans.lower_m)
    # ρ = ±(m_j - m_i) / (w_i + w_j + d), + where the claim of i is below that of j: at most one sign is possible
    ratio = (middle[second] - middle[first]) / (half[first] + half[second] + distance_m)
    is_below = level_claims.lower_m[second] - level_claims.upper_m[first] >= distance_m - ROUNDING_M
    is_above = level_claims.lower_m[first] - level_claims.upper_m[second] >= distance_m - ROUNDING_M
    ratio = np.where(is_below, ratio, np.where(is_above, -ratio, -np.inf))
    choice = ratio.argmax(axis=2)
    is_apart = np.isfinite(np.take_along_axis(ratio, choice[..., None], axis=2)[..., 0])
    pair, stage = np.nonzero(is_apart)
    axis = choice[pair, stage]
    is_above = is_above[pair, stage, axis]
    low, high = np.where(is_above, second[pair], first[pair]), np.where(is_above, first[pair], second[pair])
    low_at, high_at = (low, stage, axis), (high, stage, axis)
    # c = (p_low + p_high) / 2, at least d / 2 outside of both claims
    half_needed = 0.5 * distance_m
    least_m, most_m = claims.upper_m[low_at] + half_needed, claims.lower_m[high_at] - half_needed
    middle_m = 0.5 * (plans.upper_m[low_at] + plans.lower_m[high_at])
    centre_m = np.where(least_m > most_m, 0.5 * (least_m + most_m), np.clip(middle_m, least_m, most_m))
    upper_m, lower_m = np.full(claims.upper_m.shape, np.inf), np.full(claims.lower_m.shape, -np.inf)
    np.minimum.at(upper_m, low_at, centre_m - half_needed)
    np.maximum.at(lower_m, high_at, centre_m + half_needed)
    is_divided = np.ones(len(present), dtype=bool)
    undivided = ~is_apart.all(axis=1)
    is_divided[first[undivided]] = is_divided[second[undivided]] = False
    return Bounds(lower_m, upper_m, is_divided)


def find_gaps(first: Boxes, second: Boxes, distance_m: float) -> Array:
    """Return the larger gap, north or east, over the distance, (N, M, S), of all pairs of boxes; apart: at least 1."""
    first, second = first.take_level(), second.take_level()
    ahead_m = second.lower_m[None] - first.upper_m[:, None]
    behind_m = first.lower_m[:, None] - second.upper_m[None]
    return np.asarray(np.maximum(ahead_m, behind_m).max(axis=3) / distance_m)
