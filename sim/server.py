"""Simulation server: simulated vehicles on real sockets, in real time or a multiple of it."""

from __future__ import annotations

import math
import signal
import socket
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from multiprocessing import parent_process
from multiprocessing.connection import Connection
from multiprocessing.synchronize import Event
from selectors import EVENT_READ, SelectSelector

from sim.autopilot.profile import SIMULATED
from sim.natnet import SCHEME, NatNetPort, make_motive_config
from sim.ports import Port, open_port
from sim.simulation import MOCAP, VEHICLE, Peers, SharedSpace, VehicleSnapshot
from uavctl.config.types import Config
from uavctl.errors import ConnectionSpecError
from uavctl.records import ClosestApproach, Collision, Truth

PortWrapper = Callable[[str, Port], Port]
"""Wraps the port of a connection, which is named `vehicle` or `mocap`."""
# Longest sleep, so that `stop` is asked often enough.
MAX_SLEEP_S = 0.05
SNAPSHOT_PERIOD_S = 0.25  # real time between two snapshots
# Overdue time is simulated in steps of at most this length, so work cannot pile up at a speed beyond this computer's.
MAX_STEP_NS = 100_000_000


@dataclass(frozen=True)
class Ready:
    """The ports are open; `vehicle` and `mocap` are their URLs, time starts at `start_ns` (monotonic)."""

    vehicle: str
    mocap: str
    start_ns: int


def compute_grid_start_ns(now_ns: int, dt_ns: int) -> int:
    """Return the next multiple of Δt on CLOCK_MONOTONIC [ns]: two processes share this grid without communication."""
    return -(-now_ns // dt_ns) * dt_ns


@dataclass(frozen=True)
class Encounters:
    """Encounters of the vehicles of a run; none if there was one vehicle."""

    start_ns: int  # when time began
    collisions: tuple[Collision, ...]  # in order of time
    closest_approaches: tuple[ClosestApproach, ...]  # one a pair


@dataclass(frozen=True)
class VehicleSetup:
    """One simulated vehicle: configuration, URLs (equal ones are one connection), and the receiver of its truth."""

    config: Config
    vehicle: str
    mocap: str
    on_truth: Callable[[Truth], None]


def serve(
    config: Config,
    vehicle_url: str,
    mocap_url: str,
    *,
    duration_s: float | None,
    airborne: bool,
    on_ready: Callable[[Ready], None],
    on_truth: Callable[[Truth], None],
    stop: Callable[[], bool],
    wrap_port: PortWrapper | None = None,
) -> None:
    """Run the peers of one vehicle in real time; see `serve_all`."""
    setup = VehicleSetup(config, vehicle_url, mocap_url, on_truth)
    serve_all((setup,), duration_s=duration_s, airborne=airborne, on_ready=on_ready, stop=stop, wrap_port=wrap_port)


def serve_all(
    setups: Sequence[VehicleSetup],
    *,
    duration_s: float | None,
    airborne: bool,
    on_ready: Callable[[Ready], None],
    stop: Callable[[], bool],
    speed: float = 1.0,
    on_snapshot: Callable[[tuple[VehicleSnapshot, ...]], None] | None = None,
    wrap_port: PortWrapper | None = None,
) -> Encounters:
    """Run the peers of each setup until `stop()` or the end of the duration; return how the vehicles met.

    All vehicles are in one space: they collide, and feel each other's downwash.

    Virtual time catches up after a delay. At a speed beyond this computer's, it runs as fast as possible.

    Args:
        setups: the vehicles; their URLs are udpout (PX4 sends *to* the client's port), udpin, or tcpin; those of the
            cameras may be natnet.
        duration_s: length of the run, in simulated time [s], None for ever.
        airborne: start flying in the external mode, else on the floor and disarmed.
        on_ready: called once for each vehicle, all ports being open.
        stop: asked at least every 50 ms.
        on_snapshot: gets snapshots of all vehicles four times a second of real time, and at the end; it must not block.
        wrap_port: wraps every port, None leaves them as they are.

    Raises:
        ConnectionSpecError: a URL is not understood or cannot be opened.
        ConfigError: vehicles touch at the start.
    """
    opened_ports: list[dict[str, Port]] = []
    try:
        for setup in setups:
            if setup.vehicle.startswith(f"{SCHEME}:"):
                raise ConnectionSpecError(f"{setup.vehicle}: a vehicle speaks no NatNet; give it to the cameras")
            ports: dict[str, Port] = {}
            opened_ports.append(ports)
            ports[VEHICLE] = open_port(setup.vehicle, SIMULATED[setup.config.sim.autopilot].greeting)
            if setup.mocap != setup.vehicle:
                ports[MOCAP] = open_port(setup.mocap)
            if wrap_port is not None:  # NatNet has no signatures
                mavlink_ports = {name: port for name, port in ports.items() if not isinstance(port, NatNetPort)}
                ports.update({name: wrap_port(name, port) for name, port in mavlink_ports.items()})
        # One grid for all: a multiple of every step.
        dt_ns = math.lcm(*(round(setup.config.plant.dt_s * 1e9) for setup in setups))
        clock = _Clock(compute_grid_start_ns(time.monotonic_ns(), dt_ns), speed)
        end_ns = None if duration_s is None else clock.start_ns + round(duration_s * 1e9)
        space = SharedSpace(
            [setup.config for setup in setups],
            [_make_peers(setup, ports, clock, airborne) for setup, ports in zip(setups, opened_ports, strict=True)],
        )
        for ports in opened_ports:
            on_ready(Ready(ports[VEHICLE].url, ports.get(MOCAP, ports[VEHICLE]).url, clock.start_ns))
        _run_space(space, opened_ports, clock, end_ns, stop, on_snapshot)
        return Encounters(clock.start_ns, space.collisions, space.closest_approaches)
    finally:
        for ports in opened_ports:
            for port in ports.values():
                port.close()


@dataclass(frozen=True)
class _Clock:
    """Simulated time, which runs `speed` times as fast as real time from `start_ns` on."""

    start_ns: int
    speed: float

    def now_ns(self) -> int:
        return self.start_ns + round((time.monotonic_ns() - self.start_ns) * self.speed)

    def compute_remaining_s(self, until_ns: int) -> float:
        """Return the real time until a simulated time [s]."""
        return max(0, until_ns - self.now_ns()) * 1e-9 / self.speed


def _make_peers(setup: VehicleSetup, ports: dict[str, Port], clock: _Clock, airborne: bool) -> Peers:
    shared = setup.mocap == setup.vehicle
    config, cameras = setup.config, ports.get(MOCAP)
    if isinstance(cameras, NatNetPort):
        config = make_motive_config(config)
    peers = Peers(config, clock.start_ns, airborne=airborne, shared_link=shared, on_truth=setup.on_truth)
    if isinstance(cameras, NatNetPort):
        cameras.clock_us = lambda: peers.cameras.clock_us(clock.now_ns())
    return peers


def _run_space(
    space: SharedSpace,
    opened_ports: Sequence[dict[str, Port]],
    clock: _Clock,
    end_ns: int | None,
    stop: Callable[[], bool],
    on_snapshot: Callable[[tuple[VehicleSnapshot, ...]], None] | None,
) -> None:
    sockets = [port for ports in opened_ports for port in ports.values()]
    last_ns = None if end_ns is None else end_ns - 1  # events at the end itself are not sent
    snapshot_s = time.monotonic()  # time of the next snapshot

    def compute_goal_ns(reached_ns: int) -> int:
        now_ns = clock.now_ns() if last_ns is None else min(clock.now_ns(), last_ns)
        return min(now_ns, reached_ns + MAX_STEP_NS)

    while not stop():
        if on_snapshot is not None and time.monotonic() >= snapshot_s:
            on_snapshot(tuple(peers.take_snapshot() for peers in space.peers))
            snapshot_s = time.monotonic() + SNAPSHOT_PERIOD_S
        reached_ns = max(peers.now_ns for peers in space.peers)
        to_ns = compute_goal_ns(reached_ns)
        if to_ns >= reached_ns:  # else the start of the grid is still to come
            for ports, due in zip(opened_ports, space.advance(to_ns), strict=True):
                for _, link, data in due:
                    ports[link].write(data)
        if last_ns is not None and all(peers.now_ns >= last_ns for peers in space.peers):
            break
        until_ns = min(peers.next_ns for peers in space.peers)
        if last_ns is not None:
            until_ns = min(until_ns, last_ns)
        _wait(sockets, min(clock.compute_remaining_s(until_ns), MAX_SLEEP_S))
        for peers, ports in zip(space.peers, opened_ports, strict=True):
            for link, port in ports.items():
                for data in port.read():
                    at_ns = compute_goal_ns(peers.now_ns)
                    if at_ns >= peers.now_ns:
                        space.interact(at_ns)
                        peers.receive(link, data, at_ns)
    for peers in space.peers:
        peers.flush()
    if on_snapshot is not None:
        on_snapshot(tuple(peers.take_snapshot() for peers in space.peers))


def _wait(ports: Sequence[Port], max_s: float) -> None:
    """Sleep for a time or until bytes come; by select(2), as epoll's sleep is in whole milliseconds."""
    sockets: list[socket.socket] = [sock for port in ports for sock in port.sockets()]
    with SelectSelector() as selector:
        for sock in sockets:
            selector.register(sock, EVENT_READ)
        selector.select(max_s)


def serve_in_child(
    pipe: Connection,
    stop: Event,
    config: Config,
    vehicle_url: str,
    mocap_url: str,
    duration_s: float | None,
    airborne: bool,
    wrap_port: PortWrapper | None = None,
) -> None:
    """Run `serve` in a child process: `Ready` and every `Truth` go into the pipe.

    Signals of the terminal are left to the parent, which sets `stop`; the child also ends when its parent is gone.
    """
    for number in (signal.SIGINT, signal.SIGQUIT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    parent = parent_process()
    try:
        serve(
            config,
            vehicle_url,
            mocap_url,
            duration_s=duration_s,
            airborne=airborne,
            on_ready=pipe.send,
            on_truth=pipe.send,
            stop=lambda: stop.is_set() or (parent is not None and not parent.is_alive()),
            wrap_port=wrap_port,
        )
    except BrokenPipeError:
        return  # the parent is gone
    finally:
        pipe.close()
