"""Poses in recordings of ROS as MAVLink: each message becomes the ODOMETRY that source `ros2://` gives for it."""

from __future__ import annotations

from types import SimpleNamespace

from logs.recording.mavros import (
    DEFINITION_ENCODINGS,
    MAX_DEFINITION_BYTES,
    Definitions,
    RosReader,
    UnreadableError,
    Value,
    normalise_type_name,
    parse_definition,
)
from uavctl.io.camera import CameraError
from uavctl.io.camera_host import CameraMessageEncoder
from uavctl.io.ros2_pose import POSE_TYPES, PoseReader

_POSE_TYPES = {normalise_type_name(name): name for name in POSE_TYPES}
STATE_BYTES = 4096  # of memory for each channel of poses, beside its definition


class PoseUnwrapper:
    """Reader of the poses in a channel's messages. It counts frames, so a channel has one of its own.

    Args:
        types: Fields of each type.
        name: Type of a message.
        encoding: Encoding of messages, of ROS 1 or 2.
        topic: For errors.
    """

    def __init__(self, types: Definitions, name: str, encoding: str, topic: str) -> None:
        self._types, self._top, self._encoding = types, normalise_type_name(name), encoding
        self._reader = PoseReader(_POSE_TYPES[self._top], topic)
        self._encoder: CameraMessageEncoder | None = None

    def __call__(self, data: bytes) -> bytes:
        """Return the frame of a pose.

        Raises:
            UnreadableError: The message is damaged, or gives no pose.
        """
        message = _make_object(RosReader(data, self._types, self._encoding).read_record(self._top))
        try:
            pose = self._reader.read(message)
        except (AttributeError, TypeError, ValueError, IndexError, CameraError) as error:
            raise UnreadableError(f"it is no {self._top} by its definition ({error})") from error
        if pose is None:
            raise UnreadableError(f"no pose: {', '.join(sorted(self._reader.dropped))}")
        self._encoder = self._encoder or CameraMessageEncoder()
        return self._encoder.encode(pose)


def parse_pose_type(encoding: str, schema_encoding: str, name: str, definition: bytes) -> Definitions | None:
    """Return the fields of all types in a definition, if its messages are poses of ROS; None if they are not."""
    top = normalise_type_name(name)
    if top not in _POSE_TYPES or DEFINITION_ENCODINGS.get(encoding) != schema_encoding:
        return None
    if len(definition) > MAX_DEFINITION_BYTES:
        return None
    try:
        return parse_definition(top, definition.decode("utf-8", errors="replace"))
    except UnreadableError:
        return None


def _make_object(value: Value) -> object:
    """Return a message's value with attributes, as messages of ROS have them."""
    if isinstance(value, bytes):
        return value.rstrip(b"\0").decode("utf-8", errors="replace")
    if not isinstance(value, dict):
        return value
    fields = {name: _make_object(part) for name, part in value.items()}
    stamp = fields.get("stamp")  # a list of seconds and nanoseconds
    if isinstance(stamp, list) and len(stamp) == 2:
        fields["stamp"] = SimpleNamespace(sec=stamp[0], nanosec=stamp[1])
    return SimpleNamespace(**fields)
