"""The simulated autopilots show what was observed of the real ones."""

import math
from itertools import pairwise

import pytest
from sim_rig import ARM, INTERVAL, LAND, SET_MODE, TAKE_OFF, SimRig, make_rig, read_flight_state, read_heartbeat

from uavctl.arrays import SECOND_NS
from uavctl.config import load_config

OFFBOARD = (1, 6, 0)
# Streams


@pytest.mark.parametrize(
    ("autopilot", "number", "base", "custom"), [("px4", 12, 145, 6 << 16), ("ardupilot", 3, 217, 4)]
)
def test_airborne_start_and_telemetry_rates(autopilot: str, number: int, base: int, custom: int) -> None:
    one = make_rig(autopilot)
    one.wait(0.0)
    first = one.of("HEARTBEAT")[0]
    assert (first.autopilot, first.base_mode, first.custom_mode) == (number, base, custom)
    assert (first.type, first.system_status, first.get_srcSystem(), first.get_srcComponent()) == (2, 4, 1, 1)
    one.wait(9.95)
    assert [len(one.of(kind)) for kind in ("HEARTBEAT", "EXTENDED_SYS_STATE", "LOCAL_POSITION_NED")] == [10, 10, 100]
    assert {msg.landed_state for msg in one.of("EXTENDED_SYS_STATE")} == {2}
    positions = one.of("LOCAL_POSITION_NED")
    assert (positions[0].x, positions[0].y, positions[0].z) == (0.0, 0.0, -1.5)
    assert [b.time_boot_ms - a.time_boot_ms for a, b in pairwise(positions)] == [100] * 99
    sequence = [msg.get_seq() for _, msg in one.seen]
    assert sequence == [i % 256 for i in range(len(sequence))]


def test_ground_start_is_disarmed_and_on_the_floor() -> None:
    for autopilot, base, custom in (("px4", 29, 4 << 16 | 3 << 24), ("ardupilot", 81, 0)):
        one = make_rig(autopilot, airborne=False)
        message = read_heartbeat(one)
        assert (message.base_mode, message.custom_mode, message.system_status) == (base, custom, 3)
        assert one.of("EXTENDED_SYS_STATE")[-1].landed_state == 1
        assert one.peers.vehicle.position_m == (0.0, 0.0, 0.0)


def test_timesync_is_answered_in_its_own_clock() -> None:
    one = make_rig("px4")
    one.wait(1.5)
    (answer,) = one.send(one.client.timesync(123_456_789))
    assert (answer.tc1, answer.ts1) == (21_500_000_000, 123_456_789)
    assert one.send(one.client.timesync(5, tc1=7)) == []


def test_a_stream_can_be_asked_for_stopped_and_reset() -> None:
    one = make_rig("ardupilot")

    def in_a_second() -> int:
        before = len(one.of("LOCAL_POSITION_NED"))
        one.wait(1.0)
        return len(one.of("LOCAL_POSITION_NED")) - before

    assert one.ask(INTERVAL, 32, 40_000) == 0
    assert in_a_second() == 25
    assert one.ask(INTERVAL, 32, -1) == 0
    assert in_a_second() == 0
    assert one.ask(INTERVAL, 32, 0) == 0
    assert in_a_second() == 10
    for params in ((250, 1000), (32, math.nan), (math.nan, 0), (32, -2)):
        assert one.ask(INTERVAL, *params) == 4


# Setpoints


@pytest.mark.parametrize("mask", [3135, 2111])
@pytest.mark.parametrize(("autopilot", "frame"), [("px4", 1), ("ardupilot", 1), ("ardupilot", 7)])
def test_acceleration_setpoints_are_flown(autopilot: str, frame: int, mask: int) -> None:
    one = make_rig(autopilot)
    one.send(one.client.setpoint(1.0, -0.5, 0.25, mask=mask, frame=frame))
    assert read_flight_state(one) == (1.0, -0.5, 0.25)
    one.wait(0.5)
    assert read_flight_state(one) == (1.0, -0.5, 0.25)
    assert one.texts == []


@pytest.mark.parametrize("ignored", [0x40, 0x80, 0x100])
@pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])
def test_one_ignored_acceleration_axis_means_stop(autopilot: str, ignored: int) -> None:
    one = make_rig(autopilot, "sim.start_velocity_mps=[1.0,0.0,0.0]")
    one.send(one.client.setpoint(1.0, 1.0, 1.0, mask=3135 | ignored))
    assert read_flight_state(one) == (-2.0, -0.0, -0.0)
    for _ in range(50):
        one.send(one.client.setpoint(1.0, 1.0, 1.0, mask=3135 | ignored))
        one.wait(0.1)
    assert one.speed_mps < 0.01
    assert one.peers.autopilot.mode_name in ("OFFBOARD", "GUIDED")


def test_the_force_bit_is_refused_by_px4_and_dropped_by_ardupilot() -> None:
    one = make_rig("px4")
    one.send(one.client.setpoint(1.0, 0.0, 0.0, mask=3135 | 0x200))
    assert read_flight_state(one) == (0.0, 0.0, 0.0)
    assert one.texts == ["force setpoint not supported"]
    one = make_rig("ardupilot")
    one.send(one.client.setpoint(1.0, 0.0, 0.0, mask=3135 | 0x200))
    assert read_flight_state(one) == (1.0, 0.0, 0.0)
    assert one.texts == []


def test_other_frames_stop_ardupilot_and_are_refused_by_px4() -> None:
    one = make_rig("ardupilot", "sim.start_velocity_mps=[1.0,0.0,0.0]")
    one.send(one.client.setpoint(1.0, 0.0, 0.0, frame=20))
    assert read_flight_state(one)[0] == -2.0
    one = make_rig("px4")
    one.send(one.client.setpoint(1.0, 0.0, 0.0, frame=7))
    assert read_flight_state(one) == (0.0, 0.0, 0.0)
    assert one.texts == ["setpoint refused: frame 7"]


def test_setpoints_for_another_system_are_not_mine() -> None:
    one = make_rig("px4")
    one.send(one.client.setpoint(1.0, 0.0, 0.0, system=2))
    assert read_flight_state(one) == (0.0, 0.0, 0.0)
    one.send(one.client.setpoint(1.0, 0.0, 0.0, system=0))
    assert read_flight_state(one) == (1.0, 0.0, 0.0)


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_setpoint_that_is_no_number_kills_ardupilot_and_stops_px4(value: float) -> None:
    one = make_rig("ardupilot")
    one.send(one.client.setpoint(1.0, value, 0.0))
    assert one.peers.autopilot.mode_name == "CRASHED"
    assert one.peers.autopilot.pilot.crash_reason == "a setpoint was not a number"
    before = len(one.seen)
    one.wait(5.0)
    assert one.send(one.client.timesync(1)) == []
    assert len(one.seen) == before
    assert len(one.positions) > 10  # the cameras live on
    one = make_rig("px4")
    one.send(one.client.setpoint(1.0, value, 0.0))
    assert one.peers.autopilot.mode_name == "OFFBOARD"
    assert read_flight_state(one) == (0.0, 0.0, 0.0)


# Silence


def test_the_timeout_counts_from_the_first_setpoint() -> None:
    for autopilot in ("px4", "ardupilot"):
        one = make_rig(autopilot)
        one.wait(20.0)
        assert one.peers.autopilot.mode_name in ("OFFBOARD", "GUIDED")
        assert read_flight_state(one) == (0.0, 0.0, 0.0)


def test_px4_holds_after_silence_and_comes_back_with_the_stream() -> None:
    one = make_rig("px4", "sim.setpoint_timeout_s=1.0")
    one.stream(1.0, 1.0, 0.0, 0.0)  # the last one at 0.9 s
    one.wait(0.899)
    assert one.peers.autopilot.mode_name == "OFFBOARD"
    assert read_flight_state(one) == (1.0, 0.0, 0.0)
    one.wait(0.001)
    assert one.peers.autopilot.mode_name == "AUTO.LOITER"
    assert [(at_ns, msg.severity, msg.text) for at_ns, msg in one.seen if msg.get_type() == "STATUSTEXT"] == [
        (19 * SECOND_NS // 10, 2, "Failsafe activated")
    ]
    message = read_heartbeat(one)
    assert (message.base_mode, message.custom_mode, message.system_status) == (157, 4 << 16 | 3 << 24, 5)
    one.wait(5.0)
    assert one.speed_mps < 0.01
    one.send(one.client.setpoint(0.5, 0.0, 0.0))
    assert one.peers.autopilot.mode_name == "OFFBOARD"
    assert read_flight_state(one) == (0.5, 0.0, 0.0)


@pytest.mark.parametrize(("autopilot", "parameter"), [("px4", "COM_OF_LOSS_T"), ("ardupilot", "GUID_TIMEOUT")])
def test_the_silence_that_counts_is_the_autopilot_s_own_unless_configured(autopilot: str, parameter: str) -> None:
    assert make_rig(autopilot).peers.autopilot.parameters[parameter] == pytest.approx(0.7)
    one = make_rig(autopilot, "sim.setpoint_timeout_s=0.5", "plant.drag_1ps=[0.0,0.0,0.0]")
    assert one.peers.autopilot.parameters[parameter] == 0.5
    one.stream(1.0, 1.0, 0.0, 0.0)  # the last one at 0.9 s
    one.wait(0.399)
    assert read_flight_state(one) == (1.0, 0.0, 0.0)
    one.wait(0.002)
    assert read_flight_state(one)[0] < 0.0  # it brakes


def test_px4_does_not_come_back_by_itself_from_a_hold_that_was_asked_for() -> None:
    one = make_rig("px4")
    one.stream(1.0, 0.5, 0.0, 0.0)
    assert one.ask(SET_MODE, 1, 4, 3) == 0
    one.stream(1.0, 0.5, 0.0, 0.0)
    assert one.peers.autopilot.mode_name == "AUTO.LOITER"


def test_ardupilot_keeps_the_last_acceleration_then_brakes_and_stays_guided() -> None:
    shipped = "sim.setpoint_timeout_s=3.0"
    one = make_rig("ardupilot", shipped, "plant.drag_1ps=[0.0,0.0,0.0]", "plant.lag_s=[0.25,0.25,0.25]")
    one.stream(2.0, 1.0, 0.0, 0.0)  # the last one at 1.9 s
    one.wait(2.8)
    assert read_flight_state(one) == (1.0, 0.0, 0.0)
    # without drag v = t - T (1 - exp(-t/T)), T = 0.25 s, at 4.8 s
    assert one.speed_mps == pytest.approx(4.8 - 0.25, abs=1e-6)
    one.wait(0.11)
    assert read_flight_state(one)[0] == pytest.approx(-2.5)
    one.wait(0.5)
    before = one.speed_mps
    one.wait(0.5)
    assert (before - one.speed_mps) / 0.5 == pytest.approx(2.5, abs=0.3)
    one.wait(8.0)
    assert one.speed_mps < 0.01
    assert one.peers.autopilot.mode_name == "GUIDED"
    assert one.texts == []
    one.send(one.client.setpoint(1.0, 0.0, 0.0))
    assert read_flight_state(one) == (1.0, 0.0, 0.0)


# Commands


def test_set_mode_message_is_acknowledged_as_each_autopilot_does() -> None:
    one = make_rig("px4")
    (ack,) = one.send(one.client.set_mode(4 << 16 | 3 << 24))
    assert (ack.command, ack.result, one.peers.autopilot.mode_name) == (176, 0, "AUTO.LOITER")
    one = make_rig("ardupilot")
    (ack,) = one.send(one.client.set_mode(17))
    assert (ack.command, ack.result, one.peers.autopilot.mode_name) == (11, 0, "BRAKE")
    (ack,) = one.send(one.client.set_mode(99))
    assert (ack.result, one.peers.autopilot.mode_name) == (4, "BRAKE")
    (ack,) = one.send(one.client.set_mode(4, base=0))
    assert (ack.result, one.peers.autopilot.mode_name) == (3, "BRAKE")


def test_modes_that_do_not_exist_are_refused() -> None:
    one = make_rig("px4")
    for params in ((1, 9, 0), (1, math.nan, 0), (math.inf, 4, 3), (1, -4, 3), (1, 4, 1e30)):
        assert one.ask(SET_MODE, *params) == 2
    assert one.ask(SET_MODE, 0, 4, 3) == 3
    assert one.peers.autopilot.mode_name == "OFFBOARD"


def test_unknown_commands_are_unsupported_and_those_for_others_ignored() -> None:
    one = make_rig("px4")
    assert one.ask(246, 1) == 3
    assert one.send(one.client.command(LAND, system=9)) == []
    assert one.peers.autopilot.mode_name == "OFFBOARD"


def test_disarming_in_the_air_is_refused_even_if_forced() -> None:
    for autopilot, result in (("px4", 2), ("ardupilot", 4)):
        one = make_rig(autopilot)
        assert one.ask(ARM, 0) == result
        assert one.ask(ARM, 0, 21196) == result
        assert one.peers.autopilot.pilot.is_armed
        assert one.texts == ["Disarming denied: not landed"] * 2


def test_arming_and_disarming_on_the_floor() -> None:
    one = make_rig("px4", airborne=False)
    assert one.ask(ARM, 2) == 3
    assert one.ask(ARM, math.nan) == 3
    assert one.ask(ARM, 1) == 0
    assert one.texts == ["Armed by external command"]
    assert read_heartbeat(one).base_mode == 157
    one.stream(1.0, 0.0, 0.0, -1.0)
    assert one.ask(SET_MODE, *OFFBOARD) == 0
    one.stream(1.0, 0.0, 0.0, -1.0)
    assert one.peers.vehicle.position_m == (0.0, 0.0, 0.0)  # armed but landed: setpoints do not lift it
    assert one.ask(ARM, 0) == 0
    assert read_heartbeat(one).base_mode == 17


@pytest.mark.parametrize("command", ["command", "mode"])
def test_landing_descends_touches_and_disarms(command: str) -> None:
    for autopilot, mode, landed, disarmed in (
        ("px4", (1, 4, 6), ["Landing detected"], "Disarmed by landing"),
        ("ardupilot", (1, 9, 0), [], "Disarming motors"),
    ):
        if (autopilot, command) == ("px4", "command"):  # as recorded
            landed = ["Landing at current position", *landed]
        one = make_rig(autopilot, "sim.start_velocity_mps=[1.0,-0.5,0.0]")
        assert one.ask(LAND) == 0 if command == "command" else one.ask(SET_MODE, *mode) == 0
        one.wait(2.0)
        assert one.of("EXTENDED_SYS_STATE")[-1].landed_state == 4
        assert one.peers.vehicle.velocity_mps[2] == pytest.approx(0.5, abs=0.1)
        one.wait(2.5)
        assert one.texts == landed
        assert one.peers.vehicle.position_m[2] == 0.0
        assert one.peers.autopilot.pilot.is_armed
        one.wait(2.0)
        assert one.texts == [*landed, disarmed]
        assert not one.peers.autopilot.pilot.is_armed
        assert read_heartbeat(one).base_mode & 128 == 0
        assert one.of("EXTENDED_SYS_STATE")[-1].landed_state == 1


def test_setpoints_do_not_stop_a_landing() -> None:
    one = make_rig("px4")
    one.stream(1.0, 0.0, 0.0, 0.0)
    assert one.ask(LAND) == 0
    one.stream(8.0, 0.0, 0.0, -1.0)
    assert one.texts == ["Landing at current position", "Landing detected", "Disarmed by landing"]


def test_a_landing_can_be_called_off() -> None:
    one = make_rig("ardupilot")
    assert one.ask(LAND) == 0
    one.wait(1.0)
    assert one.ask(SET_MODE, 1, 4) == 0
    one.send(one.client.setpoint(0.5, 0.0, -0.5))
    assert read_flight_state(one) == (0.5, 0.0, -0.5)


def test_px4_takes_off_by_mode_and_then_holds() -> None:
    one = make_rig("px4", airborne=False)
    assert one.ask(SET_MODE, 1, 4, 2) == 0
    one.wait(1.0)
    assert one.peers.vehicle.position_m[2] == 0.0
    assert one.ask(ARM, 1) == 0
    one.wait(1.0)
    assert one.of("EXTENDED_SYS_STATE")[-1].landed_state == 3
    one.wait(9.0)
    assert one.peers.vehicle.position_m[2] == pytest.approx(-2.5, abs=0.15)
    assert one.peers.autopilot.mode_name == "AUTO.LOITER"
    assert one.of("EXTENDED_SYS_STATE")[-1].landed_state == 2


def test_ardupilot_takes_off_in_guided_only_and_then_takes_setpoints() -> None:
    one = make_rig("ardupilot", airborne=False)
    assert one.ask(TAKE_OFF, 0, 0, 0, 0, 0, 0, 1.5) == 4
    assert one.ask(ARM, 1) == 0
    assert one.ask(TAKE_OFF, 0, 0, 0, 0, 0, 0, 1.5) == 4
    assert one.ask(SET_MODE, 1, 4) == 0
    assert one.ask(TAKE_OFF, 0, 0, 0, 0, 0, 0, 1.5) == 0
    one.wait(8.0)
    assert one.peers.vehicle.position_m[2] == pytest.approx(-1.5, abs=0.15)
    one.send(one.client.setpoint(0.5, 0.0, 0.0))
    assert read_flight_state(one) == (0.5, 0.0, 0.0)


def test_without_a_vertical_axis_take_off_and_landing_take_a_fixed_time() -> None:
    one = SimRig(load_config("paper"), airborne=False)
    assert one.ask(SET_MODE, 1, 4, 2) == 0
    assert one.ask(ARM, 1) == 0
    one.wait(6.0)
    assert one.peers.autopilot.mode_name == "AUTO.LOITER"
    assert one.ask(LAND) == 0
    one.wait(4.9)
    assert one.texts[-2:] == ["Armed by external command", "Landing at current position"]
    one.wait(2.2)
    assert one.texts[-2:] == ["Landing detected", "Disarmed by landing"]
    assert one.peers.vehicle.velocity_mps == (0.0, 0.0, 0.0)
