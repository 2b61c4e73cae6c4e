"""Boot clock of a vehicle: its uptime, and whether it has restarted. Pure; time is an argument.

1. Keep the last `time_boot_ms` of each kind of message.
2. Accept the next one if it advances about as much as our clock did.
3. Keep any other value as a candidate. A second message must confirm it within `CONFIRM_NS`.
4. Report a restart if the confirmed value is older than before, or shows an uptime that is short enough.
"""

from __future__ import annotations

from dataclasses import dataclass

MAX_BACKSTEP_MS = 1000  # a clock that goes back by more is another one; disorder on a link is less
MAX_ADVANCE_MS = 30_000  # more than time has passed: late messages, and simulated clocks that run fast
CONFIRM_NS = 5_000_000_000  # within which another clock's second message has to come
_WRAP_MS = 2**32


@dataclass(frozen=True)
class _Reading:
    """A time since boot [ms] and when it came [ns]; confirmed by the message after it that agrees."""

    boot_ms: int
    at_ns: int
    is_confirmed: bool = False


class BootClock:
    """Takes `time_boot_ms` of several kinds of messages, each against its own kind.

    One message is no evidence, as a field may hold garbage: a clock counts once two agree, be it between those of
    another vehicle with the same id.
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
            kind: of message; the clocks of two need not agree.
            boot_ms: its time since boot, modulo 2**32 ms.
        """
        known, candidate = self._readings.get(kind), self._candidates.get(kind)
        reading = _Reading(boot_ms, at_ns)
        if known is None or _is_same_clock(known, reading):
            self._accept(kind, _Reading(boot_ms, at_ns, is_confirmed=known is not None))
        elif candidate is not None and at_ns - candidate.at_ns <= CONFIRM_NS and _is_same_clock(candidate, reading):
            del self._candidates[kind]
            has_restarted = known.is_confirmed and (
                _compute_advance_ms(known, reading) < 0 or _may_have_restarted(known, reading)
            )
            if has_restarted:  # the others' readings are from before the restart
                self._readings.clear()
                self._candidates.clear()
            self._accept(kind, _Reading(boot_ms, at_ns, is_confirmed=True))
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
    """Whether two readings may be of one clock."""
    return -MAX_BACKSTEP_MS <= _compute_advance_ms(before, after) <= _compute_elapsed_ms(before, after) + MAX_ADVANCE_MS


def _may_have_restarted(before: _Reading, after: _Reading) -> bool:
    """Whether a vehicle may have started between two readings: up for more than 24 days its clock seems to leap."""
    return after.boot_ms <= _compute_elapsed_ms(before, after) + MAX_ADVANCE_MS
