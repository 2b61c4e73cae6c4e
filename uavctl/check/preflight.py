"""Pre-flight check: listens to cameras and vehicle, requests missing data, and makes items; never arms.

Sans IO and without a clock, as the control loop: datagrams and times in, datagrams and items out.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping

from uavctl.check.axes import check_axes, has_vehicle_position
from uavctl.check.check_data import CheckData
from uavctl.check.clocks import check_clocks
from uavctl.check.findings import Item, ItemState, make_item
from uavctl.check.guide import Guide
from uavctl.check.parameters import check_parameters, list_parameters
from uavctl.check.positions import check_positions
from uavctl.check.vehicle import check_vehicle, is_armed
from uavctl.config.types import Config
from uavctl.mavlink.connection import MavlinkConnection
from uavctl.mavlink.messages import Message
from uavctl.mavlink.relay import Relay
from uavctl.records import Outgoing, PositionSample, Received, Send, VehicleStatus

VEHICLE = "vehicle"
REQUEST_INTERVAL_NS = 1_000_000_000  # between two rounds of requests
MAX_REQUEST_ROUNDS = 5
PROMPT_TIMEOUT_NS = 30_000_000_000
# Beside a link's own requests: AUTOPILOT_VERSION once (0), EKF_STATUS_REPORT or ESTIMATOR_STATUS by autopilot
_STREAMS_HZ = {3: {148: 0.0, 193: 1.0}, 12: {148: 0.0, 230: 1.0}}


MessageHandler = Callable[[Message, int], None]  # receives a message and its time of arrival [ns]
# Makes the protocol states of the connections by name; a handler receives every message.
LinkFactory = Callable[[Config, MessageHandler], Mapping[str, MavlinkConnection]]


class Preflight:
    """One check; implements `uavctl.records.Flyer`.

    Args:
        make_links: makes the links (`uavctl.mavlink.connection.make_links`).
        take_off_m: height of the climb that is planned [m].
        is_beside_flight: a control loop uses the same connections: it relays the positions.
    """

    def __init__(
        self,
        config: Config,
        make_links: LinkFactory,
        start_ns: int,
        *,
        move: bool = False,
        take_off_m: float | None = None,
        is_beside_flight: bool = False,
    ) -> None:
        self._config, self._take_off_m, self._is_beside_flight = config, take_off_m, is_beside_flight
        self._links = make_links(config, self._handle_message)
        self._data = CheckData(start_ns)
        self._relay = Relay(config.relay)
        self._requested_ns: int | None = None
        self._rounds = 0
        self.guide = Guide(PROMPT_TIMEOUT_NS) if move else None  # prompts, if requested

    def receive(self, link: str, data: bytes, at_ns: int) -> Received:
        """Take one datagram that arrived at `at_ns`; return its source and the datagrams to send at once."""
        from_vehicle = from_source = False
        decoded = self._links[link].receive(data, at_ns)
        for record in decoded.items:
            if isinstance(record, PositionSample):
                from_source = decoded.is_source_settled
                self._data.add_position(record, decoded.attitude)
                self._relay.add_sample(record, decoded.attitude)
                if self.guide is not None and self._is_safe:
                    angles_rad = self._data.angles_rad
                    self.guide.add_position(at_ns, record.position_m, angles_rad[-1][1][2] if angles_rad else None)
            elif isinstance(record, VehicleStatus):
                from_vehicle = True
        answers = tuple(Outgoing(link=link, data=answer) for answer in decoded.replies)
        return Received(answers, from_vehicle, from_source)

    def tick(self, tick: int, at_ns: int, send: Send) -> None:
        """Send messages due at `at_ns`: heartbeats, TIMESYNC, relayed positions and requests; nothing that moves."""
        del tick
        for name, link in self._links.items():
            for data in link.due(at_ns):
                send(Outgoing(link=name, data=data))
        vehicle = self._links[VEHICLE]
        for data in vehicle.encode_relayed_poses(self._relay, at_ns, refused=()):
            if not self._is_beside_flight:
                send(Outgoing(link=VEHICLE, data=data))
        if vehicle.vehicle is not None:
            for data in vehicle.setup_global_origin(at_ns, self._config.hand_over.origin_deg_m):
                send(Outgoing(link=VEHICLE, data=data))
        is_due = self._requested_ns is None or at_ns - self._requested_ns >= REQUEST_INTERVAL_NS
        if vehicle.vehicle is not None and is_due and self._rounds < MAX_REQUEST_ROUNDS:
            self._requested_ns = at_ns
            self._rounds += 1
            for data in self._requests(vehicle):
                send(Outgoing(link=VEHICLE, data=data))

    def _requests(self, vehicle: MavlinkConnection) -> Iterator[bytes]:
        """Yield requests for data that the vehicle has not sent yet."""
        kind = self._data.autopilot
        if self._rounds <= 2:  # a lost request is repeated once; a vehicle that ignores it is not pestered
            for message_id, rate_hz in _STREAMS_HZ.get(kind or 0, {}).items():
                yield vehicle.encode_stream_request(message_id, rate_hz)
        for name in list_parameters(kind):
            if name not in self._data.parameters:
                yield vehicle.encode_parameter_request(name)

    def is_complete(self, elapsed_s: float, limit_s: float) -> bool:
        """Return whether the check has listened long enough: longer where the vehicle's own position is missing."""
        return elapsed_s >= limit_s and (elapsed_s >= limit_s + self._config.check.wait_s or not self._needs_position)

    def make_items(self, at_ns: int) -> tuple[Item, ...]:
        """Return the items of the check as known by `at_ns`."""
        data, config = self._data, self._config
        data.stats = {name: link.stats(at_ns) for name, link in self._links.items()}
        vehicle = self._links[VEHICLE].vehicle
        source_trips = [trips for link in self._links.values() if (trips := link.timesync_clock()) is not None]
        data.round_trips = {
            "vehicle": None if vehicle is None else self._links[VEHICLE].timesync_clock(vehicle),
            "source": source_trips[0] if source_trips else None,
        }
        items = [*check_vehicle(data, config, at_ns, self._take_off_m), *check_positions(data, config, at_ns)]
        items += [
            *check_axes(data, config, [] if self.guide is None else self.guide.moves),
            *check_clocks(data, config),
        ]
        return (*items, *self._check_relay(), *self._check_moves(), *check_parameters(data, config, self._take_off_m))

    def _check_relay(self) -> list[Item]:
        if not self._relay.is_enabled:
            return []
        rejected = ", ".join(f"{count} {reason}" for reason, count in self._relay.kept.items() if count)
        value = f"{self._relay.sent} positions passed on" + (f", kept: {rejected}" if rejected else "")
        state = ItemState.GOOD if self._relay.sent else ItemState.BAD
        hint = "positions need an attitude, and the vehicle has to answer TIMESYNC"
        return [make_item("relay", state, value, "the vehicle gets positions", hint)]

    def _check_moves(self) -> list[Item]:
        """Prompts that were not followed: with `--move` nothing may stay undetermined."""
        if self.guide is None:
            return []
        moves, missed = len(self.guide.moves), ", ".join(self.guide.missed_prompts) or "the last ones"
        is_complete = self.guide.is_done and not self.guide.missed_prompts
        value = f"{moves} movements seen" + ("" if is_complete else f", missing: {missed}")
        hint = "run it again and follow the prompts; `nose` and `right` need the vehicle's ATTITUDE"
        return [
            make_item("movements", ItemState.GOOD if is_complete else ItemState.BAD, value, "up, nose and right", hint)
        ]

    @property
    def _needs_position(self) -> bool:
        """Whether a vehicle answers, but its own position, which would show more, is missing."""
        uses_vehicle_position = self._config.source.messages == ("LOCAL_POSITION_NED",)
        has_both = self._data.heartbeat is not None and bool(self._data.samples)
        return has_both and not uses_vehicle_position and not has_vehicle_position(self._data)

    @property
    def prompt(self) -> str:
        """Prompt for the person now; empty if there is none."""
        return self.guide.prompt if self.guide is not None and self._is_safe else ""

    @property
    def _is_safe(self) -> bool:
        """Whether a person may be sent near the vehicle: not to propellers that turn, or might."""
        return self._data.heartbeat is not None and not is_armed(self._data)

    def _handle_message(self, message: Message, at_ns: int) -> None:
        link = self._links[VEHICLE]
        trips = None if link.vehicle is None else link.timesync_clock(link.vehicle)
        self._data.add_message(message, at_ns, link.vehicle, None if trips is None else trips.offset_ns(at_ns))
