from __future__ import annotations

import math
from typing import cast

import pytest
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass

from logs.recording.derived_topics import describe_schema, make_message_class, pack_message
from uavctl.records import Record


class Pair(Record, frozen=True, kw_only=True):
    left: float
    right: float = math.nan


class Sheet(Record, frozen=True, kw_only=True):
    name: str
    count: int
    good: bool
    one: Pair
    other: Pair
    values: tuple[float, ...] = ()


class Wrong(Record, frozen=True, kw_only=True):
    value: complex


SHEET = Sheet(name="é", count=-(2**63), good=True, one=Pair(left=1e-300), other=Pair(left=-0.0, right=math.inf))


def test_a_stranger_reads_every_field_with_the_schema_alone() -> None:
    files = FileDescriptorSet.FromString(describe_schema(make_message_class(Sheet)))
    pool = DescriptorPool()
    for file in files.file:
        pool.Add(file)
    read = GetMessageClass(pool.FindMessageTypeByName("uavctl.Sheet")).FromString(
        pack_message(Sheet(name="é", count=-5, good=True, one=SHEET.one, other=SHEET.other, values=(1.5, math.nan)))
    )
    found = {field.name: getattr(read, field.name) for field in read.DESCRIPTOR.fields}
    assert (found["name"], found["count"], found["good"]) == ("é", -5, True)
    assert (found["one"].left, math.isnan(found["one"].right)) == (1e-300, True)
    assert math.copysign(1.0, found["other"].left) == -1.0 and found["other"].right == math.inf
    assert found["values"][0] == 1.5 and math.isnan(found["values"][1])


def test_integers_of_64_bits_fit_and_larger_ones_are_refused() -> None:
    assert getattr(make_message_class(Sheet).FromString(pack_message(SHEET)), "count") == SHEET.count  # noqa: B009
    with pytest.raises(ValueError, match="range"):
        pack_message(Sheet(name="", count=2**63, good=False, one=SHEET.one, other=SHEET.one))


def test_a_value_of_another_type_is_refused() -> None:
    with pytest.raises(TypeError):
        pack_message(Sheet(name="", count=cast("int", "x"), good=False, one=SHEET.one, other=SHEET.one))


def test_a_type_without_a_field_of_its_own_is_named() -> None:
    with pytest.raises(TypeError, match=r"Wrong\.value"):
        make_message_class(Wrong)
