"""PX4's clock of another computer in the simulator, against the rules of its source."""

from __future__ import annotations

import pytest

from sim.autopilot.peer_clock import CONVERGENCE_COUNT, PeerClock

MS = 1_000_000
OFFSET_NS = -7_123_456_789
PERIOD_NS = 100 * MS


def answered(
    sync: PeerClock, times: int, *, from_ns: int = 20_000 * MS, trip_ns: int = 2 * MS, extra_ns: int = 0
) -> int:
    """Let it ask so often at 10 Hz a peer whose time is its own less `OFFSET_NS + extra_ns`; the time after that."""
    for n in range(times):
        asked_ns = from_ns + n * PERIOD_NS
        sync.add_answer(asked_ns, asked_ns + trip_ns // 2 - OFFSET_NS - extra_ns, asked_ns + trip_ns)
    return from_ns + times * PERIOD_NS


def test_until_500_answers_what_arrives_is_of_now_and_then_stamps_are_moved() -> None:
    sync = PeerClock()
    now_ns = answered(sync, CONVERGENCE_COUNT - 1)
    assert not sync.is_converged and sync.convert_ns(12345, now_ns) == now_ns
    now_ns = answered(sync, 1, from_ns=now_ns)
    assert sync.is_converged
    assert sync.convert_ns(now_ns - OFFSET_NS - 30 * MS, now_ns) == pytest.approx(now_ns - 30 * MS, abs=1000)


@pytest.mark.parametrize(("trip_ns", "counts"), [(0, True), (10 * MS - 1, True), (10 * MS, False), (-1, False)])
def test_only_answers_that_were_back_in_less_than_10_ms_count(trip_ns: int, counts: bool) -> None:
    sync = PeerClock()
    answered(sync, CONVERGENCE_COUNT, trip_ns=trip_ns)
    assert sync.is_converged is counts


@pytest.mark.parametrize("theirs_ns", [0, -1, -(2**63)])
def test_a_request_is_no_answer(theirs_ns: int) -> None:
    sync = PeerClock()
    for n in range(CONVERGENCE_COUNT):
        sync.add_answer(n * PERIOD_NS, theirs_ns, n * PERIOD_NS + MS)
    assert not sync.is_converged


def test_five_answers_of_another_clock_are_dropped_and_the_sixth_begins_anew() -> None:
    sync = PeerClock()
    now_ns = answered(sync, CONVERGENCE_COUNT)
    now_ns = answered(sync, 5, from_ns=now_ns, extra_ns=101 * MS)
    now_ns = answered(sync, 1, from_ns=now_ns)  # one of the old clock: five more are dropped
    now_ns = answered(sync, 5, from_ns=now_ns, extra_ns=101 * MS)
    assert sync.is_converged and sync.convert_ns(-OFFSET_NS, now_ns) == pytest.approx(0, abs=1000)
    now_ns = answered(sync, 1, from_ns=now_ns, extra_ns=101 * MS)
    assert not sync.is_converged
    answered(sync, CONVERGENCE_COUNT, from_ns=now_ns, extra_ns=101 * MS)
    assert sync.convert_ns(-OFFSET_NS, now_ns) == pytest.approx(101 * MS, abs=1000)


def test_a_clock_that_is_a_little_off_is_followed_with_half_a_millisecond_s_lag_at_most() -> None:
    sync = PeerClock()
    now_ns, extra_ns = 20_000 * MS, 0
    for _ in range(3 * CONVERGENCE_COUNT):
        extra_ns += 1000  # 10 millionths
        now_ns = answered(sync, 1, from_ns=now_ns, extra_ns=extra_ns)
    assert sync.convert_ns(-OFFSET_NS - extra_ns, now_ns) == pytest.approx(0, abs=MS // 2)
