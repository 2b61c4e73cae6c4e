"""A cell, and the vehicle's decision about a new one. Cells may be lost, late, repeated or out of order.

1. A vehicle uses one cell at a time. It decides about a cell once, in the order of their numbers: a number that is not
   above the last one decided is ignored.
2. It takes a new cell only if its plan in progress keeps it as well as the old one, or a new plan does. So the next
   program has that plan as a solution.
3. It reports the number in use and the last number decided. Without a new cell it stays in the one in use for good.
4. A vehicle that no longer flies by plans leaves its cell. It counts its exits, and takes no cell that was issued
   before the last one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from uavctl.arrays import Array
from uavctl.records import CellMessage, CellReport, Conduct, Vec3

KEPT_TOLERANCE_M = 1e-6  # excess of a plan over a cell that is rounding of its program
STEP_TOLERANCE = 1e-6  # part of a step that is rounding of a time
NO_CELL = 0  # number without a cell
MAX_PLACE_M = 1e5  # largest coordinate of a cell, for flights far larger than any room
MAX_STEP = 2**53  # largest step, number or count: exact as a float, and some millions of years


@dataclass(frozen=True, eq=False)
class MovingCell:
    """Boxes of one vehicle: box s holds from step `step` + s to the next step, the last one for good."""

    number: int  # larger than that of each older cell of the vehicle
    step: int  # of the first box
    lower_m: Array  # (S, 3), local NED
    upper_m: Array  # (S, 3)
    goal_m: Array  # place to go to inside of the cell, or as near as it allows (3,)
    land: bool = False  # whether to land
    exits: int = 0  # times that the vehicle had left its cell when this one was issued

    def find_limits(self, step: float, stages: int) -> tuple[Array, Array]:
        """Find the limits (n, 3) in stages 1 … n of a plan from a step: in stage t both boxes that meet there hold.

        A motion along a line between two stages then stays inside the box between them. Between two steps there are
        three boxes: those that hold at some time within a step from the stage.
        """
        first = math.floor(step - self.step + STEP_TOLERANCE)
        boxes_per_stage = 2 if step - self.step - first <= STEP_TOLERANCE else 3
        index = first + np.arange(stages)[:, None] + np.arange(boxes_per_stage)
        index = np.clip(index, 0, len(self.lower_m) - 1)
        return self.lower_m[index].max(axis=1), self.upper_m[index].min(axis=1)

    def find_box(self, step: float) -> tuple[Array, Array]:
        """Find the box (3,), (3,) that holds at a time [steps]."""
        index = min(max(math.floor(step - self.step + STEP_TOLERANCE), 0), len(self.lower_m) - 1)
        return self.lower_m[index], self.upper_m[index]

    def compute_excess_m(self, step: int, plan: PlannedPath) -> Array:
        """Compute how far a plan with its margins is outside in stages 1 … H, (H, 3) [m]; 0 is inside."""
        plan = plan.advance(step)
        lower_m, upper_m = self.find_limits(step, len(plan.mean_m) - 1)
        beyond_m = np.maximum(lower_m - plan.mean_m[1:], plan.mean_m[1:] - upper_m) + plan.margin_m[1:]
        return np.maximum(beyond_m, 0.0)


@dataclass(frozen=True, eq=False)
class PlannedPath:
    """Positions of a plan, one row a step; it rests in the last one."""

    step: int  # of the first row
    mean_m: Array  # (H+1, 3)
    margin_m: Array  # back-off of the limits of each position (H+1, 3)

    def advance(self, step: int) -> PlannedPath:
        """Return the plan from a later step on."""
        index = np.minimum(np.arange(len(self.mean_m)) + step - self.step, len(self.mean_m) - 1)
        return PlannedPath(step, self.mean_m[index], self.margin_m[index])


@dataclass(frozen=True, eq=False)
class Report:
    """Report of a vehicle to the coordinator."""

    plan: PlannedPath  # plan in progress, from the step of the report on; its first row is the position
    velocity_mps: Array  # at the first row (3,)
    in_use: int  # number of the cell in use; `NO_CELL` without one
    decided: int  # number of the newest cell that was taken or refused
    conduct: Conduct = Conduct.CELL
    exits: int = 0  # times that the vehicle has left its cell
    goal_m: Array | None = None  # place that it is to reach (3,); None: as before
    reach_mps2: Array | None = None  # largest acceleration of each axis where it is free (3,); None: its limits

    @property
    def order(self) -> tuple[int, int, int]:
        """What a newer report of the vehicle has more of."""
        return self.plan.step, self.exits, self.decided


@dataclass(frozen=True, eq=False)
class CellChoice:
    """Cell in use, and the last number decided."""

    cell: MovingCell | None  # None without one
    decided: int
    exits: int = 0  # times that the vehicle has left its cell


NO_CHOICE = CellChoice(None, NO_CELL)


def is_open(choice: CellChoice, new: MovingCell) -> bool:
    """Whether a cell is still to be decided about."""
    return new.number > choice.decided and new.exits == choice.exits


def decide_cell(choice: CellChoice, new: MovingCell, step: int, plan: PlannedPath) -> CellChoice:
    """Take or refuse a new cell at a step, by the plan in progress or by a new one."""
    if not is_open(choice, new):
        return choice
    # Without a cell, the mean has to be inside: the first cell of two that stand near to each other may be narrow
    allowed_m = plan.advance(step).margin_m[1:] + KEPT_TOLERANCE_M
    if choice.cell is not None:
        allowed_m = choice.cell.compute_excess_m(step, plan) + KEPT_TOLERANCE_M
    if (new.compute_excess_m(step, plan) <= allowed_m).all():
        return replace(choice, cell=new, decided=new.number)
    return replace(choice, decided=new.number)


def leave_cell(choice: CellChoice) -> CellChoice:
    """Leave the cell in use, if there is one; cells issued before are void."""
    return choice if choice.cell is None else replace(choice, cell=None, exits=choice.exits + 1)


def format_cell(cell: MovingCell) -> CellMessage:
    """Return a cell as a message."""
    return CellMessage(
        exits=cell.exits,
        number=cell.number,
        step=cell.step,
        lower_m=_format_rows(cell.lower_m),
        upper_m=_format_rows(cell.upper_m),
        goal_m=_format_row(cell.goal_m),
        land=cell.land,
    )


def parse_cell(message: CellMessage) -> MovingCell:
    """Return the cell of a message.

    Raises:
        ValueError: It has no box, sides of different length or on the wrong side, or a number that is too large.
    """
    lower_m, upper_m, goal_m = np.array(message.lower_m), np.array(message.upper_m), np.array(message.goal_m)
    if not all(0 <= count <= MAX_STEP for count in (message.step, message.number, message.exits)):
        raise ValueError("a cell has a step, number or count of exits that is none")
    if not len(lower_m) or lower_m.shape != upper_m.shape:
        raise ValueError(f"a cell of {len(lower_m)} lower and {len(upper_m)} upper sides is none")
    if not all((np.abs(places_m) <= MAX_PLACE_M).all() for places_m in (lower_m, upper_m, goal_m)):
        raise ValueError(f"a cell has sides or a goal beyond {MAX_PLACE_M:g} m")
    if (lower_m > upper_m).any():
        raise ValueError("a cell has a lower side above its upper side")
    return MovingCell(message.number, message.step, lower_m, upper_m, goal_m, message.land, message.exits)


def parse_report(message: CellReport) -> Report:
    """Return the report of a message.

    Raises:
        ValueError: Its path has no row, another number of margins, or a number that is not finite.
    """
    mean_m, margin_m = np.array(message.path_m), np.array(message.margin_m)
    others = np.array((message.velocity_mps, message.goal_m, message.reach_mps2))
    if not len(mean_m) or mean_m.shape != margin_m.shape:
        raise ValueError(f"a path of {len(mean_m)} positions and {len(margin_m)} margins is none")
    if not (np.isfinite(mean_m).all() and np.isfinite(margin_m).all() and np.isfinite(others).all()):
        raise ValueError("a report has numbers that are not finite")
    return Report(
        PlannedPath(message.step, mean_m, margin_m),
        velocity_mps=others[0],
        in_use=message.in_use,
        decided=message.decided,
        conduct=message.conduct,
        exits=message.exits,
        goal_m=others[1],
        reach_mps2=others[2],
    )


def format_report(report: Report) -> CellReport:
    """Return a report as a message."""
    assert report.goal_m is not None
    assert report.reach_mps2 is not None
    return CellReport(
        step=report.plan.step,
        path_m=_format_rows(report.plan.mean_m),
        margin_m=_format_rows(report.plan.margin_m),
        velocity_mps=_format_row(report.velocity_mps),
        goal_m=_format_row(report.goal_m),
        exits=report.exits,
        in_use=report.in_use,
        decided=report.decided,
        conduct=report.conduct,
        reach_mps2=_format_row(report.reach_mps2),
    )


def _format_rows(rows: Array) -> tuple[Vec3, ...]:
    return tuple(_format_row(row) for row in rows)


def _format_row(row: Array) -> Vec3:
    north, east, down = row.tolist()
    return north, east, down
