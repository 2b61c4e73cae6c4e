"""Who is let in, how much of each is taken, and who gets our setpoints."""

from __future__ import annotations

import socket
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager

import pytest
from attacker import WORDS
from mavlink_rig import Peer
from patience import LIMIT_S
from places import DATA
from transport_rig import FRAME, LIMIT_NS, Clock, port_of

from logs.recording.tlog import read_tlog
from uavctl.io.admission import (
    FIRST_BURST,
    MAX_KNOWN,
    MAX_SENDERS,
    STRANGER_BURST,
    TRUSTED_BURST,
    VEHICLE_BURST,
    VEHICLE_TIMES,
    Address,
    AdmissionRules,
    AllowList,
    RateLimiter,
    count_frames,
)
from uavctl.io.base import Connection
from uavctl.io.transport import open_connection, wait
from uavctl.io.udp import PEER_SILENCE_NS
from uavctl.mavlink import framing

SECOND = 1_000_000_000
BURST = round(STRANGER_BURST[0])
ONE, VEHICLE, CAMERAS = ("192.0.2.1", 1), ("192.0.2.1", 14540), ("192.0.2.1", 14560)
HEARTBEATS = Peer(99).heartbeat() * 195


@contextmanager
def peer(host: str = "127.0.0.1") -> Iterator[socket.socket]:
    with socket.socket(type=socket.SOCK_DGRAM) as one:
        one.bind((host, 0))
        one.settimeout(LIMIT_S)
        yield one


def taken(connection: Connection, until: bytes) -> list[bytes]:
    """What is handed on, up to a datagram that ends it."""
    got: list[bytes] = []
    deadline_ns = time.monotonic_ns() + LIMIT_NS
    while until not in got and wait({"it": connection}, deadline_ns):
        got += [data for data, _ in connection.receive()]
    assert got[-1] == until
    return got[:-1]


@pytest.mark.parametrize(
    ("allow", "host", "wanted"),
    [
        ((), "192.0.2.1", True),
        (("192.0.2.1",), "192.0.2.1", True),
        (("192.0.2.1",), "192.0.2.2", False),
        (("192.0.2.0/24", "10.1.2.3"), "192.0.2.200", True),
        (("192.0.2.7/24",), "192.0.2.200", True),
        (("192.0.2.0/24", "10.1.2.3"), "10.1.2.3", True),
        (("192.0.2.0/24", "10.1.2.3"), "10.1.2.4", False),
        (("2001:db8::/32",), "2001:db8::1", True),
        (("2001:db8::/32",), "192.0.2.1", False),
        (("192.0.2.1",), "::ffff:192.0.2.1", True),
        (("fe80::/10",), "fe80::1%eth0", True),
        (("192.0.2.1",), "::1", False),
    ],
)
def test_addresses_and_networks(allow: tuple[str, ...], host: str, wanted: bool) -> None:
    rules = AllowList(allow)
    assert [rules.allows(host) for _ in range(2)] == [wanted] * 2


def test_forged_addresses_do_not_fill_the_memory() -> None:
    rules = AllowList(("192.0.2.1",))
    for n in range(5 * MAX_KNOWN):
        assert not rules.allows(f"10.{n >> 16}.{n >> 8 & 255}.{n & 255}")
    assert rules.allows("192.0.2.1")
    assert len(rules._verdicts) <= MAX_KNOWN


def budgets(per_s: float = 1000.0, frames_per_s: float = 1000.0) -> tuple[RateLimiter, Counter[str]]:
    """Budgets in flight: somebody is known whom it needs."""
    refused: Counter[str] = Counter()
    one = RateLimiter(AdmissionRules((), per_s, frames_per_s), refused)
    one.trust_sender(("192.0.2.9", 1), 0)
    return one, refused


def take(one: RateLimiter, senders: Sequence[Address], at_ns: int, data: bytes = b"x") -> list[bool]:
    return one.admit(senders, [data] * len(senders), at_ns)


@pytest.mark.fault(39)
def test_a_sender_gets_its_rate_and_the_newest_of_each_batch() -> None:
    cap, refused = budgets()
    assert take(cap, [ONE] * 100, 0) == [False] * (100 - BURST) + [True] * BURST
    assert take(cap, [ONE] * 10, 5_000_000) == [False] * 5 + [True] * 5
    assert take(cap, [ONE] * 10, 5_000_000) == [False] * 10
    assert sum(sum(take(cap, [ONE] * 20, 10_000_000 + n * 1_000_000)) for n in range(1000)) == 1004
    assert take(cap, [ONE] * 100, 100 * SECOND).count(True) == BURST  # nothing is saved up beyond a burst
    assert take(cap, [], 0) == []
    assert set(refused) == {"too-many"}


@pytest.mark.fault(39)
@pytest.mark.parametrize("gap_s", [0.05, 0.3, 0.6, 1.2])
def test_nothing_is_dropped_of_what_a_px4_says_before_it_is_known(gap_s: float) -> None:
    """Its first heartbeat, by which it is known, comes up to a second after its first word."""
    packets = [one for one in read_tlog(DATA / "px4-rest.tlog").packets if one.data[5] == 1]
    for known in (False, True):
        refused: Counter[str] = Counter()
        cap = RateLimiter(AdmissionRules(), refused)
        if known:
            cap.set_vehicle(VEHICLE, 0)
        gap_ns = round(gap_s * SECOND)
        batches = Counter((one.at_ns - packets[0].at_ns) // gap_ns for one in packets)
        words = iter(packets)
        for number in sorted(batches):
            data = [next(words).data for _ in range(batches[number])]
            assert all(cap.admit([VEHICLE] * len(data), data, (number + 1) * gap_ns))
        assert not refused and len(packets) > 700


@pytest.mark.fault(39)
@pytest.mark.fault(46)
def test_before_anybody_is_known_a_flood_of_strangers_is_bounded_too() -> None:
    cap = RateLimiter(AdmissionRules(), Counter())
    passed = 0
    for n in range(1000):  # a second, twenty new ports a millisecond
        batch: list[Address] = [("192.0.2.1", 20_000 + 20 * n + port) for port in range(20)]
        passed += sum(take(cap, batch, n * 1_000_000))
    assert passed <= 2 * FIRST_BURST[0] + AdmissionRules().max_per_s
    cap.set_vehicle(VEHICLE, SECOND)  # and nothing of it is left then
    strangers: list[Address] = [("192.0.2.2", port) for port in range(2000)]
    assert sum(take(cap, strangers, SECOND)) <= 2 * BURST


@pytest.mark.fault(39)
@pytest.mark.fault(46)
def test_frames_and_bytes_are_counted_and_not_datagrams_alone() -> None:
    """A sender within its datagrams: as many frames as it may send are looked at, and no more bytes are handed on."""
    for data in (Peer(99).heartbeat() * 5, Peer(99).odometry(1) * 5, HEARTBEATS, b"\xfe" * 4096):
        cap, refused = budgets(2000.0)
        frames = size = 0
        for n in range(2000):  # a second
            if take(cap, [ONE], n * 500_000, data) == [True]:
                frames, size = frames + count_frames(data), size + len(data)
        assert frames <= 1000 + STRANGER_BURST[1] and size <= 200_000 + STRANGER_BURST[2]
        assert set(refused) == {"too-much"}


@pytest.mark.fault(39)
@pytest.mark.parametrize("kind", WORDS)
@pytest.mark.fault(46)
def test_no_checksum_and_no_hash_is_taken_more_often_than_was_counted(
    kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    looks: Counter[str] = Counter()

    def fits(frame: bytes, shape: object) -> bool:
        looks["checksum"] += 1
        return real(frame, shape)

    def verify(frame: bytes) -> str:
        looks["hash"] += 1
        return "forged"

    real: Callable[..., bool] = framing._is_checksum_right
    monkeypatch.setattr(framing, "_is_checksum_right", fits)
    monkeypatch.setattr("attacker.MAX_FRAMES", 3)
    say = WORDS[kind]()
    for _ in range(3):
        data = say()
        looks.clear()
        framing.scan_frames(data, final=True)
        framing.scan_frames(data, final=True, verify=verify)
        assert max(looks["checksum"], looks["hash"], 1) <= count_frames(data) <= len(data) // 8 + 65


@pytest.mark.fault(39)
@pytest.mark.fault(46)
def test_a_flooder_takes_nothing_of_another_sender_s_share() -> None:
    cap, _ = budgets()
    flooder, other = ("192.0.2.1", 1), ("192.0.2.1", 2)
    for n in range(500):
        batch = [flooder] * 20 + [other] + [flooder] * 20
        assert take(cap, batch, n * 2_000_000)[20]
    assert take(cap, [flooder] * 5, 499 * 2_000_000) == [False] * 5


@pytest.mark.fault(39)
@pytest.mark.fault(46)
def test_strangers_share_what_one_has_and_take_nothing_of_vehicle_and_cameras() -> None:
    cap, refused = budgets()
    cap.set_vehicle(VEHICLE, 0)
    cap.trust_sender(CAMERAS, 0)
    passed = 0
    for n in range(1000):  # a second, twenty new ports a millisecond
        strangers: list[Address] = [("192.0.2.1", 20_000 + 20 * n + port) for port in range(20)]
        verdicts = take(cap, [*strangers, VEHICLE, VEHICLE, VEHICLE, CAMERAS], n * 1_000_000)
        assert all(verdicts[20:])
        passed += sum(verdicts[:20])
    assert 1000 <= passed <= 2 * BURST + 1000
    assert refused["too-many"] == 20_000 - passed
    assert len(cap._strangers) <= MAX_SENDERS


@pytest.mark.fault(39)
@pytest.mark.fault(47)
def test_a_later_vehicle_is_heard_beside_sixteen_flooders() -> None:
    cap, _ = budgets()
    flooders: list[Address] = [("192.0.2.1", port) for port in range(16)]
    for n in range(5000):
        take(cap, flooders * 2, n * 1_000_000, HEARTBEATS[:21])
    for n in range(20):  # once a second, as a heartbeat among other words
        at_ns = 6 * SECOND + n * SECOND
        for k in range(100):
            take(cap, flooders * 2, at_ns - (100 - k) * 1_000_000, HEARTBEATS[:21])
        assert take(cap, [*flooders, VEHICLE, *flooders], at_ns, b"\xfd" * 40)[16]


@pytest.mark.fault(39)
def test_a_backlog_of_the_vehicle_s_is_read_whole_and_ends_with_its_newest_state() -> None:
    cap, refused = budgets()
    cap.set_vehicle(VEHICLE, 0)
    assert all(take(cap, [VEHICLE] * 1500, 0, Peer().send("attitude", 1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)))
    # Beyond any stall: what may be its state counts before all else, the newest first.
    words = [Peer().heartbeat(), *[bytes((0xFD, 9, 0, 0, 0, 1, 1, 30, 0, 0)) + bytes(11)] * 100_000]
    taken = cap.admit([VEHICLE] * len(words), words, 1)
    assert taken[0] and not taken[1] and taken[-1]
    assert sum(taken) <= VEHICLE_BURST[1]
    assert refused["too-many"] + refused["too-much"] == len(words) - sum(taken)
    # a real one says so much; bytes may look like frames
    assert VEHICLE_TIMES * AdmissionRules().max_frames_per_s >= 3 * 600.0


@pytest.mark.fault(39)
def test_those_who_are_trusted_share_their_budget_fairly() -> None:
    cap, _ = budgets()
    loud: list[Address] = [("192.0.2.1", port) for port in range(8)]
    for one in (*loud, CAMERAS):
        cap.trust_sender(one, 0)
    take(cap, loud * 1000, 0)
    assert all(take(cap, [*loud * 50, CAMERAS], n * 10_000_000)[-1] for n in range(1, 100))
    for port in range(100):  # forged ones, each of which passed once for a source
        cap.trust_sender(("192.0.2.2", port), SECOND)
    assert take(cap, [CAMERAS], SECOND) == [True]
    assert TRUSTED_BURST > STRANGER_BURST


@pytest.mark.fault(39)
def test_who_is_not_listed_is_counted_and_gets_nothing() -> None:
    rules = AdmissionRules(("127.0.0.1", "127.0.0.3"))
    with (
        closing(open_connection("udpin://0.0.0.0:0", rules=rules)) as connection,
        peer("127.0.0.2") as stranger,
        peer("127.0.0.1") as vehicle,
    ):
        to = ("127.0.0.1", port_of(connection))
        for data in (b"x", FRAME, FRAME * 20):  # one byte, MAVLink, much of it
            stranger.sendto(data, to)
        connection.receive()
        connection.send(b"to nobody")
        vehicle.sendto(FRAME, to)
        vehicle.sendto(b"end", to)
        assert taken(connection, b"end") == [FRAME]
        assert connection.refused == {"not-listed": 3}
        connection.send(b"setpoint")
        assert vehicle.recv(64) == b"setpoint"
        stranger.setblocking(False)
        with pytest.raises(BlockingIOError):
            stranger.recv(64)


@pytest.mark.fault(39)
def test_a_flood_is_cut_and_counted_and_the_other_sender_is_heard() -> None:
    clock = Clock()  # stands still: nothing is earned back
    with (
        closing(open_connection("udpin://127.0.0.1:0", clock)) as connection,
        peer() as flooder,
        peer() as vehicle,
        peer() as cameras,
    ):
        to = ("127.0.0.1", port_of(connection))
        cameras.sendto(FRAME, to)
        assert wait({"it": connection}, time.monotonic_ns() + LIMIT_NS) and connection.receive()
        connection.trust_sender(0)
        got: list[bytes] = []
        for n in range(40):
            for k in range(25):
                flooder.sendto(b"%d" % (25 * n + k), to)
            if n % 4 == 0:
                vehicle.sendto(b"vehicle", to)
            got += [data for data, _ in connection.receive()]
        vehicle.sendto(b"end", to)
        got += taken(connection, b"end")
        assert got.count(b"vehicle") == 10
        assert len(got) == BURST + 10
        assert connection.refused == {"too-many": 1000 - BURST}


@pytest.mark.fault(39)
def test_a_second_address_draws_no_setpoints_while_the_first_one_speaks() -> None:
    clock = Clock()
    with closing(open_connection("udpin://127.0.0.1:0", clock)) as connection, peer() as vehicle, peer() as thief:
        to = ("127.0.0.1", port_of(connection))

        def hears(who: socket.socket) -> None:
            who.sendto(FRAME, to)
            assert wait({"it": connection}, time.monotonic_ns() + LIMIT_NS)
            assert [data for data, _ in connection.receive()] == [FRAME]
            connection.select_peer(0)

        hears(vehicle)
        hears(thief)  # a whole valid heartbeat of the same system
        clock.now_ns += PEER_SILENCE_NS
        hears(thief)
        connection.send(b"setpoint")
        assert vehicle.recv(64) == b"setpoint"
        assert connection.refused == {"second-address": 2}
        hears(vehicle)
        clock.now_ns += PEER_SILENCE_NS + 1
        hears(thief)  # the vehicle, under another port after a restart
        connection.send(b"setpoint")
        assert thief.recv(64) == b"setpoint"


@pytest.mark.fault(39)
def test_a_vehicle_that_has_closed_its_port_gets_its_setpoints_at_another_one() -> None:
    clock = Clock()
    with closing(open_connection("udpin://127.0.0.1:0", clock)) as connection, peer() as moved, peer() as thief:
        with peer() as vehicle:
            known(connection, vehicle)
        connection.send(b"setpoint")  # the answer: nobody listens there
        assert wait({"it": connection}, time.monotonic_ns() + LIMIT_NS)
        assert connection.receive(read_all=True) == []
        known(connection, moved)
        connection.send(b"setpoint")
        assert moved.recv(64) == b"setpoint"
        known(connection, thief)  # the new port is open, and keeps its place
        connection.send(b"next")
        assert moved.recv(64) == b"next"
        assert connection.refused == {"second-address": 1}


@pytest.mark.fault(39)
def test_noise_does_not_keep_the_place_of_a_vehicle() -> None:
    """Who once passed for the vehicle, with a frame held back, and then says nothing genuine loses the setpoints."""
    clock = Clock()
    with closing(open_connection("udpin://127.0.0.1:0", clock)) as connection, peer() as thief, peer() as vehicle:
        to = ("127.0.0.1", port_of(connection))
        thief.sendto(FRAME, to)
        assert wait({"it": connection}, time.monotonic_ns() + LIMIT_NS) and connection.receive()
        connection.select_peer(0)
        for _ in range(6):
            clock.now_ns += 1_000_000_000
            thief.sendto(FRAME, to)
            assert wait({"it": connection}, time.monotonic_ns() + LIMIT_NS) and connection.receive()
        vehicle.sendto(FRAME, to)
        assert wait({"it": connection}, time.monotonic_ns() + LIMIT_NS) and connection.receive()
        connection.select_peer(0)
        connection.send(b"setpoint")
        assert vehicle.recv(64) == b"setpoint"


def test_a_connected_socket_has_its_cap_too() -> None:
    with (
        peer() as vehicle,
        closing(open_connection(f"udpout://127.0.0.1:{vehicle.getsockname()[1]}", Clock())) as connection,
    ):
        connection.send(b"hello")
        _, address = vehicle.recvfrom(64)
        data = b"\xfd" * 4096
        most = int(VEHICLE_BURST[1]) // count_frames(data)
        for _ in range(most + 10):
            vehicle.sendto(data, address)
            connection.receive()
        while wait({"it": connection}, time.monotonic_ns() + 50_000_000):
            connection.receive()
        assert connection.refused == {"too-much": 10}


def known(connection: Connection, who: socket.socket) -> None:
    """Make somebody the vehicle."""
    who.sendto(FRAME, ("127.0.0.1", port_of(connection)))
    assert wait({"it": connection}, time.monotonic_ns() + LIMIT_NS)
    assert connection.receive()
    connection.select_peer(0)


@pytest.mark.fault(39)
@pytest.mark.fault(46)
def test_a_flood_does_not_fill_the_buffer_of_the_vehicle() -> None:
    with closing(open_connection("udpin://127.0.0.1:0")) as connection, peer() as vehicle, peer() as flooder:
        known(connection, vehicle)
        to = ("127.0.0.1", port_of(connection))
        for _ in range(20_000):  # nobody reads: the system drops the newest
            flooder.sendto(FRAME, to)
        for n in range(200):
            vehicle.sendto(b"%d" % n, to)
        got = [data for data, _ in connection.receive(read_all=True)]
        assert [data for data in got if data != FRAME] == [b"%d" % n for n in range(200)]
        assert not connection.has_unread and connection.has_known_sender
        assert connection.count_lost() == 0
        connection.send(b"setpoint")
        assert vehicle.recv(64) == b"setpoint"


@pytest.mark.fault(39)
def test_what_the_system_dropped_of_the_vehicle_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("uavctl.io.udp.PEER_BUFFER_BYTES", 4096)
    with closing(open_connection("udpin://127.0.0.1:0")) as connection, peer() as vehicle:
        known(connection, vehicle)
        for _ in range(1000):
            vehicle.sendto(FRAME, ("127.0.0.1", port_of(connection)))
        got = len(connection.receive(read_all=True))
        assert connection.count_lost() == 1000 - got > 0


def test_what_came_before_the_own_socket_counts_first() -> None:
    with closing(open_connection("udpin://127.0.0.1:0")) as connection, peer() as vehicle:
        to = ("127.0.0.1", port_of(connection))
        for n in range(300):
            vehicle.sendto(b"\xfd%d" % n, to)
        got = connection.receive()
        connection.select_peer(0)
        vehicle.sendto(b"\xfdlast", to)
        got += connection.receive(read_all=True)
        numbers = [data for data, _ in got]
        assert numbers[-1] == b"\xfdlast"
        assert numbers[:-1] == sorted(numbers[:-1], key=lambda one: int(one[1:]))


def test_the_port_stays_ours_and_one_who_is_silent_gives_up_the_own_socket() -> None:
    clock = Clock()
    with closing(open_connection("udpin://127.0.0.1:0", clock)) as connection, peer() as vehicle:
        known(connection, vehicle)
        assert len(connection.filenos()) == 2
        with socket.socket(type=socket.SOCK_DGRAM) as other:
            other.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
            with pytest.raises(OSError, match="in use"):
                other.bind(("127.0.0.1", port_of(connection)))
        for _ in range(20):
            with peer() as camera:
                camera.sendto(FRAME, ("127.0.0.1", port_of(connection)))
                assert wait({"it": connection}, time.monotonic_ns() + LIMIT_NS)
                assert connection.receive()
                connection.trust_sender(0)
            assert len(connection.filenos()) <= 9
            clock.now_ns += SECOND
        clock.now_ns += 10 * SECOND
        with peer() as camera:
            camera.sendto(FRAME, ("127.0.0.1", port_of(connection)))
            assert wait({"it": connection}, time.monotonic_ns() + LIMIT_NS)
            assert connection.receive()
            connection.trust_sender(0)
        assert len(connection.filenos()) == 3  # vehicle and camera


def test_where_the_system_does_not_tell_nothing_is_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("uavctl.io.udp._SO_MEMINFO", 9999)
    monkeypatch.delattr("socket.SO_REUSEPORT")
    with closing(open_connection("udpin://127.0.0.1:0")) as connection, peer() as vehicle, peer() as flooder:
        known(connection, vehicle)
        assert len(connection.filenos()) == 1 and connection.count_lost() == 0
        to = ("127.0.0.1", port_of(connection))
        for _ in range(200):
            flooder.sendto(b"x", to)
        vehicle.sendto(b"\xfdlast", to)
        assert connection.receive(read_all=True)[-1][0] == b"\xfdlast"
        assert not connection.has_unread
