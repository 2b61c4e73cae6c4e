"""The simulated cameras: when, where, how noisy, and in which message."""

import math
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace
from scipy.spatial.transform import Rotation
from sim_rig import decode

from sim.cameras import UPTIME_S, Cameras
from sim.vehicle.interface import LEVEL, Quaternion
from uavctl.config.connections import FrameConfig
from uavctl.config.sim import CameraConfig
from uavctl.errors import ConfigError

S = 1_000_000_000
PLAIN = CameraConfig(rate_hz=50.0)
STILL = (0.0, 0.0, 0.0)


def cameras(
    camera: CameraConfig = PLAIN, frame: FrameConfig | None = None, seed: int = 5, start_ns: int = 0
) -> Cameras:
    return Cameras(camera, frame or FrameConfig(), np.random.SeedSequence(seed), start_ns)


def shot(one: Cameras, where: tuple[float, float, float] = (1.5, -2.25, -0.75), attitude: Quaternion = LEVEL) -> Any:
    taken = one.capture(where, (0.5, -0.25, 0.125), attitude)
    assert taken is not None
    (msg,) = decode(taken[1])
    return msg


def test_samples_lie_on_their_own_grid_without_drift() -> None:
    one = cameras(CameraConfig(rate_hz=30.0, phase_s=0.1), start_ns=7 * S)
    times = []
    for _ in range(3001):
        times.append(one.next_ns)
        one.capture(STILL, STILL, LEVEL)
    assert times[0] == 7 * S + S // 10
    assert times[3000] == 107 * S + S // 10
    assert {b - a for a, b in pairwise(times)} == {33_333_333, 33_333_334}


def test_the_stamp_is_capture_time_in_the_cameras_own_clock_and_latency_comes_after_it() -> None:
    one = cameras(CameraConfig(rate_hz=4.0, phase_s=0.5, latency_s=0.02, clock_offset_s=-12.5), start_ns=3 * S)
    for k in range(3):
        taken = one.capture(STILL, STILL, LEVEL)
        assert taken is not None
        sent_ns, data = taken
        (msg,) = decode(data)
        assert sent_ns == 3 * S + S // 2 + k * S // 4 + S // 50
        assert msg.usec == round((UPTIME_S - 12.5 + 0.5 + 0.25 * k) * 1e6)
        assert msg.get_seq() == k


@pytest.mark.parametrize("offset_s", [-UPTIME_S, 1e10])
def test_a_stamp_that_cannot_be_is_refused(offset_s: float) -> None:
    with pytest.raises(ConfigError, match="clock_offset_s"):
        cameras(replace(PLAIN, clock_offset_s=offset_s))


@pytest.mark.parametrize(
    ("message", "kind", "stamp"),
    [
        ("vision", "VISION_POSITION_ESTIMATE", "usec"),
        ("vicon", "VICON_POSITION_ESTIMATE", "usec"),
        ("mocap", "ATT_POS_MOCAP", "time_usec"),
        ("odometry", "ODOMETRY", "time_usec"),
    ],
)
def test_every_message_carries_stamp_and_position(message: Any, kind: str, stamp: str) -> None:
    msg = shot(cameras(replace(PLAIN, message=message)))
    assert msg.get_type() == kind
    assert (msg.x, msg.y, msg.z) == (1.5, -2.25, -0.75)
    assert getattr(msg, stamp) == round(UPTIME_S * 1e6)
    covariance = msg.pose_covariance if message == "odometry" else msg.covariance
    assert math.isnan(covariance[0])
    assert (msg.get_srcSystem(), msg.get_srcComponent()) == (17, 197)


def test_odometry_in_an_unturned_frame_has_the_attitude_and_velocity_of_the_frame() -> None:
    msg = shot(cameras(replace(PLAIN, message="odometry")))
    assert (msg.vx, msg.vy, msg.vz) == (0.5, -0.25, 0.125)
    assert (msg.frame_id, msg.child_frame_id, list(msg.q)) == (20, 12, [1.0, 0.0, 0.0, 0.0])


def test_positions_are_sent_in_the_camera_frame() -> None:
    # ENU axes, first axis turned to the east by a heading of 90 deg, origin at (1, 2, 0):
    # NED offset (0.5, -4.25, -0.75); turned back by 90 deg (-4.25, -0.5, -0.75); as ENU (-0.5, -4.25, 0.75)
    frame = FrameConfig(convention="enu", origin_m=(1.0, 2.0, 0.0), yaw_deg=90.0)
    msg = shot(cameras(replace(PLAIN, message="odometry"), frame))
    assert (msg.x, msg.y, msg.z) == (-0.5, -4.25, 0.75)
    assert (msg.frame_id, msg.child_frame_id) == (4, 12)


@pytest.mark.parametrize("convention", ["ned", "enu"])
@pytest.mark.parametrize("yaw_deg", [0.0, 30.0, -120.0, 180.0])
@pytest.mark.parametrize("attitude", [LEVEL, (0.5, 0.1, -0.7, 0.5), (0.9, 0.3, -0.3, 0.1)])
def test_attitude_turns_body_velocity_into_the_camera_frame(
    convention: Any, yaw_deg: float, attitude: Quaternion
) -> None:
    frame = FrameConfig(convention=convention, yaw_deg=yaw_deg)
    msg = shot(cameras(replace(PLAIN, message="odometry"), frame), attitude=attitude)
    turned = Rotation.from_quat([*msg.q[1:], msg.q[0]]).apply([msg.vx, msg.vy, msg.vz])
    north, east, down = 0.5, -0.25, 0.125
    yaw = math.radians(yaw_deg)  # heading of the frame's first axis
    x = math.cos(yaw) * north + math.sin(yaw) * east
    y = math.cos(yaw) * east - math.sin(yaw) * north
    np.testing.assert_allclose(turned, [x, y, down] if convention == "ned" else [y, x, -down], atol=1e-7)


def test_noise_has_the_spread_asked_for_and_its_own_seed() -> None:
    noisy = replace(PLAIN, noise_std_m=0.01)
    one, again, other = cameras(noisy), cameras(noisy), cameras(noisy, seed=6)
    seen = np.array([[msg.x, msg.y, msg.z] for msg in (shot(one, STILL) for _ in range(4000))])
    assert abs(float(seen.std()) - 0.01) < 4 * 0.01 / math.sqrt(2 * 12_000)
    assert np.abs(np.corrcoef(seen.T) - np.eye(3)).max() < 4 / math.sqrt(4000)
    assert shot(again, STILL).x == seen[0, 0] != shot(other, STILL).x


@pytest.mark.parametrize("convention", ["ned", "enu"])
@pytest.mark.parametrize("message", ["vision", "vicon", "mocap"])
@pytest.mark.parametrize("attitude", [LEVEL, (0.5, 0.1, -0.7, 0.5), (0.9, 0.3, -0.3, 0.1)])
def test_the_body_s_axes_are_where_they_are_seen(convention: Any, message: Any, attitude: Quaternion) -> None:
    # By matrices of another library: nose, right side and belly of the body, in NED, then in the camera's frame.
    msg = shot(
        cameras(replace(PLAIN, message=message), FrameConfig(convention=convention, yaw_deg=40.0)), attitude=attitude
    )
    body = Rotation.from_quat([*attitude[1:], attitude[0]]).as_matrix()
    turned = Rotation.from_euler("z", -40.0, degrees=True).as_matrix() @ body
    if convention == "enu":
        turned = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]]) @ turned
    if message == "mocap":
        seen = Rotation.from_quat([*msg.q[1:], msg.q[0]]).as_matrix()
    else:
        seen = Rotation.from_euler("ZYX", [msg.yaw, msg.pitch, msg.roll]).as_matrix()
        if convention == "enu":  # FLU
            turned = turned @ np.diag([1.0, -1.0, -1.0])
    np.testing.assert_allclose(seen, turned, atol=1e-6)
