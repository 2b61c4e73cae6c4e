"""A lossy packet channel in virtual time, seeded.

Each effect draws from its own generator, the same number of values for every packet whether the
effect is on or off. So two runs with one seed differ only by the effects that differ.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass

import numpy as np

from uavctl.config.link import LinkConfig

_TO_DRAW = -1  # no run of losses is under way: the next packet begins one (of 0 or more)


@dataclass
class Counters:
    """What happened to the packets so far."""

    sent: int = 0
    lost: int = 0
    duplicated: int = 0
    corrupted: int = 0
    truncated: int = 0


class Channel:
    """One direction of a radio link.

    Loss is Bernoulli, Gilbert-Elliott (the chain starts in the good state and steps before each packet) or
    empirical (a run of losses is drawn after each arrival, and before the first packet), and total within a
    blackout. What gets through is delayed by `delay_s` plus a uniform draw up to `jitter_s`, so packets may
    overtake each other. A duplicate has its own delay. A bit flip and a cut act on a packet before it is doubled.

    Args:
        link: The section `[link]`.
        seed: Of all draws.
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
        self._link = link
        self._start_ns = start_ns
        self._step_ns = step_ns or 0
        children = [np.random.default_rng(child) for child in seed.spawn(5)]
        self._loss, self._delay, self._duplicate, self._corrupt, self._truncate = children
        self._bad = False
        self._runs = np.cumsum(link.gaps)
        self._to_lose = _TO_DRAW
        self._pending: list[tuple[int, int, bytes]] = []
        self._order = 0
        self.counters = Counters()

    def push(self, at_ns: int, data: bytes, *, certain: bool = False) -> None:
        """Send a packet at `at_ns`; a `certain` one is not lost."""
        link, counters = self._link, self.counters
        counters.sent += 1
        lost = self._loses(at_ns) and not certain
        delays = self._delay.random(2)
        doubled = self._duplicate.random() < link.duplicate
        data, corrupted = self._flip(data)
        data, truncated = self._cut(data)
        if lost:
            counters.lost += 1
            return
        counters.corrupted += corrupted
        counters.truncated += truncated
        counters.duplicated += doubled
        for draw in delays[: 1 + doubled]:
            self._order += 1
            arrival_ns = at_ns + round((link.delay_s + link.jitter_s * float(draw)) * 1e9)
            heapq.heappush(self._pending, (arrival_ns, self._order, data))

    def pop_due(self, to_ns: int) -> list[tuple[int, bytes]]:
        """Take what arrives up to and including `to_ns`, as (arrival_ns, data) in order of arrival."""
        due = []
        while self._pending and self._pending[0][0] <= to_ns:
            arrival_ns, _, data = heapq.heappop(self._pending)
            due.append((arrival_ns, data))
        return due

    @property
    def next_ns(self) -> int | None:
        """Time of the next arrival [ns], None if nothing is under way."""
        return self._pending[0][0] if self._pending else None

    def _loses(self, at_ns: int) -> bool:
        link = self._link
        step, draw = self._loss.random(2)
        since_ns = at_ns - self._start_ns
        dark = any(begin * 1e9 <= since_ns <= end * 1e9 for begin, end in link.blackout)
        return bool(draw < self._probability(since_ns, step)) or dark

    def _probability(self, since_ns: int, step: float) -> float:
        """Probability that the next packet is lost; the channel's own state moves on by the draw `step`."""
        link = self._link
        if link.model == "gilbert-elliott":
            self._bad = bool(step >= link.burst_leave if self._bad else step < link.burst_enter)
            return link.burst_loss if self._bad else link.loss
        if link.model == "empirical":
            if self._to_lose == _TO_DRAW:
                self._to_lose = int(np.searchsorted(self._runs, step * self._runs[-1], side="right"))
            self._to_lose -= 1
            return 0.0 if self._to_lose == _TO_DRAW else 1.0
        if link.probability:
            number = -(-since_ns // self._step_ns)  # step k ends at k Δt, that instant included
            return 1.0 - link.probability[min(max(number, 0), len(link.probability) - 1)]
        return link.loss

    def _flip(self, data: bytes) -> tuple[bytes, bool]:
        whether, where = self._corrupt.random(2)
        if whether >= self._link.corrupt or not data:
            return data, False
        bit = int(where * 8 * len(data))
        flipped = bytearray(data)
        flipped[bit // 8] ^= 1 << bit % 8
        return bytes(flipped), True

    def _cut(self, data: bytes) -> tuple[bytes, bool]:
        whether, where = self._truncate.random(2)
        if whether >= self._link.truncate or not data:
            return data, False
        return data[: int(where * len(data))], True
