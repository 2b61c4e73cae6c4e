"""A vehicle on the floor of a room that knows its position only through the relay, over a link of chosen delays."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

from loopback_rig import MemorySink, shared_loop
from mavlink_rig import MS, read

from sim.autopilot.profile import SIMULATED
from sim.simulation import Peers
from uavctl.config import load_config
from uavctl.lab.position_loop import EXTERNAL_ONLY
from uavctl.mavlink.handover_states import HandoverState
from uavctl.records import Datagram, Outgoing, Received

Delay = Callable[[float, bytes, bool], float | None]


def deliver_now(at_s: float, data: bytes, up: bool) -> float | None:
    """Take no time on the way, and lose nothing."""
    del at_s, data, up
    return 0.0


class IndoorsRig:
    """The whole loop, and a vehicle on the floor that knows its position only through us.

    Args:
        name: of the autopilot.
        more: overrides of the configuration.
        delay: of time, datagram, and whether it goes up to the vehicle: what it takes on the way [s]; None: it is lost.
    """

    def __init__(self, name: str, *more: str, delay: Delay = deliver_now) -> None:
        self.config = load_config(
            "room-hahn-stursberg",
            [
                f"sim.autopilot={name}",
                "sim.camera.rate_hz=30.0",
                "relay.enabled=true",
                "link.loss=0.0",
                "sim.plant=quadrotor",
                "solver.method=exact",
                # a heading of its own, so that an attitude is told
                "frame.yaw_deg=20",
                *more,
            ],
        )
        self.memory = MemorySink()
        self.loop = shared_loop(self.config, self.memory)
        self.peers = Peers(self.config, 0, airborne=False)
        for parameter, value in EXTERNAL_ONLY[name].items():
            assert self.peers.autopilot.parameters.set(parameter, value)
        self.tick = 0
        self.delay = delay
        self._way: list[tuple[int, int, bool, str, bytes]] = []  # arrival, order, up, link, data: on the way
        self._order = 0

    def run(self, seconds: float, *, stop: bool = False) -> None:
        for _ in range(round(seconds * 20)):
            if self.loop.finished:
                return
            at_ns = self.tick * 50 * MS
            self._carry(at_ns)
            self.loop.tick(self.tick, at_ns, partial(self._send, at_ns), stop=stop)
            self.tick += 1

    def _carry(self, to_ns: int) -> None:
        """Move time on, and deliver what is due, in order of arrival."""
        while True:
            due_ns = min(self._way[0][0], to_ns) if self._way else to_ns
            self.peers.exchange(max(due_ns, self.peers.now_ns), self._hear)
            if not self._way or self._way[0][0] > to_ns:
                return
            due_ns, _, up, link, data = heapq.heappop(self._way)
            if up:
                self.peers.receive(link, data, max(due_ns, self.peers.now_ns))
            else:
                for answer in self.loop.receive(link, data, due_ns).answers:
                    self._send(due_ns, answer)

    def _hear(self, link: str, data: bytes, at_ns: int) -> Received:
        self._put_on_way(at_ns, False, link, data)
        return Received((), from_vehicle=False, from_source=False)

    def _send(self, at_ns: int, outgoing: Outgoing) -> None:
        self._put_on_way(at_ns, True, outgoing.link, outgoing.data)

    def _put_on_way(self, at_ns: int, up: bool, link: str, data: bytes) -> None:
        takes_s = self.delay(at_ns * 1e-9, data, up) if link == "vehicle" else 0.0
        if takes_s is None:
            return
        if up and takes_s == 0.0:
            self.peers.receive(link, data, max(at_ns, self.peers.now_ns))
            return
        self._order += 1
        heapq.heappush(self._way, (at_ns + round(takes_s * 1e9), self._order, up, link, data))

    def pilot_flies(self, external: str) -> None:
        """The pilot takes off by hand, and switches at 1.2 m."""
        pilot, kind = self.peers.autopilot.pilot, SIMULATED[self.config.sim.autopilot]
        if kind.name == "ardupilot":
            pilot.change_mode(kind.get_mode(external), self.peers.now_ns)
        assert pilot.arm(self.peers.now_ns) == 0 and pilot.take_off(1.2, self.peers.now_ns) == 0
        self.run(5.0)
        assert pilot.change_mode(kind.get_mode(external), self.peers.now_ns) == 0
        self.run(3.0)
        assert self.loop.handover_state is HandoverState.ENGAGED and not self.loop.finished

    def sent(self, *kinds: str) -> Iterator[tuple[int, Any]]:
        for record in self.memory.of(Datagram):
            if record.outgoing:
                for message in read(record.data):
                    if message.get_type() in kinds:
                        yield record.at_ns, message

    def relayed(self) -> Iterator[tuple[int, Any]]:
        return self.sent("VISION_POSITION_ESTIMATE", "ODOMETRY")
