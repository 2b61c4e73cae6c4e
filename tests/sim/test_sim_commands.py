"""Commands, streams and failsafes of the simulated autopilots."""

from __future__ import annotations

import math
from typing import Any

import pytest
from autopilot_rig import GUIDED, HOLD, Flight, Name
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from sim_rig import ARM, INTERVAL, LAND, SET_MODE, TAKE_OFF

BOTH = pytest.mark.parametrize("name", ["px4", "ardupilot"])
REQUEST, GET_INTERVAL, HOME, SET_HOME, CHECKS, CAPABILITIES = 512, 510, 410, 179, 401, 520
ORIGIN = {"px4": (473977420, 85455940, 488_000), "ardupilot": (-353632620, 1491652370, 584_000)}


def command_int(
    one: Flight, command: int, *params: float, x: int = 0, y: int = 0, z: float = 0.0, frame: int = 6
) -> Any:
    four = (*params, *([0.0] * (4 - len(params))))
    data = one.client.pack(mavlink.MAVLink_command_int_message(1, 1, frame, command, 0, 0, *four, x, y, z))
    return next(msg for msg in one.send(data) if msg.get_type() == "COMMAND_ACK")


@BOTH
def test_what_clients_read_is_streamed_without_being_asked(name: Name) -> None:
    one = Flight(name)
    one.wait(10.0)
    own = {
        "px4": {"ESTIMATOR_STATUS", "ALTITUDE", "ATTITUDE_QUATERNION", "HOME_POSITION"},
        "ardupilot": {"EKF_STATUS_REPORT"},
    }
    wanted = {
        "HEARTBEAT": 10,
        "SYS_STATUS": 10,
        "EXTENDED_SYS_STATE": 10,
        "LOCAL_POSITION_NED": 100,
        "GLOBAL_POSITION_INT": 40,
        "ATTITUDE": 40,
        "GPS_RAW_INT": 10,
        "VFR_HUD": 10,
        "BATTERY_STATUS": 5,
    }
    for kind, count in wanted.items():
        assert abs(len(one.of(kind)) - count) <= 1, kind
    assert own[name] <= {msg.get_type() for _, msg in one.seen}


@BOTH
def test_telemetry_tells_the_truth(name: Name) -> None:
    one = Flight(name)
    one.vehicle.set_heading(math.pi / 2)
    one.stream(4.0, 0.5, 0.0, 0.0)
    for number in (30, 31, 32, 33, 24, 1, 147, 74):
        assert one.ask(REQUEST, number) == 0
    vehicle = one.vehicle
    north, east, down = vehicle.position_m
    attitude, quaternion = one.of("ATTITUDE")[-1], one.of("ATTITUDE_QUATERNION")[-1]
    assert (quaternion.q1, quaternion.q2, quaternion.q3, quaternion.q4) == pytest.approx(vehicle.attitude, abs=1e-6)
    # leaning and heading, checked with the direction in which the thrust points
    lean = math.acos(math.cos(attitude.roll) * math.cos(attitude.pitch))
    assert math.degrees(lean) == pytest.approx(one.lean_deg, abs=1e-3)
    assert math.degrees(attitude.yaw) == pytest.approx(one.heading_deg, abs=1e-3)
    local = one.of("LOCAL_POSITION_NED")[-1]
    assert (local.x, local.y, local.z) == pytest.approx((north, east, down), abs=1e-4)
    lat, lon, alt = ORIGIN[name]
    globe = one.of("GLOBAL_POSITION_INT")[-1]
    metre_e7 = 1e7 / 111_319.49  # of latitude, on a sphere of 6378137 m
    assert globe.lat - lat == pytest.approx(north * metre_e7, abs=1.5)
    assert globe.lon - lon == pytest.approx(east * metre_e7 / math.cos(math.radians(lat * 1e-7)), abs=1.5)
    assert globe.alt - alt == pytest.approx(-1000.0 * down, abs=1.0)
    assert globe.relative_alt == pytest.approx(-1000.0 * down, abs=1.0)
    assert (globe.vx, globe.vy, globe.vz) == pytest.approx([100.0 * v for v in vehicle.velocity_mps], abs=1.0)
    battery, status = one.of("BATTERY_STATUS")[-1], one.of("SYS_STATUS")[-1]
    assert battery.voltages[0] == status.voltage_battery == round(1000.0 * vehicle.battery.voltage_v)
    assert status.onboard_control_sensors_health == status.onboard_control_sensors_present
    assert one.of("GPS_RAW_INT")[-1].fix_type == 3


@BOTH
def test_single_messages_are_sent_on_request_and_unknown_ones_denied(name: Name) -> None:
    one = Flight(name)
    answers = one.send(one.client.command(REQUEST, 148))
    assert {msg.get_type() for msg in answers} == {"COMMAND_ACK", "AUTOPILOT_VERSION"}
    (version,) = one.of("AUTOPILOT_VERSION")
    assert version.capabilities & (mavlink.MAV_PROTOCOL_CAPABILITY_MAVLINK2 | 8 | 2) == 8192 | 8 | 2
    assert version.flight_sw_version >> 24 == (1 if name == "px4" else 4)
    assert one.ask(CAPABILITIES, 1) == 0 and len(one.of("AUTOPILOT_VERSION")) == 2
    for number in (250, 9999, math.nan, -1.0, 1e30):
        assert one.ask(REQUEST, number) == 2


@BOTH
def test_intervals_are_told(name: Name) -> None:
    one = Flight(name)

    def told(number: float) -> int:
        assert one.ask(GET_INTERVAL, number) == 0
        return int(one.of("MESSAGE_INTERVAL")[-1].interval_us)

    assert told(32) == 100_000
    assert one.ask(INTERVAL, 32, 20_000) == 0 and told(32) == 20_000
    assert one.ask(INTERVAL, 32, -1) == 0 and told(32) == -1
    assert told(250) == 0  # not known
    assert one.ask(REQUEST, 244, 30) == 0
    assert one.of("MESSAGE_INTERVAL")[-1].message_id == 30
    assert one.ask(GET_INTERVAL, math.nan) == 2


def test_ardupilot_takes_requests_for_groups_of_streams() -> None:
    one = Flight("ardupilot")
    for stream, rate, start in ((0, 4, 1), (10, 20, 1), (6, 0, 1), (12, 5, 0)):
        one.send(one.client.pack(mavlink.MAVLink_request_data_stream_message(1, 1, stream, rate, start)))
    before = len(one.seen)
    one.wait(2.0)
    count = [msg.get_type() for _, msg in one.seen[before:]].count
    assert count("ATTITUDE") == pytest.approx(40, abs=1) and count("VFR_HUD") == pytest.approx(8, abs=1)
    assert count("LOCAL_POSITION_NED") == count("EKF_STATUS_REPORT") == 0
    assert count("HEARTBEAT") == 2


@BOTH
def test_home_is_where_it_was_armed(name: Name) -> None:
    one = Flight(name, airborne=False)
    assert one.ask(ARM, 1) == 0
    assert len(one.of("HOME_POSITION")) >= 1
    one.wait(0.5)
    assert one.ask(HOME) == 0
    home = one.of("HOME_POSITION")[-1]
    assert (home.latitude, home.longitude, home.altitude) == ORIGIN[name]
    one = Flight(name)
    assert one.ask(SET_HOME, 1) == 0
    assert one.of("HOME_POSITION")[-1].z == pytest.approx(-5.0)
    lat, lon, _ = ORIGIN[name]
    assert command_int(one, SET_HOME, 0, x=lat, y=lon, z=490.0).result == 0
    assert one.of("HOME_POSITION")[-1].x == pytest.approx(0.0, abs=0.02)
    assert one.ask(SET_HOME, 0, 0, 0, 0, math.nan, 0, 0) == 2
    assert command_int(one, SET_HOME, 0, x=2**31 - 1, y=0).result == 2
    assert command_int(one, SET_HOME, 0, x=lat + 10**8, y=lon).result == 2  # ten degrees off
    one.set(**({"EKF2_GPS_CTRL": 0} if name == "px4" else {"GPS1_TYPE": 0}))
    assert one.ask(SET_HOME, 1) == 4 and one.ask(HOME) == 4


@BOTH
def test_the_arming_checks_are_not_run_in_flight(name: Name) -> None:
    assert Flight(name).ask(CHECKS) == 4


@BOTH
def test_command_int_and_command_long_do_the_same(name: Name) -> None:
    one = Flight(name, airborne=False)
    mode = GUIDED if name == "ardupilot" else HOLD
    assert command_int(one, SET_MODE, *mode).result == 0
    assert command_int(one, ARM, 1).result == 0
    assert command_int(one, TAKE_OFF, z=3.0).result == 0  # above home, by its frame
    one.wait(12.0)
    assert one.vehicle.position_m[2] == pytest.approx(-3.0, abs=0.2)
    assert command_int(one, LAND).result == 0
    assert command_int(one, 31000).result == 3


def test_px4_takes_a_take_off_height_above_the_sea_and_its_own_without() -> None:
    for up, height in ((488.0 + 4.0, 4.0), (math.nan, 2.5), (0.0, 2.5)):
        one = Flight("px4", airborne=False)
        assert one.ask(ARM, 1) == 0
        assert one.ask(TAKE_OFF, 0, 0, 0, 0, 0, 0, up) == 0
        one.wait(14.0)
        assert -one.vehicle.position_m[2] == pytest.approx(height, abs=0.2)


@pytest.mark.parametrize("up", [math.nan, -1.0, 0.0, 1e9])
def test_ardupilot_refuses_a_take_off_height_that_is_none(up: float) -> None:
    one = Flight("ardupilot", airborne=False)
    assert one.ask(SET_MODE, *GUIDED) == 0 and one.ask(ARM, 1) == 0
    assert one.ask(TAKE_OFF, 0, 0, 0, 0, 0, 0, up) == 4


@pytest.mark.parametrize(("name", "mode", "result"), [("px4", (1, 4, 6), 1), ("ardupilot", (1, 9), 4)])
def test_the_landing_mode_is_not_armable(name: Name, mode: tuple[int, ...], result: int) -> None:
    one = Flight(name, airborne=False)
    assert one.ask(SET_MODE, *mode) == 0
    assert one.ask(ARM, 1) == result
    assert "landing mode" in one.texts[-1] or "Land mode" in one.texts[-1]


def test_a_mission_list_is_empty() -> None:
    one = Flight("ardupilot")
    (answer,) = one.send(one.client.pack(mavlink.MAVLink_mission_request_list_message(1, 1)))
    assert (answer.get_type(), answer.count, answer.target_system) == ("MISSION_COUNT", 0, 245)


# Its own failsafes


def emptied(one: Flight, remaining: float) -> None:
    one.vehicle.battery.used_c = (1.0 - remaining) * 864.0


def test_px4_warns_of_a_low_battery_and_lands_on_a_critical_one_if_told_to() -> None:
    one = Flight("px4")
    assert one.ask(SET_MODE, *HOLD) == 0
    emptied(one, 0.14)
    one.wait(1.0)
    assert one.texts == ["Low battery level"]
    emptied(one, 0.06)
    one.wait(1.0)
    assert one.mode == "AUTO.LOITER"
    one.set(COM_LOW_BAT_ACT=2)
    one.wait(0.2)
    assert one.mode == "AUTO.LAND" and one.of("STATUSTEXT")[-1].severity == 2


def test_ardupilot_lands_when_the_voltage_was_low_for_ten_seconds_if_told_to() -> None:
    one = Flight("ardupilot")
    one.set(BATT_FS_LOW_ACT=1, BATT_LOW_VOLT=3.8)
    emptied(one, 0.2)
    one.wait(9.9)
    assert one.mode == "GUIDED"
    one.wait(0.5)
    assert one.mode == "LAND" and one.texts[-1] == "Battery Failsafe"


@pytest.mark.parametrize(
    ("name", "checked", "asked"),
    [
        ("px4", "Preflight Fail: low battery", "Preflight Fail: low battery"),
        ("ardupilot", "PreArm: Battery 1", "Arm: Battery 1"),  # as recorded of another reason
    ],
)
def test_an_empty_battery_does_not_arm(name: Name, checked: str, asked: str) -> None:
    one = Flight(name, airborne=False)
    emptied(one, 0.0)
    one.wait(0.1)
    assert one.ask(CHECKS) == 0 and one.ask(ARM, 1) != 0
    assert one.texts[0].startswith(checked) and one.texts[1].startswith(asked)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "parameter", "action", "wait_s", "mode"),
    [
        ("px4", "NAV_DLL_ACT", 1, 10, "AUTO.LOITER"),
        ("px4", "NAV_DLL_ACT", 3, 10, "AUTO.LAND"),
        ("ardupilot", "FS_GCS_ENABLE", 5, 5, "LAND"),
    ],
)
def test_a_ground_station_that_falls_silent(name: Name, parameter: str, action: int, wait_s: int, mode: str) -> None:
    one = Flight(name)
    before = one.mode
    one.wait(20.0)
    one.set(**{parameter: action})
    one.wait(20.0)
    assert one.mode == before  # there never was one
    station = mavlink.MAVLink(None, 255, 190)
    one.send(bytes(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3).pack(station)))
    one.wait(wait_s - 0.2)
    assert one.mode == before
    one.wait(0.5)
    assert one.mode == mode
    assert "ground station" in one.texts[-1] or one.texts[-1] == "GCS Failsafe"
