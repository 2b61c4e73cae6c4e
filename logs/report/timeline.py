"""Timeline of a flight: a lane each for the controller's mode, the vehicle's mode, steps without a position, events."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import groupby, pairwise
from typing import Protocol

import numpy as np
from matplotlib.axes import Axes

from logs.recording.flight import FlightData
from logs.recording.summary import SLACK_TOLERANCE, find_input_violations, find_state_violations
from logs.report.page import Mark
from logs.report.plots import set_time_axis
from logs.report.svg import WIDTH_IN, Drawing, colour, draw_strokes, open_canvas
from uavctl.arrays import Array
from uavctl.event_codes import EventCode
from uavctl.mavlink.handover_states import HandoverState
from uavctl.records import ControlMode, Decision, Severity, SolveStatus

WIDE_IN = 11.0
MAX_MARKS = 400  # of one lane: more would touch each other
_LANE_IN = 0.3
_LEFT_IN = 0.95  # for the lanes' names
_INK_PER_CHARACTER_IN = 0.072
_MODE_ROLES = {
    ControlMode.WAIT: "grid",
    ControlMode.TRACK: "estimate",
    ControlMode.BRAKE: "fallback",
    ControlMode.HOLD: "fallback",
    ControlMode.LAND: "limit",
    ControlMode.STOPPED: "grid",
}
_NO_TIMES = np.zeros(0)
_EVENT_LANES = (
    (Severity.ERROR, "errors", "limit", "an error"),
    (Severity.WARNING, "warnings", "sample", "a warning"),
    (Severity.INFO, "notes", "muted", "a note"),
)
_HAND_OVER_ROLES = {"engaged": "estimate", "failed": "limit", "landing": "limit", "settling": "limit"}


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
    marks: tuple[str, Array] = ("muted", _NO_TIMES)  # role of their colour, times [s]


class _TimedRecord(Protocol):
    @property
    def at_ns(self) -> int: ...


def draw_timeline(flight: FlightData) -> Iterator[Drawing]:
    """Draw the lanes twice: for a wide page and for a narrow one."""
    rows = list(make_lanes(flight))
    label = "Timeline of the flight: " + ", ".join(lane.name for lane in rows)
    for key, width_in, kind in (("timeline-wide", WIDE_IN, "wide broad"), ("timeline-narrow", WIDTH_IN, "wide narrow")):
        with open_canvas(key, 0.55 + _LANE_IN * len(rows), width_in) as canvas:
            ax = canvas.axes("", "time [s]", "", _LEFT_IN)
            set_time_axis(ax, flight)
            for row, lane in enumerate(rows):
                _draw_lane(ax, lane, row, _compute_character_s(float(np.ptp(ax.get_xlim())), width_in))
            ax.set_ylim(len(rows) - 0.5, -0.5)
            ax.set_yticks(range(len(rows)), [lane.name for lane in rows])
            ax.tick_params(axis="y", length=0)
            ax.grid(visible=False, axis="y")
            ax.spines["left"].set_visible(False)  # it would cover marks of the first tick
        yield Drawing(key, canvas.svg, label, kind)


def describe_lanes(flight: FlightData) -> str:
    """Return a sentence on the meaning of each lane."""
    return f"Content of a lane: {'; '.join(f'“{lane.name}”: {lane.meaning}' for lane in make_lanes(flight))}."


def _find_silent_steps(flight: FlightData) -> Iterator[Decision]:
    """Return the flown boundaries before which no position was taken since the one before."""
    flown_ticks, arrivals = {decision.tick for decision in flight.flown}, 0
    for decision in flight.decisions:
        arrivals += decision.accepted
        if decision.boundary:
            if not arrivals and decision.tick in flown_ticks:
                yield decision
            arrivals = 0


def list_hidden_texts(flight: FlightData) -> Iterator[Mark]:
    """Return legend entries for bars that are too short for their text on the narrow page."""
    shown_s = max(flight.duration_s, flight.design.dt_s)
    character_s = _compute_character_s(shown_s, WIDTH_IN)
    texts_by_role: dict[str, dict[str, None]] = {}
    for bar in (bar for lane in make_lanes(flight) for bar in lane.spans):
        if not _fits(bar, character_s):
            texts_by_role.setdefault(bar.role, {})[bar.text] = None
    for role, texts in texts_by_role.items():
        yield Mark("band", role, " · ".join(texts))


def make_lanes(flight: FlightData) -> Iterator[Lane]:
    """Return the lanes that this flight has something for; each means one thing."""
    decisions = flight.decisions
    plans = flight.flown_plans.values()
    yield Lane("controller", "the controller's mode", tuple(_list_mode_spans(flight)))
    lanes = (
        Lane("hand-over", "the state of the hand-over", tuple(_list_hand_over_spans(flight))),
        Lane("vehicle", "its own mode", tuple(_list_vehicle_spans(flight))),
        _make_mark_lane(flight, "no position", "lost", "a step without a new position", _find_silent_steps(flight)),
        _make_mark_lane(
            flight, "refused", "fallback", "a position that was refused", (d for d in decisions if d.rejected)
        ),
        _make_mark_lane(
            flight, "limited", "plan", "a setpoint that the limiter changed", (s for s in flight.setpoints if s.limited)
        ),
        Lane(
            "relaxed",
            "a plan with a relaxed constraint",
            marks=(
                "sample",
                flight.seconds([p.base_ns for p in plans if max(p.slack, p.terminal_miss) > SLACK_TOLERANCE]),
            ),
        ),
        _make_mark_lane(
            flight,
            "no optimum",
            "limit",
            "a solve without an optimum",
            (d for d in decisions if d.solve not in (None, SolveStatus.OPTIMAL)),
        ),
        Lane("outside", "the state beyond a limit", marks=("limit", flight.steps.t_s[find_state_violations(flight)])),
        Lane("input over", "an input beyond a limit", marks=("limit", flight.steps.t_s[find_input_violations(flight)])),
        *(
            _make_mark_lane(
                flight, name, role, f"{text} among the events", (e for e in flight.events if e.severity is severity)
            )
            for severity, name, role, text in _EVENT_LANES
        ),
        Lane("orders", "an order of the operator", marks=("target", _list_order_times(flight))),
    )
    for lane in lanes:
        if lane.spans or len(lane.marks[1]):
            yield lane


def _make_mark_lane(flight: FlightData, name: str, role: str, meaning: str, records: Iterable[_TimedRecord]) -> Lane:
    return Lane(name, meaning, marks=(role, flight.seconds([record.at_ns for record in records])))


def _list_mode_spans(flight: FlightData) -> Iterator[Span]:
    changes = [next(group) for _, group in groupby(flight.decisions, key=lambda decision: decision.mode)]
    begins = flight.seconds([decision.at_ns for decision in changes]).tolist()
    for decision, (begun_s, ended_s) in zip(changes, pairwise([*begins, flight.duration_s]), strict=True):
        yield Span(begun_s, ended_s, _MODE_ROLES[decision.mode], decision.mode.value)


def _list_hand_over_spans(flight: FlightData) -> Iterator[Span]:
    """Return the states of the hand-over, from its events; a flight begins in the first one."""
    events = [event for event in flight.events if event.code == EventCode.HAND_OVER]
    states = [event.subject for event in events]
    begins = flight.seconds([event.at_ns for event in events]).tolist()
    if events and begins[0] > 0.0 and not flight.part:
        states.insert(0, HandoverState.WAITING)
        begins.insert(0, 0.0)
    for state, (begun_s, ended_s) in zip(states, pairwise([*begins, flight.duration_s]), strict=True):
        yield Span(begun_s, ended_s, _HAND_OVER_ROLES.get(state, "grid"), state)


def _list_vehicle_spans(flight: FlightData) -> Iterator[Span]:
    """Return mode and arming of the vehicle, as its heartbeats said."""
    states = [
        (heartbeat.at_ns, f"{heartbeat.mode}{'' if heartbeat.armed else ', disarmed'}", heartbeat)
        for heartbeat in flight.vehicles
    ]
    changes = [next(group) for _, group in groupby(states, key=lambda row: row[1])]
    begins = flight.seconds([at_ns for at_ns, _, _ in changes]).tolist()
    for (_, text, status), (begun_s, ended_s) in zip(changes, pairwise([*begins, flight.duration_s]), strict=True):
        role = "grid" if not status.armed else "estimate" if status.external else "sample"
        yield Span(max(0.0, begun_s), ended_s, role, text)


def _list_order_times(flight: FlightData) -> Array:
    order_times = [step.at_ns for step in flight.step_inputs if step.commands]
    return flight.seconds(order_times if flight.stopped_ns is None else [*order_times, flight.stopped_ns])


def _compute_character_s(shown_s: float, width_in: float) -> float:
    """Return the width of a character of a bar's text, as time [s]."""
    return _INK_PER_CHARACTER_IN * shown_s / (width_in - 1.1)


def _fits(bar: Span, character_s: float) -> bool:
    return (len(bar.text) + 1) * character_s < bar.ended_s - bar.begun_s


def _draw_lane(ax: Axes, lane: Lane, row: int, character_s: float) -> None:
    for bar in lane.spans:
        ax.broken_barh(
            [(bar.begun_s, bar.ended_s - bar.begun_s)],
            (row - 0.32, 0.64),
            color=colour(bar.role),
            alpha=0.9 if bar.role == "grid" else 0.3,
            lw=0,
        )
        if _fits(bar, character_s):
            ax.text(0.5 * (bar.begun_s + bar.ended_s), row, bar.text, ha="center", va="center", fontsize=8.5)
    role, times_s = lane.marks
    mark_times = _thin_marks(times_s[times_s >= 0.0], float(np.ptp(ax.get_xlim())))
    lower, upper = np.full(len(mark_times), row - 0.28), np.full(len(mark_times), row + 0.28)
    draw_strokes(ax, (mark_times, lower), (mark_times, upper), colour(role), 1.2)


def _thin_marks(times_s: Array, shown_s: float) -> Array:
    """Return times (n,) [s], of several too near to be distinguished only the first."""
    _, first = np.unique(np.floor(times_s / shown_s * MAX_MARKS), return_index=True)
    return times_s[first]
