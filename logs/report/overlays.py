"""Figures of several flights over each other: paths, positions and ages, each flight in its own colour."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np
from matplotlib.axes import Axes

from logs.recording.design_view import AXIS_NUMBER
from logs.recording.flight import FlightData
from logs.report.plots import (
    DASHED,
    DISPLAY_AXES,
    DOTTED,
    PATH_VIEWS,
    draw_limits,
    draw_target,
    get_positions,
    position_limits,
    thin_path,
    thin_samples,
)
from logs.report.svg import Canvas, Drawing, colour, open_canvas
from uavctl.arrays import Array

ROLES = ("truth", "sample", "estimate", "plan", "target")  # of the flights' colours, in their order
# Lines of the first flight and of the last: where flights are the same, all are seen.
_MAX_WIDTH_PT, _MIN_WIDTH_PT = 3.2, 0.8


def draw_paths(flights: Sequence[FlightData]) -> Iterator[Drawing]:
    """Draw the paths from above and from the south, with the limits of the first flight."""
    axes = _find_common_axes(flights)
    for key, title, axes_shown in PATH_VIEWS:
        if not set(axes_shown) <= set(axes):
            continue
        (x_name, x_sign), (y_name, y_sign) = (DISPLAY_AXES[axis] for axis in axes_shown)
        with open_canvas(key, 3.7) as canvas:
            ax = canvas.axes(title, f"{x_name} [m]", f"{y_name} [m]")
            for index, flight in enumerate(flights):
                points = thin_path(get_positions(flight)[1])
                x, y = (points[:, AXIS_NUMBER[axis]] for axis in axes_shown)
                ax.plot(x_sign * x, y_sign * y, color=colour(ROLES[index]), lw=_compute_line_width(index, flights))
            for limit in _get_limits(flights[0], axes_shown[0]):
                ax.axvline(limit, color=colour("limit"), lw=1.0, ls=DASHED)
            for limit in _get_limits(flights[0], axes_shown[1]):
                ax.axhline(limit, color=colour("limit"), lw=1.0, ls=DASHED)
            ax.set_aspect("equal", adjustable="datalim")
        yield Drawing(key, canvas.svg, f"Paths of {len(flights)} flights: {x_name} and {y_name} in metres")


def draw_positions(flights: Sequence[FlightData], planned: FlightData | None = None) -> Iterator[Drawing]:
    """Draw the position on each axis that all flights have.

    Args:
        planned: Flight whose limits, reserves and target are shown; else the limits of the first one alone.
    """
    for axis in _find_common_axes(flights):
        yield _draw_position(flights, axis, planned)


def _draw_position(flights: Sequence[FlightData], axis: str, planned: FlightData | None) -> Drawing:
    name, sign = DISPLAY_AXES[axis]

    def values(flight: FlightData) -> tuple[Array, Array]:
        t_s, points = get_positions(flight)
        return t_s, sign * points[:, AXIS_NUMBER[axis]]

    with open_canvas(f"position-{axis}", 2.3) as canvas:
        ax = _draw_overlay(canvas, name.capitalize(), f"{name} [m]", flights, values)
        if planned is None:
            for limit in _get_limits(flights[0], axis):
                ax.axhline(limit, color=colour("limit"), lw=1.0, ls=DASHED)
        else:
            state = planned.design.position_index[planned.design.axes.index(axis)]
            draw_limits(ax, planned, state, sign)
            draw_target(ax, planned, state, sign)
    return Drawing(f"position-{axis}", canvas.svg, f"{name.capitalize()} over time of {len(flights)} flights")


def draw_ages(flights: Sequence[FlightData]) -> Drawing:
    """Draw the age of information at each flown tick, and the horizons."""

    def values(flight: FlightData) -> tuple[Array, Array]:
        ages = [(d.at_ns, float(d.age_steps)) for d in flight.flown if d.age_steps is not None]
        return flight.seconds([at_ns for at_ns, _ in ages]), np.array([age for _, age in ages])

    horizons = sorted({float(flight.design.horizon) for flight in flights})
    with open_canvas("age", 2.3) as canvas:
        ax = _draw_overlay(canvas, "Age of information", "age [steps]", flights, values, "steps-post")
        for horizon in horizons:
            ax.axhline(horizon, color=colour("muted"), lw=1.0, ls=DOTTED)
    return Drawing("age", canvas.svg, f"Age of information over time of {len(flights)} flights")


def _draw_overlay(
    canvas: Canvas,
    title: str,
    y_label: str,
    flights: Sequence[FlightData],
    values: Callable[[FlightData], tuple[Array, Array]],
    drawstyle: str = "default",
) -> Axes:
    ax = canvas.axes(title, "time [s]", y_label)
    for index, flight in enumerate(flights):
        ax.plot(
            *thin_samples(*values(flight)),
            color=colour(ROLES[index]),
            lw=_compute_line_width(index, flights),
            drawstyle=drawstyle,
        )
    ax.set_xlim(0, max(flight.duration_s for flight in flights))
    return ax


def _compute_line_width(index: int, flights: Sequence[FlightData]) -> float:
    """Return the width of the line of a flight [pt]; the first is the widest, so that all are seen."""
    return float(np.linspace(_MAX_WIDTH_PT, _MIN_WIDTH_PT, len(flights))[index])


def _find_common_axes(flights: Sequence[FlightData]) -> list[str]:
    return [axis for axis in flights[0].design.axes if all(axis in flight.design.axes for flight in flights)]


def _get_limits(flight: FlightData, axis: str) -> list[float]:
    """Return the finite limits of an axis' position [m], with the sign that the axis is drawn with."""
    return [limit for limit in position_limits(flight.design, axis) if np.isfinite(limit)]
