"""Figures of plans, runs and flights: for a notebook, or for a paper at the width of its columns."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from logs.report.paper_figure import WIDTHS_IN, PanelFigure, Width, draw_flight, make_figure
from uavctl.api.control import Runs, Signal, SolvedPlan, get_limits, list_signals
from uavctl.api.flights import Flight, Recording
from uavctl.arrays import Array
from uavctl.errors import UsageError
from uavctl.smpc.plant import AXES
from uavctl.wiring.controller import build_problem

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_LINES = ("-", "-.", (0, (4, 1, 1, 1, 1, 1)))  # of several controllers
_QUANTILES = (0.05, 0.5, 0.95)
_MAX_PANELS = 12


def plot(
    what: SolvedPlan | Runs | Sequence[Runs] | Flight | Recording,
    *,
    width: Width | None = None,
    path: Path | str | None = None,
) -> Figure:
    """Draw a plan, runs or a flight, with names, units and limits; the figure is returned, not shown.

    SolvedPlan: predicted states and inputs, and where it ends. Runs, of one or several controllers: median of each
    position (of each state, where a plant has no axes), and between which two values nine in ten runs are. Flight: the
    path from above and from the side.

    Args:
        what: A result of `solve`, `simulate`, `fly` or `read`.
        width: "column" (3.5 in) or "page" (7.16 in): sizes, fonts and colours of a paper, also printed in grey.
        path: File to write: PDF, SVG, EPS or PNG, with embedded fonts.

    Raises:
        UsageError: It has no figure, or the file has another ending.
        RecordingError: Nothing was flown in the recording, or the file cannot be written.
    """
    if width is not None and width not in WIDTHS_IN:
        raise UsageError(f"width {width!r}: give {' or '.join(WIDTHS_IN)}")
    return make_figure(lambda drawing: _draw(drawing, what), width, None if path is None else Path(path))


def _draw(drawing: PanelFigure, what: object) -> None:
    if isinstance(what, SolvedPlan):
        _draw_plan(drawing, what)
    elif isinstance(what, Runs):
        _draw_runs(drawing, [what])
    elif isinstance(what, list | tuple) and what and all(isinstance(one, Runs) for one in what):
        _draw_runs(drawing, what)
    elif isinstance(what, Flight):
        draw_flight(drawing, what.recording.data)
    elif isinstance(what, Recording):
        draw_flight(drawing, what.data)
    else:
        raise UsageError(f"a {type(what).__name__} has no figure; give a result of solve, simulate, fly or read")


class _Panel(NamedTuple):
    """Panel of several signals: title, unit, and (label, values (…, T), limits, target) of each signal."""

    title: str
    unit: str
    rows: list[tuple[str, Array, tuple[float, float], float | None]]


def _group_panels(
    signals: Sequence[Signal], values: Array, limits: Sequence[tuple[float, float]], target: Array | None
) -> list[_Panel]:
    """Group signals of a kind into one panel; each signal of a plant without axes has its own."""
    panels: dict[str, _Panel] = {}
    for i, signal in enumerate(signals):
        axis, _, kind = signal.name.partition(" ")
        key = kind if axis in AXES else signal.name
        panel = panels.setdefault(key, _Panel(key, signal.unit, []))
        label = axis if axis in AXES else signal.name
        panel.rows.append((label, values[..., i], limits[i], None if target is None else float(target[i])))
    return list(panels.values())


def _draw_plan(drawing: PanelFigure, plan: SolvedPlan) -> None:
    if not plan.inputs.size:
        raise UsageError(f"there is no plan to draw: {plan!r}")
    (states, inputs), (state_limits, input_limits) = list_signals(plan.config), get_limits(plan.config)
    panels = [
        *_group_panels(states, plan.states, state_limits, plan.reference),
        *_group_panels(inputs, plan.inputs, input_limits, None),
    ]
    for ax, panel in _make_grid(drawing, panels, "time ahead [s]"):
        for number, (label, values, limits, target) in enumerate(panel.rows):
            time_s = plan.config.plant.dt_s * np.arange(len(values))
            drawstyle = "steps-post" if len(values) < len(plan.states) else "default"
            ax.plot(time_s, values, color=drawing.get_colour(number), label=label, drawstyle=drawstyle)
            _draw_limits(ax, limits, target, drawing.get_colour(number))
        _add_legend(drawing, ax, panel)


def _draw_runs(drawing: PanelFigure, compared: Sequence[Runs]) -> None:
    config = compared[0].config
    for runs in compared:
        if runs.failed.all():
            raise UsageError(f"there is no run to draw: {runs!r}")
    if any(list_signals(runs.config) != list_signals(config) for runs in compared):
        raise UsageError("runs of different plants have no common figure; draw each alone")
    problem, (states, _), (limits, _) = build_problem(config), list_signals(config), get_limits(config)
    state_indices = list(problem.plant.position_index) or list(range(problem.plant.n_x))
    panels = [
        _Panel(
            states[i].name,
            states[i].unit,
            [
                (
                    "median" if len(compared) == 1 else runs.controller,
                    runs.states[:, :, i],
                    limits[i],
                    float(problem.target[i]),
                )
                for runs in compared
            ],
        )
        for i in state_indices
    ]
    for ax, panel in _make_grid(drawing, panels, "time [s]"):
        for number, (runs, (label, values, _, _)) in enumerate(zip(compared, panel.rows, strict=True)):
            low, middle, high = np.quantile(values[~runs.failed], _QUANTILES, axis=0)
            paint, band = drawing.get_colour(number), "nine in ten runs" if number == 0 else None
            ax.fill_between(runs.time_s, low, high, color=paint, alpha=0.2, lw=0, label=band)
            ax.plot(runs.time_s, middle, color=paint, ls=_LINES[number % len(_LINES)], label=label)
        *_, limits_of_state, wanted = panel.rows[0]
        _draw_limits(ax, limits_of_state, wanted, "0.4" if len(compared) > 1 or drawing.width else "C3")
        _add_legend(drawing, ax, panel)


def _draw_limits(ax: Axes, limits: tuple[float, float], target: float | None, colour: str) -> None:
    for limit in limits:
        if np.isfinite(limit):
            ax.axhline(limit, ls="--", lw=1.0, color=colour, alpha=0.7)
    if target is not None:
        ax.axhline(target, ls=":", lw=1.0, color=colour)


def _add_legend(drawing: PanelFigure, ax: Axes, panel: _Panel) -> None:
    ax.plot([], [], ls="--", lw=1.0, color="0.4", label="limit")
    if any(target is not None for *_, target in panel.rows):
        ax.plot([], [], ls=":", lw=1.0, color="0.4", label="target")
    drawing.add_legend(ax)


def _make_grid(drawing: PanelFigure, panels: Sequence[_Panel], x_label: str) -> Iterator[tuple[Axes, _Panel]]:
    """Yield axes for the first panels, with unit and time, and with a title outside of papers."""
    shown = panels[:_MAX_PANELS]
    for ax, panel in zip(drawing.make_axes(len(shown)), shown, strict=True):
        unit = f" [{panel.unit}]" if panel.unit else ""
        ax.set(xlabel=x_label, ylabel=f"{panel.title}{unit}")
        if drawing.width is None:
            ax.set_title(panel.title.capitalize())
        yield ax, panel
