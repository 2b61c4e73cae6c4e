"""The page of a tuning run: what changed and why, and both flights in the same pictures."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from logs.flight_data import FlightData
from logs.page import Mark, Section, grid, page, table
from logs.plots import DASHED, DOTTED
from logs.svg import Drawing, canvas, colour
from uavctl.tune.comparison import TuneComparison, holding
from uavctl.tune.excitation import AXES, SafeBox
from uavctl.tune.response import PredictionErrors
from uavctl.tune.run_folder import TuneProgress
from uavctl.tune.words import CHANGE_COLUMNS, FIGURE_COLUMNS, change_rows, error_columns, error_rows, figure_rows, story

_HEIGHT_IN = 2.6
_BEFORE, _AFTER = "sample", "estimate"  # roles of the colours
_MARKS = (Mark("line", _BEFORE, "before"), Mark("line", _AFTER, "after"))
_MODELS = (Mark("line", _BEFORE, "old model"), Mark("line", _AFTER, "new model"))
_TARGET, _BOX = Mark("dotted", "target", "place to fly to, before"), Mark("dashed", "limit", "box")
_CHANGES = (
    "Taken over is what the flight tells well; ± is the standard error. Noise, loss and delay are raised where the "
    "flight was worse than believed, and never lowered. An = is a value that stays."
)
_FIGURES = (
    "Held: distance from the last place, from 5 s after it became the one to fly to. Off the plan: how far the vehicle "
    "was from where the plan of half a second before had it. The model is off by the geometric mean of errors below."
)
_ERROR = "Root mean square of the motion over the next step and the next 0.25 to 2 s that is not told, "
_ON_FIRST = f"{_ERROR}each half of the flight by plants fitted to the other."
_ON_SECOND = f"{_ERROR}of a flight that neither was fitted to."
_MOTION = "Positions, by the true states if they were recorded, else by the controllers' estimates."
_HOLD = "Distance from the last place, from when it was to be held."


def write_page(progress: TuneProgress, before: FlightData, after: FlightData, box: SafeBox | None) -> str:
    """HTML of a run that is done.

    Args:
        progress: The run; changes and comparison are there.
        before: The first flight.
        after: The second.
        box: Where both were to stay; None with a recording.
    """
    assert progress.tuned is not None and progress.comparison is not None
    told, found = progress.tuned, progress.comparison
    sections = _sections(progress, found, before, after, box)
    return page("Tuned by flying", f"{found.before.recording}, {found.after.recording}", story(told, found), sections)


def _sections(
    progress: TuneProgress, found: TuneComparison, before: FlightData, after: FlightData, box: SafeBox | None
) -> Iterator[Section]:
    assert progress.tuned is not None
    told = progress.tuned
    yield Section("Both flights", _FIGURES, table(FIGURE_COLUMNS, figure_rows(found), frozenset({1, 2, 3})))
    yield Section("How the place was held", _HOLD, grid([_held(before, after)]), _MARKS)
    yield Section("What changes", _CHANGES, table(CHANGE_COLUMNS, change_rows(told), frozenset({1, 2, 3})))
    yield _prediction("first", "Prediction on the first flight", _ON_FIRST, told.old_errors, told.new_errors)
    yield _prediction("second", "Prediction on the second flight", _ON_SECOND, found.old_errors, found.new_errors)
    drawings = [_axis(before, after, name, place, box) for place, name in enumerate(before.design.axes)]
    yield Section("Motion", _MOTION, grid(drawings), (*_MARKS, _TARGET, *([] if box is None else [_BOX])))


def _prediction(key: str, title: str, note: str, old: PredictionErrors, new: PredictionErrors) -> Section:
    columns = error_columns(old)
    body = table(columns, error_rows(old, new), frozenset(range(2, len(columns))))
    return Section(title, note, body + grid([_growing(key, old, new)]), _MODELS)


def _held(before: FlightData, after: FlightData) -> Drawing:
    with canvas("held", _HEIGHT_IN) as drawn:
        ax = drawn.axes("Distance from the last place", "time of holding [s]", "distance [cm]")
        for flight, role in ((before, _BEFORE), (after, _AFTER)):
            held, steps = holding(flight), flight.steps
            if not held.any():
                continue
            off = np.linalg.norm((steps.state - steps.target)[:, list(flight.design.position_index)], axis=1)[held]
            ax.plot(steps.t_s[held] - steps.t_s[held][0], 100.0 * off, color=colour(role))
        ax.set_ylim(bottom=0.0)
    return Drawing("held", drawn.svg, "distance from the last place over the time of holding, of both flights")


def _growing(key: str, old: PredictionErrors, new: PredictionErrors) -> Drawing:
    """How errors grow with the time ahead, a line each axis."""
    title = "Error over the time ahead, each axis"
    with canvas(f"growing-{key}", _HEIGHT_IN) as drawn:
        ax = drawn.axes(title, "time ahead [s]", "error [mm]")
        for errors, role in ((old, _BEFORE), (new, _AFTER)):
            for row in errors.rms_m:
                ax.plot(errors.ahead_s, [1e3 * value for value in row], color=colour(role), marker="o", markersize=3)
        ax.set_ylim(bottom=0.0)
    return Drawing(f"growing-{key}", drawn.svg, f"error of the old and the new model over the time ahead, {key} flight")


def _axis(before: FlightData, after: FlightData, name: str, place: int, box: SafeBox | None) -> Drawing:
    with canvas(f"motion-{name}", _HEIGHT_IN) as drawn:
        ax = drawn.axes(name, "time [s]", "position [m]")
        for flight, role in ((before, _BEFORE), (after, _AFTER)):
            index = flight.design.position_index[place]
            ax.plot(flight.steps.t_s, flight.steps.state[:, index], color=colour(role))
        index = before.design.position_index[place]
        ax.plot(before.steps.t_s, before.steps.target[:, index], color=colour("target"), ls=DOTTED, lw=1.1)
        if box is not None:
            for side in (box.lower, box.upper):
                ax.axhline(side[AXES.index(name)], color=colour("limit"), ls=DASHED, lw=1.0)
    return Drawing(f"motion-{name}", drawn.svg, f"position {name} of both flights over time, and the sides of the box")
