"""Plots of the plans: certified gap to the optimum, and relaxed constraints."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from matplotlib.ticker import LogLocator, NullLocator

from logs.recording.flight import FlightData
from logs.recording.summary import SLACK_TOLERANCE
from logs.report.figures import thin_keeping_largest
from logs.report.plots import has_variation, set_time_axis
from logs.report.svg import Drawing, colour, draw_dots, format_power_of_ten, open_canvas
from uavctl.records import Plan

# Roles of the ways to a plan, in the order of their names.
_ROLES = ("estimate", "sample", "target", "plan", "limit")
_MIN_GAP = 1e-12
_PERCENT = 100.0
_METHOD_TEXTS = {
    "frozen": "with a policy computed beforehand, proven optimal for this plan",
    "mixture": "with a mixture of policies computed beforehand (up to version 0.2)",
    "exact": "with a policy computed for this plan",
}


def list_methods(flight: FlightData) -> list[tuple[str, str]]:
    """Return the methods by which plans were found, each with the role of its colour."""
    names = sorted({plan.method for plan in flight.plans})
    return [(name, _ROLES[index % len(_ROLES)]) for index, name in enumerate(names)]


def describe_methods(flight: FlightData) -> str:
    """Return a sentence on the methods by which plans were found, with a space after it; empty if none is known."""
    texts = [
        f"“{name}”: {_METHOD_TEXTS[name]}"
        for name in sorted({plan.method for plan in flight.plans} & set(_METHOD_TEXTS))
    ]
    return f"Methods that found plans: {'; '.join(texts)}. " if texts else ""


def draw_certificates(flight: FlightData) -> Iterator[Drawing]:
    """Draw the certified gap of each plan, and the slack of plans with a relaxed constraint."""
    if has_variation(np.array([plan.gap for plan in flight.plans])):
        yield _draw_gaps(flight)
    relaxed_plans = select_relaxed_plans(flight)
    if relaxed_plans:
        yield _draw_slack(flight, relaxed_plans)


def select_relaxed_plans(flight: FlightData) -> list[Plan]:
    """Return the flown plans with a relaxed constraint."""
    return [plan for plan in flight.flown_plans.values() if max(plan.slack, plan.terminal_miss) > SLACK_TOLERANCE]


def _draw_gaps(flight: FlightData) -> Drawing:
    with open_canvas("plan-gap", 2.5) as canvas:
        ax = canvas.axes("Certified gap", "time [s]", "% of the cost (log scale)")
        ax.set_yscale("log")
        for name, role in list_methods(flight):
            plans = [plan for plan in flight.plans if plan.method == name and np.isfinite(plan.gap)]
            gaps = _PERCENT * np.maximum(np.array([plan.gap for plan in plans], dtype=np.float64), _MIN_GAP)
            shown_s, shown = thin_keeping_largest(flight.seconds([plan.base_ns for plan in plans]), gaps)
            draw_dots(ax, shown_s, shown, role, 2.4)
        ax.yaxis.set_major_locator(LogLocator(numticks=7))
        ax.yaxis.set_minor_locator(NullLocator())
        ax.yaxis.set_major_formatter(format_power_of_ten)
        ax.margins(y=0.08)
        ax.autoscale_view()
        low, high = np.log10(ax.get_ylim())
        if np.floor(high) <= np.ceil(low):  # a single tick does not show the scale
            ax.set_ylim(10.0 ** np.floor(low), 10.0 ** np.ceil(high))
        set_time_axis(ax, flight)
    label = "Certified gap of each plan between its cost and the least possible, in percent of the cost, over time"
    return Drawing("plan-gap", canvas.svg, label)


def _draw_slack(flight: FlightData, plans: list[Plan]) -> Drawing:
    t_s = flight.seconds([plan.base_ns for plan in plans])
    with open_canvas("plan-slack", 2.5) as canvas:
        ax = canvas.axes("Relaxed constraints of flown plans", "time [s]", "sum over rows, their units")
        for role, values in (
            ("sample", np.array([plan.slack for plan in plans])),
            ("limit", np.array([plan.terminal_miss for plan in plans])),
        ):
            draw_dots(ax, *thin_keeping_largest(t_s, values), role, 3.0)
        ax.axhline(0.0, color=colour("muted"), lw=0.6)
        ax.margins(y=0.08)
        ax.autoscale_view()
        set_time_axis(ax, flight)
    return Drawing(
        "plan-slack", canvas.svg, "Slack of the state limits and of the missed terminal equality of plans, over time"
    )
