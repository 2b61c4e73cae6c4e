"""Configuration and controller of a what-if: those of the recording, with a change."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from msgspec.structs import replace

from uavctl.arrays import Array
from uavctl.cli.common import locate_design_errors
from uavctl.config import Config, LoadedConfig, load
from uavctl.config.checks import get_dimensions
from uavctl.config.load import parse_recorded
from uavctl.config.types import PlantConfig, TargetConfig
from uavctl.errors import UsageError
from uavctl.lab.campaign.controllers import BaselineSolver, build_from_recipe, make_recipe
from uavctl.lab.campaign.spec import CampaignSpec, ControllerSpec
from uavctl.smpc.batch import BatchController
from uavctl.smpc.nominal import ControlProblem
from uavctl.smpc.plant import AXES
from uavctl.wiring.controller import Prepared, build_flight_design, build_problem, prepare

# Sections that made the recorded bytes, and those that read them.
RECORDED_KEYS = ("sim", "daemon", "frame", "clock", "hand_over", "relay", "security", "log", "check", "duration_s")


_RATE = "source.rate_hz"


def change_config(
    before: Config, toml: str, flight: Path, config: str | None, overrides: Sequence[str]
) -> LoadedConfig:
    """Return the configuration that flies: the recording's or another one, with the recorded sections kept.

    Args:
        overrides: `key=value` each.

    Raises:
        ConfigError: It is not valid.
        UsageError: It changes a recorded section, or has a plant of another kind.
    """
    for text in overrides:
        key = text.partition("=")[0].strip()
        if key.split(".")[0] in RECORDED_KEYS or (key.startswith("source.") and key != _RATE):
            raise UsageError(
                f"--set {text}: {key} is part of the recording and cannot be changed; a what-if may "
                "change the controller, its model (plant, sets, cost, smpc, schedule, ...) and link.*"
            )
    name = f"{flight} (configuration)"
    loaded = parse_recorded(toml, name, overrides) if config is None else load(config, overrides)
    changed_base = loaded.config
    source = replace(before.source, rate_hz=changed_base.source.rate_hz)
    surroundings = {section: getattr(before, section) for section in RECORDED_KEYS}
    changed = replace(changed_base, name=f"{before.name}-whatif", source=source, **surroundings)
    check_plant(changed.plant, before.plant, "plant" if config is None else f"{config}: plant")
    return dataclasses.replace(loaded, config=changed)


def check_plant(plant: PlantConfig, recorded: PlantConfig, label: str) -> None:
    """Refuse a plant whose state differs in kind from that of the recording.

    Raises:
        UsageError: It differs in kind.
    """
    shapes = [
        (*get_dimensions(plant_config), plant_config.axes, plant_config.dt_s) for plant_config in (plant, recorded)
    ]
    if shapes[0] != shapes[1]:
        kinds = [
            f"{n_x} states, {n_u} inputs, axes {', '.join(axes)} and steps of {dt_s:g} s"
            for n_x, n_u, axes, dt_s in shapes
        ]
        raise UsageError(f"{label} has {kinds[0]}, the recorded flight {kinds[1]}; give one of the same kind")


def choose_plant(path: Path | None, before: Config) -> tuple[PlantConfig, str]:
    """Return the plant that responds to other setpoints, and its name.

    Raises:
        ConfigError: The file is not a configuration.
        UsageError: Its plant differs in kind from the recorded one.
    """
    if path is None:
        return before.plant, "the recording's [plant]"
    plant = load(str(path)).config.plant
    check_plant(plant, before.plant, f"--model {path}: plant")
    return plant, f"[plant] of {path}"


def make_baseline_controller(loaded: LoadedConfig, kind: str, start: Array) -> Prepared:
    """Make a controller with a baseline in the place of the solver.

    Args:
        start: State (n_x,) that a PID is tuned from.

    Raises:
        ConfigError: There is no such controller for this plant.
        UsageError: The mission follows a trajectory, which no baseline does.
    """
    if loaded.config.mission.trajectory.times_s:
        raise UsageError(f"--controller {kind}: follows no trajectory; fly a recording of waypoints, or smpc")
    # The baseline makes its own plans: the design only gives names and limits of the mission.
    config = replace(loaded.config, solver=replace(loaded.config.solver, method="exact"))
    spec = ControllerSpec(name=kind, kind=kind)
    campaign = CampaignSpec(name="what-if", config=config.name, controller=(spec,), start=tuple(start.tolist()))
    with locate_design_errors(loaded):
        prepared = prepare(config, build_flight_design(config))
        recipe = make_recipe(spec, config, campaign)

    def make(target: Array) -> tuple[ControlProblem, BatchController]:
        target_config = replace(
            config, target=TargetConfig(position_m=_get_position_m(config.plant.axes, prepared, target))
        )
        return build_problem(target_config), build_from_recipe(dataclasses.replace(recipe, config=target_config))

    controller = dataclasses.replace(prepared.controller, solver=BaselineSolver(kind, make))
    return dataclasses.replace(prepared, controller=controller)


def _get_position_m(axes: Sequence[str], prepared: Prepared, target: Array) -> tuple[float, float, float]:
    """Return the position of a target state, local NED [m]."""
    position_m = [0.0, 0.0, 0.0]
    for axis, index in zip(axes, prepared.controller.plant.position_index, strict=True):
        position_m[AXES.index(axis)] = float(target[index])
    return position_m[0], position_m[1], position_m[2]
