"""Listens to cameras and vehicle before a flight, asks what has to be asked, and tells items; never arms.

Sans IO and without a clock, as the control loop is: datagrams and times in, datagrams and items out.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterator, Mapping

from uavctl.check.axes import axis_items, compared
from uavctl.check.findings import Heard, Item, ItemState, item
from uavctl.check.positions import position_items
from uavctl.check.vehicle import clock_items, is_armed, parameter_items, vehicle_items, wanted
from uavctl.config.types import Config
from uavctl.mavlink.connection import MavlinkConnection
from uavctl.mavlink.messages import Message
from uavctl.mavlink.relay import Relay
from uavctl.records import Outgoing, PositionSample, Received, Send, Vec3, VehicleStatus

# Moving the body by hand as asked, to see the cameras' axes; pure, time is an argument.


WAY_M = 0.5
_DONE_M = 0.35  # from the start of a prompt, and then at rest
_REST_NS = 700_000_000
_REST_M = 0.05
PROMPTS = (
    ("up", "lift the body 0.5 m straight up, and hold it there"),
    ("nose", "carry the body 0.5 m along its nose, level, and hold it there"),
    ("right", "carry the body 0.5 m to its right, level, and hold it there"),
)


class Guide:
    """Asks for one movement after another, and takes down what the cameras see of each.

    Args:
        limit_ns: time for each prompt; one that is not followed is passed over.
    """

    def __init__(self, limit_ns: int) -> None:
        self._limit_ns = limit_ns
        self._index = 0
        self._begun_ns: int | None = None
        self._recent: deque[tuple[int, Vec3]] = deque()
        self._start: Vec3 | None = None
        self.moves: list[tuple[Vec3, Vec3]] = []  # (asked for, seen), local NED [m]
        self.missed: list[str] = []  # names of prompts that were not followed

    @property
    def over(self) -> bool:
        """Whether every prompt was followed or passed over."""
        return self._index >= len(PROMPTS)

    @property
    def prompt(self) -> str:
        """Prompt for the person now; empty while the body has to rest first, and at the end."""
        return "" if self.over or self._start is None else PROMPTS[self._index][1]

    def take(self, at_ns: int, position_m: Vec3, heading_rad: float | None) -> None:
        """Take a position of the cameras.

        Args:
            position_m: local NED [m].
            heading_rad: the vehicle's own heading; without one only `up` can be asked for.
        """
        if self.over:
            return
        self._begun_ns = at_ns if self._begun_ns is None else self._begun_ns
        self._recent.append((at_ns, position_m))
        while self._recent[0][0] < at_ns - _REST_NS:
            self._recent.popleft()
        middle = self._resting(at_ns)
        if middle is not None and self._start is None:
            self._start = middle
        elif middle is not None and self._start is not None:
            self._judge(middle, heading_rad)
        if self._begun_ns is not None and at_ns - self._begun_ns > self._limit_ns:
            self.missed.append(PROMPTS[self._index][0])
            self._next()

    def _resting(self, at_ns: int) -> Vec3 | None:
        """Mean of the last positions if they are at one place (in any unit), and there are enough."""
        if len(self._recent) < 4 or at_ns - self._recent[0][0] < _REST_NS * 3 // 4:
            return None
        places = [place for _, place in self._recent]
        n, e, d = (sum(axis) / len(places) for axis in zip(*places, strict=True))
        reach = 0.0 if self._start is None else math.dist((n, e, d), self._start)
        still = max(math.dist(place, (n, e, d)) for place in places) <= max(_REST_M, 0.1 * reach)
        return (n, e, d) if still else None

    def _judge(self, middle: Vec3, heading_rad: float | None) -> None:
        start = self._start or middle
        seen = (middle[0] - start[0], middle[1] - start[1], middle[2] - start[2])
        if math.hypot(*seen) < _DONE_M:
            return
        wanted = _direction(PROMPTS[self._index][0], heading_rad)
        if wanted is not None:
            self.moves.append((wanted, seen))
            self._next()

    def _next(self) -> None:
        self._index += 1
        self._begun_ns = self._start = None
        self._recent.clear()


def _direction(name: str, heading_rad: float | None) -> Vec3 | None:
    """The movement that a prompt asks for, local NED [m]."""
    if name == "up":
        return (0.0, 0.0, -WAY_M)
    if heading_rad is None:
        return None
    along = WAY_M * math.cos(heading_rad), WAY_M * math.sin(heading_rad)
    return (along[0], along[1], 0.0) if name == "nose" else (-along[1], along[0], 0.0)


VEHICLE = "vehicle"
ASK_NS = 1_000_000_000  # between two rounds of requests
ROUNDS = 5
PROMPT_NS = 30_000_000_000
# Beside what a link asks for anyway: AUTOPILOT_VERSION once (0), EKF_STATUS_REPORT or ESTIMATOR_STATUS by autopilot
_STREAMS_HZ = {3: {148: 0.0, 193: 1.0}, 12: {148: 0.0, 230: 1.0}}


Listen = Callable[[Message, int], None]  # hears a message that arrived at a time [ns]
# Makes the protocol states of the connections by name, with somebody who hears every message.
MakeLinks = Callable[[Config, Listen], Mapping[str, MavlinkConnection]]


class Preflight:
    """One check; implements `uavctl.records.Flyer`.

    Args:
        make_links: makes the links (`uavctl.loop.make_links`).
        take_off_m: height of the climb that is planned [m].
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
        self._seen = Heard(begun_ns)
        self._relay = Relay(config.relay)
        self._asked_ns: int | None = None
        self._rounds = 0
        self._autopilot = ""
        self.guide = Guide(PROMPT_NS) if move else None  # the prompts, if they were asked for

    def receive(self, link: str, data: bytes, at_ns: int) -> Received:
        """Take one datagram that arrived at `at_ns`; gives what it was, and what is to be sent at once."""
        from_vehicle = from_source = False
        understood = self._links[link].receive(data, at_ns)
        for one in understood.items:
            if isinstance(one, PositionSample):
                from_source = understood.settled
                self._seen.add(one, understood.attitude)
                self._relay.take(one, understood.attitude)
                if self.guide is not None and self._is_safe:
                    angles_rad = self._seen.angles_rad
                    self.guide.take(at_ns, one.position_m, angles_rad[-1][1][2] if angles_rad else None)
            elif isinstance(one, VehicleStatus):
                from_vehicle, self._autopilot = True, one.autopilot
        answers = tuple(Outgoing(link=link, data=answer) for answer in understood.answers)
        return Received(answers, from_vehicle, from_source)

    def tick(self, tick: int, at_ns: int, send: Send) -> None:
        """Send what is due at `at_ns`: heartbeats, TIMESYNC, relayed positions and requests; nothing that moves."""
        del tick
        for name, link in self._links.items():
            for data in link.due(at_ns):
                send(Outgoing(link=name, data=data))
        vehicle = self._links[VEHICLE]
        for data in vehicle.relay(self._relay, at_ns, self._autopilot, refused=()):
            send(Outgoing(link=VEHICLE, data=data))
        if vehicle.vehicle is not None:
            for data in vehicle.place_on_globe(at_ns, self._config.hand_over.origin_deg_m):
                send(Outgoing(link=VEHICLE, data=data))
        due = self._asked_ns is None or at_ns - self._asked_ns >= ASK_NS
        if vehicle.vehicle is not None and due and self._rounds < ROUNDS:
            self._asked_ns = at_ns
            self._rounds += 1
            for data in self._requests(vehicle):
                send(Outgoing(link=VEHICLE, data=data))

    def _requests(self, vehicle: MavlinkConnection) -> Iterator[bytes]:
        """Yield requests for what the vehicle has not told yet."""
        kind = self._seen.autopilot
        if self._rounds <= 2:  # a lost request is repeated once; a vehicle that ignores it is not pestered
            for message_id, rate_hz in _STREAMS_HZ.get(kind or 0, {}).items():
                yield vehicle.request_stream(message_id, rate_hz)
        for name in wanted(kind):
            if name not in self._seen.parameters:
                yield vehicle.request_parameter(name)

    def items(self, at_ns: int) -> tuple[Item, ...]:
        """Return the items of the check as known by `at_ns`."""
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
        state = ItemState.GOOD if self._relay.sent else ItemState.BAD
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
        return [item("movements", ItemState.GOOD if whole else ItemState.BAD, value, "up, nose and right", hint)]

    @property
    def waits(self) -> bool:
        """Whether a vehicle is heard whose own position would show more, and is not there yet."""
        own = self._config.source.messages == ("LOCAL_POSITION_NED",)
        there = self._seen.heartbeat is not None and bool(self._seen.samples)
        return there and not own and not compared(self._seen)

    @property
    def prompt(self) -> str:
        """Prompt that tells a person what to do now; empty for nothing."""
        return self.guide.prompt if self.guide is not None and self._is_safe else ""

    @property
    def _is_safe(self) -> bool:
        """Whether a person may be sent near the vehicle: not to propellers that turn, or might."""
        return self._seen.heartbeat is not None and not is_armed(self._seen)

    def _hear(self, message: Message, at_ns: int) -> None:
        link = self._links[VEHICLE]
        trips = None if link.vehicle is None else link.trips(link.vehicle)
        self._seen.take(message, at_ns, link.vehicle, None if trips is None else trips.offset_ns(at_ns))
