"""Figures of a fleet: paths, distances, age of information of each vehicle, and who was served when."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations
from typing import NamedTuple

import numpy as np
from matplotlib.ticker import MaxNLocator

from logs.recording.sender import ServedPositions
from logs.report.approach import Times, compute_distances_m
from logs.report.fleet import FleetRecording, RecordedVehicle
from logs.report.page import MarkKind
from logs.report.plots import DASHED, DOTTED, thin_path, thin_samples
from logs.report.svg import Drawing, colour, draw_strokes, open_canvas
from uavctl.arrays import Array

# Colours and kinds of line of the vehicles: 21 pairs that also differ in grey.
_ROLES = ("estimate", "sample", "target", "plan", "truth", "limit", "fallback")
_LINES: tuple[tuple[MarkKind, object], ...] = (("line", "-"), ("dashed", DASHED), ("dotted", DOTTED))
_DISTANCE_STEP_NS = 50_000_000
_STROKES_PER_VEHICLE = 60  # in the drawing of the messages; more would touch
_MIN_BIN_S, _MAX_BINS = 1.0, 120
_LETTER_IN, _MAX_LABEL_IN = 0.078, 1.9
_ROW_IN, _AXIS_IN = 0.2, 0.85  # of the drawing of the messages: height of a vehicle, and of all else


class LineStyle(NamedTuple):
    """Colour and line of a vehicle in all figures."""

    role: str
    kind: MarkKind
    dashes: object


def choose_style(fleet: FleetRecording, name: str) -> LineStyle:
    """Return the style of a vehicle."""
    number = fleet.names.index(name)
    kind, dashes = _LINES[number // len(_ROLES) % len(_LINES)]
    return LineStyle(_ROLES[number % len(_ROLES)], kind, dashes)


def draw_paths(fleet: FleetRecording) -> Iterator[Drawing]:
    """Draw all paths from above, and the least distance of any two vehicles over time."""
    with open_canvas("paths", 3.7) as canvas:
        ax = canvas.axes("From above", "east [m]", "north [m]")
        for south, north, west, east in {vehicle.limits_m for vehicle in fleet.vehicles}:
            if np.isfinite([south, north, west, east]).all():
                corners = [west, east, east, west, west], [south, south, north, north, south]
                ax.plot(*corners, color=colour("muted"), lw=0.8, ls=DASHED, zorder=1)
        for track in fleet.tracks:
            style, points = choose_style(fleet, track.name), thin_path(track.position_m)
            ax.plot(points[:, 1], points[:, 0], color=colour(style.role), ls=style.dashes, lw=1.4, zorder=3)
            ax.plot(points[0, 1], points[0, 0], "o", ms=5.5, mfc=colour("card"), mec=colour(style.role), zorder=4)
            ax.plot(points[-1, 1], points[-1, 0], "o", ms=5.5, color=colour(style.role), zorder=5)
        ax.set_aspect("equal", adjustable="datalim")
        ax.margins(0.06)
    yield Drawing("paths", canvas.svg, f"Paths of {len(fleet.tracks)} vehicles from above")
    if fleet.approaches:
        yield _draw_least_distance(fleet)


def _draw_least_distance(fleet: FleetRecording) -> Drawing:
    at_ns = np.arange(fleet.begin_ns, fleet.end_ns + 1, _DISTANCE_STEP_NS, dtype=np.int64)
    least_m = np.full(len(at_ns), np.nan)
    for first, second in combinations(fleet.tracks, 2):
        least_m = np.fmin(least_m, compute_distances_m(first, second, at_ns))
    with open_canvas("least-distance", 3.7) as canvas:
        ax = canvas.axes("Least distance of any two", "time [s]", "distance [m]")
        ax.plot(*thin_samples(fleet.to_seconds(at_ns), least_m), color=colour("truth" if fleet.is_true else "estimate"))
        if fleet.contact_m is not None:
            ax.axhline(fleet.contact_m, color=colour("limit"), lw=1.2, ls=DASHED)
        for collision in fleet.collisions:
            ax.axvline(fleet.to_seconds(collision.at_ns), color=colour("limit"), lw=1.2)
        ax.set_ylim(0.0, None)
        ax.set_xlim(0.0, max(fleet.duration_s, 1e-9))
    return Drawing("least-distance", canvas.svg, "Least distance of any two vehicles over time")


def draw_ages(fleet: FleetRecording) -> Iterator[Drawing]:
    """Draw the age of information of each vehicle over time, all to one scale."""
    highest_s = max((float(vehicle.ages_s.max(initial=0.0)) for vehicle in fleet.vehicles), default=0.0)
    for number, vehicle in enumerate(fleet.vehicles):
        if len(vehicle.ages_s) and highest_s > 0.0:
            yield _draw_age(fleet, vehicle, f"age-{number}", 1.1 * highest_s)


def _draw_age(fleet: FleetRecording, vehicle: RecordedVehicle, key: str, top_s: float) -> Drawing:
    with open_canvas(key, 1.75) as canvas:
        ax = canvas.axes(vehicle.name, "time [s]", "age [s]")
        for begin_ns, end_ns in vehicle.fallbacks_ns:
            ax.axvspan(fleet.to_seconds(begin_ns), fleet.to_seconds(end_ns), color=colour("fallback"), alpha=0.22, lw=0)
        t_s, ages_s = thin_samples(fleet.to_seconds(vehicle.age_at_ns), vehicle.ages_s)
        ax.plot(t_s, ages_s, color=colour("estimate"), lw=1.1)
        if vehicle.horizon_s <= top_s:
            ax.axhline(vehicle.horizon_s, color=colour("limit"), lw=1.2, ls=DASHED)
        ax.set_ylim(0.0, top_s)
        ax.yaxis.set_major_locator(MaxNLocator(4))
        ax.set_xlim(0.0, max(fleet.duration_s, 1e-9))
    return Drawing(key, canvas.svg, f"Age of information of {vehicle.name} over time")


def draw_messages(fleet: FleetRecording, sent: ServedPositions) -> Iterator[Drawing]:
    """Draw each message as a stroke in its vehicle's row, and the messages a second to each vehicle."""
    yield _draw_raster(fleet, sent)
    begin_s, end_s = (float(fleet.to_seconds(at_ns)) for at_ns in (sent.at_ns[0], sent.at_ns[-1]))
    bins = min(_MAX_BINS, int((end_s - begin_s) / _MIN_BIN_S))
    if bins >= 2:
        yield _draw_rates(fleet, sent, np.linspace(begin_s, end_s, bins + 1))


def choose_raster_span(sent: ServedPositions) -> tuple[int, int]:
    """Return the first and last index of the messages that are drawn: all, or those around the longest wait."""
    count, most = len(sent.at_ns), _STROKES_PER_VEHICLE * len(sent.names)
    if count <= most:
        return 0, count - 1
    at_ns = max((find_longest_wait(sent, name) for name in sent.names), key=lambda wait: wait.wait_ns).begin_ns
    middle = int(np.searchsorted(sent.at_ns, at_ns))
    first = min(max(0, middle - most // 2), count - most)
    return first, first + most - 1


class LongestWait(NamedTuple):
    """Time of a vehicle without a message."""

    wait_ns: int
    begin_ns: int  # UTC


def find_longest_wait(sent: ServedPositions, name: str) -> LongestWait:
    """Return the longest time of a vehicle without a message, also before its first and after its last one."""
    times_ns: Times = np.concatenate([sent.at_ns[:1], sent.get_times_ns(name), sent.at_ns[-1:]])
    waits_ns = np.diff(times_ns)
    longest = int(waits_ns.argmax())
    return LongestWait(int(waits_ns[longest]), int(times_ns[longest]))


def _compute_label_in(names: tuple[str, ...]) -> float:
    return min(_MAX_LABEL_IN, 0.3 + _LETTER_IN * max(map(len, names)))


def _draw_raster(fleet: FleetRecording, sent: ServedPositions) -> Drawing:
    first, last = choose_raster_span(sent)
    shown_s: Array = fleet.to_seconds(sent.at_ns[first : last + 1])
    rows = sent.vehicles[first : last + 1]
    with open_canvas("messages", _AXIS_IN + _ROW_IN * max(4, len(sent.names))) as canvas:
        ax = canvas.axes("Messages", "time [s]", "", _compute_label_in(sent.names))
        for number, name in enumerate(sent.names):
            t_s = shown_s[rows == number]
            role = choose_style(fleet, name).role
            low, high = np.full(len(t_s), number - 0.33), np.full(len(t_s), number + 0.33)
            draw_strokes(ax, (t_s, low), (t_s, high), colour(role), 0.8)
        ax.set_yticks(range(len(sent.names)), sent.names)
        ax.set_ylim(len(sent.names) - 0.4, -0.6)
        ax.set_xlim(float(shown_s[0]), max(float(shown_s[-1]), float(shown_s[0]) + 1e-3))
        ax.grid(visible=False, axis="y")
    return Drawing("messages", canvas.svg, f"Messages of the sender to {len(sent.names)} vehicles over time")


def _draw_rates(fleet: FleetRecording, sent: ServedPositions, edges_s: Array) -> Drawing:
    with open_canvas("message-rates", _AXIS_IN + _ROW_IN * max(4, len(sent.names))) as canvas:
        ax = canvas.axes("Messages a second", "time [s]", "messages [1/s]")
        for name in sent.names:
            style = choose_style(fleet, name)
            counts, _ = np.histogram(fleet.to_seconds(sent.get_times_ns(name)), edges_s)
            ax.step(
                edges_s,
                np.append(counts, counts[-1:]) / np.diff(edges_s)[0],
                where="post",
                color=colour(style.role),
                ls=style.dashes,
                lw=1.2,
            )
        ax.set_ylim(0.0, None)
        ax.set_xlim(float(edges_s[0]), float(edges_s[-1]))
    return Drawing("message-rates", canvas.svg, "Messages a second to each vehicle over time")
