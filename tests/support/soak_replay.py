"""Flights of random configurations with everything amiss, recorded and replayed, for `tools/soak.py` and its tests."""

from __future__ import annotations

import subprocess
import sys
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import msgspec
import numpy as np
from draw_controller import prepare_config
from draw_flight import FlightDraw, draw_flight
from msgspec.structs import replace
from signing_rig import KEY, OFFSET_NS

from logs.recording.ends import put_header
from logs.recording.info import read_info
from logs.recording.recorder import DerivedTopics, SyncRecorder
from logs.recording.replay import ReplayResult
from logs.recording.views import ViewBuilder
from sim.simulation import Peers, World
from uavctl.arrays import SECOND_NS
from uavctl.cli.replays import replay_flight
from uavctl.config import Config
from uavctl.loop import ControlLoop
from uavctl.mavlink.framing import scan_frames
from uavctl.mavlink.signing import FrameAuthenticator, FrameSigner, SigningKey, SigningTimestamps
from uavctl.records import Command, Order, Received, Record, Send, Sink
from uavctl.wiring.controller import Prepared


class SignatureChannel:
    """Signatures put on and taken off again, with what the channel has damaged left damaged."""

    def __init__(self, links: tuple[str, ...]) -> None:
        key, theirs, ours = SigningKey(KEY), SigningTimestamps(), SigningTimestamps()
        self.peers = {name: FrameAuthenticator(FrameSigner(key, 3, theirs, OFFSET_NS), stream=False) for name in links}
        self.gates = {name: FrameAuthenticator(FrameSigner(key, 7, ours, OFFSET_NS), stream=False) for name in links}
        self.told: dict[str, Counter[str]] = {name: Counter() for name in links}

    def accept(self, link: str, data: bytes, at_ns: int) -> bytes:
        """What of a datagram passes."""
        result = scan_frames(data, final=True)
        if result.frames and not result.bad:
            data = b"".join(self.peers[link].sign_frame(frame.data, at_ns) for frame in result.frames)
        return self.gates[link].verify_frames(data, at_ns)

    def take_refused(self, loop: ControlLoop, at_ns: int) -> None:
        """Return the number of refused datagrams since the last call."""
        for name, gate in self.gates.items():
            new = gate.refused - self.told[name]
            self.told[name] = Counter(gate.refused)
            if new:
                loop.add_refusals(name, dict(new), at_ns)


@dataclass
class ReplayRig:
    """The loop as the world sees it, with all that a plan has happen to it.

    Attributes:
        plan: What happens.
        prepared: What flies.
        sink: Where its records go.
        missed: Ticks missed since the last one.
    """

    plan: FlightDraw
    prepared: Prepared
    sink: Sink
    missed: int = 0
    stop: bool = False
    world: World | None = None
    _late: list[tuple[int, int]] = field(default_factory=list)

    def __post_init__(self) -> None:
        config = self.plan.config
        self.loop = ControlLoop(config, self.prepared.controller, self.sink, lambda: 0)
        self._links = ("vehicle",) if config.daemon.vehicle == config.daemon.mocap else ("vehicle", "mocap")
        self._doors = SignatureChannel(self._links) if self.plan.signed else None
        self._rng = np.random.default_rng((config.sim.seed, 1))
        self._heard: list[bytes] = []

    def receive(self, link: str, data: bytes, at_ns: int) -> Received:
        """Take a datagram."""
        self._heard = [*self._heard[-20:], data]
        if self._doors is not None:
            data = self._doors.accept(link, data, at_ns)
            if not data:
                return Received((), False, False)
        return self.loop.receive(link, data, at_ns)

    def tick(self, tick: int, at_ns: int, send: Send) -> None:
        """Run a tick, or miss it, or put it off."""
        plan = self.plan
        if tick == 0 and plan.take_off_m is not None:
            self.loop.order(Command(order=Order.TAKE_OFF, height_m=plan.take_off_m))
        for when, command in plan.orders:
            if when == tick:
                self.loop.order(command)
        if self._rng.uniform() < plan.noise:
            self._stranger(at_ns)
        if tick in plan.skipped:
            self.missed += 1
        elif tick in plan.late_ticks:
            self._late.append((tick, at_ns))
        else:
            for past_tick, its_ns in [*self._late, (tick, at_ns)]:
                stop = self.stop or (plan.stop_tick is not None and past_tick >= plan.stop_tick)
                self.loop.tick(past_tick, its_ns, send, self.missed, stop=stop)
                self.missed = 0
            self._late.clear()
        if self._doors is not None and at_ns % SECOND_NS == 0:
            self._doors.take_refused(self.loop, at_ns)
        self._reboot(tick + 1)

    def _stranger(self, at_ns: int) -> None:
        """Bytes of nobody, or somebody's again, perhaps with a byte changed."""
        data = bytearray(self._rng.bytes(int(self._rng.integers(1, 60))))
        if self._heard and self._rng.uniform() < 0.7:
            data = bytearray(self._heard[int(self._rng.integers(len(self._heard)))])
            if data and self._rng.uniform() < 0.5:
                data[int(self._rng.integers(len(data)))] ^= 1 << int(self._rng.integers(8))
        link = self._links[int(self._rng.integers(len(self._links)))]
        if self._doors is None:
            self.loop.receive(link, bytes(data), at_ns)
        else:
            data = bytearray(self._doors.gates[link].verify_frames(bytes(data), at_ns))
            if data:
                self.loop.receive(link, bytes(data), at_ns)

    def _reboot(self, next_tick: int) -> None:
        """Restart the vehicle, its cameras and its link with the next tick."""
        plan, world = self.plan, self.world
        per_step = round(plan.config.plant.dt_s / plan.config.daemon.tick_s)
        if world is None or plan.reboot_step is None or next_tick != plan.reboot_step * per_step:
            return
        at_ns = plan.start_ns + next_tick * round(plan.config.daemon.tick_s * 1e9)
        world.peers = Peers(_in(plan), at_ns, airborne=False, shared_link=len(self._links) == 1)


def _in(plan: FlightDraw) -> Config:
    return replace(plan.config, link=plan.link)


@dataclass(frozen=True)
class ReplayedFlight:
    """A flight and its replay.

    Attributes:
        seed: Of the flight.
        path: Its recording.
        labels: What it had; see `FlightDraw.labels`.
        result: What the replay found.
        record_counts: Modes, solves and events that the flight had, each with a count.
        files: Files of the recording.
        flight_s: Virtual time flown [s].
        process_difference: Difference by `uavctl log replay` in a process of its own; empty without one.
    """

    seed: int
    path: Path
    labels: tuple[str, ...]
    result: ReplayResult
    record_counts: Counter[str]
    files: int
    flight_s: float
    process_difference: str = ""

    @property
    def is_identical(self) -> bool:
        """Whether nothing differs."""
        return self.result.identical and not self.process_difference


class _Seen:
    """A sink that counts what went through it."""

    def __init__(self, inner: Sink) -> None:
        self.inner, self.count = inner, Counter[str]()

    def put(self, topic: str, at_ns: int, record: Record) -> None:
        """Count it and hand it on."""
        kind = type(record).__name__
        detail = getattr(record, "mode", "") if kind == "Decision" else getattr(record, "code", "")
        detail = detail or (getattr(record, "status", "") if kind == "Plan" else "")
        self.count[f"{kind} {detail}".rstrip()] += 1
        self.inner.put(topic, at_ns, record)


def record(seed: int, path: Path) -> tuple[FlightDraw, Counter[str]]:
    """Fly a seed's flight into the new recording `path`."""
    plan = draw_flight(seed)
    config, prepared = plan.config, prepare_config(plan.config)
    recorder = SyncRecorder(path, config.log, derived_topics=DerivedTopics(ViewBuilder()) if plan.viewers else None)
    sink = _Seen(recorder)
    try:
        put_header(recorder, prepared, started_ns=plan.start_ns)
        rig = ReplayRig(plan, prepared, sink)
        rig.world = World(
            _in(plan),
            rig,
            on_truth=lambda truth: sink.put("/sim/truth", truth.at_ns, truth),
            start_ns=plan.start_ns,
            airborne=plan.take_off_m is None,
        )
        rig.world.run(config.duration_s)
        if plan.take_off_m is not None:
            rig.stop = True
            rig.world.run(config.duration_s + 20.0, lambda: rig.loop.finished)
    finally:
        status = recorder.close()
    assert status.ok, status
    return plan, sink.count


def replay_seed(seed: int, folder: Path) -> ReplayedFlight:
    """Fly a seed's flight into a recording, and replay it from the recording alone."""
    path = folder / f"{seed}" / "flight.mcap"
    plan, observed = record(seed, path)
    result = read_info(path)
    return ReplayedFlight(
        seed, path, plan.labels, replay_flight(path).result, observed, len(result.files), result.duration_s
    )


def replay_in_process(path: Path) -> str:
    """What a replay in a process of its own finds; empty if all is identical."""
    command = [sys.executable, "-m", "uavctl", "log", "replay", str(path), "--json"]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    return "" if ended.returncode == 0 else ended.stdout or ended.stderr


def tally_flights(result: Iterable[ReplayedFlight]) -> dict[str, object]:
    """Figures of many flights."""
    flights = sorted(result, key=lambda flight_result: flight_result.seed)
    arguments, observed = Counter[str](), Counter[str]()
    for flight in flights:
        arguments.update(flight.labels)
        observed.update(flight.record_counts)
    return {
        "replayed": len(flights),
        "identical": sum(flight.is_identical for flight in flights),
        "decisions": sum(flight.result.decisions for flight in flights),
        "records": sum(flight.result.compared for flight in flights),
        "in_several_files": sum(flight.files > 1 for flight in flights),
        "virtual_s": round(sum(flight.flight_s for flight in flights), 1),
        "had": dict(sorted(arguments.items())),
        "seen": dict(sorted(observed.items())),
        "wrong": {
            str(flight.seed): flight.process_difference or msgspec.to_builtins(flight.result.first_difference)
            for flight in flights
            if not flight.is_identical
        },
    }
