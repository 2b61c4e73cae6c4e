"""The daemon's cycle on a clock and connections of our own: no sleep, no socket."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise

import pytest
from daemon_rig import DT_NS, SECOND, TICK_NS, DaemonRig
from loopback_rig import make_loop
from mavlink_rig import OFFBOARD, Peer
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from sim_rig import decode

from logs.recording.replay import replay
from uavctl.errors import UavctlError
from uavctl.io.base import Connection
from uavctl.records import ControlMode, Datagram, Decision, Event, LinkStats, Outgoing, Refused, Send, Ticked, Timing


def test_it_flies_records_its_timing_and_hands_over_at_the_end() -> None:
    bench = DaemonRig()
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


def answers(bench: DaemonRig) -> list[tuple[int, int, int]]:
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
    bench = DaemonRig('solver.method="exact"')
    times = [SECOND + n * 17_000_000 + 123 for n in range(100)]
    bench.arrives = [(at_ns, timesync(-n - 1)) for n, at_ns in enumerate(times)]
    bench.fly(duration_s=3.0)
    assert answers(bench) == [(at_ns, at_ns, -n - 1) for n, at_ns in enumerate(times)]
    assert set(times) <= set(bench.connections["vehicle"].sent)  # on the wire, too, in the moment of arrival
    result = replay(iter(bench.memory.entries), lambda sink: make_loop(bench.config, sink))
    assert result.identical, result.first_difference


@pytest.mark.slow
def test_a_flood_of_such_questions_is_answered_in_part_and_costs_no_tick() -> None:
    calm, flooded = DaemonRig(), DaemonRig()
    calm.fly(duration_s=2.0)
    flooded.arrives = [(SECOND + n * 500_000, timesync(-n - 1)) for n in range(2000)]
    flooded.fly(duration_s=2.0)
    assert 100 < len(answers(flooded)) <= 8 * 21
    assert flooded.memory.of(Decision) == calm.memory.of(Decision)
    assert flooded.memory.of(LinkStats)[-2].bad["timesync-flood"] > 1500


def test_words_of_the_vehicle_are_told_a_person_as_they_come_and_once() -> None:
    bench = DaemonRig('solver.method="exact"')
    at_ns = SECOND + 17_000_123
    bench.arrives = [(at_ns, Peer(1, 1).send("statustext", 2, b"PreArm: no"))]
    bench.fly(duration_s=1.5, stop_limit_s=0.0)
    ((text, told_ns),) = bench.told
    assert "PreArm: no" in text and told_ns == at_ns


def test_a_connection_that_is_lost_is_told_a_person() -> None:
    bench = DaemonRig('solver.method="exact"')
    bench.connections["vehicle"].refused["hung-up"] += 1
    bench.connections["mocap"].refused["went-silent"] += 1
    bench.connections["mocap"].refused["not-listed"] += 1  # counted, and no word for the console
    bench.fly(duration_s=1.5, stop_limit_s=0.0)
    assert [text.partition(":")[0] for text, _ in bench.told] == ["link vehicle", "link mocap"]


@pytest.mark.fault(21)
def test_row_21_an_oversleeping_loop_counts_what_it_missed_and_sends_no_burst() -> None:
    bench = DaemonRig()
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
    bench = DaemonRig()
    assert bench.fly(stop_at_s=2.5)
    modes = [d.mode for d in bench.memory.of(Decision)]
    begun = next(i for i, m in enumerate(modes) if m is ControlMode.BRAKE)
    kinds = list(dict.fromkeys(modes[begun:]))
    assert kinds[:3] == [ControlMode.BRAKE, ControlMode.HOLD, ControlMode.LAND]
    assert bench.peers.autopilot.mode_name == "AUTO.LAND"


def test_the_hand_over_is_cut_off_after_its_limit() -> None:
    bench = DaemonRig("fallback.brake_gain_1ps=0.001", "fallback.brake_s=100.0")
    assert bench.fly(stop_at_s=2.5, stop_limit_s=3.0)
    assert 5.4 * SECOND <= bench.now_ns <= 5.7 * SECOND


def test_an_end_that_nobody_asked_for_is_told_apart() -> None:
    bench = DaemonRig("sim.camera.occluded=[[1.5,99.0]]", "fallback.hold_s=0.5")
    assert bench.fly(duration_s=60.0) is False
    assert bench.now_ns < 30 * SECOND and bench.peers.autopilot.mode_name == "AUTO.LAND"


def test_a_closed_vehicle_link_ends_the_flight_with_what_to_do() -> None:
    bench = DaemonRig()
    bench.connections["vehicle"].closed = True
    with pytest.raises(UavctlError, match="closed the connection"):
        bench.fly()
    assert not bench.memory.of(Decision)


ON_HOLD = (4 << 16) | (3 << 24)


def setpoint_times(bench: DaemonRig) -> list[int]:
    """When setpoints went out on the wire."""
    return [at_ns for at_ns, name in bench.connections["vehicle"].words if name == "SET_POSITION_TARGET_LOCAL_NED"]


class Stalled(DaemonRig):
    """The daemon stands still from the third second on; meanwhile the vehicle speaks, and the pilot takes over.

    Args:
        stall_ticks: how long.
        room: what the system keeps; the newest is dropped.
        in_step: it stands still between its last look and its setpoint.
    """

    def __init__(self, stall_ticks: int = 20, room: int = 10**6, *, in_step: bool = False) -> None:
        super().__init__('solver.method="exact"')
        self.stall_ns, self.room = stall_ticks * TICK_NS, room
        self.woke_ns, self.silent_from_ns = 0, 3 * SECOND
        self._in_step = in_step
        if in_step:
            self._tick, self.loop.tick = self.loop.tick, self.stalling_tick  # type: ignore[method-assign]

    def stalling_tick(
        self, tick: int, at_ns: int, send: Send, missed_ticks: int = 0, stop: bool = False, core_error: str = ""
    ) -> Ticked:
        def late(message: Outgoing) -> None:
            if not self.woke_ns and at_ns >= self.silent_from_ns and len(message.data) > 50:
                self.stall()
            send(message)

        return self._tick(tick, at_ns, late, missed_ticks, stop, core_error)

    def stall(self) -> None:
        begun_ns = self.now_ns
        self.now_ns = self.woke_ns = begun_ns + self.stall_ns
        self.peers.advance(self.now_ns)  # deaf: what the vehicle says is ours
        vehicle = Peer(1, 1)
        backlog = []
        for at_ns in range(begun_ns, self.now_ns, SECOND // 600):
            mode = OFFBOARD if at_ns < begun_ns + self.stall_ns // 2 else ON_HOLD
            beat = (at_ns - begun_ns) // (SECOND // 600) % 100 == 99  # six a second, as if it were many seconds
            backlog.append(vehicle.heartbeat(mode) if beat else vehicle.send("attitude", 1, *[0.0] * 6))
        kept = backlog[: self.room]
        self.connections["vehicle"].dropped += len(backlog) - len(kept)
        self.arrived["vehicle"] = [(data, self.now_ns) for data in kept]

    def wait(self, connections: Mapping[str, Connection], deadline_ns: int) -> list[str]:
        if not self._in_step and not self.woke_ns and self.now_ns >= self.silent_from_ns:
            self.stall()
            return ["vehicle"]
        if not self.woke_ns:
            return super().wait(connections, deadline_ns)
        self.now_ns = max(self.now_ns, deadline_ns)
        return [name for name, waiting in self.arrived.items() if waiting]


@pytest.mark.slow
@pytest.mark.parametrize("in_step", [False, True])
@pytest.mark.parametrize("stall_ticks", [6, 20, 50])
@pytest.mark.fault(49)
def test_after_a_stall_no_setpoint_goes_to_a_vehicle_that_the_pilot_has(stall_ticks: int, in_step: bool) -> None:
    bench = Stalled(stall_ticks, in_step=in_step)
    bench.fly(duration_s=8.0, stop_limit_s=0.0)
    times = setpoint_times(bench)
    assert bench.woke_ns and len(times) > 20 and max(times) < bench.woke_ns
    assert bench.connections["vehicle"].dropped == 0
    told = [event.text for event in bench.memory.of(Event) if event.code == "hand-over"]
    assert "released" in told[-1]
    withheld = sum(one.counts.get("withheld", 0) for one in bench.memory.of(Refused))
    assert (withheld > 0) == in_step
    result = replay(iter(bench.memory.entries), lambda sink: make_loop(bench.config, sink))
    assert result.identical, result.first_difference


@pytest.mark.fault(50)
def test_where_the_system_kept_the_oldest_words_only_nothing_goes_out_until_the_vehicle_is_heard() -> None:
    bench = Stalled(50, room=550)  # of 1500: the take-over came later
    bench.fly(duration_s=8.0, stop_limit_s=0.0)
    assert bench.connections["vehicle"].dropped > 900
    assert max(setpoint_times(bench)) < bench.woke_ns
    assert sum(one.counts.get("overrun", 0) for one in bench.memory.of(Refused)) > 900
    result = replay(iter(bench.memory.entries), lambda sink: make_loop(bench.config, sink))
    assert result.identical, result.first_difference


@pytest.mark.fault(50)
def test_a_backlog_that_is_never_read_to_its_end_lets_nothing_out() -> None:
    bench = DaemonRig()
    bench.connections["vehicle"].has_unread = True
    bench.fly(duration_s=3.0, stop_limit_s=0.0)
    assert {name for _, name in bench.connections["vehicle"].words} <= {"TIMESYNC"}  # answers alone
    assert sum(one.counts.get("withheld", 0) for one in bench.memory.of(Refused)) > 20
    assert len(bench.memory.of(Decision)) > 50  # it ticks on, and would end if it were asked to


def test_how_long_a_controller_of_another_package_takes_is_judged_and_a_replay_is_told() -> None:
    bench = DaemonRig('smpc.controller="outside_controllers:Regulates"')
    watch_ns = 0

    def stopwatch() -> int:  # each tick's two looks at it are a tick and a millisecond apart from two seconds on
        nonlocal watch_ns
        watch_ns += TICK_NS + 1_000_000 if bench.now_ns > 2 * SECOND else 0
        return watch_ns

    bench.loop._stopwatch = stopwatch
    bench.fly(duration_s=6.0)
    told = [event.text for event in bench.memory.of(Event) if event.code == "controller-fault"]
    assert len(told) == 1 and "3 times in a row" in told[0]
    assert bench.peers.autopilot.mode_name == "AUTO.LAND"
    result = replay(iter(bench.memory.entries), lambda sink: make_loop(bench.config, sink))
    assert result.identical, result.first_difference
