"""Inbox of the control loop: messages and orders that wait for the next tick. Pure; time is an argument.

A tick takes positions and inertial data that arrived by its time; later ones wait. It takes all other messages of the
vehicle, even if they came after the time of a late tick: they may report that the pilot flies.
"""

from __future__ import annotations

from collections import Counter, deque
from typing import NamedTuple

from uavctl.mavlink.messages import CommandAck, StatusText
from uavctl.records import CellMessage, Command, InertialSample, PositionSample, VehicleMotion, VehicleStatus

MAX_ORDERS = 16  # that wait for a tick
MAX_INERTIAL = 20  # newest of one tick: their mean is what counts
MAX_SAMPLES = 20  # of one tick, the newest of each source in turn: each costs the estimator its time

ReceivedItem = PositionSample | VehicleStatus | VehicleMotion | InertialSample | CommandAck | StatusText


class TickMessages(NamedTuple):
    """Messages and orders that a tick takes, each kind in the order in which it came."""

    samples: tuple[PositionSample, ...]
    inertial: tuple[InertialSample, ...]
    statuses: tuple[VehicleStatus, ...]
    motion: VehicleMotion | None  # the newest one; None if none came
    messages: tuple[CommandAck | StatusText, ...]
    orders: tuple[Command, ...]
    cell: CellMessage | None  # the newest moving cell; None if none came


class Inbox:
    """Messages and orders that wait for the next tick."""

    def __init__(self) -> None:
        self._items: deque[tuple[int, ReceivedItem]] = deque()
        self._orders: deque[Command] = deque()
        self._cell: CellMessage | None = None

    def add(self, item: ReceivedItem, at_ns: int) -> None:
        """Add a message that arrived at `at_ns`."""
        self._items.append((at_ns, item))

    def add_order(self, command: Command) -> bool:
        """Add an order of the operator; return False if too many wait already."""
        if len(self._orders) >= MAX_ORDERS:
            return False
        self._orders.append(command)
        return True

    def put_cell(self, cell: CellMessage) -> None:
        """Put a moving cell for the next tick; it replaces one with a smaller number."""
        if self._cell is None or (cell.exits, cell.number) > (self._cell.exits, self._cell.number):
            self._cell = cell

    def take(self, at_ns: int) -> TickMessages:
        """Take the inputs that are due in the tick of `at_ns`."""
        samples: list[PositionSample] = []
        inertial: list[InertialSample] = []
        statuses: list[VehicleStatus] = []
        motion: VehicleMotion | None = None
        messages: list[CommandAck | StatusText] = []
        later_items: deque[tuple[int, ReceivedItem]] = deque()
        for received_ns, item in self._items:
            match item:
                case VehicleStatus():
                    statuses.append(item)
                case VehicleMotion():
                    motion = item
                case PositionSample() | InertialSample() if received_ns > at_ns:
                    later_items.append((received_ns, item))
                case PositionSample():
                    samples.append(item)
                case InertialSample():
                    inertial.append(item)
                case _:
                    messages.append(item)
        orders, cell = tuple(self._orders), self._cell
        self._cell = None
        self._items = later_items
        self._orders.clear()
        newest_inertial = tuple(inertial[-MAX_INERTIAL:])
        return TickMessages(
            _select_newest(samples), newest_inertial, tuple(statuses), motion, tuple(messages), orders, cell
        )


def _select_newest(samples: list[PositionSample]) -> tuple[PositionSample, ...]:
    """Return at most `MAX_SAMPLES` samples, in order; a source that sends many displaces none of another source."""
    if len(samples) <= MAX_SAMPLES:
        return tuple(samples)
    newer_counts: Counter[str] = Counter()  # newer samples of the same source
    ranks = [0] * len(samples)
    for index in range(len(samples) - 1, -1, -1):
        ranks[index] = newer_counts[samples[index].source]
        newer_counts[samples[index].source] += 1
    newest_indices = sorted(range(len(samples)), key=lambda index: (ranks[index], -index))[:MAX_SAMPLES]
    return tuple(samples[index] for index in sorted(newest_indices))
