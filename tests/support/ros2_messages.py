"""Messages of ROS 2 as objects with the fields of their types: what `uavctl.io.ros2_pose` reads needs no ROS."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

Numbers = tuple[float, ...]


def make_pose(position: Numbers, quaternion: Numbers) -> SimpleNamespace:
    """A geometry_msgs/Pose; the quaternion is (x, y, z, w)."""
    x, y, z, w = quaternion
    return SimpleNamespace(
        position=SimpleNamespace(**dict(zip("xyz", position, strict=True))),
        orientation=SimpleNamespace(x=x, y=y, z=z, w=w),
    )


def make_message(
    kind: str,
    position: Numbers = (1.0, 2.0, 3.0),
    quaternion: Numbers = (0.0, 0.0, 0.0, 1.0),
    *,
    stamp: tuple[int, int] = (100, 5),
    frame: str = "map",
    child: str = "drone",
    covariance: Numbers = (0.0,) * 36,
) -> Any:
    """A message of one of the four types."""
    message = SimpleNamespace(
        header=SimpleNamespace(frame_id=frame, stamp=SimpleNamespace(sec=stamp[0], nanosec=stamp[1]))
    )
    pose = make_pose(position, quaternion)
    if kind == "PoseStamped":
        message.pose = pose
    elif kind == "TransformStamped":
        message.transform = SimpleNamespace(translation=pose.position, rotation=pose.orientation)
        message.child_frame_id = child
    else:
        message.pose = SimpleNamespace(pose=pose, covariance=covariance)
        if kind == "Odometry":
            message.child_frame_id = child
    return message
