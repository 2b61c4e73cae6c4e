"""Replay: a recording's inputs go through the same control loop, and all its output is compared.

The raw bytes go through parser, clock offset and frames again; the ticks through the same
`step()`. Each record that comes out (step inputs, estimates, plans, decisions, setpoints, bytes
to send) must be the recorded one, bit for bit. Where one is not, the replay goes on, so that it can be
told what becomes of the difference: what is recorded stays the input.
"""

from __future__ import annotations

import math
import re
from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache

import msgspec

from logs.recording.notes import RecorderNote
from logs.recording.topics import (
    DIGITS,
    are_identical,
    convert_numpy,
    decode,
    get_record_type,
    is_encoding_of,
    parse_raw_topic,
    round_plan,
)
from uavctl.cause import Cause
from uavctl.constraint_names import name_constraints
from uavctl.loop import ControlLoop
from uavctl.records import (
    Command,
    Datagram,
    Decision,
    Ending,
    Event,
    InternalError,
    InternalErrorEffect,
    Plan,
    PositionSample,
    Record,
    Refused,
    Sink,
    StepInput,
    discard,
)
from uavctl.smpc.plant import AXES, Plant

DECISION = "/uavctl/decision"
PLAN = "/uavctl/plan"
STEP_INPUT = "/uavctl/step_input"
FAILURE = "/uavctl/failure"
NOTHING = "nothing"
Message = tuple[str, int, Record | bytes]  # topic, log time [ns], record or the bytes that it is recorded as
Leaf = tuple[str, object, object]  # path, recorded, replayed

# What the records of a tick say one after the other: those before the first one that differs are the same.
_STAGES = {
    "/uavctl/step_input": "the same bytes gave different inputs: parser, clock or frame",
    "/uavctl/vehicle": "the vehicle's messages are decoded differently",
    "/uavctl/estimate": "the inputs of the tick are the same: estimator, or weight of positions",
    "/uavctl/link_estimate": "the inputs of the tick are the same: estimate of the link",
    "/uavctl/plan": "the estimate is the same: design, target or solver",
    DECISION: "estimate and plan (if new) are the same: a rule of the decision, fallback or setpoint limiter",
    "/uavctl/setpoint": "the decision is the same: hand-over or setpoint limiter",
    "/uavctl/event": "nothing before it differs: report of an event",
    "/uavctl/link": "nothing before it differs: counters or clock of a connection",
}
_SENT = "the decision is the same: hand-over, relay or encoding"
_STATES = {
    ("/uavctl/estimate", "mean"),
    ("/uavctl/plan", "states"),
    ("/uavctl/plan", "reference"),
    (DECISION, "target"),
}
_INPUTS = {("/uavctl/estimate", "bias"), ("/uavctl/plan", "inputs"), ("/uavctl/plan", "bias"), (DECISION, "input")}
_UNITS = {"ns": "ns", "s": "s", "m": "m", "mps": "m/s", "mps2": "m/s²", "rad": "rad", "v": "V", "ppm": "ppm"}
_NUMBER = re.compile(r"\[(\d+)\]")
_STAGE = {"inputs": "stage", "states": "stage", "backoff_x": "stage", "backoff_u": "stage"}


class ReplayDifference(msgspec.Struct, frozen=True, kw_only=True):
    """First difference of recording and replay."""

    topic: str
    at_ns: int  # log time
    flight_s: float  # since the first tick
    tick: int | None  # the last one that had begun; None before the first
    field: str  # path in the record; empty if there is a record on one side only
    meaning: str  # of the field, in words; empty if its name says it all
    unit: str  # empty if it has none, or it is not known
    recorded: str
    replayed: str
    change: float | None  # replayed − recorded, of numbers
    fields: int  # that differ in this record
    stage: str  # what comes into question, in words


class Chosen(msgspec.Struct, frozen=True, kw_only=True):
    """Decision of a tick: mode, plan and input."""

    mode: str
    age_steps: int | None
    solve: str | None
    plan_seq: int | None
    plan_index: int | None
    reason: str


class Context(msgspec.Struct, frozen=True, kw_only=True):
    """Tick of the first difference: records before it, its inputs, its decisions."""

    decisions_before: int  # identical ones
    records_before: int  # of those compared, likewise
    positions: int  # that were new to the tick
    position_m: tuple[float, float, float] | None  # the newest of them, local NED
    position_age_s: float | None  # at the tick, since it was captured
    vehicle: str  # mode and arming; empty if nothing was known of one
    orders: tuple[str, ...]
    missed_ticks: int
    stop: bool
    recorded: Chosen | None  # None if the tick's decision is not there
    replayed: Chosen | None


class FieldDivergence(msgspec.Struct, frozen=True, kw_only=True):
    """Difference of one field from the first one on; entries of a vector are taken together."""

    topic: str
    field: str  # empty: there is a record on one side only
    entry: str  # of a vector: the one that differs most, in words
    unit: str  # of that
    differing: int  # records in which it differs
    records: int  # records of the field's topic, from the first difference on
    first_s: float  # of the flight
    largest: float | None  # difference; None of what is no number
    largest_s: float | None


class FieldNames:
    """Names and units of recorded fields, as far as they are known.

    Args:
        plant: plant of the controller, whose states and inputs have names.
    """

    def __init__(self, plant: Plant) -> None:
        self._states = name_constraints((), plant.n_x, plant.axes, plant.position_index, plant.velocity_index).states
        self._inputs = tuple(
            (f"{axis} input", "m/s²" if accel == 1.0 else "")
            for axis, accel in zip(plant.axes, plant.accel_per_input, strict=True)
        )

    def meaning(self, topic: str, path: str) -> tuple[str, str]:
        """Return the meaning of a leaf, and its unit; either may be empty."""
        numbers = [int(text) for text in _NUMBER.findall(path)]
        name = remove_indices(path)
        if not numbers:
            return "", _get_unit(name)
        staged = f" in stage {numbers[0]}" if name in _STAGE and len(numbers) > 1 else ""
        for kind, known in ((_STATES, self._states), (_INPUTS, self._inputs)):
            if (topic, name) in kind and numbers[-1] < len(known):
                meaning, unit = known[numbers[-1]]
                return meaning + staged, unit
        unit = _get_unit(name)
        return (AXES[numbers[-1]] if unit.startswith("m") and numbers[-1] < len(AXES) else ""), unit


def remove_indices(path: str) -> str:
    """Return a path without the indices of entries."""
    return _NUMBER.sub("", path)


def _get_unit(name: str) -> str:
    return _UNITS.get(name.rpartition("_")[2], "") if "_" in name else ""


def name_stage(topic: str) -> str:
    """Return which stage of a tick is in question if this topic is the first to differ."""
    return _STAGES.get(topic, _SENT if parse_raw_topic(topic) is not None else "")


def find_different_leaves(recorded: Record, replayed: Record) -> list[Leaf]:
    """Return the leaves in which two records of a topic differ in any bit."""
    plain, other = (msgspec.to_builtins(record, enc_hook=convert_numpy) for record in (recorded, replayed))
    return list(iterate_different_leaves(plain, other))


def iterate_different_leaves(recorded: object, replayed: object, path: str = "") -> Iterator[Leaf]:
    """Leaves where two trees of plain values differ in any bit."""
    if isinstance(recorded, dict) and isinstance(replayed, dict):
        for key in dict.fromkeys([*recorded, *replayed]):
            yield from iterate_different_leaves(
                recorded.get(key), replayed.get(key), f"{path}.{key}" if path else str(key)
            )
    elif isinstance(recorded, list | tuple) and isinstance(replayed, list | tuple) and len(recorded) == len(replayed):
        for index, (value, other) in enumerate(zip(recorded, replayed, strict=True)):
            yield from iterate_different_leaves(value, other, f"{path}[{index}]")
    elif not _have_same_bits(recorded, replayed):
        yield path, recorded, replayed


def _have_same_bits(left: object, right: object) -> bool:
    if isinstance(left, float) and isinstance(right, float):
        return left.hex() == right.hex()
    return type(left) is type(right) and left == right


def are_close(left: object, right: object, tolerance: float) -> bool:
    """Return whether two leaves that differ count as the same: numbers, relative to the larger of 1 and their size."""
    if not isinstance(left, int | float) or not isinstance(right, int | float) or tolerance == 0.0:
        return False
    return math.isclose(left, right, rel_tol=tolerance, abs_tol=tolerance)


def compute_change(recorded: object, replayed: object) -> float | None:
    """Return the difference of two numbers; None of anything else."""
    numbers = all(isinstance(value, int | float) and not isinstance(value, bool) for value in (recorded, replayed))
    return float(replayed - recorded) if numbers else None  # type: ignore[operator]  # both are numbers


def describe_record(record: Record | None) -> str:
    """Return a record in a few words."""
    match record:
        case None:
            return NOTHING
        case Event():
            return f"{record.code}: {record.text}"
        case Datagram():
            return f"{len(record.data)} bytes, {record.data[:24].hex()}"
        case _:
            return f"a record ({type(record).__name__})"


def read_choice(record: Record | None) -> Chosen | None:
    """Return the choice of a decision."""
    if not isinstance(record, Decision):
        return None
    return Chosen(
        mode=record.mode.value,
        age_steps=record.age_steps,
        solve=None if record.solve is None else record.solve.value,
        plan_seq=record.plan_seq,
        plan_index=record.plan_index,
        reason=record.reason,
    )


def make_context(
    inp: StepInput, decisions_before: int, records_before: int, recorded: Record | None, replayed: Record | None
) -> Context:
    """Return the inputs of the tick `inp`, and the decisions that it led to."""
    newest: PositionSample | None = max(inp.samples, key=lambda sample: sample.captured_ns, default=None)
    return Context(
        decisions_before=decisions_before,
        records_before=records_before,
        positions=len(inp.samples),
        position_m=None if newest is None else newest.position_m,
        position_age_s=None if newest is None else (inp.at_ns - newest.captured_ns) * 1e-9,
        vehicle="" if inp.vehicle is None else f"{inp.vehicle.mode}, {'armed' if inp.vehicle.armed else 'disarmed'}",
        orders=tuple(map(_describe_order, inp.commands)),
        missed_ticks=inp.missed_ticks,
        stop=inp.stop,
        recorded=read_choice(recorded),
        replayed=read_choice(replayed),
    )


def _describe_order(command: Command) -> str:
    argument = command.position_m if command.height_m is None else command.height_m
    return command.order.value if argument is None else f"{command.order.value} {argument}"


COMPARED = frozenset(_STAGES)
Labels = frozenset[tuple[str, str]]
# What a plan says of who made it, which a changed controller need not repeat to decide alike.
MAKERS: Labels = frozenset({("/uavctl/plan", "design_id"), ("/uavctl/plan", "method")})
# What turns with the last bit of a number that is the same to within a tolerance: a hash, and whether a limit was met.
LAST_BITS: Labels = frozenset({(PLAN, "design_id"), (PLAN, "exact_crc32"), ("/uavctl/setpoint", "limited")})

# Texts for people, which another version words otherwise: code, severity, mode and time say the same.
TEXTS: Labels = frozenset({("/uavctl/event", "text"), (DECISION, "reason")})


class ReplayResult(msgspec.Struct, frozen=True, kw_only=True):
    """Result of a replay; the four fields before the last are there if there is a difference."""

    decisions: int
    compared: int
    identical: bool
    first_difference: ReplayDifference | None
    first_decision: ReplayDifference | None = None  # the first decision that differs; None if all are alike
    context: Context | None = None  # of the first difference; None before the first tick
    decisions_differing: int = 0
    course: tuple[FieldDivergence, ...] = ()  # field by field, in the order in which they began to differ
    dropped: int = 0  # records that the recorder had to drop: what came after the first of them cannot be compared


class _Produced:
    """Sink that keeps the replayed loop's output until the recorded one is read."""

    def __init__(self) -> None:
        self.waiting: deque[tuple[str, int, Record]] = deque()

    def put(self, topic: str, at_ns: int, record: Record) -> None:
        if _is_compared(topic):
            self.waiting.append((topic, at_ns, record))

    def take(self, topic: str, at_ns: int) -> Record | None:
        """Return the next replayed record of this topic and time."""
        for index, (its_topic, its_ns, record) in enumerate(self.waiting):  # nearly always the first
            if its_ns == at_ns and its_topic == topic:
                del self.waiting[index]
                return record
        return None

    def list_missing(self) -> list[tuple[str, int, Record]]:
        """Return and forget the replayed records that the recording does not have."""
        records = [*self.waiting]
        self.waiting.clear()
        return records


@dataclass
class _Field:
    """Course of one field's difference."""

    first_s: float
    before: int  # records of its topic before it differed
    differing: int = 0
    largest: float | None = None
    largest_s: float | None = None
    path: str = ""  # of the entry that differs most

    def add(self, parts: Iterable[Leaf], at_s: float) -> None:
        self.differing += 1
        for path, recorded, replayed in parts:
            size = compute_change(recorded, replayed)
            if size is not None and (self.largest is None or abs(size) > self.largest):
                self.largest, self.largest_s, self.path = abs(size), at_s, path


@dataclass
class _Findings:
    """Comparison so far, and where the two part."""

    field_names: FieldNames
    tolerance: float
    ignored: Labels
    compared: int = 0
    decisions: int = 0
    decisions_differing: int = 0
    first: ReplayDifference | None = None
    first_decision: ReplayDifference | None = None
    context: Context | None = None
    dropped: int = 0
    _before: tuple[int, int] = (0, 0)  # decisions and records before the first difference
    _tick: StepInput | None = None
    _begun_ns: int | None = None
    _fields: dict[tuple[str, str], _Field] = field(default_factory=dict)
    _records: dict[str, int] = field(default_factory=lambda: defaultdict(int))  # by topic, since the first difference

    def begin(self, inp: StepInput) -> None:
        """Begin a tick."""
        self._tick = inp
        self._begun_ns = inp.at_ns if self._begun_ns is None else self._begun_ns

    def same(self, topic: str) -> None:
        """Count one record that is alike, while all so far were."""
        self.compared += 1
        self.decisions += topic == DECISION

    def compare(self, topic: str, at_ns: int, recorded: Record | None, replayed: Record | None) -> None:
        """Compare a recorded record with the replayed one; either may be missing."""
        parts: list[Leaf] = []
        if isinstance(recorded, Plan) and isinstance(replayed, Plan) and recorded.exact_crc32 is not None:
            replayed = round_plan(replayed)
        if recorded is not None and replayed is not None and not are_identical(recorded, replayed):
            parts = [
                leaf
                for leaf in find_different_leaves(recorded, replayed)
                if (topic, remove_indices(leaf[0])) not in self.ignored
                and not are_close(leaf[1], leaf[2], self._tolerance_of(topic))
            ]
        differs = bool(parts) or recorded is None or replayed is None
        if differs:
            self._differs(topic, at_ns, recorded, replayed, parts)
        if recorded is not None:
            self.compared += 1
            self.decisions += topic == DECISION
        if self.first is None:
            return
        self._records[topic] += 1
        self.decisions_differing += differs and topic == DECISION
        of_tick = topic == DECISION and self._tick is not None and at_ns == self._tick.at_ns
        if of_tick and self.context is None and self._tick is not None:
            self.context = make_context(self._tick, *self._before, recorded, replayed)

    def _tolerance_of(self, topic: str) -> float:
        """Return the tolerance of a topic: two numbers of a plan that are close may be rounded apart."""
        return max(self.tolerance, 10.0 ** (1 - DIGITS)) if self.tolerance and topic == PLAN else self.tolerance

    def _differs(
        self, topic: str, at_ns: int, recorded: Record | None, replayed: Record | None, parts: list[Leaf]
    ) -> None:
        at_s = 0.0 if self._begun_ns is None else (at_ns - self._begun_ns) * 1e-9
        path, left, right = parts[0] if parts else ("", None, None)
        meaning, unit = self.field_names.meaning(topic, path)
        difference = ReplayDifference(
            topic=topic,
            at_ns=at_ns,
            flight_s=at_s,
            tick=None if self._tick is None else self._tick.tick,
            field=path,
            meaning=meaning,
            unit=unit,
            recorded=repr(left) if parts else describe_record(recorded),
            replayed=repr(right) if parts else describe_record(replayed),
            change=compute_change(left, right),
            fields=len(parts),
            stage=name_stage(topic),
        )
        if self.first is None:
            self.first, self._before = difference, (self.decisions, self.compared)
        if topic == DECISION:
            self.first_decision = self.first_decision or difference
        fields: dict[str, list[Leaf]] = defaultdict(list)
        for part in parts or [("", None, None)]:
            fields[remove_indices(part[0])].append(part)
        for name, those in fields.items():
            field = self._fields.setdefault((topic, name), _Field(at_s, self._records[topic]))
            field.add(those, at_s)

    def result(self, *, finished: bool) -> ReplayResult:
        """Return the result; a recording that claims an end must hold more than nothing."""
        return ReplayResult(
            decisions=self.decisions,
            compared=self.compared,
            identical=self.first is None and (self.decisions > 0 or not finished),
            first_difference=self.first,
            first_decision=self.first_decision,
            context=self.context,
            decisions_differing=self.decisions_differing,
            course=tuple(
                FieldDivergence(
                    topic=topic,
                    field=name,
                    entry=self.field_names.meaning(topic, field.path)[0],
                    unit=self.field_names.meaning(topic, field.path or name)[1],
                    differing=field.differing,
                    records=self._records[topic] - field.before,
                    first_s=field.first_s,
                    largest=field.largest,
                    largest_s=field.largest_s,
                )
                for (topic, name), field in self._fields.items()
            ),
            dropped=self.dropped,
        )


def replay(
    messages: Iterable[Message],
    make_loop: Callable[[Sink], ControlLoop],
    tolerance: float = 0.0,
    *,
    finished: bool = True,
    ignored: Labels = frozenset(),
    moved_inputs: bool = False,
) -> ReplayResult:
    """Drive a loop with the recorded inputs, and compare its whole output with the recorded one.

    Args:
        messages: (topic, log time [ns], record or the bytes that it is recorded as) in the order of recording.
        make_loop: builds the loop from the recording's configuration, around the given sink.
        tolerance: largest difference of two numbers that counts as none, relative to the larger
            of 1 and their size; 0 compares bit for bit. For a recording of another arithmetic.
        finished: the recording was closed in order; a torn one's last tick may lack records. So may that of a flight
            that a second signal has ended at once.
        ignored: (topic, field) that may differ; of a vector all entries.
        moved_inputs: the recording is of a what-if: its measurements are not those of its raw bytes.
    """
    produced = _Produced()
    loop = make_loop(produced)
    findings = _Findings(FieldNames(loop.plant), tolerance, ignored)
    for (topic, at_ns, message), core_error in _find_core_errors(messages):
        record = _decode_records(topic, at_ns, message) if _is_input(topic) or not isinstance(message, bytes) else None
        if isinstance(record, StepInput):
            # What the last tick said must have been read by now. Only a torn file's last tick may lack some.
            _add_missing(findings, produced)
            findings.begin(record)
            for command in record.commands:
                loop.order(command)
            loop.note_solve_time(record.answered_ns)
            if record.cell is not None:
                loop.put_cell(record.cell)
            inputs = loop.gather_inputs(record.tick, record.at_ns, record.missed_ticks, record.stop)
            loop.run_inputs(inputs.with_measurements(record) if moved_inputs else inputs, discard, core_error)
        elif isinstance(record, Datagram) and not record.outgoing:
            loop.receive(record.link, record.data, record.at_ns)
        elif isinstance(record, Refused):
            loop.add_refusals(record.link, record.counts, record.at_ns)
        elif isinstance(record, InternalError) and record.effect is not InternalErrorEffect.TICK:
            loop.handle_failure(record, discard)
        elif isinstance(record, RecorderNote):
            findings.dropped = record.dropped
        elif isinstance(record, Ending):
            finished = finished and record.code != Cause.SIGNALLED
        if _is_compared(topic):
            replayed = produced.take(topic, at_ns)
            if (
                findings.first is None
                and isinstance(message, bytes)
                and replayed is not None
                and is_encoding_of(replayed, message)
            ):
                findings.same(topic)
            else:
                findings.compare(topic, at_ns, record or _decode_records(topic, at_ns, message), replayed)
    if finished:
        _add_missing(findings, produced)
    return findings.result(finished=finished)


def _find_core_errors(messages: Iterable[Message]) -> Iterator[tuple[Message, str]]:
    """Yield the messages, each step input with the error that the core met in its tick; empty without one."""
    of_tick: list[Message] = []
    for message in messages:
        if message[0] == STEP_INPUT and of_tick:
            yield from _add_core_error(of_tick)
            of_tick = []
        of_tick.append(message)
    yield from _add_core_error(of_tick)


def _add_core_error(of_tick: Sequence[Message]) -> Iterator[tuple[Message, str]]:
    errors = [_decode_records(*message) for message in of_tick if message[0] == FAILURE]
    core_errors = [
        record.text
        for record in errors
        if isinstance(record, InternalError) and record.effect is InternalErrorEffect.TICK
    ]
    return ((message, "".join(core_errors[:1])) for message in of_tick)


def _decode_records(topic: str, at_ns: int, message: Record | bytes) -> Record:
    return decode(topic, message, at_ns) if isinstance(message, bytes) else message


def _add_missing(findings: _Findings, produced: _Produced) -> None:
    for topic, at_ns, record in produced.list_missing():
        findings.compare(topic, at_ns, None, record)


@cache
def _is_compared(topic: str) -> bool:
    return topic in COMPARED or (topic.startswith("/raw/") and topic.endswith("/out"))


@cache
def _is_input(topic: str) -> bool:
    """Return whether a topic is not compared: its records drive the loop, or the result reports them."""
    link = parse_raw_topic(topic)
    try:
        return (
            get_record_type(topic) in (StepInput, Refused, InternalError, RecorderNote, Ending)
            if link is None
            else not link[1]
        )
    except KeyError:
        return True  # decoding says that nobody knows it
