"""Flight daemon: wait, receive, step, send, record.

No other thread sends setpoints. If the loop ends, the setpoints end too.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence

from uavctl.arrays import SECOND_NS
from uavctl.cause import Cause
from uavctl.clock import Ticker, monotonic_ns
from uavctl.errors import ConnectionClosedError
from uavctl.event_codes import EventCode
from uavctl.io.base import Connection
from uavctl.io.transport import wait
from uavctl.loop import VEHICLE, ControlLoop
from uavctl.mavlink.connection import OVERRUN
from uavctl.records import Event, Outgoing, Ticked

READ_PAUSE_NS = 2_000_000  # after a read without data for the flight
STALL_NS = 200_000_000  # between reads: the system may have dropped the vehicle's newest state
MAX_READ_AGE_NS = 150_000_000  # largest age of the last complete read at a setpoint
MAX_READ_ROUNDS = 10  # at a backlog, before a tick
WITHHELD = "withheld"

AfterTick = Callable[[Ticked, int], None]
"""Called with the result of a tick and its lateness [ns], after its setpoint; must neither wait nor raise."""


def fly(
    loop: ControlLoop,
    connections: Mapping[str, Connection],
    ticker: Ticker,
    stop_requested: Callable[[], bool],
    *,
    duration_s: float | None = None,
    stop_limit_s: float,
    after_tick: Sequence[AfterTick] = (),
    on_events: Callable[[tuple[Event, ...]], None] = lambda _: None,
    wait_for: Callable[[Mapping[str, Connection], int], list[str]] = wait,
    now: Callable[[], int] = monotonic_ns,
) -> bool:
    """Run the control loop in real time until it has handed the vehicle over.

    Args:
        loop: the loop, which records all its inputs and outputs.
        stop_requested: called once a tick; the first True begins the hand-over.
        duration_s: the hand-over begins by itself after this time [s]; None flies on.
        stop_limit_s: the hand-over ends after this time [s] at the latest, unless the vehicle is in the air on relayed
            positions; 0 ends without one.
        after_tick: called in this order after each tick.
        on_events: called with the events for people from a datagram or a lost connection; must neither wait nor raise.
        wait_for: sleeps until a deadline or the first arrival; returns the names of connections to read.
        now: the clock [ns].

    Returns:
        Whether the end was asked for, by `stop_requested` or `duration_s`.

    Raises:
        ConnectionClosedError: the vehicle's connection was closed by the other side.
    """
    first_ns: int | None = None
    stop_ns: int | None = None
    reporter = _RefusalReporter(loop, connections, on_events)
    reader = _Reader(loop, connections, now, on_events)
    withheld = 0

    def send(message: Outgoing) -> None:
        nonlocal withheld
        if message.link == VEHICLE and not reader.is_fresh:
            withheld += 1  # a pilot may have taken over since the last read
        else:
            connections[message.link].send(message.data)

    try:
        while not loop.finished:
            due = ticker.next()
            while True:
                has_received = reader.read(wait_for(connections, due.at_ns))
                if now() >= due.at_ns:
                    break
                if not has_received:  # a flood: read several datagrams at once
                    wait_for({}, min(due.at_ns, now() + READ_PAUSE_NS))
            if connections[VEHICLE].closed:
                loop.account.note_closed_connection(
                    f"{connections[VEHICLE].url}; nothing can be sent, and its own failsafe has it"
                )
                raise ConnectionClosedError(
                    f"{connections[VEHICLE].url}: closed by the other side, so nothing can be sent; "
                    "the vehicle's own failsafe has it. See to the link and start again"
                )
            reader.read_backlog()
            due = ticker.update_after_wait(due)
            started_ns = now()
            first_ns = due.at_ns if first_ns is None else first_ns
            is_time_over = duration_s is not None and due.at_ns - first_ns >= duration_s * 1e9
            if stop_ns is None and (is_time_over or stop_requested()):
                stop_ns = due.at_ns
                loop.account.note_requested_end(Cause.TIME_OVER if is_time_over else Cause.ENDED_BY_OPERATOR)
            is_overdue = stop_ns is not None and due.at_ns - stop_ns >= stop_limit_s * 1e9
            if is_overdue and not (stop_limit_s and loop.is_relay_needed):
                break
            withheld = 0
            ticked = loop.tick(due.tick, due.at_ns, send, due.missed, stop=stop_ns is not None)
            if withheld:
                loop.refused(VEHICLE, {WITHHELD: withheld}, now())
            loop.timing(ticked, started_ns - due.at_ns, now() - due.at_ns)
            if loop.outside and ticked.decision.solve is not None:
                loop.answered(ticked.step_ns)
            reporter.report(due.at_ns)
            for callback in after_tick:
                callback(ticked, started_ns - due.at_ns)
    finally:
        reporter.report(now(), is_last=True)
    return stop_ns is not None


class _Reader:
    """Passes arrivals to the loop, and knows the age of the last complete read."""

    def __init__(
        self,
        loop: ControlLoop,
        connections: Mapping[str, Connection],
        now: Callable[[], int],
        on_events: Callable[[tuple[Event, ...]], None],
    ) -> None:
        self._loop, self._connections, self._now, self._on_events = loop, connections, now, on_events
        self._read_ns = now()  # end of the last read
        self._complete_read_ns: int | None = None  # start of the last read that left nothing
        self._lost = dict.fromkeys(connections, 0)

    @property
    def is_fresh(self) -> bool:
        """Whether the last complete read is recent enough to send a setpoint."""
        return self._complete_read_ns is not None and self._now() - self._complete_read_ns <= MAX_READ_AGE_NS

    def read(self, names: Iterable[str], *, read_all: bool = False) -> bool:
        """Pass on arrivals of the named connections; False if the flight needs none of them."""
        start_ns = self._now()
        has_stalled = start_ns - self._read_ns > STALL_NS
        has_received = False
        for name in names:
            connection = self._connections[name]
            arrived = connection.receive(read_all=read_all or has_stalled)
            has_received = has_received or (bool(arrived) and connection.has_known_sender)
            for index, (data, received_ns) in enumerate(arrived):
                self._handle_data(name, index, data, received_ns)
        self._report_losses(has_stalled)
        self._read_ns = self._now()
        return has_received

    def read_backlog(self) -> None:
        """Read everything before a setpoint: a backlog ends with the vehicle's newest state."""
        for _ in range(MAX_READ_ROUNDS):
            start_ns = self._now()
            self.read(self._connections, read_all=True)
            if not self._connections[VEHICLE].has_unread:
                self._complete_read_ns = start_ns
                if self.is_fresh:
                    return

    def _handle_data(self, name: str, index: int, data: bytes, received_ns: int) -> None:
        connection = self._connections[name]
        received = self._loop.receive(name, data, received_ns)
        if received.from_vehicle:  # cameras or a ground station may share the port
            connection.select_peer(index)
        elif received.from_source:
            connection.trust_sender(index)
        if received.news:
            self._on_events(received.news)
        for answer in received.answers:
            self._connections[answer.link].send(answer.data)

    def _report_losses(self, has_stalled: bool) -> None:
        """Report data that the system dropped during a stall. Losses in a flood are not reported."""
        for name, connection in self._connections.items():
            before, lost = self._lost[name], connection.count_lost()
            self._lost[name] = lost
            if has_stalled and lost > before:
                self._loop.refused(name, {OVERRUN: lost - before}, self._now())


class _RefusalReporter:
    """Reports to the loop once a second what the connections dropped."""

    def __init__(
        self, loop: ControlLoop, connections: Mapping[str, Connection], on_events: Callable[[tuple[Event, ...]], None]
    ) -> None:
        self._loop, self._connections, self._on_events = loop, connections, on_events
        self._reported: dict[str, Counter[str]] = {name: Counter() for name in connections}
        self._next_ns = 0

    def report(self, at_ns: int, *, is_last: bool = False) -> None:
        """Report new counts if a second has passed, a peer has hung up, or this is the last call."""
        hung_up = any(
            connection.refused[EventCode.HUNG_UP] > self._reported[name][EventCode.HUNG_UP]
            for name, connection in self._connections.items()
        )
        if at_ns < self._next_ns and not hung_up and not is_last:
            return
        self._next_ns = at_ns + SECOND_NS
        for name, connection in self._connections.items():
            refused = Counter(connection.refused)
            new_counts = refused - self._reported[name]
            if new_counts:
                self._reported[name] = refused
                self._on_events(self._loop.refused(name, dict(new_counts), at_ns))
