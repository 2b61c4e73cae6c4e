"""Spans of time of a configuration."""

from __future__ import annotations

from uavctl.config.section import Spans


def within(spans: Spans, since_ns: int) -> bool:
    """Whether a time since the start [ns] lies in one of the spans [s], their ends included."""
    return any(begin * 1e9 <= since_ns <= end * 1e9 for begin, end in spans)
