"""Limit of the gaps between ticks: a computer that is too busy to fly ends the flight.

After a single gap the flight waits for the vehicle's heartbeat (`uavctl.flight.decide`). Several show that the next one
is near, in which the vehicle would fly the last setpoint until its own timeout.
"""

from __future__ import annotations

from collections import deque

from uavctl.arrays import SECOND_NS
from uavctl.errors import UavctlError
from uavctl.flight.context import GAP_NS

MAX_GAPS = 2  # within `SPAN_NS`; a single pause of a computer may make two
SPAN_NS = 10 * SECOND_NS


class GapLimit:
    """Counts the gaps between the ticks of a flight that is in control."""

    def __init__(self) -> None:
        self._last_ns: int | None = None  # last tick in control
        self._gaps_ns: deque[int] = deque()

    def check(self, at_ns: int, *, is_in_control: bool) -> None:
        """Note the begin of a tick.

        Raises:
            UavctlError: There have been too many gaps; they are counted anew from then on.
        """
        gap_ns = 0 if self._last_ns is None else at_ns - self._last_ns
        self._last_ns = at_ns if is_in_control else None
        if not is_in_control or gap_ns <= GAP_NS:
            return
        self._gaps_ns.append(at_ns)
        while self._gaps_ns[0] < at_ns - SPAN_NS:
            self._gaps_ns.popleft()
        if len(self._gaps_ns) > MAX_GAPS:
            self._gaps_ns.clear()
            raise UavctlError(
                f"the computer is too busy: no tick for more than {GAP_NS * 1e-9:g} s, "
                f"{MAX_GAPS + 1} times within {SPAN_NS * 1e-9:g} s; end other programs, or see --realtime"
            )
