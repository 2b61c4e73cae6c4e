"""Cells under arbitrary loss, delay, order and repetition of messages: those in use are always apart."""

import dataclasses

import numpy as np
import pytest

from uavctl.arrays import Array
from uavctl.fleet.boxes import Boxes, find_gaps
from uavctl.fleet.cell import NO_CHOICE, CellChoice, MovingCell, PlannedPath, Report, decide_cell
from uavctl.fleet.coordinator import CellParameters, advance, begin, begin_without_cells, issue, receive
from uavctl.fleet.voronoi import make_voronoi_cells
from uavctl.records import Conduct

STAGES = 8
PARAMETERS = CellParameters(
    distance_m=0.5,
    room_lower_m=np.array([-3.0, -3.0, -3.0]),
    room_upper_m=np.array([3.0, 3.0, 0.0]),
    accel_mps2=np.array([2.0, 2.0, 1.5]),
    speed_mps=np.array([1.5, 1.5, 1.0]),
    dt_s=0.1,
    stages=STAGES,
    silence_s=1e9,
)
STARTS_M = np.array([[-2.0, 0.1, -1.2], [2.0, 0.0, -1.2], [0.0, 2.0, -1.2], [0.1, -2.0, -2.0], [0.0, 0.2, -1.0]])
GOALS_M = STARTS_M[[1, 0, 3, 2, 4]]


def gather(cells: list[MovingCell], step: int) -> Boxes:
    index = [np.clip(np.arange(STAGES) + step - cell.step, 0, STAGES - 1) for cell in cells]
    pairs = list(zip(cells, index, strict=True))
    return Boxes(np.array([c.lower_m[i] for c, i in pairs]), np.array([c.upper_m[i] for c, i in pairs]))


def get_cell(choice: CellChoice) -> MovingCell:
    assert choice.cell is not None
    return choice.cell


def draw_plan(rng: np.random.Generator, cell: MovingCell, step: int) -> PlannedPath:
    """Draw a plan inside of a cell, with small margins, towards the goal of the cell or anywhere."""
    lower_m, upper_m = cell.find_limits(step, STAGES - 1)
    place_m = cell.goal_m if rng.random() < 0.7 else rng.uniform(-3.0, 3.0, 3)
    half_m = 0.5 * (upper_m - lower_m)
    margin_m = np.minimum(0.02, half_m)
    mean_m = np.clip(place_m, lower_m + margin_m, upper_m - margin_m)
    return PlannedPath(step, np.vstack([mean_m[:1], mean_m]), np.vstack([np.zeros((1, 3)), margin_m]))


@pytest.mark.parametrize(("loss", "delay"), [(0.0, 0), (0.3, 2), (0.8, 1), (0.3, 12)])
@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
def test_cells_in_use_are_apart_for_any_fate_of_messages(loss: float, delay: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    state = begin(0, STARTS_M, GOALS_M, PARAMETERS)
    choices = [CellChoice(cell, cell.number) for cell in state.newest]
    inboxes: list[list[tuple[int, MovingCell]]] = [[] for _ in choices]
    sent_reports: list[tuple[int, int, Report]] = []
    taken = refused = 0
    for step in range(150):
        state = advance(state, step)
        for at, i, report in sent_reports:
            if at == step:
                state = receive(state, {i: report})
        state = issue(state, PARAMETERS)
        for i, cell in enumerate(state.newest):
            for _ in range(2):  # each message twice
                if rng.random() >= loss:
                    inboxes[i].append((step + int(rng.integers(delay + 1)), cell))
        for i, choice in enumerate(choices):
            due = [cell for at, cell in inboxes[i] if at == step]
            plan = draw_plan(rng, get_cell(choice), step) if rng.random() < 0.5 else state.reports[i].plan
            for cell in due:
                before, choice = choice, decide_cell(choice, cell, step, plan)
                taken += choice.cell is not before.cell
                refused += choice.decided != before.decided and choice.cell is before.cell
            choices[i] = choice
            if rng.random() >= loss:
                report = Report(
                    draw_plan(rng, get_cell(choice), step), np.zeros(3), get_cell(choice).number, choice.decided
                )
                sent_reports.append((step + 1 + int(rng.integers(delay + 1)), i, report))
        used = gather([get_cell(choice) for choice in choices], step)
        gaps = find_gaps(used, used, PARAMETERS.distance_m)[np.triu_indices(len(choices), 1)]
        assert gaps.min() >= 1.0 - 1e-9
        # The cell in use is inside of the claim: for these stages and for good
        claims = state.claims
        assert (used.lower_m >= claims.lower_m - 1e-12).all()
        assert (used.upper_m <= claims.upper_m + 1e-12).all()
    assert taken > 20
    assert refused > 0


def test_a_plan_in_progress_is_inside_of_the_new_cell() -> None:
    rng = np.random.default_rng(5)
    state = begin(0, STARTS_M, GOALS_M, PARAMETERS)
    choices = [CellChoice(cell, cell.number) for cell in state.newest]
    for step in range(60):
        plans = [draw_plan(rng, get_cell(choice), step) for choice in choices]
        reports = [
            Report(plan, np.zeros(3), get_cell(choice).number, choice.decided)
            for plan, choice in zip(plans, choices, strict=True)
        ]
        state = issue(receive(advance(state, step), dict(enumerate(reports))), PARAMETERS)
        for i, (plan, cell) in enumerate(zip(plans, state.newest, strict=True)):
            assert cell.number == get_cell(choices[i]).number + 1
            for later in (step, step + 1, step + 5):
                assert cell.compute_excess_m(later, plan).max() <= 1e-9
            choices[i] = decide_cell(choices[i], cell, step, plan)
            assert choices[i].cell is cell


def test_a_cell_that_cuts_the_plan_is_refused_and_the_refusal_frees_the_claim() -> None:
    state = begin(0, STARTS_M, GOALS_M, PARAMETERS)
    state = issue(state, PARAMETERS)
    cell, choice = state.newest[0], CellChoice(begin(0, STARTS_M, GOALS_M, PARAMETERS).newest[0], 0)
    cut = dataclasses.replace(cell, lower_m=cell.upper_m - 0.01)
    after = decide_cell(choice, cut, 0, state.reports[0].plan)
    assert after.cell is choice.cell
    assert after.decided == cut.number
    assert decide_cell(after, cell, 0, state.reports[0].plan) is after  # decided once
    report = Report(state.reports[0].plan.advance(1), np.zeros(3), 0, cut.number)
    state = receive(advance(state, 1), {0: report})
    np.testing.assert_array_equal(state.claims.lower_m[0], state.used.lower_m[0])


def test_an_older_report_changes_nothing() -> None:
    state = issue(begin(0, STARTS_M, GOALS_M, PARAMETERS), PARAMETERS)
    plan = state.reports[0].plan
    state = receive(advance(state, 3), {0: Report(plan.advance(3), np.zeros(3), 1, 1)})
    late = receive(state, {0: Report(plan.advance(2), np.zeros(3), 0, 0)})
    assert late.used_numbers == state.used_numbers
    assert late.reports == state.reports


@pytest.mark.parametrize("decided", [1, 2])
def test_a_vehicle_that_left_its_cell_gets_another_one(decided: int) -> None:
    """A cell that was on its way at the exit is void: its vehicle never decides about it."""
    place_m = np.array([0.0, 0.0, -1.5])
    path = PlannedPath(0, np.tile(place_m, (STAGES, 1)), np.zeros((STAGES, 3)))
    at_rest = Report(path, np.zeros(3), in_use=0, decided=0, conduct=Conduct.REST)
    state = issue(begin_without_cells(0, [at_rest], PARAMETERS), PARAMETERS)
    first = state.newest[0]
    in_cell = dataclasses.replace(
        at_rest, plan=path.advance(1), in_use=first.number, decided=first.number, conduct=Conduct.CELL
    )
    state = issue(receive(advance(state, 1), {0: in_cell}), PARAMETERS)
    assert state.newest[0].number == first.number + 1
    left = dataclasses.replace(at_rest, plan=path.advance(2), decided=decided, conduct=Conduct.FREE, exits=1)
    state = issue(receive(advance(state, 2), {0: left}), PARAMETERS)
    again = dataclasses.replace(left, plan=path.advance(3), conduct=Conduct.REST)
    state = issue(receive(advance(state, 3), {0: again}), PARAMETERS)
    cell, choice = state.newest[0], CellChoice(None, decided, 1)
    assert decide_cell(choice, cell, 3, again.plan).cell is cell
    assert (state.claims.lower_m[0] <= cell.lower_m).all() and (state.claims.upper_m[0] >= cell.upper_m).all()


def test_vehicles_too_near_at_the_beginning_are_refused() -> None:
    with pytest.raises(ValueError, match="vehicles 0 and 1"):
        begin(0, STARTS_M[[0, 0]] + np.array([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0]]), GOALS_M[:2], PARAMETERS)


def test_cells_keep_away_from_a_released_vehicle_or_their_vehicle_is_told_to_land() -> None:
    state = begin(0, STARTS_M, GOALS_M, PARAMETERS)
    plan, velocity_mps = state.reports[4].plan, np.array([1.0, 0.0, 0.0])
    state = receive(state, {4: Report(plan, velocity_mps, 0, 0, Conduct.FREE)})
    state = issue(state, PARAMETERS)
    rng, times_s = np.random.default_rng(0), 0.1 * np.arange(STAGES)
    kept = [cell for cell in state.newest[:4] if not cell.land]
    assert kept
    for _ in range(200):
        # Any motion within the limits: one acceleration each step
        accel = PARAMETERS.accel_mps2 * rng.choice([-1.0, 0.0, 1.0], (STAGES, 3))
        position_m, velocity = STARTS_M[4].copy(), velocity_mps.copy()
        for s in range(len(times_s)):
            for cell in kept:
                offset_m = np.maximum(cell.lower_m[s] - position_m, position_m - cell.upper_m[s])
                assert offset_m[:2].max() >= PARAMETERS.distance_m - 1e-9
            after = np.clip(velocity + 0.1 * accel[s], -PARAMETERS.speed_mps, PARAMETERS.speed_mps)
            position_m, velocity = position_m + 0.05 * (velocity + after), after
    # Seen again after two seconds of silence, it may be anywhere: all others land
    state = issue(advance(state, 20), PARAMETERS)
    assert all(cell.land for cell in state.newest[:4])


@pytest.mark.parametrize(("reach_mps2", "lands"), [(0.0, False), (0.5, True)])
def test_others_land_for_a_silent_vehicle_unless_it_has_landed(reach_mps2: float, lands: bool) -> None:
    """The daemon of a vehicle that has landed ends: one that was told to land alone landed all."""
    parameters = dataclasses.replace(PARAMETERS, silence_s=1.0)

    def rest(step: int, place_m: Array, conduct: Conduct) -> Report:
        path = PlannedPath(step, np.tile(place_m, (STAGES, 1)), np.zeros((STAGES, 3)))
        return Report(path, np.zeros(3), 0, 0, conduct, goal_m=place_m, reach_mps2=np.full(3, reach_mps2))

    places_m = STARTS_M.copy()
    places_m[4, 2] = 0.0
    reports = [rest(0, places_m[i], Conduct.PATH if i == 4 else Conduct.REST) for i in range(5)]
    state = begin_without_cells(0, reports, parameters)
    known = {i: rest(200, places_m[i], Conduct.REST) for i in range(4)}
    state = issue(receive(advance(state, 200), known), parameters)
    assert [cell.land for cell in state.newest[:4]] == [lands] * 4
    assert state.waits[4] == "silent"


def test_the_place_to_land_at_stays_and_is_reached() -> None:
    """A place beside the newest position moved on with the vehicle, along the floor to the next wall."""
    released = Report(
        PlannedPath(0, np.tile(STARTS_M[4], (STAGES, 1)), np.zeros((STAGES, 3))), np.zeros(3), 0, 0, Conduct.FREE
    )
    state = receive(begin(0, STARTS_M, GOALS_M, PARAMETERS), {4: released})
    state = issue(advance(state, 20), PARAMETERS)
    places_m = [cell.goal_m for cell in state.newest[:4]]
    assert all(cell.land for cell in state.newest[:4])
    for place_m in places_m:
        assert (np.abs(place_m[:2]) <= 2.5 + 1e-9).all()  # the room's walls are at 3 m
    for step in range(21, 80):
        reports = {}
        for i, cell in enumerate(state.newest[:4]):
            plan = PlannedPath(step - 1, np.clip(cell.goal_m, cell.lower_m, cell.upper_m), np.zeros((STAGES, 3)))
            plan = plan.advance(step)
            reports[i] = Report(plan, np.zeros(3), cell.number, cell.number)
        state = issue(receive(advance(state, step), reports), PARAMETERS)
    for i, place_m in enumerate(places_m):
        assert state.newest[i].land and (state.newest[i].goal_m == place_m).all()
        assert state.reports[i].plan.mean_m[0, :2] == pytest.approx(place_m[:2], abs=0.02)


def test_a_cell_that_is_taken_before_a_refused_cell_to_land_in_is_the_claim() -> None:
    state = begin(0, STARTS_M, GOALS_M, PARAMETERS)
    state = issue(state, PARAMETERS)
    first = state.newest[0]
    released = Report(state.reports[4].plan, np.array([1.0, 0.0, 0.0]), 0, 0, Conduct.FREE)
    state = issue(advance(receive(state, {4: released}), 20), PARAMETERS)
    assert state.newest[0].land and state.newest[0].number == first.number + 1
    plan = PlannedPath(20, np.tile(STARTS_M[0], (STAGES, 1)), np.zeros((STAGES, 3)))
    state = receive(state, {0: Report(plan, np.zeros(3), first.number, first.number + 1)})
    assert state.used_numbers[0] == first.number and state.is_decided[0]
    assert (state.claims.lower_m[0] == first.lower_m[-1]).all()
    assert (state.claims.upper_m[0] == first.upper_m[-1]).all()


def test_buffered_voronoi_cells_contain_their_vehicles_and_are_apart() -> None:
    cells = make_voronoi_cells(STARTS_M[:4], GOALS_M[:4], 1, 0, PARAMETERS)
    boxes = Boxes(np.array([cell.lower_m for cell in cells]), np.array([cell.upper_m for cell in cells]))
    assert (boxes.lower_m[:, 0] <= STARTS_M[:4]).all()
    assert (boxes.upper_m[:, 0] >= STARTS_M[:4]).all()
    assert find_gaps(boxes, boxes, PARAMETERS.distance_m)[np.triu_indices(4, 1)].min() >= 1.0 - 1e-9


@pytest.mark.parametrize(("margin_m", "room_m"), [(0.15, 0.15), (2.0, PARAMETERS.max_margin_m)])
def test_a_cell_has_room_for_margins_up_to_a_limit(margin_m: float, room_m: float) -> None:
    place_m = np.array([0.0, 0.0, -1.5])
    path = PlannedPath(0, np.tile(place_m, (STAGES, 1)), np.full((STAGES, 3), margin_m))
    report = Report(path, np.zeros(3), in_use=0, decided=0, goal_m=place_m)
    cell = issue(begin_without_cells(0, [report], PARAMETERS), PARAMETERS).newest[0]
    np.testing.assert_allclose(cell.upper_m - place_m, room_m + PARAMETERS.margin_m, atol=2e-4)
    np.testing.assert_allclose(place_m - cell.lower_m, room_m + PARAMETERS.margin_m, atol=2e-4)


def test_vehicles_with_cells_of_another_coordinator_are_refused() -> None:
    reports = [
        Report(PlannedPath(0, np.tile(place_m, (STAGES, 1)), np.zeros((STAGES, 3))), np.zeros(3), 5, 6)
        for place_m in STARTS_M[:2]
    ]
    with pytest.raises(ValueError, match="another coordinator"):
        begin_without_cells(0, reports, PARAMETERS)


@pytest.mark.parametrize("number", [0, 1])
def test_a_cell_in_use_that_was_never_issued_is_an_error(number: int) -> None:
    """Where it is unknown, its vehicle could be anywhere: no claim of the others would be right."""
    state = begin(0, STARTS_M[:2], STARTS_M[1::-1].copy(), PARAMETERS)
    state = issue(state, PARAMETERS)
    known, foreign = state.newest[number].number, state.newest[number].number + 1
    taken = dataclasses.replace(state.reports[number], in_use=known, decided=known)
    assert receive(state, {number: taken}).used_numbers[number] == known
    with pytest.raises(ValueError, match="another coordinator"):
        receive(state, {number: dataclasses.replace(taken, in_use=foreign, decided=foreign)})


def test_cells_leave_more_room_for_a_vehicle_that_refuses_them_until_it_takes_one() -> None:
    place_m = np.array([0.0, 0.0, -1.5])
    path = PlannedPath(0, np.tile(place_m, (STAGES, 1)), np.full((STAGES, 3), 2.0))
    report = Report(path, np.zeros(3), in_use=0, decided=0, goal_m=place_m)
    state = issue(begin_without_cells(0, [report], PARAMETERS), PARAMETERS)
    state = issue(receive(state, {0: dataclasses.replace(report, in_use=1, decided=1)}), PARAMETERS)
    rooms_m = []
    for decided in range(2, 40):  # it keeps the first one
        state = issue(receive(state, {0: dataclasses.replace(report, in_use=1, decided=decided)}), PARAMETERS)
        rooms_m.append(float((state.newest[0].upper_m - place_m)[-1, 0]))
    assert (np.diff(rooms_m) >= 0.0).all()
    assert rooms_m[-1] > 1.5 * rooms_m[0]
    assert rooms_m[-1] <= 2.0 * PARAMETERS.max_margin_m + PARAMETERS.margin_m + 2e-4
    newest = state.newest[0].number
    state = issue(receive(state, {0: dataclasses.replace(report, in_use=newest, decided=newest)}), PARAMETERS)
    np.testing.assert_allclose((state.newest[0].upper_m - place_m)[-1, 0], rooms_m[0], atol=2e-4)


def test_vehicles_at_rest_that_stand_nearer_than_their_margins_all_get_cells_and_none_is_told_to_land() -> None:
    angles = 2.0 * np.pi * np.arange(12) / 12
    places_m = np.column_stack([2.4 * np.cos(angles), 2.4 * np.sin(angles), np.full(12, -1.2)])
    margin_m = np.linspace(0.0, 0.5, STAGES)[:, None] * np.ones(3)  # 1.24 m apart, with 0.5 m to keep
    plans = [PlannedPath(0, np.tile(place_m, (STAGES, 1)), margin_m) for place_m in places_m]
    reports = [
        Report(plan, np.zeros(3), 0, 0, Conduct.REST, goal_m=goal_m)
        for plan, goal_m in zip(plans, -places_m, strict=True)
    ]
    state = issue(begin_without_cells(0, reports, PARAMETERS), PARAMETERS)
    assert all(cell.number == 1 and not cell.land for cell in state.newest)
    gaps = find_gaps(gather(list(state.newest), 0), gather(list(state.newest), 0), PARAMETERS.distance_m)
    assert gaps[np.triu_indices(12, 1)].min() >= 1.0 - 1e-9
    for plan, cell in zip(plans, state.newest, strict=True):
        assert decide_cell(NO_CHOICE, cell, 0, plan).cell is cell  # its mean is inside, its margins are not


def test_a_vehicle_without_a_cell_takes_none_that_its_mean_plan_leaves() -> None:
    state = issue(begin(0, STARTS_M, GOALS_M, PARAMETERS), PARAMETERS)
    cell, plan = state.newest[0], state.reports[0].plan
    beside = PlannedPath(plan.step, plan.mean_m + np.array([0.0, 0.5, 0.0]), plan.margin_m)
    assert decide_cell(NO_CHOICE, cell, 0, plan).cell is cell
    assert decide_cell(NO_CHOICE, cell, 0, beside).cell is None
