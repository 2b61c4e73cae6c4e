"""Ticks on a grid, with a clock that the test moves."""

from __future__ import annotations

import time

import pytest

from uavctl.clock import TickDeadline, Ticker, monotonic_ns

PERIOD, ALIGN = 50, 200


class Clock:
    def __init__(self, now_ns: int) -> None:
        self.now_ns = now_ns

    def __call__(self) -> int:
        return self.now_ns


@pytest.mark.parametrize(("now_ns", "start_ns"), [(0, 200), (1, 200), (199, 200), (200, 400), (1_000_050, 1_000_200)])
def test_the_grid_begins_at_a_multiple_of_its_alignment(now_ns: int, start_ns: int) -> None:
    assert Ticker(PERIOD, ALIGN, Clock(now_ns)).next() == TickDeadline(0, start_ns, 0)


def test_two_tickers_share_the_grid() -> None:
    one, other = Ticker(PERIOD, ALIGN, Clock(1_003)), Ticker(PERIOD, ALIGN, Clock(1_177))
    assert one.next().at_ns == other.next().at_ns == 1_200


def test_deadlines_are_absolute() -> None:
    clock = Clock(150)
    ticker = Ticker(PERIOD, ALIGN, clock)
    for n in range(1000):
        due = ticker.next()
        assert due == TickDeadline(n, 200 + n * PERIOD, 0)
        clock.now_ns = due.at_ns + n % PERIOD  # however late the work ends within the period


def test_missed_ticks_are_counted_and_not_made_up() -> None:
    clock = Clock(150)
    ticker = Ticker(PERIOD, ALIGN, clock)
    assert ticker.next() == TickDeadline(0, 200, 0)
    clock.now_ns = 200 + 7 * PERIOD + 13  # slept through 1 to 6; 7 is 13 late
    assert ticker.next() == TickDeadline(7, 200 + 7 * PERIOD, 6)
    assert ticker.next() == TickDeadline(8, 200 + 8 * PERIOD, 0)  # ahead again: one tick, no burst
    assert ticker.next().at_ns > clock.now_ns


def test_a_wait_that_lasted_until_a_later_tick_was_due_gives_that_one() -> None:
    clock = Clock(150)
    ticker = Ticker(PERIOD, ALIGN, clock)
    due = ticker.next()
    clock.now_ns = 200 + PERIOD - 1
    assert ticker.update_after_wait(due) == due
    due = ticker.next()
    assert due == TickDeadline(1, 200 + PERIOD, 0)
    clock.now_ns = 200 + 3 * PERIOD + 7
    assert ticker.update_after_wait(due) == TickDeadline(3, 200 + 3 * PERIOD, 2)
    assert ticker.next() == TickDeadline(4, 200 + 4 * PERIOD, 0)
    clock.now_ns = 200 + 6 * PERIOD
    due = ticker.next()
    assert due == TickDeadline(6, 200 + 6 * PERIOD, 1)
    clock.now_ns += 2 * PERIOD
    assert ticker.update_after_wait(due) == TickDeadline(8, 200 + 8 * PERIOD, 3)


def test_ticks_done_and_missed_add_up_in_any_weather() -> None:
    clock = Clock(0)
    ticker = Ticker(PERIOD, ALIGN, clock)
    done = missed = 0
    last = -1
    for n in range(5000):
        due = ticker.next()
        clock.now_ns = max(clock.now_ns, due.at_ns) + (n * n * 6007) % 97
        due = ticker.update_after_wait(due)
        done, missed = done + 1, missed + due.missed
        assert due.tick == last + 1 + due.missed == done + missed - 1
        assert due.at_ns == 200 + due.tick * PERIOD
        assert clock.now_ns - due.at_ns < PERIOD
        last = due.tick
        clock.now_ns = max(clock.now_ns, due.at_ns) + (n * n * 7919) % 171


def test_nothing_is_missed_before_the_first_call() -> None:
    clock = Clock(0)
    ticker = Ticker(PERIOD, ALIGN, clock)
    clock.now_ns = 10_010  # a design was made meanwhile
    assert ticker.next() == TickDeadline(0, 10_200, 0)


@pytest.mark.parametrize(("period_ns", "align_ns"), [(0, 200), (-50, 200), (60, 200), (50, 0)])
def test_a_grid_that_does_not_fit_is_refused(period_ns: int, align_ns: int) -> None:
    with pytest.raises(ValueError, match="must be positive and divide"):
        Ticker(period_ns, align_ns)


def test_the_clock_is_the_monotonic_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(time, "time_ns", lambda: -1)  # the wall clock steps: nobody asks it
    before = time.monotonic_ns()
    assert before <= monotonic_ns() <= time.monotonic_ns()
