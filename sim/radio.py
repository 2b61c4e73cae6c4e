"""One radio that carries the positions of several vehicles, in virtual time."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Sequence
from typing import Protocol

from sim.channel import Channel, find_earliest_ns


class SentMessage(Protocol):
    """A message that a sender puts on the radio."""

    @property
    def vehicle(self) -> int:
        """Number of its vehicle."""
        ...

    @property
    def frame(self) -> bytes:
        """Its bytes."""
        ...


class Sender(Protocol):
    """Interface of a sender of the positions of several vehicles over one channel with a budget."""

    def receive_positions(self, source: int, data: bytes, at_ns: int, /) -> object:
        """Take data of the cameras of a vehicle."""

    def receive_reports(self, number: int, data: bytes, at_ns: int, /) -> None:
        """Take data of what flies a vehicle: reports of its newest position."""

    def compute_remaining_ns(self, at_ns: int) -> int:
        """Return the time until the channel is free [ns]."""
        ...

    def send_next(self, at_ns: int) -> SentMessage | None:
        """Return the message that goes out now; None if the channel is occupied or there is nothing to send."""
        ...


class RadioUser(Protocol):
    """A vehicle as the radio sees it."""

    @property
    def next_position_ns(self) -> int | None:
        """Time at which the next position arrives [ns]; None if none is under way."""
        ...

    def send_position(self, at_ns: int, data: bytes) -> None:
        """Put a position on the way to what flies the vehicle."""


Deliver = Callable[[int, int], None]  # delivers the positions of a vehicle that arrive by a time: number, time [ns]


class SharedRadio:
    """Positions from the cameras of all vehicles to a sender, and what it sends to the vehicles, in order of time.

    A message reaches its vehicle over that vehicle's own link, with its losses and delays, and a report comes back over
    a second link of the same kind, beside the budget. The time of a message on the wire is a part of `link.delay_s`.

    Args:
        reports: Link of each vehicle's reports.
    """

    def __init__(self, sender: Sender, reports: Sequence[Channel]) -> None:
        self._sender, self._reports = sender, tuple(reports)
        self._positions: list[tuple[int, int, int, bytes]] = []  # arrival at the sender, order, vehicle, data
        self._order = 0
        self._free_ns: int | None = None  # when the channel is free again, while it is occupied

    def add_position(self, number: int, at_ns: int, data: bytes) -> None:
        """Take a position that reaches the sender at `at_ns`."""
        self._order += 1
        heapq.heappush(self._positions, (at_ns, self._order, number, data))

    def add_report(self, number: int, at_ns: int, data: bytes) -> None:
        """Take a report that leaves its vehicle at `at_ns`."""
        self._reports[number].push(at_ns, data)

    def run(self, to_ns: int, users: Sequence[RadioUser], deliver: Deliver) -> None:
        """Run all events up to and including `to_ns`."""
        while (at_ns := self._find_next_ns(users)) is not None and at_ns <= to_ns:
            for number, user in enumerate(users):
                if user.next_position_ns is not None and user.next_position_ns <= at_ns:
                    deliver(number, at_ns)
            self._feed_sender(at_ns)
            self._free_ns = None
            while (sent := self._sender.send_next(at_ns)) is not None:
                users[sent.vehicle].send_position(at_ns, sent.frame)
            remaining_ns = self._sender.compute_remaining_ns(at_ns)
            if remaining_ns > 0:
                self._free_ns = at_ns + remaining_ns

    def _find_next_ns(self, users: Sequence[RadioUser]) -> int | None:
        return find_earliest_ns(
            (
                self._free_ns,
                self._positions[0][0] if self._positions else None,
                *(channel.next_ns for channel in self._reports),
                *(user.next_position_ns for user in users),
            )
        )

    def _feed_sender(self, at_ns: int) -> None:
        """Pass on the positions and reports that have arrived."""
        while self._positions and self._positions[0][0] <= at_ns:
            arrival_ns, _, number, data = heapq.heappop(self._positions)
            self._sender.receive_positions(number, data, arrival_ns)
        for number, channel in enumerate(self._reports):
            for arrival_ns, data in channel.pop_due(at_ns):
                self._sender.receive_reports(number, data, arrival_ns)
