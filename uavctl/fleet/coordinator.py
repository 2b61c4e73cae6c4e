"""Coordinator of the cells: pure transitions of its state by reports and cycles.

A cycle issues at most one new cell to each vehicle, and sends the newest one again until the vehicle has decided about
it. Cells and reports may be lost, late, repeated or out of order.

1. The claim of a vehicle is the hull of the cell that it reported in use and of all cells issued since. So the cell in
   use is always inside of the claim.
2. Planes divide the claims of each pair in each stage, `boxes.divide_pairs`. They limit the new cells of both.
3. A new cell is the plan in progress with its margins, extended towards the goal as far as the vehicle can fly, and
   cut by the planes. Planes are outside of the claim, so they never cut the plan.
4. Claims of all vehicles stay apart: a new cell is apart from the new cells and from the claims of all others.
5. A vehicle that is free is an obstacle that grows. Cells avoid it. A vehicle whose plan may meet it is told to land.
6. A vehicle without a cell, at rest or in its own climb or landing, claims the path that it reports if that is apart
   from all other claims; else it is an obstacle there. At rest by plans it claims its mean path, and gets a cell
   around that.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from uavctl.arrays import Array, Flags
from uavctl.fleet.boxes import LEVEL, ROUNDING_M, Bounds, Boxes, divide_pairs, find_gaps
from uavctl.fleet.cell import NO_CELL, MovingCell, PlannedPath, Report
from uavctl.fleet.obstacles import find_reach
from uavctl.fleet.priority import Progress, choose_places, follow_progress, make_grid
from uavctl.fleet.right_of_way import ARRIVED_M, Ways, choose_guides, separate_goals
from uavctl.records import Conduct

START_NUMBER = 0  # number of the cell in which a vehicle begins
LANDING_WAY_M = 1.2  # way to the side on which a vehicle lands beside an obstacle's way
LANDING_WALL_M = 0.5  # from the walls to a place to land at: plans keep their margins from walls, and get no nearer
GRID_M = 1e-4  # sides of cells are multiples of it: short as text, and far below all margins
GRID_TOLERANCE = 1e-6  # part of it that is rounding
# A vehicle that refuses cells needs more room around its plan: each refusal in a row gives an eighth more, up to twice
GROWTH, MAX_REFUSALS = 0.125, 8.0
MIN_SPEED_MPS, MIN_WAY_M = 0.1, 0.01  # an obstacle that is slower stands; a vehicle that is nearer has no side


@dataclass(frozen=True, eq=False)
class CellParameters:
    """Constants of the cells."""

    distance_m: float  # that all pairs keep, north or east
    room_lower_m: Array  # (3,), local NED
    room_upper_m: Array  # (3,)
    accel_mps2: Array  # largest acceleration of each axis (3,)
    speed_mps: Array  # largest speed of each axis (3,)
    dt_s: float  # a step
    stages: int  # S, boxes of a cell: one more than the steps of a plan
    # Room around a plan for its changes while a cell is on its way. With less, vehicles refuse more cells; with more,
    # two vehicles pass at a larger distance
    margin_m: float = 0.1
    shift_stages: int = (
        6  # change of the age of a position until a cell is decided about: three lost positions of 20 Hz
    )
    # Largest margin that a cell leaves room for at first. Where a cell is wide, rows that do not bind take margins of
    # up to 4.75 σ, so without it cells widen from one to the next, to 2 m. A plan that needs more refuses the cell
    max_margin_m: float = 0.2
    reach_m: float = 1.2  # longest extension beyond the plan: about the way of a plan between two cells
    silence_s: float = 1.0  # time without a report after which a vehicle counts as an obstacle


class WaitReason(StrEnum):
    """Reason why a vehicle was issued no new cell in a cycle."""

    NONE = ""  # it was issued one
    SILENT = "silent"  # its newest report is too old
    NO_PLANS = "no plans"  # it does not fly by plans: on the ground, in its own climb or landing, or free
    BLOCKED = "blocked"  # its path is too near to another vehicle's claim
    UNDIVIDED = "undivided"  # no axis divides its claim from that of another vehicle in all stages
    NO_ROOM = "no room"  # the planes leave nothing
    UNDECIDED = "undecided"  # it has not decided about its newest cell


@dataclass(frozen=True, eq=False)
class CoordinatorState:
    """State of the coordinator; boxes begin at `step`."""

    step: int
    used: Boxes  # cells reported in use
    used_numbers: tuple[int, ...]
    pending: Boxes  # hull of all cells issued since
    newest: tuple[MovingCell, ...]  # newest cell of each vehicle
    previous: tuple[MovingCell, ...]  # the one before; a cell to land in is issued before it is decided
    reports: tuple[Report, ...]  # newest report of each vehicle
    goals_m: Array  # place that each vehicle is to reach (N, 3)
    exits: tuple[int, ...]  # times that each vehicle has left its cell
    waits: tuple[WaitReason, ...] = ()  # of the last cycle, one a vehicle
    progress: tuple[Progress, ...] = ()  # of each vehicle to its goal

    @property
    def claims(self) -> Boxes:
        """Hull of all cells that each vehicle may use."""
        return self.used.cover(self.pending)

    @property
    def is_decided(self) -> Flags:
        """Whether a vehicle has decided about its newest cell, or its exit has made that cell void (N,)."""
        rows = zip(self.reports, self.newest, self.exits, strict=True)
        return np.array(
            [report.decided >= cell.number or exits > cell.exits for report, cell, exits in rows], dtype=bool
        )


def begin(step: int, positions_m: Array, goals_m: Array, parameters: CellParameters) -> CoordinatorState:
    """Begin with vehicles at rest, each in a cell around its position; both sides know these cells.

    Raises:
        ValueError: Two of these cells are nearer than the distance.
    """
    stages, half_m = parameters.stages, parameters.margin_m
    shape = (len(positions_m), stages, 3)
    lower_m = np.broadcast_to((positions_m - half_m)[:, None], shape)
    upper_m = np.broadcast_to((positions_m + half_m)[:, None], shape)
    used = Boxes(lower_m, upper_m)
    gaps = find_gaps(used, used, parameters.distance_m)[:, :, 0] + 2.0 * np.eye(len(positions_m))
    if gaps.min(initial=1.0) < 1.0:
        first, second = np.unravel_index(int(gaps.argmin()), gaps.shape)
        raise ValueError(
            f"vehicles {first} and {second} begin too near to each other for cells {parameters.distance_m:g} m apart:"
            f" place them {parameters.distance_m + 2.0 * half_m:g} m apart, north or east"
        )
    cells = tuple(MovingCell(START_NUMBER, step, lower_m[i], upper_m[i], place) for i, place in enumerate(positions_m))
    rest = [PlannedPath(step, np.tile(place, (stages, 1)), np.zeros((stages, 3))) for place in positions_m]
    return CoordinatorState(
        step=step,
        used=used,
        used_numbers=(START_NUMBER,) * len(positions_m),
        pending=Boxes.make_empty(len(positions_m), stages),
        newest=cells,
        previous=cells,
        reports=tuple(Report(plan, np.zeros(3), START_NUMBER, START_NUMBER) for plan in rest),
        goals_m=goals_m,
        exits=(0,) * len(positions_m),
    )


def begin_without_cells(step: int, reports: Sequence[Report], parameters: CellParameters) -> CoordinatorState:
    """Begin with a report of each vehicle, none of which has a cell yet.

    Raises:
        ValueError: A vehicle uses a cell of another coordinator, whose sides no report has.
    """
    for number, report in enumerate(reports):
        if report.in_use != NO_CELL:
            raise _make_foreign_cell_error(number)
    count, stages = len(reports), parameters.stages
    positions_m = [report.plan.mean_m[0] for report in reports]
    cells = [
        MovingCell(
            report.decided,
            step,
            np.tile(place_m, (stages, 1)),
            np.tile(place_m, (stages, 1)),
            place_m,
            exits=report.exits,
        )
        for report, place_m in zip(reports, positions_m, strict=True)
    ]
    state = CoordinatorState(
        step=step,
        used=Boxes.make_empty(count, stages),
        used_numbers=(NO_CELL,) * count,
        pending=Boxes.make_empty(count, stages),
        newest=tuple(cells),
        previous=tuple(cells),
        reports=tuple(reports),
        goals_m=np.array(positions_m),
        exits=tuple(report.exits for report in reports),
    )
    return replace(state, goals_m=_take_goals(state))


def _make_foreign_cell_error(number: int) -> ValueError:
    return ValueError(f"vehicle {number} uses a cell of another coordinator: land it, then start the fleet again")


def find_near_starts(reports: Sequence[Report], parameters: CellParameters) -> list[tuple[int, int, float]]:
    """Find the pairs whose places with their margins are nearer than the distance, and the distance to place them at.

    The distance holds north or east: vehicles that start do not fly above each other.
    """
    near = []
    for second in range(len(reports)):
        for first in range(second):
            plans = [reports[i].plan for i in (first, second)]
            half_m = plans[0].margin_m[0] + plans[1].margin_m[0] + 2.0 * parameters.margin_m
            needed_m = parameters.distance_m + half_m[:2]
            offset_m = np.abs(plans[1].mean_m[0] - plans[0].mean_m[0])[:2]
            if (offset_m < needed_m - ROUNDING_M).all():
                near.append((first, second, float(needed_m.max())))
    return near


def advance(state: CoordinatorState, step: int) -> CoordinatorState:
    """Advance the boxes to a later step."""
    steps = step - state.step
    return replace(state, step=step, used=state.used.advance(steps), pending=state.pending.advance(steps))


def receive(state: CoordinatorState, reports: Mapping[int, Report]) -> CoordinatorState:
    """Take up reports by the number of the vehicle; older ones than the newest known change nothing.

    Raises:
        ValueError: A vehicle uses a cell that was not issued to it: its sides are unknown.
    """
    newest, numbers, in_use, exits = list(state.reports), list(state.used_numbers), list(state.newest), [*state.exits]
    is_taken, is_decided, has_left = (np.zeros(len(newest), dtype=bool) for _ in range(3))
    for i, report in reports.items():
        if report.order < newest[i].order:
            continue
        newest[i] = report
        if report.exits > exits[i]:
            has_left[i], exits[i], numbers[i] = True, report.exits, NO_CELL
        for cell in (state.previous[i], state.newest[i]):
            if report.in_use == cell.number != numbers[i] and report.exits == cell.exits:
                is_taken[i], in_use[i], numbers[i] = True, cell, cell.number
        if report.in_use not in (NO_CELL, numbers[i], state.previous[i].number, state.newest[i].number):
            raise _make_foreign_cell_error(i)
        is_decided[i] = report.decided >= state.newest[i].number and report.in_use == numbers[i]
    empty = Boxes.make_empty(*state.used.lower_m.shape[:2])
    pending = empty.take(is_decided | has_left, state.pending)
    used = _gather_boxes(in_use, state.step).take(is_taken, empty.take(has_left, state.used))
    state = replace(
        state, used=used, pending=pending, used_numbers=tuple(numbers), reports=tuple(newest), exits=tuple(exits)
    )
    return replace(state, goals_m=_take_goals(state))


def _take_goals(state: CoordinatorState) -> Array:
    """Return the goals of the newest reports (N, 3); as before where one names none."""
    rows = [
        known_m if report.goal_m is None else report.goal_m
        for report, known_m in zip(state.reports, state.goals_m, strict=True)
    ]
    return np.array(rows)


def issue(state: CoordinatorState, parameters: CellParameters) -> CoordinatorState:
    """Issue new cells where the newest ones are decided; `state.newest` is what to send."""
    step = state.step
    is_silent = np.array(
        [(step - report.plan.step) * parameters.dt_s > parameters.silence_s for report in state.reports], dtype=bool
    )
    is_free = np.array([report.conduct is Conduct.FREE for report in state.reports], dtype=bool)
    positions_m, room_m, plans = _gather_plans(state, parameters)
    claims, is_blocked = _gather_claims(state, plans, is_free, is_silent, parameters)
    bounds = divide_pairs(claims, plans, parameters.distance_m)
    is_growing = is_free | is_silent
    away, must_land = _avoid_obstacles(state, is_growing, is_blocked, plans, parameters)
    takes_cells = np.array([report.conduct in (Conduct.CELL, Conduct.REST) for report in state.reports], dtype=bool)
    is_led = takes_cells & ~is_silent & ~must_land
    guides_m, progress = lead(state.progress, positions_m, state.goals_m, is_led, step, parameters)
    has_landing_cell = np.array([cell.land for cell in state.newest], dtype=bool)
    # The place stays once it is issued: one beside the newest position would lead the vehicle along the floor for good
    landing_places_m = np.where(
        has_landing_cell[:, None],
        [cell.goal_m for cell in state.newest],
        _find_landing_places(state, is_growing, positions_m, parameters),
    )
    guides_m = np.where(must_land[:, None], landing_places_m, guides_m)
    wanted = _extend(plans, guides_m, room_m, parameters)
    lower_m = np.maximum(wanted.lower_m, bounds.lower_m)
    upper_m = np.minimum(wanted.upper_m, bounds.upper_m)
    # Away from obstacles, but never so far that the plan in progress is cut
    lower_m = np.maximum(lower_m, np.minimum(away.lower_m, plans.lower_m))
    upper_m = np.minimum(upper_m, np.maximum(away.upper_m, plans.upper_m))
    cells = Boxes(
        np.ceil(lower_m / GRID_M - GRID_TOLERANCE) * GRID_M, np.floor(upper_m / GRID_M + GRID_TOLERANCE) * GRID_M
    )
    # A vehicle that must land has its first such cell at once
    reasons = {
        WaitReason.SILENT: is_silent,
        WaitReason.NO_PLANS: ~takes_cells,
        WaitReason.BLOCKED: is_blocked,
        WaitReason.UNDIVIDED: ~bounds.is_divided,
        WaitReason.NO_ROOM: cells.is_empty,
        WaitReason.UNDECIDED: ~(state.is_decided | (must_land & ~has_landing_cell)),
    }
    waits = tuple(
        next((wait for wait, flags in reasons.items() if flags[i]), WaitReason.NONE) for i in range(len(is_silent))
    )
    is_new = np.array([wait is WaitReason.NONE for wait in waits], dtype=bool)
    newest = tuple(
        MovingCell(
            cell.number + 1, step, cells.lower_m[i], cells.upper_m[i], guides_m[i], bool(must_land[i]), state.exits[i]
        )
        if is_new[i]
        else cell
        for i, cell in enumerate(state.newest)
    )
    previous = tuple(state.newest[i] if is_new[i] else cell for i, cell in enumerate(state.previous))
    pending = state.pending.cover(cells).take(is_new, state.pending)
    return replace(state, pending=pending, newest=newest, previous=previous, waits=waits, progress=progress)


def lead(
    known: tuple[Progress, ...],
    positions_m: Array,
    goals_m: Array,
    is_led: Flags,
    step: int,
    parameters: CellParameters,
) -> tuple[Array, tuple[Progress, ...]]:
    """Find the place that each vehicle flies to next (N, 3), and its progress: by priority while one is stuck.

    Args:
        known: Progress so far; empty at the start.
        positions_m: (N, 3).
        goals_m: (N, 3).
        is_led: Whether a vehicle follows (N,).
        step: Step now.
        parameters: Constants of the cells.
    """
    room = parameters.room_lower_m, parameters.room_upper_m
    ways = Ways(parameters.distance_m, parameters.margin_m, *room)
    pitch_m = parameters.distance_m + 2.0 * (parameters.margin_m + parameters.max_margin_m)
    goals_m = separate_goals(goals_m, positions_m, ways, pitch_m)
    level_m, level_goals_m = positions_m[:, :2], goals_m[:, :2]
    progress = follow_progress(known, level_m, level_goals_m, is_led, step, parameters.dt_s, ARRIVED_M)
    if not any(one.is_stuck for one in progress):
        return choose_guides(positions_m, goals_m, ways), progress
    waits = step - np.array([one.step for one in progress])
    guides_m = goals_m.copy()
    guides_m[:, :2] = choose_places(level_m, level_goals_m, waits, is_led, make_grid(*room, pitch_m))
    return guides_m, progress


def _gather_claims(
    state: CoordinatorState, plans: Boxes, is_free: Flags, is_silent: Flags, parameters: CellParameters
) -> tuple[Boxes, Flags]:
    """Gather the claims, and find the vehicles whose path is too near to another one's claim (N,).

    A cell in use stays a claim until its vehicle reports the exit, also if it is free. A vehicle without a cell claims
    its path, if nobody is there.
    """
    claims = state.claims
    is_path = state.used.is_empty & ~is_free & ~is_silent
    is_blocked = np.zeros(len(is_free), dtype=bool)
    for i in np.flatnonzero(is_path):
        only = np.arange(len(is_free)) == i
        path = plans.take(only, Boxes.make_empty(*plans.lower_m.shape[:2]))
        near = find_gaps(Boxes(path.lower_m[only], path.upper_m[only]), claims, parameters.distance_m)[0]
        is_blocked[i] = bool((near[~only] < 1.0 - ROUNDING_M).any())
        if not is_blocked[i]:
            claims = claims.cover(path)
    return claims, is_blocked


def find_nearest_claims(state: CoordinatorState, parameters: CellParameters) -> list[tuple[int, float]]:
    """Find for each vehicle the one with the nearest claim, and the least gap in all stages over its distance.

    A vehicle alone, or without a claim, has itself and infinity.
    """
    gaps = find_gaps(state.claims, state.claims, parameters.distance_m).min(axis=2)
    np.fill_diagonal(gaps, np.inf)
    return [(i if np.isinf(row.min()) else int(row.argmin()), float(row.min())) for i, row in enumerate(gaps)]


def _gather_boxes(cells: Sequence[MovingCell], step: int) -> Boxes:
    """Gather the boxes of cells from a step on."""
    stages = np.arange(len(cells[0].lower_m))
    index = [np.minimum(stages + step - cell.step, len(stages) - 1) for cell in cells]
    return Boxes(
        np.array([cell.lower_m[i] for cell, i in zip(cells, index, strict=True)]),
        np.array([cell.upper_m[i] for cell, i in zip(cells, index, strict=True)]),
    )


def _gather_plans(state: CoordinatorState, parameters: CellParameters) -> tuple[Array, Array, Boxes]:
    """Gather the positions (N, 3), the room around each stage of a plan (N, S, 3), and the boxes of the plans.

    Box s contains the mean of stages s and s + 1, with the room around it, inside of a cell in use. The room is the
    largest margin of the stages nearby, up to a limit: it moves there as the age of the position changes.
    """
    plans = [report.plan.advance(state.step) for report in state.reports]
    mean_m, margin_m = np.array([plan.mean_m for plan in plans]), np.array([plan.margin_m for plan in plans])
    most_m = parameters.max_margin_m * (1.0 + GROWTH * _count_refusals(state))[:, None, None]
    shift = parameters.shift_stages
    padded_m = np.pad(np.minimum(margin_m, most_m), ((0, 0), (shift, shift), (0, 0)))
    room_m = sliding_window_view(padded_m, 2 * shift + 1, axis=1).max(axis=3) + parameters.margin_m
    # Two vehicles at rest may be nearer than their margins for the time without a position: they claim where they are
    is_at_rest = np.array([report.conduct is Conduct.REST for report in state.reports], dtype=bool)
    own_m = np.where(is_at_rest[:, None, None], parameters.margin_m, room_m)
    lower_m, upper_m = mean_m - own_m, mean_m + own_m
    later = np.minimum(np.arange(parameters.stages) + 1, parameters.stages - 1)
    boxes = Boxes(np.minimum(lower_m, lower_m[:, later]), np.maximum(upper_m, upper_m[:, later]))
    return mean_m[:, 0], room_m, boxes.take(state.used.is_empty, boxes.clip_to(state.used))


def _count_refusals(state: CoordinatorState) -> Array:
    """Count the cells that each vehicle has refused in a row but for the first, up to a limit (N,)."""
    rows = [report.decided - report.in_use - 1 if report.in_use != NO_CELL else 0 for report in state.reports]
    return np.clip(np.array(rows, dtype=np.float64), 0.0, MAX_REFUSALS)


def _extend(plans: Boxes, guides_m: Array, room_m: Array, parameters: CellParameters) -> Boxes:
    """Extend boxes towards places (N, 3), as far as a vehicle can depart from its plan, inside of the walls.

    A box that reaches a place has the room (N, S, 3) around it: a plan can rest there.
    """
    # s(t) = min(a t² / 2, v t, reach)
    times_s = parameters.dt_s * np.arange(1, parameters.stages + 1)[:, None]
    way_m = np.minimum(0.5 * parameters.accel_mps2 * times_s**2, parameters.speed_mps * times_s)
    way_m = np.minimum(way_m, parameters.reach_m)
    places_m = guides_m[:, None]
    lower_m = np.minimum(plans.lower_m, np.maximum(plans.lower_m - way_m, places_m - room_m))
    upper_m = np.maximum(plans.upper_m, np.minimum(plans.upper_m + way_m, places_m + room_m))
    return Boxes(
        np.minimum(plans.lower_m, np.maximum(lower_m, parameters.room_lower_m)),
        np.maximum(plans.upper_m, np.minimum(upper_m, parameters.room_upper_m)),
    )


def _avoid_obstacles(
    state: CoordinatorState, is_growing: Flags, is_blocked: Flags, plans: Boxes, parameters: CellParameters
) -> tuple[Bounds, Flags]:
    """Return the sides of the planes beside obstacles, and whether a vehicle's plan may meet one (N,)."""
    lower_m, upper_m = np.full(plans.lower_m.shape, -np.inf), np.full(plans.upper_m.shape, np.inf)
    must_land = np.zeros(len(is_growing), dtype=bool)
    for i in np.flatnonzero(is_growing | is_blocked):
        box = _find_reach_boxes(state, i, parameters) if is_growing[i] else (plans.lower_m[i], plans.upper_m[i])
        low_m, high_m = box[0] - parameters.distance_m, box[1] + parameters.distance_m
        gap = np.concatenate([(low_m - plans.upper_m)[..., LEVEL], (plans.lower_m - high_m)[..., LEVEL]], axis=2)
        choice = gap.argmax(axis=2)
        if is_growing[i]:
            must_land |= (gap.max(axis=2) < 0.0).any(axis=1) & (np.arange(len(must_land)) != i)
        vehicle, stage = np.nonzero(np.ones(choice.shape, dtype=bool))
        axis, is_below = choice.ravel() % 2, choice.ravel() < 2
        at = vehicle, stage, axis
        np.minimum.at(upper_m, at, np.where(is_below, low_m[stage, axis], np.inf))
        np.maximum.at(lower_m, at, np.where(is_below, -np.inf, high_m[stage, axis]))
    must_land &= ~is_growing
    return Bounds(lower_m, upper_m, ~must_land), must_land


def _find_reach_boxes(state: CoordinatorState, i: np.intp, parameters: CellParameters) -> tuple[Array, Array]:
    """Find the boxes (S, 3), (S, 3) of a free vehicle: all that it can reach, with a margin."""
    report = state.reports[i]
    times_s = np.arange(parameters.stages + 1, dtype=np.float64)
    times_s = parameters.dt_s * (times_s + (state.step - report.plan.step))
    accel_mps2 = parameters.accel_mps2 if report.reach_mps2 is None else report.reach_mps2
    lower_m, upper_m = find_reach(report.plan.mean_m[0], report.velocity_mps, accel_mps2, parameters.speed_mps, times_s)
    # Box s: from stage s to s + 1
    return (
        np.minimum(lower_m[:-1], lower_m[1:]) - parameters.margin_m,
        np.maximum(upper_m[:-1], upper_m[1:]) + parameters.margin_m,
    )


def _find_landing_places(
    state: CoordinatorState, is_obstacle: Flags, positions_m: Array, parameters: CellParameters
) -> Array:
    """Find places (N, 3) on the floor, beside the ways of the obstacles."""
    places_m = positions_m.copy()
    for i in np.flatnonzero(is_obstacle):
        report = state.reports[i]
        offsets_m, way_mps = (positions_m - report.plan.mean_m[0])[:, :2], report.velocity_mps[:2]
        # Place of the way that is nearest to each vehicle: t = o'v / v'v
        ahead_s = offsets_m @ way_mps / max(float(way_mps @ way_mps), MIN_SPEED_MPS**2)
        beside_m = offsets_m - np.clip(ahead_s, 0.0, None)[:, None] * way_mps
        length_m = np.linalg.norm(beside_m, axis=1, keepdims=True)
        places_m[:, :2] += LANDING_WAY_M * beside_m / np.maximum(length_m, MIN_WAY_M)
    places_m = np.clip(places_m, parameters.room_lower_m + LANDING_WALL_M, parameters.room_upper_m - LANDING_WALL_M)
    places_m[:, 2] = parameters.room_upper_m[2]
    return places_m
