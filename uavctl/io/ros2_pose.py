"""Poses out of messages of ROS 2. Pure: no ROS is imported, messages are objects with the fields of their type.

Axes by REP 103: the frame is east, north, up, and the body forward, left, up.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from uavctl.arrays import SECOND_NS
from uavctl.frames import Frame, convert_covariance_to_ned, normalise_quaternion
from uavctl.io.camera import BodyPose, CameraError

UNTRACKED = "untracked"
NO_STAMP = "no-stamp"
OTHER_FRAME = "other-frame"
OTHER_CHILD = "other-child"

_ENU = Frame("enu")


class _Fields(NamedTuple):
    position: Any
    orientation: Any
    covariance: Sequence[float] | None = None
    child: str | None = None  # None: the type has no frame of the body


# Fields of a message, by the name of its type.
_READERS: Mapping[str, Callable[[Any], _Fields]] = {
    "geometry_msgs/msg/PoseStamped": lambda m: _Fields(m.pose.position, m.pose.orientation),
    "geometry_msgs/msg/PoseWithCovarianceStamped": lambda m: _Fields(
        m.pose.pose.position, m.pose.pose.orientation, m.pose.covariance
    ),
    "geometry_msgs/msg/TransformStamped": lambda m: _Fields(
        m.transform.translation, m.transform.rotation, child=m.child_frame_id
    ),
    "nav_msgs/msg/Odometry": lambda m: _Fields(
        m.pose.pose.position, m.pose.pose.orientation, m.pose.covariance, m.child_frame_id
    ),
}
POSE_TYPES = tuple(_READERS)


class Publisher(NamedTuple):
    """A publisher of a topic."""

    node: str
    kind: str  # type of its messages
    gid: bytes = b""  # its identifier


class OnePublisher:
    """Chooses the publisher whose poses count: the first, until it is silent. Two would mix.

    Args:
        silent_s: Time without a pose after which another one may take its place [s].

    Attributes:
        gid: Identifier of the chosen publisher; None before the first pose.
    """

    def __init__(self, silent_s: float) -> None:
        self._silent_s = silent_s
        self._heard_s = 0.0
        self.gid: bytes | None = None

    def accepts(self, gid: bytes, at_s: float) -> bool:
        """Return whether a pose counts that a publisher sends.

        Args:
            at_s: Time of its arrival [s].
        """
        if gid != self.gid and self.gid is not None and at_s - self._heard_s <= self._silent_s:
            return False
        self.gid, self._heard_s = gid, at_s
        return True


class PoseReader:
    """Reads the poses of one body out of the messages of one topic.

    Args:
        kind: One of `POSE_TYPES`.
        topic: For errors.
        frame: Frame of the poses; empty: that of the first message.
        child: Frame of the body; empty: that of the first message.

    Attributes:
        dropped: Counts of messages that gave no pose, by reason.
    """

    def __init__(self, kind: str, topic: str, frame: str = "", child: str = "") -> None:
        self._read_fields, self._kind, self._topic = _READERS[kind], kind, topic
        self._frame, self._child = frame, child
        self._is_first = True
        self.dropped: Counter[str] = Counter()

    def read(self, message: Any) -> BodyPose | None:
        """Return the pose of a message, in local NED if north is the frame's; None if it gives none.

        Raises:
            CameraError: The first message is in another frame, or of another body.
        """
        fields = self._read_fields(message)
        problem = self._check_frames(message.header.frame_id, fields.child)
        if problem:
            self.dropped[problem] += 1
            return None
        stamp_ns = message.header.stamp.sec * SECOND_NS + message.header.stamp.nanosec
        position = fields.position.x, fields.position.y, fields.position.z
        q = fields.orientation
        attitude = normalise_quaternion((q.w, q.x, q.y, q.z))
        if stamp_ns <= 0:
            self.dropped[NO_STAMP] += 1
            return None
        if attitude is None or not all(map(math.isfinite, position)):
            self.dropped[UNTRACKED] += 1
            return None
        return BodyPose(
            stamp_ns,
            _ENU.to_ned(position),
            _ENU.attitude_to_ned(attitude, euler=True),
            _convert_covariance(fields.covariance),
        )

    def _check_frames(self, frame: str, child: str | None) -> str:
        """Return why a message does not count; empty if it does."""
        if self._is_first:
            self._is_first = False
            if self._frame and frame != self._frame:
                raise CameraError(
                    f"{self._topic} has poses in frame {frame!r}, not {self._frame!r}; write ?frame={frame}, or let "
                    "the driver publish that frame"
                )
            if self._child and child is None:
                raise CameraError(f"{self._topic} has {self._kind}, which names no body; leave out child=")
            self._frame, self._child = frame, self._child or child or ""
        if frame != self._frame:
            return OTHER_FRAME
        return OTHER_CHILD if child is not None and child != self._child else ""


def _convert_covariance(covariance: Sequence[float] | None) -> tuple[float, ...] | None:
    """Convert a covariance by rows to NED; None if it is not known: no variance of a position may be zero or less."""
    if covariance is None or not all(map(math.isfinite, covariance)):
        return None
    if min(covariance[0], covariance[7], covariance[14]) <= 0 or min(covariance[21::7]) < 0:
        return None
    return convert_covariance_to_ned(covariance, "enu")


def choose_type(topic: str, publishers: Sequence[Publisher]) -> str:
    """Return the type of a topic's messages.

    Raises:
        CameraError: It has not one publisher, or its messages are no poses.
    """
    if len(publishers) > 1:
        raise CameraError(
            f"{topic} has {len(publishers)} publishers ({list_nodes(publishers)}), whose poses would mix; give each a "
            "topic of its own"
        )
    (publisher,) = publishers
    if publisher.kind not in _READERS:
        raise CameraError(f"{topic} of {publisher.node} has {publisher.kind}; poses are {', '.join(POSE_TYPES)}")
    return publisher.kind


def list_nodes(publishers: Sequence[Publisher]) -> str:
    """Return the names of the publishers' nodes in words."""
    return ", ".join(sorted(publisher.node for publisher in publishers))


def describe_pose_topics(topics: Sequence[tuple[str, Sequence[str]]]) -> str:
    """Return the topics with poses, in words.

    Args:
        topics: Name and types of each.
    """
    names = sorted(name for name, kinds in topics if any(kind in _READERS for kind in kinds))
    return f"topics with poses: {', '.join(names)}" if names else "no topic with poses is heard"
