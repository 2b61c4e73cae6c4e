"""Page of a flight as its MAVLink or its autopilot tells it: a `.tlog` or a ULog, whoever flew."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
from markupsafe import Markup

from logs.recording.design_view import AXIS_NUMBER, Floats
from logs.recording.disk import write_whole
from logs.recording.mavlink_flight import Ages, MavlinkFlight, MavlinkFlightInfo, facts_of, longest_gap, rate_of
from logs.recording.summary import BLIND_S, count
from logs.report import page
from logs.report.figures import largest
from logs.report.headline import BAD, GOOD, MIND, Headline, metres, seconds
from logs.report.page import Mark, PageSection
from logs.report.plots import DOTTED, RATE, SEEN, along, thin
from logs.report.svg import Drawing, canvas, colour, dots
from uavctl.mavlink.profile import PROFILES

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
        story(info),
        _sections(flight),
        top=page.banner(main.tone, main.word, main.text, main.why),
    )


# What matters most in it: such a recording knows neither room nor mission, so it is what the vehicle itself alarmed of,
# how far its own position and those that it was sent went apart, and how long none came.


_ALARMS = ("emergency", "alert", "critical")  # of MAV_SEVERITY
_APART_M = 0.5  # between its own position and those sent, beyond what their origins differ by
_NEAR_S = 0.5  # between two of its own positions, to tell one in between
_TOLD = 3  # sentences of a kind


def headline_of(flight: MavlinkFlight) -> Headline:
    """Return what matters most in a flight of a foreign recording, while the vehicle was armed."""
    info = flight.info
    if info.vehicle_system is None:
        return Headline(MIND, "No vehicle", "no autopilot's heartbeat is in it.", ())
    spans = armed_spans(info)
    if not info.modes:
        return Headline(MIND, "Arming not known", "nothing in it tells modes or arming.", ())
    if not spans:
        said = tuple(_alarms(flight, [(0.0, np.inf)]))
        return Headline(MIND, "Not armed", "the vehicle was never armed in it.", said)
    found = [(BAD, "The vehicle alarmed", text) for text in list(_alarms(flight, spans))[:_TOLD]]
    apart_m, apart_s, of = _apart(flight, spans)
    if apart_m > _APART_M:
        where = f"{metres(apart_m)} off that of {of} at {seconds(apart_s)} ({_mode_at(info, apart_s)})"
        tone = BAD if apart_m > 2 * _APART_M else MIND
        found.append((tone, "Positions disagree", f"its own position was {where}."))
    silent_s, since_s = _silence(flight, spans)
    if silent_s > BLIND_S:
        moved_m = _moved(flight, since_s, silent_s)
        carried = f", while its own position moved by {metres(moved_m)}" if moved_m >= _APART_M else ""
        when = f"for {seconds(silent_s)}, from {seconds(since_s)} on ({_mode_at(info, since_s)})"
        found.append((MIND, "Blind", f"no position came {when}{carried}."))
    if not found:
        armed_s = sum(end_s - begin_s for begin_s, end_s in spans)
        fed = (
            f"no position was missing for longer than {seconds(silent_s)}" if flight.sent else "it was sent no position"
        )
        near = f", and its own kept within {metres(apart_m)} of them" if np.isfinite(apart_s) else ""
        found.append((GOOD, "Nothing odd", f"armed for {seconds(armed_s)}; {fed}{near}."))
    (tone, word, text), *others = found
    return Headline(tone, word, text, (*(one[0].upper() + one[1:] for _, _, one in others), *_left(info)))


def armed_spans(info: MavlinkFlightInfo) -> list[tuple[float, float]]:
    """Return from when to when it was armed [s]."""
    spans: list[tuple[float, float]] = []
    since_s: float | None = None
    for one in info.modes:
        if one.armed and since_s is None:
            since_s = one.at_s
        elif not one.armed and since_s is not None:
            spans.append((since_s, one.at_s))
            since_s = None
    return spans if since_s is None else [*spans, (since_s, info.duration_s)]


def _within(at_s: float, spans: Sequence[tuple[float, float]]) -> bool:
    return any(begin_s <= at_s <= end_s for begin_s, end_s in spans)


def _mode_at(info: MavlinkFlightInfo, at_s: float) -> str:
    return next((one.mode for one in reversed(info.modes) if one.at_s <= at_s), "no mode yet")


def _alarms(flight: MavlinkFlight, spans: Sequence[tuple[float, float]]) -> Iterator[str]:
    """Yield what it said, gravely, while it was armed; each text once."""
    grave = [one for one in flight.info.texts if one.severity in _ALARMS and _within(one.at_s, spans)]
    first = {one.text: one for one in reversed(grave)}
    for one in sorted(first.values(), key=lambda text: text.at_s):
        mode = _mode_at(flight.info, one.at_s)
        yield f'it said "{one.text.strip()}" ({one.severity}) at {seconds(one.at_s)} ({mode}).'


def _apart(flight: MavlinkFlight, spans: Sequence[tuple[float, float]]) -> tuple[float, float, str]:
    """Return how far its own position was off one that it was sent [m], when [s], and which source's.

    What they differ by at all times is that of their origins, and does not count. Where nothing is to be compared the
    time is infinite.
    """
    worst = (0.0, np.inf, "")
    own = flight.own
    if len(own.t_s) < 2:
        return worst
    for source, track in flight.sent.items():
        after = np.searchsorted(own.t_s, track.t_s).clip(1, len(own.t_s) - 1)
        known = (
            (own.t_s[after] - own.t_s[after - 1] <= _NEAR_S) & (track.t_s <= own.t_s[-1]) & (track.t_s >= own.t_s[0])
        )
        known &= np.array([_within(at_s, spans) for at_s in track.t_s], dtype=np.bool_)
        if known.sum() < 2:
            continue
        at_s = track.t_s[known]
        there_m = np.column_stack([np.interp(at_s, own.t_s, own.position_m[:, axis]) for axis in range(3)])
        differs_m = track.position_m[known] - there_m
        apart_m = np.linalg.norm(differs_m - np.median(differs_m, axis=0), axis=1)
        most = int(apart_m.argmax())
        if apart_m[most] > worst[0]:
            worst = (float(apart_m[most]), float(at_s[most]), source)
    return worst


def _silence(flight: MavlinkFlight, spans: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """Return the longest time that it was sent no position while armed, and when that began [s]; 0 if it never was."""
    came_s = np.sort(np.concatenate([track.t_s for track in flight.sent.values()] or [np.empty(0)]))
    worst = (0.0, 0.0)
    for begin_s, end_s in spans if len(came_s) else ():
        edges = np.concatenate([[begin_s], came_s[(came_s > begin_s) & (came_s < end_s)], [end_s]])
        longest = int(np.diff(edges).argmax())
        worst = max(worst, (float(np.diff(edges)[longest]), float(edges[longest])))
    return worst


def _moved(flight: MavlinkFlight, since_s: float, for_s: float) -> float:
    """Return how far its own position went in a time [m]."""
    inside = (flight.own.t_s >= since_s) & (flight.own.t_s <= since_s + for_s)
    places_m = flight.own.position_m[inside]
    return float(np.linalg.norm(places_m - places_m[0], axis=1).max()) if len(places_m) else 0.0


def _left(info: MavlinkFlightInfo) -> Iterator[str]:
    """Yield where it left a mode that takes setpoints, whoever wanted that."""
    external = {profile.external for profile in PROFILES.values()}
    left = [
        (one, then)
        for one, then in pairwise(info.modes)
        if one.armed and one.mode in external and then.mode != one.mode
    ]
    for one, then in left[:_TOLD]:
        yield f"It left {one.mode} for {then.mode} at {seconds(then.at_s)}{'' if then.armed else ', disarmed'}."


def story(info: MavlinkFlightInfo) -> Iterator[str]:
    """Return what the recording tells, in sentences; what is odd about it comes last."""
    if info.vehicle_system is None:
        yield "No autopilot's heartbeat is in it, so nobody knows what the vehicle did."
    else:
        told = f"by {info.own_source}" if info.own_positions else "and it told no position"
        positions = f", {count(info.own_positions, 'position')} of its own" if info.own_positions else ","
        yield f"System {info.vehicle_system} ({info.autopilot}){positions} {told}."
    for sent in info.sent:
        yield f"{sent.source}: {count(sent.positions, 'position')}, {sent.rate_hz:.1f}/s, {longest_gap(sent)}."
    yield f"{count(info.setpoints, 'setpoint')} in local NED; {count(len(info.texts), 'text')} of the vehicle."
    if info.missing:
        yield f"Not in it, and so not shown: {', '.join(info.missing)}."
    yield from (f"{note}." for note in info.notes)


def _sections(flight: MavlinkFlight) -> Iterator[PageSection]:
    info = flight.info
    yield PageSection("Summary", "", page.facts(facts_of(info)))
    marks = (*((_OWN,) if len(flight.own.t_s) else ()), *((_SENT,) if flight.sent else ()))
    if marks:
        yield PageSection("Path", "", page.grid(list(_paths(flight))), marks)
        asked = np.isfinite(flight.setpoint_m).any() or np.isfinite(flight.setpoint_mps).any()
        wanted = (_WANTED,) if asked else ()
        note = "Time counts from the recording's begin. All is in local NED, height upwards."
        yield PageSection("Axes over time", note, page.grid(list(_axes(flight))), (*marks, *wanted))
    elif len(flight.height_t_s):
        height = _course(flight, "height", "Height", "height [m]", flight.height_t_s, flight.height_m)
        yield PageSection("Height", "It told no place, and its height alone.", page.grid([height]))
    if len(flight.battery_t_s):
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
        body = page.grid(drawn) if drawn else page.paragraph("They hold places and speeds alone, drawn above.")
        yield PageSection("Acceleration setpoints", "", body)
    modes = [(f"{one.at_s:.2f}", one.mode, "armed" if one.armed else "") for one in info.modes]
    yield PageSection("Modes", "", _table(("from [s]", "mode", "armed"), modes))
    texts = [(f"{one.at_s:.2f}", one.severity, one.text) for one in info.texts]
    yield PageSection("Texts of the vehicle", "", _table(("at [s]", "severity", "text"), texts))
    messages = [(name, str(number), rate_of(info, name)) for name, number in info.messages.items()]
    parameters = [(name, str(one.value), one.type) for name, one in info.parameters.items()]
    folded = page.folded("Messages", page.table(("message", "number", "rate"), messages, frozenset({1, 2})))
    if parameters:
        columns = ("parameter", "value", "type")
        folded += page.folded("Parameters of the vehicle", page.table(columns, parameters, frozenset({1})))
    yield PageSection("What is in it", "", folded)


def _table(columns: Sequence[str], rows: Sequence[tuple[str, ...]]) -> Markup:
    more = [f"{len(rows) - _MOST_ROWS} more are in the document of --json"] if len(rows) > _MOST_ROWS else []
    return page.table(columns, rows[:_MOST_ROWS], frozenset({0}), more) if rows else page.paragraph(_NONE)


def _paths(flight: MavlinkFlight) -> Iterator[Drawing]:
    for key, title, shown in (
        ("path-above", "From above", ("east", "north")),
        ("path-side", "From the south", ("east", "down")),
    ):
        pick = [AXIS_NUMBER[axis] for axis in shown]
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
        yield _over_time(
            flight, f"position-{axis}", name.capitalize(), f"{name} [m]",
            [(t_s, sign * values[:, number]) for t_s, values in sent],
            (flight.own.t_s, sign * flight.own.position_m[:, number]),
            sign * flight.setpoint_m[:, number],
        )  # fmt: skip
        speed = sign * flight.own.velocity_mps[:, number]
        if np.isfinite(speed).any():
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
        if not np.isfinite(values).any():
            continue
        key, upwards = f"setpoint-{axis}", "upwards" if axis == "down" else name
        with canvas(key, 2.3) as one:
            ax = one.axes(f"Acceleration {upwards}", "time [s]", f"acceleration {upwards} [m/s²]")
            ax.step(*thin(flight.setpoint_t_s, values), where="post", color=colour("estimate"), lw=1.1)
            ax.set_xlim(0, max(flight.duration_s, 1e-3))
        yield Drawing(key, one.svg, f"Acceleration setpoint {upwards} over time")
