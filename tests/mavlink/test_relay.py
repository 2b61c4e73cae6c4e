"""Positions passed on to the vehicle's estimator: which go, with what stamp, and that the vehicle flies by them."""

from __future__ import annotations

import math
from statistics import median
from typing import Any

import pytest
from indoors_rig import IndoorsRig
from mavlink_rig import MS, SECOND, read
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from sim_rig import Client

from sim.autopilot.autopilot import UPTIME_NS
from uavctl.config.connections import RelayConfig
from uavctl.frames import quaternion_from_euler
from uavctl.mavlink.encoder import Encoder, UnsendableError
from uavctl.mavlink.handover_states import HandoverState
from uavctl.mavlink.relay import FROZEN_POSES, MAX_AGE_NS, Pose, Relay
from uavctl.mavlink.vehicle_turn import VehicleTurn
from uavctl.records import Event, LinkStats, PositionSample, Vec3

NOW = 1_000 * SECOND
LEVEL = (1.0, 0.0, 0.0, 0.0)
STILL: dict[str, Any] = {"turn": VehicleTurn(), "armed": False}  # a vehicle that sends no attitude
BOTH = pytest.mark.parametrize("name", ["px4", "ardupilot"])


def sample(captured_ns: int, *where: float, received_ns: int = NOW, velocity: Vec3 | None = None) -> PositionSample:
    x, y, z = where or (1.0, 2.0, -0.5)
    return PositionSample(
        captured_ns=captured_ns,
        received_ns=received_ns,
        position_m=(x, y, z),
        velocity_mps=velocity,
        std_m=0.01,
        source="test",
        seq=1,
    )


def relay(**more: Any) -> Relay:
    return Relay(RelayConfig(enabled=True, **more))


def test_a_pose_carries_its_time_of_capture_in_the_vehicle_s_clock() -> None:
    one = relay()
    one.add_sample(sample(NOW - 30 * MS), LEVEL)
    (pose,) = one.due(NOW, offset_ns=900 * SECOND, refused=(), **STILL)
    assert pose == Pose("vision-position-estimate", 99_970_000, (1.0, 2.0, -0.5), LEVEL, None)


def kept(one: Relay) -> dict[str, int]:
    return {reason: count for reason, count in one.kept.items() if count}


def test_nothing_goes_without_an_attitude_or_when_switched_off() -> None:
    one = relay()
    one.add_sample(sample(NOW), None)
    one.add_sample(sample(NOW), LEVEL)
    assert one.due(NOW, offset_ns=NOW, refused=(), **STILL) == ()  # before the vehicle's clock began
    assert kept(one) == {"no clock": 1, "no attitude": 1}
    off = Relay(RelayConfig())
    off.add_sample(sample(NOW), LEVEL)
    assert off.due(NOW, offset_ns=0, refused=(), **STILL) == ()


def test_stale_late_and_refused_positions_stay_here() -> None:
    one = relay()
    one.add_sample(sample(NOW - MAX_AGE_NS - 1), LEVEL)
    one.add_sample(sample(NOW - 10 * MS, 1.0, 1.0, 0.0), LEVEL)
    assert len(one.due(NOW, offset_ns=0, refused=(), **STILL)) == 1
    one.add_sample(sample(NOW - 40 * MS, 1.1, 1.0, 0.0), LEVEL)  # captured before the one that went
    assert one.due(NOW, offset_ns=0, refused=(), **STILL) == ()
    refused = sample(NOW + 40 * MS, 1.2, 1.0, 0.0)
    one.add_sample(refused, LEVEL)
    assert one.due(NOW + 50 * MS, offset_ns=0, refused=(refused,), **STILL) == ()
    assert kept(one) == {"old": 1, "out of order": 1, "refused": 1}


def test_a_frozen_pose_is_stuck_until_it_changes() -> None:
    one, sent = relay(), 0
    for n in range(60):
        at_ns = NOW + n * 50 * MS
        one.add_sample(sample(at_ns, received_ns=at_ns), LEVEL)
        sent += len(one.due(at_ns, offset_ns=0, refused=(), **STILL))
    assert (sent, kept(one)) == (FROZEN_POSES, {"frozen": 60 - FROZEN_POSES})
    at_ns = NOW + 60 * 50 * MS
    one.add_sample(sample(at_ns, 1.0, 2.0, -0.51, received_ns=at_ns), LEVEL)
    assert len(one.due(at_ns, offset_ns=0, refused=(), **STILL)) == 1


def test_the_rate_is_bounded_and_the_order_is_that_of_capture() -> None:
    one, poses = relay(rate_hz=20.0), list[Pose]()
    for n in range(200):  # 100 Hz, by tens and from back to front
        at_ns = NOW + n * 10 * MS
        one.add_sample(sample(at_ns, n * 1e-3, 0.0, 0.0, received_ns=at_ns), LEVEL)
        if n % 10 == 9:
            poses += one.due(at_ns, offset_ns=0, refused=(), **STILL)
    stamps = [pose.usec for pose in poses]
    assert stamps == sorted(stamps) and 38 <= len(stamps) <= 41


def test_what_arrives_after_the_tick_waits_for_the_next() -> None:
    one = relay()
    one.add_sample(sample(NOW, received_ns=NOW + 1), LEVEL)
    assert one.due(NOW, offset_ns=0, refused=(), **STILL) == ()
    assert len(one.due(NOW + 50 * MS, offset_ns=0, refused=(), **STILL)) == 1


def test_odometry_has_the_velocity_in_body_axes_and_without_one_it_is_a_position() -> None:
    east = quaternion_from_euler((0.0, 0.0, math.pi / 2))
    assert east is not None
    one = relay(message="odometry")
    one.add_sample(sample(NOW, velocity=(0.0, 2.0, 0.0)), east)
    (pose,) = one.due(NOW, offset_ns=0, refused=(), **STILL)
    assert pose.body_mps == pytest.approx((2.0, 0.0, 0.0))
    (message,) = read(Encoder(245, 25).encode_external_position(pose))
    assert (message.get_type(), message.frame_id, message.child_frame_id) == ("ODOMETRY", 20, 12)
    assert (message.x, message.y, message.z, message.vx) == pytest.approx((1.0, 2.0, -0.5, 2.0))
    one.add_sample(sample(NOW + SECOND, received_ns=NOW + SECOND), east)
    (pose,) = one.due(NOW + SECOND, offset_ns=0, refused=(), **STILL)
    (message,) = read(Encoder(245, 25).encode_external_position(pose))
    assert message.get_type() == "VISION_POSITION_ESTIMATE"
    assert (message.roll, message.pitch, message.yaw) == pytest.approx((0.0, 0.0, math.pi / 2))
    assert math.isnan(message.covariance[0])


@pytest.mark.parametrize(
    "pose",
    [
        Pose("odometry", 1, (math.nan, 0.0, 0.0), LEVEL, None),
        Pose("odometry", 1, (0.0, 0.0, 0.0), LEVEL, (0.0, math.inf, 0.0)),
        Pose("odometry", 0, (0.0, 0.0, 0.0), LEVEL, None),
    ],
)
def test_nothing_unsound_is_ever_sent(pose: Pose) -> None:
    with pytest.raises(UnsendableError):
        Encoder(245, 25).encode_external_position(pose)


# --- against the simulated vehicles, in lockstep ---------------------------------------------------------------------


@BOTH
def test_a_vehicle_without_gps_gets_its_position_through_us_and_may_be_armed(name: str) -> None:
    rig = IndoorsRig(name)
    rig.peers.receive("vehicle", Client().pack(mavlink.MAVLink_set_gps_global_origin_message(1, 0, 0, 0)), 0)
    rig.run(6.0)
    estimator = rig.peers.autopilot.estimator
    assert estimator.is_position_valid and estimator.has_heading
    assert estimator.position_m == pytest.approx(rig.peers.vehicle.position_m, abs=0.03)
    assert len(list(rig.relayed())) > 90  # and every one is in the recording


def moved_by_us(rig: IndoorsRig) -> float:
    """By what PX4 moves stamps after TIMESYNC: half of (its request's time + its time of arrival) - our time.

    The vehicle is reached in the moment of sending here.
    """
    answers = [
        (at_ns, message)
        for at_ns, message in rig.sent("TIMESYNC")
        if message.tc1 > 0  # else it is a request of our own
    ]
    assert len(answers) > 30  # asked for at 10 Hz
    return median(float((message.ts1 + at_ns + UPTIME_NS) / 2 - message.tc1) for at_ns, message in answers) / 1000


@BOTH
def test_the_stamp_is_the_time_of_capture_in_the_vehicle_s_clock(name: str) -> None:
    rig = IndoorsRig(name, "clock.latency_s=0.03")
    rig.run(4.0)
    moved_us = moved_by_us(rig) if name == "px4" else 0.0  # ArduPilot takes stamps as they are
    ages_ms = [(at_ns + UPTIME_NS) / MS - (message.usec + moved_us) / 1000 for at_ns, message in rig.relayed()]
    assert len(ages_ms) > 50
    assert min(ages_ms) >= 28 and max(ages_ms) <= 30 + 40 + 50 + 2  # delay, jitter, and the wait for the tick


@pytest.mark.slow
def test_px4_moves_stamps_once_its_timesync_has_converged() -> None:
    rig = IndoorsRig("px4", "sim.camera.latency_s=0.05", "clock.latency_s=0.05")
    estimator, ages_ms = rig.peers.autopilot.estimator, list[float]()
    age_ns = estimator._age_ns

    def noted(stamp_ns: int, at_ns: int) -> int:
        ages_ms.append(age_ns(stamp_ns, at_ns) / MS)
        return age_ns(stamp_ns, at_ns)

    estimator._age_ns = noted
    rig.run(49.0)  # 500 answers at 10 Hz are not there yet
    assert estimator.is_position_valid and set(ages_ms) == {0.0}
    rig.run(3.0)
    assert estimator.is_position_valid
    assert min(ages_ms[-20:]) > 45 and max(ages_ms[-20:]) < 200  # the cameras' time, and the wait for the tick


@pytest.mark.slow
@pytest.mark.parametrize(("name", "external"), [("px4", "OFFBOARD"), ("ardupilot", "GUIDED")])
def test_a_vehicle_that_the_pilot_took_off_lands_by_our_positions_to_the_end(name: str, external: str) -> None:
    rig = IndoorsRig(name, "sim.start_position_m=[0.0, 0.0, -0.1]")
    rig.peers.receive("vehicle", Client().pack(mavlink.MAVLink_set_gps_global_origin_message(1, 0, 0, 0)), 0)
    rig.run(8.0)
    rig.pilot_flies(external)
    rig.run(40.0, stop=True)
    assert rig.loop.finished and rig.loop.handover_state is HandoverState.DONE
    assert not rig.peers.autopilot.pilot.is_armed and rig.peers.autopilot.estimator.is_position_valid
    assert not any("Failsafe" in event.text for event in rig.memory.of(Event))
    end_ns = rig.peers.now_ns
    assert len([at_ns for at_ns, _ in rig.relayed() if end_ns - SECOND < at_ns <= end_ns]) > 15


def test_without_the_relay_a_vehicle_that_the_pilot_took_off_is_left_as_soon_as_it_lands() -> None:
    rig = IndoorsRig("px4", "sim.start_position_m=[0.0, 0.0, -0.1]", "relay.enabled=false")
    for parameter in ("SYS_HAS_GPS", "EKF2_GPS_CTRL", "SYS_HAS_MAG", "EKF2_BARO_CTRL"):
        assert rig.peers.autopilot.parameters.set(parameter, 7.0 if parameter == "EKF2_GPS_CTRL" else 1.0)
    assert rig.peers.autopilot.parameters.set("EKF2_MAG_TYPE", 0.0)
    rig.run(3.0)
    rig.pilot_flies("OFFBOARD")
    rig.run(40.0, stop=True)
    assert rig.loop.finished and rig.loop.handover_state is HandoverState.SETTLING
    assert rig.peers.autopilot.pilot.is_armed


def test_frozen_cameras_are_not_passed_on() -> None:
    rig = IndoorsRig("px4", "sim.camera.frozen=[[3.0, 10.0]]")
    rig.run(8.0)
    late = [at_ns for at_ns, _ in rig.relayed() if at_ns > 4.5 * SECOND]
    assert late == []


def test_without_the_relay_nothing_is_sent() -> None:
    rig = IndoorsRig("px4", "relay.enabled=false")
    rig.run(3.0)
    assert list(rig.relayed()) == []


def test_the_clocks_are_recorded_once_a_second() -> None:
    rig = IndoorsRig("px4")
    rig.run(5.0)
    stats = [one for one in rig.memory.of(LinkStats) if one.link == "vehicle"]
    assert len(stats) == 5
    assert stats[0].clock_drift_ppm is None  # too early
    assert (stats[-1].clock_rtt_ns, stats[-1].clock_drift_ppm, stats[-1].clock_rejected) == (0, 0.0, 0)
