"""The clock of another program's recording, which may leap, stand still or run back: what that does to its times."""

from __future__ import annotations

from logs.summary import count
from uavctl.errors import RecordingError

# Clocks are set by hand, by a GPS or by a server; what is no more than this is order, or a silence.
FARTHEST_BACK_NS = 1_000_000_000
LONGEST_SILENCE_NS = 3600 * 1_000_000_000
_TOLD_SILENCE_NS = 10_000_000_000  # a vehicle's heartbeats come once a second


class SteadyClock:
    """Times that go on where the recorder's clock leaps.

    After a leap time goes on from the last one before it. When the stamps come back to what they were (a single one
    was wrong), so do the times. A stamp of zero among others is none: the time is that of the last.
    """

    def __init__(self) -> None:
        self._offset_ns = self._former_ns = 0
        self._last_ns: int | None = None  # the latest time given
        self._stamps = self._zeros = self._missing = self._backward = self._leaps = 0
        self._farthest_ns = self._silence_ns = 0

    def expects(self, stamp_ns: int) -> bool:
        """Whether a stamp may follow the others without a leap; not before the first."""
        return self._fitting(stamp_ns) is not None

    def steady(self, stamp_ns: int) -> int:
        """The time of what was stamped so, in the order of the recording [ns]."""
        self._stamps += 1
        self._zeros += stamp_ns == 0
        if self._last_ns is None:
            self._last_ns = stamp_ns
        offset_ns = self._fitting(stamp_ns)
        if offset_ns is None and stamp_ns == 0:
            self._missing += 1
            return self._last_ns
        if offset_ns is None:
            offset_ns = self._last_ns - stamp_ns
        if offset_ns != self._offset_ns:
            self._leaps += 1
            self._farthest_ns = max(self._farthest_ns, abs(offset_ns - self._offset_ns))
            self._former_ns, self._offset_ns = self._offset_ns, offset_ns
        at_ns = stamp_ns + offset_ns
        self._backward += at_ns < self._last_ns
        self._silence_ns = max(self._silence_ns, at_ns - self._last_ns)
        self._last_ns = max(self._last_ns, at_ns)
        return at_ns

    def check(self, name: str) -> None:
        """Refuse stamps that say nothing.

        Raises:
            RecordingError: There are several, and all are zero.
        """
        if self._zeros == self._stamps > 1:
            raise RecordingError(f"{name}: all {self._stamps} time stamps are zero, so nobody knows what came when")

    def notes(self, name: str) -> tuple[str, ...]:
        """What was odd about the stamps, in sentences."""
        found = []
        if self._leaps:
            found.append(
                f"{name}: its clock leaps ({count(self._leaps, 'time')}, by up to {self._farthest_ns * 1e-9:.0f} s); "
                "taken as if it had gone on"
            )
        if self._missing:
            found.append(f"{name}: {count(self._missing, 'time stamp')} of zero; taken for the time before")
        if self._backward:
            found.append(f"{name}: {count(self._backward, 'time stamp')} not in order; put in order")
        if self._silence_ns > _TOLD_SILENCE_NS:
            found.append(f"{name}: nothing in it for {self._silence_ns * 1e-9:.0f} s")
        return tuple(found)

    def _fitting(self, stamp_ns: int) -> int | None:
        """Which of the last two offsets a stamp goes with [ns]; None if neither."""
        if self._last_ns is None:
            return None
        for offset_ns in (self._offset_ns, self._former_ns):
            if -FARTHEST_BACK_NS <= stamp_ns + offset_ns - self._last_ns <= LONGEST_SILENCE_NS:
                return offset_ns
        return None
