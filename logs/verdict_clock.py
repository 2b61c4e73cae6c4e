"""Verdict on the clocks: where capture times come from, how steady the offset was, and how true the stamps were."""

from __future__ import annotations

from collections import defaultdict

import msgspec
import numpy as np

from logs.design_view import AXIS_NUMBER, Floats
from logs.digits import duration
from logs.flight_data import FlightData
from logs.statistics import normal_reach
from uavctl.data import LinkStats, PositionSample, Truth

_FEWEST = 3
# Slower than this the true path says nothing of the time. [m/s]
_MOVING_MPS = 0.05


class ClockVerdict(msgspec.Struct, frozen=True, kw_only=True):
    """A connection's clock against ours."""

    link: str
    text: str
    source: str  # "timesync", "minimum" or "none"
    samples: int  # positions that were stamped by it
    counted: int  # times that the offset was told
    offset_s: float | None  # at the end
    drift_ppm: float | None  # what our clock gained on the peer's, by the offsets
    told_drift_ppm: float | None  # as the synchronisation itself told it at the end
    residual_us: float | None  # of the offsets about a straight line, root mean square
    largest_residual_us: float | None
    rtt_ms: float | None  # median round trip, at the end
    rejected: int  # answers that came too late, or deviated


class StampVerdict(msgspec.Struct, frozen=True, kw_only=True):
    """By how much capture times are off, by where the vehicle truly was."""

    text: str
    late_ms: float  # stamps are later than the capture by this
    bound_ms: float  # uncertainty of that, with `level`
    positions: int


def judge_clocks(flight: FlightData) -> tuple[ClockVerdict, ...]:
    """One verdict for each connection that ever told an offset, in order of their names."""
    told: defaultdict[str, list[LinkStats]] = defaultdict(list)
    for one in flight.links:
        told[one.link].append(one)
    return tuple(_clock(link, rows) for link, rows in sorted(told.items()) if _offsets(rows))


def offsets(flight: FlightData, link: str) -> tuple[Floats, Floats]:
    """Times of the report (n,) [s] and a connection's offsets less their straight line (n,) [s]."""
    known = _offsets([one for one in flight.links if one.link == link])
    t_s = flight.seconds([one.at_ns for one in known])
    return t_s, _residual_s(t_s, known)[0]


def _offsets(rows: list[LinkStats]) -> list[LinkStats]:
    return [one for one in rows if one.clock_offset_ns is not None]


def _residual_s(t_s: Floats, known: list[LinkStats]) -> tuple[Floats, float]:
    """Offsets less their straight line (n,) [s], and the line's slope."""
    first_ns = known[0].clock_offset_ns or 0
    off_s = np.array([((one.clock_offset_ns or 0) - first_ns) * 1e-9 for one in known])
    if len(known) < _FEWEST:
        return np.zeros(len(known)), 0.0
    slope, level = np.polyfit(t_s - t_s[0], off_s, 1)
    return off_s - level - slope * (t_s - t_s[0]), float(slope)


def _clock(link: str, rows: list[LinkStats]) -> ClockVerdict:
    known, last = _offsets(rows), rows[-1]
    t_s = np.array([one.at_ns * 1e-9 for one in known])
    residual_s, slope = _residual_s(t_s, known)
    enough = len(known) >= _FEWEST
    found = ClockVerdict(
        link=link,
        text="",
        source=last.clock_source,
        samples=last.samples,
        counted=len(known),
        offset_s=(known[-1].clock_offset_ns or 0) * 1e-9,
        drift_ppm=1e6 * slope if enough else None,
        told_drift_ppm=last.clock_drift_ppm,
        residual_us=1e6 * float(np.sqrt(np.mean(residual_s**2))) if enough else None,
        largest_residual_us=1e6 * float(np.abs(residual_s).max()) if enough else None,
        rtt_ms=None if last.clock_rtt_ns is None else last.clock_rtt_ns * 1e-6,
        rejected=last.clock_rejected,
    )
    return msgspec.structs.replace(found, text=_text(found))


_SOURCES = {
    "timesync": "by asking the peer (TIMESYNC)",
    "minimum": "by the quickest arrivals, which cannot tell a constant delay from an offset",
    "none": "from nothing",
}


def plain(value: float) -> str:
    """A figure for people: three digits, all of those before the point, never an exponent."""
    told = f"{value:.0f}" if abs(value) >= 999.5 or abs(value) < 5e-4 else f"{value:.3g}"
    return told.removeprefix("-") if told == "-0" else told.replace("-", "−")


def _text(found: ClockVerdict) -> str:
    told = f"The offset of “{found.link}” was found {_SOURCES.get(found.source, found.source)}"
    if found.residual_us is None or found.drift_ppm is None:
        return f"{told}; it was told too seldom to judge."
    trip = "" if found.rtt_ms is None else f"; a round trip took {found.rtt_ms:.3g} ms"
    refused = f"; {found.rejected} answers were refused" if found.rejected else ""
    return (
        f"{told}; it drifted by {plain(found.drift_ppm)} ppm and moved by "
        f"{duration(found.residual_us)} about that (root mean square){trip}{refused}."
    )


def judge_stamps(flight: FlightData) -> StampVerdict | None:
    """Delay of the stamps that fits the positions to the true path best; None without truth or without motion.

    Least squares of position - truth(stamp) = -delay · velocity + noise.
    """
    truths, samples = flight.truths, flight.samples
    if len(truths) < 2 or len(samples) < 2:
        return None
    known_ns = np.array([one.at_ns for one in truths])
    inside = [one for one in samples if known_ns[0] <= one.captured_ns < known_ns[-1]]
    if not inside:
        return None
    place, speed = _true_path(truths, known_ns, inside, [AXIS_NUMBER[axis] for axis in flight.design.axes])
    weight = float(np.sum(speed**2))
    if weight < len(inside) * _MOVING_MPS**2:
        return None
    measured = np.array([one.position_m for one in inside])[:, [AXIS_NUMBER[axis] for axis in flight.design.axes]]
    off = measured - place
    late_s = -float(np.sum(off * speed)) / weight
    noise = off + late_s * speed
    bound_s = normal_reach() * float(np.sqrt(np.mean(noise**2) / weight))
    text = f"By the true path, capture times are {1e3 * late_s:+.1f} ms off (± {1e3 * bound_s:.1f} ms).".replace(
        " -", " −"
    )
    return StampVerdict(text=text, late_ms=1e3 * late_s, bound_ms=1e3 * bound_s, positions=len(inside))


def _true_path(
    truths: tuple[Truth, ...], known_ns: np.ndarray, samples: list[PositionSample], axes: list[int]
) -> tuple[Floats, Floats]:
    """Where the vehicle truly was at the stamps, and how fast (n, axes), by cubics between the truths."""
    at = np.array([one.captured_ns for one in samples])
    left = np.searchsorted(known_ns, at, side="right") - 1
    span_s = ((known_ns[left + 1] - known_ns[left]) * 1e-9)[:, None]
    part = ((at - known_ns[left]) * 1e-9)[:, None] / span_s
    p = np.array([one.position_m for one in truths])[:, axes]
    v = np.array([one.velocity_mps for one in truths])[:, axes]
    p0, p1, v0, v1 = p[left], p[left + 1], v[left] * span_s, v[left + 1] * span_s
    bend, twist = 3.0 * (p1 - p0) - 2.0 * v0 - v1, 2.0 * (p0 - p1) + v0 + v1
    place = p0 + part * (v0 + part * (bend + part * twist))
    speed = (v0 + part * (2.0 * bend + part * 3.0 * twist)) / span_s
    return place, speed
