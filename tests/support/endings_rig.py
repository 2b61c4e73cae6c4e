"""`uavctl fly` in virtual time against the simulated peers, and all reports of its ending."""

from __future__ import annotations

import html
import json
import re
import select
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any

import pytest
from patience import LIMIT_S
from recording_fakes import Disk
from sim_rig import decode
from transport_rig import IdleConnection

from logs.recording.flight import FlightData
from logs.recording.reader import read
from logs.recording.recorder import SyncRecorder
from logs.recording.summary import summarise
from logs.report import flight_page as report
from sim.autopilot.profile import SIMULATED
from sim.simulation import Peers
from uavctl.arrays import SECOND_NS
from uavctl.cause import Cause
from uavctl.cli import fly as fly_cmd
from uavctl.cli import tune_flights
from uavctl.cli.app import run
from uavctl.clock import Ticker
from uavctl.config import load_config
from uavctl.daemon import control_socket
from uavctl.daemon.daemon import fly
from uavctl.daemon.health import HealthMonitor
from uavctl.daemon.lock import find_lock_paths, lock_vehicle
from uavctl.daemon.notifier import Notifier
from uavctl.io.base import Connection
from uavctl.loop import ControlLoop
from uavctl.mavlink.handover_states import HandoverState
from uavctl.records import Ending, RelayStats

BEGIN_NS = 1  # a tick before the grid
MAX_FLIGHT_S = 400.0  # of a flight that should have ended long ago
PRESET = ["--config", "room-hahn-stursberg", "--set", "solver.method=exact"]
ON_THE_FLOOR = ("sim.start_position_m=[0.0,0.0,-0.7]",)
TAKE_OFF = ("--arm", "--takeoff", "1.2")
Step = tuple[Callable[["EndingRig"], bool], Callable[["EndingRig"], None]]


class PeerConnection(IdleConnection):
    """A connection to the simulated peers."""

    def __init__(self, rig: EndingRig, name: str) -> None:
        super().__init__(name)
        self._rig, self._name = rig, name
        self.arrived: list[tuple[bytes, int]] = []

    def receive(self, *, read_all: bool = False) -> list[tuple[bytes, int]]:
        taken, self.arrived = self.arrived, []
        return taken

    def send(self, data: bytes) -> None:
        self._rig.sent.append((self._rig.now_ns, data))
        if self._rig.is_delivered(data):
            self._rig.peers.receive(self._name, data, self._rig.now_ns)


class DiskRecorder(SyncRecorder):
    """A recorder without a thread, on a disk that may take no more.

    Attributes:
        full: Whether the disk is.
    """

    full = False

    def __init__(self, *given: Any, **more: Any) -> None:
        super().__init__(*given, open_file=Disk(lambda _: DiskRecorder.full).open, **more)

    def catch_up(self) -> None:
        pass


class EndingRig:
    """One flight of the command, with what the test does on the way: each step once its time has come.

    Attributes:
        is_delivered: Whether the vehicle receives a datagram of ours.
        is_received: Whether we receive one of the vehicle's.
        sent: Each datagram of ours, with its time.
        steps: (when, what) in their order.
        statuses: What `uavctl ctl status --json` has answered.
    """

    def __init__(
        self,
        folder: Path,
        *overrides: str,
        airborne: bool = False,
        peers: tuple[str, ...] = (),
        preset: str = "room-hahn-stursberg",
    ) -> None:
        self.overrides = (*(() if airborne else ON_THE_FLOOR), *overrides)
        settings = [*self.overrides, 'solver.method="exact"', *peers]
        self.config = load_config(preset, settings)
        self.folder, self.now_ns = folder, BEGIN_NS
        self.peers = Peers(self.config, BEGIN_NS, airborne=airborne)
        self.peers.autopilot.pilot.has_radio = True  # the pilot is there, with his stick
        self.lines = {"vehicle": PeerConnection(self, "vehicle"), "mocap": PeerConnection(self, "mocap")}
        self.is_delivered: Callable[[bytes], bool] = lambda data: True
        self.is_received: Callable[[bytes], bool] = lambda data: True
        self.sent: list[tuple[int, bytes]] = []
        self.steps: list[Step] = []
        self.statuses: list[dict[str, Any]] = []
        self.listener: socket.socket | None = None
        self._status_processes: list[subprocess.Popen[str]] = []
        self.loop: ControlLoop | None = None
        self.health_monitor: HealthMonitor | None = None
        self.notified_texts: list[str] = []

    # Methods for steps

    def is_in(self, state: HandoverState) -> bool:
        return self.loop is not None and self.loop.handover_state is state

    @property
    def active_loop(self) -> ControlLoop:
        assert self.loop is not None
        return self.loop

    def switch_mode(self, mode: str) -> None:
        kind = SIMULATED[self.config.sim.autopilot]
        self.peers.autopilot.pilot.change_mode(kind.get_mode(mode), self.now_ns)

    def add_step_in(self, state: HandoverState, do: Callable[[EndingRig], None], *, after_s: float = 0.0) -> EndingRig:
        """Add a step once the hand-over has been in a state for `after_s`."""
        since: list[int] = []

        def due(rig: EndingRig) -> bool:
            if rig.is_in(state) and not since:
                since.append(rig.now_ns)
            return bool(since) and rig.now_ns - since[0] >= after_s * SECOND_NS

        self.steps.append((due, do))
        return self

    def add_step_after(self, seconds: float, do: Callable[[EndingRig], None]) -> EndingRig:
        """Add a step at a time after the start [s]."""
        self.steps.append((lambda rig: rig.now_ns >= seconds * SECOND_NS, do))
        return self

    def request_status(self) -> None:
        """Request the status as an operator does, in a process of its own; the reply comes in one of the next ticks."""
        assert self.listener is not None
        folder = Path(self.listener.getsockname()).parent
        arguments = [sys.executable, "-m", "uavctl", "ctl", "status", "--json", "--control", str(folder)]
        self._status_processes.append(subprocess.Popen(arguments, stdout=subprocess.PIPE, text=True))
        assert select.select([self.listener], [], [], LIMIT_S)[0], "nobody has asked"

    def _take_answers(self) -> None:
        for process in list(self._status_processes):
            with suppress(subprocess.TimeoutExpired):
                out, _ = process.communicate(timeout=0.02)  # time stands still meanwhile, for it and the flight
                self._status_processes.remove(process)
                assert process.returncode == 0
                self.statuses.append(json.loads(out))

    # Time

    def wait(self, connections: Mapping[str, Connection], deadline_ns: int) -> list[str]:
        assert self.now_ns < MAX_FLIGHT_S * SECOND_NS, "the flight does not end"
        self.now_ns = max(self.now_ns, deadline_ns)
        self._take_answers()
        while self.steps and self.steps[0][0](self):
            self.steps.pop(0)[1](self)
        if self.now_ns > self.peers.now_ns:
            for at_ns, link, data in self.peers.advance(self.now_ns):
                if link == "mocap" or self.is_received(data):
                    self.lines[link].arrived.append((data, at_ns))
        return [name for name, line in self.lines.items() if line.arrived]

    def fly(self, loop: ControlLoop, *given: Any, **more: Any) -> bool:
        """The daemon's cycle on our clock."""
        self.loop = loop
        return fly(loop, *given, **more, wait_for=self.wait, now=lambda: self.now_ns)


def interrupt(rig: EndingRig) -> None:
    """Ctrl-C."""
    signal.raise_signal(signal.SIGINT)


def read_page_text(page: Path) -> str:
    """Return the text of a page."""
    return " ".join(html.unescape(re.sub(r"<[^>]*>", " ", page.read_text())).split())


class EndingReport:
    """Ending of a flight as console, page, status, recording and JSON report it."""

    def __init__(self, rig: EndingRig, code: int, out: str, err: str, *, is_left_in_flight: bool) -> None:
        self.code, self.is_left_in_flight = code, is_left_in_flight
        self.summary: dict[str, Any] = json.loads(out) if out else {}
        self.console = " ".join(err.split())
        self.path = rig.folder / "flight.mcap"
        self.entries = list(read(self.path))
        self.records = [record for _, _, record in self.entries]
        self.recorded_endings = [record for record in self.records if isinstance(record, Ending)]
        page = self.path.with_suffix(".html")
        self.page = read_page_text(page) if page.exists() else ""
        health = None if rig.health_monitor is None else rig.health_monitor.make_health()
        self.status = "" if health is None else health.ending
        self.relay = None if health is None else health.relay
        self.notified_texts = rig.notified_texts

    @property
    def ending(self) -> dict[str, Any]:
        document: dict[str, Any] = self.summary["ending"]
        return document

    def assert_agreement(self) -> None:
        """Assert that all reports have the same sentence, and the exit code that belongs to it."""
        sentence = self.ending["sentence"]
        assert f"ended: {sentence}" in self.console
        if self.ending["code"] != Cause.ENDED_IN_AIR:  # then nobody can ask any more when it is known
            assert self.status == sentence, (self.status, sentence)
        assert self.notified_texts[-1] == f"ended: {sentence}"
        self._assert_relay_agreement()
        assert sentence in self.page
        assert self.ending["exit_code"] == self.code == (0 if self.ending["as_ordered"] else 1)
        assert self.ending["cause"] == self.summary["ended"]
        assert [ending.sentence for ending in self.recorded_endings] == [sentence]
        again = summarise(FlightData.from_records(self.entries), wall_s=None)
        assert (again.ending.sentence, again.ending.exit_code) == (sentence, self.code)

    def _assert_relay_agreement(self) -> None:
        """The positions for the vehicle are counted alike in status, summary, recording and on the page."""
        (recorded,) = self.recorded_endings
        assert recorded.relay == self.ending["relay"]
        assert (self.relay is not None) == bool(recorded.relay)
        if self.relay is None:
            return
        count, kept = self.relay.sent, sum(self.relay.kept.values())
        assert [int(number) for number in re.findall(r"\d+(?= positions| back)", recorded.relay)] == [count, kept]
        assert self.relay.last_s is not None and self.relay.last_s < 5.0
        stats = [record for record in self.records if isinstance(record, RelayStats)]
        assert stats and stats[-1].sent <= count and stats[-1].alone == self.relay.alone
        assert f"relay: {recorded.relay}" in self.console and recorded.relay in self.page


@contextmanager
def use_virtual_time(rig: EndingRig) -> Iterator[None]:
    """Replace clock, connections and threads of the command."""

    @contextmanager
    def open_links(*given: object) -> Iterator[dict[str, PeerConnection]]:
        yield rig.lines

    class Watched(HealthMonitor):
        def __init__(self, *given: Any) -> None:
            super().__init__(*given)
            rig.health_monitor = self

    @contextmanager
    def open_listener(*given: Any) -> Iterator[socket.socket]:
        with control_socket.open_listener(*given) as rig.listener:
            yield rig.listener

    with pytest.MonkeyPatch.context() as patch:
        for module in (fly_cmd, tune_flights):
            patch.setattr(module, "open_links", open_links)
            patch.setattr(module, "monotonic_ns", lambda: rig.now_ns)
        patch.setattr(tune_flights, "wait", rig.wait)
        patch.setattr(fly_cmd, "open_listener", open_listener)
        patch.setattr(fly_cmd, "run_daemon", rig.fly)
        patch.setattr(fly_cmd, "Ticker", lambda tick_ns, dt_ns: Ticker(tick_ns, dt_ns, lambda: rig.now_ns))
        patch.setattr(fly_cmd, "Recorder", DiskRecorder)
        patch.setattr(fly_cmd, "guard_landing", lambda *_: nullcontext(()))
        patch.setattr("uavctl.cli.check.check_before_arming", lambda *_: ())
        patch.setattr("uavctl.cli.services.HealthMonitor", Watched)
        patch.setattr(Notifier, "send_status", lambda _, text: rig.notified_texts.append(text))
        patch.setattr(report, "SECTIONS", report.SECTIONS[-1:])  # the summary alone: no drawings
        patch.setattr(DiskRecorder, "full", False)
        yield


def fly_command(rig: EndingRig, capsys: pytest.CaptureFixture[str], *arguments: str) -> EndingReport:
    """Run `uavctl fly` and return the report of its ending."""
    with socket.socket(type=socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        url = f"udpin://127.0.0.1:{sock.getsockname()[1]}"
    for path in find_lock_paths(url):  # what a daemon of another test has left on this port
        path.unlink(missing_ok=True)
    sets = [argument for setting in rig.overrides for argument in ("--set", setting)]
    places = ["--vehicle", url, "--out", str(rig.folder), "--json"]
    try:
        # A folder with a short name: a socket's path has 107 bytes.
        with use_virtual_time(rig), tempfile.TemporaryDirectory(prefix="uavctl-") as control:
            code = run(["fly", *PRESET, *sets, *places, "--control", control, *arguments])
    except SystemExit as ended:
        code = int(ended.code or 0)
    try:
        with lock_vehicle(url) as tenure:  # it is free again
            is_left_in_flight = tenure.is_left_in_flight
    finally:
        for path in find_lock_paths(url):
            path.unlink(missing_ok=True)
    out, err = capsys.readouterr()
    assert (rig.folder / "flight.mcap").exists(), err
    return EndingReport(rig, code, out, err, is_left_in_flight=is_left_in_flight)


def is_message(kind: str) -> Callable[[bytes], bool]:
    """Whether a datagram is of a kind of message."""
    return lambda data: any(message.get_type() == kind for message in decode(data))
