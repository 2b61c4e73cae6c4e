"""Listens to cameras and vehicle before a flight, asks what has to be asked, and tells items; never arms.

Sans IO and without a clock, as the control loop is: datagrams and times in, datagrams and items out.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Protocol

from uavctl.check.axes import axis_items, compared
from uavctl.check.clocks import clock_items
from uavctl.check.guide import Guide
from uavctl.check.item import Item, State, item
from uavctl.check.parameters import parameter_items, wanted
from uavctl.check.positions import position_items
from uavctl.check.seen import Seen
from uavctl.check.vehicle import is_armed, vehicle_items
from uavctl.config.types import Config
from uavctl.data import Outgoing, PositionSample, VehicleStatus
from uavctl.mavlink.link import Link
from uavctl.mavlink.messages import Message
from uavctl.mavlink.relay import Relay

VEHICLE = "vehicle"
ASK_NS = 1_000_000_000  # between two rounds of requests
ROUNDS = 5
PROMPT_NS = 30_000_000_000
# Beside what a link asks for anyway: AUTOPILOT_VERSION once (0), EKF_STATUS_REPORT or ESTIMATOR_STATUS by autopilot
_STREAMS_HZ = {3: {148: 0.0, 193: 1.0}, 12: {148: 0.0, 230: 1.0}}


class MakeLinks(Protocol):
    """Makes the protocol states of the connections, with somebody who hears every message."""

    def __call__(self, config: Config, listen: Listen) -> Mapping[str, Link]:
        """The links by name."""
        ...


class Listen(Protocol):
    """Hears a message that arrived at a time [ns]."""

    def __call__(self, message: Message, at_ns: int, /) -> None:
        """Take one message."""
        ...


class Preflight:
    """One check; implements `uavctl.data.Flyer`.

    Args:
        config: the configuration.
        make_links: makes the links (`uavctl.loop.make_links`).
        begun_ns: when listening begins.
        move: ask a person to move the body.
        take_off_m: height of the climb that is planned [m].

    Attributes:
        heard_vehicle: whether the last datagram came from the vehicle.
        heard_source: whether it held a position of a source that has spoken for a while.
        guide: the prompts, if they were asked for.
    """

    def __init__(
        self,
        config: Config,
        make_links: MakeLinks,
        begun_ns: int,
        *,
        move: bool = False,
        take_off_m: float | None = None,
    ) -> None:
        self._config, self._take_off_m = config, take_off_m
        self._links = make_links(config, self._hear)
        self._seen = Seen(begun_ns)
        self._relay = Relay(config.relay)
        self._asked_ns: int | None = None
        self._rounds = 0
        self._autopilot = ""
        self.heard_vehicle = self.heard_source = False
        self.guide = Guide(PROMPT_NS) if move else None

    def receive(self, link: str, data: bytes, at_ns: int) -> tuple[Outgoing, ...]:
        """Take one datagram that arrived at `at_ns`; gives what is to be sent at once."""
        self.heard_vehicle = self.heard_source = False
        for one in self._links[link].receive(data, at_ns):
            if isinstance(one, PositionSample):
                self.heard_source = self._links[link].settled
                attitude = self._links[link].attitude
                self._seen.add(one, attitude)
                self._relay.take(one, attitude)
                if self.guide is not None and self._is_safe:
                    self.guide.take(at_ns, one.position_m, self._heading_rad())
            elif isinstance(one, VehicleStatus):
                self.heard_vehicle, self._autopilot = True, one.autopilot
        return tuple(Outgoing(link=link, data=answer) for answer in self._links[link].answers())

    def tick(self, tick: int, at_ns: int) -> Iterator[Outgoing]:
        """What is to be sent at `at_ns`: heartbeats, TIMESYNC, relayed positions and requests; nothing that moves."""
        del tick
        for name, link in self._links.items():
            for data in link.due(at_ns):
                yield Outgoing(link=name, data=data)
        vehicle = self._links[VEHICLE]
        for data in vehicle.relay(self._relay, at_ns, self._autopilot, refused=()):
            yield Outgoing(link=VEHICLE, data=data)
        if vehicle.vehicle is not None:
            for data in vehicle.place_on_globe(at_ns, self._config.hand_over.origin_deg_m):
                yield Outgoing(link=VEHICLE, data=data)
        due = self._asked_ns is None or at_ns - self._asked_ns >= ASK_NS
        if vehicle.vehicle is not None and due and self._rounds < ROUNDS:
            self._asked_ns = at_ns
            self._rounds += 1
            for data in self._requests(vehicle):
                yield Outgoing(link=VEHICLE, data=data)

    def _requests(self, vehicle: Link) -> Iterator[bytes]:
        """What has not been told yet is asked for."""
        kind = self._seen.autopilot
        if self._rounds <= 2:  # a lost request is repeated once; a vehicle that ignores it is not pestered
            for message_id, rate_hz in _STREAMS_HZ.get(kind or 0, {}).items():
                yield vehicle.request_stream(message_id, rate_hz)
        for name in wanted(kind):
            if name not in self._seen.parameters:
                yield vehicle.request_parameter(name)

    def items(self, at_ns: int) -> tuple[Item, ...]:
        """What is known by `at_ns`."""
        seen, config = self._seen, self._config
        seen.stats = {name: link.stats(at_ns) for name, link in self._links.items()}
        vehicle = self._links[VEHICLE].vehicle
        sources = [trips for link in self._links.values() if (trips := link.trips()) is not None]
        seen.trips = {
            "vehicle": None if vehicle is None else self._links[VEHICLE].trips(vehicle),
            "source": sources[0] if sources else None,
        }
        found = [*vehicle_items(seen, config, at_ns, self._take_off_m), *position_items(seen, config, at_ns)]
        found += [*axis_items(seen, config, [] if self.guide is None else self.guide.moves), *clock_items(seen, config)]
        return (*found, *self._relayed(), *self._moves(), *parameter_items(seen, config, self._take_off_m))

    def _relayed(self) -> list[Item]:
        if not self._relay.enabled:
            return []
        kept = ", ".join(f"{count} {reason}" for reason, count in self._relay.kept.items() if count)
        value = f"{self._relay.sent} positions passed on" + (f", kept: {kept}" if kept else "")
        state = State.GOOD if self._relay.sent else State.BAD
        hint = "positions need an attitude, and the vehicle has to answer TIMESYNC"
        return [item("relay", state, value, "the vehicle gets positions", hint)]

    def _moves(self) -> list[Item]:
        """Prompts that were not followed: with `--move` nothing may stay undetermined."""
        if self.guide is None:
            return []
        done, missed = len(self.guide.moves), ", ".join(self.guide.missed) or "the last ones"
        whole = self.guide.over and not self.guide.missed
        value = f"{done} movements seen" + ("" if whole else f", missing: {missed}")
        hint = "run it again and follow the prompts; `nose` and `right` need the vehicle's ATTITUDE"
        return [item("movements", State.GOOD if whole else State.BAD, value, "up, nose and right", hint)]

    @property
    def waits(self) -> bool:
        """Whether a vehicle is heard whose own position would show more, and is not there yet."""
        own = self._config.source.messages == ("LOCAL_POSITION_NED",)
        there = self._seen.heartbeat is not None and bool(self._seen.samples)
        return there and not own and not compared(self._seen)

    @property
    def prompt(self) -> str:
        """What a person is asked to do now; empty for nothing."""
        return self.guide.prompt if self.guide is not None and self._is_safe else ""

    @property
    def _is_safe(self) -> bool:
        """Nobody is sent near propellers that turn, or might."""
        return self._seen.heartbeat is not None and not is_armed(self._seen)

    def _heading_rad(self) -> float | None:
        return self._seen.angles_rad[-1][1][2] if self._seen.angles_rad else None

    def _hear(self, message: Message, at_ns: int) -> None:
        link = self._links[VEHICLE]
        trips = None if link.vehicle is None else link.trips(link.vehicle)
        self._seen.take(message, at_ns, link.vehicle, None if trips is None else trips.offset_ns(at_ns))
