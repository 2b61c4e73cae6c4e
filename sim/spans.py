"""Spans of time of a configuration, and which of several times is the next."""

from __future__ import annotations

from collections.abc import Iterable

from uavctl.config.section import Spans


def within(spans: Spans, since_ns: int) -> bool:
    """Whether a time since the start [ns] lies in one of the spans [s], their ends included."""
    return any(begin * 1e9 <= since_ns <= end * 1e9 for begin, end in spans)


def earliest(times_ns: Iterable[int | None]) -> int | None:
    """The first of some times [ns], None for none."""
    first_ns = None
    for at_ns in times_ns:
        if at_ns is not None and (first_ns is None or at_ns < first_ns):
            first_ns = at_ns
    return first_ns
