"""Measurement of a real link between two computers, without sockets: datagrams and times in, datagrams out.

1. The measuring side sends numbered probes at a fixed rate. From the first one on, the answering side sends as many
   back. Each side counts the losses of the other's, so each way is measured by itself.
2. An answer holds the times of the newest probe: sent, received. They give the round trips.
3. At the end the measuring side asks for the times of arrival of its probes, again and again until it has them.
4. The lower envelopes of both ways give offset and drift of the clocks, see `fit_clock`.

Probes have the size of a position in a signed frame of MAVLink 2. The answering side sends nothing after a second
without a probe.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar

from uavctl.arrays import SECOND_NS, Array
from uavctl.config.link import MAX_TRACE_PACKETS
from uavctl.errors import UavctlError

MIN_PERIOD_NS = SECOND_NS // 1000
MIN_ARRIVALS = 50  # of either way; fewer say nothing of losses
WAIT_NS = SECOND_NS  # for the last probes; a later one counts as lost
REPORT_LIMIT_NS = 30 * SECOND_NS
_MAX_DRIFT = 5e-4  # of the clocks [s/s]: quartz has 1e-4 at most, and NTP adds no more than 5e-4
_SILENCE_NS = SECOND_NS  # from the last probe to the end of the answers
_ASK_PERIOD_NS = SECOND_NS // 20
_SIZE = 145  # bytes of a datagram
_MAGIC = b"uavl"
_HEAD = struct.Struct("<4sBQ")  # magic, kind, session
_PROBE = struct.Struct("<IIQq")  # number, count, period, sent
_ANSWER = struct.Struct("<Iqqq")  # number, sent; of the newest probe: sent, received
_FIRST = struct.Struct("<I")  # number of the first probe of a report
_REPORTED = 14  # times of arrival in a report
_TIMES = struct.Struct(f"<{_REPORTED}q")
_LOST_NS = -1
_KIND_PROBE, _KIND_ANSWER, _KIND_ASK, _KIND_REPORT = 1, 2, 3, 4


@dataclass(frozen=True)
class WayMeasurement:
    """One way of the link: a delay for each packet, infinite for a lost one."""

    sent_s: Array  # (n,), from the first packet [s]
    delays_s: Array  # (n,)


@dataclass(frozen=True)
class LinkMeasurement:
    """Both ways of a link, and the round trips."""

    there: WayMeasurement  # from the measuring side
    back: WayMeasurement
    round_trips_s: Array  # (m,), without the time at the other side
    clock_offset_s: float  # of the answering side's clock at the first packet, as if the shortest delays were equal
    clock_drift: float  # of that offset [s/s]


class LinkProbe:
    """The measuring side.

    Args:
        session: Number that no other measurement has, so that no old datagram counts.
        count: Packets of either way.
        period_ns: Time from one packet to the next.
    """

    def __init__(self, session: int, count: int, period_ns: int, start_ns: int) -> None:
        self._session, self._count, self._period_ns, self._start_ns = session, count, period_ns, start_ns
        self._sent_ns: list[int] = []
        self._answers: dict[int, tuple[int, int]] = {}  # by number: sent, received
        self._trips: list[tuple[int, int, int, int]] = []  # probe sent, received; answer sent, received
        self._reports: dict[int, tuple[int, ...]] = {}
        self._asked_ns = 0
        self._end_ns = start_ns + count * period_ns + WAIT_NS

    @property
    def next_ns(self) -> int:
        """Time of the next call of `poll` [ns]."""
        if len(self._sent_ns) < self._count:
            return self._start_ns + len(self._sent_ns) * self._period_ns
        return max(self._end_ns, self._asked_ns + _ASK_PERIOD_NS)

    @property
    def sent(self) -> int:
        """Number of probes sent."""
        return len(self._sent_ns)

    @property
    def is_complete(self) -> bool:
        """Whether all times of arrival are known."""
        return len(self._reports) * _REPORTED >= self._count

    def is_over(self, now_ns: int) -> bool:
        """Return whether there is nothing more to wait for."""
        return self.is_complete or now_ns >= self._end_ns + REPORT_LIMIT_NS

    def poll(self, now_ns: int) -> list[bytes]:
        """Return the datagrams that are due."""
        if len(self._sent_ns) < self._count:
            if now_ns < self.next_ns:
                return []
            number = len(self._sent_ns)
            self._sent_ns.append(now_ns)
            return [self._pack(_KIND_PROBE, _PROBE.pack(number, self._count, self._period_ns, now_ns))]
        if now_ns < self.next_ns:
            return []
        self._asked_ns = now_ns
        missing = [first for first in range(0, self._count, _REPORTED) if first not in self._reports]
        return [self._pack(_KIND_ASK, _FIRST.pack(first)) for first in missing[:10]]

    def receive(self, data: bytes, at_ns: int) -> None:
        """Take a datagram; what is no answer of this measurement is passed over."""
        kind, session, body = unpack_head(data)
        if session != self._session:
            return
        if kind == _KIND_ANSWER:
            number, sent_ns, probe_sent_ns, probe_received_ns = _ANSWER.unpack_from(body)
            if number < self._count and at_ns < self._end_ns:
                self._answers.setdefault(number, (sent_ns, at_ns))
                self._trips.append((probe_sent_ns, probe_received_ns, sent_ns, at_ns))
        elif kind == _KIND_REPORT:
            (first,) = _FIRST.unpack_from(body)
            if first % _REPORTED == 0 and first < self._count:
                self._reports[first] = _TIMES.unpack_from(body, _FIRST.size)

    def measure(self) -> LinkMeasurement:
        """Return both ways of the link.

        Raises:
            UavctlError: Too little has arrived.
        """
        if not self.is_complete:
            raise UavctlError(
                f"the other side reported {len(self._reports) * _REPORTED} of {self._count} times of arrival; see that "
                "`uavctl bench --link udpin://0.0.0.0:PORT` runs there, and that nothing between blocks the port"
            )
        received_ns = [time_ns for first in sorted(self._reports) for time_ns in self._reports[first]][: self._count]
        counts = len(self._answers), sum(time_ns != _LOST_NS for time_ns in received_ns)
        if min(counts) < MIN_ARRIVALS:
            raise UavctlError(
                f"{counts[1]} packets arrived there and {counts[0]} here, of {self._count}; at least {MIN_ARRIVALS} "
                "are needed: measure longer with --seconds"
            )
        sent_ns = np.array(self._sent_ns, dtype=np.int64)
        arrived_ns = np.array(received_ns, dtype=np.int64)
        is_there = arrived_ns != _LOST_NS
        begin_ns = self._sent_ns[0]
        answered_ns, heard_ns = np.array(list(self._answers.values()), dtype=np.int64).T
        offset_s, drift = fit_clock(
            1e-9 * (sent_ns - begin_ns)[is_there],
            1e-9 * (arrived_ns - sent_ns)[is_there],
            1e-9 * (heard_ns - begin_ns),
            1e-9 * (heard_ns - answered_ns),
        )

        def get_offset_ns(at_ns: int) -> int:
            return round(1e9 * (offset_s + drift * 1e-9 * (at_ns - begin_ns)))

        there = [
            (at_ns, None if time_ns == _LOST_NS else time_ns - get_offset_ns(at_ns))
            for at_ns, time_ns in zip(self._sent_ns, received_ns, strict=True)
        ]
        # A lost answer was sent at about its turn.
        first = min(self._answers)
        base_ns = self._answers[first][0] - first * self._period_ns
        back = [
            (self._answers[number][0], self._answers[number][1] + get_offset_ns(self._answers[number][1]))
            if number in self._answers
            else (base_ns + number * self._period_ns, None)
            for number in range(self._count)
        ]
        t1, t2, t3, t4 = np.array(self._trips, dtype=np.int64).T
        return LinkMeasurement(
            there=_make_way(there),
            back=_make_way(back),
            round_trips_s=1e-9 * ((t4 - t1) - (t3 - t2)),
            clock_offset_s=offset_s,
            clock_drift=drift,
        )

    def _pack(self, kind: int, body: bytes) -> bytes:
        return pack_datagram(kind, self._session, body)


def fit_clock(there_at_s: Array, there_s: Array, back_at_s: Array, back_s: Array) -> tuple[float, float]:
    """Fit offset θ [s] and drift δ [s/s] of the answering side's clock to the lower envelopes of both ways.

    No delay is shorter than the link's, d, which is taken to be the same both ways. On a clock that drifts, the
    shortest differences of the clocks' times lie on d + θ + δ t on the way there, and on d − θ − δ t on the way back.
    δ is where both lines below all differences are nearest to them in the mean.

    Args:
        there_at_s: Times of sending (n,) on the measuring side.
        there_s: Times of arrival there less those of sending (n,).
        back_at_s: Times of arrival (m,) on the measuring side.
        back_s: Times of arrival less those of sending there (m,).
    """
    # Large offsets have few digits left for delays.
    there_base_s, back_base_s = there_s.min(), back_s.min()
    there, back = there_s - there_base_s, back_s - back_base_s

    def compute_distance(drift: float) -> float:
        levels = there - drift * there_at_s, back + drift * back_at_s
        return float(sum(level.mean() - level.min() for level in levels))

    found = minimize_scalar(
        compute_distance, bounds=(-_MAX_DRIFT, _MAX_DRIFT), method="bounded", options={"xatol": 1e-8}
    )
    drift = float(found.x)
    # d + θ = min(t₂ − t₁ − δ t),   d − θ = min(t₄ − t₃ + δ t)
    plus_s = there_base_s + (there - drift * there_at_s).min()
    minus_s = back_base_s + (back + drift * back_at_s).min()
    return float(plus_s - minus_s) / 2.0, drift


class LinkAnswer:
    """The answering side, for one measurement after another.

    Attributes:
        reports: Reports of the present measurement that were asked for.
    """

    def __init__(self) -> None:
        self._session: int | None = None
        self._count = self._period_ns = self._start_ns = self._sent = 0
        self._newest: tuple[int, int] = (0, 0)  # of the newest probe: sent, received
        self._heard_ns = 0
        self._received_ns: dict[int, int] = {}
        self.reports: set[int] = set()

    @property
    def is_complete(self) -> bool:
        """Whether each report of a measurement was asked for."""
        return self._session is not None and len(self.reports) * _REPORTED >= self._count

    def next_ns(self, now_ns: int) -> int:
        """Return the time of the next answer [ns]."""
        if self._session is None or self._sent >= self._count or now_ns - self._heard_ns > _SILENCE_NS:
            return now_ns + SECOND_NS // 10
        return self._start_ns + self._sent * self._period_ns

    def poll(self, now_ns: int) -> list[bytes]:
        """Return the answer that is due."""
        if self._session is None or self._sent >= self._count or now_ns - self._heard_ns > _SILENCE_NS:
            return []
        if now_ns < self._start_ns + self._sent * self._period_ns:
            return []
        body = _ANSWER.pack(self._sent, now_ns, *self._newest)
        self._sent += 1
        return [pack_datagram(_KIND_ANSWER, self._session, body)]

    def receive(self, data: bytes, at_ns: int) -> list[bytes] | None:
        """Take a datagram; return what to send at once, or None for one that is none of a measurement."""
        kind, session, body = unpack_head(data)
        if kind == _KIND_PROBE:
            number, count, period_ns, sent_ns = _PROBE.unpack_from(body)
            if not (number < count <= MAX_TRACE_PACKETS and period_ns >= MIN_PERIOD_NS):
                return None
            if session != self._session:
                self._session, self._count, self._period_ns, self._sent = session, count, period_ns, 0
                self._start_ns, self._received_ns, self.reports = at_ns, {}, set()
            if number not in self._received_ns:
                self._received_ns[number] = at_ns
                self._newest = sent_ns, at_ns
            self._heard_ns = at_ns
            return []
        if kind == _KIND_ASK and session == self._session:
            (first,) = _FIRST.unpack_from(body)
            numbers = range(first, first + _REPORTED)
            self.reports.add(first)
            times = _TIMES.pack(*(self._received_ns.get(number, _LOST_NS) for number in numbers))
            return [pack_datagram(_KIND_REPORT, session, _FIRST.pack(first) + times)]
        return None


def pack_datagram(kind: int, session: int, body: bytes) -> bytes:
    """Return a datagram of the size of all others."""
    return (_HEAD.pack(_MAGIC, kind, session) + body).ljust(_SIZE, b"\0")


def unpack_head(data: bytes) -> tuple[int, int, bytes]:
    """Return kind, session and the rest of a datagram; kind 0 if it is another program's."""
    if len(data) != _SIZE:
        return 0, 0, b""
    magic, kind, session = _HEAD.unpack_from(data)
    return (int(kind), int(session), data[_HEAD.size :]) if magic == _MAGIC else (0, 0, b"")


def _make_way(packets: Sequence[tuple[int, int | None]]) -> WayMeasurement:
    begin_ns = packets[0][0]
    delays_s = [np.inf if arrived_ns is None else 1e-9 * (arrived_ns - sent_ns) for sent_ns, arrived_ns in packets]
    return WayMeasurement(
        sent_s=1e-9 * np.array([sent_ns - begin_ns for sent_ns, _ in packets], dtype=np.float64),
        delays_s=np.maximum(np.array(delays_s), 0.0),
    )
