"""Orders of the operator in flight: a Unix socket that the daemon reads after each tick without waiting.

Each direction carries one JSON object a line: a `ControlRequest`, then its `Reply`. The reply to an order holds what
the next tick decided, the `CellReply` to a cell the report of the vehicle. File permissions protect the socket (folder
0700, socket 0600). The kernel also reports the user at the other end.
"""

from __future__ import annotations

import math
import os
import re
import socket
import stat
import struct
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol

import msgspec

from uavctl.config import Config
from uavctl.config.checks import find_outside
from uavctl.daemon.health import Health
from uavctl.daemon.runtime_folder import find_runtime_folders
from uavctl.errors import UsageError, VehicleTakenError, in_words
from uavctl.event_codes import EventCode
from uavctl.records import CellMessage, CellReport, Command, Event, Order, Ticked, Vec3

FOLDER_VARIABLE = "UAVCTL_CONTROL"
SUFFIX = ".sock"
MAX_LINE = 65_536  # bytes of a request; a cell of 101 boxes, the most there are, has some 20,000
_MAX_NAME = 48  # characters of a daemon's name
_MAX_PATH = 107  # bytes that the kernel takes for the path of a socket


class ControlRequest(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """Status request, order, or cell of the coordinator."""

    ask: Literal["goto", "hold", "resume", "land", "engage", "take-off", "status", "cell"]
    position_m: Vec3 | None = None  # local NED; with goto only
    height_m: float | None = None  # above the ground; with take-off only
    arm: bool = False  # with take-off only: the vehicle may be armed
    cell: CellMessage | None = None  # with cell only; None: the report alone is wanted
    may_take_off: bool = False  # with cell only: all vehicles are known, and stand apart

    def find_problem(self) -> str | None:
        """Return the error in the request itself; None without one."""
        if (self.ask == "goto") != (self.position_m is not None):
            return "goto needs a position_m" if self.position_m is None else f"{self.ask} takes no position_m"
        if self.position_m is not None and not all(map(math.isfinite, self.position_m)):
            return "position_m has to be finite"
        if self.ask != "take-off" and (self.height_m is not None or self.arm):
            return f"{self.ask} takes no height_m and no arm"
        if self.ask == "take-off" and not self.arm:
            return "take-off needs arm: it permits arming the vehicle"
        if self.ask == "take-off" and not (self.height_m is not None and 0.0 < self.height_m < math.inf):
            return f"take-off needs a height_m above the ground, not {self.height_m}"
        if self.ask != "cell" and (self.cell is not None or self.may_take_off):
            return f"{self.ask} takes no cell"
        return None


class Reply(msgspec.Struct, frozen=True, kw_only=True):
    """Reply to a request: the decision on an order, or the state of the flight."""

    ok: bool
    text: str
    status: Health | None = None


class CellReply(msgspec.Struct, frozen=True, kw_only=True):
    """Reply to a cell: whether it is well-formed, and the report of the vehicle."""

    ok: bool
    text: str
    report: CellReport | None = None  # None before its position is known


def make_daemon_name(config: Config) -> str:
    """Make the name of a daemon from the names of its configuration and the vehicle's URL."""
    url = config.daemon.vehicle.replace("://", "-")
    return re.sub(r"[^A-Za-z0-9.]+", "-", f"{config.name}-{url}").strip("-.")[:_MAX_NAME]


def find_control_folder(chosen: Path | None, environ: Mapping[str, str] = os.environ) -> Path:
    """Find the folder of the sockets: as chosen, else $UAVCTL_CONTROL, else the user's runtime folder.

    Raises:
        UsageError: the user has none.
    """
    if chosen is not None:
        return chosen
    if environ.get(FOLDER_VARIABLE):
        return Path(environ[FOLDER_VARIABLE])
    return find_runtime_folders(environ)[0]


def make_socket_path(folder: Path, name: str) -> Path:
    """Return the path of the socket on which the daemon of this name listens.

    Raises:
        UsageError: the path is too long for a socket.
    """
    path = folder / f"{name}{SUFFIX}"
    if len(os.fsencode(path)) > _MAX_PATH:
        raise UsageError(
            f"{path}: longer than the {_MAX_PATH} bytes of a socket's path; choose a shorter folder with --control"
        )
    return path


MAX_CLIENTS = 8
IDLE_NS = 10_000_000_000
_CREDENTIALS = struct.Struct("3i")  # pid, uid, gid
_REQUEST = msgspec.json.Decoder(ControlRequest)


class OrderReceiver(Protocol):
    """Receiver of orders: the control loop."""

    def order(self, command: Command) -> bool:
        """Queue an order for the next tick; False if too many wait."""
        ...

    def explain_refusal(self, order: Order) -> str:
        """Return why an order would have no effect now; empty if it may be given."""
        ...

    def put_cell(self, cell: CellMessage) -> str:
        """Put a moving cell for the next tick; return why it is refused, empty if it is not."""
        ...

    def report_cell(self) -> CellReport | None:
        """Report to the coordinator of the cells; None before the position is known."""
        ...


class TakeOffChecker(Protocol):
    """Check before arming, which takes many ticks."""

    def begin(self, height_m: float, at_ns: int) -> str:
        """Begin a check before a climb [m]; return why none may begin, empty if it has begun."""
        ...

    def update(self, at_ns: int) -> str | None:
        """Continue the check; return the reasons not to arm, empty without one, None before its end."""
        ...

    def cancel(self) -> None:
        """End the check without a result."""
        ...


@dataclass(eq=False)
class _Client:
    socket: socket.socket
    heard_ns: int
    buffer: bytes = b""


class ControlServer:
    """Serves one listening socket; its `after_tick` is for the daemon.

    Args:
        config: For the limits of a position.
        permit_take_off: Called once the coordinator of the cells permits the take-off.
        take_off_checker: Check before an ordered take-off; without one the order is refused.
    """

    def __init__(
        self,
        listener: socket.socket,
        config: Config,
        order_receiver: OrderReceiver,
        make_health: Callable[[], Health],
        permit_take_off: Callable[[], None] = lambda: None,
        take_off_checker: TakeOffChecker | None = None,
    ) -> None:
        self._listener, self._config, self._order_receiver = listener, config, order_receiver
        self._make_health, self._permit_take_off = make_health, permit_take_off
        self._clients: list[_Client] = []
        self._pending: list[tuple[_Client, Command]] = []  # for the next tick's answers
        self._take_off_checker = take_off_checker
        self._checked: tuple[_Client, Command] | None = None  # a take-off, while its check runs
        self._coordinator: _Client | None = None  # the first one that asks for cells, while it is connected

    def after_tick(self, ticked: Ticked, lateness_ns: int) -> None:
        """Answer the orders of the tick, then read new requests; bounded work, no waiting."""
        del lateness_ns
        self._send_answers(list(ticked.answers))
        self._accept(ticked.decision.at_ns)
        self._continue_check(ticked.decision.at_ns)
        waiting = [client for client, _ in (*self._pending, *([self._checked] if self._checked else ()))]
        for idle in [client for client in self._clients if client not in waiting]:
            self._serve(idle, ticked.decision.at_ns)

    def close(self) -> None:
        """End the service; clients that still wait get a refusal."""
        for client, _ in (*self._pending, *([self._checked] if self._checked else ())):
            self._reply(client, Reply(ok=False, text="the flight ended before a decision on this order"))
        for client in self._clients:
            client.socket.close()
        self._clients.clear()
        self._pending.clear()
        self._checked = None

    def _send_answers(self, answers: list[tuple[Command, Event]]) -> None:
        waiting, self._pending = self._pending, []
        for client, command in waiting:
            answer = next((pair for pair in answers if pair[0] == command), None)
            if answer is None:
                self._reply(client, Reply(ok=False, text="the flight did not answer this order"))
            else:
                answers.remove(answer)
                self._reply(client, Reply(ok=answer[1].code == EventCode.ORDER_ACCEPTED, text=answer[1].text))

    def _continue_check(self, now_ns: int) -> None:
        """Order the take-off once its check has ended, if its client still waits for it."""
        if self._checked is None or self._take_off_checker is None:
            return
        client, command = self._checked
        if _has_hung_up(client.socket):
            self._checked = None
            self._take_off_checker.cancel()
            self._drop(client)
            return
        try:
            refusal = self._take_off_checker.update(now_ns)
        except Exception as error:  # noqa: BLE001 other orders are taken all the same
            self._take_off_checker.cancel()
            refusal = f"not armed, because the check has failed: {in_words(error)}"
        if refusal is None:
            return
        self._checked = None
        if refusal:
            self._reply(client, Reply(ok=False, text=refusal))
        else:
            self._order(client, command)

    def _accept(self, now_ns: int) -> None:
        while len(self._clients) < MAX_CLIENTS:
            try:
                connection, _ = self._listener.accept()
            except OSError:
                return  # no client, or it has gone
            connection.setblocking(False)
            _, uid, _ = _CREDENTIALS.unpack(
                connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
            )
            if uid in (os.geteuid(), 0):
                self._clients.append(_Client(connection, now_ns))
            else:
                connection.close()

    def _serve(self, client: _Client, now_ns: int) -> None:
        """Read from a client and handle its first complete line."""
        try:
            data = client.socket.recv(MAX_LINE)
        except BlockingIOError:
            data = None
        except OSError:
            data = b""
        if data:
            client.heard_ns = now_ns
            client.buffer += data
        line, separator, rest = client.buffer.partition(b"\n")
        if separator and len(line) <= MAX_LINE:
            client.buffer = rest
            self._handle_request(client, line, now_ns)
        elif len(client.buffer) > MAX_LINE:
            self._reply(client, Reply(ok=False, text=f"a request has {MAX_LINE} bytes at most"))
            self._drop(client)
        elif data == b"" or now_ns - client.heard_ns > IDLE_NS:
            self._drop(client)

    def _handle_request(self, client: _Client, line: bytes, now_ns: int) -> None:
        try:
            request = _REQUEST.decode(line)
        except msgspec.MsgspecError as error:  # of msgspec's own, a subclass of ValueError
            self._reply(client, Reply(ok=False, text=f"not understood: {error}"))
            return
        if request.ask == "status":
            self._reply(client, Reply(ok=True, text="", status=self._make_health()))
            return
        if request.ask == "cell":
            self._reply(client, self._exchange_cell(client, request))
            return
        problem = (
            request.find_problem()
            or self._check_position(request)
            or self._order_receiver.explain_refusal(Order(request.ask))
            or self._begin_check(request, now_ns)
        )
        if problem:
            self._reply(client, Reply(ok=False, text=problem))
            return
        command = Command(order=Order(request.ask), position_m=request.position_m, height_m=request.height_m)
        if command.order is Order.TAKE_OFF:
            self._checked = (client, command)
        else:
            self._order(client, command)

    def _begin_check(self, request: ControlRequest, now_ns: int) -> str:
        """Begin the check before a take-off; return why it is refused, empty if it has begun or for another order."""
        if request.height_m is None:
            return ""
        if self._take_off_checker is None:
            return "this flight takes no order to take off"
        return self._take_off_checker.begin(request.height_m, now_ns)

    def _order(self, client: _Client, command: Command) -> None:
        """Queue an order; its client gets the answer of the next tick."""
        if self._order_receiver.order(command):
            self._pending.append((client, command))
        else:
            self._reply(client, Reply(ok=False, text="too many orders at once; try again"))

    def _exchange_cell(self, client: _Client, request: ControlRequest) -> CellReply:
        """Put the cell of the coordinator, and return the report for it.

        Cells of two coordinators have the same numbers, so that neither would know which one is in use.
        """
        if self._coordinator not in self._clients:
            self._coordinator = client
        problem = request.find_problem() or ""
        if self._coordinator is not client:
            problem = "another coordinator sends cells to this vehicle: end one of the two fleets"
        if not problem and request.cell is not None:
            problem = self._order_receiver.put_cell(request.cell)
        if problem:
            return CellReply(ok=False, text=problem)
        if request.may_take_off:
            self._permit_take_off()
        return CellReply(ok=True, text="", report=self._order_receiver.report_cell())

    def _check_position(self, request: ControlRequest) -> str | None:
        """Return the coordinates of a position outside the limits; None if it is inside, or there is none."""
        if request.position_m is None:
            return None
        config = self._config
        problems = list(find_outside(config.plant, config.sets, request.position_m, "position_m", "place"))
        hints = dict.fromkeys(problem.todo for problem in problems)
        return "; ".join([*(problem.reason for problem in problems), *hints]) or None

    def _reply(self, client: _Client, reply: Reply | CellReply) -> None:
        data = msgspec.json.encode(reply) + b"\n"
        try:
            sent = client.socket.send(data)
        except OSError:
            sent = 0
        if sent < len(data):  # reads too slowly, or is gone
            self._drop(client)

    def _drop(self, client: _Client) -> None:
        if client in self._clients:
            self._clients.remove(client)
            client.socket.close()


def _has_hung_up(connection: socket.socket) -> bool:
    """Return whether the other end has closed the connection; what it sends else stays unread."""
    try:
        return connection.recv(1, socket.MSG_PEEK) == b""
    except BlockingIOError:
        return False
    except OSError:
        return True


@contextmanager
def open_listener(folder: Path, name: str) -> Iterator[socket.socket]:
    """Open the listening socket of a daemon; remove it at the end.

    Args:
        folder: its folder; made if missing.

    Raises:
        UsageError: the folder is not ours alone, or the path too long.
        VehicleTakenError: a daemon of this name is running.
    """
    _prepare_folder(folder)
    path = make_socket_path(folder, name)
    listener = _listen(path, name)
    try:
        yield listener
    finally:
        listener.close()
        path.unlink(missing_ok=True)


def _prepare_folder(folder: Path) -> None:
    """Make a folder that only this user can enter, or check it."""
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        status = folder.lstat()
    except OSError as error:
        raise UsageError(f"{folder}: {error.strerror}; choose another folder with --control") from error
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.geteuid():
        raise UsageError(f"{folder}: not a folder of this user; choose another one with --control")
    if status.st_mode & 0o077:
        raise UsageError(f"{folder}: other users can enter it and give orders; run: chmod 700 {folder}")


def _listen(path: Path, name: str) -> socket.socket:
    """Bind and listen; replace the socket of a dead daemon."""
    if path.is_socket():
        try:
            is_listening = _is_listening(path)
        except OSError as error:
            raise UsageError(
                f"{path}: {error.strerror}: another user (perhaps root) left it; if no daemon of that user flies, "
                f"run: sudo rm {path}"
            ) from error
        if is_listening:
            raise VehicleTakenError(
                f"{path}: a daemon named {name} is running; end it, or give this one another --set 'name=\"...\"'"
            )
        path.unlink(missing_ok=True)
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        listener.bind(os.fspath(path))
        path.chmod(0o600)
        listener.listen(MAX_CLIENTS)
    except OSError as error:
        listener.close()
        raise UsageError(f"{path}: {error.strerror}; choose another folder with --control") from error
    listener.setblocking(False)
    return listener


def _is_listening(path: Path) -> bool:
    """Return whether a process listens on the socket.

    Raises:
        OSError: it is not ours.
    """
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.setblocking(False)
        try:
            probe.connect(os.fspath(path))
        except (ConnectionRefusedError, FileNotFoundError):
            return False
        except BlockingIOError:
            return True  # its queue is full
    return True
