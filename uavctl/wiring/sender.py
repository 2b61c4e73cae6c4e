"""Sender of the positions of several vehicles over one channel, sans IO: bytes and times in, frames out.

1. Decode the messages of each source once, and give each body to its vehicle, as its daemon does: axes, clock.
2. Keep the newest position of each vehicle; an older one is never sent.
3. Where the channel is free, the scheduler chooses a vehicle. Its position goes out as VISION_POSITION_ESTIMATE, in the
   axes of its `[frame]`. Its stamp is the time of capture in the sender's own clock.
4. Ask the sources for their time, and answer vehicles that ask for ours. So a stamp is right on both ways, however long
   the cameras and the channel take.
5. Take the reports of the vehicles (`source.report`): PINGs that repeat a stamp.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterator, Sequence
from typing import NamedTuple, Protocol

import msgspec
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from uavctl.arrays import SECOND_NS
from uavctl.config.connections import CAMERA_MESSAGE, CAMERA_SYSTEM_ID
from uavctl.config.types import Config
from uavctl.frames import Frame, euler_from_quaternion
from uavctl.io.shared_sources import ANY, SharedSource
from uavctl.mavlink.codec import StreamDecoder, decode
from uavctl.mavlink.connection import (
    FIRST_TIMESYNC_NS,
    MAX_FIRST_REQUESTS,
    MAX_OPEN_REQUESTS,
    STREAM_SCHEMES,
    TIMESYNC_NS,
)
from uavctl.mavlink.encoder import Encoder
from uavctl.mavlink.framing import scan_frames
from uavctl.mavlink.message_layout import MessageLayout
from uavctl.mavlink.messages import Message, Position, TimeSync
from uavctl.mavlink.positions import PositionDecoder
from uavctl.records import PositionSample, Vec3
from uavctl.schedule.channel import SIGNATURE_BYTES, BudgetedChannel
from uavctl.wiring.radio import (
    PlacedSchedule,
    RadioConfig,
    build_schedule_parameters,
    compute_answer_period_ns,
    make_budget,
)

COMPONENT_ID = mavlink.MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY
WEIGHT_PERIOD_NS = SECOND_NS // 10  # between two updates of the weights: a vehicle moves 15 cm at 1.5 m/s
MAX_OPEN_STAMPS = 100  # stamps sent to a vehicle that it may still report
UNUSED = "without-position"  # messages of a source that are no accepted positions
SILENCE_NS = SECOND_NS  # without a new position of a vehicle; then a message says so
MAX_REQUEST_AGE_NS = SECOND_NS // 2  # a time request that waited for longer is not answered
_PING = MessageLayout(mavlink.MAVLink_ping_message)
_TIMESYNC = MessageLayout(mavlink.MAVLink_timesync_message)


class PositionMessage(NamedTuple):
    """Message with a position, as it was sent."""

    vehicle: int  # number of its vehicle
    captured_ns: int  # time of capture [ns]
    frame: bytes
    wire_bytes: int  # its length on the channel
    ages_s: tuple[float, ...]  # believed age of each vehicle's newest position before it [s]


class SentAnswer(NamedTuple):
    """An answer to a vehicle that asked for our time."""

    vehicle: int
    frame: bytes


class ScheduleWatch(Protocol):
    """Interface of a recording of what the choices of a sender come from; times are monotonic [ns]."""

    def add_position(self, at_ns: int, vehicle: int, captured_ns: int, position_m: Vec3) -> None:
        """Add a position that may be sent."""
        ...

    def add_report(self, at_ns: int, vehicle: int, captured_ns: int) -> None:
        """Add a report of a vehicle."""
        ...

    def add_weights(self, at_ns: int, weights: Sequence[float]) -> None:
        """Add the weights from now on."""
        ...


class _Source:
    """One connection to cameras: decoder of its bytes, and the requests for its time."""

    def __init__(self, shared: SharedSource) -> None:
        is_stream = not shared.is_camera and shared.url.startswith(STREAM_SCHEMES)
        self.stream = StreamDecoder() if is_stream else None
        self._addresses = shared.addresses
        self._encoder = Encoder(CAMERA_SYSTEM_ID, COMPONENT_ID)
        self._requests_ns: deque[int] = deque(maxlen=MAX_OPEN_REQUESTS)
        self._request_count, self._has_answer = 0, False

    def find_vehicles(self, message: Message) -> Iterator[int]:
        """Yield the numbers of the vehicles that a message is for."""
        for number, (system, component) in self._addresses.items():
            if system in (ANY, message.system) and component in (ANY, message.component):
                yield number

    def is_answer(self, message: TimeSync) -> bool:
        """Return whether a message answers a request of ours."""
        is_ours = message.tc1_ns != 0 and message.ts1_ns in self._requests_ns
        self._has_answer |= is_ours
        return is_ours

    def make_time_request(self, at_ns: int) -> bytes | None:
        """Return a request for the source's time; None while none is due."""
        is_first_phase = not self._has_answer and self._request_count < MAX_FIRST_REQUESTS
        interval_ns = FIRST_TIMESYNC_NS if is_first_phase else TIMESYNC_NS
        if self._requests_ns and at_ns - self._requests_ns[-1] < interval_ns:
            return None
        self._requests_ns.append(at_ns)
        self._request_count += 1
        return self._encoder.encode_timesync(0, at_ns)


class _Target:
    """One vehicle: decoder of its body, encoder to it, and its newest position."""

    def __init__(self, config: Config, start_ns: int, refused: Counter[str], *, is_camera: bool) -> None:
        def count(reason: str) -> None:
            refused[reason] += 1

        # `[source]` is what the daemon takes; it hears the sender, not the cameras.
        messages = (CAMERA_MESSAGE,) if is_camera else config.source.messages
        source = msgspec.structs.replace(config.source, system_id=ANY, messages=messages)
        self.frame = Frame(config.frame.convention, config.frame.origin_m, config.frame.yaw_deg)
        self.decoder = PositionDecoder(config.frame, config.clock, source, config.estimator, count)
        self.encoder = Encoder(CAMERA_SYSTEM_ID, COMPONENT_ID)
        self.received_ns = start_ns  # of the newest one
        self.next_frame: tuple[Vec3, Vec3] = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))  # position, angles
        self.source_stamp_us = 0  # stamp of the newest one, in its source's clock
        self.captured_ns_by_stamp: dict[int, int] = {}  # of positions sent
        self.request: tuple[int, int] | None = None  # newest time request: its own time, and its arrival [ns]
        self.answered_ns = start_ns
        self._max_position_m = config.estimator.max_position_m

    def is_plausible(self, sample: PositionSample) -> bool:
        """Return whether the vehicle would not refuse a position as absurd."""
        return max(map(abs, sample.position_m)) <= self._max_position_m


class PositionSender:
    """Sender of all vehicles of a fleet.

    Attributes:
        refused: Counts of positions that were not used, by reason.
        parameters: Constants of the schedule.
        watch: Gets what the choices come from; None: no receiver.

    Args:
        configs: Configuration of each vehicle.
        sources: Connections that give their positions.
        spacing_m: Smallest distance of two vehicles [m].
        start_ns: Time of the start [ns].
        keeps_stamps: Whether positions keep the stamps of their source, whom the vehicles then ask for its time.

    Raises:
        DesignError: A plant is not valid, or the longest wait has no slot for each vehicle.
    """

    def __init__(
        self,
        configs: Sequence[Config],
        sources: Sequence[SharedSource],
        radio: RadioConfig,
        *,
        spacing_m: float,
        start_ns: int,
        keeps_stamps: bool = False,
    ) -> None:
        self._keeps_stamps = keeps_stamps
        self.watch: ScheduleWatch | None = None
        self.refused: Counter[str] = Counter()
        self.sent = Counter[int]()
        self._sources = [_Source(source) for source in sources]
        is_camera = {number: source.is_camera for source in sources for number in source.addresses}
        self._targets = [
            _Target(config, start_ns, self.refused, is_camera=is_camera[number])
            for number, config in enumerate(configs)
        ]
        self._signature_bytes = SIGNATURE_BYTES if radio.signed else 0
        self._answer_period_ns, self._answered_ns = compute_answer_period_ns(radio, len(configs)), start_ns
        self._weighted_ns = start_ns
        self._channel = BudgetedChannel(make_budget(radio))
        self.parameters = build_schedule_parameters(configs, radio)
        self._schedule = PlacedSchedule(self.parameters, spacing_m, start_ns)
        self._scheduler = self._schedule.scheduler

    def make_time_request(self, source: int, at_ns: int) -> bytes | None:
        """Return a request for the time of a source; None while none is due."""
        return self._sources[source].make_time_request(at_ns)

    def receive_positions(self, source: int, data: bytes, at_ns: int) -> bool:
        """Handle data of a source; return whether its sender gives positions for some time. Never raises."""
        stream = self._sources[source].stream
        decoded = decode(data) if stream is None else stream.push(data)
        self.refused.update({str(reason): count for reason, count in decoded.bad.items()})
        is_settled = False
        for message in decoded.messages:
            if isinstance(message, Position):
                numbers = list(self._sources[source].find_vehicles(message))
                for number in numbers:
                    is_settled |= self._add_position(number, message, at_ns)
                if not numbers:
                    self.refused[UNUSED] += 1
            elif isinstance(message, TimeSync) and self._sources[source].is_answer(message):
                for number in self._sources[source].find_vehicles(message):
                    address = message.system, message.component
                    decoder = self._targets[number].decoder
                    decoder.add_timesync_answer(address, message.ts1_ns, message.tc1_ns, at_ns)
        return is_settled

    def _add_position(self, number: int, message: Position, at_ns: int) -> bool:
        """Take a position of a vehicle; return whether its source is settled."""
        target = self._targets[number]
        sample = target.decoder.make_sample(message, at_ns)
        if sample is None or not target.is_plausible(sample):
            self.refused[UNUSED] += 1
        elif self._schedule.add_position(number, sample.captured_ns, sample.position_m):
            if self.watch is not None:
                self.watch.add_position(at_ns, number, sample.captured_ns, sample.position_m)
            attitude = target.decoder.attitude
            rotation = None if attitude is None else target.frame.attitude_from_ned(attitude, euler=True)
            angles = (0.0, 0.0, 0.0) if rotation is None else euler_from_quaternion(rotation)
            target.received_ns = at_ns
            target.source_stamp_us = message.stamp_us or 0
            target.next_frame = target.frame.from_ned(sample.position_m), angles
        return target.decoder.is_settled

    def find_silent(self, at_ns: int) -> set[int]:
        """Return the numbers of the vehicles without a new position for `SILENCE_NS`."""
        return {number for number, target in enumerate(self._targets) if at_ns - target.received_ns > SILENCE_NS}

    def receive_reports(self, number: int, data: bytes, at_ns: int) -> None:
        """Handle data of a vehicle's daemon: reports of its newest position, time requests; never raises."""
        target = self._targets[number]
        for frame in scan_frames(data, final=True).frames:
            if frame.message_id == mavlink.MAVLINK_MSG_ID_TIMESYNC and not self._keeps_stamps:
                request = _TIMESYNC.unpack(frame.data)
                if request.tc1 == 0 and request.ts1 > 0:
                    target.request = request.ts1, at_ns
            elif frame.message_id == mavlink.MAVLINK_MSG_ID_PING:
                ping = _PING.unpack(frame.data)
                captured_ns = target.captured_ns_by_stamp.get(ping.time_usec)
                if (ping.target_system, ping.target_component) == (CAMERA_SYSTEM_ID, COMPONENT_ID) and captured_ns:
                    self._scheduler.add_feedback(number, captured_ns, at_ns)
                    if self.watch is not None:
                        self.watch.add_report(at_ns, number, captured_ns)

    def compute_remaining_ns(self, at_ns: int) -> int:
        """Return the time until the channel is free [ns]."""
        return self._channel.compute_remaining_ns(at_ns)

    def send_next(self, at_ns: int) -> PositionMessage | SentAnswer | None:
        """Return what goes out now; None if the channel is occupied, or there is nothing to send."""
        if not self._channel.is_free(at_ns):
            return None
        answer = self._answer_request(at_ns)
        if answer is not None:
            self._channel.occupy(at_ns, len(answer.frame) + self._signature_bytes)
            return answer
        if at_ns - self._weighted_ns >= WEIGHT_PERIOD_NS:
            self._weighted_ns = at_ns
            self._schedule.update_placed_weights()
            if self.watch is not None:
                self.watch.add_weights(at_ns, self._schedule.weights)
        number = self._scheduler.choose(at_ns)
        if number is None:
            return None
        target, captured_ns = self._targets[number], self._scheduler.vehicles[number].sent_ns
        assert captured_ns is not None
        # 0 means that there is none
        stamp_us = target.source_stamp_us if self._keeps_stamps else max(captured_ns // 1000, 1)
        frame = target.encoder.encode_position(stamp_us, *target.next_frame)
        if len(target.captured_ns_by_stamp) >= MAX_OPEN_STAMPS:
            del target.captured_ns_by_stamp[next(iter(target.captured_ns_by_stamp))]
        target.captured_ns_by_stamp[stamp_us] = captured_ns
        wire_bytes = len(frame) + self._signature_bytes
        self._channel.occupy(at_ns, wire_bytes)
        self.sent[number] += 1
        return PositionMessage(number, captured_ns, frame, wire_bytes, tuple(self._scheduler.ages_s))

    def _answer_request(self, at_ns: int) -> SentAnswer | None:
        """Return an answer to the vehicle that has waited longest for one; None while none may go out.

        Our time in it is the middle between the request's arrival and now, so that the middle of the round trip is
        right however long the request waited for the channel.
        """
        if at_ns - self._answered_ns < self._answer_period_ns:
            return None
        waiting = [
            (target.answered_ns, number)
            for number, target in enumerate(self._targets)
            if target.request is not None and at_ns - target.request[1] <= MAX_REQUEST_AGE_NS
        ]
        if not waiting:
            return None
        number = min(waiting)[1]
        target = self._targets[number]
        assert target.request is not None
        token, received_ns = target.request
        target.request, target.answered_ns, self._answered_ns = None, at_ns, at_ns
        return SentAnswer(number, target.encoder.encode_timesync((received_ns + at_ns) // 2, token))
