"""How runs of the linear world went through the room: to the target, at it, and how near to the walls."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from uavctl.config import Config
from uavctl.trial.fly import NEAR_M, NEARER_M
from uavctl.trial.room import room_of

Array = NDArray[np.float64]

_AXES = ("north", "east", "down")


def ways(config: Config, states: Array) -> dict[str, Array]:
    """Figures (N,) of runs, by column of the results.

    `near_s` and `nearer_s` are when the target was first that near, infinite if it never was; `hold_rms_m` is of the
    second half of a run; `beyond_m` is the furthest beyond a wall, negative for the room that was left.

    Args:
        config: The configuration by which runs are judged: room, target, Δt.
        states: (N, T+1, n_x).
    """
    plant = config.plant
    index = list(plant.position_index or (3 * i for i in range(len(plant.axes))))
    axes = [_AXES.index(axis) for axis in plant.axes]
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
    """Time of the first step (N,) in which it was so; infinite where it never was."""
    return np.where(near.any(axis=1), near.argmax(axis=1) * dt_s, np.inf)
