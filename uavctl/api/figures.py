"""Figures of answers, runs and flights."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from uavctl.api.flights import Flight, Recording
from uavctl.api.runs import Runs
from uavctl.build.controller import build_problem
from uavctl.errors import UsageError
from uavctl.smpc.answer import Answer

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_QUANTILES = (0.05, 0.5, 0.95)


def plot(what: Answer | Runs | Flight | Recording) -> Figure:
    """Draw an answer, runs or a flight; the figure is returned, not shown.

    Answer: predicted states and inputs by step. Runs: median of each position, and between which two values nine in
    ten runs are, with limits and target. Flight: the path from above and from the side.

    Raises:
        UsageError: It is nothing that has a figure.
        RecordingError: Nothing was flown in the recording.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 3.2), layout="constrained")
    if isinstance(what, Answer):
        _draw_answer(figure, what)
    elif isinstance(what, Runs):
        _draw_runs(figure, what)
    elif isinstance(what, Flight):
        _draw_path(figure, what.recording)
    elif isinstance(what, Recording):
        _draw_path(figure, what)
    else:
        raise UsageError(f"a {type(what).__name__} has no figure; give what solve, simulate, fly or read returned")
    return figure


def _draw_answer(figure: Figure, answer: Answer) -> None:
    for place, (name, rows) in enumerate((("state", answer.states), ("input", answer.inputs)), 1):
        ax = _axes(figure, 2, place, f"Predicted {name}", "step", name)
        for number, values in enumerate(rows.T):
            ax.plot(np.arange(len(rows)), values, marker=".", label=f"{name} {number}")
        ax.legend()


def _draw_runs(figure: Figure, runs: Runs) -> None:
    problem = build_problem(runs.config)
    axes, index = problem.plant.axes, problem.plant.position_index
    lower, upper = problem.state_set.bounds
    for place, (axis, of) in enumerate(zip(axes, index, strict=True), 1):
        ax = _axes(figure, len(axes), place, axis.capitalize(), "time [s]", f"{axis} [m]")
        low, middle, high = np.quantile(runs.states[~runs.failed, :, of], _QUANTILES, axis=0)
        ax.fill_between(runs.time_s, low, high, alpha=0.25, lw=0)
        ax.plot(runs.time_s, middle)
        ax.axhline(problem.target[of], ls=":", color="C2")
        for limit in (lower[of], upper[of]):
            if np.isfinite(limit):
                ax.axhline(limit, ls="--", color="C3")


def _draw_path(figure: Figure, recording: Recording) -> None:
    from logs.report.plots import draw_path

    views = [("From above", ("east", "north"))]
    if "down" in recording.data.design.axes:
        views.append(("From the south", ("east", "down")))
    for place, (title, shown) in enumerate(views, 1):
        names = ["height" if axis == "down" else axis for axis in shown]
        ax = _axes(figure, len(views), place, title, f"{names[0]} [m]", f"{names[1]} [m]")
        draw_path(ax, recording.data, shown)


def _axes(figure: Figure, count: int, place: int, title: str, x_label: str, y_label: str) -> Axes:
    ax = figure.add_subplot(1, count, place)
    ax.set(title=title, xlabel=x_label, ylabel=y_label)
    ax.grid(visible=True, alpha=0.3)
    return ax
