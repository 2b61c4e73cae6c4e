"""Command `uavctl fly`: the flight daemon on a real link. Without `--arm` it asks for no mode but landing."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from logs.recording.ends import create_recording, describe_ending, put_header
from logs.recording.parameters import ParameterReader
from logs.recording.recorder import Recorder
from logs.recording.summary import FlightSummary, make_summary_table
from logs.recording.topics import ENDED
from uavctl.check.findings import Item
from uavctl.cli.common import DEFAULTS, SPAN_S, Common, Mocap, TakeOff, locate_design_errors, make_key_overrides
from uavctl.cli.error_stream import limit_output_wait
from uavctl.cli.flying import (
    Live,
    LivePort,
    Ros2Choice,
    check_take_off,
    choose_live_port,
    conclude_flight,
    make_goto_overrides,
    open_viewers,
    order_stand_by,
    print_ending,
    print_warning,
    record_failure,
    wait_for_server,
)
from uavctl.cli.live_line import show_live_line
from uavctl.cli.output import label_text, print_message
from uavctl.cli.services import enable_realtime_process, run_services
from uavctl.cli.signals import ignore_stopping_signals, stop_on_signals
from uavctl.clock import Ticker, monotonic_ns, read_zero_utc_ns
from uavctl.config import LoadedConfig
from uavctl.config.connections import find_security_warnings
from uavctl.daemon.control_socket import find_control_folder, make_daemon_name, make_socket_path, open_listener
from uavctl.daemon.daemon import fly as run_daemon
from uavctl.daemon.flight_orders import FlightOrders, TickFollower, check_places, compute_stop_limit_s
from uavctl.daemon.landing_guard import guard_landing
from uavctl.daemon.lock import lock_vehicle
from uavctl.daemon.take_off_check import TakeOffCheck
from uavctl.daemon.tick_limit import ENGAGED_LIMIT_S, LIMIT_S, limit_ticks
from uavctl.errors import UsageError
from uavctl.io.signed_connection import open_links
from uavctl.loop import ControlLoop
from uavctl.mavlink.connection import VEHICLE
from uavctl.wiring.controller import build_flight_design, prepare


def fly(
    *,
    common: Common = DEFAULTS,
    vehicle: Annotated[str | None, Parameter(help="URL of the vehicle; else daemon.vehicle")] = None,
    mocap: Mocap = None,
    duration: Annotated[
        float | None, Parameter(help="brake and land after this time [s]; else fly on", validator=SPAN_S)
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
    ros2: Annotated[
        str | None, Parameter(help="namespace of ROS 2 to publish the flight in, from a process of its own")
    ] = None,
    ros2_orders: Annotated[
        bool, Parameter(negative=(), help="take orders of any node of ROS 2, below the namespace of --ros2")
    ] = False,
) -> int:
    """Fly a vehicle that the pilot arms and switches to OFFBOARD or GUIDED; Ctrl-C brakes, then lands it.

    Ctrl-C and the end of --duration brake and hold. Then the vehicle's own landing is requested (`fallback.land`; else
    the pilot takes the vehicle). The program ends once that landing has begun; after --takeoff, or where it passes
    positions on to the vehicle, once the vehicle is disarmed. A second Ctrl-C ends it at once; another process then
    asks for the landing.
    With --arm --takeoff HEIGHT the vehicle on the ground is armed, climbs by itself, and is flown from there.

    Setpoints are streamed as soon as the vehicle is heard and there is an estimate, neutral ones until the pilot
    switches. When the pilot leaves the mode, streaming stops at once and does not come back.
    """
    take_off_m = check_take_off(arm, takeoff)
    view_port = choose_live_port(live=live, port=live_port)
    if ros2_orders and ros2 is None:
        raise UsageError("--ros2-orders needs --ros2 NAMESPACE: orders are services below it")
    overrides = [*make_key_overrides(daemon__vehicle=vehicle, daemon__mocap=mocap), *make_goto_overrides(goto)]
    summary = fly_daemon(
        common.with_overrides(overrides).load(),
        take_off_m=take_off_m,
        goto=goto is not None,
        duration_s=duration,
        out=out,
        control=control,
        realtime=realtime,
        view_port=view_port,
        ros2=ros2,
        ros2_orders=ros2_orders,
    )
    with limit_output_wait():
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
    realtime: bool = False,
    view_port: int | None = None,
    ros2: str | None = None,
    ros2_orders: bool = False,
    follower: TickFollower | None = None,
) -> FlightSummary:
    """Fly a vehicle until the end, record it, and print how it ended.

    Args:
        loaded: The configuration and its source.
        take_off_m: Height of the climb above the ground [m]; None leaves arming and modes to the pilot.
        goto: Whether the mission is the place of `--goto`.
        duration_s: Brake and land after this time [s]; None flies on.
        out: Folder of the recording; None makes a new one below `flights/`.
        control: Folder of the socket for orders; None: the user's folder.
        realtime: SCHED_FIFO and locked memory, as far as permitted.
        view_port: TCP port of a live view; None: no view.
        ros2: Namespace of ROS 2 to publish the flight in; None: none.
        ros2_orders: Whether any node of ROS 2 may give orders.
        follower: Called at every tick; may give orders.

    Raises:
        UavctlError: Nothing was flown; the message is the reason.
    """
    config = loaded.config
    in_cells = config.mission.cells
    orders = FlightOrders(config, take_off_m=take_off_m, goto=goto, follower=follower, waits_for_fleet=in_cells)
    tick_ns, dt_ns = round(config.daemon.tick_s * 1e9), round(config.plant.dt_s * 1e9)
    folder, name = find_control_folder(control), make_daemon_name(config)
    ros2_choice = None if ros2 is None else Ros2Choice(ros2, (folder, name) if ros2_orders else None)
    # The lock comes first: it refuses a second daemon at once.
    with (
        lock_vehicle(config.daemon.vehicle) as vehicle_lock,
        open_listener(folder, name) as listener,
        open_viewers(view_port, ros2_choice, {config.name: make_socket_path(folder, name)}) as viewers,
        create_recording(out, config.name, config.log) as path,
    ):
        with locate_design_errors(loaded):
            design = build_flight_design(config)
            check_places(config, design, take_off_m, orders.goal)
            prepared = prepare(config, design)
        prepared.make_levels()
        # Loaded late: it takes an eighth of the loading time of `fly`.
        from uavctl.cli.check import (
            check_before_arming,
            make_mission_items,
            print_items,
            record_items,
            record_parameters,
        )

        mission_items = make_mission_items(config, prepared)  # also for a take-off that is ordered later
        begin_s = time.perf_counter()
        with (
            enable_realtime_process(realtime) as garbage_functions,
            ignore_stopping_signals(),
            stop_on_signals() as stopped,
            open_links(config, wait_for_server(stopped)) as connections,
        ):
            checked: tuple[Item, ...] = ()
            parameters = ParameterReader()
            if take_off_m is not None:
                checked = check_before_arming(config, connections, stopped, take_off_m, parameters, mission_items)
            recorder = Recorder(path, config.log, derived_topics=viewers)
            loop = ControlLoop(config, prepared.controller, recorder, time.perf_counter_ns)
            orders.begin(loop)

            def report_items(items: tuple[Item, ...]) -> None:
                print_items(items)
                record_items(recorder, items, monotonic_ns())

            region = prepared.controller.mission.rest_region
            checker = TakeOffCheck(config, loop, connections, region, mission_items, report_items)
            is_stop_requested = False
            try:
                put_header(recorder, prepared, monotonic_ns(), read_zero_utc_ns())
                record_items(recorder, checked, monotonic_ns())
                record_parameters(recorder, parameters, monotonic_ns())
                for warning in find_security_warnings(config.security, config.daemon):
                    print_message(label_text("warning", warning))
                if vehicle_lock.left_flight_ns is not None:
                    order_stand_by(loop, vehicle_lock.left_flight_ns)
                on_stop = "brakes and lands" if config.fallback.land else "brakes, then leaves the vehicle to the pilot"
                print_message(f"recording to {path}; Ctrl-C {on_stop}")
                if orders.takes_off and in_cells:
                    print_message("the take-off waits for the coordinator of the cells: `uavctl fleet fly`")
                with (
                    show_live_line(loop, recorder.status, duration_s, config.daemon.tick_s) as feed,
                    run_services(
                        loop, config, path, recorder.status, listener, orders.permit_take_off, checker
                    ) as service_functions,
                    record_failure(loop),
                    limit_ticks(ENGAGED_LIMIT_S if config.smpc.controller else LIMIT_S) as tick_limit,
                    guard_landing(loop, config, connections[VEHICLE], path, print_warning) as guard_functions,
                ):
                    is_stop_requested = run_daemon(
                        loop,
                        connections,
                        Ticker(tick_ns, dt_ns),
                        stopped,
                        duration_s=duration_s,
                        stop_limit_s=lambda: compute_stop_limit_s(config, takes_off=loop.account.takes_off),
                        give_orders=lambda ticked, _: orders.handle_tick(loop, ticked),
                        after_tick=(
                            *guard_functions,
                            feed.after_tick,
                            lambda *_: vehicle_lock.update(loop.leaves_vehicle),
                            lambda *_: recorder.catch_up(),
                            *service_functions,
                            *garbage_functions,
                        ),
                        limit_tick=lambda engaged: tick_limit.apply(is_engaged=engaged),
                        on_events=feed.events.extend,
                    )
                if is_stop_requested and loop.finished:  # not where the limit of the end broke it off
                    vehicle_lock.update(False)
            finally:
                ending = loop.ending
                recorder.put(ENDED, monotonic_ns(), ending)
                status = recorder.close()
                print_ending(describe_ending(ending, status))
    return conclude_flight(path, time.perf_counter() - begin_s, status, ending)
