"""Flights beside each other: differences, figures, page."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from string import ascii_uppercase

import msgspec
import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from numpy.typing import NDArray
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from logs.recording.design_view import AXIS_NUMBER, Floats
from logs.recording.disk import spare_recording, write_whole
from logs.recording.flight import FlightData
from logs.recording.info import info
from logs.recording.parameters import VehicleParameter
from logs.recording.reader import RecordedMessage, good_messages, read
from logs.recording.replay import leaves
from logs.recording.summary import FlightSummary, Percentiles, count, position_error_m, summarise
from logs.recording.topics import HEADER, LIBRARY, RECORDER, decode, raw_link
from logs.report import page
from logs.report.page import Mark, PageSection
from logs.report.plots import DASHED, DOTTED, SEEN, along, course, position_limits, thin
from logs.report.svg import Canvas, Drawing, canvas, colour
from uavctl.config.load import flatten_keys
from uavctl.errors import RecordingError, UsageError
from uavctl.mavlink.framing import scan_frames
from uavctl.records import Header

# The recordings of a comparison, in memory.


class ComparedFlight(msgspec.Struct, frozen=True, kw_only=True):
    """One recording of a comparison: its name there, where it is from, and how its flight ended."""

    name: str  # A to Z, and then A1, B1, ...
    recording: str
    config: str
    command: str
    started_utc: str
    seed: int
    ended: str
    finished: bool  # closed in order; else compared up to its end
    records_lost: int  # dropped, refused, or missing in the file


@dataclass(frozen=True, eq=False)
class LoadedFlight:
    """One recording of a comparison in memory, with its records and its summary."""

    side: ComparedFlight
    flight: FlightData
    summary: FlightSummary
    parameters: Mapping[str, VehicleParameter]  # of the vehicle, as it told them


def load_all(paths: Sequence[Path], on_loaded: Callable[[], None] = lambda: None) -> tuple[LoadedFlight, ...]:
    """Read the recordings of a comparison, named A, B, … in their order.

    Raises:
        RecordingError: One cannot be read, or nothing was flown in it; names it.
    """
    loaded = []
    for number, path in enumerate(paths):
        name = ascii_uppercase[number % 26] + (str(number // 26) if number >= 26 else "")
        loaded.append(_load(path, name))
        on_loaded()
    return tuple(loaded)


def _load(path: Path, name: str) -> LoadedFlight:
    whole = info(path)
    flight = FlightData.from_records(read(path), path)
    summary = summarise(flight, wall_s=None)
    side = ComparedFlight(
        name=name,
        recording=str(path),
        config="" if whole.origin is None else whole.origin.config,
        command=flight.header.command,
        started_utc=flight.header.started_utc,
        seed=flight.header.seed,
        ended=summary.ending.cause,
        finished=whole.finished,
        records_lost=whole.dropped + whole.refused + whole.missing,
    )
    return LoadedFlight(side, flight, summary, whole.parameters)


# Figures of flights beside each other.


Value = int | float | None


class Figure(msgspec.Struct, frozen=True, kw_only=True):
    """One figure (error, cost, time, …) of all compared flights; null where it was not measured."""

    key: str
    group: str
    text: str
    unit: str
    values: tuple[Value, ...]  # one each recording
    differences: tuple[Value, ...]  # from the first, one each other recording
    ratios: tuple[float | None, ...]  # to the first, likewise; null if that is 0


def figures(loaded: Sequence[LoadedFlight]) -> Iterator[Figure]:
    """Return the figures that at least one of the flights has."""
    measured = [{row[0]: row for row in _rows(one)} for one in loaded]
    for key, (_, group, text, unit, _) in {key: row for one in reversed(measured) for key, row in one.items()}.items():
        values = tuple(one[key][-1] if key in one else None for one in measured)
        if all(value is None for value in values):
            continue
        first, *others = values
        yield Figure(
            key=key,
            group=group,
            text=text,
            unit=unit,
            values=values,
            differences=tuple(None if first is None or one is None else one - first for one in others),
            ratios=tuple(None if not first or one is None else one / first for one in others),
        )


_Row = tuple[str, str, str, str, Value]  # key, group, text, unit and value


def _rows(one: LoadedFlight) -> tuple[_Row, ...]:
    """Return the figures of one flight; those of the summary keep its keys."""
    s, flight = one.summary, one.flight
    ages = [d.age_steps for d in flight.steps.decisions if d.age_steps is not None]
    error_m = position_error_m(flight)
    inputs = np.linalg.norm(flight.steps.input, axis=1)
    methods = {**dict.fromkeys(("frozen", "mixture", "exact"), 0), **s.methods}
    in_fallback_s = sum((b - a for a, b in flight.fallback_spans), 0.0)
    return (
        ("steps", "flight", "steps flown", "", s.steps),
        ("duration_s", "flight", "duration", "s", s.duration_s),
        ("received", "link", "positions received", "", s.received),
        ("lost", "link", "positions lost", "", s.lost),
        ("loss", "link", "share lost", "", None if s.lost is None else _ratio(s.lost, s.received + s.lost)),
        ("rejected", "link", "positions refused", "", s.rejected),
        ("mean_age", "link", "mean age", "steps", _ratio(sum(ages), len(ages))),
        ("max_age", "link", "largest age", "steps", s.max_age),
        ("max_age_s", "link", "largest age", "s", s.max_age_s),
        ("fallbacks", "limits", "fallbacks", "", s.fallbacks),
        ("fallback_s", "limits", "time in fallback", "s", round(in_fallback_s, 9)),
        ("state_violations", "limits", "state outside limits", "steps", s.state_violations),
        ("input_violations", "limits", "input outside limits", "steps", s.input_violations),
        ("slack_used", "limits", "plans with slack", "", s.slack_used),
        ("cost", "tracking", "cost", "", s.cost),
        ("cost_per_step", "tracking", "cost a step", "", _ratio(s.cost, s.steps)),
        ("mean_error_m", "tracking", "distance from target, rms", "m", _rms(error_m)),
        ("settled_error_m", "tracking", "same, last quarter", "m", s.settled_error_m),
        ("final_error_m", "tracking", "same, at the end", "m", s.final_error_m),
        ("mean_input", "tracking", "input, rms", flight.design.input_unit, _rms(inputs)),
        ("solves", "plans", "solves", "", s.solves),
        ("failed_solves", "plans", "solves without optimum", "", s.failed_solves),
        *((f"methods.{name}", "plans", f"plans, {name}", "", count) for name, count in methods.items()),
        ("largest_gap", "plans", "largest certified gap", "", s.largest_gap),
        *_times("decision_us", "decision time", s.decision_us),
        *_times("tick_lateness_us", "tick lateness", s.tick_lateness_us),
        ("missed_ticks", "time", "ticks missed", "", s.missed_ticks),
        ("records_lost", "recording", "records lost", "", one.side.records_lost),
    )


def _times(key: str, text: str, spread: Percentiles) -> Iterator[_Row]:
    for name, words in (("p50", "median"), ("p99", "99 %"), ("max", "largest")):
        yield f"{key}.{name}", "time", f"{text}, {words}", "µs", getattr(spread, name)


def _ratio(part: float, whole: float) -> float | None:
    return part / whole if whole else None


def _rms(values: NDArray[np.float64]) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if len(known) else None


# Flights beside each other: what differs in how they were made, and their figures.


# How a recording was made, and what a computer's clock said: not what was flown.
_NOT_FLOWN = frozenset({HEADER, LIBRARY, RECORDER, "/uavctl/timing"})
_LONGEST = 72  # characters of a value


class FirstDivergence(msgspec.Struct, frozen=True, kw_only=True):
    """First record in which a flight differs from the first one."""

    topic: str
    flight_s: float  # since the first tick of the first recording
    field: str  # path in the record; empty if there is none on one side, or at another time
    first: str  # what the first recording has there
    other: str


class Match(msgspec.Struct, frozen=True, kw_only=True):
    """Agreement of a flight with that of the first recording, bit for bit; computing times do not count."""

    name: str
    identical: bool
    records: int  # alike, from the beginning
    parting: FirstDivergence | None  # None if all are alike


class ParameterDifference(msgspec.Struct, frozen=True, kw_only=True):
    """Parameter in which the recordings differ; null where a recording does not have it."""

    # dotted name in the configuration, or design_id, library_id, cpu, platform, versions.<package>, vehicle.<PARAMETER>
    key: str
    values: tuple[object, ...]  # one each recording


class FlightComparison(msgspec.Struct, frozen=True, kw_only=True):
    """Result of `compare`: all flights against the first."""

    recordings: tuple[ComparedFlight, ...]
    likenesses: tuple[Match, ...]
    parameters: tuple[ParameterDifference, ...]
    figures: tuple[Figure, ...]
    notes: tuple[str, ...]  # what to mind when reading the figures


def compare(loaded: Sequence[LoadedFlight]) -> FlightComparison:
    """Compare flights with the first of them.

    Raises:
        RecordingError: A header's configuration cannot be read.
    """
    return FlightComparison(
        recordings=tuple(one.side for one in loaded),
        likenesses=tuple(_likeness(loaded[0], other) for other in loaded[1:]),
        parameters=(*_differences([_parameters(one) for one in loaded]), *_differences(_vehicles(loaded))),
        figures=tuple(figures(loaded)),
        notes=tuple(_notes(loaded)),
    )


def _likeness(first: LoadedFlight, other: LoadedFlight) -> Match:
    alike = 0
    mine, theirs = (
        filter(lambda message: message.definition.topic not in _NOT_FLOWN, good_messages(Path(one.side.recording)))
        for one in (first, other)
    )
    for left, right in zip_longest(mine, theirs):
        if left is None or right is None or _word(left) != _word(right):
            parting = _parting(left, right, first.flight.origin_ns)
            return Match(name=other.side.name, identical=False, records=alike, parting=parting)
        alike += 1
    return Match(name=other.side.name, identical=True, records=alike, parting=None)


def _word(message: RecordedMessage) -> tuple[str, bytes, int]:
    """Return the content of a message that is compared: topic, bytes and log time [ns]."""
    return message.definition.topic, message.data, message.at_ns


def _parting(left: RecordedMessage | None, right: RecordedMessage | None, origin_ns: int) -> FirstDivergence:
    """Return the first difference of two recordings; None for a message stands for a recording's end."""
    there = left or right
    assert there is not None
    topic, at_ns = there.definition.topic, there.at_ns
    field = ""
    if left is None or right is None:
        said = tuple("its end" if one is None else "a record" for one in (left, right))
    elif (left.definition.topic, left.at_ns) != (right.definition.topic, right.at_ns):
        said = tuple(f"{one.definition.topic} at {(one.at_ns - origin_ns) * 1e-9:.3f} s" for one in (left, right))
    elif raw_link(topic) is not None:
        said = (_frame(left.data), _frame(right.data))
    else:
        field, mine, theirs = leaves(decode(*_word(left)), decode(*_word(right)))[0]
        said = (repr(mine), repr(theirs))
    return FirstDivergence(
        topic=topic, flight_s=(at_ns - origin_ns) * 1e-9, field=field, first=_short(said[0]), other=_short(said[1])
    )


def _frame(data: bytes) -> str:
    """Return raw bytes in words: the name of their first MAVLink message, and their number."""
    frames = scan_frames(data, final=True).frames
    name = mavlink.mavlink_map[frames[0].message_id].msgname if frames else "no whole packet"
    return f"{name}, {len(data)} bytes"


def _short(text: str) -> str:
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 1]}…"


def _parameters(one: LoadedFlight) -> dict[str, object]:
    """Return what a flight was set up with: configuration, design, library, versions, processor."""
    header: Header = one.flight.header
    try:
        config = tomllib.loads(header.config_toml)
    except tomllib.TOMLDecodeError as error:
        raise RecordingError(f"{one.side.recording}: the configuration in its header is damaged ({error})") from error
    return {
        # JSON has no infinity, which limits may be.
        **{
            key: str(one) if isinstance(one, float) and not math.isfinite(one) else one
            for key, one in flatten_keys(config)
        },
        "design_id": header.design_id,
        "library_id": header.library_id,
        "cpu": header.cpu,
        "platform": header.platform or None,
        **{f"versions.{name}": version for name, version in sorted(header.versions.items())},
    }


def _vehicles(loaded: Sequence[LoadedFlight]) -> list[dict[str, object]]:
    """Return the vehicle's parameters that differ, of those told in all flights in which it told any."""
    told = [one.parameters for one in loaded if one.parameters]
    common = sorted(set.intersection(*map(set, told))) if told else []
    differing = [name for name in common if len({one[name].value for one in told}) > 1]
    return [{f"vehicle.{name}": one.parameters[name].value for name in differing if one.parameters} for one in loaded]


def _differences(parameters: Sequence[Mapping[str, object]]) -> Iterator[ParameterDifference]:
    for key in dict.fromkeys(key for one in parameters for key in one):
        values = tuple(one.get(key) for one in parameters)
        if any(value != values[0] for value in values[1:]):
            yield ParameterDifference(key=key, values=values)


def _notes(loaded: Sequence[LoadedFlight]) -> Iterator[str]:
    if _differ(loaded, lambda one: one.parameters.keys()):
        told = ", ".join(f"{one.side.name} {len(one.parameters)}" for one in loaded)
        yield f"the vehicle did not tell the same parameters in all ({told}): those that only some have are left out"
    for one in loaded:
        if not one.side.finished:
            yield f"{one.side.name} is torn: compared up to its end"
        if one.side.records_lost:
            yield f"{one.side.name} lacks {one.side.records_lost} records: what they held is in no figure"
    if _differ(loaded, lambda one: one.summary.steps):
        yield "the flights are of different length: counts and the cost add up over the steps flown"
    if _differ(loaded, lambda one: (one.flight.design.q_x, one.flight.design.q_u, one.flight.design.dt_s)):
        yield "the costs are not of one kind: weights or the length of a step differ"
    if _differ(loaded, lambda one: one.summary.state_source):
        sources = ", ".join(f"{one.side.name} by the {one.summary.state_source}" for one in loaded)
        yield f"states are judged by different sources: {sources}"
    if _differ(loaded, lambda one: one.flight.virtual_time):
        yield "some were flown in virtual time, where no tick is late"
    if _differ(loaded, lambda one: one.flight.header.cpu):
        yield "times were measured on different processors"


def _differ(loaded: Sequence[LoadedFlight], of: Callable[[LoadedFlight], object]) -> bool:
    return any(of(one) != of(loaded[0]) for one in loaded[1:])


# A comparison in words and digits for people.


_NONE = "–"


def likeness(one: Match) -> str:
    """Return a sentence on how long a flight is the same as the first one, and where it departs from it."""
    where = one.parting
    if where is None:
        alike = count(one.records, "record")
        return f"{one.name} is the same flight as A: {alike} alike, bit for bit (computing times do not count)."
    if not one.records:
        return f"{one.name} is another flight than A from its first record on."
    field = f", {where.field}" if where.field else ""
    return (
        f"{one.name} is the same as A for {count(one.records, 'record')}, up to {where.flight_s:.3f} s. Then "
        f"{where.topic}{field}: {where.first} in A, {where.other} in {one.name}."
    )


def parameter(value: object) -> str:
    """Return a parameter's value as text."""
    if value is None:
        return _NONE
    return value if isinstance(value, str) else msgspec.json.encode(value).decode()


def for_people(figure: Figure) -> Figure:
    """Return a figure in the unit that it is shown in; the certified gap, a small share, in percent."""
    if figure.key != "largest_gap":
        return figure
    values, differences = (
        tuple(None if value is None else 100.0 * value for value in some)
        for some in (figure.values, figure.differences)
    )
    return msgspec.structs.replace(figure, unit="%", values=values, differences=differences)


def measured(value: Value) -> str:
    """Return a figure as text: four digits, or all of those before the point up to a million."""
    if value is None:
        return _NONE
    return f"{value:.0f}" if isinstance(value, int) or 1e4 <= abs(value) < 1e6 else f"{value:.4g}"


def difference(value: Value) -> str:
    """Return a difference of figures as text, with its sign."""
    return f"+{measured(value)}" if value is not None and value > 0 else measured(value)


def label(figure: Figure) -> str:
    """Return the name of a figure with its unit."""
    return f"{figure.text}, {figure.unit}" if figure.unit else figure.text


# The page of a comparison: flights in one drawing, and the tables of the terminal.


_ROLES = ("truth", "estimate", "sample", "plan", "target")
_LIMIT = Mark("dashed", "limit", "limit of A")
_HORIZON = Mark("dotted", "muted", "horizon H")
_WIDEST, _FINEST = 3.2, 0.8  # lines of the first flight and of the last: where they are the same, all are seen
_OTHERS_OF_A_TABLE = 2  # more columns would not fit on paper


def write_page(found: FlightComparison, loaded: Sequence[LoadedFlight], path: Path) -> None:
    """Write the page.

    Raises:
        RecordingError: The file cannot be written.
        UsageError: More flights than can be told apart in one drawing, or `path` is that of a recording.
    """
    spare_recording(path)
    if len(loaded) > len(_ROLES):
        raise UsageError(f"--out draws {len(_ROLES)} flights at most, these are {len(loaded)}; compare fewer at a time")
    write_whole(path, comparison_html(found, loaded))


def comparison_html(found: FlightComparison, loaded: Sequence[LoadedFlight]) -> str:
    """Return the page of a comparison as HTML."""
    names = [one.side.name for one in loaded]
    story = [*map(likeness, found.likenesses), *(f"Mind: {note}." for note in found.notes)]
    title = f"Flights {', '.join(names)}"
    return page.page(
        title, "The first is what the others are compared with.", story, _sections(found, loaded), "How alike they are"
    )


def _sections(found: FlightComparison, loaded: Sequence[LoadedFlight]) -> Iterator[PageSection]:
    flights = [one.flight for one in loaded]
    marks = tuple(Mark("line", _ROLES[place], one.side.name) for place, one in enumerate(loaded))
    axes = [axis for axis in flights[0].design.axes if all(axis in one.design.axes for one in flights)]
    yield PageSection("Recordings", "", _sides(found))
    yield PageSection("Path", "", page.grid(list(_paths(flights, axes))), (*marks, _LIMIT))
    yield PageSection(
        "Positions and age",
        "Time counts from each flight's first tick. Positions are the true ones where they are known.",
        page.grid([*(_position(flights, axis) for axis in axes), _ages(flights)]),
        (*marks, _LIMIT, _HORIZON),
    )
    yield PageSection("Figures", "", _figures(found))
    yield PageSection("Parameters that differ", "", _parameter_table(found))


def _paths(flights: Sequence[FlightData], axes: Sequence[str]) -> Iterator[Drawing]:
    for key, title, shown in (
        ("path-above", "From above", ("east", "north")),
        ("path-side", "From the south", ("east", "down")),
    ):
        if not set(shown) <= set(axes):
            continue
        (x_name, x_sign), (y_name, y_sign) = (SEEN[axis] for axis in shown)
        with canvas(key, 3.7) as one:
            ax = one.axes(title, f"{x_name} [m]", f"{y_name} [m]")
            for place, flight in enumerate(flights):
                points = along(course(flight)[1])
                x, y = (points[:, AXIS_NUMBER[axis]] for axis in shown)
                ax.plot(x_sign * x, y_sign * y, color=colour(_ROLES[place]), lw=_width(place, flights))
            for side in _limits(flights[0], shown[0]):
                ax.axvline(side, color=colour("limit"), lw=1.0, ls=DASHED)
            for side in _limits(flights[0], shown[1]):
                ax.axhline(side, color=colour("limit"), lw=1.0, ls=DASHED)
            ax.set_aspect("equal", adjustable="datalim")
        yield Drawing(key, one.svg, f"Paths of {len(flights)} flights: {x_name} and {y_name} in metres")


def _position(flights: Sequence[FlightData], axis: str) -> Drawing:
    name, sign = SEEN[axis]

    def values(flight: FlightData) -> tuple[Floats, Floats]:
        t_s, points = course(flight)
        return t_s, sign * points[:, AXIS_NUMBER[axis]]

    with canvas(f"position-{axis}", 2.3) as one:
        ax = _overlay(one, name.capitalize(), f"{name} [m]", flights, values)
        for side in _limits(flights[0], axis):
            ax.axhline(side, color=colour("limit"), lw=1.0, ls=DASHED)
    return Drawing(f"position-{axis}", one.svg, f"{name.capitalize()} over time of {len(flights)} flights")


def _ages(flights: Sequence[FlightData]) -> Drawing:
    def values(flight: FlightData) -> tuple[Floats, Floats]:
        known = [(d.at_ns, float(d.age_steps)) for d in flight.flown if d.age_steps is not None]
        return flight.seconds([at_ns for at_ns, _ in known]), np.array([age for _, age in known])

    horizons = sorted({float(flight.design.horizon) for flight in flights})
    with canvas("age", 2.3) as one:
        ax = _overlay(one, "Age of information", "age [steps]", flights, values, "steps-post")
        for horizon in horizons:
            ax.axhline(horizon, color=colour("muted"), lw=1.0, ls=DOTTED)
    return Drawing("age", one.svg, f"Age of information over time of {len(flights)} flights")


def _overlay(
    one: Canvas,
    title: str,
    y_label: str,
    flights: Sequence[FlightData],
    values: Callable[[FlightData], tuple[Floats, Floats]],
    drawstyle: str = "default",
) -> Axes:
    ax = one.axes(title, "time [s]", y_label)
    for place, flight in enumerate(flights):
        ax.plot(*thin(*values(flight)), color=colour(_ROLES[place]), lw=_width(place, flights), drawstyle=drawstyle)
    ax.set_xlim(0, max(flight.duration_s for flight in flights))
    return ax


def _width(place: int, flights: Sequence[FlightData]) -> float:
    """Return the width of the line of flight `place` [pt]; the first is the widest, so that all are seen."""
    return float(np.linspace(_WIDEST, _FINEST, len(flights))[place])


def _limits(flight: FlightData, axis: str) -> list[float]:
    """Return the finite limits of an axis' position [m], with the sign that the axis is drawn with."""
    return [side for side in position_limits(flight.design, axis) if np.isfinite(side)]


def _sides(found: FlightComparison) -> Markup:
    return page.facts(
        (
            one.name,
            f"{one.recording} · {one.started_utc} · {one.command} · {one.ended}{'' if one.finished else ', torn'}",
        )
        for one in found.recordings
    )


def _figures(found: FlightComparison) -> Markup:
    others = range(1, len(found.recordings))
    parts = [others[begin : begin + _OTHERS_OF_A_TABLE] for begin in range(0, len(others), _OTHERS_OF_A_TABLE)]
    return page.joined(_figures_of(found, part) for part in parts)


def _figures_of(found: FlightComparison, others: Sequence[int]) -> Markup:
    """Return a table of the first flight's figures beside those of some others."""
    names = {place: found.recordings[place].name for place in others}
    columns = ["figure", "A"]
    columns += [text for name in names.values() for text in (name, f"{name} − A", f"{name} / A")]
    rows = []
    for one in map(for_people, found.figures):
        cells = [measured(one.values[0])]
        for place in others:
            cells += [measured(one.values[place]), difference(one.differences[place - 1])]
            cells.append(measured(one.ratios[place - 1]))
        rows.append([label(one), *(cell.replace("-", "−") for cell in cells)])
    return page.table(columns, rows, frozenset(range(1, len(columns))))


def _parameter_table(found: FlightComparison) -> Markup:
    if not found.parameters:
        return page.paragraph("None.")
    columns = ["parameter", *(one.name for one in found.recordings)]
    rows = [[one.key, *map(parameter, one.values)] for one in found.parameters]
    return page.table(columns, rows, frozenset())
