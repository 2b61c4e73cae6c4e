"""The simulated cameras as an OptiTrack server, heard by the package `natnet`, whose client is not ours."""

from __future__ import annotations

import math
import select
import socket
import struct
import threading
from collections.abc import Callable, Iterator
from typing import Any
from urllib.parse import urlsplit

import natnet
import pytest
from patience import wait_until
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from scipy.spatial.transform import Rotation

from sim.cameras import UPTIME_S
from sim.fleet import make_fleet
from sim.natnet import NatNetPort
from sim.ports import open_port
from sim.server import VehicleSetup, serve_all
from uavctl.config import load_config
from uavctl.errors import ConnectionSpecError
from uavctl.frames import Frame, Up
from uavctl.io.camera import BodyPose, Echo
from uavctl.io.natnet import UNTRACKED, NatNet
from uavctl.io.sources import open_source
from uavctl.mavlink.codec import decode
from uavctl.records import Truth, Vec3

NOW_US = 4_000_000_000
TURNED = (0.9, 0.1, -0.3, 0.3)  # w, x, y, z; made a unit below


def odometry(usec: int, where: Vec3, attitude: tuple[float, ...]) -> bytes:
    unknown = [math.nan, *([0.0] * 20)]
    msg = mavlink.MAVLink_odometry_message(usec, 20, 12, *where, list(attitude), *[0.0] * 6, unknown, unknown)
    return bytes(msg.pack(mavlink.MAVLink(None, 17, 197)))


class Talk:
    """A camera of ours and the simulator's port, over loopback, without waiting."""

    def __init__(self, port: NatNetPort, up: Up) -> None:
        self.port, self.camera, self.told = port, NatNet("drone 1", up), list[BodyPose | Echo]()
        port.clock_us = lambda: NOW_US
        self._socket = socket.socket(type=socket.SOCK_DGRAM)
        where = urlsplit(port.url)
        self._to = where.hostname, where.port
        self._said_ns = 0
        wait_until(self._introduced, "it names its bodies")

    def _introduced(self) -> bool:
        self._said_ns += 500_000_000
        self.ask(*self.camera.due(self._said_ns))
        return self.camera.ready

    def ask(self, *data: bytes) -> None:
        for one in data:
            self._socket.sendto(one, self._to)
            self.port.read()
        self.hear()

    def hear(self) -> None:
        """Take what has come."""
        while select.select([self._socket], [], [], 0.0)[0]:
            self.told += self.camera.receive(self._socket.recv(65536), self._said_ns)

    def close(self) -> None:
        self._socket.close()
        self.port.close()


@pytest.fixture(params=["y", "z"])
def talk(request: pytest.FixtureRequest) -> Iterator[Talk]:
    port = open_port(f"natnet://127.0.0.1:0/drone%201?up={request.param}")
    assert isinstance(port, NatNetPort)
    talk = Talk(port, request.param)
    yield talk
    talk.close()


def test_a_pose_and_its_time_arrive_as_the_cameras_saw_them(talk: Talk) -> None:
    turned = Rotation.from_quat([*TURNED[1:], TURNED[0]])
    x, y, z, w = turned.as_quat()
    talk.port.write(odometry(NOW_US - 5000, (1.0, 2.0, -3.0), (w, x, y, z)))
    talk.hear()
    (seen,) = talk.told
    assert isinstance(seen, BodyPose)
    assert seen.position_m == pytest.approx((1.0, 2.0, -3.0))
    assert Rotation.from_quat([*seen.attitude[1:], seen.attitude[0]]).approx_equal(turned, atol=1e-6)
    assert seen.exposed_ns == (NOW_US - 5000) * 1000


def test_it_answers_with_the_cameras_time(talk: Talk) -> None:
    talk.ask(talk.camera.ask_time(77))
    assert talk.told == [Echo(77, NOW_US * 1000)]


def test_while_nothing_is_seen_the_body_is_not_tracked_and_what_is_damaged_is_lost(talk: Talk) -> None:
    data = odometry(NOW_US, (1.0, 2.0, -3.0), (1.0, 0.0, 0.0, 0.0))
    talk.port.write(data[:40])
    talk.port.write(data[:40] + bytes([data[40] ^ 1]) + data[41:])

    def untracked() -> bool:
        talk.port.read()
        talk.hear()
        return talk.camera.dropped[UNTRACKED] > 0

    wait_until(untracked, "a frame without the body")
    assert talk.told == []


def test_no_bytes_of_a_client_break_it(talk: Talk) -> None:
    with socket.socket(type=socket.SOCK_DGRAM) as other:
        for size in range(20):
            for kind in (0, 1, 4, 10, 12, 700):
                other.sendto(
                    struct.pack("<HH", kind, size)[:size] + bytes(size),
                    ("127.0.0.1", int(urlsplit(talk.port.url).port or 0)),
                )
            talk.port.read()
    talk.port.write(odometry(NOW_US, (1.0, 2.0, -3.0), (1.0, 0.0, 0.0, 0.0)))
    talk.hear()
    assert len(talk.told) == 1


@pytest.mark.parametrize(
    "url",
    [
        "natnet://127.0.0.1:1510",
        "natnet://127.0.0.1:1510/",
        "natnet://127.0.0.1:x/drone",
        "natnet://127.0.0.1:0/drone?up=x",
        "natnet://127.0.0.1:0/drone?side=z",
        "natnet://127.0.0.1:0/drone,udpout://127.0.0.1:14560",
        "natnet://no.such.host.invalid/drone",
    ],
)
def test_urls_that_are_wrong(url: str) -> None:
    with pytest.raises(ConnectionSpecError, match="natnet:"):
        open_port(url)


def served(seats: tuple[VehicleSetup, ...], over: threading.Event, urls: list[str]) -> threading.Thread:
    thread = threading.Thread(
        target=lambda: serve_all(
            seats, duration_s=None, airborne=True, on_ready=lambda ready: urls.append(ready.mocap), stop=over.is_set
        )
    )
    thread.start()
    return thread


def heard(url: str, enough: Callable[[list[Any]], bool]) -> tuple[list[Any], list[Any]]:
    """Frames and descriptions that the package's own client gets."""
    frames: list[Any] = []
    described: list[Any] = []
    client: Any = natnet.NatNetClient(command_port=urlsplit(url).port, use_multicast=False)  # type: ignore[attr-defined]
    client.on_data_frame_received_event.handlers.append(frames.append)
    client.on_data_description_received_event.handlers.append(described.append)
    with client:
        client.request_modeldef()

        def came() -> bool:
            client.update_sync()
            return bool(described) and enough(frames)

        wait_until(came, "frames come")
    return frames, described


def test_the_client_of_another_package_sees_where_each_simulated_vehicle_is() -> None:
    truths: list[Truth] = []
    config = load_config("room-hahn-stursberg", ["link.loss=0.0", "sim.start_position_m=[0.5,-1.0,-1.5]"])
    seats = make_fleet(config, "udpin://127.0.0.1:0", "natnet://127.0.0.1:0/drone", 2, truths.append)
    over, urls = threading.Event(), list[str]()
    thread = served(seats, over, urls)
    try:
        wait_until(lambda: len(urls) == 2, "both serve")
        for url, east_m in zip(urls, (-1.0, 0.0), strict=True):
            frames, described = heard(url, lambda frames: any(one.rigid_bodies[0].tracking_valid for one in frames))
            (body,) = described[0].rigid_bodies
            assert body.name == "drone"
            seen = next(one.rigid_bodies[0] for one in frames if one.rigid_bodies[0].tracking_valid)
            assert seen.id_num == body.id_num
            assert seen.pos == pytest.approx((0.5, 1.5, east_m), abs=0.3)  # forward, up, right
    finally:
        over.set()
        thread.join()
    assert truths


@pytest.mark.slow
@pytest.mark.parametrize("up", ["", "?up=z"])
def test_the_daemon_s_own_source_has_them_where_the_vehicle_was(up: str) -> None:
    truths: list[Truth] = []
    config = load_config("room-hahn-stursberg", ["link.loss=0.0", "frame.yaw_deg=30.0", "frame.origin_m=[1.0,2.0,0.5]"])
    seats = (VehicleSetup(config, "udpin://127.0.0.1:0", f"natnet://127.0.0.1:0/drone%201{up}", truths.append),)
    over, urls = threading.Event(), list[str]()
    thread = served(seats, over, urls)
    seen: list[Any] = []
    try:
        wait_until(lambda: len(urls) == 1, "it serves")
        source = open_source(urls[0])

        def came() -> bool:
            seen.extend(msg for data, _ in source.receive() for msg in decode(data).messages)
            return len(seen) > 20 and len(truths) > 3

        wait_until(came, "positions come")
        source.close()
    finally:
        over.set()
        thread.join()
    frame = Frame(yaw_deg=30.0, origin_m=(1.0, 2.0, 0.5))
    for msg in seen:
        assert msg.convention == "ned"
        # The cameras' clock counts from the first truth.
        at_ns = truths[0].at_ns + msg.stamp_us * 1000 - round(UPTIME_S * 1e9)
        near = min(truths, key=lambda truth: abs(truth.at_ns - at_ns))
        assert frame.to_ned(msg.position_m) == pytest.approx(near.position_m, abs=0.2)


def test_a_vehicle_speaks_no_natnet() -> None:
    config = load_config("room-hahn-stursberg")
    seats = (VehicleSetup(config, "natnet://127.0.0.1:0/drone", "udpin://127.0.0.1:0", lambda _: None),)
    with pytest.raises(ConnectionSpecError, match="a vehicle speaks no NatNet"):
        serve_all(seats, duration_s=None, airborne=True, on_ready=lambda _: None, stop=lambda: True)


def test_ports_of_a_fleet_of_servers_follow_each_other() -> None:
    seats = make_fleet(
        load_config("room"), "udpin://127.0.0.1:5000", "natnet://127.0.0.1/drone%201?up=z", 2, lambda _: None
    )
    assert [seat.mocap for seat in seats] == [
        "natnet://127.0.0.1:1510/drone%201?up=z",
        "natnet://127.0.0.1:1511/drone%201?up=z",
    ]
