"""Command `uavctl fly`."""

from __future__ import annotations

import os
import socket
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter
from rich.text import Text

from logs.recording.ends import create_recording, describe_ending, put_header
from logs.recording.parameters import ParameterReader
from logs.recording.recorder import Recorder, RecorderStatus
from logs.recording.summary import FlightSummary, make_summary_table
from logs.recording.topics import ENDED
from uavctl.build.controller import design_of, prepare
from uavctl.check.findings import Item
from uavctl.cli.common import DEFAULTS, SPAN_S, Common, Mocap, TakeOff, given_keys, labelled, located, messages
from uavctl.cli.flying import (
    Live,
    LivePort,
    checked_take_off,
    conclude,
    ending_noted,
    goto_overrides,
    live_line,
    live_view_port,
    onlookers,
    stand_by,
    stop_on_signals,
    tell_ending,
    wait_for_server,
)
from uavctl.clock import Ticker, monotonic_ns, read_zero_utc_ns
from uavctl.config import Config, LoadedConfig
from uavctl.config.connections import find_security_warnings
from uavctl.daemon.control_socket import ControlServer, find_control_folder, make_daemon_name, open_listener
from uavctl.daemon.daemon import AfterTick
from uavctl.daemon.daemon import fly as run_daemon
from uavctl.daemon.engagement import Engagement, TickFollower, check_places, compute_stop_limit_s
from uavctl.daemon.health import HealthMonitor, RecorderHealth
from uavctl.daemon.lock import lock_vehicle
from uavctl.daemon.notifier import Notifier
from uavctl.daemon.realtime import control_garbage_collection, enable_realtime
from uavctl.io.signed_connection import open_links
from uavctl.loop import ControlLoop

# What stands beside the control loop of `uavctl fly`: orders, health lines, the service manager, real time.


_UNREAD_LINES = 10  # health lines that wait for a slow terminal or log


@contextmanager
def operation(
    loop: ControlLoop, config: Config, path: Path, status: Callable[[], RecorderStatus], listener: socket.socket
) -> Iterator[Sequence[AfterTick]]:
    """Yield the function that the daemon calls after each tick; close its parts at the end.

    Raises:
        UsageError: the service manager's variables cannot be understood.
    """
    notifier = Notifier()
    with _health_lines() as show:

        def tell(line: str) -> None:
            notifier.send_status(line)
            show(line)

        def recorder() -> RecorderHealth:
            return recorder_health(status(), path)

        identity = (make_daemon_name(config), config.daemon.vehicle, os.getpid())
        watch = HealthMonitor(loop, config, identity, recorder, tell)
        server = ControlServer(listener, config, loop, watch.make_health)
        try:
            # The sign of life comes last: it stands for all that a tick has to do.
            yield watch.after_tick, server.after_tick, notifier.after_tick
        finally:
            notifier.send_status(f"ended: {loop.ending.sentence}")
            server.close()
            notifier.close()


@contextmanager
def as_realtime(wanted: bool) -> Iterator[Sequence[AfterTick]]:
    """Set real-time scheduling and memory if wanted; return the function to call after each tick."""
    with ExitStack() as stack:
        for outcome in stack.enter_context(enable_realtime()) if wanted else ():
            told = Text(f"--realtime: {outcome.name}: {outcome.text}")
            messages().print(
                told if outcome.is_applied else labelled("warning", told.plain, "bold yellow"), soft_wrap=True
            )
        yield (stack.enter_context(control_garbage_collection()).after_tick,)


@contextmanager
def _health_lines() -> Iterator[Callable[[str], None]]:
    """Write lines to standard error from a thread of its own, unless a terminal shows the live line instead."""
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
    """Return the state of a recording, for the flight's status."""
    reason = status.warning if status.ok else status.reason or status.refusal
    return RecorderHealth(
        ok=status.ok,
        dropped=status.dropped + status.refused + status.gone,
        reason=reason,
        path=str(path),
        unwritten_s=status.unwritten_s,
    )


# `uavctl fly`: the flight daemon on a real link. Without `--arm` it never asks for a mode but landing.


def fly(
    *,
    common: Common = DEFAULTS,
    vehicle: Annotated[str | None, Parameter(help="URL of the vehicle; else daemon.vehicle")] = None,
    mocap: Mocap = None,
    duration: Annotated[
        float | None, Parameter(help="hand over after this time [s]; else fly on", validator=SPAN_S)
    ] = None,
    arm: Annotated[bool, Parameter(negative=(), help="the vehicle may be armed; needs --takeoff")] = False,
    takeoff: TakeOff = None,
    goto: Annotated[
        str | None,
        Parameter(help="x,y,z in local NED [m]: fly there once in charge and stay", allow_leading_hyphen=True),
    ] = None,
    out: Annotated[Path | None, Parameter(help="folder of the recording; else a new one below flights/")] = None,
    control: Annotated[
        Path | None, Parameter(help="folder of the socket for `uavctl ctl`; else $UAVCTL_CONTROL or the user's own")
    ] = None,
    realtime: Annotated[bool, Parameter(negative=(), help="SCHED_FIFO and locked memory, as far as permitted")] = False,
    live: Live = False,
    live_port: LivePort = None,
) -> int:
    """Fly a vehicle that the pilot arms and switches to OFFBOARD or GUIDED; Ctrl-C hands it back.

    With --arm --takeoff HEIGHT the vehicle on the ground is armed, climbs by itself, and is flown from there; the end,
    by Ctrl-C or --duration, is its landing.

    Setpoints are streamed as soon as the vehicle is heard and there is an estimate, neutral ones until the pilot
    switches. When the pilot leaves the mode, streaming stops at once and does not come back.
    """
    take_off_m = checked_take_off(arm, takeoff)
    view_port = live_view_port(live=live, port=live_port)
    overrides = [*given_keys(daemon__vehicle=vehicle, daemon__mocap=mocap), *goto_overrides(goto)]
    summary = fly_daemon(
        common.with_overrides(overrides).load(),
        take_off_m=take_off_m,
        goto=goto is not None,
        duration_s=duration,
        out=out,
        control=control,
        as_realtime_process=realtime,
        view_port=view_port,
    )
    common.show("fly", summary, lambda: make_summary_table(summary))
    return summary.ending.exit_code


def fly_daemon(
    loaded: LoadedConfig,
    *,
    take_off_m: float | None = None,
    goto: bool = False,
    duration_s: float | None = None,
    out: Path | None = None,
    control: Path | None = None,
    as_realtime_process: bool = False,
    view_port: int | None = None,
    follower: TickFollower | None = None,
) -> FlightSummary:
    """Fly a vehicle until the end, record it, and say on the console how it ended.

    Args:
        loaded: the configuration, with where it is from.
        take_off_m: height of the climb above the ground [m]; None leaves arming and modes to the pilot.
        goto: whether the mission is the place of `--goto`.
        duration_s: hand over after this time [s]; None flies on.
        out: folder of the recording; None makes a new one below `flights/`.
        control: folder of the socket for orders; None is the user's own.
        as_realtime_process: SCHED_FIFO and locked memory, as far as permitted.
        view_port: TCP port of a live view; None is none.
        follower: looks at every tick, and may give orders.

    Raises:
        UavctlError: nothing was flown, and why.
    """
    config = loaded.config
    engagement = Engagement(config, take_off_m=take_off_m, goto=goto, follower=follower)
    tick_ns, dt_ns = round(config.daemon.tick_s * 1e9), round(config.plant.dt_s * 1e9)
    # First of all, so that a second daemon is refused at once.
    with (
        lock_vehicle(config.daemon.vehicle) as tenure,
        open_listener(find_control_folder(control), make_daemon_name(config)) as listener,
        onlookers(view_port) as looking,
        create_recording(out, config.name, config.log.free_bytes) as path,
    ):
        with located(loaded):
            design = design_of(config)
            check_places(config, design, take_off_m, engagement.goal)
            prepared = prepare(config, design)
        # an eighth of what loading `fly` would take
        from uavctl.cli.check import checked_before_arming, mission_items, record_items, record_parameters

        planned = () if take_off_m is None else mission_items(config, prepared)
        begun = time.perf_counter()
        with (
            as_realtime(as_realtime_process) as collect,
            stop_on_signals() as stopped,
            open_links(config, wait_for_server(stopped)) as connections,
        ):
            checked: tuple[Item, ...] = ()
            told = ParameterReader()
            if take_off_m is not None:
                checked = checked_before_arming(config, connections, stopped, take_off_m, told, planned)
            recorder = Recorder(path, config.log, onlookers=looking)
            loop = ControlLoop(config, prepared.controller, recorder, time.perf_counter_ns)
            engagement.begin(loop)
            asked_for = False
            try:
                put_header(recorder, prepared, monotonic_ns(), read_zero_utc_ns())
                record_items(recorder, checked, monotonic_ns())
                record_parameters(recorder, told, monotonic_ns())
                for warning in find_security_warnings(config.security, config.daemon):
                    messages().print(labelled("warning", warning), soft_wrap=True)
                if tenure.left_flight_ns is not None:
                    stand_by(loop, tenure.left_flight_ns)
                messages().print(f"recording to {path}; Ctrl-C hands over", soft_wrap=True)
                with (
                    live_line(loop, recorder, duration_s, config.daemon.tick_s) as shown,
                    operation(loop, config, path, recorder.status, listener) as beside,
                    ending_noted(loop),
                ):
                    asked_for = run_daemon(
                        loop,
                        connections,
                        Ticker(tick_ns, dt_ns),
                        stopped,
                        duration_s=duration_s,
                        stop_limit_s=compute_stop_limit_s(config, takes_off=engagement.takes_off),
                        after_tick=(
                            shown.after_tick,
                            lambda *_: tenure.update(loop.leaves_vehicle),
                            lambda *_: recorder.catch_up(),
                            lambda ticked, _: engagement.handle_tick(loop, ticked),
                            *beside,
                            *collect,
                        ),
                        on_events=shown.news.extend,
                    )
                if asked_for:
                    tenure.update(False)
            finally:
                ending = loop.ending
                recorder.put(ENDED, monotonic_ns(), ending)
                status = recorder.close()
                tell_ending(describe_ending(ending, status))
    return conclude(path, time.perf_counter() - begun, status, ending)
