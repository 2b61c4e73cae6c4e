"""Pictures of the verdicts: errors of the forecast, what they tell of each other, ellipsoids, clocks."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from matplotlib.ticker import MaxNLocator

from logs.design_view import Floats
from logs.flight_data import FlightData
from logs.plots import DASHED, span
from logs.statistics import normal_reach
from logs.svg import Drawing, canvas, colour, dots, strokes
from logs.verdict_clock import ClockVerdict, offsets
from logs.verdict_model import AxisVerdict, LeadVerdict

MARKS = 1200
_MARGIN = 1.25


def whiteness(axis: AxisVerdict) -> Drawing:
    """Correlation of an axis' errors with those of later positions."""
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
    """Share of the positions in their ellipsoids, by the time ahead."""
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
    """One-step errors of an axis over time, in foretold deviations."""
    with canvas(f"error-{axis}", 2.3) as one:
        ax = one.axes(f"Errors of the forecast, {axis}", "time [s]", "foretold deviations")
        reach = normal_reach()
        ax.axhspan(-reach, reach, color=colour("target"), alpha=0.15, lw=0)
        stride = max(1, -(-len(t_s) // MARKS))
        dots(ax, t_s[::stride], normalised[::stride], "estimate", 1.8)
        most = max(4.0, 1.1 * float(np.abs(normalised).max(initial=0.0)))
        ax.set_ylim(-most, most)
        span(ax, flight)
    return Drawing(f"error-{axis}", one.svg, f"Errors of the forecast {axis} over time, in foretold deviations")


def clocks(flight: FlightData, verdicts: tuple[ClockVerdict, ...]) -> Iterator[Drawing]:
    """Offsets about their straight line, of clocks that strayed from it."""
    for number, verdict in enumerate(verdicts):
        if not verdict.residual_us:
            continue
        t_s, residual_s = offsets(flight, verdict.link)
        with canvas(f"clock-{number}", 2.3) as one:
            ax = one.axes(f"Clock of “{verdict.link}”", "time [s]", "offset less its line [ms]")
            ax.step(t_s, 1e3 * residual_s, where="post", color=colour("estimate"), lw=1.2)
            ax.axhline(0.0, color=colour("muted"), lw=0.8)
            span(ax, flight)
        yield Drawing(f"clock-{number}", one.svg, f"Clock offset of {verdict.link} less its straight line, over time")
