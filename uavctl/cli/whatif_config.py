"""What flies in a what-if: the recorded configuration with what was changed, and its controller."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from uavctl.build import build_problem, design_of
from uavctl.campaign.controllers import build, recipe_for
from uavctl.campaign.spec import CampaignSpec, ControllerSpec, Kind
from uavctl.cli.common import located
from uavctl.cli.prepare import Prepared, prepare, ready_library
from uavctl.config import Config, Loaded, load
from uavctl.config.checks import dimensions
from uavctl.config.load import parse
from uavctl.config.types import PlantConfig, TargetConfig
from uavctl.errors import UsageError
from uavctl.smpc.baselines import Problem
from uavctl.smpc.batch import BatchController
from uavctl.smpc.plant import AXES
from uavctl.whatif.baseline import BaselineSolver

Array = NDArray[np.float64]
# What the recorded bytes were made with, and how they are read.
RECORDED = ("sim", "daemon", "frame", "clock", "hand_over", "relay", "security", "log", "check", "duration_s")
_RATE = "source.rate_hz"


def changed(before: Config, toml: str, flight: Path, config: str | None, overrides: Sequence[str]) -> Loaded:
    """The configuration that flies: the recording's, or another one in the recorded surroundings.

    Args:
        before: The recorded configuration.
        toml: Its text.
        flight: The recording.
        config: Preset or file in its place.
        overrides: `key=value` each.

    Raises:
        ConfigError: It is none.
        UsageError: A change of what is recorded, or a plant of another kind.
    """
    for text in overrides:
        key = text.partition("=")[0].strip()
        if key.split(".")[0] in RECORDED or (key.startswith("source.") and key != _RATE):
            raise UsageError(
                f"--set {text}: {key} is part of what was recorded and cannot be another one now; what can be changed "
                "is the controller, its beliefs (plant, sets, cost, smpc, schedule, ...) and link.*"
            )
    name = f"{flight} (configuration)"
    loaded = parse(toml, name, overrides) if config is None else load(config, overrides)
    given = loaded.config
    source = replace(before.source, rate_hz=given.source.rate_hz)
    surroundings = {section: getattr(before, section) for section in RECORDED}
    flies = replace(given, name=f"{before.name}-whatif", source=source, **surroundings)
    check_plant(flies.plant, before.plant, "plant" if config is None else f"{config}: plant")
    return dataclasses.replace(loaded, config=flies)


def check_plant(plant: PlantConfig, recorded: PlantConfig, what: str) -> None:
    """Refuse a plant whose state is not that of the recording.

    Raises:
        UsageError: It is another one.
    """
    shapes = [(*dimensions(one), one.axes, one.dt_s) for one in (plant, recorded)]
    if shapes[0] != shapes[1]:
        told = [
            f"{n_x} states, {n_u} inputs, axes {', '.join(axes)} and steps of {dt_s:g} s"
            for n_x, n_u, axes, dt_s in shapes
        ]
        raise UsageError(f"{what} has {told[0]}, the recorded flight {told[1]}; give one of the same kind")


def plant_of(path: Path | None, before: Config) -> tuple[PlantConfig, str]:
    """The plant that answers to other setpoints, and what it is called.

    Raises:
        ConfigError: The file is no configuration.
        UsageError: It is of another kind than the recorded plant.
    """
    if path is None:
        return before.plant, "the recording's [plant]"
    plant = load(str(path)).config.plant
    check_plant(plant, before.plant, f"--model {path}: plant")
    return plant, f"[plant] of {path}"


def baseline_flyer(loaded: Loaded, kind: Kind, start: Array) -> Prepared:
    """A baseline in the place of the solver.

    Args:
        loaded: The configuration.
        kind: Which one.
        start: State (n_x,) that a PID is tuned from.

    Raises:
        ConfigError: There is no such controller for this plant.
        UsageError: The mission follows a trajectory, which no baseline does.
    """
    if loaded.config.mission.trajectory.times_s:
        raise UsageError(f"--controller {kind}: follows no trajectory; fly a recording of waypoints, or smpc")
    # Its plans are its own: the design is for the mission's names and limits, and needs no policy library.
    config = replace(loaded.config, solver=replace(loaded.config.solver, method="exact"))
    spec = ControllerSpec(name=kind, kind=kind)
    campaign = CampaignSpec(name="what-if", config=config.name, controller=(spec,), start=tuple(start.tolist()))
    with located(loaded):
        prepared = prepare(config, design_of(config))
        recipe = recipe_for(spec, config, campaign, ready_library)

    def make(target: Array) -> tuple[Problem, BatchController]:
        there = replace(config, target=TargetConfig(position_m=_place(config.plant.axes, prepared, target)))
        return build_problem(there), build(dataclasses.replace(recipe, config=there))

    controller = dataclasses.replace(prepared.controller, solver=BaselineSolver(kind, make))
    return dataclasses.replace(prepared, controller=controller)


def _place(axes: Sequence[str], prepared: Prepared, target: Array) -> tuple[float, float, float]:
    """Position of a target state, in local NED [m]."""
    place = [0.0, 0.0, 0.0]
    for axis, index in zip(axes, prepared.controller.plant.position_index, strict=True):
        place[AXES.index(axis)] = float(target[index])
    return place[0], place[1], place[2]
