"""Script of a flight's page: a cursor that shows one moment in all plots."""

from __future__ import annotations

import json
from importlib import resources
from itertools import groupby

import numpy as np

from logs.recording.flight import FlightData
from logs.recording.summary import compute_box
from logs.report.excursion import select_trusted_estimates
from logs.report.plots import DISPLAY_AXES, VIEWS
from uavctl.arrays import Array

MAX_POINTS = 500  # of a path, evenly in time


def render_cursor_script(flight: FlightData, at_s: float) -> str:
    """Return the script of a flight's page, which shows the moment `at_s` [s] first."""
    design = flight.design
    estimates = select_trusted_estimates(flight)
    estimated_m = np.array([design.position_of(estimate.mean) for estimate in estimates]).reshape(-1, 3)
    course_m = np.array([truth.position_m for truth in flight.truths]).reshape(-1, 3)
    modes = [next(group) for _, group in groupby(flight.decisions, key=lambda decision: decision.mode)]
    data = {
        "end_s": round(flight.duration_s, 3),
        "step_s": round(flight.tick_ns * 1e-9, 3) or 0.01,
        "at_s": round(at_s, 3),
        "views": {name: matrix.tolist() for name, (_, matrix) in VIEWS.items()},
        "course": _make_rows(flight.seconds([truth.at_ns for truth in flight.truths]), course_m),
        "estimated": _make_rows(flight.seconds([estimate.at_ns for estimate in estimates]), estimated_m),
        "modes": [(round((mode.at_ns - flight.origin_ns) * 1e-9, 3), mode.mode) for mode in modes],
        "fences": _list_moving_limits(flight),
    }
    text = json.dumps(data, separators=(",", ":")).replace("</", "<\\/")
    return resources.files("logs.report").joinpath("cursor.js").read_text(encoding="utf-8").replace("DATA", text, 1)


def _make_rows(t_s: Array, position_m: Array) -> list[list[float]]:
    """Return rows of time [s] and place [m], thinned; those that are not finite are left out."""
    indices = np.flatnonzero(np.isfinite(position_m).all(axis=1))
    if len(indices) > MAX_POINTS:
        indices = indices[np.unique(np.linspace(0, len(indices) - 1, MAX_POINTS).astype(int))]
    table = np.column_stack([t_s[indices], position_m[indices]]).round(2)
    return [[value + 0.0 for value in row] for row in table.tolist()]


def _list_moving_limits(flight: FlightData) -> list[dict[str, object]]:
    """Return the limits of position that move, for each view in which they are a line."""
    t_s = np.linspace(0.0, flight.duration_s, MAX_POINTS // 4)
    design, limits = flight.design, []
    for view, (axes, _) in VIEWS.items():
        for axis in set(axes) & set(design.axes):
            for side in compute_box(flight, t_s):
                values = DISPLAY_AXES[axis][1] * side[:, design.position_index[design.axes.index(axis)]]
                if np.isfinite(values).all() and np.ptp(values):
                    positions = np.zeros((len(t_s), 3))
                    positions[:, 0] = values
                    limits.append({"view": view, "along": axis == axes[1], "rows": _make_rows(t_s, positions)})
    return limits
