"""Composition of the target: the state in which a plant is to rest, and the input that holds it."""

from __future__ import annotations

import numpy as np

from uavctl.arrays import Array
from uavctl.config.types import Config, CostConfig, SetsConfig
from uavctl.errors import DesignError
from uavctl.smpc.plant import Plant
from uavctl.smpc.sets import find_equilibria

_ROUNDING = 1e-9


def check_axes(config: Config) -> None:
    """Check that the configuration names the positions and velocities of a plant, as a flight needs.

    Raises:
        DesignError: It does not.
    """
    if not config.plant.axes:
        raise DesignError(
            "plant.axes",
            "is missing: a flight and its simulated vehicle, a cascade and a filter of positions have to know which "
            "states are positions and velocities",
            "add it with position_index, velocity_index and accel_per_input; `uavctl solve`, `design`, `campaign` and "
            "uavctl.simulate go without",
        )


def build_state_bounds(sets: SetsConfig, plant: Plant) -> tuple[Array, Array]:
    """Return the least and the largest state (n_x,); gusts have no limits."""
    free = np.full(len(plant.gust_mps2), np.inf)
    return np.append(sets.state_lower, -free), np.append(sets.state_upper, free)


def build_weights(cost: CostConfig, plant: Plant) -> tuple[Array, Array]:
    """Return Q_x (n_x, n_x), zero for gusts, and Q_u (n_u, n_u)."""
    return np.diag([*cost.state, *(0.0 for _ in plant.gust_mps2)]), np.diag(cost.input)


def pad_state(state: Array, plant: Plant) -> Array:
    """Return states (…, n_x) with gusts; states that are given without them have none."""
    missing = plant.n_x - state.shape[-1]
    if not missing or missing != len(plant.gust_mps2):
        return state
    return np.concatenate([state, np.zeros((*state.shape[:-1], missing))], axis=-1)


def compute_target_equilibrium(config: Config, plant: Plant) -> tuple[Array, Array]:
    """Return the target state (n_x,), and the input (n_u,) within its limits that holds it.

    The target of a plant without axes is its origin, or the middle of the limits if the origin is outside.

    Raises:
        DesignError: The plant cannot rest there, or nowhere within its limits.
    """
    sets = config.sets
    rest_set = find_equilibria(
        plant.a, plant.b, *build_weights(config.cost, plant), np.array(plant.position_index, int)
    )
    state = plant.equilibrium(config.target.position_m)
    low_x, high_x = build_state_bounds(sets, plant)
    low_u, high_u = np.array(sets.input_lower), np.array(sets.input_upper)
    u = rest_set.u_eq @ state[rest_set.held]
    if not plant.axes and not (_is_within(state, low_x, high_x) and _is_within(u, low_u, high_u)):
        middle = _find_middle(
            np.vstack([rest_set.x_eq, rest_set.u_eq]), np.concatenate([low_x, low_u]), np.concatenate([high_x, high_u])
        )
        if middle is not None:
            state, u = rest_set.x_eq @ middle, rest_set.u_eq @ middle
    for i, held_input in enumerate(u.tolist()):
        if not _is_within(held_input, low_u[i], high_u[i]):
            raise DesignError(
                f"sets.input_{'lower' if held_input < low_u[i] else 'upper'}[{i}]",
                f"the input that holds the target is {held_input:.3g}, and [{low_u[i]:g}, {high_u[i]:g}] leaves it out",
                "give limits that have it between them"
                if not rest_set.u_eq[i].any()
                else "give limits that have it between them, or another target",
            )
    if not _is_within(state, low_x, high_x):
        i = int(np.argmax(~((state >= low_x) & (state <= high_x))))
        raise DesignError(
            f"sets.state_lower[{i}]",
            f"no state within the limits is one that the plant can rest in (the nearest has state {i} at "
            f"{state[i]:.3g}, outside [{low_x[i]:g}, {high_x[i]:g}])",
            "give limits that have a state at rest between them",
        )
    return state, u


def _is_within(value: float | Array, low: Array, high: Array) -> bool:
    size = _ROUNDING * (1.0 + np.abs(value))
    return bool(np.all((value >= low - size) & (value <= high + size)))


def _find_middle(rows: Array, low: Array, high: Array) -> Array | None:
    """Return the y with the largest margin s: low + s (high - low) / 2 <= rows y <= high - s (high - low) / 2.

    An open side counts as one unit wide; None if no y is within all limits.
    """
    from scipy.optimize import linprog

    if not rows.shape[1]:
        return None
    half_widths = np.where(np.isfinite(high - low), (high - low) / 2.0, 1.0)
    c = np.vstack([np.column_stack([rows, half_widths]), np.column_stack([-rows, half_widths])])
    limits = np.concatenate([high, -low])
    is_finite = np.isfinite(limits)
    objective = np.append(np.zeros(rows.shape[1]), -1.0)
    result = linprog(objective, c[is_finite], limits[is_finite], bounds=[(None, None)] * rows.shape[1] + [(0.0, 1.0)])
    return None if result.status or result.x is None else np.asarray(result.x[:-1])
