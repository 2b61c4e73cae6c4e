"""Missed ticks of a flight: whether this computer was too slow for it."""

from __future__ import annotations

from collections.abc import Sequence

from uavctl.records import Decision

MAX_MISSED_SHARE = 0.01  # one late tick in a hundred changes no input noticeably
PAUSE_TICKS = 20  # so many at once are a pause of the process (`stood-still`)
MIN_MISSED = 3  # ticks; fewer prove nothing in a short flight


def describe_missed_ticks(decisions: Sequence[Decision]) -> str:
    """Return how many ticks a slow computer missed, with the remedy; empty for a few."""
    missed = sum(decision.missed_ticks for decision in decisions if decision.missed_ticks < PAUSE_TICKS)
    ticks = missed + len(decisions)
    if missed < MIN_MISSED or missed <= MAX_MISSED_SHARE * ticks:
        return ""
    return f"{missed} of {ticks} ticks missed; end other programs, or fly with --realtime"
