"""Common parts of flights, of fly and loopback: recording, signals, live line, engagement."""

from __future__ import annotations

import pickle
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Protocol

from cyclopts import Parameter
from msgspec.structs import replace
from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, Task, TimeElapsedColumn
from rich.text import Text

from logs.recording.ends import count_missing_records, describe_ending
from logs.recording.flight import FlightData
from logs.recording.reader import read
from logs.recording.recorder import DerivedTopics, RecorderStatus, live_view
from logs.recording.summary import FlightSummary, summarise
from logs.recording.views import ViewBuilder
from uavctl.cli.common import FREE_PORT, labelled, messages
from uavctl.daemon.engagement import make_goto_keys
from uavctl.errors import ConnectionClosedError, EndedBySignal, RecordingError, UavctlError, UsageError, in_words
from uavctl.event_codes import EventCode
from uavctl.loop import ControlLoop
from uavctl.mavlink.handover_states import HandoverState
from uavctl.records import Command, ControlMode, Ending, Event, Order, Record, Severity, Ticked

# What `fly` and `loopback` ask of the hand-over: whether to arm and take off, and where to go.


def goto_overrides(goto: str | None) -> tuple[str, ...]:
    """Return configuration keys for `--goto x,y,z`.

    Raises:
        UsageError: it is not three numbers.
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


def stand_by(loop: ControlLoop, flown_ns: int) -> None:
    """Leave a vehicle alone that is found armed, and say so: an earlier daemon left it in flight.

    Args:
        flown_ns: when that flight began; a vehicle that has started since is another one.
    """
    loop.order(Command(order=Order.STAND_BY, flown_ns=flown_ns))
    messages().print(
        labelled(
            "warning",
            "the daemon before this one left the vehicle in flight; if it is still armed, and has not started anew "
            "since, nothing is sent until `uavctl ctl engage`",
            "bold yellow",
        ),
        soft_wrap=True,
    )


def checked_take_off(arm: bool, takeoff: float | None) -> float | None:
    """Return the height of the climb [m], if the command line asks for one; --arm and --takeoff go together.

    Raises:
        UsageError: one of the two is missing.
    """
    if arm and takeoff is None:
        raise UsageError("--arm needs --takeoff HEIGHT: on the ground nothing else can be done with an armed vehicle")
    if takeoff is not None and not arm:
        raise UsageError("--takeoff needs --arm: say that the vehicle may be armed")
    return takeoff


def tell_ending(ending: Ending) -> None:
    """Say on the console how the flight ended."""
    style = "bold" if ending.as_ordered else "bold red"
    messages().print(labelled("ended", ending.sentence, style), soft_wrap=True)
    if ending.relay:
        messages().print(labelled("relay", ending.relay, "bold"), soft_wrap=True)


# What a person at the console is told of a flight's events, and of what is being waited for.


AGAIN_NS = 30_000_000_000  # until the same is said again, if it goes on
MOST = 256  # different texts that are remembered

_WAITS_FOR = {
    HandoverState.WAITING: "the vehicle's heartbeat",
    HandoverState.MODE: "the mode to take off in",
    HandoverState.ARMING: "arming",
    HandoverState.CLIMBING: "the end of the climb",
    HandoverState.ENGAGING: "the mode that takes setpoints",
    HandoverState.RETURNING: "the mode that takes setpoints",
    HandoverState.LANDING: "landing",
    HandoverState.SETTLING: "the ground",
}


def waits_for(state: HandoverState) -> str:
    """Return what the hand-over waits for; empty if it waits for nothing of the vehicle."""
    return _WAITS_FOR.get(state, "")


class Said:
    """Filter for messages: each different text passes once, and again only after a while if it goes on."""

    def __init__(self) -> None:
        self._said_ns: dict[str, int] = {}

    def line(self, event: Event, state: HandoverState) -> str | None:
        """Return the line to print for an event now; None for nothing."""
        if event.code == EventCode.VEHICLE_TEXT and event.severity is Severity.INFO:
            return None
        said_ns = self._said_ns.get(event.text)
        if said_ns is not None and event.at_ns - said_ns < AGAIN_NS:
            return None
        if said_ns is None and len(self._said_ns) >= MOST:
            del self._said_ns[min(self._said_ns, key=lambda text: self._said_ns[text])]
        self._said_ns[event.text] = event.at_ns
        waiting = waits_for(state)
        text = f'the vehicle says: "{event.text}"' if event.code == EventCode.VEHICLE_TEXT else event.text
        return f"{text} (waiting for {waiting})" if waiting else text


# What `fly` and `loopback` share: the recording's beginning and end, signals, the live line.


MAX_NEWS = 64  # that wait to be shown, of the vehicle and the core
MAX_NOTICES = 100  # the same, of the hand-over
REFRESH_S = 0.25
SIGNALLED = 128  # exit codes of a process that a signal has ended are this much higher than its number
LIVE_PORT = 8765  # where Foxglove looks first
Live = Annotated[
    bool,
    Parameter(
        negative=(),
        help="show the flight in a browser on this machine and, with uavctl[live], serve its topics to Foxglove",
    ),
]
LivePort = Annotated[
    int | None,
    Parameter(
        help=f"TCP port for Foxglove, 0 is any free one; else {LIVE_PORT}. The page's is the next one",
        validator=FREE_PORT,
    ),
]
# How long another thread may keep the control thread waiting for the interpreter [s].
SWITCH_INTERVAL_S = 0.0005


class FlightRecorder(Protocol):
    """Interface of a recorder."""

    def put(self, topic: str, at_ns: int, record: Record) -> None:
        """Record one value."""
        ...

    def close(self) -> RecorderStatus:
        """End the recording."""
        ...

    def status(self) -> RecorderStatus:
        """Return the state of the recorder."""
        ...


def live_view_port(*, live: bool, port: int | None) -> int | None:
    """Return the port of the live view; None if there is none.

    Raises:
        UsageError: A port, and no view.
    """
    if port is not None and not live:
        raise UsageError(f"--live-port {port} is of the live view; add --live")
    return (LIVE_PORT if port is None else port) if live else None


@contextmanager
def onlookers(live_port: int | None = None) -> Iterator[DerivedTopics]:
    """Make what looks on at a flight: views in its recording and, with a port, a live page and a live view.

    Args:
        live_port: TCP port of the view, the page's is the next one; 0: any free ones.

    Raises:
        UsageError: there can be no live page, or no live view.
    """
    if live_port is None:
        yield DerivedTopics(ViewBuilder())
        return
    from logs.live import FlightScene, serve_live_page  # nobody looks: nothing of it is loaded

    def tell(port: int) -> None:
        messages().print(f'for Foxglove: ws://localhost:{port} ("Open connection")', soft_wrap=True)

    flight, has_sdk = FlightScene(), find_spec("foxglove") is not None
    with (
        serve_live_page(flight.scene, live_port and live_port + 1) as address,
        live_view(live_port if has_sdk else None, on_open=tell) as watch,
    ):
        messages().print(f"live page: {address}", soft_wrap=True)
        if not has_sdk:
            messages().print("nothing for Foxglove: that takes pip install 'uavctl[live]'", soft_wrap=True)
        yield DerivedTopics(ViewBuilder(), watch, flight.add_record)


def conclude(path: Path, wall_s: float, status: RecorderStatus, ending: Ending | None = None) -> FlightSummary:
    """Read the recording back, summarise it and have its page drawn; a page that fails is only reported.

    Args:
        path: path of the recording, which is closed.
        wall_s: how long the flight took [s].
        ending: how the flight ended, in the words of those who flew; None where nobody did.

    Raises:
        RecordingError: the recording cannot be read, or nothing was flown.
    """
    tell_losses(status)
    if not status.segments and status.gone:
        raise RecordingError(f"{path}: {status.reason}; nothing of the flight is on the disk")
    flight = FlightData.from_records(read(path), path)
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
    except UavctlError as error:  # the flight and its recording are as they are
        messages().print(labelled("warning", f"no page: {error}"), soft_wrap=True)
        summary = replace(summary, report=None)
    return summary


def draw_page(path: Path, summary: FlightSummary, page: Path) -> None:
    """Write the page of a recording in a process of its own, so that matplotlib is not loaded where it flies.

    Args:
        path: path of the recording.
        summary: summary of the flight, as the console shows it.
        page: where it is written.

    Raises:
        UavctlError: it cannot be written; the recording is as it was.
    """
    command = [sys.executable, "-P", "-m", "logs.report.flight_page", str(path), str(page)]
    done = subprocess.run(command, input=pickle.dumps(summary), capture_output=True, check=False)
    if done.returncode:
        told = done.stderr.decode(errors="replace").strip().splitlines()
        why = told[-1] if told else f"its process ended with {done.returncode}"
        where = "" if str(page) in why else f"{page}: "
        raise UavctlError(f"{where}{why}; `uavctl log report {path}` draws the page once that is mended")


@contextmanager
def ending_noted(loop: ControlLoop) -> Iterator[None]:
    """Record an error that ends a flight; a lost link is reported with the flight's end instead of raised."""
    try:
        yield
    except ConnectionClosedError:
        pass
    except SystemExit as ended:
        loop.account.note_signal(int(ended.code or 0) - SIGNALLED)
        raise
    except Exception as error:
        loop.account.control_error = in_words(error)
        raise


@contextmanager
def stop_on_signals() -> Iterator[Callable[[], bool]]:
    """Yield a function that says whether Ctrl-C or SIGTERM has come; a second signal ends the process at once."""
    asked = threading.Event()

    def ask(number: int, frame: object) -> None:
        del frame
        if asked.is_set():
            raise EndedBySignal(SIGNALLED + number)
        asked.set()

    before = {number: signal.signal(number, ask) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield asked.is_set
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


SERVER_RETRY_S = 1.0


def wait_for_server(stopped: Callable[[], bool]) -> Callable[[str], bool]:
    """Return a function that waits a second for a server of TCP, says so once, and returns False once it is to stop."""
    told: set[str] = set()

    def wait(url: str) -> bool:
        if url not in told:
            told.add(url)
            messages().print(f"waiting for {url}, where nobody listens yet; Ctrl-C ends it", soft_wrap=True)
        until_s = time.monotonic() + SERVER_RETRY_S
        while time.monotonic() < until_s and not stopped():
            time.sleep(0.05)
        return not stopped()

    return wait


class LiveFeed:
    """Last tick and messages of a flight that are to be shown: filled by the control loop's thread, emptied by another.

    Attributes:
        ticked: the last tick; None before the first.
        news: of the vehicle and the core, not shown yet.
        notices: of the hand-over, not shown yet.
    """

    def __init__(self) -> None:
        self.ticked: Ticked | None = None
        self.news: deque[Event] = deque(maxlen=MAX_NEWS)
        self.notices: deque[Event] = deque(maxlen=MAX_NOTICES)

    def after_tick(self, ticked: Ticked, lateness_ns: int) -> None:
        """Keep a tick, and queue its messages."""
        del lateness_ns
        self.news.extend(ticked.news)
        self.notices.extend(ticked.notices)
        self.ticked = ticked


@contextmanager
def live_line(
    loop: ControlLoop, recorder: FlightRecorder, duration_s: float | None, tick_s: float
) -> Iterator[LiveFeed]:
    """Show the state of the loop while it flies, from a thread of its own, on standard error; yields its feed."""
    before_s = sys.getswitchinterval()
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    columns = (BarColumn(bar_width=20), TimeElapsedColumn(), _State())
    done, told = threading.Event(), threading.Event()
    with Progress(*columns, console=messages(), transient=True, refresh_per_second=1 / REFRESH_S) as progress:
        # The bar's own console would draw it, also into a file.
        console = progress.console if progress.console.is_terminal else messages()
        task = progress.add_task("waiting", total=duration_s)
        said, feed = Said(), LiveFeed()

        def tell() -> None:
            while feed.news:
                line = said.line(feed.news.popleft(), loop.handover_state)
                if line is not None:
                    console.print(Text(line, style="yellow"), soft_wrap=True)

        def show() -> None:
            while not done.wait(REFRESH_S):
                tell()
                ticked = feed.ticked
                tell_notices(feed.notices, console)
                if loop.let_go and not told.is_set():
                    told.set()
                    console.print(labelled("letting go", loop.let_go, "bold red"), soft_wrap=True)
                if ticked is not None:
                    line = _line(ticked, loop.handover_state) + _alarm(recorder.status())
                    progress.update(task, completed=ticked.decision.tick * tick_s, line=line)

        thread = threading.Thread(target=show, name="live", daemon=True)
        thread.start()
        try:
            yield feed
        finally:
            done.set()
            thread.join()
            tell()
            tell_notices(feed.notices, console)
            sys.setswitchinterval(before_s)


def tell_notices(notices: deque[Event], console: Console) -> None:
    """Print the hand-over's notices and take them out: each transition that is a warning."""
    while notices:
        event = notices.popleft()
        style = "bold red" if event.severity is Severity.ERROR else "bold yellow"
        console.print(labelled(event.code, event.text, style), soft_wrap=True)


class _State(ProgressColumn):
    """State of a flight, in its styles."""

    def render(self, task: Task) -> Text:
        """Return what the task's field `line` holds."""
        line = task.fields.get("line")
        return line if isinstance(line, Text) else Text(task.description)


def _line(ticked: Ticked, who_flies: HandoverState) -> Text:
    decision, vehicle, estimate = ticked.decision, ticked.vehicle, ticked.estimate
    mode = "no vehicle" if vehicle is None else f"{vehicle.mode} {'armed' if vehicle.armed else 'disarmed'}"
    age = "-" if estimate is None else f"{max(0.0, estimate.age_s):.2f} s"
    accel = "-" if decision.input is None else " ".join(f"{u:+z.2f}" for u in decision.input)
    waiting = waits_for(who_flies) if decision.mode is ControlMode.WAIT else ""
    mode = f"{mode}, waiting for {waiting}" if waiting else mode
    return Text.assemble(f"{decision.mode.value:7} age {age:>6}  input {accel}  ", (mode, "dim"))


def _alarm(status: RecorderStatus) -> Text:
    """Return a warning on the recording while it is being made; empty if there is none."""
    if status.ok:
        return Text(f"  disk gets low: {status.warning}" if status.warning else "", style="yellow")
    return Text(f"  recording in trouble: {status.reason or f'{status.dropped} records dropped'}", style="bold red")


def tell_losses(status: RecorderStatus) -> None:
    """Print after a flight what the recording lacks, and why."""
    if status.failures or not status.ok:
        messages().print(
            labelled(
                "warning",
                f"the recording lacks {count_missing_records(status)} records "
                f"({status.reason or status.refusal or 'the disk was too slow'}); what is in it is whole. "
                f"Files: {', '.join(status.segments) or 'none'}",
                "bold red",
            ),
            soft_wrap=True,
        )
