"""Whole flights in virtual time, from the ground to the ground, against the simulated vehicles."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from loopback_rig import MemorySink, header, share_flight
from sim_rig import decode

from sim.autopilot.profile import SIMULATED
from sim.simulation import Peers
from uavctl.config import load_config
from uavctl.lab.position_loop import EXTERNAL_ONLY
from uavctl.loop import ControlLoop
from uavctl.mavlink.handover_states import HandoverState
from uavctl.records import Command, Datagram, Event, Order, Outgoing, Setpoint, Ticked

# Positions come through the relay alone, from cameras whose packets a third of are lost in bursts of ten on the mean.
RELAYED = [
    "relay.enabled=true",
    "sim.plant=quadrotor",
    "sim.camera.rate_hz=40.0",
    "sim.camera.noise_std_m=0.002",
    "link.model=gilbert-elliott",
    "link.loss=0.0",
    "link.burst_enter=0.043",
    "link.burst_leave=0.1",
    "source.rate_hz=40.0",
    "solver.method=exact",
]
TICK_NS, SECOND = 50_000_000, 1_000_000_000
GOAL = (1.5, 1.0, -1.2)
ON_THE_FLOOR = ["sim.start_position_m=[0.0,0.0,-0.7]", f"mission.waypoints=[{list(GOAL)}]", "mission.accept_m=0.3"]


class TakeOffRig:
    """The loop and the peers; between them the test may change, drop or add what is said."""

    def __init__(self, autopilot: str, *overrides: str) -> None:
        self.config = load_config("room-hahn-stursberg", [*ON_THE_FLOOR, f"sim.autopilot={autopilot}", *overrides])
        self.memory = MemorySink()
        design, controller = share_flight(self.config)
        self.memory.put("/uavctl/header", 0, header(self.config, design))
        self.loop = ControlLoop(self.config, controller, self.memory, lambda: 0)
        self.peers = Peers(self.config, 0, airborne=False)
        self.peers.autopilot.pilot.has_radio = True  # the pilot is there, with his stick
        self.tick = 0
        self.ticked: Ticked | None = None  # the last one
        self.notices: list[Event] = []  # of the whole flight
        self.hears: Callable[[bytes], bool] = lambda data: True  # whether the vehicle hears a datagram of ours
        self.told: Callable[[bytes], bool] = lambda data: True  # whether we hear one of the vehicle's

    @property
    def now_ns(self) -> int:
        return self.tick * TICK_NS

    @property
    def state(self) -> HandoverState:
        return self.loop.handover_state

    def is_in(self, *states: HandoverState) -> bool:
        return self.state in states

    def relayed(self) -> TakeOffRig:
        """The vehicle's own estimator gets no position but ours."""
        for name, value in EXTERNAL_ONLY[self.config.sim.autopilot].items():
            assert self.peers.autopilot.parameters.set(name, value)
        return self

    def take_off(self, height_m: float = 1.2) -> TakeOffRig:
        self.loop.order(Command(order=Order.TAKE_OFF, height_m=height_m))
        return self

    def run(self, seconds: float, *, stop: bool = False, until: HandoverState | None = None) -> TakeOffRig:
        for _ in range(round(seconds * SECOND) // TICK_NS):
            if self.state is until:
                return self
            for arrival_ns, link, data in self.peers.advance(self.now_ns):
                if link == "mocap" or self.told(data):
                    self.loop.receive(link, data, arrival_ns)
            self.ticked = self.loop.tick(self.tick, self.now_ns, self._send, stop=stop)
            self.notices += self.ticked.notices
            self.tick += 1
        assert until is None or self.state is until, (self.state, self.texts)
        return self

    def _send(self, outgoing: Outgoing) -> None:
        if self.hears(outgoing.data):
            self.peers.receive(outgoing.link, outgoing.data, self.now_ns)

    def stick(self, mode: str) -> None:
        """The pilot changes the mode."""
        kind = SIMULATED[self.config.sim.autopilot]
        self.peers.autopilot.pilot.change_mode(kind.get_mode(mode), self.now_ns)

    @property
    def states(self) -> list[str]:
        texts = [event.text for event in self.memory.of(Event) if event.code == "hand-over"]
        return [text.split(" -> ")[1].split(" (")[0] for text in texts]

    @property
    def texts(self) -> list[str]:
        return [event.text for event in self.memory.of(Event)]

    def sent(self, kind: str) -> list[tuple[int, Any]]:
        """(time, message) of what went to the vehicle."""
        results = [d for d in self.memory.of(Datagram) if d.outgoing and d.link == "vehicle"]
        return [(d.at_ns, m) for d in results for m in decode(d.data) if m.get_type() == kind]

    def commands(self) -> list[int]:
        """Numbers of the commands that were sent, but for streams."""
        return [m.command for _, m in self.sent("COMMAND_LONG") if m.command not in (511, 512)]

    def setpoints_between(self, since_ns: int, until_ns: int) -> Sequence[Setpoint]:
        return [s for s in self.memory.of(Setpoint) if since_ns <= s.at_ns < until_ns]
