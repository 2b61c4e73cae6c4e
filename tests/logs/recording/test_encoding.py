from __future__ import annotations

import json
import math
import struct
import typing
import zlib

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from record_values import values
from recording_fakes import HEADER

from logs.recording.earlier import complete_record
from logs.recording.topics import MATRICES, TOPICS, EncodingError, Topic, are_identical, decode, encode, round_plan
from uavctl.errors import RecordingError
from uavctl.records import (
    Datagram,
    Estimate,
    Event,
    Matrix,
    Plan,
    Record,
    Setpoint,
    SetpointSource,
    Severity,
    SolveStatus,
    Truth,
)


@pytest.mark.slow
@pytest.mark.parametrize("topic", TOPICS, ids=lambda topic: topic.name)
def test_every_record_reads_back_bit_for_bit(topic: Topic) -> None:
    @given(values(topic.record))
    def check(record: object) -> None:
        assert isinstance(record, Record)
        data = encode(record)
        json.loads(data, parse_constant=pytest.fail)  # plain JSON, no bare NaN
        found = decode(topic.name, data, 0)
        # Records of earlier versions lack fields, which reading adds; texts may be drawn that such records have.
        written = round_plan(record) if isinstance(record, Plan) else complete_record(record)
        # repr tells every float apart, the sign of zero and NaN included
        assert repr_whole(found) == repr_whole(written)

    check()


def repr_whole(record: Record) -> str:
    """Return the text of a record, its matrices as lists: numpy shortens the text of an array."""
    return repr(msgspec.to_builtins(record, enc_hook=lambda matrix: matrix.tolist(), builtin_types=(bytes,)))


@given(values(Truth), values(Truth))
def test_records_that_are_alike_are_so_in_every_bit(one: Truth, other: Truth) -> None:
    same = msgspec.structs.replace(one)
    assert are_identical(one, same) and repr(one) == repr(same)
    assert are_identical(one, other) == (repr(one) == repr(other))  # the sign of a zero too


def make_plan(rows: Matrix) -> Plan:
    """Return a plan whose matrices all have these rows."""
    matrix = np.array(rows)
    return Plan(
        seq=1,
        base_ns=2**60,
        captured_ns=0xCB7FF8,
        status=SolveStatus.OPTIMAL,
        method="NaN",
        inputs=matrix,
        states=matrix,
        backoff_x=matrix,
        backoff_u=matrix,
        reference=rows[0],
        slack=0.25,
        offset=-0.0,
        terminal_miss=0.0,
        cost=1.5,
        cost_lower=0.5,
        gap=2.5,
        iterations=3,
        design_id="",
    )


SIZES = st.floats(1e-9, 1e15)
NUMBERS = st.one_of(st.sampled_from([0.0, -0.0]), SIZES, SIZES.map(lambda size: -size))


@given(st.lists(st.tuples(NUMBERS, NUMBERS), min_size=1, max_size=4))
def test_a_recorded_plan_has_four_digits_of_each_number_and_the_checksum_of_all_bits(
    rows: list[tuple[float, float]],
) -> None:
    found = round_plan(make_plan(tuple(rows)))
    numbers = [number for row in rows for number in row]
    assert found.exact_crc32 == zlib.crc32(4 * struct.pack(f"={len(numbers)}d", *numbers))
    assert all(getattr(found, name).tolist() == found.states.tolist() for name in MATRICES)
    rounded = found.states.ravel().tolist()
    assert rounded == [float(f"{number:.3e}") for number in rounded]
    assert rounded == pytest.approx(numbers, rel=5.0001e-4, abs=0.0)
    assert round_plan(found) is found


@pytest.mark.parametrize("name", MATRICES)
def test_the_last_bit_of_a_plan_changes_what_is_recorded(name: str) -> None:
    plan = make_plan(((0.1, 1.0), (2.0, 3.0)))
    nudged = msgspec.structs.replace(plan, **{name: np.array([[0.1, 1.0], [2.0, math.nextafter(3.0, 4.0)]])})
    assert encode(nudged) != encode(plan)
    assert round_plan(nudged).states.tolist() == round_plan(plan).states.tolist()
    assert nudged != plan and plan == make_plan(((0.1, 1.0), (2.0, 3.0)))


def test_alike_looks_at_every_bit_and_never_raises() -> None:
    def setpoint(north: float, at_ns: int = 1) -> Setpoint:
        return Setpoint(at_ns=at_ns, accel_mps2=(north, 0.0, 0.0), source=SetpointSource.HOLD)

    assert are_identical(setpoint(math.nan), setpoint(math.nan))
    assert not are_identical(setpoint(0.0), setpoint(-0.0))
    assert not are_identical(setpoint(1.0), setpoint(math.nextafter(1.0, 2.0)))
    assert not are_identical(setpoint(1.0), setpoint(1))
    assert not are_identical(setpoint(1.0, 2**70), setpoint(1.0, 2**70))  # not sure: to be looked at


def test_numbers_that_look_like_non_finite_ones_in_between_change_nothing() -> None:
    # bytes of a NaN within an integer, beside a missing value
    record = Setpoint(at_ns=0xCB7FF8, accel_mps2=(0.5, -0.0, 1.0), source=SetpointSource.HOLD)
    assert encode(record) == msgspec.json.encode(record)
    large = msgspec.structs.replace(record, at_ns=2**70)
    assert json.loads(encode(large))["at_ns"] == 2**70


def test_spelling_of_non_finite_floats() -> None:
    record = Setpoint(at_ns=1, accel_mps2=(math.nan, math.inf, -math.inf), source=SetpointSource.HOLD)
    plain = json.loads(encode(record))
    assert plain["accel_mps2"] == ["NaN", "Infinity", "-Infinity"]
    assert plain["yaw_rad"] is None


@given(st.sampled_from(["cost", "gap", "backoff_x"]), st.sampled_from([math.nan, math.inf, -math.inf]))
def test_fields_beside_a_non_finite_float_are_written_as_without_it(field: str, value: float) -> None:
    rows = ((0.1, -0.0, 5e-324), (1e300, 1 / 3, 7.0))
    plan = make_plan(rows)
    odd = np.array([(value, -0.0, 5e-324), *rows[1:]]) if field == "backoff_x" else value
    changed = msgspec.structs.replace(plan, **{field: odd})
    written = encode(changed)
    spelled = "NaN" if math.isnan(value) else "Infinity" if value > 0 else "-Infinity"
    fields = json.loads(encode(plan)) | {"exact_crc32": round_plan(changed).exact_crc32}
    fields[field] = [[spelled, -0.0, 5e-324], [1e300, 0.3333, 7.0]] if field == "backoff_x" else spelled
    assert written == msgspec.json.encode(fields)
    for method in ("NaN", "qp"):  # a text that looks like a number stays one
        whole = msgspec.structs.replace(plan, method=method, **{field: odd})
        assert are_identical(decode("/uavctl/plan", encode(whole), 0), round_plan(whole))


def test_text_is_left_alone() -> None:
    record = Event(at_ns=1, severity=Severity.INFO, code="NaN", text="Infinity")
    assert decode("/uavctl/event", encode(record), 0) == record


def test_numpy_values_become_plain_numbers() -> None:
    row = typing.cast("tuple[float, ...]", np.array([1.5, math.nan, -0.0]))
    one = typing.cast("float", np.float64(math.inf))
    record = Estimate(at_ns=1, captured_ns=1, mean=row, cov=((one,), (typing.cast("float", np.float32(0.5)),)))
    plain = Estimate(at_ns=1, captured_ns=1, mean=(1.5, math.nan, -0.0), cov=((math.inf,), (0.5,)))
    assert repr(decode("/uavctl/estimate", encode(record), 0)) == repr(plain)


def test_datagram_is_its_bytes() -> None:
    record = Datagram(at_ns=77, link="mocap", outgoing=False, data=b"\xfd\x00null")
    assert encode(record) == record.data
    assert decode("/raw/mocap/in", record.data, 77) == record


@pytest.mark.parametrize("value", [object(), 1j, "\ud800"])
def test_what_cannot_be_written_is_refused(value: object) -> None:
    record = Event(at_ns=1, severity=Severity.INFO, code="x", text=typing.cast("str", value))
    with pytest.raises(EncodingError, match="Event"):
        encode(record)


@pytest.mark.parametrize(
    ("topic", "data"),
    [
        ("/uavctl/unknown", b"{}"),
        ("/sim/truth", b"{"),
        ("/sim/truth", b'{"at_ns": 1}'),
        ("/uavctl/setpoint", b'{"at_ns":1,"accel_mps2":["NaN",0],"source":"hold"}'),
        ("/uavctl/setpoint", b'{"at_ns":1,"accel_mps2":["NaN",0,"1.0"],"source":"hold"}'),
        ("/uavctl/setpoint", b'{"at_ns":"NaN","accel_mps2":[0,0,0],"source":"hold"}'),
        (
            "/uavctl/header",
            encode(HEADER).replace(b'"design":{', b'"design":{"deep":' + b"[" * 10_000 + b"]" * 10_000 + b","),
        ),
    ],
)
def test_foreign_bytes_are_refused(topic: str, data: bytes) -> None:
    with pytest.raises(RecordingError, match=topic):
        decode(topic, data, 0)


def test_finite_truth_has_no_text_for_numbers() -> None:
    record = Truth(
        at_ns=1,
        position_m=(0.1, 0.2, 0.3),
        velocity_mps=(0.0, -0.0, 1e300),
        state=(1 / 3,),
        input=(),
        sent=0,
        lost=0,
        mode="x",
    )
    assert json.loads(encode(record))["velocity_mps"] == [0.0, -0.0, 1e300]
