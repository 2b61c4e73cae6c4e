"""A recording's inputs through a control loop, its positions moved to where that would have brought the vehicle."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from msgspec.structs import replace

from uavctl.config import Config
from uavctl.data import Datagram, Record, Refused, Setpoint, Sink, StepInput, Truth, Vec3
from uavctl.flight.controller import Controller
from uavctl.loop import MOCAP, VEHICLE, ControlLoop
from uavctl.mavlink.framing import RawFrame, scan
from uavctl.whatif.departure import Departure, Response
from uavctl.whatif.history import Entry, History
from uavctl.whatif.inertial import InertialFrames
from uavctl.whatif.rewrite import Axes

TRUTH = "/sim/truth"
# As in identification: without setpoints for longer than this, the vehicle does as it likes.
LONGEST_PAUSE_NS = 500_000_000
_WHOLE = "the recording ends"
Watch = Callable[[Iterable[Entry]], Iterable[Entry]]
"""Looks at a recording's entries as they go by, for a progress bar."""


class OtherLink(Protocol):
    """A link that positions come over in place of the recorded one."""

    @property
    def counts(self) -> tuple[int, int]:
        """Positions sent so far, and how many of them were lost."""
        ...

    def due(self, to_ns: int, departure: Departure) -> list[tuple[int, bytes]]:
        """What arrives up to and including `to_ns`, as (arrival [ns], bytes)."""
        ...


@dataclass
class Course:
    """How a flight went, as far as it can be told.

    Attributes:
        departure: From the recorded one.
        inertial_moved: Inertial frames of the vehicle's that were given its other acceleration.
        inertial_left_out: Inertial frames that were left out, because none can be told of them.
        end_ns: Tick up to which both were flown on setpoints [ns].
        ended: Why not further.
    """

    departure: Departure
    end_ns: int = 0
    ended: str = _WHOLE
    inertial_moved: int = 0
    inertial_left_out: int = 0


def fly(
    history: History,
    config: Config,
    controller: Controller,
    response: Response,
    sink: Sink,
    stopwatch: Callable[[], int],
    other: OtherLink | None = None,
    watch: Watch = iter,
) -> Course:
    """Fly a recorded flight otherwise.

    Args:
        history: The recorded flight.
        config: What flies in it now; connections, frame and source are those of the recording.
        controller: Its controller.
        response: How the vehicle answers to setpoints that differ from the recorded ones.
        sink: Gets what a recording of this flight holds, but for its header.
        stopwatch: Time for the timing records [ns].
        other: The link that positions come over; else they come when they came.
        watch: Sees the entries as they are flown.
    """
    tap = _Tap(sink)
    loop = ControlLoop(config, controller, tap, stopwatch)
    flight = _Flight(history, loop, tap, Course(Departure(response)), other)
    for _, _, record in watch(history.entries):
        if isinstance(record, StepInput):
            flight.tick(record)
        elif isinstance(record, Datagram) and not record.outgoing:
            flight.arrive(record)
        elif isinstance(record, Refused):
            loop.refused(record.link, record.counts, record.at_ns)
        elif isinstance(record, Truth):
            flight.truths.append(record)
        if flight.over:
            break
    else:
        flight.tell(max((truth.at_ns for truth in flight.truths), default=0))
    return flight.course


class _Tap:
    """A sink that notes the setpoint of the tick."""

    def __init__(self, sink: Sink) -> None:
        self._sink = sink
        self.setpoint: Vec3 | None = None

    def put(self, topic: str, at_ns: int, record: Record) -> None:
        if isinstance(record, Setpoint):
            self.setpoint = record.accel_mps2
        self._sink.put(topic, at_ns, record)


class _Flight:
    """One flight in progress."""

    def __init__(self, history: History, loop: ControlLoop, tap: _Tap, course: Course, other: OtherLink | None) -> None:
        self._history, self._loop, self._tap, self._other = history, loop, tap, other
        self.course = course
        self.truths: deque[Truth] = deque()  # of boundaries whose tick may not have run
        self.over = False
        daemon = history.config.daemon
        self._positions_link = VEHICLE if daemon.vehicle == daemon.mocap else MOCAP
        self._axes = Axes(history.config.frame)
        self._inertial = InertialFrames(daemon)
        self._begun = False
        self._apart_ns: int | None = None  # since when one of the two is not flown on setpoints

    def arrive(self, record: Datagram) -> None:
        """Let a recorded datagram come, its positions moved, or taken out where another link carries them."""
        data = self._moved(record.data, record.at_ns, of_vehicle=record.link == VEHICLE)
        if data or not record.data:
            self._loop.receive(record.link, data, record.at_ns)

    def tick(self, record: StepInput) -> None:
        """Decide, and let the vehicle answer to what is decided otherwise."""
        at_ns = record.at_ns
        if self._other is not None:
            for arrival_ns, data in self._other.due(at_ns, self.course.departure):
                self._loop.receive(self._positions_link, data, arrival_ns)
        for command in record.commands:
            self._loop.order(command)
        self._tap.setpoint = None
        deque(self._loop.tick(record.tick, at_ns, record.missed_ticks, record.stop), maxlen=0)
        self._loop.timing(record.tick, at_ns, lateness_ns=0, send_ns=0)
        self._steer(at_ns)
        self.tell(at_ns)

    def tell(self, to_ns: int) -> None:
        """Put down where the vehicle would have been at the boundaries up to `to_ns`."""
        departure = self.course.departure
        while self.truths and self.truths[0].at_ns <= to_ns:
            told = self.truths.popleft()
            at_ns = told.at_ns
            if departure.begun_ns is not None:
                told = replace(
                    told,
                    position_m=_plus(told.position_m, departure.position_m(at_ns)),
                    velocity_mps=_plus(told.velocity_mps, departure.velocity_mps(at_ns)),
                    state=tuple((np.array(told.state) + departure.state(at_ns)).tolist()),
                    input=tuple((np.array(told.input) + departure.input(at_ns)).tolist()),
                )
            if self._other is not None:
                sent, lost = self._other.counts
                told = replace(told, sent=sent, lost=lost)
            self._tap.put(TRUTH, at_ns, told)

    def _steer(self, at_ns: int) -> None:
        course, was, now = self.course, self._history.setpoints.get(at_ns), self._tap.setpoint
        taken = self._history.taken[at_ns]
        if was is not None and now is not None and taken:
            self._begun, self._apart_ns = True, None
            course.departure.steer(at_ns, (now[0] - was[0], now[1] - was[1], now[2] - was[2]))
        elif self._begun and self._apart_ns is None:
            self._apart_ns = at_ns
            reason = "" if self._loop.decision is None else self._loop.decision.reason
            course.ended = "no setpoint of the recording flies the vehicle any more" if now is not None else reason
        if self._apart_ns is None:
            course.end_ns, course.ended = at_ns, _WHOLE
        else:
            self.over = at_ns - self._apart_ns > LONGEST_PAUSE_NS

    def _moved(self, data: bytes, at_ns: int, *, of_vehicle: bool) -> bytes:
        """The bytes as they would have come: positions, own velocity and inertial data of the other course."""
        departure = self.course.departure
        begun = departure.begun_ns is not None
        if not (begun or of_vehicle or self._other is not None):
            return data
        parts: list[bytes] = []
        done = 0
        for frame in scan(data, final=True).frames:
            now = self._shown(frame, at_ns, begun=begun)
            if of_vehicle:  # it follows the recorded vehicle, so it hears of positions too
                other = self._inertial.heard(frame, at_ns, departure.acceleration_mps2(at_ns) if begun else None)
                now = other if now is frame.data else now
            if now is not frame.data:
                begin = data.index(frame.data, done)
                parts += (data[done:begin], now)
                done = begin + len(frame.data)
        self.course.inertial_moved = self._inertial.moved
        self.course.inertial_left_out = self._inertial.left_out
        return b"".join((*parts, data[done:]))

    def _shown(self, frame: RawFrame, at_ns: int, *, begun: bool) -> bytes:
        """A frame, its position moved; nothing where another link carries it."""
        seen = self._axes.position(frame) if begun or self._other is not None else None
        if seen is None:
            return frame.data
        captured_ns = self._history.captured_ns(seen, at_ns)
        own = captured_ns is None and seen.position.local_ned  # the vehicle's word of itself, on its own connection
        if captured_ns is None and not own:
            return frame.data
        if self._other is not None and not own:
            return b""
        if not begun:
            return frame.data
        departure = self.course.departure
        when_ns = at_ns if captured_ns is None else captured_ns
        return self._axes.moved(seen, departure.position_m(when_ns), departure.velocity_mps(when_ns))


def _plus(a: Vec3, b: Vec3) -> Vec3:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]
