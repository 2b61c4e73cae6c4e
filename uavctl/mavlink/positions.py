"""Position messages to position samples: source filter, plausibility, frame and clock.

1. Ignore messages and systems that the configuration does not name.
2. Convert the position to local NED.
3. Limit the rate of new sources. Settled sources are never limited.
4. Convert the stamp to our clock (`clocksync`). If the stamp is not usable, drop the sample and count the reason.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Generic, TypeVar, get_args

from uavctl.config.connections import ClockConfig, FrameConfig, SourceConfig
from uavctl.config.types import EstimatorConfig
from uavctl.event_codes import EventCode
from uavctl.frames import Convention, Frame, Quaternion
from uavctl.mavlink.clocksync import ClockSource, ClockSync, StampRefusal, StampUnit, StampUnitDetector, TimesyncClock
from uavctl.mavlink.encoder import BOOT_MS_WRAP
from uavctl.mavlink.messages import Position
from uavctl.records import PositionSample, Vec3

MAX_SOURCES = 32
SILENCE_NS = 10_000_000_000  # after which any other source may replace one
SETTLED_SAMPLES = 20  # samples after which a source is settled
# Samples of all new sources together: without a settled source that is active, and beside one. Each sample costs the
# estimator time, and a new source may be hostile.
NEW_SOURCE_PER_S, NEW_SOURCE_BESIDE_PER_S = 100, 10
NEW_SOURCE_BURST = 50
SOURCE_ACTIVE_NS = 1_000_000_000

WRONG_SYSTEM = "system-id"
NEW_SOURCE = "new-source"  # more samples of new sources than the limit
TOO_MANY_SOURCES = "sources"  # more than `MAX_SOURCES`: the state of one is lost
IMPLAUSIBLE = "absurd"

Address = tuple[int, int]


Key = TypeVar("Key")
State = TypeVar("State")


class SourceTable(Generic[Key, State]):
    """Table of states by source. A new source replaces the one with the fewest messages.

    So other sources cannot keep one out, and a settled source keeps its state.

    Args:
        count_bad: called when an active source is removed.
    """

    def __init__(self, max_sources: int, count_bad: Callable[[], None]) -> None:
        self._max_sources, self._on_eviction = max_sources, count_bad
        self._entries: dict[Key, tuple[State, int, int]] = {}  # state, number of messages, time of the last one

    def __len__(self) -> int:
        return len(self._entries)

    def get(self, key: Key) -> State | None:
        """Return the state of a source; None if it is not in the table."""
        entry = self._entries.get(key)
        return None if entry is None else entry[0]

    def message_count(self, key: Key) -> int:
        """Return the number of messages of a source; 0 if it is not in the table."""
        entry = self._entries.get(key)
        return 0 if entry is None else entry[1]

    def values(self) -> Iterator[State]:
        """Iterate over the states of all sources."""
        return (state for state, _, _ in self._entries.values())

    def record_message(self, key: Key, at_ns: int, make_state: Callable[[], State]) -> State:
        """Count a message of a source and return its state; `make_state` makes that of a new source."""
        entry = self._entries.get(key)
        if entry is None and len(self._entries) >= self._max_sources:
            self._evict(at_ns)
        state, count = (make_state(), 0) if entry is None else entry[:2]
        self._entries[key] = state, count + 1, at_ns
        return state

    def _evict(self, at_ns: int) -> None:
        def weight(key: Key) -> tuple[int, int]:
            _, count, last_ns = self._entries[key]
            return (count if at_ns - last_ns <= SILENCE_NS else 0), last_ns

        oldest = min(self._entries, key=weight)
        if weight(oldest)[0]:
            self._on_eviction()
        del self._entries[oldest]


class PositionDecoder:
    """Makes samples of the position messages of one connection.

    Args:
        clock: window, latency and tolerance of the sources' clocks.
        source: accepted messages and system.
        estimator: standard deviation of a sample, and the limits of plausible ones.
        count_bad: counts refusals, by reason.
    """

    def __init__(
        self,
        frame: FrameConfig,
        clock: ClockConfig,
        source: SourceConfig,
        estimator: EstimatorConfig,
        count_bad: Callable[[str], None],
    ) -> None:
        frame_config = Frame(frame.convention, frame.origin_m, frame.yaw_deg)
        # The axes that a message declares count. The vehicle's own estimate needs no conversion.
        self._frames: dict[Convention | None, Frame] = {None: frame_config}
        for axes in get_args(Convention):
            self._frames[axes] = replace(frame_config, convention=axes)
        self._clock, self._source, self._estimator, self._count_bad = clock, source, estimator, count_bad
        self._clocks: SourceTable[tuple[Address, bool], ClockSync] = SourceTable(MAX_SOURCES, self._count_eviction)
        self._units: SourceTable[Address, StampUnitDetector] = SourceTable(MAX_SOURCES, self._count_eviction)
        self.units: dict[Address, StampUnit] = {}  # of sources with stamps that are not in microseconds
        self._timesync_clocks: SourceTable[Address, TimesyncClock] = SourceTable(MAX_SOURCES, self._count_eviction)
        self._new_source_budget, self._new_source_budget_ns = float(NEW_SOURCE_BURST), 0
        self._settled_ns: int | None = None  # last sample of a settled source
        self.is_settled = False  # whether the source of the newest sample is settled
        self._latest: ClockSync | None = None
        self._latest_address: Address | None = None
        self.samples = 0
        self.resyncs = 0  # number of new clocks of sources
        self.attitude: Quaternion | None = None  # of the newest sample: body axes forward, right, down to NED

    @property
    def clock_offset_ns(self) -> int | None:
        """(our time − the source's time) of the newest sample's source."""
        return None if self._latest is None else self._latest.offset_ns

    @property
    def clock_source(self) -> ClockSource:
        """Source of that offset."""
        return ClockSource.NONE if self._latest is None else self._latest.source

    def timesync_clock(self, address: Address | None = None) -> TimesyncClock | None:
        """Return the clock of a peer that answers TIMESYNC; without an address, of the newest sample's source."""
        address = self._latest_address if address is None else address
        return None if address is None else self._timesync_clocks.get(address)

    def are_clocks_known(self, at_ns: int) -> bool:
        """Return whether the clock of every peer that answers is known now."""
        return all(timesync.offset_ns(at_ns) is not None for timesync in self._timesync_clocks.values())

    def add_timesync_answer(self, address: Address, sent_ns: int, remote_ns: int, received_ns: int) -> None:
        """Add an answer to a TIMESYNC request."""
        timesync = self._timesync_clocks.record_message(
            address, received_ns, lambda: TimesyncClock(_ns(self._clock.window_s))
        )
        if not timesync.add_answer(sent_ns, remote_ns, received_ns):
            self._count_bad(EventCode.SLOW_ANSWER)

    def make_sample(self, message: Position, received_ns: int) -> PositionSample | None:
        """Make a sample of a message, or count the reason why not; None also for messages that are not configured."""
        if message.name not in self._source.messages:
            return None
        if self._source.system_id not in (0, message.system):
            self._count_bad(WRONG_SYSTEM)
            return None
        frame = self._frames[message.convention]
        position_m, velocity_mps = message.position_m, message.velocity_mps
        if not message.local_ned:
            position_m = frame.to_ned(position_m)
            velocity_mps = None if velocity_mps is None else frame.velocity_to_ned(velocity_mps)
        if self._is_implausible(position_m, velocity_mps):
            # The controller refuses it too, and measures how long a source sends nothing else.
            self._count_bad(IMPLAUSIBLE)
        if not self._is_within_budget(message, received_ns):
            self._count_bad(NEW_SOURCE)
            return None
        captured = self._estimate_capture_ns(message, received_ns)
        if isinstance(captured, str):
            self._count_bad(captured)
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

    def _is_implausible(self, position_m: Vec3, velocity_mps: Vec3 | None) -> bool:
        is_far = max(map(abs, position_m)) > self._estimator.max_position_m
        return is_far or (velocity_mps is not None and max(map(abs, velocity_mps)) > self._estimator.max_velocity_mps)

    def _is_within_budget(self, message: Position, received_ns: int) -> bool:
        """Return whether to use one more sample; those of a settled source always pass."""
        self.is_settled = self._clocks.message_count(_find_key(message)) >= SETTLED_SAMPLES
        if self.is_settled:
            self._settled_ns = received_ns
            return True
        is_beside_settled = self._settled_ns is not None and received_ns - self._settled_ns <= SOURCE_ACTIVE_NS
        per_s = NEW_SOURCE_BESIDE_PER_S if is_beside_settled else NEW_SOURCE_PER_S
        refill = (received_ns - self._new_source_budget_ns) * 1e-9 * per_s
        burst = NEW_SOURCE_BESIDE_PER_S if is_beside_settled else NEW_SOURCE_BURST
        self._new_source_budget, self._new_source_budget_ns = min(burst, self._new_source_budget + refill), received_ns
        if self._new_source_budget < 1.0:
            return False
        self._new_source_budget -= 1.0
        return True

    def _count_eviction(self) -> None:
        self._count_bad(TOO_MANY_SOURCES)

    def _estimate_capture_ns(self, message: Position, received_ns: int) -> int | StampRefusal:
        address = (message.system, message.component)
        clock = self._clocks.record_message(_find_key(message), received_ns, lambda: make_clock(self._clock))
        stamp_ns: int | None = None
        if message.boot_ms and message.stamp_us is not None:
            stamp_ns = clock.unwrap_ns(message.stamp_us // 1000, BOOT_MS_WRAP, 1_000_000)
        elif message.stamp_us is not None and self._is_stamp_in_us(message, message.stamp_us, received_ns):
            stamp_ns = message.stamp_us * 1000
        timesync, resyncs = self._timesync_clocks.get(address), clock.resyncs
        captured = clock.estimate_capture_ns(
            stamp_ns, received_ns, None if timesync is None else timesync.offset_ns(received_ns)
        )
        self.resyncs += clock.resyncs - resyncs
        if not isinstance(captured, str):
            self._latest, self._latest_address = clock, address
        return captured

    def _is_stamp_in_us(self, message: Position, stamp: int, received_ns: int) -> bool:
        """Return whether a stamp is in microseconds; otherwise the position counts by its arrival."""
        address = (message.system, message.component)
        detector = self._units.record_message(address, received_ns, StampUnitDetector)
        before, unit = detector.unit, detector.update(stamp, message.position_m, received_ns)
        if unit is not before:
            self.units.pop(address, None)
            if unit is not StampUnit.MICROSECONDS and len(self.units) < MAX_SOURCES:
                self.units[address] = unit
        return unit is StampUnit.MICROSECONDS


def make_clock(config: ClockConfig) -> ClockSync:
    """Make the clock of a source."""
    return ClockSync(_ns(config.window_s), _ns(config.latency_s), _ns(config.future_tolerance_s))


def _find_key(message: Position) -> tuple[Address, bool]:
    """Return the key of the clock that stamps a message: sender, and kind of stamp."""
    return (message.system, message.component), message.boot_ms


def _ns(seconds: float) -> int:
    return math.floor(seconds * 1e9 + 0.5)
