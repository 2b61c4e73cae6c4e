"""Health lines of a daemon on standard error."""

from __future__ import annotations

import sys
from collections.abc import Callable
from contextvars import ContextVar

_IS_HIDDEN: ContextVar[bool] = ContextVar("health lines hidden", default=False)


def hide_health_lines() -> None:
    """Hide health lines from now on, in this process: a fleet shows the health of its daemons in a table."""
    _IS_HIDDEN.set(True)


def choose_line_writer() -> Callable[[str], object]:
    """Return the function that writes a line to standard error; it drops them where a live line or a table is shown."""
    if sys.stderr.isatty() or _IS_HIDDEN.get():
        return lambda _: None
    return lambda line: sys.stderr.write(line + "\n")
