"""Poses in bags of ROS, by writers that know nothing of ours: they drive the controller as a source's positions do."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from foreign_rig import rows_of
from mcap.writer import Writer
from mcap_ros1._vendor.genpy.dynamic import generate_dynamic
from mcap_ros1.writer import Writer as Ros1Writer
from mcap_ros2.writer import Writer as Ros2Writer
from ros2_messages import make_message

from logs.recording.foreign import ForeignMcap, read_mcap
from uavctl.cli.app import run
from uavctl.config import load_config
from uavctl.errors import RecordingError, UsageError
from uavctl.mavlink.codec import decode
from uavctl.mavlink.messages import Position

S = 10**9
BORDER = "=" * 80
STAMP = f"{BORDER}\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
HEADER = f"{BORDER}\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n{STAMP}"
HEADER1 = f"{BORDER}\nMSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id\n"
QUATERNION = f"{BORDER}\nMSG: geometry_msgs/Quaternion\nfloat64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1\n"
POSE_PARTS = (
    f"{BORDER}\nMSG: geometry_msgs/Pose\nPoint position\nQuaternion orientation\n"
    f"{BORDER}\nMSG: geometry_msgs/Point\nfloat64 x\nfloat64 y\nfloat64 z\n{QUATERNION}"
)
COVARIANCE_PARTS = f"{BORDER}\nMSG: geometry_msgs/PoseWithCovariance\nPose pose\nfloat64[36] covariance\n{POSE_PARTS}"
# Fields and parts of each type, as ROS defines them; an Odometry's twist is left out of the messages here.
FIELDS = {
    "geometry_msgs/msg/PoseStamped": ("std_msgs/Header header\nPose pose\n", POSE_PARTS),
    "geometry_msgs/msg/PoseWithCovarianceStamped": (
        "std_msgs/Header header\nPoseWithCovariance pose\n",
        COVARIANCE_PARTS,
    ),
    "nav_msgs/msg/Odometry": (
        "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/PoseWithCovariance pose\n",
        COVARIANCE_PARTS,
    ),
    "geometry_msgs/msg/TransformStamped": (
        "std_msgs/Header header\nstring child_frame_id\nTransform transform\n",
        f"{BORDER}\nMSG: geometry_msgs/Transform\nVector3 translation\nQuaternion rotation\n"
        f"{BORDER}\nMSG: geometry_msgs/Vector3\nfloat64 x\nfloat64 y\nfloat64 z\n{QUATERNION}",
    ),
}
POSE = "geometry_msgs/msg/PoseStamped"
Row = tuple[str, int, Any]  # topic, log time, message


def write_bag(path: Path, rows: Sequence[Row], kind: str = POSE) -> Path:
    fields, parts = FIELDS[kind]
    with path.open("wb") as file, Ros2Writer(file) as writer:
        schema = writer.register_msgdef(kind, f"{fields}{parts}{HEADER}")
        for topic, at_ns, message in rows:
            writer.write_message(topic, schema, message, log_time=at_ns)
    return path


def write_ros1_bag(path: Path, rows: Sequence[Row]) -> Path:
    name, (fields, parts) = "geometry_msgs/PoseStamped", FIELDS[POSE]
    parts = parts.replace(" 0\n", "\n").replace(" 1\n", "\n")  # ROS 1 has no defaults
    kinds: Any = generate_dynamic(name, f"{fields}{parts}{HEADER1}")  # type: ignore[no-untyped-call]
    with path.open("wb") as file, Ros1Writer(file) as writer:
        for number, (topic, at_ns, message) in enumerate(rows):
            header = kinds["std_msgs/Header"](seq=number, frame_id="map")
            header.stamp.secs, header.stamp.nsecs = message.header.stamp.sec, message.header.stamp.nanosec
            position, turn = message.pose.position, message.pose.orientation
            pose = kinds["geometry_msgs/Pose"](
                position=kinds["geometry_msgs/Point"](**vars(position)),
                orientation=kinds["geometry_msgs/Quaternion"](**vars(turn)),
            )
            writer.write_message(topic, kinds[name](header=header, pose=pose), log_time=at_ns)
    return path


def circle(kind: str = POSE, count: int = 500, topic: str = "/drone/pose") -> list[Row]:
    """Positions on a circle, 50 a second, each heard 30 ms after its stamp."""
    rows: list[Row] = []
    for i in range(count):
        stamp_ns, angle = 1000 * S + i * S // 50, 0.3 * i / 50
        position = (0.5 * math.sin(angle), 0.5 * math.cos(angle), 1.2)
        message = make_message(kind.rpartition("/")[2], position, stamp=divmod(stamp_ns, S))
        rows.append((topic, stamp_ns + 30_000_000, message))
    return rows


def list_positions(found: ForeignMcap) -> list[Position]:
    messages = [message for packet in found.packets for message in decode(packet.data).messages]
    return [message for message in messages if isinstance(message, Position)]


@pytest.mark.parametrize("kind", FIELDS)
def test_each_pose_is_a_position_in_ned_with_its_stamp(tmp_path: Path, kind: str) -> None:
    rows = circle(kind, 20)
    found = read_mcap(write_bag(tmp_path / "a.mcap", rows, kind))
    assert found.topics == ("/drone/pose",) and not found.notes
    assert [packet.at_ns for packet in found.packets] == [at_ns for _, at_ns, _ in rows]
    for position, (_, at_ns, _), (_, _, plain) in zip(list_positions(found), rows, circle(POSE, 20), strict=True):
        at = plain.pose.position
        assert position.position_m == pytest.approx((at.y, at.x, -at.z), abs=1e-6)
        assert position.stamp_us == (at_ns - 30_000_000) // 1000


def test_poses_of_ros_1_are_read_too(tmp_path: Path) -> None:
    rows = circle(POSE, 20)
    ros2 = read_mcap(write_bag(tmp_path / "2.mcap", rows))
    assert read_mcap(write_ros1_bag(tmp_path / "1.mcap", rows)).packets == ros2.packets


def test_what_gives_no_pose_is_told(tmp_path: Path) -> None:
    rows = circle(POSE, 20)
    rows[5][2].pose.position.x = math.nan
    rows[7][2].header.stamp = SimpleNamespace(sec=0, nanosec=0)
    found = read_mcap(write_bag(tmp_path / "a.mcap", rows))
    assert len(list_positions(found)) == 18
    assert len(found.notes) == 1 and "2 messages left out" in found.notes[0]


def test_several_topics_are_not_mixed(tmp_path: Path) -> None:
    other = circle(POSE, 20, "/table/pose")
    path = write_bag(tmp_path / "a.mcap", [*circle(POSE, 20), *other])
    with pytest.raises(UsageError, match=r"--topic: /drone/pose, /table/pose"):
        read_mcap(path)
    assert read_mcap(path, ["/table/pose"]).topics == ("/table/pose",)


def test_mavlink_comes_before_poses(tmp_path: Path) -> None:
    beats = rows_of("px4-offboard.tlog")[:50]
    path = tmp_path / "a.mcap"
    fields, parts = FIELDS[POSE]
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema(POSE, "ros2msg", f"{fields}{parts}{HEADER}".encode())
        mavlink = writer.register_channel("/mavlink", "mavlink", schema_id=0)
        poses = writer.register_channel("/drone/pose", "cdr", schema_id=schema)
        for _, _, at_ns, data in beats:
            writer.add_message(mavlink, at_ns, data, at_ns)
        writer.add_message(poses, beats[0][2], b"\0\1\0\0", beats[0][2])
        writer.finish()  # type: ignore[no-untyped-call]
    assert read_mcap(path).topics == ("/mavlink",)
    with pytest.raises(RecordingError, match="1 message left out"):
        read_mcap(path, ["/drone/pose"])


def test_a_bag_drives_the_controller(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = circle()
    path = write_bag(tmp_path / "a.mcap", rows)
    assert run(["log", "replay", str(path), "--config", "room-hahn-stursberg", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert (result["positions"], result["rejected"], result["out_of_order"]) == (len(rows), 0, 0)
    assert result["accepted"] == len(rows)
    # All are equally late: with their clock unknown, each has the smallest delay, which the configuration states.
    latency_ms = load_config("room-hahn-stursberg").clock.latency_s * 1e3
    assert np.allclose([result["age_ms"][key] for key in ("min", "max")], latency_ms, atol=0.01)
    assert result["decisions"] > 50
