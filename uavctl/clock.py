"""Monotonic clock and the time grid of control ticks."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

monotonic_ns: Callable[[], int] = time.monotonic_ns
"""Monotonic clock [ns]. Adjustments of the wall clock do not move it. All processes of a machine share it."""

VIRTUAL_ZERO_UTC_NS = 946_684_800 * 1_000_000_000
"""UTC of time 0 in virtual time [ns since 1970]: 2000-01-01, so that a repeated flight has the same times."""


def read_zero_utc_ns() -> int:
    """Read the UTC of time 0 of the monotonic clock [ns since 1970]; called once in a flight."""
    # wall - (before + after) / 2
    before_ns, wall_ns, after_ns = monotonic_ns(), time.time_ns(), monotonic_ns()
    return wall_ns - (before_ns + after_ns) // 2


@dataclass(frozen=True, slots=True)
class TickDeadline:
    """Number of a tick, its absolute deadline on the grid, and the number of skipped ticks before it."""

    tick: int
    at_ns: int
    missed: int


class Ticker:
    """Generator of absolute deadlines on a time grid.

    The grid begins at the first multiple of `align_ns` after the first call of `next()`. So all processes of a
    machine share it. A late caller gets the newest tick that is due. Earlier ticks count as missed and are skipped.

    Args:
        align_ns: the grid's origin is a multiple of it; itself a multiple of `period_ns`.
        now: the clock [ns].

    Raises:
        ValueError: a period below 1 ns, or one that does not divide `align_ns`.
    """

    def __init__(self, period_ns: int, align_ns: int, now: Callable[[], int] = monotonic_ns) -> None:
        if period_ns < 1 or align_ns < 1 or align_ns % period_ns:
            raise ValueError(f"a period of {period_ns} ns must be positive and divide the {align_ns} ns of the grid")
        self._period_ns = period_ns
        self._align_ns = align_ns
        self._now = now
        self._start_ns: int | None = None
        self._tick = -1

    def next(self) -> TickDeadline:
        """Return the next tick; its deadline is less than one period in the past."""
        now_ns = self._now()
        if self._start_ns is None:
            self._start_ns = (now_ns // self._align_ns + 1) * self._align_ns
        return self._latest_due(self._start_ns, self._tick + 1, now_ns)

    def update_after_wait(self, due: TickDeadline) -> TickDeadline:
        """Return the tick to run after the wait for `due`: a later one if the wait took too long."""
        return self._latest_due(due.at_ns - due.tick * self._period_ns, due.tick - due.missed, self._now())

    def _latest_due(self, start_ns: int, expected_tick: int, now_ns: int) -> TickDeadline:
        self._tick = max(self._tick, expected_tick, (now_ns - start_ns) // self._period_ns)
        return TickDeadline(self._tick, start_ns + self._tick * self._period_ns, self._tick - expected_tick)
