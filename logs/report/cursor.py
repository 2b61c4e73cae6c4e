"""The page's cursor: one moment of the flight, moved by a slider through all drawings at once.

The drawings say where their axes are (`Canvas.cursor`); the script beside this file moves lines and dots over them. A
page whose script does not run lacks the slider, and nothing else.
"""

from __future__ import annotations

import json
from importlib import resources
from itertools import groupby

import numpy as np

from logs.recording.design_view import Floats
from logs.recording.flight import FlightData
from logs.recording.summary import box_at
from logs.report.excursion import trusted
from logs.report.plots import SEEN, VIEWS

POINTS = 500  # of a path, evenly in time


def script(flight: FlightData, at_s: float) -> str:
    """Return the script of a flight's page, which shows the moment `at_s` [s] first."""
    design = flight.design
    estimates = trusted(flight)
    believed_m = np.array([design.position_of(one.mean) for one in estimates]).reshape(-1, 3)
    course_m = np.array([one.position_m for one in flight.truths]).reshape(-1, 3)
    modes = [next(group) for _, group in groupby(flight.decisions, key=lambda one: one.mode)]
    data = {
        "end_s": round(flight.duration_s, 3),
        "step_s": round(flight.tick_ns * 1e-9, 3) or 0.01,
        "at_s": round(at_s, 3),
        "views": {name: matrix.tolist() for name, (_, matrix) in VIEWS.items()},
        "course": _rows(flight.seconds([one.at_ns for one in flight.truths]), course_m),
        "believed": _rows(flight.seconds([one.at_ns for one in estimates]), believed_m),
        "modes": [(round((one.at_ns - flight.origin_ns) * 1e-9, 3), one.mode) for one in modes],
        "fences": _fences(flight),
    }
    text = json.dumps(data, separators=(",", ":")).replace("</", "<\\/")
    return resources.files("logs.report").joinpath("cursor.js").read_text(encoding="utf-8").replace("DATA", text, 1)


def _rows(t_s: Floats, position_m: Floats) -> list[list[float]]:
    """Return rows of time [s] and place [m], thinned; those that are not finite are left out."""
    kept = np.flatnonzero(np.isfinite(position_m).all(axis=1))
    if len(kept) > POINTS:
        kept = kept[np.unique(np.linspace(0, len(kept) - 1, POINTS).astype(int))]
    table = np.column_stack([t_s[kept], position_m[kept]]).round(2)
    return [[value + 0.0 for value in row] for row in table.tolist()]


def _fences(flight: FlightData) -> list[dict[str, object]]:
    """Return the limits of position that move, for each view in which they are a line."""
    t_s = np.linspace(0.0, flight.duration_s, POINTS // 4)
    design, found = flight.design, []
    for view, (axes, _) in VIEWS.items():
        for axis in set(axes) & set(design.axes):
            for side in box_at(flight, t_s):
                values = SEEN[axis][1] * side[:, design.position_index[design.axes.index(axis)]]
                if np.isfinite(values).all() and np.ptp(values):
                    places = np.zeros((len(t_s), 3))
                    places[:, 0] = values
                    found.append({"view": view, "along": axis == axes[1], "rows": _rows(t_s, places)})
    return found
