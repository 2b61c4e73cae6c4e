"""Plots of a flight: the path within its limits, each axis over time, and plans against the flown path."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from logs.recording.design_view import AXIS_NUMBER, DesignView
from logs.recording.flight import FlightData
from logs.recording.summary import compute_box, compute_position_errors_m, find_state_violations
from logs.report.excursion import Excursion, find_excursions, select_trusted_estimates
from logs.report.svg import Drawing, colour, draw_dots, open_canvas
from uavctl.arrays import Array
from uavctl.records import Plan

MAX_POINTS = 800
LIMIT_SAMPLES = 200
MAX_PLANS = 6
ARRIVAL_SHARE = 0.1
DASHED = (0, (5, 3))
DOTTED = (0, (1, 1.6))

# Axes as people see them: down is drawn as height, upwards.
DISPLAY_AXES = {"north": ("north", 1.0), "east": ("east", 1.0), "down": ("height", -1.0)}

# Views of the path that the page's cursor moves in: its name, the axes across and up, and the projection.
# In three dimensions north runs into the picture, to the upper right.
VIEWS: dict[str, tuple[tuple[str, ...], Array]] = {
    "above": (("east", "north"), np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])),
    "side": (("east", "down"), np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0]])),
    "deep": ((), np.array([[0.42, 1.0, 0.0], [0.36, -0.12, -1.0]])),
}
# Key, title, and the axes across and up.
PATH_VIEWS = (("path-above", "From above", ("east", "north")), ("path-side", "From the south", ("east", "down")))
RATE_NAMES = {"north": "speed north", "east": "speed east", "down": "climb rate"}

# Text beside a mark that is to be seen: of the limits' colour, on a ground that keeps it readable.
_MARK_STYLE: dict[str, Any] = {
    "color": colour("limit"),
    "fontsize": 8.5,
    "fontweight": "bold",
    "bbox": {"facecolor": colour("card"), "edgecolor": "none", "alpha": 0.75, "pad": 0.8},
}


@dataclass(frozen=True)
class MovingLimit:
    """A limit of position that moves over a flight [m], and when it first was at its tightest [s]."""

    axis: str
    upper: bool
    widest_m: float
    tightest_m: float
    at_s: float


def find_moving_limits(flight: FlightData) -> list[MovingLimit]:
    """Return the limits of position that move over the flight."""
    t_s, design = np.linspace(0.0, flight.duration_s, LIMIT_SAMPLES), flight.design
    moving_limits = []
    for upper, sides in enumerate(compute_box(flight, t_s)):
        for axis, state in zip(design.axes, design.position_index, strict=True):
            side = sides[:, state]
            if np.isfinite(side).all() and np.ptp(side) > 0.0:
                tightest = int(side.argmin() if upper else side.argmax())
                widest_m = float(side.max() if upper else side.min())
                moving_limits.append(
                    MovingLimit(axis, bool(upper), widest_m, float(side[tightest]), float(t_s[tightest]))
                )
    return moving_limits


def draw_path_views(flight: FlightData) -> Iterator[Drawing]:
    """Draw the path from above, and from the side if the plant moves vertically."""
    for key, title, axes_shown in PATH_VIEWS:
        if "down" not in axes_shown or "down" in flight.design.axes:
            yield draw_path_view(flight, key, title, axes_shown)


def draw_path_view(flight: FlightData, key: str, title: str, axes_shown: tuple[str, str]) -> Drawing:
    """Draw path, samples, limits, start and target in one plane."""
    (x_name, _), (y_name, _) = (DISPLAY_AXES[axis] for axis in axes_shown)
    with open_canvas(key, 3.7) as canvas:
        ax = canvas.axes(title, f"{x_name} [m]", f"{y_name} [m]")
        canvas.cursor_axes = next(name for name, (axes, _) in VIEWS.items() if axes == axes_shown)
        draw_path(ax, flight, axes_shown)
    label = f"Path seen {title[0].lower()}{title[1:]}: {x_name} and {y_name} in metres, within the position limits"
    return Drawing(key, canvas.svg, label)


def draw_path(ax: Axes, flight: FlightData, axes_shown: tuple[str, str]) -> None:
    """Draw path, samples, limits, start and target on given axes, to scale."""
    columns = [AXIS_NUMBER[axis] for axis in axes_shown]
    sign = np.array([DISPLAY_AXES[axis][1] for axis in axes_shown])

    def project(positions: Array) -> Array:
        return np.asarray(positions[:, columns] * sign)

    design = flight.design
    samples = project(_thin_rows(np.array([s.position_m for s in flight.samples]).reshape(-1, 3)))
    estimate = project(thin_path(np.array([design.position_of(e.mean) for e in select_trusted_estimates(flight)])))
    truth = project(thin_path(np.array([t.position_m for t in flight.truths])))
    target = project(thin_path(np.array([design.position_of(state) for state in _list_targets(flight)])))
    _draw_room(ax, design, axes_shown)
    _draw_fences(ax, flight, axes_shown)
    ax.plot(*estimate.T, color=colour("estimate"), lw=2.8, alpha=0.5, zorder=2)
    ax.plot(*truth.T, color=colour("truth"), lw=1.0, zorder=3)
    draw_dots(ax, samples[:, 0], samples[:, 1], "sample", 2.4, zorder=4)
    flown = truth if len(truth) else estimate
    ax.plot(*flown[:1].T, "o", ms=6, mfc=colour("card"), mec=colour("truth"), mew=1.5, zorder=5)
    if flight.moving_target:
        ax.plot(*target.T, color=colour("target"), lw=1.1, ls=DOTTED, zorder=3)
    else:
        ax.plot(*target.T, "*", ms=12, color=colour("target"), mec=colour("card"), mew=0.6, zorder=6)
    _draw_excursions(ax, flight, project)
    ax.set_aspect("equal", adjustable="datalim")
    ax.margins(0.06)


def _draw_fences(ax: Axes, flight: FlightData, axes_shown: tuple[str, str]) -> None:
    """Draw the limits that move: where each was at its tightest, and the space that it took away until then."""
    for number, fence in enumerate(limit for limit in find_moving_limits(flight) if limit.axis in axes_shown):
        is_vertical = axes_shown[1] == fence.axis
        sign, other_axis = DISPLAY_AXES[fence.axis][1], axes_shown[0 if is_vertical else 1]
        begin, end = position_limits(flight.design, other_axis)
        if not np.isfinite([begin, end]).all():
            positions_m = DISPLAY_AXES[other_axis][1] * get_positions(flight)[1][:, AXIS_NUMBER[other_axis]]
            begin, end = float(np.nanmin(positions_m)), float(np.nanmax(positions_m))
        tightest_m, widest_m = sign * fence.tightest_m, sign * fence.widest_m
        along, across = np.array([begin, end]), np.array([tightest_m, tightest_m])
        fill, line = (ax.fill_between, (along, across)) if is_vertical else (ax.fill_betweenx, (across, along))
        fill(along, tightest_m, widest_m, color=colour("limit"), alpha=0.1, lw=0, zorder=0)
        ax.plot(*line, color=colour("limit"), lw=1.6, zorder=1)
        text, inward_sign = f"fence at {fence.at_s:.1f} s", -1 if widest_m > tightest_m else 1
        # Each label lies along its own line, at a place of its own: fences that close in from two sides would meet.
        label_position = begin + (0.06 + 0.24 * (number % 4)) * (end - begin)
        anchor, offset = (
            ((label_position, tightest_m), (0, 8 * inward_sign))
            if is_vertical
            else ((tightest_m, label_position), (8 * inward_sign, 0))
        )
        alignment: dict[str, Any] = (
            {"va": "center", "ha": "left"} if is_vertical else {"ha": "center", "va": "bottom", "rotation": 90}
        )
        ax.annotate(
            text,
            anchor,
            offset,
            textcoords="offset points",
            annotation_clip=False,
            zorder=9,
            **alignment,
            **_MARK_STYLE,
        )


def _draw_excursions(ax: Axes, flight: FlightData, project: Callable[[Array], Array]) -> None:
    """Mark where the vehicle left its limits, and where it was furthest outside, for the worst of its excursions."""
    for worst in find_excursions(flight)[:1]:
        exit_xy, furthest_xy = project(np.array([worst.exit_m, worst.worst_m]))
        mark_excursion(ax, worst, exit_xy, furthest_xy)


def mark_excursion(ax: Axes, worst: Excursion, exit_xy: Array, furthest_xy: Array) -> None:
    """Mark an excursion at two places on the page (2,), with the times and how far it went."""
    mark_colour = colour("limit")
    ax.plot(*furthest_xy, "X", ms=8, color=mark_colour, mec=colour("card"), mew=0.8, zorder=8)
    ax.plot(*exit_xy, "o", ms=9, mfc="none", mec=mark_colour, mew=2.2, zorder=8)
    # Each text above or below its mark, away from the other one, and towards the middle of the drawing.
    vertical = 1 if furthest_xy[1] >= exit_xy[1] else -1
    horizontal = 1 if 0.5 * (exit_xy[0] + furthest_xy[0]) < np.mean(ax.get_xlim()) else -1
    for (x, y), text, vertical_sign in (
        (exit_xy, f"left at {worst.exit_s:.1f} s", -vertical),
        (furthest_xy, f"{worst.beyond_m:.2g} m out at {worst.worst_s:.1f} s", vertical),
    ):
        side = "left" if horizontal > 0 else "right"
        ax.annotate(
            text,
            (x, y),
            (8 * horizontal, 12 * vertical_sign),
            textcoords="offset points",
            ha=side,
            va="center",
            zorder=9,
            **_MARK_STYLE,
        )


def _list_targets(flight: FlightData) -> Array:
    """Return the targets as points: each waypoint once, or the whole of a trajectory."""
    _, states = flight.targets
    changes = np.flatnonzero(np.any(states[1:] != states[:-1], axis=1)) + 1
    return np.asarray(states[[0, *changes]])


def make_path_legend(flight: FlightData) -> list[Line2D]:
    """Make the entries of a legend of `draw_path`."""
    lines: list[tuple[str, dict[str, Any]]] = [("estimate", {"color": colour("estimate"), "lw": 2.8, "alpha": 0.5})]
    if flight.truths:
        lines.append(("truth", {"color": colour("truth"), "lw": 1.0}))
    if flight.samples:
        lines.append(("positions", {"color": colour("sample"), "ls": "", "marker": "o", "ms": 2.4}))
    target = {"ls": DOTTED, "lw": 1.1} if flight.moving_target else {"ls": "", "marker": "*", "ms": 8}
    lines.append(("target", {"color": colour("target"), **target}))
    lines.append(("limits", {"color": colour("limit"), "lw": 1.2, "ls": DASHED}))
    return [Line2D([], [], label=label, **style) for label, style in lines]


def _draw_room(ax: Axes, design: DesignView, axes_shown: tuple[str, str]) -> None:
    """Draw the position limits as a frame; an open side has no line."""
    (x0, x1), (y0, y1) = (position_limits(design, axis) for axis in axes_shown)
    if np.isfinite([x0, x1, y0, y1]).all():
        corners = [x0, x1, x1, x0, x0], [y0, y0, y1, y1, y0]
        ax.plot(*corners, color=colour("limit"), lw=1.2, ls=DASHED, zorder=1)
        return
    for draw, sides in ((ax.axvline, (x0, x1)), (ax.axhline, (y0, y1))):
        for side in sides:
            if np.isfinite(side):
                draw(side, color=colour("limit"), lw=1.2, ls=DASHED, zorder=1)


def position_limits(design: DesignView, axis: str) -> tuple[float, float]:
    """Return the position limits of an axis with the sign that it is drawn with [m]; infinite if open."""
    if axis not in design.axes:
        return -np.inf, np.inf
    index = design.position_index[design.axes.index(axis)]
    sides = sorted(
        DISPLAY_AXES[axis][1] * side for side in (design.state_box.lower[index], design.state_box.upper[index])
    )
    return float(sides[0]), float(sides[1])


def has_variation(values: Array) -> bool:
    """Return whether there are two different finite values at least: one alone makes no plot."""
    finite = values[np.isfinite(values)]
    return bool(len(finite)) and float(np.ptp(finite)) > 0.0


def draw_axes_over_time(flight: FlightData) -> Iterator[Drawing]:
    """Draw position and velocity of each axis over time against their limits, the positions first."""
    design = flight.design
    for axis, index in zip(design.axes, design.position_index, strict=True):
        if _is_moving(flight, index):
            yield _draw_state(flight, axis, index, f"{DISPLAY_AXES[axis][0]} [m]", DISPLAY_AXES[axis][0].capitalize())
    for axis, index in zip(design.axes, design.velocity_index, strict=True):
        if _is_moving(flight, index):
            yield _draw_state(flight, axis, index, f"{RATE_NAMES[axis]} [m/s]", RATE_NAMES[axis].capitalize())


def _is_moving(flight: FlightData, index: int) -> bool:
    """Return whether a state, estimated or true, has more than one value."""
    estimated = np.array([estimate.mean[index] for estimate in select_trusted_estimates(flight)])
    return has_variation(estimated) or has_variation(np.array([truth.state[index] for truth in flight.truths]))


def _draw_state(flight: FlightData, axis: str, index: int, y_label: str, title: str) -> Drawing:
    key, sign = f"state-{index}", DISPLAY_AXES[axis][1]
    outside = find_state_violations(flight, index)
    with open_canvas(key, 2.3) as canvas:
        ax = canvas.axes(title, "time [s]", y_label)
        shade_fallback(ax, flight)
        draw_limits(ax, flight, index, sign)
        estimates = select_trusted_estimates(flight)
        estimate_s, estimate = thin_samples(
            flight.seconds([e.at_ns for e in estimates]), np.array([sign * e.mean[index] for e in estimates])
        )
        ax.plot(estimate_s, estimate, color=colour("estimate"), lw=2.6, alpha=0.5)
        truth_s, truth = thin_samples(
            flight.seconds([t.at_ns for t in flight.truths]), np.array([sign * t.state[index] for t in flight.truths])
        )
        ax.plot(truth_s, truth, color=colour("truth"), lw=1.0)
        draw_target(ax, flight, index, sign)
        steps = flight.steps
        ax.plot(steps.t_s[outside], sign * steps.state[outside, index], "x", ms=6, mew=1.6, color=colour("limit"))
        set_time_axis(ax, flight)
    return Drawing(key, canvas.svg, f"{title} over time against its limits")


def draw_target(ax: Axes, flight: FlightData, index: int, sign: float) -> None:
    """Draw the target of a state over time: steps between waypoints, or a trajectory."""
    t_s, states = flight.targets
    ends_s = np.append(t_s, flight.duration_s)
    values = sign * np.append(states[:, index], states[-1, index])
    ax.step(*thin_samples(ends_s, values), where="post", color=colour("target"), lw=1.1, ls=DOTTED)


def draw_limits(ax: Axes, flight: FlightData, index: int, sign: float) -> None:
    """Draw the limits of a state, and the reserve that each plan keeps from them at its end."""
    box = flight.design.state_box
    plans = list(flight.flown_plans.values())
    t_s = flight.seconds([plan.base_ns for plan in plans])
    all_s = np.linspace(0.0, flight.duration_s, LIMIT_SAMPLES)
    at_plans, at_all = compute_box(flight, t_s), compute_box(flight, all_s)
    for side_index, row, inward_sign in ((0, box.row_lower[index], 1.0), (1, box.row_upper[index], -1.0)):
        if row < 0:
            continue
        limit_at_plans, limit_values = at_plans[side_index][:, index], at_all[side_index][:, index]
        if np.ptp(limit_values):
            ax.plot(all_s, sign * limit_values, color=colour("limit"), lw=1.2, ls=DASHED)
        else:
            ax.axhline(sign * limit_values[0], color=colour("limit"), lw=1.2, ls=DASHED)
        scale = abs(flight.design.c_x[row][index])
        reserve = np.array([plan.backoff_x[:, row].max() for plan in plans]) / scale
        if len(plans):
            # The last one is flown to the end of its step, or on through a silence.
            ends_s = np.append(t_s, _find_plan_end_s(flight))
            shown_s, reserve_values = thin_samples(
                ends_s,
                np.append(limit_at_plans + inward_sign * reserve, limit_at_plans[-1] + inward_sign * reserve[-1]),
            )
            limit = np.interp(shown_s, t_s, limit_at_plans)
            ax.fill_between(
                shown_s, sign * limit, sign * reserve_values, step="post", color=colour("limit"), alpha=0.13, lw=0
            )


def _find_plan_end_s(flight: FlightData) -> float:
    """Return the end of the last tick that flew a plan [s]."""
    last = next(d for d in reversed(flight.decisions) if d.plan_seq in flight.flown_plans)
    return float(flight.seconds([last.at_ns + flight.tick_ns])[0])


def draw_plans_against_flown(flight: FlightData) -> Iterator[Drawing]:
    """Draw a few plans over the flight, axis by axis."""
    plans = choose_plans(flight)
    if not plans:
        return
    end_s = max(_compute_plan_times(flight, plan)[-1] for plan in plans)
    if {"north", "east"} <= set(flight.design.axes):
        yield _draw_plans_above(flight, plans, end_s)
    for axis, index in zip(flight.design.axes, flight.design.position_index, strict=True):
        name, sign = DISPLAY_AXES[axis]
        key = f"plan-{index}"
        with open_canvas(key, 2.5) as canvas:
            ax = canvas.axes(name.capitalize(), "time [s]", f"{name} [m]")
            for plan in plans:
                _draw_plan(ax, flight, plan, index, sign)
            records = flight.truths or flight.estimates
            t_s = flight.seconds([k.at_ns for k in records])
            values = np.array([sign * x for x in _get_component(flight, index)])
            is_shown = t_s <= end_s
            ax.plot(*thin_samples(t_s[is_shown], values[is_shown]), color=colour("truth"), lw=1.5, zorder=4)
            ax.set_xlim(0, end_s)
        yield Drawing(
            key, canvas.svg, f"{name.capitalize()}: {len(plans)} plans with their back-off against the flown path"
        )


def _draw_plans_above(flight: FlightData, plans: list[Plan], end_s: float) -> Drawing:
    """Draw a few plans over the flight, from above."""
    design, (t_s, position) = flight.design, get_positions(flight)
    flown = thin_path(position[t_s <= end_s])
    with open_canvas("plan-above", 2.5) as canvas:
        ax = canvas.axes("From above", "east [m]", "north [m]")
        canvas.cursor_axes = "above"
        for plan in plans:
            north, east, _ = design.positions_of(plan.states).T
            ax.plot(east, north, "-", color=colour("plan"), lw=1.3, marker=".", ms=3, zorder=3)
            ax.plot(east[0], north[0], "o", ms=4.5, color=colour("plan"), zorder=5)
        ax.plot(flown[:, 1], flown[:, 0], color=colour("truth"), lw=1.5, zorder=4)
        ax.set_aspect("equal", adjustable="datalim")
    return Drawing("plan-above", canvas.svg, f"{len(plans)} plans against the flown path, seen from above")


def get_positions(flight: FlightData) -> tuple[Array, Array]:
    """Where it was: times (n,) [s] and positions (n, 3), local NED; the true ones where they are known."""
    records = flight.truths or flight.estimates
    points = [t.position_m for t in flight.truths] or [flight.design.position_of(e.mean) for e in flight.estimates]
    return flight.seconds([record.at_ns for record in records]), np.array(points).reshape(-1, 3)


def _get_component(flight: FlightData, index: int) -> list[float]:
    if flight.truths:
        return [truth.state[index] for truth in flight.truths]
    return [estimate.mean[index] for estimate in flight.estimates]


def _draw_plan(ax: Axes, flight: FlightData, plan: Plan, index: int, sign: float) -> None:
    """Draw a plan's predicted mean, and its back-off: the reserve for disturbance and estimation error."""
    t_s = _compute_plan_times(flight, plan)
    mean, box = plan.states[:, index], flight.design.state_box
    below, above = (
        plan.backoff_x[:, row] / abs(flight.design.c_x[row][index]) if row >= 0 else np.zeros(len(mean))
        for row in (box.row_lower[index], box.row_upper[index])
    )
    ax.fill_between(t_s, sign * (mean - below), sign * (mean + above), color=colour("plan"), alpha=0.16, lw=0)
    ax.plot(t_s, sign * mean, "-", color=colour("plan"), lw=1.3, marker=".", ms=3, zorder=3)
    ax.plot(t_s[0], sign * mean[0], "o", ms=4.5, color=colour("plan"), zorder=5)


def _compute_plan_times(flight: FlightData, plan: Plan) -> Array:
    return np.asarray(flight.seconds([plan.base_ns])[0] + flight.design.dt_s * np.arange(len(plan.states)))


def choose_plans(flight: FlightData) -> list[Plan]:
    """Choose at most six plans on the way to the target: of each sixth of it the one flown longest."""
    steps, plans = flight.steps, flight.flown_plans
    error_m = compute_position_errors_m(flight)
    if not plans or not len(steps):
        return []
    arrival_indices = np.flatnonzero(error_m <= ARRIVAL_SHARE * error_m[0])
    arrived_s = float(steps.t_s[arrival_indices[0] if len(arrival_indices) else -1])
    window_s = max(arrived_s * 1.2, MAX_PLANS * flight.design.horizon * flight.design.dt_s * 0.6)
    last_index_by_plan: dict[int, int] = {}
    for decision in steps.decisions:
        if decision.plan_seq in plans and decision.plan_index is not None:
            last_index_by_plan[decision.plan_seq] = max(
                last_index_by_plan.get(decision.plan_seq, 0), decision.plan_index
            )
    longest_by_window: dict[int, Plan] = {}
    for seq, index in last_index_by_plan.items():
        window = int(flight.seconds([plans[seq].base_ns])[0] / window_s * MAX_PLANS)
        if window < MAX_PLANS and (
            window not in longest_by_window or index > last_index_by_plan[longest_by_window[window].seq]
        ):
            longest_by_window[window] = plans[seq]
    return list(longest_by_window.values())


def shade_fallback(ax: Axes, flight: FlightData) -> None:
    """Shade the spans of time in which the fallback flew."""
    for begun_s, ended_s in flight.fallback_spans:
        ax.axvspan(begun_s, ended_s, color=colour("fallback"), alpha=0.22, lw=0)


def set_time_axis(ax: Axes, flight: FlightData) -> None:
    """Set the time axis to the whole flight."""
    ax.set_xlim(0, max(flight.duration_s, flight.design.dt_s))


def thin_samples(t_s: Array, values: Array) -> tuple[Array, Array]:
    """Thin points to about `POINTS`, keeping each bucket's smallest and largest value; drop non-finite ones."""
    is_finite = np.isfinite(values)
    t_s, values = t_s[is_finite], values[is_finite]
    if len(values) <= MAX_POINTS:
        return t_s, values
    width = -(-len(values) // (MAX_POINTS // 2))
    index = [
        start + offset
        for start in range(0, len(values), width)
        for bucket in (values[start : start + width],)
        for offset in sorted({int(bucket.argmin()), int(bucket.argmax())})
    ]
    return t_s[index], values[index]


def thin_path(points: Array) -> Array:
    """Thin a path (n, 3) to about `POINTS` rows, evenly by distance flown, so a long hover takes none from the way."""
    points = points.reshape(-1, 3)
    finite = points[np.isfinite(points).all(axis=1)]
    if len(finite) <= MAX_POINTS:
        return finite
    distance_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(finite, axis=0), axis=1))])
    return np.asarray(finite[np.unique(np.searchsorted(distance_m, np.linspace(0.0, distance_m[-1], MAX_POINTS)))])


def _thin_rows(points: Array) -> Array:
    """Thin rows evenly to about `POINTS`; drop those that are not finite."""
    finite = points[np.isfinite(points).all(axis=1)]
    return finite[:: max(1, -(-len(finite) // MAX_POINTS))]
