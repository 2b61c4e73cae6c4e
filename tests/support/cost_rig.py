"""What recording costs the thread that flies: a flight's records put tick by tick, in real time, after a rest each."""

from __future__ import annotations

import gc
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import cycle
from pathlib import Path

import numpy as np
from loopback_rig import lockstep
from recording_fakes import Item

from logs.recording.recorder import DerivedTopics, Recorder
from logs.recording.views import ViewBuilder
from uavctl.cli.live_line import SWITCH_INTERVAL_S
from uavctl.records import Record, Sink

FLIGHT_S = 20.0  # it is put again and again
TICK_S = 0.05
SWEPT = 1_000_000  # floats that are touched between ticks, so that caches hold as little as after a decision


class NullSink:
    """Takes records and does nothing: what calling and measuring cost by themselves."""

    def put(self, topic: str, at_ns: int, record: Record) -> None:
        """Do nothing."""


def flown_ticks() -> list[list[Item]]:
    """A flight's records, tick by tick."""
    ticks: list[list[Item]] = [[]]
    for item in lockstep("room-hahn-stursberg", FLIGHT_S).entries:
        if item[0] == "/uavctl/step_input" and ticks[-1]:
            ticks.append([])
        ticks[-1].append(item)
    return ticks


def measure_cost(folder: Path, ticks: list[list[Item]], seconds: float) -> dict[str, float]:
    """Put so many seconds of ticks, every other one into a sink that does nothing.

    Returns:
        Wall times [us] of a record and of a tick's records, median and 99th percentile; with `empty_`, those of the
        sink that does nothing. The clock's own time is in all of them. `dropped`, `records` and `ticks` were recorded.
    """
    recorder, nothing = Recorder(folder / "flight.mcap", derived_topics=DerivedTopics(ViewBuilder())), NullSink()
    with _as_in_flight():
        result = _measured({"": recorder, "empty_": nothing}, ticks, round(seconds / TICK_S))
    status = recorder.close()
    assert status.waiting == 0, "the disk hangs"
    return {**result, "dropped": status.dropped + status.refused}


def _measured(sinks: dict[str, Sink], ticks: list[list[Item]], count: int) -> dict[str, float]:
    swept = np.zeros(SWEPT)
    each_ns: dict[str, list[int]] = {name: [] for name in sinks}
    tick_ns: dict[str, list[int]] = {name: [] for name in sinks}
    due_s = time.monotonic()
    for (name, sink), items, _ in zip(cycle(sinks.items()), cycle(ticks), range(count), strict=False):
        due_s += TICK_S
        time.sleep(max(0.0, due_s - time.monotonic()))
        swept += 1.0
        spent = [_timed(sink, item) for item in items]
        each_ns[name] += spent
        tick_ns[name].append(sum(spent))
    result: dict[str, float] = {"records": len(each_ns[""]), "ticks": len(tick_ns[""])}
    for name in sinks:
        for what, times_ns in (("record", each_ns[name]), ("tick", tick_ns[name])):
            p50, p99 = np.percentile(times_ns, (50, 99)) / 1e3
            result |= {f"{name}{what}_p50_us": float(p50), f"{name}{what}_p99_us": float(p99)}
        result[f"{name}record_mean_us"] = float(np.mean(each_ns[name])) / 1e3
    return result


def _timed(sink: Sink, item: Item) -> int:
    topic, at_ns, record = item
    begun_ns = time.perf_counter_ns()
    sink.put(topic, at_ns, record)
    return time.perf_counter_ns() - begun_ns


@contextmanager
def _as_in_flight() -> Iterator[None]:
    """Garbage and the interpreter's switching as `uavctl fly --realtime` has them."""
    before_s = sys.getswitchinterval()
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()
        gc.unfreeze()
        sys.setswitchinterval(before_s)
