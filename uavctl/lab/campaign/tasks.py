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
from numpy.typing import NDArray

from uavctl import __version__
from uavctl.arrays import Array
from uavctl.config import Config
from uavctl.config.checks import get_position_index
from uavctl.config.link import LinkConfig
from uavctl.errors import RAISED, DesignError, in_words
from uavctl.lab.campaign.controllers import Recipe, Setting, built, met, recipe_for, sight_of
from uavctl.lab.campaign.pool import Columns, Work
from uavctl.lab.campaign.results import SMPC
from uavctl.lab.campaign.spec import CHUNK, Campaign
from uavctl.lab.campaign.world import Flown, MeasuredPositions, PositionFilter, fly
from uavctl.lab.trial import NEAR_M, NEARER_M, room_of, usable_seen
from uavctl.smpc.batch import Tally
from uavctl.smpc.plant import AXES

VERSION = 1


@dataclass(frozen=True, eq=False)
class Cell:
    """One cell of a campaign: a controller in a setting."""

    index: int  # its number
    names: tuple[str, str, str, str]  # of controller, link, disturbance and plant
    kind: str  # kind of the controller
    setting: Setting  # plant, link and disturbance of its runs
    recipe: Recipe | None  # recipe of its controller; None if there is no such controller
    refused: str  # why not


def cells_of(campaign: Campaign) -> tuple[Cell, ...]:
    """Make every cell of a campaign, and each controller's recipe once."""
    recipes, spec = {key: _recipe(campaign, key) for key in campaign.believed}, campaign.spec
    i, j, k, m = (range(len(one)) for one in (spec.controller, spec.link, spec.disturbance, spec.plant))
    return tuple(
        _cell(campaign, index, which, recipes[which[0], campaign.believed_link(*which[:2])])
        for index, which in enumerate(product(i, j, k, m))
    )


def _recipe(campaign: Campaign, key: tuple[int, str]) -> Recipe | str:
    """Return the recipe of a controller for the link that it believes in, or why there is none."""
    try:
        return recipe_for(campaign.tuned(*key), campaign.believed[key], campaign.spec)
    except DesignError as error:
        return str(error)


def _cell(campaign: Campaign, index: int, which: tuple[int, int, int, int], recipe: Recipe | str) -> Cell:
    i, j, k, m = which
    spec = campaign.spec
    controller, link, disturbance, plant = spec.controller[i], spec.link[j], spec.disturbance[k], spec.plant[m]
    setting = Setting(spec, campaign.base, campaign.flown_plant[m].plant, campaign.flown_link[j].link, disturbance)
    refused = recipe if isinstance(recipe, str) else _refused(setting)
    return Cell(
        index=index,
        names=(controller.name, link.name, disturbance.name, plant.name),
        kind=controller.kind,
        setting=setting,
        recipe=None if refused or isinstance(recipe, str) else recipe,
        refused=refused,
    )


def document(campaign: Campaign, cells: tuple[Cell, ...]) -> dict[str, object]:
    """Return the content of `campaign.json`."""
    spec = campaign.spec
    return {
        "version": VERSION,
        "name": spec.name,
        "uavctl_version": __version__,
        "master": spec.master,
        "runs": spec.runs,
        "steps": spec.steps,
        "spec": msgspec.to_builtins(spec),
        "configuration": campaign.configuration,
        "cells": [told(cell) for cell in cells],
    }


def told(cell: Cell) -> dict[str, object]:
    """Return what `campaign.json` holds of a cell."""
    recipe, (controller, link, disturbance, plant) = cell.recipe, cell.names
    design, gains = (None, None) if recipe is None else (recipe.design, recipe.gains)
    smpc = None if recipe is None or cell.kind != SMPC else recipe.config.smpc
    delta_u = None if smpc is None else smpc.delta_u
    return {
        "index": cell.index,
        "controller": controller,
        "link": link,
        "disturbance": disturbance,
        "plant": plant,
        "kind": cell.kind,
        "design_id": None if design is None else design.design_id,
        "promised_x": None if smpc is None else 1.0 - smpc.delta_x,
        "promised_u": None if delta_u is None else 1.0 - delta_u,
        "gains": None if gains is None else {one.name: getattr(gains, one.name).tolist() for one in fields(gains)},
        "link_loss": _plain_loss(cell.setting.link),
        "usable_room": None if smpc is None or recipe is None else _usable(recipe),
        "refused": cell.refused,
    }


def _usable(recipe: Recipe) -> float | None:
    """Return the share of the room in which a plan may rest; None where a wall is open, or there is no such place."""
    try:
        share = usable_seen(recipe.config, recipe.design)
    except DesignError:
        return None
    return share if math.isfinite(share) else None


def _plain_loss(link: LinkConfig) -> float | None:
    """Return the loss of a link with independent losses and nothing else; None of any other link."""
    plain = LinkConfig(loss=link.loss)
    return link.loss if link == plain else None


def _refused(setting: Setting) -> str:
    """Return why nothing can fly in a setting; empty if it can."""
    try:
        met(setting, 0, 1)
    except DesignError as error:
        return str(error)
    return ""


def ways(config: Config, states: Array) -> dict[str, Array]:
    """Return figures (N,) of runs by column of the results: way to the target, hold, and distance to walls.

    A plant without axes has none of them.

    `near_s` and `nearer_s` are when the target was first that near, infinite if it never was; `hold_rms_m` is of the
    second half of a run; `beyond_m` is the furthest beyond a wall, negative for the room that was left.

    Args:
        config: The configuration by which runs are judged: room, target, Δt.
        states: (N, T+1, n_x).
    """
    plant, index = config.plant, list(get_position_index(config.plant))
    if not index:
        return {}
    axes = [AXES.index(axis) for axis in plant.axes]
    where = states[:, :, index]
    off = np.linalg.norm(where - np.array(config.target.position_m)[axes], axis=2)
    lower, upper = (side[axes] for side in room_of(config))
    beyond = np.maximum(lower - where, where - upper).max(axis=(1, 2))
    return {
        "near_s": _first_s(off <= NEAR_M, plant.dt_s),
        "nearer_s": _first_s(off <= NEARER_M, plant.dt_s),
        "hold_rms_m": np.sqrt(np.square(off[:, off.shape[1] // 2 :]).mean(axis=1)),
        "beyond_m": beyond,
    }


def _first_s(near: NDArray[np.bool_], dt_s: float) -> Array:
    """Return the time of the first step (N,) that is true [s]; infinite where there is none."""
    return np.where(near.any(axis=1), near.argmax(axis=1) * dt_s, np.inf)


_MET = ("decisions", "infeasible", "slack_used", "fallbacks")
_WHOLE = ("steps", "state_violations", "input_violations", "saturated", "max_age", *_MET)
_WAYS = ("near_s", "nearer_s", "hold_rms_m", "beyond_m")
_REAL = ("cost", "settled_cost", "mean_square_input", "largest_gap", *_WAYS)
_AT_LIMIT = 1e-9


@dataclass(frozen=True, eq=False)
class Task(Work):
    """Task of a campaign: runs `first` … `first` + `runs` - 1 of a cell."""

    setting: Setting
    recipe: Recipe

    def fly(self) -> Columns:
        """Fly the runs at once; if that raises, one by one, and those that raise have its message.

        Returns:
            Columns as in the results, each with a row a run; `ages` and `outside` are (runs, steps).
        """
        try:
            built(self.recipe)
        except RAISED as error:  # a crashed run is reported and stops nothing
            return self.lost(in_words(error))
        try:
            return _figures(self, self.first, self.runs)
        except RAISED:  # as above
            rows = [_alone(self, self.first + i) for i in range(self.runs)]
            return {name: np.concatenate([row[name] for row in rows]) for name in rows[0]}

    def lost(self, error: str) -> Columns:
        """See `Work`."""
        return _without_figures(self, self.first, self.runs, error)


def tasks_of(cells: Sequence[Cell]) -> Iterator[Task]:
    """Return all tasks of a campaign, in order."""
    for cell in cells:
        if cell.recipe is not None:
            runs = cell.setting.spec.runs
            for first in range(0, runs, CHUNK):
                yield Task(cell.index, first, min(CHUNK, runs - first), cell.setting, cell.recipe)


def flown(task: Task, first: int, runs: int) -> tuple[Flown, Tally | None]:
    """Fly some runs; return their trajectories, and the solver's tally where the controller has one."""
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
    except RAISED as error:  # as above
        return _without_figures(task, run, 1, in_words(error))


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
    """Return the steps in which an input acted at its limit (N, T)."""
    sets = task.setting.base.sets
    low, high = np.array(sets.input_lower), np.array(sets.input_upper)
    near = np.where(np.isfinite(high - low), _AT_LIMIT * (high - low), 0.0)
    return np.asarray(((found.inputs <= low + near) | (found.inputs >= high - near)).any(axis=2), dtype=np.bool_)
