"""Right of way: a rule that ends deadlocks without messages. Pass on the right, then by number.

1. Where the way to the goal is free, a vehicle goes ahead.
2. Where another vehicle blocks it, the vehicle passes on the right. Two vehicles face to face then pass each other.
3. Where the right is blocked as well, the vehicle with the smaller number waits. The other one gives way: to the left,
   else back.
4. A vehicle at its goal, or on its way back there, gives way to one that can pass on neither side. Else that one goes
   back and ahead for good.
5. Of several with one goal the nearest gets it. The others go to places beside it.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np

from uavctl.arrays import Array, Flags
from uavctl.fleet.boxes import LEVEL, ROUNDING_M


class Move(Enum):
    """Direction of a move, seen from the way to the goal: quarter turns to the right."""

    AHEAD = 0
    RIGHT = 1
    BACK = 2
    LEFT = 3
    WAIT = -1


def choose_move(is_free: dict[Move, bool], has_right_of_way: bool) -> Move:
    """Choose a move, by the directions that are free and by whether the vehicle that blocks the way has to wait."""
    for move in (Move.AHEAD, Move.RIGHT):
        if is_free[move]:
            return move
    if has_right_of_way:
        return Move.WAIT
    return next((move for move in (Move.LEFT, Move.BACK) if is_free[move]), Move.WAIT)


LOOK_AHEAD_M = 1.6  # way on which a vehicle looks for others: about that of a stop from 1.5 m/s, twice
PASS_M = 1.2  # way of a move to a side
# Corners of a square, and middles of its sides
_SQUARE = np.array([(north, east) for north in (-1.0, 0.0, 1.0) for east in (-1.0, 0.0, 1.0) if north or east])
ARRIVED_M = 0.15  # a vehicle that is this near to its goal rests


@dataclass(frozen=True, eq=False)
class Ways:
    """Room and width of the ways of the vehicles."""

    distance_m: float  # that the pairs keep, north or east
    margin_m: float  # room around a plan
    room_lower_m: Array  # (3,)
    room_upper_m: Array  # (3,)

    @property
    def width_m(self) -> float:
        """Sideways distance within which another vehicle blocks the way."""
        return self.distance_m + 2.0 * self.margin_m


def separate_goals(goals_m: Array, positions_m: Array, ways: Ways, pitch_m: float) -> Array:
    """Separate goals that are too near for cells at both (N, 3): the vehicle that is nearest to its goal keeps it.

    Each other one gets the nearest place of a square around the goals that are kept, or stays where it is.

    Args:
        goals_m: (N, 3).
        positions_m: (N, 3).
        pitch_m: Half side of the square, by which places for two are apart.
    """
    apart_m = goals_m.copy()
    offsets_m = np.abs(goals_m[:, None] - goals_m[None])[..., LEVEL].max(axis=2)
    np.fill_diagonal(offsets_m, np.inf)
    if offsets_m.min() >= ways.width_m - ROUNDING_M:
        return apart_m
    level_m, begin_m = apart_m[:, LEVEL], positions_m[:, LEVEL]
    kept = np.zeros((0, 2))
    for i in np.argsort(np.linalg.norm(goals_m - positions_m, axis=1), kind="stable"):
        if _find_nearest_m(level_m[i : i + 1], kept)[0] < ways.width_m - ROUNDING_M:
            # The place of the square towards the vehicle, its corners and the middles of its sides
            way_m = begin_m[i] - kept
            towards = way_m / np.maximum(np.abs(way_m).max(axis=1, keepdims=True), ROUNDING_M)
            places_m = np.vstack([kept + pitch_m * towards, (kept[:, None] + pitch_m * _SQUARE).reshape(-1, 2)])
            is_inside = ((places_m > ways.room_lower_m[LEVEL]) & (places_m < ways.room_upper_m[LEVEL])).all(axis=1)
            places_m = places_m[is_inside & (_find_nearest_m(places_m, kept) >= pitch_m - ROUNDING_M)]
            places_m = np.vstack([places_m, begin_m[i : i + 1]])[: max(len(places_m), 1)]
            level_m[i] = places_m[np.linalg.norm(places_m - begin_m[i], axis=1).argmin()]
        kept = np.vstack([kept, level_m[i]])
    return apart_m


def _find_nearest_m(places_m: Array, others_m: Array) -> Array:
    """Find the distance, north or east, from each place (M, 2) to the nearest other one (K, 2): (M,)."""
    return np.asarray(np.abs(places_m[:, None] - others_m[None]).max(axis=2).min(axis=1, initial=np.inf))


def choose_guides(positions_m: Array, goals_m: Array, ways: Ways) -> Array:
    """Choose the place that each vehicle flies to next (N, 3): its goal, or a place beside the way to it.

    Args:
        positions_m: (N, 3).
        goals_m: (N, 3).
    """
    guides_m = goals_m.copy()
    way_m = (goals_m - positions_m)[:, LEVEL]
    length_m = np.linalg.norm(way_m, axis=1)
    ahead = way_m / np.maximum(length_m, ARRIVED_M)[:, None]
    offsets_m = (positions_m[None] - positions_m[:, None])[..., LEVEL]
    is_other = ~np.eye(len(positions_m), dtype=bool)
    look_m = np.minimum(LOOK_AHEAD_M, length_m + ways.width_m)[:, None]
    is_blocking = is_other & _is_on_way(*_project(offsets_m, ahead), look_m, ways.width_m)
    blockers = np.where(is_blocking, np.linalg.norm(offsets_m, axis=2), np.inf).argmin(axis=1)
    is_free = _find_free(positions_m[:, LEVEL], ahead, offsets_m, is_other, ways)
    asked: dict[int, int] = {}  # vehicle that waits for a vehicle at its goal
    for i in np.flatnonzero(is_blocking.any(axis=1) & (length_m > ARRIVED_M)).tolist():
        blocker = int(blockers[i])
        is_resting, directions = bool(length_m[blocker] < PASS_M), _describe_free(is_free[i])
        directions[Move.BACK] &= not is_resting
        move = choose_move(directions, i < blocker and bool(length_m[blocker] > ARRIVED_M))
        if move is Move.WAIT and is_resting:
            asked.setdefault(blocker, i)
        guides_m[i, LEVEL] = positions_m[i, LEVEL] + _find_step_m(move, ahead[i])
    for i, waiting in asked.items():
        towards = offsets_m[i, waiting] / np.linalg.norm(offsets_m[i, waiting])
        place_m, row = positions_m[i : i + 1, LEVEL], slice(i, i + 1)
        is_free = _find_free(place_m, towards[None], offsets_m[row], is_other[row], ways)
        move = choose_move(_describe_free(is_free[0]), False)
        guides_m[i, LEVEL] = positions_m[i, LEVEL] + _find_step_m(move, towards)
    return guides_m


def _describe_free(is_free: Flags) -> dict[Move, bool]:
    """Describe the directions (4,) that are free; the way ahead is blocked."""
    return {Move.AHEAD: False, Move.RIGHT: bool(is_free[1]), Move.BACK: bool(is_free[2]), Move.LEFT: bool(is_free[3])}


def _find_free(places_m: Array, ahead: Array, offsets_m: Array, is_other: Flags, ways: Ways) -> Flags:
    """Find whether M vehicles may move in each direction, by quarter turns to the right (M, 4).

    Args:
        places_m: (M, 2).
        ahead: Directions of the ways (M, 2).
        offsets_m: Offsets of all vehicles (M, N, 2).
        is_other: Which of them count (M, N).
    """
    along_m, across_m = _project(offsets_m, ahead)
    right = _turn(ahead)
    is_free = []
    for direction, forward_m, aside_m in (
        (ahead, along_m, across_m),
        (right, across_m, along_m),
        (-ahead, -along_m, across_m),
        (-right, -across_m, along_m),
    ):
        end_m = places_m + PASS_M * direction
        is_inside = ((end_m > ways.room_lower_m[LEVEL]) & (end_m < ways.room_upper_m[LEVEL])).all(axis=1)
        is_free.append(is_inside & ~(is_other & _is_on_way(forward_m, aside_m, PASS_M, ways.width_m)).any(axis=1))
    return np.column_stack(is_free)


def _turn(direction: Array) -> Array:
    """Turn directions (…, 2), north and east, to the right by a quarter turn."""
    return np.stack([-direction[..., 1], direction[..., 0]], axis=-1)


def _project(offsets_m: Array, ahead: Array) -> tuple[Array, Array]:
    """Project offsets (M, N, 2) on directions (M, 2) and to the right of them: (M, N), (M, N)."""
    along_m = (offsets_m * ahead[:, None]).sum(axis=2)
    across_m = (offsets_m * _turn(ahead)[:, None]).sum(axis=2)
    return along_m, across_m


def _is_on_way(forward_m: Array, aside_m: Array, length_m: Array | float, width_m: float) -> Flags:
    """Return which offsets are on a way of this length and half width; one that is abeam is not."""
    return np.asarray((forward_m > ROUNDING_M) & (forward_m < length_m) & (np.abs(aside_m) < width_m))


def _find_step_m(move: Move, ahead: Array) -> Array:
    """Find the way (2,) of a move."""
    if move is Move.WAIT:
        return np.zeros(2)
    direction = ahead
    for _ in range(move.value):
        direction = _turn(direction)
    return PASS_M * direction
