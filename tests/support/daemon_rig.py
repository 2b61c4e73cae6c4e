"""The daemon's cycle in virtual time: a bench with the simulated peers behind its connections."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from loopback_rig import MemorySink, shared_loop
from sim_rig import decode
from transport_rig import IdleConnection

from sim.simulation import Peers
from uavctl.clock import Ticker
from uavctl.config import load_config
from uavctl.daemon.daemon import AfterTick, fly
from uavctl.io.base import Connection
from uavctl.records import Event

TICK_NS, DT_NS, SECOND = 50_000_000, 200_000_000, 1_000_000_000


class DaemonRig:
    """Virtual time with the simulated peers behind the daemon's connections."""

    def __init__(self, *overrides: str) -> None:
        self.config = load_config("room-hahn-stursberg", overrides)
        self.memory = MemorySink()
        self.loop = shared_loop(self.config, self.memory)
        self.now_ns = 1
        self.peers = Peers(self.config, DT_NS)
        self.arrived: dict[str, list[tuple[bytes, int]]] = {"vehicle": [], "mocap": []}
        self.connections = {name: PeerConnection(self, name) for name in self.arrived}
        self.told: list[tuple[str, int]] = []  # words for a person, and when they were told
        self.arrives: list[tuple[int, bytes]] = []  # what comes between ticks
        self.services: list[AfterTick] = [
            lambda ticked, _: self.told.extend((e.text, self.now_ns) for e in ticked.console_events)
        ]
        self.give_orders: AfterTick = lambda *_: None
        self.oversleep: dict[int, int] = {}  # deadline -> how much later the sleep ends

    def tell(self, news: Sequence[Event]) -> None:
        self.told.extend((event.text, self.now_ns) for event in news)

    def wait(self, connections: Mapping[str, Connection], deadline_ns: int) -> list[str]:
        del connections
        if self.arrives and self.arrives[0][0] < deadline_ns:
            self.now_ns, data = self.arrives.pop(0)
            self.arrived["vehicle"].append((data, self.now_ns))
            return ["vehicle"]
        self.now_ns = max(self.now_ns, deadline_ns) + self.oversleep.pop(deadline_ns, 0)
        if self.now_ns >= self.peers.now_ns:
            for at_ns, link, data in self.peers.advance(self.now_ns):
                self.arrived[link].append((data, at_ns))
        return [name for name, waiting in self.arrived.items() if waiting]

    def fly(self, *, stop_at_s: float = 1e9, duration_s: float | None = None, stop_limit_s: float = 12.0) -> bool:
        return fly(
            self.loop,
            self.connections,
            Ticker(TICK_NS, DT_NS, lambda: self.now_ns),
            lambda: self.now_ns >= stop_at_s * SECOND,
            duration_s=duration_s,
            stop_limit_s=lambda: stop_limit_s,
            give_orders=self.give_orders,
            after_tick=self.services,
            on_events=self.tell,
            wait_for=self.wait,
            now=lambda: self.now_ns,
        )


class PeerConnection(IdleConnection):
    """A connection to the simulated peers."""

    def __init__(self, bench: DaemonRig, name: str) -> None:
        super().__init__(name)
        self._bench, self._name = bench, name
        self.sent: list[int] = []
        self.words: list[tuple[int, str]] = []  # what was sent, and when
        self.dropped = 0

    def count_lost(self) -> int:
        return self.dropped

    def receive(self, *, read_all: bool = False) -> list[tuple[bytes, int]]:
        taken, self._bench.arrived[self._name] = self._bench.arrived[self._name], []
        return taken

    def send(self, data: bytes) -> None:
        self.sent.append(self._bench.now_ns)
        self.words += [(self._bench.now_ns, message.get_type()) for message in decode(data)]
        self._bench.peers.receive(self._name, data, self._bench.now_ns)
