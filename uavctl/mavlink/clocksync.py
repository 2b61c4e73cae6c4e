"""Time stamps of a source to our monotonic clock. Pure; time is an argument.

1. If the source answers TIMESYNC, the middle of a round trip gives the offset: (t_sent + t_received)/2 − t_remote.
2. `TimesyncClock` fits a robust line through the last offsets, because simulated clocks drift by up to 3 %.
3. Otherwise the minimum of (received − stamp) gives the offset plus the smallest delay; `latency` is subtracted.
4. `ClockSync` refuses stamps that its clock cannot have given. After a few that agree, it starts a new clock.
"""

from __future__ import annotations

from collections import deque
from enum import StrEnum
from itertools import combinations
from statistics import median, median_low

from uavctl.arrays import SECOND_NS
from uavctl.records import Vec3

MAX_ROUND_TRIP_NS = SECOND_NS  # a longer round trip gives no useful bound
ROUND_TRIP_MARGIN_NS = 10_000_000  # more than the shortest: as good as the shortest
# Largest change of a drift. Real clocks keep 1e-4; this value follows a simulator on a busy computer.
DRIFT_CHANGE = 2e-3
MAX_DEVIATION_NS = 100_000_000
RESYNC_AFTER = 5  # deviating values in a row that show a new clock
MAX_CLOCK_STEP_NS = SECOND_NS
MIN_SAMPLES = 20  # samples before the minimum may refuse a stamp
MAX_DELAY_SPREAD_NS = 200_000_000  # spread of the delays of one new clock
STAMP_HISTORY = 64
FIT_POINTS = 5  # round trips of a line: few, because the drift of a busy computer's clock changes
MIN_FIT_POINTS = 3
MIN_FIT_SPAN_NS = 2_000_000_000  # from first to last: a shorter span shows no drift
MAX_DRIFT = 0.05  # recorded: up to 0.034
ROUND_TRIP_HISTORY = 60


class StampRefusal(StrEnum):
    """Reason why a stamp gives no time of capture."""

    FUTURE = "future-stamp"
    LEAP = "stamp-leap"
    DUPLICATE = "duplicate"


class ClockSource(StrEnum):
    """Source of a clock offset."""

    TIMESYNC = "timesync"
    MINIMUM = "minimum"
    NONE = "none"


class StampUnit(StrEnum):
    """Unit of a source's stamps; MAVLink requires microseconds."""

    MICROSECONDS = "us"
    MILLISECONDS = "ms"
    NANOSECONDS = "ns"
    SECONDS = "s"
    CONSTANT = "constant"  # they do not advance


_UNITS_PER_SECOND = {
    StampUnit.SECONDS: 1.0,
    StampUnit.MILLISECONDS: 1e3,
    StampUnit.MICROSECONDS: 1e6,
    StampUnit.NANOSECONDS: 1e9,
}
UNIT_WINDOW_NS = 1_500_000_000  # comparison of stamps with our clock: stamps in s advance within it


class StampUnitDetector:
    """Detects the unit of a source's stamps from their rate against our clock.

    Attributes:
        unit: the detected unit; microseconds before a detection.
    """

    def __init__(self) -> None:
        self.unit = StampUnit.MICROSECONDS
        self._reference: tuple[int, int, Vec3] | None = None  # stamp, arrival, position

    def update(self, stamp: int, position_m: Vec3, at_ns: int) -> StampUnit:
        """Add a stamp and its position; return the unit.

        The same stamp with the same position is a repeated message and does not show the unit.
        """
        if self._reference is None:
            self._reference = stamp, at_ns, position_m
        elif at_ns - self._reference[1] >= UNIT_WINDOW_NS:
            advance, passed_s = stamp - self._reference[0], (at_ns - self._reference[1]) * 1e-9
            if advance == 0 and position_m != self._reference[2]:
                self.unit = StampUnit.CONSTANT
            for unit, per_second in _UNITS_PER_SECOND.items():
                # Whole seconds may be one more or less than have passed.
                if 0.5 * per_second * passed_s <= advance <= 2.0 * per_second * passed_s:
                    self.unit = unit
            self._reference = stamp, at_ns, position_m
        return self.unit


class SlidingMinimum:
    """Minimum over a sliding time window, amortised O(1): a new value removes all larger ones before it."""

    def __init__(self, window_ns: int) -> None:
        self._window_ns = window_ns
        self._queue: deque[tuple[int, int]] = deque()  # (at_ns, value), values ascending

    def push(self, at_ns: int, value: int) -> int:
        """Add a value and return the minimum of those younger than the window."""
        while self._queue and self._queue[-1][1] >= value:
            self._queue.pop()
        self._queue.append((at_ns, value))
        while self._queue[0][0] <= at_ns - self._window_ns:
            self._queue.popleft()
        return self._queue[0][1]

    @property
    def value(self) -> int | None:
        """The minimum when the last value came, or None."""
        return self._queue[0][1] if self._queue else None

    def clear(self) -> None:
        """Forget all values."""
        self._queue.clear()


class TimesyncClock:
    """Offset and drift of a peer's clock from its answers to TIMESYNC requests.

    The peer reads its clock between our sending and our receiving. So the middle is wrong by half the round trip at
    most. The offset is that of a robust line (Theil and Sen: median of the slopes between all pairs) through the last
    short round trips. The uncertainty of the line grows with time. A longer round trip joins the line once it is as
    certain as the line; before that it only bounds the line. Without answers the line is extrapolated.

    Errors in recorded flights, just before each next answer (median): 2.8 ms for a simulator whose clock ran 1.3 %
    slow (47 ms for an average of the offsets), 0.5 ms for steady clocks.

    Attributes:
        rejected: answers that were not used: too slow, or of another clock.
        shortest_round_trip_ns: the shortest round trip of the line.
    """

    def __init__(self, lifetime_ns: int) -> None:
        self._lifetime_ns = lifetime_ns
        self._answers: deque[tuple[int, int, int]] = deque(maxlen=FIT_POINTS)  # (received, offset, round trip)
        self._round_trips_ns: deque[int] = deque(maxlen=ROUND_TRIP_HISTORY)
        self._has_drift = False  # whether the slope is known
        self._slope = 0.0
        self._line_ns = 0
        self._line_at_ns = 0
        self._used_ns = 0  # arrival of the last answer that was used
        self._deviating_count = 0
        self.rejected = 0
        self.shortest_round_trip_ns = 0

    def offset_ns(self, at_ns: int) -> int | None:
        """Return (our time − its time); None without a used answer in the last `lifetime_ns`."""
        if not self._answers or at_ns - self._used_ns > self._lifetime_ns:
            return None
        return self.last_known_ns(at_ns)

    def last_known_ns(self, at_ns: int) -> int | None:
        """Return (our time − its time) by all answers, old ones too; None before the first."""
        return self._line_ns + round(self._slope * (at_ns - self._line_at_ns)) if self._answers else None

    def uncertainty_ns(self, at_ns: int) -> int | None:
        """Return the largest error of the offset at a time; None before the first answer."""
        if not self._answers:
            return None
        return self.shortest_round_trip_ns // 2 + round(DRIFT_CHANGE * (at_ns - self._answers[-1][0]))

    @property
    def drift_ppm(self) -> float | None:
        """Gain of our clock on the peer's [millionths]; None before enough answers."""
        return self._slope * 1e6 if self._has_drift else None

    @property
    def round_trips_ns(self) -> tuple[int, ...]:
        """The last round trips, rejected ones too, in order."""
        return tuple(self._round_trips_ns)

    def add_answer(self, sent_ns: int, remote_ns: int, received_ns: int) -> bool:
        """Add one answer.

        Args:
            sent_ns: our time when the request was sent.

        Returns:
            Whether it was used; a deviating or too slow one is not.
        """
        used = self._use_answer(sent_ns, remote_ns, received_ns)
        self.rejected += not used
        return used

    def _use_answer(self, sent_ns: int, remote_ns: int, received_ns: int) -> bool:
        round_trip_ns = received_ns - sent_ns
        if round_trip_ns >= 0:
            self._round_trips_ns.append(round_trip_ns)
        if not 0 <= round_trip_ns <= MAX_ROUND_TRIP_NS:
            return False
        half_ns = round_trip_ns // 2
        measured_ns = sent_ns + half_ns - remote_ns
        expected_ns, uncertainty_ns = self.last_known_ns(received_ns), self.uncertainty_ns(received_ns)
        if expected_ns is not None and abs(measured_ns - expected_ns) > max(MAX_DEVIATION_NS, half_ns):
            self._deviating_count += 1
            if self._deviating_count < RESYNC_AFTER and self.offset_ns(received_ns) is not None:
                return False
            self._reset()
            uncertainty_ns = None
        self._deviating_count = 0
        self._used_ns = received_ns
        if (
            expected_ns is not None
            and uncertainty_ns is not None
            and half_ns > uncertainty_ns + ROUND_TRIP_MARGIN_NS // 2
        ):
            clamped_ns = min(max(expected_ns, measured_ns - half_ns), measured_ns + half_ns)
            self._line_ns += clamped_ns - expected_ns
            return True
        # Round trips of other lengths have other errors, which are no drift: the slope ignores them.
        similar = [trip for trip in self._answers if abs(round_trip_ns - trip[2]) <= 2 * ROUND_TRIP_MARGIN_NS]
        self._answers = deque([*similar, (received_ns, measured_ns, round_trip_ns)], maxlen=FIT_POINTS)
        self._fit_line()
        return True

    def _reset(self) -> None:
        """Forget the line: the peer has another clock now."""
        self._answers.clear()
        self._slope, self._has_drift = 0.0, False

    def _fit_line(self) -> None:
        """Fit the line through the last answers: its slope, and its value at the last one."""
        self.shortest_round_trip_ns = min(length_ns for _, _, length_ns in self._answers)
        last_ns = self._answers[-1][0]
        if len(self._answers) >= MIN_FIT_POINTS and last_ns - self._answers[0][0] >= MIN_FIT_SPAN_NS:
            pairs = combinations(self._answers, 2)
            slope = median((o2 - o1) / (t2 - t1) for (t1, o1, _), (t2, o2, _) in pairs if t2 > t1)
            self._slope, self._has_drift = min(max(slope, -MAX_DRIFT), MAX_DRIFT), True
        first_ns = self._answers[0][1]  # differences stay exact in floating point
        levels = [offset - first_ns + self._slope * (last_ns - at_ns) for at_ns, offset, _ in self._answers]
        self._line_ns, self._line_at_ns = first_ns + round(median(levels)), last_ns


class ArrivalClock:
    """Clock of a sender by the arrival of its stamps alone: the quickest message counts.

    (our time − its time) is at most (arrival − stamp). The minimum of these follows the clock's drift. The drift is the
    median of the slopes from second to second: a slower link is one slope among many, and no drift.
    """

    def __init__(self) -> None:
        self._min_offset_ns: float = 0.0
        self._at_ns: int | None = None  # time of the last stamp
        # start of the second, smallest (arrival − stamp) in it, and its time of arrival
        self._current_second: tuple[int, int, int] = (0, 0, 0)
        self._previous_second: tuple[int, int] | None = None  # minimum and arrival of the previous second
        self._slopes: deque[float] = deque(maxlen=FIT_POINTS)
        self._slope = 0.0
        self._impossible_count = 0  # stamps in a row that this clock cannot have given

    def offset_ns(self, at_ns: int) -> int | None:
        """Return (our time − its time) plus the smallest delay; None before the first stamp."""
        return None if self._at_ns is None else round(self._min_offset_ns + self._slope * (at_ns - self._at_ns))

    def measure_delay_ns(self, stamp_ns: int, at_ns: int) -> int:
        """Add a stamp; return its delay behind the quickest one [ns]."""
        offset_ns = at_ns - stamp_ns
        if self._at_ns is None or self._impossible_count >= RESYNC_AFTER:
            self._previous_second, self._slope, self._impossible_count = None, 0.0, 0
            self._slopes.clear()
            self._current_second, self._min_offset_ns = (at_ns, offset_ns, at_ns), offset_ns
        elif offset_ns < self._min_offset_ns - MAX_CLOCK_STEP_NS:
            self._impossible_count += 1
            return 0
        else:
            self._impossible_count = 0
            second_start_ns, min_offset_ns, _ = self._current_second
            if at_ns - second_start_ns >= SECOND_NS:
                self._start_second(offset_ns, at_ns)
            elif offset_ns < min_offset_ns:
                self._current_second = second_start_ns, offset_ns, at_ns
            since_ns = at_ns - self._at_ns
            self._min_offset_ns = min(offset_ns, self._min_offset_ns + (self._slope + DRIFT_CHANGE) * since_ns)
        self._at_ns = at_ns
        return round(offset_ns - self._min_offset_ns)

    def _start_second(self, offset_ns: int, at_ns: int) -> None:
        """Update the drift from the finished second."""
        _, min_offset_ns, min_offset_at_ns = self._current_second
        if self._previous_second is not None:
            slope = (min_offset_ns - self._previous_second[0]) / (min_offset_at_ns - self._previous_second[1])
            self._slopes.append(min(max(slope, -MAX_DRIFT), MAX_DRIFT))
            self._slope = median_low(self._slopes)
            if len(self._slopes) == 1:  # the minimum of the first seconds was without drift
                self._min_offset_ns = min_offset_ns + self._slope * (at_ns - min_offset_at_ns)
        self._previous_second, self._current_second = (min_offset_ns, min_offset_at_ns), (at_ns, offset_ns, at_ns)


class ClockSync:
    """Clock of one source, identified by system, component and kind of stamp.

    Args:
        latency_ns: smallest delay from capture to arrival.
        future_tolerance_ns: a stamp further ahead than this is refused.
    """

    def __init__(self, window_ns: int, latency_ns: int, future_tolerance_ns: int) -> None:
        self._latency_ns = latency_ns
        self._future_tolerance_ns = future_tolerance_ns
        self._minimum = SlidingMinimum(window_ns)
        self._min_delay = SlidingMinimum(window_ns)  # delay by the offset from round trips
        self._newest_ns = 0
        self._stamp_count = 0
        self._stamps: deque[int] = deque(maxlen=STAMP_HISTORY)
        self._new_delays_ns: deque[int] = deque(maxlen=RESYNC_AFTER)
        self.resyncs = 0
        self.offset_ns: int | None = None
        self.source = ClockSource.NONE

    def estimate_capture_ns(
        self, stamp_ns: int | None, received_ns: int, offset_ns: int | None = None
    ) -> int | StampRefusal:
        """Convert a stamp to the time of capture in our clock.

        Args:
            stamp_ns: the source's stamp; None if it gives none.
            offset_ns: offset from round trips, if known. It is used if the smallest delay is plausible with it: answers
                and stamps may come from different clocks.

        Returns:
            The time of capture, never after the arrival, or why the stamp is refused.
        """
        if stamp_ns is None:
            return received_ns - self._latency_ns
        refusal = self._check_stamp(stamp_ns, received_ns)
        if refusal is not None:
            return refusal
        self._stamp_count += 1
        self._newest_ns = stamp_ns if self._stamp_count == 1 else max(self._newest_ns, stamp_ns)
        self._stamps.append(stamp_ns)
        minimum_ns = self._minimum.push(received_ns, received_ns - stamp_ns)
        if offset_ns is not None and self._is_plausible(offset_ns, minimum_ns, stamp_ns, received_ns):
            self.offset_ns, self.source = offset_ns, ClockSource.TIMESYNC
        else:
            self.offset_ns, self.source = minimum_ns - self._latency_ns, ClockSource.MINIMUM
        return min(stamp_ns + self.offset_ns, received_ns)

    def _is_plausible(self, offset_ns: int, minimum_ns: int, stamp_ns: int, received_ns: int) -> bool:
        """Return whether the smallest delay with an offset is neither negative nor long.

        The minimum of a slow clock is old and too small for now. So each delay is also tested with the offset of its
        own time.
        """
        shortest_ns = self._min_delay.push(received_ns, received_ns - stamp_ns - offset_ns)
        min_offset_ns = -self._future_tolerance_ns
        return any(min_offset_ns <= delay_ns <= MAX_CLOCK_STEP_NS for delay_ns in (minimum_ns - offset_ns, shortest_ns))

    def unwrap_ns(self, stamp: int, modulus: int, unit_ns: int) -> int:
        """Convert a counter that wraps to nanoseconds: the value nearest to the newest stamp."""
        half = modulus // 2
        newest = self._newest_ns // unit_ns if self._stamp_count else stamp
        return (newest + (stamp - newest + half) % modulus - half) * unit_ns

    def _check_stamp(self, stamp_ns: int, received_ns: int) -> StampRefusal | None:
        """Refuse stamps that the clock so far cannot have given, until several in a row agree on a new clock."""
        minimum_ns = self._minimum.value
        if minimum_ns is None:
            return None
        if stamp_ns in self._stamps:
            return StampRefusal.DUPLICATE
        delay_ns = received_ns - stamp_ns
        ahead_ns = self._future_tolerance_ns if self._stamp_count >= MIN_SAMPLES else MAX_CLOCK_STEP_NS
        if minimum_ns - delay_ns > ahead_ns:
            refusal = StampRefusal.FUTURE
        elif self._newest_ns - stamp_ns > MAX_CLOCK_STEP_NS:
            refusal = StampRefusal.LEAP
        else:
            self._new_delays_ns.clear()
            return None
        self._new_delays_ns.append(delay_ns)
        if (
            len(self._new_delays_ns) < RESYNC_AFTER
            or max(self._new_delays_ns) - min(self._new_delays_ns) > MAX_DELAY_SPREAD_NS
        ):
            return refusal
        self._reset()
        return None

    def _reset(self) -> None:
        """Reset all estimates: the source has another clock now."""
        self._minimum.clear()
        self._min_delay.clear()
        self._stamps.clear()
        self._new_delays_ns.clear()
        self._stamp_count = 0
        self.resyncs += 1
