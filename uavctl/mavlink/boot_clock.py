"""Boot clock of a vehicle: its uptime, and whether it has restarted. Pure; time is an argument.

1. Keep the last `time_boot_ms` of each kind of message.
2. Accept the next one if it advances about as much as our clock did.
3. Keep any other value as a candidate. A second message must confirm it within `CONFIRM_NS`.
4. Report a restart if the confirmed value is older than messages become on a link, or shows an uptime that is short
   enough.
"""

from __future__ import annotations

from typing import NamedTuple

MAX_BACKSTEP_MS = 1000  # a clock that goes back by more is another one; reordering on a link is less
MAX_LATE_MS = 10_000  # messages that are no older than this are late, unless the clock can have begun anew since
BEGINS_MS = 1000  # a clock that has begun anew shows no more than the time since, and the delay of a message
MAX_ADVANCE_MS = 30_000  # more than our clock: late messages, and fast simulated clocks
CONFIRM_NS = 5_000_000_000  # time limit for the second message of another clock
_WRAP_MS = 2**32


class _Reading(NamedTuple):
    """Time since boot [ms] and its arrival [ns]; a consistent message after it confirms it."""

    boot_ms: int
    at_ns: int
    is_confirmed: bool = False


class BootClock:
    """Uptime from `time_boot_ms` of several kinds of messages, each compared with its own kind.

    One message is no evidence, because a field may hold garbage. A clock counts once two messages agree, even between
    those of another vehicle with the same id.
    """

    def __init__(self) -> None:
        self._readings: dict[str, _Reading] = {}  # by kind of message
        self._candidates: dict[str, _Reading] = {}  # inconsistent with the last reading; by kind
        self._newest: _Reading | None = None

    def uptime_s(self, at_ns: int) -> float | None:
        """Return the vehicle's uptime by its own clock [s]; None if unknown."""
        newest = self._newest
        return None if newest is None else newest.boot_ms / 1e3 + (at_ns - newest.at_ns) / 1e9

    def update(self, kind: str, boot_ms: int, at_ns: int) -> bool:
        """Add a time since boot; return whether it shows a restart of the vehicle.

        Args:
            kind: kind of message; two kinds may have different clocks.
            boot_ms: its time since boot, modulo 2**32 ms.
        """
        known, candidate = self._readings.get(kind), self._candidates.get(kind)
        reading = _Reading(boot_ms, at_ns, is_confirmed=known is not None)
        if known is None or _is_same_clock(known, reading):
            self._accept(kind, reading)
        elif candidate is not None and at_ns - candidate.at_ns <= CONFIRM_NS and _is_same_clock(candidate, reading):
            del self._candidates[kind]
            has_restarted = known.is_confirmed and _may_have_restarted(known, reading)
            if has_restarted:  # readings of other kinds are older than the restart
                self._readings.clear()
                self._candidates.clear()
            self._accept(kind, reading)
            return has_restarted
        else:
            self._candidates[kind] = reading
        return False

    def reset(self) -> None:
        """Forget all readings: another vehicle is followed now."""
        self._readings.clear()
        self._candidates.clear()
        self._newest = None

    def _accept(self, kind: str, reading: _Reading) -> None:
        self._readings[kind] = self._newest = reading


def _compute_advance_ms(before: _Reading, after: _Reading) -> int:
    """Return the advance of a clock [ms], modulo its wrap."""
    return (after.boot_ms - before.boot_ms + _WRAP_MS // 2) % _WRAP_MS - _WRAP_MS // 2


def _compute_elapsed_ms(before: _Reading, after: _Reading) -> int:
    return (after.at_ns - before.at_ns) // 1_000_000


def _is_same_clock(before: _Reading, after: _Reading) -> bool:
    """Return whether two readings may be of one clock."""
    return -MAX_BACKSTEP_MS <= _compute_advance_ms(before, after) <= _compute_elapsed_ms(before, after) + MAX_ADVANCE_MS


def _may_have_restarted(before: _Reading, after: _Reading) -> bool:
    """Return whether a restart between two readings is possible; after 24 days of uptime a clock seems to jump."""
    advance_ms, elapsed_ms = _compute_advance_ms(before, after), _compute_elapsed_ms(before, after)
    if advance_ms < 0:
        return advance_ms < -MAX_LATE_MS or after.boot_ms <= elapsed_ms + BEGINS_MS
    return after.boot_ms <= elapsed_ms + MAX_ADVANCE_MS
