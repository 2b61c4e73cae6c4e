"""`uavctl fly` as a process against the simulated peers in a thread, its datagrams counted on the way."""

from __future__ import annotations

import io
import json
import os
import select
import socket
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

import pytest
from patience import LIMIT_S, wait_until
from places import without_pages
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from sim_rig import Client

from sim.server import serve
from uavctl.cli.app import run
from uavctl.config import load_config
from uavctl.daemon.lock import find_lock_paths
from uavctl.records import Truth

# The machine may stand still for a while, and then neither side has failed: the vehicle bears with a pause in the
# setpoints that is long for a flight, and the daemon with one in the positions and in the vehicle's answers.
PATIENT_VEHICLE = "sim.setpoint_timeout_s=600.0"
PATIENT_DAEMON = ("fallback.hold_s=60.0", "fallback.blind_hold_s=60.0", "hand_over.engage_s=60.0")
MARK = b"the test's own mark"


def reserve_port() -> socket.socket:
    """A UDP socket on a free port of this machine."""
    sock = socket.socket(type=socket.SOCK_DGRAM)
    sock.bind(("127.0.0.1", 0))
    return sock


class VehicleTap:
    """Relay between vehicle and daemon that counts the datagrams of the daemon."""

    def __init__(self, daemon_port: int) -> None:
        self.spoken = 0  # datagrams of the daemon's
        self._marked = threading.Event()
        self._daemon = ("127.0.0.1", daemon_port)
        self._ours, self._old, self._theirs = reserve_port(), reserve_port(), reserve_port()
        self.vehicle_port = int(self._theirs.getsockname()[1])
        self._vehicle: Any = None
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        while not self._done.is_set():
            ready, _, _ = select.select([self._ours, self._old, self._theirs], [], [], 0.05)
            if self._theirs in ready:
                data, self._vehicle = self._theirs.recvfrom(65_536)
                self._ours.sendto(data, self._daemon)
            for sock in {self._ours, self._old}.intersection(ready):
                try:
                    data = sock.recv(65_536)
                except ConnectionRefusedError:
                    continue  # nobody listens at the daemon's port
                if data == MARK:
                    self._marked.set()
                    continue
                self.spoken += 1
                if self._vehicle is not None:
                    self._theirs.sendto(data, self._vehicle)

    def read_frames(self) -> int:
        """How much the daemon has said, with what waits in the socket's queue: a mark put behind it has come out."""
        self._marked.clear()
        with reserve_port() as port_number:
            port_number.sendto(MARK, self._ours.getsockname())
        assert self._marked.wait(LIMIT_S)
        return self.spoken

    def set_parameter(self, name: str, value: float) -> None:
        """Set one of the vehicle's parameters, as a ground station on the same link does."""
        message = mavlink.MAVLink_param_set_message(1, 1, name.encode(), value, mavlink.MAV_PARAM_TYPE_REAL32)
        self._theirs.sendto(Client().pack(message), self._vehicle)

    def change_port(self) -> None:
        """Talk to the daemon from another port from now on; what it sends to the old one still comes in."""
        self._old, self._ours = self._ours, self._old

    def close(self) -> None:
        self._done.set()
        self._thread.join()
        for sock in (self._ours, self._old, self._theirs):
            sock.close()


class Scene:
    """A simulated vehicle that flies, and what a daemon needs to fly it."""

    def __init__(self, folder: Path, tap: VehicleTap, vehicle_port: int, mocap_port: int) -> None:
        self.folder, self.tap, self.control = folder, tap, folder / "control"
        self.truths: list[Truth] = []
        self.vehicle, self.mocap = (f"udpin://127.0.0.1:{port_number}" for port_number in (vehicle_port, mocap_port))

    @property
    def mode(self) -> str:
        return self.truths[-1].mode if self.truths else ""

    @property
    def has_landed(self) -> bool:
        """Whether it has been landing; once disarmed, a PX4 takes up the mode of before."""
        return any(truth.mode in ("AUTO.LAND", "LAND") for truth in self.truths)

    def wait_for_flight(self, seconds: float) -> None:
        """Let some of the vehicle's own time go by."""
        end_ns = self.truths[-1].at_ns + round(seconds * 1e9)
        wait_until(lambda: self.truths[-1].at_ns >= end_ns, f"{seconds:g} s on board")

    def fly(
        self,
        out: str,
        *options: str,
        environ: dict[str, str] | None = None,
        stderr: int | None = subprocess.PIPE,
        preexec_fn: Callable[[], object] | None = None,
        json: bool = True,
    ) -> subprocess.Popen[str]:
        """The daemon, ready to fly or already over."""
        urls = ["--vehicle", self.vehicle, "--mocap", self.mocap]
        patience = [argument for setting in PATIENT_DAEMON for argument in ("--set", setting)]
        command = [sys.executable, "-m", "uavctl", "fly", *urls, *patience, *(["--json"] if json else [])]
        places = ["--out", str(self.folder / out), "--control", str(self.control)]
        return subprocess.Popen(
            [*command, *places, *options],
            stdout=subprocess.PIPE,
            stderr=stderr,
            text=True,
            preexec_fn=preexec_fn,
            env=without_pages(environ or os.environ),
        )

    def ctl(self, *arguments: str) -> tuple[int, str, str]:
        """Exit code, standard output and error of `uavctl ctl`."""
        out, errors = io.StringIO(), io.StringIO()
        with redirect_stdout(out), redirect_stderr(errors):
            code = run(["ctl", *arguments, "--control", str(self.control)])
        return code, out.getvalue(), errors.getvalue()

    def status(self) -> dict[str, Any]:
        document: dict[str, Any] = json.loads(self.ctl("status", "--json")[1])
        return document


@contextmanager
def open_scene(*overrides: str, airborne: bool = True) -> Iterator[Scene]:
    """A simulated vehicle in the air, or on the ground, as long as the block lasts."""
    with reserve_port() as first, reserve_port() as second, tempfile.TemporaryDirectory(prefix="uavctl-") as folder:
        vehicle_port, mocap_port = int(first.getsockname()[1]), int(second.getsockname()[1])
        first.close()
        second.close()
        tap = VehicleTap(vehicle_port)
        result = Scene(Path(folder), tap, vehicle_port, mocap_port)
        done = threading.Event()
        config = load_config("room", [PATIENT_VEHICLE, *overrides])

        def serve_peers() -> None:
            serve(
                config,
                f"udpout://127.0.0.1:{tap.vehicle_port}",
                f"udpout://127.0.0.1:{mocap_port}",
                duration_s=None,
                airborne=airborne,
                on_ready=lambda _: None,
                on_truth=result.truths.append,
                stop=done.is_set,
            )

        peers = threading.Thread(target=serve_peers)
        peers.start()
        try:
            with pytest.MonkeyPatch.context() as patch:
                patch.setattr("uavctl.cli.ctl.ANSWER_LIMIT_S", LIMIT_S)
                yield result
        finally:
            done.set()
            peers.join()
            tap.close()
            for path in find_lock_paths(result.vehicle):
                path.unlink(missing_ok=True)  # the port's next vehicle was not left in flight


@contextmanager
def end_process(process: subprocess.Popen[str]) -> Iterator[subprocess.Popen[str]]:
    """End a process with the block, if it has not ended by itself."""
    try:
        yield process
    finally:
        if process.poll() is None:
            process.kill()
        process.wait()
        for stream in (process.stdout, process.stderr):
            if stream is not None:
                stream.close()
