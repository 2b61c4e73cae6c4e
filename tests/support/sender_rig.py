"""True vehicles in one world and virtual time, whose positions a sender carries over one lossy channel.

Cameras, sender, channel and reports are links that a test may cut, delay or forge. What counts is the true motion.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache
from itertools import combinations

import numpy as np
from msgspec.structs import replace

from sim.simulation import FleetWorld, Seat
from uavctl.config import Config, load_config
from uavctl.config.checks import get_position_limits_m
from uavctl.io.shared_sources import find_shared_sources
from uavctl.loop import ControlLoop
from uavctl.mavlink.connection import MOCAP
from uavctl.records import ControlMode, Outgoing, Received, Record, Send, Truth, Vec3
from uavctl.wiring.controller import Prepared, build_flight_design, prepare
from uavctl.wiring.radio import RadioConfig, make_link_overrides
from uavctl.wiring.sender import PositionMessage, PositionSender

SPACING_M = 0.4
RADIO = RadioConfig(bytes_per_s=5760.0, rate_hz=50.0, loss=0.3, feedback_s=0.2)
RADIO_NS = 20_000_000  # on the way, each way
SOURCES = find_shared_sources([f"udpin://127.0.0.1:{1 + number}" for number in range(2)])
# Of vehicle, datagram and time: the vehicles and datagrams that the sender gets, or added delays [ns] on the radio
CameraAttack = Callable[[int, bytes, int], Sequence[tuple[int, bytes]]]
FrameAttack = Callable[[int, bytes, int], Sequence[tuple[int, bytes]]]


def pass_on(number: int, data: bytes, at_ns: int) -> Sequence[tuple[int, bytes]]:
    """Cameras without a fault."""
    del at_ns
    return ((number, data),)


def pass_at_once(number: int, data: bytes, at_ns: int) -> Sequence[tuple[int, bytes]]:
    """A radio without another fault than its loss."""
    del number, at_ns
    return ((0, data),)


@cache
def prepare_vehicle(
    number: int, seed: int, autopilot: str, radio: RadioConfig, apart_m: float, *, is_parallel: bool
) -> Prepared:
    """A vehicle that flies past the other one, each in its box."""
    low, high = ((-2.5, -0.2), (0.2, 2.5))[number]
    east_m, way = (-0.5 * apart_m, 0.5 * apart_m)[number], 1 if is_parallel else (1, -1)[number]
    sets = load_config(f"room-{autopilot}").sets
    config = load_config(
        f"room-{autopilot}",
        [
            *make_link_overrides(radio, 2),
            f"sets.state_lower={_write_limits(sets.state_lower, low)}",
            f"sets.state_upper={_write_limits(sets.state_upper, high)}",
            f"sim.start_position_m=[{-2.0 * way},{east_m},-1.2]",
            f"target.position_m=[{2.0 * way},{east_m},-1.2]",
            f"sim.system_id={1 + number}",
            f"sim.seed={1000 * number + seed}",
            "sim.camera.rate_hz=50",
        ],
    )
    return prepare(_drop_loss(config), build_flight_design(config))


def _write_limits(limits: Sequence[float], east_m: float) -> str:
    """Limits of a state with another one of the position east; each axis has as many states."""
    changed = [*limits]
    changed[len(limits) // 3] = east_m
    return f"[{','.join(map(str, changed))}]"


def _drop_loss(config: Config) -> Config:
    """Give the world's own channel no loss: the rig loses what the sender has sent."""
    return replace(config, link=replace(config.link, model="bernoulli", loss=0.0))


@dataclass
class Air:
    """What lies between cameras and control loops."""

    radio: RadioConfig
    configs: list[Config]
    seed: int
    cameras: CameraAttack = pass_on
    to_vehicle: FrameAttack = pass_at_once
    to_sender: FrameAttack = pass_at_once
    senders: list[PositionSender | None] = field(default_factory=list)
    loops: list[ControlLoop] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._rng = np.random.default_rng(self.seed)
        self._under_way: list[tuple[int, int, int, bytes, bool]] = []
        self._order = 0
        self._now_ns = 0
        self.sent: list[tuple[int, int]] = []  # time and vehicle
        if not self.senders:
            self.senders = [self.make_sender(0)]

    def make_sender(self, at_ns: int) -> PositionSender:
        """A sender that starts now."""
        return PositionSender(self.configs, SOURCES, self.radio, spacing_m=SPACING_M, start_ns=at_ns)

    def capture(self, number: int, data: bytes, at_ns: int) -> None:
        """Take a datagram of the cameras of a vehicle."""
        self.advance(at_ns)
        for receiver, changed in self.cameras(number, data, at_ns):
            for sender in self.senders:
                if sender is not None:
                    sender.receive_positions(receiver, changed, at_ns)
        self.advance(at_ns)

    def answer(self, number: int, data: bytes, at_ns: int) -> None:
        """Take what a daemon sends to the sender."""
        if self._rng.random() >= self.radio.loss:
            for delay_ns, changed in self.to_sender(number, data, at_ns):
                self._push(at_ns + RADIO_NS + delay_ns, number, changed, is_report=True)

    def advance(self, to_ns: int) -> None:
        """Let the senders send, and deliver, in order of time."""
        while True:
            self._deliver()
            has_sent = [self._send(sender) for sender in self.senders if sender is not None]
            if any(has_sent):
                continue
            # Nothing can be sent now: the next chance is a channel that becomes free, or a report that arrives.
            waits_ns = [sender.compute_remaining_ns(self._now_ns) for sender in self.senders if sender is not None]
            times_ns = [self._now_ns + wait_ns for wait_ns in waits_ns if wait_ns]
            times_ns += [at_ns for at_ns, *_ in self._under_way[:1]]
            next_ns = min(times_ns, default=to_ns)
            self._now_ns = min(next_ns, to_ns)
            if next_ns > to_ns or not times_ns:
                return

    def _send(self, sender: PositionSender) -> bool:
        sent = sender.send_next(self._now_ns)
        if sent is None:
            return False
        if isinstance(sent, PositionMessage):
            self.sent.append((self._now_ns, sent.vehicle))
        if self._rng.random() >= self.radio.loss:
            for delay_ns, changed in self.to_vehicle(sent.vehicle, sent.frame, self._now_ns):
                self._push(self._now_ns + RADIO_NS + delay_ns, sent.vehicle, changed, is_report=False)
        return True

    def _push(self, at_ns: int, number: int, data: bytes, *, is_report: bool) -> None:
        self._order += 1
        heapq.heappush(self._under_way, (at_ns, self._order, number, data, is_report))

    def _deliver(self) -> None:
        while self._under_way and self._under_way[0][0] <= self._now_ns:
            at_ns, _, number, data, is_report = heapq.heappop(self._under_way)
            if is_report:
                for sender in self.senders:
                    if sender is not None:
                        sender.receive_reports(number, data, at_ns)
            else:
                for reply in self.loops[number].receive(MOCAP, data, at_ns).answers:
                    self.answer(number, reply.data, at_ns)


class _Flyer:
    """A control loop whose cameras' link goes through the air."""

    def __init__(self, air: Air, number: int, loop: ControlLoop, on_tick: Callable[[int], None]) -> None:
        self._air, self._number, self._loop, self._on_tick = air, number, loop, on_tick
        self.modes: list[ControlMode] = []

    def receive(self, link: str, data: bytes, at_ns: int) -> Received:
        if link == MOCAP:
            self._air.capture(self._number, data, at_ns)
            return Received((), from_vehicle=False, from_source=False)
        return self._loop.receive(link, data, at_ns)

    def tick(self, tick: int, at_ns: int, send: Send) -> None:
        self._air.advance(at_ns)
        self._on_tick(at_ns)

        def send_or_answer(outgoing: Outgoing) -> None:
            if outgoing.link == MOCAP:
                self._air.answer(self._number, outgoing.data, at_ns)
            else:
                send(outgoing)

        self.modes.append(self._loop.tick(tick, at_ns, send_or_answer).decision.mode)


class _NoSink:
    def put(self, topic: str, at_ns: int, record: Record) -> None:
        """Drop a record."""


@dataclass(frozen=True)
class SentFlight:
    """True motion of a pair."""

    truths: tuple[list[Truth], ...]
    modes: tuple[list[ControlMode], ...]
    limits: tuple[dict[str, tuple[float, float]], ...]
    targets_m: tuple[Vec3, ...]
    closest_m: float
    collisions: int
    sent: list[tuple[int, int]]

    def compute_outside_m(self, number: int) -> float:
        """Largest true distance beyond walls and ceiling of a vehicle's box; the floor is no wall."""
        outside_m = 0.0
        for truth in self.truths[number]:
            for value, (axis, (low, high)) in zip(truth.position_m, self.limits[number].items(), strict=True):
                outside_m = max(outside_m, low - value, 0.0 if axis == "down" else value - high)
        return outside_m

    def compute_final_error_m(self, number: int) -> float:
        """True distance to the target at the end."""
        return math.dist(self.truths[number][-1].position_m, self.targets_m[number])

    def is_settled(self, number: int) -> bool:
        """Whether a vehicle is where it belongs at the end, or on the ground."""
        last = self.truths[number][-1]
        return self.compute_final_error_m(number) < 0.3 or last.position_m[2] > -0.05


def fly_pair(
    seed: int,
    make_attack: Callable[[Air], Callable[[int], None] | None] = lambda _: None,
    *,
    autopilot: str = "px4",
    duration_s: float = 10.0,
    radio: RadioConfig = RADIO,
    apart_m: float = 1.2,
    is_parallel: bool = False,
) -> SentFlight:
    """Fly a pair.

    Args:
        apart_m: distance of their ways.
        is_parallel: both fly the same way, instead of past each other.
        make_attack: changes the air before the start; the result is called before each tick of the first vehicle.
    """
    prepared = [
        prepare_vehicle(number, seed, autopilot, radio, apart_m, is_parallel=is_parallel) for number in range(2)
    ]
    configs = [one.config for one in prepared]
    air = Air(radio, configs, seed)
    attack = make_attack(air)
    air.loops = [ControlLoop(one.config, one.controller, _NoSink(), lambda: 0) for one in prepared]
    flyers = [
        _Flyer(air, number, loop, attack if attack is not None and number == 0 else lambda _: None)
        for number, loop in enumerate(air.loops)
    ]
    truths: tuple[list[Truth], ...] = ([], [])
    world = FleetWorld(
        [Seat(one.config, flyer, own.append) for one, flyer, own in zip(prepared, flyers, truths, strict=True)]
    )
    world.run(duration_s)
    closest = min(approach.distance_m for approach in world.space.closest_approaches)
    sampled = min(
        math.dist(a.position_m, b.position_m) for pair in combinations(truths, 2) for a, b in zip(*pair, strict=True)
    )
    assert closest <= sampled + 0.01
    return SentFlight(
        truths,
        tuple(flyer.modes for flyer in flyers),
        tuple(get_position_limits_m(config) for config in configs),
        tuple(config.target.position_m for config in configs),
        closest,
        len(world.space.collisions),
        air.sent,
    )
