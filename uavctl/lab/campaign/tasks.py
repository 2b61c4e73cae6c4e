"""Cells and tasks of a campaign in the linear world.

The cells are the product of controllers, links, disturbances and plants, in the order of the specification. A task
flies some runs of one cell and returns a row of figures for each, the same on every worker.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from itertools import product

import msgspec
import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from uavctl import __version__
from uavctl.arrays import Array, Flags
from uavctl.config import Config
from uavctl.config.checks import get_position_index
from uavctl.config.link import LinkConfig
from uavctl.errors import RAISED, DesignError, in_words
from uavctl.lab.campaign.controllers import (
    CellSetting,
    Recipe,
    draw_conditions,
    get_controller,
    make_filter_belief,
    make_recipe,
)
from uavctl.lab.campaign.pool import Columns, Work
from uavctl.lab.campaign.position_filter import PositionFilter
from uavctl.lab.campaign.results import SCHEMA, CellFigures, LinearCampaignRecord
from uavctl.lab.campaign.spec import CHUNK, Campaign
from uavctl.lab.campaign.verdicts import SMPC
from uavctl.lab.campaign.world import MeasuredPositions, Trajectories, simulate
from uavctl.lab.trial import NEAR_M, NEARER_M, compute_exact_usable_share, get_room_limits
from uavctl.smpc.batch import Tally
from uavctl.smpc.pid import PidGains
from uavctl.smpc.plant import AXES


@dataclass(frozen=True, eq=False)
class Cell:
    """One cell of a campaign: a controller in a setting."""

    index: int  # its number
    names: tuple[str, str, str, str]  # of controller, link, disturbance and plant
    kind: str  # kind of the controller
    setting: CellSetting  # plant, link and disturbance of its runs
    recipe: Recipe | None  # recipe of its controller; None if there is no such controller
    refused: str  # why not


def make_cells(campaign: Campaign) -> tuple[Cell, ...]:
    """Make every cell of a campaign, and each controller's recipe once."""
    recipes, spec = {key: _make_recipe(campaign, key) for key in campaign.believed_configs}, campaign.spec
    i, j, k, m = (range(len(entries)) for entries in (spec.controller, spec.link, spec.disturbance, spec.plant))
    return tuple(
        _make_cell(campaign, index, indices, recipes[indices[0], campaign.get_believed_link(*indices[:2])])
        for index, indices in enumerate(product(i, j, k, m))
    )


def _make_recipe(campaign: Campaign, key: tuple[int, str]) -> Recipe | str:
    """Return the recipe of a controller for the link that it believes in, or why there is none."""
    try:
        return make_recipe(campaign.get_tuned_controller(*key), campaign.believed_configs[key], campaign.spec)
    except DesignError as error:
        return str(error)


def _make_cell(campaign: Campaign, index: int, indices: tuple[int, int, int, int], recipe: Recipe | str) -> Cell:
    i, j, k, m = indices
    spec = campaign.spec
    controller, link, disturbance, plant = spec.controller[i], spec.link[j], spec.disturbance[k], spec.plant[m]
    setting = CellSetting(
        spec, campaign.base, campaign.flown_plants[m].plant, campaign.flown_links[j].link, disturbance
    )
    refusal = recipe if isinstance(recipe, str) else _find_refusal(setting)
    return Cell(
        index=index,
        names=(controller.name, link.name, disturbance.name, plant.name),
        kind=controller.kind,
        setting=setting,
        recipe=None if refusal or isinstance(recipe, str) else recipe,
        refused=refusal,
    )


def make_document(campaign: Campaign, cells: tuple[Cell, ...]) -> LinearCampaignRecord:
    """Return the content of `campaign.json`."""
    spec = campaign.spec
    return LinearCampaignRecord(
        name=spec.name,
        uavctl_version=__version__,
        master=spec.master,
        runs=spec.runs,
        steps=spec.steps,
        spec=msgspec.to_builtins(spec),
        configuration=campaign.configuration,
        cells=[describe_cell(cell) for cell in cells],
    )


def describe_cell(cell: Cell) -> CellFigures:
    """Return the record of a cell in `campaign.json`."""
    recipe, (controller, link, disturbance, plant) = cell.recipe, cell.names
    smpc = None if recipe is None or cell.kind != SMPC else recipe.config.smpc
    return CellFigures(
        index=cell.index,
        controller=controller,
        link=link,
        disturbance=disturbance,
        plant=plant,
        kind=cell.kind,
        design_id=recipe.design.design_id if recipe and recipe.design else None,
        promised_x=None if smpc is None else 1.0 - smpc.delta_x,
        promised_u=None if smpc is None or smpc.delta_u is None else 1.0 - smpc.delta_u,
        gains=_list_gains(recipe.gains) if recipe and recipe.gains else None,
        link_loss=_get_plain_loss(cell.setting.link),
        usable_room=None if smpc is None or recipe is None else _get_usable_share(recipe),
        refused=cell.refused,
    )


def _list_gains(gains: PidGains) -> dict[str, list[float]]:
    return {field.name: getattr(gains, field.name).tolist() for field in fields(gains)}


def _get_usable_share(recipe: Recipe) -> float | None:
    """Return the share of the room in which a plan may rest; None where a wall is open, or there is no such place."""
    try:
        share = compute_exact_usable_share(recipe.config, recipe.design)
    except DesignError:
        return None
    return share if math.isfinite(share) else None


def _get_plain_loss(link: LinkConfig) -> float | None:
    """Return the loss of a link with independent losses and nothing else; None of any other link."""
    plain = LinkConfig(loss=link.loss)
    return link.loss if link == plain else None


def _find_refusal(setting: CellSetting) -> str:
    """Return why a setting cannot be flown; empty if it can."""
    try:
        draw_conditions(setting, 0, 1)
    except DesignError as error:
        return str(error)
    return ""


def compute_path_figures(config: Config, states: Array) -> dict[str, Array]:
    """Return figures (N,) of runs by column of the results: path to the target, hold, and distance to walls.

    A plant without axes has no such figures.

    `near_s` and `nearer_s` are the first times so near to the target, infinite if there is none. `hold_rms_m` is of the
    second half of a run. `beyond_m` is the largest distance beyond a wall; negative is the distance to the nearest.

    Args:
        config: The configuration by which runs are judged: room, target, Δt.
        states: (N, T+1, n_x).
    """
    plant, index = config.plant, list(get_position_index(config.plant))
    if not index:
        return {}
    axes = [AXES.index(axis) for axis in plant.axes]
    positions_m = states[:, :, index]
    distances_m = np.linalg.norm(positions_m - np.array(config.target.position_m)[axes], axis=2)
    lower, upper = (corner[axes] for corner in get_room_limits(config))
    beyond_m = np.maximum(lower - positions_m, positions_m - upper).max(axis=(1, 2))
    return {
        "near_s": _find_first_time_s(distances_m <= NEAR_M, plant.dt_s),
        "nearer_s": _find_first_time_s(distances_m <= NEARER_M, plant.dt_s),
        "hold_rms_m": np.sqrt(np.square(distances_m[:, distances_m.shape[1] // 2 :]).mean(axis=1)),
        "beyond_m": beyond_m,
    }


def _find_first_time_s(is_near: Flags, dt_s: float) -> Array:
    """Return the time of the first step (N,) that is true [s]; infinite where there is none."""
    return np.where(is_near.any(axis=1), is_near.argmax(axis=1) * dt_s, np.inf)


_TALLY_COLUMNS = ("decisions", "infeasible", "slack_used", "fallbacks")
_LIMIT_TOLERANCE = 1e-9


@dataclass(frozen=True, eq=False)
class Task(Work):
    """Task of a campaign: runs `first` … `first` + `runs` - 1 of a cell."""

    setting: CellSetting
    recipe: Recipe

    def fly(self) -> Columns:
        """Fly the runs at once; if that raises, one by one, and the rows of those that raise have the message.

        Returns:
            Columns as in the results, each with a row a run; `ages` and `outside` are (runs, steps).
        """
        try:
            get_controller(self.recipe)
        except RAISED as error:  # a crashed run is reported and stops nothing
            return self.make_lost_rows(in_words(error))
        try:
            return _compute_figures(self, self.first, self.runs)
        except RAISED:  # as above
            rows = [_fly_single_run(self, self.first + i) for i in range(self.runs)]
            return {name: np.concatenate([row[name] for row in rows]) for name in rows[0]}

    def make_lost_rows(self, error: str) -> Columns:
        """See `Work`."""
        return _make_empty_columns(self, self.first, self.runs, error)


def make_tasks(cells: Sequence[Cell]) -> Iterator[Task]:
    """Return all tasks of a campaign, in order."""
    for cell in cells:
        if cell.recipe is not None:
            runs = cell.setting.spec.runs
            for first in range(0, runs, CHUNK):
                yield Task(cell.index, first, min(CHUNK, runs - first), cell.setting, cell.recipe)


def fly_task(task: Task, first: int, runs: int) -> tuple[Trajectories, Tally | None]:
    """Fly some runs; return their trajectories, and the solver's tally where the controller has one."""
    controller = get_controller(task.recipe)
    conditions = draw_conditions(task.setting, first, runs)
    measured = None
    if conditions.noise is not None:
        measured = MeasuredPositions(
            PositionFilter(make_filter_belief(task.recipe.config), conditions.known_steps), conditions.noise
        )
    with np.errstate(over="ignore", invalid="ignore"):  # results that are not finite count as failed
        trajectories = simulate(
            conditions.world, controller, conditions.newest_captures, conditions.disturbances, measured
        )
    tally = getattr(controller, "tally", None)
    return trajectories, tally if isinstance(tally, Tally) else None


def _fly_single_run(task: Task, run: int) -> Columns:
    try:
        return _compute_figures(task, run, 1)
    except RAISED as error:  # as above
        return _make_empty_columns(task, run, 1, in_words(error))


def _make_empty_columns(task: Task, first: int, runs: int, error: str) -> Columns:
    columns: Columns = {name: _make_empty_column(name, runs, task.setting.spec.steps) for name in SCHEMA.names}
    numbers = np.arange(first, first + runs)
    return columns | {"cell": np.full(runs, task.cell), "run": numbers, "error": np.full(runs, error, dtype=object)}


def _make_empty_column(name: str, runs: int, steps: int) -> NDArray[np.generic]:
    """Return a column of the table before anything is known: histograms (runs, steps), else (runs,)."""
    column_type = SCHEMA.field(name).type
    if column_type == pa.float64():
        return np.full(runs, np.nan)
    return np.zeros((runs, steps) if column_type == pa.list_(pa.int64()) else runs, dtype=np.int64)


def _compute_figures(task: Task, first: int, runs: int) -> Columns:
    trajectories, tally = fly_task(task, first, runs)
    steps = trajectories.age.shape[1]
    columns = _make_empty_columns(task, first, runs, "")
    is_complete = ~trajectories.failed
    columns["error"][:] = trajectories.errors
    with np.errstate(over="ignore", invalid="ignore"):
        figures = {
            "cost": trajectories.cost.sum(axis=1),
            "settled_cost": trajectories.cost[:, steps // 2 :].mean(axis=1),
            "mean_square_input": np.square(trajectories.inputs).sum(axis=2).mean(axis=1),
            "steps": np.full(runs, steps),
            "state_violations": trajectories.state_violated.sum(axis=1),
            "input_violations": trajectories.input_violated.sum(axis=1),
            "saturated": _is_at_limit(task, trajectories).sum(axis=1),
            "max_age": trajectories.age.max(axis=1),
            "age_sum": trajectories.age.sum(axis=1),
            "outside": trajectories.state_violated,
            "ages": np.stack([np.bincount(row, minlength=steps) for row in trajectories.age]),
            **compute_path_figures(task.setting.base, trajectories.states),
        }
    if tally is not None:
        for name in _TALLY_COLUMNS:
            figures[name] = getattr(tally, name)
        figures["largest_gap"] = np.where(tally.decisions > tally.infeasible, tally.largest_gap, np.nan)
    for name, values in figures.items():
        columns[name][is_complete] = values[is_complete]
    return columns


def _is_at_limit(task: Task, trajectories: Trajectories) -> Flags:
    """Return the steps in which an input acted at its limit (N, T)."""
    sets = task.setting.base.sets
    low, high = np.array(sets.input_lower), np.array(sets.input_upper)
    tolerance = np.where(np.isfinite(high - low), _LIMIT_TOLERANCE * (high - low), 0.0)
    return np.asarray(
        ((trajectories.inputs <= low + tolerance) | (trajectories.inputs >= high - tolerance)).any(axis=2),
        dtype=np.bool_,
    )
