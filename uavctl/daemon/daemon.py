"""Flight daemon: wait, receive, step, send, record.

No other thread sends setpoints. If the loop ends, the setpoints end too.

An error ends no flight without a landing request:
1. In what the flight does not need (services, bookkeeping, one datagram): it is reported, and the flight goes on.
2. In what gives the orders of the flight: the flight ends as if that were asked for.
3. In a cycle: no setpoint any more; the next cycles ask for landing and pass positions on.
4. In several cycles in a row: a landing request of its own is sent until it is answered.
A tick that does not end is an error of its cycle (`uavctl.daemon.tick_limit`), and so are ticks that come too rarely
(`uavctl.daemon.tick_gaps`). If the process dies, another one asks for landing (`uavctl.daemon.landing_host`).
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext, suppress

from msgspec.structs import replace

from uavctl.arrays import SECOND_NS
from uavctl.cause import Cause
from uavctl.clock import Ticker, monotonic_ns
from uavctl.daemon.tick_gaps import GapLimit
from uavctl.errors import ConnectionClosedError, TickOverdueError, UavctlError
from uavctl.event_codes import EventCode
from uavctl.io.base import Connection
from uavctl.io.transport import wait
from uavctl.loop import ControlLoop
from uavctl.mavlink.connection import OVERRUN, VEHICLE
from uavctl.mavlink.handover_states import HandoverState
from uavctl.records import Event, Outgoing, Ticked

READ_PAUSE_NS = 2_000_000  # after a read without data for the flight
STALL_NS = 200_000_000  # between reads: the system may have dropped the vehicle's newest state
MAX_READ_AGE_NS = 150_000_000  # largest age of the last complete read at a setpoint
MAX_READ_ROUNDS = 10  # at a backlog, before a tick
WITHHELD = "withheld"
MAX_FAILED_CYCLES = 3  # in a row
MAX_FAILED_READS = 20  # cycles in a row in which the vehicle's connection cannot be read: a second
RESERVE_BYTES = 2**20  # given back after the first failure, which may be one of memory
ANSWER_PAUSE_NS = 50_000_000  # between two looks for the answer to the last landing request

AfterTick = Callable[[Ticked, int], None]
"""Called with the result of a tick and its lateness [ns], after its setpoint; must not wait."""


def fly(
    loop: ControlLoop,
    connections: Mapping[str, Connection],
    ticker: Ticker,
    stop_requested: Callable[[], bool],
    *,
    duration_s: float | None = None,
    stop_limit_s: Callable[[], float],
    give_orders: AfterTick = lambda *_: None,
    after_tick: Sequence[AfterTick] = (),
    limit_tick: Callable[[bool], AbstractContextManager[None]] = lambda _: nullcontext(),
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
        give_orders: called after each tick; gives the orders of the flight. The hand-over begins if it raises.
        after_tick: services, called in this order after each tick; their errors are reported.
        limit_tick: called with whether the vehicle flies the setpoints; returns the context of a tick, which
            interrupts one that does not end.
        on_events: called with the events for people; must not wait.
        wait_for: sleeps until a deadline or the first arrival; returns the names of connections to read.
        now: the clock [ns].

    Returns:
        Whether the end was asked for, by `stop_requested` or `duration_s`.

    Raises:
        ConnectionClosedError: the vehicle's connection was closed by the other side.
        Exception: of `give_orders`, after the end of the flight; of cycles that fail in a row, after a landing request.
    """
    flight = _Flight(loop, connections, ticker, on_events, wait_for, now)
    flight.stop_requested, flight.duration_s, flight.stop_limit_s = stop_requested, duration_s, stop_limit_s
    flight.give_orders, flight.services, flight.limit_tick = give_orders, after_tick, limit_tick
    try:
        return flight.run()
    except ConnectionClosedError:
        raise
    except (Exception, TickOverdueError):
        flight.request_landing()
        raise
    finally:
        flight.report_refusals()


class _Flight:
    """Flight of one vehicle: its cycles, and the actions on failure."""

    stop_requested: Callable[[], bool]
    duration_s: float | None
    stop_limit_s: Callable[[], float]
    give_orders: AfterTick
    services: Sequence[AfterTick]
    limit_tick: Callable[[bool], AbstractContextManager[None]]

    def __init__(
        self,
        loop: ControlLoop,
        connections: Mapping[str, Connection],
        ticker: Ticker,
        on_events: Callable[[tuple[Event, ...]], None],
        wait_for: Callable[[Mapping[str, Connection], int], list[str]],
        now: Callable[[], int],
    ) -> None:
        self._loop, self._connections, self._ticker = loop, connections, ticker
        self._on_events, self._wait_for, self._now = on_events, wait_for, now
        self._reporter = _RefusalReporter(loop, connections, on_events)
        self._reader = _Reader(loop, connections, now, on_events, self._report_error)
        self._first_ns: int | None = None
        self._stop_ns: int | None = None
        self._is_over = False
        self._gap_limit = GapLimit()
        self._withheld = 0  # messages to the vehicle in this cycle
        self._failed_cycles = 0  # in a row
        self._ticked: Ticked | None = None  # the last tick
        self._orders_error: Exception | None = None
        self._reported_subjects: set[str] = set()
        self._reserve = bytearray(RESERVE_BYTES)

    def run(self) -> bool:
        """Run cycles until the end; return whether it was asked for."""
        while not (self._loop.finished or self._is_over):
            try:
                self._run_cycle()
            except ConnectionClosedError:
                raise
            except (Exception, TickOverdueError) as error:
                self._reserve = bytearray()
                self._failed_cycles += 1
                event = self._loop.fail(error, self._now())
                if self._failed_cycles >= MAX_FAILED_CYCLES:
                    raise
                self._tell(event)
            else:
                self._failed_cycles = 0
        if self._orders_error is not None:
            raise self._orders_error
        return self._stop_ns is not None

    def request_landing(self) -> None:
        """Send the landing request of a flight whose cycles have failed, until it is answered. Services go on."""
        connection = self._connections[VEHICLE]
        quiet_tick = None if self._ticked is None else replace(self._ticked, answers=(), console_events=(), notices=())
        while not connection.closed and self._loop.send_landing_request(
            self._now(), lambda message: connection.send(message.data)
        ):
            self._attempt_pause()
            if quiet_tick is not None:
                self._run_services(self.services, quiet_tick, 0)
            try:
                for data, _ in connection.receive():
                    self._loop.receive_landing_answer(data)
            except Exception as error:  # noqa: BLE001 it is sent without an answer, for a limited time
                self._report_error("the answer to the landing request", error)

    def _attempt_pause(self) -> None:
        try:
            self._wait_for({}, self._now() + ANSWER_PAUSE_NS)
        except Exception:  # noqa: BLE001 what has failed in the cycles may be this
            time.sleep(ANSWER_PAUSE_NS * 1e-9)

    def report_refusals(self) -> None:
        """Report the data that connections have dropped since the last report."""
        try:
            self._reporter.report(self._now(), is_last=True)
        except Exception as error:  # noqa: BLE001 not needed for flying
            self._report_error("the count of dropped data", error)

    def _run_cycle(self) -> None:
        loop = self._loop
        due = self._ticker.next()
        self._reader.wait(due.at_ns, self._wait_for)
        self._check_connection()
        self._reader.read_backlog()
        due = self._ticker.update_after_wait(due)
        started_ns = self._now()
        if self._is_past_limit(due.at_ns):
            self._is_over = True
            return
        is_engaged = loop.handover_state is HandoverState.ENGAGED
        self._gap_limit.check(due.at_ns, is_in_control=is_engaged)
        self._withheld = 0
        with self.limit_tick(is_engaged):
            ticked = loop.tick(due.tick, due.at_ns, self._send, due.missed, stop=self._stop_ns is not None)
        lateness_ns, send_ns = started_ns - due.at_ns, self._now() - due.at_ns
        self._handle_orders(ticked, lateness_ns)
        bookkeeping: tuple[AfterTick, ...] = (
            lambda *_: self._report_withheld(),
            lambda *_: loop.record_timing(ticked, lateness_ns, send_ns),
            lambda *_: self._reporter.report(due.at_ns),
        )
        if loop.outside and ticked.decision.solve is not None:
            loop.note_solve_time(ticked.step_ns)
        self._run_services((*bookkeeping, *self.services), ticked, lateness_ns)
        self._ticked = ticked

    def _run_services(self, services: Sequence[AfterTick], ticked: Ticked, lateness_ns: int) -> None:
        for number, service in enumerate(services):
            try:
                service(ticked, lateness_ns)
            except Exception as error:  # noqa: BLE001 not needed for flying
                self._report_error(f"service {number} of the flight", error)

    def _is_past_limit(self, at_ns: int) -> bool:
        """Note a requested end; return whether its limit is over."""
        self._first_ns = at_ns if self._first_ns is None else self._first_ns
        is_time_over = self.duration_s is not None and at_ns - self._first_ns >= self.duration_s * 1e9
        if self._stop_ns is None and (is_time_over or self.stop_requested()):
            self._stop_ns = at_ns
            self._loop.account.note_requested_end(Cause.TIME_OVER if is_time_over else Cause.ENDED_BY_OPERATOR)
        limit_s = self.stop_limit_s()
        is_overdue = self._stop_ns is not None and at_ns - self._stop_ns >= limit_s * 1e9
        return is_overdue and not (limit_s and self._loop.is_relay_needed)

    def _send(self, message: Outgoing) -> None:
        if message.link == VEHICLE and not self._reader.is_fresh:
            self._withheld += 1  # a pilot may have taken over since the last read
        else:
            self._connections[message.link].send(message.data)

    def _report_withheld(self) -> None:
        if self._withheld:
            self._loop.add_refusals(VEHICLE, {WITHHELD: self._withheld}, self._now())

    def _handle_orders(self, ticked: Ticked, lateness_ns: int) -> None:
        """Let the orders of the flight be given; an error begins its end."""
        if self._orders_error is not None:
            return
        try:
            self.give_orders(ticked, lateness_ns)
        except Exception as error:  # noqa: BLE001 raised after the end
            self._orders_error = error
            self._stop_ns = ticked.decision.at_ns if self._stop_ns is None else self._stop_ns
            self._report_error("the orders of the flight", error)

    def _check_connection(self) -> None:
        connection = self._connections[VEHICLE]
        if connection.closed:
            self._loop.account.note_closed_connection(
                f"{connection.url}; nothing can be sent, and the vehicle's own failsafe acts"
            )
            raise ConnectionClosedError(
                f"{connection.url}: the other side closed the connection, so nothing can be "
                "sent; the vehicle's own failsafe acts. Check the link and start again"
            )

    def _report_error(self, subject: str, error: Exception) -> None:
        """Report an error that does not end the flight, once for each subject."""
        if subject not in self._reported_subjects:
            self._reported_subjects.add(subject)
            self._tell(self._loop.note_error(subject, error, self._now()))

    def _tell(self, event: Event) -> None:
        with suppress(Exception):  # the recording has it
            self._on_events((event,))


class _Reader:
    """Passes arrivals to the loop, and knows the age of the last complete read."""

    def __init__(
        self,
        loop: ControlLoop,
        connections: Mapping[str, Connection],
        now: Callable[[], int],
        on_events: Callable[[tuple[Event, ...]], None],
        report_error: Callable[[str, Exception], None],
    ) -> None:
        self._loop, self._connections, self._now, self._on_events = loop, connections, now, on_events
        self._report_error = report_error
        self._failed_reads = 0  # cycles in a row in which the vehicle's connection could not be read
        self._read_ns = now()  # end of the last read
        self._has_failed = False  # the last read of the vehicle's connection
        self._complete_read_ns: int | None = None  # start of the last read that left nothing
        self._lost = dict.fromkeys(connections, 0)

    @property
    def is_fresh(self) -> bool:
        """Whether the last complete read is recent enough to send a setpoint."""
        return self._complete_read_ns is not None and self._now() - self._complete_read_ns <= MAX_READ_AGE_NS

    def wait(self, until_ns: int, wait_for: Callable[[Mapping[str, Connection], int], list[str]]) -> None:
        """Wait until a time, and pass on messages that arrive meanwhile."""
        while True:
            has_received = self.read(wait_for(self._connections, until_ns))
            if self._now() >= until_ns:
                return
            if not has_received:  # a flood: read several datagrams at once
                wait_for({}, min(until_ns, self._now() + READ_PAUSE_NS))

    def read(self, names: Iterable[str], *, read_all: bool = False) -> bool:
        """Pass on arrivals of the named connections; False if the flight needs none of them."""
        start_ns = self._now()
        has_stalled = start_ns - self._read_ns > STALL_NS
        has_received = False
        self._has_failed = False
        for name in names:
            try:
                has_received = self._read_connection(name, read_all=read_all or has_stalled) or has_received
            except Exception as error:  # noqa: BLE001 what is not heard is treated as silent
                self._has_failed = self._has_failed or name == VEHICLE
                self._report_error(f"link {name}", error)
        self._report_losses(has_stalled)
        self._read_ns = self._now()
        return has_received

    def _read_connection(self, name: str, *, read_all: bool) -> bool:
        connection = self._connections[name]
        arrived = connection.receive(read_all=read_all)
        for index, (data, received_ns) in enumerate(arrived):
            self._handle_data(name, index, data, received_ns)
        return bool(arrived) and connection.has_known_sender

    def read_backlog(self) -> None:
        """Read everything before a setpoint: a backlog ends with the vehicle's newest state.

        Raises:
            UavctlError: The vehicle's connection could not be read for long; then its messages are not known.
        """
        for _ in range(MAX_READ_ROUNDS):
            start_ns = self._now()
            self.read(self._connections, read_all=True)
            if self._has_failed:
                break
            self._failed_reads = 0
            if not self._connections[VEHICLE].has_unread:
                self._complete_read_ns = start_ns
                if self.is_fresh:
                    return
        self._failed_reads += self._has_failed
        if self._failed_reads >= MAX_FAILED_READS:
            raise UavctlError(f"{self._connections[VEHICLE].url}: cannot be read; see the error before")

    def _handle_data(self, name: str, index: int, data: bytes, received_ns: int) -> None:
        connection = self._connections[name]
        received = self._loop.receive(name, data, received_ns)
        if received.from_vehicle:  # cameras or a ground station may share the port
            connection.select_peer(index)
        elif received.from_source:
            connection.trust_sender(index)
        if received.console_events:
            self._on_events(received.console_events)
        for answer in received.answers:
            self._connections[answer.link].send(answer.data)

    def _report_losses(self, has_stalled: bool) -> None:
        """Report data that the system dropped during a stall. Losses in a flood are not reported."""
        for name, connection in self._connections.items():
            before, lost = self._lost[name], connection.count_lost()
            self._lost[name] = lost
            if has_stalled and lost > before:
                self._loop.add_refusals(name, {OVERRUN: lost - before}, self._now())


class _RefusalReporter:
    """Reports to the loop once a second the data that connections dropped."""

    def __init__(
        self, loop: ControlLoop, connections: Mapping[str, Connection], on_events: Callable[[tuple[Event, ...]], None]
    ) -> None:
        self._loop, self._connections, self._on_events = loop, connections, on_events
        self._reported: dict[str, Counter[str]] = {name: Counter() for name in connections}
        self._next_ns = 0

    def report(self, at_ns: int, *, is_last: bool = False) -> None:
        """Report new counts if a second has passed, a peer has closed the connection, or this is the last call."""
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
                self._on_events(self._loop.add_refusals(name, dict(new_counts), at_ns))
