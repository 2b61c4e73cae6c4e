"""Cells in use are apart where vehicles leave them, drift and return, whatever happens to the messages.

The vehicles decide by `uavctl.flight.cells`; the oracle is the distance of the boxes of all pairs in use.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from uavctl.arrays import SECOND_NS, Array
from uavctl.fleet.boxes import LEVEL
from uavctl.fleet.cell import NO_CELL, MovingCell, PlannedPath, Report, format_report, parse_cell
from uavctl.fleet.coordinator import CellParameters
from uavctl.flight.cells import NO_CELLS, add_cell, choose_cell, leave_cells, refuse_cell
from uavctl.records import CellMessage, CellReport, Conduct
from uavctl.wiring.cells import Coordinator

STAGES, STEPS, DT_NS = 8, 150, SECOND_NS // 10
LOWER_M, UPPER_M = np.array([-3.0, -3.0, -3.0]), np.array([3.0, 3.0, 0.0])
PARAMETERS = CellParameters(
    distance_m=0.5,
    room_lower_m=LOWER_M,
    room_upper_m=UPPER_M,
    accel_mps2=np.array([2.0, 2.0, 1.5]),
    speed_mps=np.array([1.5, 1.5, 1.0]),
    dt_s=DT_NS / SECOND_NS,
    stages=STAGES,
)
EXIT_SHARE, RETURN_SHARE, FREE_REPORT_SHARE = 0.03, 0.15, 0.1  # of the steps


class ExitingVehicle:
    """Flies in cells by random plans, which need not rest; at times it leaves its cell, drifts, and rests again."""

    def __init__(self, rng: np.random.Generator, position_m: Array) -> None:
        self.rng, self.position_m, self.cells = rng, position_m, NO_CELLS
        self.velocity_mps, self.is_free = np.zeros(3), False
        self.plan = self.rest(0)

    def rest(self, step: int) -> PlannedPath:
        return PlannedPath(step, np.tile(self.position_m, (STAGES, 1)), np.full((STAGES, 3), 0.05))

    def draw_plan(self, cell: MovingCell, step: int) -> PlannedPath:
        lower_m, upper_m = cell.find_limits(step, STAGES - 1)
        places_m = cell.goal_m if self.rng.random() < 0.5 else self.rng.uniform(LOWER_M, UPPER_M, (STAGES - 1, 3))
        margin_m = np.clip(0.5 * (upper_m - lower_m), 0.0, 0.02)
        mean_m = np.clip(places_m, lower_m + margin_m, upper_m - margin_m)
        return PlannedPath(step, np.vstack([self.position_m, mean_m]), np.vstack([np.zeros(3), margin_m]))

    def move(self, step: int, messages: list[CellMessage]) -> None:
        for message in messages:
            self.cells = add_cell(self.cells, parse_cell(message))
        if self.is_free:
            self.position_m = np.clip(self.position_m + 0.1 * self.velocity_mps, LOWER_M, UPPER_M)
            if self.rng.random() < RETURN_SHARE:
                self.is_free, self.velocity_mps, self.plan = False, np.zeros(3), self.rest(step)
            return
        self.plan = self.plan.advance(step)
        self.position_m = self.plan.mean_m[0]
        self._decide(step)
        if self.rng.random() < EXIT_SHARE:  # also in the step in which it has taken a cell
            self.cells, self.is_free = leave_cells(self.cells), True
            self.velocity_mps = self.rng.uniform(-0.7, 0.7, 3)

    def _decide(self, step: int) -> None:
        if self.cells.pending is not None:
            plan = self.plan if self.rng.random() < 0.6 else self.draw_plan(self.cells.pending, step)
            before, self.cells = self.cells, choose_cell(self.cells, plan)
            if self.cells is not before:
                self.plan = plan
            elif self.rng.random() < 0.5:
                self.cells = refuse_cell(self.cells)
        if self.cells.choice.cell is not None and self.rng.random() < 0.4:
            self.plan = self.draw_plan(self.cells.choice.cell, step)

    def report(self, step: int) -> CellReport:
        choice, conduct, path = self.cells.choice, Conduct.REST, self.plan.advance(step)
        if choice.cell is not None:
            conduct = Conduct.CELL
        if self.is_free or self.rng.random() < FREE_REPORT_SHARE:  # the second one may still name a cell in use
            conduct, path = Conduct.FREE, self.rest(step)
        in_use = NO_CELL if choice.cell is None else choice.cell.number
        reach_mps2, goal_m = np.full(3, 0.5), self.rng.uniform(LOWER_M, UPPER_M)
        return format_report(
            Report(path, self.velocity_mps, in_use, choice.decided, conduct, choice.exits, goal_m, reach_mps2)
        )


def measure_gap(first: MovingCell, second: MovingCell, step: int) -> float:
    """Return the least gap of two cells from a step on, north or east, over the distance."""
    index = np.arange(STAGES)
    boxes = [np.minimum(index + step - cell.step, STAGES - 1) for cell in (first, second)]
    gaps_m = np.maximum(
        first.lower_m[boxes[0]] - second.upper_m[boxes[1]], second.lower_m[boxes[1]] - first.upper_m[boxes[0]]
    )
    return float((gaps_m[:, LEVEL] / PARAMETERS.distance_m).max(axis=1).min())


@pytest.mark.parametrize(("loss", "delay"), [(0.0, 1), (0.3, 4), (0.6, 15)])
@pytest.mark.parametrize("vehicles", [2, pytest.param(4, marks=pytest.mark.slow), 6])
def test_cells_in_use_are_apart_where_vehicles_leave_them_and_return(loss: float, delay: int, vehicles: int) -> None:
    rng = np.random.default_rng(vehicles)
    places_m = rng.uniform([-1.5, -1.5, -2.0], [1.5, 1.5, -0.5], (vehicles, 3))
    if vehicles > 2:
        places_m[-1] = places_m[0]  # two at one place: neither gets a cell there
    fleet = [ExitingVehicle(rng, place_m) for place_m in places_m]
    coordinator = Coordinator(PARAMETERS, vehicles)
    reports: list[tuple[int, int, CellReport]] = []  # with the step of arrival, and the vehicle
    cells: list[tuple[int, int, CellMessage]] = []
    pairs = 0
    for step in range(1, STEPS):
        for at, number, report in reports:
            if at == step:
                coordinator.receive(number, report)
        issued = coordinator.update(step * DT_NS)
        # Each message twice; either may be lost, or late
        copies = [pair for pair in issued.items() for _ in range(2) if rng.random() >= loss]
        cells += [(step + int(rng.integers(delay + 1)), number, cell) for number, cell in copies]
        for number, vehicle in enumerate(fleet):
            due = [cell for at, receiver, cell in cells if at == step and receiver == number]
            vehicle.move(step, [due[i] for i in rng.permutation(len(due))])
            for _ in range(2):
                if rng.random() >= loss:
                    reports.append((step + 1 + int(rng.integers(delay + 1)), number, vehicle.report(step)))
        used = [vehicle.cells.choice.cell for vehicle in fleet]
        for first, second in combinations([cell for cell in used if cell is not None], 2):
            pairs += 1
            assert measure_gap(first, second, step) >= 1.0 - 1e-9
    assert pairs > 0
    assert sum(vehicle.cells.choice.exits for vehicle in fleet) > 0
