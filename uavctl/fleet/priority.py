"""Priority inheritance with backtracking: the next place of each vehicle, so that the first one always comes nearer.

1. Places lie on a grid. Two vehicles at different ones are apart with their margins. The goal of a vehicle is one more
   place, of that vehicle alone.
2. The vehicle that has come no nearer to its goal for longest chooses first: the next place on a shortest way.
3. A vehicle that stands there, or ahead near the same place, inherits the priority. It chooses next, and leaves:
   ahead, else to the right, to the left or back. If it cannot leave, the first one takes its next best place
   (backtracking).
4. No vehicle takes the place of one that waits for it. Vehicles in a ring could all move at once, but their cells
   cannot.

On a grid of two or more rows and columns with a free place, the first one advances: the search of 3 finds each free
place that a way without the first one's place leads to, and one place does not part such a grid.

Source: K. Okumura et al., Priority inheritance with backtracking for iterative multi-agent path finding (Artificial
Intelligence 310, 2022), without rings, and with goals off the grid.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.sparse.csgraph import shortest_path

from uavctl.arrays import Array, Flags
from uavctl.fleet.boxes import ROUNDING_M

WALL_M = 0.5  # from the walls to the places: plans keep their margins from walls, and get no nearer
NEARER_M = 0.1  # less is noise
MAX_LINES = 12  # of a grid, north or east: with more the choice takes longer than a cycle of the coordinator
STUCK_S = 6.0  # twice the time in which two vehicles pass each other
BLOCKED_M2 = 1e4  # cost of a place that an obstacle blocks: more than any way in a room, squared


@dataclass(frozen=True)
class Progress:
    """Progress of a vehicle to its goal."""

    goal_m: tuple[float, float]  # north and east
    nearest_m: float  # least distance so far
    step: int  # when it came nearer, or was there
    is_stuck: bool = False  # whether it came no nearer for `STUCK_S`, and has not arrived since


def follow_progress(
    known: tuple[Progress, ...],
    positions_m: Array,
    goals_m: Array,
    is_movable: Flags,
    step: int,
    dt_s: float,
    arrived_m: float,
) -> tuple[Progress, ...]:
    """Follow the progress of each vehicle to its goal.

    Args:
        known: Progress so far; empty at the start.
        positions_m: North and east (N, 2).
        goals_m: North and east (N, 2).
        is_movable: Whether a vehicle flies to its goal (N,): one on the ground is not stuck.
        step: Step now.
        dt_s: Δt.
        arrived_m: Distance from a goal within which a vehicle is there.
    """
    followed = []
    for i, (position_m, (north_m, east_m)) in enumerate(zip(positions_m, goals_m.tolist(), strict=True)):
        distance_m = float(np.hypot(north_m - position_m[0], east_m - position_m[1]))
        before = known[i] if known and known[i].goal_m == (north_m, east_m) else None
        if before is None or distance_m < arrived_m or not is_movable[i]:
            followed.append(Progress((north_m, east_m), distance_m, step))
        elif distance_m < before.nearest_m - NEARER_M:
            followed.append(Progress((north_m, east_m), distance_m, step, before.is_stuck))
        else:
            is_stuck = before.is_stuck or (step - before.step) * dt_s > STUCK_S
            followed.append(Progress((north_m, east_m), before.nearest_m, before.step, is_stuck))
    return tuple(followed)


@dataclass(frozen=True, eq=False)
class Grid:
    """Places in a room."""

    places_m: Array  # (V, 2), north and east
    are_neighbours: Flags  # (V, V)
    pitch_m: float  # least distance, north or east, of two places


def make_grid(room_lower_m: Array, room_upper_m: Array, pitch_m: float) -> Grid:
    """Make the places of a room, as many as fit, up to `MAX_LINES` north and east."""
    lines_m = []
    for low_m, high_m in zip(room_lower_m[:2] + WALL_M, room_upper_m[:2] - WALL_M, strict=True):
        count = min(1 + int(max(high_m - low_m, 0.0) / pitch_m + ROUNDING_M), MAX_LINES)
        lines_m.append(np.linspace(low_m, high_m, count) if count > 1 else np.array([0.5 * (low_m + high_m)]))
    north, east = (index.ravel() for index in np.indices((len(lines_m[0]), len(lines_m[1]))))
    hops = np.abs(north[:, None] - north) + np.abs(east[:, None] - east)
    return Grid(np.column_stack([lines_m[0][north], lines_m[1][east]]), hops == 1, pitch_m)


def choose_places(positions_m: Array, goals_m: Array, waits: Array, is_movable: Flags, grid: Grid) -> Array:
    """Choose the next place of each vehicle (N, 2).

    Args:
        positions_m: North and east (N, 2).
        goals_m: North and east (N, 2).
        waits: Time for which each vehicle has come no nearer to its goal, in any unit (N,); of equal ones, the first.
        is_movable: Whether a vehicle follows what is chosen (N,); one that does not is an obstacle.
        grid: Places of the room.
    """
    count, size = len(positions_m), len(grid.places_m)
    places_m = np.vstack([grid.places_m, goals_m])
    distances_m = np.abs(places_m[:, None] - places_m).max(axis=2)
    to_obstacles_m = np.abs(places_m[:, None] - positions_m[~is_movable]).max(axis=2)
    is_blocked = (to_obstacles_m < grid.pitch_m - ROUNDING_M).any(axis=1)
    links = np.zeros((size + count, size + count), dtype=bool)
    links[:size, :size] = grid.are_neighbours
    links[:size, size:] = distances_m[:size, size:] < _find_reach_m(grid)
    links[size:, :size] = links[:size, size:].T
    links[is_blocked] = links[:, is_blocked] = False
    search = _Search(
        places_m,
        positions_m,
        at=_find_nearest_places(positions_m, places_m, is_blocked),
        hops=_count_hops(links, size),
        links=links,
        near=[frozenset(np.flatnonzero(row).tolist()) for row in distances_m < grid.pitch_m - ROUNDING_M],
        movable=np.flatnonzero(is_movable).tolist(),
    )
    for i in np.argsort(-waits, kind="stable").tolist():
        if is_movable[i] and i not in search.next:
            search.choose(i)
    return places_m[[search.next.get(i, size + i) for i in range(count)]]


def _find_reach_m(grid: Grid) -> float:
    """Find the distance, north or east, from which a vehicle flies to its goal: the longest side of the grid."""
    sides_m = np.abs(grid.places_m[:, None] - grid.places_m).max(axis=2)[grid.are_neighbours]
    return float(sides_m.max(initial=grid.pitch_m)) - ROUNDING_M


def _count_hops(links: Flags, size: int) -> Array:
    """Count the hops from each place (V + N,) to each goal (N,), over the grid alone: (N, V + N)."""
    hops = np.full((len(links) - size, len(links)), np.inf)
    between = _count_grid_hops(links[:size, :size].tobytes(), size)
    for number, row in enumerate(hops):
        ends = np.flatnonzero(links[size + number, :size])
        # h(p, g) = 1 + min over the neighbours e of g of h(p, e)
        row[:size] = 1.0 + between[:, ends].min(axis=1, initial=np.inf)
        row[size + number] = 0.0
    return hops


@lru_cache(maxsize=8)  # the grid seldom changes, and this is a third of a choice
def _count_grid_hops(links: bytes, size: int) -> Array:
    """Count the hops between the places (V, V) of a grid with links (V, V)."""
    return np.asarray(shortest_path(np.frombuffer(links, dtype=bool).reshape(size, size), unweighted=True))


def _find_nearest_places(positions_m: Array, places_m: Array, is_blocked: Flags) -> list[int]:
    """Find the place where each vehicle is: the nearest ones that are all different; of goals only its own."""
    count = len(positions_m)
    size = len(places_m) - count
    # |p - q|² to each place
    cost_m2 = ((positions_m[:, None] - places_m) ** 2).sum(axis=2)
    cost_m2[:, is_blocked] += BLOCKED_M2
    cost_m2[:, size:] += BLOCKED_M2 * (1.0 - np.eye(count))
    return [int(place) for place in linear_sum_assignment(cost_m2)[1]]


class _Search:
    """Search for the next places.

    Args:
        places_m: North and east of the grid, then of the goals (V + N, 2).
        positions_m: North and east of the vehicles (N, 2).
        at: Place where each vehicle is (N,).
        hops: Hops from each place to each goal (N, V + N).
        links: Whether a hop leads from one place to another.
        near: Places that stay empty while a vehicle is at a place.
        movable: Vehicles that follow.
    """

    def __init__(
        self,
        places_m: Array,
        positions_m: Array,
        at: list[int],
        hops: Array,
        links: Flags,
        near: list[frozenset[int]],
        movable: list[int],
    ) -> None:
        self.next: dict[int, int] = {}  # place that each vehicle has chosen
        self._places_m, self._positions_m, self._at, self._hops, self._links = places_m, positions_m, at, hops, links
        self._near, self._movable = near, movable

    def choose(self, i: int, asking: tuple[int, ...] = ()) -> bool:
        """Choose the next place of a vehicle, and those of all that stand there; false if it cannot leave its own.

        Args:
            asking: Vehicles that wait for this one.
        """
        for place in self._list_places(i):
            near = self._near[place]
            if any(taken in near for j, taken in self.next.items() if j != i):
                continue
            standing = [j for j in self._movable if j != i and (self._at[j] in near or self._is_ahead(j, i, place))]
            if any(j in asking for j in standing):
                continue
            self.next[i] = place
            if all(j in self.next or self.choose(j, (*asking, i)) for j in standing):
                return True
        self.next[i] = self._at[i]
        return False

    def _is_ahead(self, j: int, i: int, place: int) -> bool:
        """Whether a vehicle is ahead of another one near to its place: a hop was not complete, or a goal is there."""
        if place == self._at[i] or self._at[j] not in self._near[self._at[i]]:
            return False
        begin_m = self._positions_m[i]
        return float((self._positions_m[j] - begin_m) @ (self._places_m[place] - begin_m)) > 0.0

    def _list_places(self, i: int) -> list[int]:
        """List the places that a vehicle can be at next, the best one first."""
        at, hops, goal = self._at[i], self._hops[i], len(self._links) - len(self._at) + i
        ahead_m = self._places_m[goal] - self._places_m[at]
        occupied = {self._at[j] for j in self._movable if j != i}

        def rank(place: int) -> tuple[float, bool, bool, float, float]:
            way_m = self._places_m[place] - self._places_m[at]
            along_m2 = float(ahead_m @ way_m)
            right_m2 = float(ahead_m[0] * way_m[1] - ahead_m[1] * way_m[0])
            is_back = along_m2 < -abs(right_m2)
            return float(hops[place]), place in occupied, is_back, -right_m2, -along_m2

        is_open = np.isfinite(hops)
        return sorted([at, *(place for place in np.flatnonzero(self._links[at]).tolist() if is_open[place])], key=rank)
