"""The path in three dimensions, drawn flat: a fixed view from the south-east and above that needs no script."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Ellipse

from logs.design_view import DesignView, Floats
from logs.flight_data import FlightData
from logs.plots import DASHED, POINTS, along, choose_plans
from logs.svg import WIDTH_IN, Drawing, canvas, colour
from uavctl.data import Plan

OPEN_M = 1.0  # an open side of the room is drawn so far beyond what was flown
_STAGES = (3, 6, 12)  # of a plan whose spread is shown
_LINES = 20.0  # of the floor's grid, at most, in each direction
_DROPS = 12  # lines from the path to the floor
# Where a metre north, east and down goes on the page: north runs into the picture, to the upper right.
_SHOWN = np.array([[0.42, 1.0, 0.0], [0.36, -0.12, -1.0]])


def path_3d(flight: FlightData) -> tuple[Drawing, Drawing] | None:
    """Path, plans with their spread, limits and target, for a wide page and for a narrow one.

    None for a plant that does not move in three axes, or where nobody knows where it was.
    """
    if len(flight.design.axes) < 3 or not len(_flown_m(flight)):
        return None
    return _view(flight, "path-3d-wide", 8.6, 4.6), _view(flight, "path-3d-narrow", WIDTH_IN, 3.5)


def _view(flight: FlightData, key: str, width_in: float, height_in: float) -> Drawing:
    path_m = _flown_m(flight)
    lower, upper = _room(flight.design, path_m)
    with canvas(key, height_in, width_in) as one:
        ax = one.figure.add_axes((0.04, 0.05, 0.92, 0.93))
        one.figure.set_layout_engine(None)
        ax.set_axis_off()
        ax.set_aspect("equal", adjustable="datalim")
        _draw_room(ax, lower, upper)
        _draw_path(ax, path_m, upper[2], "truth" if flight.truths else "estimate")
        for plan in choose_plans(flight):
            _draw_plan(ax, flight.design, plan)
        _draw_places(ax, flight, path_m, upper[2])
        ax.margins(0.03)
    label = "Path in three dimensions, seen from the south-east and above, within the position limits"
    return Drawing(key, one.svg, label)


def shown(places_m: Floats) -> Floats:
    """Places in local NED (n, 3) [m] as they lie on the page (n, 2)."""
    return np.asarray(places_m @ _SHOWN.T)


def outline(semi_axes_m: Floats) -> tuple[float, float, float]:
    """Width, height and tilt [degrees] of the ellipse that an axis-parallel ellipsoid (3,) [m] is on the page.

    The shadow of {x | xᵀ D⁻² x <= 1} under P is {y | yᵀ (P D² Pᵀ)⁻¹ y <= 1}.
    """
    sizes, directions = np.linalg.eigh(_SHOWN @ np.diag(semi_axes_m**2) @ _SHOWN.T)
    height, width = 2.0 * np.sqrt(np.maximum(sizes, 0.0))
    return float(width), float(height), float(np.degrees(np.arctan2(directions[1, 1], directions[0, 1])))


def _flown_m(flight: FlightData) -> Floats:
    """Where it was (n, 3) [m], by the truth if that is known, thinned along the way."""
    design = flight.design
    places = np.array([t.position_m for t in flight.truths] or [design.position_of(e.mean) for e in flight.estimates])
    return along(places)


def _room(design: DesignView, path_m: Floats) -> tuple[Floats, Floats]:
    """Corners of the room (3,) [m]: limits, or a little beyond the flight where a side is open."""
    box = design.state_box
    seen = np.vstack([path_m, design.target_m])
    low = np.array(design.position_of(box.lower.tolist()))
    high = np.array(design.position_of(box.upper.tolist()))
    return (
        np.where(np.isfinite(low), low, seen.min(axis=0) - OPEN_M),
        np.where(np.isfinite(high), high, seen.max(axis=0) + OPEN_M),
    )


def _draw_room(ax: Axes, lower: Floats, upper: Floats) -> None:
    """Floor, grid on it, edges and their lengths."""
    corners = np.array(list(product(*zip(lower, upper, strict=True))))
    floor = [corners[1], corners[5], corners[7], corners[3]]  # down is positive: the floor is the upper limit
    ax.fill(*shown(np.array(floor)).T, color=colour("grid"), alpha=0.45, lw=0, zorder=0)
    for axis, other in ((0, 1), (1, 0)):
        for at in grid_m(float(lower[axis]), float(upper[axis])):
            ends = np.tile(upper, (2, 1))
            ends[:, axis] = at
            ends[:, other] = lower[other], upper[other]
            ax.plot(*shown(ends).T, color=colour("muted"), lw=0.4, alpha=0.5, zorder=0)
    for first, second in product(range(8), repeat=2):
        if first < second and (first ^ second) in (1, 2, 4):
            ax.plot(*shown(corners[[first, second]]).T, color=colour("limit"), lw=1.0, ls=DASHED, zorder=1)
    south_west, south_east, north_east = corners[1], corners[3], corners[7]
    _label(ax, 0.5 * (south_west + south_east), (0, -7), f"east {_ends(lower[1], upper[1])}", "center", "top")
    _label(ax, 0.65 * south_east + 0.35 * north_east, (7, -3), f"north {_ends(lower[0], upper[0])}", "left", "top")
    _label(ax, 0.5 * (corners[0] + corners[1]), (-4, 0), f"height {_ends(-upper[2], -lower[2])}", "right", "center", 90)


def grid_m(lower: float, upper: float) -> Floats:
    """Places of grid lines [m]: each metre, or each 10, 100, … in a room of more than so many."""
    step = 10.0 ** max(0.0, np.ceil(np.log10(max(upper - lower, 1.0) / _LINES)))
    return np.asarray(step * np.arange(np.ceil(lower / step), np.floor(upper / step) + 1.0))


def _ends(low: float, high: float) -> str:
    return f"{low + 0.0:.3g} … {high + 0.0:.3g} m".replace("-", "−")


def _label(ax: Axes, at_m: Floats, off: tuple[int, int], text: str, ha: str, va: str, turn: float = 0.0) -> None:
    ((x, y),) = shown(at_m[None])
    ax.annotate(
        text, (x, y), off, textcoords="offset points", rotation=turn, ha=ha, va=va, color=colour("muted"), fontsize=9
    )


def _draw_path(ax: Axes, path_m: Floats, floor_m: float, role: str) -> None:
    """The path, its shadow on the floor, and lines between them for the eye."""
    shadow = path_m.copy()
    shadow[:, 2] = floor_m
    ax.plot(*shown(shadow).T, color=colour("muted"), lw=1.0, alpha=0.6, zorder=2)
    ax.plot(*shown(path_m).T, color=colour(role), lw=1.5, zorder=5)
    gone = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path_m, axis=0), axis=1))])
    for place in np.searchsorted(gone, np.linspace(0.0, gone[-1], _DROPS)).tolist():
        ax.plot(*shown(np.array([path_m[place], shadow[place]])).T, color=colour("muted"), lw=0.7, alpha=0.6, zorder=2)


def _draw_plan(ax: Axes, design: DesignView, plan: Plan) -> None:
    """A plan's mean, and the ellipsoids with its back-offs as semi-axes in a few stages."""
    places = np.array([design.position_of(state) for state in plan.states])
    ax.plot(*shown(places).T, color=colour("plan"), lw=1.2, marker=".", ms=3, zorder=4)
    for stage in _STAGES:
        if stage < len(plan.states):
            (centre,) = shown(places[stage][None])
            width, height, tilt = outline(np.array(design.position_of(_reach(design, plan.backoff_x[stage]))))
            ax.add_patch(
                Ellipse(
                    (centre[0], centre[1]), width, height, angle=tilt, fc=colour("plan"), alpha=0.10, lw=0, zorder=3
                )
            )


def _reach(design: DesignView, backoff: Sequence[float]) -> list[float]:
    """Largest back-off from a limit of each state (n_x,), in its unit; 0 without limits."""
    box, reach = design.state_box, [0.0] * len(design.target)
    for state in design.position_index:
        for row in (int(box.row_lower[state]), int(box.row_upper[state])):
            if row >= 0:
                reach[state] = max(reach[state], backoff[row] / abs(design.c_x[row][state]))
    return reach


def _draw_places(ax: Axes, flight: FlightData, path_m: Floats, floor_m: float) -> None:
    """Start and targets, each over its point of the floor."""
    _, states = flight.targets
    targets = np.unique(np.array([flight.design.position_of(state) for state in states]), axis=0)
    if not flight.moving_target:
        for place in targets:
            ax.plot(
                *shown(np.array([place, [place[0], place[1], floor_m]])).T, color=colour("target"), lw=0.9, zorder=2
            )
        ax.plot(*shown(targets).T, "*", ms=12, color=colour("target"), mec=colour("card"), mew=0.6, zorder=7)
    else:
        route = np.array([flight.design.position_of(state) for state in states])
        ax.plot(*shown(route[:: max(1, len(route) // POINTS)]).T, color=colour("target"), lw=1.1, ls=":", zorder=3)
    ax.plot(*shown(path_m[:1]).T, "o", ms=6, mfc=colour("card"), mec=colour("truth"), mew=1.5, zorder=6)
