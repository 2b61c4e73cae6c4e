"""Right of way: a rule that ends deadlocks without messages. Pass on the right, then by number.

1. Where the way to the goal is free, a vehicle goes ahead.
2. Where another vehicle blocks it, the vehicle passes on the right. Two vehicles face to face then pass each other.
3. Where the right is blocked as well, the vehicle with the smaller number waits. The other one gives way: to the left,
   else back.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np

from uavctl.arrays import Array, Flags
from uavctl.fleet.boxes import DOWNWASH


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
ARRIVED_M = 0.15  # a vehicle that is this near to its goal rests
LEVEL = slice(0, 2)  # north and east


@dataclass(frozen=True, eq=False)
class Ways:
    """Room and width of the ways of the vehicles."""

    distance_m: float  # horizontal distance of the pairs
    margin_m: float  # room around a plan
    room_lower_m: Array  # (3,)
    room_upper_m: Array  # (3,)

    @property
    def width_m(self) -> float:
        """Sideways distance within which another vehicle blocks the way."""
        return self.distance_m + 2.0 * self.margin_m


def choose_guides(positions_m: Array, goals_m: Array, ways: Ways) -> Array:
    """Choose the place that each vehicle flies to next (N, 3): its goal, or a place beside the way to it.

    Args:
        positions_m: (N, 3).
        goals_m: (N, 3).
    """
    guides_m = goals_m.copy()
    way_m = (goals_m - positions_m)[:, LEVEL]
    length_m = np.linalg.norm(way_m, axis=1)
    asked: dict[int, int] = {}  # vehicle that waits for a vehicle at its goal
    for i in np.flatnonzero(length_m > ARRIVED_M).tolist():
        move, ahead, blocker = _choose_own_move(i, positions_m, way_m, length_m, ways)
        if move is Move.WAIT and length_m[blocker] < PASS_M:
            asked.setdefault(blocker, i)
        if blocker >= 0:
            guides_m[i, LEVEL] = positions_m[i, LEVEL] + _find_step_m(move, ahead)
    for i, waiting in asked.items():
        offset_m = (positions_m[waiting] - positions_m[i])[LEVEL]
        ahead = offset_m / np.linalg.norm(offset_m)
        is_free = _find_free(i, positions_m, ahead, ways) | {Move.AHEAD: False}
        guides_m[i, LEVEL] = positions_m[i, LEVEL] + _find_step_m(choose_move(is_free, False), ahead)
    return guides_m


def _choose_own_move(i: int, positions_m: Array, way_m: Array, length_m: Array, ways: Ways) -> tuple[Move, Array, int]:
    """Choose the move of a vehicle on its way; also return its direction (2,) and the vehicle ahead, -1 for none."""
    ahead = way_m[i] / length_m[i]
    offsets_m = _find_offsets(i, positions_m, ways)
    look_m = min(LOOK_AHEAD_M, float(length_m[i]) + ways.width_m)
    is_blocking = _find_blocking(offsets_m, ahead, look_m, ways.width_m)
    if not is_blocking.any():
        return Move.AHEAD, ahead, -1
    blocker = int(np.where(is_blocking, np.linalg.norm(offsets_m, axis=1), np.inf).argmin())
    is_free = _find_free(i, positions_m, ahead, ways) | {Move.AHEAD: False}
    return choose_move(is_free, i < blocker and bool(length_m[blocker] > ARRIVED_M)), ahead, blocker


def _find_free(i: int, positions_m: Array, ahead: Array, ways: Ways) -> dict[Move, bool]:
    """Find the directions in which a vehicle may move."""
    offsets_m, place_m = _find_offsets(i, positions_m, ways), positions_m[i, LEVEL]
    directions = {move: _turn(ahead, move.value) for move in Move if move is not Move.WAIT}
    return {
        move: _is_inside(place_m + PASS_M * direction, ways)
        and not _find_blocking(offsets_m, direction, PASS_M, ways.width_m).any()
        for move, direction in directions.items()
    }


def _find_offsets(i: int, positions_m: Array, ways: Ways) -> Array:
    """Find the horizontal offsets (N, 2) of all vehicles; infinite for itself and those far above or below."""
    offsets_m = positions_m - positions_m[i]
    is_other = np.abs(offsets_m[:, 2]) < DOWNWASH * ways.distance_m
    is_other[i] = False
    return np.where(is_other[:, None], offsets_m[:, LEVEL], np.inf)


def _find_step_m(move: Move, ahead: Array) -> Array:
    """Find the way (2,) of a move."""
    return np.zeros(2) if move is Move.WAIT else PASS_M * _turn(ahead, move.value)


def _turn(direction: Array, quarters: int) -> Array:
    """Turn a direction (2,), north and east, to the right by quarter turns."""
    for _ in range(quarters):
        direction = np.array([-direction[1], direction[0]])
    return direction


def _find_blocking(offsets_m: Array, direction: Array, length_m: float, width_m: float) -> Flags:
    """Find which offsets (n, 2) are on a way of this direction (2,), length and half width."""
    near_m = np.where(np.isfinite(offsets_m), offsets_m, 0.0)  # a vehicle itself is not on its way
    along_m, across_m = near_m @ direction, near_m @ _turn(direction, 1)
    return np.asarray((along_m > 0.0) & (along_m < length_m) & (np.abs(across_m) < width_m))


def _is_inside(place_m: Array, ways: Ways) -> bool:
    """Return whether a place (2,) is inside of the room."""
    return bool((place_m > ways.room_lower_m[LEVEL]).all() and (place_m < ways.room_upper_m[LEVEL]).all())
