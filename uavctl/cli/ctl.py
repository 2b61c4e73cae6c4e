"""Command `uavctl ctl`: orders and requests for the status to a daemon in flight."""

from __future__ import annotations

import socket
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from cyclopts import App, Parameter
from rich.table import Table

from uavctl.cli.common import Common, QuietJson
from uavctl.cli.output import make_pair_table, print_message
from uavctl.cli.usage import format_example
from uavctl.daemon.control_socket import SUFFIX, ControlRequest, Reply, find_control_folder
from uavctl.daemon.health import Health, RecorderHealth, RelayHealth
from uavctl.errors import NotReachedError, UsageError
from uavctl.mavlink.relay import REASONS
from uavctl.records import Vec3

ANSWER_LIMIT_S = 5.0  # a tick takes a tenth of a second at most
CHECK_LIMIT_S = 1300.0  # `check.seconds` and `check.wait_s` take 600 s each at most
_BLOCK_BYTES = 65_536
_MAX_ANSWER_BYTES = 2**20  # a daemon's status has some thousand

ctl_app = App(
    name="ctl",
    help="Orders to a running flight: takeoff, goto, hold, resume, land, engage; and its status.",
    help_epilogue=format_example("ctl"),
    help_format="markdown",
)


@Parameter(name="*")
@dataclass(frozen=True)
class DaemonChoice:
    """Options of every order: which daemon gets it."""

    vehicle: Annotated[
        str | None, Parameter(help="which daemon, if several run: its name, or a part of it that no other one has")
    ] = None
    control: Annotated[
        Path | None, Parameter(help="folder of the control sockets; else $UAVCTL_CONTROL or the user's own")
    ] = None
    json: QuietJson = False


ANY_DAEMON = DaemonChoice()


@ctl_app.command(usage="Usage: uavctl ctl goto [OPTIONS] NORTH EAST DOWN", help_epilogue=format_example("ctl goto"))
def goto(*place: Annotated[str, Parameter(allow_leading_hyphen=True)], choice: DaemonChoice = ANY_DAEMON) -> int:
    """Fly to a place and stay there: north, east, down in local NED [m], as in `ctl goto 2,1,-2` or `goto 2 1 -2`.

    Args:
        place: north,east,down, or each for itself.
    """
    return _send_order(ControlRequest(ask="goto", position_m=_parse_position(",".join(place))), choice)


@ctl_app.command(usage="Usage: uavctl ctl takeoff [OPTIONS] HEIGHT", help_epilogue=format_example("ctl takeoff"))
def takeoff(
    height: Annotated[float, Parameter(allow_leading_hyphen=True)],
    /,
    *,
    arm: Annotated[bool, Parameter(negative=(), help="the vehicle may be armed; needed")] = False,
    choice: DaemonChoice = ANY_DAEMON,
) -> int:
    """Check vehicle and cameras, arm, climb HEIGHT [m] above the ground, and fly, as `uavctl fly --arm --takeoff`.

    The vehicle stands disarmed on the ground. Ctrl-C during the check takes the order back.

    Args:
        height: height of the climb [m].
    """
    if not arm:
        raise UsageError("takeoff needs --arm: it permits arming the vehicle")
    request = ControlRequest(ask="take-off", height_m=height, arm=arm)
    if request.find_problem() is not None:
        raise UsageError(f"takeoff {height:g}: give a height above the ground [m], as in 1.2")
    print_message("checking before arming; Ctrl-C takes the order back")
    return _send_order(request, choice, CHECK_LIMIT_S)


OrderName = Literal["hold", "resume", "land", "engage"]


def _make_order_command(order_name: OrderName) -> Callable[..., int]:
    def give_order(*, choice: DaemonChoice = ANY_DAEMON) -> int:
        return _send_order(ControlRequest(ask=order_name), choice)

    return give_order


_ORDERS: dict[OrderName, str] = {
    "hold": "Stay where the vehicle comes to rest.",
    "resume": "Continue the configured mission.",
    "land": "Brake and hand over to the vehicle's own landing.",
    "engage": "Ask for the external mode again, after the pilot or the vehicle has left it.",
}
for _name, _help in _ORDERS.items():
    ctl_app.command(_make_order_command(_name), name=_name, help=_help, help_epilogue=format_example(f"ctl {_name}"))


@ctl_app.command(help_epilogue=format_example("ctl status"))
def status(*, choice: DaemonChoice = ANY_DAEMON) -> int:
    """Show the state of the flight. Exit code 1: no daemon answers."""
    reply = send_request(ControlRequest(ask="status"), find_control_folder(choice.control), choice.vehicle)
    if reply.status is None:
        raise NotReachedError(f"the daemon gave no status: {reply.text}; does it have this version?")
    health = reply.status
    Common(json=choice.json).show("ctl/status", health, lambda: _make_status_table(health))
    return 0


def _parse_position(text: str) -> Vec3:
    try:
        north, east, down = map(float, text.split(","))
    except ValueError:
        unknown = [argument for argument in text.split(",") if argument.startswith("--")]
        if unknown:
            raise UsageError(f'Unknown option: "{unknown[0]}"; see uavctl ctl goto --help') from None
        raise UsageError(f"goto {text}: write three numbers, north,east,down [m], as in 2,1,-2") from None
    request = ControlRequest(ask="goto", position_m=(north, east, down))
    if request.find_problem() is not None:
        raise UsageError(f"goto {text}: {request.find_problem()}")
    return north, east, down


def _send_order(request: ControlRequest, choice: DaemonChoice, limit_s: float | None = None) -> int:
    reply = send_request(request, find_control_folder(choice.control), choice.vehicle, limit_s)
    if choice.json:
        Common(json=True).show("ctl/order", {"ok": reply.ok, "text": reply.text}, str)
    else:
        verdict = "accepted" if reply.ok else "refused"
        print_message(f"{request.ask} {verdict}: {reply.text}", highlight=False)
    return 0 if reply.ok else 1


def send_request(request: ControlRequest, folder: Path, vehicle: str | None, limit_s: float | None = None) -> Reply:
    """Return the daemon's answer to a request.

    Args:
        limit_s: Longest wait for it [s]; None: `ANSWER_LIMIT_S`.

    Raises:
        NotReachedError: No daemon, several daemons, or no answer.
    """
    with _connect_daemon(folder, vehicle) as connection:
        try:
            connection.settimeout(ANSWER_LIMIT_S if limit_s is None else limit_s)
            connection.sendall(msgspec.json.encode(request) + b"\n")
            line = bytearray()
            while not line.endswith(b"\n"):
                if len(line) > _MAX_ANSWER_BYTES:
                    raise NotReachedError("the answer does not end; does another program use this socket?")
                data = connection.recv(_BLOCK_BYTES)
                if not data:
                    raise NotReachedError("the daemon closed the connection: it is ending, or runs as another user")
                line += data
            return msgspec.json.decode(line, type=Reply)
        except OSError as error:
            raise NotReachedError(
                f"no answer within {connection.gettimeout():g} s ({error}); the daemon is not ready yet "
                "(its design, the check before arming), or the control loop may hang: watch the vehicle"
            ) from error
        except msgspec.MsgspecError as error:
            raise NotReachedError(
                f"the answer is not understood ({error}); does the daemon have this version?"
            ) from error


def _connect_daemon(folder: Path, vehicle: str | None) -> socket.socket:
    """Return a connection to the chosen daemon."""
    paths = {path.name.removesuffix(SUFFIX): path for path in _list_sockets(folder)}
    names = [name for name in paths if vehicle is None or vehicle in name]
    if vehicle in paths:
        names = [vehicle]
    connections: dict[str, socket.socket] = {}
    for name in names:
        connection = _connect_socket(paths[name])
        if connection is not None:
            connections[name] = connection
    if len(connections) == 1:
        return connections.popitem()[1]
    for connection in connections.values():
        connection.close()
    if connections:
        raise NotReachedError(f"several daemons run: {', '.join(sorted(connections))}; choose one with --vehicle NAME")
    missing = "no daemon" if vehicle is None else f"no daemon named like {vehicle!r}"
    raise NotReachedError(
        f"{missing} answers in {folder}; start one with `uavctl fly`, or name its folder with --control "
        "(a service's is in its unit)"
    )


def _list_sockets(folder: Path) -> list[Path]:
    try:
        return sorted(path for path in folder.iterdir() if path.suffix == SUFFIX)
    except FileNotFoundError:
        return []
    except OSError as error:
        raise NotReachedError(
            f"{folder}: {error.strerror}; orders are for the user that the daemon runs as, and for root"
        ) from error


def _connect_socket(path: Path) -> socket.socket | None:
    """Return a connection to a daemon's socket; None if the daemon has ended."""
    connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    connection.settimeout(ANSWER_LIMIT_S)
    try:
        connection.connect(str(path))
    except OSError:
        connection.close()
        return None
    return connection


def _make_status_table(health: Health) -> Table:
    vehicle, recorder = health.vehicle, health.recorder
    rows = {
        "mode": "waiting" if health.mode is None else f"{health.mode.value}: {health.reason}",
        "in control": health.who_flies or "-",
        **({"ending": health.ending} if health.ending else {}),
        **({} if health.relay is None else {"relay": describe_relay(health.relay)}),
        "age": "-" if health.age_s is None else f"{health.age_s:.2f} s ({health.age_steps} steps)",
        "position": _format_point(health.position_m),
        "target": _format_point(health.target_m),
        "vehicle": "not heard" if vehicle is None else f"{vehicle.mode}, {'armed' if vehicle.armed else 'disarmed'}",
        "battery": "-" if vehicle is None or vehicle.battery_v is None else f"{vehicle.battery_v:.1f} V",
        "loss": "-" if health.loss is None else f"{health.loss:.0%}",
        "lateness": f"{health.lateness_us / 1e3:.2f} ms, {health.missed_ticks} ticks missed",
        "recording": recorder.path
        if recorder.ok and not recorder.reason
        else f"{recorder.path}, {_describe_recorder(recorder)}",
    }
    return make_pair_table(f"{health.name} (process {health.pid}), {health.url}", list(rows.items()))


def describe_relay(relay: RelayHealth) -> str:
    """Describe how the vehicle gets its positions, also after the end of control."""
    if relay.last_s is None:
        return "no position has been passed on yet"
    suffix = "; control has ended, positions continue" if relay.alone else ""
    if relay.attitude_fault:
        suffix += f"; {REASONS.get(relay.attitude_fault, relay.attitude_fault)}"
    return f"{relay.sent_hz:.0f} positions a second, {relay.sent} in all, the last {relay.last_s:.1f} s ago{suffix}"


def _describe_recorder(recorder: RecorderHealth) -> str:
    """Describe the trouble of the recording."""
    return f"{'' if recorder.ok else 'fails, '}{recorder.dropped} dropped: {recorder.reason or 'the disk is slow'}"


def _format_point(point: dict[str, float] | None) -> str:
    return "-" if point is None else ", ".join(f"{axis} {value:z.2f} m" for axis, value in point.items())
