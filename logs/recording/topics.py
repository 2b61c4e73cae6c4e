"""Topics of a recording, one row each.

Raw MAVLink bytes have one topic a connection and direction; everything else is one record type, written as JSON with
its JSON Schema. Beside these stand the topics made for viewers, as protobuf (`logs.recording.derived_topics`);
nothing is decided, replayed or reported from them.
"""

from __future__ import annotations

import math
import re
import types
import typing
import zlib
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache
from typing import cast

import msgspec
import numpy as np

from logs.recording.derived_topics import VIEWS
from logs.recording.earlier import complete_record
from logs.recording.notes import RecorderNote
from uavctl.arrays import Array
from uavctl.errors import RecordingError
from uavctl.fleet_records import (
    CoordinatorCycle,
    CoordinatorHeader,
    IssuedCell,
    OfferedPosition,
    ReportedPosition,
    ScheduleWeights,
    SenderHeader,
    SentPosition,
    TakenReport,
)
from uavctl.records import (
    CellDecision,
    Checked,
    ClosestApproach,
    Collision,
    Datagram,
    Decision,
    Ending,
    Estimate,
    Event,
    FleetTruth,
    Header,
    InternalError,
    LinkEstimate,
    LinkStats,
    Matrix,
    Plan,
    PolicyLibrary,
    Record,
    Refused,
    RelayStats,
    Setpoint,
    StepInput,
    Timing,
    ToldParameter,
    Truth,
    VehicleStatus,
    raw_topic,
)

HEADER = "/uavctl/header"
LIBRARY = "/uavctl/library"
PARAMETER = "/uavctl/parameter"
ENDED = "/uavctl/end"
RECORDER = "/uavctl/recorder"
SENDER_HEADER, COORDINATOR_HEADER = "/uavctl/sender_header", "/uavctl/coordinator_header"
OFFERED, REPORTED = "/uavctl/sender_position", "/uavctl/sender_report"
WEIGHTS, SENT = "/uavctl/sender_weights", "/uavctl/sender"
TAKEN, ISSUED, CYCLE = "/uavctl/coordinator_report", "/uavctl/coordinator_cell", "/uavctl/coordinator"


@dataclass(frozen=True)
class Definition:
    """Encoding of a topic's messages, and their schema unless the bytes need none."""

    topic: str
    encoding: str
    schema_name: str = ""
    schema_encoding: str = ""
    schema: bytes = b""

    @cached_property
    def for_viewers(self) -> bool:
        """Whether the topic was made for viewers: it holds nothing that the records do not."""
        return is_view(self.topic)


@dataclass(frozen=True)
class Topic:
    """A topic of JSON records of one type."""

    name: str
    record: type[Record]
    text: str

    @cached_property
    def definition(self) -> Definition:
        """Return encoding and JSON Schema; the schema's top level is the object itself, as viewers want it."""
        return Definition(
            topic=self.name,
            encoding="json",
            schema_name=f"uavctl.{self.record.__name__}",
            schema_encoding="jsonschema",
            schema=msgspec.json.encode(_make_schema(self.record)),
        )


TOPICS: tuple[Topic, ...] = (
    Topic(HEADER, Header, "configuration, design, seed, versions; first message of every segment"),
    Topic(LIBRARY, PolicyLibrary, "policy library, as base64; up to version 0.2"),
    Topic("/uavctl/step_input", StepInput, "all inputs of a tick; replay starts from here"),
    Topic("/uavctl/estimate", Estimate, "state estimate at `at_ns`; `captured_ns`: capture of its newest sample"),
    Topic("/uavctl/plan", Plan, "a new plan, one row a step Δt from `base_ns` on"),
    Topic("/uavctl/cell", CellDecision, "decision about a moving cell, or the exit from one"),
    Topic("/uavctl/decision", Decision, "decision of a tick, and its reason"),
    Topic("/uavctl/setpoint", Setpoint, "acceleration setpoint after the setpoint limiter"),
    Topic("/uavctl/vehicle", VehicleStatus, "mode and state that the vehicle reports"),
    Topic("/uavctl/event", Event, "event; `count` of one kind, once a second"),
    Topic("/uavctl/timing", Timing, "lateness and run time of a tick; a replay does not compare it"),
    Topic("/uavctl/check", Checked, "check before arming, one record an item"),
    Topic(PARAMETER, ToldParameter, "parameter of the vehicle, sent before arming, one record each"),
    Topic("/uavctl/failure", InternalError, "an error outside the control loop, and its effect on the flight"),
    Topic("/uavctl/refused", Refused, "datagrams dropped unread (address, rate, signature), once a second"),
    Topic("/uavctl/link", LinkStats, "counters of a connection since the start, once a second"),
    Topic("/uavctl/relay", RelayStats, "positions passed on to the vehicle, once a second"),
    Topic("/uavctl/link_estimate", LinkEstimate, "estimate of the link of the positions, at a Δt boundary"),
    Topic(ENDED, Ending, "end of the flight"),
    Topic("/sim/truth", Truth, "true state, in simulated flights"),
    Topic("/sim/fleet", FleetTruth, "true state of all vehicles in one world, in `world.mcap`"),
    Topic("/sim/collision", Collision, "collision of two simulated vehicles"),
    Topic("/sim/closest", ClosestApproach, "closest approach of each pair, at the end"),
    Topic(SENDER_HEADER, SenderHeader, "constants of the sender; first message of `sender.mcap`"),
    Topic(OFFERED, OfferedPosition, "position that came to the sender; replay starts from here"),
    Topic(REPORTED, ReportedPosition, "report that came to the sender; an input of its replay, too"),
    Topic(WEIGHTS, ScheduleWeights, "weights of the vehicles, at each update"),
    Topic(SENT, SentPosition, "position that the sender sent"),
    Topic(COORDINATOR_HEADER, CoordinatorHeader, "constants of the coordinator; first message of `coordinator.mcap`"),
    Topic(TAKEN, TakenReport, "report to the coordinator; replay starts from here"),
    Topic(ISSUED, IssuedCell, "cell of the coordinator"),
    Topic(CYCLE, CoordinatorCycle, "cycle of the coordinator, after its reports and cells"),
    Topic(RECORDER, RecorderNote, "state of the recorder: segments, drops, failed writes"),
)
_BY_NAME = {topic.name: topic for topic in TOPICS}
_VIEW_BY_NAME = {view.name: view for view in VIEWS}
_RAW = re.compile(r"/raw/([^/]+)/(in|out)")


@lru_cache(maxsize=256)
def parse_raw_topic(topic: str) -> tuple[str, bool] | None:
    """Return connection name and whether outgoing, of a raw topic; None for any other topic."""
    match = _RAW.fullmatch(topic)
    return None if match is None else (match[1], match[2] == "out")


def is_view(topic: str) -> bool:
    """Return whether a topic was made for viewers: it holds nothing that the records do not."""
    return topic in _VIEW_BY_NAME


def is_known(topic: str) -> bool:
    """Whether this version has records of a topic."""
    return topic in _BY_NAME or parse_raw_topic(topic) is not None


@lru_cache(maxsize=256)
def get_record_type(topic: str) -> type[Record]:
    """Return the record type of a topic.

    Raises:
        KeyError: there is no such topic.
    """
    return Datagram if parse_raw_topic(topic) is not None else _BY_NAME[topic].record


@lru_cache(maxsize=256)
def get_definition(topic: str) -> Definition:
    """Return encoding and schema of a topic.

    Raises:
        KeyError: there is no such topic.
    """
    if parse_raw_topic(topic) is not None:
        return Definition(topic=topic, encoding="mavlink")
    if topic in _VIEW_BY_NAME:
        view = _VIEW_BY_NAME[topic]
        return Definition(topic, "protobuf", view.schema_name, "protobuf", view.schema)
    return _BY_NAME[topic].definition


def _make_schema(record: type[Record]) -> dict[str, object]:
    (reference,), parts = msgspec.json.schema_components(
        [record], schema_hook=_make_type_schema, ref_template="#/$defs/{name}"
    )
    name = cast("str", reference["$ref"]).rpartition("/")[2]
    top: dict[str, object] = parts.pop(name)
    return {**top, "$defs": parts} if parts else top


def _make_type_schema(kind: type) -> dict[str, object]:
    """Return the schema of a type that msgspec does not know: any value, or the rows of a matrix."""
    if kind is object:
        return {"description": "any JSON value"}
    if kind is np.ndarray:
        return msgspec.json.schema(Matrix)
    raise NotImplementedError(kind)


_MAX_TIME_NS = 2**64 - 1
MATRICES = ("inputs", "states", "backoff_x", "backoff_u")  # of a plan, rounded in recordings
DIGITS = 4  # of them: of 3 m, a millimetre
_MIN_ROUNDED = 1e-12  # a smaller number is left as it is: its power of ten would not be exact
_POWERS = 10.0 ** np.arange(309.0)  # of ten
_NON_FINITE = {"NaN": math.nan, "Infinity": math.inf, "-Infinity": -math.inf}


class EncodingError(RecordingError):
    """A value cannot be written so that it reads back the same."""


def convert_numpy(value: object) -> object:
    """Turn numpy values of a record into plain numbers."""
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    raise NotImplementedError


_ENCODER = msgspec.json.Encoder(enc_hook=convert_numpy)
# MessagePack keeps the eight bytes of each float behind 0xcb: where the exponent has all bits set, it is not finite.
# Other values may have such bytes too, which costs time only.
_BINARY = msgspec.msgpack.Encoder(enc_hook=convert_numpy)
_NON_FINITE_BYTES = re.compile(rb"\xcb[\x7f\xff][\xf0-\xff]", re.DOTALL)


def encode(record: Record) -> bytes:
    """Encode a record: a datagram as its own bytes, any other as JSON.

    Raises:
        EncodingError: the record holds something that JSON cannot give back.
    """
    if isinstance(record, Datagram):
        return record.data
    try:
        if isinstance(record, Plan):
            record = _spell_float_fields(round_plan(record))
        data = _ENCODER.encode(record)
        # msgspec writes every non-finite float as null: without one, all is said.
        if b"null" not in data or not _may_be_non_finite(record):
            return data
        return _ENCODER.encode({field: _spell_field(getattr(record, field)) for field in record.__struct_fields__})
    except (TypeError, ValueError, NotImplementedError, OverflowError, RecursionError) as error:
        raise EncodingError(f"{type(record).__name__}: {error}") from error


def round_plan(plan: Plan) -> Plan:
    """Round a plan's matrices as they are recorded, and note the checksum of all their bits; a condensed one stays.

    An exact plan is two thirds of a recording: 1,461 numbers in each step. What flies of it is in the decisions, bit
    for bit. So four digits are enough for people, and the checksum for a replay.
    """
    if plan.exact_crc32 is not None:
        return plan
    matrices: list[Array] = [getattr(plan, name) for name in MATRICES]
    values = np.concatenate([matrix.ravel() for matrix in matrices])
    rounded, end = _round(values), 0
    parts: dict[str, Array] = {}
    for name, matrix in zip(MATRICES, matrices, strict=True):
        begin, end = end, end + matrix.size
        parts[name] = rounded[begin:end].reshape(matrix.shape)
    return msgspec.structs.replace(plan, exact_crc32=zlib.crc32(values.tobytes()), **parts)


def _round(values: Array) -> Array:
    """Round to `DIGITS` significant digits; what is zero, too small, not finite or would be infinite stays."""
    size = np.abs(values)
    counts = (size > _MIN_ROUNDED) & (size < np.inf)
    # scale = 10^(digits − 1 − floor(log10 |x|)), rounded = rint(x · scale) / scale
    digits = (DIGITS - 1 - np.floor(np.log10(np.where(counts, size, 1.0)))).astype(np.intp)
    up, down = _POWERS.take(digits, mode="clip"), _POWERS.take(-digits, mode="clip")  # exact: no digit is added
    with np.errstate(over="ignore"):
        rounded = np.rint(values / down * up) / up * down
    return np.where(counts & np.isfinite(rounded), rounded, values)


def are_identical(record: Record, other: Record) -> bool:
    """Return whether two records of a type are surely the same in every bit; cheaper than to look for a difference."""
    binary = _get_exact_bytes(record)
    return binary is not None and binary == _get_exact_bytes(other)


def is_encoding_of(record: Record, message: bytes) -> bool:
    """Return whether a message is surely this record in every bit: its bytes are those that it would be recorded as."""
    try:
        return encode(record) == message
    except EncodingError:
        return False


def encode_message(topic: str, at_ns: int, record: Record, zero_utc_ns: int = 0) -> bytes:
    """Encode a record so that a reader gets the same back under this topic and time [ns].

    Args:
        zero_utc_ns: what is added to its time in the file [ns].

    Raises:
        RecordingError: it would not, and why.
    """
    try:
        expected = get_record_type(topic)
    except KeyError:
        raise RecordingError(f"there is no topic {topic}") from None
    if type(record) is not expected:
        raise RecordingError(f"topic {topic} takes {expected.__name__}, not {type(record).__name__}")
    if isinstance(record, Datagram) and topic != raw_topic(record.link, outgoing=record.outgoing):
        raise RecordingError(f"topic {topic} is not that of connection {record.link}")
    if at_ns < 0 or not 0 <= at_ns + zero_utc_ns <= _MAX_TIME_NS:
        raise RecordingError(f"topic {topic}: time {at_ns} ns does not fit a recording")
    return encode(record)


def decode(topic: str, data: bytes, at_ns: int) -> Record:
    """Decode the record of a message.

    Args:
        at_ns: log time of the message, which is a datagram's time [ns].

    Raises:
        RecordingError: no such topic, or the bytes are no record of its type.
    """
    raw = parse_raw_topic(topic)
    if raw is not None:
        return Datagram(at_ns=at_ns, link=raw[0], outgoing=raw[1], data=data)
    try:
        return complete_record(_decode_fields(data, get_record_type(topic)))
    except KeyError as error:
        raise RecordingError(f"topic {topic} is not known to this version") from error
    except (msgspec.MsgspecError, RecursionError) as error:
        raise RecordingError(f"topic {topic}, log time {at_ns} ns: {error}") from error


def _decode_fields(data: bytes, kind: type[Record]) -> Record:
    if b'NaN"' not in data and b'Infinity"' not in data:
        return _make_decoder(kind).decode(data)
    fields = msgspec.json.decode(data)
    # the gap of most plans is the only one: their thousands of numbers need not be looked through
    if isinstance(fields, dict) and _restore_fields(fields, kind) == data.count(b'NaN"') + data.count(b'Infinity"'):
        return msgspec.convert(fields, kind, dec_hook=_make_matrix)
    return msgspec.convert(_restore_tree(fields, kind), kind, dec_hook=_make_matrix)


@cache
def _make_decoder(kind: type[Record]) -> msgspec.json.Decoder[Record]:
    return msgspec.json.Decoder(kind, dec_hook=_make_matrix)


def _make_matrix(kind: type, value: object) -> object:
    """Make the matrix of a field of type `Array` from its rows, which must be of one length; keep any other value."""
    if kind != Array:
        return value
    matrix = np.array(msgspec.convert(value, Matrix), dtype=np.float64)
    return matrix if matrix.size else matrix.reshape(len(matrix), 0)


def _get_exact_bytes(value: object) -> bytes | None:
    """Return a value's bytes and those of its floats; None if an integer is too large for that."""
    try:
        return _BINARY.encode(value)
    except OverflowError:
        return None


def _spell_float_fields(plan: Plan) -> Plan:
    """Return a plan whose fields of type float are texts where they are not finite, as the gap of most plans is."""
    values = {name: getattr(plan, name) for name in _list_float_fields(Plan)}
    spelled = {
        name: _spell_tree(value) for name, value in values.items() if type(value) is float and not math.isfinite(value)
    }
    return msgspec.structs.replace(plan, **spelled) if spelled else plan


@cache
def _list_float_fields(kind: type[Record]) -> tuple[str, ...]:
    return tuple(field.name for field in msgspec.structs.fields(kind) if field.type is float)


def _may_be_non_finite(value: object) -> bool:
    binary = _get_exact_bytes(value)
    return binary is None or _NON_FINITE_BYTES.search(binary) is not None


def _spell_field(value: object) -> object:
    """Return a record's field with non-finite floats as text; the numbers of a plan without any are not searched."""
    if isinstance(value, tuple | np.ndarray) and not _may_be_non_finite(value):
        return value
    return _spell_tree(msgspec.to_builtins(value, enc_hook=convert_numpy))


def _spell_tree(value: object) -> object:
    """Return a tree with non-finite floats as text."""
    if isinstance(value, float) and not math.isfinite(value):
        return "NaN" if math.isnan(value) else "Infinity" if value > 0 else "-Infinity"
    if isinstance(value, dict):
        return {key: _spell_tree(element) for key, element in value.items()}
    if isinstance(value, tuple | list):
        return [_spell_tree(entry) for entry in value]
    return value


def _restore_fields(fields: dict[str, object], kind: type[Record]) -> int:
    """Turn spelled floats back where a field itself is a float; return how many."""
    number_texts = {name: value for name in _list_float_fields(kind) if isinstance(value := fields.get(name), str)}
    restored = {name: _NON_FINITE[text] for name, text in number_texts.items() if text in _NON_FINITE}
    fields.update(restored)
    return len(restored)


def _restore_tree(value: object, kind: object) -> object:
    """Return a tree with spelled floats turned back, where the type has a float; text stays text."""
    if isinstance(value, str):
        return _NON_FINITE.get(value, value) if float in _list_alternatives(kind) else value
    if isinstance(value, list):
        kind = Matrix if kind == Array else kind
        return [
            _restore_tree(entry, item) for entry, item in zip(value, _list_item_types(kind, len(value)), strict=True)
        ]
    if isinstance(value, dict):
        return {key: _restore_tree(element, _get_field_type(kind, key)) for key, element in value.items()}
    return value


@cache
def _list_alternatives(kind: object) -> tuple[object, ...]:
    """Return the members of a union; the type itself if it is none."""
    if isinstance(kind, types.UnionType) or typing.get_origin(kind) is typing.Union:
        return typing.get_args(kind)
    return (kind,)


def _list_item_types(kind: object, count: int) -> tuple[object, ...]:
    for alternative in _list_alternatives(kind):
        if typing.get_origin(alternative) is tuple:
            args = typing.get_args(alternative)
            items = args[:1] * count if args[-1] is Ellipsis else args
            # a wrong length is told by the conversion that follows
            return items if len(items) == count else (object,) * count
    return (object,) * count


def _get_field_type(kind: object, key: str) -> object:
    for alternative in _list_alternatives(kind):
        if typing.get_origin(alternative) is dict:
            return typing.get_args(alternative)[1]
        if isinstance(alternative, type) and issubclass(alternative, msgspec.Struct):
            return _list_fields(alternative).get(key, object)
    return object


@cache
def _list_fields(kind: type[msgspec.Struct]) -> dict[str, object]:
    return {field.encode_name: field.type for field in msgspec.structs.fields(kind)}
