"""Who is let in, how much of each is taken, and who gets our setpoints."""

from __future__ import annotations

import socket
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager

import pytest
from patience import LIMIT_S
from test_transport import FRAME, LIMIT_NS, Clock, port_of

from uavctl.transport import PEER_SILENCE_NS, Connection, Rules, open_connection, wait
from uavctl.transport.rules import BURST, MAX_KNOWN, MAX_SENDERS, SILENCE_NS, AllowList, RateCap

SECOND = 1_000_000_000


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
    assert [rules.lets_in(host) for _ in range(2)] == [wanted] * 2


def test_forged_addresses_do_not_fill_the_memory() -> None:
    rules = AllowList(("192.0.2.1",))
    for n in range(5 * MAX_KNOWN):
        assert not rules.lets_in(f"10.{n >> 16}.{n >> 8 & 255}.{n & 255}")
    assert rules.lets_in("192.0.2.1")
    assert len(rules._known) <= MAX_KNOWN


@pytest.mark.fault(39)
def test_a_sender_gets_its_rate_and_the_newest_of_each_batch() -> None:
    cap, one = RateCap(1000.0), ("192.0.2.1", 1)
    assert cap.take([one] * 100, 0) == [False] * (100 - BURST) + [True] * BURST
    assert cap.take([one] * 10, 5_000_000) == [False] * 5 + [True] * 5
    assert cap.take([one] * 10, 5_000_000) == [False] * 10
    assert sum(sum(cap.take([one] * 20, 10_000_000 + n * 1_000_000)) for n in range(1000)) == 1004
    assert cap.take([one] * 100, 100 * SECOND).count(True) == BURST  # nothing is saved up beyond a burst
    assert cap.take([], 0) == []


@pytest.mark.fault(39)
def test_a_flooder_takes_nothing_of_another_sender_s_share() -> None:
    cap, flooder, other = RateCap(1000.0), ("192.0.2.1", 1), ("192.0.2.1", 2)
    for n in range(500):
        batch = [flooder] * 20 + [other] + [flooder] * 20
        verdicts = cap.take(batch, n * 2_000_000)
        assert verdicts[20]
    assert cap.take([flooder] * 5, 499 * 2_000_000) == [False] * 5


@pytest.mark.fault(39)
def test_forged_senders_share_what_one_has_and_early_ones_keep_theirs() -> None:
    cap, vehicle = RateCap(1000.0), ("192.0.2.1", 14540)
    assert cap.take([vehicle], 0) == [True]
    passed = 0
    for n in range(1000):  # a second, twenty new ports a millisecond
        at_ns = n * 1_000_000
        verdicts = cap.take([("192.0.2.1", 20 * n + port) for port in range(20)] + [vehicle], at_ns)
        assert verdicts[-1]
        passed += sum(verdicts[:-1])
    assert passed <= (MAX_SENDERS + 1) * BURST + 1000
    later_ns = 2 * SECOND + SILENCE_NS
    assert cap.take([("192.0.2.9", 1)], later_ns) == [True]  # a place has become free
    assert len(cap._budgets) == 1


@pytest.mark.fault(39)
def test_who_is_not_listed_is_counted_and_gets_nothing() -> None:
    rules = Rules(("127.0.0.1", "127.0.0.3"))
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
    ):
        to = ("127.0.0.1", port_of(connection))
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
    with (
        closing(open_connection("udpin://127.0.0.1:0", clock)) as connection,
        peer() as vehicle,
        peer() as thief,
    ):
        to = ("127.0.0.1", port_of(connection))

        def hears(who: socket.socket) -> None:
            who.sendto(FRAME, to)
            assert wait({"it": connection}, time.monotonic_ns() + LIMIT_NS)
            assert [data for data, _ in connection.receive()] == [FRAME]
            connection.answer(0)

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
def test_noise_does_not_keep_the_place_of_a_vehicle() -> None:
    """Who once passed for the vehicle, with a frame held back, and then says nothing genuine loses the setpoints."""
    clock = Clock()
    with (
        closing(open_connection("udpin://127.0.0.1:0", clock)) as connection,
        peer() as thief,
        peer() as vehicle,
    ):
        to = ("127.0.0.1", port_of(connection))
        thief.sendto(FRAME, to)
        assert wait({"it": connection}, time.monotonic_ns() + LIMIT_NS) and connection.receive()
        connection.answer(0)
        for _ in range(6):
            clock.now_ns += 1_000_000_000
            thief.sendto(FRAME, to)
            assert wait({"it": connection}, time.monotonic_ns() + LIMIT_NS) and connection.receive()
        vehicle.sendto(FRAME, to)
        assert wait({"it": connection}, time.monotonic_ns() + LIMIT_NS) and connection.receive()
        connection.answer(0)
        connection.send(b"setpoint")
        assert vehicle.recv(64) == b"setpoint"


def test_a_connected_socket_has_its_cap_too() -> None:
    with (
        peer() as vehicle,
        closing(open_connection(f"udpout://127.0.0.1:{vehicle.getsockname()[1]}", Clock())) as connection,
    ):
        connection.send(b"hello")
        _, address = vehicle.recvfrom(64)
        for _ in range(100):
            vehicle.sendto(FRAME, address)
        while wait({"it": connection}, time.monotonic_ns() + 50_000_000):
            connection.receive()
        assert connection.refused == {"too-many": 100 - BURST}
