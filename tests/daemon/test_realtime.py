"""`--realtime`: what is permitted is done and undone, what is not is told with what to do."""

from __future__ import annotations

import gc
import os
import resource
import weakref
from collections.abc import Iterator

import pytest
from ticked_rig import ticked

from uavctl.daemon import realtime as module
from uavctl.daemon.realtime import GarbageCollector, RealtimeSetting, control_garbage_collection, enable_realtime

SECOND = 1_000_000_000


@pytest.fixture(autouse=True)
def _as_before() -> Iterator[None]:
    gc.unfreeze()  # another test of this process may have left objects frozen
    before = os.sched_getscheduler(0)
    yield
    assert os.sched_getscheduler(0) == before
    assert gc.isenabled() and gc.get_freeze_count() == 0
    gc.freeze()  # as tests/conftest.py has it for the others of this process


def outcomes(found: tuple[RealtimeSetting, ...]) -> dict[str, RealtimeSetting]:
    return {outcome.name: outcome for outcome in found}


def test_what_it_says_is_what_holds() -> None:
    with enable_realtime() as found:
        told = outcomes(found)
        assert told["scheduling"].is_applied == (os.sched_getscheduler(0) == os.SCHED_FIFO)


def test_without_permission_it_flies_on_and_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    monkeypatch.setattr(module, "_may_lock_memory", lambda: False)
    monkeypatch.setattr(resource, "getrlimit", lambda _: (65536, 65536))
    with enable_realtime() as found:
        told = outcomes(found)
        assert not told["scheduling"].is_applied and "LimitRTPRIO=20" in told["scheduling"].text
        # A limit that the memory fits in today would make an allocation fail in flight.
        assert not told["memory"].is_applied and "LimitMEMLOCK=infinity" in told["memory"].text


class _Ring:
    """Garbage that only a collection finds."""

    def __init__(self) -> None:
        self.itself = self


def test_what_was_there_is_not_walked_in_a_flight_and_nothing_is_collected_of_itself() -> None:
    with control_garbage_collection():
        assert not gc.isenabled() and gc.get_freeze_count() > 0
    assert gc.isenabled() and gc.get_freeze_count() == 0


def test_garbage_goes_once_a_second_and_only_after_a_tick() -> None:
    collector = GarbageCollector()
    gc.disable()
    try:
        collector.after_tick(ticked(0), 0)
        seen = weakref.ref(_Ring())
        collector.after_tick(ticked(SECOND - 1), 0)
        assert seen() is not None
        collector.after_tick(ticked(SECOND), 0)
        assert seen() is None
    finally:
        gc.enable()
