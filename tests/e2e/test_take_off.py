"""From the ground to the ground in virtual time, both autopilots: the whole way, and what may stop it."""

from __future__ import annotations

import math

import pytest
from loopback_rig import make_loop
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from sim_rig import decode
from take_off_rig import GOAL, TakeOffRig

from logs.recording.replay import replay
from sim.autopilot.profile import SIMULATED, Role
from uavctl.mavlink.handover_states import HandoverState
from uavctl.records import Command, ControlMode, Decision, Event, Order, Setpoint

BOTH = pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])
CRAFT = pytest.mark.parametrize("plant", ["linear", "quadrotor"])
SET_MODE, ARM, TAKE_OFF, LAND = 176, 400, 22, 21
ARDUPILOT_EXTERNAL = {"GPS1_TYPE": 0, "VISO_TYPE": 1, "EK3_SRC1_POSXY": 6, "EK3_SRC1_POSZ": 6, "EK3_SRC1_YAW": 6}


def make_heartbeat(system: int) -> bytes:
    mav = mavlink.MAVLink(None, srcSystem=system, srcComponent=1)
    return bytes(mavlink.MAVLink_heartbeat_message(2, 12, 29, 4 << 16 | 3 << 24, 3, 3).pack(mav))


@pytest.mark.slow
@BOTH
@CRAFT
def test_the_whole_way(autopilot: str, plant: str) -> None:
    flight = TakeOffRig(autopilot, f"sim.plant={plant}").take_off().run(12.0)
    assert flight.is_in(HandoverState.ENGAGED)
    assert math.dist(flight.peers.vehicle.position_m, GOAL) < 0.3
    flight.run(20.0, stop=True, until=HandoverState.DONE)
    assert flight.loop.finished and not flight.loop.failure
    assert not flight.peers.autopilot.pilot.is_armed and flight.peers.autopilot.vehicle.landed
    went = ["ready", "asking for the mode", "arming", "climbing", "engaging", "engaged", "landing", "settling", "done"]
    assert flight.states == went
    wanted = [SET_MODE, ARM, SET_MODE, LAND] if autopilot == "px4" else [SET_MODE, ARM, TAKE_OFF, LAND]
    assert flight.commands() == wanted


@pytest.mark.parametrize("autopilot", [pytest.param("px4", marks=pytest.mark.slow), "ardupilot"])
def test_the_same_flight_replays_identically(autopilot: str) -> None:
    flight = TakeOffRig(autopilot).take_off().run(6.0)
    flight.loop.order(Command(order=Order.GOTO, position_m=(0.0, 0.0, -1.0)))
    flight.run(2.0).run(20.0, stop=True, until=HandoverState.DONE)
    result = replay(flight.memory.entries, lambda sink: make_loop(flight.config, sink))
    assert result.identical, result.first_difference
    assert result.decisions == flight.tick


@BOTH
def test_the_controller_waits_until_the_vehicle_is_handed_over(autopilot: str) -> None:
    flight = TakeOffRig(autopilot).take_off().run(10.0, until=HandoverState.ENGAGED)
    assert {d.mode for d in flight.memory.of(Decision)} == {ControlMode.WAIT}
    assert {s.accel_mps2 for s in flight.memory.of(Setpoint)} == {(0.0, 0.0, 0.0)}


def test_px4_is_flown_before_it_has_climbed_to_its_own_height() -> None:
    flight = TakeOffRig("px4", "sim.plant=quadrotor").take_off(1.0)
    highest_m = 0.0
    for _ in range(160):
        flight.run(0.05)
        highest_m = max(highest_m, -flight.peers.vehicle.position_m[2])
    assert flight.is_in(HandoverState.ENGAGED)
    assert highest_m < 1.8  # MIS_TAKEOFF_ALT is 2.5 m


# What may stop it


@pytest.mark.fault(26)
def test_a_refusal_to_arm_ends_it_with_the_vehicle_s_text() -> None:
    flight = TakeOffRig("px4", "hand_over.ground_s=6.0", "sim.plant=quadrotor", "sim.quadrotor.charge=0.1").take_off()
    flight.run(12.0, until=HandoverState.FAILED)
    assert "low battery" in flight.loop.failure and "TEMPORARILY_REJECTED" in flight.loop.failure
    assert 2 <= flight.commands().count(ARM) <= 6
    assert flight.loop.finished and not flight.peers.autopilot.pilot.is_armed


@pytest.mark.fault(26)
@BOTH
def test_nothing_is_armed_without_fresh_positions(autopilot: str) -> None:
    flight = TakeOffRig(autopilot, "hand_over.ground_s=4.0", "link.blackout=[[0.0, 100.0]]").take_off()
    flight.run(6.0, until=HandoverState.FAILED)
    assert not flight.commands() and "position" in flight.loop.failure


@pytest.mark.fault(16)
def test_a_second_vehicle_on_the_link_refuses_arming() -> None:
    flight = TakeOffRig("px4").run(0.5)
    flight.loop.receive("vehicle", make_heartbeat(9), flight.now_ns)
    flight.run(1.2).take_off().run(1.0)
    assert flight.is_in(HandoverState.FAILED) and "another vehicle" in flight.loop.failure
    assert flight.commands() == []


@pytest.mark.fault(8)
def test_px4_whose_setpoints_do_not_arrive_is_let_go_and_comes_back_by_order_only() -> None:
    flight = TakeOffRig("px4").take_off().run(6.0)
    setpoint = "SET_POSITION_TARGET_LOCAL_NED"
    flight.hears = lambda data: decode(data)[0].get_type() != setpoint
    flight.run(4.0, until=HandoverState.FAILSAFE)
    released_ns = flight.now_ns
    flight.hears = lambda data: True
    flight.run(5.0)
    assert flight.is_in(HandoverState.FAILSAFE) and not flight.setpoints_between(released_ns, flight.now_ns)
    assert flight.commands().count(SET_MODE) == 2  # nothing is asked for
    flight.loop.order(Command(order=Order.ENGAGE))
    flight.run(3.0, until=HandoverState.ENGAGED)
    flight.run(4.0)
    assert flight.is_in(HandoverState.ENGAGED) and math.dist(flight.peers.vehicle.position_m, GOAL) < 0.5


@pytest.mark.fault(25)
@pytest.mark.parametrize(("autopilot", "mode"), [("px4", "POSCTL"), ("ardupilot", "LOITER")])
def test_the_pilot_s_stick_ends_streaming_and_is_never_argued_with(autopilot: str, mode: str) -> None:
    flight = TakeOffRig(autopilot).take_off().run(7.0)
    before = flight.commands()
    flight.stick(mode)
    flight.run(3.0, until=HandoverState.TAKEN_OVER)
    released_ns = flight.now_ns
    flight.run(5.0)
    assert flight.is_in(HandoverState.TAKEN_OVER) and flight.commands() == before
    assert not flight.setpoints_between(released_ns, flight.now_ns)
    flight.run(2.0, stop=True)
    assert flight.loop.finished and flight.commands() == before  # nor asked to land


@pytest.mark.fault(28)
@pytest.mark.parametrize("autopilot", ["px4", pytest.param("ardupilot", marks=pytest.mark.slow)])
def test_the_vehicle_s_own_failsafe_has_precedence(autopilot: str) -> None:
    flight = TakeOffRig(autopilot, "sim.plant=quadrotor").take_off().run(7.0)
    pilot = flight.peers.autopilot.pilot
    pilot.enter_failsafe(SIMULATED[autopilot].get_mode_by_role(Role.LAND), flight.now_ns)
    before = flight.commands()
    flight.run(2.0, until=HandoverState.FAILSAFE)
    flight.run(20.0, until=HandoverState.DONE)
    assert flight.commands() == before and not pilot.is_armed
    assert "failsafe" in flight.loop.failure


@pytest.mark.fault(34)
@BOTH
@pytest.mark.parametrize("state", [HandoverState.ARMING, HandoverState.CLIMBING, HandoverState.ENGAGING])
def test_a_stop_on_the_way_up_lands(autopilot: str, state: HandoverState) -> None:
    flight = TakeOffRig(autopilot).take_off().run(10.0, until=state)
    flight.run(25.0, stop=True, until=HandoverState.DONE)
    assert LAND in flight.commands()
    assert not flight.peers.autopilot.pilot.is_armed and flight.peers.autopilot.vehicle.landed


@pytest.mark.fault(34)
@BOTH
def test_a_stop_before_the_mode_is_given_asks_for_nothing_more(autopilot: str) -> None:
    flight = TakeOffRig(autopilot).take_off().run(10.0, until=HandoverState.MODE)
    flight.run(5.0, stop=True)
    assert flight.loop.finished and flight.commands() == [SET_MODE]


@pytest.mark.fault(26)
def test_a_climb_that_never_ends_is_ended_by_landing() -> None:
    flight = TakeOffRig("ardupilot", "hand_over.climb_s=1.0").take_off()
    flight.run(8.0, until=HandoverState.LANDING)
    flight.run(20.0, until=HandoverState.DONE)
    assert "take-off" in flight.loop.failure and not flight.peers.autopilot.pilot.is_armed


@pytest.mark.fault(20)
def test_a_restarted_vehicle_gets_no_setpoints() -> None:
    flight = TakeOffRig("px4").take_off().run(6.0)
    mav = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    for boot_ms in (100, 150):
        young = bytes(mavlink.MAVLink_local_position_ned_message(boot_ms, 0, 0, 0, 0, 0, 0).pack(mav))
        flight.loop.receive("vehicle", young, flight.now_ns)
    flight.run(0.1)
    assert flight.is_in(HandoverState.TAKEN_OVER) and "vehicle-reboot" in {
        event.code for event in flight.memory.of(Event)
    }


def test_only_an_ardupilot_without_gps_gets_a_global_origin() -> None:
    with_gps = TakeOffRig("ardupilot").take_off().run(4.0)
    assert not with_gps.sent("SET_GPS_GLOBAL_ORIGIN")
    relayed = ["relay.enabled=true", "sim.camera.rate_hz=20.0", "link.loss=0.0"]
    flight = TakeOffRig("ardupilot", *relayed)
    for name, value in ARDUPILOT_EXTERNAL.items():
        flight.peers.autopilot.parameters.set(name, value)
    flight.take_off().run(20.0, until=HandoverState.ENGAGED)  # by the positions that we relay to it
    origins = flight.sent("SET_GPS_GLOBAL_ORIGIN")
    assert len(origins) == 1 and flight.peers.autopilot.estimator.has_origin
    assert (origins[0][1].latitude, origins[0][1].altitude) == (473977420, 488000)


def test_without_an_order_no_global_origin_is_sent() -> None:
    flight = TakeOffRig("ardupilot")
    for name, value in ARDUPILOT_EXTERNAL.items():
        flight.peers.autopilot.parameters.set(name, value)
    flight.run(6.0)
    assert not flight.sent("SET_GPS_GLOBAL_ORIGIN") and flight.commands() == []


def test_a_vehicle_that_sends_little_is_asked_for_its_streams_a_few_times() -> None:
    flight = TakeOffRig("px4")
    flight.told = lambda data: decode(data)[0].get_type() == "HEARTBEAT"
    flight.run(30.0)
    asked = [(m.param1, m.param2) for _, m in flight.sent("COMMAND_LONG") if m.command == 511]
    assert set(asked) == {(32.0, 1e5), (30.0, 1e5), (245.0, 2e5), (1.0, 1e6), (65.0, 2e5)} and len(asked) == 25
    lively = TakeOffRig("px4").run(10.0)
    # It has no remote control, whose channels it could send.
    assert {(m.command, m.param1) for _, m in lively.sent("COMMAND_LONG")} <= {(511, 65.0)}
