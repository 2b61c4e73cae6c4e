"""Plots of path, axes over time, plans, and the path in 3D."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Ellipse
from numpy.typing import NDArray

from logs.recording.design_view import AXIS_NUMBER, DesignView, Floats
from logs.recording.flight import FlightData
from logs.recording.summary import RELATIVE_TOLERANCE, WIRE_TOLERANCE, box_at, limits_at, position_error_m
from logs.report.excursion import Excursion, excursions, trusted
from logs.report.svg import Drawing, canvas, colour, dots
from uavctl.records import Plan

# Where it flew: the path within its limits, each axis over time, and plans against what was flown.


POINTS = 800
LIMIT_POINTS = 200
PLANS_SHOWN = 6
ARRIVED_SHARE = 0.1
DASHED = (0, (5, 3))
DOTTED = (0, (1, 1.6))
# Axes as people see them: down is drawn as height, upwards.
SEEN = {"north": ("north", 1.0), "east": ("east", 1.0), "down": ("height", -1.0)}
# Views of the path that the page's cursor moves in: its name, the axes across and up, and what a place becomes there.
# In three dimensions north runs into the picture, to the upper right.
VIEWS: dict[str, tuple[tuple[str, ...], Floats]] = {
    "above": (("east", "north"), np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])),
    "side": (("east", "down"), np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0]])),
    "deep": ((), np.array([[0.42, 1.0, 0.0], [0.36, -0.12, -1.0]])),
}
RATE = {"north": "speed north", "east": "speed east", "down": "climb rate"}

# Text beside a mark that is to be seen: of the limits' colour, on a ground that keeps it readable.
_MARKED: dict[str, Any] = {
    "color": colour("limit"),
    "fontsize": 8.5,
    "fontweight": "bold",
    "bbox": {"facecolor": colour("card"), "edgecolor": "none", "alpha": 0.75, "pad": 0.8},
}


@dataclass(frozen=True)
class MovedLimit:
    """A limit of position that moves over a flight [m], and when it first was at its tightest [s]."""

    axis: str
    upper: bool
    widest_m: float
    tightest_m: float
    at_s: float


def fences(flight: FlightData) -> list[MovedLimit]:
    """Return the limits of position that move over the flight."""
    t_s, design = np.linspace(0.0, flight.duration_s, LIMIT_POINTS), flight.design
    found = []
    for upper, sides in enumerate(box_at(flight, t_s)):
        for axis, state in zip(design.axes, design.position_index, strict=True):
            side = sides[:, state]
            if np.isfinite(side).all() and np.ptp(side) > 0.0:
                tight = int(side.argmin() if upper else side.argmax())
                wide = float(side.max() if upper else side.min())
                found.append(MovedLimit(axis, bool(upper), wide, float(side[tight]), float(t_s[tight])))
    return found


def path(flight: FlightData) -> Iterator[Drawing]:
    """Draw the path from above, and from the side if the plant moves vertically."""
    yield path_view(flight, "path-above", "From above", ("east", "north"))
    if "down" in flight.design.axes:
        yield path_view(flight, "path-side", "From the south", ("east", "down"))


def path_view(flight: FlightData, key: str, title: str, axes_shown: tuple[str, str]) -> Drawing:
    """Draw path, samples, limits, start and target in one plane."""
    (x_name, _), (y_name, _) = (SEEN[axis] for axis in axes_shown)
    with canvas(key, 3.7) as one:
        ax = one.axes(title, f"{x_name} [m]", f"{y_name} [m]")
        one.seen = next(name for name, (axes, _) in VIEWS.items() if axes == axes_shown)
        draw_path(ax, flight, axes_shown)
    label = f"Path seen {title[0].lower()}{title[1:]}: {x_name} and {y_name} in metres, within the position limits"
    return Drawing(key, one.svg, label)


def draw_path(ax: Axes, flight: FlightData, axes_shown: tuple[str, str]) -> None:
    """Draw path, samples, limits, start and target on given axes, to scale."""
    pick = [AXIS_NUMBER[axis] for axis in axes_shown]
    sign = np.array([SEEN[axis][1] for axis in axes_shown])

    def seen(positions: Floats) -> Floats:
        return np.asarray(positions[:, pick] * sign)

    design = flight.design
    samples = seen(_thin(np.array([s.position_m for s in flight.samples]).reshape(-1, 3)))
    estimate = seen(along(np.array([design.position_of(e.mean) for e in trusted(flight)])))
    truth = seen(along(np.array([t.position_m for t in flight.truths])))
    target = seen(along(np.array([design.position_of(state) for state in _places(flight)])))
    _draw_room(ax, design, axes_shown)
    _draw_fences(ax, flight, axes_shown)
    ax.plot(*estimate.T, color=colour("estimate"), lw=2.8, alpha=0.5, zorder=2)
    ax.plot(*truth.T, color=colour("truth"), lw=1.0, zorder=3)
    dots(ax, samples[:, 0], samples[:, 1], "sample", 2.4, zorder=4)
    flown = truth if len(truth) else estimate
    ax.plot(*flown[:1].T, "o", ms=6, mfc=colour("card"), mec=colour("truth"), mew=1.5, zorder=5)
    if flight.moving_target:
        ax.plot(*target.T, color=colour("target"), lw=1.1, ls=DOTTED, zorder=3)
    else:
        ax.plot(*target.T, "*", ms=12, color=colour("target"), mec=colour("card"), mew=0.6, zorder=6)
    _draw_excursions(ax, flight, seen)
    ax.set_aspect("equal", adjustable="datalim")
    ax.margins(0.06)


def _draw_fences(ax: Axes, flight: FlightData, axes_shown: tuple[str, str]) -> None:
    """Draw the limits that move: where each was at its tightest, and the space that it took away until then."""
    for number, fence in enumerate(one for one in fences(flight) if one.axis in axes_shown):
        up = axes_shown[1] == fence.axis
        sign, other = SEEN[fence.axis][1], axes_shown[0 if up else 1]
        begin, end = position_limits(flight.design, other)
        if not np.isfinite([begin, end]).all():
            places = SEEN[other][1] * course(flight)[1][:, AXIS_NUMBER[other]]
            begin, end = float(np.nanmin(places)), float(np.nanmax(places))
        tight, wide = sign * fence.tightest_m, sign * fence.widest_m
        along, over = np.array([begin, end]), np.array([tight, tight])
        fill, line = (ax.fill_between, (along, over)) if up else (ax.fill_betweenx, (over, along))
        fill(along, tight, wide, color=colour("limit"), alpha=0.1, lw=0, zorder=0)
        ax.plot(*line, color=colour("limit"), lw=1.6, zorder=1)
        told, inwards = f"fence at {fence.at_s:.1f} s", -1 if wide > tight else 1
        # Each label lies along its own line, at a place of its own: fences that close in from two sides would meet.
        part = begin + (0.06 + 0.24 * (number % 4)) * (end - begin)
        at, off = ((part, tight), (0, 8 * inwards)) if up else ((tight, part), (8 * inwards, 0))
        how: dict[str, Any] = {"va": "center", "ha": "left"} if up else {"ha": "center", "va": "bottom", "rotation": 90}
        ax.annotate(told, at, off, textcoords="offset points", annotation_clip=False, zorder=9, **how, **_MARKED)


def _draw_excursions(ax: Axes, flight: FlightData, seen: Callable[[Floats], Floats]) -> None:
    """Mark where the vehicle left its limits, and where it was furthest outside, for the worst of its excursions."""
    for worst in excursions(flight)[:1]:
        left, furthest = seen(np.array([worst.left_m, worst.worst_m]))
        mark_excursion(ax, worst, left, furthest)


def mark_excursion(ax: Axes, worst: Excursion, left: Floats, furthest: Floats) -> None:
    """Mark an excursion at two places on the page (2,), with the times and how far it went."""
    paint = colour("limit")
    ax.plot(*furthest, "X", ms=8, color=paint, mec=colour("card"), mew=0.8, zorder=8)
    ax.plot(*left, "o", ms=9, mfc="none", mec=paint, mew=2.2, zorder=8)
    # Each text above or below its mark, away from the other one, and towards the middle of the drawing.
    up = 1 if furthest[1] >= left[1] else -1
    across = 1 if 0.5 * (left[0] + furthest[0]) < np.mean(ax.get_xlim()) else -1
    for (x, y), told, way in (
        (left, f"left at {worst.left_s:.1f} s", -up),
        (furthest, f"{worst.beyond_m:.2g} m out at {worst.worst_s:.1f} s", up),
    ):
        side = "left" if across > 0 else "right"
        ax.annotate(
            told, (x, y), (8 * across, 12 * way), textcoords="offset points", ha=side, va="center", zorder=9, **_MARKED
        )


def _places(flight: FlightData) -> Floats:
    """Return the targets as points: each waypoint once, or the whole of a trajectory."""
    _, states = flight.targets
    changes = np.flatnonzero(np.any(states[1:] != states[:-1], axis=1)) + 1
    return np.asarray(states[[0, *changes]])


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
    sides = sorted(SEEN[axis][1] * side for side in (design.state_box.lower[index], design.state_box.upper[index]))
    return float(sides[0]), float(sides[1])


def varies(values: Floats) -> bool:
    """Return whether there are two different finite values at least: one alone makes no plot."""
    known = values[np.isfinite(values)]
    return bool(len(known)) and float(np.ptp(known)) > 0.0


def axes_over_time(flight: FlightData) -> Iterator[Drawing]:
    """Draw position and velocity of each axis over time against their limits, the positions first."""
    design = flight.design
    for axis, index in zip(design.axes, design.position_index, strict=True):
        if _moves(flight, index):
            yield _state_over_time(flight, axis, index, f"{SEEN[axis][0]} [m]", SEEN[axis][0].capitalize())
    for axis, index in zip(design.axes, design.velocity_index, strict=True):
        if _moves(flight, index):
            yield _state_over_time(flight, axis, index, f"{RATE[axis]} [m/s]", RATE[axis].capitalize())


def _moves(flight: FlightData, index: int) -> bool:
    """Return whether a state, believed or true, has more than one value."""
    believed = np.array([one.mean[index] for one in trusted(flight)])
    return varies(believed) or varies(np.array([one.state[index] for one in flight.truths]))


def _state_over_time(flight: FlightData, axis: str, index: int, y_label: str, title: str) -> Drawing:
    key, sign = f"state-{index}", SEEN[axis][1]
    outside = state_beyond(flight, index)
    with canvas(key, 2.3) as one:
        ax = one.axes(title, "time [s]", y_label)
        shade_fallback(ax, flight)
        draw_limits(ax, flight, index, sign)
        estimates = trusted(flight)
        estimate_s, estimate = thin(
            flight.seconds([e.at_ns for e in estimates]), np.array([sign * e.mean[index] for e in estimates])
        )
        ax.plot(estimate_s, estimate, color=colour("estimate"), lw=2.6, alpha=0.5)
        truth_s, truth = thin(
            flight.seconds([t.at_ns for t in flight.truths]), np.array([sign * t.state[index] for t in flight.truths])
        )
        ax.plot(truth_s, truth, color=colour("truth"), lw=1.0)
        _draw_target(ax, flight, index, sign)
        steps = flight.steps
        ax.plot(steps.t_s[outside], sign * steps.state[outside, index], "x", ms=6, mew=1.6, color=colour("limit"))
        span(ax, flight)
    return Drawing(key, one.svg, f"{title} over time against its limits")


def state_beyond(flight: FlightData, index: int) -> NDArray[np.bool_]:
    """Return at which flown boundaries a limit that a state has a part in is violated (n,)."""
    states, limits = flight.steps.state, limits_at(flight, flight.steps.t_s)
    rows = np.flatnonzero([normal[index] != 0.0 for normal in flight.design.c_x])
    return _beyond(states, np.array(flight.design.c_x)[rows], limits[:, rows], RELATIVE_TOLERANCE)


def input_beyond(flight: FlightData, number: int) -> NDArray[np.bool_]:
    """Return at which flown boundaries a limit that an input has a part in is violated, as decided or applied (n,)."""
    design, steps = flight.design, flight.steps
    rows = np.flatnonzero([normal[number] != 0.0 for normal in design.c_u])
    c, b = np.array(design.c_u)[rows], np.array(design.b_u)[rows]
    outside = ~np.isnan(steps.decided).any(axis=1) & _beyond(steps.decided, c, b, RELATIVE_TOLERANCE)
    return outside | _beyond(steps.input, c, b, WIRE_TOLERANCE) if steps.from_truth else outside


def _beyond(values: Floats, c: Floats, b: Floats, tolerance: float) -> NDArray[np.bool_]:
    normals = c.reshape(-1, values.shape[1])
    return np.asarray(~(values @ normals.T <= b + tolerance * np.maximum(1.0, np.abs(b))).all(axis=1))


def _draw_target(ax: Axes, flight: FlightData, index: int, sign: float) -> None:
    """Draw the target of a state over time: steps between waypoints, or a trajectory."""
    t_s, states = flight.targets
    ends_s = np.append(t_s, flight.duration_s)
    values = sign * np.append(states[:, index], states[-1, index])
    ax.step(*thin(ends_s, values), where="post", color=colour("target"), lw=1.1, ls=DOTTED)


def draw_limits(ax: Axes, flight: FlightData, index: int, sign: float) -> None:
    """Draw the limits of a state, and the reserve that each plan keeps from them at its end."""
    box = flight.design.state_box
    plans = list(flight.flown_plans.values())
    t_s = flight.seconds([plan.base_ns for plan in plans])
    all_s = np.linspace(0.0, flight.duration_s, LIMIT_POINTS)
    at_plans, at_all = box_at(flight, t_s), box_at(flight, all_s)
    for which, row, inwards in ((0, box.row_lower[index], 1.0), (1, box.row_upper[index], -1.0)):
        if row < 0:
            continue
        side, over = at_plans[which][:, index], at_all[which][:, index]
        if np.ptp(over):
            ax.plot(all_s, sign * over, color=colour("limit"), lw=1.2, ls=DASHED)
        else:
            ax.axhline(sign * over[0], color=colour("limit"), lw=1.2, ls=DASHED)
        scale = abs(flight.design.c_x[row][index])
        reserve = np.array([max(stage[row] for stage in plan.backoff_x) for plan in plans]) / scale
        if len(plans):
            # The last one is flown to the end of its step, or on through a silence.
            ends_s = np.append(t_s, _played_until_s(flight))
            shown_s, kept = thin(ends_s, np.append(side + inwards * reserve, side[-1] + inwards * reserve[-1]))
            limit = np.interp(shown_s, t_s, side)
            ax.fill_between(shown_s, sign * limit, sign * kept, step="post", color=colour("limit"), alpha=0.13, lw=0)


def _played_until_s(flight: FlightData) -> float:
    """Return the end of the last tick that flew a plan [s]."""
    last = next(d for d in reversed(flight.decisions) if d.plan_seq in flight.flown_plans)
    return float(flight.seconds([last.at_ns + flight.tick_ns])[0])


def plans_against_flown(flight: FlightData) -> Iterator[Drawing]:
    """Draw a few plans over what was then flown, axis by axis."""
    chosen = choose_plans(flight)
    if not chosen:
        return
    end_s = max(_plan_times(flight, plan)[-1] for plan in chosen)
    if {"north", "east"} <= set(flight.design.axes):
        yield _plans_above(flight, chosen, end_s)
    for axis, index in zip(flight.design.axes, flight.design.position_index, strict=True):
        name, sign = SEEN[axis]
        key = f"plan-{index}"
        with canvas(key, 2.5) as one:
            ax = one.axes(name.capitalize(), "time [s]", f"{name} [m]")
            for plan in chosen:
                _draw_plan(ax, flight, plan, index, sign)
            known = flight.truths or flight.estimates
            t_s = flight.seconds([k.at_ns for k in known])
            flown = np.array([sign * x for x in _component(flight, index)])
            shown = t_s <= end_s
            ax.plot(*thin(t_s[shown], flown[shown]), color=colour("truth"), lw=1.5, zorder=4)
            ax.set_xlim(0, end_s)
        yield Drawing(
            key, one.svg, f"{name.capitalize()}: {len(chosen)} plans with their back-off against what was flown"
        )


def _plans_above(flight: FlightData, chosen: list[Plan], end_s: float) -> Drawing:
    """Draw a few plans over what was then flown, from above."""
    design, (t_s, position) = flight.design, course(flight)
    flown = along(position[t_s <= end_s])
    with canvas("plan-above", 2.5) as one:
        ax = one.axes("From above", "east [m]", "north [m]")
        one.seen = "above"
        for plan in chosen:
            north, east, _ = np.array([design.position_of(state) for state in plan.states]).T
            ax.plot(east, north, "-", color=colour("plan"), lw=1.3, marker=".", ms=3, zorder=3)
            ax.plot(east[0], north[0], "o", ms=4.5, color=colour("plan"), zorder=5)
        ax.plot(flown[:, 1], flown[:, 0], color=colour("truth"), lw=1.5, zorder=4)
        ax.set_aspect("equal", adjustable="datalim")
    return Drawing("plan-above", one.svg, f"{len(chosen)} plans against what was flown, seen from above")


def course(flight: FlightData) -> tuple[Floats, Floats]:
    """Where it was: times (n,) [s] and positions (n, 3), local NED; the true ones where they are known."""
    known = flight.truths or flight.estimates
    points = [t.position_m for t in flight.truths] or [flight.design.position_of(e.mean) for e in flight.estimates]
    return flight.seconds([one.at_ns for one in known]), np.array(points).reshape(-1, 3)


def _component(flight: FlightData, index: int) -> list[float]:
    if flight.truths:
        return [truth.state[index] for truth in flight.truths]
    return [estimate.mean[index] for estimate in flight.estimates]


def _draw_plan(ax: Axes, flight: FlightData, plan: Plan, index: int, sign: float) -> None:
    """Draw a plan's predicted mean, and its back-off: the reserve for disturbance and estimation error."""
    t_s = _plan_times(flight, plan)
    mean = np.array([state[index] for state in plan.states])
    box, rows = flight.design.state_box, np.array(plan.backoff_x)
    below, above = (
        rows[:, row] / abs(flight.design.c_x[row][index]) if row >= 0 else np.zeros(len(mean))
        for row in (box.row_lower[index], box.row_upper[index])
    )
    ax.fill_between(t_s, sign * (mean - below), sign * (mean + above), color=colour("plan"), alpha=0.16, lw=0)
    ax.plot(t_s, sign * mean, "-", color=colour("plan"), lw=1.3, marker=".", ms=3, zorder=3)
    ax.plot(t_s[0], sign * mean[0], "o", ms=4.5, color=colour("plan"), zorder=5)


def _plan_times(flight: FlightData, plan: Plan) -> Floats:
    return np.asarray(flight.seconds([plan.base_ns])[0] + flight.design.dt_s * np.arange(len(plan.states)))


def choose_plans(flight: FlightData) -> list[Plan]:
    """Choose at most six plans on the way to the target: of each sixth of it the one flown longest."""
    steps, plans = flight.steps, flight.flown_plans
    error_m = position_error_m(flight)
    if not plans or not len(steps):
        return []
    near = np.flatnonzero(error_m <= ARRIVED_SHARE * error_m[0])
    arrived_s = float(steps.t_s[near[0] if len(near) else -1])
    window_s = max(arrived_s * 1.2, PLANS_SHOWN * flight.design.horizon * flight.design.dt_s * 0.6)
    played: dict[int, int] = {}
    for decision in steps.decisions:
        if decision.plan_seq in plans and decision.plan_index is not None:
            played[decision.plan_seq] = max(played.get(decision.plan_seq, 0), decision.plan_index)
    best: dict[int, Plan] = {}
    for seq, index in played.items():
        part = int(flight.seconds([plans[seq].base_ns])[0] / window_s * PLANS_SHOWN)
        if part < PLANS_SHOWN and (part not in best or index > played[best[part].seq]):
            best[part] = plans[seq]
    return list(best.values())


def shade_fallback(ax: Axes, flight: FlightData) -> None:
    """Shade the spans of time in which the fallback flew."""
    for begun_s, ended_s in flight.fallback_spans:
        ax.axvspan(begun_s, ended_s, color=colour("fallback"), alpha=0.22, lw=0)


def span(ax: Axes, flight: FlightData) -> None:
    """Set the time axis to the whole flight."""
    ax.set_xlim(0, max(flight.duration_s, flight.design.dt_s))


def thin(t_s: Floats, values: Floats) -> tuple[Floats, Floats]:
    """Thin points to about `POINTS`, keeping each bucket's smallest and largest value; drop what is not finite."""
    kept = np.isfinite(values)
    t_s, values = t_s[kept], values[kept]
    if len(values) <= POINTS:
        return t_s, values
    width = -(-len(values) // (POINTS // 2))
    index = [
        start + place
        for start in range(0, len(values), width)
        for bucket in (values[start : start + width],)
        for place in sorted({int(bucket.argmin()), int(bucket.argmax())})
    ]
    return t_s[index], values[index]


def along(points: Floats) -> Floats:
    """Thin a path (n, 3) to about `POINTS` rows, evenly by distance flown, so a long hover takes none from the way."""
    points = points.reshape(-1, 3)
    finite = points[np.isfinite(points).all(axis=1)]
    if len(finite) <= POINTS:
        return finite
    gone = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(finite, axis=0), axis=1))])
    return np.asarray(finite[np.unique(np.searchsorted(gone, np.linspace(0.0, gone[-1], POINTS)))])


def _thin(points: Floats) -> Floats:
    """Thin rows evenly to about `POINTS`; drop those that are not finite."""
    finite = points[np.isfinite(points).all(axis=1)]
    return finite[:: max(1, -(-len(finite) // POINTS))]


# The path in three dimensions, drawn flat: a fixed view from the south-east and above that needs no script.


OPEN_M = 1.0  # an open side of the room is drawn so far beyond what was flown
_STAGES = (3, 6, 12)  # of a plan whose spread is shown
_LINES = 20.0  # of the floor's grid, at most, in each direction
_DROPS = 12  # lines from the path to the floor
_SHOWN = VIEWS["deep"][1]


def path_3d(flight: FlightData) -> Drawing | None:
    """Draw path, plans with their spread, limits and target in 3D.

    None for a plant that does not move in three axes, or where no position is known.
    """
    if len(flight.design.axes) < 3 or not len(_flown_m(flight)):
        return None
    path_m, key = _flown_m(flight), "path-3d"
    lower, upper = _room(flight.design, path_m)
    with canvas(key, 3.7) as one:
        ax = one.figure.add_axes((0.04, 0.05, 0.92, 0.93))
        one.seen = "deep"
        one.figure.set_layout_engine(None)
        ax.set_axis_off()
        ax.set_aspect("equal", adjustable="datalim")
        _draw_room_3d(ax, lower, upper)
        _draw_fences_3d(ax, flight, lower, upper)
        _draw_path(ax, path_m, upper[2], "truth" if flight.truths else "estimate")
        for plan in choose_plans(flight):
            _draw_plan_3d(ax, flight.design, plan)
        _draw_places(ax, flight, path_m, upper[2])
        for worst in excursions(flight)[:1]:
            mark_excursion(ax, worst, *shown(np.array([worst.left_m, worst.worst_m])))
        ax.margins(0.03)
    label = "Path in three dimensions, seen from the south-east and above, within the position limits"
    return Drawing(key, one.svg, label)


def shown(places_m: Floats) -> Floats:
    """Project places in local NED (n, 3) [m] onto the page (n, 2)."""
    return np.asarray(places_m @ _SHOWN.T)


def outline(semi_axes_m: Floats) -> tuple[float, float, float]:
    """Return width, height and tilt [degrees] of the ellipse on the page that outlines an ellipsoid.

    The ellipsoid is axis-parallel, with semi-axes (3,) [m]. The shadow of
    {x | xᵀ D⁻² x <= 1} under P is {y | yᵀ (P D² Pᵀ)⁻¹ y <= 1}.
    """
    sizes, directions = np.linalg.eigh(_SHOWN @ np.diag(semi_axes_m**2) @ _SHOWN.T)
    height, width = 2.0 * np.sqrt(np.maximum(sizes, 0.0))
    return float(width), float(height), float(np.degrees(np.arctan2(directions[1, 1], directions[0, 1])))


def _flown_m(flight: FlightData) -> Floats:
    """Return the flown path (n, 3) [m], thinned: by the truth if that is known, else by the estimate."""
    return along(course(flight)[1])


def _room(design: DesignView, path_m: Floats) -> tuple[Floats, Floats]:
    """Return two corners of the room (3,) [m]: the limits, or a little beyond the flight where a side is open."""
    box = design.state_box
    seen = np.vstack([path_m, design.target_m])
    low = np.array(design.position_of(box.lower.tolist()))
    high = np.array(design.position_of(box.upper.tolist()))
    return (
        np.where(np.isfinite(low), low, seen.min(axis=0) - OPEN_M),
        np.where(np.isfinite(high), high, seen.max(axis=0) + OPEN_M),
    )


def _draw_room_3d(ax: Axes, lower: Floats, upper: Floats) -> None:
    """Draw the floor with its grid, and the edges of the room with their lengths."""
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


def _draw_fences_3d(ax: Axes, flight: FlightData, lower: Floats, upper: Floats) -> None:
    """Draw each limit that moves as a wall where it was at its tightest."""
    for fence in fences(flight):
        low, high = lower.copy(), upper.copy()
        low[AXIS_NUMBER[fence.axis]] = high[AXIS_NUMBER[fence.axis]] = fence.tightest_m
        corners = np.array(list(product(*zip(low, high, strict=True))))
        wall = np.unique(corners, axis=0)[[0, 1, 3, 2]]
        ax.fill(*shown(wall).T, fc=colour("limit"), ec=colour("limit"), alpha=0.16, lw=1.2, zorder=1)


def grid_m(lower: float, upper: float) -> Floats:
    """Return places of grid lines [m]: each metre, or each 10, 100, … in a larger room."""
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
    """Draw the path, its shadow on the floor, and vertical lines between them."""
    shadow = path_m.copy()
    shadow[:, 2] = floor_m
    ax.plot(*shown(shadow).T, color=colour("muted"), lw=1.0, alpha=0.6, zorder=2)
    ax.plot(*shown(path_m).T, color=colour(role), lw=1.5, zorder=5)
    gone = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path_m, axis=0), axis=1))])
    for place in np.searchsorted(gone, np.linspace(0.0, gone[-1], _DROPS)).tolist():
        ax.plot(*shown(np.array([path_m[place], shadow[place]])).T, color=colour("muted"), lw=0.7, alpha=0.6, zorder=2)


def _draw_plan_3d(ax: Axes, design: DesignView, plan: Plan) -> None:
    """Draw a plan's mean and, at a few stages, ellipsoids with its back-offs as semi-axes."""
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
    """Return the largest back-off from a limit of each state (n_x,), in its unit; 0 without limits."""
    box, reach = design.state_box, [0.0] * len(design.target)
    for state in design.position_index:
        for row in (int(box.row_lower[state]), int(box.row_upper[state])):
            if row >= 0:
                reach[state] = max(reach[state], backoff[row] / abs(design.c_x[row][state]))
    return reach


def _draw_places(ax: Axes, flight: FlightData, path_m: Floats, floor_m: float) -> None:
    """Draw start and targets, each over its point of the floor."""
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
