"""OptiTrack from end to end: a server of NatNet on loopback, the process that listens to it, and the daemon's link."""

from __future__ import annotations

import json
import os
import select
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable
from contextlib import closing

import pytest
from natnet_server import UPTIME_S, Body, Server, message
from patience import LIMIT_S, wait_until
from process_rig import child_of, running

from uavctl.config import Config, load_config
from uavctl.config.connections import find_security_warnings
from uavctl.errors import ConfigError, ConnectionSpecError, ExtraMissingError
from uavctl.event_codes import EventCode
from uavctl.io.admission import AdmissionRules
from uavctl.io.base import Connection
from uavctl.io.camera import COUNTS, READY, BodyPose, Echo
from uavctl.io.camera_host import CameraHost
from uavctl.io.daemon_pipe import OVERRUN
from uavctl.io.helper_process import MAX_RESTARTS
from uavctl.io.natnet import ECHO
from uavctl.io.signed_connection import open_links
from uavctl.io.sources import open_source
from uavctl.mavlink.codec import decode
from uavctl.mavlink.connection import MavlinkConnection
from uavctl.mavlink.messages import Position
from uavctl.records import PositionSample, Severity

HOST = "uavctl.io.camera_host"
DRONE, OTHER = Body(7, "drone 1", (1.0, 1.5, 2.0)), Body(3, "table")


def drone(**changes: object) -> Body:
    body = Body(7, "drone 1", (1.0, 1.5, 2.0))
    for name, value in changes.items():
        setattr(body, name, value)
    return body


def url(server: Server, rest: str = "drone%201") -> str:
    return f"natnet://127.0.0.1:{server.port}/{rest}"


class Desk:
    """The daemon's side: reads the connection into a link, and lets the link ask for the time."""

    def __init__(self, connection: Connection, config: Config) -> None:
        self.connection = connection
        self.record: list[tuple[bytes, int, int | None]] = []
        self.samples: list[PositionSample] = []
        self.link = make_link(config)

    def wait_until(self, done: Callable[[], bool]) -> None:
        """Serve until something holds; fails after `LIMIT_S`."""

        def served() -> bool:
            self.turn()
            return done()

        wait_until(served, "what the daemon is to be told", pause_s=0.0)

    def turn(self) -> None:
        select.select([self.connection], [], [], 0.02)
        for data, at_ns in self.connection.receive():
            self.record.append((data, at_ns, None))
            self.samples += [item for item in self.link.receive(data, at_ns).items if isinstance(item, PositionSample)]
        asked_ns = time.monotonic_ns()
        self.record.append((b"", 0, asked_ns))
        for data in self.link.due(asked_ns):
            self.connection.send(data)


def off_ns(link: MavlinkConnection) -> float:
    """Error of what the link believes of the server's clock."""
    return (link.stats(0).clock_offset_ns or 0) + UPTIME_S * 1e9


def age_ns(sample: PositionSample) -> int:
    return sample.received_ns - sample.captured_ns


def make_link(config: Config) -> MavlinkConnection:
    return MavlinkConnection(
        "mocap",
        roles=frozenset({"mocap"}),
        daemon=config.daemon,
        frame=config.frame,
        clock=config.clock,
        source=config.source,
        estimator=config.estimator,
    )


def test_a_body_becomes_samples_as_old_as_their_exposure_and_replays() -> None:
    # The exposure lies 30 ms before the sending: without the echoes the least delay would be taken for none.
    config = load_config("room-hahn-stursberg", ("frame.yaw_deg=90",))
    with Server([OTHER, DRONE], latency_s=0.03) as server, closing(open_source(url(server))) as connection:
        desk = Desk(connection, config)
        # An answer that was long under way tells less than the next ones.
        desk.wait_until(lambda: desk.link.stats(0).clock_source == "timesync" and abs(off_ns(desk.link)) < 5e6)
        assert server.echo_answers > 0
        desk.wait_until(lambda: len(desk.samples) > 20 and min(map(age_ns, desk.samples[-20:])) >= 25_000_000)
        sample = desk.samples[-1]
        # Y up: forward 1, right 2, down -1.5; turned by 90 degrees: north -2, east 1.
        assert sample.position_m == pytest.approx((-2.0, 1.0, -1.5))
        assert sample.source == "ODOMETRY 246/197"
        assert 4 in server.heard
    # Of the bytes alone, with the questions that were asked in between, a second link makes the same samples.
    again = make_link(config)
    repeated = []
    for data, at_ns, asked_ns in desk.record:
        if asked_ns is None:
            repeated += [item for item in again.receive(data, at_ns).items if isinstance(item, PositionSample)]
        else:
            again.due(asked_ns)
    assert repeated == desk.samples


def test_a_lost_body_gives_nothing_and_is_counted_until_it_is_back() -> None:
    body = drone()
    with Server([OTHER, body]) as server, closing(open_source(url(server))) as connection:
        desk = Desk(connection, load_config("room-hahn-stursberg"))
        desk.wait_until(lambda: bool(desk.samples))
        body.tracked = False
        desk.wait_until(lambda: connection.refused["untracked"] > 20)
        lost = len(desk.samples)
        for _ in range(20):
            desk.turn()
        assert len(desk.samples) == lost
        body.tracked = True
        desk.wait_until(lambda: len(desk.samples) > lost)


@pytest.mark.slow
def test_a_server_that_went_is_asked_until_it_is_back() -> None:
    with Server([DRONE]) as server, closing(open_source(url(server))) as connection:
        desk = Desk(connection, load_config("room-hahn-stursberg"))
        desk.wait_until(lambda: bool(desk.samples))
        server.__exit__()
        desk.wait_until(lambda: connection.refused["server-silent"] > 0)
        assert not connection.closed
        lost = len(desk.samples)
        with Server([drone(number=9)], port=server.port) as other:  # another number for the same body
            desk.wait_until(lambda: len(desk.samples) > lost)
            assert 0 in other.heard
        server.__enter__()


def test_a_group_is_joined() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        group = ("239.255.42.98", free.getsockname()[1])
    with (
        Server([DRONE], version=(3, 1), group=group, needs_mask=False) as server,
        closing(open_source(url(server) + "?interface=127.0.0.1")) as connection,
    ):
        desk = Desk(connection, load_config("room-hahn-stursberg"))
        desk.wait_until(lambda: len(desk.samples) > 3)


def test_the_process_ends_with_the_daemon() -> None:
    with Server([DRONE]) as server:
        daemon = (
            f"from uavctl.io.sources import open_source; c = open_source({url(server)!r}); print(flush=True); input()"
        )
        command = [sys.executable, "-c", daemon]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            process.stdout.readline()
            child = child_of(process.pid, HOST)
            process.kill()
        wait_until(lambda: not running(child), "the process ends")


@pytest.mark.slow
@pytest.mark.fault(92)
def test_92_a_process_that_dies_is_reported_and_started_again_for_a_limited_number_of_times() -> None:
    with Server([DRONE]) as server, closing(open_source(url(server))) as connection:
        desk = Desk(connection, load_config("room-hahn-stursberg"))
        reported: Counter[str] = Counter()
        for _ in range(MAX_RESTARTS + 1):
            count, told = len(desk.samples), reported.total()
            desk.wait_until(lambda count=count: len(desk.samples) > count)  # type: ignore[misc]
            os.kill(child_of(os.getpid(), HOST), signal.SIGKILL)
            desk.wait_until(lambda told=told: connection.refused.total() > told)  # type: ignore[misc]
            events = desk.link.add_refusals(connection.refused - reported, time.monotonic_ns())
            assert [event.severity for event in events if event.code == EventCode.PROCESS_ENDED] == [Severity.ERROR]
            reported = Counter(connection.refused)
        assert connection.closed
        connection.send(b"to nobody")
        assert connection.send_errors == 1


@pytest.mark.fault(91)
def test_91_a_forged_answer_with_a_time_that_cannot_be_is_ignored_and_counted() -> None:
    with Server([DRONE]) as server, closing(open_source(url(server))) as connection:
        desk = Desk(connection, load_config("room-hahn-stursberg"))
        desk.wait_until(lambda: bool(desk.samples))
        child = child_of(os.getpid(), HOST)
        server.send(message(ECHO, struct.pack("<QQ", 1, 2**64 - 1)))
        desk.wait_until(lambda: connection.refused["unreadable"] == 1)
        count = len(desk.samples)
        desk.wait_until(lambda: len(desk.samples) > count)
        assert child_of(os.getpid(), HOST) == child


@pytest.mark.parametrize(
    ("server", "rest", "words"),
    [
        (Server([OTHER, DRONE]), "dron", "no rigid body 'dron'; it has: 'drone 1', 'table'"),
        (Server([DRONE], version=(2, 10)), "drone%201", "NatNet 2.10, and this reads 3.0"),
        (Server([DRONE], short=True), "drone%201", "older NatNet than 3.0"),
    ],
)
def test_cameras_that_cannot_be_used(server: Server, rest: str, words: str) -> None:
    with server, pytest.raises(ConnectionSpecError, match=words) as caught:
        open_source(url(server, rest))
    assert not isinstance(caught.value.__cause__, OSError)


@pytest.mark.slow
def test_a_server_that_does_not_answer_is_a_matter_of_the_network() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as deaf:
        deaf.bind(("127.0.0.1", 0))
        with pytest.raises(ConnectionSpecError, match="no answer within 5 s; does Motive run") as caught:
            open_source(f"natnet://127.0.0.1:{deaf.getsockname()[1]}/drone")
    assert isinstance(caught.value.__cause__, OSError)


class Counting:
    """A camera that sees the numbers that its server sends."""

    group, awaits = None, ""

    def __init__(self) -> None:
        self.ready = False
        self.taken = 0
        self.dropped: Counter[str] = Counter()

    def receive(self, data: bytes, at_ns: int) -> tuple[BodyPose | Echo, ...]:
        self.taken += 1
        self.ready = True
        return (BodyPose(1000 * int(data), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)),)

    def due(self, at_ns: int) -> tuple[bytes, ...]:
        return (b"hello",)

    def ask_time(self, token: int) -> bytes:
        return b"time"


def test_a_daemon_that_does_not_read_finds_the_newest_and_how_many_were_dropped() -> None:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as server, theirs:
        server.bind(("127.0.0.1", 0))
        theirs.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 8192)
        camera = Counting()
        host = CameraHost({"drone": camera}, theirs, server.getsockname(), "127.0.0.1")
        thread = threading.Thread(target=host.run)
        thread.start()
        with ours, closing(host):
            _, client = server.recvfrom(100)
            for number in range(1, 501):
                server.sendto(b"%d" % number, client)
                if number % 50 == 0:  # the kernel's buffer must not be what drops
                    wait_until(lambda number=number: camera.taken == number, "all are taken")  # type: ignore[misc]
            ours.settimeout(LIMIT_S)
            assert ours.recv(65536) == READY  # before the position that the same datagram gave
            stamps: list[int] = []
            counts: dict[str, int] = {}
            while not stamps or stamps[-1] < 500 or OVERRUN not in counts:
                data = ours.recv(65536)
                if data[:1] == COUNTS:
                    counts = json.loads(data[1:])
                stamps += [m.stamp_us for m in decode(data).messages if isinstance(m, Position) and m.stamp_us]
            ours.close()
            thread.join()
        assert stamps == sorted(stamps)
        assert stamps[-64 + 2 :] == list(range(500 - 61, 501))  # all that waited, but for the word and the counts
        assert len(stamps) < 200


def test_what_is_wrong_before_anything_is_started(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ConnectionSpecError, match="needs a server"):
        open_source("natnet://127.0.0.1")
    with pytest.raises(ConnectionSpecError, match=r"not in security\.allow"):
        open_source("natnet://127.0.0.1/drone", rules=AdmissionRules(allow=("10.0.0.0/8",)))
    monkeypatch.setattr("uavctl.io.camera_process.find_spec", lambda name: None)
    with pytest.raises(ExtraMissingError) as caught:
        open_source("natnet://127.0.0.1/drone")
    assert (caught.value.package, caught.value.extra) == ("natnet", "optitrack")


def test_other_urls_are_opened_as_ever() -> None:
    with closing(open_source("udpin://127.0.0.1:0")) as connection:
        assert connection.receive() == []
    with pytest.raises(ConnectionSpecError, match="no known form"):
        open_source("vicon://127.0.0.1")


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (("daemon.vehicle=natnet://10.0.0.5/drone",), "daemon.vehicle: .* is a camera system"),
        (('source.messages=["VISION_POSITION_ESTIMATE"]',), "source.messages: leaves out ODOMETRY"),
        (("source.system_id=17",), "source.system_id: 17 is another system"),
        (("security.key_file=/etc/uavctl/vehicle.key",), 'security.require: "mocap" cannot be'),
    ],
)
def test_configurations_that_cannot_be(overrides: tuple[str, ...], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        load_config("room-hahn-stursberg", ("daemon.mocap=natnet://10.0.0.5/drone", *overrides))


def test_it_is_told_that_nothing_is_signed() -> None:
    config = load_config("room-hahn-stursberg", ("daemon.mocap=natnet://10.0.0.5/drone",))
    assert any(
        "natnet://10.0.0.5/drone has no signatures" in text
        for text in find_security_warnings(config.security, config.daemon)
    )


def test_the_daemon_opens_it_by_its_configuration() -> None:
    with Server([DRONE]) as server:
        config = load_config(
            "room-hahn-stursberg", ("daemon.vehicle=udpin://127.0.0.1:0", f"daemon.mocap={url(server)}")
        )
        with open_links(config) as connections:
            desk = Desk(connections["mocap"], config)
            desk.wait_until(lambda: bool(desk.samples))
