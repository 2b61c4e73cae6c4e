"""External positions in the simulated autopilots' own estimate, and what happens when they stop."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest
from autopilot_rig import GUIDED, Flight, Name
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from sim_rig import ARM, SET_MODE

from uavctl.arrays import SECOND_NS
from uavctl.lab.position_loop import EXTERNAL_ONLY

BOTH = pytest.mark.parametrize("name", ["px4", "ardupilot"])
TAKEN = {
    "px4": ("VISION_POSITION_ESTIMATE", "ODOMETRY"),
    "ardupilot": ("VISION_POSITION_ESTIMATE", "ATT_POS_MOCAP", "ODOMETRY"),
}
EACH = pytest.mark.parametrize(("name", "kind"), [(name, kind) for name, kinds in TAKEN.items() for kind in kinds])


def indoors(name: Name, kind: str | None, *, origin: bool = True) -> Flight:
    """On the floor without GPS, configured as the ones that were seen to fly."""
    one = Flight(name, airborne=False)
    one.set(**EXTERNAL_ONLY[name])
    one.external, one.external_hz = kind, 30.0 if name == "px4" else 25.0
    if origin and name == "ardupilot":
        one.send(one.client.pack(mavlink.MAVLink_set_gps_global_origin_message(1, 473977420, 85455940, 488_000)))
    one.wait(5.0)
    return one


@pytest.mark.slow
@EACH
def test_it_flies_on_every_kind_that_the_autopilot_takes(name: Name, kind: str) -> None:
    one = indoors(name, kind)
    one.delays_s = (0.0, 0.05)
    one.climb(2.0)
    assert one.vehicle.position_m == pytest.approx((0.0, 0.0, -2.0), abs=0.15)
    local = one.of("LOCAL_POSITION_NED")[-1]
    assert (local.x, local.y, local.z) == pytest.approx(one.vehicle.position_m, abs=0.03)
    assert one.autopilot.estimator.flags & 0x3F & ~0x10 == 0x2F


@pytest.mark.parametrize(
    ("name", "kind"),
    [("px4", "ATT_POS_MOCAP"), ("px4", "VICON_POSITION_ESTIMATE"), ("ardupilot", "VICON_POSITION_ESTIMATE")],
)
def test_other_kinds_are_not_fused_and_arming_is_denied(name: Name, kind: str) -> None:
    one = indoors(name, kind)
    assert one.ask(ARM, 1) == (1 if name == "px4" else 4)
    assert any("position" in text or "VisOdom" in text for text in one.texts)
    assert not one.autopilot.pilot.is_armed
    assert one.of("LOCAL_POSITION_NED")[-1:] == one.of("LOCAL_POSITION_NED")[:1]  # at most the one with GPS


@BOTH
def test_without_any_position_arming_is_denied_with_reasons_and_the_pre_arm_bit_is_off(name: Name) -> None:
    one = indoors(name, None)
    assert one.ask(ARM, 1) == (1 if name == "px4" else 4)
    assert len(one.texts) >= 3  # position, height and heading
    assert one.of("SYS_STATUS")[-1].onboard_control_sensors_health & 0x10000000 == 0
    assert one.ask(401) == 0
    assert len(one.texts) >= 6
    assert one.ask(ARM, 1, 21196) == 0  # forced


def test_ardupilot_arms_24_s_after_its_start_and_wants_an_origin() -> None:
    one = indoors("ardupilot", "VISION_POSITION_ESTIMATE", origin=False)
    assert one.ask(ARM, 1) == 4
    assert one.autopilot.estimator.flags == 0x25
    assert one.ask(SET_MODE, *GUIDED) == 4
    assert one.texts[-1] == "Mode change failed: GUIDED requires position"
    one = Flight("ardupilot", airborne=False)  # its clock begins at 20 s
    one.set(**EXTERNAL_ONLY["ardupilot"])
    one.external, one.external_hz = "VISION_POSITION_ESTIMATE", 25.0
    one.send(one.client.pack(mavlink.MAVLink_set_gps_global_origin_message(1, 0, 0, 0)))
    one.wait(3.9)
    assert one.autopilot.estimator.flags == 0x33F
    assert one.ask(ARM, 1) == 4
    assert one.texts == ["Arm: EKF3 still initialising"]
    one.wait(0.2)
    assert one.ask(ARM, 1) == 0


def test_px4_does_not_begin_on_a_slow_stream() -> None:
    one = Flight("px4", airborne=False)
    one.set(**EXTERNAL_ONLY["px4"])
    one.external, one.external_hz = "VISION_POSITION_ESTIMATE", 4.0
    one.wait(10.0)
    assert one.ask(ARM, 1) == 1
    one.external_hz = 30.0
    one.wait(2.0)
    assert one.ask(ARM, 1) == 0


def test_ardupilot_notices_the_loss_of_the_cameras_after_seven_seconds_and_lands_adrift() -> None:
    """The recorded flight: 0x33f to 0x25 after 7.2 s, LAND 0.9 s later; drift 0.54 m north, -0.43 m east at 7.6 s."""
    one = indoors("ardupilot", "VISION_POSITION_ESTIMATE")
    one.delays_s = (0.025, 0.124)
    one.climb(2.0)
    one.stream(2.0, 0.0, 0.0, 0.0)
    assert one.vehicle.position_m == pytest.approx((0.0, 0.0, -2.0), abs=0.15)
    begin, lost_ns = one.vehicle.position_m, one.now_ns
    one.external = None
    drifts = []
    for _ in range(76):
        one.send(one.client.position(begin[0], begin[1], -2.0))
        one.wait(0.1)
        drifts.append(tuple(a - b for a, b in zip(one.vehicle.position_m, begin, strict=True)))
        local = one.of("LOCAL_POSITION_NED")[-1]
        assert math.dist((local.x, local.y), begin[:2]) < 0.15  # stays near, whatever is true
    assert drifts[75][:2] == pytest.approx((0.54, -0.43), abs=0.2)
    assert math.hypot(*drifts[35][:2]) == pytest.approx(math.hypot(0.12, 0.05), abs=0.12)
    one.wait(2.0)
    reports = [(at_ns, msg.flags) for at_ns, msg in one.seen if msg.get_type() == "EKF_STATUS_REPORT"]
    assert reports[-1][1] == 0x25
    (changed_ns,) = [b for (_, old), (b, new) in pairwise(reports) if b > lost_ns and old != new]
    assert (changed_ns - lost_ns) * 1e-9 == pytest.approx(7.2, abs=1.2)  # told once a second
    landed_ns = next(at_ns for at_ns, msg in one.seen if getattr(msg, "text", "").startswith("EKF Failsafe"))
    assert (landed_ns - lost_ns) * 1e-9 == pytest.approx(8.2, abs=0.3)
    assert one.texts[-2:] == ["EKF variance", "EKF Failsafe: changed to LAND Mode"]
    assert one.mode == "LAND" and one.of("HEARTBEAT")[-1].system_status == 5
    assert one.ask(SET_MODE, *GUIDED) == 4
    one.wait(10.0)
    assert not one.autopilot.pilot.is_armed


def test_with_its_estimators_failsafe_off_ardupilot_only_says_that_it_is_lost() -> None:
    one = indoors("ardupilot", "VISION_POSITION_ESTIMATE")
    one.set(FS_EKF_ACTION=0)
    one.climb(2.0)
    one.external = None
    one.wait(15.0)
    assert one.mode == "GUIDED" and one.texts[-1] == "EKF variance"


@BOTH
def test_the_velocity_of_odometry_is_fused_where_it_is_configured(name: Name) -> None:
    """Odometry of a vehicle that claims to move while its position stays: only a fused velocity is led by it."""
    claimed = []
    for fused in (0, 1):
        one = indoors(name, None)
        one.set(**({"EKF2_EV_CTRL": 11 + 4 * fused} if name == "px4" else {"EK3_SRC1_VELXY": 6 * fused}))
        for _ in range(60):
            msg = mavlink.MAVLink_odometry_message(
                one.now_ns // 1000,
                20,
                12,
                0.0,
                0.0,
                0.0,
                [1.0, 0.0, 0.0, 0.0],
                0.3,
                *([0.0] * 5),
                [math.nan] * 21,
                [math.nan] * 21,
            )
            one.send(one.client.pack(msg))
            one.wait(0.03)
        claimed.append(one.autopilot.estimator.velocity_mps[0])
    assert abs(claimed[0]) < 0.05 and claimed[1] == pytest.approx(0.3, abs=0.1)


def test_px4_lands_five_seconds_after_the_loss() -> None:
    one = indoors("px4", "VISION_POSITION_ESTIMATE")
    one.climb(2.0)
    one.external = None
    one.wait(4.8)
    assert one.mode == "AUTO.TAKEOFF"
    one.wait(0.5)
    assert one.mode == "AUTO.DESCEND"
    assert one.texts[-1] == "Failsafe activated"


# px4-sih-relay-released-in-climb: no place on the globe, and from 10 to 43 s in AUTO.TAKEOFF at the height;
# px4-sih-offboard-accel: GPS, and AUTO.LOITER from 0.5 m below the height on. 3 and 2 are landed states.
@pytest.mark.slow
@pytest.mark.parametrize(("placed", "mode", "state"), [(False, "AUTO.TAKEOFF", 3), (True, "AUTO.LOITER", 2)])
def test_px4_without_a_place_on_the_globe_hovers_in_its_take_off_mode(placed: bool, mode: str, state: int) -> None:
    one = indoors("px4", "VISION_POSITION_ESTIMATE")
    if placed:
        one.send(one.client.pack(mavlink.MAVLink_set_gps_global_origin_message(1, 473977420, 85455940, 488_000)))
    one.climb(1.2)
    one.wait(20.0)
    assert one.mode == mode
    assert one.of("EXTENDED_SYS_STATE")[-1].landed_state == state
    assert one.vehicle.position_m == pytest.approx((0.0, 0.0, -1.2), abs=0.1)
    assert one.ask(SET_MODE, 1, 3, 0) == 0  # the pilot's POSCTL ends it
    one.wait(1.5)
    assert one.mode == "POSCTL" and one.of("EXTENDED_SYS_STATE")[-1].landed_state == 2
    assert one.vehicle.position_m == pytest.approx((0.0, 0.0, -1.2), abs=0.1)


def test_a_jump_is_not_believed_and_a_short_pause_is_survived() -> None:
    one = indoors("ardupilot", "VISION_POSITION_ESTIMATE")
    one.climb(2.0)
    far = mavlink.MAVLink_vision_position_estimate_message(1, 5.0, 5.0, -5.0, 0.0, 0.0, 0.0)
    for _ in range(10):
        one.wait(0.04)
        one.send(one.client.pack(far))
        assert one.autopilot.estimator.position_m == pytest.approx(one.vehicle.position_m, abs=0.02)
    assert one.vehicle.position_m == pytest.approx((0.0, 0.0, -2.0), abs=0.15)
    one.external = None
    one.wait(3.0)
    one.external = "VISION_POSITION_ESTIMATE"
    one.wait(3.0)
    assert one.mode == "GUIDED" and one.autopilot.estimator.is_position_valid
    assert one.autopilot.estimator.position_m == pytest.approx(one.vehicle.position_m, abs=0.02)


@BOTH
def test_an_odometry_of_the_wrong_frames_or_not_a_number_is_not_taken(name: Name) -> None:
    one = indoors(name, None)
    unknown = [math.nan] * 21
    for frame, child, x in ((20, 8, 0.0), (14, 12, 0.0), (20, 12, math.nan), (20, 12, math.inf)):
        for _ in range(60):
            msg = mavlink.MAVLink_odometry_message(
                one.now_ns // 1000, frame, child, x, 0.0, 0.0, [1.0, 0.0, 0.0, 0.0], *([0.0] * 6), unknown, unknown
            )
            one.send(one.client.pack(msg))
            one.wait(0.03)
        assert one.ask(ARM, 1) != 0


def test_with_gps_external_positions_change_nothing() -> None:
    one = Flight("px4")
    one.send(one.client.pack(mavlink.MAVLink_vision_position_estimate_message(1, 9.0, 9.0, 9.0, 0.0, 0.0, 0.0)))
    one.wait(1.0)
    local = one.of("LOCAL_POSITION_NED")[-1]
    assert math.dist((local.x, local.y, local.z), one.vehicle.position_m) < 0.05
    assert one.now_ns == SECOND_NS


def test_back_on_gps_the_error_is_gone() -> None:
    one = indoors("ardupilot", "VISION_POSITION_ESTIMATE")
    one.climb(2.0)
    one.external = None
    one.wait(6.0)
    assert math.dist(one.autopilot.estimator.position_m, one.vehicle.position_m) > 0.1
    one.set(GPS1_TYPE=1, EK3_SRC1_POSXY=3)
    one.wait(0.1)
    assert one.autopilot.estimator.position_m == one.vehicle.position_m


def test_a_stamp_of_another_clock_does_not_spoil_what_follows() -> None:
    one = indoors("ardupilot", "VISION_POSITION_ESTIMATE")
    one.delays_s = (0.025, 0.124)
    one.climb(2.0)
    one.send(
        one.client.pack(mavlink.MAVLink_vision_position_estimate_message(2**63, *one.vehicle.position_m, 0.0, 0.0, 0.0))
    )
    one.wait(0.5)
    for _ in range(20):
        one.send(one.client.velocity(1.0, 0.0, 0.0))
        one.wait(0.1)
    assert one.autopilot.estimator.position_m == pytest.approx(one.vehicle.position_m, abs=0.1)
