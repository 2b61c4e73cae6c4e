"""PX4's idea of another computer's clock, from that one's answers to its TIMESYNC requests.

Rules and figures are those of PX4's src/lib/timesync/Timesync.{hpp,cpp}: an answer counts if it came back in less than
10 ms; after 500 of them, so after 50 s at 10 Hz, stamps of what it receives are moved by the offset found. Until then
they are not looked at: what arrives is taken as of now. Offset and skew are smoothed with gains that fall from 0.05 to
0.003 over those 500.
"""

from __future__ import annotations

import math

WINDOW = 500
MAX_ROUND_TRIP_NS = 10_000_000
MAX_DEVIATION_NS = 100_000_000
MAX_DEVIATING = 5  # in a row; one more, and it begins anew
FIRST_GAIN, LAST_GAIN = 0.05, 0.003


class TimeSync:
    """One peer's clock."""

    def __init__(self) -> None:
        self._restart()

    def _restart(self) -> None:
        self._count = self._deviating = 0
        self._offset_ns = self._skew_ns = 0.0

    @property
    def converged(self) -> bool:
        """Whether stamps are moved."""
        return self._count >= WINDOW

    def take(self, asked_ns: int, theirs_ns: int, now_ns: int) -> None:
        """Take an answer.

        Args:
            asked_ns: own time of the request, as the answer gives it back.
            theirs_ns: the peer's time in it; only one after 0 is an answer.
            now_ns: own time.
        """
        if theirs_ns <= 0 or not 0 <= now_ns - asked_ns < MAX_ROUND_TRIP_NS:
            return
        offset_ns = (asked_ns + now_ns) / 2 - theirs_ns
        if self.converged and abs(self._offset_ns - offset_ns) > MAX_DEVIATION_NS:
            self._deviating += 1
            if self._deviating > MAX_DEVIATING:
                self._restart()
            return
        self._smooth(offset_ns)
        self._count += 1
        self._deviating = 0

    def _smooth(self, offset_ns: float) -> None:
        if self._count == 0:
            self._offset_ns = offset_ns
            return
        before_ns, gain = self._offset_ns, self._gain
        self._offset_ns = gain * offset_ns + (1.0 - gain) * (before_ns + self._skew_ns)
        self._skew_ns = gain * (self._offset_ns - before_ns) + (1.0 - gain) * self._skew_ns

    @property
    def _gain(self) -> float:
        """The same for offset and skew."""
        if self.converged:
            return LAST_GAIN
        last = 1.0 - math.exp(0.5 * (1.0 - 1.0 / (1.0 - self._count / WINDOW)))
        return last * LAST_GAIN + (1.0 - last) * FIRST_GAIN

    def moved_ns(self, stamp_ns: int, now_ns: int) -> int:
        """A stamp of the peer's in own time: now, until the peer's clock is known."""
        return stamp_ns + round(self._offset_ns) if self.converged else now_ns
