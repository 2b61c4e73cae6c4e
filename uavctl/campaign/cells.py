"""The cells of a campaign: the product of its controllers, links, disturbances and plants, in the order given."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from itertools import product

import msgspec

from uavctl import __version__
from uavctl.campaign.compose import Campaign
from uavctl.campaign.controllers import LibraryFor, Recipe, recipe_for
from uavctl.campaign.setting import Setting, met
from uavctl.campaign.verdict import SMPC
from uavctl.config.link import LinkConfig
from uavctl.errors import DesignError
from uavctl.smpc.baselines import PidGains
from uavctl.trial.room import usable_seen

VERSION = 1


@dataclass(frozen=True, eq=False)
class Cell:
    """One combination.

    Attributes:
        index: Its number.
        names: Of controller, link, disturbance and plant.
        kind: Kind of the controller.
        setting: What its runs meet.
        recipe: Who flies them; None if there is no such controller.
        refused: Why not.
    """

    index: int
    names: tuple[str, str, str, str]
    kind: str
    setting: Setting
    recipe: Recipe | None
    refused: str


def cells_of(campaign: Campaign, library_for: LibraryFor) -> tuple[Cell, ...]:
    """Make every cell, and each controller's recipe once.

    Args:
        campaign: The campaign.
        library_for: Gives the policy library of a design.
    """
    recipes = {key: _recipe(campaign, key, library_for) for key in campaign.believed}
    return tuple(
        _cell(campaign, index, which, recipes[which[0], campaign.believed_link(*which[:2])])
        for index, which in enumerate(_product(campaign))
    )


def cell_of(campaign: Campaign, index: int, library_for: LibraryFor) -> Cell:
    """One cell alone; see `cells_of`."""
    which = _product(campaign)[index]
    recipe = _recipe(campaign, (which[0], campaign.believed_link(*which[:2])), library_for)
    return _cell(campaign, index, which, recipe)


Which = tuple[int, int, int, int]  # indices of controller, link, disturbance and plant


def _product(campaign: Campaign) -> list[Which]:
    spec = campaign.spec
    lists = (spec.controller, spec.link, spec.disturbance, spec.plant)
    i, j, k, m = (range(len(one)) for one in lists)
    return list(product(i, j, k, m))


def _recipe(campaign: Campaign, key: tuple[int, str], library_for: LibraryFor) -> Recipe | str:
    """The recipe of a controller for the link that it believes in, or why there is none."""
    try:
        return recipe_for(campaign.tuned(*key), campaign.believed[key], campaign.spec, library_for)
    except DesignError as error:
        return str(error)


def _cell(campaign: Campaign, index: int, which: Which, recipe: Recipe | str) -> Cell:
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
    """What `campaign.json` holds: enough to fly every run again."""
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
    """What `campaign.json` holds of a cell."""
    recipe, (controller, link, disturbance, plant) = cell.recipe, cell.names
    design = None if recipe is None else recipe.design
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
        "library_id": None if recipe is None else recipe.library_id,
        "promised_x": None if smpc is None else 1.0 - smpc.delta_x,
        "promised_u": None if delta_u is None else 1.0 - delta_u,
        "gains": None if recipe is None or recipe.gains is None else _gains(recipe.gains),
        "link_loss": _plain_loss(cell.setting.link),
        "usable_room": None if smpc is None or recipe is None else _usable(recipe),
        "refused": cell.refused,
    }


def _usable(recipe: Recipe) -> float | None:
    """Share of the room in which a plan may rest; None where a wall is open, or the plant cannot rest anywhere."""
    try:
        share = usable_seen(recipe.config, recipe.design)
    except DesignError:
        return None
    return share if math.isfinite(share) else None


def _gains(gains: PidGains) -> dict[str, list[float]]:
    return {field.name: getattr(gains, field.name).tolist() for field in fields(gains)}


def _plain_loss(link: LinkConfig) -> float | None:
    """Loss of a link on which nothing else happens to a position than to be lost, each by itself."""
    plain = LinkConfig(loss=link.loss)
    return link.loss if link == plain else None


def _refused(setting: Setting) -> str:
    """Why nothing can fly there, if nothing can."""
    try:
        met(setting, 0, 1)
    except DesignError as error:
        return str(error)
    return ""
