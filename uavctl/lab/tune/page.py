"""Page and summary of a tuning run."""

from __future__ import annotations

from collections.abc import Iterator

from logs.recording.flight import FlightData
from logs.recording.summary import position_error_m
from logs.report.page import Mark, PageSection, grid, page, table
from logs.report.plots import DASHED, DOTTED
from logs.report.svg import Drawing, canvas, colour
from uavctl.lab.tune.change import Change, PredictionErrors, TunedResult
from uavctl.lab.tune.excitation import SafeBox
from uavctl.lab.tune.run_folder import PLANNED_AHEAD_S, TuneComparison, TuneProgress, holding
from uavctl.smpc.plant import AXES

# A tuning run in words and rows, as terminal and page show them.


CHANGE_COLUMNS = ("value", "old", "the flight says", "new", "why")
FIGURE_COLUMNS = ("figure", "before", "after", "after / before")
_NONE = "–"


def change_rows(told: TunedResult) -> Iterator[tuple[str, ...]]:
    """Return a row for each value: name, old value, what the flight shows, new value, reason."""
    for row in told.changes:
        yield (name_of(row), f"{row.old:.4g}", _said(row), f"{row.new:.4g}" if row.changed else "=", row.reason)


def name_of(row: Change) -> str:
    """Return key, axis and unit of a value."""
    unit = f" [{row.unit}]" if row.unit else ""
    return f"{row.key}{f' {row.axis}' if row.axis else ''}{unit}"


def error_columns(errors: PredictionErrors) -> tuple[str, ...]:
    """Return the headings of the prediction errors."""
    return ("axis", "model", *(f"{time_s:g} s [mm]" for time_s in errors.ahead_s))


def error_rows(old: PredictionErrors, new: PredictionErrors) -> Iterator[tuple[str, ...]]:
    """Return the rms errors of both models, axis by axis."""
    for axis, before, after in zip(old.axes, old.rms_m, new.rms_m, strict=True):
        for model, row in (("old", before), ("new", after)):
            yield (axis, model, *(f"{1e3 * value:.1f}" for value in row))


def figure_rows(found: TuneComparison) -> Iterator[tuple[str, ...]]:
    """Return the figures of both flights."""
    before, after = found.before, found.after
    yield _row("held to, rms [cm]", before.hold_rms_m, after.hold_rms_m, 100.0)
    yield _row("held to, at most [cm]", before.hold_max_m, after.hold_max_m, 100.0)
    yield _row(f"off the plan of {PLANNED_AHEAD_S:g} s before, rms [cm]", before.plan_rms_m, after.plan_rms_m, 100.0)
    yield _row("model off on the second flight [mm]", found.old_errors.overall_m, found.new_errors.overall_m, 1000.0)
    if before.beyond_box_m is not None and after.beyond_box_m is not None:
        yield ("room left in the box [m]", f"{-before.beyond_box_m:.2f}", f"{-after.beyond_box_m:.2f}", _NONE)
    yield ("fallbacks", str(before.fallbacks), str(after.fallbacks), _NONE)


def story(told: TunedResult, found: TuneComparison | None) -> list[str]:
    """Return sentences on the result."""
    changed = sum(row.changed for row in told.changes)
    old_m, new_m = told.old_errors.overall_m, told.new_errors.overall_m
    said = [
        f"{changed} of {len(told.changes)} values of the configuration were changed.",
        f"On the halves of the first flight that it was not fitted to, the model is off by {1e3 * new_m:.1f} mm, not "
        f"{1e3 * old_m:.1f} mm (0.25 to 2 s ahead).",
    ]
    if found is not None:
        said.append(
            f"On the second flight, which neither was fitted to: {1e3 * found.new_errors.overall_m:.1f} mm instead of "
            f"{1e3 * found.old_errors.overall_m:.1f} mm."
        )
        before_m, after_m = found.before.hold_rms_m, found.after.hold_rms_m
        if before_m is not None and after_m is not None:
            said.append(
                f"The last place was held to {100.0 * after_m:.1f} cm (rms, {found.after.hold_s:.0f} s) instead of "
                f"{100.0 * before_m:.1f} cm, by the {found.after.judged_by}."
            )
    return [*said, *(f"{one}." for one in told.warnings)]


def _said(row: Change) -> str:
    if row.flight is None:
        return _NONE
    return f"{row.flight:.4g}" if row.std is None else f"{row.flight:.4g} ± {row.std:.2g}"


def _row(name: str, before: float | None, after: float | None, scale: float) -> tuple[str, ...]:
    ratio = _NONE if before is None or after is None or not before else f"{after / before:.2f}"
    return (name, *(_NONE if one is None else f"{scale * one:.1f}" for one in (before, after)), ratio)


# The page of a tuning run: what changed and why, and both flights in the same pictures.


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
    """Return the page of a run that is done as HTML.

    Args:
        progress: The run; changes and comparison are there.
        box: Where both were to stay; None with a recording.
    """
    assert progress.tuned is not None and progress.comparison is not None
    told, found = progress.tuned, progress.comparison
    sections = _sections(progress, found, before, after, box)
    return page("Tuned by flying", f"{found.before.recording}, {found.after.recording}", story(told, found), sections)


def _sections(
    progress: TuneProgress, found: TuneComparison, before: FlightData, after: FlightData, box: SafeBox | None
) -> Iterator[PageSection]:
    assert progress.tuned is not None
    told = progress.tuned
    yield PageSection("Both flights", _FIGURES, table(FIGURE_COLUMNS, figure_rows(found), frozenset({1, 2, 3})))
    yield PageSection("How the place was held", _HOLD, grid([_held(before, after)]), _MARKS)
    yield PageSection("What changes", _CHANGES, table(CHANGE_COLUMNS, change_rows(told), frozenset({1, 2, 3})))
    yield _prediction("first", "Prediction on the first flight", _ON_FIRST, told.old_errors, told.new_errors)
    yield _prediction("second", "Prediction on the second flight", _ON_SECOND, found.old_errors, found.new_errors)
    drawings = [_axis(before, after, name, place, box) for place, name in enumerate(before.design.axes)]
    yield PageSection("Motion", _MOTION, grid(drawings), (*_MARKS, _TARGET, *([] if box is None else [_BOX])))


def _prediction(key: str, title: str, note: str, old: PredictionErrors, new: PredictionErrors) -> PageSection:
    columns = error_columns(old)
    body = table(columns, error_rows(old, new), frozenset(range(2, len(columns))))
    return PageSection(title, note, body + grid([_growing(key, old, new)]), _MODELS)


def _held(before: FlightData, after: FlightData) -> Drawing:
    with canvas("held", _HEIGHT_IN) as drawn:
        ax = drawn.axes("Distance from the last place", "time of holding [s]", "distance [cm]")
        for flight, role in ((before, _BEFORE), (after, _AFTER)):
            held, steps = holding(flight), flight.steps
            if not held.any():
                continue
            off = position_error_m(flight)[held]
            ax.plot(steps.t_s[held] - steps.t_s[held][0], 100.0 * off, color=colour(role))
        ax.set_ylim(bottom=0.0)
    return Drawing("held", drawn.svg, "distance from the last place over the time of holding, of both flights")


def _growing(key: str, old: PredictionErrors, new: PredictionErrors) -> Drawing:
    """Draw how errors grow with the time ahead, a line for each axis."""
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
