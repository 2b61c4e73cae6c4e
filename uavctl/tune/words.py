"""A tuning run in words and rows, as terminal and page show them."""

from __future__ import annotations

from collections.abc import Iterator

from uavctl.tune.change import Change, TunedResult
from uavctl.tune.comparison import PLANNED_AHEAD_S, TuneComparison
from uavctl.tune.response import PredictionErrors

CHANGE_COLUMNS = ("value", "old", "the flight says", "new", "why")
FIGURE_COLUMNS = ("figure", "before", "after", "after / before")
_NONE = "–"


def change_rows(told: TunedResult) -> Iterator[tuple[str, ...]]:
    """Each value: its name, what it was, what the flight says, what it is, and why."""
    for row in told.changes:
        yield (name_of(row), f"{row.old:.4g}", _said(row), f"{row.new:.4g}" if row.changed else "=", row.reason)


def name_of(row: Change) -> str:
    """Key, axis and unit of a value."""
    unit = f" [{row.unit}]" if row.unit else ""
    return f"{row.key}{f' {row.axis}' if row.axis else ''}{unit}"


def error_columns(errors: PredictionErrors) -> tuple[str, ...]:
    """Headings of the errors of prediction."""
    return ("axis", "model", *(f"{time_s:g} s [mm]" for time_s in errors.ahead_s))


def error_rows(old: PredictionErrors, new: PredictionErrors) -> Iterator[tuple[str, ...]]:
    """Rms errors of both models, axis by axis."""
    for axis, before, after in zip(old.axes, old.rms_m, new.rms_m, strict=True):
        for model, row in (("old", before), ("new", after)):
            yield (axis, model, *(f"{1e3 * value:.1f}" for value in row))


def figure_rows(found: TuneComparison) -> Iterator[tuple[str, ...]]:
    """Figures of both flights."""
    before, after = found.before, found.after
    yield _row("held to, rms [cm]", before.hold_rms_m, after.hold_rms_m, 100.0)
    yield _row("held to, at most [cm]", before.hold_max_m, after.hold_max_m, 100.0)
    yield _row(f"off the plan of {PLANNED_AHEAD_S:g} s before, rms [cm]", before.plan_rms_m, after.plan_rms_m, 100.0)
    yield _row("model off on the second flight [mm]", found.old_errors.overall_m, found.new_errors.overall_m, 1000.0)
    if before.beyond_box_m is not None and after.beyond_box_m is not None:
        yield ("room left in the box [m]", f"{-before.beyond_box_m:.2f}", f"{-after.beyond_box_m:.2f}", _NONE)
    yield ("fallbacks", str(before.fallbacks), str(after.fallbacks), _NONE)


def story(told: TunedResult, found: TuneComparison | None) -> list[str]:
    """What came of it, in sentences."""
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
