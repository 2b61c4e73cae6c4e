"""Replay: a recording's inputs through the same control loop, everything that it says compared.

The raw bytes go through parser, clock offset and frames again; the ticks through the same
`step()`. Each record that comes out (step inputs, estimates, plans, decisions, setpoints, bytes
to send) must be the recorded one, bit for bit.
"""

from __future__ import annotations

import math
from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import msgspec

from logs.reader import records
from uavctl.data import Datagram, PolicyLibrary, Record, Sink, StepInput
from uavctl.errors import RecordingError
from uavctl.loop import ControlLoop

COMPARED = frozenset(
    {
        "/uavctl/step_input",
        "/uavctl/estimate",
        "/uavctl/plan",
        "/uavctl/decision",
        "/uavctl/setpoint",
        "/uavctl/vehicle",
        "/uavctl/event",
    }
)
Key = tuple[str, int]


class Difference(msgspec.Struct, frozen=True, kw_only=True):
    """The first place where recording and replay part."""

    topic: str
    at_ns: int
    field: str
    recorded: str
    replayed: str


class ReplayResult(msgspec.Struct, frozen=True, kw_only=True):
    """What a replay found."""

    decisions: int
    compared: int
    identical: bool
    first_difference: Difference | None


def recorded_library(path: Path) -> PolicyLibrary:
    """The policy library that a recording was flown with.

    Raises:
        RecordingError: it cannot be read, or carries none.
    """
    for record in records(path, PolicyLibrary):
        return record
    raise RecordingError(
        f"{path}: flown with a policy library, but carries none, so it cannot be decided alike; "
        "was it cut, or the chunk lost? `uavctl log info` tells"
    )


class _Produced:
    """Sink that keeps what the replayed loop says until the recording's word is read."""

    def __init__(self) -> None:
        self.waiting: dict[Key, deque[Record]] = defaultdict(deque)

    def put(self, topic: str, at_ns: int, record: Record) -> None:
        if _is_compared(topic):
            self.waiting[topic, at_ns].append(record)

    def take(self, topic: str, at_ns: int) -> Record | None:
        """The next record said under this topic and time."""
        queue = self.waiting.get((topic, at_ns))
        found = queue.popleft() if queue else None
        if queue is not None and not queue:
            del self.waiting[topic, at_ns]
        return found

    def unsaid(self) -> Difference | None:
        """What the loop has said and the recording has not."""
        for topic, at_ns in self.waiting:
            return Difference(topic=topic, at_ns=at_ns, field="", recorded="nothing", replayed="a record")
        return None


def replay(
    messages: Iterable[tuple[str, int, Record]],
    make_loop: Callable[[Sink], ControlLoop],
    tolerance: float = 0.0,
    *,
    finished: bool = True,
) -> ReplayResult:
    """Drive a loop with the recorded inputs and compare all that it says, and that it says no more.

    Args:
        messages: (topic, log time [ns], record) in the order of recording.
        make_loop: builds the loop from the recording's configuration, around the given sink.
        tolerance: largest difference of two numbers that counts as none, relative to the larger
            of 1 and their size; 0 compares bit for bit. For a recording of another CPU type.
        finished: the recording was closed in order; a torn one's last tick may lack records.
    """
    produced = _Produced()
    loop = make_loop(produced)
    decisions = compared = 0
    first: Difference | None = None
    for topic, at_ns, record in messages:
        if isinstance(record, StepInput):
            # What the last tick said must have been read by now. Only a torn file's last tick may lack some.
            first = first or produced.unsaid()
            deque(loop.tick(record.tick, record.at_ns, record.missed_ticks, record.stop), maxlen=0)
        elif isinstance(record, Datagram) and not record.outgoing:
            loop.receive(record.link, record.data, record.at_ns)
        if _is_compared(topic):
            compared += 1
            decisions += topic == "/uavctl/decision"
            first = first or _difference(topic, at_ns, record, produced.take(topic, at_ns), tolerance)
    if finished:
        first = first or produced.unsaid()
    identical = first is None and decisions > 0
    return ReplayResult(decisions=decisions, compared=compared, identical=identical, first_difference=first)


def _is_compared(topic: str) -> bool:
    return topic in COMPARED or (topic.startswith("/raw/") and topic.endswith("/out"))


def _difference(
    topic: str, at_ns: int, recorded: Record, replayed: Record | None, tolerance: float
) -> Difference | None:
    if replayed is None:
        return Difference(topic=topic, at_ns=at_ns, field="", recorded="a record", replayed="nothing")
    for field, left, right in _unequal(msgspec.to_builtins(recorded), msgspec.to_builtins(replayed), ""):
        if not _close(left, right, tolerance):
            return Difference(topic=topic, at_ns=at_ns, field=field, recorded=repr(left), replayed=repr(right))
    return None


def _unequal(left: object, right: object, path: str) -> Iterator[tuple[str, object, object]]:
    """Leaves where two trees of plain values differ in any bit."""
    if isinstance(left, dict) and isinstance(right, dict):
        for key in dict.fromkeys([*left, *right]):
            yield from _unequal(left.get(key), right.get(key), f"{path}.{key}" if path else str(key))
    elif isinstance(left, list | tuple) and isinstance(right, list | tuple) and len(left) == len(right):
        for index, (one, other) in enumerate(zip(left, right, strict=True)):
            yield from _unequal(one, other, f"{path}[{index}]")
    elif not _same_bits(left, right):
        yield path, left, right


def _same_bits(left: object, right: object) -> bool:
    if isinstance(left, float) and isinstance(right, float):
        return left.hex() == right.hex()
    return type(left) is type(right) and left == right


def _close(left: object, right: object, tolerance: float) -> bool:
    if not isinstance(left, int | float) or not isinstance(right, int | float) or tolerance == 0.0:
        return False
    return math.isclose(left, right, rel_tol=tolerance, abs_tol=tolerance)
