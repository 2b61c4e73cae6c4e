"""Priority inheritance on grids, flown hop by hop: what it states, from random and from all situations."""

import itertools

import numpy as np
import pytest

from uavctl.arrays import Array
from uavctl.fleet.priority import NEARER_M, STUCK_S, Grid, Progress, choose_places, follow_progress, make_grid

Node = tuple[int, int]
PITCH_M, DT_S = 1.0, 0.05


def make_places(shape: Node) -> Grid:
    nodes = np.array(list(itertools.product(range(shape[0]), range(shape[1]))), dtype=float)
    return Grid(nodes, np.abs(nodes[:, None] - nodes).sum(axis=2) == 1.0, PITCH_M)


def fly_rounds(grid: Grid, starts: list[int], goals: list[int], most: int) -> list[list[int]]:
    """Fly hop by hop until all are at their goals at once, and return where they were."""
    count = len(starts)
    waits, here, flown = np.zeros(count), list(starts), [list(starts)]
    for _ in range(most):
        if here == goals:
            break
        chosen_m = choose_places(grid.places_m[here], grid.places_m[goals], waits, np.ones(count, dtype=bool), grid)
        here = [int(np.linalg.norm(grid.places_m - place_m, axis=1).argmin()) for place_m in chosen_m]
        waits = np.where(np.array(here) == np.array(goals), 0.0, waits + 1.0)
        flown.append(here)
    return flown


def check_hops(grid: Grid, flown: list[list[int]]) -> None:
    for before, after in itertools.pairwise(flown):
        assert len(set(after)) == len(after)
        for i, (old, new) in enumerate(zip(before, after, strict=True)):
            assert old == new or grid.are_neighbours[old, new]
            # Whoever follows into a place does not get back to itself: no ring
            ring, last = {i}, new
            while last in before and after[before.index(last)] != last:
                follower = before.index(last)
                assert follower != i
                if follower in ring:
                    break
                ring.add(follower)
                last = after[follower]


@pytest.mark.parametrize("shape", [(2, 2), (2, 3), pytest.param((3, 3), marks=pytest.mark.slow)])
def test_two_vehicles_arrive_from_everywhere(shape: Node) -> None:
    grid = make_places(shape)
    pairs = list(itertools.permutations(range(len(grid.places_m)), 2))
    for starts, goals in itertools.product(pairs, pairs):
        flown = fly_rounds(grid, list(starts), list(goals), 4 * sum(shape))
        assert flown[-1] == list(goals), (starts, goals)
        check_hops(grid, flown)


@pytest.mark.parametrize(("shape", "count"), [((2, 3), 5), ((3, 3), 6), ((4, 4), 10), ((5, 5), 12)])
def test_many_vehicles_arrive(shape: Node, count: int) -> None:
    grid, rng = make_places(shape), np.random.default_rng(7)
    for _ in range(20):
        starts, goals = (rng.permutation(len(grid.places_m))[:count].tolist() for _ in range(2))
        flown = fly_rounds(grid, starts, goals, 20 * count)
        check_hops(grid, flown)
        arrived = np.array(flown) == goals
        assert arrived.any(axis=0).all()  # each was there once, and so has the last priority after that


@pytest.mark.parametrize(("shape", "count"), [((2, 2), 3), ((3, 3), 8), ((4, 4), 15)])
def test_the_first_one_advances_with_one_free_place(shape: Node, count: int) -> None:
    grid, rng = make_places(shape), np.random.default_rng(8)
    for _ in range(30):
        starts, goals = (rng.permutation(len(grid.places_m))[:count].tolist() for _ in range(2))
        if starts[0] == goals[0]:
            continue
        waits = np.append(1.0, np.zeros(count - 1))
        chosen_m = choose_places(grid.places_m[starts], grid.places_m[goals], waits, np.ones(count, dtype=bool), grid)

        def count_hops(place_m: Array, goal_m: Array = grid.places_m[goals[0]]) -> float:
            return float(np.abs(place_m - goal_m).sum())

        assert count_hops(chosen_m[0]) == count_hops(grid.places_m[starts[0]]) - 1.0


def test_an_obstacle_is_flown_around() -> None:
    grid = make_places((3, 3))
    places_m = np.array([[0.0, 1.0], [1.0, 1.0]])
    goals_m, is_movable = np.array([[2.0, 1.0], [1.0, 1.0]]), np.array([True, False])
    seen = []
    for _ in range(4):
        places_m[0] = choose_places(places_m, goals_m, np.zeros(2), is_movable, grid)[0]
        seen.append(tuple(places_m[0]))
    assert seen[-1] == (2.0, 1.0)
    assert (1.0, 1.0) not in seen


def test_a_vehicle_at_a_goal_beside_the_grid_leaves_for_one_that_needs_the_place() -> None:
    grid = make_places((3, 3))
    positions_m = np.array([[0.0, 1.0], [1.3, 1.3]])
    goals_m = np.array([[2.0, 1.0], [1.3, 1.3]])
    chosen_m = choose_places(positions_m, goals_m, np.array([5.0, 0.0]), np.ones(2, dtype=bool), grid)
    np.testing.assert_array_equal(chosen_m[0], [1.0, 1.0])
    assert np.abs(chosen_m[1] - chosen_m[0]).max() >= PITCH_M


def test_a_face_to_face_pair_parts_to_the_right_of_the_one_that_leaves() -> None:
    grid = make_places((5, 3))
    positions_m, goals_m = np.array([[1.0, 1.0], [2.0, 1.0]]), np.array([[4.0, 1.0], [0.0, 1.0]])
    chosen_m = choose_places(positions_m, goals_m, np.array([1.0, 0.0]), np.ones(2, dtype=bool), grid)
    # It faces south: its right is west
    np.testing.assert_array_equal(chosen_m, [[2.0, 1.0], [2.0, 0.0]])


def test_the_grid_fills_the_room_with_places_a_pitch_apart() -> None:
    grid = make_grid(np.array([-3.0, -2.0, -3.0]), np.array([3.0, 2.0, 0.0]), 1.2)
    lines_m = [np.unique(grid.places_m[:, axis]) for axis in (0, 1)]
    assert [len(lines) for lines in lines_m] == [5, 3]
    for lines, half_m in zip(lines_m, (2.5, 1.5), strict=True):
        assert (np.diff(lines) >= 1.2).all()
        assert lines[0] == -half_m
        assert lines[-1] == half_m


def test_a_large_room_has_few_places_and_its_vehicles_arrive() -> None:
    grid, rng = make_grid(np.full(3, -300.0), np.full(3, 300.0), 1.2), np.random.default_rng(9)
    assert len(grid.places_m) <= 150  # of 250,000 that fit: the choice is made in each cycle
    starts, goals = (rng.permutation(len(grid.places_m))[:6].tolist() for _ in range(2))
    flown = fly_rounds(grid, starts, goals, 60)
    assert flown[-1] == goals
    check_hops(grid, flown)


def test_a_room_for_one_place_has_one() -> None:
    assert make_grid(np.full(3, -0.6), np.full(3, 0.6), 1.2).places_m.tolist() == [[0.0, 0.0]]


def test_a_vehicle_at_its_goal_beside_a_place_leaves_for_one_that_waits_there() -> None:
    # The goal of the second one is near to the place (1, 0) of the first one, and on its way to the place (0, 0)
    grid = make_places((2, 2))
    positions_m = np.array([[1.2, 0.0], [0.6, 0.4]])
    goals_m = np.array([[0.0, 0.0], [0.9, 0.4]])
    chosen_m = choose_places(positions_m, goals_m, np.array([9.0, 1.0]), np.ones(2, dtype=bool), grid)
    assert chosen_m[0].tolist() == [0.0, 0.0]
    for place_m in ([0.0, 0.0], [1.0, 0.0]):
        assert np.abs(chosen_m[1] - place_m).max() >= PITCH_M
    # One that is behind stays
    behind_m = np.array([[0.7, 0.0], [1.1, 0.1]])
    chosen_m = choose_places(behind_m, np.array([[0.0, 0.0], [1.1, 0.1]]), np.array([9.0, 1.0]), np.ones(2, bool), grid)
    assert chosen_m.tolist() == [[0.0, 0.0], [1.1, 0.1]]


def follow(
    distances_m: list[float], goal_m: Array, known: tuple[Progress, ...] = (), first: int = 0, is_movable: bool = True
) -> Progress:
    for step, distance_m in enumerate(distances_m, first):
        known = follow_progress(
            known, goal_m + np.array([distance_m, 0.0]), goal_m, np.array([is_movable]), step, DT_S, 0.15
        )
    return known[0]


def test_a_vehicle_that_comes_no_nearer_is_stuck_until_it_arrives() -> None:
    goal_m, steps = np.array([[1.0, 2.0]]), round(STUCK_S / DT_S)
    assert not follow([2.0] * (steps + 1), goal_m).is_stuck
    stuck = follow([2.0] * (steps + 2), goal_m)
    assert stuck.is_stuck
    assert follow([1.0], goal_m, (stuck,), steps + 2).is_stuck
    assert not follow([0.1], goal_m, (stuck,), steps + 2).is_stuck
    assert not follow([2.0], goal_m + 1.0, (stuck,), steps + 2).is_stuck  # to another goal
    assert not follow([2.0] * (steps + 2), goal_m, is_movable=False).is_stuck
    approach = 2.0 - 1.5 * NEARER_M * np.arange(0.0, 10.0)
    slow = [float(d) for d in np.repeat(approach, steps - 1)]
    assert not follow(slow, goal_m).is_stuck
