"""A check on real connections, bounded in time: what `uavctl check` runs, and `uavctl fly --arm` before it arms."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from uavctl.check.item import Item
from uavctl.check.preflight import Preflight
from uavctl.clock import Ticker, monotonic_ns
from uavctl.config import Config
from uavctl.loop import make_links
from uavctl.transport import Connection, wait

MOVE_LIMIT_S = 120.0  # for the guided movements, beside the listening


def run_preflight(
    config: Config,
    connections: Mapping[str, Connection],
    seconds: float,
    *,
    move: bool = False,
    take_off_m: float | None = None,
    prompt: Callable[[str], None] | None = None,
    stop: Callable[[], bool] = lambda: False,
    wait_for: Callable[[Mapping[str, Connection], int], list[str]] = wait,
    now: Callable[[], int] = monotonic_ns,
) -> tuple[Item, ...]:
    """Listen, ask, and tell what was found. Arms nothing, changes no mode and no parameter.

    Args:
        config: the configuration.
        connections: open connections by link name.
        seconds: how long to listen [s].
        move: go on until a person has moved the body as asked, for `MOVE_LIMIT_S` at most.
        take_off_m: height of the climb that is planned [m]; None if none is.
        prompt: told every new thing that is asked of that person; empty to wait.
        stop: asked once a tick; ends the listening.
        wait_for: sleeps until a deadline or the first arrival; gives the names of connections to read.
        now: the clock [ns].
    """
    ticker = Ticker(round(config.daemon.tick_s * 1e9), round(config.plant.dt_s * 1e9), now)
    due = ticker.next()
    begun_ns, asked = due.at_ns, ""
    flight = Preflight(config, make_links, begun_ns, move=move, take_off_m=take_off_m)
    while True:
        while True:
            for name in wait_for(connections, due.at_ns):
                _receive(flight, name, connections[name])
            if now() >= due.at_ns:
                break
        for message in flight.tick(due.tick, due.at_ns):
            connections[message.link].send(message.data)
        if prompt is not None and flight.prompt != asked:
            asked = flight.prompt
            prompt(asked)
        moving = flight.guide is not None and not flight.guide.over
        closed = all(connection.closed for connection in connections.values())
        heard_s = (due.at_ns - begun_ns) * 1e-9
        limit_s = seconds + (MOVE_LIMIT_S if moving else 0.0)
        if closed or stop() or (heard_s >= limit_s and (heard_s >= limit_s + config.check.wait_s or not flight.waits)):
            return flight.items(due.at_ns)
        due = ticker.next()


def _receive(flight: Preflight, name: str, connection: Connection) -> None:
    for index, (data, received_ns) in enumerate(connection.receive()):
        answers = flight.receive(name, data, received_ns)
        if flight.heard_vehicle:  # cameras or a ground station may share the port
            connection.answer(index)
        elif flight.heard_source:
            connection.trust(index)
        for answer in answers:
            connection.send(answer.data)
