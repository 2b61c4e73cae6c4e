"""How plans were found: how far from the optimum they are certified to be, and what they gave way by."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from matplotlib.ticker import LogLocator, NullLocator

from logs.flight_data import FlightData
from logs.plots import span
from logs.plots_control import largest
from logs.summary import SLACK_TOLERANCE
from logs.svg import Drawing, canvas, colour, dots, power_of_ten
from uavctl.data import Plan

# Roles of the ways to a plan, in the order of their names.
_ROLES = ("estimate", "sample", "target", "plan", "limit")
_LEAST_GAP = 1e-12
_PERCENT = 100.0
_WAYS = {
    "frozen": "with the policy that costs least of those made beforehand",
    "mixture": "with another of them, or with several, weighed together",
    "exact": "with a policy found for this very plan",
}


def methods(flight: FlightData) -> list[tuple[str, str]]:
    """Ways in which plans were found, each with its colour's role."""
    names = sorted({plan.method for plan in flight.plans})
    return [(name, _ROLES[place % len(_ROLES)]) for place, name in enumerate(names)]


def ways(flight: FlightData) -> str:
    """A sentence on the ways in which plans were found, and a space after it; empty where none is known."""
    told = [f"“{name}”: {_WAYS[name]}" for name in sorted({plan.method for plan in flight.plans} & set(_WAYS))]
    return f"Plans were found in these ways: {'; '.join(told)}. " if told else ""


def certificates(flight: FlightData) -> Iterator[Drawing]:
    """Certified gap of each plan, and the slack of those that gave way."""
    if any(np.isfinite(plan.gap) for plan in flight.plans):
        yield _gaps(flight)
    gave = [plan for plan in flight.flown_plans.values() if max(plan.slack, plan.terminal_miss) > SLACK_TOLERANCE]
    if gave:
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
        span(ax, flight)
    return Drawing("plan-slack", one.svg, "Slack of the state limits and of the rest at the end of plans, over time")
