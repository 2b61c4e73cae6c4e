"""The room of a configuration, and what of it a controller can use."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from uavctl.build import build_conditioned, build_plant, resting
from uavctl.build_mission import build_rests, resting_places
from uavctl.config import Config
from uavctl.smpc.conditioned_design import AnyDesign
from uavctl.smpc.design import Design

Array = NDArray[np.float64]

_AXES = ("north", "east", "down")


def room_of(config: Config) -> tuple[Array, Array]:
    """Least and largest position in the room (3,); infinite where there is no wall."""
    lower, upper = np.full(3, -np.inf), np.full(3, np.inf)
    index = config.plant.position_index or tuple(
        config.plant.states_per_axis * i for i in range(len(config.plant.axes))
    )
    for axis, place in zip(config.plant.axes, index, strict=True):
        lower[_AXES.index(axis)] = config.sets.state_lower[place]
        upper[_AXES.index(axis)] = config.sets.state_upper[place]
    return lower, upper


def usable_room(config: Config, design: AnyDesign) -> float:
    """Share of the room in which a plan may rest, with what the estimator does not see; NaN where a wall is open.

    Raises:
        DesignError: There is no such scheme.
    """
    return _share(config, *resting_places(design.plant, design.state_set, resting(design)))


def usable_seen(config: Config, design: Design | None) -> float:
    """The same for a controller that is told the exact state, as in the linear world.

    Raises:
        DesignError: There is no such scheme.
    """
    if design is not None:
        return _share(config, *resting_places(design.plant, design.state_set, build_rests(design)))
    n_x = build_plant(config).n_x
    exact = build_conditioned(config, flown=False, cov=np.zeros((n_x, n_x)))
    return _share(config, *resting_places(exact.plant, exact.state_set, exact.rests))


def _share(config: Config, least: Array, most: Array) -> float:
    axes = [_AXES.index(axis) for axis in config.plant.axes]
    lower, upper = room_of(config)
    whole = (upper - lower)[axes]
    return float(np.prod(np.clip(most - least, 0.0, None) / whole)) if np.isfinite(whole).all() else math.nan
