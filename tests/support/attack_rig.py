"""`uavctl fly` as a process, a vehicle with cameras on real UDP, attackers beside it: work and setpoints counted."""

from __future__ import annotations

import json
import os
import random
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

from mavlink_rig import OFFBOARD, Peer
from operation_rig import reserve_port
from patience import LIMIT_S
from places import without_pages
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from signing_rig import EPOCH_S, KEY, SECOND, SignedPeer

from logs.recording.notes import RecorderNote
from logs.recording.reader import read
from uavctl.records import ControlMode, Decision, Refused

POSITION_CONTROL = 3 << 16
SETPOINT, COMMAND = 84, 76
ARMED, DISARMED = 129, 1  # base modes with a mode of the autopilot's own
POSITIONS_HZ = 20.0
NOISE_M = 0.003
START_LIMIT_S = 120.0
REPORT_PERIOD_NS = 1_100_000_000  # what was refused is told once a second
_TICKS_PER_S = os.sysconf("SC_CLK_TCK")


class FakeVehicle:
    """A point mass that flies by our setpoints, streams telemetry, and gives its positions to the cameras' port.

    Args:
        vehicle_port: of the daemon, for the vehicle.
        mocap_port: for the cameras.
        signed: sign what is sent.
        telemetry_hz: messages a second of the vehicle besides heartbeats.
    """

    def __init__(self, vehicle_port: int, mocap_port: int, *, signed: bool, telemetry_hz: float) -> None:
        self._vehicle, self._cameras = reserve_port(), reserve_port()
        self._vehicle.connect(("127.0.0.1", vehicle_port))
        self._cameras.connect(("127.0.0.1", mocap_port))
        for connection in (self._vehicle, self._cameras):
            connection.setblocking(False)
        stamp = int((time.time() - EPOCH_S) * SECOND)
        self._voice: Peer = SignedPeer(KEY, stamp) if signed else Peer()
        self._eyes: Peer = SignedPeer(KEY, stamp, 4, 17, 18) if signed else Peer(17, 18)
        self.mode, self.armed = OFFBOARD, True
        self.position, self.velocity = [0.0, 0.0, -1.2], [0.0, 0.0, 0.0]
        self._accel = (0.0, 0.0, 0.0)
        self.setpoints = 0
        self.setpoint_s: list[float] = []
        self._period_s = 1.0 / telemetry_hz
        now_s = time.monotonic()
        self._next = {"beat": now_s, "telemetry": now_s, "position": now_s}
        self._moved_s = now_s
        self._number = 0
        self._chance = random.Random(1)

    def close(self) -> None:
        self._vehicle.close()
        self._cameras.close()

    def run(self, seconds: float, until: Callable[[], bool] = lambda: False) -> bool:
        """Fly for a time, or until something holds; whether it does."""
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s:
            self.step()
            if until():
                return True
            time.sleep(0.0015)
        return False

    def step(self) -> None:
        """Run what is due."""
        now_s = time.monotonic()
        self.listen()
        self._move(now_s)
        if now_s >= self._next["beat"]:
            self._next["beat"] = now_s + 1.0
            self.send_heartbeat()
        while now_s >= self._next["telemetry"]:
            self._next["telemetry"] = max(self._next["telemetry"] + self._period_s, now_s - 0.1)
            self._send(self._vehicle, self._send_telemetry())
        if now_s >= self._next["position"]:
            self._next["position"] = now_s + 1.0 / POSITIONS_HZ
            self._send(self._cameras, self._eyes.vision(int(now_s * 1e6), *self._measure_position()))

    def send_heartbeat(self) -> None:
        """Send a heartbeat with the mode."""
        self._send(self._vehicle, self._voice.heartbeat(self.mode, ARMED if self.armed else DISARMED))

    def take_over(self) -> None:
        """Change the mode as the pilot does, and send it."""
        self.mode = POSITION_CONTROL
        self._accel = (0.0, 0.0, 0.0)
        self.velocity = [0.0, 0.0, 0.0]
        self.send_heartbeat()

    def listen(self) -> None:
        """Receive pending datagrams."""
        while True:
            try:
                data = self._vehicle.recv(2048)
            except (BlockingIOError, ConnectionRefusedError):
                break
            self._receive(data)
        while True:
            try:
                self._cameras.recv(2048)
            except (BlockingIOError, ConnectionRefusedError):
                break

    def _receive(self, data: bytes) -> None:
        message_id = int.from_bytes(data[7:10], "little")
        payload = data[10 : 10 + data[1]].ljust(53, b"\0")
        if message_id == SETPOINT:
            self.setpoints += 1
            self.setpoint_s.append(time.monotonic())
            if self.mode == OFFBOARD:
                self._accel = struct.unpack_from("<3f", payload, 28)
        elif message_id == COMMAND:
            (command,) = struct.unpack_from("<H", payload, 28)
            if command == mavlink.MAV_CMD_DO_SET_MODE:
                _, main, sub = struct.unpack_from("<3f", payload)
                self.mode = int(main) << 16 | int(sub) << 24
                self.send_heartbeat()
            self._send(self._vehicle, self._voice.send("command_ack", command, 0))

    def _send_telemetry(self) -> bytes:
        self._number += 1
        boot_ms = int(time.monotonic() * 1e3) % 2**32
        if self._number % 10:
            return self._voice.send("attitude", boot_ms, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        return self._voice.send("local_position_ned", boot_ms, *self.position, *self.velocity)

    def _measure_position(self) -> tuple[float, float, float]:
        """Where it is, with the cameras' noise: positions that are all the same count as stuck."""
        north, east, down = (coordinate + self._chance.gauss(0.0, NOISE_M) for coordinate in self.position)
        return north, east, down

    def _move(self, now_s: float) -> None:
        dt_s, self._moved_s = min(now_s - self._moved_s, 0.05), now_s
        if self.setpoint_s and now_s - self.setpoint_s[-1] > 0.5:
            self._accel, self.velocity = (0.0, 0.0, 0.0), [0.0, 0.0, 0.0]
        for axis, accel in enumerate(self._accel):
            self.velocity[axis] += accel * dt_s
            self.position[axis] += self.velocity[axis] * dt_s

    def _send(self, to: socket.socket, data: bytes) -> None:
        try:
            to.send(data)
        except OSError:
            return


@dataclass
class Window:
    """A part of a flight, from the outside.

    Attributes:
        begun_ns, ended_ns: Of the monotonic clock.
        cpu_s: Processor time of all of the daemon's threads.
        largest_gap_s: Between two setpoints.
        sent: Datagrams of the attackers.
    """

    begin_ns: int
    end_ns: int
    cpu_s: float
    largest_gap_s: float
    sent: int = 0

    @property
    def seconds(self) -> float:
        return (self.end_ns - self.begin_ns) * 1e-9


@dataclass
class AttackReport:
    """The same from the recording."""

    ticks: int = 0
    missed: int = 0
    fallbacks: int = 0
    refused: Counter[str] = field(default_factory=Counter)


class DaemonFlight:
    """One flight of a daemon."""

    def __init__(self, folder: Path, *, signed: bool, listed: bool, telemetry_hz: float = 350.0) -> None:
        self.folder = folder
        with reserve_port() as first, reserve_port() as second:
            self.vehicle_port, self.mocap_port = int(first.getsockname()[1]), int(second.getsockname()[1])
        urls = [f"udpin://127.0.0.1:{reserve_port}" for reserve_port in (self.vehicle_port, self.mocap_port)]
        options = ["--vehicle", urls[0], "--mocap", urls[1], "--set", "clock.latency_s=0.0"]
        if not listed:
            options += ["--set", 'security.allow=["127.0.0.1"]']
        if signed:
            key = folder / "key"
            key.write_text(KEY.hex())
            key.chmod(0o600)
            options += ["--set", f"security.key_file={key}"]
        self.log = folder / "messages"
        environ = {**without_pages(), "XDG_STATE_HOME": str(folder / "state"), "XDG_RUNTIME_DIR": str(folder)}
        command = [sys.executable, "-m", "uavctl", "fly", *options, "--json"]
        with self.log.open("w", encoding="utf-8") as stream:
            self.process = subprocess.Popen(
                [*command, "--out", str(folder / "f"), "--control", str(folder / "c")],
                stdout=subprocess.PIPE,
                stderr=stream,
                text=True,
                env=environ,
            )
        self._environ = environ
        self.vehicle = FakeVehicle(self.vehicle_port, self.mocap_port, signed=signed, telemetry_hz=telemetry_hz)

    def wait_until_it_flies(self) -> None:
        """Until setpoints have come for a second."""
        begun = 0

        def streams() -> bool:
            assert self.process.poll() is None, self.log.read_text(encoding="utf-8")
            return self.vehicle.setpoints >= begun + 20

        assert self.vehicle.run(START_LIMIT_S, streams), self.log.read_text(encoding="utf-8")
        self.vehicle.run(2.0)

    def cpu_s(self) -> float:
        """Processor time of all threads until now, user's and system's."""
        fields = Path(f"/proc/{self.process.pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / _TICKS_PER_S

    def measure(self, seconds: float) -> Window:
        """Fly on, and measure."""
        begin_ns, cpu_s, first = time.monotonic_ns(), self.cpu_s(), len(self.vehicle.setpoint_s)
        self.vehicle.run(seconds)
        times = [begin_ns * 1e-9, *self.vehicle.setpoint_s[first:], time.monotonic()]
        gap_s = max(after - before for before, after in pairwise(times))
        return Window(begin_ns, time.monotonic_ns(), self.cpu_s() - cpu_s, gap_s)

    def attack(
        self, kind: str, seconds: float, *, senders: int, listed: bool, per_s: float, cameras: bool = False
    ) -> Window:
        """The same under attack."""
        began = self.folder / f"began-{kind}"
        began.unlink(missing_ok=True)
        to = self.mocap_port if cameras else self.vehicle_port
        script = Path(__file__).with_name("attacker.py")
        arguments = [kind, str(to), "--source", "127.0.0.1" if listed else "127.0.0.2", "--per-s", str(per_s)]
        rest = ["--senders", str(senders), "--seconds", str(seconds + 0.5), "--log", str(began)]
        with subprocess.Popen(
            [sys.executable, str(script), *arguments, *rest], stdout=subprocess.PIPE, text=True
        ) as process:
            try:
                assert self.vehicle.run(LIMIT_S, began.exists), "the attacker does not begin"
                self.vehicle.run(0.3)
                window = self.measure(seconds)
                self.vehicle.run(LIMIT_S, lambda: process.poll() is not None)
                window.sent = int(process.communicate(timeout=LIMIT_S)[0])
            finally:
                if process.poll() is None:
                    process.kill()
        return window

    def order_engage(self) -> bool:
        """Order it to take the vehicle up again; whether it did."""
        ask = [sys.executable, "-m", "uavctl", "ctl", "engage", "--control", str(self.folder / "c")]
        with subprocess.Popen(ask, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=self._environ) as process:
            self.vehicle.run(LIMIT_S, lambda: process.poll() is not None)
        before = self.vehicle.setpoints
        return self.vehicle.run(5.0, lambda: self.vehicle.mode == OFFBOARD and self.vehicle.setpoints > before + 20)

    def stop(self, seconds: float) -> tuple[int, float]:
        """Stop the daemon for a time, take over in the middle; setpoints after it woke, and until when [s]."""
        vehicle = self.vehicle
        os.kill(self.process.pid, signal.SIGSTOP)
        try:
            vehicle.run(0.5 * seconds)
            vehicle.take_over()
            vehicle.run(0.5 * seconds)
            vehicle.listen()
            before = vehicle.setpoints
        finally:
            os.kill(self.process.pid, signal.SIGCONT)
        woke_s = time.monotonic()
        vehicle.run(2.0)
        late_s = vehicle.setpoint_s[len(vehicle.setpoint_s) - (vehicle.setpoints - before) :]
        return len(late_s), (late_s[-1] - woke_s if late_s else 0.0)

    def end(self) -> None:
        """End the flight: the vehicle is disarmed, and there is nothing to hand over."""
        self.vehicle.armed = False
        self.vehicle.send_heartbeat()
        self.process.send_signal(signal.SIGTERM)
        self.vehicle.run(LIMIT_S, lambda: self.process.poll() is not None)

    def read_report(self, window: Window) -> AttackReport:
        """Return the figures of a part from the recording."""
        result = AttackReport()
        mode = ControlMode.TRACK
        for _, at_ns, record in read(self.folder / "f" / "flight.mcap"):
            if isinstance(record, Refused) and window.begin_ns <= at_ns <= window.end_ns + REPORT_PERIOD_NS:
                result.refused.update(record.counts)
            elif isinstance(record, Decision) and window.begin_ns <= at_ns <= window.end_ns:
                result.ticks += 1 + record.missed_ticks
                result.missed += record.missed_ticks
                result.fallbacks += mode is ControlMode.TRACK and record.mode is not mode
                mode = record.mode
        return result

    def recorder_dropped(self) -> int:
        """Records that the recorder could not keep."""
        notes = [record for _, _, record in read(self.folder / "f" / "flight.mcap") if isinstance(record, RecorderNote)]
        return notes[-1].dropped if notes else -1


@contextmanager
def run_flight(*, signed: bool, listed: bool, telemetry_hz: float = 350.0) -> Iterator[DaemonFlight]:
    """A flight as long as the block lasts."""
    with tempfile.TemporaryDirectory(prefix="uavctl-attack-") as folder:
        rig = DaemonFlight(Path(folder), signed=signed, listed=listed, telemetry_hz=telemetry_hz)
        try:
            rig.wait_until_it_flies()
            yield rig
        finally:
            if rig.process.poll() is None:
                rig.process.kill()
            rig.process.communicate()
            rig.vehicle.close()


def run_attacks(
    kinds: list[str], *, seconds: float, senders: int, listed: bool, signed: bool, per_s: float, cameras: bool = False
) -> Iterator[dict[str, Any]]:
    """One flight with attacks of all kinds, one after the other; what each cost beside the calm part.

    Args:
        kinds: of `attacker.WORDS`.
        seconds: of each.
        senders: ports that are sent from.
        listed: their address is in the allow-list, or there is none.
        signed: the daemon has a key.
        per_s: datagrams a second of each sender.
        cameras: the cameras' port is attacked, not the vehicle's.
    """
    with run_flight(signed=signed, listed=listed) as rig:
        calm = rig.measure(2.0 * seconds)
        windows = {}
        for kind in kinds:
            windows[kind] = rig.attack(kind, seconds, senders=senders, listed=listed, per_s=per_s, cameras=cameras)
            alive = rig.process.poll() is None
            if not alive:
                break
            rig.vehicle.run(1.0)
        if rig.process.poll() is None:
            rig.end()
        quiet, dropped = rig.read_report(calm), rig.recorder_dropped()
        base = calm.cpu_s / calm.seconds
        for kind, window in windows.items():
            report = rig.read_report(window)
            yield {
                "kind": kind,
                "senders": senders,
                "listed": listed,
                "signed": signed,
                "port": "mocap" if cameras else "vehicle",
                "sent_per_s": round(window.sent / (window.seconds + 0.8)),
                "cpu_calm": round(base, 3),
                "cpu_added": round(window.cpu_s / window.seconds - base, 3),
                "missed": report.missed,
                "ticks": report.ticks,
                "missed_calm": quiet.missed,
                "ticks_calm": quiet.ticks,
                "largest_gap_s": round(window.largest_gap_s, 3),
                "fallbacks": report.fallbacks,
                "records_dropped": dropped,
                "refused": dict(report.refused),
            }


def run_stalls(runs: int, seed: int, telemetry_hz: float, *, signed: bool = False) -> Iterator[dict[str, Any]]:
    """Stop a daemon again and again while the pilot takes over; what came after it woke."""
    chance = random.Random(seed)
    with run_flight(signed=signed, listed=True, telemetry_hz=telemetry_hz) as rig:
        for number in range(runs):
            rig.vehicle.run(0.3 + chance.random())
            seconds = chance.uniform(0.3, 2.5)
            count, last_s = rig.stop(seconds)
            yield {"run": number, "stall_s": round(seconds, 3), "setpoints": count, "last_s": round(last_s, 3)}
            if number + 1 < runs and not rig.order_engage():
                text = rig.log.read_text(encoding="utf-8")
                raise AssertionError(f"it does not take the vehicle up again: {json.dumps(text[-500:])}")
