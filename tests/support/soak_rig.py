"""A flight of preset `room` in virtual time with a watch over every tick, for `tools/soak.py` and its tests."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from logs.recording.ends import put_header
from logs.recording.recorder import SyncRecorder
from sim.simulation import World
from uavctl.config import Config, load_config
from uavctl.daemon.flight_orders import compute_stop_limit_s
from uavctl.loop import ControlLoop
from uavctl.records import (
    Command,
    ControlMode,
    Decision,
    Event,
    Order,
    Plan,
    Received,
    Record,
    Send,
    Setpoint,
    Sink,
    Ticked,
    Vec3,
)
from uavctl.wiring.controller import Prepared, build_flight_design, prepare

ALARMS = ("envelope-", "sample-jump", "sample-frozen")
MOST_FINDINGS = 20  # of one flight: the first ones tell


def prepare_room(*overrides: str, preset: str = "room-hahn-stursberg") -> Prepared:
    """Design and controller of a preset."""
    config = load_config(preset, overrides)
    return prepare(config, build_flight_design(config))


@dataclass
class LoopWatch:
    """The loop as the world sees it; holds on to what a tick decided, and what was wrong with it.

    Attributes:
        loop: The loop.
        ticked: The last tick.
        plan: The newest plan.
        prepared: What it flies with.
        sink: Where its records go.
        after_tick: Called with the grid time after each tick.
        take_off_m: Height of the climb that is ordered in the first tick; None for none.
        stop: Whether the operator asks for the hand-over.
        wrong: What no tick may do and one did.
        alarms: What the envelope, or the gate of positions, took for impossible.
        ticks: Ticks so far.
        modes: Ticks in each mode.
    """

    prepared: Prepared
    sink: Sink
    after_tick: Callable[[int], None]
    take_off_m: float | None = None
    stop: bool = False
    wrong: list[str] = field(default_factory=list)
    alarms: list[str] = field(default_factory=list)
    ticks: int = 0
    modes: dict[str, int] = field(default_factory=dict)
    plan: Plan | None = None
    ticked: Ticked | None = None
    _setpoint: Setpoint | None = None
    _failed: bool = False
    _before: Vec3 = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        self.loop = ControlLoop(self.prepared.config, self.prepared.controller, self, lambda: 0)

    def put(self, topic: str, at_ns: int, record: Record) -> None:
        """Take a record, as a sink."""
        if isinstance(record, Setpoint):
            self._setpoint = record
        elif isinstance(record, Plan):
            self.plan = record
        elif isinstance(record, Event) and record.code.startswith(ALARMS):
            self.alarms.append(f"at {at_ns * 1e-9:.2f} s: {record.code}: {record.text}")
        self.sink.put(topic, at_ns, record)

    def receive(self, link: str, data: bytes, at_ns: int) -> Received:
        """Take a datagram."""
        return self.loop.receive(link, data, at_ns)

    def tick(self, tick: int, at_ns: int, send: Send) -> None:
        """Run a tick and look at it."""
        if tick == 0 and self.take_off_m is not None:
            self.loop.order(Command(order=Order.TAKE_OFF, height_m=self.take_off_m))
        self._setpoint = None
        self.ticked = self.loop.tick(tick, at_ns, send, stop=self.stop)
        self.ticks += 1
        decision = self.ticked.decision
        self.modes[decision.mode.value] = self.modes.get(decision.mode.value, 0) + 1
        self._judge(decision)
        if self.loop.account.control_error and not self._failed:
            self.wrong.append(f"at {at_ns * 1e-9:.2f} s: the controller has failed: {self.loop.account.control_error}")
        self._failed = bool(self.loop.account.control_error)
        self.after_tick(at_ns)

    def _judge(self, decision: Decision) -> None:
        if len(self.wrong) >= MOST_FINDINGS:
            return
        horizon, limits = self.prepared.controller.horizon, self.prepared.controller.limits
        when = f"at {decision.at_ns * 1e-9:.2f} s"
        age = decision.age_steps
        if decision.boundary and age is not None and age >= horizon and decision.mode is ControlMode.TRACK:
            self.wrong.append(f"{when}: a plan is flown at age {age}")
        now = (0.0, 0.0, 0.0) if self._setpoint is None else self._setpoint.accel_mps2
        # The one leap that there is: level at once, where what is seen cannot be.
        level = now == (0.0, 0.0, 0.0) and any("envelope-" in alarm for alarm in self.alarms)
        max_slew_mps2 = limits.slew_mps3 * self.prepared.controller.tick_ns * 1e-9
        for axis, (before, after, bound) in enumerate(zip(self._before, now, limits.accel_mps2, strict=True)):
            if not math.isfinite(after) or abs(after) > bound:
                self.wrong.append(f"{when}: setpoint {after} m/s² of axis {axis} is beyond {bound}")
            elif self._setpoint is not None and abs(after - before) > max_slew_mps2 + 1e-9 and not level:
                self.wrong.append(f"{when}: setpoint of axis {axis} leaps from {before} to {after} m/s²")
        self._before = now


class NullSink:
    """A sink that keeps nothing."""

    def put(self, topic: str, at_ns: int, record: Record) -> None:
        """Forget it."""


def fly(
    prepared: Prepared,
    config: Config,
    after_tick: Callable[[World, LoopWatch, int], None] = lambda *_: None,
    *,
    take_off_m: float | None = None,
    path: Path | None = None,
    lands: bool = False,
) -> LoopWatch:
    """Fly in virtual time until it is over, on the ground where it took off.

    Args:
        prepared: What flies.
        config: What it flies in: that of `prepared`, with another simulator or link.
        after_tick: Called after each tick.
        take_off_m: Begin on the ground and climb so far; None: begin in the air.
        path: Recording; None for none.
        lands: Look on when the controller is done, until the vehicle has landed and is disarmed.
    """
    recorder = None if path is None else SyncRecorder(path, config.log)
    if recorder is not None:
        put_header(recorder, prepared, started_ns=0)
    sink: Sink = recorder or NullSink()
    watch = LoopWatch(prepared, sink, lambda at_ns: after_tick(world, watch, at_ns), take_off_m)
    world = World(
        config, watch, on_truth=lambda truth: sink.put("/sim/truth", truth.at_ns, truth), airborne=take_off_m is None
    )

    def is_over() -> bool:
        autopilot = world.peers.autopilot
        return watch.loop.finished and not (lands and (autopilot.pilot.is_armed or not autopilot.vehicle.landed))

    try:
        world.run(config.duration_s, is_over)
        if take_off_m is not None:
            watch.stop = True
            world.run(config.duration_s + compute_stop_limit_s(config, takes_off=True), lambda: watch.loop.finished)
    finally:
        if recorder is not None:
            recorder.close()
    return watch
