"""A check beside the simulated peers in virtual time, and peers of its own that a hand moves."""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Sequence

from mavlink_rig import Peer
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from sim_rig import Client, decode

from sim.simulation import VEHICLE, Peers
from uavctl.check.findings import Item, ItemState
from uavctl.check.preflight import Preflight
from uavctl.config import load_config
from uavctl.mavlink.connection import make_links
from uavctl.records import discard

TICK_NS, S = 50_000_000, 1_000_000_000
# Cameras as they are: the sim's own [frame] is right, the one of the check is what is tried.
CALM = ("plant.wind_std_mps2=[1e-9,1e-9,1e-9]", "sim.camera.rate_hz=20.0", "link.loss=0.0")


class CheckResult:
    """The items of a check, and the check itself."""

    def __init__(self, flight: Preflight, at_ns: int) -> None:
        self.flight = flight
        self.items = {item.name: item for item in flight.make_items(at_ns)}

    def __getitem__(self, name: str) -> Item:
        return self.items[name]

    @property
    def bad_items(self) -> list[str]:
        return [name for name, item in self.items.items() if item.state is ItemState.BAD]


def run_check(
    overrides: Sequence[str] = (),
    wrong: Sequence[str] = (),
    *,
    seconds: float = 6.0,
    airborne: bool = False,
    setpoints: Callable[[float], tuple[float, float, float] | None] = lambda _: None,
    twist: Callable[[bytes], bytes] = lambda data: data,
    prepare: Callable[[Peers], None] = lambda _: None,
) -> CheckResult:
    """Check the simulated peers.

    Args:
        overrides: of the configuration of both sides.
        wrong: of the check's alone.
        seconds: how long.
        airborne: whether it flies.
        setpoints: acceleration that a client of its own asks for at a time [s].
        twist: what happens to the cameras' datagrams on their way.
        prepare: called with the peers before the start.
    """
    config = load_config("room-hahn-stursberg", [*CALM, *overrides, *wrong])
    shared = config.daemon.vehicle == config.daemon.mocap
    peers = Peers(load_config("room-hahn-stursberg", [*CALM, *overrides]), 0, airborne=airborne, shared_link=shared)
    prepare(peers)
    flight, client = Preflight(config, make_links, 0), Client()
    ticks = round(seconds * S) // TICK_NS
    for tick in range(ticks):
        at_ns = tick * TICK_NS
        for arrival_ns, link, data in peers.advance(at_ns):
            flight.receive(link, data if link == VEHICLE else twist(data), arrival_ns)
        flight.tick(tick, at_ns, peers.make_sender(at_ns))
        accel = setpoints(at_ns * 1e-9)
        if accel is not None:
            peers.receive(VEHICLE, client.setpoint(*accel), at_ns)
    return CheckResult(flight, ticks * TICK_NS)


def transform_cameras(matrix: Sequence[Sequence[float]]) -> Callable[[bytes], bytes]:
    """Cameras whose positions are multiplied by a matrix on their way: a unit, a mirror, other axes."""

    def twist(data: bytes) -> bytes:
        (message,) = decode(data)
        where = (message.x, message.y, message.z)
        x, y, z = (sum(a * b for a, b in zip(row, where, strict=True)) for row in matrix)
        mav = mavlink.MAVLink(None, message.get_srcSystem(), message.get_srcComponent())
        mav.seq = message.get_seq()
        angles = message.roll, message.pitch, message.yaw
        return bytes(mavlink.MAVLink_vision_position_estimate_message(message.usec, x, y, z, *angles).pack(mav))

    return twist


class HandMotion:
    """A body in a hand, with a vehicle on it that knows its attitude, and a position of its own if it is told to.

    Speaks through pymavlink alone; `place` is the truth in local NED, `matrix` what the cameras make of it.
    """

    def __init__(
        self, *overrides: str, heading_rad: float = 0.0, has_estimate: bool = False, move: bool = False
    ) -> None:
        self.config = load_config("room-hahn-stursberg", [*CALM, *overrides])
        self.flight = Preflight(self.config, make_links, 0, move=move)
        self.vehicle, self.cameras = Peer(1, 1), Peer(17, 18)
        self.heading_rad, self.own = heading_rad, has_estimate
        self.place = [0.3, 0.2, -0.02]
        self.matrix = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
        self.at_ns = 0
        self._random = random.Random(1)

    def hold(self, seconds: float, *, armed: bool = False) -> None:
        for _ in range(round(seconds * 20)):
            self.at_ns += 50_000_000
            if self.at_ns % S == 0:
                self.report(self.vehicle.heartbeat(base_mode=209 if armed else 81, custom_mode=4 << 16 | 3 << 24))
            boot_ms = self.at_ns // 1_000_000 + 20_000
            self.report(self.vehicle.send("attitude", boot_ms, 0.01, 0.0, self.heading_rad, 0.0, 0.0, 0.0))
            if self.own:
                self.report(self.vehicle.local_position(boot_ms, *self.place))
            observed = [sum(a * b for a, b in zip(row, self.place, strict=True)) for row in self.matrix]
            x, y, z = (value + self._random.gauss(0.0, 0.003) for value in observed)
            self.flight.receive("mocap", self.cameras.vision(self.at_ns // 1000 + 10**9, x, y, z), self.at_ns)
            self.flight.tick(0, self.at_ns, discard)

    def carry(self, *displacement_m: float) -> None:
        """Carry it along a way in 1 s, and hold it for 1.5 s."""
        for _ in range(20):
            self.place = [a + b / 20 for a, b in zip(self.place, displacement_m, strict=True)]
            self.hold(0.05)
        self.hold(1.5)

    def follow(self) -> None:
        """Do what is asked, rightly."""
        c, s = 0.5 * math.cos(self.heading_rad), 0.5 * math.sin(self.heading_rad)
        self.hold(2.0)
        for displacement_m in ((0.0, 0.0, -0.5), (c, s, 0.0), (-s, c, 0.0)):
            self.carry(*displacement_m)

    def is_done(self) -> CheckResult:
        return CheckResult(self.flight, self.at_ns)

    def report(self, data: bytes) -> None:
        self.flight.receive("vehicle", data, self.at_ns)
