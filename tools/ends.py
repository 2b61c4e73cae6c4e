"""Ends of flights by signals and failures, as real processes over loopback, judged on the true vehicle.

`python tools/ends.py`: each case starts a simulated vehicle and `uavctl fly --arm --takeoff`, waits until the vehicle
moves, and does one thing to the flight's process. Judged are the simulator's truth (landed, distance outside of the
room), the recording (closed, replays identically), the exit code, the time to the end, and the document of `--json`.

Exit code 1 where something was wrong; `--keep FOLDER` keeps recordings and consoles.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import resource
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests" / "support"))

from places import ROOT, UNDRAWN
from process_rig import child_of
from soak_pairs import compute_outside_m

from sim.server import serve
from uavctl.config import load_config
from uavctl.records import Truth, Vec3

AUTOPILOTS = ("px4", "ardupilot")
CLOSED = b"\x89MCAP0\r\n"  # the last bytes of a closed recording
OUTSIDE_M = 1.0  # furthest beyond walls and ceiling
# The same where only the vehicle's own setpoint timeout of 0.7 s can act: the regulator flies up to 3.7 m/s.
OUTSIDE_UNHEARD_M = 2.0
MOVES_MPS = 0.3
START_LIMIT_S = 90.0  # until the vehicle moves
END_LIMIT_S = 60.0  # from the act to the end of the process
LAND_LIMIT_S = 25.0  # from there until the vehicle is down, where the process has died
FLOOR_M = 0.15
TRUTH_PERIOD_NS = 50_000_000
LANDING = ("AUTO.LAND", "LAND")

# Read by the flight's interpreter at its start: it runs a file once that is there.
HOOK = """
import sys
if "logs.report.flight_page" in sys.orig_argv:
    import os
    os._exit(0)
if "fly" in sys.orig_argv:
    import pathlib, threading, time
    def wait(path=pathlib.Path({folder!r}) / "inject.py"):
        while not path.exists():
            time.sleep(0.05)
        exec(compile(path.read_text(), "injected", "exec"), {{}})
    threading.Thread(target=wait, daemon=True, name="injector").start()
"""

# Controllers of another package: each flies well until a file is there.
CONTROLLERS = """
import os, pathlib, time
from uavctl.smpc.nominal import lqr
FLAG = pathlib.Path(os.environ.get("ENDS_FLAG", "/nonexistent"))
class Regulates:
    def __init__(self, problem):
        self.k = lqr(problem.plant, problem.q_x, problem.q_u).k
        self.count = 0
    def plan(self, request):
        self.count += 1
        if FLAG.exists() or self.count > 10**6:
            self.fail()
        return request.inputs[0] + self.k @ (request.state - request.states[0])
class Raises(Regulates):
    def fail(self):
        raise ZeroDivisionError("no gain")
class Loops(Regulates):
    def fail(self):
        while FLAG.exists():
            pass
class Sleeps(Regulates):
    def fail(self):
        while FLAG.exists():
            time.sleep(3600)
class Swallows(Regulates):
    def fail(self):
        while FLAG.exists():
            try:
                while FLAG.exists():
                    pass
            except BaseException:
                pass
class Holds(Regulates):
    def fail(self):
        sum(range(10**12))
class Allocates(Regulates):
    def fail(self):
        import resource
        used = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + 2**28, resource.getrlimit(resource.RLIMIT_AS)[1]))
        blocks = []
        while True:
            blocks.append(bytearray(2**22))
"""


@dataclass
class Case:
    """One thing that happens to a flight."""

    act: Callable[[Flight], None]
    options: tuple[str, ...] = ()
    code: int = 0  # exit code of the process
    dies: bool = False  # the process dies at once; the vehicle has to come down all the same
    outside_m: float = OUTSIDE_M
    moment: str = "moving"  # or `start`, `climb`, `landing`
    natnet: bool = False
    controller: str = ""
    stderr: str = "file"  # or `full`, `closed`, `gone`
    stdout: str = "file"
    json: bool = True
    small_disk: bool = False
    replays: bool = True
    stops: bool = True  # the act ends the flight; else SIGTERM follows after some seconds
    flies_on: bool = False  # the flight has to go on until then
    is_defect: bool = False  # an error that nobody expects: its traceback is printed


@dataclass
class Flight:
    """A flight in two processes."""

    name: str
    autopilot: str
    case: Case
    folder: Path
    sim: subprocess.Popen[bytes] = field(init=False)
    fly: subprocess.Popen[bytes] = field(init=False)
    pipes: list[int] = field(default_factory=list)

    def truths(self) -> list[tuple[int, Vec3, Vec3, str]]:
        """Read what the vehicle has done: time [ns], position, velocity, mode."""
        rows = []
        for line in (self.folder / "truth").read_text().splitlines():
            with contextlib.suppress(ValueError):
                at_ns, position, velocity, mode = json.loads(line)
                rows.append((at_ns, tuple(position), tuple(velocity), mode))
        return rows

    def send(self, *numbers: int) -> None:
        """Send signals to the flight's process."""
        for number in numbers:
            self.fly.send_signal(number)

    def inject(self, code: str) -> None:
        """Run code in the flight's process."""
        (self.folder / "inject.new").write_text(code)
        (self.folder / "inject.new").rename(self.folder / "inject.py")
        time.sleep(0.3)

    @property
    def recording(self) -> Path:
        """Path of the recording."""
        return self.folder / "out" / "flight.mcap"

    def set_limit(self, number: int, value: int) -> None:
        """Set a limit of the flight's process."""
        _, hard = resource.prlimit(self.fly.pid, number)
        resource.prlimit(self.fly.pid, number, (value, hard))


def find_port(kind: int) -> int:
    """Find a free port."""
    with socket.socket(type=kind) as sock:
        sock.bind(("127.0.0.1", 0))
        return int(sock.getsockname()[1])


def serve_peers(autopilot: str, vehicle: str, mocap: str, truth: str) -> None:
    """Run the simulated vehicle, and write what it truly does."""
    last: list[Any] = [0, ""]
    with Path(truth).open("w") as file:

        def write(truth: Truth) -> None:
            if truth.at_ns - last[0] >= TRUTH_PERIOD_NS or truth.mode != last[1]:
                last[:] = [truth.at_ns, truth.mode]
                file.write(json.dumps([truth.at_ns, truth.position_m, truth.velocity_mps, truth.mode]) + "\n")
                file.flush()

        parent = os.getppid()
        config = load_config(f"room-{autopilot}", [f'sim.autopilot="{autopilot}"'])
        serve(
            config,
            vehicle,
            mocap,
            duration_s=None,
            airborne=False,
            on_ready=lambda _: None,
            on_truth=write,
            stop=lambda: os.getppid() != parent,
        )


def full_pipe() -> tuple[int, int]:
    """Return both ends of a pipe that holds no more."""
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    with contextlib.suppress(BlockingIOError):
        while True:
            os.write(writer, b"x" * 4096)
    os.set_blocking(writer, True)
    return reader, writer


def start(flight: Flight) -> None:
    """Start vehicle and flight."""
    case, folder = flight.case, flight.folder
    if flight.autopilot == "px4":
        port = find_port(socket.SOCK_DGRAM)
        theirs, ours = f"udpout://127.0.0.1:{port}", f"udpin://127.0.0.1:{port}"
    else:
        port = find_port(socket.SOCK_STREAM)
        theirs, ours = f"tcpin://127.0.0.1:{port}", f"tcp://127.0.0.1:{port}"
    camera_port = find_port(socket.SOCK_DGRAM)
    cameras = (f"natnet://127.0.0.1:{camera_port}/drone",) * 2
    if not case.natnet:
        cameras = (f"udpout://127.0.0.1:{camera_port}", f"udpin://127.0.0.1:{camera_port}")
    flight.sim = subprocess.Popen(
        [sys.executable, __file__, "--peers", flight.autopilot, theirs, cameras[0], str(folder / "truth")],
        stdout=subprocess.DEVNULL,
        stderr=(folder / "sim.err").open("wb"),
    )
    (folder / "hook").mkdir()
    (folder / "hook" / "sitecustomize.py").write_text(HOOK.format(folder=str(folder)))
    (folder / "hook" / "ends_controllers.py").write_text(CONTROLLERS)
    environ = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([str(folder / "hook"), str(ROOT), str(UNDRAWN)]),
        "ENDS_FLAG": str(folder / "flag"),
        "UAVCTL_CONTROL": str(folder / "c"),
    }
    out = folder / "out"
    if case.small_disk:
        out.mkdir()
        subprocess.run(["mount", "-t", "tmpfs", "-o", "size=16m", "tmpfs", str(out)], check=True)
    command = [sys.executable, "-m", "uavctl", "fly", "--config", f"room-{flight.autopilot}", "--vehicle", ours]
    command += ["--mocap", cameras[1], "--arm", "--takeoff", "1.2", "--out", str(out), *case.options]
    command += ["--set", "log.free_bytes=1000000"] if case.small_disk else []
    command += ["--json"] if case.json else []
    if case.controller:
        command += ["--set", f"smpc.controller=ends_controllers:{case.controller}"]
    streams: dict[str, Any] = {}
    for name, kind in (("stdout", case.stdout), ("stderr", case.stderr)):
        if kind == "full":
            reader, writer = full_pipe()
            flight.pipes.append(reader)
            streams[name] = writer
        elif kind == "gone":
            reader, writer = os.pipe()
            os.close(reader)
            streams[name] = writer
        else:
            streams[name] = (folder / name).open("wb")

    def close_stderr() -> None:
        os.close(2)

    flight.fly = subprocess.Popen(
        command,
        env=environ,
        stdin=subprocess.DEVNULL,
        preexec_fn=close_stderr if case.stderr == "closed" else None,
        **streams,
    )
    for stream in streams.values():
        os.close(stream) if isinstance(stream, int) else stream.close()


def wait_for(condition: Callable[[], bool], limit_s: float) -> bool:
    """Wait until a condition holds; return whether it does."""
    end_s = time.monotonic() + limit_s
    while time.monotonic() < end_s:
        if condition():
            return True
        time.sleep(0.05)
    return False


def has_moment(flight: Flight) -> bool:
    """Whether the moment of the case has come."""
    if not (flight.folder / "truth").exists():
        return False
    rows = flight.truths()
    if not rows:
        return False
    _, position, velocity, mode = rows[-1]
    if flight.case.moment == "start":
        return flight.recording.exists()
    if flight.case.moment == "climb":
        return position[2] < -0.4
    return mode in ("OFFBOARD", "GUIDED") and position[2] < -0.8 and abs(velocity[0]) > MOVES_MPS


def is_down(flight: Flight) -> bool:
    """Whether the vehicle rests on the floor."""
    _, position, velocity, _ = flight.truths()[-1]
    return abs(position[2]) < FLOOR_M and max(map(abs, velocity)) < 0.1


def fly(name: str, autopilot: str, case: Case, folder: Path) -> dict[str, Any]:
    """Fly one case; return its row."""
    folder.mkdir(parents=True)
    flight = Flight(name, autopilot, case, folder)
    row: dict[str, Any] = {"case": name, "autopilot": autopilot, "wrong": []}
    wrong: list[str] = row["wrong"]
    try:
        start(flight)
        if not wait_for(lambda: has_moment(flight) or flight.fly.poll() is not None, START_LIMIT_S):
            wrong.append("the vehicle never moved")
            return row
        if flight.fly.poll() is not None:
            wrong.append(f"ended before the act with {flight.fly.returncode}")
            return row
        if case.moment == "landing":
            flight.send(signal.SIGTERM)
            wait_for(lambda: flight.truths()[-1][3] in LANDING, 30.0)
        act_ns, act_s = flight.truths()[-1][0], time.monotonic()
        case.act(flight)
        if not case.stops:
            wait_for(lambda: flight.fly.poll() is not None, 4.0)
            row["flew_on"] = flight.fly.poll() is None
            if case.flies_on:
                mode = flight.truths()[-1][3]
                if not row["flew_on"] or mode not in ("OFFBOARD", "GUIDED"):
                    wrong.append(f"the flight did not go on ({mode})")
            if flight.fly.poll() is None:
                flight.send(signal.SIGTERM)
        has_ended = wait_for(lambda: flight.fly.poll() is not None, END_LIMIT_S)
        row["end_s"] = round(time.monotonic() - act_s, 1)
        if not has_ended:
            wrong.append("the process does not end")
            flight.fly.kill()
        row["code"] = flight.fly.wait()
        if has_ended and row["code"] != case.code:
            wrong.append(f"exit code {row['code']}")
        judge(flight, act_ns, row)
    finally:
        for process in (getattr(flight, "fly", None), getattr(flight, "sim", None)):
            if process is not None:
                if process.poll() is None:
                    process.kill()
                process.wait()
        for pipe in flight.pipes:
            os.close(pipe)
        if case.small_disk:
            subprocess.run(["umount", "-l", str(folder / "out")], check=False)
    return row


def judge(flight: Flight, act_ns: int, row: dict[str, Any]) -> None:
    """Judge vehicle, recording, replay and words of a flight that is over."""
    wrong, case = row["wrong"], flight.case
    config = load_config(f"room-{flight.autopilot}")
    if wait_for(lambda: is_down(flight), LAND_LIMIT_S):
        down_ns = next(at for at, place, _, _ in flight.truths() if at > act_ns and abs(place[2]) < FLOOR_M)
        row["down_s"] = round((down_ns - act_ns) * 1e-9, 1)
    else:
        wrong.append(f"in the air in {flight.truths()[-1][3]}")
    rows = [truth for truth in flight.truths() if truth[0] >= act_ns]
    row["outside_m"] = round(max(compute_outside_m(config, place) for _, place, _, _ in rows), 2)
    row["modes"] = list(dict.fromkeys(mode for *_, mode in rows))
    if row["outside_m"] > case.outside_m:
        wrong.append(f"{row['outside_m']} m outside")
    (flight.folder / "flag").unlink(missing_ok=True)
    files = sorted((flight.folder / "out").glob("flight*.mcap"))
    row["closed"] = bool(files) and all(file.read_bytes().endswith(CLOSED) for file in files)
    if not row["closed"] and not case.dies:
        wrong.append("the recording is not closed")
    if case.replays:
        environ = {**os.environ, "PYTHONPATH": os.pathsep.join([str(flight.folder / "hook"), str(ROOT)])}
        try:
            replay = subprocess.run(
                [sys.executable, "-m", "uavctl", "log", "replay", str(flight.recording)],
                env=environ,
                capture_output=True,
                text=True,
                timeout=120.0,
            )
            row["replay"] = replay.returncode
            if replay.returncode:
                wrong.append(f"replay {replay.returncode}: {(replay.stdout + replay.stderr).strip()[-300:]}")
        except subprocess.TimeoutExpired:
            wrong.append("the replay does not end")
    row["sentence"] = read_sentence(flight, row)
    if not case.dies and not row["sentence"]:
        wrong.append("nothing says how it ended")


def read_sentence(flight: Flight, row: dict[str, Any]) -> str:
    """Read how the flight ended, from its document or the last lines of its console."""
    lines = []
    output = flight.folder / "stdout"
    if flight.case.json and output.exists():
        text = output.read_text(errors="replace")
        if not text.strip():
            if flight.case.code in (0, 1):  # else it has ended at once
                row["wrong"].append("no document")
        else:
            try:
                document = json.loads(text)
                lines.append(str(document.get("ending", {}).get("sentence") or document.get("message", "")))
            except ValueError:
                row["wrong"].append("standard output is no document")
    errors = flight.folder / "stderr"
    if errors.exists():
        text = errors.read_text(errors="replace")
        if "Traceback" in text and not flight.case.is_defect:
            row["wrong"].append("traceback")
        lines += [line for line in text.splitlines() if line.startswith("ended")]
        if not lines:
            lines = text.splitlines()[-1:]
    if not lines and flight.case.stderr != "file" and flight.case.stdout != "file":
        return "nobody reads"
    return " / ".join(lines)[:200]


def stop_and_go(flight: Flight) -> None:
    """Press Ctrl-Z, and continue."""
    flight.send(signal.SIGTSTP)
    time.sleep(1.5)
    flight.send(signal.SIGCONT)


def starve(flight: Flight) -> None:
    """Let the process stand still again and again, longer than a PX4 waits for setpoints."""
    for _ in range(15):
        if flight.fly.poll() is None:
            flight.send(signal.SIGSTOP)
            time.sleep(0.8)
            flight.send(signal.SIGCONT)
            time.sleep(0.1)


def lower_memory(flight: Flight) -> None:
    """Let the process get no memory any more, whatever it gives back: its limit is half of what it has."""
    pages = int(Path(f"/proc/{flight.fly.pid}/statm").read_text().split()[0])
    flight.set_limit(resource.RLIMIT_AS, pages * resource.getpagesize() // 2)


def take_descriptors(flight: Flight) -> None:
    """Leave the process no file descriptor."""
    taken = {int(path.name) for path in Path(f"/proc/{flight.fly.pid}/fd").iterdir()}
    flight.set_limit(resource.RLIMIT_NOFILE, next(n for n in range(len(taken) + 1) if n not in taken))


def fill_disk(flight: Flight) -> None:
    """Fill the disk of the recording."""
    with contextlib.suppress(OSError), (flight.folder / "out" / "filler").open("wb") as file:
        while True:
            file.write(b"x" * 65536)
            file.flush()


def limit_files(flight: Flight) -> None:
    """Let files grow by a kilobyte at most."""
    flight.set_limit(resource.RLIMIT_FSIZE, flight.recording.stat().st_size + 1000)


def remove_folder(flight: Flight) -> None:
    """Remove the folder of the recording."""
    shutil.rmtree(flight.folder / "out")


def kill_child(words: str, times: int = 1) -> Callable[[Flight], None]:
    """Return an act that kills a helper process so many times."""

    def act(flight: Flight) -> None:
        for _ in range(times):
            if wait_for(lambda: has_child(flight, words), 3.0):
                os.kill(child_of(flight.fly.pid, words), signal.SIGKILL)
                time.sleep(1.0)

    return act


def has_child(flight: Flight, words: str) -> bool:
    """Whether the flight has such a helper process."""
    try:
        child_of(flight.fly.pid, words)
    except AssertionError:
        return False
    return True


def interrupt_twice(flight: Flight) -> None:
    """Press Ctrl-C twice; two signals at the same time would be one."""
    flight.send(signal.SIGINT)
    time.sleep(0.4)
    flight.send(signal.SIGINT)


def send_garbage(flight: Flight) -> None:
    """Send bad bytes to all UDP ports of the flight's process."""
    inodes = {str(path.readlink()) for path in Path(f"/proc/{flight.fly.pid}/fd").iterdir() if path.exists()}
    with socket.socket(type=socket.SOCK_DGRAM) as sock:
        for line in Path(f"/proc/{flight.fly.pid}/net/udp").read_text().splitlines()[1:]:
            parts = line.split()
            if f"socket:[{parts[9]}]" in inodes:
                for _ in range(300):
                    sock.sendto(os.urandom(200), ("127.0.0.1", int(parts[1].partition(":")[2], 16)))


def raise_flag(flight: Flight) -> None:
    """Let the controller fail."""
    (flight.folder / "flag").touch()


def signals(*numbers: int) -> Callable[[Flight], None]:
    """Return an act that sends signals."""
    return lambda flight: flight.send(*numbers)


def inject(code: str) -> Callable[[Flight], None]:
    """Return an act that runs code in the flight's process."""
    return lambda flight: flight.inject(code)


REFUSED_THREADS = """
import _thread, threading
def refuse(*a, **k): raise RuntimeError("can't start new thread")
_thread.start_new_thread = threading._start_new_thread = refuse
if hasattr(threading, "_start_joinable_thread"): threading._start_joinable_thread = refuse
"""
FAILING_SELECT = """
import select, threading
plain = select.select
def failing(*arguments):
    if threading.current_thread() is threading.main_thread(): raise MemoryError
    return plain(*arguments)
select.select = failing
class Poll:
    def __getattr__(self, name): raise MemoryError
select.poll = lambda: Poll()
"""
FAILING_TICK = """
from uavctl.loop import ControlLoop
def failing(*a, **k): raise MemoryError
ControlLoop.tick = failing
"""
DEAD_RECORDER = """
from logs.recording.recorder import WriteQueue
plain = WriteQueue.drain
def dies(*a, **k):
    WriteQueue.drain = plain
    raise SystemExit
WriteQueue.drain = dies
"""
CLOCK_STEP = """
import time
plain = time.time, time.time_ns
time.time = lambda: plain[0]() + 1e6
time.time_ns = lambda: plain[1]() + 10**15
"""
CRASH = "import ctypes; ctypes.string_at(0)"

CASES = {
    **{
        name: Case(signals(getattr(signal, name)))
        for name in (
            [
                "SIGINT",
                "SIGTERM",
                "SIGHUP",
                "SIGQUIT",
                "SIGUSR1",
                "SIGUSR2",
                "SIGALRM",
                "SIGVTALRM",
                "SIGPROF",
                "SIGXCPU",
            ]
        )
    },
    "SIGPIPE": Case(signals(signal.SIGPIPE), stops=False, flies_on=True),
    "two-signals": Case(signals(signal.SIGHUP, signal.SIGTERM)),
    "int-twice": Case(interrupt_twice, code=130),
    "term-before-arming": Case(signals(signal.SIGTERM), moment="start", code=1),
    "hup-before-arming": Case(signals(signal.SIGHUP), moment="start", code=1),
    "term-in-climb": Case(signals(signal.SIGTERM), moment="climb", code=1),
    "hup-in-climb": Case(signals(signal.SIGHUP), moment="climb", code=1),
    "hup-in-landing": Case(signals(signal.SIGHUP), moment="landing"),
    "int-in-landing": Case(signals(signal.SIGINT), moment="landing", code=130),
    "ctrl-z": Case(stop_and_go, stops=False),
    "starved": Case(starve, stops=False, code=1),
    "stderr-full": Case(signals(signal.SIGTERM), stderr="full"),
    "stdout-full": Case(signals(signal.SIGTERM), stdout="full", code=1),
    "both-full": Case(signals(signal.SIGTERM), stdout="full", stderr="full", json=False, code=1),
    "stdout-gone": Case(signals(signal.SIGTERM), stdout="gone", code=1),
    "stderr-closed": Case(signals(signal.SIGTERM), stderr="closed"),
    "descriptors": Case(take_descriptors, stops=False, flies_on=True),
    "memory": Case(lower_memory, stops=False, code=1),
    "disk-full": Case(fill_disk, stops=False, flies_on=True, small_disk=True, code=1),
    "file-size": Case(limit_files, stops=False, flies_on=True, code=1),
    "file-size-in-climb": Case(limit_files, moment="climb", stops=False, code=1),
    "folder-removed": Case(remove_folder, stops=False, flies_on=True, replays=False, code=1),
    "camera-killed": Case(kill_child("uavctl.io.camera_host"), natnet=True, stops=False),
    "camera-killed-5": Case(kill_child("uavctl.io.camera_host", 5), natnet=True, stops=False, code=1),
    "live-killed": Case(
        kill_child("logs.live.host"), options=("--live", "--live-port", "0"), stops=False, flies_on=True
    ),
    "live-killed-5": Case(
        kill_child("logs.live.host", 5), options=("--live", "--live-port", "0"), stops=False, flies_on=True
    ),
    "garbage": Case(send_garbage, stops=False, flies_on=True),
    "threads-refused": Case(inject(REFUSED_THREADS), stops=False, flies_on=True),
    "clock-step": Case(inject(CLOCK_STEP), stops=False, flies_on=True),
    "recorder-thread": Case(inject(DEAD_RECORDER), stops=False, flies_on=True),
    "select-fails": Case(inject(FAILING_SELECT), code=1, is_defect=True),
    "tick-fails": Case(inject(FAILING_TICK), code=1, is_defect=True),
    "tick-fails-in-climb": Case(inject(FAILING_TICK), moment="climb", code=1, is_defect=True),
    "tick-fails-in-landing": Case(inject(FAILING_TICK), moment="landing", code=1, is_defect=True),
    "controller-raises": Case(raise_flag, controller="Raises", code=1, replays=False),
    "controller-loops": Case(raise_flag, controller="Loops", code=1),
    "controller-sleeps": Case(raise_flag, controller="Sleeps", code=1),
    "controller-swallows": Case(
        raise_flag, controller="Swallows", dies=True, outside_m=OUTSIDE_UNHEARD_M, replays=False, code=-9
    ),
    "controller-holds": Case(
        raise_flag, controller="Holds", dies=True, outside_m=OUTSIDE_UNHEARD_M, replays=False, code=-9
    ),
    "controller-allocates": Case(raise_flag, controller="Allocates", code=1, replays=False),
    "SIGKILL": Case(signals(signal.SIGKILL), dies=True, code=-9),
    "kill-before-arming": Case(signals(signal.SIGKILL), moment="start", dies=True, replays=False, code=-9),
    "kill-in-climb": Case(signals(signal.SIGKILL), moment="climb", dies=True, code=-9),
    "kill-in-landing": Case(signals(signal.SIGKILL), moment="landing", dies=True, code=-9),
    "SIGSTOP": Case(signals(signal.SIGSTOP), dies=True, code=-9),
    "SIGSEGV": Case(signals(signal.SIGSEGV), dies=True, code=-11),
    "SIGABRT": Case(signals(signal.SIGABRT), dies=True, code=-6),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Fly the cases, and print a line of JSON for each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="*", choices=CASES, help="cases")
    parser.add_argument("--autopilot", nargs="*", choices=AUTOPILOTS, default=AUTOPILOTS)
    parser.add_argument("--jobs", type=int, default=1, help="flights at a time")
    parser.add_argument("--keep", type=Path)
    parser.add_argument("--peers", nargs=4, help=argparse.SUPPRESS)
    given = parser.parse_args(arguments)
    if given.peers:
        serve_peers(*given.peers)
        return 0
    with open_folder(given.keep) as folder, ThreadPoolExecutor(given.jobs) as pool:
        waiting = [
            pool.submit(fly, name, autopilot, CASES[name], folder / f"{name}-{autopilot}")
            for name in given.only or CASES
            for autopilot in given.autopilot
        ]
        is_right = True
        for one in waiting:
            row = one.result()
            is_right = is_right and not row["wrong"]
            sys.stdout.write(json.dumps(row) + "\n")
            sys.stdout.flush()
    return 0 if is_right else 1


@contextlib.contextmanager
def open_folder(keep: Path | None) -> Iterator[Path]:
    """Open the folder of all cases."""
    if keep is not None:
        yield keep
        return
    with tempfile.TemporaryDirectory(prefix="ends-") as folder:
        yield Path(folder)


if __name__ == "__main__":
    sys.exit(main())
