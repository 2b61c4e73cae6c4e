"""Time limit of a tick: a controller that never answers must not keep the loop from relaying and landing.

1. A thread counts its own wake-ups while a tick runs. A computer that stands still does not count.
2. At the limit it sends a signal to the main thread, whose handler raises in the tick. That also ends a sleep.
3. The signal comes again after each further limit, where code of another package has swallowed the error.

Code that never returns to the interpreter is not interrupted.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from uavctl.errors import TickOverdueError
from uavctl.flight.monitors.external import MAX_ANSWER_NS

LIMIT_S = 1.0  # 20 ticks; vehicles leave the external mode after 0.5 to 3 s without a setpoint
# With a controller of another package in control: a later answer would end the plans anyway, and a PX4 flies its last
# acceleration on for 0.7 s, which led out of a room of 6 m by 1.0 to 1.5 m.
ENGAGED_LIMIT_S = MAX_ANSWER_NS * 1e-9
_PERIOD_S = 0.05


class TickLimit:
    """Time limit of the ticks of the main thread."""

    def __init__(self, engaged_limit_s: float) -> None:
        self._engaged_limit_s = engaged_limit_s
        self._limit_s = LIMIT_S  # of the tick that runs
        self._is_running = False
        self._wakes = 0
        self._done = threading.Event()

    @contextmanager
    def apply(self, *, is_engaged: bool = False) -> Iterator[None]:
        """Raise in this block once it has taken too long.

        Args:
            is_engaged: whether the vehicle flies the setpoints.

        Raises:
            TickOverdueError: it has.
        """
        self._limit_s = self._engaged_limit_s if is_engaged else LIMIT_S
        self._wakes, self._is_running = 0, True
        try:
            yield
        finally:
            self._is_running = False

    def handle_signal(self, number: int, frame: FrameType | None) -> None:
        """Raise in the main thread, if a tick runs."""
        del number, frame
        if self._is_running:
            raise TickOverdueError(f"no end of the tick within {self._limit_s:g} s")

    def watch(self, thread: int) -> None:
        """Count while a tick runs, and send the signal at the limit; until `end`."""
        while not self._done.wait(_PERIOD_S):
            self._wakes += self._is_running
            # The first wake may come right after the tick began.
            if self._is_running and (self._wakes - 1) * _PERIOD_S >= self._limit_s:
                self._wakes = 0
                signal.pthread_kill(thread, signal.SIGURG)

    def end(self) -> None:
        """End the watch."""
        self._done.set()


@contextmanager
def limit_ticks(engaged_limit_s: float = LIMIT_S) -> Iterator[TickLimit]:
    """Yield the limit of the ticks of this thread, which is the main thread. Without room for a thread none applies.

    Args:
        engaged_limit_s: of a tick while the vehicle flies the setpoints [s].
    """
    limit, main_thread = TickLimit(engaged_limit_s), threading.main_thread()
    # The only signal that is ignored without a handler, and that no timer sends.
    previous = signal.signal(signal.SIGURG, limit.handle_signal)
    try:
        watcher = threading.Thread(target=limit.watch, args=(main_thread.ident,), name="tick limit", daemon=True)
        try:
            watcher.start()
        except (RuntimeError, MemoryError):
            yield limit
            return
        try:
            yield limit
        finally:
            limit.end()
            watcher.join()
    finally:
        signal.signal(signal.SIGURG, previous)
