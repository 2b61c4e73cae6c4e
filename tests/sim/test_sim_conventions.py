"""How each autopilot fills in what it tells: masks, states, indices and texts as in the recorded flights."""

import math
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from recorded_rig import packets
from sim_rig import ARM, LAND, SET_MODE, TAKE_OFF, SimRig, decode, make_rig, read_heartbeat

from sim.autopilot.parameters import TABLES
from uavctl.arrays import SECOND_NS

GUIDED, OFFBOARD, HOLD, BRAKE = (1, 4, 0), (1, 6, 0), (1, 4, 3), (1, 17, 0)
RADIO, FENCE = 1 << 16, 1 << 20  # MAV_SYS_STATUS_SENSOR_RC_RECEIVER, MAV_SYS_STATUS_GEOFENCE
STICK = 'sim.fault=[{at_s=50.0, kind="mode", name="POSCTL"}]'
BOTH = pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])


def target(one: SimRig, seconds: float = 1.0) -> Any:
    """The last one told; it goes out every second."""
    one.wait(seconds)
    return one.of("POSITION_TARGET_LOCAL_NED")[-1]


def test_px4_tells_its_target_always_and_what_is_not_set_is_no_number() -> None:
    one = make_rig("px4", airborne=False)
    told = target(one)
    assert (told.type_mask, told.afz) == (63, 100.0) and math.isnan(told.x) and math.isnan(told.vx)
    one = make_rig("px4")
    one.stream(1.5, 0.5, 0.0, 0.0)
    told = target(one, 0.0)
    assert (told.type_mask, told.afx) == (63, 0.5) and math.isnan(told.vx)
    one.send(one.client.velocity(0.25, 0.0, 0.0))
    told = target(one, 0.6)
    assert (told.type_mask, told.vx) == (7, 0.25) and math.isnan(told.x)
    assert one.ask(SET_MODE, *HOLD) == 0
    told = target(one)
    assert told.type_mask == 0
    assert told.z == pytest.approx(-1.5, abs=0.1)


def test_ardupilot_tells_its_target_when_guided_and_what_is_not_set_is_zero() -> None:
    one = make_rig("ardupilot", airborne=False)
    one.wait(2.0)
    assert one.of("POSITION_TARGET_LOCAL_NED") == []
    assert one.ask(SET_MODE, *GUIDED) == 0
    assert target(one).type_mask == 3079
    assert one.ask(ARM, 1) == 0
    assert target(one).type_mask == 3576
    assert one.ask(TAKE_OFF, *[0.0] * 6, 3.0) == 0
    assert target(one).type_mask == 3576
    one.wait(15.0)
    assert target(one).type_mask == 3079  # holds
    one.peers.autopilot.parameters.set("GUID_TIMEOUT", 3.0)
    one.send(one.client.setpoint(0.5, 0.0, 0.0))
    told = target(one)
    assert (told.type_mask, told.afx, told.x, told.vx) == (3135, 0.5, 0.0, 0.0)
    one.send(one.client.position(1.0, 0.0, -3.0))
    assert target(one).type_mask == 3576
    count = len(one.of("POSITION_TARGET_LOCAL_NED"))
    assert one.ask(SET_MODE, *BRAKE) == 0
    one.wait(3.0)
    assert len(one.of("POSITION_TARGET_LOCAL_NED")) == count


def test_px4_asks_for_the_time_ten_times_a_second_and_ardupilot_does_not() -> None:
    one = make_rig("px4")
    one.wait(0.95)
    asked = [(at_ns, msg) for at_ns, msg in one.seen if msg.get_type() == "TIMESYNC"]
    assert [(msg.tc1, msg.ts1) for _, msg in asked] == [(0, at_ns + 20 * SECOND_NS) for at_ns, _ in asked]
    assert len(asked) == 10
    assert one.send(one.client.timesync(5, tc1=7)) == []  # the answer needs none
    one = make_rig("ardupilot")
    one.wait(1.0)
    assert one.of("TIMESYNC") == []


def test_armed_on_the_floor_px4_is_active_and_ardupilot_stands_by() -> None:
    for autopilot, status in (("px4", 4), ("ardupilot", 3)):
        one = make_rig(autopilot, airborne=False)
        assert read_heartbeat(one).system_status == 3
        assert one.ask(ARM, 1) == 0
        assert read_heartbeat(one).system_status == status


@BOTH
def test_the_landed_state_says_what_kind_of_vehicle_it_is_and_the_estimate_that_it_is_good(autopilot: str) -> None:
    one = make_rig(autopilot)
    one.wait(1.0)
    ardupilot = autopilot == "ardupilot"
    assert one.of("EXTENDED_SYS_STATE")[-1].vtol_state == (3 if ardupilot else 0)
    assert one.peers.autopilot.estimator.flags == (0x33F if ardupilot else 0x37F)
    told = one.of("EKF_STATUS_REPORT" if ardupilot else "ESTIMATOR_STATUS")[-1]
    assert told.flags == one.peers.autopilot.estimator.flags


@BOTH
def test_a_changed_parameter_is_told_with_its_index_by_px4_alone(autopilot: str) -> None:
    one = make_rig(autopilot)
    name = {"px4": "COM_OF_LOSS_T", "ardupilot": "GUID_TIMEOUT"}[autopilot]
    (told,) = one.send(one.client.pack(mavlink.MAVLink_param_set_message(1, 1, name.encode(), 2.0, 9)))
    assert (told.param_id, told.param_value) == (name, 2.0)
    assert told.param_index == (sorted(TABLES["px4"]).index(name) if autopilot == "px4" else 65535)


@pytest.mark.parametrize(
    ("autopilot", "more", "there"), [("ardupilot", (), True), ("px4", (), False), ("px4", (STICK,), True)]
)
def test_a_client_sees_whether_there_is_a_stick(autopilot: str, more: tuple[str, ...], there: bool) -> None:
    one = make_rig(autopilot, *more)
    one.wait(9.95)
    status = one.of("SYS_STATUS")[-1]
    bits = {
        bool(mask & RADIO)
        for mask in (
            status.onboard_control_sensors_present,
            status.onboard_control_sensors_enabled,
            status.onboard_control_sensors_health,
        )
    }
    assert bits == {there}
    channels = one.of("RC_CHANNELS")
    assert len(channels) == (10 if there else 0)
    # Four sticks at rest, and the switch of modes.
    assert {(told.chancount, told.chan1_raw, told.chan5_raw, told.rssi) for told in channels} <= {(5, 1500, 1000, 254)}
    if autopilot == "px4":
        assert one.peers.autopilot.parameters["COM_RC_IN_MODE"] == (0 if there else 4)


def test_with_a_stick_px4_leaves_the_end_of_the_stream_to_it() -> None:
    for more, mode in (((), "OFFBOARD"), ((STICK,), "POSCTL")):
        one = make_rig("px4", *more)
        one.peers.autopilot.parameters.set("COM_OBL_RC_ACT", 0)
        one.stream(1.0, 0.5, 0.0, 0.0)
        one.wait(5.0)
        assert one.peers.autopilot.mode_name == mode
        one.stream(0.5, 0.5, 0.0, 0.0)
        assert one.peers.autopilot.mode_name == "OFFBOARD"


def test_only_px4_says_that_it_has_landed() -> None:
    for autopilot, says in (("px4", True), ("ardupilot", False)):
        one = make_rig(autopilot)
        assert one.ask(LAND) == 0
        one.wait(8.0)
        assert ("Landing detected" in one.texts) is says
        assert not one.peers.autopilot.pilot.is_armed


@BOTH
def test_a_quadrotor_flown_onto_the_floor_has_landed_and_disarms(autopilot: str) -> None:
    one = make_rig(autopilot, "sim.plant=quadrotor", "sim.start_position_m=[0.0,0.0,-1.0]")
    one.stream(6.0, 0.0, 0.0, 0.5)
    assert one.of("EXTENDED_SYS_STATE")[-1].landed_state == 1
    assert one.peers.read_truth().position_m[2] == pytest.approx(0.0, abs=0.02)
    one.stream(3.0, 0.0, 0.0, -1.0)  # landed: it does not rise again
    assert not one.peers.autopilot.pilot.is_armed
    assert one.peers.read_truth().position_m[2] == 0.0


@pytest.mark.parametrize(
    ("autopilot", "recording"), [("ardupilot", "arducopter-relay-pilot-switches"), ("px4", "px4-sih-false-reboot")]
)
def test_the_fence_that_nobody_set_is_told_as_it_was_recorded(autopilot: str, recording: str) -> None:
    def told(status: Any) -> tuple[bool, ...]:
        masks = ("present", "enabled", "health")
        return tuple(bool(getattr(status, f"onboard_control_sensors_{mask}") & FENCE) for mask in masks)

    real = [msg for packet in packets(recording) for msg in decode(packet.data) if msg.get_type() == "SYS_STATUS"]
    one = make_rig(autopilot)
    one.wait(2.0)
    assert {told(status) for status in one.of("SYS_STATUS")} == {told(status) for status in real}
