"""Common parts of the flights of `fly` and `loopback`: orders, signals, viewers and the summary."""

from __future__ import annotations

import pickle
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from traceback import format_exc
from typing import TYPE_CHECKING, Annotated, NamedTuple

from cyclopts import Parameter
from msgspec.structs import replace

from logs.recording.ends import count_missing_records, describe_ending, find_missing_files
from logs.recording.flight import FlightData
from logs.recording.missed_ticks import describe_missed_ticks
from logs.recording.reader import read
from logs.recording.recorder import DerivedTopics, RecorderStatus, Watcher
from logs.recording.summary import FlightSummary, summarise
from logs.recording.views import ViewBuilder
from uavctl.cli.common import FREE_PORT
from uavctl.cli.output import label_text, print_message
from uavctl.cli.signals import SIGNAL_EXIT_BASE, stop_on_signals
from uavctl.daemon.flight_orders import make_goto_keys
from uavctl.errors import ConnectionClosedError, TickOverdueError, UavctlError, UsageError, in_words
from uavctl.loop import ControlLoop
from uavctl.records import Command, Ending, Order

if TYPE_CHECKING:
    from logs.live.feed_process import FeedProcess


def make_goto_overrides(goto: str | None) -> tuple[str, ...]:
    """Return configuration keys for `--goto x,y,z`.

    Raises:
        UsageError: It is not three numbers.
    """
    if goto is None:
        return ()
    try:
        keys = make_goto_keys([float(number) for number in goto.split(",")])
    except (ValueError, UsageError) as error:
        raise UsageError(
            f"--goto {goto}: give north, east and down in local NED [m], as in --goto 2,1,-2 (up is < 0)"
        ) from error
    return tuple(f"{key}={value!r}".replace("'", '"') for key, value in keys.items())


def order_stand_by(loop: ControlLoop, flown_ns: int) -> None:
    """Order no setpoints to an armed vehicle that an earlier daemon left in flight, and print a warning.

    Args:
        flown_ns: Begin of that flight; a vehicle that has started later is another one.
    """
    loop.order(Command(order=Order.STAND_BY, flown_ns=flown_ns))
    print_message(
        label_text(
            "warning",
            "an earlier daemon left the vehicle in flight; if the vehicle is still armed, and has not restarted "
            "since, nothing is sent until `uavctl ctl engage`",
            "bold yellow",
        )
    )


def check_take_off(arm: bool, takeoff: float | None) -> float | None:
    """Return the height of the climb [m], if the command line asks for one; --arm and --takeoff go together.

    Raises:
        UsageError: One of the two is missing.
    """
    if arm and takeoff is None:
        raise UsageError("--arm needs --takeoff HEIGHT: an armed vehicle on the ground can only take off")
    if takeoff is not None and not arm:
        raise UsageError("--takeoff needs --arm: it permits arming the vehicle")
    return takeoff


def print_ending(ending: Ending) -> None:
    """Print how the flight ended."""
    style = "bold" if ending.as_ordered else "bold red"
    print_message(label_text("ended", ending.sentence, style))
    if ending.relay:
        print_message(label_text("relay", ending.relay, "bold"))


LIVE_PORT = 8765  # where Foxglove looks first
Live = Annotated[
    bool,
    Parameter(
        negative=(), help="show the flight to browsers and to Foxglove on this machine, from a process of its own"
    ),
]
LivePort = Annotated[
    int | None, Parameter(help=f"TCP port of the live view, 0 is any free one; else {LIVE_PORT}", validator=FREE_PORT)
]


def choose_live_port(*, live: bool, port: int | None) -> int | None:
    """Return the port of the live view; None if there is none.

    Raises:
        UsageError: A port is given without a view.
    """
    if port is not None and not live:
        raise UsageError(f"--live-port {port} belongs to the live view; add --live")
    return (LIVE_PORT if port is None else port) if live else None


class Ros2Choice(NamedTuple):
    """What `--ros2` asks for."""

    namespace: str
    control: tuple[Path, str] | None = None  # folder and name of the daemon that gets orders; None: none are taken


@contextmanager
def open_viewers(
    live_port: int | None = None, ros2: Ros2Choice | None = None, sockets: Mapping[str, Path] | None = None
) -> Iterator[DerivedTopics]:
    """Open the viewers of a flight: views in its recording, a live view and a node of ROS 2 in processes of their own.

    Args:
        live_port: TCP port of the live view; 0: any free one; None: no live view.
        ros2: Node of ROS 2; None: no node.
        sockets: Control socket by name of the vehicle, for orders of the live view's page; None: it gives none.

    Raises:
        UsageError: The live view or the node cannot be opened.
    """
    with ExitStack() as stack:
        processes: list[FeedProcess] = []
        if live_port is not None:
            from logs.live.process import LiveProcess  # loaded only for a live view

            live = LiveProcess(live_port, report_dead_view, sockets)
            stack.callback(live.close)
            processes.append(live)
            print_message(f"live page: {live.page_url}")
            print_message(f'for Foxglove: ws://localhost:{live.port}/{live.token} ("Open connection")')
        if ros2 is not None:
            from uavctl.cli.ros2_process import Ros2Process  # loaded only for a node

            node = Ros2Process(*ros2, report_dead_node)
            stack.callback(node.close)
            processes.append(node)
            print_message(f"ROS 2: /{ros2.namespace}/pose, plan, limits and /diagnostics")
        yield DerivedTopics(ViewBuilder(), _join_watchers(processes))


def _join_watchers(processes: Sequence[FeedProcess]) -> Watcher | None:
    """Return the function that gives each message to all processes; None without any."""
    if len(processes) < 2:
        return processes[0].send if processes else None

    def send(topic: str, at_ns: int, data: bytes) -> None:
        for process in processes:
            process.send(topic, at_ns, data)

    return send


def print_warning(text: str) -> None:
    """Print a warning."""
    print_message(label_text("warning", text))


def report_dead_view(reason: str) -> None:
    """Print that the process of a live view has ended, and the effect."""
    print_message(label_text("warning", f"the live view has ended: {reason}; the flight continues"))


def report_dead_node(reason: str) -> None:
    """Print that the process of a node of ROS 2 has ended, and the effect."""
    print_message(label_text("warning", f"the node of ROS 2 has ended: {reason}; the flight continues"))


def conclude_flight(path: Path, wall_s: float, status: RecorderStatus, ending: Ending | None = None) -> FlightSummary:
    """Read the closed recording, summarise it and draw its page; a failure of the page is only printed.

    The flight is over: a first signal ends nothing any more, a second deliberate one ends the command.

    Args:
        path: Path of the recording.
        wall_s: Duration of the flight [s].
        ending: Ending as the control loop has it; None: the ending that the recording has.

    Raises:
        RecordingError: The recording cannot be read, or nothing was flown.
    """
    print_losses(status)
    with stop_on_signals():
        flight = FlightData.from_records(read(path), path)
        slowness = describe_missed_ticks(flight.decisions)
        if slowness:
            print_message(label_text("warning", f"this computer was too slow: {slowness}", "bold yellow"))
        page = path.with_suffix(".html")
        summary = summarise(
            flight,
            wall_s=wall_s,
            recording=str(path),
            report=str(page),
            recorder_dropped=0 if status.ok else count_missing_records(status),
            ending=None if ending is None else describe_ending(ending, status),
        )
        try:
            draw_page(path, summary, page)
        except UavctlError as error:  # the flight and its recording are complete
            print_message(label_text("warning", f"no page: {error}"))
            summary = replace(summary, report=None)
        return summary


def draw_page(path: Path, summary: FlightSummary, page: Path) -> None:
    """Write the page of a recording in a process of its own, so that the flight does not load matplotlib.

    Args:
        path: Path of the recording.
        summary: Summary of the flight, as the console shows it.
        page: Path of the page.

    Raises:
        UavctlError: The page cannot be written; the recording is unchanged.
    """
    run_page_process("logs.report.flight_page", path, page, pickle.dumps(summary))


def run_page_process(module: str, path: Path, page: Path, data: bytes = b"") -> str:
    """Run a module that draws a page in a process of its own; return its output.

    Args:
        module: Called with both paths.
        path: Path of the recording, or of a fleet's folder.
        page: Path of the page.
        data: Standard input of the process.

    Raises:
        UavctlError: The page cannot be written; the recordings are unchanged.
    """
    command = [sys.executable, "-P", "-m", module, str(path), str(page)]
    try:
        process = subprocess.run(command, input=data, capture_output=True, check=False)
    except OSError as error:  # no memory, or no descriptor left
        raise UavctlError(f"{page}: {error.strerror}; `uavctl log report {path}` draws the page later") from error
    if process.returncode:
        error_lines = process.stderr.decode(errors="replace").strip().splitlines()
        reason = error_lines[-1] if error_lines else f"its process ended with {process.returncode}"
        prefix = "" if str(page) in reason else f"{page}: "
        raise UavctlError(f"{prefix}{reason}; `uavctl log report {path}` draws the page after the repair")
    return process.stdout.decode(errors="replace").strip()


@contextmanager
def record_failure(loop: ControlLoop) -> Iterator[None]:
    """Record an error that ends a flight. A lost link, and an unexpected error, are not raised: the ending has them."""
    try:
        yield
    except ConnectionClosedError:
        pass
    except SystemExit as error:
        loop.account.note_signal(int(error.code or 0) - SIGNAL_EXIT_BASE)
        raise
    except UavctlError as error:
        loop.account.control_error = in_words(error)
        raise
    except (Exception, TickOverdueError) as error:  # noqa: BLE001 the flight is over; its ending holds the cause
        loop.account.control_error = in_words(error)
        sys.stderr.write(format_exc())


SERVER_RETRY_S = 1.0


def wait_for_server(stopped: Callable[[], bool]) -> Callable[[str], bool]:
    """Return a function that waits a second for a TCP server; it prints this once, and returns False after a stop."""
    reported_urls: set[str] = set()

    def wait(url: str) -> bool:
        if url not in reported_urls:
            reported_urls.add(url)
            print_message(f"waiting for {url}, where no server listens yet; Ctrl-C ends it")
        until_s = time.monotonic() + SERVER_RETRY_S
        while time.monotonic() < until_s and not stopped():
            time.sleep(0.05)
        return not stopped()

    return wait


def print_losses(status: RecorderStatus) -> None:
    """Print after a flight the gaps of the recording, and their cause."""
    if status.failures or not status.ok:
        missing = count_missing_records(status)
        missing_files = find_missing_files(status)
        loss = f"the recording lacks {missing} records" if missing else "a write of the recording failed"
        print_message(
            label_text(
                "warning",
                f"{loss} ({status.reason or status.refusal or 'the disk was too slow'}); the records in it are whole. "
                f"Files: {', '.join(name for name in status.segments if name not in missing_files) or 'none'}"
                + (f". Deleted or moved: {', '.join(missing_files)}" if missing_files else ""),
                "bold red",
            )
        )
