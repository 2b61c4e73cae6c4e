"""The control loop measured from outside: `uavctl fly` as a process, an empty loop beside it, a vehicle on real UDP.

Both loops run at the same time, half a tick apart, so that what else the machine does meets both alike.
"""

from __future__ import annotations

import multiprocessing
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from multiprocessing.connection import Connection as Pipe
from pathlib import Path

import numpy as np

from logs.reader import read
from logs.topics import RecorderNote
from uavctl.bench.loop_peer import Peer
from uavctl.bench.loop_result import LoopBench, LoopRun, Spread
from uavctl.clock import Ticker, monotonic_ns
from uavctl.config import Config
from uavctl.data import Decision, Timing
from uavctl.errors import UavctlError
from uavctl.realtime import realtime
from uavctl.transport import open_connection, wait

START_LIMIT_S = 600.0  # a design may have to be made first
_END_LIMIT_S = 60.0
_WARM_SHARE = 0.2
_SAMPLE_NS = 1_000_000_000


def run_loop_bench(
    config: Config, options: Sequence[str], seconds: float, runs: int, told: Callable[[str, int, int], None]
) -> LoopBench:
    """Measure, with and without `--realtime` in turns.

    Args:
        config: what the daemon flies.
        options: the command line that gives this configuration: --config and --set.
        seconds: length of a run.
        runs: of each kind.
        told: what is done, how many runs are, of how many.

    Raises:
        UavctlError: a daemon did not fly.
    """
    found: dict[bool, list[LoopRun]] = {False: [], True: []}
    permitted = True
    for number in range(runs):
        for real in (False, True):
            told("with --realtime" if real else "without --realtime", 2 * number + real, 2 * runs)
            run, held = _run(config, options, seconds, real)
            found[real].append(run)
            permitted = permitted and held
    return LoopBench(
        seconds=seconds,
        runs=runs,
        tick_s=config.daemon.tick_s,
        plain=LoopRun.middle(found[False]),
        realtime=LoopRun.middle(found[True]),
        permitted=permitted,
    )


def _run(config: Config, options: Sequence[str], seconds: float, real: bool) -> tuple[LoopRun, bool]:
    """One run, and whether real time was permitted where it was asked for."""
    tick_ns = round(config.daemon.tick_s * 1e9)
    with tempfile.TemporaryDirectory(prefix="uavctl-bench-") as name, socket.socket(type=socket.SOCK_DGRAM) as free:
        folder = Path(name)
        free.bind(("127.0.0.1", 0))
        port = int(free.getsockname()[1])
        free.close()
        with _daemon(port, options, folder, real) as process, _empty_loop(tick_ns, seconds, real) as empty:
            peer = Peer(port, tick_ns)
            memory_kib = _fly(peer, process, round(seconds * 1e9) // tick_ns)
            peer.finish()
            peer.close()
            process.terminate()
            process.communicate(timeout=_END_LIMIT_S)
            if not empty.poll(_END_LIMIT_S):
                raise UavctlError("the empty loop beside the control loop gave no result; try again")
            idle_ns, held = empty.recv()
        return _measured(folder / "flight.mcap", peer, memory_kib, idle_ns), held


def _measured(path: Path, peer: Peer, memory_kib: Sequence[int], idle_ns: list[int]) -> LoopRun:
    timings: list[Timing] = []
    missed = recorded = dropped = 0
    for _, _, record in read(path):
        recorded += 1
        if isinstance(record, Timing):
            timings.append(record)
        elif isinstance(record, Decision):
            missed += record.missed_ticks
        elif isinstance(record, RecorderNote):
            dropped = record.dropped + record.refused
    late = Spread.of(np.array([timing.lateness_ns for timing in timings]))
    empty = Spread.of(np.array(idle_ns))
    return LoopRun(
        in_to_out_us=Spread.of(np.array(peer.seen.in_to_out_ns)),
        lateness_us=late,
        empty_lateness_us=empty,
        above_empty_us=late.p999 - empty.p999,
        step_us=Spread.of(np.array([timing.step_ns for timing in timings])),
        positions=peer.seen.positions,
        unanswered=peer.seen.positions - len(peer.seen.in_to_out_ns),
        missed_ticks=missed,
        recorded=recorded,
        dropped=dropped,
        memory_growth_kib=memory_kib[-1] - memory_kib[int(_WARM_SHARE * (len(memory_kib) - 1))],
        memory_mib=memory_kib[-1] / 1024,
    )


@contextmanager
def _daemon(port: int, options: Sequence[str], folder: Path, real: bool) -> Iterator[subprocess.Popen[str]]:
    """`uavctl fly`, ready."""
    url = f"udpin://127.0.0.1:{port}"
    command = [sys.executable, "-m", "uavctl", "fly", *options, "--vehicle", url, "--mocap", url, "--json"]
    places = ["--out", str(folder), "--control", str(folder / "control")]
    log = folder / "messages"
    with log.open("w", encoding="utf-8") as stream:
        process = subprocess.Popen(
            [*command, *places, *(["--realtime"] if real else [])], stdout=subprocess.PIPE, stderr=stream, text=True
        )
    try:
        end_s = time.monotonic() + START_LIMIT_S
        while "recording to" not in log.read_text(encoding="utf-8"):
            if process.poll() is not None or time.monotonic() > end_s:
                raise UavctlError(f"the daemon did not start:\n{log.read_text(encoding='utf-8').strip()}")
            time.sleep(0.05)
        yield process
    finally:
        if process.poll() is None:
            process.kill()
        process.communicate()


@contextmanager
def _empty_loop(tick_ns: int, seconds: float, real: bool) -> Iterator[Pipe]:
    """The empty loop in a process of its own; its result comes through the pipe."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe(duplex=False)
    child = context.Process(target=empty_loop, args=(theirs, tick_ns, seconds, real), name="empty loop")
    child.start()
    theirs.close()
    try:
        yield ours
    finally:
        if child.is_alive():
            child.kill()
        child.join()
        ours.close()


def empty_loop(pipe: Pipe, tick_ns: int, seconds: float, real: bool) -> None:
    """A loop that only waits for its ticks, as the daemon does; sends how late they were [ns], and what was permitted.

    Args:
        pipe: for the result.
        tick_ns: time between ticks.
        seconds: how long.
        real: as `--realtime`.
    """
    if real:
        with realtime() as outcomes:
            pipe.send((_lateness(tick_ns, seconds), all(outcome.ok for outcome in outcomes)))
    else:
        pipe.send((_lateness(tick_ns, seconds), True))


def _lateness(tick_ns: int, seconds: float) -> list[int]:
    offset_ns = tick_ns // 2
    ticker = Ticker(tick_ns, tick_ns, lambda: monotonic_ns() - offset_ns)
    connections = {"idle": open_connection("udpin://127.0.0.1:0")}
    late_ns: list[int] = []
    for _ in range(round(seconds * 1e9) // tick_ns):
        due_ns = ticker.next().at_ns + offset_ns
        while monotonic_ns() < due_ns:
            wait(connections, due_ns)
        late_ns.append(monotonic_ns() - due_ns)
    return late_ns


def _fly(peer: Peer, process: subprocess.Popen[str], positions: int) -> list[int]:
    """Be the vehicle for as many ticks as the empty loop has; gives the daemon's resident memory by the second [KiB].

    Ticks and not a time: one that the machine slept through has no position, and takes none from the others.
    """
    memory_kib: list[int] = []
    next_ns = time.monotonic_ns()
    while peer.seen.positions < positions:
        now_ns = time.monotonic_ns()
        peer.tick()
        if now_ns >= next_ns:
            next_ns += _SAMPLE_NS
            if process.poll() is not None:
                raise UavctlError(f"the daemon ended with code {process.returncode} while it was measured")
            memory_kib.append(_resident_kib(process.pid))
    return memory_kib


def _resident_kib(pid: int) -> int:
    for line in Path(f"/proc/{pid}/status").read_text(encoding="ascii").splitlines():
        if line.startswith("VmRSS:"):
            return int(line.split()[1])
    return 0
