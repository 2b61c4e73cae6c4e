"""Moving cells in a tick: the cell in use, the choice of a new one, and the report to the coordinator. Pure.

1. The newest cell that came waits for the next plan. It is decided there: by the plan in progress, or by a new plan.
2. A plan keeps the limits of the cell in use, and goes to its goal. Without a cell the vehicle stays where it came to
   rest.
3. A vehicle that does not fly by plans leaves its cell. Braking would leave it in motion, and two that fly to each
   other would meet. So an end that the operator orders waits until the vehicle is at rest in its cell.
4. A report has the plan in progress at the steps of the common clock, on lines between the stages of the plan.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import msgspec
import numpy as np

from uavctl.arrays import Array, Counts
from uavctl.fleet.cell import NO_CHOICE, CellChoice, MovingCell, PlannedPath, decide_cell, is_open, leave_cell
from uavctl.records import CellDecision, Plan, Vector
from uavctl.smpc.answer import Preview

REST_NS = 3_000_000_000  # longest time to come to rest in a cell before the end: a plan is 2.4 s long
AT_REST_MPS = 0.15  # slower is at rest: the noise of an estimate, and a light gust
LANDING_NEAR_M = 0.3  # horizontal distance from the goal of a cell at which its vehicle lands


@dataclass(frozen=True, eq=False)
class CellRows:
    """Rows of the state set that limit the positions, north, east and down."""

    upper: Counts  # (3,)
    lower: Counts  # (3,)
    upper_scale: Array  # right side of the row for each metre of the limit (3,)
    lower_scale: Array  # (3,)
    position_index: Counts  # states that are positions (3,)


class CellGroup(msgspec.Struct, frozen=True, eq=False):
    """State of the moving cells of a vehicle."""

    choice: CellChoice = NO_CHOICE
    pending: MovingCell | None = None  # newest cell that is not decided
    rest: Vector | None = None  # equilibrium (n_x,) at which a vehicle without a cell stays; None: none was planned


NO_CELLS = CellGroup()


def add_cell(cells: CellGroup, cell: MovingCell | None) -> CellGroup:
    """Add a cell that came; older ones than the one that waits, and those that are decided, change nothing."""
    if cell is None or not is_open(cells.choice, cell):
        return cells
    is_newer = cells.pending is None or cell.number > cells.pending.number or not is_open(cells.choice, cells.pending)
    return msgspec.structs.replace(cells, pending=cell) if is_newer else cells


def locate_plan(plan: Plan, rows: CellRows, at_ns: int, dt_ns: int, position_m: Sequence[float]) -> PlannedPath:
    """Locate a plan at the steps of the common clock, from the last one at a time on.

    Args:
        at_ns: A time at which a step begins.
        position_m: Predicted position then; the plan itself begins once an input acts.
    """
    index, step = rows.position_index, at_ns // dt_ns
    mean_m = np.vstack([position_m, plan.states[:, index]])
    margin_m = np.maximum(
        plan.backoff_x[:, rows.upper] / rows.upper_scale, plan.backoff_x[:, rows.lower] / rows.lower_scale
    )
    margin_m = np.vstack([margin_m[:1], margin_m])
    # Times of these rows since the step [steps]
    base = (plan.base_ns - step * dt_ns) / dt_ns
    times = np.concatenate([[min(0.0, base - 1.0)], base + np.arange(len(plan.states))])
    if base <= 0.0:  # the position now is that of the plan
        times, mean_m, margin_m = times[1:], mean_m[1:], margin_m[1:]
    else:
        times[0] = 0.0
    steps = np.arange(len(plan.states), dtype=np.float64)
    return PlannedPath(step, _interpolate(steps, times, mean_m), _interpolate(steps, times, margin_m))


def _interpolate(at: Array, times: Array, rows: Array) -> Array:
    """Interpolate rows (n, 3) at other times (m,): (m, 3); constant outside."""
    return np.column_stack([np.interp(at, times, column) for column in rows.T])


def limit_preview(
    preview: Preview, cell: MovingCell, rows: CellRows, limits: Array, base_ns: int, dt_ns: int, horizon: int
) -> Preview:
    """Limit a plan that begins at a time by a cell.

    Args:
        limits: Right sides of the state rows (m_x,), constant in time.
        base_ns: When the plan begins [ns].
    """
    lower_m, upper_m = cell.find_limits(base_ns / dt_ns, horizon)
    known = np.tile(limits, (horizon + 1, 1)) if preview.limits is None else preview.limits
    bounded = known.copy()
    # h_t = min(h_t, cell in stage t)
    bounded[1:, rows.upper] = np.minimum(bounded[1:, rows.upper], upper_m * rows.upper_scale)
    bounded[1:, rows.lower] = np.minimum(bounded[1:, rows.lower], -lower_m * rows.lower_scale)
    resting = known[-1].copy()
    resting[rows.upper] = np.minimum(resting[rows.upper], cell.upper_m[-1] * rows.upper_scale)
    resting[rows.lower] = np.minimum(resting[rows.lower], -cell.lower_m[-1] * rows.lower_scale)
    return msgspec.structs.replace(preview, limits=bounded, path=None, resting_limits=resting)


def choose_cell(cells: CellGroup, path: PlannedPath) -> CellGroup:
    """Take the cell that waits if a path keeps it, else leave it undecided."""
    if cells.pending is None or not is_open(cells.choice, cells.pending):
        return cells
    choice = decide_cell(cells.choice, cells.pending, path.step, path)
    is_taken = choice.cell is cells.pending
    return msgspec.structs.replace(cells, choice=choice, pending=None, rest=None) if is_taken else cells


def refuse_cell(cells: CellGroup) -> CellGroup:
    """Refuse the cell that waits."""
    if cells.pending is None or not is_open(cells.choice, cells.pending):
        return cells
    choice = CellChoice(cells.choice.cell, cells.pending.number, cells.choice.exits)
    return msgspec.structs.replace(cells, choice=choice, pending=None)


def leave_cells(cells: CellGroup) -> CellGroup:
    """Leave the cell in use, and the place to rest at."""
    if cells.choice.cell is None and cells.rest is None:
        return cells
    return CellGroup(leave_cell(cells.choice))


def is_at_landing_place(cells: CellGroup, position_m: Sequence[float]) -> bool:
    """Whether the vehicle is told to land, and is beside the place for it."""
    cell = cells.choice.cell
    if cell is None or not cell.land:
        return False
    return math.hypot(position_m[0] - cell.goal_m[0], position_m[1] - cell.goal_m[1]) <= LANDING_NEAR_M


def describe_decision(before: CellGroup, after: CellGroup, at_ns: int) -> CellDecision | None:
    """Describe the decision of a tick about a cell, or the exit from one; None without either."""
    first, choice = before.choice, after.choice
    if choice.exits != first.exits:
        number = 0 if first.cell is None else first.cell.number
        return CellDecision(at_ns=at_ns, number=number, taken=False, exits=choice.exits)
    if choice.decided == first.decided:
        return None
    taken = choice.cell is not None and choice.cell.number == choice.decided
    return CellDecision(at_ns=at_ns, number=choice.decided, taken=taken, exits=choice.exits)
