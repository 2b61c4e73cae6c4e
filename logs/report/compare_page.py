"""Page of a comparison: all flights in one drawing, and the tables of the terminal."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes

from logs.recording.design_view import AXIS_NUMBER
from logs.recording.flight import FlightData
from logs.recording.output_files import refuse_recording_path, write_atomically
from logs.report.compare import FlightComparison, LoadedFlight
from logs.report.compare_text import (
    convert_to_display_unit,
    describe_match,
    format_difference,
    format_label,
    format_parameter,
    format_value,
)
from logs.report.page import Mark, Part, Section, render_facts, render_list, render_page, render_table
from logs.report.plots import DASHED, DISPLAY_AXES, DOTTED, get_positions, position_limits, thin_path, thin_samples
from logs.report.svg import Canvas, Drawing, colour, open_canvas
from uavctl.arrays import Array
from uavctl.errors import UsageError

_ROLES = ("truth", "estimate", "sample", "plan", "target")
_MAX_WIDTH_PT, _MIN_WIDTH_PT = (
    3.2,
    0.8,
)  # lines of the first flight and of the last: where they are the same, all are seen
_MAX_COMPARED_COLUMNS = 2  # more columns would not fit on paper


def write_comparison_page(comparison: FlightComparison, recordings: Sequence[LoadedFlight], path: Path) -> None:
    """Write the page.

    Raises:
        RecordingError: The file cannot be written.
        UsageError: More flights than can be told apart in one drawing, or `path` is that of a recording.
    """
    refuse_recording_path(path)
    if len(recordings) > len(_ROLES):
        raise UsageError(
            f"--out draws {len(_ROLES)} flights at most, these are {len(recordings)}; compare fewer at a time"
        )
    write_atomically(path, render_comparison(ComparisonView(comparison, recordings)))


@dataclass(frozen=True, eq=False)
class ComparisonView:
    """What the page shows: the comparison, and the flights themselves."""

    comparison: FlightComparison
    recordings: Sequence[LoadedFlight]

    @property
    def flights(self) -> list[FlightData]:
        """The flights, the first one first."""
        return [recording.flight for recording in self.recordings]

    @property
    def names(self) -> list[str]:
        """Their names."""
        return [recording.identity.name for recording in self.recordings]

    @property
    def axes(self) -> list[str]:
        """Axes that all flights have."""
        return [axis for axis in self.flights[0].design.axes if all(axis in f.design.axes for f in self.flights)]


def render_comparison(view: ComparisonView) -> str:
    """Return the page of a comparison as HTML."""
    subtitle = f"The others are compared with {view.names[0]}."
    return render_page(f"Comparison of {len(view.recordings)} flights", subtitle, SECTIONS, view)


def _describe_likeness(view: ComparisonView) -> Iterator[Part]:
    matches = (describe_match(match, view.names[0]) for match in view.comparison.likenesses)
    yield render_list([*matches, *(f"Mind: {note}." for note in view.comparison.notes)])


def _draw_flights_over_time(view: ComparisonView) -> Iterator[Part]:
    yield from (_draw_position(view.flights, axis) for axis in view.axes)
    yield _draw_ages(view.flights)


def _list_marks(view: ComparisonView) -> Iterator[Mark]:
    yield from (Mark("line", role, name) for role, name in zip(_ROLES, view.names, strict=False))
    yield Mark("dashed", "limit", f"limit of {view.names[0]}")


def _draw_paths(flights: Sequence[FlightData], axes: Sequence[str]) -> Iterator[Drawing]:
    for key, title, axes_shown in (
        ("path-above", "From above", ("east", "north")),
        ("path-side", "From the south", ("east", "down")),
    ):
        if not set(axes_shown) <= set(axes):
            continue
        (x_name, x_sign), (y_name, y_sign) = (DISPLAY_AXES[axis] for axis in axes_shown)
        with open_canvas(key, 3.7) as canvas:
            ax = canvas.axes(title, f"{x_name} [m]", f"{y_name} [m]")
            for index, flight in enumerate(flights):
                points = thin_path(get_positions(flight)[1])
                x, y = (points[:, AXIS_NUMBER[axis]] for axis in axes_shown)
                ax.plot(x_sign * x, y_sign * y, color=colour(_ROLES[index]), lw=_compute_line_width(index, flights))
            for limit in _get_limits(flights[0], axes_shown[0]):
                ax.axvline(limit, color=colour("limit"), lw=1.0, ls=DASHED)
            for limit in _get_limits(flights[0], axes_shown[1]):
                ax.axhline(limit, color=colour("limit"), lw=1.0, ls=DASHED)
            ax.set_aspect("equal", adjustable="datalim")
        yield Drawing(key, canvas.svg, f"Paths of {len(flights)} flights: {x_name} and {y_name} in metres")


def _draw_position(flights: Sequence[FlightData], axis: str) -> Drawing:
    name, sign = DISPLAY_AXES[axis]

    def values(flight: FlightData) -> tuple[Array, Array]:
        t_s, points = get_positions(flight)
        return t_s, sign * points[:, AXIS_NUMBER[axis]]

    with open_canvas(f"position-{axis}", 2.3) as canvas:
        ax = _draw_overlay(canvas, name.capitalize(), f"{name} [m]", flights, values)
        for limit in _get_limits(flights[0], axis):
            ax.axhline(limit, color=colour("limit"), lw=1.0, ls=DASHED)
    return Drawing(f"position-{axis}", canvas.svg, f"{name.capitalize()} over time of {len(flights)} flights")


def _draw_ages(flights: Sequence[FlightData]) -> Drawing:
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
            color=colour(_ROLES[index]),
            lw=_compute_line_width(index, flights),
            drawstyle=drawstyle,
        )
    ax.set_xlim(0, max(flight.duration_s for flight in flights))
    return ax


def _compute_line_width(index: int, flights: Sequence[FlightData]) -> float:
    """Return the width of the line of flight `place` [pt]; the first is the widest, so that all are seen."""
    return float(np.linspace(_MAX_WIDTH_PT, _MIN_WIDTH_PT, len(flights))[index])


def _get_limits(flight: FlightData, axis: str) -> list[float]:
    """Return the finite limits of an axis' position [m], with the sign that the axis is drawn with."""
    return [limit for limit in position_limits(flight.design, axis) if np.isfinite(limit)]


def _show_recordings(view: ComparisonView) -> Iterator[Part]:
    yield render_facts(
        (
            recording.name,
            f"{recording.recording} · {recording.started_utc} · {recording.command} · "
            f"{recording.ended}{'' if recording.finished else ', torn'}",
        )
        for recording in view.comparison.recordings
    )


def _show_figures(view: ComparisonView) -> Iterator[Part]:
    """Return the first flight's figures beside those of the others, a few others in each table."""
    indices = range(1, len(view.recordings))
    for begin in range(0, len(indices), _MAX_COMPARED_COLUMNS):
        yield _make_figure_table(view, indices[begin : begin + _MAX_COMPARED_COLUMNS])


def _make_figure_table(view: ComparisonView, indices: Sequence[int]) -> Markup:
    first = view.names[0]
    columns = ["figure", first]
    for index in indices:
        name = view.names[index]
        columns += [name, f"{name} − {first}", f"{name} / {first}"]
    rows = []
    for figure in map(convert_to_display_unit, view.comparison.figures):
        cells = [format_value(figure.values[0])]
        for index in indices:
            cells += [format_value(figure.values[index]), format_difference(figure.differences[index - 1])]
            cells.append(format_value(figure.ratios[index - 1]))
        rows.append([format_label(figure), *(cell.replace("-", "−") for cell in cells)])
    return render_table(columns, rows, frozenset(range(1, len(columns))))


def _show_parameters(view: ComparisonView) -> Iterator[Part]:
    rows = [[entry.key, *map(format_parameter, entry.values)] for entry in view.comparison.parameters]
    if rows:
        yield render_table(["parameter", *view.names], rows, frozenset())


SECTIONS: tuple[Section[ComparisonView], ...] = (
    Section("How alike they are", _describe_likeness),
    Section("Recordings", _show_recordings),
    Section("Path", lambda view: _draw_paths(view.flights, view.axes), legend=_list_marks),
    Section(
        "Positions and age",
        _draw_flights_over_time,
        note="Time counts from each flight's first tick. Positions are the true ones where they are known.",
        legend=lambda view: (*_list_marks(view), Mark("dotted", "muted", "horizon H")),
    ),
    Section("Figures", _show_figures),
    Section("Parameters that differ", _show_parameters, otherwise="None."),
)
