"""A cell, and the vehicle's decision about a new one. Cells may be lost, late, repeated or out of order.

1. A vehicle uses one cell at a time. It decides about a cell once, in the order of their numbers: a number that is not
   above the last one decided is ignored.
2. It takes a new cell only if its plan in progress keeps it as well as the old one, or a new plan does. So the next
   program has that plan as a solution.
3. It reports the number in use and the last number decided. Without a new cell it stays in the one in use for good.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from uavctl.arrays import Array

KEPT_TOLERANCE_M = 1e-6  # excess of a plan over a cell that is rounding of its program


@dataclass(frozen=True, eq=False)
class MovingCell:
    """Boxes of one vehicle: box s holds from step `step` + s to the next step, the last one for good."""

    number: int  # larger than that of each older cell of the vehicle
    step: int  # of the first box
    lower_m: Array  # (S, 3), local NED
    upper_m: Array  # (S, 3)
    goal_m: Array  # place to go to inside of the cell, or as near as it allows (3,)
    land: bool = False  # whether to land

    def find_limits(self, step: int, stages: int) -> tuple[Array, Array]:
        """Find the limits (n, 3) in stages 1 … n of a plan from a step: in stage t both boxes that meet there hold.

        A motion along a line between two steps then stays inside the box between them.
        """
        index = np.clip(step - self.step + np.arange(stages + 1), 0, len(self.lower_m) - 1)
        lower_m, upper_m = self.lower_m[index], self.upper_m[index]
        return np.maximum(lower_m[:-1], lower_m[1:]), np.minimum(upper_m[:-1], upper_m[1:])

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


class Conduct(Enum):
    """How a vehicle moves."""

    CELL = "cell"  # inside of its cell
    FREE = "free"  # released, blind or flown by its pilot


@dataclass(frozen=True, eq=False)
class Report:
    """Report of a vehicle to the coordinator."""

    plan: PlannedPath  # plan in progress, from the step of the report on; its first row is the position
    velocity_mps: Array  # at the first row (3,)
    in_use: int  # number of the cell in use
    decided: int  # number of the newest cell that was taken or refused
    conduct: Conduct = Conduct.CELL

    @property
    def order(self) -> tuple[int, int]:
        """What a newer report of the vehicle has more of."""
        return self.plan.step, self.decided


@dataclass(frozen=True, eq=False)
class CellChoice:
    """Cell in use, and the last number decided."""

    cell: MovingCell
    decided: int


def decide_cell(choice: CellChoice, new: MovingCell, step: int, plan: PlannedPath) -> CellChoice:
    """Take or refuse a new cell at a step, by the plan in progress or by a new one."""
    if new.number <= choice.decided:
        return choice
    allowed_m = choice.cell.compute_excess_m(step, plan) + KEPT_TOLERANCE_M
    if (new.compute_excess_m(step, plan) <= allowed_m).all():
        return CellChoice(new, new.number)
    return replace(choice, decided=new.number)
