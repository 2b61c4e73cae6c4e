"""Page of a flight as its MAVLink or its autopilot tells it: a `.tlog` or a ULog, whoever flew."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from markupsafe import Markup

from logs.recording.design_view import AXIS_NUMBER
from logs.recording.mavlink_flight import Ages, MavlinkFlight, MavlinkFlightInfo, format_rate, list_facts
from logs.recording.output_files import write_atomically
from logs.report import page
from logs.report.figures import thin_keeping_largest
from logs.report.page import Mark, PageSection
from logs.report.plots import DISPLAY_AXES, DOTTED, RATE_NAMES, has_variation, thin_path, thin_samples
from logs.report.svg import Drawing, colour, draw_dots, open_canvas
from logs.report.tlog_headline import derive_tlog_headline
from uavctl.arrays import Array

_OWN = Mark("line", "estimate", "position of the vehicle's own")
_SENT = Mark("dot", "sample", "position sent to it")
_SETPOINT = Mark("dotted", "target", "setpoint")
_EMPTY_TEXT = "There are none."
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
    autopilot = info.autopilot or "no autopilot"
    headline = derive_tlog_headline(flight)
    return page.render_page(
        f"Flight in {Path(info.recording).name}",
        f"{info.begin_utc or 'no date'} · {info.duration_s:.1f} s · {autopilot}",
        (),
        _make_sections(flight),
        top=page.render_banner(headline.tone, headline.word, headline.text, headline.reasons),
    )


def describe_recording(info: MavlinkFlightInfo) -> Iterator[str]:
    """Return what the table does not have, in sentences: what is odd about the recording."""
    if info.vehicle_system is None:
        yield "No autopilot's heartbeat is in it, so it does not tell what the vehicle did."
    yield from (f"{note}." for note in info.notes)


def _make_sections(flight: MavlinkFlight) -> Iterator[PageSection]:
    info = flight.info
    marks = (*((_OWN,) if len(flight.own.t_s) else ()), *((_SENT,) if flight.sent else ()))
    if marks:
        yield PageSection("Path", "", page.render_grid(list(_draw_paths(flight))), marks)
        has_setpoints = np.isfinite(flight.setpoint_m).any() or np.isfinite(flight.setpoint_mps).any()
        wanted = (_SETPOINT,) if has_setpoints else ()
        note = "Time counts from the recording's begin. All is in local NED, height upwards."
        yield PageSection("Axes over time", note, page.render_grid(list(_draw_axes(flight))), (*marks, *wanted))
    elif has_variation(flight.height_m):
        height = _draw_values(flight, "height", "Height", "height [m]", flight.height_t_s, flight.height_m)
        yield PageSection("Height", "It told no place, and its height alone.", page.render_grid([height]))
    if has_variation(flight.battery_v):
        battery = _draw_values(flight, "battery", "Battery", "voltage [V]", flight.battery_t_s, flight.battery_v)
        yield PageSection("Battery", "", page.render_grid([battery]))
    if len(flight.attitude_t_s):
        yield PageSection("Attitude", "", page.render_grid(list(_draw_attitude(flight))))
    ages_by_source = {source: ages for source, ages in flight.ages.items() if len(ages.age_s)}
    if ages_by_source:
        note = (
            "The age of the newest position grows until another one arrives. Its source's clock is not known: ages are "
            "those beyond the quickest position of the last ten seconds."
        )
        drawings = [
            _draw_age(flight, f"age-{number}", *source_ages)
            for number, source_ages in enumerate(ages_by_source.items())
        ]
        yield PageSection("Age of positions", note, page.render_grid(drawings))
    if info.setpoints:
        drawings = list(_draw_setpoints(flight))
        body = (
            page.render_grid(drawings)
            if drawings
            else page.render_paragraph("They ask for no acceleration that changes.")
        )
        yield PageSection("Acceleration setpoints", "", body)
    modes = [(f"{mode.at_s:.2f}", mode.mode, "armed" if mode.armed else "") for mode in info.modes]
    yield PageSection("Modes", "", _make_table(("from [s]", "mode", "armed"), modes))
    texts = [(f"{text.at_s:.2f}", text.severity, text.text) for text in info.texts]
    if texts:
        yield PageSection("Texts of the vehicle", "", _make_table(("at [s]", "severity", "text"), texts))
    messages = [(name, str(number), format_rate(info, name)) for name, number in info.messages.items()]
    parameters = [(name, str(parameter.value), parameter.type) for name, parameter in info.parameters.items()]
    folded = page.render_folded(
        "Messages", page.render_table(("message", "number", "rate"), messages, frozenset({1, 2}))
    )
    if parameters:
        columns = ("parameter", "value", "type")
        folded += page.render_folded(
            "Parameters of the vehicle", page.render_table(columns, parameters, frozenset({1}))
        )
    yield PageSection("What is in it", "", folded)
    yield PageSection("Summary", "", page.render_list(describe_recording(info)) + page.render_facts(list_facts(info)))


def _make_table(columns: Sequence[str], rows: Sequence[tuple[str, ...]]) -> Markup:
    more = [f"{len(rows) - _MAX_ROWS} more are in the document of --json"] if len(rows) > _MAX_ROWS else []
    return (
        page.render_table(columns, rows[:_MAX_ROWS], frozenset({0}), more)
        if rows
        else page.render_paragraph(_EMPTY_TEXT)
    )


def _draw_paths(flight: MavlinkFlight) -> Iterator[Drawing]:
    for key, title, axes_shown in (
        ("path-above", "From above", ("east", "north")),
        ("path-side", "From the south", ("east", "down")),
    ):
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
