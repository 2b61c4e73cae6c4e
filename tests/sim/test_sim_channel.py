"""The channel's statistics against closed forms; its effects one by one."""

import math
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from sim.channel import Channel
from uavctl.config.document import Spans
from uavctl.config.link import LinkConfig

MS = 1_000_000
N = 20_000


def channel(seed: int = 3, start_ns: int = 0, **link: Any) -> Channel:
    return Channel(LinkConfig(**link), np.random.SeedSequence(seed), start_ns)


def packet(i: int) -> bytes:
    return i.to_bytes(8, "little") + bytes(24)


def arrivals(ch: Channel, n: int = N, period_ns: int = 10 * MS) -> list[tuple[int, bytes]]:
    for i in range(n):
        ch.push(i * period_ns, packet(i))
    return ch.pop_due(10**18)


def numbers(got: list[tuple[int, bytes]]) -> list[int]:
    return [int.from_bytes(data[:8], "little") for _, data in got]


def test_a_perfect_link_delivers_everything_at_once_and_in_order() -> None:
    ch = channel()
    got = arrivals(ch, 100)
    assert got == [(i * 10 * MS, packet(i)) for i in range(100)]
    assert (ch.counters.sent, ch.counters.lost, ch.next_ns) == (100, 0, None)


def test_bernoulli_loses_the_share_asked_for_independently() -> None:
    ch = channel(loss=0.3)
    got = set(numbers(arrivals(ch)))
    assert len(got) == N - ch.counters.lost
    assert abs(ch.counters.lost / N - 0.3) < 4 * math.sqrt(0.3 * 0.7 / N)
    lost = np.array([i not in got for i in range(N)])
    # two in a row: p², with the standard error of N - 1 dependent pairs bounded by that of pairs doubled
    assert abs(float(np.mean(lost[1:] & lost[:-1])) - 0.09) < 4 * math.sqrt(2 * 0.09 * 0.91 / N)


@pytest.mark.slow
def test_gilbert_elliott_loss_rate_and_burst_length() -> None:
    enter, leave, in_good, in_bad = 0.05, 0.25, 0.02, 1.0
    ch = channel(model="gilbert-elliott", loss=in_good, burst_enter=enter, burst_leave=leave, burst_loss=in_bad)
    got = set(numbers(arrivals(ch)))
    bad = enter / (enter + leave)
    rate = (1 - bad) * in_good + bad * in_bad
    memory = 1 - enter - leave  # second eigenvalue of the chain
    error = math.sqrt(bad * (1 - bad) * (1 + memory) / (1 - memory) / N + rate * (1 - rate) / N)
    assert abs(ch.counters.lost / N - rate) < 4 * error
    clean = channel(model="gilbert-elliott", burst_enter=enter, burst_leave=leave)
    got = set(numbers(arrivals(clean)))
    lost = [i not in got for i in range(N)]
    ends = sum(a and not b for a, b in pairwise(lost))
    bursts = ends + lost[-1]
    # geometric bursts: mean 1 / leave, variance (1 - leave) / leave²
    assert abs(sum(lost) / bursts - 1 / leave) < 4 * math.sqrt((1 - leave) / leave**2 / bursts)


def test_delay_lies_in_its_range_evenly_and_packets_overtake() -> None:
    got = arrivals(channel(delay_s=0.03, jitter_s=0.04))
    assert [at_ns for at_ns, _ in got] == sorted(at_ns for at_ns, _ in got)
    delays = np.array([at_ns - 10 * MS * i for (at_ns, _), i in zip(got, numbers(got), strict=True)]) / MS
    assert delays.min() >= 30
    assert delays.max() <= 70
    assert abs(float(delays.mean()) - 50) < 4 * 40 / math.sqrt(12 * N)
    assert abs(float(delays.std()) - 40 / math.sqrt(12)) < 0.2
    order = numbers(got)
    assert sorted(order) == list(range(N))
    assert any(a > b for a, b in pairwise(order))


def test_only_what_is_due_is_taken_the_limit_included() -> None:
    ch = channel(delay_s=0.03)
    ch.push(0, b"a")
    ch.push(10 * MS, b"b")
    assert ch.next_ns == 30 * MS
    assert ch.pop_due(30 * MS - 1) == []
    assert ch.pop_due(30 * MS) == [(30 * MS, b"a")]
    assert ch.next_ns == 40 * MS
    assert ch.pop_due(50 * MS) == [(40 * MS, b"b")]


def test_duplicates_come_with_a_delay_of_their_own() -> None:
    ch = channel(duplicate=0.25, jitter_s=0.04)
    got = arrivals(ch)
    assert len(got) == N + ch.counters.duplicated
    assert abs(ch.counters.duplicated / N - 0.25) < 4 * math.sqrt(0.25 * 0.75 / N)
    times: dict[int, list[int]] = {}
    for (at_ns, _), i in zip(got, numbers(got), strict=True):
        times.setdefault(i, []).append(at_ns)
    assert all(a != b for a, b in (pair for pair in times.values() if len(pair) == 2))


def test_corruption_flips_exactly_one_bit_anywhere() -> None:
    ch = channel(corrupt=0.5)
    wrong = np.zeros(8 * 32, dtype=int)
    for i, (_, data) in enumerate(arrivals(ch, 20_000)):
        difference = int.from_bytes(data, "little") ^ int.from_bytes(packet(i), "little")
        if difference:
            assert difference.bit_count() == 1
            wrong[difference.bit_length() - 1] += 1
    assert wrong.sum() == ch.counters.corrupted
    assert abs(wrong.sum() / 20_000 - 0.5) < 4 * math.sqrt(0.25 / 20_000)
    assert wrong.min() > 0


def test_truncation_cuts_somewhere_before_the_end() -> None:
    ch = channel(truncate=1.0)
    got = arrivals(ch, 2000)
    assert ch.counters.truncated == 2000
    assert all(packet(i).startswith(data) for i, (_, data) in enumerate(got))
    assert {len(data) for _, data in got} == set(range(32))


def test_blackout_loses_everything_from_its_first_to_its_last_instant() -> None:
    ch = channel(start_ns=5 * MS, blackout=((0.02, 0.05), (0.09, math.inf)))
    for i in range(12):
        ch.push(5 * MS + i * 10 * MS, packet(i))
    assert numbers(ch.pop_due(10**18)) == [0, 1, 6, 7, 8]
    assert ch.counters.lost == 7


def test_a_backlog_comes_all_at_once_at_the_end_of_its_span_and_in_order() -> None:
    ch = channel(start_ns=5 * MS, delay_s=0.005, held=((0.06, 0.08), (0.02, 0.05)))
    for i in range(10):
        ch.push(5 * MS + i * 10 * MS, packet(i))
    # on their way for 5 ms: packets 2, 3, 4 would come at 25, 35, 45 ms, packets 6, 7 at 65, 75 ms
    got = ch.pop_due(10**18)
    assert [at_ns // MS - 5 for at_ns, _ in got] == [5, 15, 50, 50, 50, 55, 80, 80, 85, 95]
    assert numbers(got) == list(range(10))
    assert ch.counters.lost == 0


def test_a_backlog_is_in_the_order_of_arrival_not_of_sending() -> None:
    free, held = channel(jitter_s=0.1), channel(jitter_s=0.1, held=((0.0, 1.0),))
    assert numbers(arrivals(held, 50)) == numbers(arrivals(free, 50)) != list(range(50))


@pytest.mark.parametrize("held", [((0.01, 0.02), (0.02, 0.03)), ((0.02, 0.03), (0.01, 0.02))])
def test_spans_of_backlog_that_touch_are_one(held: Spans) -> None:
    ch = channel(held=held)
    ch.push(15 * MS, b"a")
    assert ch.next_ns == 30 * MS


def test_each_step_has_its_probability_to_arrive_its_end_included() -> None:
    link = LinkConfig(probability=(1.0, 0.0, 1.0))
    ch = Channel(link, np.random.SeedSequence(3), 5 * MS, 10 * MS)
    for i, at_ms in enumerate((0, 1, 10, 11, 20, 90)):  # steps 0, 1, 1, 2, 2, and beyond the last
        ch.push((5 + at_ms) * MS, packet(i))
    assert numbers(ch.pop_due(10**18)) == [0, 3, 4, 5]
    with pytest.raises(ValueError, match="by steps"):
        Channel(link, np.random.SeedSequence(3), 0)


def test_oversized_datagrams_are_the_packet_and_padding() -> None:
    ch = channel(oversize=0.25)
    got = arrivals(ch, 4000)
    large = [data for _, data in got if len(data) > 32]
    assert len(large) == ch.counters.oversized
    assert abs(len(large) / 4000 - 0.25) < 4 * math.sqrt(0.25 * 0.75 / 4000)
    assert {len(data) for data in large} == {5000}  # beyond the 4096 bytes that the other end takes
    assert [data[:32] for _, data in got] == [packet(i) for i in range(4000)]


def test_what_is_not_sent_shifts_no_draw() -> None:
    link: dict[str, Any] = {"loss": 0.3, "jitter_s": 0.2, "duplicate": 0.2, "corrupt": 0.2, "truncate": 0.2}
    bursts = {"model": "gilbert-elliott", "burst_enter": 0.2, "burst_leave": 0.3}
    for more in ({}, bursts, {"model": "empirical", "gaps": (0.5, 0.2, 0.3)}):
        whole, holes = channel(**link, **more), channel(**link, **more)
        for i in range(400):
            whole.push(i * 10 * MS, packet(i))
            if 100 <= i < 200:
                holes.skip_packet(i * 10 * MS)
            else:
                holes.push(i * 10 * MS, packet(i))
        assert holes.counters.sent == 300
        rest = set(holes.pop_due(10**18))
        everything = set(whole.pop_due(10**18))
        assert rest < everything


OTHERS: dict[str, dict[str, Any]] = {
    "loss": {"loss": 0.3},
    "bursts": {"model": "gilbert-elliott", "burst_enter": 0.1, "burst_leave": 0.3},
    "duplicate": {"duplicate": 0.2},
    "corrupt": {"corrupt": 0.2},
    "truncate": {"truncate": 0.2},
    "oversize": {"oversize": 0.2},
    "held": {"held": ((100.0, 101.0),)},
    "blackout": {"blackout": ((1.0, 2.0),)},
}


@pytest.mark.parametrize("effect", OTHERS)
def test_an_effect_switched_on_shifts_no_other_draw(effect: str) -> None:
    link: dict[str, Any] = {"delay_s": 0.01, "jitter_s": 0.1}
    plain = {at_ns for at_ns, _ in arrivals(channel(**link), 500)}
    loaded = {at_ns for at_ns, _ in arrivals(channel(**link, **OTHERS[effect]), 500)}
    assert len(plain) == 500
    assert len(loaded) > 200
    assert plain < loaded if effect == "duplicate" else loaded <= plain


def test_loss_is_the_same_whatever_else_goes_wrong() -> None:
    plain = set(numbers(arrivals(channel(loss=0.3), 2000)))
    messy = set(numbers(arrivals(channel(loss=0.3, jitter_s=0.3, duplicate=0.3), 2000)))
    assert plain == messy


def test_one_seed_one_history() -> None:
    link: dict[str, Any] = {"loss": 0.2, "jitter_s": 0.1, "duplicate": 0.1, "corrupt": 0.1, "truncate": 0.1}
    assert arrivals(channel(1, **link), 1000) == arrivals(channel(1, **link), 1000)
    assert arrivals(channel(1, **link), 1000) != arrivals(channel(2, **link), 1000)
