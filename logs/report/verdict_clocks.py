"""Verdict on the clocks: source and steadiness of each offset, and error of the capture times."""

from __future__ import annotations

from collections import defaultdict

import msgspec
import numpy as np

from logs.recording.design_view import AXIS_NUMBER
from logs.recording.flight import FlightData
from logs.report.statistics import two_sided_quantile
from uavctl.arrays import Array
from uavctl.number_text import format_duration
from uavctl.records import LinkStats, PositionSample, Truth

_MIN_OFFSETS = 3

# Slower than this the true path does not show the time. [m/s]
_MOVING_MPS = 0.05


class ClockVerdict(msgspec.Struct, frozen=True, kw_only=True):
    """Clock of a connection's sender, measured against ours."""

    link: str
    text: str
    source: str  # "timesync", "minimum" or "none"
    samples: int  # positions that were stamped by it
    counted: int  # times that the offset was reported
    offset_s: float | None  # at the end
    drift_ppm: float | None  # gain of our clock on the peer's, by the offsets
    told_drift_ppm: float | None  # as the synchronisation reported it at the end
    residual_us: float | None  # of the offsets about a straight line, root mean square
    largest_residual_us: float | None
    rtt_ms: float | None  # median round trip, at the end
    rejected: int  # answers that came too late, or deviated


class StampVerdict(msgspec.Struct, frozen=True, kw_only=True):
    """Error of capture times, measured against the true path of the vehicle."""

    text: str
    late_ms: float  # stamps are later than the capture by this
    bound_ms: float  # uncertainty of that, with `level`
    positions: int


def judge_clocks(flight: FlightData) -> tuple[ClockVerdict, ...]:
    """Judge the clock of each connection that reported an offset, in order of their names."""
    stats_by_link: defaultdict[str, list[LinkStats]] = defaultdict(list)
    for stats in flight.links:
        stats_by_link[stats.link].append(stats)
    return tuple(_judge_clock(link, rows) for link, rows in sorted(stats_by_link.items()) if _select_offsets(rows))


def compute_offset_residuals(flight: FlightData, link: str) -> tuple[Array, Array]:
    """Return report times (n,) [s], and a connection's clock offsets less their straight line (n,) [s]."""
    with_offset = _select_offsets([stats for stats in flight.links if stats.link == link])
    t_s = flight.seconds([stats.at_ns for stats in with_offset])
    return t_s, _fit_residual_s(t_s, with_offset)[0]


def _select_offsets(rows: list[LinkStats]) -> list[LinkStats]:
    return [stats for stats in rows if stats.clock_offset_ns is not None]


def _fit_residual_s(t_s: Array, with_offset: list[LinkStats]) -> tuple[Array, float]:
    """Return offsets less their straight line (n,) [s], and the line's slope [s/s]."""
    first_ns = with_offset[0].clock_offset_ns or 0
    offsets_s = np.array([((stats.clock_offset_ns or 0) - first_ns) * 1e-9 for stats in with_offset])
    if len(with_offset) < _MIN_OFFSETS:
        return np.zeros(len(with_offset)), 0.0
    slope, level = np.polyfit(t_s - t_s[0], offsets_s, 1)
    return offsets_s - level - slope * (t_s - t_s[0]), float(slope)


def _judge_clock(link: str, rows: list[LinkStats]) -> ClockVerdict:
    with_offset, last_stats = _select_offsets(rows), rows[-1]
    t_s = np.array([stats.at_ns * 1e-9 for stats in with_offset])
    residual_s, slope = _fit_residual_s(t_s, with_offset)
    is_enough = len(with_offset) >= _MIN_OFFSETS
    verdict = ClockVerdict(
        link=link,
        text="",
        source=last_stats.clock_source,
        samples=last_stats.samples,
        counted=len(with_offset),
        offset_s=(with_offset[-1].clock_offset_ns or 0) * 1e-9,
        drift_ppm=1e6 * slope if is_enough else None,
        told_drift_ppm=last_stats.clock_drift_ppm,
        residual_us=1e6 * float(np.sqrt(np.mean(residual_s**2))) if is_enough else None,
        largest_residual_us=1e6 * float(np.abs(residual_s).max()) if is_enough else None,
        rtt_ms=None if last_stats.clock_rtt_ns is None else last_stats.clock_rtt_ns * 1e-6,
        rejected=last_stats.clock_rejected,
    )
    return msgspec.structs.replace(verdict, text=_describe_clock(verdict))


_SOURCES = {
    "timesync": "by TIMESYNC with the peer",
    "minimum": "by the quickest arrivals, which cannot separate a constant delay from an offset",
    "none": "without a source",
}


def format_plain(value: float) -> str:
    """Return a figure as text: three digits, all of those before the point, never an exponent."""
    text = f"{value:.0f}" if abs(value) >= 999.5 or abs(value) < 5e-4 else f"{value:.3g}"
    return text.removeprefix("-") if text == "-0" else text.replace("-", "−")


def _describe_clock(verdict: ClockVerdict) -> str:
    text = f"The offset of “{verdict.link}” was found {_SOURCES.get(verdict.source, verdict.source)}"
    if verdict.residual_us is None or verdict.drift_ppm is None:
        return f"{text}; it was reported too seldom to judge."
    round_trip_text = "" if verdict.rtt_ms is None else f"; a round trip took {verdict.rtt_ms:.3g} ms"
    refused_text = f"; {verdict.rejected} answers were refused" if verdict.rejected else ""
    return (
        f"{text}; it drifted by {format_plain(verdict.drift_ppm)} ppm and moved by "
        f"{format_duration(verdict.residual_us)} about that (root mean square){round_trip_text}{refused_text}."
    )


def judge_stamps(flight: FlightData) -> StampVerdict | None:
    """Return by which delay of the stamps positions fit the true path best [ms]; None without truth or motion.

    Least squares of position - truth(stamp) = -delay · velocity + noise.
    """
    truths, samples = flight.truths, flight.samples
    if len(truths) < 2 or len(samples) < 2:
        return None
    truth_ns = np.array([truth.at_ns for truth in truths])
    samples_inside = [sample for sample in samples if truth_ns[0] <= sample.captured_ns < truth_ns[-1]]
    if not samples_inside:
        return None
    true_position_m, true_velocity_mps = _interpolate_true_path(
        truths, truth_ns, samples_inside, [AXIS_NUMBER[axis] for axis in flight.design.axes]
    )
    squared_velocity = float(np.sum(true_velocity_mps**2))
    if squared_velocity < len(samples_inside) * _MOVING_MPS**2:
        return None
    measured = np.array([sample.position_m for sample in samples_inside])[
        :, [AXIS_NUMBER[axis] for axis in flight.design.axes]
    ]
    error_m = measured - true_position_m
    delay_s = -float(np.sum(error_m * true_velocity_mps)) / squared_velocity
    residual_m = error_m + delay_s * true_velocity_mps
    bound_s = two_sided_quantile() * float(np.sqrt(np.mean(residual_m**2) / squared_velocity))
    text = f"By the true path, capture times are {1e3 * delay_s:+.1f} ms off (± {1e3 * bound_s:.1f} ms).".replace(
        " -", " −"
    )
    return StampVerdict(text=text, late_ms=1e3 * delay_s, bound_ms=1e3 * bound_s, positions=len(samples_inside))


def _interpolate_true_path(
    truths: tuple[Truth, ...], truth_ns: np.ndarray, samples: list[PositionSample], axes: list[int]
) -> tuple[Array, Array]:
    """Return true positions [m] and velocities [m/s] at the stamps (n, axes), by cubics between the truths."""
    captured_ns = np.array([sample.captured_ns for sample in samples])
    interval = np.searchsorted(truth_ns, captured_ns, side="right") - 1
    span_s = ((truth_ns[interval + 1] - truth_ns[interval]) * 1e-9)[:, None]
    fraction = ((captured_ns - truth_ns[interval]) * 1e-9)[:, None] / span_s
    p = np.array([truth.position_m for truth in truths])[:, axes]
    v = np.array([truth.velocity_mps for truth in truths])[:, axes]
    p0, p1, v0, v1 = p[interval], p[interval + 1], v[interval] * span_s, v[interval + 1] * span_s
    quadratic, cubic = 3.0 * (p1 - p0) - 2.0 * v0 - v1, 2.0 * (p0 - p1) + v0 + v1
    position_m = p0 + fraction * (v0 + fraction * (quadratic + fraction * cubic))
    velocity_mps = (v0 + fraction * (2.0 * quadratic + fraction * 3.0 * cubic)) / span_s
    return position_m, velocity_mps
