"""The flight daemon: wait, receive, step, send, record; nothing else.

The loop stops sending when it dies: there is no other thread that could re-send a setpoint.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence

from uavctl.clock import Due, Ticker, monotonic_ns
from uavctl.errors import UavctlError
from uavctl.loop import SECOND_NS, VEHICLE, ControlLoop
from uavctl.transport import Connection, wait

PAUSE_NS = 1_000_000  # after a read that gave nothing


def fly(
    loop: ControlLoop,
    connections: Mapping[str, Connection],
    ticker: Ticker,
    stop_requested: Callable[[], bool],
    *,
    duration_s: float | None = None,
    stop_limit_s: float,
    after_tick: Sequence[Callable[[Due, int], None]] = (),
    wait_for: Callable[[Mapping[str, Connection], int], list[str]] = wait,
    now: Callable[[], int] = monotonic_ns,
) -> bool:
    """Run the control loop in real time until it has handed the vehicle over.

    Args:
        loop: the loop, which records whatever it sees and does.
        connections: open connections by link name.
        ticker: the grid of ticks.
        stop_requested: asked once a tick; the first True begins the hand-over.
        duration_s: the hand-over begins by itself after this time [s]; None flies on.
        stop_limit_s: the hand-over is cut off after this time [s]; 0 ends without one.
        after_tick: called with each tick and its lateness [ns] once its setpoint is out; none may wait or raise.
        wait_for: sleeps until a deadline or the first arrival; gives the names of connections to read.
        now: the clock [ns].

    Returns:
        Whether the end was asked for, by `stop_requested` or `duration_s`.

    Raises:
        UavctlError: the vehicle's connection was closed by the other side.
    """
    first_ns: int | None = None
    stop_ns: int | None = None
    refusals = _Refusals(loop, connections)
    try:
        while not loop.finished:
            due = ticker.next()
            while True:
                heard = _receive(loop, connections, wait_for(connections, due.at_ns))
                if now() >= due.at_ns:
                    break
                if not heard:  # a flood: take what comes by the handful, not each by itself
                    wait_for({}, min(due.at_ns, now() + PAUSE_NS))
            if connections[VEHICLE].closed:
                raise UavctlError(
                    f"{connections[VEHICLE].url}: closed by the other side, so nothing can be sent; "
                    "the vehicle's own failsafe has it. See to the link and start again"
                )
            due = ticker.overslept(due)
            started_ns = now()
            first_ns = due.at_ns if first_ns is None else first_ns
            over = duration_s is not None and due.at_ns - first_ns >= duration_s * 1e9
            if stop_ns is None and (over or stop_requested()):
                stop_ns = due.at_ns
            if stop_ns is not None and due.at_ns - stop_ns >= stop_limit_s * 1e9:
                break
            for message in loop.tick(due.tick, due.at_ns, due.missed, stop=stop_ns is not None):
                connections[message.link].send(message.data)
            loop.timing(due.tick, due.at_ns, started_ns - due.at_ns, now() - due.at_ns)
            refusals.tell(due.at_ns)
            for follow in after_tick:
                follow(due, started_ns - due.at_ns)
    finally:
        refusals.tell(now(), last=True)
    return stop_ns is not None


class _Refusals:
    """Tells the loop once a second what the connections dropped."""

    def __init__(self, loop: ControlLoop, connections: Mapping[str, Connection]) -> None:
        self._loop, self._connections = loop, connections
        self._told: dict[str, Counter[str]] = {name: Counter() for name in connections}
        self._next_ns = 0

    def tell(self, at_ns: int, *, last: bool = False) -> None:
        """Do so if the time has come, or the last one, and there is something to tell."""
        if at_ns < self._next_ns and not last:
            return
        self._next_ns = at_ns + SECOND_NS
        for name, connection in self._connections.items():
            refused = Counter(connection.refused)
            new = refused - self._told[name]
            if new:
                self._told[name] = refused
                self._loop.refused(name, dict(new), at_ns)


def _receive(loop: ControlLoop, connections: Mapping[str, Connection], names: Iterable[str]) -> bool:
    """Hand on what has arrived on the named connections; False if nothing was worth it."""
    heard = False
    for name in names:
        connection = connections[name]
        for index, (data, received_ns) in enumerate(connection.receive()):
            heard = True
            answers = loop.receive(name, data, received_ns)
            if loop.heard_vehicle:  # cameras or a ground station may share the port
                connection.answer(index)
            for answer in answers:
                connections[answer.link].send(answer.data)
    return heard
