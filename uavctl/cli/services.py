"""Services beside the control loop of `uavctl fly`: orders, health, the service manager, real-time scheduling."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

from rich.text import Text

from logs.recording.recorder import RecorderStatus
from uavctl.cli.health_lines import choose_line_writer
from uavctl.cli.output import label_text, print_message
from uavctl.config import Config
from uavctl.daemon.control_socket import ControlServer, TakeOffChecker, make_daemon_name
from uavctl.daemon.daemon import AfterTick
from uavctl.daemon.health import HealthMonitor, RecorderHealth
from uavctl.daemon.notifier import Notifier
from uavctl.daemon.realtime import control_garbage_collection, enable_realtime
from uavctl.loop import ControlLoop


@contextmanager
def run_services(
    loop: ControlLoop,
    config: Config,
    path: Path,
    status: Callable[[], RecorderStatus],
    listener: socket.socket,
    permit_take_off: Callable[[], None],
    take_off_checker: TakeOffChecker,
) -> Iterator[Sequence[AfterTick]]:
    """Yield the functions that the daemon calls after each tick; close the services at the end.

    Raises:
        UsageError: A variable of the service manager is not valid.
    """
    notifier, write_line = Notifier(), choose_line_writer()

    def report_health(line: str) -> None:
        notifier.send_status(line)
        write_line(line)

    def get_recorder_health() -> RecorderHealth:
        return make_recorder_health(status(), path)

    identity = (make_daemon_name(config), config.daemon.vehicle, os.getpid())
    monitor = HealthMonitor(loop, config, identity, get_recorder_health, report_health)
    server = ControlServer(listener, config, loop, monitor.make_health, permit_take_off, take_off_checker)
    try:
        # The sign of life comes last: it confirms all work of the tick.
        yield monitor.after_tick, server.after_tick, notifier.after_tick
    finally:
        notifier.send_status(f"ended: {loop.ending.sentence}")
        server.close()
        notifier.close()


@contextmanager
def enable_realtime_process(is_wanted: bool) -> Iterator[Sequence[AfterTick]]:
    """Set real-time scheduling and memory if wanted; yield the functions to call after each tick."""
    with ExitStack() as stack:
        for outcome in stack.enter_context(enable_realtime()) if is_wanted else ():
            text = Text(f"--realtime: {outcome.name}: {outcome.text}")
            print_message(text if outcome.is_applied else label_text("warning", text.plain, "bold yellow"))
        yield (stack.enter_context(control_garbage_collection()).after_tick,)


def make_recorder_health(status: RecorderStatus, path: Path) -> RecorderHealth:
    """Return the state of a recording, for the flight's status."""
    reason = status.warning if status.ok else status.reason or status.refusal
    return RecorderHealth(
        ok=status.ok,
        dropped=status.dropped + status.refused,
        reason=reason,
        path=str(path),
        unwritten_s=status.unwritten_s,
    )
