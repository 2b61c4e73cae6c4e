"""Waiting for other threads and processes: for a condition, never for a time."""

from __future__ import annotations

import time
from collections.abc import Callable

LIMIT_S = 60.0  # detects a hang; a busy machine may be slow


def wait_until(condition: Callable[[], bool], what: str, *, pause_s: float = 0.02) -> None:
    """Wait until a condition is true.

    Args:
        condition: Checked repeatedly, at least once.
        what: Name of the condition for the message.
        pause_s: Pause between two checks; 0 if the check itself waits.

    Raises:
        AssertionError: It is not true within `LIMIT_S`.
    """
    end_s = time.monotonic() + LIMIT_S
    while not condition():
        assert time.monotonic() < end_s, f"{what}: not within {LIMIT_S:g} s"
        time.sleep(pause_s)
