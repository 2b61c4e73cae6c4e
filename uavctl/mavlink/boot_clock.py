"""A vehicle's time since boot: how long it has been up, and whether it has started anew. Pure: time is an argument."""

from __future__ import annotations

from dataclasses import dataclass

BACK_MS = 1000  # a clock that goes back by more is another one; disorder on a link is less
AHEAD_MS = 30_000  # more than time has passed: late messages, and simulated clocks that run fast
AGREE_NS = 5_000_000_000  # within which another clock's second message has to come
_WRAP_MS = 2**32


@dataclass(frozen=True)
class _Reading:
    """A time since boot [ms] and when it came [ns]; confirmed by the message after it that agrees."""

    boot_ms: int
    at_ns: int
    confirmed: bool = False


class BootClock:
    """Takes `time_boot_ms` of several kinds of messages, each against its own kind.

    One message is no evidence, as a field may hold garbage: a clock counts once two agree, be it between those of
    another vehicle with the same id.
    """

    def __init__(self) -> None:
        self._known: dict[str, _Reading] = {}  # by kind of message
        self._doubted: dict[str, _Reading] = {}  # does not go on from what is known
        self._newest: _Reading | None = None

    def up_s(self, at_ns: int) -> float | None:
        """How long ago the vehicle started, by its own clock [s]; None if it does not tell."""
        newest = self._newest
        return None if newest is None else newest.boot_ms / 1e3 + (at_ns - newest.at_ns) / 1e9

    def take(self, kind: str, boot_ms: int, at_ns: int) -> bool:
        """Take a time since boot; whether it shows that the vehicle has started anew.

        Args:
            kind: of message; the clocks of two need not agree.
            boot_ms: its time since boot, modulo 2**32 ms.
            at_ns: its arrival.
        """
        known, doubted = self._known.get(kind), self._doubted.get(kind)
        reading = _Reading(boot_ms, at_ns)
        if known is None or _goes_on(known, reading):
            self._adopt(kind, _Reading(boot_ms, at_ns, confirmed=known is not None))
        elif doubted is not None and at_ns - doubted.at_ns <= AGREE_NS and _goes_on(doubted, reading):
            del self._doubted[kind]
            anew = known.confirmed and (_advance_ms(known, reading) < 0 or _is_young(known, reading))
            if anew:  # what the others have told is of the time before
                self._known.clear()
                self._doubted.clear()
            self._adopt(kind, _Reading(boot_ms, at_ns, confirmed=True))
            return anew
        else:
            self._doubted[kind] = reading
        return False

    def forget(self) -> None:
        """Begin anew, with another vehicle."""
        self._known.clear()
        self._doubted.clear()
        self._newest = None

    def _adopt(self, kind: str, reading: _Reading) -> None:
        self._known[kind] = self._newest = reading


def _advance_ms(before: _Reading, after: _Reading) -> int:
    """By how much a clock went on, the shorter way around its wrap [ms]."""
    return (after.boot_ms - before.boot_ms + _WRAP_MS // 2) % _WRAP_MS - _WRAP_MS // 2


def _passed_ms(before: _Reading, after: _Reading) -> int:
    return (after.at_ns - before.at_ns) // 1_000_000


def _goes_on(before: _Reading, after: _Reading) -> bool:
    """Whether two readings may be of one clock."""
    return -BACK_MS <= _advance_ms(before, after) <= _passed_ms(before, after) + AHEAD_MS


def _is_young(before: _Reading, after: _Reading) -> bool:
    """Whether a vehicle may have started between two readings: up for more than 24 days its clock seems to leap."""
    return after.boot_ms <= _passed_ms(before, after) + AHEAD_MS
