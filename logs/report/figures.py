"""Plots of the control: age of information, inputs and their plan index, decision times."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator
from numpy.typing import NDArray

from logs.recording.flight import FlightData
from logs.recording.summary import find_input_violations, get_decision_times_us
from logs.report.plots import DASHED, draw_path, has_variation, set_time_axis, shade_fallback, thin_samples
from logs.report.svg import (
    PALETTE,
    Drawing,
    choose_ramp_colour,
    colour,
    draw_dots,
    draw_strokes,
    make_standalone,
    open_canvas,
)
from uavctl.arrays import Array
from uavctl.number_text import format_duration

WIDE_IN = 8.6
MAX_MARKS = 1500
DURATION_LABEL_IN = 0.86  # for ticks like "100 ms"

# Keeps a text readable on what it lies on.
_TEXT_BOX = {"facecolor": PALETTE["card"][0], "edgecolor": "none", "alpha": 0.75, "pad": 0.8}

# Inputs as people see them: down is drawn upwards, like the height.
DISPLAY_INPUTS = {"north": ("north", 1.0), "east": ("east", 1.0), "down": ("up", -1.0)}
OVERVIEW_LABEL = "A flight from above within its limits, and the age of its position information"


def draw_age_figure(flight: FlightData) -> Drawing:
    """Draw the age of information with the horizon H, losses and fallback."""
    label = (
        f"Age of information over time in steps; the horizon is {flight.design.horizon} steps; "
        "lost positions and fallback spans are marked"
    )
    with open_canvas("age", 2.5) as canvas:
        draw_age(canvas.axes("Age of information", "time [s]", "age [steps]"), flight)
    return Drawing("age", canvas.svg, label)


def draw_age(ax: Axes, flight: FlightData) -> None:
    """Draw the age of information at each tick [steps], the horizon H, and ticks for lost positions below zero."""
    horizon = flight.design.horizon
    ages_by_time = [(d.at_ns, float(d.age_steps)) for d in flight.decisions if d.age_steps is not None]
    t_s, ages = thin_samples(
        flight.seconds([at_ns for at_ns, _ in ages_by_time]), np.array([value for _, value in ages_by_time])
    )
    lost_s = flight.lost_at_s()
    highest = max(float(ages.max(initial=0.0)), float(horizon))
    strip = 0.09 * highest
    shade_fallback(ax, flight)
    ax.fill_between(t_s, 0, ages, step="post", color=colour("estimate"), alpha=0.2, lw=0)
    ax.step(t_s, ages, where="post", color=colour("estimate"), lw=1.3)
    ax.axhline(horizon, color=colour("limit"), lw=1.2, ls=DASHED)
    marks_s = lost_s[:: _compute_stride(len(lost_s))]
    low, high = np.full(len(marks_s), -1.2 * strip), np.full(len(marks_s), -0.4 * strip)
    draw_strokes(ax, (marks_s, low), (marks_s, high), colour("lost"), 1.1)
    ax.axhline(0, color=colour("muted"), lw=0.6)
    ax.set_ylim(-1.6 * strip, highest * 1.1)
    ax.yaxis.set_major_locator(MaxNLocator(6, integer=True))
    ax.set_yticks([tick for tick in ax.get_yticks() if 0 <= tick <= highest * 1.1])
    set_time_axis(ax, flight)


def draw_inputs(flight: FlightData) -> Iterator[Drawing]:
    """Draw each input against its limits, coloured by the plan index that was flown."""
    steps, design = flight.steps, flight.design
    index = _get_plan_indices(flight)
    for column, (name, sign) in enumerate(DISPLAY_INPUTS[axis] for axis in design.axes):
        key = f"input-{column}"
        if not has_variation(steps.input[:, column]):
            continue
        with open_canvas(key, 2.3) as canvas:
            ax = canvas.axes(f"Input {name}", "time [s]", f"input {name} [{design.input_unit}]")
            shade_fallback(ax, flight)
            for side in (design.input_box.lower[column], design.input_box.upper[column]):
                if np.isfinite(side):
                    ax.axhline(sign * side, color=colour("limit"), lw=1.2, ls=DASHED)
            values = sign * steps.input[:, column]
            ax.step(*thin_samples(steps.t_s, values), where="post", color=colour("muted"), lw=0.6)
            for plan_index in np.unique(index):
                is_flown = index == plan_index
                shade_colour = (
                    choose_ramp_colour(int(plan_index), design.horizon) if plan_index >= 0 else colour("fallback")
                )
                _draw_held(ax, steps.t_s[is_flown], values[is_flown], design.dt_s, shade_colour)
            outside = find_input_violations(flight, column)
            ax.plot(steps.t_s[outside], values[outside], "x", ms=6, mew=1.6, color=colour("limit"))
            set_time_axis(ax, flight)
        yield Drawing(key, canvas.svg, f"Input {name} over time against its limits, coloured by the plan index flown")


def _get_plan_indices(flight: FlightData) -> NDArray[np.int64]:
    """Return the plan index of each flown boundary (n,), -1 where no plan was flown."""
    return np.array([-1 if d.plan_index is None else d.plan_index for d in flight.steps.decisions], dtype=np.int64)


def draw_plan_indices(flight: FlightData) -> Iterator[Drawing]:
    """Draw the share of steps in which each plan index was flown [%]; nothing where it is one index alone."""
    horizon, indices = flight.design.horizon, _get_plan_indices(flight)
    if len(np.unique(indices)) < 2:
        return
    share = (
        np.array([np.count_nonzero(indices == plan_index) for plan_index in range(horizon)])
        / max(1, len(indices))
        * 100
    )
    with open_canvas("plan-index", 2.3) as canvas:
        ax = canvas.axes("Plan index flown", "plan index [steps]", "steps flown [%]")
        ax.bar(
            range(horizon),
            share,
            color=[choose_ramp_colour(plan_index, horizon) for plan_index in range(horizon)],
            width=0.8,
        )
        ax.xaxis.set_major_locator(MaxNLocator(12, integer=True))
        ax.grid(visible=False, axis="x")
    yield Drawing("plan-index", canvas.svg, "Share of the steps in which each plan index was flown, in percent")


def _draw_held(ax: Axes, t_s: Array, values: Array, dt_s: float, shade_colour: str) -> None:
    """Draw values (n,) that are each held for one step."""
    indices = np.flatnonzero(np.isfinite(values))[:: _compute_stride(len(values))]
    draw_strokes(
        ax, (t_s[indices], values[indices]), (t_s[indices] + dt_s, values[indices]), shade_colour, 2.2, zorder=3
    )


def draw_timing(flight: FlightData) -> Iterator[Drawing]:
    """Draw decision times and tick lateness; neither where no times were measured, no lateness in virtual time."""
    if not flight.timings:
        return
    solved = {d.tick for d in flight.decisions if d.solve is not None}
    timings = [t for t in flight.timings if t.tick in solved] or list(flight.timings)
    if not has_variation(get_decision_times_us(flight)):
        return
    yield _draw_times(
        flight,
        "time-decision",
        "Decision time",
        flight.seconds([t.at_ns for t in timings]),
        get_decision_times_us(flight),
    )
    if flight.virtual_time:
        return
    lateness_us = np.array([t.lateness_ns for t in flight.timings]) * 1e-3
    yield _draw_times(
        flight, "time-late", "Tick lateness", flight.seconds([t.at_ns for t in flight.timings]), lateness_us
    )


def _draw_times(flight: FlightData, key: str, title: str, t_s: Array, values_us: Array) -> Drawing:
    with open_canvas(key, 2.3) as canvas:
        ax = canvas.axes(title, "time [s]", "duration (log scale)", DURATION_LABEL_IN)
        ax.set_yscale("log")
        shown_s, shown_us = thin_keeping_largest(t_s, np.maximum(values_us, 1.0))
        low, high = float(shown_us.min()), float(shown_us.max())
        # Before anything is drawn: one value alone makes limits that a logarithmic axis cannot invert.
        ax.set_ylim(low / 2, high * 2)
        draw_dots(ax, shown_s, shown_us, "estimate", 2.0)
        p50, p99 = np.percentile(values_us, [50, 99])
        for value, name, side in ((p50, "median", "top"), (p99, "99 %", "bottom")):
            ax.axhline(max(value, 1.0), color=colour("muted"), lw=0.9, ls=DASHED)
            anchor, offset = (1.0, max(value, 1.0)), (-2, -1 if side == "top" else 1)
            ax.annotate(
                name, anchor, offset, ("axes fraction", "data"), "offset points", va=side, ha="right", bbox=_TEXT_BOX
            )
        ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if high < 30 * low else (1.0,)))
        ax.yaxis.set_minor_locator(NullLocator())
        ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: format_duration(value)))
        set_time_axis(ax, flight)
    return Drawing(
        key, canvas.svg, f"{title} over time; median {format_duration(p50)}, 99 percent below {format_duration(p99)}"
    )


def thin_keeping_largest(t_s: Array, values: Array) -> tuple[Array, Array]:
    """Thin points to about `MARKS`: the largest third of them is kept, the rest evenly, so no outlier is hidden."""
    if len(values) <= MAX_MARKS:
        return t_s, values
    order = np.argsort(values)
    index = np.union1d(order[-MAX_MARKS // 3 :], np.arange(0, len(values), _compute_stride(len(values))))
    return t_s[index], values[index]


def _compute_stride(count: int) -> int:
    return max(1, -(-count // MAX_MARKS))


def draw_overview(flight: FlightData) -> str:
    """Return a drawing of the flight as an SVG file: path from above beside the age of information."""
    with open_canvas("flight", 3.6, 9.0) as canvas:
        path_axes, age_axes = canvas.figure.subplots(1, 2, width_ratios=(1.0, 1.25))
        path_axes.set(title="The path, from above", xlabel="east [m]", ylabel="north [m]")
        draw_path(path_axes, flight, ("east", "north"))
        age_axes.set(title="Age of its position information", xlabel="time [s]", ylabel="age [steps]")
        draw_age(age_axes, flight)
        flown = "truth" if flight.truths else "estimate"
        names = ((flown, "-", "flown"), ("sample", ".", "position used"), ("target", "*", "target"))
        marks = [age_axes.plot([], [], mark, color=colour(role), label=name)[0] for role, mark, name in names]
        limit = age_axes.plot([], [], color=colour("limit"), ls=DASHED, label="limits, horizon H")[0]
        handles: list[Artist] = [*marks, limit]
        if flight.truths:
            handles += age_axes.plot([], [], "|", ms=7, color=colour("lost"), label="position lost")
        if flight.fallback_spans:
            handles.append(Patch(color=colour("fallback"), alpha=0.22, lw=0, label="fallback"))
        canvas.figure.legend(handles=handles, loc="outside lower center", ncols=6)
    return make_standalone(canvas.svg, OVERVIEW_LABEL)
