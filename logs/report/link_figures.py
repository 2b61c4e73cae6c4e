"""Plots of the link: measured ages and delays against the design, and the link's estimate in flight."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from matplotlib.ticker import FuncFormatter, MaxNLocator, NullLocator

from logs.recording.flight import FlightData
from logs.report.figures import DURATION_LABEL_IN
from logs.report.plots import DASHED, has_variation, set_time_axis, thin_samples
from logs.report.svg import Drawing, colour, open_canvas
from logs.report.verdict_link import LinkVerdict, compute_delays_s

_BINS = 40
_MIN_SHARE = 2e-5
_MIN_SPAN_SHARE = 0.01  # of the axis: a delay configured without jitter is seen, too


def draw_link_ages(flight: FlightData, verdict: LinkVerdict) -> Iterator[Drawing]:
    """Draw a histogram of the age; nothing where it never changed."""
    if sum(share > 0.0 for share in verdict.ages) > 1:
        yield _draw_age_histogram(flight, verdict)


def draw_link_in_flight(flight: FlightData, verdict: LinkVerdict) -> Iterator[Drawing]:
    """Draw the estimated share of arrivals over time, and a histogram of the delay; constant ones are left out."""
    if has_variation(np.array([estimate.arrival_mean for estimate in flight.link_estimates])):
        yield _draw_arrivals(flight)
    if verdict.delay is not None and has_variation(compute_delays_s(flight)):
        yield _draw_delay_histogram(flight, verdict)


def _draw_age_histogram(flight: FlightData, verdict: LinkVerdict) -> Drawing:
    age_count = max(len(verdict.ages), flight.design.horizon) + 1
    promised = np.array(verdict.promised_ages[:age_count])
    with open_canvas("age-share", 2.5) as canvas:
        ax = canvas.axes("Age of information", "age [steps]", "steps (log scale)", DURATION_LABEL_IN)
        ax.set_yscale("log")
        ax.bar(range(len(verdict.ages)), verdict.ages, color=colour("estimate"), alpha=0.6, width=0.8)
        if len(promised):
            ax.plot(promised, "o", ms=3.5, color=colour("limit"), ls=DASHED, lw=1.0)
        ax.yaxis.set_major_formatter(FuncFormatter(lambda share, _: f"{100 * share:g} %"))
        ax.yaxis.set_minor_locator(NullLocator())
        ax.axvline(flight.design.horizon, color=colour("muted"), lw=1.0, ls=":")
        min_share = min(share for share in verdict.ages if share > 0.0)
        ax.set_ylim(max(_MIN_SHARE, 0.3 * min_share), 1.6)
        ax.set_xlim(-0.7, age_count - 0.3)
        ax.xaxis.set_major_locator(MaxNLocator(12, integer=True))
        ax.grid(visible=False, axis="x")
    return Drawing("age-share", canvas.svg, "Share of the steps at each age of information, measured and promised")


def _draw_arrivals(flight: FlightData) -> Drawing:
    estimates = flight.link_estimates
    t_s = flight.seconds([estimate.at_ns for estimate in estimates])
    promised = estimates[-1].promised
    with open_canvas("link-estimate", 2.5) as canvas:
        ax = canvas.axes("Steps with a new position, estimated in flight", "time [s]", "probability")
        ax.step(
            *thin_samples(t_s, np.array([e.arrival_lower for e in estimates])),
            where="post",
            color=colour("estimate"),
            lw=0.8,
        )
        ax.step(
            *thin_samples(t_s, np.array([e.arrival_mean for e in estimates])),
            where="post",
            color=colour("estimate"),
            lw=1.6,
        )
        ax.axhline(promised, color=colour("limit"), lw=1.2, ls=DASHED)
        ax.set_ylim(-0.02, 1.02)
        set_time_axis(ax, flight)
    label = (
        f"Estimated probability of a new position over time with its lower bound; the design counts on {promised:.3g}"
    )
    return Drawing("link-estimate", canvas.svg, label)


def _draw_delay_histogram(flight: FlightData, verdict: LinkVerdict) -> Drawing:
    delays_ms = 1e3 * compute_delays_s(flight)
    finite_ms = delays_ms[np.isfinite(delays_ms)]
    delay = verdict.delay
    with open_canvas("link-delay", 2.5) as canvas:
        ax = canvas.axes("Capture to arrival, by the stamps", "delay [ms]", "positions")
        # One very late position would compress the rest of the histogram.
        edge = float(np.percentile(finite_ms, 99.5)) * 1.3 + 1.0
        counted_ms = np.minimum(finite_ms, edge)
        counts, edges = np.histogram(counted_ms, _BINS, (min(0.0, counted_ms.min()), max(1.0, counted_ms.max())))
        ax.stairs(counts, edges, fill=True, color=colour("estimate"), alpha=0.6)
        if delay is not None and delay.promised_low_ms is not None and delay.promised_high_ms is not None:
            low, high = delay.promised_low_ms, delay.promised_high_ms
            min_span = _MIN_SPAN_SHARE * max(high, edges[-1])
            ax.axvspan(low, max(high, low + min_span), color=colour("limit"), alpha=0.13, lw=0)
        ax.yaxis.set_major_locator(MaxNLocator(5, integer=True))
    label = "Histogram of the time from capture to arrival of the positions, with the configured span"
    return Drawing("link-delay", canvas.svg, label)
