"""Moving cells in a tick: limits of plans, the choice of a cell, exits, and reports; judged by geometry."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from uavctl.config import load_config
from uavctl.fleet.cell import MovingCell, PlannedPath, format_cell, parse_cell
from uavctl.flight.cells import (
    NO_CELLS,
    CellGroup,
    CellRows,
    add_cell,
    choose_cell,
    describe_decision,
    is_at_landing_place,
    leave_cells,
    limit_preview,
    locate_plan,
    refuse_cell,
)
from uavctl.flight.controller import Controller
from uavctl.records import Plan, SolveStatus
from uavctl.smpc.answer import NOMINAL
from uavctl.wiring.cells import build_cell_rows
from uavctl.wiring.controller import build_flight_design, prepare

DT_NS = 50_000_000
BOXES = 6


def make_cell(number: int = 1, step: int = 10, half_m: float = 1.0, exits: int = 0) -> MovingCell:
    """A cell whose boxes move north by 0.1 m a step."""
    middle_m = np.column_stack([0.1 * np.arange(BOXES), np.zeros(BOXES), np.full(BOXES, -1.0)])
    return MovingCell(number, step, middle_m - half_m, middle_m + half_m, np.array([3.0, 0.0, -1.0]), exits=exits)


def make_path(place_m: tuple[float, float, float], step: int = 10) -> PlannedPath:
    return PlannedPath(step, np.tile(np.array(place_m), (BOXES, 1)), np.full((BOXES, 3), 0.1))


def get_rows() -> CellRows:
    return CellRows(np.array([0, 2, 4]), np.array([1, 3, 5]), np.ones(3), np.ones(3), np.array([0, 2, 4]))


def make_plan(states: np.ndarray, base_ns: int, backoffs: np.ndarray) -> Plan:
    return Plan(
        seq=1, base_ns=base_ns, captured_ns=0, status=SolveStatus.OPTIMAL, method="", inputs=np.zeros((1, 3)),
        states=states, backoff_x=backoffs, backoff_u=np.zeros((1, 3)), reference=(0.0,) * 6, slack=0.0, offset=0.0,
        terminal_miss=0.0, cost=0.0, cost_lower=0.0, gap=0.0, iterations=0, design_id="",
    )  # fmt: skip


@given(st.floats(0.0, 12.0), st.floats(0.0, 1.0), st.floats(0.0, 1.0))
def test_a_line_between_two_stages_within_the_limits_is_inside_of_every_box_on_its_way(
    step: float, low_share: float, high_share: float
) -> None:
    cell = make_cell(step=5)
    lower_m, upper_m = cell.find_limits(step, 3)
    begin_m = lower_m[0] + low_share * (upper_m[0] - lower_m[0])
    end_m = lower_m[1] + high_share * (upper_m[1] - lower_m[1])
    for part in np.linspace(0.0, 1.0, 21):
        place_m, at = begin_m + part * (end_m - begin_m), step + 1.0 + part
        index = int(np.clip(np.floor(at - cell.step + 1e-9), 0, BOXES - 1))
        assert (place_m >= cell.lower_m[index] - 1e-9).all()
        assert (place_m <= cell.upper_m[index] + 1e-9).all()


def test_limits_at_a_step_are_those_of_the_two_boxes_that_meet_there() -> None:
    cell = make_cell(step=0)
    lower_m, upper_m = cell.find_limits(0, 2)
    np.testing.assert_allclose(lower_m[:, 0], [-0.9, -0.8])
    np.testing.assert_allclose(upper_m[:, 0], [1.0, 1.1])
    lower_m, upper_m = cell.find_limits(0.4, 1)  # boxes 0, 1 and 2
    np.testing.assert_allclose([lower_m[0, 0], upper_m[0, 0]], [-0.8, 1.0])


def test_a_plan_is_limited_by_the_cell_and_rests_in_its_last_box() -> None:
    limits = np.array([2.0, 2.0, 2.0, 2.0, 0.0, 2.0])  # north, east ≤ 2 and ≥ -2; down ≤ 0 and ≥ -2
    preview = limit_preview(NOMINAL, make_cell(step=0, half_m=0.5), get_rows(), limits, 0, DT_NS, 3)
    assert preview.limits is not None
    np.testing.assert_allclose(preview.limits[0], limits)
    np.testing.assert_allclose(preview.limits[2], [0.6, -(-0.5 + 0.2), 0.5, 0.5, -0.5, 1.5])
    assert preview.resting_limits is not None
    np.testing.assert_allclose(preview.resting_limits, [1.0, 0.0, 0.5, 0.5, -0.5, 1.5])


def test_a_plan_is_located_on_lines_between_its_stages() -> None:
    states = np.zeros((4, 6))
    states[:, 0] = [1.0, 2.0, 4.0, 8.0]
    backoffs = np.zeros((4, 6))
    backoffs[:, 0], backoffs[:, 1] = [0.1, 0.2, 0.3, 0.4], [0.0, 0.4, 0.0, 0.0]
    # The plan begins 1.5 steps after step 7, at which the vehicle is at 0.4 m
    plan = make_plan(states, base_ns=7 * DT_NS + 3 * DT_NS // 2, backoffs=backoffs)
    path = locate_plan(plan, get_rows(), 7 * DT_NS, DT_NS, (0.4, 0.0, 0.0))
    assert path.step == 7
    np.testing.assert_allclose(path.mean_m[:, 0], [0.4, 0.8, 1.5, 3.0])
    np.testing.assert_allclose(path.margin_m[:, 0], [0.1, 0.1, 0.25, 0.35])
    later = locate_plan(plan, get_rows(), 9 * DT_NS, DT_NS, (9.0, 9.0, 9.0))
    np.testing.assert_allclose(later.mean_m[:, 0], [1.5, 3.0, 6.0, 8.0])  # where it is then is of no account


def test_a_cell_is_taken_by_a_path_that_keeps_it_and_else_waits() -> None:
    cells = add_cell(NO_CELLS, make_cell())
    assert choose_cell(cells, make_path((1.2, 0.0, -1.0))) is cells  # 0.3 m beyond the first box, with its margin
    taken = choose_cell(cells, make_path((0.3, 0.0, -1.0)))
    assert taken.choice.cell is cells.pending
    assert taken.pending is None
    decision = describe_decision(NO_CELLS, taken, 7)
    assert decision is not None
    assert (decision.number, decision.taken, decision.exits) == (1, True, 0)
    refused = refuse_cell(cells)
    assert (refused.choice.cell, refused.choice.decided, refused.pending) == (None, 1, None)
    assert add_cell(refused, make_cell()) is refused  # decided once


def test_an_older_cell_does_not_replace_the_one_that_waits() -> None:
    cells = add_cell(add_cell(NO_CELLS, make_cell(number=3)), make_cell(number=2))
    assert cells.pending is not None
    assert cells.pending.number == 3


def test_a_vehicle_that_left_its_cell_takes_none_of_before() -> None:
    taken = choose_cell(add_cell(NO_CELLS, make_cell()), make_path((0.3, 0.0, -1.0)))
    left = leave_cells(taken)
    assert (left.choice.cell, left.choice.exits) == (None, 1)
    assert add_cell(left, make_cell(number=2)) is left
    again = add_cell(left, make_cell(number=3, exits=1))
    assert choose_cell(again, make_path((0.3, 0.0, -1.0))).choice.cell is again.pending
    decision = describe_decision(taken, left, 7)
    assert decision is not None
    assert (decision.number, decision.taken, decision.exits) == (1, False, 1)
    assert leave_cells(left) is left


def test_a_vehicle_lands_beside_the_goal_of_a_cell_to_land_in() -> None:
    landing = replace(make_cell(), land=True)
    cells = CellGroup(replace(NO_CELLS.choice, cell=landing, decided=1))
    assert is_at_landing_place(cells, (2.8, 0.2, -2.0))
    assert not is_at_landing_place(cells, (2.6, 0.0, -1.0))
    assert not is_at_landing_place(NO_CELLS, (3.0, 0.0, -1.0))


@given(st.lists(st.tuples(*[st.floats(-1e3, 1e3)] * 3), min_size=1, max_size=4), st.integers(0, 9), st.booleans())
def test_a_cell_is_the_same_after_its_message(rows: list[tuple[float, float, float]], exits: int, land: bool) -> None:
    cell = MovingCell(4, 9, np.array(rows), np.array(rows) + 1.0, np.array(rows[0]), land, exits)
    message = format_cell(cell)
    again = parse_cell(msgspec.json.decode(msgspec.json.encode(message), type=type(message)))
    np.testing.assert_array_equal(again.lower_m, cell.lower_m)
    np.testing.assert_array_equal(again.upper_m, cell.upper_m)
    np.testing.assert_array_equal(again.goal_m, cell.goal_m)
    assert (again.number, again.step, again.land, again.exits) == (4, 9, land, exits)


@pytest.mark.parametrize(
    "change",
    [
        {"lower_m": ()},
        {"lower_m": (), "upper_m": ()},
        {"goal_m": (float("nan"), 0.0, 0.0)},
        {"upper_m": ((float("inf"), 0.0, 0.0),) * BOXES},
    ],
    ids=["other length", "no box", "goal", "side"],
)
def test_a_malformed_cell_is_refused(change: dict[str, object]) -> None:
    with pytest.raises(ValueError, match="cell"):
        parse_cell(msgspec.structs.replace(format_cell(make_cell()), **change))


@pytest.fixture(scope="module")
def controller() -> Controller:
    config = load_config("room-px4", ["mission.cells=true"])
    return prepare(config, build_flight_design(config)).controller


def test_the_rows_are_those_of_the_room(controller: Controller) -> None:
    rows = controller.cell_rows
    assert rows is not None
    limits = controller.mission.limits
    np.testing.assert_allclose(limits[rows.upper] / rows.upper_scale, [3.0, 2.5, 0.0])
    np.testing.assert_allclose(-limits[rows.lower] / rows.lower_scale, [-3.0, -2.5, -2.5])


@pytest.mark.parametrize(
    ("overrides", "key"), [(["sets.state_upper=[inf, 1.5, inf, 2.5, 1.5, inf, 0.0, 1.0, inf]"], "sets.state_upper")]
)
def test_a_room_without_walls_has_no_cells(overrides: list[str], key: str) -> None:
    config = load_config("room-px4", ["mission.cells=true", *overrides])
    design = build_flight_design(config)
    with pytest.raises(Exception, match=key):
        build_cell_rows(config, design)
