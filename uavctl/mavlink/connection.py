"""Protocol state of one MAVLink connection, sans IO: bytes in; items, replies and requests out.

1. Decode the bytes and pass each message on by the roles of the connection.
2. Role `vehicle`: `VehicleMonitor` makes status, motion and inertial samples; `stream_requests` asks for messages.
3. Role `mocap`: `PositionDecoder` makes position samples with a capture time in our clock.
4. Answer TIMESYNC requests at once. A late answer would make the measured round trip longer.
5. Count everything that is dropped, and report it in events: at most one in a second.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from statistics import median
from typing import NamedTuple

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from uavctl.arrays import SECOND_NS
from uavctl.config import Config
from uavctl.config.connections import ClockConfig, DaemonConfig, FrameConfig, SourceConfig
from uavctl.config.types import EstimatorConfig
from uavctl.event_codes import EventCode
from uavctl.frames import Quaternion
from uavctl.mavlink.clocksync import (
    MAX_CLOCK_STEP_NS,
    ROUND_TRIP_MARGIN_NS,
    ArrivalClock,
    ClockSource,
    StampUnit,
    TimesyncClock,
)
from uavctl.mavlink.codec import AUTOPILOT_ESTIMATE, StreamDecoder, decode
from uavctl.mavlink.encoder import Encoder, UnsendableError
from uavctl.mavlink.framing import SkipReason
from uavctl.mavlink.messages import Attitude, CommandAck, Message, Position, StatusText, TimeSync
from uavctl.mavlink.positions import PositionDecoder
from uavctl.mavlink.profile import PROFILES
from uavctl.mavlink.relay import Relay
from uavctl.mavlink.requests import COMMANDS, RequestKind
from uavctl.mavlink.statustext import StatusTextAssembler
from uavctl.mavlink.stream_requests import (
    GPS_GLOBAL_ORIGIN,
    SOURCE_PARAMETER,
    GlobalOriginSetup,
    ParameterDownload,
    StreamRequests,
)
from uavctl.mavlink.vehicle import MIN_INERTIAL, MIN_INERTIAL_SHARE, VehicleMonitor
from uavctl.records import (
    Event,
    InertialSample,
    LinkStats,
    PositionSample,
    Setpoint,
    Severity,
    Vec3,
    VehicleMotion,
    VehicleStatus,
)

VEHICLE, MOCAP = "vehicle", "mocap"
HEARTBEAT_NS = SECOND_NS
# Not quite one second, so that requests do not always wait for the solve of the same step.
TIMESYNC_NS = 950_000_000
FIRST_TIMESYNC_NS = 200_000_000
MAX_FIRST_REQUESTS = 10  # at the faster rate, until the first answer
MAX_OPEN_REQUESTS = 8  # requests that still accept an answer
# Limit of answers to TIMESYNC in a time window; one for the vehicle, one for all others. A flood of requests must not
# make a flood of answers, or take the time of a tick.
MAX_ANSWERS, ANSWER_WINDOW_NS = 8, 50_000_000
STREAM_SCHEMES = ("tcp:", "serial:")
SLOW_EVENT_NS = 10_000_000_000  # between two events about slow answers
NO_HEARTBEAT_NS = 3 * SECOND_NS  # of positions without a heartbeat, which comes once a second
TIMESYNC_FLOOD = "timesync-flood"
OVERRUN = "overrun"  # dropped by the system before it was read; perhaps the newest state of the vehicle
# Code of a lost connection: what happened, and what follows.
DISCONNECT_TEXTS = {
    EventCode.HUNG_UP: ("the other side closed the connection", "the daemon connects again each second"),
    EventCode.CONNECTION_SILENT: ("the connection fell silent", "the daemon connects again"),
}
_STALE_NOUNS = {EventCode.INERTIAL_STALE: "IMU message", EventCode.VELOCITY_STALE: "velocity message"}
# Counted but not reported: every flight has them, or another event reports them.
_NOT_REPORTED = frozenset({SkipReason.UNKNOWN, AUTOPILOT_ESTIMATE, *DISCONNECT_TEXTS})

Item = PositionSample | VehicleStatus | VehicleMotion | InertialSample | Event | CommandAck | StatusText


class ReceiveResult(NamedTuple):
    """Content of one datagram, and the source state of the newest sample, which may be of an earlier datagram."""

    items: tuple[Item, ...]
    replies: tuple[bytes, ...]  # answers to TIMESYNC requests, to be sent at once: a delay would count as round trip
    is_source_settled: bool  # whether the source of the newest sample is settled
    attitude: Quaternion | None  # of its body: body axes forward, right, down to NED (w, x, y, z)
    clock_source: ClockSource  # source of its capture time


class MavlinkConnection:
    """MAVLink on one connection.

    Args:
        name: the connection's name in records.
        roles: `vehicle` (heartbeats, status, setpoints), `mocap` (positions), or both.
        daemon: our ids; the connection's URL tells a byte stream from datagrams.
        source: which messages and which system count as positions.
        estimator: standard deviation of a position, and the limits of plausible ones.
        on_message: called with every decoded message of others and its time of arrival; for callers that need more
            than the items.
        vehicle_time: a vehicle that asks for our time gets that of its own clock (`relay.vehicle_time`).
    """

    def __init__(
        self,
        name: str,
        *,
        roles: frozenset[str],
        daemon: DaemonConfig,
        frame: FrameConfig,
        clock: ClockConfig,
        source: SourceConfig,
        estimator: EstimatorConfig,
        on_message: Callable[[Message, int], None] | None = None,
        vehicle_time: bool = False,
    ) -> None:
        self._name, self._roles, self._uses_vehicle_time = name, roles, vehicle_time
        self._own_address = (daemon.system_id, daemon.component_id)
        self._reports_positions = source.report
        self._reported_stamps_us: dict[tuple[int, int], int] = {}  # of the sender of the newest position
        url = daemon.vehicle if VEHICLE in roles else daemon.mocap
        self._stream = StreamDecoder() if url.startswith(STREAM_SCHEMES) else None
        self._encoder = Encoder(*self._own_address)
        self._positions = PositionDecoder(frame, clock, source, estimator, self._count_bad)
        wants_inertial = estimator.inertial_std_mps2 > 0.0
        self._vehicle = VehicleMonitor(
            self._count_bad,
            self._own_address,
            daemon.vehicle_system_id,
            daemon.vehicle_component_id,
            inertial=wants_inertial,
            channels=daemon.radio_channels,
        )
        self._streams, self._origin_setup, self._text_assembler = (
            StreamRequests(inertial=wants_inertial, channels=daemon.radio_channels),
            GlobalOriginSetup(),
            StatusTextAssembler(),
        )
        self._wants_parameters, self._parameters = daemon.parameters, ParameterDownload()
        self._bad: Counter[str] = Counter()
        self._unreported: Counter[str] = Counter()
        self._reported_ns: int | None = None
        self._slow_count = 0  # unused answers to TIMESYNC, not reported yet
        self._slow_reported_ns: int | None = None
        self._reported_resyncs = 0
        self._is_low_share_reported = False
        # A vehicle that sends its position, but no heartbeat: address, start, and whether it was reported
        self._no_heartbeat_address: tuple[int, int] | None = None
        self._no_heartbeat_since_ns: int | None = None
        self._is_no_heartbeat_reported = False
        self._reported_units: set[tuple[int, int, StampUnit]] = set()
        self._datagrams = self._messages = 0
        self._heartbeat_ns: int | None = None
        self._request_ns: int | None = None
        self._requests = 0
        self._open_requests_ns: deque[int] = deque(maxlen=MAX_OPEN_REQUESTS)
        self._has_answer = False
        self._on_message = on_message
        self._vehicle_clock = ArrivalClock()
        self._replies: list[bytes] = []  # to requests of the present datagram
        self._reply_window_ns = 0
        self._reply_counts: Counter[bool] = Counter()  # requests of the vehicle (True) and of all others in the window

    @property
    def vehicle(self) -> tuple[int, int] | None:
        """System and component of the vehicle; None before its first heartbeat."""
        return self._vehicle.address

    def timesync_clock(self, address: tuple[int, int] | None = None) -> TimesyncClock | None:
        """Return the clock of a peer that answers TIMESYNC; without an address, of the newest sample's source."""
        return self._positions.timesync_clock(address)

    def add_timesync_answer(self, address: tuple[int, int], sent_ns: int, remote_ns: int, received_ns: int) -> None:
        """Add an answer to the TIMESYNC request of another client, from a recording.

        Args:
            address: system and component whose clock it shows.
        """
        self._positions.add_timesync_answer(address, sent_ns, remote_ns, received_ns)

    @property
    def inertial_counts(self) -> tuple[int, int]:
        """Numbers of inertial data: used, and all."""
        return self._vehicle.inertial_used, self._vehicle.inertial_total

    def vehicle_uptime_s(self, at_ns: int) -> float | None:
        """Return the vehicle's uptime by its own clock [s]; None if unknown."""
        return self._vehicle.uptime_s(at_ns)

    def receive(self, data: bytes, at_ns: int) -> ReceiveResult:
        """Decode one datagram, or one chunk of a stream, that arrived at `at_ns`; never raises."""
        self._replies.clear()
        decoded = decode(data) if self._stream is None else self._stream.push(data)
        self._datagrams += 1
        self._messages += decoded.total
        for reason, count in decoded.bad.items():
            self._count_bad(reason, count)
        items = [item for message in decoded.messages for item in self._handle_message(message, at_ns)]
        items += [
            item
            for text in self._text_assembler.flush_overdue(at_ns)
            for item in self._vehicle.handle_message(text, at_ns)
        ]
        positions = self._positions
        items_and_events = (*items, *self._make_events(at_ns))
        return ReceiveResult(
            items_and_events, tuple(self._replies), positions.is_settled, positions.attitude, positions.clock_source
        )

    def add_refusals(self, counts: Mapping[str, int], at_ns: int) -> tuple[Event, ...]:
        """Add counts of data that the connection dropped before decoding: by address, rate or signature.

        A reason may have a cause behind a colon.
        """
        events = [
            self._make_event(at_ns, Severity.ERROR, code, "; ".join(texts))
            for code, texts in DISCONNECT_TEXTS.items()
            if code in counts
        ]
        for reason, count in counts.items():
            code, _, cause = reason.partition(": ")
            self._count_bad(code, count)
            if code == EventCode.PROCESS_ENDED:
                text = f"the camera process has ended: {cause}"
                events.append(self._make_event(at_ns, Severity.ERROR, EventCode.PROCESS_ENDED, text))
            elif code == EventCode.SEVERAL_PUBLISHERS and cause:  # with a cause it comes once, else with each pose
                events.append(self._make_event(at_ns, Severity.ERROR, EventCode.SEVERAL_PUBLISHERS, cause))
        return (*events, *self._make_events(at_ns))

    def due(self, at_ns: int) -> tuple[bytes, ...]:
        """Return the frames that are due at `at_ns`: heartbeat, TIMESYNC, requests for streams and parameters."""
        frames = []
        if self._heartbeat_ns is None or at_ns - self._heartbeat_ns >= HEARTBEAT_NS:
            self._heartbeat_ns = at_ns
            frames.append(self._encoder.encode_heartbeat())
        is_first_phase = not self._has_answer and self._requests < MAX_FIRST_REQUESTS
        interval_ns = FIRST_TIMESYNC_NS if is_first_phase else TIMESYNC_NS
        if self._request_ns is None or at_ns - self._request_ns >= interval_ns:
            self._request_ns = at_ns
            self._requests += 1
            self._open_requests_ns.append(at_ns)
            frames.append(self._encoder.encode_timesync(0, at_ns))
        if VEHICLE in self._roles and self._vehicle.address is not None:
            streams = self._streams.due(at_ns, self._vehicle.autopilot)
            frames += [self.encode_stream_request(number, rate_hz) for number, rate_hz in streams]
            indices = self._parameters.due(at_ns, armed=self._vehicle.is_armed) if self._wants_parameters else ()
            frames += [self._encoder.encode_parameter_list_request(index, *self._target_address()) for index in indices]
        return tuple(frames)

    def encode_setpoint(self, setpoint: Setpoint) -> bytes:
        """Encode a setpoint for the vehicle.

        Raises:
            UnsendableError: a value is not finite, or no vehicle has been heard.
        """
        return self._encoder.encode_setpoint(setpoint, *self._target_address())

    def encode_request(self, kind: RequestKind, height_m: float) -> bytes:
        """Encode a request to the vehicle.

        Args:
            height_m: of the climb above the ground [m], for a take-off.

        Raises:
            UnsendableError: no vehicle has been heard, or its modes are not known.
        """
        parameters: tuple[float, ...] = ()  # zeros: land here, disarm
        match kind:
            case RequestKind.TAKE_OFF_MODE | RequestKind.EXTERNAL_MODE:
                parameters = self._choose_mode_parameters(kind)
            case RequestKind.ARM:
                parameters = (1.0,)
            case RequestKind.TAKE_OFF:
                parameters = (*(0.0,) * 6, height_m)
        return self._encoder.encode_command(COMMANDS[kind], parameters, *self._target_address())

    def _choose_mode_parameters(self, kind: RequestKind) -> tuple[float, ...]:
        """Return the parameters of DO_SET_MODE: main and sub mode for PX4, the mode number for ArduPilot."""
        profile = PROFILES.get(self._vehicle.autopilot)
        if profile is None:
            raise UnsendableError(f"link {self._name}: modes of autopilot {self._vehicle.autopilot!r} are not known")
        name = profile.external_mode if kind is RequestKind.EXTERNAL_MODE else profile.take_off_mode
        return (float(mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED), *map(float, profile.mode_parameters[name]))

    def setup_global_origin(self, at_ns: int, origin_deg_m: Vec3) -> tuple[bytes, ...]:
        """Return the messages that an ArduPilot without GPS needs before it arms; called until it is armed.

        Args:
            origin_deg_m: latitude, longitude [deg] and altitude [m] of local zero.
        """
        profile = PROFILES.get(self._vehicle.autopilot)
        if profile is None or not profile.needs_global_origin:
            return ()
        is_request_due, is_origin_due = self._origin_setup.due(at_ns)
        if not is_request_due:
            return ()
        system, component = self._target_address()
        frames = (
            self._encoder.encode_parameter_request(SOURCE_PARAMETER, system, component),
            self._encoder.encode_message_request(GPS_GLOBAL_ORIGIN, system, component),
        )
        return (self._encoder.encode_global_origin(origin_deg_m, system), *frames) if is_origin_due else frames

    def encode_parameter_request(self, name: str) -> bytes:
        """Encode the request for one parameter.

        Raises:
            UnsendableError: no vehicle has been heard.
        """
        return self._encoder.encode_parameter_request(name, *self._target_address())

    def encode_stream_request(self, message_id: int, rate_hz: float) -> bytes:
        """Encode the request for a message at a rate, or once for rate 0.

        Raises:
            UnsendableError: no vehicle has been heard.
        """
        if rate_hz == 0.0:
            return self._encoder.encode_message_request(message_id, *self._target_address())
        return self._encoder.encode_interval_request(message_id, round(1e6 / rate_hz), *self._target_address())

    def encode_relayed_poses(self, relay: Relay, at_ns: int, *, refused: Sequence[PositionSample]) -> tuple[bytes, ...]:
        """Encode the positions for the vehicle's own estimator in the tick of `at_ns`.

        Args:
            refused: samples that the tick has refused.
        """
        if not relay.is_enabled or self.vehicle is None:
            return ()
        # Only PX4 moves stamps by its offset to our time. That offset is zero if we answer with its own time.
        moves_stamps = not self._uses_vehicle_time and self._vehicle.autopilot == "px4"
        offset_ns = 0 if moves_stamps else self._vehicle_offset_ns(at_ns) or 0
        poses = relay.due(
            at_ns, offset_ns=offset_ns, refused=refused, turn=self._vehicle.turn, armed=self._vehicle.is_armed
        )
        return tuple(self._encoder.encode_external_position(pose) for pose in poses)

    def _vehicle_time_ns(self, at_ns: int) -> int | None:
        """Return the time of the vehicle's clock; None if unknown.

        It is the answer to a vehicle that requests our time. PX4 moves the stamps of positions by its offset to the
        answers. With round trips of more than 10 ms it keeps an old offset (src/lib/timesync/Timesync.cpp) and does
        not follow a drift. With its own time as answer there is no offset and no drift.
        """
        offset_ns = self._vehicle_offset_ns(at_ns)
        return None if offset_ns is None else at_ns - offset_ns

    def _vehicle_offset_ns(self, at_ns: int) -> int | None:
        """Return (our time − the vehicle's time); without new answers, an older offset within the bounds of arrivals.

        A message arrives after its stamp, and no delay is longer than the shortest round trip. A vehicle without
        answers and stamps gets our own time. That is steady, so its own delay estimate works.
        """
        timesync, arrival_ns = self.timesync_clock(self.vehicle), self._vehicle_clock.offset_ns(at_ns)
        known_ns = None if timesync is None else timesync.last_known_ns(at_ns)
        if timesync is None or known_ns is None:
            return arrival_ns
        if (
            arrival_ns is None
            or timesync.offset_ns(at_ns) is not None
            or abs(arrival_ns - known_ns) > MAX_CLOCK_STEP_NS
        ):
            return known_ns
        return min(max(known_ns, arrival_ns - timesync.shortest_round_trip_ns - ROUND_TRIP_MARGIN_NS), arrival_ns)

    def stats(self, at_ns: int) -> LinkStats:
        """Return the counters since the start."""
        timesync = self.timesync_clock() or (None if self.vehicle is None else self.timesync_clock(self.vehicle))
        round_trips_ns = () if timesync is None else timesync.round_trips_ns
        return LinkStats(
            at_ns=at_ns,
            link=self._name,
            datagrams=self._datagrams,
            messages=self._messages,
            samples=self._positions.samples,
            bad={str(reason): count for reason, count in self._bad.items()},
            clock_offset_ns=self._positions.clock_offset_ns,
            clock_source=str(self._positions.clock_source),
            clock_rtt_ns=round(median(round_trips_ns)) if round_trips_ns else None,
            clock_drift_ppm=None if timesync is None else timesync.drift_ppm,
            clock_rejected=0 if timesync is None else timesync.rejected,
            stamp_units=tuple(sorted({str(unit) for unit in self._positions.units.values()})),
        )

    def _target_address(self) -> tuple[int, int]:
        if self._vehicle.address is None:
            raise UnsendableError(f"link {self._name}: no vehicle has been heard, so nothing can be sent")
        return self._vehicle.address

    def _handle_message(self, message: Message, at_ns: int) -> tuple[Item, ...]:
        if (message.system, message.component) == self._own_address:  # our own message, sent back by a router
            return ()
        if self._on_message is not None:
            self._on_message(message, at_ns)
        if isinstance(message, TimeSync):
            self._handle_timesync(message, at_ns)
            return ()
        items: tuple[Item, ...] = self._handle_vehicle_message(message, at_ns) if VEHICLE in self._roles else ()
        if isinstance(message, Position) and MOCAP in self._roles:
            sample = self._positions.make_sample(message, at_ns)
            if sample is not None and self._reports_positions and message.stamp_us is not None:
                self._report_position(message.stamp_us, (message.system, message.component), sample.seq)
            return items if sample is None else (*items, sample)
        return items

    def _report_position(self, stamp_us: int, address: tuple[int, int], number: int) -> None:
        """Report the newest position to its sender; an older one that came late is none."""
        if stamp_us > self._reported_stamps_us.get(address, -1):
            self._reported_stamps_us = {address: stamp_us}
            self._replies.append(self._encoder.encode_position_report(stamp_us, number, *address))

    def _handle_vehicle_message(self, message: Message, at_ns: int) -> tuple[Item, ...]:
        """Handle a message for the vehicle monitor; return its items."""
        if isinstance(message, StatusText):
            texts = self._text_assembler.add_chunk(message, at_ns)
            return tuple(item for text in texts for item in self._vehicle.handle_message(text, at_ns))
        boots, not_ready_count, address = self._vehicle.boots, self._vehicle.not_ready_count, self.vehicle
        items = self._vehicle.handle_message(message, at_ns)
        if address is None and self.vehicle is None:
            self._note_missing_heartbeat(message, at_ns)
        elif self.vehicle != address:
            self._streams.restart()
            self._origin_setup, self._parameters, self._vehicle_clock = (
                GlobalOriginSetup(),
                ParameterDownload(),
                ArrivalClock(),
            )
        if self._vehicle.boots != boots:
            self._streams.restart()
            self._origin_setup, self._parameters, self._vehicle_clock = (
                GlobalOriginSetup(),
                ParameterDownload(),
                ArrivalClock(),
            )
            text = "the vehicle has restarted"
            return (*items, self._make_event(at_ns, Severity.ERROR, EventCode.VEHICLE_REBOOT, text))
        if self._vehicle.not_ready_count != not_ready_count:
            self._streams.restart()  # streams that continue are received again before the next request
        if (message.system, message.component) == self.vehicle:
            self._streams.handle_message(message)
            self._origin_setup.handle_message(message)
            self._parameters.handle_message(message)
            match message:
                case Position(boot_ms=True, stamp_us=int(stamp_us)) | Attitude(stamp_us=stamp_us) if stamp_us:
                    self._vehicle_clock.measure_delay_ns(1000 * stamp_us, at_ns)
        return items

    def _note_missing_heartbeat(self, message: Message, at_ns: int) -> None:
        """Note a vehicle that sends its position or attitude, but no heartbeat."""
        if isinstance(message, Attitude) or (isinstance(message, Position) and message.boot_ms):
            self._no_heartbeat_address = (message.system, message.component)
            if self._no_heartbeat_since_ns is None:
                self._no_heartbeat_since_ns = at_ns

    def _handle_timesync(self, message: TimeSync, at_ns: int) -> None:
        if message.tc1_ns == 0:
            if at_ns - self._reply_window_ns >= ANSWER_WINDOW_NS:
                self._reply_window_ns = at_ns
                self._reply_counts.clear()
            is_from_vehicle = self.vehicle is not None and message.system == self.vehicle[0]
            if self._reply_counts[is_from_vehicle] >= MAX_ANSWERS:
                self._count_bad(TIMESYNC_FLOOD)
                return
            self._reply_counts[is_from_vehicle] += 1
            is_vehicle = self._uses_vehicle_time and (message.system, message.component) == self.vehicle
            time_ns = self._vehicle_time_ns(at_ns) if is_vehicle else at_ns
            if time_ns is not None:
                self._replies.append(self._encoder.encode_timesync(time_ns, message.ts1_ns))
        elif message.ts1_ns in self._open_requests_ns:  # else it answers another client
            self._has_answer = True
            self._positions.add_timesync_answer(
                (message.system, message.component), message.ts1_ns, message.tc1_ns, at_ns
            )

    def _count_bad(self, reason: str, count: int = 1) -> None:
        self._bad[reason] += count
        if reason == EventCode.SLOW_ANSWER:
            self._slow_count += count
        elif reason == EventCode.INERTIAL_STALE:  # reported once; then the used share is reported
            if self._bad[reason] == count:
                self._unreported[reason] += count
        elif reason not in _NOT_REPORTED:
            self._unreported[reason] += count

    def _make_event(self, at_ns: int, severity: Severity, code: EventCode, text: str, count: int = 1) -> Event:
        """Make an event of this connection."""
        return Event(
            at_ns=at_ns,
            severity=severity,
            code=code,
            text=f"link {self._name}: {text}",
            count=count,
            subject=self._name,
        )

    def _make_events(self, at_ns: int) -> tuple[Event, ...]:
        """Return events: dropped data once a second; new clocks, units and other findings once each."""
        events = []
        if self._positions.resyncs > self._reported_resyncs:
            self._reported_resyncs = self._positions.resyncs
            text = "a source's clock jumped, and is synchronised again"
            events.append(self._make_event(at_ns, Severity.WARNING, EventCode.CLOCK_RESYNC, text))
        for (system, component), unit in self._positions.units.items():
            if (system, component, unit) not in self._reported_units:
                self._reported_units.add((system, component, unit))
                fault = "do not advance" if unit is StampUnit.CONSTANT else f"are in {unit}, not in us"
                text = f"stamps of the positions of {system}/{component} {fault}: "
                text += "ages count from arrival"
                events.append(self._make_event(at_ns, Severity.WARNING, EventCode.STAMP_UNIT, text))
        since_ns = self._no_heartbeat_since_ns
        if (
            since_ns is not None
            and self.vehicle is None
            and not self._is_no_heartbeat_reported
            and at_ns - since_ns >= NO_HEARTBEAT_NS
        ):
            self._is_no_heartbeat_reported = True
            sender = self._no_heartbeat_address and self._no_heartbeat_address[0]
            text = f"system {sender} sends its position or attitude, "
            text += "but no heartbeat of an autopilot. Its mode is unknown, so the controller does not fly it"
            events.append(self._make_event(at_ns, Severity.WARNING, EventCode.NO_HEARTBEAT, text))
        used_count, total = self._vehicle.inertial_used, self._vehicle.inertial_total
        if not self._is_low_share_reported and total >= MIN_INERTIAL and used_count < MIN_INERTIAL_SHARE * total:
            self._is_low_share_reported = True
            text = f"{1 - used_count / total:.0%} of the IMU data are ignored: late, frozen, "
            text += "or without a current attitude"
            events.append(self._make_event(at_ns, Severity.WARNING, EventCode.INERTIAL_STALE, text, total - used_count))
        if self._slow_count and (self._slow_reported_ns is None or at_ns - self._slow_reported_ns >= SLOW_EVENT_NS):
            self._slow_reported_ns = at_ns
            events.append(self._make_slow_answer_event(at_ns))
            self._slow_count = 0
        if self._unreported and (self._reported_ns is None or at_ns - self._reported_ns >= SECOND_NS):
            self._reported_ns = at_ns
            events.extend(self._make_drop_events(at_ns))
            self._unreported.clear()
        return tuple(events)

    def _make_slow_answer_event(self, at_ns: int) -> Event:
        """Return the event about answers to TIMESYNC that were too slow; harmless while other answers are used."""
        known = self._positions.are_clocks_known(at_ns)
        text = "answers to TIMESYNC came too late, and are ignored; the clock " + (
            "is still known by others" if known else "is unknown"
        )
        severity = Severity.INFO if known else Severity.WARNING
        return self._make_event(at_ns, severity, EventCode.SLOW_ANSWER, text, self._slow_count)

    def _make_drop_events(self, at_ns: int) -> list[Event]:
        events = []
        vehicles = self._unreported.pop(EventCode.SECOND_VEHICLE, 0)
        if vehicles and self._vehicle.address is not None:
            text = f"another vehicle than system {self._vehicle.address[0]} is on this link; its messages are ignored"
            events.append(self._make_event(at_ns, Severity.ERROR, EventCode.SECOND_VEHICLE, text, vehicles))
        if self._unreported:
            text, count = _describe_drops(self._unreported), self._unreported.total()
            events.append(self._make_event(at_ns, Severity.WARNING, EventCode.DROPPED, text, count))
        return events


def _describe_drops(counts: Mapping[str, int]) -> str:
    """Describe ignored data: late messages by their content, all others by the codes of the manual."""
    texts = [
        f"{counts[code]} {noun}{'' if counts[code] == 1 else 's'}: too old"
        for code, noun in _STALE_NOUNS.items()
        if counts.get(code)
    ]
    others = ", ".join(f"{count} {reason}" for reason, count in sorted(counts.items()) if reason not in _STALE_NOUNS)
    return "ignored " + "; ".join([*texts, f"data: {others}"] if others else texts)


def make_links(
    config: Config, on_message: Callable[[Message, int], None] | None = None
) -> dict[str, MavlinkConnection]:
    """Make the connections' protocol states: one for both roles when the two URLs are the same.

    Args:
        on_message: Called with each decoded message of others, and its time [ns].
    """
    shared = config.daemon.vehicle == config.daemon.mocap
    names = {VEHICLE: (VEHICLE, MOCAP)} if shared else {VEHICLE: (VEHICLE,), MOCAP: (MOCAP,)}
    return {
        name: MavlinkConnection(
            name,
            roles=frozenset(roles),
            daemon=config.daemon,
            frame=config.frame,
            clock=config.clock,
            source=config.source,
            estimator=config.estimator,
            on_message=on_message,
            vehicle_time=config.relay.enabled and config.relay.vehicle_time,
        )
        for name, roles in names.items()
    }
