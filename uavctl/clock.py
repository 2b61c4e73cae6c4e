"""Monotonic time and the grid of control ticks."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

monotonic_ns: Callable[[], int] = time.monotonic_ns
"""Nanoseconds of the clock that no adjustment of the wall clock moves; shared by all processes of a machine."""

VIRTUAL_ZERO_UTC_NS = 946_684_800 * 1_000_000_000
"""UTC of time 0 in virtual time [ns since 1970]: 2000-01-01, so that the same flight has the same times."""


def zero_utc_ns() -> int:
    """UTC of time 0 of our clock by the wall clock as it is now [ns since 1970]; asked once a flight."""
    before_ns, wall_ns, after_ns = monotonic_ns(), time.time_ns(), monotonic_ns()
    return wall_ns - (before_ns + after_ns) // 2


@dataclass(frozen=True, slots=True)
class Due:
    """One tick: its number, its absolute deadline on the grid, and the ticks skipped before it."""

    tick: int
    at_ns: int
    missed: int


class Ticker:
    """Absolute deadlines on a grid.

    The grid begins at the first multiple of `align_ns` after the first call of `next()`, so that
    processes on one machine share it. Who oversleeps gets the newest tick that is due, once; the
    ones before it are counted as missed and never made up.

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

    def next(self) -> Due:
        """The next tick; its deadline may be in the past by less than a period, never by more."""
        now_ns = self._now()
        if self._start_ns is None:
            self._start_ns = (now_ns // self._align_ns + 1) * self._align_ns
        return self._newest(self._start_ns, self._tick + 1, now_ns)

    def overslept(self, due: Due) -> Due:
        """The tick to do after the wait for `due`: itself, unless the wait lasted until a later one was due."""
        return self._newest(due.at_ns - due.tick * self._period_ns, due.tick - due.missed, self._now())

    def _newest(self, start_ns: int, expected: int, now_ns: int) -> Due:
        self._tick = max(self._tick, expected, (now_ns - start_ns) // self._period_ns)
        return Due(self._tick, start_ns + self._tick * self._period_ns, self._tick - expected)
