"""Plot of the path in three dimensions: a fixed view from the south-east and above that needs no script."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Ellipse

from logs.recording.design_view import AXIS_NUMBER, DesignView
from logs.recording.flight import FlightData
from logs.report.excursion import find_excursions
from logs.report.plots import (
    DASHED,
    MAX_POINTS,
    VIEWS,
    choose_plans,
    find_moving_limits,
    get_positions,
    mark_excursion,
    thin_path,
)
from logs.report.svg import Drawing, colour, open_canvas
from uavctl.arrays import Array
from uavctl.records import Plan

OPEN_SIDE_M = 1.0  # an open side of the room is drawn so far beyond the flight
_STAGES = (3, 6, 12)  # of a plan whose spread is shown
_MAX_GRID_LINES = 20.0  # of the floor's grid, at most, in each direction
_DROP_LINES = 12  # lines from the path to the floor
_PROJECTION = VIEWS["deep"][1]


def can_draw_path_3d(flight: FlightData) -> bool:
    """Return whether the plant moves in three axes and a position is known."""
    return len(flight.design.axes) >= 3 and len(_get_flown_path_m(flight)) > 0


def draw_path_3d(flight: FlightData) -> Iterator[Drawing]:
    """Draw path, plans with their spread, limits and target in 3D, if they can be drawn."""
    if not can_draw_path_3d(flight):
        return
    path_m, key = _get_flown_path_m(flight), "path-3d"
    lower, upper = _find_room_corners(flight.design, path_m)
    with open_canvas(key, 3.7) as canvas:
        ax = canvas.figure.add_axes((0.04, 0.05, 0.92, 0.93))
        canvas.cursor_axes = "deep"
        canvas.figure.set_layout_engine(None)
        ax.set_axis_off()
        ax.set_aspect("equal", adjustable="datalim")
        _draw_room_3d(ax, lower, upper)
        _draw_fences_3d(ax, flight, lower, upper)
        _draw_path_and_shadow(ax, path_m, upper[2], "truth" if flight.truths else "estimate")
        for plan in choose_plans(flight):
            _draw_plan_3d(ax, flight.design, plan)
        _draw_targets_3d(ax, flight, path_m, upper[2])
        for worst in find_excursions(flight)[:1]:
            mark_excursion(ax, worst, *project_3d(np.array([worst.exit_m, worst.worst_m])))
        ax.margins(0.03)
    label = "Path in three dimensions, seen from the south-east and above, within the position limits"
    yield Drawing(key, canvas.svg, label)


def project_3d(places_m: Array) -> Array:
    """Project places in local NED (n, 3) [m] onto the page (n, 2)."""
    return np.asarray(places_m @ _PROJECTION.T)


def outline_ellipsoid(semi_axes_m: Array) -> tuple[float, float, float]:
    """Return width, height and tilt [degrees] of the ellipse on the page that outlines an ellipsoid.

    The ellipsoid is axis-parallel, with semi-axes (3,) [m]. The shadow of
    {x | xᵀ D⁻² x <= 1} under P is {y | yᵀ (P D² Pᵀ)⁻¹ y <= 1}.
    """
    sizes, directions = np.linalg.eigh(_PROJECTION @ np.diag(semi_axes_m**2) @ _PROJECTION.T)
    height, width = 2.0 * np.sqrt(np.maximum(sizes, 0.0))
    return float(width), float(height), float(np.degrees(np.arctan2(directions[1, 1], directions[0, 1])))


def _get_flown_path_m(flight: FlightData) -> Array:
    """Return the flown path (n, 3) [m], thinned: by the truth if that is known, else by the estimate."""
    return thin_path(get_positions(flight)[1])


def _find_room_corners(design: DesignView, path_m: Array) -> tuple[Array, Array]:
    """Return two corners of the room (3,) [m]: the limits, or a little beyond the flight where a side is open."""
    box = design.state_box
    points = np.vstack([path_m, design.target_m])
    low = np.array(design.position_of(box.lower.tolist()))
    high = np.array(design.position_of(box.upper.tolist()))
    return (
        np.where(np.isfinite(low), low, points.min(axis=0) - OPEN_SIDE_M),
        np.where(np.isfinite(high), high, points.max(axis=0) + OPEN_SIDE_M),
    )


def _draw_room_3d(ax: Axes, lower: Array, upper: Array) -> None:
    """Draw the floor with its grid, and the edges of the room with their lengths."""
    corners = np.array(list(product(*zip(lower, upper, strict=True))))
    floor = [corners[1], corners[5], corners[7], corners[3]]  # down is positive: the floor is the upper limit
    ax.fill(*project_3d(np.array(floor)).T, color=colour("grid"), alpha=0.45, lw=0, zorder=0)
    for axis, other_axis in ((0, 1), (1, 0)):
        for line_m in compute_grid_m(float(lower[axis]), float(upper[axis])):
            ends = np.tile(upper, (2, 1))
            ends[:, axis] = line_m
            ends[:, other_axis] = lower[other_axis], upper[other_axis]
            ax.plot(*project_3d(ends).T, color=colour("muted"), lw=0.4, alpha=0.5, zorder=0)
    for first, second in product(range(8), repeat=2):
        if first < second and (first ^ second) in (1, 2, 4):
            ax.plot(*project_3d(corners[[first, second]]).T, color=colour("limit"), lw=1.0, ls=DASHED, zorder=1)
    south_west, south_east, north_east = corners[1], corners[3], corners[7]
    _draw_label(
        ax, 0.5 * (south_west + south_east), (0, -7), f"east {_format_range(lower[1], upper[1])}", "center", "top"
    )
    _draw_label(
        ax, 0.65 * south_east + 0.35 * north_east, (7, -3), f"north {_format_range(lower[0], upper[0])}", "left", "top"
    )
    _draw_label(
        ax,
        0.5 * (corners[0] + corners[1]),
        (-4, 0),
        f"height {_format_range(-upper[2], -lower[2])}",
        "right",
        "center",
        90,
    )


def _draw_fences_3d(ax: Axes, flight: FlightData, lower: Array, upper: Array) -> None:
    """Draw each limit that moves as a wall where it was at its tightest."""
    for fence in find_moving_limits(flight):
        low, high = lower.copy(), upper.copy()
        low[AXIS_NUMBER[fence.axis]] = high[AXIS_NUMBER[fence.axis]] = fence.tightest_m
        corners = np.array(list(product(*zip(low, high, strict=True))))
        wall = np.unique(corners, axis=0)[[0, 1, 3, 2]]
        ax.fill(*project_3d(wall).T, fc=colour("limit"), ec=colour("limit"), alpha=0.16, lw=1.2, zorder=1)


def compute_grid_m(lower: float, upper: float) -> Array:
    """Return places of grid lines [m]: each metre, or each 10, 100, … in a larger room."""
    step = 10.0 ** max(0.0, np.ceil(np.log10(max(upper - lower, 1.0) / _MAX_GRID_LINES)))
    return np.asarray(step * np.arange(np.ceil(lower / step), np.floor(upper / step) + 1.0))


def _format_range(low: float, high: float) -> str:
    return f"{low + 0.0:.3g} … {high + 0.0:.3g} m".replace("-", "−")


def _draw_label(
    ax: Axes, position_m: Array, offset: tuple[int, int], text: str, ha: str, va: str, rotation: float = 0.0
) -> None:
    ((x, y),) = project_3d(position_m[None])
    ax.annotate(
        text,
        (x, y),
        offset,
        textcoords="offset points",
        rotation=rotation,
        ha=ha,
        va=va,
        color=colour("muted"),
        fontsize=9,
    )


def _draw_path_and_shadow(ax: Axes, path_m: Array, floor_m: float, role: str) -> None:
    """Draw the path, its shadow on the floor, and vertical lines between them."""
    shadow = path_m.copy()
    shadow[:, 2] = floor_m
    ax.plot(*project_3d(shadow).T, color=colour("muted"), lw=1.0, alpha=0.6, zorder=2)
    ax.plot(*project_3d(path_m).T, color=colour(role), lw=1.5, zorder=5)
    distance_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path_m, axis=0), axis=1))])
    for index in np.searchsorted(distance_m, np.linspace(0.0, distance_m[-1], _DROP_LINES)).tolist():
        ax.plot(
            *project_3d(np.array([path_m[index], shadow[index]])).T, color=colour("muted"), lw=0.7, alpha=0.6, zorder=2
        )


def _draw_plan_3d(ax: Axes, design: DesignView, plan: Plan) -> None:
    """Draw a plan's mean and, at a few stages, ellipsoids with its back-offs as semi-axes."""
    positions = design.positions_of(plan.states)
    ax.plot(*project_3d(positions).T, color=colour("plan"), lw=1.2, marker=".", ms=3, zorder=4)
    for stage in _STAGES:
        if stage < len(plan.states):
            (centre,) = project_3d(positions[stage][None])
            width, height, tilt = outline_ellipsoid(
                np.array(design.position_of(_find_largest_backoff(design, plan.backoff_x[stage])))
            )
            ax.add_patch(
                Ellipse(
                    (centre[0], centre[1]), width, height, angle=tilt, fc=colour("plan"), alpha=0.10, lw=0, zorder=3
                )
            )


def _find_largest_backoff(design: DesignView, backoff: Array) -> list[float]:
    """Return the largest back-off from a limit of each state (n_x,), in its unit; 0 without limits."""
    box, backoffs = design.state_box, [0.0] * len(design.target)
    for state in design.position_index:
        for row in (int(box.row_lower[state]), int(box.row_upper[state])):
            if row >= 0:
                backoffs[state] = max(backoffs[state], backoff[row] / abs(design.c_x[row][state]))
    return backoffs


def _draw_targets_3d(ax: Axes, flight: FlightData, path_m: Array, floor_m: float) -> None:
    """Draw start and targets, each over its point of the floor."""
    _, states = flight.targets
    targets = np.unique(np.array([flight.design.position_of(state) for state in states]), axis=0)
    if not flight.moving_target:
        for target in targets:
            ax.plot(
                *project_3d(np.array([target, [target[0], target[1], floor_m]])).T,
                color=colour("target"),
                lw=0.9,
                zorder=2,
            )
        ax.plot(*project_3d(targets).T, "*", ms=12, color=colour("target"), mec=colour("card"), mew=0.6, zorder=7)
    else:
        route = np.array([flight.design.position_of(state) for state in states])
        ax.plot(
            *project_3d(route[:: max(1, len(route) // MAX_POINTS)]).T, color=colour("target"), lw=1.1, ls=":", zorder=3
        )
    ax.plot(*project_3d(path_m[:1]).T, "o", ms=6, mfc=colour("card"), mec=colour("truth"), mew=1.5, zorder=6)
