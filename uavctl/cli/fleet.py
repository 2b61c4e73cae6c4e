"""Command `uavctl fleet`: several vehicles from one file, landed together.

Each vehicle has a daemon, a process of its own, so an error in one does not reach the others.
1. With `spacing_m` each has a box of its own. Plans stay within the limits of their configuration, so vehicles with
   separate limits stay separate. A file whose boxes are too near is refused before anything is sent.
2. With `distance_m` all share one room, in moving cells; a thread of this process coordinates them.
If one vehicle ends otherwise than requested, its position is unknown: all others land.
"""

from __future__ import annotations

import math
import os
import select
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from itertools import combinations, zip_longest
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import App, Parameter
from rich.console import Group
from rich.live import Live
from rich.table import Table

from logs.recording.coordinator import CoordinatorRecording
from uavctl.arrays import SECOND_NS
from uavctl.cell_report import COLUMN_M
from uavctl.cli import main
from uavctl.cli.common import SPAN_S, Common, QuietJson, TakeOff
from uavctl.cli.ctl import send_request
from uavctl.cli.fleet_file import MAX_VEHICLES, Fleet, Member, read_fleet
from uavctl.cli.fleet_view import ShownVehicle, choose_ports, show_fleet_page
from uavctl.cli.flying import LivePort, check_take_off, choose_live_port, print_warning, run_page_process
from uavctl.cli.health_lines import hide_health_lines
from uavctl.cli.output import make_message_console, make_pair_table, make_table, print_message
from uavctl.cli.signals import stop_on_signals
from uavctl.cli.usage import format_example
from uavctl.clock import monotonic_ns, read_zero_utc_ns
from uavctl.daemon.cell_exchange import CellExchange, ExchangedVehicle, run_exchange
from uavctl.daemon.control_socket import ControlRequest, Reply, find_control_folder, make_socket_path
from uavctl.daemon.health import Health
from uavctl.errors import NotReachedError, UavctlError, in_words
from uavctl.fleet.coordinator import CellParameters
from uavctl.flight.limits import AXES
from uavctl.operating_system import check_flight_platform
from uavctl.wiring.cells import Coordinator
from uavctl.wiring.radio import RadioConfig, RadioLoad, compute_loads, compute_slot_ns

STATUS_PERIOD_S = 0.5  # between two requests for the status of all vehicles
POLL_S = 0.1  # between two checks of their processes
TABLE_PERIOD_S = 5.0  # between two tables where there is no terminal
RUNS, ORDERED = b".", b"x"  # to standard input of a daemon: the fleet's process runs; the end is ordered
# Without news of the fleet's process a daemon ends its flight: longer than a computer stands still that is only busy
STANDSTILL_S = 20.0
COORDINATOR_FILE = "coordinator.mcap"

fleet_app = App(
    name="fleet",
    help="Fly several vehicles from one file: check, fly, status, land.",
    help_epilogue=format_example("fleet"),
    help_format="markdown",
)
HealthByName = dict[str, Health | None]  # None where no daemon answers

FleetLive = Annotated[
    bool, Parameter(negative=(), help="show all vehicles on one page to browsers on this machine, and each on its own")
]
File = Annotated[Path, Parameter(help="TOML file: spacing_m or distance_m, and a [[vehicle]] table for each vehicle")]


@fleet_app.command(help_epilogue=format_example("fleet check"))
def check(file: File, /, *, json: QuietJson = False) -> int:
    """Check whether a fleet can be flown: its configurations, links, boxes, and what its radio carries; sends nothing.

    Exit code 1: the radio does not carry all vehicles.
    """
    fleet = read_fleet(file)
    loads = compute_loads(fleet.radio, [m.config for m in fleet.members], MAX_VEHICLES)
    carried = max((load.vehicles for load in loads if load.is_carried), default=0)
    document: dict[str, object] = {
        "vehicles": [
            {"name": member.name, "daemon": member.daemon, "url": member.config.daemon.vehicle}
            for member in fleet.members
        ],
        "nearest_m": fleet.nearest_m if math.isfinite(fleet.nearest_m) else None,
    }
    if fleet.cells is not None:
        document["cells"] = _describe_cells(fleet.cells)
    if fleet.radio.has_budget:
        document["radio"] = {
            "slot_s": compute_slot_ns(fleet.radio) / SECOND_NS,
            "carried": carried,
            "loads": [load._asdict() for load in loads],
        }

    def make_tables() -> Group:
        tables = [_make_box_table(fleet)] if fleet.cells is None else [_make_room_table(fleet, fleet.cells)]
        if fleet.radio.has_budget:
            tables.append(_make_radio_table(fleet.radio, len(fleet.members), carried, loads))
        return Group(*tables)

    Common(json=json).show("fleet/check", document, make_tables)
    return 1 if fleet.radio.has_budget and carried < len(fleet.members) else 0


@fleet_app.command(help_epilogue=format_example("fleet fly"))
def fly(
    file: File,
    /,
    *,
    duration: Annotated[
        float | None, Parameter(help="brake and land after this time [s]; else fly on", validator=SPAN_S)
    ] = None,
    arm: Annotated[bool, Parameter(negative=(), help="the vehicles may be armed; needs --takeoff")] = False,
    takeoff: TakeOff = None,
    out: Annotated[Path, Parameter(help="folder of the recordings, one below it for each vehicle")],
    live: FleetLive = False,
    live_port: LivePort = None,
    json: QuietJson = False,
) -> int:
    """Fly all vehicles of a file, each by a daemon of its own; Ctrl-C lands them all, or hands them over.

    When one ends otherwise than it was asked to, the others are landed, too. Exit code: the largest of theirs.
    With `distance_m` all first come to rest in their cells. `coordinator.mcap` has each cycle of the coordinator.
    """
    check_flight_platform()
    check_take_off(arm, takeoff)
    view_port = choose_live_port(live=live, port=live_port)
    fleet = read_fleet(file)
    options = [] if duration is None else ["--duration", str(duration)]
    options += ["--arm", "--takeoff", str(takeoff)] if takeoff is not None else []
    ports = [] if view_port is None else choose_ports(len(fleet.members))
    flights = [
        FleetFlight(member, [*options, "--out", str(out / member.name), *_make_live_options(port)])
        for member, port in zip_longest(fleet.members, ports)
    ]
    coordination: Coordination | None = None
    with (
        stop_on_signals() as stopped,
        _show_status(flights) as health,
        _open_page(f"uavctl fleet: {file.stem}", view_port, flights, ports, health),
        ExitStack() as stack,
    ):
        if fleet.cells is not None:
            coordination = stack.enter_context(coordinate(fleet, fleet.cells, out / COORDINATOR_FILE))
        for flight in flights:
            flight.start()
        end = FleetEnd(flights, coordination)
        while any(flight.is_running() for flight in flights):
            end.update("ordered" if stopped() else _find_failure(flights, health))
            for flight in flights:
                flight.tell_running()
            time.sleep(POLL_S)
        for flight in flights:
            flight.join_output()
    page = _draw_page(out)
    document = {
        "vehicles": [
            {"name": flight.member.name, "exit_code": flight.exit_code, "out": str(out / flight.member.name)}
            for flight in flights
        ],
        "report": None if page is None else str(page),
    }
    Common(json=json).show("fleet/fly", document, lambda: _make_exit_table(flights))
    code = max((flight.exit_code or 0 for flight in flights), default=0)
    return code if coordination is None or not coordination.problem else max(code, 1)


@fleet_app.command(help_epilogue=format_example("fleet status"))
def status(
    file: File, /, *, control: Annotated[Path | None, Parameter(show=False)] = None, json: QuietJson = False
) -> int:
    """Show the state of all vehicles of a file in one table. Exit code 1: not all daemons answer."""
    fleet, folder = read_fleet(file), find_control_folder(control)
    health = _read_health(fleet.members, folder)
    Common(json=json).show("fleet/status", {"vehicles": health}, lambda: _make_status_table(health))
    return 0 if all(health.values()) else 1


@fleet_app.command(help_epilogue=format_example("fleet land"))
def land(file: File, /, *, control: Annotated[Path | None, Parameter(show=False)] = None) -> int:
    """Land all vehicles of a file; those in cells first come to rest. Exit code 1: not all of them take the order."""
    fleet, folder, all_accepted = read_fleet(file), find_control_folder(control), True
    with stop_on_signals():  # Ctrl-C leaves none without the order to land
        replies = _ask_all(fleet.members, folder, "land")
    for member, reply in zip(fleet.members, replies, strict=True):
        if isinstance(reply, NotReachedError):
            verdict, text = "not reached", str(reply)
        else:
            verdict, text = ("accepted" if reply.ok else "refused"), reply.text
        all_accepted = all_accepted and verdict == "accepted"
        print_message(f"{member.name}: land {verdict}: {text}", highlight=False)
    return 0 if all_accepted else 1


def _make_live_options(port: int | None) -> tuple[str, ...]:
    return () if port is None else ("--live", "--live-port", str(port))


@contextmanager
def _open_page(
    title: str,
    live_port: int | None,
    flights: Sequence[FleetFlight],
    ports: Sequence[int],
    health_by_name: HealthByName,
) -> Iterator[None]:
    """Serve the live page of all vehicles; without a port there is none."""
    if live_port is None:
        yield
        return
    folder = find_control_folder(None)
    vehicles = [
        ShownVehicle(
            flight.member.name,
            port,
            make_socket_path(folder, flight.member.daemon),
            partial(health_by_name.get, flight.member.name),
            partial(getattr, flight, "exit_code"),
        )
        for flight, port in zip(flights, ports, strict=True)
    ]
    with show_fleet_page(title, live_port, vehicles):
        yield


def _draw_page(folder: Path) -> Path | None:
    """Draw the page of all recordings, and print its first line; a failure is only printed."""
    from logs.report.fleet import PAGE, is_fleet_folder

    page = folder / PAGE
    if not is_fleet_folder(folder):  # no daemon came so far
        return None
    try:
        with stop_on_signals():  # the flights are over: a first signal ends nothing any more
            line = run_page_process("logs.report.fleet_page", folder, page)
    except UavctlError as error:
        print_warning(f"no page: {error}")
        return None
    print_message(f"{line}\npage: {page}".strip(), highlight=False)
    return page


class FleetFlight:
    """The daemon of one vehicle, as a process."""

    def __init__(self, member: Member, options: Sequence[str]) -> None:
        self.member = member
        daemon_code = "from uavctl.cli.fleet import run_fleet_daemon; run_fleet_daemon()"
        self._command = [sys.executable, "-P", "-c", daemon_code, "fly", *member.options, *options]
        self._process: subprocess.Popen[str] | None = None
        self._output_thread = threading.Thread(target=self._print_output, name=member.name, daemon=True)

    @property
    def exit_code(self) -> int | None:
        """Exit code of the flight, 128 more than its number for a signal; None while it lasts."""
        code = None if self._process is None else self._process.poll()
        return code if code is None or code >= 0 else 128 - code

    def start(self) -> None:
        """Start the daemon; its output is printed with the vehicle's name before each line."""
        # Ctrl-C of a terminal goes to all processes of its session: a second signal would end a daemon at once.
        self._process = subprocess.Popen(
            self._command,
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            errors="replace",
            start_new_session=True,
        )
        assert self._process.stdin is not None
        os.set_blocking(self._process.stdin.fileno(), False)
        self._output_thread.start()

    def is_running(self) -> bool:
        """Return whether the daemon runs."""
        return self._process is not None and self._process.poll() is None

    def request_fallback(self) -> None:
        """Request the end, as Ctrl-C does: the vehicle brakes, holds, and lands or is handed over."""
        self._write(ORDERED)

    def tell_running(self) -> None:
        """Tell the daemon that this process does not stand still."""
        self._write(RUNS)

    def _write(self, data: bytes) -> None:
        if self._process is not None and self._process.stdin is not None:
            with suppress(OSError):  # the daemon has ended, or stands still and has not read for hours
                os.write(self._process.stdin.fileno(), data)

    def join_output(self) -> None:
        """Wait until the output of the daemon is printed, not for a child process that keeps it open."""
        self._output_thread.join(TABLE_PERIOD_S)
        if self._process is not None and self._process.stdin is not None:
            self._process.stdin.close()
            self._process.stdin = None

    def _print_output(self) -> None:
        assert self._process is not None and self._process.stderr is not None
        with self._process.stderr as lines:
            for line in lines:
                text = line.rstrip()
                if text:
                    print_message(f"{self.member.name}: {text}", highlight=False)


class FleetEnd:
    """The end of all flights, for the first reason that there is."""

    def __init__(self, flights: Sequence[FleetFlight], coordination: Coordination | None) -> None:
        self._flights, self._coordination = flights, coordination
        self._is_requested = False

    def update(self, reason: str) -> None:
        """Request the end of all flights once there is a reason."""
        if self._coordination is not None:
            reason = reason or self._coordination.problem
        if self._is_requested or not reason:
            return
        self._is_requested = True
        print_message(f"{reason}: all vehicles end their flights", highlight=False)
        for flight in self._flights:
            flight.request_fallback()


class Coordination:
    """The coordinator of the moving cells, in a thread of its own.

    Attributes:
        exchange: with the daemons.
        failure: error of the thread; empty without one.
    """

    def __init__(self, exchange: CellExchange) -> None:
        self.exchange, self.failure = exchange, ""

    @property
    def problem(self) -> str:
        """Why the flights have to end; empty without a reason."""
        return self.failure or self.exchange.problem

    def run(self, is_over: Callable[[float], bool]) -> None:
        """Run until the end; an error is a failure."""
        try:
            run_exchange(self.exchange, is_over)
        except Exception as error:  # noqa: BLE001 the vehicles hold in their last cells, and then all land
            self.failure = f"the coordinator has failed ({in_words(error)})"


@contextmanager
def coordinate(fleet: Fleet, parameters: CellParameters, path: Path) -> Iterator[Coordination]:
    """Coordinate the vehicles from a thread, and record each cycle.

    Raises:
        RecordingError: There is such a file, or it cannot be made.
    """
    folder, coordinator = find_control_folder(None), Coordinator(parameters, len(fleet.members))
    names = [member.name for member in fleet.members]

    with CoordinatorRecording(
        path, names, parameters, start_ns=monotonic_ns(), zero_utc_ns=read_zero_utc_ns()
    ) as recording:
        sockets = [make_socket_path(folder, member.daemon) for member in fleet.members]
        vehicles = [ExchangedVehicle(name, path) for name, path in zip(names, sockets, strict=True)]
        exchange = CellExchange(coordinator, vehicles, lambda at_ns: recording.add(at_ns, coordinator), print_message)
        coordination = Coordination(exchange)
        done = threading.Event()
        thread = threading.Thread(target=coordination.run, args=(done.wait,), name="cells", daemon=True)
        thread.start()
        try:
            yield coordination
        finally:
            done.set()
            thread.join(TABLE_PERIOD_S)
    if recording.failure:
        print_message(f"{path}: the recording lacks cycles ({recording.failure}); check the disk")


def wait_for_end(descriptor: int, standstill_s: float) -> Literal["ordered", "killed", "stands still"]:
    """Wait for the end of a flight, and return why it has come: nothing else supervises the spacing.

    Args:
        descriptor: Pipe from the fleet's process: a byte each 0.1 s, `ORDERED` for the end; it closes with the process.
        standstill_s: Time without a byte after which the process counts as one that stands still [s].
    """
    # Without `sys.stdin`: this thread would hold its lock, and the interpreter would abort at its end.
    while select.select([descriptor], [], [], standstill_s)[0]:
        data = os.read(descriptor, 4096)
        if not data:
            return "killed"
        if ORDERED in data:
            return "ordered"
    return "stands still"


def run_fleet_daemon() -> None:
    """Run the command line as a daemon of a fleet; raise Ctrl-C once the fleet's process orders the end, or is gone."""

    def end() -> None:
        wait_for_end(0, STANDSTILL_S)
        signal.raise_signal(signal.SIGINT)

    try:
        threading.Thread(target=end, name="fleet", daemon=True).start()
        hide_health_lines()  # the fleet's table has the health of each vehicle
        main()
    except KeyboardInterrupt:  # before the command line answers signals
        sys.exit(128 + signal.SIGINT)


def _find_failure(flights: Sequence[FleetFlight], health_by_name: HealthByName) -> str:
    """Return the failure of a vehicle: the envelope let it go, or its daemon failed; empty if there is none."""
    for flight in flights:
        name, health = flight.member.name, health_by_name.get(flight.member.name)
        if flight.exit_code:
            return f"the daemon of {name} has ended with exit code {flight.exit_code}"
        if health is not None and health.let_go:
            return f"{name} is let go ({health.let_go})"
    return ""


@contextmanager
def _show_status(flights: Sequence[FleetFlight]) -> Iterator[HealthByName]:
    """Show the status of all vehicles from a thread of its own; yield the newest health of each."""
    done, console, folder, health_by_name = (
        threading.Event(),
        make_message_console(),
        find_control_folder(None),
        HealthByName(),
    )

    def refresh() -> Table:
        health_by_name.update({flight.member.name: None for flight in flights if not flight.is_running()})
        health_by_name.update(_read_health([flight.member for flight in flights if flight.is_running()], folder))
        return _make_status_table(health_by_name)

    def draw() -> None:
        if console.is_terminal:
            with Live(console=console, auto_refresh=False, transient=True) as live:
                while not done.wait(STATUS_PERIOD_S):
                    live.update(refresh(), refresh=True)
            return
        printed_s = -TABLE_PERIOD_S
        while not done.wait(STATUS_PERIOD_S):
            table = refresh()
            if time.monotonic() - printed_s >= TABLE_PERIOD_S:
                printed_s = time.monotonic()
                console.print(table)

    thread = threading.Thread(target=draw, name="fleet", daemon=True)
    thread.start()
    try:
        yield health_by_name
    finally:
        done.set()
        thread.join(TABLE_PERIOD_S)


def _ask_all(members: Sequence[Member], folder: Path, ask: Literal["land", "status"]) -> list[Reply | NotReachedError]:
    """Ask all daemons at once: one that hangs delays no other."""

    def send(member: Member) -> Reply | NotReachedError:
        try:
            return send_request(ControlRequest(ask=ask), folder, member.daemon)
        except NotReachedError as error:
            return error

    with ThreadPoolExecutor(len(members)) as pool:
        return list(pool.map(send, members))


def _read_health(members: Sequence[Member], folder: Path) -> HealthByName:
    """Return the health of vehicles; None where a daemon does not answer."""
    replies = _ask_all(members, folder, "status") if members else []
    return {
        member.name: None if isinstance(reply, NotReachedError) else reply.status
        for member, reply in zip(members, replies, strict=True)
    }


def _make_status_table(health_by_name: HealthByName) -> Table:
    rows = []
    in_cells = any(health is not None and health.cell is not None for health in health_by_name.values())
    distances_m = find_nearest_m(health_by_name)
    for name, health in health_by_name.items():
        if health is None:
            rows.append([name, "-", "no daemon answers", "-", "-", "-", *(["-"] * 3 if in_cells else [])])
            continue
        vehicle = health.vehicle
        position = health.position_m
        rows.append(
            [
                name,
                "waiting" if health.mode is None else health.mode.value,
                health.ending or health.who_flies or "-",
                "not heard" if vehicle is None else f"{vehicle.mode}, {'armed' if vehicle.armed else 'disarmed'}",
                "-" if health.age_s is None else f"{health.age_s:.2f} s",
                "-" if position is None else ", ".join(f"{value:+.2f}" for value in position.values()),
            ]
        )
        if in_cells:
            distance_m = distances_m.get(name)
            rows[-1] += [
                str(health.cell or "-"),
                health.conduct or "-",
                "-" if distance_m is None else f"{distance_m:.2f}",
            ]
    headings = ("vehicle", "mode", "in control", "autopilot", "age", "position NED [m]")
    more = ("cell", "moves", "nearest [m]") if in_cells else ()
    return make_table("", (*headings, *more), rows, (*headings[:4], *more[1:2]), fold=True)


def find_nearest_m(health_by_name: HealthByName) -> dict[str, float]:
    """Find the distance of each vehicle to the nearest other one [m], by their estimates; without height."""
    places = {
        name: health.position_m
        for name, health in health_by_name.items()
        if health is not None and health.position_m is not None
    }
    nearest_m: dict[str, float] = {}
    for (name, place), (other_name, other) in combinations(places.items(), 2):
        apart_m = math.hypot(*(place[axis] - other[axis] for axis in AXES[:2] if axis in place and axis in other))
        for one in (name, other_name):
            nearest_m[one] = min(apart_m, nearest_m.get(one, math.inf))
    return nearest_m


def _describe_cells(cells: CellParameters) -> dict[str, float]:
    """Describe what the distance of moving cells means; lengths in metres."""
    return {
        "distance_m": cells.distance_m,
        "margin_m": cells.margin_m,
        "start_distance_m": cells.distance_m + 2.0 * (COLUMN_M + cells.margin_m),
        "silence_s": cells.silence_s,
    }


def _make_room_table(fleet: Fleet, cells: CellParameters) -> Table:
    figures = _describe_cells(cells)
    texts = {
        "vehicles": ", ".join(member.name for member in fleet.members),
        **{
            f"{axis} [m]": f"{low:g} to {high:g}"
            for axis, low, high in zip(AXES, cells.room_lower_m, cells.room_upper_m, strict=True)
        },
        "cells apart, north or east": f"{figures['distance_m']:g} m; height does not count",
        "centres apart in flight": f"more: each cell also holds its plan's margins and {figures['margin_m']:g} m",
        "centres apart at the start": f"{figures['start_distance_m']:.2f} m, north or east",
    }
    return make_pair_table("one room for all: moving cells", list(texts.items()))


def _make_box_table(fleet: Fleet) -> Table:
    rows = []
    for member in fleet.members:
        sides = [f"{low:g} to {high:g}" for low, high in map(member.get_limits_m, AXES)]
        rows.append([member.name, member.config.daemon.vehicle, *sides])
    title = "one vehicle" if not math.isfinite(fleet.nearest_m) else f"nearest boxes {fleet.nearest_m:.2f} m apart"
    return make_table(
        title, ("vehicle", "link", *(f"{axis} [m]" for axis in AXES)), rows, ("vehicle", "link"), fold=True
    )


def _make_radio_table(radio: RadioConfig, count: int, carried: int, loads: Sequence[RadioLoad]) -> Table:
    rows = [
        [
            f"{load.vehicles}{' (this fleet)' if load.vehicles == count else ''}",
            f"{load.wait_s:.3f}",
            f"{load.mean_age_s:.3f}",
            f"{load.silence_probability:.2g}",
            "yes" if load.is_carried else "no",
        ]
        for load in loads
    ]
    title = f"radio: {SECOND_NS / compute_slot_ns(radio):.0f} positions a second, {radio.schedule}, {carried} vehicles"
    headings = ("vehicles", "longest wait [s]", "mean age in turns [s]", "P(no position in the horizon)", "carried")
    return make_table(title, headings, rows, headings[:1], fold=True)


def _make_exit_table(flights: Sequence[FleetFlight]) -> Table:
    rows = [[flight.member.name, str(flight.exit_code)] for flight in flights]
    return make_table("how the daemons ended", ("vehicle", "exit code"), rows)
