"""The simulated peers on real sockets, in real time."""

from __future__ import annotations

import signal
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing import parent_process
from multiprocessing.connection import Connection
from multiprocessing.synchronize import Event
from selectors import EVENT_READ, SelectSelector

from sim.peers import MOCAP, VEHICLE, Peers
from sim.sockets import Port, open_port
from uavctl.config.types import Config
from uavctl.data import Truth

# Longest sleep, so that `stop` is asked often enough.
NAP_NS = 50_000_000


@dataclass(frozen=True)
class Ready:
    """The ports are open; `vehicle` and `mocap` are their URLs, time starts at `start_ns` (monotonic)."""

    vehicle: str
    mocap: str
    start_ns: int


def grid_start(now_ns: int, dt_ns: int) -> int:
    """The next multiple of Δt on CLOCK_MONOTONIC: a grid that two processes share without a word."""
    return -(-now_ns // dt_ns) * dt_ns


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
) -> None:
    """Run the peers until `stop()` or the end of the duration; what was missed is caught up in virtual time.

    Args:
        config: the whole configuration.
        vehicle_url: udpout (PX4 sends *to* the client's port), udpin, or tcpin.
        mocap_url: the same for the cameras; an equal URL is one connection.
        duration_s: length of the run [s], None for ever.
        airborne: start flying in the external mode, else on the floor and disarmed.
        on_ready: called once, the ports being open.
        on_truth: gets every `Truth`, see `Peers`.
        stop: asked at least every 50 ms.

    Raises:
        ConnectionSpecError: a URL is not understood or cannot be opened.
    """
    shared = vehicle_url == mocap_url
    ports: dict[str, Port] = {}
    try:
        ports[VEHICLE] = open_port(vehicle_url)
        if not shared:
            ports[MOCAP] = open_port(mocap_url)
        dt_ns = round(config.plant.dt_s * 1e9)
        start_ns = grid_start(time.monotonic_ns(), dt_ns)
        end_ns = None if duration_s is None else start_ns + round(duration_s * 1e9)
        peers = Peers(config, start_ns, airborne=airborne, shared_link=shared, on_truth=on_truth)
        on_ready(Ready(ports[VEHICLE].url, ports[VEHICLE if shared else MOCAP].url, start_ns))
        _run(peers, ports, end_ns, stop)
    finally:
        for port in ports.values():
            port.close()


def _run(peers: Peers, ports: dict[str, Port], end_ns: int | None, stop: Callable[[], bool]) -> None:
    while not stop():
        now_ns = time.monotonic_ns()
        if end_ns is not None and now_ns >= end_ns:
            break
        if now_ns >= peers.now_ns:  # else the start of the grid is still to come
            for _, link, data in peers.advance(now_ns):
                ports[link].write(data)
        until_ns = min(peers.next_ns, now_ns + NAP_NS, end_ns or peers.next_ns)
        _wait(ports, until_ns)
        for link, port in ports.items():
            for data in port.read():
                at_ns = time.monotonic_ns()
                if at_ns >= peers.now_ns:
                    peers.receive(link, data, at_ns)
    peers.flush()


def _wait(ports: dict[str, Port], until_ns: int) -> None:
    """Sleep until a time or the first incoming bytes; select(2), since epoll's sleep is in milliseconds."""
    sockets: list[socket.socket] = [one for port in ports.values() for one in port.sockets()]
    with SelectSelector() as selector:
        for one in sockets:
            selector.register(one, EVENT_READ)
        selector.select(max(0, until_ns - time.monotonic_ns()) * 1e-9)


def serve_in_child(
    pipe: Connection,
    stop: Event,
    config: Config,
    vehicle_url: str,
    mocap_url: str,
    duration_s: float | None,
    airborne: bool,
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
        )
    except BrokenPipeError:
        return  # nobody listens any more
    finally:
        pipe.close()
