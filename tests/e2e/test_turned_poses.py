"""Poses that are right in place and wrong in attitude, relayed to a vehicle that has its heading from them alone."""

from __future__ import annotations

import math

import pytest
from loopback_rig import MemorySink
from turned_poses_rig import TurnedPosesFlight

from uavctl.event_codes import EventCode
from uavctl.mavlink.handover_states import HandoverState
from uavctl.records import Event

pytestmark = pytest.mark.long
BOTH = pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])


# The heading does not matter to the linear plant, which is always level: it flies once for each way to be wrong.
QUADROTORS = (("px4", "quadrotor"), ("ardupilot", "quadrotor"))
FLIPS = (
    ("yaw-180", "turned", 0.0),
    ("yaw-90", "turned", 0.0),
    ("yaw-180", "turned", 0.4),
    ("roll-180", "tilted", 0.0),
    ("pitch-90", "tilted", 0.0),
)


def find_attitude_events(memory: MemorySink) -> list[tuple[str, str]]:
    codes = (EventCode.RELAY_ATTITUDE, EventCode.RELAY_ATTITUDE_RIGHT)
    return [(event.code, event.subject) for event in memory.of(Event) if event.code in codes]


@pytest.mark.fault(99)
@pytest.mark.parametrize(
    ("turn", "subject", "every_s", "autopilot", "plant"),
    [(*flip, *world) for flip in FLIPS for world in QUADROTORS]
    + [("yaw-180", "turned", 0.0, "px4", "linear"), ("roll-180", "tilted", 0.0, "ardupilot", "linear")],
)
def test_a_flip_of_some_seconds_is_kept_from_the_vehicle_and_flown_through(
    turn: str, subject: str, every_s: float, autopilot: str, plant: str
) -> None:
    flight = TurnedPosesFlight(autopilot, turn, begin_s=4.0, wrong_s=3.0, every_s=every_s, plant=plant).fly(20.0)
    assert flight.wrong_sent == 0 and flight.error_rad < math.radians(10.0)
    assert find_attitude_events(flight.memory) == [
        (EventCode.RELAY_ATTITUDE, subject),
        (EventCode.RELAY_ATTITUDE_RIGHT, ""),
    ]
    assert {event.code for event in flight.notices} >= {EventCode.RELAY_ATTITUDE, EventCode.RELAY_ATTITUDE_RIGHT}
    assert flight.is_in(HandoverState.ENGAGED) and flight.distance_m < 0.2 and flight.outside_m < 0.0


@pytest.mark.fault(99)
@pytest.mark.parametrize(
    ("turn", "autopilot", "plant"),
    [(turn, *world) for turn in ("yaw-180", "creep", "roll-180") for world in QUADROTORS]
    + [("yaw-180", "ardupilot", "linear"), ("roll-180", "px4", "linear")],
)
def test_an_attitude_that_stays_wrong_ends_on_the_floor_inside(turn: str, autopilot: str, plant: str) -> None:
    flight = TurnedPosesFlight(autopilot, turn, begin_s=4.0, wrong_s=300.0, plant=plant).fly(60.0)
    assert flight.wrong_sent == 0 and flight.error_rad < math.radians(20.0)
    assert [code for code, _ in find_attitude_events(flight.memory)] == [EventCode.RELAY_ATTITUDE]
    assert flight.outside_m < 0.0 and not flight.peers.autopilot.pilot.is_armed


@pytest.mark.fault(99)
@BOTH
@pytest.mark.parametrize("turn", ["yaw-90", "yaw-180"])
def test_a_heading_that_is_wrong_from_the_first_pose_on_ends_on_the_floor_inside(autopilot: str, turn: str) -> None:
    """Nothing shows it before the vehicle moves; turned by 180°, its own position control drives it away."""
    flight = TurnedPosesFlight(autopilot, turn, begin_s=None, wrong_s=300.0).fly(50.0)
    assert flight.wrong_sent > 0 and flight.error_rad > math.radians(40.0)
    assert flight.outside_m < 0.0 and not flight.peers.autopilot.pilot.is_armed


@BOTH
def test_a_right_attitude_is_never_kept_back(autopilot: str) -> None:
    flight = TurnedPosesFlight(autopilot, "right", "sim.wind.gust_wind_mps=3.0", begin_s=0.0, wrong_s=0.0).fly(40.0)
    stats = flight.loop.relay
    assert stats is not None and not stats.kept.keys() & {"turned", "tilted"}
    assert find_attitude_events(flight.memory) == []
