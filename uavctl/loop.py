"""The control loop without its clock and sockets: bytes in, decisions, bytes out.

The daemon runs it in real time, the simulator in lockstep, and replay from a recording. Whatever
it learns and chooses goes to the sink, in the order in which it happened.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator

import msgspec

from uavctl.config import Config
from uavctl.data import (
    ControlMode,
    Datagram,
    Decision,
    Estimate,
    Event,
    Outgoing,
    PositionSample,
    Record,
    Sink,
    StepInput,
    Timing,
    VehicleStatus,
    raw_topic,
)
from uavctl.flight.step import Controller, StepOutput, initial_state, step
from uavctl.mavlink.link import Link
from uavctl.mavlink.mode import HandOver, Seen, Sending, State, look

VEHICLE = "vehicle"
MOCAP = "mocap"
SECOND_NS = 1_000_000_000
LAND_REQUESTS = 5


def make_links(config: Config) -> dict[str, Link]:
    """The connections' protocol states: one for both roles when the two URLs are the same."""
    shared = config.daemon.vehicle == config.daemon.mocap
    names = {VEHICLE: (VEHICLE, MOCAP)} if shared else {VEHICLE: (VEHICLE,), MOCAP: (MOCAP,)}
    return {
        name: Link(
            name,
            roles=frozenset(roles),
            daemon=config.daemon,
            frame=config.frame,
            clock=config.clock,
            source=config.source,
            estimator=config.estimator,
        )
        for name, roles in names.items()
    }


class ControlLoop:
    """One vehicle's controller with its MAVLink links; implements `uavctl.data.Flyer`.

    `stopwatch` gives nanoseconds for the timing records only; no decision depends on it.
    """

    def __init__(self, config: Config, controller: Controller, sink: Sink, stopwatch: Callable[[], int]) -> None:
        self._controller = controller
        self._sink = sink
        self._stopwatch = stopwatch
        self._links = make_links(config)
        self._hand_over = HandOver()
        self._state = initial_state()
        self._inbox: deque[tuple[int, PositionSample | VehicleStatus]] = deque()
        self._next_stats_ns: int | None = None
        self._last_step_ns = 0
        self._requests = 0
        self._asked_ns = 0
        self.heard_vehicle = False  # whether the last datagram came from the vehicle that is flown
        self.vehicle: VehicleStatus | None = None
        self.decision: Decision | None = None
        self.estimate: Estimate | None = None

    @property
    def finished(self) -> bool:
        """Whether the vehicle has been handed over and nothing more will be sent."""
        over = self.decision is not None and self.decision.mode in (ControlMode.LAND, ControlMode.STOPPED)
        return over and not self._must_ask_again()

    def receive(self, link: str, data: bytes, at_ns: int) -> None:
        """Take one datagram that arrived at `at_ns`; ticks before that time will not see it."""
        self._put(raw_topic(link, outgoing=False), at_ns, Datagram(at_ns=at_ns, link=link, outgoing=False, data=data))
        self.heard_vehicle = False
        for item in self._links[link].receive(data, at_ns):
            self.heard_vehicle = self.heard_vehicle or isinstance(item, VehicleStatus)
            if isinstance(item, Event):
                self._put("/uavctl/event", at_ns, item)
            else:
                self._inbox.append((at_ns, item))

    def tick(self, tick: int, at_ns: int, missed_ticks: int = 0, stop: bool = False) -> Iterator[Outgoing]:
        """Run the control tick of grid time `at_ns`; yields the bytes to send, each as soon as it is known.

        Heartbeats and TIMESYNC come before the decision, so that a solve does not delay a round trip.
        """
        inp = self._gather(tick, at_ns, missed_ticks, stop)
        for name, link in self._links.items():
            for data in link.due(at_ns):
                yield self._send(name, data, at_ns)
        begun = self._stopwatch()
        self._state, out = step(self._state, inp, self._controller)
        self._last_step_ns = self._stopwatch() - begun
        self.decision, self.estimate = out.decision, out.estimate
        self._record(out, at_ns)
        yield from self._command(out, at_ns)
        self._record_stats(at_ns)

    def timing(self, tick: int, at_ns: int, lateness_ns: int, send_ns: int) -> None:
        """Record what the shell measured around the last tick."""
        estimate = self.estimate
        self._put(
            "/uavctl/timing",
            at_ns,
            Timing(
                tick=tick,
                at_ns=at_ns,
                lateness_ns=lateness_ns,
                step_ns=self._last_step_ns,
                send_ns=send_ns,
                capture_to_send_ns=None if estimate is None else at_ns + send_ns - estimate.captured_ns,
            ),
        )

    def _gather(self, tick: int, at_ns: int, missed_ticks: int, stop: bool) -> StepInput:
        """All that the tick may know; recorded first, so that a replay knows when the tick ran."""
        samples, heard = self._take_due(at_ns)
        inp = StepInput(
            tick=tick,
            at_ns=at_ns,
            samples=samples,
            vehicle=self._flyable(at_ns),
            missed_ticks=missed_ticks,
            stop=stop,
        )
        self._put("/uavctl/step_input", at_ns, inp)
        for status in heard:
            self._put("/uavctl/vehicle", status.at_ns, status)
        return inp

    def _take_due(self, at_ns: int) -> tuple[tuple[PositionSample, ...], tuple[VehicleStatus, ...]]:
        """Samples and vehicle states that arrived up to `at_ns`; the newest state is taken over."""
        samples: list[PositionSample] = []
        heard: list[VehicleStatus] = []
        while self._inbox and self._inbox[0][0] <= at_ns:
            item = self._inbox.popleft()[1]
            if isinstance(item, VehicleStatus):
                self.vehicle = item
                heard.append(item)
            else:
                samples.append(item)
        return tuple(samples), tuple(heard)

    def _flyable(self, at_ns: int) -> VehicleStatus | None:
        """The vehicle as far as it is ours: none when its heartbeats stopped, not external once the pilot took over."""
        vehicle = self.vehicle
        if vehicle is None or look(at_ns, vehicle, land=False) is Seen.SILENCE:
            return None
        if self._hand_over.state is State.RELEASED:
            return msgspec.structs.replace(vehicle, external=False, mode=f"{vehicle.mode} (released to the pilot)")
        return vehicle

    def _record(self, out: StepOutput, at_ns: int) -> None:
        if out.estimate is not None:
            self._put("/uavctl/estimate", at_ns, out.estimate)
        if out.link is not None:
            self._put("/uavctl/link_estimate", at_ns, out.link)
        if out.plan is not None:
            self._put("/uavctl/plan", at_ns, out.plan)
        self._put("/uavctl/decision", at_ns, out.decision)
        for event in out.events:
            self._put("/uavctl/event", at_ns, event)

    def _command(self, out: StepOutput, at_ns: int) -> Iterator[Outgoing]:
        """What the vehicle is told: a setpoint, the request to land, or nothing."""
        sending, events = self._hand_over.update(at_ns, self.vehicle, ready=out.setpoint is not None, land=out.land)
        for event in events:
            self._put("/uavctl/event", at_ns, event)
        link = self._links[VEHICLE]
        takes = sending in (Sending.SETPOINTS, Sending.NEUTRAL) and not self._pilot_took_over()
        if takes and out.setpoint is not None:
            self._put("/uavctl/setpoint", at_ns, out.setpoint)
            yield self._send(VEHICLE, link.setpoint(out.setpoint), at_ns)
        if sending is Sending.LAND or (self._must_ask_again() and at_ns - self._asked_ns >= SECOND_NS):
            self._requests += 1
            self._asked_ns = at_ns
            yield self._send(VEHICLE, link.land(at_ns), at_ns)

    def _pilot_took_over(self) -> bool:
        """Whether a heartbeat that came after this late tick's grid time says that the vehicle is no longer ours."""
        flown = self.vehicle is not None and self.vehicle.external
        return flown and any(isinstance(item, VehicleStatus) and not item.external for _, item in self._inbox)

    def _must_ask_again(self) -> bool:
        """Whether the vehicle was asked to land, does not do so yet, and may be asked again."""
        vehicle, asked = self.vehicle, self._hand_over.state is State.LANDING
        return asked and vehicle is not None and vehicle.external and vehicle.armed and self._requests < LAND_REQUESTS

    def _send(self, link: str, data: bytes, at_ns: int) -> Outgoing:
        self._put(raw_topic(link, outgoing=True), at_ns, Datagram(at_ns=at_ns, link=link, outgoing=True, data=data))
        return Outgoing(link=link, data=data)

    def _record_stats(self, at_ns: int) -> None:
        if self._next_stats_ns is None:
            self._next_stats_ns = at_ns
        if at_ns >= self._next_stats_ns:
            self._next_stats_ns = at_ns + SECOND_NS
            for link in self._links.values():
                self._put("/uavctl/link", at_ns, link.stats(at_ns))

    def _put(self, topic: str, at_ns: int, record: Record) -> None:
        self._sink.put(topic, at_ns, record)
