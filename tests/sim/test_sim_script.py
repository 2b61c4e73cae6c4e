"""A flight with everything given: the vehicle moves by the recursion itself, the channel does what it is told."""

from __future__ import annotations

import numpy as np
import pytest

from sim.simulation import MOCAP, Peers
from sim.vehicle.linear import Script, ScriptedChannel
from uavctl.config import load_config
from uavctl.records import Truth

SECOND_NS = 1_000_000_000


def test_the_channel_loses_and_delays_what_it_is_told() -> None:
    channel = ScriptedChannel((0, None, 25, 10))
    for number in range(6):
        channel.push(10 * number, bytes([number]))
    assert channel.next_ns == 0
    assert channel.pop_due(30) == [(0, b"\x00")]
    assert channel.pop_due(100) == [(40, b"\x03"), (45, b"\x02")]
    assert channel.next_ns is None
    assert (channel.counters.sent, channel.counters.lost) == (6, 3)  # the last two are beyond what was told


def test_a_certain_packet_is_never_lost_but_may_be_late() -> None:
    channel = ScriptedChannel((None, 7))
    channel.push(0, b"a", certain=True)
    channel.push(1, b"b", certain=True)
    assert channel.pop_due(100) == [(0, b"a"), (8, b"b")]


def test_the_vehicle_is_the_scripts_plant_from_its_start_under_its_disturbances() -> None:
    config = load_config("paper", ["link.loss=0.9"])
    true = load_config("paper", ["plant.a=[[1,0.7,0,0],[0,0.5,0,0],[0,0,1,0.8],[0,0,0,0.6]]"]).plant
    w = np.random.default_rng(8).normal(size=(6, 2))
    start = np.array([3.0, -1.0, 2.0, 0.5])
    truths: list[Truth] = []
    peers = Peers(config, 0, on_truth=truths.append, script=Script(true, start, w, (0, None, SECOND_NS)))
    arrived = [at_ns // SECOND_NS for at_ns, link, _ in peers.advance(8 * SECOND_NS) if link == MOCAP]
    peers.flush()
    a, e = np.array(true.a), np.array(true.e)
    states = [start]
    for k in range(8):
        states.append(a @ states[-1] + e @ (w[k] if k < 6 else np.zeros(2)))  # none after the last one
    assert np.array([truth.state for truth in truths]) == pytest.approx(np.array(states), abs=1e-12)
    assert arrived == [0, 3]
    assert truths[-1].lost == 7
