"""Plots of control, link, solver and verdicts."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator
from numpy.typing import NDArray

from logs.recording.design_view import Floats
from logs.recording.flight import FlightData
from logs.recording.summary import SLACK_TOLERANCE, decision_times_us
from logs.report.plots import DASHED, draw_path, input_beyond, shade_fallback, span, thin, varies
from logs.report.statistics import normal_reach
from logs.report.svg import PALETTE, Drawing, canvas, colour, dots, power_of_ten, ramp, standalone, strokes
from logs.report.verdict_model import AxisVerdict, LeadVerdict
from logs.report.verdicts import ClockVerdict, LinkVerdict, delays_s, offsets
from uavctl.records import Plan, duration

# How it was controlled: age of information, inputs and their plan index, decision times.


WIDE_IN = 8.6
MARKS = 1500
_DURATIONS_IN = 0.86  # for ticks like "100 ms"
# Keeps a text readable on what it lies on.
_BEHIND = {"facecolor": PALETTE["card"][0], "edgecolor": "none", "alpha": 0.75, "pad": 0.8}
# Inputs as people see them: down is drawn upwards, like the height.
INPUT = {"north": ("north", 1.0), "east": ("east", 1.0), "down": ("up", -1.0)}
PICTURE_LABEL = "A flight from above within its limits, and the age of its position information"


def age(flight: FlightData) -> Drawing:
    """Draw the age of information with the horizon H, losses and fallback."""
    label = (
        f"Age of information over time in steps; the horizon is {flight.design.horizon} steps; "
        "lost positions and fallback spans are marked"
    )
    with canvas("age", 2.5) as one:
        draw_age(one.axes("Age of information", "time [s]", "age [steps]"), flight)
    return Drawing("age", one.svg, label)


def draw_age(ax: Axes, flight: FlightData) -> None:
    """Draw the age of information at each tick [steps], the horizon H, and ticks for lost positions below zero."""
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
    """Draw each input against its limits, coloured by the plan index that was flown."""
    steps, design = flight.steps, flight.design
    index = _plan_index(flight)
    for number, (name, sign) in enumerate(INPUT[axis] for axis in design.axes):
        key = f"input-{number}"
        if not varies(steps.input[:, number]):
            continue
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
            outside = input_beyond(flight, number)
            ax.plot(steps.t_s[outside], values[outside], "x", ms=6, mew=1.6, color=colour("limit"))
            span(ax, flight)
        yield Drawing(key, one.svg, f"Input {name} over time against its limits, coloured by the plan index flown")


def _plan_index(flight: FlightData) -> NDArray[np.int64]:
    """Return the plan index of each flown boundary (n,), -1 where no plan was flown."""
    return np.array([-1 if d.plan_index is None else d.plan_index for d in flight.steps.decisions], dtype=np.int64)


def plan_indices(flight: FlightData) -> Iterator[Drawing]:
    """Draw the share of steps in which each plan index was flown [%]; nothing where it is one index alone."""
    horizon, index = flight.design.horizon, _plan_index(flight)
    if len(np.unique(index)) < 2:
        return
    share = np.array([np.count_nonzero(index == at) for at in range(horizon)]) / max(1, len(index)) * 100
    with canvas("plan-index", 2.3) as one:
        ax = one.axes("Plan index flown", "plan index [steps]", "steps flown [%]")
        ax.bar(range(horizon), share, color=[ramp(at, horizon) for at in range(horizon)], width=0.8)
        ax.xaxis.set_major_locator(MaxNLocator(12, integer=True))
        ax.grid(visible=False, axis="x")
    yield Drawing("plan-index", one.svg, "Share of the steps in which each plan index was flown, in percent")


def _draw_held(ax: Axes, t_s: Floats, values: Floats, dt_s: float, shade: str) -> None:
    """Draw values (n,) that are each held for one step."""
    kept = np.flatnonzero(np.isfinite(values))[:: _stride(len(values))]
    strokes(ax, (t_s[kept], values[kept]), (t_s[kept] + dt_s, values[kept]), shade, 2.2, zorder=3)


def timing(flight: FlightData) -> Iterator[Drawing]:
    """Draw decision times and tick lateness; neither where no times were measured, no lateness in virtual time."""
    if not flight.timings:
        return
    solved = {d.tick for d in flight.decisions if d.solve is not None}
    chosen = [t for t in flight.timings if t.tick in solved] or list(flight.timings)
    if not varies(decision_times_us(flight)):
        return
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
    """Thin points to about `MARKS`: the largest third of them is kept, the rest evenly, so no outlier is hidden."""
    if len(values) <= MARKS:
        return t_s, values
    order = np.argsort(values)
    index = np.union1d(order[-MARKS // 3 :], np.arange(0, len(values), _stride(len(values))))
    return t_s[index], values[index]


def _stride(count: int) -> int:
    return max(1, -(-count // MARKS))


def picture(flight: FlightData) -> str:
    """Return a drawing of the flight as an SVG file: path from above beside the age of information."""
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


# The link: ages and delays seen against those promised, and what was believed of it on the way.


_BINS = 40
_LEAST_SHARE = 2e-5
_LEAST_SPAN = 0.01  # of the axis: a delay configured without jitter is seen, too


def link_ages(flight: FlightData, verdict: LinkVerdict) -> Iterator[Drawing]:
    """Draw a histogram of the age; nothing where it never changed."""
    if sum(share > 0.0 for share in verdict.ages) > 1:
        yield _ages(flight, verdict)


def link_in_flight(flight: FlightData, verdict: LinkVerdict) -> Iterator[Drawing]:
    """Draw the estimated share of arrivals over time, and a histogram of the delay; what never changed is left out."""
    if varies(np.array([one.arrival_mean for one in flight.link_estimates])):
        yield _arrivals(flight)
    if verdict.delay is not None and varies(delays_s(flight)):
        yield _delays(flight, verdict)


def _ages(flight: FlightData, verdict: LinkVerdict) -> Drawing:
    shown = max(len(verdict.ages), flight.design.horizon) + 1
    promised = np.array(verdict.promised_ages[:shown])
    with canvas("age-share", 2.5) as one:
        ax = one.axes("Age of information", "age [steps]", "steps (log scale)", _DURATIONS_IN)
        ax.set_yscale("log")
        ax.bar(range(len(verdict.ages)), verdict.ages, color=colour("estimate"), alpha=0.6, width=0.8)
        if len(promised):
            ax.plot(promised, "o", ms=3.5, color=colour("limit"), ls=DASHED, lw=1.0)
        ax.yaxis.set_major_formatter(FuncFormatter(lambda share, _: f"{100 * share:g} %"))
        ax.yaxis.set_minor_locator(NullLocator())
        ax.axvline(flight.design.horizon, color=colour("muted"), lw=1.0, ls=":")
        least = min(share for share in verdict.ages if share > 0.0)
        ax.set_ylim(max(_LEAST_SHARE, 0.3 * least), 1.6)
        ax.set_xlim(-0.7, shown - 0.3)
        ax.xaxis.set_major_locator(MaxNLocator(12, integer=True))
        ax.grid(visible=False, axis="x")
    return Drawing("age-share", one.svg, "Share of the steps at each age of information, measured and promised")


def _arrivals(flight: FlightData) -> Drawing:
    told = flight.link_estimates
    t_s = flight.seconds([one.at_ns for one in told])
    promised = told[-1].promised
    with canvas("link-estimate", 2.5) as one:
        ax = one.axes("Steps with news, as believed in flight", "time [s]", "probability of news")
        ax.step(*thin(t_s, np.array([e.arrival_lower for e in told])), where="post", color=colour("estimate"), lw=0.8)
        ax.step(*thin(t_s, np.array([e.arrival_mean for e in told])), where="post", color=colour("estimate"), lw=1.6)
        ax.axhline(promised, color=colour("limit"), lw=1.2, ls=DASHED)
        ax.set_ylim(-0.02, 1.02)
        span(ax, flight)
    label = f"Believed probability of news over time with its lower bound; the design counts on {promised:.3g}"
    return Drawing("link-estimate", one.svg, label)


def _delays(flight: FlightData, verdict: LinkVerdict) -> Drawing:
    took_ms = 1e3 * delays_s(flight)
    shown_ms = took_ms[np.isfinite(took_ms)]
    delay = verdict.delay
    with canvas("link-delay", 2.5) as one:
        ax = one.axes("Capture to arrival, by the stamps", "delay [ms]", "positions")
        # One position that came very late would leave nothing of the others' shape.
        edge = float(np.percentile(shown_ms, 99.5)) * 1.3 + 1.0
        counted_ms = np.minimum(shown_ms, edge)
        counts, edges = np.histogram(counted_ms, _BINS, (min(0.0, counted_ms.min()), max(1.0, counted_ms.max())))
        ax.stairs(counts, edges, fill=True, color=colour("estimate"), alpha=0.6)
        if delay is not None and delay.promised_low_ms is not None and delay.promised_high_ms is not None:
            low, high = delay.promised_low_ms, delay.promised_high_ms
            least = _LEAST_SPAN * max(high, edges[-1])
            ax.axvspan(low, max(high, low + least), color=colour("limit"), alpha=0.13, lw=0)
        ax.yaxis.set_major_locator(MaxNLocator(5, integer=True))
    label = "Histogram of the time from capture to arrival of the positions, with the span that was configured"
    return Drawing("link-delay", one.svg, label)


# How plans were found: how far from the optimum they are certified to be, and what they gave way by.


# Roles of the ways to a plan, in the order of their names.
_ROLES = ("estimate", "sample", "target", "plan", "limit")
_LEAST_GAP = 1e-12
_PERCENT = 100.0
_WAYS = {
    "frozen": "with the policy that was made beforehand, which is the best there",
    "mixture": "with several policies made beforehand, weighed together (up to version 0.2)",
    "exact": "with a policy found for this very plan",
}


def methods(flight: FlightData) -> list[tuple[str, str]]:
    """Return the methods by which plans were found, each with the role of its colour."""
    names = sorted({plan.method for plan in flight.plans})
    return [(name, _ROLES[place % len(_ROLES)]) for place, name in enumerate(names)]


def ways(flight: FlightData) -> str:
    """Return a sentence on the methods by which plans were found, with a space after it; empty if none is known."""
    told = [f"“{name}”: {_WAYS[name]}" for name in sorted({plan.method for plan in flight.plans} & set(_WAYS))]
    return f"Plans were found in these ways: {'; '.join(told)}. " if told else ""


def certificates(flight: FlightData) -> Iterator[Drawing]:
    """Draw the certified gap of each plan, and the slack of those in which a constraint gave way."""
    if varies(np.array([plan.gap for plan in flight.plans])):
        yield _gaps(flight)
    gave = [plan for plan in flight.flown_plans.values() if max(plan.slack, plan.terminal_miss) > SLACK_TOLERANCE]
    if len(gave) > 1:
        yield _slack(flight, gave)


def _gaps(flight: FlightData) -> Drawing:
    with canvas("plan-gap", 2.5) as one:
        ax = one.axes("Certified gap", "time [s]", "% of the cost (log scale)")
        ax.set_yscale("log")
        for name, role in methods(flight):
            plans = [plan for plan in flight.plans if plan.method == name and np.isfinite(plan.gap)]
            gaps = _PERCENT * np.maximum(np.array([plan.gap for plan in plans], dtype=np.float64), _LEAST_GAP)
            shown_s, shown = largest(flight.seconds([plan.base_ns for plan in plans]), gaps)
            dots(ax, shown_s, shown, role, 2.4)
        ax.yaxis.set_major_locator(LogLocator(numticks=7))
        ax.yaxis.set_minor_locator(NullLocator())
        ax.yaxis.set_major_formatter(power_of_ten)
        ax.margins(y=0.08)
        ax.autoscale_view()
        low, high = np.log10(ax.get_ylim())
        if np.floor(high) <= np.ceil(low):  # a single tick would say nothing of the scale
            ax.set_ylim(10.0 ** np.floor(low), 10.0 ** np.ceil(high))
        span(ax, flight)
    label = "Certified gap of each plan between its cost and the least possible, in percent of the cost, over time"
    return Drawing("plan-gap", one.svg, label)


def _slack(flight: FlightData, plans: list[Plan]) -> Drawing:
    t_s = flight.seconds([plan.base_ns for plan in plans])
    with canvas("plan-slack", 2.5) as one:
        ax = one.axes("What gave way in plans flown", "time [s]", "sum over rows, their units")
        for role, values in (
            ("sample", np.array([plan.slack for plan in plans])),
            ("limit", np.array([plan.terminal_miss for plan in plans])),
        ):
            dots(ax, *largest(t_s, values), role, 3.0)
        ax.axhline(0.0, color=colour("muted"), lw=0.6)
        ax.margins(y=0.08)
        ax.autoscale_view()
        span(ax, flight)
    return Drawing("plan-slack", one.svg, "Slack of the state limits and of the rest at the end of plans, over time")


# Pictures of the verdicts: errors of the forecast, what they tell of each other, ellipsoids, clocks.


VERDICT_MARKS = 1200
_MARGIN = 1.25


def whiteness(axis: AxisVerdict) -> Drawing:
    """Draw the autocorrelation of an axis' one-step errors."""
    lags = np.arange(1, len(axis.correlation) + 1, dtype=np.float64)
    values = np.array(axis.correlation)
    with canvas(f"white-{axis.axis}", 2.3) as one:
        ax = one.axes(f"Whiteness, {axis.axis}", "positions apart", "correlation of errors")
        ax.axhspan(-axis.correlation_bound, axis.correlation_bound, color=colour("target"), alpha=0.15, lw=0)
        ax.axhline(0.0, color=colour("muted"), lw=0.8)
        strokes(ax, (lags, np.zeros(len(lags))), (lags, values), colour("estimate"), 2.4)
        dots(ax, lags, values, "estimate", 5.0)
        reach = max(0.3, _MARGIN * float(np.abs(values).max()), _MARGIN * axis.correlation_bound)
        ax.set_ylim(-reach, reach)
        ax.set_xlim(0.0, len(lags) + 1.0)
        ax.xaxis.set_major_locator(MaxNLocator(5, integer=True))
    label = f"Correlation of the forecast's errors {axis.axis} with those of later positions; white within the band"
    return Drawing(f"white-{axis.axis}", one.svg, label)


def coverage(leads: tuple[LeadVerdict, ...]) -> Drawing:
    """Draw the share of positions inside their confidence ellipsoids over the time ahead."""
    t_s = np.array([one.lead_s for one in leads])
    with canvas("coverage", 2.3) as one:
        ax = one.axes("Positions in their ellipsoid", "time ahead [s]", "share [%]")
        low, high = (100.0 * np.array([getattr(one.inside, side) for one in leads]) for side in ("low", "high"))
        rate = np.array([100.0 * one.inside.rate for one in leads])
        strokes(ax, (t_s, low), (t_s, high), colour("estimate"), 1.4)
        dots(ax, t_s, rate, "estimate", 5.0)
        ax.axhline(100.0 * leads[0].promised, color=colour("limit"), lw=1.2, ls=DASHED)
        ax.set_ylim(min(50.0, float(low.min()) - 5.0), 103.0)
        ax.set_xlim(0.0, t_s[-1] * 1.05)
    label = "Share of the positions within the ellipsoid foretold for them, by the time ahead, with exact intervals"
    return Drawing("coverage", one.svg, label)


def errors(flight: FlightData, axis: str, t_s: Floats, normalised: Floats) -> Drawing:
    """Draw the one-step errors of an axis over time, in foretold standard deviations."""
    with canvas(f"error-{axis}", 2.3) as one:
        ax = one.axes(f"Errors of the forecast, {axis}", "time [s]", "foretold deviations")
        reach = normal_reach()
        ax.axhspan(-reach, reach, color=colour("target"), alpha=0.15, lw=0)
        stride = max(1, -(-len(t_s) // VERDICT_MARKS))
        dots(ax, t_s[::stride], normalised[::stride], "estimate", 1.8)
        most = max(4.0, 1.1 * float(np.abs(normalised).max(initial=0.0)))
        ax.set_ylim(-most, most)
        span(ax, flight)
    return Drawing(f"error-{axis}", one.svg, f"Errors of the forecast {axis} over time, in foretold deviations")


def clocks(flight: FlightData, verdicts: tuple[ClockVerdict, ...]) -> Iterator[Drawing]:
    """Draw clock offsets about their straight line, for clocks that strayed from it."""
    for number, verdict in enumerate(verdicts):
        if not verdict.residual_us or not varies(offsets(flight, verdict.link)[1]):
            continue
        t_s, residual_s = offsets(flight, verdict.link)
        with canvas(f"clock-{number}", 2.3) as one:
            ax = one.axes(f"Clock of “{verdict.link}”", "time [s]", "offset less its line [ms]")
            ax.step(t_s, 1e3 * residual_s, where="post", color=colour("estimate"), lw=1.2)
            ax.axhline(0.0, color=colour("muted"), lw=0.8)
            span(ax, flight)
        yield Drawing(f"clock-{number}", one.svg, f"Clock offset of {verdict.link} less its straight line, over time")
