"""What stands beside the control loop of `uavctl fly`: orders, health lines, the service manager, real time."""

from __future__ import annotations

import os
import socket
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

from logs.journal import RecorderStatus
from uavctl.cli.common import messages
from uavctl.clock import Due
from uavctl.config import Config
from uavctl.control_messages import daemon_name
from uavctl.control_socket import ControlServer
from uavctl.health import HealthWatch, RecorderHealth
from uavctl.loop import ControlLoop
from uavctl.notify import Notifier
from uavctl.realtime import collected_between_ticks, realtime

AfterTick = Callable[[Due, int], None]
_UNREAD_LINES = 10  # health lines that wait for a slow terminal or log


@contextmanager
def operation(
    loop: ControlLoop, config: Config, path: Path, status: Callable[[], RecorderStatus], listener: socket.socket
) -> Iterator[Sequence[AfterTick]]:
    """What the daemon calls after each tick; closed at the end.

    Raises:
        UsageError: the service manager's variables cannot be understood.
    """
    notifier = Notifier()
    with _health_lines() as show:

        def tell(line: str) -> None:
            notifier.status(line)
            show(line)

        def recorder() -> RecorderHealth:
            return recorder_health(status(), path)

        identity = (daemon_name(config), config.daemon.vehicle, os.getpid())
        watch = HealthWatch(loop, config, identity, recorder, tell)
        server = ControlServer(listener, config, loop, watch.look)
        try:
            # The sign of life comes last: it stands for all that a tick has to do.
            yield watch.after_tick, server.after_tick, notifier.after_tick
        finally:
            notifier.status(f"ended: {loop.ending.sentence}")
            server.close()
            notifier.close()


@contextmanager
def as_realtime(wanted: bool) -> Iterator[Sequence[AfterTick]]:
    """Real-time scheduling and memory if wanted, with what was not permitted told; what to call after each tick."""
    with ExitStack() as stack:
        for outcome in stack.enter_context(realtime()) if wanted else ():
            style = "" if outcome.ok else "[bold yellow]warning:[/] "
            messages().print(f"{style}--realtime: {outcome.part}: {outcome.text}", soft_wrap=True)
        yield (stack.enter_context(collected_between_ticks()).after_tick,)


@contextmanager
def _health_lines() -> Iterator[Callable[[str], None]]:
    """Write lines to standard error from a thread of its own, where no terminal shows the live line instead."""
    lines: deque[str] = deque(maxlen=_UNREAD_LINES)
    if sys.stderr.isatty():
        yield lines.append
        return
    news, done = threading.Event(), threading.Event()

    def write() -> None:
        while not done.is_set():
            news.wait()
            news.clear()
            while lines:
                sys.stderr.write(lines.popleft() + "\n")
                sys.stderr.flush()

    def show(line: str) -> None:
        lines.append(line)
        news.set()

    thread = threading.Thread(target=write, name="health", daemon=True)
    thread.start()
    try:
        yield show
    finally:
        done.set()
        news.set()
        thread.join(1.0)  # a reader that hangs does not keep the daemon


def recorder_health(status: RecorderStatus, path: Path) -> RecorderHealth:
    """How a recording is doing, for those who look at the flight."""
    reason = status.warning if status.ok else status.reason or status.refusal
    return RecorderHealth(
        ok=status.ok,
        dropped=status.dropped + status.refused + status.gone,
        reason=reason,
        path=str(path),
        unwritten_s=status.unwritten_s,
    )
