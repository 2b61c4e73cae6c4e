"""What `fly` and `loopback` share: the recording's beginning and end, signals, the live line."""

from __future__ import annotations

import shlex
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Protocol

from cyclopts import Parameter
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from logs.disk import check_room
from logs.flight_data import FlightData
from logs.journal import RecorderStatus
from logs.live import live_view
from logs.made_folders import no_empty_folders
from logs.onlookers import Onlookers
from logs.reader import read
from logs.report import write_report
from logs.summary import FlightSummary, summarise
from logs.topics import HEADER, LIBRARY
from logs.views import Views
from uavctl.build import record_of
from uavctl.cli.common import FREE_PORT, messages
from uavctl.cli.prepare import Prepared
from uavctl.cli.provenance import cpu, versions
from uavctl.cli.said import Said, waits_for
from uavctl.config import Config
from uavctl.config.load import dump_config
from uavctl.data import ControlMode, Ending, Header, PolicyLibrary, Record, Severity
from uavctl.ending import lacking
from uavctl.errors import ConnectionClosedError, RecordingError, UsageError
from uavctl.loop import ControlLoop

LANDING_S = 10.0  # after braking: for asking the vehicle to land
REFRESH_S = 0.25
SIGNALLED = 128  # exit codes of a process that a signal has ended are this much higher than its number
LIVE_PORT = 8765  # where Foxglove looks first
Live = Annotated[bool, Parameter(negative=(), help="serve the topics to a viewer on this machine; needs uavctl[live]")]
LivePort = Annotated[
    int | None, Parameter(help=f"TCP port of the live view, 0 is any free one; else {LIVE_PORT}", validator=FREE_PORT)
]
# How long another thread may keep the control thread waiting for the interpreter [s].
SWITCH_INTERVAL_S = 0.0005


class Recording(Protocol):
    """A recorder of either kind."""

    def put(self, topic: str, at_ns: int, record: Record) -> None:
        """Record one value."""
        ...

    def close(self) -> RecorderStatus:
        """End the recording."""
        ...

    def status(self) -> RecorderStatus:
        """How it is doing."""
        ...


def live_view_port(*, live: bool, port: int | None) -> int | None:
    """Port of the live view; None if there is none.

    Raises:
        UsageError: A port, and no view.
    """
    if port is not None and not live:
        raise UsageError(f"--live-port {port} is of the live view; add --live")
    return (LIVE_PORT if port is None else port) if live else None


@contextmanager
def onlookers(live_port: int | None = None) -> Iterator[Onlookers]:
    """Those who look at a flight: viewers of its recording, and with a port a live view.

    Raises:
        UsageError: there can be no live view.
    """

    def tell(port: int) -> None:
        messages().print(f'live view: ws://localhost:{port} (Foxglove, "Open connection")', soft_wrap=True)

    with live_view(live_port, on_open=tell) as watch:
        yield Onlookers(Views(), watch)


def recording_path(out: Path | None, name: str) -> Path:
    """File of a new recording: in `out`, or in a folder of its own below `flights/`."""
    stamp = datetime.now(UTC).strftime("%Y%m%d-%H%M%S-%f")[:-3]
    folder = out if out is not None else Path("flights") / f"{stamp}-{name}"
    return folder / "flight.mcap"


@contextmanager
def new_recording(out: Path | None, name: str, free_bytes: int) -> Iterator[Path]:
    """File of a new recording, with room for it; folders that are made for it and stay empty are gone in the end.

    Raises:
        RecordingError: as `check_room` does.
    """
    path = recording_path(out, name)
    with no_empty_folders([path]):
        check_room(path, free_bytes)
        yield path


def put_header(recorder: Recording, prepared: Prepared, started_ns: int) -> None:
    """Begin a recording with what is needed to decide alike."""
    config, design, library = prepared.config, prepared.design, prepared.library
    header = Header(
        started_ns=started_ns,
        started_utc=datetime.now(UTC).isoformat(timespec="milliseconds"),
        seed=config.sim.seed,
        command=shlex.join(["uavctl", *sys.argv[1:]]),
        config_toml=dump_config(config),
        design_id=design.design_id,
        design=record_of(design),
        versions=versions(),
        cpu=cpu(),
        library_id=None if library is None else library.library_id,
    )
    recorder.put(HEADER, started_ns, header)
    if library is not None:
        record = PolicyLibrary(library_id=library.library_id, design_id=design.design_id, data=library.data)
        recorder.put(LIBRARY, started_ns, record)


def stop_limit_s(config: Config, *, takes_off: bool) -> float:
    """How long a hand-over may take [s]; a flight that we began, or that lands by our positions, ends on the ground."""
    lands = takes_off or config.relay.enabled
    return config.fallback.brake_s + LANDING_S + (config.hand_over.land_s if lands else 0.0)


def conclude(path: Path, wall_s: float, status: RecorderStatus, ending: Ending | None = None) -> FlightSummary:
    """Read the recording back, sum it up and write the page beside it.

    Args:
        path: of the recording, which is closed.
        wall_s: how long the flight took [s].
        status: how the recorder fared.
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
        recorder_dropped=0 if status.ok else _lacking(status),
        ending=None if ending is None else final(ending, status),
    )
    write_report(flight, summary, page)
    return summary


@contextmanager
def ending_noted(loop: ControlLoop) -> Iterator[None]:
    """Note what ends a flight otherwise than in order; the link's end is told with the flight's, and raises no more."""
    try:
        yield
    except ConnectionClosedError:
        pass
    except SystemExit as ended:
        loop.course.kill(int(ended.code or 0) - SIGNALLED)
        raise
    except Exception as error:
        loop.course.died = f"{type(error).__name__}: {error}"
        raise


def final(ending: Ending, status: RecorderStatus) -> Ending:
    """How a flight ended, with how its recording did."""
    why = status.reason or status.refusal or "the disk was too slow"
    return ending if status.ok else lacking(ending, max(_lacking(status), 1), why)


@contextmanager
def stop_on_signals() -> Iterator[Callable[[], bool]]:
    """Turn Ctrl-C and SIGTERM into a question that the loop asks; a second signal ends at once."""
    asked = threading.Event()

    def ask(number: int, frame: object) -> None:
        del frame
        if asked.is_set():
            raise SystemExit(SIGNALLED + number)
        asked.set()

    before = {number: signal.signal(number, ask) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield asked.is_set
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def live_line(loop: ControlLoop, recorder: Recording, duration_s: float | None, tick_s: float) -> Iterator[None]:
    """Show what the loop does while it flies, from a thread of its own, on standard error."""
    before_s = sys.getswitchinterval()
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    columns = (BarColumn(bar_width=20), TimeElapsedColumn(), TextColumn("{task.description}"))
    done, told = threading.Event(), threading.Event()
    with Progress(*columns, console=messages(), transient=True, refresh_per_second=1 / REFRESH_S) as progress:
        task = progress.add_task("waiting", total=duration_s)
        said = Said()

        def tell() -> None:
            while loop.news:
                line = said.line(loop.news.popleft(), loop.who_flies)
                if line is not None:
                    progress.console.print(f"[yellow]{escape(line)}[/]", soft_wrap=True)

        def show() -> None:
            while not done.wait(REFRESH_S):
                tell()
                decision = loop.decision
                tell_notices(loop, progress.console)
                if loop.let_go and not told.is_set():
                    told.set()
                    progress.console.print(f"[bold red]letting go:[/] {escape(loop.let_go)}", soft_wrap=True)
                if decision is not None:
                    line = _line(loop) + _alarm(recorder.status())
                    progress.update(task, completed=decision.tick * tick_s, description=line)

        thread = threading.Thread(target=show, name="live", daemon=True)
        thread.start()
        try:
            yield
        finally:
            done.set()
            thread.join()
            tell()
            tell_notices(loop, progress.console)
            sys.setswitchinterval(before_s)


def tell_notices(loop: ControlLoop, console: Console) -> None:
    """Say what the hand-over has to tell a person, as far as it is not said yet: each transition that is a warning."""
    while loop.notices:
        event = loop.notices.popleft()
        style = "bold red" if event.severity is Severity.ERROR else "bold yellow"
        console.print(f"[{style}]{event.code}:[/] {escape(event.text)}", soft_wrap=True)


def _line(loop: ControlLoop) -> str:
    decision, vehicle, estimate = loop.decision, loop.vehicle, loop.estimate
    if decision is None:
        return "waiting"
    mode = "no vehicle" if vehicle is None else f"{vehicle.mode} {'armed' if vehicle.armed else 'disarmed'}"
    age = "-" if estimate is None else f"{max(0.0, estimate.age_s):.2f} s"
    accel = "-" if decision.input is None else " ".join(f"{u:+.2f}" for u in decision.input)
    waiting = waits_for(loop.who_flies) if decision.mode is ControlMode.WAIT else ""
    mode = f"{mode}, waiting for {waiting}" if waiting else mode
    return f"{decision.mode.value:7} age {age:>6}  input {accel}  [dim]{mode}[/dim]"


def _alarm(status: RecorderStatus) -> str:
    """What a person has to know of the recording while it is being made."""
    if status.ok:
        return f"  [yellow]disk gets low: {escape(status.warning)}[/]" if status.warning else ""
    return f"  [bold red]recording in trouble: {escape(status.reason or f'{status.dropped} records dropped')}[/]"


def _lacking(status: RecorderStatus) -> int:
    """Records that are not in the recording."""
    return status.dropped + status.refused + status.gone + status.waiting


def tell_losses(status: RecorderStatus) -> None:
    """Say after a flight what the recording lacks, and why."""
    if status.failures or not status.ok:
        messages().print(
            f"[bold red]warning:[/] the recording lacks {_lacking(status)} records "
            f"({escape(status.reason or status.refusal or 'the disk was too slow')}); what is in it is whole. "
            f"Files: {escape(', '.join(status.segments)) or 'none'}",
            soft_wrap=True,
        )
