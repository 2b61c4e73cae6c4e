"""How a flight begins."""

from __future__ import annotations

import pytest
from sim_rig import Client, decode

from sim.simulation import MOCAP, VEHICLE, Peers
from uavctl.arrays import SECOND_NS
from uavctl.config import load_config


@pytest.mark.parametrize("airborne", [True, False])
def test_a_flight_that_begins_in_the_air_begins_with_a_known_position(airborne: bool) -> None:
    # a(0) = 0, as in the paper; all later positions are lost, and so is the first one of a start on the ground.
    config = load_config("paper", ["link.blackout=[[0.0, 100.0]]"])
    peers = Peers(config, 0, airborne=airborne)
    arrived = [at_ns for at_ns, link, _ in peers.advance(20_000_000_000) if link == MOCAP]
    assert arrived == ([0] if airborne else [])
    assert peers.channel.counters.lost == 21 - airborne


def test_nothing_that_is_sent_reaches_the_vehicle_in_an_uplink_blackout_and_what_it_says_goes_on() -> None:
    config = load_config("room-hahn-stursberg", ["link.uplink_blackout=[[1.0, 2.0]]", "sim.autopilot=ardupilot"])
    peers, client = Peers(config, 3 * SECOND_NS), Client()
    answered: list[int] = []
    told: list[int] = []
    for tenth in range(30):
        at_ns = 3 * SECOND_NS + tenth * SECOND_NS // 10
        peers.receive(VEHICLE, client.timesync(tenth + 1), at_ns)
        kinds = [msg for _, link, data in peers.advance(at_ns + 1) if link == VEHICLE for msg in decode(data)]
        answered += [msg.ts1 - 1 for msg in kinds if msg.get_type() == "TIMESYNC"]
        told += [tenth for msg in kinds if msg.get_type() == "HEARTBEAT"]
    assert answered == [*range(10), *range(21, 30)]
    assert any(10 <= tenth <= 20 for tenth in told)
