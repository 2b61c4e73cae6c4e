"""Command `uavctl loopback`: simulated vehicle, cameras, lossy channel and the controller together."""

from __future__ import annotations

import multiprocessing
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from multiprocessing.connection import Connection as Pipe
from pathlib import Path
from typing import Annotated

import msgspec
from cyclopts import Parameter
from rich.progress import TaskProgressColumn, TimeRemainingColumn

from logs.recording.ends import create_recording, describe_ending, put_header
from logs.recording.recorder import DerivedTopics, Recorder
from logs.recording.summary import FlightSummary, make_summary_table
from logs.recording.topics import ENDED
from sim.server import Ready, serve_in_child
from uavctl.cli.common import (
    DEFAULTS,
    SEED,
    SPAN_S,
    Common,
    TakeOff,
    locate_design_errors,
    make_key_overrides,
    make_progress,
)
from uavctl.cli.flying import (
    Live,
    LivePort,
    check_take_off,
    choose_live_port,
    conclude_flight,
    make_goto_overrides,
    open_viewers,
    print_ending,
    record_failure,
)
from uavctl.cli.live_line import show_live_line
from uavctl.cli.output import warn
from uavctl.cli.signals import stop_on_signals
from uavctl.cli.signed_port import make_port_wrapper
from uavctl.clock import Ticker, monotonic_ns, read_zero_utc_ns
from uavctl.config import Config, LoadedConfig
from uavctl.daemon.daemon import fly
from uavctl.daemon.flight_orders import FlightOrders, TickFollower, check_places, compute_stop_limit_s
from uavctl.daemon.realtime import control_garbage_collection
from uavctl.errors import UavctlError, UsageError
from uavctl.flight.monitors.external import MAX_ANSWER_NS
from uavctl.io.signed_connection import open_links
from uavctl.lab.lockstep import TRUTH, LockstepFlight, check_length
from uavctl.loop import ControlLoop
from uavctl.operating_system import check_flight_platform
from uavctl.records import Sink, Truth
from uavctl.wiring.controller import Prepared, build_flight_design, prepare

START_LIMIT_S = 60.0


def loopback(
    *,
    common: Common = DEFAULTS,
    udp: Annotated[bool, Parameter(negative=(), help="real UDP sockets and real time, else lockstep")] = False,
    duration: Annotated[
        float | None, Parameter(help="length of the flight [s]; else duration_s", validator=SPAN_S)
    ] = None,
    seed: Annotated[int | None, Parameter(help="seed of every random draw; else sim.seed", validator=SEED)] = None,
    arm: Annotated[bool, Parameter(negative=(), help="begin on the ground, disarmed; needs --takeoff")] = False,
    takeoff: TakeOff = None,
    goto: Annotated[
        str | None, Parameter(help="x,y,z in local NED [m]: fly there and stay", allow_leading_hyphen=True)
    ] = None,
    out: Annotated[Path | None, Parameter(help="folder of the recording; else a new one below flights/")] = None,
    live: Live = False,
    live_port: LivePort = None,
) -> int:
    """Fly the simulated vehicle over a lossy link, record it, and report.

    In virtual time the same seed gives the same flight, bit for bit. It begins in the air; with --arm --takeoff HEIGHT
    on the ground, and after its duration it ends there too.
    """
    if udp:
        check_flight_platform()
    take_off_m = check_take_off(arm, takeoff)
    view_port = choose_live_port(live=live, port=live_port)
    if live and not udp:
        raise UsageError("--live needs --udp: in virtual time a flight is too short for a viewer")
    overrides = [*make_key_overrides(duration_s=duration, sim__seed=seed), *make_goto_overrides(goto)]
    summary = fly_simulated(
        common.with_overrides(overrides).load(),
        udp=udp,
        take_off_m=take_off_m,
        goto=goto is not None,
        out=out,
        view_port=view_port,
    )
    common.show("loopback", summary, lambda: make_summary_table(summary))
    return summary.ending.exit_code


def fly_simulated(
    loaded: LoadedConfig,
    *,
    udp: bool = False,
    take_off_m: float | None = None,
    goto: bool = False,
    out: Path | None = None,
    view_port: int | None = None,
    follower: TickFollower | None = None,
) -> FlightSummary:
    """Fly the simulated vehicle for the configured time, record it, and print how it ended.

    Args:
        loaded: The configuration and its source.
        udp: Over real sockets and in real time, else in lockstep and virtual time.
        take_off_m: Height of the climb above the ground [m]; None begins and ends in the air.
        goto: Whether the mission is the place of `--goto`.
        out: Folder of the recording; None makes a new one below `flights/`.
        view_port: TCP port of a live view; None: no view.
        follower: Called at every tick; may give orders.

    Raises:
        UavctlError: Nothing was flown; the message is the reason.
    """
    config = _use_loopback_ports(loaded.config) if udp else loaded.config
    check_length(config)
    with locate_design_errors(loaded):
        design = build_flight_design(config)
    orders = FlightOrders(config, take_off_m=take_off_m, goto=goto, follower=follower)
    with open_viewers(view_port) as viewers, create_recording(out, config.name, config.log) as path:
        with locate_design_errors(loaded):
            check_places(config, design, take_off_m, orders.goal)
            prepared = prepare(config, design)
        return _fly_real_time(prepared, path, orders, viewers) if udp else fly_lockstep(prepared, path, orders)


def fly_lockstep(prepared: Prepared, path: Path, orders: FlightOrders) -> FlightSummary:
    """Fly in virtual time, with a progress bar."""
    config = prepared.config
    flight = LockstepFlight(prepared, path)
    orders.begin(flight.loop)
    try:
        with (
            record_failure(flight.loop),
            stop_on_signals() as stopped,
            make_progress(TaskProgressColumn(), TimeRemainingColumn()) as progress,
        ):
            task = progress.add_task("flying in virtual time", total=config.duration_s)

            def show(flown_s: float) -> bool:
                progress.update(task, completed=flown_s)
                return not stopped()

            landing_s = compute_stop_limit_s(config, takes_off=True) if orders.takes_off else None
            flight.fly(show, observer=orders, landing_s=landing_s)
    finally:
        status = flight.close()
        print_ending(describe_ending(flight.loop.ending, status))
    summary = conclude_flight(path, flight.wall_s, status, flight.loop.ending)
    if config.smpc.controller:
        _warn_of_slow_answers(config, summary)
    return summary


def _warn_of_slow_answers(config: Config, summary: FlightSummary) -> None:
    """Warn of a controller that a flight in real time would not ask again."""
    median_us, largest_us = summary.decision_us.p50 or 0.0, summary.decision_us.max or 0.0
    if median_us <= config.daemon.tick_s * 1e6 and largest_us <= MAX_ANSWER_NS * 1e-3:
        return
    warn(
        f"{config.smpc.controller} took {median_us * 1e-3:.0f} ms (median; largest {largest_us * 1e-3:.0f} ms) in "
        f"virtual time; a flight in real time would end for this: a tick lasts {config.daemon.tick_s * 1e3:g} ms"
    )


def _fly_real_time(prepared: Prepared, path: Path, orders: FlightOrders, viewers: DerivedTopics) -> FlightSummary:
    config, takes_off = prepared.config, orders.takes_off
    tick_ns, dt_ns = round(config.daemon.tick_s * 1e9), round(config.plant.dt_s * 1e9)
    prepared.make_levels()
    with ExitStack() as stack:
        stopped = stack.enter_context(stop_on_signals())
        connections = stack.enter_context(open_links(config))
        recorder = Recorder(path, config.log, derived_topics=viewers)
        loop = ControlLoop(config, prepared.controller, recorder, time.perf_counter_ns)
        orders.begin(loop)
        loop.account.ends_in_flight = not takes_off
        wall_s = 0.0
        try:
            put_header(recorder, prepared, monotonic_ns(), read_zero_utc_ns())
            simulator = stack.enter_context(ExitStack())
            simulator.enter_context(_run_simulator(config, recorder, airborne=not takes_off))
            feed = simulator.enter_context(
                show_live_line(loop, recorder.status, config.duration_s, config.daemon.tick_s)
            )
            collector = simulator.enter_context(control_garbage_collection())
            begin_s = time.perf_counter()
            with record_failure(loop):
                fly(
                    loop,
                    connections,
                    Ticker(tick_ns, dt_ns),
                    stopped,
                    duration_s=config.duration_s,
                    stop_limit_s=lambda: compute_stop_limit_s(config, takes_off=True) if takes_off else 0.0,
                    give_orders=lambda ticked, _: orders.handle_tick(loop, ticked),
                    after_tick=(feed.after_tick, lambda *_: recorder.catch_up(), collector.after_tick),
                    on_events=feed.events.extend,
                )
            wall_s = time.perf_counter() - begin_s
            simulator.close()  # its last records go into the recording
        finally:
            recorder.put(ENDED, monotonic_ns(), loop.ending)
            status = recorder.close()
            print_ending(describe_ending(loop.ending, status))
    return conclude_flight(path, wall_s, status, loop.ending)


def _use_loopback_ports(config: Config) -> Config:
    """Return the configuration with connections on free ports of this machine."""
    with socket.socket(type=socket.SOCK_DGRAM) as first, socket.socket(type=socket.SOCK_DGRAM) as second:
        first.bind(("127.0.0.1", 0))
        second.bind(("127.0.0.1", 0))
        vehicle, mocap = (f"udpin://127.0.0.1:{s.getsockname()[1]}" for s in (first, second))
    return msgspec.structs.replace(config, daemon=msgspec.structs.replace(config.daemon, vehicle=vehicle, mocap=mocap))


@contextmanager
def _run_simulator(config: Config, sink: Sink, *, airborne: bool) -> Iterator[None]:
    """Run the simulated peers in a process of their own, which sends to the daemon's ports; record their truth.

    Raises:
        UavctlError: The simulator does not start.
    """
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    stop = context.Event()
    urls = [url.replace("udpin", "udpout") for url in (config.daemon.vehicle, config.daemon.mocap)]
    arguments = (sender, stop, config, *urls, None, airborne, make_port_wrapper(config.security))
    child = context.Process(target=serve_in_child, args=arguments, name="simulator")
    child.start()
    sender.close()
    listener = threading.Thread(target=_record_truth, args=(receiver, sink), name="truth", daemon=True)
    try:
        if not _wait_for_ready(receiver):
            raise UavctlError(f"the simulator did not start within {START_LIMIT_S:g} s; see the messages above")
        listener.start()
        yield
    finally:
        stop.set()
        child.join(START_LIMIT_S)
        if child.is_alive():
            child.kill()
        if listener.ident is not None:
            listener.join(START_LIMIT_S)
        receiver.close()


def _wait_for_ready(pipe: Pipe) -> bool:
    """Wait for the simulator's ports; return False if it ended or took too long."""
    try:
        return pipe.poll(START_LIMIT_S) and isinstance(pipe.recv(), Ready)
    except EOFError:
        return False


def _record_truth(pipe: Pipe, sink: Sink) -> None:
    """Record the truth of the simulator until its connection closes."""
    try:
        while True:
            message = pipe.recv()
            if isinstance(message, Truth):
                sink.put(TRUTH, message.at_ns, message)
    except EOFError:
        return
