"""Composition of the mission: waypoints or a trajectory, and fences, from a configuration."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from uavctl.arrays import SECOND_NS, Array
from uavctl.config.mission import FenceConfig, TrajectoryConfig
from uavctl.config.types import Config
from uavctl.constraint_names import ConstraintNames, name_constraints
from uavctl.errors import DesignError
from uavctl.flight.mission import Fence, Mission, RestRegion, Trajectory, Waypoint, make_hold_mission
from uavctl.flight.trajectory import PlantMotion, follow_positions, make_rest_region, plan_along
from uavctl.smpc.conditioned.design import AnyDesign
from uavctl.smpc.plant import Plant
from uavctl.smpc.sets import Polytope, find_equilibria

if TYPE_CHECKING:
    from uavctl.smpc.hahn_stursberg.design import Design


_ROUNDING = 1e-9


def build_mission(config: Config, design: AnyDesign, reference_limits: Array) -> Mission:
    """Build waypoints or a trajectory, and fences; without any, `target.position_m` is held.

    Args:
        reference_limits: Right sides (m_x,) of the state rows, less the back-offs of a plan at rest.

    Raises:
        DesignError: The plant cannot rest or move there, or a fence limits a state without a limit.
    """
    mission_config, plant = config.mission, design.plant
    mission = make_hold_mission(
        design.target,
        plant.position_index,
        design.state_set.b,
        horizon=design.horizon,
        dt_ns=round(plant.dt_s * SECOND_NS),
        rest_region=_build_rest_region(design, reference_limits),
    )
    if mission_config.waypoints:
        holds_s = (
            mission_config.hold_s
            if isinstance(mission_config.hold_s, tuple)
            else (mission_config.hold_s,) * len(mission_config.waypoints)
        )
        yaw_deg = mission_config.yaw_deg
        yaws_rad: tuple[float | None, ...] = (
            tuple(map(math.radians, yaw_deg)) if isinstance(yaw_deg, tuple) else (None,) * len(holds_s)
        )
        waypoints = tuple(
            Waypoint(plant.equilibrium(position_m), round(hold_s * SECOND_NS), yaw_rad)
            for position_m, hold_s, yaw_rad in zip(mission_config.waypoints, holds_s, yaws_rad, strict=True)
        )
        mission = replace(mission, waypoints=waypoints, accept_m=mission_config.accept_m)
    return replace(
        mission,
        trajectory=build_trajectory(mission_config.trajectory, design, reference_limits, config.plant.dead_time_s)
        if mission_config.trajectory.times_s
        else None,
        dead_ns=round(config.plant.dead_time_s * SECOND_NS),
        fences=tuple(
            _build_fence(number, fence, design, reference_limits) for number, fence in enumerate(config.fence)
        ),
        land=mission_config.then == "land",
        lead_ns=round(config.envelope.lead_s * SECOND_NS),
    )


def build_names(design: AnyDesign) -> ConstraintNames:
    """Return the names of the design's rows and states."""
    plant = design.plant
    return name_constraints(
        design.state_set.c.tolist(),
        plant.n_x,
        plant.axes,
        plant.position_index,
        plant.velocity_index,
        plant.extra_states,
        len(plant.gust_mps2),
    )


def build_trajectory(
    trajectory_config: TrajectoryConfig, design: AnyDesign, reference_limits: Array, dead_s: float = 0.0
) -> Trajectory:
    """Sample a trajectory each Δt and make the plant follow it; one horizon of rest is added at its end.

    Its rows begin `dead_s` after its time zero: an input that is sent then acts from there on.

    Args:
        reference_limits: See `build_mission`.

    Raises:
        DesignError: The motion leaves the state limits.
    """
    positions_m, velocities_mps = sample_trajectory(trajectory_config, design, dead_s)
    motion = follow_positions(design.plant, positions_m, velocities_mps)
    _check_limits(motion, design)
    reference_range = compute_reference_range(design.plant, design.state_set, reference_limits)
    return plan_along(design.plant, motion, design.horizon, design.arrival_stage, *reference_range)


def sample_trajectory(
    trajectory_config: TrajectoryConfig, design: AnyDesign, dead_s: float
) -> tuple[Array, Array | None]:
    """Return positions (n, 3) [m] and velocities (n, 3) [m/s] of a trajectory each Δt, a horizon of rest at its end.

    A line between samples has no velocities: None.
    """
    dt_s, times_s, positions_m = (
        design.plant.dt_s,
        np.array(trajectory_config.times_s),
        np.array(trajectory_config.positions_m),
    )
    last_s = dt_s * np.ceil(times_s[-1] / dt_s - _ROUNDING)
    grid_s = dead_s + dt_s * np.arange(round(last_s / dt_s) + design.horizon + 1)
    within_s = np.clip(grid_s, times_s[0], times_s[-1])
    is_moving = ((grid_s >= times_s[0]) & (grid_s < times_s[-1]))[:, None]
    if trajectory_config.interpolation == "linear":
        return np.column_stack([np.interp(within_s, times_s, column) for column in positions_m.T]), None
    from scipy.interpolate import CubicHermiteSpline, CubicSpline  # loads long, and few flights need it

    spline = (
        CubicHermiteSpline(times_s, positions_m, np.array(trajectory_config.velocities_mps))
        if trajectory_config.velocities_mps
        else CubicSpline(times_s, positions_m)
    )
    return spline(within_s), spline(within_s, nu=1) * is_moving


def build_reference_limits(design: Design) -> Array:
    """Return the right sides (m_x,) of the state rows, less the back-offs of the design's terminal set."""
    from uavctl.smpc.hahn_stursberg.components import decompose
    from uavctl.smpc.hahn_stursberg.program import terminal_backoff_x

    reference_limits = design.state_set.b.copy()
    for part in decompose(design):
        reference_limits[part.rows_x] -= terminal_backoff_x(design, part)
    return reference_limits


def _build_rest_region(design: AnyDesign, reference_limits: Array) -> RestRegion | None:
    try:
        reference_range = compute_reference_range(design.plant, design.state_set, reference_limits)
        return make_rest_region(design.plant, design.arrival_stage, *reference_range)
    except DesignError:
        return None


def compute_reference_range(plant: Plant, state_set: Polytope, reference_limits: Array) -> tuple[Array, Array]:
    """Return the least and the largest position at rest of each axis [m], by the right sides (m_x,) at rest."""
    index = plant.position_index
    lower, upper = np.full(len(index), -np.inf), np.full(len(index), np.inf)
    for c, limit in zip(state_set.c, reference_limits, strict=True):
        (used_states,) = np.nonzero(c)
        if used_states.size == 1 and used_states[0] in index:
            axis, limit_m = index.index(int(used_states[0])), limit / c[used_states[0]]
            if c[used_states[0]] > 0:
                upper[axis] = min(upper[axis], limit_m)
            else:
                lower[axis] = max(lower[axis], limit_m)
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


def _build_fence(number: int, fence_config: FenceConfig, design: AnyDesign, reference_limits: Array) -> Fence:
    key, plant = f"fence[{number}]", design.plant
    axis = fence_config.state
    state = plant.position_index[plant.axes.index(axis)] if isinstance(axis, str) else axis
    sign = 1.0 if fence_config.side == "upper" else -1.0
    single_state_rows = np.flatnonzero((design.state_set.c != 0).sum(axis=1) == 1)
    rows = [int(row) for row in single_state_rows if sign * design.state_set.c[row, state] > 0]
    if not rows:
        raise DesignError(
            f"{key}.side",
            f"the {fence_config.side} side of state {state} has no limit that could close in",
            f"give sets.state_{fence_config.side}[{state}] a finite limit, further out",
        )
    row = rows[0]
    row_limits = abs(design.state_set.c[row, state]) * sign * np.array(fence_config.values)
    _check_room(key, row, float(row_limits.min()), design, reference_limits)
    return Fence(row=row, times_ns=np.array(fence_config.times_s) * SECOND_NS, values=row_limits)


def _check_room(key: str, row: int, min_limit: float, design: AnyDesign, reference_limits: Array) -> None:
    """Check that a limit leaves room for plans at rest, if its state is equal at every position, as a velocity is."""
    plant = design.plant
    # Weights choose among the inputs that hold a position, not among the positions.
    weights = np.eye(plant.n_x), np.eye(plant.n_u)
    equilibrium_states = find_equilibria(plant.a, plant.b, *weights, np.array(plant.position_index, dtype=np.intp)).x_eq
    if np.any(design.state_set.c[row] @ equilibrium_states):
        return
    needed = float(design.state_set.b[row] - reference_limits[row])
    if min_limit < needed:
        raise DesignError(
            f"{key}.values",
            f"{min_limit:.3g} is less than the {needed:.3g} that plans keep from it at rest",
            "keep the limit further out",
        )
