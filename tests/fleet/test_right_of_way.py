"""Right of way on grids, exhaustively: two vehicles always arrive."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from uavctl.arrays import Array
from uavctl.fleet.boxes import ROUNDING_M
from uavctl.fleet.right_of_way import LOOK_AHEAD_M, PASS_M, Move, Ways, choose_guides, choose_move, separate_goals

Node = tuple[int, int]
TURNS: tuple[Node, ...] = ((1, 0), (0, 1), (-1, 0), (0, -1))  # north, east, south, west: quarter turns to the right


def list_ways(place: Node, goal: Node, heading: int | None) -> list[int]:
    """List the directions that lead to the goal, that of the longer way first."""
    north, east = goal[0] - place[0], goal[1] - place[1]
    ways = [(abs(north), 0 if north > 0 else 2)] * bool(north) + [(abs(east), 1 if east > 0 else 3)] * bool(east)
    return [way for _, way in sorted(ways, key=lambda entry: (-entry[0], entry[1] != heading))]


def count_rounds(shape: Node, starts: tuple[Node, ...], goals: tuple[Node, ...]) -> int | None:
    """Count the rounds until all have arrived; None if a situation comes again before."""
    places, seen = list(starts), set()
    headings: list[int | None] = [None] * len(starts)
    for rounds in itertools.count():
        if tuple(places) == goals:
            return rounds
        situation = tuple(places), tuple(headings)
        if situation in seen:
            return None
        seen.add(situation)
        for i in range(len(goals)):
            move_one(shape, places, headings, i, goals)
    return None


def move_one(shape: Node, places: list[Node], headings: list[int | None], i: int, goals: tuple[Node, ...]) -> None:
    def find(way: int) -> Node:
        return places[i][0] + TURNS[way % 4][0], places[i][1] + TURNS[way % 4][1]

    def is_free(way: int) -> bool:
        node = find(way)
        return 0 <= node[0] < shape[0] and 0 <= node[1] < shape[1] and node not in places

    ways = list_ways(places[i], goals[i], headings[i])
    if not ways:
        headings[i] = None
        return
    way = next((way for way in ways if is_free(way)), ways[0])
    blocker = places.index(find(way)) if find(way) in places else i
    free: dict[Move, bool] = {move: is_free(way + move.value) for move in Move if move is not Move.WAIT}
    move = choose_move(free, has_right_of_way=i < blocker and places[blocker] != goals[blocker])
    if move is not Move.WAIT:
        way = (way + move.value) % 4
        headings[i], places[i] = way, find(way)


# The last one has 57,600 pairs of starts and goals; (3, 4) has room for each turn, too.
@pytest.mark.parametrize(
    "shape", [(2, 2), (2, 3), (3, 2), (2, 5), (3, 3), (3, 4), pytest.param((4, 4), marks=pytest.mark.slow)]
)
def test_two_vehicles_always_arrive(shape: Node) -> None:
    nodes = list(itertools.product(range(shape[0]), range(shape[1])))
    pairs = list(itertools.permutations(nodes, 2))
    longest = 2 * sum(shape)
    for starts in pairs:
        for goals in pairs:
            rounds = count_rounds(shape, starts, goals)
            assert rounds is not None, (starts, goals)
            assert rounds <= longest, (starts, goals)


WAYS = Ways(0.5, 0.06, np.array([-3.0, -3.0, -3.0]), np.array([3.0, 3.0, 0.0]))


def test_two_face_to_face_both_pass_on_the_right() -> None:
    positions_m = np.array([[-0.6, 0.0, -1.0], [0.6, 0.0, -1.0]])
    guides_m = choose_guides(positions_m, np.array([[2.0, 0.0, -1.0], [-2.0, 0.0, -1.0]]), WAYS)
    np.testing.assert_allclose(guides_m, [[-0.6, PASS_M, -1.0], [0.6, -PASS_M, -1.0]], atol=1e-12)


def test_a_free_way_leads_to_the_goal() -> None:
    positions_m = np.array([[0.0, 0.0, -1.0], [-0.6, 0.0, -1.0], [LOOK_AHEAD_M + 0.1, 0.0, -1.0]])
    goals_m = np.array([[2.9, 0.0, -1.0], [-0.6, 0.0, -1.0], [2.0, 0.0, -1.0]])
    np.testing.assert_array_equal(choose_guides(positions_m, goals_m, WAYS)[0], goals_m[0])


def test_a_vehicle_far_above_blocks_the_way() -> None:
    positions_m = np.array([[0.0, 0.0, -1.0], [0.6, 0.0, -2.9]])
    goals_m = np.array([[2.9, 0.0, -1.0], [0.6, 0.0, -2.9]])
    np.testing.assert_array_equal(choose_guides(positions_m, goals_m, WAYS)[0, :2], [0.0, PASS_M])


def test_a_vehicle_at_its_goal_gives_way_to_one_that_cannot_pass() -> None:
    # In the corner behind it, with walls to the right, to the left and behind
    walls = Ways(0.5, 0.06, np.array([-3.0, -0.5, -3.0]), np.array([3.0, 0.5, 0.0]))
    positions_m = np.array([[-2.5, 0.0, -1.0], [-1.5, 0.0, -1.0]])
    guides_m = choose_guides(positions_m, np.array([[2.0, 0.0, -1.0], [-1.5, 0.0, -1.0]]), walls)
    np.testing.assert_allclose(guides_m, [[-2.5, 0.0, -1.0], [-1.5 + PASS_M, 0.0, -1.0]], atol=1e-12)


def test_a_vehicle_at_its_goal_gives_way_to_one_that_could_only_go_back() -> None:
    walls = Ways(0.5, 0.06, np.array([-3.0, -0.5, -3.0]), np.array([3.0, 0.5, 0.0]))
    positions_m = np.array([[-0.5, 0.0, -1.0], [0.5, 0.0, -1.0]])
    guides_m = choose_guides(positions_m, np.array([[2.0, 0.0, -1.0], [0.5, 0.0, -1.0]]), walls)
    np.testing.assert_allclose(guides_m, [[-0.5, 0.0, -1.0], [0.5 + PASS_M, 0.0, -1.0]], atol=1e-12)


WIDE_M, PITCH_M = 3.0, 1.1
SMALL_ROOM = Ways(0.5, 0.1, np.full(3, -WIDE_M), np.full(3, WIDE_M))
PLACES = st.lists(st.tuples(*[st.integers(-9, 9)] * 4), min_size=1, max_size=8)


def measure_apart_m(places_m: Array) -> Array:
    """Distances of all pairs (N, N), north or east; infinite to itself."""
    offsets_m = np.abs(places_m[:, None, :2] - places_m[None, :, :2]).max(axis=2)
    return np.asarray(offsets_m + np.diag(np.full(len(places_m), np.inf)))


@given(PLACES)
def test_of_several_with_one_goal_the_nearest_keeps_it_and_the_others_get_places_apart(
    rows: list[tuple[int, int, int, int]],
) -> None:
    table = np.array(rows) * 0.3
    flat = np.zeros((len(rows), 1))
    positions_m, goals_m = np.hstack([table[:, :2], flat]), np.hstack([table[:, 2:], flat])
    separated_m = separate_goals(goals_m, positions_m, SMALL_ROOM, PITCH_M)
    is_kept = (separated_m == goals_m).all(axis=1)
    is_apart = measure_apart_m(goals_m).min(axis=1) >= SMALL_ROOM.width_m - ROUNDING_M
    assert is_kept[np.linalg.norm(goals_m - positions_m, axis=1).argmin()]
    assert (np.abs(separated_m) <= WIDE_M).all()
    stays = (separated_m == positions_m).all(axis=1)
    moved = ~stays & ~is_kept
    assert (measure_apart_m(separated_m)[moved][:, is_kept | moved] >= SMALL_ROOM.width_m - ROUNDING_M).all()
    if is_apart.all():
        assert is_kept.all()
