"""Flights beside each other: what differs in how they were made, and their figures."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import zip_longest
from pathlib import Path

import msgspec
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from logs.chunks import Message
from logs.compare_figures import Figure, figures
from logs.compare_side import Loaded, Side
from logs.difference import leaves
from logs.encoding import decode
from logs.reader import good_messages
from logs.topics import HEADER, LIBRARY, RECORDER, raw_link
from uavctl.data import Header
from uavctl.errors import RecordingError
from uavctl.mavlink.framing import scan

# How a recording was made, and what a computer's clock said: not what was flown.
_NOT_FLOWN = frozenset({HEADER, LIBRARY, RECORDER, "/uavctl/timing"})
_LONGEST = 72  # characters of a value


class Parting(msgspec.Struct, frozen=True, kw_only=True):
    """The first record in which two flights differ."""

    topic: str
    flight_s: float  # since the first tick of the first recording
    field: str  # path in the record; empty if there is none on one side, or at another time
    first: str  # what the first recording has there
    other: str


class Likeness(msgspec.Struct, frozen=True, kw_only=True):
    """How far a flight is the same as that of the first recording, bit for bit; computing times do not count."""

    name: str
    identical: bool
    records: int  # alike, from the beginning
    parting: Parting | None  # None if all are alike


class Difference(msgspec.Struct, frozen=True, kw_only=True):
    """A parameter in which the recordings differ; null where one has none."""

    key: str  # dotted name in the configuration, or design_id, library_id, cpu, versions.<package>
    values: tuple[object, ...]  # one each recording


class Comparison(msgspec.Struct, frozen=True, kw_only=True):
    """Flights beside each other; the first is what the others are compared with."""

    recordings: tuple[Side, ...]
    likenesses: tuple[Likeness, ...]
    parameters: tuple[Difference, ...]
    figures: tuple[Figure, ...]
    notes: tuple[str, ...]  # what to mind when reading the figures


def compare(loaded: Sequence[Loaded]) -> Comparison:
    """Compare flights with the first of them.

    Raises:
        RecordingError: A header's configuration cannot be read.
    """
    return Comparison(
        recordings=tuple(one.side for one in loaded),
        likenesses=tuple(_likeness(loaded[0], other) for other in loaded[1:]),
        parameters=tuple(_differences([_parameters(one) for one in loaded])),
        figures=tuple(figures(loaded)),
        notes=tuple(_notes(loaded)),
    )


def _likeness(first: Loaded, other: Loaded) -> Likeness:
    alike = 0
    mine, theirs = (_flown(Path(one.side.recording)) for one in (first, other))
    for left, right in zip_longest(mine, theirs):
        if left is None or right is None or _word(left) != _word(right):
            parting = _parting(left, right, first.flight.origin_ns)
            return Likeness(name=other.side.name, identical=False, records=alike, parting=parting)
        alike += 1
    return Likeness(name=other.side.name, identical=True, records=alike, parting=None)


def _flown(path: Path) -> Iterator[Message]:
    return (message for message in good_messages(path) if message.definition.topic not in _NOT_FLOWN)


def _word(message: Message) -> tuple[str, bytes, int]:
    """What a message says: topic, bytes and time."""
    return message.definition.topic, message.data, message.at_ns


def _parting(left: Message | None, right: Message | None, origin_ns: int) -> Parting:
    """Where two recordings part; at most one of the messages is None."""
    there = left or right
    assert there is not None
    topic, at_ns = there.definition.topic, there.at_ns
    field = ""
    if left is None or right is None:
        said = tuple("its end" if one is None else "a record" for one in (left, right))
    elif (left.definition.topic, left.at_ns) != (right.definition.topic, right.at_ns):
        said = tuple(f"{one.definition.topic} at {(one.at_ns - origin_ns) * 1e-9:.3f} s" for one in (left, right))
    elif raw_link(topic) is not None:
        said = (_frame(left.data), _frame(right.data))
    else:
        field, mine, theirs = leaves(decode(*_word(left)), decode(*_word(right)))[0]
        said = (repr(mine), repr(theirs))
    return Parting(
        topic=topic, flight_s=(at_ns - origin_ns) * 1e-9, field=field, first=_short(said[0]), other=_short(said[1])
    )


def _frame(data: bytes) -> str:
    """Raw bytes by the name of their MAVLink message."""
    frames = scan(data, final=True).frames
    name = mavlink.mavlink_map[frames[0].message_id].msgname if frames else "no whole packet"
    return f"{name}, {len(data)} bytes"


def _short(text: str) -> str:
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 1]}…"


def _parameters(one: Loaded) -> dict[str, object]:
    """What decides a flight beside what happened in it: configuration, design, versions, processor."""
    header: Header = one.flight.header
    try:
        config = tomllib.loads(header.config_toml)
    except tomllib.TOMLDecodeError as error:
        raise RecordingError(f"{one.side.recording}: the configuration in its header is damaged ({error})") from error
    return {
        **dict(_dotted(config, "")),
        "design_id": header.design_id,
        "library_id": header.library_id,
        "cpu": header.cpu,
        **{f"versions.{name}": version for name, version in sorted(header.versions.items())},
    }


def _dotted(value: object, path: str) -> Iterator[tuple[str, object]]:
    """Keys of a configuration by their dotted names; tables of a list are numbered."""
    if isinstance(value, Mapping):
        for key, one in value.items():
            yield from _dotted(one, f"{path}.{key}" if path else key)
    elif isinstance(value, list) and value and isinstance(value[0], Mapping):
        for place, one in enumerate(value):
            yield from _dotted(one, f"{path}[{place}]")
    else:
        # JSON has no infinity, which limits may be.
        yield path, str(value) if isinstance(value, float) and not math.isfinite(value) else value


def _differences(parameters: Sequence[Mapping[str, object]]) -> Iterator[Difference]:
    for key in dict.fromkeys(key for one in parameters for key in one):
        values = tuple(one.get(key) for one in parameters)
        if any(value != values[0] for value in values[1:]):
            yield Difference(key=key, values=values)


def _notes(loaded: Sequence[Loaded]) -> Iterator[str]:
    for one in loaded:
        if not one.side.finished:
            yield f"{one.side.name} is torn: compared up to its end"
        if one.side.records_lost:
            yield f"{one.side.name} lacks {one.side.records_lost} records: what they held is in no figure"
    if _differ(loaded, lambda one: one.summary.steps):
        yield "the flights are of different length: counts and the cost add up over the steps flown"
    if _differ(loaded, lambda one: (one.flight.design.q_x, one.flight.design.q_u, one.flight.design.dt_s)):
        yield "the costs are not of one kind: weights or the length of a step differ"
    if _differ(loaded, lambda one: one.summary.state_source):
        sources = ", ".join(f"{one.side.name} by the {one.summary.state_source}" for one in loaded)
        yield f"states are judged by different sources: {sources}"
    if _differ(loaded, lambda one: one.flight.virtual_time):
        yield "some were flown in virtual time, where no tick is late"
    if _differ(loaded, lambda one: one.flight.header.cpu):
        yield "times were measured on different processors"


def _differ(loaded: Sequence[Loaded], of: Callable[[Loaded], object]) -> bool:
    return any(of(one) != of(loaded[0]) for one in loaded[1:])
