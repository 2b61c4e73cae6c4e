"""Time limit of a tick: what never answers is interrupted, whatever it does and catches."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable
from types import SimpleNamespace

import pytest

from uavctl.daemon import tick_limit
from uavctl.daemon.tick_limit import ENGAGED_LIMIT_S, LIMIT_S, TickLimit, limit_ticks
from uavctl.errors import TickOverdueError


def loop_for_ever() -> None:
    while True:
        pass


def sleep_for_ever() -> None:
    time.sleep(10**6)


def catch_errors_for_ever() -> None:
    while True:
        try:
            loop_for_ever()
        except Exception:  # noqa: BLE001 as code of another package may
            continue


@pytest.fixture
def _short_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    """A fifth of the real time; how long the limits are is counted below."""
    monkeypatch.setattr(tick_limit, "LIMIT_S", 0.2)


@pytest.mark.usefixtures("_short_limit")
@pytest.mark.fault(102)
@pytest.mark.parametrize("run", [loop_for_ever, sleep_for_ever, catch_errors_for_ever])
def test_102_a_tick_without_an_end_is_interrupted(run: Callable[[], None]) -> None:
    with limit_ticks() as limit, pytest.raises(TickOverdueError), limit.apply():
        run()


@pytest.mark.usefixtures("_short_limit")
@pytest.mark.fault(102)
def test_102_an_error_that_is_swallowed_comes_again() -> None:
    caught = []
    with limit_ticks() as limit, pytest.raises(TickOverdueError), limit.apply():
        try:
            loop_for_ever()
        except BaseException as error:  # noqa: BLE001 as code of another package may
            caught.append(error)
        loop_for_ever()
    assert len(caught) == 1


@pytest.mark.fault(102)
@pytest.mark.parametrize(("is_engaged", "limit_s"), [(False, LIMIT_S), (True, ENGAGED_LIMIT_S)])
def test_102_a_tick_in_control_has_a_limit_of_its_own(
    is_engaged: bool, limit_s: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Counted in wakes of the watch: the first one may come at once, so there is one more than fit into the limit."""
    limit, wakes = TickLimit(ENGAGED_LIMIT_S), 0
    monkeypatch.setattr(signal, "pthread_kill", lambda *_: limit.end())

    def wake(_: float) -> bool:
        nonlocal wakes
        wakes += not ended.is_set()
        return ended.is_set()

    ended = limit._done
    monkeypatch.setattr(limit, "_done", SimpleNamespace(wait=wake, set=ended.set))
    with limit.apply(is_engaged=is_engaged):
        limit.watch(0)
    assert wakes == 1 + round(limit_s / 0.05)


def test_nothing_is_interrupted_between_ticks() -> None:
    before = signal.getsignal(signal.SIGURG)
    with limit_ticks():
        signal.raise_signal(signal.SIGURG)
    assert signal.getsignal(signal.SIGURG) is before
