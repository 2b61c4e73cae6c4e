"""A lossy packet channel in virtual time, seeded.

Each effect draws from its own generator, the same number of values for every packet whether the
effect is on or off. So two runs with one seed differ only by the effects that differ.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from uavctl.config.document import Spans
from uavctl.config.link import LinkConfig


def is_within(spans: Spans, since_ns: int) -> bool:
    """Return whether a time since the start [ns] lies in one of the spans [s], their ends included."""
    return any(begin * 1e9 <= since_ns <= end * 1e9 for begin, end in spans)


def find_earliest_ns(times_ns: Iterable[int | None]) -> int | None:
    """Return the first of some times [ns]; None for none."""
    first_ns = None
    for at_ns in times_ns:
        if at_ns is not None and (first_ns is None or at_ns < first_ns):
            first_ns = at_ns
    return first_ns


OVERSIZE_BYTES = 5000
_NO_RUN = -1  # no run of losses is under way: the next packet begins one (of 0 or more)


@dataclass
class Counters:
    """Counts of the packets so far, by their fate."""

    sent: int = 0
    lost: int = 0
    duplicated: int = 0
    corrupted: int = 0
    truncated: int = 0
    oversized: int = 0


class _Outcome(NamedTuple):
    """Fate of a packet: lost, delayed, doubled, damaged."""

    lost: bool
    delays_s: tuple[float, ...]  # delay of the packet, and of its duplicate
    data: bytes
    corrupted: bool
    truncated: bool
    oversized: bool


class Channel:
    """One direction of a radio link.

    Loss is Bernoulli, Gilbert-Elliott (the chain starts in the good state and steps before each packet) or
    empirical (a run of losses is drawn after each arrival, and before the first packet) or that of a trace (from its
    first packet on, and over again), and total within a blackout. With `scheduled`, the sender has a turn each
    `wait_s` from the start on and sends the newest packet; all others are lost. What gets through is delayed by
    `delay_s` plus a uniform draw up to `jitter_s`, or as the trace was, so packets may overtake each other. A duplicate
    has its own delay, but with a trace. A bit flip, a cut and padding act on a packet before it is doubled. What
    arrives in a span of `held` is kept until its end.

    Attributes:
        counters: Counts of the packets so far.

    Args:
        link: The section `[link]`.
        start_ns: Where spans and steps count from [ns].
        step_ns: Δt, the step of `link.probability` [ns].

    Raises:
        ValueError: `link.probability` is given without `step_ns`.
    """

    def __init__(
        self, link: LinkConfig, seed: np.random.SeedSequence, start_ns: int, step_ns: int | None = None
    ) -> None:
        if link.probability and step_ns is None:
            raise ValueError("link.probability goes by steps, so their length is needed")
        self.counters = Counters()
        self._pending: list[tuple[int, int, int, bytes]] = []  # (arrival, unheld arrival, order, data)
        self._order = 0
        self._link = link
        self._start_ns = start_ns
        self._step_ns = step_ns or 0
        children = [np.random.default_rng(child) for child in seed.spawn(6)]
        self._loss, self._delay, self._duplicate, self._corrupt, self._truncate, self._oversize = children
        self._is_bad = False
        self._run_probabilities = np.cumsum(link.gaps)
        self._remaining_losses = _NO_RUN
        self._packet_number = 0  # of the next packet
        self._turns = -1  # turns of the sender so far; the first one is at the start

    def push(self, at_ns: int, data: bytes, *, is_certain: bool = False) -> None:
        """Send a packet at `at_ns`; the link never loses one that `is_certain`."""
        counters, outcome = self.counters, self._draw(at_ns, data)
        counters.sent += 1
        if outcome.lost and not is_certain:
            counters.lost += 1
            return
        counters.corrupted += outcome.corrupted
        counters.truncated += outcome.truncated
        counters.oversized += outcome.oversized
        counters.duplicated += len(outcome.delays_s) - 1
        for delay_s in outcome.delays_s:
            # A packet that a trace loses has no delay of its own, but it may be certain.
            arrival_ns = at_ns + (round(delay_s * 1e9) if math.isfinite(delay_s) else 0)
            self._order += 1
            heapq.heappush(self._pending, (self._compute_release_ns(arrival_ns), arrival_ns, self._order, outcome.data))

    def skip_packet(self, at_ns: int) -> None:
        """Skip a packet that was due at `at_ns`; later ones fare as if it had been sent."""
        self._draw(at_ns, b"")

    def pop_due(self, to_ns: int) -> list[tuple[int, bytes]]:
        """Take the packets that arrive up to and including `to_ns`, as (arrival_ns, data) in order of arrival."""
        due = []
        while self._pending and self._pending[0][0] <= to_ns:
            arrival_ns, *_, data = heapq.heappop(self._pending)
            due.append((arrival_ns, data))
        return due

    @property
    def next_ns(self) -> int | None:
        """Time of the next arrival [ns]; None if nothing is under way."""
        return self._pending[0][0] if self._pending else None

    def _draw(self, at_ns: int, data: bytes) -> _Outcome:
        link = self._link
        lost = self._draw_loss(at_ns)
        delays = [link.delay_s + link.jitter_s * float(draw) for draw in self._delay.random(2)]
        if link.model == "trace":
            delays = [link.trace_s[self._packet_number % len(link.trace_s)]] * 2
            lost |= math.isinf(delays[0])
        self._packet_number += 1
        is_duplicated = self._duplicate.random() < link.duplicate
        data, corrupted = self._flip_bit(data)
        data, truncated = self._truncate_data(data)
        oversized = bool(self._oversize.random() < link.oversize)
        data = data.ljust(OVERSIZE_BYTES, b"\0") if oversized else data
        return _Outcome(lost, tuple(delays[: 1 + is_duplicated]), data, corrupted, truncated, oversized)

    def _compute_release_ns(self, arrival_ns: int) -> int:
        """Return when a packet that comes at `arrival_ns` is let through [ns]."""
        for begin, end in sorted(self._link.held):
            if begin * 1e9 <= arrival_ns - self._start_ns < end * 1e9:
                arrival_ns = self._start_ns + round(end * 1e9)
        return arrival_ns

    def _draw_loss(self, at_ns: int) -> bool:
        link = self._link
        step, draw = self._loss.random(2)
        since_ns = at_ns - self._start_ns
        return bool(draw < self._compute_loss_probability(since_ns, step)) or is_within(link.blackout, since_ns)

    def _compute_loss_probability(self, since_ns: int, step: float) -> float:
        """Return the probability that the next packet is lost; the channel's own state moves on by the draw `step`."""
        link = self._link
        if link.model == "gilbert-elliott":
            self._is_bad = bool(step >= link.burst_leave if self._is_bad else step < link.burst_enter)
            return link.burst_loss if self._is_bad else link.loss
        if link.model == "empirical":
            if self._remaining_losses == _NO_RUN:
                self._remaining_losses = int(
                    np.searchsorted(self._run_probabilities, step * self._run_probabilities[-1], side="right")
                )
            self._remaining_losses -= 1
            return 0.0 if self._remaining_losses == _NO_RUN else 1.0
        if link.model == "scheduled":
            turns = math.floor(since_ns * 1e-9 / link.wait_s)
            count, self._turns = turns - self._turns, turns
            return link.loss**count
        if link.model == "trace":
            return 0.0
        if link.probability:
            number = -(-since_ns // self._step_ns)  # step k ends at k Δt, that instant included
            return 1.0 - link.probability[min(max(number, 0), len(link.probability) - 1)]
        return link.loss

    def _flip_bit(self, data: bytes) -> tuple[bytes, bool]:
        draw, position = self._corrupt.random(2)
        if draw >= self._link.corrupt or not data:
            return data, False
        bit = int(position * 8 * len(data))
        flipped = bytearray(data)
        flipped[bit // 8] ^= 1 << bit % 8
        return bytes(flipped), True

    def _truncate_data(self, data: bytes) -> tuple[bytes, bool]:
        draw, position = self._truncate.random(2)
        if draw >= self._link.truncate or not data:
            return data, False
        return data[: int(position * len(data))], True
