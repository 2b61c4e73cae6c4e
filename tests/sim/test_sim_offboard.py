"""What PX4 takes for a stream of setpoints, and when it takes OFFBOARD."""

import math

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from sim_rig import SET_MODE, make_rig, read_flight_state

from sim.autopilot.setpoints import ParsedSetpoint, SetpointKind

OFFBOARD = (1, 6, 0)


def test_px4_refuses_offboard_without_a_stream_above_2_hz() -> None:
    one = make_rig("px4")
    assert one.ask(SET_MODE, 1, 4, 3) == 0
    assert one.ask(SET_MODE, *OFFBOARD) == 1  # as recorded
    assert one.texts == ["Switching to Offboard is currently not available"]
    one.stream(2.0, 0.0, 0.0, 0.0, period_s=0.5)
    assert one.ask(SET_MODE, *OFFBOARD) == 1  # at 2 Hz it depends on the moment
    one.stream(2.0, 0.0, 0.0, 0.0, period_s=0.49)
    assert one.ask(SET_MODE, *OFFBOARD) == 0  # above it does not
    assert one.peers.autopilot.mode_name == "OFFBOARD"


def test_px4_takes_offboard_right_after_the_first_setpoint_while_it_is_fresh() -> None:
    one = make_rig("px4")
    assert one.ask(SET_MODE, 1, 4, 3) == 0
    one.send(one.client.setpoint(0.0, 0.0, 0.0))
    assert one.ask(SET_MODE, *OFFBOARD) == 0
    assert one.ask(SET_MODE, 1, 4, 3) == 0
    one.peers.autopilot.parameters.set("COM_OF_LOSS_T", 0.2)
    one.wait(0.19)
    assert one.ask(SET_MODE, *OFFBOARD) == 0
    assert one.ask(SET_MODE, 1, 4, 3) == 0
    one.wait(0.011)
    assert one.ask(SET_MODE, *OFFBOARD) == 1
    assert one.peers.autopilot.mode_name == "AUTO.LOITER"


@pytest.mark.parametrize("number", [0.0, math.nan])
def test_a_setpoint_that_sets_nothing_is_told_by_px4_and_counts_for_no_stream(number: float) -> None:
    one = make_rig("px4")
    one.peers.autopilot.parameters.set("COM_OF_LOSS_T", 1.0)
    one.send(one.client.setpoint(1.0, 0.0, 0.0))
    mask = 0xFFF if number == 0.0 else 3135
    one.wait(0.9)
    one.send(one.client.setpoint(number, number, number, mask=mask))
    assert one.texts == ["SET_POSITION_TARGET_LOCAL_NED invalid"]
    assert read_flight_state(one) == (1.0, 0.0, 0.0)
    one.wait(0.1)
    assert one.peers.autopilot.mode_name == "AUTO.LOITER"  # COM_OF_LOSS_T after the one before
    assert one.ask(SET_MODE, *OFFBOARD) == 1


def test_px4_flies_what_is_set_beside_numbers_that_are_none() -> None:
    one = make_rig("px4")
    nothing = math.nan, math.nan, math.nan
    message = mavlink.MAVLink_set_position_target_local_ned_message
    one.send(one.client.pack(message(0, 1, 1, 1, 0xC00, *nothing, *nothing, 0.5, 0.0, 0.0, 0.0, 0.0)))
    assert read_flight_state(one) == (0.5, 0.0, 0.0)
    # A velocity with the force bit, which is about accelerations.
    one.send(one.client.pack(message(0, 1, 1, 1, 0xDC7 | 0x200, *nothing, 1.0, 0.0, 0.0, *nothing, 0.0, 0.0)))
    assert one.peers.autopilot.pilot.dispatch.active_setpoint == ParsedSetpoint(SetpointKind.VELOCITY, (1.0, 0.0, 0.0))
    assert one.texts == []
