"""The simulated peers on real sockets, in real time or a multiple of it."""

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

from sim.look import Look
from sim.peers import MOCAP, VEHICLE, Peers
from sim.personality import PERSONALITIES
from sim.sockets import Port, open_port
from uavctl.config.types import Config
from uavctl.data import Truth

Door = Callable[[str, Port], Port]
"""Puts something around the port of a connection, which is named `vehicle` or `mocap`."""
# Longest sleep, so that `stop` is asked often enough.
NAP_S = 0.05
LOOK_S = 0.25  # real time between two looks
# What is late is made up in strides of simulated time, so that a speed beyond this computer's cannot pile up work.
STRIDE_NS = 100_000_000


@dataclass(frozen=True)
class Ready:
    """The ports are open; `vehicle` and `mocap` are their URLs, time starts at `start_ns` (monotonic)."""

    vehicle: str
    mocap: str
    start_ns: int


def grid_start(now_ns: int, dt_ns: int) -> int:
    """The next multiple of Δt on CLOCK_MONOTONIC: a grid that two processes share without a word."""
    return -(-now_ns // dt_ns) * dt_ns


@dataclass(frozen=True)
class Seat:
    """One simulated vehicle: its configuration, its URLs (equal ones are one connection), and who hears the truth."""

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
    door: Door | None = None,
) -> None:
    """Run the peers of one vehicle in real time; see `serve_all`."""
    seat = Seat(config, vehicle_url, mocap_url, on_truth)
    serve_all((seat,), duration_s=duration_s, airborne=airborne, on_ready=on_ready, stop=stop, door=door)


def serve_all(
    seats: Sequence[Seat],
    *,
    duration_s: float | None,
    airborne: bool,
    on_ready: Callable[[Ready], None],
    stop: Callable[[], bool],
    speed: float = 1.0,
    on_look: Callable[[tuple[Look, ...]], None] | None = None,
    door: Door | None = None,
) -> None:
    """Run the peers of each seat until `stop()` or the end of the duration.

    What was missed is caught up in virtual time; at a speed that this computer does not reach, time goes as fast as it
    can.

    Args:
        seats: the vehicles; their URLs are udpout (PX4 sends *to* the client's port), udpin, or tcpin.
        duration_s: length of the run, in simulated time [s], None for ever.
        airborne: start flying in the external mode, else on the floor and disarmed.
        on_ready: called once for each vehicle, all ports being open.
        stop: asked at least every 50 ms.
        speed: simulated time per real time.
        on_look: gets a look at all the vehicles four times a second of real time, and one at the end; it must not wait.
        door: put around every port, None leaves them as they are.

    Raises:
        ConnectionSpecError: a URL is not understood or cannot be opened.
    """
    opened: list[dict[str, Port]] = []
    try:
        for seat in seats:
            ports: dict[str, Port] = {}
            opened.append(ports)
            ports[VEHICLE] = open_port(seat.vehicle, PERSONALITIES[seat.config.sim.autopilot].greeting)
            if seat.mocap != seat.vehicle:
                ports[MOCAP] = open_port(seat.mocap)
            if door is not None:
                ports.update({name: door(name, port) for name, port in ports.items()})
        # One grid for all: a multiple of every step.
        dt_ns = math.lcm(*(round(seat.config.plant.dt_s * 1e9) for seat in seats))
        clock = _Clock(grid_start(time.monotonic_ns(), dt_ns), speed)
        end_ns = None if duration_s is None else clock.start_ns + round(duration_s * 1e9)
        worlds = [_world(seat, ports, clock.start_ns, airborne) for seat, ports in zip(seats, opened, strict=True)]
        for ports in opened:
            on_ready(Ready(ports[VEHICLE].url, ports.get(MOCAP, ports[VEHICLE]).url, clock.start_ns))
        _run(worlds, clock, end_ns, stop, on_look)
    finally:
        for ports in opened:
            for port in ports.values():
                port.close()


@dataclass(frozen=True)
class _Clock:
    """Simulated time, `speed` times as quick as real time from `start_ns` on."""

    start_ns: int
    speed: float

    def now_ns(self) -> int:
        return self.start_ns + round((time.monotonic_ns() - self.start_ns) * self.speed)

    def left_s(self, until_ns: int) -> float:
        """Real time until a simulated time."""
        return max(0, until_ns - self.now_ns()) * 1e-9 / self.speed


_World = tuple[Peers, dict[str, Port]]


def _world(seat: Seat, ports: dict[str, Port], start_ns: int, airborne: bool) -> _World:
    shared = seat.mocap == seat.vehicle
    return Peers(seat.config, start_ns, airborne=airborne, shared_link=shared, on_truth=seat.on_truth), ports


def _run(
    worlds: Sequence[_World],
    clock: _Clock,
    end_ns: int | None,
    stop: Callable[[], bool],
    on_look: Callable[[tuple[Look, ...]], None] | None,
) -> None:
    sockets = [port for _, ports in worlds for port in ports.values()]
    last_ns = None if end_ns is None else end_ns - 1  # what happens at the end itself is not told any more
    look_s = time.monotonic()  # time of the next look

    def goal_ns(peers: Peers) -> int:
        now_ns = clock.now_ns() if last_ns is None else min(clock.now_ns(), last_ns)
        return min(now_ns, peers.now_ns + STRIDE_NS)

    while not stop():
        if on_look is not None and time.monotonic() >= look_s:
            on_look(tuple(peers.look() for peers, _ in worlds))
            look_s = time.monotonic() + LOOK_S
        for peers, ports in worlds:
            to_ns = goal_ns(peers)
            if to_ns >= peers.now_ns:  # else the start of the grid is still to come
                for _, link, data in peers.advance(to_ns):
                    ports[link].write(data)
        if last_ns is not None and all(peers.now_ns >= last_ns for peers, _ in worlds):
            break
        until_ns = min(peers.next_ns for peers, _ in worlds)
        if last_ns is not None:
            until_ns = min(until_ns, last_ns)
        _wait(sockets, min(clock.left_s(until_ns), NAP_S))
        for peers, ports in worlds:
            for link, port in ports.items():
                for data in port.read():
                    at_ns = goal_ns(peers)
                    if at_ns >= peers.now_ns:
                        peers.receive(link, data, at_ns)
    for peers, _ in worlds:
        peers.flush()
    if on_look is not None:
        on_look(tuple(peers.look() for peers, _ in worlds))


def _wait(ports: Sequence[Port], longest_s: float) -> None:
    """Sleep for a time or until the first incoming bytes; select(2), since epoll's sleep is in milliseconds."""
    sockets: list[socket.socket] = [one for port in ports for one in port.sockets()]
    with SelectSelector() as selector:
        for one in sockets:
            selector.register(one, EVENT_READ)
        selector.select(longest_s)


def serve_in_child(
    pipe: Connection,
    stop: Event,
    config: Config,
    vehicle_url: str,
    mocap_url: str,
    duration_s: float | None,
    airborne: bool,
    door: Door | None = None,
) -> None:
    """`serve` as the target of a child process: `Ready` and every `Truth` go into the pipe.

    Ctrl-C is left to the parent, which sets `stop`; the child also ends when its parent is gone.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
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
            door=door,
        )
    except BrokenPipeError:
        return  # nobody listens any more
    finally:
        pipe.close()
