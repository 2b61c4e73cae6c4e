"""How a flight begins."""

from __future__ import annotations

import pytest

from sim.peers import MOCAP, Peers
from uavctl.config import load_config


@pytest.mark.parametrize("airborne", [True, False])
def test_a_flight_that_begins_in_the_air_begins_with_a_known_position(airborne: bool) -> None:
    # a(0) = 0, as in the paper; all later positions are lost, and so is the first one of a start on the ground.
    config = load_config("paper", ["link.blackout=[[0.0, 100.0]]"])
    peers = Peers(config, 0, airborne=airborne)
    arrived = [at_ns for at_ns, link, _ in peers.advance(20_000_000_000) if link == MOCAP]
    assert arrived == ([0] if airborne else [])
    assert peers.channel.counters.lost == 21 - airborne
