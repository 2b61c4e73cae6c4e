"""The same peers on real sockets of this machine, each run a second or two where nothing else keeps the machine."""

import multiprocessing
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
from patience import LIMIT_S, wait_until
from sim_rig import Client, decode

from sim.ports import open_port, split_frames
from sim.server import MAX_STEP_NS, Ready, VehicleSetup, compute_grid_start_ns, serve, serve_all, serve_in_child
from sim.simulation import Peers
from uavctl.config import Config, load_config
from uavctl.errors import ConnectionSpecError
from uavctl.records import Truth

S = 1_000_000_000
HERE = ("127.0.0.1", 0)


def config(*overrides: str) -> Config:
    return load_config(
        "room-hahn-stursberg", ["link.loss=0", "sim.camera.rate_hz=50", "sim.camera.phase_s=0", *overrides]
    )


class Served:
    """`serve` in a thread, with everything that it told."""

    def __init__(self, config: Config, vehicle: str, mocap: str, *, duration_s: float | None, airborne: bool) -> None:
        self.ready: Ready | None = None
        self.truths: list[Truth] = []
        self.is_ready, self.stop = threading.Event(), threading.Event()
        self.thread = threading.Thread(
            target=serve,
            args=(config, vehicle, mocap),
            kwargs={
                "duration_s": duration_s,
                "airborne": airborne,
                "on_ready": self._on_ready,
                "on_truth": self.truths.append,
                "stop": self.stop.is_set,
            },
        )
        self.thread.start()
        assert self.is_ready.wait(LIMIT_S)

    def _on_ready(self, ready: Ready) -> None:
        self.ready = ready
        self.is_ready.set()


@contextmanager
def serving(
    config: Config, vehicle: str, mocap: str, *, duration_s: float | None = 1.0, airborne: bool = True
) -> Iterator[Served]:
    one = Served(config, vehicle, mocap, duration_s=duration_s, airborne=airborne)
    try:
        yield one
    finally:
        one.stop.set()
        one.thread.join(LIMIT_S)
    assert not one.thread.is_alive()


def udp() -> tuple[socket.socket, str]:
    """A bound client socket, and the URL by which the simulator sends to it."""
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.bind(HERE)
    sock.settimeout(LIMIT_S)
    return sock, f"udpout://127.0.0.1:{sock.getsockname()[1]}"


def listen(sock: socket.socket, wait_until: Any, limit: int = 2000) -> list[Any]:
    """Messages from a socket until one of them is what is waited for."""
    got: list[Any] = []
    for _ in range(limit):
        data, sender = sock.recvfrom(65535)
        for msg in decode(data):
            msg.sender = sender
            got.append(msg)
            if wait_until(msg):
                return got
    raise AssertionError("waited in vain")


def is_a(kind: str) -> Any:
    return lambda msg: msg.get_type() == kind


def test_the_grid_is_shared_without_a_word() -> None:
    assert compute_grid_start_ns(17, 5) == 20
    assert compute_grid_start_ns(20, 5) == 20


def test_udp_vehicle_and_cameras_send_to_the_client_and_obey_it() -> None:
    vehicle, vehicle_url = udp()
    mocap, mocap_url = udp()
    with vehicle, mocap, serving(config(), vehicle_url, mocap_url, duration_s=None) as served:
        client = Client()
        assert served.ready is not None
        assert (served.ready.vehicle, served.ready.mocap) == (vehicle_url, mocap_url)
        assert served.ready.start_ns % (S // 5) == 0
        beat = listen(vehicle, is_a("HEARTBEAT"))[-1]
        assert beat.base_mode == 145
        samples = [msg for _ in range(5) for msg in listen(mocap, is_a("VISION_POSITION_ESTIMATE"))]
        # the cameras' clock counts from the start of the grid
        assert [msg.usec % 20_000 for msg in samples] == [0] * 5
        vehicle.sendto(client.timesync(77), beat.sender)
        assert listen(vehicle, lambda msg: msg.get_type() == "TIMESYNC" and msg.tc1)[-1].ts1 == 77
        moving = len(served.truths)

        def obeyed() -> bool:
            vehicle.sendto(client.setpoint(1.0, 0.0, 0.0), beat.sender)
            listen(vehicle, is_a("LOCAL_POSITION_NED"))
            return bool(served.truths) and served.truths[-1].input == (1.0, 0.0, 0.0)

        wait_until(obeyed, "the setpoint is flown")
        told = served.truths.copy()  # time goes on
        assert len(told) > moving
        assert [one.at_ns for one in told] == [served.ready.start_ns + k * S // 5 for k in range(len(told))]


def test_one_url_is_one_connection() -> None:
    sock, url = udp()
    with sock, serving(config(), url, url, duration_s=None) as served:
        assert served.ready is not None
        assert served.ready.vehicle == served.ready.mocap == url
        first, second = listen(sock, is_a("HEARTBEAT")), listen(sock, is_a("VISION_POSITION_ESTIMATE"))
        assert first[-1].sender == second[-1].sender


def test_it_ends_with_its_duration_and_counts_the_time_from_the_grid() -> None:
    vehicle, vehicle_url = udp()
    mocap, mocap_url = udp()
    with vehicle, mocap, serving(config(), vehicle_url, mocap_url, duration_s=0.5) as served:
        served.thread.join(LIMIT_S)
        assert not served.thread.is_alive()
        assert [(one.at_ns - served.truths[0].at_ns) * 10 // S for one in served.truths] == [0, 2, 4]


def test_nobody_listening_is_no_error() -> None:
    vehicle, vehicle_url = udp()
    mocap, mocap_url = udp()
    vehicle.close()
    mocap.close()
    with serving(config(), vehicle_url, mocap_url, duration_s=0.4) as served:
        served.thread.join(LIMIT_S)
        assert len(served.truths) == 2


def test_udpin_answers_whoever_speaks() -> None:
    sock, _ = udp()
    mocap, mocap_url = udp()
    with sock, mocap, serving(config(), "udpin://127.0.0.1:0", mocap_url, duration_s=None) as served:
        assert served.ready is not None
        port = int(served.ready.vehicle.rsplit(":", 1)[1])
        listen(mocap, is_a("VISION_POSITION_ESTIMATE"))  # time has begun
        sock.sendto(b"garbage", ("127.0.0.1", port))
        assert listen(sock, is_a("HEARTBEAT"))[-1].get_srcSystem() == 1


@pytest.mark.slow
def test_tcp_takes_a_client_a_stream_in_pieces_and_the_next_client() -> None:
    mocap, mocap_url = udp()
    ardupilot = config("sim.autopilot=ardupilot")
    with mocap, serving(ardupilot, "tcpin://127.0.0.1:0", mocap_url, duration_s=None, airborne=False) as served:
        assert served.ready is not None
        address = ("127.0.0.1", int(served.ready.vehicle.rsplit(":", 1)[1]))
        for ts1 in (1, 2):
            with socket.create_connection(address, timeout=LIMIT_S) as sock:
                stream = b"noise" + Client().timesync(ts1)
                listen(mocap, is_a("VISION_POSITION_ESTIMATE"))
                sock.sendall(stream[:11])
                listen(mocap, is_a("VISION_POSITION_ESTIMATE"))
                sock.sendall(stream[11:])
                assert tcp_until(sock, "TIMESYNC").ts1 == ts1
                assert tcp_until(sock, "HEARTBEAT").base_mode == 81


def test_several_tcp_clients_get_the_same_and_are_all_heard() -> None:
    mocap, mocap_url = udp()
    ardupilot = config("sim.autopilot=ardupilot")
    with mocap, serving(ardupilot, "tcpin://127.0.0.1:0", mocap_url, duration_s=None, airborne=False) as served:
        assert served.ready is not None
        address = ("127.0.0.1", int(served.ready.vehicle.rsplit(":", 1)[1]))
        with (
            socket.create_connection(address, timeout=LIMIT_S) as one,
            socket.create_connection(address, timeout=LIMIT_S) as two,
        ):
            for sock in (one, two):
                tcp_until(sock, "HEARTBEAT")
            one.sendall(Client().timesync(1))
            assert tcp_until(one, "TIMESYNC").ts1 == tcp_until(two, "TIMESYNC").ts1 == 1
            two.sendall(Client().timesync(2))
            assert tcp_until(one, "TIMESYNC").ts1 == tcp_until(two, "TIMESYNC").ts1 == 2
            one.close()
            two.sendall(Client().timesync(3))
            assert tcp_until(two, "TIMESYNC").ts1 == 3


def test_a_tcp_client_that_reads_nothing_is_dropped_and_the_others_stay() -> None:
    port = open_port("tcpin://127.0.0.1:0")
    address = ("127.0.0.1", int(port.url.rsplit(":", 1)[1]))
    with socket.create_connection(address) as lazy, socket.create_connection(address, timeout=LIMIT_S) as keen:
        while len(port.sockets()) < 3:
            port.read()
        taken = 0
        for _ in range(10_000):  # 160 MB: more than any socket keeps
            port.write(bytes(1 << 14))
            taken += len(keen.recv(1 << 20))
            if len(port.sockets()) == 2:
                break
        assert len(port.sockets()) == 2 and taken > 1 << 16
        lazy.settimeout(LIMIT_S)
        port.write(b"end")
        while not (last := keen.recv(1 << 20)).endswith(b"end"):
            assert last
    port.close()


def test_px4_sends_to_several_ports_and_listens_at_all_of_them() -> None:
    one, one_url = udp()
    two, two_url = udp()
    mocap, mocap_url = udp()
    urls = f"{one_url},{two_url}"
    with one, two, mocap, serving(config(), urls, mocap_url, duration_s=None) as served:
        assert served.ready is not None and served.ready.vehicle == urls
        for sock in (one, two):
            mine = sock.getsockname()[1]
            beat = listen(sock, is_a("HEARTBEAT"))[-1]
            sock.sendto(Client().timesync(mine), beat.sender)
            listen(sock, lambda msg, mine=mine: msg.get_type() == "TIMESYNC" and msg.ts1 == mine)


def test_of_several_ports_one_that_cannot_be_opened_closes_the_others() -> None:
    free, _ = udp()
    port = free.getsockname()[1]
    free.close()
    with pytest.raises(ConnectionSpecError, match="write udpout"):
        open_port(f"udpin://127.0.0.1:{port},nonsense")
    open_port(f"udpin://127.0.0.1:{port}").close()


def tcp_until(sock: socket.socket, kind: str) -> Any:
    stream = bytearray()
    for _ in range(500):
        stream += sock.recv(4096)
        for frame in split_frames(stream):
            (msg,) = decode(frame)
            if msg.get_type() == kind:
                return msg
    raise AssertionError("waited in vain")


def test_frames_are_cut_off_a_stream_whatever_the_pieces() -> None:
    client = Client()
    wanted = [client.timesync(1), client.setpoint(1.0, 2.0, 3.0), client.command(400, 1)]
    stream, got = bytearray(), []
    for byte in b"\x00\x11" + wanted[0] + b"\x22" + wanted[1] + wanted[2]:
        stream.append(byte)
        got += split_frames(stream)
    assert got == wanted
    assert not stream
    signed = bytearray(wanted[0])
    signed[2] = 1
    assert split_frames(bytearray(bytes(signed) + bytes(13) + wanted[1])) == [bytes(signed) + bytes(13), wanted[1]]


@pytest.mark.parametrize(
    "url", ["serial:///dev/ttyX", "udpout://127.0.0.1", "udpout://127.0.0.1:99999", "14540", "tcpin://192.0.2.1:5760"]
)
def test_a_url_that_cannot_be_served_is_refused_with_what_to_do(url: str) -> None:
    with pytest.raises(ConnectionSpecError, match=r"write udpout|choose another"):
        open_port(url)


def test_a_taken_port_is_refused() -> None:
    sock, _ = udp()
    with sock, pytest.raises(ConnectionSpecError, match="choose another port"):
        open_port(f"udpin://127.0.0.1:{sock.getsockname()[1]}")


def test_a_child_process_tells_through_a_pipe_and_stops_when_told() -> None:
    vehicle, vehicle_url = udp()
    mocap, mocap_url = udp()
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe(duplex=False)
    stop = context.Event()
    arguments = (there, stop, config(), vehicle_url, mocap_url, None, True)
    with vehicle, mocap, here:
        child = context.Process(target=serve_in_child, args=arguments)
        child.start()
        there.close()
        assert here.poll(LIMIT_S)
        ready = here.recv()
        assert isinstance(ready, Ready)
        first = here.recv()
        assert isinstance(first, Truth)
        assert first.at_ns == ready.start_ns
        assert first.at_ns <= time.monotonic_ns()  # one clock for both processes
        stop.set()
        child.join(LIMIT_S)
        assert child.exitcode == 0
        child.close()


def test_a_speed_beyond_this_computer_s_piles_up_no_work_and_tells_all(monkeypatch: pytest.MonkeyPatch) -> None:
    strides: list[int] = []
    advance = Peers.advance

    def spied(peers: Peers, to_ns: int) -> Any:
        strides.append(to_ns - peers.now_ns)
        return advance(peers, to_ns)

    monkeypatch.setattr(Peers, "advance", spied)
    told: list[Truth] = []
    seat = VehicleSetup(config("sim.plant=quadrotor"), "udpin://127.0.0.1:0", "udpin://127.0.0.1:0", told.append)
    readies: list[Ready] = []
    serve_all((seat,), duration_s=10.0, airborne=True, on_ready=readies.append, stop=lambda: False, speed=1000.0)
    assert max(strides) <= MAX_STEP_NS
    assert [one.at_ns - readies[0].start_ns for one in told] == [k * S // 5 for k in range(50)]


def test_simulated_time_runs_at_a_multiple_of_real_time_for_several_vehicles_at_once() -> None:
    clients = [udp() for _ in range(4)]
    told: tuple[list[Truth], list[Truth]] = ([], [])
    seats = [
        VehicleSetup(
            config(f"sim.autopilot={name}", f"sim.start_position_m=[0,{i},-1]"),
            clients[2 * i][1],
            clients[2 * i + 1][1],
            told[i].append,
        )
        for i, name in enumerate(("px4", "ardupilot"))
    ]
    readies: list[Ready] = []
    begun_s = time.monotonic()
    serve_all(seats, duration_s=6.0, airborne=True, on_ready=readies.append, stop=lambda: False, speed=20.0)
    took_s = time.monotonic() - begun_s
    assert took_s >= 0.3  # 6 s of simulated time cannot be over sooner
    assert [(one.vehicle, one.mocap) for one in readies] == [(one.vehicle, one.mocap) for one in seats]
    assert readies[0].start_ns == readies[1].start_ns
    for truths in told:
        assert [one.at_ns - readies[0].start_ns for one in truths] == [k * S // 5 for k in range(30)]
    for i, number in ((0, 12), (2, 3)):  # each client hears its own vehicle
        beat = listen(clients[i][0], is_a("HEARTBEAT"))[-1]
        assert beat.autopilot == number
    for sock, _ in clients:
        sock.close()
