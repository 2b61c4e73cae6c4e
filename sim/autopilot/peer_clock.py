"""Clock of a peer as PX4 estimates it from the answers to its TIMESYNC requests.

Rules and figures are those of PX4's src/lib/timesync/Timesync.{hpp,cpp}. An answer counts if it comes back in less than
10 ms. After 500 answers, 50 s at 10 Hz, PX4 moves the stamps of received messages by the offset. Until then a message
counts as captured on arrival. Gains of offset and skew fall from 0.05 to 0.003 over these 500 answers.
"""

from __future__ import annotations

import math

CONVERGENCE_COUNT = 500
MAX_ROUND_TRIP_NS = 10_000_000
MAX_DEVIATION_NS = 100_000_000
MAX_OUTLIERS = 5  # in a row; one more restarts the estimate
FIRST_GAIN, LAST_GAIN = 0.05, 0.003


class PeerClock:
    """Clock of one peer, estimated by TIMESYNC."""

    def __init__(self) -> None:
        self._restart()

    def _restart(self) -> None:
        self._count = self._outlier_count = 0
        self._offset_ns = self._skew_ns = 0.0

    @property
    def is_converged(self) -> bool:
        """Whether the offset is known, so that the peer's stamps are converted."""
        return self._count >= CONVERGENCE_COUNT

    def add_answer(self, request_ns: int, peer_ns: int, now_ns: int) -> None:
        """Take an answer to TIMESYNC.

        Args:
            asked_ns: own time of the request, as the answer gives it back.
            theirs_ns: the peer's time in it; only one after 0 is an answer.
        """
        if peer_ns <= 0 or not 0 <= now_ns - request_ns < MAX_ROUND_TRIP_NS:
            return
        offset_ns = (request_ns + now_ns) / 2 - peer_ns
        if self.is_converged and abs(self._offset_ns - offset_ns) > MAX_DEVIATION_NS:
            self._outlier_count += 1
            if self._outlier_count > MAX_OUTLIERS:
                self._restart()
            return
        self._filter_offset(offset_ns)
        self._count += 1
        self._outlier_count = 0

    def _filter_offset(self, offset_ns: float) -> None:
        if self._count == 0:
            self._offset_ns = offset_ns
            return
        previous_ns, gain = self._offset_ns, self._gain
        self._offset_ns = gain * offset_ns + (1.0 - gain) * (previous_ns + self._skew_ns)
        self._skew_ns = gain * (self._offset_ns - previous_ns) + (1.0 - gain) * self._skew_ns

    @property
    def _gain(self) -> float:
        """Present filter gain, the same for offset and skew."""
        if self.is_converged:
            return LAST_GAIN
        last_share = 1.0 - math.exp(0.5 * (1.0 - 1.0 / (1.0 - self._count / CONVERGENCE_COUNT)))
        return last_share * LAST_GAIN + (1.0 - last_share) * FIRST_GAIN

    def convert_ns(self, stamp_ns: int, now_ns: int) -> int:
        """Convert a stamp of the peer to own time [ns]; it counts as now until the peer's clock is known."""
        return stamp_ns + round(self._offset_ns) if self.is_converged else now_ns
