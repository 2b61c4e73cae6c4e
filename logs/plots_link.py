"""The link: ages and delays seen against those promised, and what was believed of it on the way."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from matplotlib.ticker import FuncFormatter, MaxNLocator, NullLocator

from logs.flight_data import FlightData
from logs.plots import DASHED, span, thin
from logs.svg import Drawing, canvas, colour
from logs.verdict_link import LinkVerdict, delays_s

_BINS = 40
_LEAST_SHARE = 2e-5
_LEAST_SPAN = 0.01  # of the axis: a delay configured without jitter is seen, too


def link(flight: FlightData, verdict: LinkVerdict) -> Iterator[Drawing]:
    """Histogram of the age, of the delay, and the estimate of the arrivals over time."""
    if verdict.ages:
        yield _ages(flight, verdict)
    if flight.link_estimates:
        yield _arrivals(flight)
    if verdict.delay is not None:
        yield _delays(flight, verdict)


def _ages(flight: FlightData, verdict: LinkVerdict) -> Drawing:
    shown = max(len(verdict.ages), flight.design.horizon) + 1
    promised = np.array(verdict.promised_ages[:shown])
    with canvas("age-share", 2.5) as one:
        ax = one.axes("Age of information", "age [steps]", "steps (log scale)")
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
