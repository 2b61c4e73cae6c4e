"""A foreign flight as input: a `.tlog` through parser, clock offset, estimator and controller."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterable

import msgspec
import numpy as np

from uavctl.data import Decision, LinkStats, PositionSample, Record, Sink, StepInput
from uavctl.loop import ControlLoop


class Quantiles(msgspec.Struct, frozen=True, kw_only=True):
    """Spread of a figure."""

    min: float
    p05: float
    p50: float
    p95: float
    max: float


class ForeignReplay(msgspec.Struct, frozen=True, kw_only=True):
    """What the controller made of somebody else's recording."""

    datagrams: int
    positions: int
    out_of_order: int
    accepted: int
    rejected: int
    ticks: int
    decisions: int
    solves: dict[str, int]
    modes: dict[str, int]
    left_out: dict[str, int]  # what the connection did not take, by reason
    age_ms: Quantiles | None  # capture -> arrival, after clock conversion
    age_steps: dict[str, int]  # at Δt boundaries


class _Collector:
    """Sink that keeps the figures and forgets the records."""

    def __init__(self) -> None:
        self.samples: list[PositionSample] = []
        self.decisions: list[Decision] = []
        self.stats: dict[str, LinkStats] = {}  # the last of each connection
        self.over = False  # the flight is, and only the counters are waited for

    def put(self, _topic: str, _at_ns: int, record: Record) -> None:
        if isinstance(record, LinkStats):
            self.stats[record.link] = record
        elif self.over:
            return
        elif isinstance(record, StepInput):
            self.samples.extend(record.samples)
        elif isinstance(record, Decision):
            self.decisions.append(record)


def replay_tlog(
    packets: Iterable[tuple[int, bytes]],
    make_loop: Callable[[Sink], ControlLoop],
    *,
    link: str,
    tick_ns: int,
) -> ForeignReplay:
    """Feed incoming packets to a loop on a virtual grid of ticks.

    Args:
        packets: (arrival [ns], bytes) in order of arrival, without the client's own.
        make_loop: builds the loop around the given sink.
        link: name of the connection that they came over.
        tick_ns: grid of the control loop [ns].
    """
    collector = _Collector()
    loop = make_loop(collector)
    datagrams = tick = 0
    start_ns: int | None = None
    for at_ns, data in packets:
        start_ns = at_ns if start_ns is None else start_ns
        while start_ns + tick * tick_ns < at_ns:
            deque(loop.tick(tick, start_ns + tick * tick_ns), maxlen=0)
            tick += 1
        loop.receive(link, data, at_ns)
        datagrams += 1
    if start_ns is None:
        return _figures(collector, link, datagrams, tick)
    end_ns = start_ns + tick * tick_ns
    deque(loop.tick(tick, end_ns), maxlen=0)  # sees the last packets
    tick += 1
    collector.over, later = True, tick
    while collector.stats[link].at_ns < end_ns:  # they are told once a second
        deque(loop.tick(later, start_ns + later * tick_ns), maxlen=0)
        later += 1
    return _figures(collector, link, datagrams, tick)


def _figures(collector: _Collector, link: str, datagrams: int, ticks: int) -> ForeignReplay:
    captured = np.array([s.captured_ns for s in collector.samples], dtype=np.int64)
    age_ms = np.array([(s.received_ns - s.captured_ns) * 1e-6 for s in collector.samples])
    boundaries = [d for d in collector.decisions if d.boundary]
    ages = Counter(d.age_steps for d in boundaries if d.age_steps is not None)
    return ForeignReplay(
        datagrams=datagrams,
        positions=len(captured),
        out_of_order=int(np.count_nonzero(np.diff(captured) < 0)),
        accepted=sum(d.accepted for d in collector.decisions),
        rejected=sum(d.rejected for d in collector.decisions),
        ticks=ticks,
        decisions=len(boundaries),
        solves=dict(Counter(d.solve.value for d in collector.decisions if d.solve is not None)),
        modes=dict(Counter(d.mode.value for d in collector.decisions)),
        left_out=dict(sorted(collector.stats[link].bad.items())) if link in collector.stats else {},
        age_ms=_quantiles(age_ms),
        age_steps={str(age): count for age, count in sorted(ages.items())},
    )


def _quantiles(values: np.ndarray[tuple[int], np.dtype[np.float64]]) -> Quantiles | None:
    if not len(values):
        return None
    low, p05, p50, p95, high = (float(q) for q in np.quantile(values, [0.0, 0.05, 0.5, 0.95, 1.0]))
    return Quantiles(min=low, p05=p05, p50=p50, p95=p95, max=high)
