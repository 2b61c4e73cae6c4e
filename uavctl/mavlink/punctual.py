"""Whether what a vehicle streams is of now: late, repeated and frozen inertial data say what was."""

from __future__ import annotations

from uavctl.data import Vec3

LATE_NS = 60_000_000  # later than the quickest: a stream of 50 Hz is 20 ms apart
CREEP = 1e-3  # by which two clocks may drift apart: ten times what bad oscillators do
BACK_US = 1_000_000  # a stamp that goes back by more is of another clock


class Punctual:
    """Tells what is late, or says again what has been said, in one stream of one sender.

    A message's delay is told against that of the quickest before it: clocks need not agree.
    """

    def __init__(self) -> None:
        self._least_ns: int | None = None  # arrival less stamp
        self._heard_ns = 0  # the last that was taken
        self._stamp_us = 0  # of that
        self._values: Vec3 | None = None

    def takes(self, stamp_us: int, values: Vec3, at_ns: int) -> bool:
        """Whether a message is of now.

        Args:
            stamp_us: when it was measured, by the sender's clock.
            values: what was measured; the same to the last bit is no measurement.
            at_ns: its arrival.
        """
        if stamp_us < self._stamp_us - BACK_US:
            self._least_ns, self._stamp_us = None, 0
        behind_ns = at_ns - 1000 * stamp_us
        least_ns = behind_ns
        if self._least_ns is not None:
            least_ns = min(behind_ns, self._least_ns + round(CREEP * (at_ns - self._heard_ns)))
        if stamp_us <= self._stamp_us or values == self._values or behind_ns - least_ns > LATE_NS:
            return False
        self._least_ns, self._heard_ns = least_ns, at_ns
        self._stamp_us, self._values = stamp_us, values
        return True
