"""The daemon's cycle on a clock and connections of our own: no sleep, no socket."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from itertools import pairwise

import pytest
from loopback_rig import Memory, make_loop
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from sim_rig import decode

from logs.replay import replay
from sim.peers import Peers
from uavctl.clock import Ticker
from uavctl.config import load_config
from uavctl.daemon import fly
from uavctl.data import ControlMode, Datagram, Decision, LinkStats, Timing
from uavctl.errors import UavctlError
from uavctl.transport import Connection

TICK_NS, DT_NS, SECOND = 50_000_000, 200_000_000, 1_000_000_000


class Bench:
    """Virtual time with the simulated peers behind the daemon's connections."""

    def __init__(self, *overrides: str) -> None:
        self.config = load_config("room", overrides)
        self.memory = Memory()
        self.loop = make_loop(self.config, self.memory)
        self.now_ns = 1
        self.peers = Peers(self.config, DT_NS)
        self.arrived: dict[str, list[tuple[bytes, int]]] = {"vehicle": [], "mocap": []}
        self.connections = {name: Wire(self, name) for name in self.arrived}
        self.arrives: list[tuple[int, bytes]] = []  # what comes between ticks
        self.oversleep: dict[int, int] = {}  # deadline -> how much later the sleep ends

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
            stop_limit_s=stop_limit_s,
            wait_for=self.wait,
            now=lambda: self.now_ns,
        )


class Wire:
    """A connection to the simulated peers."""

    def __init__(self, bench: Bench, name: str) -> None:
        self.url, self.closed, self.send_errors, self.receive_errors = f"test://{name}", False, 0, 0
        self._bench, self._name = bench, name
        self.answered: list[int] = []
        self.sent: list[int] = []
        self.refused: Counter[str] = Counter()

    def fileno(self) -> int:
        return -1

    def receive(self) -> list[tuple[bytes, int]]:
        taken, self._bench.arrived[self._name] = self._bench.arrived[self._name], []
        return taken

    def answer(self, index: int) -> None:
        self.answered.append(index)

    def send(self, data: bytes) -> None:
        self.sent.append(self._bench.now_ns)
        self._bench.peers.receive(self._name, data, self._bench.now_ns)

    def close(self) -> None:
        self.closed = True


def test_it_flies_records_its_timing_and_hands_over_at_the_end() -> None:
    bench = Bench()
    bench.fly(duration_s=8.0)
    decisions = bench.memory.of(Decision)
    assert [d.tick for d in decisions] == list(range(len(decisions)))
    assert sum(d.mode is ControlMode.TRACK for d in decisions) > 150
    assert decisions[-1].mode in (ControlMode.LAND, ControlMode.STOPPED)
    assert bench.peers.autopilot.mode_name == "AUTO.LAND"
    timings = bench.memory.of(Timing)
    assert len(timings) == len(decisions)
    assert all(timing.lateness_ns == 0 for timing in timings)
    assert bench.connections["vehicle"].answered and not bench.connections["mocap"].answered


def timesync(ts1_ns: int) -> bytes:
    return bytes(mavlink.MAVLink_timesync_message(0, ts1_ns).pack(mavlink.MAVLink(None, 1, 1)))


def answers(bench: Bench) -> list[tuple[int, int, int]]:
    """(time of sending, tc1, ts1) of the answers to requests of `timesync`."""
    found = []
    for record in bench.memory.of(Datagram):
        if record.outgoing and record.link == "vehicle":
            found += [
                (record.at_ns, message.tc1, message.ts1)
                for message in decode(record.data)
                if message.get_type() == "TIMESYNC" and message.tc1 and message.ts1 < 0
            ]
    return found


def test_who_asks_for_the_time_is_answered_before_the_next_tick_and_a_replay_says_the_same() -> None:
    bench = Bench('solver.method="exact"')
    times = [SECOND + n * 17_000_000 + 123 for n in range(100)]
    bench.arrives = [(at_ns, timesync(-n - 1)) for n, at_ns in enumerate(times)]
    bench.fly(duration_s=3.0)
    assert answers(bench) == [(at_ns, at_ns, -n - 1) for n, at_ns in enumerate(times)]
    assert set(times) <= set(bench.connections["vehicle"].sent)  # on the wire, too, in the moment of arrival
    result = replay(iter(bench.memory.entries), lambda sink: make_loop(bench.config, sink))
    assert result.identical, result.first_difference


def test_a_flood_of_such_questions_is_answered_in_part_and_costs_no_tick() -> None:
    calm, flooded = Bench(), Bench()
    calm.fly(duration_s=2.0)
    flooded.arrives = [(SECOND + n * 500_000, timesync(-n - 1)) for n in range(2000)]
    flooded.fly(duration_s=2.0)
    assert 100 < len(answers(flooded)) <= 8 * 21
    assert flooded.memory.of(Decision) == calm.memory.of(Decision)
    assert flooded.memory.of(LinkStats)[-2].bad["timesync-flood"] > 1500


@pytest.mark.fault(21)
def test_row_21_an_oversleeping_loop_counts_what_it_missed_and_sends_no_burst() -> None:
    bench = Bench()
    bench.oversleep[DT_NS + 40 * TICK_NS] = 7 * TICK_NS + 3_000_000
    bench.fly(duration_s=4.0)
    missed = {d.tick: d.missed_ticks for d in bench.memory.of(Decision) if d.missed_ticks}
    # Tick 47 is the newest that is due then, and 40 to 46 are gone.
    assert missed == {47: 7}
    late = {t.tick: t.lateness_ns for t in bench.memory.of(Timing) if t.lateness_ns}
    assert late == {47: 3_000_000}
    started = [t.at_ns + t.lateness_ns for t in bench.memory.of(Timing)]
    assert min(after - before for before, after in pairwise(started)) == TICK_NS - 3_000_000


@pytest.mark.fault(34)
def test_row_34_a_stop_in_flight_brakes_then_lands() -> None:
    bench = Bench()
    assert bench.fly(stop_at_s=2.5)
    modes = [d.mode for d in bench.memory.of(Decision)]
    begun = next(i for i, m in enumerate(modes) if m is ControlMode.BRAKE)
    kinds = list(dict.fromkeys(modes[begun:]))
    assert kinds[:3] == [ControlMode.BRAKE, ControlMode.HOLD, ControlMode.LAND]
    assert bench.peers.autopilot.mode_name == "AUTO.LAND"


def test_the_hand_over_is_cut_off_after_its_limit() -> None:
    bench = Bench("fallback.brake_gain_1ps=0.001", "fallback.brake_s=100.0")
    assert bench.fly(stop_at_s=2.5, stop_limit_s=3.0)
    assert 5.4 * SECOND <= bench.now_ns <= 5.7 * SECOND


def test_an_end_that_nobody_asked_for_is_told_apart() -> None:
    bench = Bench("sim.camera.occluded=[[1.5,99.0]]", "fallback.hold_s=0.5")
    assert bench.fly(duration_s=60.0) is False
    assert bench.now_ns < 30 * SECOND and bench.peers.autopilot.mode_name == "AUTO.LAND"


def test_a_closed_vehicle_link_ends_the_flight_with_what_to_do() -> None:
    bench = Bench()
    bench.connections["vehicle"].closed = True
    with pytest.raises(UavctlError, match="closed by the other side"):
        bench.fly()
    assert not bench.memory.of(Decision)
