"""Plots of the verdicts: errors of the forecasts, their correlation, confidence ellipsoids, clocks."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from matplotlib.ticker import MaxNLocator

from logs.recording.flight import FlightData
from logs.report.plots import DASHED, has_variation, set_time_axis
from logs.report.statistics import two_sided_quantile
from logs.report.svg import Drawing, colour, draw_dots, draw_strokes, open_canvas
from logs.report.verdict_clocks import ClockVerdict, compute_offset_residuals
from logs.report.verdict_model import AxisVerdict, LeadVerdict
from uavctl.arrays import Array

MAX_VERDICT_MARKS = 1200
_MARGIN = 1.25


def draw_whiteness(axis: AxisVerdict) -> Drawing:
    """Draw the autocorrelation of an axis' one-step errors."""
    label = f"Correlation of the forecast's errors {axis.axis} with those of later positions; white within the band"
    return draw_correlation(axis.axis, np.array(axis.correlation), axis.correlation_bound, label)


def draw_correlation(axis: str, correlation: Array, bound: float, label: str) -> Drawing:
    """Draw the autocorrelation of the errors of an axis at 1, 2, … positions apart, with a band for white ones."""
    lags = np.arange(1, len(correlation) + 1, dtype=np.float64)
    with open_canvas(f"white-{axis}", 2.3) as canvas:
        ax = canvas.axes(f"Whiteness, {axis}", "positions apart", "correlation of errors")
        ax.axhspan(-bound, bound, color=colour("target"), alpha=0.15, lw=0)
        ax.axhline(0.0, color=colour("muted"), lw=0.8)
        draw_strokes(ax, (lags, np.zeros(len(lags))), (lags, correlation), colour("estimate"), 2.4)
        draw_dots(ax, lags, correlation, "estimate", 5.0)
        reach = max(0.3, _MARGIN * float(np.abs(correlation).max()), _MARGIN * bound)
        ax.set_ylim(-reach, reach)
        ax.set_xlim(0.0, len(lags) + 1.0)
        ax.xaxis.set_major_locator(MaxNLocator(5, integer=True))
    return Drawing(f"white-{axis}", canvas.svg, label)


def draw_coverage(leads: tuple[LeadVerdict, ...]) -> Drawing:
    """Draw the share of positions inside their confidence ellipsoids over the time ahead."""
    t_s = np.array([lead.lead_s for lead in leads])
    with open_canvas("coverage", 2.3) as canvas:
        ax = canvas.axes("Positions in their ellipsoid", "time ahead [s]", "share [%]")
        low, high = (100.0 * np.array([getattr(lead.inside, side) for lead in leads]) for side in ("low", "high"))
        rate = np.array([100.0 * lead.inside.rate for lead in leads])
        draw_strokes(ax, (t_s, low), (t_s, high), colour("estimate"), 1.4)
        draw_dots(ax, t_s, rate, "estimate", 5.0)
        ax.axhline(100.0 * leads[0].promised, color=colour("limit"), lw=1.2, ls=DASHED)
        ax.set_ylim(min(50.0, float(low.min()) - 5.0), 103.0)
        ax.set_xlim(0.0, t_s[-1] * 1.05)
    label = "Share of the positions within the ellipsoid predicted for them, by the time ahead, with exact intervals"
    return Drawing("coverage", canvas.svg, label)


def draw_errors(flight: FlightData, axis: str, t_s: Array, normalised: Array) -> Drawing:
    """Draw the one-step errors of an axis over time, in predicted standard deviations."""
    with open_canvas(f"error-{axis}", 2.3) as canvas:
        ax = canvas.axes(f"Errors of the forecast, {axis}", "time [s]", "predicted deviations")
        reach = two_sided_quantile()
        ax.axhspan(-reach, reach, color=colour("target"), alpha=0.15, lw=0)
        stride = max(1, -(-len(t_s) // MAX_VERDICT_MARKS))
        draw_dots(ax, t_s[::stride], normalised[::stride], "estimate", 1.8)
        limit = max(4.0, 1.1 * float(np.abs(normalised).max(initial=0.0)))
        ax.set_ylim(-limit, limit)
        set_time_axis(ax, flight)
    return Drawing(f"error-{axis}", canvas.svg, f"Errors of the forecast {axis} over time, in predicted deviations")


def draw_clocks(flight: FlightData, verdicts: tuple[ClockVerdict, ...]) -> Iterator[Drawing]:
    """Draw clock offsets about their straight line, for clocks that strayed from it."""
    for number, verdict in enumerate(verdicts):
        if not verdict.residual_us or not has_variation(compute_offset_residuals(flight, verdict.link)[1]):
            continue
        t_s, residual_s = compute_offset_residuals(flight, verdict.link)
        with open_canvas(f"clock-{number}", 2.3) as canvas:
            ax = canvas.axes(f"Clock of “{verdict.link}”", "time [s]", "offset less its line [ms]")
            ax.step(t_s, 1e3 * residual_s, where="post", color=colour("estimate"), lw=1.2)
            ax.axhline(0.0, color=colour("muted"), lw=0.8)
            set_time_axis(ax, flight)
        yield Drawing(
            f"clock-{number}", canvas.svg, f"Clock offset of {verdict.link} less its straight line, over time"
        )
