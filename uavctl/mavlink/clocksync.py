"""A source's stamps to our monotonic clock; pure, time is an argument.

Two estimates of (our time − its time): from TIMESYNC round trips if the source answers them, else the
sliding minimum of (received − stamp), which is the true offset plus the smallest delay; `latency`, the
smallest delay as configured, is taken off again.
"""

from __future__ import annotations

from collections import deque
from enum import StrEnum
from itertools import combinations
from statistics import median

MAX_ROUND_TRIP_NS = 10_000_000
MAX_DEVIATION_NS = 100_000_000
RESYNC_AFTER = 5  # deviating values in a row that are believed
LEAP_NS = 1_000_000_000
SETTLED_AFTER = 20  # samples before the minimum is trusted to judge the next stamp
AGREE_NS = 200_000_000  # spread of the delays of one new clock
REMEMBERED_STAMPS = 64
FITTED = 5  # round trips that the line of a clock goes through: few, as a busy computer's clock changes its pace
MIN_FITTED = 3
MIN_SPAN_NS = 2_000_000_000  # between the first and the last of them: nearer ones say nothing of a drift
MAX_DRIFT = 0.05  # recorded: up to 0.034
REMEMBERED_TRIPS = 60


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


class SlidingMinimum:
    """Minimum over a window of time, amortised O(1): values that a later, smaller one outlives are dropped."""

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


class RoundTrips:
    """Offset and drift of a peer's clock from its answers to TIMESYNC requests.

    The offset between answers is that of a robust line (Theil and Sen: median of the slopes between all pairs) through
    the last few. Against the recorded flights, just before each next answer: a simulator whose clock ran 1.3 % slow is
    followed to 2.8 ms (median; an average of the offsets alone was 47 ms behind), steady ones to 0.5 ms.
    """

    def __init__(self, lifetime_ns: int) -> None:
        self._lifetime_ns = lifetime_ns
        self._trips: deque[tuple[int, int]] = deque(maxlen=FITTED)  # (received, offset)
        self._round_trips_ns: deque[int] = deque(maxlen=REMEMBERED_TRIPS)
        self._slope = 0.0
        self._base_ns = 0
        self._deviating = 0
        self.rejected = 0

    def offset_ns(self, at_ns: int) -> int | None:
        """(our time − its time), or None without a good answer in the last `lifetime_ns`."""
        if not self._trips or at_ns - self._trips[-1][0] > self._lifetime_ns:
            return None
        return self._base_ns + round(self._slope * (at_ns - self._trips[-1][0]))

    @property
    def drift_ppm(self) -> float | None:
        """Gain of our clock on the peer's [millionths]; None before enough answers."""
        return self._slope * 1e6 if self._settled else None

    @property
    def round_trips_ns(self) -> tuple[int, ...]:
        """The last round trips, rejected ones too, in order."""
        return tuple(self._round_trips_ns)

    def answer(self, sent_ns: int, remote_ns: int, received_ns: int) -> bool:
        """Take one answer.

        Args:
            sent_ns: our time when the request was sent.

        Returns:
            Whether it was used; a slow or deviating one is not.
        """
        used = self._take(sent_ns, remote_ns, received_ns)
        self.rejected += not used
        return used

    def _take(self, sent_ns: int, remote_ns: int, received_ns: int) -> bool:
        round_trip_ns = received_ns - sent_ns
        if round_trip_ns >= 0:
            self._round_trips_ns.append(round_trip_ns)
        if not 0 <= round_trip_ns <= MAX_ROUND_TRIP_NS:
            return False
        measured_ns = sent_ns + round_trip_ns // 2 - remote_ns
        old_ns = self.offset_ns(received_ns)
        if old_ns is None:
            self._trips.clear()
        elif abs(measured_ns - old_ns) > MAX_DEVIATION_NS:
            self._deviating += 1
            if self._deviating < RESYNC_AFTER:
                return False
            self._trips.clear()
        self._deviating = 0
        self._trips.append((received_ns, measured_ns))
        self._fit()
        return True

    @property
    def _settled(self) -> bool:
        return len(self._trips) >= MIN_FITTED and self._trips[-1][0] - self._trips[0][0] >= MIN_SPAN_NS

    def _fit(self) -> None:
        """The line through the last answers, as its slope and its value at the last one."""
        last_ns = self._trips[-1][0]
        self._slope = 0.0
        if self._settled:
            pairs = combinations(self._trips, 2)
            slope = median((o2 - o1) / (t2 - t1) for (t1, o1), (t2, o2) in pairs if t2 > t1)
            self._slope = min(max(slope, -MAX_DRIFT), MAX_DRIFT)
        first_ns = self._trips[0][1]  # differences stay exact in floating point
        levels = [offset - first_ns + self._slope * (last_ns - at_ns) for at_ns, offset in self._trips]
        self._base_ns = first_ns + round(median(levels))


class ClockSync:
    """The clock of one source, identified by system, component and kind of stamp.

    Args:
        latency_ns: smallest delay from capture to arrival.
        future_tolerance_ns: a stamp further ahead than this is refused.
    """

    def __init__(self, window_ns: int, latency_ns: int, future_tolerance_ns: int) -> None:
        self._latency_ns = latency_ns
        self._future_tolerance_ns = future_tolerance_ns
        self._minimum = SlidingMinimum(window_ns)
        self._shortest = SlidingMinimum(window_ns)  # delay by the offset from round trips
        self._newest_ns = 0
        self._count = 0
        self._stamps: deque[int] = deque(maxlen=REMEMBERED_STAMPS)
        self._leaps: deque[int] = deque(maxlen=RESYNC_AFTER)
        self.resyncs = 0
        self.offset_ns: int | None = None
        self.source = ClockSource.NONE

    def captured_ns(self, stamp_ns: int | None, received_ns: int, offset_ns: int | None = None) -> int | StampRefusal:
        """Time of capture in our clock.

        Args:
            stamp_ns: the source's stamp; None if it gives none.
            offset_ns: offset from round trips, if there is one. It is used if it makes the smallest
                delay plausible: answers and stamps may come from different clocks.

        Returns:
            The time of capture, never after the arrival, or why the stamp is refused.
        """
        if stamp_ns is None:
            return received_ns - self._latency_ns
        refusal = self._judge(stamp_ns, received_ns)
        if refusal is not None:
            return refusal
        self._count += 1
        self._newest_ns = stamp_ns if self._count == 1 else max(self._newest_ns, stamp_ns)
        self._stamps.append(stamp_ns)
        minimum_ns = self._minimum.push(received_ns, received_ns - stamp_ns)
        if offset_ns is not None and self._is_plausible(offset_ns, minimum_ns, stamp_ns, received_ns):
            self.offset_ns, self.source = offset_ns, ClockSource.TIMESYNC
        else:
            self.offset_ns, self.source = minimum_ns - self._latency_ns, ClockSource.MINIMUM
        return min(stamp_ns + self.offset_ns, received_ns)

    def _is_plausible(self, offset_ns: int, minimum_ns: int, stamp_ns: int, received_ns: int) -> bool:
        """Whether an offset makes the smallest delay neither negative nor long.

        The minimum of a clock that runs slow is that of a while ago, and too small for now: so each delay is also
        judged by the offset of its own time.
        """
        shortest_ns = self._shortest.push(received_ns, received_ns - stamp_ns - offset_ns)
        least_ns = -self._future_tolerance_ns
        return any(least_ns <= delay_ns <= LEAP_NS for delay_ns in (minimum_ns - offset_ns, shortest_ns))

    def unwrap(self, stamp: int, modulus: int, unit_ns: int) -> int:
        """Nanoseconds of a counter that wraps, as the value nearest to the newest stamp."""
        half = modulus // 2
        newest = self._newest_ns // unit_ns if self._count else stamp
        return (newest + (stamp - newest + half) % modulus - half) * unit_ns

    def _judge(self, stamp_ns: int, received_ns: int) -> StampRefusal | None:
        """Refuse stamps that the clock so far cannot have given, until several in a row agree on a new clock."""
        minimum_ns = self._minimum.value
        if minimum_ns is None:
            return None
        if stamp_ns in self._stamps:
            return StampRefusal.DUPLICATE
        delay_ns = received_ns - stamp_ns
        ahead_ns = self._future_tolerance_ns if self._count >= SETTLED_AFTER else LEAP_NS
        if minimum_ns - delay_ns > ahead_ns:
            refusal = StampRefusal.FUTURE
        elif self._newest_ns - stamp_ns > LEAP_NS:
            refusal = StampRefusal.LEAP
        else:
            self._leaps.clear()
            return None
        self._leaps.append(delay_ns)
        if len(self._leaps) < RESYNC_AFTER or max(self._leaps) - min(self._leaps) > AGREE_NS:
            return refusal
        self._restart()
        return None

    def _restart(self) -> None:
        """Begin anew: the source has another clock now."""
        self._minimum.clear()
        self._shortest.clear()
        self._stamps.clear()
        self._leaps.clear()
        self._count = 0
        self.resyncs += 1
