"""Health lines of a daemon on standard error."""

from __future__ import annotations

import sys
import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

_MAX_UNREAD_LINES = 10  # health lines that wait for a slow terminal or log
_IS_HIDDEN: ContextVar[bool] = ContextVar("health lines hidden", default=False)


def hide_health_lines() -> None:
    """Hide health lines from now on, in this process: a fleet shows the health of its daemons in a table."""
    _IS_HIDDEN.set(True)


@contextmanager
def write_health_lines() -> Iterator[Callable[[str], None]]:
    """Write lines to standard error from a thread of its own, unless a live line or a table shows them instead."""
    lines: deque[str] = deque(maxlen=_MAX_UNREAD_LINES)
    if sys.stderr.isatty() or _IS_HIDDEN.get():
        yield lines.append
        return
    has_lines, done = threading.Event(), threading.Event()

    def write() -> None:
        while not done.is_set():
            has_lines.wait()
            has_lines.clear()
            while lines:
                sys.stderr.write(lines.popleft() + "\n")
                sys.stderr.flush()

    def append_line(line: str) -> None:
        lines.append(line)
        has_lines.set()

    thread = threading.Thread(target=write, name="health", daemon=True)
    thread.start()
    try:
        yield append_line
    finally:
        done.set()
        has_lines.set()
        thread.join(1.0)  # a slow reader does not delay the end of the daemon
