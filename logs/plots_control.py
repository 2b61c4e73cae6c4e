"""How it was controlled: age of information, inputs and their plan index, decision times."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator
from numpy.typing import NDArray

from logs.design_view import Floats
from logs.digits import duration
from logs.flight_data import FlightData
from logs.plots import DASHED, draw_path, shade_fallback, span, thin
from logs.summary import decision_times_us, input_outside
from logs.svg import PALETTE, WIDTH_IN, Drawing, canvas, colour, dots, ramp, standalone, strokes

WIDE_IN = 8.6
MARKS = 1500
_DURATIONS_IN = 0.86  # for ticks like "100 ms"
# Keeps a text readable on what it lies on.
_BEHIND = {"facecolor": PALETTE["card"][0], "edgecolor": "none", "alpha": 0.75, "pad": 0.8}
# Inputs as people see them: down is drawn upwards, like the height.
INPUT = {"north": ("north", 1.0), "east": ("east", 1.0), "down": ("up", -1.0)}
PICTURE_LABEL = "A flight from above within its limits, and the age of its position information"


def age(flight: FlightData) -> tuple[Drawing, Drawing]:
    """Age of information with H, losses and fallback: for a wide page and for a narrow one."""
    label = (
        f"Age of information over time in steps; the horizon is {flight.design.horizon} steps; "
        "lost positions and fallback spans are marked"
    )
    drawings = []
    for key, width_in in (("age-wide", WIDE_IN), ("age-narrow", WIDTH_IN)):
        with canvas(key, 2.6, width_in) as one:
            draw_age(one.axes("", "time [s]", "age [steps]"), flight)
        drawings.append(Drawing(key, one.svg, label))
    return drawings[0], drawings[1]


def draw_age(ax: Axes, flight: FlightData) -> None:
    """Age at each tick, the horizon, and a strip of lost positions below zero."""
    horizon = flight.design.horizon
    known = [(d.at_ns, float(d.age_steps)) for d in flight.decisions if d.age_steps is not None]
    t_s, ages = thin(flight.seconds([at for at, _ in known]), np.array([value for _, value in known]))
    lost_s = flight.lost_at_s()
    highest = max(float(ages.max(initial=0.0)), float(horizon))
    strip = 0.09 * highest
    shade_fallback(ax, flight)
    ax.fill_between(t_s, 0, ages, step="post", color=colour("estimate"), alpha=0.2, lw=0)
    ax.step(t_s, ages, where="post", color=colour("estimate"), lw=1.3)
    ax.axhline(horizon, color=colour("limit"), lw=1.2, ls=DASHED)
    marks_s = lost_s[:: _stride(len(lost_s))]
    low, high = np.full(len(marks_s), -1.2 * strip), np.full(len(marks_s), -0.4 * strip)
    strokes(ax, (marks_s, low), (marks_s, high), colour("lost"), 1.1)
    ax.axhline(0, color=colour("muted"), lw=0.6)
    ax.set_ylim(-1.6 * strip, highest * 1.1)
    ax.yaxis.set_major_locator(MaxNLocator(6, integer=True))
    ax.set_yticks([tick for tick in ax.get_yticks() if 0 <= tick <= highest * 1.1])
    span(ax, flight)


def inputs(flight: FlightData) -> Iterator[Drawing]:
    """Each input against its limits, coloured by the plan index that was flown."""
    steps, design = flight.steps, flight.design
    outside = input_outside(flight)
    index = np.array([-1 if d.plan_index is None else d.plan_index for d in steps.decisions], dtype=np.int64)
    yield _indices(flight, index)
    for number, (name, sign) in enumerate(INPUT[axis] for axis in design.axes):
        key = f"input-{number}"
        with canvas(key, 2.3) as one:
            ax = one.axes(f"Input {name}", "time [s]", f"input {name} [{design.input_unit}]")
            shade_fallback(ax, flight)
            for side in (design.input_box.lower[number], design.input_box.upper[number]):
                if np.isfinite(side):
                    ax.axhline(sign * side, color=colour("limit"), lw=1.2, ls=DASHED)
            values = sign * steps.input[:, number]
            ax.step(*thin(steps.t_s, values), where="post", color=colour("muted"), lw=0.6)
            for at in np.unique(index):
                chosen = index == at
                shade = ramp(int(at), design.horizon) if at >= 0 else colour("fallback")
                _draw_held(ax, steps.t_s[chosen], values[chosen], design.dt_s, shade)
            ax.plot(steps.t_s[outside], values[outside], "x", ms=6, mew=1.6, color=colour("limit"))
            span(ax, flight)
        yield Drawing(key, one.svg, f"Input {name} over time against its limits, coloured by the plan index flown")


def _indices(flight: FlightData, index: NDArray[np.int64]) -> Drawing:
    """How often each plan index was flown; the key to the colours, too."""
    horizon = flight.design.horizon
    share = np.array([np.count_nonzero(index == at) for at in range(horizon)]) / max(1, len(index)) * 100
    with canvas("plan-index", 2.3) as one:
        ax = one.axes("Plan index flown", "plan index [steps]", "steps flown [%]")
        ax.bar(range(horizon), share, color=[ramp(at, horizon) for at in range(horizon)], width=0.8)
        ax.xaxis.set_major_locator(MaxNLocator(12, integer=True))
        ax.grid(visible=False, axis="x")
    return Drawing("plan-index", one.svg, "Share of the steps in which each plan index was flown, in percent")


def _draw_held(ax: Axes, t_s: Floats, values: Floats, dt_s: float, shade: str) -> None:
    """Values held for a step each."""
    kept = np.flatnonzero(np.isfinite(values))[:: _stride(len(values))]
    strokes(ax, (t_s[kept], values[kept]), (t_s[kept] + dt_s, values[kept]), shade, 2.2, zorder=3)


def timing(flight: FlightData) -> Iterator[Drawing]:
    """Decision times, if the shell measured any, and tick lateness, if there can be any."""
    if not flight.timings:
        return
    solved = {d.tick for d in flight.decisions if d.solve is not None}
    chosen = [t for t in flight.timings if t.tick in solved] or list(flight.timings)
    yield _times(
        flight, "time-decision", "Decision time", flight.seconds([t.at_ns for t in chosen]), decision_times_us(flight)
    )
    if flight.virtual_time:
        return
    late_us = np.array([t.lateness_ns for t in flight.timings]) * 1e-3
    yield _times(flight, "time-late", "Tick lateness", flight.seconds([t.at_ns for t in flight.timings]), late_us)


def _times(flight: FlightData, key: str, title: str, t_s: Floats, values_us: Floats) -> Drawing:
    with canvas(key, 2.3) as one:
        ax = one.axes(title, "time [s]", "duration (log scale)", _DURATIONS_IN)
        ax.set_yscale("log")
        shown_s, shown_us = largest(t_s, np.maximum(values_us, 1.0))
        low, high = float(shown_us.min()), float(shown_us.max())
        # Before anything is drawn: one value alone makes limits that a logarithmic axis cannot invert.
        ax.set_ylim(low / 2, high * 2)
        dots(ax, shown_s, shown_us, "estimate", 2.0)
        p50, p99 = np.percentile(values_us, [50, 99])
        for value, name, side in ((p50, "median", "top"), (p99, "99 %", "bottom")):
            ax.axhline(max(value, 1.0), color=colour("muted"), lw=0.9, ls=DASHED)
            at, off = (1.0, max(value, 1.0)), (-2, -1 if side == "top" else 1)
            ax.annotate(name, at, off, ("axes fraction", "data"), "offset points", va=side, ha="right", bbox=_BEHIND)
        ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if high < 30 * low else (1.0,)))
        ax.yaxis.set_minor_locator(NullLocator())
        ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: duration(value)))
        span(ax, flight)
    return Drawing(key, one.svg, f"{title} over time; median {duration(p50)}, 99 percent below {duration(p99)}")


def largest(t_s: Floats, values: Floats) -> tuple[Floats, Floats]:
    """The MARKS largest values evenly thinned below: outliers are never hidden."""
    if len(values) <= MARKS:
        return t_s, values
    order = np.argsort(values)
    index = np.union1d(order[-MARKS // 3 :], np.arange(0, len(values), _stride(len(values))))
    return t_s[index], values[index]


def _stride(count: int) -> int:
    return max(1, -(-count // MARKS))


def picture(flight: FlightData) -> str:
    """A drawing of the flight that stands alone: path from above beside the age of information, as SVG text."""
    with canvas("flight", 3.6, 9.0) as one:
        left, right = one.figure.subplots(1, 2, width_ratios=(1.0, 1.25))
        left.set(title="The path, from above", xlabel="east [m]", ylabel="north [m]")
        draw_path(left, flight, ("east", "north"))
        right.set(title="Age of its position information", xlabel="time [s]", ylabel="age [steps]")
        draw_age(right, flight)
        flown = "truth" if flight.truths else "estimate"
        names = ((flown, "-", "flown"), ("sample", ".", "position used"), ("target", "*", "target"))
        marks = [right.plot([], [], mark, color=colour(role), label=name)[0] for role, mark, name in names]
        limit = right.plot([], [], color=colour("limit"), ls=DASHED, label="limits, horizon H")[0]
        handles: list[Artist] = [*marks, limit]
        if flight.truths:
            handles += right.plot([], [], "|", ms=7, color=colour("lost"), label="position lost")
        if flight.fallback_spans:
            handles.append(Patch(color=colour("fallback"), alpha=0.22, lw=0, label="fallback"))
        one.figure.legend(handles=handles, loc="outside lower center", ncols=6)
    return standalone(one.svg, PICTURE_LABEL)
