"""The page of a comparison: flights in one drawing, and the tables of the terminal."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from logs import page
from logs.compare import Comparison
from logs.compare_side import Loaded
from logs.compare_words import difference, for_people, label, likeness, measured, parameter
from logs.design_view import AXIS_NUMBER, Floats
from logs.flight_data import FlightData
from logs.outputs import spare_recording, write_whole
from logs.page import Mark, Section
from logs.plots import DASHED, DOTTED, SEEN, along, thin
from logs.svg import Canvas, Drawing, canvas, colour
from uavctl.errors import UsageError

_ROLES = ("truth", "estimate", "sample", "plan", "target")
_LIMIT = Mark("dashed", "limit", "limit of A")
_HORIZON = Mark("dotted", "muted", "horizon H")
_WIDEST, _FINEST = 3.2, 0.8  # lines of the first flight and of the last: where they are the same, all are seen
_OTHERS_OF_A_TABLE = 2  # more columns would not fit on paper


def write_page(found: Comparison, loaded: Sequence[Loaded], path: Path) -> None:
    """Write the page.

    Raises:
        RecordingError: The file cannot be written.
        UsageError: More flights than can be told apart in one drawing, or `path` is that of a recording.
    """
    spare_recording(path)
    if len(loaded) > len(_ROLES):
        raise UsageError(f"--out draws {len(_ROLES)} flights at most, these are {len(loaded)}; compare fewer at a time")
    write_whole(path, comparison_html(found, loaded))


def comparison_html(found: Comparison, loaded: Sequence[Loaded]) -> str:
    """The page as text."""
    names = [one.side.name for one in loaded]
    story = [*map(likeness, found.likenesses), *(f"Mind: {note}." for note in found.notes)]
    title = f"Flights {', '.join(names)}"
    return page.page(
        title, "The first is what the others are compared with.", story, _sections(found, loaded), "How alike they are"
    )


def _sections(found: Comparison, loaded: Sequence[Loaded]) -> Iterator[Section]:
    flights = [one.flight for one in loaded]
    marks = tuple(Mark("line", _ROLES[place], one.side.name) for place, one in enumerate(loaded))
    axes = [axis for axis in flights[0].design.axes if all(axis in one.design.axes for one in flights)]
    yield Section("Recordings", "", _sides(found))
    yield Section("Path", "", page.grid(list(_paths(flights, axes))), (*marks, _LIMIT))
    yield Section(
        "Positions and age",
        "Time counts from each flight's first tick. Positions are the true ones where they are known.",
        page.grid([*(_position(flights, axis) for axis in axes), _ages(flights)]),
        (*marks, _LIMIT, _HORIZON),
    )
    yield Section("Figures", "", _figures(found))
    yield Section("Parameters that differ", "", _parameters(found))


def _paths(flights: Sequence[FlightData], axes: Sequence[str]) -> Iterator[Drawing]:
    for key, title, shown in (
        ("path-above", "From above", ("east", "north")),
        ("path-side", "From the south", ("east", "down")),
    ):
        if not set(shown) <= set(axes):
            continue
        (x_name, x_sign), (y_name, y_sign) = (SEEN[axis] for axis in shown)
        with canvas(key, 3.7) as one:
            ax = one.axes(title, f"{x_name} [m]", f"{y_name} [m]")
            for place, flight in enumerate(flights):
                points = along(_course(flight)[1])
                x, y = (points[:, AXIS_NUMBER[axis]] for axis in shown)
                ax.plot(x_sign * x, y_sign * y, color=colour(_ROLES[place]), lw=_width(place, flights))
            for side in _limits(flights[0], shown[0]):
                ax.axvline(side, color=colour("limit"), lw=1.0, ls=DASHED)
            for side in _limits(flights[0], shown[1]):
                ax.axhline(side, color=colour("limit"), lw=1.0, ls=DASHED)
            ax.set_aspect("equal", adjustable="datalim")
        yield Drawing(key, one.svg, f"Paths of {len(flights)} flights: {x_name} and {y_name} in metres")


def _position(flights: Sequence[FlightData], axis: str) -> Drawing:
    name, sign = SEEN[axis]

    def values(flight: FlightData) -> tuple[Floats, Floats]:
        t_s, points = _course(flight)
        return t_s, sign * points[:, AXIS_NUMBER[axis]]

    with canvas(f"position-{axis}", 2.3) as one:
        ax = _overlay(one, name.capitalize(), f"{name} [m]", flights, values)
        for side in _limits(flights[0], axis):
            ax.axhline(side, color=colour("limit"), lw=1.0, ls=DASHED)
    return Drawing(f"position-{axis}", one.svg, f"{name.capitalize()} over time of {len(flights)} flights")


def _ages(flights: Sequence[FlightData]) -> Drawing:
    def values(flight: FlightData) -> tuple[Floats, Floats]:
        known = [(d.at_ns, float(d.age_steps)) for d in flight.flown if d.age_steps is not None]
        return flight.seconds([at_ns for at_ns, _ in known]), np.array([age for _, age in known])

    horizons = sorted({float(flight.design.horizon) for flight in flights})
    with canvas("age", 2.3) as one:
        ax = _overlay(one, "Age of information", "age [steps]", flights, values, "steps-post")
        for horizon in horizons:
            ax.axhline(horizon, color=colour("muted"), lw=1.0, ls=DOTTED)
    return Drawing("age", one.svg, f"Age of information over time of {len(flights)} flights")


def _overlay(
    one: Canvas,
    title: str,
    y_label: str,
    flights: Sequence[FlightData],
    values: Callable[[FlightData], tuple[Floats, Floats]],
    drawstyle: str = "default",
) -> Axes:
    ax = one.axes(title, "time [s]", y_label)
    for place, flight in enumerate(flights):
        ax.plot(*thin(*values(flight)), color=colour(_ROLES[place]), lw=_width(place, flights), drawstyle=drawstyle)
    ax.set_xlim(0, max(flight.duration_s for flight in flights))
    return ax


def _width(place: int, flights: Sequence[FlightData]) -> float:
    """Width of a flight's line [pt]."""
    return float(np.linspace(_WIDEST, _FINEST, len(flights))[place])


def _course(flight: FlightData) -> tuple[Floats, Floats]:
    """Where it was: times (n,) [s] and positions (n, 3), local NED; the true ones where they are known."""
    if flight.truths:
        points = [truth.position_m for truth in flight.truths]
        return flight.seconds([truth.at_ns for truth in flight.truths]), np.array(points)
    points = [flight.design.position_of(estimate.mean) for estimate in flight.estimates]
    return flight.seconds([estimate.at_ns for estimate in flight.estimates]), np.array(points).reshape(-1, 3)


def _limits(flight: FlightData, axis: str) -> list[float]:
    """Sides of the limits of a position, as people see the axis; open ones are left out."""
    design = flight.design
    index = design.position_index[design.axes.index(axis)]
    sides = (SEEN[axis][1] * float(box[index]) for box in (design.state_box.lower, design.state_box.upper))
    return [side for side in sides if np.isfinite(side)]


def _sides(found: Comparison) -> str:
    return page.facts(
        (
            one.name,
            f"{one.recording} · {one.started_utc} · {one.command} · {one.ended}{'' if one.finished else ', torn'}",
        )
        for one in found.recordings
    )


def _figures(found: Comparison) -> str:
    others = range(1, len(found.recordings))
    parts = [others[begin : begin + _OTHERS_OF_A_TABLE] for begin in range(0, len(others), _OTHERS_OF_A_TABLE)]
    return "".join(_figures_of(found, part) for part in parts)


def _figures_of(found: Comparison, others: Sequence[int]) -> str:
    """The first flight's figures beside those of some others."""
    names = {place: found.recordings[place].name for place in others}
    columns = ["figure", "A"]
    columns += [text for name in names.values() for text in (name, f"{name} − A", f"{name} / A")]
    rows = []
    for one in map(for_people, found.figures):
        cells = [measured(one.values[0])]
        for place in others:
            cells += [measured(one.values[place]), difference(one.differences[place - 1])]
            cells.append(measured(one.ratios[place - 1]))
        rows.append([label(one), *(cell.replace("-", "−") for cell in cells)])
    return page.table(columns, rows, frozenset(range(1, len(columns))))


def _parameters(found: Comparison) -> str:
    if not found.parameters:
        return page.paragraph("None.")
    columns = ["parameter", *(one.name for one in found.recordings)]
    rows = [[one.key, *map(parameter, one.values)] for one in found.parameters]
    return page.table(columns, rows, frozenset())
