"""The daemon's cycle on a clock and connections of our own: no sleep, no socket."""

from __future__ import annotations

from collections.abc import Mapping

import pytest
from loopback_rig import Memory, make_loop

from sim.peers import Peers
from uavctl.clock import Ticker
from uavctl.config import load_config
from uavctl.daemon import fly
from uavctl.data import ControlMode, Decision, Setpoint, Timing
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
        self.oversleep: dict[int, int] = {}  # deadline -> how much later the sleep ends

    def wait(self, connections: Mapping[str, Connection], deadline_ns: int) -> list[str]:
        del connections
        self.now_ns = max(self.now_ns, deadline_ns) + self.oversleep.pop(deadline_ns, 0)
        if self.now_ns >= self.peers.now_ns:
            for at_ns, link, data in self.peers.advance(self.now_ns):
                self.arrived[link].append((data, at_ns))
        return [name for name, waiting in self.arrived.items() if waiting]

    def fly(self, *, stop_at_s: float = 1e9, duration_s: float | None = None, stop_limit_s: float = 12.0) -> None:
        fly(
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

    def fileno(self) -> int:
        return -1

    def receive(self) -> list[tuple[bytes, int]]:
        taken, self._bench.arrived[self._name] = self._bench.arrived[self._name], []
        return taken

    def answer(self, index: int) -> None:
        self.answered.append(index)

    def send(self, data: bytes) -> None:
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


def test_row_21_an_oversleeping_loop_counts_what_it_missed_and_sends_no_burst() -> None:
    bench = Bench()
    bench.oversleep[DT_NS + 40 * TICK_NS] = 7 * TICK_NS + 3_000_000
    bench.fly(duration_s=4.0)
    missed = {d.tick: d.missed_ticks for d in bench.memory.of(Decision) if d.missed_ticks}
    # Tick 40 itself runs late; tick 47 is the newest that is due then, and 41 to 46 are gone.
    assert missed == {47: 6}
    late = {t.tick: t.lateness_ns for t in bench.memory.of(Timing) if t.lateness_ns}
    assert late == {40: 7 * TICK_NS + 3_000_000, 47: 3_000_000}
    times = [s.at_ns for s in bench.memory.of(Setpoint)]
    assert len(times) == len(set(times))


def test_row_34_a_stop_in_flight_brakes_then_lands() -> None:
    bench = Bench()
    bench.fly(stop_at_s=2.5)
    modes = [d.mode for d in bench.memory.of(Decision)]
    begun = next(i for i, m in enumerate(modes) if m is ControlMode.BRAKE)
    kinds = list(dict.fromkeys(modes[begun:]))
    assert kinds[:3] == [ControlMode.BRAKE, ControlMode.HOLD, ControlMode.LAND]
    assert bench.peers.autopilot.mode_name == "AUTO.LAND"


def test_the_hand_over_is_cut_off_after_its_limit() -> None:
    bench = Bench("fallback.brake_gain_1ps=0.001", "fallback.brake_s=100.0")
    bench.fly(stop_at_s=2.5, stop_limit_s=3.0)
    assert 5.4 * SECOND <= bench.now_ns <= 5.7 * SECOND


def test_a_closed_vehicle_link_ends_the_flight_with_what_to_do() -> None:
    bench = Bench()
    bench.connections["vehicle"].closed = True
    with pytest.raises(UavctlError, match="closed by the other side"):
        bench.fly()
    assert not bench.memory.of(Decision)
