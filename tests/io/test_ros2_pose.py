"""Poses of ROS 2: axes against an oracle of matrices, and messages that give no pose. No ROS is needed."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from ros2_messages import make_message
from scipy.spatial.transform import Rotation

from uavctl.errors import ConnectionSpecError
from uavctl.io.camera import BodyPose, CameraError
from uavctl.io.ros2_pose import (
    NO_STAMP,
    OTHER_CHILD,
    OTHER_FRAME,
    POSE_TYPES,
    UNTRACKED,
    OnePublisher,
    PoseReader,
    Publisher,
    choose_type,
    describe_pose_topics,
)
from uavctl.io.ros2_url import Ros2Url, parse_ros2_url

# Columns: east, north and up in NED; forward, left and up in forward, right, down.
NED_FROM_ENU = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
FRD_FROM_FLU = np.diag([1.0, -1.0, -1.0])
KINDS = tuple(name.rpartition("/")[2] for name in POSE_TYPES)
NAMES = dict(zip(KINDS, POSE_TYPES, strict=True))
POSE, ODOMETRY, TRANSFORM = "PoseStamped", "Odometry", "TransformStamped"


def reader(kind: str, frame: str = "", child: str = "") -> PoseReader:
    return PoseReader(NAMES[kind], "/drone/pose", frame, child)


def read(kind: str, **fields: object) -> BodyPose:
    pose = reader(kind).read(make_message(kind, **fields))  # type: ignore[arg-type]
    assert pose is not None
    return pose


def upper_triangle(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    return matrix[np.triu_indices(6)]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0), (0.3, -0.8, 0.5), (3.1, 0.2, 0.1), (0.2, -0.1, 3.1)])
def test_position_and_attitude_agree_with_an_oracle_of_matrices(kind: str, turn: tuple[float, ...]) -> None:
    turned, position = Rotation.from_rotvec(turn), (1.0, 2.0, 3.0)
    pose = read(kind, position=position, quaternion=tuple(turned.as_quat()))
    assert pose.position_m == pytest.approx(NED_FROM_ENU @ position)
    want = Rotation.from_matrix(NED_FROM_ENU @ turned.as_matrix() @ FRD_FROM_FLU.T)
    assert Rotation.from_quat([*pose.attitude[1:], pose.attitude[0]]).approx_equal(want, atol=1e-9)
    assert pose.exposed_ns == 100_000_000_005


@pytest.mark.parametrize("kind", ["PoseWithCovarianceStamped", ODOMETRY])
def test_the_covariance_is_that_of_the_converted_errors(kind: str) -> None:
    errors = np.random.default_rng(7).normal(size=(20, 6)) * 1e-3
    converted = np.array(
        [
            [
                *(NED_FROM_ENU @ error[:3]),
                *Rotation.from_matrix(
                    NED_FROM_ENU @ Rotation.from_rotvec(error[3:]).as_matrix() @ NED_FROM_ENU.T
                ).as_rotvec(),
            ]
            for error in errors
        ]
    )
    pose = read(kind, covariance=tuple((errors.T @ errors).ravel()))
    assert pose.covariance == pytest.approx(upper_triangle(converted.T @ converted), rel=1e-6, abs=1e-15)


@pytest.mark.parametrize("first", [0.0, -1.0, math.nan, math.inf])
def test_a_covariance_that_says_nothing_is_unknown(first: float) -> None:
    assert read(ODOMETRY, covariance=(first, *(0.0,) * 35)).covariance is None
    assert read(POSE).covariance is None


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"position": (math.nan, 0.0, 0.0)}, UNTRACKED),
        ({"position": (0.0, math.inf, 0.0)}, UNTRACKED),
        ({"quaternion": (0.0, 0.0, 0.0, 0.0)}, UNTRACKED),
        ({"quaternion": (0.0, 0.0, 0.0, math.nan)}, UNTRACKED),
        ({"stamp": (0, 0)}, NO_STAMP),
        ({"stamp": (-1, 5)}, NO_STAMP),
        ({"frame": "odom"}, OTHER_FRAME),
        ({"child": "table"}, OTHER_CHILD),
    ],
)
def test_what_gives_no_pose_is_counted_and_the_next_message_does(fields: dict[str, object], reason: str) -> None:
    poses = reader(ODOMETRY)
    assert poses.read(make_message(ODOMETRY)) is not None
    assert poses.read(make_message(ODOMETRY, **fields)) is None  # type: ignore[arg-type]
    assert poses.dropped == {reason: 1}
    assert poses.read(make_message(ODOMETRY)) is not None


def test_frames_of_the_url_decide() -> None:
    with pytest.raises(CameraError, match="in frame 'map', not 'world'"):
        reader(POSE, frame="world").read(make_message(POSE))
    with pytest.raises(CameraError, match="names no body"):
        reader(POSE, child="drone").read(make_message(POSE))
    poses = reader(TRANSFORM, frame="map", child="drone")
    assert poses.read(make_message(TRANSFORM, child="table")) is None
    assert poses.read(make_message(TRANSFORM, child="drone")) is not None


def test_a_topic_has_one_publisher_of_poses() -> None:
    assert choose_type("/drone/pose", [Publisher("driver", NAMES[ODOMETRY])]) == NAMES[ODOMETRY]
    with pytest.raises(CameraError, match=r"2 publishers \(a, b\)"):
        choose_type("/drone/pose", [Publisher("b", NAMES[POSE]), Publisher("a", NAMES[POSE])])
    with pytest.raises(CameraError, match="of imu has sensor_msgs/msg/Imu; poses are"):
        choose_type("/drone/imu", [Publisher("imu", "sensor_msgs/msg/Imu")])
    topics = [("/b", [NAMES[POSE]]), ("/a", [NAMES[TRANSFORM], "x/msg/Y"]), ("/rosout", ["rcl_interfaces/msg/Log"])]
    assert describe_pose_topics(topics).endswith(": /a, /b")


def test_the_first_publisher_counts_until_it_is_silent_for_a_second() -> None:
    one = OnePublisher(1.0)
    for gid, at_s, counts in ((b"a", 0.0, True), (b"b", 0.5, False), (b"a", 1.0, True), (b"b", 2.0, False)):
        assert one.accepts(gid, at_s) is counts
    assert one.accepts(b"b", 2.1) and not one.accepts(b"a", 2.2)


@pytest.mark.parametrize(
    ("url", "want"),
    [
        ("ros2://drone/pose", Ros2Url("/drone/pose")),
        ("ros2:///Drone_1/pose", Ros2Url("/Drone_1/pose")),
        ("ros2://pose?frame=map&child=base_link", Ros2Url("/pose", "map", "base_link")),
        ("ros2://pose?clock=sim", Ros2Url("/pose", clock="sim")),
    ],
)
def test_a_url_names_a_topic(url: str, want: Ros2Url) -> None:
    assert parse_ros2_url(url) == want


@pytest.mark.parametrize(
    ("url", "reason"),
    [
        ("ros2://", "no name of a topic"),
        ("ros2://drone/1", "no name of a topic"),
        ("ros2://drone//pose", "no name of a topic"),
        ("ros2://drone pose", "no name of a topic"),
        ("ros2://pose?up=y", "'up' is not known"),
        ("ros2://pose?frame", "bad query field"),
        ("ros2://pose?clock=gps", "none of sender, system, sim"),
    ],
)
def test_a_url_that_cannot_be_is_refused(url: str, reason: str) -> None:
    with pytest.raises(ConnectionSpecError, match=reason):
        parse_ros2_url(url)
