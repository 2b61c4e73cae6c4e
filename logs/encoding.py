"""Records as exact JSON.

Floats keep every bit: shortest digits that round-trip, the sign of zero included. JSON has no NaN
and no infinity (msgspec would write null, which reads back as "missing"), so these are the strings
"NaN", "Infinity" and "-Infinity", read back as floats wherever the record's type has a float. Where
it has any value at all (`Header.design`) they stay strings.
"""

from __future__ import annotations

import math
import types
import typing
from functools import cache

import msgspec
import numpy as np

from logs.topics import raw_link, record_type
from uavctl.data import Datagram, Record
from uavctl.errors import RecordingError

_NON_FINITE = {"NaN": math.nan, "Infinity": math.inf, "-Infinity": -math.inf}


class EncodingError(RecordingError):
    """A value cannot be written so that it reads back the same."""


def _plain(value: object) -> object:
    """Plain numbers of a numpy value that slipped into a record."""
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    raise NotImplementedError


_ENCODER = msgspec.json.Encoder(enc_hook=_plain)


def encode(record: Record) -> bytes:
    """Bytes of a record: a datagram's own, JSON of any other.

    Raises:
        EncodingError: the record holds something that JSON cannot give back.
    """
    if isinstance(record, Datagram):
        return record.data
    try:
        data = _ENCODER.encode(record)
        # msgspec writes every non-finite float as null: without one, all is said.
        if b"null" not in data or not _has_non_finite(record):
            return data
        return _ENCODER.encode(_spell(msgspec.to_builtins(record, enc_hook=_plain)))
    except (TypeError, ValueError, NotImplementedError, OverflowError, RecursionError) as error:
        raise EncodingError(f"{type(record).__name__}: {error}") from error


def decode(topic: str, data: bytes, at_ns: int) -> Record:
    """Record of a message.

    Args:
        topic: the message's topic.
        data: the message.
        at_ns: its log time, which is a datagram's time [ns].

    Raises:
        RecordingError: no such topic, or the bytes are no record of its type.
    """
    raw = raw_link(topic)
    if raw is not None:
        return Datagram(at_ns=at_ns, link=raw[0], outgoing=raw[1], data=data)
    try:
        kind = record_type(topic)
        if b'NaN"' not in data and b'Infinity"' not in data:
            return _decoder(kind).decode(data)
        return msgspec.convert(_restore(msgspec.json.decode(data), kind), kind)
    except KeyError as error:
        raise RecordingError(f"topic {topic} is not known to this version") from error
    except msgspec.MsgspecError as error:
        raise RecordingError(f"topic {topic}, log time {at_ns} ns: {error}") from error


@cache
def _decoder(kind: type[Record]) -> msgspec.json.Decoder[Record]:
    return msgspec.json.Decoder(kind)


def _has_non_finite(value: object) -> bool:
    if isinstance(value, float | np.floating):
        return not math.isfinite(value)
    if isinstance(value, msgspec.Struct):
        return any(_has_non_finite(getattr(value, name)) for name in value.__struct_fields__)
    if isinstance(value, dict):
        return any(map(_has_non_finite, value.values()))
    if isinstance(value, np.ndarray):
        return value.dtype.kind == "f" and not bool(np.isfinite(value).all())
    return isinstance(value, tuple | list) and any(map(_has_non_finite, value))


def _spell(value: object) -> object:
    """The same tree with non-finite floats spelled out."""
    if isinstance(value, float) and not math.isfinite(value):
        return "NaN" if math.isnan(value) else "Infinity" if value > 0 else "-Infinity"
    if isinstance(value, dict):
        return {key: _spell(one) for key, one in value.items()}
    if isinstance(value, tuple | list):
        return [_spell(one) for one in value]
    return value


def _restore(value: object, kind: object) -> object:
    """The tree with spelled floats put back, where the type has a float (text stays text)."""
    if isinstance(value, str):
        return _NON_FINITE.get(value, value) if float in _alternatives(kind) else value
    if isinstance(value, list):
        return [_restore(one, item) for one, item in zip(value, _item_types(kind, len(value)), strict=True)]
    if isinstance(value, dict):
        return {key: _restore(one, _field_type(kind, key)) for key, one in value.items()}
    return value


@cache
def _alternatives(kind: object) -> tuple[object, ...]:
    """Members of a union; the type itself if it is none."""
    if isinstance(kind, types.UnionType) or typing.get_origin(kind) is typing.Union:
        return typing.get_args(kind)
    return (kind,)


def _item_types(kind: object, count: int) -> tuple[object, ...]:
    for one in _alternatives(kind):
        if typing.get_origin(one) is tuple:
            args = typing.get_args(one)
            items = args[:1] * count if args[-1] is Ellipsis else args
            # a wrong length is told by the conversion that follows
            return items if len(items) == count else (object,) * count
    return (object,) * count


def _field_type(kind: object, key: str) -> object:
    for one in _alternatives(kind):
        if typing.get_origin(one) is dict:
            return typing.get_args(one)[1]
        if isinstance(one, type) and issubclass(one, msgspec.Struct):
            return _fields(one).get(key, object)
    return object


@cache
def _fields(kind: type[msgspec.Struct]) -> dict[str, object]:
    return {field.encode_name: field.type for field in msgspec.structs.fields(kind)}
