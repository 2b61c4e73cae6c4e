"""What the tests with real clients share: the simulator as a process, and the clients' interpreters."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

HERE = Path(__file__).parent
# For what is stuck, not for what is slow: one thing that is waited for, and a client's whole flight.
LIMIT_S, FLIGHT_LIMIT_S = 60.0, 600.0


def interpreter(variable: str, package: str) -> str:
    """The Python that has a client; the environment names it. Missing is a failure, not a reason to skip."""
    found = os.environ.get(variable)
    assert found, f"{variable} must name a Python interpreter that has {package}: run `make test-clients`"
    return found


def free_port(kind: socket.SocketKind) -> int:
    with socket.socket(type=kind) as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


@contextmanager
def simulator(autopilot: str, vehicle: str, *options: str) -> Iterator[str]:
    """`uavctl sim` on a URL of this machine; gives the URL with the port that is really used."""
    mocap = f"udpout://127.0.0.1:{free_port(socket.SOCK_DGRAM)}"
    command = [
        sys.executable,
        "-m",
        "uavctl",
        "sim",
        "--config",
        "room-hahn-stursberg",
        "--autopilot",
        autopilot,
        "--json",
    ]
    process = subprocess.Popen(
        [*command, "--vehicle", vehicle, "--mocap", mocap, *options], stdout=subprocess.PIPE, text=True
    )
    try:
        assert process.stdout is not None
        yield str(json.loads(process.stdout.readline())["vehicles"][0]["vehicle"])
    finally:
        process.send_signal(signal.SIGINT)
        try:
            process.wait(LIMIT_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        if process.stdout is not None:
            process.stdout.close()
