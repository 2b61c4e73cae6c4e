"""An unmodified MAVProxy connects, lists parameters, changes mode, arms and takes off in GUIDED."""

from __future__ import annotations

import queue
import re
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from client_rig import LIMIT_S, free_port, interpreter, simulator

from sim.autopilot.parameters import ARDUPILOT_PARAMETERS


class Console:
    """MAVProxy's console: lines in, lines out."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process
        self._lines: queue.Queue[str] = queue.Queue()
        self.seen: list[str] = []
        self._reader = threading.Thread(target=self._read)
        self._reader.start()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self._lines.put(line.rstrip())

    def join(self) -> None:
        self._reader.join(LIMIT_S)

    def say(self, line: str) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(line + "\n")
        self._process.stdin.flush()

    def wait(self, pattern: str) -> re.Match[str]:
        """The next line in which a pattern is found."""
        (found,) = self.wait_for_each(pattern)
        return found

    def wait_for_each(self, *patterns: str) -> list[re.Match[str]]:
        """The next lines in which each pattern is found, in any order."""
        found: dict[str, re.Match[str]] = {}
        end = time.monotonic() + LIMIT_S
        while len(found) < len(patterns):
            assert time.monotonic() < end, f"waited in vain for {set(patterns) - found.keys()}: {self.seen}"
            try:
                line = self._lines.get(timeout=0.1)
            except queue.Empty:
                assert self._process.poll() is None, self.seen
                continue
            self.seen.append(line)
            matches = {pattern: re.search(pattern, line) for pattern in patterns if pattern not in found}
            found |= {pattern: match for pattern, match in matches.items() if match}
        return [found[pattern] for pattern in patterns]


@contextmanager
def mavproxy(port: int, state: Path) -> Iterator[Console]:
    python = interpreter("UAVCTL_MAVPROXY_PYTHON", "MAVProxy")
    command = [python, str(Path(python).parent / "mavproxy.py"), f"--master=tcp:127.0.0.1:{port}"]
    options = [f"--state-basedir={state}", "--aircraft=a", "--default-modules=mode,arm,param,cmdlong,misc"]
    process = subprocess.Popen(
        [*command, *options],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        cwd=state,
    )
    console = Console(process)
    try:
        yield console
    finally:
        process.kill()
        process.wait()
        console.join()
        for stream in (process.stdin, process.stdout):
            if stream is not None:
                stream.close()


def poll(console: Console, ask: str, pattern: str, until: Callable[[float], bool]) -> float:
    """Ask again and again until the number in the answer is as wanted."""
    for _ in range(60):
        console.say(ask)
        value = float(console.wait(pattern).group(1))
        if until(value):
            return value
        time.sleep(0.5)
    raise AssertionError(f"{ask}: still {value}")


def test_mavproxy_lists_parameters_changes_mode_arms_and_takes_off(tmp_path: Path) -> None:
    port = free_port(socket.SOCK_STREAM)
    with simulator("ardupilot", f"tcpin://127.0.0.1:{port}"), mavproxy(port, tmp_path) as console:
        console.wait("Detected vehicle 1:1")
        console.wait("Mode STABILIZE")
        count = len(ARDUPILOT_PARAMETERS)
        assert console.wait(r"Received (\d+) parameters").group(1) == str(count)
        console.wait("Saved .* parameters")
        assert len((next(tmp_path.rglob("mav.parm"))).read_text().splitlines()) == count
        console.say("param show GUID_TIMEOUT")
        console.wait(r"GUID_TIMEOUT +\d")
        # A float and two integers, one of which keeps it armed until it takes off.
        for name, value in (("GUID_TIMEOUT", 2.5), ("WP_YAW_BEHAVIOR", 0.0), ("DISARM_DELAY", 0.0)):
            console.say(f"param set {name} {value:g}")
            poll(console, f"param fetch {name}", rf"{name} = ([\d.]+)", value.__eq__)

        console.say("takeoff 2")  # neither GUIDED nor armed
        console.wait("NAV_TAKEOFF: FAILED")
        console.say("mode GUIDED")
        console.wait("Mode GUIDED")
        console.say("arm throttle")
        console.wait("AP: Arming motors")
        console.say("takeoff 2")
        console.wait("NAV_TAKEOFF: ACCEPTED")
        down = poll(console, "status LOCAL_POSITION_NED", r"LOCAL_POSITION_NED.* z : (-?[\d.e-]+)", lambda z: z < -1.8)
        assert down == pytest.approx(-2.0, abs=0.3)

        console.say("mode LAND")
        console.wait("Mode LAND")
        console.wait_for_each("AP: Disarming motors", "DISARMED")  # its words, and its next heartbeat
