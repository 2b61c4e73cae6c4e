"""What a cell's runs meet, whoever flies them: plant, limits, costs, start, link, disturbance."""

from __future__ import annotations

from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

from uavctl.build import build_plant, build_problem, start_state
from uavctl.campaign.chance import draw, draw_noise
from uavctl.campaign.disturbances import disturbances
from uavctl.campaign.links import known, newest_of
from uavctl.campaign.spec import CampaignSpec, DisturbanceSpec
from uavctl.campaign.world import Scene
from uavctl.config import Config
from uavctl.config.link import LinkConfig
from uavctl.config.types import PlantConfig
from uavctl.smpc.batch import Counts

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
        known: Step that knows the position of each step first (N, T).
        noise: Noise of the positions (N, T, n_axes) [m]; None where the state is measured.
    """

    scene: Scene
    newest: Counts
    disturbances: Array
    known: Counts
    noise: Array | None


def met(setting: Setting, first: int, runs: int) -> Met:
    """What the runs `first` … `first` + `runs` - 1 meet.

    Raises:
        DesignError: The plant that flies is none.
    """
    spec, flown = setting.spec, msgspec.structs.replace(setting.base, plant=setting.plant)
    plant, judged = build_plant(flown), build_problem(setting.base)
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
    first_known = known(setting.link, plant.dt_s, chances.link)
    noise = None
    if spec.measured == "position":
        std_m = setting.base.sim.camera.noise_std_m
        noise = std_m * draw_noise(spec.master, first, runs, spec.steps, len(plant.axes))
    return Met(
        scene,
        newest_of(first_known),
        disturbances(setting.disturbance, plant.w, chances.normal),
        first_known,
        noise,
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
