"""Page of a flight from a `.tlog` or a ULog, with any controller."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from logs.recording.design_view import AXIS_NUMBER
from logs.recording.mavlink_flight import Ages, MavlinkFlight, MavlinkFlightInfo, format_rate, list_facts
from logs.recording.output_files import write_atomically
from logs.report.figures import thin_keeping_largest
from logs.report.page import (
    Mark,
    PageSection,
    Part,
    render_facts,
    render_folded,
    render_list,
    render_page,
    render_table,
)
from logs.report.plots import DISPLAY_AXES, DOTTED, PATH_VIEWS, RATE_NAMES, has_variation, thin_path, thin_samples
from logs.report.svg import Drawing, colour, draw_dots, open_canvas
from logs.report.tlog_headline import derive_tlog_headline
from uavctl.arrays import Array

_MAX_ROWS = 1000  # of a table on the page; the document of `--json` has all


def write_tlog_page(flight: MavlinkFlight, path: Path) -> None:
    """Write the page.

    Raises:
        RecordingError: The file cannot be written.
    """
    write_atomically(path, render_tlog_page(flight))


def render_tlog_page(flight: MavlinkFlight) -> str:
    """Return the page of a flight as HTML."""
    info = flight.info
    return render_page(
        f"Flight in {Path(info.recording).name}",
        f"{info.begin_utc or 'no date'} · {info.duration_s:.1f} s · {info.autopilot or 'no autopilot'}",
        SECTIONS,
        flight,
        derive_tlog_headline(flight),
    )


def describe_recording(info: MavlinkFlightInfo) -> Iterator[str]:
    """Return sentences on oddities of the recording that the table does not have."""
    if info.vehicle_system is None:
        yield "The recording holds no heartbeat of an autopilot, so it does not show the vehicle's flight."
    yield from (f"{note}." for note in info.notes)


def _draw_height(flight: MavlinkFlight) -> Iterator[Part]:
    yield _draw_values(flight, "height", "Height", "height [m]", flight.height_t_s, flight.height_m)


def _draw_battery(flight: MavlinkFlight) -> Iterator[Part]:
    yield _draw_values(flight, "battery", "Battery", "voltage [V]", flight.battery_t_s, flight.battery_v)


def _draw_ages(flight: MavlinkFlight) -> Iterator[Part]:
    known = [(source, ages) for source, ages in flight.ages.items() if len(ages.age_s)]
    return (_draw_age(flight, f"age-{number}", source, ages) for number, (source, ages) in enumerate(known))


def _show_modes(flight: MavlinkFlight) -> Iterator[Part]:
    rows = [(f"{mode.at_s:.2f}", mode.mode, "armed" if mode.armed else "") for mode in flight.info.modes]
    return _make_table(("from [s]", "mode", "armed"), rows)


def _show_texts(flight: MavlinkFlight) -> Iterator[Part]:
    rows = [(f"{text.at_s:.2f}", text.severity, text.text) for text in flight.info.texts]
    return _make_table(("at [s]", "severity", "text"), rows)


def _show_contents(flight: MavlinkFlight) -> Iterator[Part]:
    info = flight.info
    messages = [(name, str(number), format_rate(info, name)) for name, number in info.messages.items()]
    yield render_folded("Messages", render_table(("message", "number", "rate"), messages, frozenset({1, 2})))
    parameters = [(name, str(parameter.value), parameter.type) for name, parameter in info.parameters.items()]
    if parameters:
        table = render_table(("parameter", "value", "type"), parameters, frozenset({1}))
        yield render_folded("Parameters of the vehicle", table)


def _show_summary(flight: MavlinkFlight) -> Iterator[Part]:
    yield render_list(describe_recording(flight.info))
    yield render_facts(list_facts(flight.info))


def _has_place(flight: MavlinkFlight) -> bool:
    return bool(len(flight.own.t_s) or flight.sent)


def _make_table(columns: Sequence[str], rows: Sequence[tuple[str, ...]]) -> Iterator[Part]:
    more = [f"{len(rows) - _MAX_ROWS} more are in the document of --json"] if len(rows) > _MAX_ROWS else []
    if rows:
        yield render_table(columns, rows[:_MAX_ROWS], frozenset({0}), more)


def _draw_paths(flight: MavlinkFlight) -> Iterator[Drawing]:
    for key, title, axes_shown in PATH_VIEWS:
        columns = [AXIS_NUMBER[axis] for axis in axes_shown]
        tracks = (flight.own.position_m, *(track.position_m for track in flight.sent.values()))
        if not any(has_variation(track[:, number]) for track in tracks for number in columns):
            continue
        signs = np.array([DISPLAY_AXES[axis][1] for axis in axes_shown])
        names = [DISPLAY_AXES[axis][0] for axis in axes_shown]
        with open_canvas(key, 3.7) as canvas:
            ax = canvas.axes(title, f"{names[0]} [m]", f"{names[1]} [m]")
            for track in flight.sent.values():
                points = thin_path(track.position_m)[:, columns] * signs
                draw_dots(ax, points[:, 0], points[:, 1], "sample", 2.4)
            points = thin_path(flight.own.position_m)[:, columns] * signs
            ax.plot(*points.T, color=colour("estimate"), lw=1.4, zorder=3)
            ax.plot(*points[:1].T, "o", ms=6, mfc=colour("card"), mec=colour("estimate"), mew=1.5, zorder=4)
            ax.set_aspect("equal", adjustable="datalim")
            ax.margins(0.06)
        yield Drawing(key, canvas.svg, f"Path seen {title[0].lower()}{title[1:]}: {names[0]} and {names[1]} in metres")


def _draw_axes(flight: MavlinkFlight) -> Iterator[Drawing]:
    for axis, number in AXIS_NUMBER.items():
        name, sign = DISPLAY_AXES[axis]
        sent = [(track.t_s, track.position_m) for track in flight.sent.values()]
        places = (flight.own.position_m, flight.setpoint_m, *(values for _, values in sent))
        if any(has_variation(place[:, number]) for place in places):
            yield _draw_against_setpoints(
            flight, f"position-{axis}", name.capitalize(), f"{name} [m]",
            [(t_s, sign * values[:, number]) for t_s, values in sent],
            (flight.own.t_s, sign * flight.own.position_m[:, number]),
            sign * flight.setpoint_m[:, number],
        )  # fmt: skip
        speed = sign * flight.own.velocity_mps[:, number]
        if has_variation(speed):
            yield _draw_against_setpoints(
                flight, f"velocity-{axis}", RATE_NAMES[axis].capitalize(), f"{RATE_NAMES[axis]} [m/s]", [],
                (flight.own.t_s, speed), sign * flight.setpoint_mps[:, number],
            )  # fmt: skip


def _draw_against_setpoints(
    flight: MavlinkFlight,
    key: str,
    title: str,
    y_label: str,
    sent: Sequence[tuple[Array, Array]],
    own: tuple[Array, Array],
    setpoints: Array,
) -> Drawing:
    with open_canvas(key, 2.3) as canvas:
        ax = canvas.axes(title, "time [s]", y_label)
        for t_s, values in sent:
            draw_dots(ax, *thin_samples(t_s, values), "sample", 2.0)
        ax.plot(*thin_samples(*own), color=colour("estimate"), lw=1.4, zorder=3)
        ax.plot(*thin_samples(flight.setpoint_t_s, setpoints), color=colour("target"), lw=1.1, ls=DOTTED, zorder=4)
        ax.set_xlim(0, max(flight.duration_s, 1e-3))
    return Drawing(key, canvas.svg, f"{title} over time")


def _draw_attitude(flight: MavlinkFlight) -> Iterator[Drawing]:
    for number, angle in enumerate(("roll", "pitch", "yaw")):
        values = flight.attitude_deg[:, number]
        if has_variation(values):
            yield _draw_values(
                flight, f"attitude-{angle}", angle.capitalize(), f"{angle} [°]", flight.attitude_t_s, values
            )


def _draw_values(flight: MavlinkFlight, key: str, title: str, y_label: str, t_s: Array, values: Array) -> Drawing:
    with open_canvas(key, 2.3) as canvas:
        ax = canvas.axes(title, "time [s]", y_label)
        ax.plot(*thin_samples(t_s, values), color=colour("estimate"), lw=1.1)
        ax.set_xlim(0, max(flight.duration_s, 1e-3))
    return Drawing(key, canvas.svg, f"{title} over time")


def _draw_age(flight: MavlinkFlight, key: str, source: str, ages: Ages) -> Drawing:
    with open_canvas(key, 2.3) as canvas:
        ax = canvas.axes(source, "time [s]", "age [s]")
        t_s, age_s = thin_keeping_largest(ages.age_t_s, ages.age_s)
        ax.plot(t_s, age_s, color=colour("estimate"), lw=1.1)
        draw_dots(
            ax,
            *thin_keeping_largest(ages.t_s[np.isfinite(ages.delay_s)], ages.delay_s[np.isfinite(ages.delay_s)]),
            "sample",
            2.0,
        )
        ax.set_xlim(0, max(flight.duration_s, 1e-3))
        ax.set_ylim(bottom=0)
    return Drawing(key, canvas.svg, f"Age of the positions of {source} over time")


def _draw_setpoints(flight: MavlinkFlight) -> Iterator[Drawing]:
    for axis, number in AXIS_NUMBER.items():
        name, sign = DISPLAY_AXES[axis]
        values = sign * flight.setpoint_mps2[:, number]
        if not has_variation(values):
            continue
        key, upwards = f"setpoint-{axis}", "upwards" if axis == "down" else name
        with open_canvas(key, 2.3) as canvas:
            ax = canvas.axes(f"Acceleration {upwards}", "time [s]", f"acceleration {upwards} [m/s²]")
            ax.step(*thin_samples(flight.setpoint_t_s, values), where="post", color=colour("estimate"), lw=1.1)
            ax.set_xlim(0, max(flight.duration_s, 1e-3))
        yield Drawing(key, canvas.svg, f"Acceleration setpoint {upwards} over time")


_MARKS = (
    Mark("line", "estimate", "position of the vehicle's own", when=lambda flight: len(flight.own.t_s)),
    Mark("dot", "sample", "position sent to it", when=lambda flight: flight.sent),
)
_SETPOINT = Mark(
    "dotted",
    "target",
    "setpoint",
    when=lambda flight: np.isfinite(flight.setpoint_m).any() or np.isfinite(flight.setpoint_mps).any(),
)
SECTIONS: tuple[PageSection[MavlinkFlight], ...] = (
    PageSection("Path", _draw_paths, when=_has_place, legend=_MARKS),
    PageSection(
        "Axes over time",
        _draw_axes,
        when=_has_place,
        note="Time counts from the start of the recording. Positions are in local NED; height is positive upwards.",
        legend=(*_MARKS, _SETPOINT),
    ),
    PageSection(
        "Height",
        _draw_height,
        when=lambda flight: not _has_place(flight) and has_variation(flight.height_m),
        note="The vehicle reported its height, but no position.",
    ),
    PageSection("Battery", _draw_battery, when=lambda flight: has_variation(flight.battery_v)),
    PageSection("Attitude", _draw_attitude),
    PageSection(
        "Age of positions",
        _draw_ages,
        note="The age of the newest position grows until another one arrives. Its source's clock is not known: ages "
        "are those beyond the quickest position of the last ten seconds.",
    ),
    PageSection(
        "Acceleration setpoints",
        _draw_setpoints,
        when=lambda flight: flight.info.setpoints,
        empty_text="The acceleration setpoints are constant.",
    ),
    PageSection("Modes", _show_modes, empty_text="There are no acceleration setpoints."),
    PageSection("Texts of the vehicle", _show_texts),
    PageSection("Contents", _show_contents),
    PageSection("Summary", _show_summary),
)
