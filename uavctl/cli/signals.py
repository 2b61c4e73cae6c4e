"""Signals that end a command in order: each signal that would kill the process, as far as it can be handled."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

from uavctl.errors import EndedBySignal


def _list_signals(*names: str) -> frozenset[signal.Signals]:
    """Return those of the signals that this operating system has."""
    return frozenset(signal.Signals[name] for name in names if hasattr(signal, name))


SIGNAL_EXIT_BASE = 128  # exit codes of a process that a signal has ended are this much higher than its number
# Sent on purpose by a person or a service manager. Only the second one of these ends the process at once: a closed
# terminal sends SIGHUP twice, and limits and timers repeat their signals.
DELIBERATE = _list_signals("SIGINT", "SIGTERM", "SIGQUIT")
# Signals that do not kill, cannot be handled, or report a fault of the process itself.
_EXCLUDED = _list_signals(
    *("SIGKILL", "SIGSTOP", "SIGCHLD", "SIGCONT", "SIGTSTP", "SIGTTIN", "SIGTTOU", "SIGURG", "SIGWINCH"),
    *("SIGSEGV", "SIGBUS", "SIGFPE", "SIGILL", "SIGABRT"),
)
# Signals of a terminal that stop a process; a stopped flight would send nothing, and hear no pilot.
_STOPPING = _list_signals("SIGTSTP", "SIGTTIN", "SIGTTOU")
END_LIMIT_S = 10  # from the second signal to the end of the process; the recording closes within 5 s

Handler = Callable[[int, FrameType | None], None]


@contextmanager
def handle_end_signals(handler: Handler) -> Iterator[None]:
    """Call a function at each signal that would kill the process; ignored signals stay ignored, as under nohup."""
    numbers = [
        number
        for number in signal.valid_signals() - _EXCLUDED
        if number in DELIBERATE or signal.getsignal(number) is signal.SIG_DFL
    ]
    previous = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield
    finally:
        for number, old in previous.items():
            signal.signal(number, signal.SIG_DFL if old is None else old)


@contextmanager
def ignore_stopping_signals() -> Iterator[None]:
    """Ignore Ctrl-Z, and the signals that stop a background process at its terminal."""
    previous = {number: signal.signal(number, signal.SIG_IGN) for number in _STOPPING}
    try:
        yield
    finally:
        for number, old in previous.items():
            signal.signal(number, signal.SIG_DFL if old is None else old)


@contextmanager
def stop_on_signals() -> Iterator[Callable[[], bool]]:
    """Yield a function that returns whether a signal has asked for the end.

    A second deliberate signal raises in the main thread. The system ends the process if that takes too long.
    """
    stop_requested, deliberate_requested = threading.Event(), threading.Event()

    def request_stop(number: int, frame: FrameType | None) -> None:
        del frame
        stop_requested.set()
        if number not in DELIBERATE:
            return
        if deliberate_requested.is_set():
            if hasattr(signal, "SIGALRM"):
                signal.signal(signal.SIGALRM, signal.SIG_DFL)
                signal.alarm(END_LIMIT_S)
            raise EndedBySignal(SIGNAL_EXIT_BASE + number)
        deliberate_requested.set()

    with handle_end_signals(request_stop):
        yield stop_requested.is_set
