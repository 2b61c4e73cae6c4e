"""A vehicle's own fence and its blind descent end a flight that we began, judged on the true vehicle."""

from __future__ import annotations

import pytest
from take_off_rig import RELAYED, SECOND, TakeOffRig

from uavctl.cause import Cause
from uavctl.mavlink.handover_states import HandoverState
from uavctl.records import Command, Order

GOAL = "mission.waypoints=[[0.5,0.0,-2.4]]"
LAND = 21  # MAV_CMD_NAV_LAND
# Parameters of a fence 1.7 m above home, and the mode that each action is to choose.
FENCES = {
    ("ardupilot", "RTL"): {"FENCE_ENABLE": 1, "FENCE_ALT_MAX": 1.7, "FENCE_ACTION": 1},
    ("ardupilot", "LAND"): {"FENCE_ENABLE": 1, "FENCE_ALT_MAX": 1.7, "FENCE_ACTION": 2},
    ("px4", "AUTO.RTL"): {"MIS_TAKEOFF_ALT": 1.2, "GF_MAX_VER_DIST": 1.7, "GF_ACTION": 3},
    ("px4", "AUTO.LAND"): {"MIS_TAKEOFF_ALT": 1.2, "GF_MAX_VER_DIST": 1.7, "GF_ACTION": 5},
    ("px4", "AUTO.LOITER"): {"MIS_TAKEOFF_ALT": 1.2, "GF_MAX_VER_DIST": 1.7, "GF_ACTION": 2},
}


def start_flight(autopilot: str, *more: str, **parameters: float) -> TakeOffRig:
    flight = TakeOffRig(autopilot, *RELAYED, *more).relayed()
    for name, value in parameters.items():
        assert flight.peers.autopilot.parameters.set(name, value)
    return flight.take_off().run(40.0, until=HandoverState.ENGAGED)


def fly_to_ground(flight: TakeOffRig, seconds: float) -> None:
    """The vehicle ends on the ground, disarmed, and the flight is over."""
    flight.run(seconds, until=HandoverState.DONE)
    assert flight.loop.finished
    assert flight.peers.vehicle.position_m[2] == pytest.approx(0.0, abs=0.15)
    assert not flight.peers.autopilot.pilot.is_armed


@pytest.mark.slow
@pytest.mark.parametrize(("autopilot", "mode"), FENCES)
def test_the_vehicle_s_own_fence_ends_the_flight_on_the_ground(autopilot: str, mode: str) -> None:
    flight = start_flight(autopilot, "hand_over.climb_s=15.0", **FENCES[autopilot, mode])
    flight.run(1.0)
    flight.loop.order(Command(order=Order.GOTO, position_m=(1.5, 1.0, -2.0)))
    flight.run(20.0, until=HandoverState.FAILSAFE)
    assert flight.peers.autopilot.mode_name == mode
    assert -flight.peers.vehicle.position_m[2] < 1.7 + 0.5
    taken_ns = flight.now_ns
    fly_to_ground(flight, 60.0)
    assert not flight.setpoints_between(taken_ns, flight.now_ns)
    ending = flight.loop.ending
    assert ending.code in (Cause.VEHICLE_FENCE, Cause.FENCE_LANDED) and ending.exit_code == 1, ending
    orders = flight.commands()[len([0 for at_ns, _ in flight.sent("COMMAND_LONG") if at_ns < taken_ns]) :]
    assert set(orders) <= {LAND}


@pytest.mark.slow
@pytest.mark.parametrize("dark_s", [6.0, 15.0])
def test_px4_s_blind_descent_is_a_failsafe_and_positions_go_on_as_soon_as_they_are_back(dark_s: float) -> None:
    from_s, height_m = 30.0, 2.4
    flight = TakeOffRig("px4", *RELAYED, f"link.blackout=[[{from_s}, {from_s + dark_s}]]", GOAL).relayed()
    flight.peers.autopilot.parameters.set("MIS_TAKEOFF_ALT", height_m)
    flight.take_off(height_m).run(from_s - 1.0, until=HandoverState.ENGAGED)
    descent: list[int] = []
    seen_ns = 0
    while not flight.loop.finished and flight.now_ns < (from_s + 30.0) * SECOND:
        flight.run(0.05)
        if flight.peers.autopilot.mode_name == "AUTO.DESCEND":
            descent.append(flight.now_ns)
        seen_ns = seen_ns or (flight.now_ns if flight.is_in(HandoverState.FAILSAFE, HandoverState.LANDING) else 0)
    assert descent and flight.loop.finished and not flight.peers.autopilot.pilot.is_armed
    assert flight.loop.ending.exit_code == 1, flight.loop.ending
    assert seen_ns - descent[0] < SECOND and not flight.setpoints_between(seen_ns, flight.now_ns)
    back_ns = round((from_s + dark_s) * SECOND)
    poses = [at_ns for at_ns, _ in flight.sent("VISION_POSITION_ESTIMATE") if at_ns > back_ns]
    if descent[-1] > back_ns + SECOND:  # it is still in its failsafe then
        assert flight.loop.ending.code == Cause.FAILSAFE_LANDED
        assert poses[0] - back_ns < SECOND and len([pose for pose in poses if pose < descent[-1]]) > 20
    else:
        assert dark_s > 10.0
