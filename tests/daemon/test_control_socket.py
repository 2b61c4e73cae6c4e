"""The control socket: who may ask, what is answered when, and that nobody can make the loop wait."""

from __future__ import annotations

import json
import os
import socket
import stat
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
from ticked_rig import ticked

from uavctl.config import load_config
from uavctl.daemon.control_socket import (
    MAX_CLIENTS,
    MAX_LINE,
    ControlRequest,
    ControlServer,
    find_control_folder,
    make_daemon_name,
    make_socket_path,
    open_listener,
)
from uavctl.daemon.health import Health, RecorderHealth
from uavctl.errors import UsageError, VehicleTakenError
from uavctl.event_codes import EventCode
from uavctl.fleet.cell import parse_cell
from uavctl.records import CellMessage, CellReport, Command, Conduct, Event, Order, Severity

SECOND = 1_000_000_000
CONFIG = load_config("room")


@pytest.fixture
def folder() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(prefix="uavctl-") as path:  # short: a socket's path has 107 bytes
        yield Path(path)


def health() -> Health:
    return Health(
        name="one", url="udpin://x:1", pid=7, running_s=1.0, mode=None, reason="", age_s=None, age_steps=None,
        position_m=None, velocity_mps=None, target_m=None, waypoint=None, loss=None, lateness_us=0.0, missed_ticks=0,
        vehicle=None, recorder=RecorderHealth(ok=True, dropped=0, reason="", path="f.mcap", unwritten_s=0.0),
    )  # fmt: skip


class Flight:
    """Takes orders and decides on them in the next tick: north of 1 m is refused."""

    def __init__(self, room: int = 16) -> None:
        self.orders: list[Command] = []
        self.taken: list[Command] = []
        self._room = room
        self.idle: tuple[Order, ...] = ()
        self.cells: list[CellMessage] = []
        self.report: CellReport | None = None

    def order(self, command: Command) -> bool:
        if len(self.orders) >= self._room:
            return False
        self.orders.append(command)
        return True

    def explain_refusal(self, order: Order) -> str:
        return f"{order} is for nothing" if order in self.idle else ""

    def put_cell(self, cell: CellMessage) -> str:
        try:
            parse_cell(cell)
        except ValueError as error:
            return str(error)
        self.cells.append(cell)
        return ""

    def report_cell(self) -> CellReport | None:
        return self.report

    def tick(self, at_ns: int) -> tuple[tuple[Command, Event], ...]:
        answers = tuple((one, self._decide(one, at_ns)) for one in reversed(self.orders))  # in any order
        self.taken += self.orders
        self.orders.clear()
        return answers

    def _decide(self, command: Command, at_ns: int) -> Event:
        good = command.position_m is None or command.position_m[0] <= 1.0
        code, severity = (
            (EventCode.ORDER_ACCEPTED, Severity.INFO) if good else (EventCode.ORDER_REFUSED, Severity.WARNING)
        )
        return Event(at_ns=at_ns, severity=severity, code=code, text=f"{command.order} {'yes' if good else 'no'}")


class Check:
    """A check before a take-off that ends as it is told."""

    def __init__(self) -> None:
        self.result: str | None = None  # None: it runs on
        self.heights_m: list[float] = []
        self.fault: Exception | None = None
        self.is_cancelled = False

    def begin(self, height_m: float, at_ns: int) -> str:
        if height_m > 2.0:
            return "too high"
        self.heights_m.append(height_m)
        return ""

    def update(self, at_ns: int) -> str | None:
        if self.fault is not None:
            raise self.fault
        return self.result

    def cancel(self) -> None:
        self.is_cancelled = True


class Rig:
    def __init__(self, folder: Path, listener: socket.socket, room: int = 16) -> None:
        self.path = folder / "one.sock"
        self.flight = Flight(room)
        self.permits = 0
        self.check = Check()
        self.server = ControlServer(listener, CONFIG, self.flight, health, self.permit, self.check)
        self.now_ns = 0
        self._clients: list[socket.socket] = []

    def permit(self) -> None:
        self.permits += 1

    def close(self) -> None:
        self.server.close()
        for client in self._clients:
            client.close()

    def ticks(self, count: int = 1, step_ns: int = 50_000_000) -> None:
        for _ in range(count):
            self.now_ns += step_ns
            self.server.after_tick(ticked(self.now_ns, answers=self.flight.tick(self.now_ns)), 0)

    def client(self) -> socket.socket:
        client = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        client.settimeout(5.0)
        client.connect(str(self.path))
        self._clients.append(client)
        return client

    def say(self, *lines: bytes) -> list[socket.socket]:
        clients = []
        for line in lines:
            client = self.client()
            client.sendall(line)
            clients.append(client)
        return clients


@pytest.fixture
def rig(folder: Path) -> Iterator[Rig]:
    with open_listener(folder, "one") as listener:
        rig = Rig(folder, listener)
        yield rig
        rig.close()


def heard(client: socket.socket) -> Any:
    """The reply that is there now; None if there is none, "" after a hang-up."""
    client.setblocking(False)
    try:
        data = client.recv(65_536)
    except BlockingIOError:
        return None
    except ConnectionResetError:
        return ""
    return json.loads(data) if data else ""


def ask(**fields: object) -> bytes:
    return json.dumps(fields).encode() + b"\n"


def test_an_order_is_answered_with_what_the_next_tick_decided(rig: Rig) -> None:
    good, bad = rig.say(ask(ask="goto", position_m=[1, 0.5, -1]), ask(ask="goto", position_m=[2, 0.5, -1]))
    rig.ticks()
    assert heard(good) is None and heard(bad) is None  # queued is no answer
    rig.ticks()
    assert heard(good) == {"ok": True, "text": "goto yes", "status": None}
    assert heard(bad) == {"ok": False, "text": "goto no", "status": None}
    assert rig.flight.taken[0] == Command(order=Order.GOTO, position_m=(1.0, 0.5, -1.0))


@pytest.mark.parametrize("order", [Order.HOLD, Order.RESUME, Order.LAND, Order.ENGAGE])
def test_every_order_reaches_the_flight(rig: Rig, order: Order) -> None:
    (client,) = rig.say(ask(ask=order))
    rig.ticks(2)
    assert rig.flight.taken == [Command(order=order)] and heard(client)["ok"]


@pytest.mark.fault(62)
def test_an_order_that_would_come_to_nothing_is_refused_with_the_reason_and_reaches_no_tick(rig: Rig) -> None:
    rig.flight.idle = (Order.GOTO,)
    moved, held = rig.say(ask(ask="goto", position_m=[1, 0.5, -1]), ask(ask="hold"))
    rig.ticks(2)
    assert heard(moved) == {"ok": False, "text": "goto is for nothing", "status": None}
    assert heard(held)["ok"] and rig.flight.taken == [Command(order=Order.HOLD)]


TAKE_OFF = Command(order=Order.TAKE_OFF, height_m=1.2)


def test_a_take_off_is_ordered_after_its_check_and_others_are_served_meanwhile(rig: Rig) -> None:
    (client,) = rig.say(ask(ask="take-off", height_m=1.2, arm=True))
    rig.ticks(400)  # 20 s: the waiting client is not idle
    (other,) = rig.say(ask(ask="hold"))
    rig.ticks(2)
    assert heard(client) is None and heard(other)["ok"] and rig.flight.taken == [Command(order=Order.HOLD)]
    rig.check.result = ""
    rig.ticks(2)
    assert heard(client) == {"ok": True, "text": "take-off yes", "status": None}
    assert rig.check.heights_m == [1.2] and rig.flight.taken[1:] == [TAKE_OFF]


def test_a_take_off_whose_check_fails_is_refused_with_the_reason(rig: Rig) -> None:
    (client,) = rig.say(ask(ask="take-off", height_m=1.2, arm=True))
    rig.check.result = "the battery is empty"
    rig.ticks(3)
    assert heard(client) == {"ok": False, "text": "the battery is empty", "status": None} and not rig.flight.taken


def test_a_take_off_whose_client_has_gone_is_not_ordered(rig: Rig) -> None:
    (client,) = rig.say(ask(ask="take-off", height_m=1.2, arm=True))
    rig.ticks()
    client.close()
    rig.check.result = ""
    rig.ticks(3)
    assert rig.check.is_cancelled and not rig.flight.taken


def test_an_error_in_the_check_arms_nothing_and_leaves_the_other_orders(rig: Rig) -> None:
    (client,) = rig.say(ask(ask="take-off", height_m=1.2, arm=True))
    rig.check.fault = ValueError("no such parameter")
    rig.ticks(2)
    (other,) = rig.say(ask(ask="land"))
    rig.ticks(2)
    assert "no such parameter" in heard(client)["text"] and rig.check.is_cancelled
    assert heard(other)["ok"] and rig.flight.taken == [Command(order=Order.LAND)]


def test_the_end_of_the_flight_answers_a_take_off_that_is_being_checked(rig: Rig) -> None:
    (client,) = rig.say(ask(ask="take-off", height_m=1.2, arm=True))
    rig.ticks()
    rig.server.close()
    assert not heard(client)["ok"] and not rig.flight.orders


def test_status_is_answered_at_once(rig: Rig) -> None:
    (client,) = rig.say(ask(ask="status"))
    rig.ticks()
    assert msgspec.convert(heard(client)["status"], Health) == health()


@pytest.mark.parametrize(
    ("line", "words"),
    [
        (b"{}\n", "ask"),
        (b"nonsense\n", "not understood"),
        (b"\xff\xfe\n", "not understood"),
        (ask(ask="fly"), "not understood"),
        (ask(ask="hold", now=True), "now"),
        (ask(ask="goto"), "needs a position"),
        (ask(ask="hold", position_m=[0, 0, -1]), "takes no position"),
        (ask(ask="goto", position_m=[0, 0]), "not understood"),
        (b'{"ask": "goto", "position_m": [NaN, 0, -1]}\n', "not understood"),
        (b'{"ask": "goto", "position_m": [1e999, 0, -1]}\n', "not understood"),
        (ask(ask="take-off", height_m=1.2), "needs arm"),
        (ask(ask="take-off", arm=True), "height_m"),
        (ask(ask="take-off", arm=True, height_m=-1.2), "height_m"),
        (ask(ask="take-off", arm=True, height_m=0), "height_m"),
        (b'{"ask": "take-off", "arm": true, "height_m": 1e999}\n', "not understood"),
        (ask(ask="take-off", arm=True, height_m=3.0), "too high"),
        (ask(ask="hold", arm=True), "takes no height_m and no arm"),
        (ask(ask="goto", position_m=[0, 0, 1.1]), "up is negative: write -1.1"),
        (ask(ask="goto", position_m=[3.5, 0, 0.5]), "north 3.5 m is outside the admissible box [-3, 3]; down 0.5 m"),
    ],
)
def test_bad_requests_are_told_and_never_reach_the_flight(rig: Rig, line: bytes, words: str) -> None:
    (client,) = rig.say(line)
    rig.ticks()
    reply = heard(client)
    assert not reply["ok"] and words in reply["text"]
    client.sendall(ask(ask="status"))  # it may ask again
    rig.ticks()
    assert heard(client)["ok"] and not rig.flight.taken


def test_requests_in_pieces_and_several_at_once_are_taken_one_a_tick(rig: Rig) -> None:
    (client,) = rig.say(b'{"ask": "ho')
    rig.ticks(3)
    client.sendall(b'ld"}\n' + ask(ask="status"))
    rig.ticks()
    assert heard(client) is None  # the second one waits until the first one is answered
    rig.ticks()
    client.setblocking(False)
    first, second = client.recv(65_536).splitlines()
    assert json.loads(first)["text"] == "hold yes"
    assert json.loads(second)["status"]["name"] == "one"


def test_endless_and_idle_clients_are_dropped(rig: Rig) -> None:
    endless, idle = rig.say(b"x" * (MAX_LINE + 1), b"")
    rig.ticks(2)
    assert "bytes at most" in heard(endless)["text"]
    assert heard(endless) == "" and heard(idle) is None
    rig.ticks(1, 11 * SECOND)
    assert heard(idle) == ""


def test_more_clients_than_there_are_places_wait_their_turn(rig: Rig) -> None:
    clients = rig.say(*[b""] * MAX_CLIENTS, ask(ask="status"))
    rig.ticks()
    assert heard(clients[-1]) is None
    clients[0].close()
    rig.ticks(2)
    assert heard(clients[-1])["ok"]


def test_a_client_that_reads_nothing_is_dropped_without_waiting(rig: Rig) -> None:
    client = rig.client()
    client.setblocking(False)
    for _ in range(5000):
        try:
            client.sendall(ask(ask="status"))
        except (BlockingIOError, BrokenPipeError, ConnectionResetError):
            break
        rig.ticks(1, 1000)
    else:
        pytest.fail("it was served for ever")


def test_a_client_that_goes_before_its_answer_disturbs_nobody(rig: Rig) -> None:
    gone, stays = rig.say(ask(ask="hold"), ask(ask="land"))
    rig.ticks()
    gone.close()
    rig.ticks()
    assert heard(stays)["text"] == "land yes"


def test_too_many_orders_for_one_tick_are_refused(folder: Path) -> None:
    with open_listener(folder, "one") as listener:
        rig = Rig(folder, listener, room=1)
        first, second = rig.say(ask(ask="hold"), ask(ask="land"))
        rig.ticks(2)
        assert heard(first)["ok"] and "too many orders" in heard(second)["text"]
        rig.close()


def test_who_waits_at_the_end_is_told_so(rig: Rig) -> None:
    (client,) = rig.say(ask(ask="land"))
    rig.ticks()
    rig.server.close()
    assert "ended before" in heard(client)["text"]


def test_an_order_that_the_flight_left_unanswered_is_told_as_refused(rig: Rig) -> None:
    (client,) = rig.say(ask(ask="engage"))
    rig.ticks()
    rig.flight.orders.clear()
    rig.ticks()
    assert heard(client) == {"ok": False, "text": "the flight did not answer this order", "status": None}


@pytest.mark.parametrize(("uid", "served"), [("same", True), ("root", True), ("other", False)])
def test_the_kernel_says_who_asks(rig: Rig, monkeypatch: pytest.MonkeyPatch, uid: str, served: bool) -> None:
    own = os.geteuid()
    (client,) = rig.say(ask(ask="status"))
    if uid == "root":
        # the daemon's user is another one, the client is root: only where the tests run as root
        monkeypatch.setattr(os, "geteuid", lambda: own if own else 12345)
    elif uid == "other":
        monkeypatch.setattr("uavctl.daemon.control_socket._CREDENTIALS", Stranger())
    rig.ticks()
    assert bool(heard(client)) is served


class Stranger:
    """Credentials of another user's process."""

    size = 12

    def unpack(self, data: bytes) -> tuple[int, int, int]:
        return 1, os.geteuid() + 4711, 1


def test_folder_and_socket_are_for_one_user(folder: Path) -> None:
    inner = folder / "uavctl"
    with open_listener(inner, "one"):
        assert stat.S_IMODE(inner.stat().st_mode) == 0o700
        assert stat.S_IMODE((inner / "one.sock").stat().st_mode) == 0o600
    assert not (inner / "one.sock").exists()
    inner.chmod(0o750)
    with pytest.raises(UsageError, match="chmod 700"), open_listener(inner, "one"):
        pytest.fail("others may enter")


def test_a_dead_daemon_s_socket_is_taken_over_and_a_live_one_s_is_not(folder: Path) -> None:
    dead = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    dead.bind(str(folder / "one.sock"))
    dead.listen()
    dead.close()  # the file stays, as after SIGKILL
    with open_listener(folder, "one"):
        with pytest.raises(VehicleTakenError, match="a daemon named one is running"), open_listener(folder, "one"):
            pytest.fail("two of one name")
        with open_listener(folder, "two"):
            pass


def test_what_is_no_socket_stays(folder: Path) -> None:
    (folder / "one.sock").write_text("notes")
    with pytest.raises(UsageError, match="another folder"), open_listener(folder, "one"):
        pytest.fail("bound over a file")
    assert (folder / "one.sock").read_text() == "notes"
    with pytest.raises(UsageError, match="shorter folder"):
        make_socket_path(folder / ("x" * 120), "one")
    with pytest.raises(UsageError, match="choose another"), open_listener(folder / "one.sock" / "below", "one"):
        pytest.fail("a folder below a file")


def test_a_socket_of_another_user_in_the_way_is_told_in_a_line(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as theirs:
        theirs.bind(str(folder / "one.sock"))

    def connect(probe: socket.socket, address: str) -> None:
        del probe
        raise PermissionError(13, "Permission denied", address)

    monkeypatch.setattr("uavctl.daemon.control_socket.socket.socket.connect", connect)
    with pytest.raises(UsageError, match=f"run: sudo rm {folder}/one.sock$"), open_listener(folder, "one"):
        pytest.fail("bound over another one's socket")
    assert (folder / "one.sock").is_socket()


def test_names_and_folders() -> None:
    assert make_daemon_name(CONFIG) == "room-udpin-0.0.0.0-14540"
    odd = load_config("room", ['name="a/../b c"', 'daemon.vehicle="serial:///dev/ttyACM0:57600"'])
    assert make_daemon_name(odd) == "a-..-b-c-serial-dev-ttyACM0-57600"
    assert find_control_folder(Path("/x"), {"UAVCTL_CONTROL": "/y"}) == Path("/x")
    assert find_control_folder(None, {"UAVCTL_CONTROL": "/y", "XDG_RUNTIME_DIR": "/z"}) == Path("/y")
    with tempfile.TemporaryDirectory(prefix="uavctl-") as own:
        assert find_control_folder(None, {"XDG_RUNTIME_DIR": own}) == Path(own) / "uavctl"
    assert (
        ControlRequest(ask="goto", position_m=(float("inf"), 0.0, 0.0)).find_problem() == "position_m has to be finite"
    )


def make_cell(**changes: object) -> dict[str, object]:
    box = {"lower_m": [[-1.0, -1.0, -2.0]] * 101, "upper_m": [[1.0, 1.0, -0.5123]] * 101}
    return {"exits": 0, "number": 3, "step": 1_267_000_000, "goal_m": [0.5, 0.0, -1.2], **box, **changes}


def test_a_cell_of_the_longest_horizon_reaches_the_flight_and_its_report_comes_back(rig: Rig) -> None:
    rows = ((0.1, 0.2, -1.0),) * 101
    rig.flight.report = CellReport(
        step=7, path_m=rows, margin_m=rows, velocity_mps=(0.0, 0.0, 0.0), goal_m=(1.0, 0.0, -1.0), exits=2, in_use=4,
        decided=5, conduct=Conduct.CELL, reach_mps2=(1.0, 1.0, 1.0),
    )  # fmt: skip
    (client,) = rig.say(ask(ask="cell", cell=make_cell()))
    rig.ticks()
    reply = heard(client)
    assert reply["ok"] and msgspec.convert(reply["report"], CellReport) == rig.flight.report
    assert rig.flight.cells == [msgspec.convert(make_cell(), CellMessage)]
    assert rig.permits == 0
    client.sendall(ask(ask="cell", may_take_off=True))
    client.setblocking(True)
    rig.ticks()
    assert json.loads(client.recv(65_536))["ok"] and len(rig.flight.cells) == 1 and rig.permits == 1


def test_cells_and_permits_come_from_one_connection_until_it_closes(rig: Rig) -> None:
    """Two coordinators count their cells alike: each would take those of the other one for its own."""
    (first,) = rig.say(ask(ask="cell", cell=make_cell()))
    rig.ticks()
    assert heard(first)["ok"]
    (second,) = rig.say(ask(ask="cell", cell=make_cell(number=4), may_take_off=True))
    rig.ticks()
    reply = heard(second)
    assert not reply["ok"] and reply["report"] is None and "another coordinator" in reply["text"]
    assert len(rig.flight.cells) == 1 and rig.permits == 0
    first.close()
    second.sendall(ask(ask="cell", cell=make_cell(number=4), may_take_off=True))
    rig.ticks()
    second.setblocking(True)
    assert json.loads(second.recv(65_536))["ok"] and len(rig.flight.cells) == 2 and rig.permits == 1


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"lower_m": []}, "0 lower and 101 upper"),
        ({"lower_m": [[2.0, 0.0, 0.0]] * 101}, "above its upper"),
        ({"goal_m": [1e300, 0.0, 0.0]}, "beyond"),
        ({"step": 10**19}, "step"),
        ({"step": 2**60}, "step"),
        ({"number": -1}, "number"),
        ({"goal_m": [0.0, 0.0]}, "not understood"),
        ({"land": "yes"}, "not understood"),
    ],
)
def test_a_malformed_cell_is_refused_with_the_reason(rig: Rig, changes: dict[str, object], words: str) -> None:
    (client,) = rig.say(ask(ask="cell", cell=make_cell(**changes), may_take_off=True))
    rig.ticks()
    reply = heard(client)
    assert not reply["ok"] and words in reply["text"]
    assert not rig.flight.cells and rig.permits == 0


def test_an_order_with_a_cell_is_refused(rig: Rig) -> None:
    (client,) = rig.say(ask(ask="hold", cell=make_cell()))
    rig.ticks()
    assert "takes no cell" in heard(client)["text"] and not rig.flight.orders
