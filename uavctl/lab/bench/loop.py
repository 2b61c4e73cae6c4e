"""Benchmark of the control loop: `uavctl fly` as a process with a vehicle on real UDP, an empty loop beside it.

1. The vehicle is a point mass with cameras. It sends each position just in time for a tick.
2. The empty loop does the same sleeps without a controller. Both loops run at the same time, half a tick apart, so
   other work of the machine delays both alike.
3. `LoopBench` holds the figures; its fields are the keys of the JSON document of `uavctl bench --loop`.
"""

from __future__ import annotations

import multiprocessing
import select
import socket
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from multiprocessing.connection import Connection as Pipe
from pathlib import Path
from statistics import median
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray
from pymavlink.dialects.v20 import common as mavlink

from logs.recording.notes import RecorderNote
from logs.recording.reader import read
from uavctl.arrays import SECOND_NS
from uavctl.clock import Ticker, monotonic_ns
from uavctl.config import Config
from uavctl.daemon.realtime import enable_realtime
from uavctl.errors import UavctlError
from uavctl.io.transport import open_connection, wait
from uavctl.records import Decision, Timing

LEAD_NS = 2_000_000  # a position is sent this long before the deadline of a tick
_HEARTBEAT_TICKS = 10
_OFFBOARD = 6 << 16
_ARMED = mavlink.MAV_MODE_FLAG_SAFETY_ARMED | mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
_SO_TIMESTAMPNS = 35  # Linux: the kernel's own time of arrival, so that our wake-up time is not measured
_TIMESPEC = struct.Struct("qq")


class BenchVehicle:
    """Vehicle of the benchmark on one UDP connection; ticks are on the grid of CLOCK_MONOTONIC."""

    def __init__(self, port: int, tick_ns: int) -> None:
        # For each answered position, from the deadline of its tick to the arrival of the setpoint [ns]
        self.in_to_out_ns: list[int] = []
        self.positions = 0  # number of sent positions
        self._tick_ns = tick_ns
        self._socket = socket.socket(type=socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
        self._socket.connect(("127.0.0.1", port))
        self._socket.setblocking(False)
        self._encoder = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
        self._position, self._velocity = [0.5, 0.5, -1.0], [0.0, 0.0, 0.0]
        self._accel = (0.0, 0.0, 0.0)
        self._unanswered_ns: set[int] = set()  # deadlines of ticks that have a position and no setpoint yet

    def close(self) -> None:
        """Release the socket."""
        self._socket.close()

    def run_tick(self) -> None:
        """Receive until the next position is due, and send it in time for its tick."""
        now_ns = time.monotonic_ns()
        deadline_ns = (now_ns + LEAD_NS) // self._tick_ns * self._tick_ns + self._tick_ns
        self._receive_until(deadline_ns - LEAD_NS)
        if self.positions % _HEARTBEAT_TICKS == 0:
            self._send_heartbeat(_ARMED)
        sent_ns = time.monotonic_ns()
        self._send(self._encoder.vision_position_estimate_encode(sent_ns // 1000, *self._position, 0.0, 0.0, 0.0))
        self._unanswered_ns.add(sent_ns // self._tick_ns * self._tick_ns + self._tick_ns)
        self.positions += 1
        self._move()

    def finish(self) -> None:
        """Receive the answer to the last position, and report a disarmed vehicle, which needs no hand-over."""
        self._receive_until(time.monotonic_ns() + self._tick_ns)
        self._send_heartbeat(mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED)

    def _receive_until(self, until_ns: int) -> None:
        while (left_ns := until_ns - time.monotonic_ns()) > 0:
            select.select([self._socket], [], [], left_ns * 1e-9)
            self._receive_all()

    def _receive_all(self) -> None:
        while True:
            try:
                data, ancillary, _, _ = self._socket.recvmsg(2048, 64)
            except (BlockingIOError, ConnectionRefusedError):
                return
            stamp = next(value for level, kind, value in ancillary if kind == _SO_TIMESTAMPNS)
            seconds, nanoseconds = _TIMESPEC.unpack(stamp)
            # The kernel stamps in wall time; both clocks are read now, a moment later.
            arrived_ns = seconds * SECOND_NS + nanoseconds - time.time_ns() + time.monotonic_ns()
            parser = mavlink.MAVLink(None)
            for message in parser.parse_buffer(data) or []:
                if message.get_type() == "SET_POSITION_TARGET_LOCAL_NED":
                    self._accel = (message.afx, message.afy, message.afz)
                    self._note_answer(arrived_ns)

    def _note_answer(self, arrived_ns: int) -> None:
        deadline_ns = arrived_ns // self._tick_ns * self._tick_ns
        if deadline_ns in self._unanswered_ns:
            self._unanswered_ns.remove(deadline_ns)
            self.in_to_out_ns.append(arrived_ns - deadline_ns)

    def _move(self) -> None:
        tick_s = self._tick_ns * 1e-9
        for axis, accel in enumerate(self._accel):
            self._velocity[axis] += accel * tick_s
            self._position[axis] += self._velocity[axis] * tick_s

    def _send_heartbeat(self, base_mode: int) -> None:
        kind, autopilot = mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_AUTOPILOT_PX4
        self._send(self._encoder.heartbeat_encode(kind, autopilot, base_mode, _OFFBOARD, mavlink.MAV_STATE_ACTIVE))

    def _send(self, message: mavlink.MAVLink_message) -> None:
        data = message.pack(self._encoder)
        self._encoder.seq = (self._encoder.seq + 1) % 256
        try:
            self._socket.send(data)
        except ConnectionRefusedError:
            return  # the daemon has not started, or has ended


class TimeQuantiles(msgspec.Struct, frozen=True, kw_only=True):
    """Quantiles of a time [µs]; over several runs the median of each."""

    p50: float
    p99: float
    p999: float
    max: float

    @staticmethod
    def compute(times_ns: NDArray[np.int64]) -> TimeQuantiles:
        """Return the quantiles of one run's times [ns] (n,)."""
        p50, p99, p999, worst = (np.quantile(times_ns, [0.5, 0.99, 0.999, 1.0]) * 1e-3).tolist()
        return TimeQuantiles(p50=p50, p99=p99, p999=p999, max=worst)

    @staticmethod
    def compute_median(runs: Sequence[TimeQuantiles]) -> TimeQuantiles:
        """Return the median over runs, quantile by quantile."""
        return TimeQuantiles(
            **{key: median(getattr(run, key) for run in runs) for key in TimeQuantiles.__struct_fields__}
        )


class LoopRun(msgspec.Struct, frozen=True, kw_only=True):
    """One run, or the median of several."""

    # Tick deadline of a position that arrives in time -> arrival of its setpoint at the vehicle
    in_to_out_us: TimeQuantiles
    lateness_us: TimeQuantiles  # tick deadline -> start of the tick
    empty_lateness_us: TimeQuantiles  # the same of an empty loop that ran at the same time
    above_empty_us: float  # p99.9 of the lateness less that of the empty loop
    step_us: TimeQuantiles  # in the control core
    positions: float  # sent, one a tick
    unanswered: float  # of which no setpoint came within the tick
    missed_ticks: float
    recorded: float  # records
    dropped: float  # records that the recorder could not keep
    memory_growth_kib: float  # resident memory, from a fifth of the run to its end
    memory_mib: float  # at the end

    @staticmethod
    def compute_median(runs: Sequence[LoopRun]) -> LoopRun:
        """Return the median over runs, figure by figure."""
        columns = {name: [getattr(run, name) for run in runs] for name in LoopRun.__struct_fields__}
        figures: dict[str, Any] = {
            name: TimeQuantiles.compute_median(values)
            if isinstance(values[0], TimeQuantiles)
            else float(median(values))
            for name, values in columns.items()
        }
        return LoopRun(**figures)


class LoopBench(msgspec.Struct, frozen=True, kw_only=True):
    """Figures of the recording control loop on real UDP beside an empty loop, without and with `--realtime`."""

    seconds: float  # length of a run
    runs: int  # number of each kind, in turns
    tick_s: float
    plain: LoopRun
    realtime: LoopRun
    permitted: bool  # whether all steps of --realtime were permitted


START_LIMIT_S = 600.0  # a design may have to be made first
_END_LIMIT_S = 60.0
_WARM_SHARE = 0.2
_MEMORY_PERIOD_NS = SECOND_NS


def run_loop_bench(
    config: Config, options: Sequence[str], seconds: float, runs: int, on_progress: Callable[[str, int, int], None]
) -> LoopBench:
    """Measure the loop with and without `--realtime`, in turns.

    Args:
        options: the command line that gives this configuration: --config and --set.
        on_progress: called with the name of the run, the number of finished runs, and of all.

    Raises:
        UavctlError: a daemon did not fly.
    """
    runs_by_mode: dict[bool, list[LoopRun]] = {False: [], True: []}
    permitted = True
    for number in range(runs):
        for is_realtime in (False, True):
            on_progress("with --realtime" if is_realtime else "without --realtime", 2 * number + is_realtime, 2 * runs)
            run, is_permitted = _run_once(config, options, seconds, is_realtime)
            runs_by_mode[is_realtime].append(run)
            permitted = permitted and is_permitted
    return LoopBench(
        seconds=seconds,
        runs=runs,
        tick_s=config.daemon.tick_s,
        plain=LoopRun.compute_median(runs_by_mode[False]),
        realtime=LoopRun.compute_median(runs_by_mode[True]),
        permitted=permitted,
    )


def _run_once(config: Config, options: Sequence[str], seconds: float, is_realtime: bool) -> tuple[LoopRun, bool]:
    """Measure one run; return also whether the requested real time was permitted."""
    tick_ns = round(config.daemon.tick_s * 1e9)
    with (
        tempfile.TemporaryDirectory(prefix="uavctl-bench-") as name,
        socket.socket(type=socket.SOCK_DGRAM) as free_socket,
    ):
        folder = Path(name)
        free_socket.bind(("127.0.0.1", 0))
        port = int(free_socket.getsockname()[1])
        free_socket.close()
        with (
            _start_daemon(port, options, folder, is_realtime) as process,
            _start_empty_loop(tick_ns, seconds, is_realtime) as empty,
        ):
            vehicle = BenchVehicle(port, tick_ns)
            memory_kib = _fly_vehicle(vehicle, process, round(seconds * 1e9) // tick_ns)
            vehicle.finish()
            vehicle.close()
            process.terminate()
            process.communicate(timeout=_END_LIMIT_S)
            if not empty.poll(_END_LIMIT_S):
                raise UavctlError("the empty loop beside the control loop gave no result; try again")
            empty_lateness_ns, is_permitted = empty.recv()
        return _make_loop_run(folder / "flight.mcap", vehicle, memory_kib, empty_lateness_ns), is_permitted


def _make_loop_run(
    path: Path, vehicle: BenchVehicle, memory_kib: Sequence[int], empty_lateness_ns: list[int]
) -> LoopRun:
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
    lateness = TimeQuantiles.compute(np.array([timing.lateness_ns for timing in timings]))
    empty = TimeQuantiles.compute(np.array(empty_lateness_ns))
    return LoopRun(
        in_to_out_us=TimeQuantiles.compute(np.array(vehicle.in_to_out_ns)),
        lateness_us=lateness,
        empty_lateness_us=empty,
        above_empty_us=lateness.p999 - empty.p999,
        step_us=TimeQuantiles.compute(np.array([timing.step_ns for timing in timings])),
        positions=vehicle.positions,
        unanswered=vehicle.positions - len(vehicle.in_to_out_ns),
        missed_ticks=missed,
        recorded=recorded,
        dropped=dropped,
        memory_growth_kib=memory_kib[-1] - memory_kib[int(_WARM_SHARE * (len(memory_kib) - 1))],
        memory_mib=memory_kib[-1] / 1024,
    )


@contextmanager
def _start_daemon(
    port: int, options: Sequence[str], folder: Path, is_realtime: bool
) -> Iterator[subprocess.Popen[str]]:
    """Start `uavctl fly`, and wait until it is ready."""
    url = f"udpin://127.0.0.1:{port}"
    command = [sys.executable, "-m", "uavctl", "fly", *options, "--vehicle", url, "--mocap", url, "--json"]
    folders = ["--out", str(folder), "--control", str(folder / "control")]
    log = folder / "messages"
    with log.open("w", encoding="utf-8") as stream:
        process = subprocess.Popen(
            [*command, *folders, *(["--realtime"] if is_realtime else [])],
            stdout=subprocess.PIPE,
            stderr=stream,
            text=True,
        )
    try:
        limit_s = time.monotonic() + START_LIMIT_S
        while "recording to" not in log.read_text(encoding="utf-8"):
            if process.poll() is not None or time.monotonic() > limit_s:
                raise UavctlError(f"the daemon did not start:\n{log.read_text(encoding='utf-8').strip()}")
            time.sleep(0.05)
        yield process
    finally:
        if process.poll() is None:
            process.kill()
        process.communicate()


@contextmanager
def _start_empty_loop(tick_ns: int, seconds: float, is_realtime: bool) -> Iterator[Pipe]:
    """Start the empty loop in a separate process; its result comes through the pipe."""
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    child = context.Process(target=run_empty_loop, args=(sender, tick_ns, seconds, is_realtime), name="empty loop")
    child.start()
    sender.close()
    try:
        yield receiver
    finally:
        if child.is_alive():
            child.kill()
        child.join()
        receiver.close()


def run_empty_loop(pipe: Pipe, tick_ns: int, seconds: float, is_realtime: bool) -> None:
    """Wait for ticks as the daemon does; send their lateness [ns] and whether real time was permitted."""
    if is_realtime:
        with enable_realtime() as outcomes:
            pipe.send((_measure_lateness_ns(tick_ns, seconds), all(outcome.is_applied for outcome in outcomes)))
    else:
        pipe.send((_measure_lateness_ns(tick_ns, seconds), True))


def _measure_lateness_ns(tick_ns: int, seconds: float) -> list[int]:
    offset_ns = tick_ns // 2
    ticker = Ticker(tick_ns, tick_ns, lambda: monotonic_ns() - offset_ns)
    connections = {"idle": open_connection("udpin://127.0.0.1:0")}
    lateness_ns: list[int] = []
    for _ in range(round(seconds * 1e9) // tick_ns):
        due_ns = ticker.next().at_ns + offset_ns
        while monotonic_ns() < due_ns:
            wait(connections, due_ns)
        lateness_ns.append(monotonic_ns() - due_ns)
    return lateness_ns


def _fly_vehicle(vehicle: BenchVehicle, process: subprocess.Popen[str], positions: int) -> list[int]:
    """Fly the vehicle for the number of ticks of the empty loop; return the daemon's memory each second [KiB].

    The number of ticks is fixed, not the time: a tick that the machine slept through has no position.
    """
    memory_kib: list[int] = []
    next_ns = time.monotonic_ns()
    while vehicle.positions < positions:
        now_ns = time.monotonic_ns()
        vehicle.run_tick()
        if now_ns >= next_ns:
            next_ns += _MEMORY_PERIOD_NS
            if process.poll() is not None:
                raise UavctlError(f"the daemon ended with code {process.returncode} while it was measured")
            memory_kib.append(_read_resident_kib(process.pid))
    return memory_kib


def _read_resident_kib(pid: int) -> int:
    for line in Path(f"/proc/{pid}/status").read_text(encoding="ascii").splitlines():
        if line.startswith("VmRSS:"):
            return int(line.split()[1])
    return 0
