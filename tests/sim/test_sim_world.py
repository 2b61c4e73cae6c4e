"""Peers and a scripted controller in lockstep: order, timing, truth, reproducibility."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
from sim_rig import Client, decode

from sim.simulation import MOCAP, VEHICLE, Peers, World
from uavctl.arrays import SECOND_NS
from uavctl.config import load_config
from uavctl.records import Outgoing, Received, Send, Truth, Vec3, discard

MS = 1_000_000


@dataclass
class Scripted:
    """A Flyer that keeps what it gets and sends the acceleration of a script."""

    script: Callable[[int], Vec3 | None] = lambda tick: (0.0, 0.0, 0.0)
    client: Client = field(default_factory=Client)
    got: list[tuple[int | None, int, str, bytes]] = field(default_factory=list)  # (ticks so far, arrival, link, data)
    ticks: list[tuple[int, int]] = field(default_factory=list)
    answer: Callable[[str, bytes], tuple[Outgoing, ...]] = lambda link, data: ()

    def receive(self, link: str, data: bytes, at_ns: int) -> Received:
        self.got.append((len(self.ticks), at_ns, link, data))
        return Received(self.answer(link, data), True, True)

    def tick(self, tick: int, at_ns: int, send: Send) -> None:
        self.ticks.append((tick, at_ns))
        accel = self.script(tick)
        if accel is not None:
            send(Outgoing(link=VEHICLE, data=self.client.setpoint(*accel)))

    def messages(self, link: str) -> list[tuple[int, int, Any]]:
        return [(n or 0, at_ns, msg) for n, at_ns, where, data in self.got if where == link for msg in decode(data)]


def fly(
    name: str, seconds: float, *overrides: str, script: Callable[[int], Vec3 | None] | None = None, start_ns: int = 0
) -> tuple[Scripted, list[Truth], World]:
    flyer = Scripted() if script is None else Scripted(script)
    truths: list[Truth] = []
    world = World(load_config(name, list(overrides)), flyer, truths.append, start_ns=start_ns)
    world.run(seconds)
    return flyer, truths, world


def test_the_first_decision_of_preset_paper_knows_the_first_sample_and_a_heartbeat() -> None:
    flyer, _, _ = fly("paper", 0.1, "link.loss=0")
    assert flyer.ticks == [(0, 0)]
    before_tick_0 = [(at_ns, link, decode(data)[0].get_type()) for n, at_ns, link, data in flyer.got if n == 0]
    assert (0, VEHICLE, "HEARTBEAT") in before_tick_0
    assert (0, MOCAP, "ODOMETRY") in before_tick_0
    (sample,) = [msg for _, _, msg in flyer.messages(MOCAP)]
    assert (sample.x, sample.y, sample.vx, sample.vy) == (35.0, -20.0, -2.0, -4.0)


def test_ticks_lie_on_the_grid_and_see_only_what_has_arrived() -> None:
    flyer, _, _ = fly("room-hahn-stursberg", 4.0, start_ns=3 * SECOND_NS)
    assert flyer.ticks == [(n, 3 * SECOND_NS + n * 50 * MS) for n in range(80)]
    arrivals = [at_ns for _, at_ns, _, _ in flyer.got]
    assert arrivals == sorted(arrivals)
    for ticks_before, at_ns, _, _ in flyer.got:
        grid_ns = 3 * SECOND_NS + (ticks_before or 0) * 50 * MS
        assert grid_ns - 50 * MS < at_ns <= grid_ns


def test_positions_come_late_by_the_channels_delay() -> None:
    flyer, truths, world = fly("room-hahn-stursberg", 20.0)
    samples = flyer.messages(MOCAP)
    for _, at_ns, msg in samples:
        captured_ns = msg.usec * 1000 - 4000 * SECOND_NS
        assert captured_ns % (200 * MS) == 100 * MS
        assert 30 * MS <= at_ns - captured_ns <= 70 * MS
    counters = world.peers.channel.counters
    assert counters.sent == 100
    assert counters.lost == 100 - len(samples) - len(world.peers.channel.pop_due(10**18))  # lost, come, under way
    assert 15 < counters.lost < 45
    assert truths[-1].sent == 99
    assert truths[-1].lost <= counters.lost <= truths[-1].lost + 1


def test_truth_of_a_boundary_is_the_state_there_and_the_input_from_there() -> None:
    inputs = np.random.default_rng(4).uniform(-3, 3, (30, 2))

    def script(tick: int) -> Vec3:
        north, east = inputs[tick // 10] * 0.49429632181478
        return float(np.float32(north)), float(np.float32(east)), 0.0

    _, truths, _ = fly("paper", 30.0, script=script)
    assert [one.at_ns for one in truths] == [k * SECOND_NS for k in range(30)]
    np.testing.assert_allclose([one.input for one in truths], inputs, rtol=1e-6)
    plant = load_config("paper").plant
    a, b, e = (np.array(rows) for rows in (plant.a, plant.b, plant.e))
    x, u = (np.array([getattr(one, field) for one in truths]) for field in ("state", "input"))
    rest = x[1:] - x[:-1] @ a.T - u[:-1] @ b.T
    w = rest[:, [1, 3]]
    # what is left is E w for one w a step
    np.testing.assert_allclose(rest, w @ e.T, rtol=0, atol=1e-10)
    assert 0.3 < float(np.var(w)) < 1.0
    assert truths[0].position_m == (35.0, -20.0, 0.0)
    assert {one.mode for one in truths} == {"OFFBOARD"}


def test_the_truth_of_the_last_boundary_is_told_even_if_the_run_ends_there() -> None:
    _, truths, _ = fly("room-hahn-stursberg", 0.65)
    assert [one.at_ns for one in truths] == [0, 200 * MS, 400 * MS, 600 * MS]
    _, truths, _ = fly("paper", 0.1)
    assert [one.at_ns for one in truths] == [0]


def test_odometry_shows_the_true_state_of_its_capture() -> None:
    flyer, truths, _ = fly("paper", 20.0, "link.loss=0", script=lambda tick: (0.5, -0.5, 0.0))
    samples = [msg for _, _, msg in flyer.messages(MOCAP)]
    assert len(samples) == len(truths) == 20
    for truth, msg in zip(truths, samples, strict=True):
        want = (truth.position_m[0], truth.velocity_mps[0], truth.position_m[1], truth.velocity_mps[1])
        assert (msg.x, msg.vx, msg.y, msg.vy) == tuple(float(np.float32(v)) for v in want)


def test_silence_of_the_controller_is_answered_by_the_vehicle() -> None:
    flyer, truths, _ = fly("room-hahn-stursberg", 4.0, script=lambda tick: (0.5, 0.0, 0.0) if tick < 20 else None)
    # the last setpoint at 0.95 s, the timeout 0.7 s later
    ((at_ns, text),) = [(at, msg.text) for _, at, msg in flyer.messages(VEHICLE) if msg.get_type() == "STATUSTEXT"]
    assert (abs(at_ns - 1650 * MS) < 1000, text) == (True, "Failsafe activated")
    modes = {one.at_ns: one.mode for one in truths}
    assert (modes[1600 * MS], modes[1800 * MS]) == ("OFFBOARD", "AUTO.LOITER")


def test_blackout_and_corruption_reach_the_flyer_as_such() -> None:
    flyer, _, world = fly("paper", 30.0, "link.loss=0", "link.blackout=[[5.0, 9.5]]", "link.corrupt=1.0")
    assert len([1 for *_, link, _ in flyer.got if link == MOCAP]) == 25
    assert world.peers.channel.counters.corrupted == 25
    assert {msg.get_type() for _, _, msg in flyer.messages(MOCAP)} == {"BAD_DATA"}


def test_answers_come_back_on_the_wire_and_the_cameras_listen_to_nothing() -> None:
    class Asking(Scripted):
        def tick(self, tick: int, at_ns: int, send: Send) -> None:
            super().tick(tick, at_ns, discard)
            for link in (VEHICLE, MOCAP):
                send(Outgoing(link=link, data=self.client.timesync(at_ns + 1)))

    flyer = Asking()
    World(load_config("room-hahn-stursberg", ["link.loss=0"]), flyer).run(1.0)
    answers = [(n, at_ns, msg) for n, at_ns, msg in flyer.messages(VEHICLE) if msg.get_type() == "TIMESYNC" and msg.tc1]
    assert [(n, at_ns, msg.ts1, msg.tc1) for n, at_ns, msg in answers] == [
        (n + 1, n * 50 * MS, n * 50 * MS + 1, n * 50 * MS + 20 * SECOND_NS) for n in range(19)
    ]
    assert {msg.get_type() for _, _, msg in flyer.messages(MOCAP)} == {"VISION_POSITION_ESTIMATE"}


def test_equal_urls_are_one_connection() -> None:
    flyer, _, _ = fly("room-hahn-stursberg", 3.0, "daemon.mocap=udpin://0.0.0.0:14540")
    kinds = {msg.get_type() for _, _, msg in flyer.messages(VEHICLE)}
    assert {"HEARTBEAT", "VISION_POSITION_ESTIMATE"} <= kinds
    assert flyer.messages(MOCAP) == []


@pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])
def test_a_seed_gives_the_same_flight_bit_for_bit(autopilot: str) -> None:
    def run(seed: int) -> tuple[Any, ...]:
        noisy = ["link.duplicate=0.1", "link.corrupt=0.05", "link.truncate=0.05", f"sim.seed={seed}"]
        flyer, truths, _ = fly(
            "room-hahn-stursberg",
            20.0,
            f"sim.autopilot={autopilot}",
            *noisy,
            script=lambda tick: (math.sin(tick / 9), 0.3, 0.1) if tick < 300 else None,
        )
        return flyer.got, truths

    assert run(1) == run(1)
    assert run(1)[1] != run(2)[1]


def test_progress_is_told_after_every_step() -> None:
    seen: list[float] = []
    World(load_config("paper"), Scripted(), on_progress=seen.append).run(5.0)
    assert seen == pytest.approx([1.0, 2.0, 3.0, 4.0, 5.0])


@pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])
def test_time_missed_is_caught_up_as_if_nothing_had_been_missed(autopilot: str) -> None:
    config = load_config("room-hahn-stursberg", [f"sim.autopilot={autopilot}"])
    told: tuple[list[Truth], list[Truth]] = ([], [])
    due: tuple[list[Any], list[Any]] = ([], [])
    for steps, truths, got in zip((1, 977), told, due, strict=True):
        peers = Peers(config, 0, on_truth=truths.append)
        peers.receive(VEHICLE, Client().setpoint(1.0, 0.5, 0.0), 1 * MS)
        for n in range(steps):
            got += peers.advance(1 * MS + (n + 1) * 5 * SECOND_NS // steps)
    assert told[0] == told[1]
    assert due[0] == due[1]
    assert len(told[0]) == 26


def test_the_next_event_is_never_later_than_something_due() -> None:
    peers = Peers(load_config("room-hahn-stursberg", ["sim.autopilot=ardupilot"]), 0)
    peers.advance(0)
    for _ in range(2000):
        next_ns = peers.next_ns
        assert next_ns > peers.now_ns
        assert peers.advance(next_ns - 1) == []
        peers.advance(next_ns)
