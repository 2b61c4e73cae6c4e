"""Position messages to samples: source filter, checks, frame, clock."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import get_args

from uavctl.config.peers import ClockConfig, FrameConfig, SourceConfig
from uavctl.config.types import EstimatorConfig
from uavctl.data import PositionSample, Vec3
from uavctl.frames import Convention, Frame, Quaternion
from uavctl.mavlink.clocksync import ClockSource, ClockSync, Refusal, RoundTrips
from uavctl.mavlink.encoder import BOOT_MS_WRAP
from uavctl.mavlink.messages import Position

MAX_SOURCES = 16

WRONG_SYSTEM = "system-id"
TOO_MANY_SOURCES = "sources"
ABSURD = "absurd"
SLOW_ANSWER = "timesync"

Address = tuple[int, int]


class PositionIntake:
    """Makes samples of the position messages of one connection.

    Args:
        frame: camera frame to local NED.
        clock: window, latency and tolerance of the sources' clocks.
        source: which messages and which system count.
        estimator: standard deviation of a sample, and what is absurd.
        bad: counter that refusals are added to.
    """

    def __init__(
        self,
        frame: FrameConfig,
        clock: ClockConfig,
        source: SourceConfig,
        estimator: EstimatorConfig,
        bad: Callable[[str], None],
    ) -> None:
        configured = Frame(frame.convention, frame.origin_m, frame.yaw_deg)
        # A message that declares its axes is believed; the vehicle's own estimate needs no conversion.
        self._frames: dict[Convention | None, Frame] = {None: configured}
        for axes in get_args(Convention):
            self._frames[axes] = replace(configured, convention=axes)
        self._clock, self._source, self._estimator, self._bad = clock, source, estimator, bad
        self._clocks: dict[tuple[Address, bool], ClockSync] = {}
        self._round_trips: dict[Address, RoundTrips] = {}
        self._latest: ClockSync | None = None
        self._latest_address: Address | None = None
        self.samples = 0
        self.resyncs = 0  # times that a source turned out to have a new clock
        self.attitude: Quaternion | None = None  # of the newest sample: body axes forward, right, down to NED

    @property
    def clock_offset_ns(self) -> int | None:
        """(our time − the source's time) of the newest sample's source."""
        return None if self._latest is None else self._latest.offset_ns

    @property
    def clock_source(self) -> ClockSource:
        """Where that offset comes from."""
        return ClockSource.NONE if self._latest is None else self._latest.source

    def trips(self, address: Address | None = None) -> RoundTrips | None:
        """Round trips to a peer that answers; without an address, to the newest sample's source."""
        wanted = self._latest_address if address is None else address
        return None if wanted is None else self._round_trips.get(wanted)

    def knows_clocks(self, at_ns: int) -> bool:
        """Whether every peer that answers has given an answer lately by which its clock is known."""
        return all(trips.offset_ns(at_ns) is not None for trips in self._round_trips.values())

    def answer(self, address: Address, sent_ns: int, remote_ns: int, received_ns: int) -> None:
        """Take an answer to a TIMESYNC request."""
        trips = self._round_trips.get(address)
        if trips is None:
            if len(self._round_trips) >= MAX_SOURCES:
                self._bad(TOO_MANY_SOURCES)
                return
            trips = self._round_trips[address] = RoundTrips(_ns(self._clock.window_s))
        if not trips.answer(sent_ns, remote_ns, received_ns):
            self._bad(SLOW_ANSWER)

    def take(self, message: Position, received_ns: int) -> PositionSample | None:
        """Make a sample of a message, or count why not; None also for messages that are not asked for."""
        if message.name not in self._source.messages:
            return None
        if self._source.system_id not in (0, message.system):
            self._bad(WRONG_SYSTEM)
            return None
        frame = self._frames[message.convention]
        position_m, velocity_mps = message.position_m, message.velocity_mps
        if not message.local_ned:
            position_m = frame.to_ned(position_m)
            velocity_mps = None if velocity_mps is None else frame.velocity_to_ned(velocity_mps)
        if self._absurd(position_m, velocity_mps):
            self._bad(ABSURD)
            return None
        captured = self._captured(message, received_ns)
        if isinstance(captured, str):
            self._bad(captured)
            return None
        self.samples += 1
        self.attitude = message.attitude and frame.attitude_to_ned(message.attitude, euler=message.euler)
        return PositionSample(
            captured_ns=captured,
            received_ns=received_ns,
            position_m=position_m,
            velocity_mps=velocity_mps,
            std_m=self._estimator.position_std_m,
            source=f"{message.name} {message.system}/{message.component}",
            seq=self.samples,
        )

    def _absurd(self, position_m: Vec3, velocity_mps: Vec3 | None) -> bool:
        far = max(map(abs, position_m)) > self._estimator.max_position_m
        return far or (velocity_mps is not None and max(map(abs, velocity_mps)) > self._estimator.max_velocity_mps)

    def _captured(self, message: Position, received_ns: int) -> int | Refusal | str:
        address = (message.system, message.component)
        clock = self._clocks.get((address, message.boot_ms))
        if clock is None:
            if len(self._clocks) >= MAX_SOURCES:
                return TOO_MANY_SOURCES
            clock = ClockSync(
                _ns(self._clock.window_s), _ns(self._clock.latency_s), _ns(self._clock.future_tolerance_s)
            )
            self._clocks[address, message.boot_ms] = clock
        stamp_ns: int | None = None
        if message.boot_ms and message.stamp_us is not None:
            stamp_ns = clock.unwrap(message.stamp_us // 1000, BOOT_MS_WRAP, 1_000_000)
        elif message.stamp_us is not None:
            stamp_ns = message.stamp_us * 1000
        trips, resyncs = self._round_trips.get(address), clock.resyncs
        captured = clock.captured_ns(stamp_ns, received_ns, None if trips is None else trips.offset_ns(received_ns))
        self.resyncs += clock.resyncs - resyncs
        if not isinstance(captured, str):
            self._latest, self._latest_address = clock, address
        return captured


def _ns(seconds: float) -> int:
    return math.floor(seconds * 1e9 + 0.5)
