"""The flight daemon: wait, receive, step, send, record; nothing else.

The loop stops sending when it dies: there is no other thread that could re-send a setpoint.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

from uavctl.clock import Ticker, monotonic_ns
from uavctl.errors import UavctlError
from uavctl.loop import VEHICLE, ControlLoop
from uavctl.transport import Connection, wait


def fly(
    loop: ControlLoop,
    connections: Mapping[str, Connection],
    ticker: Ticker,
    stop_requested: Callable[[], bool],
    *,
    duration_s: float | None = None,
    stop_limit_s: float,
    wait_for: Callable[[Mapping[str, Connection], int], list[str]] = wait,
    now: Callable[[], int] = monotonic_ns,
) -> None:
    """Run the control loop in real time until it has handed the vehicle over.

    Args:
        loop: the loop, which records whatever it sees and does.
        connections: open connections by link name.
        ticker: the grid of ticks.
        stop_requested: asked once a tick; the first True begins the hand-over.
        duration_s: the hand-over begins by itself after this time [s]; None flies on.
        stop_limit_s: the hand-over is cut off after this time [s]; 0 ends without one.
        wait_for: sleeps until a deadline or the first arrival; gives the names of connections to read.
        now: the clock [ns].

    Raises:
        UavctlError: the vehicle's connection was closed by the other side.
    """
    first_ns: int | None = None
    stop_ns: int | None = None
    while not loop.finished:
        due = ticker.next()
        while True:
            _receive(loop, connections, wait_for(connections, due.at_ns))
            if now() >= due.at_ns:
                break
        if connections[VEHICLE].closed:
            raise UavctlError(
                f"{connections[VEHICLE].url}: closed by the other side, so nothing can be sent; "
                "the vehicle's own failsafe has it. See to the link and start again"
            )
        started_ns = now()
        first_ns = due.at_ns if first_ns is None else first_ns
        over = duration_s is not None and due.at_ns - first_ns >= duration_s * 1e9
        if stop_ns is None and (over or stop_requested()):
            stop_ns = due.at_ns
        if stop_ns is not None and due.at_ns - stop_ns >= stop_limit_s * 1e9:
            return
        for message in loop.tick(due.tick, due.at_ns, due.missed, stop=stop_ns is not None):
            connections[message.link].send(message.data)
        loop.timing(due.tick, due.at_ns, started_ns - due.at_ns, now() - due.at_ns)


def _receive(loop: ControlLoop, connections: Mapping[str, Connection], names: Iterable[str]) -> None:
    """Hand on what has arrived on the named connections."""
    for name in names:
        connection = connections[name]
        for index, (data, received_ns) in enumerate(connection.receive()):
            loop.receive(name, data, received_ns)
            if loop.heard_vehicle:  # cameras or a ground station may share the port
                connection.answer(index)
