"""The language of NatNet, without sockets: frames of an encoder of the tests' own, read with the package `natnet`."""

from __future__ import annotations

import math
import struct

import pytest
from natnet_server import TICKS_PER_S, UPTIME_S, Body, descriptions, frame, message, server_info
from scipy.spatial.transform import Rotation
from work_rig import limit_calls, limit_memory

from uavctl.errors import ConnectionSpecError
from uavctl.frames import Frame, Up, convert_pose_to_frd, rotate_vector
from uavctl.io.camera import BodyPose, CameraError, Echo
from uavctl.io.camera_host import CameraMessageEncoder, parse_time_requests
from uavctl.io.camera_url import CameraUrl, parse_camera_url
from uavctl.io.natnet import MISSING, NO_STAMP, SILENT, UNREADABLE, UNTRACKED, NatNet
from uavctl.mavlink.codec import decode
from uavctl.mavlink.messages import Position, TimeSync

SECOND = 1_000_000_000
VERSIONS = ((3, 0), (3, 1), (4, 0), (4, 1), (4, 2), (4, 4))
DRONE, OTHER = Body(7, "drone 1", (1.0, 2.0, 3.0)), Body(3, "table")


def ready(version: tuple[int, int] = (4, 1), up: Up = "z") -> NatNet:
    camera = NatNet("drone 1", up)
    camera.receive(server_info(version), 0)
    camera.receive(descriptions([OTHER, DRONE], version), 0)
    assert camera.ready
    return camera


def sights(camera: NatNet, data: bytes, at_ns: int = 0) -> list[BodyPose]:
    return [told for told in camera.receive(data, at_ns) if isinstance(told, BodyPose)]


@pytest.mark.parametrize("version", VERSIONS)
def test_a_frame_gives_the_place_of_the_body_and_the_time_of_exposure(version: tuple[int, int]) -> None:
    camera = ready(version)
    (sight,) = sights(camera, frame(1, [OTHER, DRONE], version, 10.0, 10.004))
    assert sight.position_m == (1.0, -2.0, -3.0)
    assert sight.exposed_ns == round((UPTIME_S + 10.0) * 1e9)
    assert sight.attitude == (1.0, 0.0, 0.0, 0.0)
    assert not camera.dropped


@pytest.mark.parametrize(
    ("body", "reason"),
    [
        (Body(7, "drone 1", tracked=False), UNTRACKED),
        (Body(7, "drone 1", (math.nan, 0.0, 0.0)), UNTRACKED),
        (Body(7, "drone 1", xyzw=(0.0, 0.0, 0.0, 0.0)), UNTRACKED),
        (Body(7, "drone 1", shown=False), MISSING),
    ],
)
def test_a_body_that_is_not_tracked_gives_no_sample(body: Body, reason: str) -> None:
    camera = ready()
    assert sights(camera, frame(1, [OTHER, body], (4, 1), 10.0, 10.004)) == []
    assert camera.dropped == {reason: 1}
    assert sights(camera, frame(2, [OTHER, DRONE], (4, 1), 10.01, 10.014))  # and comes back


@pytest.mark.parametrize("version", [(3, 1), (4, 1)])
def test_a_count_is_not_believed_wherever_it_stands(version: tuple[int, int]) -> None:
    camera = ready(version)
    for whole in (frame(1, [OTHER, DRONE], version, 10.0, 10.004), descriptions([OTHER, DRONE], version)):
        for at in range(4, len(whole) - 3):
            data = whole[:at] + struct.pack("<I", 2**24) + whole[at + 4 :]
            with limit_memory(200_000), limit_calls(5000):
                camera.receive(data, 0)
    assert camera.dropped[UNREADABLE] > 0
    assert sights(ready(version), frame(2, [OTHER, DRONE], version, 10.01, 10.014))


def test_frames_without_a_time_of_exposure_are_refused() -> None:
    camera = ready()
    assert sights(camera, frame(1, [DRONE], (4, 1), 10.0, 10.004, stamped=False)) == []
    assert sights(camera, frame(1, [DRONE], (4, 1), 10.0, 12.0)) == []  # two seconds on the way inside Motive: no
    assert sights(camera, frame(1, [DRONE], (4, 1), 10.0, 9.9)) == []
    assert camera.dropped == {NO_STAMP: 1, UNREADABLE: 2}


def test_a_wrong_name_is_told_with_the_names_there_are() -> None:
    camera = NatNet("dron", "y")
    camera.receive(server_info((4, 1)), 0)
    with pytest.raises(CameraError, match="no rigid body 'dron'; it has: 'drone 1', 'table'"):
        camera.receive(descriptions([OTHER, DRONE], (4, 1)), 0)
    with pytest.raises(CameraError, match="it has: none"):
        camera.receive(descriptions([], (4, 1)), 0)


@pytest.mark.parametrize(
    ("info", "words"),
    [
        (server_info((2, 10)), "NatNet 2.10, and this reads 3.0 to 4.x"),
        (server_info((5, 0)), "NatNet 5.0, and this reads"),
        (server_info((2, 5), short=True), "older NatNet than 3.0"),
        (server_info((4, 1), rate=0), "without the rate of its clock"),
    ],
)
def test_other_versions_are_refused(info: bytes, words: str) -> None:
    with pytest.raises(CameraError, match=words):
        NatNet("drone 1", "y").receive(info, 0)


def test_no_bytes_break_it() -> None:
    camera = ready()
    good = frame(1, [OTHER, DRONE], (4, 1), 10.0, 10.004)
    payload = good[4:]
    for cut in range(len(payload)):
        camera.receive(message(7, payload[:cut]), 0)
        camera.receive(good[:cut], 0)
    for kind in (0, 1, 5, 13, 100):
        for length in (0, 1, 3, 40):
            camera.receive(message(kind, b"\xff" * length), 0)
    assert set(camera.dropped) <= {UNREADABLE, MISSING, NO_STAMP, UNTRACKED}
    assert sights(camera, good)


def test_frames_of_another_layout_give_nothing() -> None:
    camera = ready((4, 1))
    for number in range(20):
        assert sights(camera, frame(number, [OTHER, DRONE], (3, 1), 10.0, 10.004)) == []
    assert camera.dropped.total() == 20


def test_it_asks_until_it_is_answered_and_again_when_the_server_is_silent() -> None:
    camera = NatNet("drone 1", "y")
    asked = [camera.due(at_ns) for at_ns in range(0, SECOND, SECOND // 10)]
    connect = message(0, b"Ping\0")
    assert [data for (data,) in filter(None, asked)] == [connect, connect]
    assert camera.awaits == "answer"
    camera.receive(server_info((4, 1)), SECOND)
    assert camera.awaits.startswith("names of rigid bodies")
    said = [data for tenth in range(10, 20) for data in camera.due(tenth * SECOND // 10)]
    wanted = [message(4, struct.pack("<I", 2)), message(4, b"")]  # with the mask of Motive 3, and without
    assert [data for data in said if data != message(10, b"")] == wanted
    camera.receive(server_info((4, 1)), 3 * SECOND)
    camera.receive(descriptions([DRONE], (4, 1)), 3 * SECOND)
    assert [camera.due(3 * SECOND + k) for k in (1, 2)] == [(message(10, b""),), ()]  # once a second
    assert camera.due(5 * SECOND) == (connect,)
    assert camera.dropped == {SILENT: 1}
    # It came back with another number for the body.
    camera.receive(server_info((4, 1)), 6 * SECOND)
    moved = Body(9, "drone 1", (4.0, 0.0, 0.0))
    assert sights(camera, frame(1, [moved], (4, 1), 10.0, 10.004), 6 * SECOND) == []
    camera.receive(descriptions([moved], (4, 1)), 6 * SECOND)
    (sight,) = sights(camera, frame(2, [moved], (4, 1), 10.0, 10.004), 6 * SECOND)
    assert sight.position_m[0] == 4.0


@pytest.mark.parametrize("up", ["y", "z"])
def test_poses_agree_with_an_oracle_of_matrices(up: Up) -> None:
    # Columns: forward, right, down in the camera's axes. The first axis is forward, what is up is not down.
    up_axis = [0.0, 1.0, 0.0] if up == "y" else [0.0, 0.0, 1.0]
    forward, down = [1.0, 0.0, 0.0], [-value for value in up_axis]
    right = [
        down[1] * forward[2] - down[2] * forward[1],
        down[2] * forward[0] - down[0] * forward[2],
        down[0] * forward[1] - down[1] * forward[0],
    ]
    axes = Rotation.from_matrix([list(row) for row in zip(forward, right, down, strict=True)])
    turned = Rotation.from_rotvec([0.3, -0.8, 0.5])
    x, y, z, w = turned.as_quat()
    position_m, attitude = convert_pose_to_frd((1.0, 2.0, 3.0), (w, x, y, z), up)
    assert position_m == pytest.approx(axes.inv().apply([1.0, 2.0, 3.0]))
    want = axes.inv() * turned * axes
    for vector in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)):
        assert rotate_vector(attitude, vector) == pytest.approx(want.apply(vector))


@pytest.mark.parametrize(("up", "place"), [("y", (0.0, 1.5, 0.0)), ("z", (0.0, 0.0, 1.5))])
def test_a_raised_body_is_above_the_floor_and_a_nose_to_the_left_turns_left(
    up: Up, place: tuple[float, float, float]
) -> None:
    half = math.radians(30.0) / 2  # about the axis that points up: to the left, seen from above
    axis = (0.0, math.sin(half), 0.0) if up == "y" else (0.0, 0.0, math.sin(half))
    position_m, attitude = convert_pose_to_frd(place, (math.cos(half), *axis), up)
    assert position_m == (0.0, 0.0, -1.5)
    nose = rotate_vector(Frame(yaw_deg=90.0).attitude_to_ned(attitude, euler=False), (1.0, 0.0, 0.0))
    assert nose == pytest.approx((math.cos(math.radians(60)), math.sin(math.radians(60)), 0.0))


def test_what_is_said_is_mavlink_that_declares_its_axes() -> None:
    words = CameraMessageEncoder()
    said = words.encode(BodyPose(5_000_000_123_000, (1.0, 2.0, -3.0), (1.0, 0.0, 0.0, 0.0)))
    (position,) = decode(said).messages
    assert isinstance(position, Position)
    assert (position.name, position.system, position.stamp_us) == ("ODOMETRY", 246, 5_000_000_123)
    assert (position.position_m, position.convention, position.velocity_mps) == ((1.0, 2.0, -3.0), "ned", None)
    assert position.attitude == (1.0, 0.0, 0.0, 0.0)
    (answer,) = decode(words.encode(Echo(77, 88))).messages
    assert isinstance(answer, TimeSync)
    assert (answer.tc1_ns, answer.ts1_ns) == (88, 77)


def test_an_echo_is_the_servers_clock() -> None:
    camera = ready()
    assert camera.ask_time(77) == message(12, struct.pack("<Q", 77))
    answer = message(13, struct.pack("<QQ", 77, 3 * TICKS_PER_S + 1))
    assert camera.receive(answer, 0) == (Echo(77, 3 * SECOND + 100),)
    assert parse_time_requests(b"\x00" * 30) == ()


def test_urls() -> None:
    assert parse_camera_url("natnet://10.0.0.5/drone%201") == CameraUrl("natnet", "10.0.0.5", 1510, "drone 1")
    given = parse_camera_url("natnet://motive:1600/a/b?up=z&interface=10.0.0.9")
    assert given == CameraUrl("natnet", "motive", 1600, "a/b", "z", "10.0.0.9")


@pytest.mark.parametrize(
    ("url", "words"),
    [
        ("natnet://10.0.0.5", "needs a server and the name"),
        ("natnet:///drone", "needs a server and the name"),
        ("natnet://10.0.0.5:0/drone", "needs a server"),
        ("natnet://10.0.0.5:x/drone", "Port"),
        ("natnet://10.0.0.5/drone?up=x", "neither y nor z"),
        ("natnet://10.0.0.5/drone?group=1", "option 'group' is not known"),
        ("natnet://10.0.0.5/drone?interface=eth0", "interface"),
        ("natnet://10.0.0.5/drone?up", "write natnet"),
        ("natnet://10.0.0.5/drone#1", "needs a server"),
    ],
)
def test_urls_that_are_wrong(url: str, words: str) -> None:
    with pytest.raises(ConnectionSpecError, match=words):
        parse_camera_url(url)


def test_a_server_that_began_anew_is_asked_to_stream_though_it_answers_questions() -> None:
    # It answers who asks for the time, and streams only to who asked to connect: an answer is no sign of a stream.
    camera = ready()
    sights(camera, frame(1, [DRONE], (4, 1), 10.0, 10.004), SECOND)
    said: list[bytes] = []
    for tenth in range(11, 31):
        camera.receive(message(13, struct.pack("<QQ", 1, TICKS_PER_S)), tenth * SECOND // 10)
        said += camera.due(tenth * SECOND // 10)
    assert message(0, b"Ping\0") in said
    assert camera.dropped[SILENT]
