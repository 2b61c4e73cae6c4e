"""`uavctl fly` as a process against the simulated peers in a thread, with every datagram of its counted on the way."""

from __future__ import annotations

import io
import json
import select
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

from sim.server import serve
from uavctl.cli.app import run
from uavctl.config import load_config
from uavctl.data import Truth
from uavctl.lock import lock_path

LIMIT_S = 60.0  # for what is stuck, not for what is slow: a machine may have much else to do


def port() -> socket.socket:
    """A UDP socket on a free port of this machine."""
    one = socket.socket(type=socket.SOCK_DGRAM)
    one.bind(("127.0.0.1", 0))
    return one


class Tap:
    """Sits between vehicle and daemon, hands everything on, and notes when the daemon spoke."""

    def __init__(self, daemon_port: int) -> None:
        self.spoken_s: list[float] = []  # monotonic times of the daemon's datagrams
        self._daemon = ("127.0.0.1", daemon_port)
        self._ours, self._theirs = port(), port()
        self.vehicle_port = int(self._theirs.getsockname()[1])
        self._vehicle: Any = None
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        while not self._done.is_set():
            ready, _, _ = select.select([self._ours, self._theirs], [], [], 0.05)
            if self._theirs in ready:
                data, self._vehicle = self._theirs.recvfrom(65_536)
                self._ours.sendto(data, self._daemon)
            if self._ours in ready:
                try:
                    data = self._ours.recv(65_536)
                except ConnectionRefusedError:
                    continue  # nobody listens at the daemon's port
                self.spoken_s.append(time.monotonic())
                if self._vehicle is not None:
                    self._theirs.sendto(data, self._vehicle)

    def close(self) -> None:
        self._done.set()
        self._thread.join()
        self._ours.close()
        self._theirs.close()


class Scene:
    """A simulated vehicle that flies, and what a daemon needs to fly it."""

    def __init__(self, folder: Path, tap: Tap, vehicle_port: int, mocap_port: int) -> None:
        self.folder, self.tap, self.control = folder, tap, folder / "control"
        self.truths: list[Truth] = []
        self.vehicle, self.mocap = (f"udpin://127.0.0.1:{one}" for one in (vehicle_port, mocap_port))

    @property
    def mode(self) -> str:
        return self.truths[-1].mode if self.truths else ""

    def fly(self, out: str, *options: str, environ: dict[str, str] | None = None) -> subprocess.Popen[str]:
        """The daemon, ready to fly or already over."""
        urls = ["--vehicle", self.vehicle, "--mocap", self.mocap]
        command = [sys.executable, "-m", "uavctl", "fly", *urls, "--json"]
        places = ["--out", str(self.folder / out), "--control", str(self.control)]
        return subprocess.Popen(
            [*command, *places, *options], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environ
        )

    def ctl(self, *arguments: str) -> tuple[int, str, str]:
        """Exit code, standard output and error of `uavctl ctl`."""
        out, told = io.StringIO(), io.StringIO()
        with redirect_stdout(out), redirect_stderr(told):
            code = run(["ctl", *arguments, "--control", str(self.control)])
        return code, out.getvalue(), told.getvalue()

    def status(self) -> dict[str, Any]:
        found: dict[str, Any] = json.loads(self.ctl("status", "--json")[1])
        return found


def until(holds: Callable[[], bool], what: str) -> None:
    """Wait for something that other processes do."""
    end_s = time.monotonic() + LIMIT_S
    while not holds():
        assert time.monotonic() < end_s, f"{what}: not within {LIMIT_S:g} s"
        time.sleep(0.02)


@contextmanager
def scene(*overrides: str) -> Iterator[Scene]:
    """A simulated vehicle in the air, as long as the block lasts."""
    with port() as one, port() as other, tempfile.TemporaryDirectory(prefix="uavctl-") as folder:
        vehicle_port, mocap_port = int(one.getsockname()[1]), int(other.getsockname()[1])
        one.close()
        other.close()
        tap = Tap(vehicle_port)
        found = Scene(Path(folder), tap, vehicle_port, mocap_port)
        done = threading.Event()
        config = load_config("room", overrides)

        def serve_peers() -> None:
            serve(
                config,
                f"udpout://127.0.0.1:{tap.vehicle_port}",
                f"udpout://127.0.0.1:{mocap_port}",
                duration_s=None,
                airborne=True,
                on_ready=lambda _: None,
                on_truth=found.truths.append,
                stop=done.is_set,
            )

        peers = threading.Thread(target=serve_peers)
        peers.start()
        try:
            yield found
        finally:
            done.set()
            peers.join()
            tap.close()
            lock_path(found.vehicle).unlink(missing_ok=True)  # the port's next vehicle was not left in flight


@contextmanager
def ended(process: subprocess.Popen[str]) -> Iterator[subprocess.Popen[str]]:
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
