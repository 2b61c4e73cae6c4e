"""Connections on 127.0.0.1 and a pseudo terminal."""

from __future__ import annotations

import os
import pty
import socket
import time
import tty
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager

import pytest
from patience import LIMIT_S, wait_until
from transport_rig import FRAME, LIMIT_NS, Clock, port_of

from uavctl.errors import ConnectionSpecError
from uavctl.event_codes import EventCode
from uavctl.io.base import Connection
from uavctl.io.byte_stream import RETRY_NS
from uavctl.io.transport import open_connection, wait
from uavctl.io.udp import PEER_SILENCE_NS


@contextmanager
def opened(url: str, now: Callable[[], int] = time.monotonic_ns) -> Iterator[Connection]:
    with closing(open_connection(url, now)) as connection:
        yield connection


@contextmanager
def udp() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
        peer.bind(("127.0.0.1", 0))
        peer.settimeout(LIMIT_S)
        yield peer


def arrived(connection: Connection, at_least: int = 1) -> list[bytes]:
    """Data that arrives, waited for while there is a connection."""
    got: list[bytes] = []
    deadline_ns = time.monotonic_ns() + LIMIT_NS
    while (
        sum(map(len, got)) < at_least
        and not connection.closed
        and connection.filenos()
        and wait({"it": connection}, deadline_ns)
    ):
        got += [data for data, _ in connection.receive()]
    return got


@pytest.mark.parametrize(
    "url",
    [
        "",
        "udp://127.0.0.1:14540",
        "udpin:127.0.0.1:14540",
        "udpin://127.0.0.1",
        "udpin://:14540",
        "udpin://127.0.0.1:99999",
        "udpin://127.0.0.1:port",
        "udpin://127.0.0.1:14540/path",
        "tcp://[::1:5760",
        "serial:///dev/ttyUSB0",
        "serial:///dev/ttyUSB0:fast",
        "serial:///dev/ttyUSB0:0",
        "serial://ttyUSB0:57600",
    ],
)
def test_malformed_urls_say_what_to_write(url: str) -> None:
    with pytest.raises(ConnectionSpecError, match=r"write .*(udpin|serial)://"):
        open_connection(url)


def test_an_unknown_host_is_told() -> None:
    with pytest.raises(ConnectionSpecError, match=r"host 'no\.such\.host\.invalid' is unknown"):
        open_connection("udpout://no.such.host.invalid:1")


def test_a_port_in_use_is_told() -> None:
    with udp() as other, pytest.raises(ConnectionSpecError, match="another program uses this port"):
        open_connection(f"udpin://127.0.0.1:{other.getsockname()[1]}")


def test_an_address_of_another_computer_is_told() -> None:
    with pytest.raises(ConnectionSpecError, match=r"no address of this computer; 0\.0\.0\.0"):
        open_connection("udpin://192.0.2.7:15560")


def test_a_missing_device_is_told() -> None:
    with pytest.raises(ConnectionSpecError, match="check the device"):
        open_connection("serial:///dev/no-such-device:57600")


def test_a_refused_tcp_connection_is_told() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    with pytest.raises(ConnectionSpecError, match="is the vehicle or simulator running"):
        open_connection(f"tcp://127.0.0.1:{port}")


def test_udpin_hands_on_datagrams_with_their_times() -> None:
    with opened("udpin://127.0.0.1:0") as connection, udp() as peer:
        before = time.monotonic_ns()
        for data in (FRAME, b"x", FRAME * 3):
            peer.sendto(data, ("127.0.0.1", port_of(connection)))
        got: list[tuple[bytes, int]] = []
        while len(got) < 3 and wait({"it": connection}, before + LIMIT_NS):
            got += connection.receive()
        assert [data for data, _ in got] == [FRAME, b"x", FRAME * 3]
        times = [received_ns for _, received_ns in got]
        assert times == sorted(times)
        assert before <= times[0] <= times[-1] <= time.monotonic_ns()
        assert connection.receive() == []


def test_udpin_answers_the_first_peer_and_another_only_after_silence() -> None:
    clock = Clock()
    with opened("udpin://127.0.0.1:0", clock) as connection, udp() as first, udp() as second:
        to = ("127.0.0.1", port_of(connection))
        connection.send(b"nobody is there")
        second.sendto(b"no MAVLink", to)
        assert arrived(connection) == [b"no MAVLink"]
        connection.send(b"still nobody")
        first.sendto(FRAME, to)
        arrived(connection)
        clock.now_ns += PEER_SILENCE_NS
        second.sendto(FRAME, to)
        assert arrived(connection) == [FRAME]  # heard, but not answered
        connection.send(b"to the first")
        assert first.recv(100) == b"to the first"
        clock.now_ns += 1
        second.sendto(FRAME, to)
        arrived(connection)
        connection.send(b"to the second")
        assert second.recv(100) == b"to the second"
        assert connection.send_errors == 0


def test_udpout_talks_to_its_peer() -> None:
    with udp() as peer, opened(f"udpout://127.0.0.1:{peer.getsockname()[1]}") as connection:
        connection.send(b"hello")
        data, address = peer.recvfrom(100)
        assert data == b"hello"
        peer.sendto(FRAME, address)
        assert arrived(connection) == [FRAME]


def test_udpout_survives_a_peer_that_is_not_there() -> None:
    with udp() as peer:
        port = peer.getsockname()[1]
    with opened(f"udpout://127.0.0.1:{port}") as connection:
        for _ in range(20):
            connection.send(FRAME)
            connection.receive()
        assert connection.send_errors + connection.receive_errors > 0
        assert not connection.closed


def test_tcp_carries_bytes_both_ways_and_counts_the_end() -> None:
    with (
        socket.create_server(("127.0.0.1", 0)) as server,
        opened(f"tcp://127.0.0.1:{server.getsockname()[1]}") as connection,
    ):
        peer, _ = server.accept()
        with peer:
            peer.settimeout(LIMIT_S)
            connection.send(FRAME)
            assert peer.recv(100) == FRAME
            peer.sendall(FRAME * 4)
            assert b"".join(arrived(connection, 12)) == FRAME * 4
            assert not connection.closed
        assert arrived(connection) == []
        assert connection.refused == {EventCode.HUNG_UP: 1} and not connection.closed
        connection.send(FRAME)  # no error into the loop
        assert connection.send_errors == 1
        assert wait({"it": connection}, time.monotonic_ns()) == []


def test_tcp_calls_a_peer_again_that_has_hung_up_and_never_waits_for_it() -> None:
    clock = [0]
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = server.getsockname()
        connection = open_connection(f"tcp://127.0.0.1:{address[1]}", lambda: clock[0])
        peer, _ = server.accept()
        peer.settimeout(LIMIT_S)
        half = bytes(2048)
        while connection.send_errors == 0:  # until something of a frame waits
            connection.send(half)
        peer.close()
    with closing(connection):
        wait_until(lambda: connection.receive() == [] and bool(connection.refused), "the end is noticed")
        for _ in range(3):  # nobody listens
            clock[0] += RETRY_NS
            assert connection.receive() == [] and wait({"it": connection}, time.monotonic_ns()) == []
        with socket.create_server(address) as server:
            assert connection.receive() == []  # its time has not come
            server.settimeout(0.0)
            with pytest.raises(BlockingIOError):
                server.accept()
            clock[0] += RETRY_NS
            connection.receive()
            server.settimeout(LIMIT_S)
            peer, _ = server.accept()
            with peer:
                peer.settimeout(LIMIT_S)
                wait_until(lambda: connection.receive() == [] and connection.filenos() != (), "the connection stands")
                peer.sendall(FRAME)
                assert b"".join(arrived(connection, len(FRAME))) == FRAME
                connection.send(FRAME)
                assert peer.recv(4096) == FRAME  # nothing of what waited for the one before
        assert connection.refused == {EventCode.HUNG_UP: 1}


def test_tcp_makes_a_connection_again_that_has_fallen_silent() -> None:
    clock = [0]
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(LIMIT_S)
        with closing(open_connection(f"tcp://127.0.0.1:{server.getsockname()[1]}", lambda: clock[0])) as connection:
            peer, _ = server.accept()
            with peer:
                clock[0] += 10 * PEER_SILENCE_NS  # a vehicle that is still starting up
                assert connection.receive() == [] and not connection.refused
                peer.sendall(FRAME)
                assert b"".join(arrived(connection, len(FRAME))) == FRAME
                connection.send(FRAME)
                clock[0] += PEER_SILENCE_NS
                assert connection.receive() == [] and not connection.refused
                clock[0] += 1
                assert connection.receive() == [] and connection.refused == {EventCode.CONNECTION_SILENT: 1}
                peer.settimeout(LIMIT_S)
                with pytest.raises(ConnectionResetError):  # an end that is still there knows at once
                    while peer.recv(100):
                        pass
            for again in (2, 3):  # the next one is given as long
                clock[0] += RETRY_NS
                wait_until(lambda: connection.receive() == [] and connection.filenos() != (), "the connection stands")
                peer, _ = server.accept()
                with peer:
                    clock[0] += PEER_SILENCE_NS
                    assert connection.receive() == [] and connection.refused == {EventCode.CONNECTION_SILENT: again - 1}
                    clock[0] += 1
                    assert connection.receive() == [] and connection.refused == {EventCode.CONNECTION_SILENT: again}


def test_tcp_never_cuts_a_frame_when_the_peer_does_not_read() -> None:
    frame = bytes((0xFD,)) + bytes(199)
    with (
        socket.create_server(("127.0.0.1", 0)) as server,
        opened(f"tcp://127.0.0.1:{server.getsockname()[1]}") as connection,
    ):
        peer, _ = server.accept()
        with peer:
            sent = 0
            while connection.send_errors < 3:
                connection.send(frame)
                sent += 1
            taken = (sent - connection.send_errors) * len(frame)
            peer.settimeout(LIMIT_S)
            got = b""
            while len(got) < taken:
                got += peer.recv(65_536)
                connection.send(b"")  # writes what waits
            assert got == frame * (taken // len(frame))


@contextmanager
def terminal() -> Iterator[tuple[int, str]]:
    far, near = pty.openpty()
    tty.setraw(near)
    try:
        yield far, os.ttyname(near)
    finally:
        os.close(near)
        os.close(far)


def test_serial_carries_bytes_both_ways() -> None:
    with terminal() as (far, device), opened(f"serial://{device}:115200") as connection:
        os.write(far, FRAME * 2)
        assert b"".join(arrived(connection, 6)) == FRAME * 2
        connection.send(b"\xfd\x00\x03")
        assert os.read(far, 100) == b"\xfd\x00\x03"
        assert connection.receive() == []
        assert connection.send_errors == connection.receive_errors == 0


def test_serial_drops_whole_frames_when_the_port_is_full() -> None:
    with terminal() as (far, device), opened(f"serial://{device}:115200") as connection:
        frame = bytes((0xFD,)) + bytes(99)
        while connection.send_errors < 3:
            connection.send(frame)
        assert os.read(far, 100) == frame


def test_a_serial_port_that_goes_is_closed() -> None:
    far, near = pty.openpty()
    tty.setraw(near)
    with opened(f"serial://{os.ttyname(near)}:115200") as connection:
        os.close(near)
        os.close(far)
        assert arrived(connection) == []
        assert connection.closed
        assert connection.receive_errors == 1
        connection.send(FRAME)
        assert connection.send_errors == 1


def test_wait_names_who_can_be_read() -> None:
    with opened("udpin://127.0.0.1:0") as one, opened("udpin://127.0.0.1:0") as other, udp() as peer:
        peer.sendto(FRAME, ("127.0.0.1", port_of(other)))
        assert wait({"one": one, "other": other}, time.monotonic_ns() + LIMIT_NS) == ["other"]
        one.close()
        assert wait({"one": one, "other": other}, time.monotonic_ns() + LIMIT_NS) == ["other"]


def test_wait_ends_at_its_deadline() -> None:
    with opened("udpin://127.0.0.1:0") as connection:
        deadline_ns = time.monotonic_ns() + 2_000_000
        assert wait({"it": connection}, deadline_ns) == []
        assert time.monotonic_ns() >= deadline_ns
        assert wait({"it": connection}, deadline_ns) == []
        assert wait({}, time.monotonic_ns() + 1_000_000) == []


def test_a_flood_does_not_hold_the_loop() -> None:
    with opened("udpin://127.0.0.1:0") as connection, udp() as peer:
        for _ in range(300):
            peer.sendto(FRAME, ("127.0.0.1", port_of(connection)))
        assert 0 < len(connection.receive()) <= 256


def test_setpoints_go_to_the_vehicle_and_not_to_cameras_that_spoke_first_on_the_same_port() -> None:
    with socket.socket(type=socket.SOCK_DGRAM) as cameras, socket.socket(type=socket.SOCK_DGRAM) as vehicle:
        connection = open_connection("udpin://127.0.0.1:0")
        try:
            port = port_of(connection)
            vehicle.settimeout(LIMIT_S)
            cameras.sendto(b"\xfdcameras", ("127.0.0.1", port))
            vehicle.sendto(b"\xfdvehicle", ("127.0.0.1", port))
            arrived: list[bytes] = []
            while len(arrived) < 2:
                wait({"one": connection}, time.monotonic_ns() + 1_000_000_000)
                batch = connection.receive()
                arrived += [data for data, _ in batch]
                for index, (data, _) in enumerate(batch):
                    if data == b"\xfdvehicle":
                        connection.select_peer(index)
            connection.send(b"setpoint")
            assert vehicle.recv(64) == b"setpoint"
        finally:
            connection.close()
