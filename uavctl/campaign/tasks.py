"""A task of a campaign: some runs of one cell, in; a row of figures for each, out. The same wherever it is done."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from uavctl.campaign.cells import Cell
from uavctl.campaign.controllers import Recipe, built, sight_of
from uavctl.campaign.positions import PositionFilter
from uavctl.campaign.setting import Setting, met
from uavctl.campaign.spec import CHUNK
from uavctl.campaign.ways import ways
from uavctl.campaign.world import Flown, MeasuredPositions, fly
from uavctl.smpc.batch_smpc import Tally

Columns = dict[str, NDArray[np.generic]]

_MET = ("decisions", "infeasible", "slack_used", "fallbacks")
_WHOLE = ("steps", "state_violations", "input_violations", "saturated", "max_age", *_MET)
_WAYS = ("near_s", "nearer_s", "hold_rms_m", "beyond_m")
_REAL = ("cost", "settled_cost", "mean_square_input", "largest_gap", *_WAYS)
_AT_LIMIT = 1e-9


class Work(Protocol):
    """What a worker is given: some runs of a cell, in any world."""

    @property
    def cell(self) -> int:
        """Index of the cell."""
        ...

    @property
    def runs(self) -> int:
        """How many."""
        ...

    @property
    def name(self) -> str:
        """Names it within its campaign; sorts as the rows do."""
        ...

    def fly(self) -> Columns:
        """Fly the runs; what raises is told in a row, and stops nothing."""
        ...

    def lost(self, error: str) -> Columns:
        """The rows of runs that all ended without figures."""
        ...


@dataclass(frozen=True, eq=False)
class Task:
    """Runs `first` … `first` + `runs` - 1 of a cell."""

    cell: int
    first: int
    runs: int
    setting: Setting
    recipe: Recipe

    @property
    def name(self) -> str:
        """Names it within its campaign; sorts as the rows do."""
        return name_of(self.cell, self.first)

    def fly(self) -> Columns:
        """See `fly_task`."""
        return fly_task(self)

    def lost(self, error: str) -> Columns:
        """The rows of a task whose runs all ended without figures."""
        return _without_figures(self, self.first, self.runs, error)


def name_of(cell: int, first: int) -> str:
    """Name of a task that begins with a run of a cell; sorts as the rows do."""
    return f"{cell:05d}-{first:08d}"


def tasks_of(cells: Sequence[Cell]) -> Iterator[Task]:
    """All tasks of a campaign, in order."""
    for cell in cells:
        if cell.recipe is not None:
            runs = cell.setting.spec.runs
            for first in range(0, runs, CHUNK):
                yield Task(cell.index, first, min(CHUNK, runs - first), cell.setting, cell.recipe)


def fly_task(task: Task) -> Columns:
    """Fly the runs of a task at once; if that raises, one by one, and those that raise have its message.

    Returns:
        Columns as in the results, each with a row a run; `ages` and `outside` are (runs, steps).
    """
    try:
        built(task.recipe)
    except Exception as error:  # noqa: BLE001 a crashed run is reported and stops nothing
        return task.lost(told_of(error))
    try:
        return _figures(task, task.first, task.runs)
    except Exception:  # noqa: BLE001 as above
        rows = [_alone(task, task.first + i) for i in range(task.runs)]
        return {name: np.concatenate([row[name] for row in rows]) for name in rows[0]}


def flown(task: Task, first: int, runs: int) -> tuple[Flown, Tally | None]:
    """Fly some runs: their trajectories, and what their controller met where it counts that."""
    controller = built(task.recipe)
    meets = met(task.setting, first, runs)
    seen = None
    if meets.noise is not None:
        seen = MeasuredPositions(PositionFilter(sight_of(task.recipe.config), meets.known), meets.noise)
    with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is told as failed
        found = fly(meets.scene, controller, meets.newest, meets.disturbances, seen)
    tally = getattr(controller, "tally", None)
    return found, tally if isinstance(tally, Tally) else None


def _alone(task: Task, run: int) -> Columns:
    try:
        return _figures(task, run, 1)
    except Exception as error:  # noqa: BLE001 as above
        return _without_figures(task, run, 1, told_of(error))


def told_of(error: Exception) -> str:
    """What ended a run, in words."""
    return f"{type(error).__name__}: {error}"


def _without_figures(task: Task, first: int, runs: int, error: str) -> Columns:
    columns: Columns = {
        "cell": np.full(runs, task.cell, dtype=np.int32),
        "run": np.arange(first, first + runs, dtype=np.int64),
        "error": np.full(runs, error, dtype=object),
        "age_sum": np.zeros(runs, dtype=np.int64),
        **{name: np.zeros((runs, task.setting.spec.steps), dtype=np.int64) for name in ("ages", "outside")},
    }
    columns.update({name: np.zeros(runs, dtype=np.int32) for name in _WHOLE})
    columns.update({name: np.full(runs, np.nan) for name in _REAL})
    return columns


def _figures(task: Task, first: int, runs: int) -> Columns:
    found, tally = flown(task, first, runs)
    steps = found.age.shape[1]
    columns = _without_figures(task, first, runs, "")
    finite = np.isfinite(found.states).all(axis=(1, 2)) & np.isfinite(found.cost).all(axis=1)
    good = finite & ~found.failed
    columns["error"][~good] = "ended in numbers that are not finite"
    with np.errstate(over="ignore", invalid="ignore"):
        figures = {
            "cost": found.cost.sum(axis=1),
            "settled_cost": found.cost[:, steps // 2 :].mean(axis=1),
            "mean_square_input": np.square(found.inputs).sum(axis=2).mean(axis=1),
            "steps": np.full(runs, steps),
            "state_violations": found.state_violated.sum(axis=1),
            "input_violations": found.input_violated.sum(axis=1),
            "saturated": _at_limit(task, found).sum(axis=1),
            "max_age": found.age.max(axis=1),
            "age_sum": found.age.sum(axis=1),
            "outside": found.state_violated,
            "ages": np.stack([np.bincount(row, minlength=steps) for row in found.age]),
            **ways(task.setting.base, found.states),
        }
    if tally is not None:
        for name in _MET:
            figures[name] = getattr(tally, name)
        figures["largest_gap"] = np.where(tally.decisions > tally.infeasible, tally.largest_gap, np.nan)
    for name, values in figures.items():
        columns[name][good] = values[good]
    return columns


def _at_limit(task: Task, found: Flown) -> NDArray[np.bool_]:
    """Steps in which an input acted at its limit (N, T)."""
    sets = task.setting.base.sets
    low, high = np.array(sets.input_lower), np.array(sets.input_upper)
    near = np.where(np.isfinite(high - low), _AT_LIMIT * (high - low), 0.0)
    return np.asarray(((found.inputs <= low + near) | (found.inputs >= high - near)).any(axis=2), dtype=np.bool_)
