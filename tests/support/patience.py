"""Waiting for what other threads and processes do: for a condition, never for a time."""

from __future__ import annotations

import time
from collections.abc import Callable

LIMIT_S = 60.0  # for what is stuck, not for what is slow: a machine may have much else to do


def wait_until(condition: Callable[[], bool], what: str, *, pause_s: float = 0.02) -> None:
    """Wait until something holds.

    Args:
        condition: asked again and again, at least once.
        what: what is waited for, in words.
        pause_s: between two questions; 0 if the question itself waits.

    Raises:
        AssertionError: it does not within `LIMIT_S`.
    """
    end_s = time.monotonic() + LIMIT_S
    while not condition():
        assert time.monotonic() < end_s, f"{what}: not within {LIMIT_S:g} s"
        time.sleep(pause_s)
