"""Composition: where the plant of a configuration is to rest, with which input."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from uavctl.config.types import Config
from uavctl.errors import DesignError
from uavctl.smpc.plant import Plant
from uavctl.smpc.sets import find_equilibria

Array = NDArray[np.float64]

_ROUNDING = 1e-9


def check_axes(config: Config) -> None:
    """See that a plant's states are known to be positions and velocities, which a flight has to do with.

    Raises:
        DesignError: They are not.
    """
    if not config.plant.axes:
        raise DesignError(
            "plant.axes",
            "is missing: a flight and its simulated vehicle, a cascade and a filter of positions have to know which "
            "states are positions and velocities",
            "add it with position_index, velocity_index and accel_per_input; `uavctl solve`, `campaign` and "
            "uavctl.simulate go without",
        )


def resting_target(config: Config, plant: Plant) -> tuple[Array, Array]:
    """The state (n_x,) to go to, and the input (n_u,) that holds it, which is within its limits.

    A plant without axes goes to its origin, or where that is not within the limits, to the middle of what is.

    Raises:
        DesignError: The plant cannot rest there, or nowhere within its limits.
    """
    sets = config.sets
    rests = find_equilibria(
        plant.a, plant.b, np.diag(config.cost.state), np.diag(config.cost.input), np.array(plant.position_index, int)
    )
    state = plant.equilibrium(config.target.position_m)
    low_x, high_x, low_u, high_u = map(
        np.array, (sets.state_lower, sets.state_upper, sets.input_lower, sets.input_upper)
    )
    u = rests.u_eq @ state[rests.held]
    if not plant.axes and not (_within(state, low_x, high_x) and _within(u, low_u, high_u)):
        middle = _middle(
            np.vstack([rests.x_eq, rests.u_eq]), np.concatenate([low_x, low_u]), np.concatenate([high_x, high_u])
        )
        if middle is not None:
            state, u = rests.x_eq @ middle, rests.u_eq @ middle
    for i, held in enumerate(u.tolist()):
        if not _within(held, low_u[i], high_u[i]):
            raise DesignError(
                f"sets.input_{'lower' if held < low_u[i] else 'upper'}[{i}]",
                f"the input that holds the target is {held:.3g}, and [{low_u[i]:g}, {high_u[i]:g}] leaves it out",
                "give limits that have it between them"
                if not rests.u_eq[i].any()
                else "give limits that have it between them, or another target",
            )
    if not _within(state, low_x, high_x):
        i = int(np.argmax(~((state >= low_x) & (state <= high_x))))
        raise DesignError(
            f"sets.state_lower[{i}]",
            f"no state within the limits is one that the plant can rest in (the nearest has state {i} at "
            f"{state[i]:.3g}, outside [{low_x[i]:g}, {high_x[i]:g}])",
            "give limits that have a state at rest between them",
        )
    return state, u


def _within(value: float | Array, low: Array, high: Array) -> bool:
    size = _ROUNDING * (1.0 + np.abs(value))
    return bool(np.all((value >= low - size) & (value <= high + size)))


def _middle(rows: Array, low: Array, high: Array) -> Array | None:
    """The y with the largest least share s of the room that low + s (high - low) / 2 <= rows y <= … keep free.

    An open side counts as one unit wide; None if there is no y within all limits.
    """
    from scipy.optimize import linprog

    if not rows.shape[1]:
        return None
    room = np.where(np.isfinite(high - low), (high - low) / 2.0, 1.0)
    c = np.vstack([np.column_stack([rows, room]), np.column_stack([-rows, room])])
    sides = np.concatenate([high, -low])
    kept = np.isfinite(sides)
    aim = np.append(np.zeros(rows.shape[1]), -1.0)
    found = linprog(aim, c[kept], sides[kept], bounds=[(None, None)] * rows.shape[1] + [(0.0, 1.0)])
    return None if found.status or found.x is None else np.asarray(found.x[:-1])
