"""The simulated autopilots on the quadrotor, against what was observed of the real ones: figures and behaviour."""

from __future__ import annotations

import math
from collections import Counter

import numpy as np
import pytest
from autopilot_rig import GUIDED, HOLD, OFFBOARD, Flight, Name
from mavlink_rig import read
from places import DATA
from quadrotor_rig import quadrotor, steady
from sim_rig import ARM, LAND, SET_MODE, TAKE_OFF, decode

from logs.recording.tlog import TlogPacket, read_tlog
from sim.autopilot.autopilot import Autopilot
from uavctl.config import load_config

BOTH = pytest.mark.parametrize("name", ["px4", "ardupilot"])
WITH_YAW = 2111  # acceleration and heading; 3135: acceleration alone
AS_SEEN = 0.15  # relative: "4.9 m/s ± 15 %"

# Acceleration


def test_ardupilot_keeps_the_velocity_at_zero_acceleration_and_rejects_wind() -> None:
    one = Flight("ardupilot", wind=(0.0, -2.0, 0.0))
    one.stream(3.0, 0.0, 0.0, 0.0)
    one.stream(2.0, 1.0, 0.0, 0.0)
    one.stream(1.0, 0.0, 0.0, 0.0)
    before = one.vehicle.velocity_mps
    height = one.vehicle.position_m[2]
    for _ in range(5):
        one.stream(1.0, 0.0, 0.0, 0.0)
        assert one.vehicle.velocity_mps == pytest.approx(before, abs=0.1)
    assert before[0] == pytest.approx(2.0, abs=0.2)
    assert one.vehicle.position_m[2] == pytest.approx(height, abs=0.05)


def test_px4_flies_zero_acceleration_open_loop_and_drifts() -> None:
    one = Flight("px4")
    one.stream(3.0, 0.0, 0.0, 0.0)  # the recorded one had been drifting
    before = one.vehicle.position_m[2]
    one.stream(5.0, 0.0, 0.0, 0.0)
    assert before - one.vehicle.position_m[2] == pytest.approx(0.75, rel=AS_SEEN)
    windy = Flight("px4", wind=(0.0, -2.0, 0.0))
    windy.stream(5.0, 0.0, 0.0, 0.0)
    assert windy.vehicle.velocity_mps[1] < -1.5  # carried along


def test_ardupilot_has_the_commanded_slope_after_a_quarter_of_a_second() -> None:
    one = Flight("ardupilot")
    one.stream(0.3, 0.0, 0.0, 0.0)
    one.stream(0.3, 1.0, 0.0, 0.0)
    before = one.level_mps
    one.stream(1.0, 1.0, 0.0, 0.0)
    assert one.level_mps - before == pytest.approx(1.05, rel=0.1)


def test_ardupilot_answers_10_hz_and_1_hz_streams_alike() -> None:
    reached = []
    for period_s in (0.1, 1.0):
        one = Flight("ardupilot")
        one.set(GUID_TIMEOUT=3.0)  # as recorded
        one.stream(3.0, 1.0, 0.0, 0.0, period_s=period_s)
        reached.append(one.level_mps)
    assert reached[0] == pytest.approx(reached[1], abs=0.02)


def test_px4_is_slower() -> None:
    one = Flight("px4")
    one.stream(2.0, 1.0, 0.0, 0.0)
    assert one.level_mps == pytest.approx(0.8, rel=AS_SEEN)


@BOTH
def test_axes_are_those_of_ned(name: Name) -> None:
    one = Flight(name)
    one.stream(1.5, 0.0, 0.0, -0.5)
    assert one.vehicle.velocity_mps[2] < -0.4  # climbs
    assert one.level_mps < 0.01


@pytest.mark.parametrize(("name", "lean_deg"), [("ardupilot", 30.0), ("px4", 45.0)])
def test_20_mps2_are_taken_and_lean_as_far_as_the_vehicle_allows(name: Name, lean_deg: float) -> None:
    one = Flight(name)
    one.stream(2.0, 20.0, 0.0, 0.0)
    assert one.lean_deg == pytest.approx(lean_deg, abs=2.0)
    assert one.texts == []


# Masks, frames and headings


@BOTH
@pytest.mark.parametrize("ignored", [0x40, 0x80, 0x100])
def test_one_ignored_axis_stops_the_vehicle(name: Name, ignored: int) -> None:
    one = Flight(name, speed=(1.0, 0.0, 0.0))
    one.stream(4.0, 1.0, 0.0, 0.0, mask=3135 | ignored)
    assert one.level_mps < 0.1
    assert one.mode in ("OFFBOARD", "GUIDED")


def test_a_setpoint_that_ignores_everything_stops_ardupilot_and_is_none_for_px4() -> None:
    one = Flight("ardupilot", speed=(1.0, 0.0, 0.0))
    one.stream(4.0, 1.0, 0.0, 0.0, mask=0xFFF)
    assert one.level_mps < 0.1 and one.mode == "GUIDED"
    one = Flight("px4")
    one.stream(0.5, 0.0, 0.0, 0.0)
    one.stream(1.5, 1.0, 0.0, 0.0, mask=0xFFF)
    assert one.mode == "AUTO.LOITER"
    assert set(one.texts) == {"SET_POSITION_TARGET_LOCAL_NED invalid", "Failsafe activated"}


def test_on_the_ground_a_number_that_is_none_harms_nobody() -> None:
    one = Flight("ardupilot", airborne=False)
    one.stream(0.5, math.nan, 0.0, 0.0)
    assert one.mode == "STABILIZE"


def test_ardupilot_points_its_nose_along_its_way_unless_a_heading_is_given() -> None:
    one = Flight("ardupilot")
    one.stream(4.0, 0.0, 1.0, 0.0)
    assert one.heading_deg == pytest.approx(90.0, abs=5.0)
    one = Flight("ardupilot")
    one.stream(4.0, 0.0, 1.0, 0.0, mask=WITH_YAW)
    assert one.heading_deg == pytest.approx(0.0, abs=3.0)
    one = Flight("ardupilot")
    one.set(WP_YAW_BEHAVIOR=0)
    one.stream(4.0, 0.0, 1.0, 0.0)
    assert one.heading_deg == pytest.approx(0.0, abs=3.0)


def test_px4_holds_its_heading() -> None:
    one = Flight("px4")
    one.stream(4.0, 0.0, 1.0, 0.0)
    assert one.heading_deg == pytest.approx(0.0, abs=3.0)


def turned(name: Name, yaw_rad: float) -> Flight:
    """Hovering, with its nose turned."""
    one = Flight(name)
    one.vehicle.set_heading(yaw_rad)
    one.stream(4.0, 0.0, 0.0, 0.0)
    return one


@pytest.mark.parametrize(("frame", "heading_deg"), [(1, 0.0), (7, 0.0), (8, 90.0), (9, 90.0)])
def test_ardupilot_turns_body_frames_by_its_yaw(frame: int, heading_deg: float) -> None:
    one = turned("ardupilot", math.pi / 2)
    one.stream(1.0, 1.0, 0.0, 0.0, frame=frame)
    north, east, _ = one.vehicle.velocity_mps
    assert math.degrees(math.atan2(east, north)) == pytest.approx(heading_deg, abs=8.0)


def test_px4_turns_body_frames_by_its_full_attitude() -> None:
    one = turned("px4", math.pi / 2)
    one.stream(1.0, 1.0, 0.0, 0.0, frame=8)
    north, east, down = one.vehicle.velocity_mps
    assert math.degrees(math.atan2(east, north)) == pytest.approx(90.0, abs=8.0)
    level = turned("px4", math.pi / 2)
    level.stream(1.0, 0.0, 1.0, 0.0, frame=1)
    # Leaning forward its front points down: the same acceleration along it sinks, and the level one does not.
    assert down - level.vehicle.velocity_mps[2] > 0.03


def test_other_frames_stop_ardupilot_and_are_refused_by_px4() -> None:
    one = Flight("ardupilot", speed=(1.0, 0.0, 0.0))
    one.stream(3.0, 1.0, 0.0, 0.0, frame=20)
    assert one.level_mps < 0.1
    one = Flight("px4")
    one.stream(1.0, 1.0, 0.0, 0.0, frame=9)
    assert one.level_mps < 0.01
    assert set(one.texts) == {"setpoint refused: frame 9"}


def test_the_force_bit_is_refused_by_px4_and_dropped_by_ardupilot() -> None:
    one = Flight("px4")
    one.stream(1.0, 1.0, 0.0, 0.0, mask=3135 | 0x200)
    assert one.level_mps < 0.01
    assert set(one.texts) == {"force setpoint not supported"}
    one = Flight("ardupilot")
    one.stream(1.0, 1.0, 0.0, 0.0, mask=3135 | 0x200)
    assert one.level_mps > 0.5
    assert one.texts == []


def test_a_number_that_is_none_kills_ardupilot_and_stops_px4() -> None:
    one = Flight("ardupilot")
    one.stream(0.5, math.nan, 0.0, 0.0)
    assert one.mode == "CRASHED"
    one = Flight("px4", speed=(1.0, 0.0, 0.0))
    one.stream(3.0, math.nan, 0.0, 0.0)
    assert one.mode == "OFFBOARD" and one.level_mps < 0.1


# On the ground


@BOTH
def test_armed_on_the_ground_setpoints_are_ignored_until_a_take_off(name: Name) -> None:
    one = Flight(name, airborne=False)
    one.stream(1.0, 0.0, 0.0, -2.0)
    assert one.ask(SET_MODE, *(GUIDED if name == "ardupilot" else OFFBOARD)) == 0
    assert one.ask(ARM, 1) == 0
    one.stream(3.0, 0.0, 0.0, -2.0)
    assert one.vehicle.position_m[2] == 0.0
    assert one.ask(TAKE_OFF, 0, 0, 0, 0, 0, 0, 2.0) == 0
    one.wait(10.0)
    assert one.vehicle.position_m[2] < -1.8


@pytest.mark.parametrize(("name", "text"), [("ardupilot", "Disarming"), ("px4", "Disarmed by auto preflight")])
def test_armed_and_not_taken_off_it_disarms_by_itself_after_10_s(name: Name, text: str) -> None:
    one = Flight(name, airborne=False)
    assert one.ask(ARM, 1) == 0
    one.wait(9.9)
    assert one.autopilot.pilot.is_armed
    one.wait(0.2)
    assert not one.autopilot.pilot.is_armed
    assert one.texts[-1].startswith(text)


@BOTH
def test_take_off_and_landing_on_the_quadrotor(name: Name) -> None:
    one = Flight(name, airborne=False)
    one.climb(2.0)
    assert one.vehicle.position_m == pytest.approx((0.0, 0.0, -2.0), abs=0.15)
    assert [msg.landed_state for msg in one.of("EXTENDED_SYS_STATE")][-1] == 2
    assert one.ask(LAND) == 0
    one.wait(12.0)
    assert one.vehicle.position_m == pytest.approx((0.0, 0.0, 0.0), abs=0.15)
    assert one.vehicle.rotor_speeds_rps[0] < 1.0  # disarmed: they stand
    assert not one.autopilot.pilot.is_armed
    assert one.of("BATTERY_STATUS")[-1].battery_remaining < 100


# Silence


def test_ardupilot_flies_the_last_acceleration_for_three_seconds_then_brakes_and_stays_guided() -> None:
    one = Flight("ardupilot")
    one.set(GUID_TIMEOUT=3.0)  # as shipped
    one.stream(2.0, 1.0, 0.0, 0.0)
    assert one.level_mps == pytest.approx(1.9, rel=AS_SEEN)
    one.wait(2.9)  # the last setpoint is 3 s old
    assert one.level_mps == pytest.approx(4.9, rel=AS_SEEN)
    one.wait(0.6)
    before = one.level_mps
    one.wait(1.0)
    assert before - one.level_mps == pytest.approx(2.5, rel=AS_SEEN)
    one.wait(5.0)
    assert one.level_mps < 0.1 and one.mode == "GUIDED" and one.texts == []


def test_the_timeout_of_ardupilot_is_its_parameter() -> None:
    one = Flight("ardupilot")
    one.set(GUID_TIMEOUT=1.0)
    one.stream(1.0, 1.0, 0.0, 0.0)
    one.wait(4.0)
    assert one.level_mps < 0.3


def test_a_position_does_not_time_out_and_a_velocity_does() -> None:
    one = Flight("ardupilot")
    one.send(one.client.setpoint(0.0, 0.0, 0.0, mask=0xDF8))  # position (0, 0, 0): down to the floor's height
    one.wait(3.5)
    assert one.vehicle.velocity_mps[2] > 0.5
    assert one.autopilot.pilot.dispatch.active_setpoint is not None


def test_px4_goes_on_with_the_last_acceleration_where_the_loss_of_the_stream_needs_a_radio() -> None:
    one = Flight("px4")
    one.set(COM_OBL_RC_ACT=0)
    one.stream(2.0, 1.0, 0.0, 0.0)
    for _ in range(12):
        one.wait(1.0)
        assert one.mode == "OFFBOARD"
    assert one.level_mps == pytest.approx(1.0, abs=0.1)  # against its drag of 1 1/s: the acceleration still acts
    assert one.texts == []


@pytest.mark.parametrize(("action", "mode"), [(5, "AUTO.LOITER"), (4, "AUTO.LAND")])
def test_px4_acts_one_second_after_the_last_setpoint_as_configured(action: int, mode: str) -> None:
    one = Flight("px4")
    one.set(COM_OBL_RC_ACT=action, COM_OF_LOSS_T=1.0)  # as recorded
    one.stream(2.0, 1.0, 0.0, 0.0)
    last_ns = one.now_ns - 100_000_000
    one.wait(3.0)
    assert one.mode == mode
    (at_ns,) = [at_ns for at_ns, msg in one.seen if msg.get_type() == "STATUSTEXT"]
    assert (at_ns - last_ns) * 1e-9 == pytest.approx(1.0, abs=0.01)
    assert one.level_mps < 0.3
    one.stream(0.2, 0.0, 0.0, 0.0)
    assert one.mode == "OFFBOARD"  # by itself, as recorded


def test_px4_needs_a_stream_above_2_hz_before_offboard() -> None:
    one = Flight("px4")
    assert one.ask(SET_MODE, *HOLD) == 0
    one.stream(3.0, 0.0, 0.0, 0.0, period_s=0.5)
    assert one.ask(SET_MODE, *OFFBOARD) == 1
    one.stream(1.0, 0.0, 0.0, 0.0, period_s=0.4)
    assert one.ask(SET_MODE, *OFFBOARD) == 0


# Positions and velocities


@BOTH
def test_position_and_velocity_setpoints_are_flown(name: Name) -> None:
    one = Flight(name)
    for _ in range(100):
        one.send(one.client.position(1.0, -0.5, -4.0))
        one.wait(0.1)
    assert one.vehicle.position_m == pytest.approx((1.0, -0.5, -4.0), abs=0.1)
    told = one.of("POSITION_TARGET_LOCAL_NED")[-1]
    assert (told.x, told.y, told.z) == (1.0, -0.5, -4.0)
    for _ in range(40):
        one.send(one.client.velocity(0.5, 0.5, 0.0))
        one.wait(0.1)
    assert one.vehicle.velocity_mps == pytest.approx((0.5, 0.5, 0.0), abs=0.1)


def test_ardupilot_counts_positions_of_offset_frames_from_where_it_is() -> None:
    one = turned("ardupilot", math.pi / 2)
    one.send(one.client.position(1.0, 0.0, -1.0, frame=9))
    one.wait(8.0)
    assert one.vehicle.position_m == pytest.approx((0.0, 1.0, -6.0), abs=0.2)


# Streams


def test_px4_sends_as_often_as_recorded_on_an_onboard_link() -> None:
    """All that is simulated of what a real one sends unasked; rates of 5 Hz and more can be counted in 2 s."""
    packets = read_tlog(DATA / "px4-rest.tlog").packets
    recorded = Counter(int.from_bytes(one.data[7:10], "little") for one in packets if one.data[5] == 1)
    seconds = (packets[-1].at_ns - packets[0].at_ns) / 1e9
    config = load_config("room-hahn-stursberg", ["sim.streams=onboard"])
    vehicle = quadrotor("px4", wind=steady((0.0, 0.0, 0.0)), at=(0.0, 0.0, -5.0))
    autopilot = Autopilot(config, vehicle, 0, np.random.SeedSequence(1), airborne=True)
    sent: Counter[int] = Counter()
    while (at_ns := autopilot.next_ns) is not None and at_ns <= 2_000_000_000:
        vehicle.advance(at_ns)
        sent.update(msg.get_msgId() for data in autopilot.run(at_ns) for msg in decode(data))
    often = {number for number, times in recorded.items() if times / seconds >= 5.0}
    assert {30, 31, 32, 105, 331} <= often & set(sent)
    for number in often & set(sent):
        assert sent[number] / 2.0 == pytest.approx(recorded[number] / seconds, rel=0.2), number
    assert sum(sent.values()) / 2.0 > 300


def test_a_px4_at_rest_tells_a_constant_position_and_none_in_the_air() -> None:
    packets = read_tlog(DATA / "px4-rest.tlog").packets
    (resting,) = {read(one.data)[0].flags & 0x80 for one in packets if is_status(one)}
    told = []
    for airborne in (False, True):
        one = Flight("px4", airborne=airborne)
        one.wait(2.0)
        told.append(one.of("ESTIMATOR_STATUS")[-1].flags & 0x80)
    assert told == [resting, 0] == [0x80, 0]


def is_status(packet: TlogPacket) -> bool:
    return packet.data[5] == 1 and int.from_bytes(packet.data[7:10], "little") == 230


@pytest.mark.parametrize(
    ("name", "lift_s", "disarm_s"),
    [("ardupilot", 3.8, 2.15), ("px4", 4.1, 4.4)],  # recorded: 3.7 to 3.9 and 4.1 to 4.3; 2.1 to 2.25 and 4.1 to 4.8
)
def test_rotors_spin_up_before_it_lifts_and_it_disarms_some_time_after_it_stands(
    name: Name, lift_s: float, disarm_s: float
) -> None:
    one = Flight(name, airborne=False)
    order = [(SET_MODE, *GUIDED)] if name == "ardupilot" else []
    for command, *parameters in order:
        assert one.ask(command, *parameters) == 0
    assert one.ask(ARM, 1) == 0
    begun_ns = one.now_ns
    assert one.ask(TAKE_OFF, 0, 0, 0, 0, 0, 0, math.nan if name == "px4" else 1.2) == 0
    while one.vehicle.position_m[2] > -0.03:
        one.wait(0.05)
        assert one.now_ns - begun_ns < 10e9
    assert (one.now_ns - begun_ns) * 1e-9 == pytest.approx(lift_s, abs=0.4)
    one.wait(6.0)
    assert one.ask(LAND) == 0
    while one.vehicle.position_m[2] < 0.0:
        one.wait(0.05)
    stood_ns = one.now_ns
    while one.autopilot.pilot.is_armed:
        one.wait(0.05)
    assert (one.now_ns - stood_ns) * 1e-9 == pytest.approx(disarm_s, abs=0.4)


def test_px4_s_take_off_mode_climbs_to_its_parameter() -> None:
    one = Flight("px4", airborne=False)
    one.set(MIS_TAKEOFF_ALT=1.2)
    assert one.ask(SET_MODE, 1, 4, 2) == 0
    assert one.ask(ARM, 1) == 0
    one.wait(12.0)
    assert one.vehicle.position_m[2] == pytest.approx(-1.2, abs=0.15)
    assert "Using default takeoff altitude: 1.2 m" in one.texts


# Heights above the floor 0.5, 1, 2 and 4 s after 0.03 m, of the take-offs to these heights.
@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "height_m", "recorded_m"),
    [
        ("ardupilot", 1.2, (0.36, 0.85, 1.30, 1.18)),  # arducopter-relay-pilot-switches
        ("ardupilot", 2.0, (0.68, 1.26, 2.00, 1.96)),  # arducopter-vicon-guided-accel
        ("ardupilot", 5.0, (0.67, 1.34, 3.06, 4.88)),  # arducopter-gps-guided-accel
        ("px4", 1.2, (0.25, 0.47, 0.85, 1.21)),  # px4-sih-relay-released-in-climb
        ("px4", 5.0, (0.25, 0.63, 1.74, 4.01)),  # px4-sih-offboard-accel
    ],
)
def test_each_climbs_as_fast_as_it_was_recorded_to(name: Name, height_m: float, recorded_m: tuple[float, ...]) -> None:
    one = Flight(name, airborne=False)
    if name == "px4":
        one.set(MIS_TAKEOFF_ALT=height_m)
    else:
        assert one.ask(SET_MODE, 1, 4) == 0
    assert one.ask(ARM, 1) == 0
    assert one.ask(TAKE_OFF, 0, 0, 0, 0, 0, 0, math.nan if name == "px4" else height_m) == 0
    while one.vehicle.position_m[2] > -0.03:
        one.wait(0.01)
        assert one.now_ns < 10e9
    climbed_m = []
    for after_s in (0.5, 0.5, 1.0, 2.0):
        one.wait(after_s)
        climbed_m.append(-one.vehicle.position_m[2])
    assert climbed_m == pytest.approx(recorded_m, abs=0.25)
    one.wait(6.0)
    assert one.vehicle.position_m[2] == pytest.approx(-height_m, abs=0.1)


def test_px4_that_has_landed_is_in_the_mode_of_before_and_stands_by_only_while_it_is_sent_setpoints() -> None:
    """As px4-sih-offboard-accel and px4-sih-relay-waypoints end: OFFBOARD, disarmed, UNINIT."""
    one = Flight("px4")
    one.stream(1.0, 0.0, 0.0, 0.5)
    assert one.ask(LAND) == 0 and one.texts[-1] == "Landing at current position"
    while one.autopilot.pilot.is_armed:
        one.wait(0.5)
        assert one.now_ns < 40e9
    one.wait(1.1)
    last = one.of("HEARTBEAT")[-1]
    assert one.mode == "OFFBOARD" and (last.base_mode, last.system_status) == (17, 0)
    assert one.ask(ARM, 1) == 1 and one.texts[-1].startswith("Arming denied: Resolve system health")
    one.stream(1.2, 0.0, 0.0, 0.0)
    assert one.of("HEARTBEAT")[-1].system_status == 3
    assert one.ask(ARM, 1) == 0
