"""Sender of the positions of several vehicles over one channel, sans IO: bytes and times in, frames out.

1. Decode the messages of each vehicle's source, as its daemon does: accepted messages, axes, clock.
2. Keep the newest position of each vehicle; an older one is never sent.
3. Where the channel is free, the scheduler chooses a vehicle. Its position goes out as VISION_POSITION_ESTIMATE, in the
   axes of its `[frame]` and with the stamp of its source.
4. Take the reports of the vehicles (`source.report`): PINGs that repeat a stamp.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from uavctl.arrays import SECOND_NS
from uavctl.config.checks import get_position_limits_m
from uavctl.config.connections import CAMERA_SYSTEM_ID
from uavctl.config.types import Config
from uavctl.frames import Frame, euler_from_quaternion
from uavctl.mavlink.codec import StreamDecoder, decode
from uavctl.mavlink.connection import STREAM_SCHEMES
from uavctl.mavlink.encoder import Encoder
from uavctl.mavlink.framing import scan_frames
from uavctl.mavlink.message_layout import MessageLayout
from uavctl.mavlink.messages import Position
from uavctl.mavlink.positions import PositionDecoder
from uavctl.records import PositionSample, Vec3
from uavctl.schedule.channel import BudgetedChannel
from uavctl.schedule.scheduler import Scheduler
from uavctl.schedule.value import compute_weight
from uavctl.wiring.radio import (
    RadioConfig,
    build_message_values,
    compute_max_wait_slots,
    compute_quantile,
    compute_slot_ns,
    make_budget,
)

COMPONENT_ID = mavlink.MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY
WEIGHT_PERIOD_NS = SECOND_NS // 10  # between two updates of the weights: a vehicle moves 15 cm at 1.5 m/s
MAX_OPEN_STAMPS = 100  # stamps sent to a vehicle that it may still report
UNUSED = "without-position"  # messages of a source that are no accepted positions
_PING = MessageLayout(mavlink.MAVLink_ping_message)


class SentPosition(NamedTuple):
    """A position on its way."""

    vehicle: int  # number of its vehicle
    captured_ns: int  # time of capture [ns]
    frame: bytes
    ages_s: tuple[float, ...]  # believed age of each vehicle's newest position before it [s]


class _Target:
    """One vehicle: decoder of its source, encoder to it, and its newest position."""

    def __init__(self, config: Config, source_url: str, refused: Counter[str]) -> None:
        def count(reason: str) -> None:
            refused[reason] += 1

        self.frame = Frame(config.frame.convention, config.frame.origin_m, config.frame.yaw_deg)
        self.stream = StreamDecoder() if source_url.startswith(STREAM_SCHEMES) else None
        self.decoder = PositionDecoder(config.frame, config.clock, config.source, config.estimator, count)
        self.encoder = Encoder(CAMERA_SYSTEM_ID, COMPONENT_ID)
        self.position_m: Vec3 | None = None  # newest one, local NED
        self.next_frame = (0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))  # stamp [us], position, angles
        self.captured_ns_by_stamp: dict[int, int] = {}  # of positions sent
        limits = get_position_limits_m(config).values()
        self._max_position_m = config.estimator.max_position_m
        self.lower_m, self.upper_m = (np.array(side) for side in zip(*limits, strict=True))

    def is_plausible(self, sample: PositionSample) -> bool:
        """Return whether the vehicle would not refuse a position as absurd."""
        return max(map(abs, sample.position_m)) <= self._max_position_m


class PositionSender:
    """Sender of all vehicles of a fleet.

    Attributes:
        refused: Counts of positions that were not used, by reason.

    Args:
        configs: Configuration of each vehicle.
        source_urls: Source of each vehicle's positions.
        spacing_m: Smallest distance of two vehicles [m].
        start_ns: Time of the start [ns].

    Raises:
        DesignError: A plant is not valid, or the longest wait has no slot for each vehicle.
    """

    def __init__(
        self,
        configs: Sequence[Config],
        source_urls: Sequence[str],
        radio: RadioConfig,
        *,
        spacing_m: float,
        start_ns: int,
    ) -> None:
        self.refused: Counter[str] = Counter()
        self.sent = Counter[int]()
        self._targets = [_Target(config, url, self.refused) for config, url in zip(configs, source_urls, strict=True)]
        self._spacing_m, self._weighted_ns = spacing_m, start_ns
        slot_ns, max_wait_slots = compute_slot_ns(radio), compute_max_wait_slots(radio, len(configs))
        values, stds_m = zip(*(build_message_values(config, radio) for config in configs), strict=True)
        self._wait_stds_m = [float(stds[min(max_wait_slots, len(stds) - 1)]) for stds in stds_m]
        self._quantiles = [compute_quantile(config) for config in configs]
        self._channel = BudgetedChannel(make_budget(radio))
        self._scheduler = Scheduler(
            radio.schedule,
            np.array(values),
            slot_ns=slot_ns,
            max_wait_slots=max_wait_slots,
            loss=radio.loss,
            feedback_delay_ns=round(radio.feedback_s * SECOND_NS),
            start_ns=start_ns,
        )

    def receive_positions(self, number: int, data: bytes, at_ns: int) -> None:
        """Handle data of a vehicle's source; never raises."""
        target = self._targets[number]
        decoded = decode(data) if target.stream is None else target.stream.push(data)
        self.refused.update({str(reason): count for reason, count in decoded.bad.items()})
        for message in decoded.messages:
            sample = target.decoder.make_sample(message, at_ns) if isinstance(message, Position) else None
            if sample is None or not isinstance(message, Position) or not target.is_plausible(sample):
                self.refused[UNUSED] += 1
                continue
            if self._scheduler.add_position(number, sample.captured_ns):
                attitude = target.decoder.attitude
                rotation = None if attitude is None else target.frame.attitude_from_ned(attitude, euler=True)
                angles = (0.0, 0.0, 0.0) if rotation is None else euler_from_quaternion(rotation)
                target.position_m = sample.position_m
                target.next_frame = message.stamp_us or 0, target.frame.from_ned(sample.position_m), angles

    def receive_reports(self, number: int, data: bytes, at_ns: int) -> None:
        """Handle data of a vehicle's daemon: reports of its newest position; never raises."""
        for frame in scan_frames(data, final=True).frames:
            if frame.message_id != mavlink.MAVLINK_MSG_ID_PING:
                continue
            ping = _PING.unpack(frame.data)
            captured_ns = self._targets[number].captured_ns_by_stamp.get(ping.time_usec)
            if (ping.target_system, ping.target_component) == (CAMERA_SYSTEM_ID, COMPONENT_ID) and captured_ns:
                self._scheduler.add_feedback(number, captured_ns, at_ns)

    def compute_remaining_ns(self, at_ns: int) -> int:
        """Return the time until the channel is free [ns]."""
        return self._channel.compute_remaining_ns(at_ns)

    def send_next(self, at_ns: int) -> SentPosition | None:
        """Return the position that goes out now; None if the channel is occupied or no vehicle has a new one."""
        if not self._channel.is_free(at_ns):
            return None
        if at_ns - self._weighted_ns >= WEIGHT_PERIOD_NS:
            self._weighted_ns = at_ns
            self._update_weights()
        number = self._scheduler.choose(at_ns)
        if number is None:
            return None
        target, captured_ns = self._targets[number], self._scheduler.vehicles[number].sent_ns
        assert captured_ns is not None
        stamp_us, position_m, angles_rad = target.next_frame
        frame = target.encoder.encode_position(stamp_us, position_m, angles_rad)
        if len(target.captured_ns_by_stamp) >= MAX_OPEN_STAMPS:
            del target.captured_ns_by_stamp[next(iter(target.captured_ns_by_stamp))]
        target.captured_ns_by_stamp[stamp_us] = captured_ns
        self._channel.occupy(at_ns, len(frame))
        self.sent[number] += 1
        return SentPosition(number, captured_ns, frame, tuple(self._scheduler.ages_s))

    def _update_weights(self) -> None:
        """Set w_i by the distance to the nearest limit, and half of the free distance to another vehicle."""
        positions_m = np.array([target.position_m or (np.inf,) * 3 for target in self._targets])
        known = np.flatnonzero(np.isfinite(positions_m[:, 0]))
        horizontal_m = positions_m[known, :2]
        # Height does not count, as in the vehicles' limits.
        gaps_m = np.linalg.norm(horizontal_m[:, None] - horizontal_m[None, :], axis=2) - self._spacing_m
        np.fill_diagonal(gaps_m, np.inf)
        half_gaps_m = 0.5 * gaps_m.min(axis=1, initial=np.inf)
        for i, half_gap_m in zip(known.tolist(), half_gaps_m.tolist(), strict=True):
            target = self._targets[i]
            columns = positions_m[i, : len(target.lower_m)]
            wall_m = min((columns - target.lower_m).min(), (target.upper_m - columns).min())
            weight = compute_weight(min(float(wall_m), half_gap_m), self._wait_stds_m[i], self._quantiles[i])
            self._scheduler.vehicles[i].weight = weight
