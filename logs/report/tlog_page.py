"""Page of a flight as its MAVLink or its autopilot tells it: a `.tlog` or a ULog, whoever flew."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from markupsafe import Markup

from logs.recording.design_view import AXIS_NUMBER, Floats
from logs.recording.disk import write_whole
from logs.recording.mavlink_flight import Ages, MavlinkFlight, MavlinkFlightInfo, facts_of, rate_of
from logs.report import page
from logs.report.figures import largest
from logs.report.page import Mark, PageSection
from logs.report.plots import DOTTED, RATE, SEEN, along, thin, varies
from logs.report.svg import Drawing, canvas, colour, dots
from logs.report.tlog_headline import headline_of

__all__ = ["headline_of", "tlog_html", "write_tlog_page"]

_OWN = Mark("line", "estimate", "position of the vehicle's own")
_SENT = Mark("dot", "sample", "position sent to it")
_WANTED = Mark("dotted", "target", "setpoint")
_NONE = "There are none."
_MOST_ROWS = 1000  # of a table on the page; the document of `--json` has all


def write_tlog_page(flight: MavlinkFlight, path: Path) -> None:
    """Write the page.

    Raises:
        RecordingError: The file cannot be written.
    """
    write_whole(path, tlog_html(flight))


def tlog_html(flight: MavlinkFlight) -> str:
    """Return the page of a flight as HTML."""
    info = flight.info
    who = info.autopilot or "no autopilot"
    main = headline_of(flight)
    return page.page(
        f"Flight in {Path(info.recording).name}",
        f"{info.begin_utc or 'no date'} · {info.duration_s:.1f} s · {who}",
        (),
        _sections(flight),
        top=page.banner(main.tone, main.word, main.text, main.why),
    )


def story(info: MavlinkFlightInfo) -> Iterator[str]:
    """Return what the table does not have, in sentences: what is odd about the recording."""
    if info.vehicle_system is None:
        yield "No autopilot's heartbeat is in it, so it does not tell what the vehicle did."
    yield from (f"{note}." for note in info.notes)


def _sections(flight: MavlinkFlight) -> Iterator[PageSection]:
    info = flight.info
    marks = (*((_OWN,) if len(flight.own.t_s) else ()), *((_SENT,) if flight.sent else ()))
    if marks:
        yield PageSection("Path", "", page.grid(list(_paths(flight))), marks)
        asked = np.isfinite(flight.setpoint_m).any() or np.isfinite(flight.setpoint_mps).any()
        wanted = (_WANTED,) if asked else ()
        note = "Time counts from the recording's begin. All is in local NED, height upwards."
        yield PageSection("Axes over time", note, page.grid(list(_axes(flight))), (*marks, *wanted))
    elif varies(flight.height_m):
        height = _course(flight, "height", "Height", "height [m]", flight.height_t_s, flight.height_m)
        yield PageSection("Height", "It told no place, and its height alone.", page.grid([height]))
    if varies(flight.battery_v):
        battery = _course(flight, "battery", "Battery", "voltage [V]", flight.battery_t_s, flight.battery_v)
        yield PageSection("Battery", "", page.grid([battery]))
    if len(flight.attitude_t_s):
        yield PageSection("Attitude", "", page.grid(list(_attitude(flight))))
    aged = {source: ages for source, ages in flight.ages.items() if len(ages.age_s)}
    if aged:
        note = (
            "The age of the newest position grows until another one arrives. Its source's clock is not known: ages are "
            "those beyond the quickest position of the last ten seconds."
        )
        drawn = [_age(flight, f"age-{number}", *one) for number, one in enumerate(aged.items())]
        yield PageSection("Age of positions", note, page.grid(drawn))
    if info.setpoints:
        drawn = list(_setpoints(flight))
        body = page.grid(drawn) if drawn else page.paragraph("They ask for no acceleration that changes.")
        yield PageSection("Acceleration setpoints", "", body)
    modes = [(f"{one.at_s:.2f}", one.mode, "armed" if one.armed else "") for one in info.modes]
    yield PageSection("Modes", "", _table(("from [s]", "mode", "armed"), modes))
    texts = [(f"{one.at_s:.2f}", one.severity, one.text) for one in info.texts]
    if texts:
        yield PageSection("Texts of the vehicle", "", _table(("at [s]", "severity", "text"), texts))
    messages = [(name, str(number), rate_of(info, name)) for name, number in info.messages.items()]
    parameters = [(name, str(one.value), one.type) for name, one in info.parameters.items()]
    folded = page.folded("Messages", page.table(("message", "number", "rate"), messages, frozenset({1, 2})))
    if parameters:
        columns = ("parameter", "value", "type")
        folded += page.folded("Parameters of the vehicle", page.table(columns, parameters, frozenset({1})))
    yield PageSection("What is in it", "", folded)
    yield PageSection("Summary", "", page.listed(story(info)) + page.facts(facts_of(info)))


def _table(columns: Sequence[str], rows: Sequence[tuple[str, ...]]) -> Markup:
    more = [f"{len(rows) - _MOST_ROWS} more are in the document of --json"] if len(rows) > _MOST_ROWS else []
    return page.table(columns, rows[:_MOST_ROWS], frozenset({0}), more) if rows else page.paragraph(_NONE)


def _paths(flight: MavlinkFlight) -> Iterator[Drawing]:
    for key, title, shown in (
        ("path-above", "From above", ("east", "north")),
        ("path-side", "From the south", ("east", "down")),
    ):
        pick = [AXIS_NUMBER[axis] for axis in shown]
        tracks = (flight.own.position_m, *(track.position_m for track in flight.sent.values()))
        if not any(varies(track[:, number]) for track in tracks for number in pick):
            continue
        signs = np.array([SEEN[axis][1] for axis in shown])
        names = [SEEN[axis][0] for axis in shown]
        with canvas(key, 3.7) as one:
            ax = one.axes(title, f"{names[0]} [m]", f"{names[1]} [m]")
            for track in flight.sent.values():
                points = along(track.position_m)[:, pick] * signs
                dots(ax, points[:, 0], points[:, 1], "sample", 2.4)
            points = along(flight.own.position_m)[:, pick] * signs
            ax.plot(*points.T, color=colour("estimate"), lw=1.4, zorder=3)
            ax.plot(*points[:1].T, "o", ms=6, mfc=colour("card"), mec=colour("estimate"), mew=1.5, zorder=4)
            ax.set_aspect("equal", adjustable="datalim")
            ax.margins(0.06)
        yield Drawing(key, one.svg, f"Path seen {title[0].lower()}{title[1:]}: {names[0]} and {names[1]} in metres")


def _axes(flight: MavlinkFlight) -> Iterator[Drawing]:
    for axis, number in AXIS_NUMBER.items():
        name, sign = SEEN[axis]
        sent = [(track.t_s, track.position_m) for track in flight.sent.values()]
        places = (flight.own.position_m, flight.setpoint_m, *(values for _, values in sent))
        if any(varies(one[:, number]) for one in places):
            yield _over_time(
            flight, f"position-{axis}", name.capitalize(), f"{name} [m]",
            [(t_s, sign * values[:, number]) for t_s, values in sent],
            (flight.own.t_s, sign * flight.own.position_m[:, number]),
            sign * flight.setpoint_m[:, number],
        )  # fmt: skip
        speed = sign * flight.own.velocity_mps[:, number]
        if varies(speed):
            yield _over_time(
                flight, f"velocity-{axis}", RATE[axis].capitalize(), f"{RATE[axis]} [m/s]", [],
                (flight.own.t_s, speed), sign * flight.setpoint_mps[:, number],
            )  # fmt: skip


def _over_time(
    flight: MavlinkFlight,
    key: str,
    title: str,
    y_label: str,
    sent: Sequence[tuple[Floats, Floats]],
    own: tuple[Floats, Floats],
    wanted: Floats,
) -> Drawing:
    with canvas(key, 2.3) as one:
        ax = one.axes(title, "time [s]", y_label)
        for t_s, values in sent:
            dots(ax, *thin(t_s, values), "sample", 2.0)
        ax.plot(*thin(*own), color=colour("estimate"), lw=1.4, zorder=3)
        ax.plot(*thin(flight.setpoint_t_s, wanted), color=colour("target"), lw=1.1, ls=DOTTED, zorder=4)
        ax.set_xlim(0, max(flight.duration_s, 1e-3))
    return Drawing(key, one.svg, f"{title} over time")


def _attitude(flight: MavlinkFlight) -> Iterator[Drawing]:
    for number, angle in enumerate(("roll", "pitch", "yaw")):
        values = flight.attitude_deg[:, number]
        if varies(values):
            yield _course(flight, f"attitude-{angle}", angle.capitalize(), f"{angle} [°]", flight.attitude_t_s, values)


def _course(flight: MavlinkFlight, key: str, title: str, y_label: str, t_s: Floats, values: Floats) -> Drawing:
    with canvas(key, 2.3) as one:
        ax = one.axes(title, "time [s]", y_label)
        ax.plot(*thin(t_s, values), color=colour("estimate"), lw=1.1)
        ax.set_xlim(0, max(flight.duration_s, 1e-3))
    return Drawing(key, one.svg, f"{title} over time")


def _age(flight: MavlinkFlight, key: str, source: str, ages: Ages) -> Drawing:
    with canvas(key, 2.3) as one:
        ax = one.axes(source, "time [s]", "age [s]")
        t_s, age_s = largest(ages.age_t_s, ages.age_s)
        ax.plot(t_s, age_s, color=colour("estimate"), lw=1.1)
        dots(ax, *largest(ages.t_s[np.isfinite(ages.delay_s)], ages.delay_s[np.isfinite(ages.delay_s)]), "sample", 2.0)
        ax.set_xlim(0, max(flight.duration_s, 1e-3))
        ax.set_ylim(bottom=0)
    return Drawing(key, one.svg, f"Age of the positions of {source} over time")


def _setpoints(flight: MavlinkFlight) -> Iterator[Drawing]:
    for axis, number in AXIS_NUMBER.items():
        name, sign = SEEN[axis]
        values = sign * flight.setpoint_mps2[:, number]
        if not varies(values):
            continue
        key, upwards = f"setpoint-{axis}", "upwards" if axis == "down" else name
        with canvas(key, 2.3) as one:
            ax = one.axes(f"Acceleration {upwards}", "time [s]", f"acceleration {upwards} [m/s²]")
            ax.step(*thin(flight.setpoint_t_s, values), where="post", color=colour("estimate"), lw=1.1)
            ax.set_xlim(0, max(flight.duration_s, 1e-3))
        yield Drawing(key, one.svg, f"Acceleration setpoint {upwards} over time")
