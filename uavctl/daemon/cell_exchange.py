"""Exchange of cells and reports with the daemons of a fleet, over their control sockets; it waits for none.

It wakes in the middle of each step of the clock that all processes share: the daemons have then ticked and replied.
1. Read the replies, and pass their reports to the coordinator.
2. Ten times a second run a cycle of the coordinator.
3. Send each daemon its cell, or ask for its report alone. Each has one open request: a slow one gets the newest cell
   once it has replied.
A process that stood still has old reports. It first asks for new ones.
"""

from __future__ import annotations

import socket
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec

from uavctl.clock import monotonic_ns
from uavctl.daemon.control_socket import CellReply, ControlRequest
from uavctl.records import CellMessage
from uavctl.wiring.cells import CYCLE_NS, Coordinator

STALL_NS = 300_000_000  # between two wakes: the process stood still
SETTLE_STEPS = 3  # after that: a request waits for a tick, its reply for the next wake
_BLOCK_BYTES = 65_536
_MAX_REPLY_BYTES = 2**20
_REPLY = msgspec.json.Decoder(CellReply)


@dataclass(frozen=True)
class ExchangedVehicle:
    """Name of a vehicle, and socket of its daemon."""

    name: str
    path: Path


class DaemonConnection:
    """Connection to the control socket of one daemon; no call waits.

    Attributes:
        is_awaited: whether a reply is due.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._socket: socket.socket | None = None
        self._buffer = b""
        self.is_awaited = False

    def send(self, request: ControlRequest) -> bool:
        """Send a request, over a new connection if there is none; return whether it is on its way."""
        if self.is_awaited:
            return False
        data = msgspec.json.encode(request) + b"\n"
        try:
            connection = self._connect()
            sent = connection.send(data)
        except OSError:
            sent = 0
        self.is_awaited = sent == len(data)
        if not self.is_awaited:  # no daemon, or a line in part
            self.close()
        return self.is_awaited

    def receive(self) -> CellReply | None:
        """Return the reply if it is there.

        Raises:
            ValueError: It is not understood; the connection is closed.
        """
        if self._socket is None:
            return None
        try:
            data = self._socket.recv(_BLOCK_BYTES)
        except BlockingIOError:
            return None
        except OSError:
            data = b""
        self._buffer += data
        line, separator, self._buffer = self._buffer.partition(b"\n")
        if not separator:
            self._buffer = line
            if not data or len(line) > _MAX_REPLY_BYTES:
                self.close()
            return None
        self.is_awaited = False
        try:
            return _REPLY.decode(line)
        except msgspec.MsgspecError:
            self.close()
            raise

    def close(self) -> None:
        """Close the connection; the next request makes a new one."""
        if self._socket is not None:
            self._socket.close()
        self._socket, self._buffer, self.is_awaited = None, b"", False

    def _connect(self) -> socket.socket:
        if self._socket is None:
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
            self._socket.setblocking(False)
            self._socket.connect(str(self._path))
        return self._socket


class CellExchange:
    """Exchange between a coordinator and the daemons of its vehicles; time is an argument.

    Attributes:
        problem: Why the flights have to end; empty without a reason.

    Args:
        on_cycle: Called with the time of each cycle, after it.
        on_note: Called with a text for people.
    """

    def __init__(
        self,
        coordinator: Coordinator,
        vehicles: Sequence[ExchangedVehicle],
        on_cycle: Callable[[int], None],
        on_note: Callable[[str], None],
    ) -> None:
        self._coordinator, self._vehicles = coordinator, tuple(vehicles)
        self._on_cycle, self._on_note = on_cycle, on_note
        self._connections = [DaemonConnection(vehicle.path) for vehicle in vehicles]
        self._cells: dict[int, CellMessage] = {}  # to send
        self._may_take_off = False
        self._notes: set[str] = set()
        self._woken_ns: int | None = None
        self._cycle: int | None = None  # number of the last cycle
        self._not_before_ns = 0  # the next cycle
        self._dt_ns = round(coordinator.parameters.dt_s * 1e9)
        self.problem = ""

    def find_next_ns(self, now_ns: int) -> int:
        """Return the time of the next wake: the middle of a step."""
        half_ns = self._dt_ns // 2
        return (now_ns + half_ns) // self._dt_ns * self._dt_ns + half_ns

    def wake(self, at_ns: int) -> None:
        """Read the replies, run a cycle if it is due, and send the requests."""
        if self._woken_ns is not None and at_ns - self._woken_ns > STALL_NS:
            self._not_before_ns = at_ns + SETTLE_STEPS * self._dt_ns
        self._woken_ns = at_ns
        for number in range(len(self._vehicles)):
            self._read_reply(number)
        if not self._may_take_off and not self.problem and self._coordinator.has_all_reports:
            self._check_starts()
        cycle = at_ns // CYCLE_NS
        if self._may_take_off and cycle != self._cycle and at_ns >= self._not_before_ns:
            self._cycle = cycle
            self._cells = self._coordinator.update(at_ns)
            self._on_cycle(at_ns)
        for number, connection in enumerate(self._connections):
            cell = self._cells.get(number)
            if connection.send(ControlRequest(ask="cell", cell=cell, may_take_off=self._may_take_off)):
                self._cells.pop(number, None)

    def close(self) -> None:
        """Close all connections."""
        for connection in self._connections:
            connection.close()

    def _read_reply(self, number: int) -> None:
        name = self._vehicles[number].name
        try:
            reply = self._connections[number].receive()
            if reply is not None and reply.report is not None:
                self._coordinator.receive(number, reply.report)
        except ValueError as error:
            self._note(f"{name}: its report is not used: {error}")
            return
        if reply is not None and not reply.ok:
            self._note(f"{name}: refuses its cell: {reply.text}")

    def _check_starts(self) -> None:
        """Permit the take-off, or find the vehicles that stand too near to each other."""
        near = self._coordinator.find_near_starts()
        names = [vehicle.name for vehicle in self._vehicles]
        self.problem = "; ".join(
            f"{names[first]} and {names[second]} are too near to each other for cells: place them {needed_m:.2f} m "
            "apart, north or east"
            for first, second, needed_m in near
        )
        self._may_take_off = not near

    def _note(self, text: str) -> None:
        if text not in self._notes:
            self._notes.add(text)
            self._on_note(text)


def run_exchange(
    exchange: CellExchange, is_over: Callable[[float], bool], now: Callable[[], int] = monotonic_ns
) -> None:
    """Run an exchange until its end.

    Args:
        is_over: Waits for some seconds, or until the end; returns whether that has come.
        now: The clock [ns].
    """
    try:
        while not is_over(max(0, exchange.find_next_ns(now()) - now()) * 1e-9):
            exchange.wake(now())
    finally:
        exchange.close()
