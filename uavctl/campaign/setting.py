"""What a cell's runs meet, whoever flies them: plant, limits, costs, start, link, disturbance."""

from __future__ import annotations

from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

from uavctl.build import build_plant, start_state
from uavctl.campaign.chance import draw
from uavctl.campaign.disturbances import disturbances
from uavctl.campaign.links import newest
from uavctl.campaign.spec import CampaignSpec, DisturbanceSpec
from uavctl.campaign.world import Scene
from uavctl.config import Config
from uavctl.config.link import LinkConfig
from uavctl.config.types import PlantConfig
from uavctl.smpc.baselines import Problem
from uavctl.smpc.batch import Counts
from uavctl.smpc.equilibria import equilibria
from uavctl.smpc.sets import Polytope

Array = NDArray[np.float64]

_START = 2  # child of a run's seed that draws its start; 0 and 1 are those of `chance.draw`


@dataclass(frozen=True, eq=False)
class Setting:
    """A cell without its controller.

    Attributes:
        spec: The campaign's specification: steps, seed, start.
        base: The base configuration, which every cell is judged by.
        plant: The plant that flies.
        link: The link that it flies on.
        disturbance: The disturbance.
    """

    spec: CampaignSpec
    base: Config
    plant: PlantConfig
    link: LinkConfig
    disturbance: DisturbanceSpec


@dataclass(frozen=True, eq=False)
class Met:
    """What N runs of T steps meet.

    Attributes:
        scene: The scene.
        newest: Capture step of the newest position known in each step (N, T).
        disturbances: w (N, T, n_w).
    """

    scene: Scene
    newest: Counts
    disturbances: Array


def met(setting: Setting, first: int, runs: int) -> Met:
    """What the runs `first` … `first` + `runs` - 1 meet.

    Raises:
        DesignError: The plant that flies is none.
    """
    spec, flown = setting.spec, msgspec.structs.replace(setting.base, plant=setting.plant)
    plant, judged = build_plant(flown), problem_of(setting.base)
    chances = draw(spec.master, first, runs, spec.steps, plant.n_w)
    scene = Scene(
        plant=plant,
        state_set=judged.state_set,
        input_set=judged.input_set,
        q_x=judged.q_x,
        q_u=judged.q_u,
        target=judged.target,
        u_target=judged.u_target,
        start=_starts(setting, first, runs),
    )
    return Met(
        scene,
        newest(setting.link, plant.dt_s, chances.link),
        disturbances(setting.disturbance, plant.w, chances.normal),
    )


def problem_of(config: Config) -> Problem:
    """The control problem of a configuration, as baselines are given it.

    Raises:
        DesignError: The plant is none, or cannot rest at the target.
    """
    plant, sets = build_plant(config), config.sets
    q_x, q_u = np.diag(config.cost.state), np.diag(config.cost.input)
    rests = equilibria(plant.a, plant.b, q_x, q_u, np.array(plant.position_index, dtype=np.intp))
    target = plant.equilibrium(config.target.position_m)
    return Problem(
        plant=plant,
        state_set=Polytope.from_box(sets.state_lower, sets.state_upper),
        input_set=Polytope.from_box(sets.input_lower, sets.input_upper),
        q_x=q_x,
        q_u=q_u,
        target=target,
        u_target=rests.u_eq @ target[rests.held],
        horizon=config.smpc.horizon,
        slack_linear=config.smpc.slack_linear,
        slack_quadratic=config.smpc.slack_quadratic,
    )


def start_of(spec: CampaignSpec, base: Config) -> Array:
    """The state in which runs start (n_x,); with a box, its middle."""
    if spec.start:
        return np.array(spec.start, dtype=np.float64)
    if spec.start_box:
        middle: Array = np.array(spec.start_box, dtype=np.float64).mean(axis=0)
        return middle
    return start_state(base, build_plant(base))


def _starts(setting: Setting, first: int, runs: int) -> Array:
    """x(0) of every run (N, n_x)."""
    spec = setting.spec
    if not spec.start_box:
        return np.tile(start_of(spec, setting.base), (runs, 1))
    lower, upper = np.array(spec.start_box, dtype=np.float64)
    draws = np.empty((runs, lower.size))
    for i in range(runs):
        seed = np.random.SeedSequence([spec.master, first + i]).spawn(_START + 1)[_START]
        np.random.default_rng(seed).random(out=draws[i])
    return np.asarray(lower + (upper - lower) * draws, dtype=np.float64)
