"""Timeline of a flight in lanes that mean one thing each: who flew, the vehicle's mode, steps without news, events."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from importlib import resources
from itertools import groupby, pairwise
from typing import Protocol

import numpy as np
from matplotlib.axes import Axes

from logs.recording.design_view import Floats
from logs.recording.flight import FlightData
from logs.recording.summary import SLACK_TOLERANCE, box_at, input_outside, state_outside
from logs.report.excursion import trusted
from logs.report.page import Mark
from logs.report.plots import SEEN, VIEWS, span
from logs.report.svg import WIDTH_IN, Drawing, canvas, colour, strokes
from uavctl.records import ControlMode, Decision, Severity, SolveStatus

WIDE_IN = 11.0
MARKS = 400  # of one lane: more would touch each other
_LANE_IN = 0.3
_LEFT_IN = 0.95  # for the lanes' names
_INK_PER_CHARACTER_IN = 0.072
_MODES = {
    ControlMode.WAIT: "grid",
    ControlMode.TRACK: "estimate",
    ControlMode.BRAKE: "fallback",
    ControlMode.HOLD: "fallback",
    ControlMode.LAND: "limit",
    ControlMode.STOPPED: "grid",
}
_NONE = np.zeros(0)
_EVENTS = (
    (Severity.ERROR, "errors", "limit", "an error"),
    (Severity.WARNING, "warnings", "sample", "a warning"),
    (Severity.INFO, "notes", "muted", "what else came"),
)
_HANDS = {"engaged": "estimate", "failed": "limit", "landing": "limit", "settling": "limit"}


@dataclass(frozen=True)
class Span:
    """A bar of a lane, with its text where there is room for it."""

    begun_s: float
    ended_s: float
    role: str
    text: str


@dataclass(frozen=True)
class Lane:
    """A lane of the timeline: bars, or marks that all mean the same."""

    name: str
    meaning: str
    spans: tuple[Span, ...] = ()
    marks: tuple[str, Floats] = ("muted", _NONE)  # role of their colour, times [s]


class _Timed(Protocol):
    @property
    def at_ns(self) -> int: ...


def timeline(flight: FlightData) -> tuple[Drawing, Drawing, tuple[Mark, ...], str]:
    """Draw the lanes for a wide page and a narrow one; return both, a legend of bars, and what the lanes mean."""
    rows = list(lanes(flight))
    label = "Timeline of the flight: " + ", ".join(lane.name for lane in rows)
    drawings = []
    for key, width_in in (("timeline-wide", WIDE_IN), ("timeline-narrow", WIDTH_IN)):
        with canvas(key, 0.55 + _LANE_IN * len(rows), width_in) as one:
            ax = one.axes("", "time [s]", "", _LEFT_IN)
            span(ax, flight)
            for row, lane in enumerate(rows):
                _draw_lane(ax, lane, row, _character_s(float(np.ptp(ax.get_xlim())), width_in))
            ax.set_ylim(len(rows) - 0.5, -0.5)
            ax.set_yticks(range(len(rows)), [lane.name for lane in rows])
            ax.tick_params(axis="y", length=0)
            ax.grid(visible=False, axis="y")
            ax.spines["left"].set_visible(False)  # it would cover marks of the first tick
        drawings.append(Drawing(key, one.svg, label))
    meanings = "; ".join(f"“{lane.name}”: {lane.meaning}" for lane in rows)
    return drawings[0], drawings[1], tuple(_untold(rows, flight)), f"What a lane shows: {meanings}."


def _silent(flight: FlightData) -> Iterator[Decision]:
    """Return the flown boundaries before which no position was taken since the one before."""
    flown, came = {one.tick for one in flight.flown}, 0
    for decision in flight.decisions:
        came += decision.accepted
        if decision.boundary:
            if not came and decision.tick in flown:
                yield decision
            came = 0


def _untold(rows: list[Lane], flight: FlightData) -> Iterator[Mark]:
    """Return legend entries for bars that are too short for their text on the narrow page."""
    shown_s = max(flight.duration_s, flight.design.dt_s)
    character_s = _character_s(shown_s, WIDTH_IN)
    texts: dict[str, dict[str, None]] = {}
    for one in (one for lane in rows for one in lane.spans):
        if not _fits(one, character_s):
            texts.setdefault(one.role, {})[one.text] = None
    for role, told in texts.items():
        yield Mark("band", role, " · ".join(told))


def lanes(flight: FlightData) -> Iterator[Lane]:
    """Return the lanes that this flight has something for; each means one thing."""
    decisions = flight.decisions
    plans = flight.flown_plans.values()
    yield Lane("controller", "what flew", tuple(_modes(flight)))
    found = (
        Lane("hand-over", "who is in charge", tuple(_hand_over(flight))),
        Lane("vehicle", "its own mode", tuple(_vehicle(flight))),
        _marks(flight, "no news", "lost", "a step without a new position", _silent(flight)),
        _marks(flight, "refused", "fallback", "a position that was not believed", (d for d in decisions if d.rejected)),
        _marks(
            flight,
            "limited",
            "plan",
            "a setpoint that the last gate changed",
            (s for s in flight.setpoints if s.limited),
        ),
        Lane(
            "gave way",
            "a plan that could not keep a constraint",
            marks=(
                "sample",
                flight.seconds([p.base_ns for p in plans if max(p.slack, p.terminal_miss) > SLACK_TOLERANCE]),
            ),
        ),
        _marks(
            flight,
            "no optimum",
            "limit",
            "a plan that was not found",
            (d for d in decisions if d.solve not in (None, SolveStatus.OPTIMAL)),
        ),
        Lane("outside", "the state beyond a limit", marks=("limit", flight.steps.t_s[state_outside(flight)])),
        Lane("input over", "an input beyond a limit", marks=("limit", flight.steps.t_s[input_outside(flight)])),
        *(
            _marks(flight, name, role, f"{text} among the events", (e for e in flight.events if e.severity is severity))
            for severity, name, role, text in _EVENTS
        ),
        Lane("orders", "an order of the operator", marks=("target", _orders(flight))),
    )
    for lane in found:
        if lane.spans or len(lane.marks[1]):
            yield lane


def _marks(flight: FlightData, name: str, role: str, meaning: str, records: Iterable[_Timed]) -> Lane:
    return Lane(name, meaning, marks=(role, flight.seconds([one.at_ns for one in records])))


def _modes(flight: FlightData) -> Iterator[Span]:
    changes = [next(group) for _, group in groupby(flight.decisions, key=lambda decision: decision.mode)]
    begins = flight.seconds([decision.at_ns for decision in changes]).tolist()
    for decision, (begun_s, ended_s) in zip(changes, pairwise([*begins, flight.duration_s]), strict=True):
        yield Span(begun_s, ended_s, _MODES[decision.mode], decision.mode.value)


def _hand_over(flight: FlightData) -> Iterator[Span]:
    """Return the states of the hand-over, read from its events: "before -> after (mode, armed)"."""
    told = [event for event in flight.events if event.code == "hand-over" and " -> " in event.text]
    states = [event.text.split(" -> ", 1)[1].split(" (", 1)[0] for event in told]
    begins = flight.seconds([event.at_ns for event in told]).tolist()
    if told and begins[0] > 0.0:
        states.insert(0, told[0].text.split(" -> ", 1)[0])
        begins.insert(0, 0.0)
    for state, (begun_s, ended_s) in zip(states, pairwise([*begins, flight.duration_s]), strict=True):
        yield Span(begun_s, ended_s, _HANDS.get(state, "grid"), state)


def _vehicle(flight: FlightData) -> Iterator[Span]:
    """Return mode and arming of the vehicle, as its heartbeats said."""
    told = [(one.at_ns, f"{one.mode}{'' if one.armed else ', disarmed'}", one) for one in flight.vehicles]
    changes = [next(group) for _, group in groupby(told, key=lambda one: one[1])]
    begins = flight.seconds([at_ns for at_ns, _, _ in changes]).tolist()
    for (_, text, status), (begun_s, ended_s) in zip(changes, pairwise([*begins, flight.duration_s]), strict=True):
        role = "grid" if not status.armed else "estimate" if status.external else "sample"
        yield Span(max(0.0, begun_s), ended_s, role, text)


def _orders(flight: FlightData) -> Floats:
    given = [one.at_ns for one in flight.step_inputs if one.commands]
    return flight.seconds(given if flight.stopped_ns is None else [*given, flight.stopped_ns])


def _character_s(shown_s: float, width_in: float) -> float:
    """Return the width of a character of a bar's text, as time [s]."""
    return _INK_PER_CHARACTER_IN * shown_s / (width_in - 1.1)


def _fits(one: Span, character_s: float) -> bool:
    return (len(one.text) + 1) * character_s < one.ended_s - one.begun_s


def _draw_lane(ax: Axes, lane: Lane, row: int, character_s: float) -> None:
    for one in lane.spans:
        ax.broken_barh(
            [(one.begun_s, one.ended_s - one.begun_s)],
            (row - 0.32, 0.64),
            color=colour(one.role),
            alpha=0.9 if one.role == "grid" else 0.3,
            lw=0,
        )
        if _fits(one, character_s):
            ax.text(0.5 * (one.begun_s + one.ended_s), row, one.text, ha="center", va="center", fontsize=8.5)
    role, times_s = lane.marks
    shown = _apart(times_s[times_s >= 0.0], float(np.ptp(ax.get_xlim())))
    low, high = np.full(len(shown), row - 0.28), np.full(len(shown), row + 0.28)
    strokes(ax, (shown, low), (shown, high), colour(role), 1.2)


def _apart(times_s: Floats, shown_s: float) -> Floats:
    """Return times (n,) [s], of several too near to be told apart only the first."""
    _, first = np.unique(np.floor(times_s / shown_s * MARKS), return_index=True)
    return times_s[first]


POINTS = 500  # of a path, evenly in time


def script(flight: FlightData, at_s: float) -> str:
    """Return the script of a flight's page, which shows the moment `at_s` [s] first."""
    design = flight.design
    estimates = trusted(flight)
    believed_m = np.array([design.position_of(one.mean) for one in estimates]).reshape(-1, 3)
    course_m = np.array([one.position_m for one in flight.truths]).reshape(-1, 3)
    modes = [next(group) for _, group in groupby(flight.decisions, key=lambda one: one.mode)]
    data = {
        "end_s": round(flight.duration_s, 3),
        "step_s": round(flight.tick_ns * 1e-9, 3) or 0.01,
        "at_s": round(at_s, 3),
        "views": {name: matrix.tolist() for name, (_, matrix) in VIEWS.items()},
        "course": _rows(flight.seconds([one.at_ns for one in flight.truths]), course_m),
        "believed": _rows(flight.seconds([one.at_ns for one in estimates]), believed_m),
        "modes": [(round((one.at_ns - flight.origin_ns) * 1e-9, 3), one.mode) for one in modes],
        "fences": _fences(flight),
    }
    text = json.dumps(data, separators=(",", ":")).replace("</", "<\\/")
    return resources.files("logs.report").joinpath("cursor.js").read_text(encoding="utf-8").replace("DATA", text, 1)


def _rows(t_s: Floats, position_m: Floats) -> list[list[float]]:
    """Return rows of time [s] and place [m], thinned; those that are not finite are left out."""
    kept = np.flatnonzero(np.isfinite(position_m).all(axis=1))
    if len(kept) > POINTS:
        kept = kept[np.unique(np.linspace(0, len(kept) - 1, POINTS).astype(int))]
    table = np.column_stack([t_s[kept], position_m[kept]]).round(2)
    return [[value + 0.0 for value in row] for row in table.tolist()]


def _fences(flight: FlightData) -> list[dict[str, object]]:
    """Return the limits of position that move, for each view in which they are a line."""
    t_s = np.linspace(0.0, flight.duration_s, POINTS // 4)
    design, found = flight.design, []
    for view, (axes, _) in VIEWS.items():
        for axis in set(axes) & set(design.axes):
            for side in box_at(flight, t_s):
                values = SEEN[axis][1] * side[:, design.position_index[design.axes.index(axis)]]
                if np.isfinite(values).all() and np.ptp(values):
                    places = np.zeros((len(t_s), 3))
                    places[:, 0] = values
                    found.append({"view": view, "along": axis == axes[1], "rows": _rows(t_s, places)})
    return found
