"""Where a replay parts from its recording: the field, what the tick knew, and how the difference goes on."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator

import msgspec

from logs.topics import raw_link
from uavctl.data import Command, Datagram, Decision, Event, PositionSample, Record, StepInput, VehicleStatus
from uavctl.naming import names_of
from uavctl.smpc.plant import Plant

DECISION = "/uavctl/decision"
NOTHING = "nothing"
Leaf = tuple[str, object, object]  # path, recorded, replayed

# What the records of a tick say one after the other: those before the first one that differs are the same.
_SAID_BY = {
    "/uavctl/step_input": "of the same bytes the tick was given something else: parser, clock or frame",
    "/uavctl/vehicle": "the vehicle's messages are understood otherwise",
    "/uavctl/estimate": "the tick was given the same: estimator, or how far positions are believed",
    "/uavctl/link_estimate": "the tick was given the same: what is believed of the link",
    "/uavctl/plan": "the estimate is the same: design, target or solver",
    DECISION: "estimate and plan (if there is a new one) are the same: a rule of the decision, fallback or last gate",
    "/uavctl/setpoint": "the decision is the same: hand-over or last gate",
    "/uavctl/event": "nothing before it differs: what is told",
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
_AXES = ("north", "east", "down")  # of what is a vector in local NED
_UNITS = {"ns": "ns", "s": "s", "m": "m", "mps": "m/s", "mps2": "m/s²", "rad": "rad", "v": "V", "ppm": "ppm"}
_NUMBER = re.compile(r"\[(\d+)\]")
_STAGE = {"inputs": "stage", "states": "stage", "backoff_x": "stage", "backoff_u": "stage"}


class Difference(msgspec.Struct, frozen=True, kw_only=True):
    """One place where recording and replay part."""

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
    """What a tick decided."""

    mode: str
    age_steps: int | None
    solve: str | None
    plan_seq: int | None
    plan_index: int | None
    reason: str


class Context(msgspec.Struct, frozen=True, kw_only=True):
    """The tick of the first difference: what came before, what it was given, what it decided."""

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


class Course(msgspec.Struct, frozen=True, kw_only=True):
    """One field from the first difference on; entries of a vector are taken together."""

    topic: str
    field: str  # empty: there is a record on one side only
    entry: str  # of a vector: the one that differs most, in words
    unit: str  # of that
    differing: int  # records in which it differs
    records: int  # of its topic, from the first difference on
    first_s: float  # of the flight
    largest: float | None  # difference; None of what is no number
    largest_s: float | None


class Places:
    """Names and units of fields, as far as they are known.

    Args:
        plant: of the controller; its states and inputs have names.
    """

    def __init__(self, plant: Plant) -> None:
        self._states = names_of((), plant.n_x, plant.axes, plant.position_index, plant.velocity_index).states
        self._inputs = tuple(
            (f"{axis} input", "m/s²" if one == 1.0 else "")
            for axis, one in zip(plant.axes, plant.accel_per_input, strict=True)
        )

    def meaning(self, topic: str, path: str) -> tuple[str, str]:
        """What a leaf is, and its unit; either may be empty."""
        numbers = [int(one) for one in _NUMBER.findall(path)]
        name = plain(path)
        if not numbers:
            return "", _unit(name)
        staged = f" in stage {numbers[0]}" if name in _STAGE and len(numbers) > 1 else ""
        for kind, known in ((_STATES, self._states), (_INPUTS, self._inputs)):
            if (topic, name) in kind and numbers[-1] < len(known):
                meaning, unit = known[numbers[-1]]
                return meaning + staged, unit
        unit = _unit(name)
        return (_AXES[numbers[-1]] if unit.startswith("m") and numbers[-1] < len(_AXES) else ""), unit


def plain(path: str) -> str:
    """A path without numbers of entries."""
    return _NUMBER.sub("", path)


def _unit(name: str) -> str:
    return _UNITS.get(name.rpartition("_")[2], "") if "_" in name else ""


def stage(topic: str) -> str:
    """What comes into question if this topic is the first that differs."""
    return _SAID_BY.get(topic, _SENT if raw_link(topic) is not None else "")


def leaves(recorded: Record, replayed: Record) -> list[Leaf]:
    """Leaves where two records of a topic differ in any bit."""
    return list(_unequal(msgspec.to_builtins(recorded), msgspec.to_builtins(replayed), ""))


def _unequal(left: object, right: object, path: str) -> Iterator[Leaf]:
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


def close(left: object, right: object, tolerance: float) -> bool:
    """Whether two leaves that differ count as the same: numbers, relative to the larger of 1 and their size."""
    if not isinstance(left, int | float) or not isinstance(right, int | float) or tolerance == 0.0:
        return False
    return math.isclose(left, right, rel_tol=tolerance, abs_tol=tolerance)


def change(recorded: object, replayed: object) -> float | None:
    """Difference of two numbers; None of anything else."""
    numbers = all(isinstance(one, int | float) and not isinstance(one, bool) for one in (recorded, replayed))
    return float(replayed - recorded) if numbers else None  # type: ignore[operator]  # both are numbers


def brief(record: Record | None) -> str:
    """A record in a few words."""
    match record:
        case None:
            return NOTHING
        case Event():
            return f"{record.code}: {record.text}"
        case Datagram():
            return f"{len(record.data)} bytes, {record.data[:24].hex()}"
        case _:
            return f"a record ({type(record).__name__})"


def chosen(record: Record | None) -> Chosen | None:
    """What a decision says."""
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


def context(
    inp: StepInput, decisions_before: int, records_before: int, recorded: Record | None, replayed: Record | None
) -> Context:
    """The tick `inp` and the decisions that it led to."""
    newest: PositionSample | None = max(inp.samples, key=lambda one: one.captured_ns, default=None)
    return Context(
        decisions_before=decisions_before,
        records_before=records_before,
        positions=len(inp.samples),
        position_m=None if newest is None else newest.position_m,
        position_age_s=None if newest is None else (inp.at_ns - newest.captured_ns) * 1e-9,
        vehicle="" if inp.vehicle is None else _vehicle(inp.vehicle),
        orders=tuple(map(_order, inp.commands)),
        missed_ticks=inp.missed_ticks,
        stop=inp.stop,
        recorded=chosen(recorded),
        replayed=chosen(replayed),
    )


def _order(command: Command) -> str:
    given = command.position_m if command.height_m is None else command.height_m
    return command.order.value if given is None else f"{command.order.value} {given}"


def _vehicle(status: VehicleStatus) -> str:
    return f"{status.mode}, {'armed' if status.armed else 'disarmed'}"
