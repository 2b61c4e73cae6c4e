"""The landing request of a flight whose control has failed: when it is sent, and what ends it."""

from __future__ import annotations

from itertools import pairwise

import pytest
from mavlink_rig import OFFBOARD, Peer
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from sim_rig import decode

from uavctl.config.connections import HandOverConfig
from uavctl.mavlink.landing import LandingRequest

SECOND = 1_000_000_000
CONFIG = HandOverConfig()
ARMED, DISARMED = 129, 1
POSITION_CONTROL, LAND = 3 << 16, 4 << 16 | 6 << 24


def begin_request() -> LandingRequest:
    request = LandingRequest((245, 191), CONFIG)
    request.prepare((1, 1), "px4")
    request.begin(0)
    return request


def acknowledge(result: int) -> bytes:
    message = mavlink.MAVLink_command_ack_message(mavlink.MAV_CMD_NAV_LAND, result)
    return bytes(message.pack(mavlink.MAVLink(None, 1, 1)))


@pytest.mark.fault(88)
def test_it_is_repeated_with_a_heartbeat_until_its_time_is_over() -> None:
    request = begin_request()
    sent = {at_ns: request.due(at_ns) for at_ns in range(0, round(CONFIG.land_s * SECOND) + SECOND, SECOND // 10)}
    times = [at_ns for at_ns, frames in sent.items() if frames]
    assert times[0] == 0 and {b - a for a, b in pairwise(times)} == {CONFIG.answer_s * SECOND}
    assert times[-1] < CONFIG.land_s * SECOND and not request.is_pending
    types = [message.get_type() for frame in sent[0] for message in decode(frame)]
    assert types == ["HEARTBEAT", "COMMAND_LONG"]


@pytest.mark.fault(88)
@pytest.mark.parametrize(
    ("data", "is_answer"),
    [
        (acknowledge(mavlink.MAV_RESULT_ACCEPTED), True),
        (acknowledge(mavlink.MAV_RESULT_TEMPORARILY_REJECTED), False),
        (Peer().heartbeat(LAND, ARMED), True),
        (Peer().heartbeat(POSITION_CONTROL, ARMED), True),  # the pilot has taken over
        (Peer().heartbeat(OFFBOARD, DISARMED), True),
        (Peer().heartbeat(OFFBOARD, ARMED), False),
        (Peer(9, 1).heartbeat(LAND, ARMED), False),  # another vehicle
        (b"noise", False),
    ],
)
def test_the_vehicle_s_answer_ends_it(data: bytes, is_answer: bool) -> None:
    request = begin_request()
    request.receive(data)
    assert request.is_pending is not is_answer
    assert bool(request.due(0)) is not is_answer
    request.begin(SECOND)
    assert request.is_pending is not is_answer  # begun once


@pytest.mark.fault(88)
def test_without_a_vehicle_nothing_is_sent() -> None:
    request = LandingRequest((245, 191), CONFIG)
    request.begin(0)
    assert not request.is_pending and not request.due(0)
