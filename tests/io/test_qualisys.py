"""Qualisys: packets built by hand, read with the package `qtm_rt`; then a whole source over loopback."""

from __future__ import annotations

import math
import socket
import struct
from collections.abc import Iterable
from contextlib import closing
from typing import Any

import pytest
from patience import wait_until
from qtm_server import UPTIME_US, QtmBody, QtmServer, command, frame, packet, parameters
from scipy.spatial.transform import Rotation
from work_rig import limit_calls

from uavctl.errors import ConnectionSpecError
from uavctl.frames import Up
from uavctl.io.base import Connection
from uavctl.io.camera import BodyPose, CameraError
from uavctl.io.camera_url import parse_camera_url
from uavctl.io.qualisys import MISSING, NO_MEASUREMENT, SILENT, UNREADABLE, UNTRACKED, Qualisys
from uavctl.io.sources import open_source
from uavctl.mavlink.codec import decode
from uavctl.mavlink.messages import Position

SECOND = 1_000_000_000
DRONE, TABLE = QtmBody("drone 1", (1.0, 2.0, 3.0)), QtmBody("table")
WELCOME = command("QTM RT Interface connected")


def ready(up: Up = "z") -> Qualisys:
    camera = Qualisys("drone 1", up)
    camera.receive(b"", 0)
    camera.receive(WELCOME + command("Version set to 1.25") + parameters(["table", "drone 1"]), 0)
    assert camera.ready
    camera.due(0)
    return camera


def sights(camera: Qualisys, data: bytes) -> list[BodyPose]:
    return [told for told in camera.receive(data, 0) if isinstance(told, BodyPose)]


def test_it_asks_for_version_names_and_frames_in_turn() -> None:
    camera = Qualisys("drone 1", "z")
    camera.receive(b"", 0)
    assert camera.due(0) == ()
    for heard, said in (
        (WELCOME, "Version 1.25"),
        (command("Version set to 1.25"), "GetParameters 6D"),
        (parameters(["table", "drone 1"]), "StreamFrames AllFrames 6D"),
    ):
        assert not camera.ready
        camera.receive(heard, 0)
        assert camera.due(0) == (command(said),)
    assert camera.ready and camera.ask_time(7) == b""


def test_a_count_is_not_believed_wherever_it_stands() -> None:
    whole = frame(1, 5_000_000, [TABLE, DRONE])
    for at in range(8, len(whole) - 3):
        camera = ready()
        with limit_calls(5000):
            camera.receive(whole[:at] + struct.pack("<I", 2**24) + whole[at + 4 :], 0)
    camera = ready()
    empty_components = struct.pack("<qII", 1, 1, 2**24) + struct.pack("<II", 0, 1) * 2
    with limit_calls(5000):
        camera.receive(packet(3, empty_components), 0)
    assert camera.dropped == {UNREADABLE: 1}
    assert sights(camera, whole)


@pytest.mark.parametrize("size", [1, 7, 50, 10_000])
def test_a_frame_gives_the_place_in_metres_however_the_stream_is_cut(size: int) -> None:
    camera = ready()
    stream = frame(1, 5_000_000, [TABLE, DRONE]) + frame(2, 5_010_000, [TABLE, DRONE])
    found = [one for at in range(0, len(stream), size) for one in sights(camera, stream[at : at + size])]
    assert [one.exposed_ns for one in found] == [5_000_000_000, 5_010_000_000]
    assert found[0].position_m == pytest.approx((1.0, -2.0, -3.0))
    assert found[0].attitude == (1.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize("up", ["y", "z"])
@pytest.mark.parametrize("turn", [(0.3, -0.8, 0.5), (3.1, 0.2, 0.1), (0.1, 3.1, -0.2), (0.2, -0.1, 3.1)])
def test_turns_agree_with_an_oracle_of_matrices(up: Up, turn: tuple[float, float, float]) -> None:
    turned = Rotation.from_rotvec(turn)
    columns = tuple(float(value) for value in turned.as_matrix().T.flatten())
    (seen,) = sights(ready(up), frame(1, 0, [TABLE, QtmBody("drone 1", columns=columns)]))
    right = (0.0, 0.0, 1.0) if up == "y" else (0.0, -1.0, 0.0)
    down = (0.0, -1.0, 0.0) if up == "y" else (0.0, 0.0, -1.0)
    axes = Rotation.from_matrix([list(row) for row in zip((1.0, 0.0, 0.0), right, down, strict=True)])
    want = axes.inv() * turned * axes
    assert Rotation.from_quat([*seen.attitude[1:], seen.attitude[0]]).approx_equal(want, atol=1e-5)


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (frame(1, 0, [TABLE, QtmBody("drone 1", seen=False)]), UNTRACKED),
        (frame(1, 0, [TABLE, QtmBody("drone 1", columns=(0.5,) * 9)]), UNTRACKED),
        (frame(1, 0, [TABLE, QtmBody("drone 1", (math.inf, 0.0, 0.0))]), UNTRACKED),
        (frame(1, 0, [TABLE]), MISSING),
        (packet(3, struct.pack("<qII", 0, 1, 0)), NO_MEASUREMENT),
        (packet(4, b""), NO_MEASUREMENT),
        (packet(3, b"\1\2"), UNREADABLE),
        (packet(3, struct.pack("<qIIII", 0, 1, 1, 8, 99)), UNREADABLE),
        (command("<", 2), UNREADABLE),
    ],
)
def test_what_gives_no_position_is_counted_and_the_next_frame_does(data: bytes, reason: str) -> None:
    camera = ready()
    assert sights(camera, data) == [] and camera.dropped == {reason: 1}
    assert len(sights(camera, frame(2, 0, [TABLE, DRONE]))) == 1


def test_a_stream_out_of_step_is_begun_anew() -> None:
    camera = ready()
    camera.receive(struct.pack("<II", 3, 3), 0)
    assert camera.dropped == {UNREADABLE: 1} and camera.due(0) == (command("Quit"),)
    camera.receive(b"", SECOND)  # the next connection
    camera.receive(WELCOME + command("Version set to 1.25") + parameters(["drone 1"]), SECOND)
    assert len(sights(camera, frame(1, 0, [DRONE]))) == 1


def test_bodies_that_change_are_asked_for_anew_and_a_silent_server_too() -> None:
    camera = ready()
    camera.receive(packet(6, b"\x0b"), 0)
    assert camera.due(0) == (command("GetParameters 6D"),)
    camera.receive(parameters(["drone 1", "table"]), 0)
    assert camera.due(0) == (command("StreamFrames AllFrames 6D"),)
    (seen,) = sights(camera, frame(1, 0, [DRONE, TABLE]))
    assert seen.position_m[0] == pytest.approx(1.0)
    assert camera.due(2 * SECOND) == (command("GetParameters 6D"),) and camera.dropped == {SILENT: 1}
    camera.receive(parameters(["table"]), 2 * SECOND)  # in flight: no error, no positions
    assert sights(camera, frame(2, 0, [TABLE])) == [] and camera.dropped[MISSING] == 1


def test_a_wrong_name_and_a_refused_version_are_told() -> None:
    camera = Qualisys("dron", "z")
    with pytest.raises(CameraError, match="no rigid body 'dron'; it has: 'drone 1', 'table'"):
        camera.receive(parameters(["table", "drone 1"]), 0)
    with pytest.raises(CameraError, match="refused a request: Version NOT supported"):
        camera.receive(command("Version NOT supported", 0), 0)


def test_z_is_up_where_the_url_says_nothing() -> None:
    assert (parse_camera_url("qualisys://10.0.0.5/drone").up, parse_camera_url("qualisys://10.0.0.5/drone").port) == (
        "z",
        22223,
    )
    assert parse_camera_url("qualisys://10.0.0.5/drone?up=y").up == "y"
    assert parse_camera_url("natnet://10.0.0.5/drone").up == "y"


def url(server: QtmServer, body: str = "drone%201") -> str:
    return f"qualisys://127.0.0.1:{server.port}/{body}"


def positions(connection: Connection) -> list[Any]:
    heard: Iterable[tuple[bytes, int]] = connection.receive()
    return [msg for data, _ in heard for msg in decode(data).messages if isinstance(msg, Position)]


def test_a_body_becomes_positions_and_a_lost_connection_is_made_again() -> None:
    with QtmServer([TABLE, DRONE]) as server, closing(open_source(url(server))) as connection:
        found: list[Any] = []

        def came() -> bool:
            found.extend(positions(connection))
            return len(found) > 5

        wait_until(came, "positions come")
        assert found[0].position_m == pytest.approx((1.0, -2.0, -3.0), abs=1e-6)
        assert found[0].stamp_us > UPTIME_US and found[0].name == "ODOMETRY"
        server.hang_up()
        wait_until(lambda: server.connections == 2, "it connects again")
        positions(connection)
        found.clear()
        wait_until(came, "positions come again")
        wait_until(
            lambda: not connection.receive() or connection.refused["connection-lost"] == 1, "the loss is counted"
        )


@pytest.mark.parametrize(
    ("server", "body", "words"),
    [
        (QtmServer([TABLE]), "drone", "no rigid body 'drone'; it has: 'table'"),
        (QtmServer([TABLE], refuses="Version NOT supported"), "table", "Version NOT supported"),
    ],
)
def test_a_server_that_cannot_be_used_says_why(server: QtmServer, body: str, words: str) -> None:
    with server, pytest.raises(ConnectionSpecError, match=words):
        open_source(url(server, body))


def test_a_server_that_is_not_there_is_told_with_what_to_look_at() -> None:
    with socket.socket() as nobody:
        nobody.bind(("127.0.0.1", 0))
        with pytest.raises(ConnectionSpecError, match=r"refused; does QTM run there"):
            open_source(f"qualisys://127.0.0.1:{nobody.getsockname()[1]}/drone")
