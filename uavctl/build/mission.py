"""Composition: a configuration's mission becomes the flight's."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from uavctl.config.mission import FenceConfig, TrajectoryConfig
from uavctl.config.types import Config
from uavctl.errors import DesignError
from uavctl.flight.mission import Fence, Mission, Room, Trajectory, Waypoint, make_hold_mission
from uavctl.flight.trajectory import PlantMotion, follow_positions, make_room, plan_along
from uavctl.records import Names, names_of
from uavctl.smpc.conditioned.planner import AnyDesign
from uavctl.smpc.plant import Plant
from uavctl.smpc.sets import Polytope, find_equilibria

if TYPE_CHECKING:
    from uavctl.smpc.hahn_stursberg.design import Design


Array = NDArray[np.float64]

NANOSECONDS = 1e9
_ROUNDING = 1e-9


def build_mission(config: Config, design: AnyDesign, rests: Array) -> Mission:
    """Waypoints or trajectory, and fences; without any, `target.position_m` is held.

    Args:
        rests: Right sides (m_x,) of the state rows, less what a plan keeps from them that rests.

    Raises:
        DesignError: The plant cannot rest or move there, or a fence limits what has no limit.
    """
    given, plant = config.mission, design.plant
    mission = make_hold_mission(
        design.target,
        plant.position_index,
        design.state_set.b,
        horizon=design.horizon,
        dt_ns=round(plant.dt_s * NANOSECONDS),
        room=_resting(design, rests),
    )
    if given.waypoints:
        holds_s = given.hold_s if isinstance(given.hold_s, tuple) else (given.hold_s,) * len(given.waypoints)
        waypoints = tuple(
            Waypoint(plant.equilibrium(place), round(hold_s * NANOSECONDS))
            for place, hold_s in zip(given.waypoints, holds_s, strict=True)
        )
        mission = replace(mission, waypoints=waypoints, accept_m=given.accept_m)
    return replace(
        mission,
        trajectory=build_trajectory(given.trajectory, design, rests, config.plant.dead_time_s)
        if given.trajectory.times_s
        else None,
        dead_ns=round(config.plant.dead_time_s * NANOSECONDS),
        fences=tuple(_fence(number, one, design, rests) for number, one in enumerate(config.fence)),
        land=given.then == "land",
        lead_ns=round(config.envelope.lead_s * NANOSECONDS),
    )


def build_names(design: AnyDesign) -> Names:
    """Return the names of the design's rows and states."""
    plant = design.plant
    return names_of(
        design.state_set.c.tolist(),
        plant.n_x,
        plant.axes,
        plant.position_index,
        plant.velocity_index,
        plant.extra_states,
    )


def build_trajectory(given: TrajectoryConfig, design: AnyDesign, rests: Array, dead_s: float = 0.0) -> Trajectory:
    """Sample a trajectory each Δt and make the plant follow it; one horizon of rest is added at its end.

    Its rows begin `dead_s` after its time zero: there begins what is sent then. For `rests` see `build_mission`.

    Raises:
        DesignError: The motion leaves the state limits.
    """
    positions, velocities = wanted_positions(given, design, dead_s)
    motion = follow_positions(design.plant, positions, velocities)
    _check_limits(motion, design)
    places = resting_places(design.plant, design.state_set, rests)
    return plan_along(design.plant, motion, design.horizon, design.rest_stage, *places)


def wanted_positions(given: TrajectoryConfig, design: AnyDesign, dead_s: float) -> tuple[Array, Array | None]:
    """Return positions (n, 3) [m] and velocities (n, 3) [m/s] of a trajectory each Δt, a horizon of rest at its end.

    A line between samples has no velocities: None.
    """
    dt_s, times_s, places = design.plant.dt_s, np.array(given.times_s), np.array(given.positions_m)
    last_s = dt_s * np.ceil(times_s[-1] / dt_s - _ROUNDING)
    grid_s = dead_s + dt_s * np.arange(round(last_s / dt_s) + design.horizon + 1)
    within_s = np.clip(grid_s, times_s[0], times_s[-1])
    moves = ((grid_s >= times_s[0]) & (grid_s < times_s[-1]))[:, None]
    if given.interpolation == "linear":
        return np.column_stack([np.interp(within_s, times_s, column) for column in places.T]), None
    from scipy.interpolate import (
        CubicHermiteSpline,  # takes long to load, and few flights need it
        CubicSpline,  # takes long to load, and few flights need it
    )

    spline = (
        CubicHermiteSpline(times_s, places, np.array(given.velocities_mps))
        if given.velocities_mps
        else CubicSpline(times_s, places)
    )
    return spline(within_s), spline(within_s, nu=1) * moves


def build_rests(design: Design) -> Array:
    """Right sides (m_x,) of the state rows, less the back-offs of the design's terminal set."""
    from uavctl.smpc.hahn_stursberg.components import decompose
    from uavctl.smpc.hahn_stursberg.program import terminal_backoff_x

    rests = design.state_set.b.copy()
    for part in decompose(design):
        rests[part.rows_x] -= terminal_backoff_x(design, part)
    return rests


def _resting(design: AnyDesign, rests: Array) -> Room | None:
    try:
        places = resting_places(design.plant, design.state_set, rests)
        return make_room(design.plant, design.rest_stage, *places)
    except DesignError:
        return None


def resting_places(plant: Plant, state_set: Polytope, rests: Array) -> tuple[Array, Array]:
    """Least and largest place to rest at of each axis [m], by the right sides (m_x,) at rest."""
    index = plant.position_index
    lower, upper = np.full(len(index), -np.inf), np.full(len(index), np.inf)
    for c, side in zip(state_set.c, rests, strict=True):
        (used,) = np.nonzero(c)
        if used.size == 1 and used[0] in index:
            axis, place = index.index(int(used[0])), side / c[used[0]]
            if c[used[0]] > 0:
                upper[axis] = min(upper[axis], place)
            else:
                lower[axis] = max(lower[axis], place)
    return lower, upper


def _check_limits(motion: PlantMotion, design: AnyDesign) -> None:
    excess = motion.states @ design.state_set.c.T - design.state_set.b
    step, row = np.unravel_index(int(excess.argmax()), excess.shape)
    if excess[step, row] > _ROUNDING:
        name, unit, size = build_names(design).rows[int(row)]
        raise DesignError(
            "mission.trajectory",
            f"the motion is {excess[step, row] / size:.3g} {unit} beyond the {name}".rstrip()
            + f" at {step * design.plant.dt_s:g} s",
            "fly it slower or further inside, or widen [sets]",
        )


def _fence(number: int, given: FenceConfig, design: AnyDesign, rests: Array) -> Fence:
    key, plant = f"fence[{number}]", design.plant
    axis = given.state
    state = plant.position_index[plant.axes.index(axis)] if isinstance(axis, str) else axis
    sign = 1.0 if given.side == "upper" else -1.0
    alone = np.flatnonzero((design.state_set.c != 0).sum(axis=1) == 1)
    rows = [int(row) for row in alone if sign * design.state_set.c[row, state] > 0]
    if not rows:
        raise DesignError(
            f"{key}.side",
            f"the {given.side} side of state {state} has no limit that could close in",
            f"give sets.state_{given.side}[{state}] a finite limit, further out",
        )
    row = rows[0]
    right = abs(design.state_set.c[row, state]) * sign * np.array(given.values)
    _check_room(key, row, float(right.min()), design, rests)
    return Fence(row=row, times_ns=np.array(given.times_s) * NANOSECONDS, values=right)


def _check_room(key: str, row: int, least: float, design: AnyDesign, rests: Array) -> None:
    """Check that a limit leaves room for plans at rest, if its state is the same at every place, as a velocity is."""
    plant = design.plant
    # Weights choose among the inputs that hold a place, and not among the places.
    weights = np.eye(plant.n_x), np.eye(plant.n_u)
    places = find_equilibria(plant.a, plant.b, *weights, np.array(plant.position_index, dtype=np.intp)).x_eq
    if np.any(design.state_set.c[row] @ places):
        return
    needed = float(design.state_set.b[row] - rests[row])
    if least < needed:
        raise DesignError(
            f"{key}.values",
            f"{least:.3g} is less than the {needed:.3g} that plans keep from it at rest",
            "keep the limit further out",
        )
