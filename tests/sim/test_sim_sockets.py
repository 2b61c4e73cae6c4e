"""What the simulator's ports say before the first packet, and what becomes of what they cannot send."""

import errno
import socket
from typing import Any

import pytest
from patience import LIMIT_S
from sim_rig import Client, make_rig

from sim.autopilot.profile import ARDUPILOT
from sim.ports import UdpPort, open_port
from uavctl.cli.app import run
from uavctl.mavlink.codec import StreamDecoder
from uavctl.mavlink.messages import Heartbeat

ANY = "udpin://127.0.0.1:0"


def heard(stream: bytes, size: int) -> tuple[int, int]:
    """Heartbeats that the daemon reads from a stream that comes in pieces, and runs of bytes that are none."""
    decoder = StreamDecoder()
    found = [decoder.push(stream[at : at + size]) for at in range(0, len(stream), size)]
    beats = [msg for one in found for msg in one.messages if isinstance(msg, Heartbeat)]
    return len(beats), sum(count for one in found for reason, count in one.bad.items() if reason == "garbage")


def packets(count: int) -> list[bytes]:
    """Heartbeats of a vehicle."""
    one = make_rig("ardupilot")
    client = Client()
    beat = one.of("HEARTBEAT")[0]
    return [client.pack(beat) for _ in range(count)]


@pytest.mark.parametrize("size", [1, 2, 3, 7, 16, 61, 1000])
def test_the_daemon_reads_every_packet_around_the_text_of_the_boot(size: int) -> None:
    first, second = ARDUPILOT.greeting
    beats = packets(20)
    stream = first + beats[0] + second + b"".join(beats[1:])
    assert heard(stream, size) == (20, 2)


def test_text_in_which_a_packet_could_begin_costs_no_packet() -> None:
    beats = packets(20)
    text = b"Init \xfd\x09 ArduCopter \xfe\xff\n"
    assert heard(text + b"".join(beats), 11)[0] == 20


def received(sock: socket.socket, count: int) -> bytes:
    data = b""
    while len(data) < count:
        data += sock.recv(4096)
    return data


def test_each_new_tcp_client_is_greeted_around_its_first_packet() -> None:
    port = open_port("tcpin://127.0.0.1:0", (b"hello\n", b"world\n"))
    address = ("127.0.0.1", int(port.url.rsplit(":", 1)[1]))

    def joined(clients: int) -> socket.socket:
        sock = socket.create_connection(address, timeout=LIMIT_S)
        while len(port.sockets()) < 1 + clients:
            port.read()
        return sock

    with joined(1) as one:
        for packet in (b"<1>", b"<2>", b"<3>"):
            port.write(packet)
        with joined(2) as two:
            port.write(b"<4>")
            port.write(b"<5>")
            assert received(one, 27) == b"hello\n<1>world\n<2><3><4><5>"
            assert received(two, 18) == b"hello\n<4>world\n<5>"
    port.close()


@pytest.mark.parametrize(("autopilot", "greeted"), [("ardupilot", True), ("px4", False)])
def test_ardupilot_s_server_tells_its_boot(autopilot: str, greeted: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[tuple[Any, ...]] = []

    def spy(url: str, greeting: tuple[bytes, ...] = ()) -> Any:
        opened.append(greeting)
        return open_port(url, greeting)

    monkeypatch.setattr("sim.server.open_port", spy)
    command = ["sim", "--autopilot", autopilot, "--vehicle", "tcpin://127.0.0.1:0", "--mocap", ANY, "--duration", "0.1"]
    assert run(command) == 0
    vehicle, mocap = opened
    assert (bool(vehicle), mocap) == (greeted, ())


@pytest.mark.parametrize("url", ["udpout://nosuch.invalid:14540", "udpout://127.0.0.1:0", ""])
def test_a_url_to_which_nothing_can_be_sent_is_refused_at_the_start(
    url: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["sim", "--vehicle", url, "--mocap", ANY, "--duration", "0.1"]) == 2
    told = capsys.readouterr().err
    assert url in told and "Traceback" not in told


class Unreachable:
    """A socket of a machine whose network is gone."""

    def sendto(self, data: bytes, address: tuple[str, int]) -> int:
        raise OSError(errno.ENETUNREACH, "Network is unreachable")


def test_a_datagram_that_cannot_be_sent_is_lost() -> None:
    port = UdpPort("udpout", ("127.0.0.1", 14540))
    port.close()
    vars(port)["_socket"] = Unreachable()
    port.write(b"lost")


@pytest.mark.parametrize(
    "options", [["--speed", "inf"], ["--speed", "0"], ["--speed", "1001"], ["--duration", "inf"], ["--duration", "nan"]]
)
def test_a_speed_or_a_duration_that_cannot_be_is_refused(options: list[str]) -> None:
    assert run(["sim", "--vehicle", ANY, "--mocap", ANY, "--duration", "0.1", *options]) == 2
