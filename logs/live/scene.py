"""Content of the live page at a moment, made from a flight's records."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from typing import Literal, TypeVar

import msgspec

from logs.live.history import History
from logs.recording.derived_topics import tighten_limits
from logs.recording.design_view import AXIS_NUMBER, DesignView, get_config_name, get_position_rate_hz, read_design
from uavctl.arrays import SECOND_NS, Array
from uavctl.errors import RecordingError
from uavctl.records import (
    ControlMode,
    Decision,
    Estimate,
    Event,
    Header,
    LinkEstimate,
    Plan,
    Record,
    Setpoint,
    Severity,
    Timing,
    Truth,
    Vec3,
    VehicleStatus,
)

MOST_EVENTS = 12
R = TypeVar("R", bound=Record)
Level = Literal["good", "warn", "bad", "plain"]
_LEVELS: dict[Severity, Level] = {Severity.INFO: "plain", Severity.WARNING: "warn", Severity.ERROR: "bad"}
_LOSS_PERIODS = 10  # seconds over which losses are counted
_IN_CONTROL = frozenset({ControlMode.WAIT, ControlMode.TRACK})


class SceneBody(msgspec.Struct, frozen=True):
    """A vehicle, or an estimate of one."""

    name: str
    at_m: Vec3  # local NED
    level: Level = "good"


class SceneBox(msgspec.Struct, frozen=True):
    """Limits of a place, local NED; an open side is null."""

    lower_m: tuple[float | None, ...]
    upper_m: tuple[float | None, ...]


class SceneFigure(msgspec.Struct, frozen=True):
    """A figure with its name."""

    name: str
    value: str
    level: Level = "plain"


class SceneEvent(msgspec.Struct, frozen=True):
    """A message to a person."""

    time_s: float
    level: Level
    text: str


class SceneVehicle(msgspec.Struct, frozen=True):
    """One of several vehicles on a page: its row in the table, and its place on the map."""

    name: str
    cells: tuple[str, ...]  # under `LiveScene.columns`
    level: Level = "good"
    at_m: Vec3 | None = None  # local NED, as is all below
    plan: tuple[Vec3, ...] = ()
    target_m: Vec3 | None = None
    boxes: tuple[SceneBox, ...] = ()  # that it stays within


class LiveScene(msgspec.Struct, frozen=True):
    """All that a page shows at a moment."""

    title: str
    time_s: float
    headline: str
    level: Level
    bodies: tuple[SceneBody, ...] = ()
    plan: tuple[Vec3, ...] = ()  # predicted places, local NED
    target_m: Vec3 | None = None
    box: SceneBox | None = None
    margins: SceneBox | None = None  # box less the back-offs of the plan's last stage
    age_s: float | None = None
    age_limit_s: float | None = None
    figures: tuple[SceneFigure, ...] = ()
    events: tuple[SceneEvent, ...] = ()
    columns: tuple[str, ...] = ()
    vehicles: tuple[SceneVehicle, ...] = ()  # of a fleet


def add_scene(history: History, scene: LiveScene) -> None:
    """Add a scene to a history: all vehicles and bodies that have a place."""
    places_m = {body.name: body.at_m for body in scene.bodies}
    places_m |= {vehicle.name: vehicle.at_m for vehicle in scene.vehicles if vehicle.at_m is not None}
    history.add(scene.time_s, scene.age_s, places_m)


class FlightScene:
    """Keeps the newest record of each kind.

    Args:
        history: Gets the state of each tick; None: it is not kept.
    """

    def __init__(self, history: History | None = None) -> None:
        self._history, self._loss_meter = history, _LossMeter()
        self._newest: dict[type[Record], Record] = {}
        self._events: deque[Event] = deque(maxlen=MOST_EVENTS)
        self._design: DesignView | None = None
        self._name: str | None = None  # of the configuration

    def add_record(self, record: Record) -> None:
        """Take a record."""
        self._newest[type(record)] = record
        if isinstance(record, Event):
            self._events.append(record)
        elif isinstance(record, Header):
            self._name = get_config_name(record)
            try:
                self._design = read_design(record)
            except RecordingError:
                self._design = None  # the page then draws no limits
            self._loss_meter = _LossMeter(get_position_rate_hz(record))
        elif isinstance(record, Decision):
            self._loss_meter.add(record)
            header = self._get(Header)
            if header is not None and self._history is not None:
                places_m = {body.name: body.at_m for body in self._list_bodies(record)}
                self._history.add((record.at_ns - header.started_ns) * 1e-9, self._get_age_s(), places_m)

    def scene(self) -> LiveScene | None:
        """Return the scene of the newest records; None before the first decision."""
        decision, design = self._get(Decision), self._design
        header, plan = self._get(Header), self._get(Plan)
        if decision is None or header is None:
            return None
        age_s = self._get_age_s()
        limit_s = None if design is None else design.horizon * design.dt_s
        current = plan if plan is not None and plan.seq == decision.plan_seq else None
        level = _get_level(decision, age_s, limit_s)
        return LiveScene(
            title=f"uavctl: {self._name}" if self._name else "uavctl",
            time_s=(decision.at_ns - header.started_ns) * 1e-9,
            headline=_make_headline(decision, age_s),
            level=level,
            bodies=tuple(self._list_bodies(decision)),
            plan=() if current is None or design is None else _list_positions(design, current),
            target_m=None if decision.target is None or design is None else design.position_of(decision.target),
            box=None if design is None else _make_box(design, design.state_box.lower, design.state_box.upper),
            margins=None
            if current is None or design is None
            else _make_box(design, *tighten_limits(design, current.backoff_x, -1)),
            age_s=age_s,
            age_limit_s=limit_s,
            figures=tuple(self._list_figures(decision, current)),
            events=tuple(
                SceneEvent((event.at_ns - header.started_ns) * 1e-9, _LEVELS[event.severity], event.text)
                for event in reversed(self._events)
            ),
        )

    def _get_age_s(self) -> float | None:
        estimate = self._get(Estimate)
        return None if estimate is None else max(0.0, estimate.age_s)

    def _list_bodies(self, decision: Decision) -> Iterator[SceneBody]:
        estimate, truth = self._get(Estimate), self._get(Truth)
        if estimate is not None and self._design is not None:
            level: Level = "good" if decision.news else "warn"
            position_m = self._design.position_of(estimate.mean)
            yield SceneBody("estimate", position_m, level if decision.mode in _IN_CONTROL else "bad")
        if truth is not None:
            yield SceneBody("truth", truth.position_m, "plain")

    def _list_state_figures(self) -> Iterator[SceneFigure]:
        """List position, age of information and lost positions."""
        estimate, age_s, loss = self._get(Estimate), self._get_age_s(), self._loss_meter.loss
        if estimate is not None and self._design is not None:
            place_text = ", ".join(f"{value:+z.2f}" for value in self._design.position_of(estimate.mean))
            yield SceneFigure("position N, E, D [m]", place_text)
        yield SceneFigure("age of information", "no position yet" if age_s is None else f"{age_s:.2f} s")
        yield SceneFigure("positions lost in the last 10 s", "-" if loss is None else f"{loss:.0%}")

    def _list_figures(self, decision: Decision, plan: Plan | None) -> Iterator[SceneFigure]:
        yield from self._list_state_figures()
        vehicle, setpoint = self._get(VehicleStatus), self._get(Setpoint)
        link, timing = self._get(LinkEstimate), self._get(Timing)
        if vehicle is None:
            yield SceneFigure("vehicle", "no heartbeat yet", "warn")
        else:
            armed = "armed" if vehicle.armed else "disarmed"
            yield SceneFigure("vehicle", f"{vehicle.mode}, {armed}", "bad" if vehicle.failsafe else "plain")
            if vehicle.battery_v is not None:
                yield SceneFigure("battery", f"{vehicle.battery_v:.1f} V")
        if link is not None and link.below_promise:
            yield SceneFigure("positions", "fewer in time than the design counts on", "warn")
        if setpoint is not None:
            accel_text = ", ".join(f"{value:+.2f}" for value in setpoint.accel_mps2)
            limited = f" (limited: {', '.join(setpoint.limited)})" if setpoint.limited else ""
            yield SceneFigure("setpoint N, E, D [m/s²]", accel_text + limited, "warn" if limited else "plain")
        if plan is not None:
            relaxed_text = f", relaxed by {plan.slack:.2g}" if plan.gave_way else ""
            yield SceneFigure(
                "plan", f"{plan.status.value}, {plan.method}{relaxed_text}", "warn" if relaxed_text else "plain"
            )
        if decision.unexplained_mps2 is not None:
            yield SceneFigure("unexplained acceleration", f"{decision.unexplained_mps2:.2f} m/s²")
        if timing is not None:
            yield SceneFigure("tick late by", f"{timing.lateness_ns * 1e-6:.1f} ms")

    def _get(self, kind: type[R]) -> R | None:
        record = self._newest.get(kind)
        return record if isinstance(record, kind) else None


class _LossMeter:
    """Share of the expected positions that did not come in the last ten seconds, as `uavctl ctl status` counts it.

    Args:
        rate_hz: Positions that are expected [1/s].
    """

    def __init__(self, rate_hz: float | None = None) -> None:
        self._rate_hz, self._count = rate_hz, 0
        self._counts: deque[tuple[int, int]] = deque(maxlen=_LOSS_PERIODS + 1)  # at_ns, positions; one a second
        self.loss: float | None = None  # None in the first second

    def add(self, decision: Decision) -> None:
        """Count the positions of a tick."""
        if not self._counts:
            self._counts.append((decision.at_ns, 0))
        self._count += decision.accepted + decision.rejected
        if decision.at_ns - self._counts[-1][0] < SECOND_NS:
            return
        if self._rate_hz:
            before_ns, before = self._counts[0]
            expected = self._rate_hz * (decision.at_ns - before_ns) / SECOND_NS
            self.loss = max(0.0, 1.0 - (self._count - before) / expected)
        self._counts.append((decision.at_ns, self._count))


def _make_headline(decision: Decision, age_s: float | None) -> str:
    age = "no position yet" if age_s is None else f"newest position {age_s:.2f} s old"
    reason = "" if decision.mode in _IN_CONTROL else decision.reason
    return f"{decision.mode.value}: {reason or age}"


def _get_level(decision: Decision, age_s: float | None, limit_s: float | None) -> Level:
    if decision.mode not in _IN_CONTROL:
        return "bad"
    return "warn" if age_s is None or (limit_s is not None and age_s > 0.5 * limit_s) else "good"


def _list_positions(design: DesignView, plan: Plan) -> tuple[Vec3, ...]:
    rows = design.positions_of(plan.states).tolist()
    return tuple((north, east, down) for north, east, down in rows)


def _make_box(design: DesignView, lower: Array, upper: Array) -> SceneBox:
    """Return the limits of the positions among those of the states."""
    sides: list[tuple[float | None, ...]] = []
    for limits in (lower, upper):
        bounds: list[float | None] = [None, None, None]
        for axis, index in zip(design.axes, design.position_index, strict=True):
            if math.isfinite(limits[index]):
                bounds[AXIS_NUMBER[axis]] = float(limits[index])
        sides.append(tuple(bounds))
    return SceneBox(*sides)
