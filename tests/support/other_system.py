"""Python as on a system without POSIX: modules and names that Windows lacks are taken away, then a flight is flown.

Run as a process of its own: `other_system.py FOLDER` flies into the folder and prints one JSON document.
"""

from __future__ import annotations

import importlib
import io
import json
import os
import pkgutil
import signal
import socket
import sys
from contextlib import redirect_stdout
from pathlib import Path

MODULES = ("fcntl", "grp", "pwd", "resource", "termios")
NAMES = {
    os: "O_CLOEXEC O_NOFOLLOW O_NONBLOCK SCHED_FIFO SCHED_OTHER fchmod fork geteuid getuid nice pread pwrite "
    "sched_getaffinity sched_getparam sched_getscheduler sched_param sched_setscheduler",
    signal: "ITIMER_REAL SIGALRM SIGBUS SIGCHLD SIGCONT SIGHUP SIGKILL SIGQUIT SIGSTOP SIGTSTP SIGTTIN SIGTTOU SIGURG "
    "SIGWINCH alarm pthread_kill setitimer",
    socket: "AF_UNIX SOCK_SEQPACKET SO_PEERCRED SO_REUSEPORT recv_fds send_fds",
}
# Other packages have versions for each system: they are loaded before anything is taken away.
OTHER_PACKAGES = (
    *("asyncio", "ctypes", "multiprocessing.connection", "subprocess", "tempfile", "concurrent.futures.process"),
    *("cyclopts", "cvxpy", "matplotlib.pyplot", "mcap.reader", "pandas", "pyarrow.parquet", "pymavlink.mavutil"),
    *("rich.console", "rich.progress", "scipy.optimize", "serial"),
)


def take_away() -> None:
    """Take away what this system has and others lack."""
    for name in OTHER_PACKAGES:
        importlib.import_module(name)
    sys.modules.update(dict.fromkeys(MODULES))  # type: ignore[arg-type]  # None: no such module
    for module, names in NAMES.items():
        for name in names.split():
            delattr(module, name)
    windows = {signal.SIGABRT, signal.SIGFPE, signal.SIGILL, signal.SIGINT, signal.SIGSEGV, signal.SIGTERM}
    signal.valid_signals = lambda: windows


def find_import_errors() -> dict[str, str]:
    """Import every module of the three packages; return the errors by module."""
    errors = {}
    for package in map(importlib.import_module, ("uavctl", "sim", "logs")):
        for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            if module.name.startswith("uavctl.docs") or module.name.endswith("__main__"):
                continue
            try:
                importlib.import_module(module.name)
            except Exception as error:  # noqa: BLE001 reported
                errors[module.name] = repr(error)
    return errors


def run_command(*arguments: str) -> tuple[int, str]:
    """Run a command line in this process; return its exit code and standard output."""
    from uavctl.cli.app import run

    with redirect_stdout(io.StringIO()) as output:
        code = run(arguments)
    return code, output.getvalue()


def main(folder: Path) -> None:
    """Fly, read, draw and replay; ask for flights in real time; print what came of it."""
    take_away()
    errors = find_import_errors()
    import uavctl

    room = uavctl.load("room", link={"loss": 0.3})
    flight = uavctl.fly(room, folder, seed=7, duration_s=4)
    flight.recording.report()
    path = str(flight.recording.path)
    preset = folder / "own.toml"
    preset.write_bytes((Path(uavctl.__file__).parent / "presets" / "room.toml").read_bytes())
    lockstep = ("loopback", "--config", str(preset), "--duration", "3", "--out", str(folder / "second"))
    commands = {
        name: run_command(*command)[0]
        for name, command in {
            "replay": ("log", "replay", path),
            "info": ("log", "info", path),
            "export": ("log", "export", path, "--to", "csv"),
            "loopback": lockstep,
            "design": ("design", "--config", "room"),
        }.items()
    }
    refused = {
        name: json.loads(run_command(*command, "--json")[1])
        for name, command in {
            "fly": ("fly", "--config", "room"),
            "loopback": ("loopback", "--udp"),
            "ctl": ("ctl", "status"),
        }.items()
    }
    runs = uavctl.simulate(room, "smpc", runs=2, seed=1, steps=10)
    print(  # noqa: T201
        json.dumps(
            {
                "errors": errors,
                "position_m": flight.position_m.tolist(),
                "rows": len(flight.recording.pandas("/uavctl/decision")),
                "commands": commands,
                "refused": refused,
                "states": runs.states.tolist(),
                "doctor": json.loads(run_command("doctor", "--json")[1]),
                "is_page": flight.recording.path.with_suffix(".html").is_file(),
            }
        )
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]))
