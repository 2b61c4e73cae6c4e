"""Records as rows: every value is in the cell that its name says, bit for bit, and nothing else is there."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator

import msgspec
import numpy as np
import pytest
from flat_rig import tabulate
from hypothesis import given, settings
from hypothesis import strategies as st
from record_values import values

from logs.recording.export import Cell
from logs.recording.topics import TOPICS, Topic, get_record_type
from uavctl.records import (
    Command,
    Estimate,
    Order,
    PositionSample,
    Record,
    Setpoint,
    SetpointSource,
    StepInput,
    Truth,
    Vec3,
    VehicleStatus,
)


def leaves(value: object, name: str = "") -> Iterator[tuple[str, object]]:
    """Where the values of a record should be; what is missing, and lists of records, are nowhere."""
    if isinstance(value, msgspec.Struct):
        places = {field.name: field.type for field in msgspec.structs.fields(value)}
        for field, kind in places.items():
            held, here = getattr(value, field), f"{name}.{field}" if name else field
            if kind in (Vec3, Vec3 | None) and held is not None:
                yield from zip((f"{here}_x", f"{here}_y", f"{here}_z"), held, strict=True)
            elif kind == tuple[Vec3, ...]:
                for place, vector in enumerate(held):
                    yield from zip((f"{here}_{place}_x", f"{here}_{place}_y", f"{here}_{place}_z"), vector, strict=True)
            elif kind == dict[str, object]:
                yield here, msgspec.json.encode(held).decode()
            else:
                yield from leaves(held, here)
    elif isinstance(value, dict):
        for key, one in value.items():
            yield from leaves(one, f"{name}.{key}")
    elif isinstance(value, tuple) and any(isinstance(one, msgspec.Struct) for one in value):
        yield name, len(value)
    elif isinstance(value, np.ndarray):
        yield from leaves(value.tolist(), name)
    elif isinstance(value, tuple | list):
        for place, one in enumerate(value):
            yield from leaves(one, f"{name}_{place}")
    elif value is not None:
        yield name, value


def expect(row: dict[str, Cell], record: msgspec.Struct) -> None:
    """A row holds a record, and nothing else."""
    wanted = dict(leaves(record))
    # repr tells every float apart, the sign of zero and NaN included; an empty list of records counts 0
    found = {name: repr(cell) for name, cell in row.items() if cell is not None and (cell != 0 or name in wanted)}
    assert found == {name: repr(getattr(value, "value", value)) for name, value in wanted.items()}


@pytest.mark.slow
@pytest.mark.parametrize("topic", TOPICS, ids=lambda topic: topic.name)
def test_every_value_of_every_record_is_in_its_column(topic: Topic) -> None:
    @settings(max_examples=30)  # of up to three records
    @given(st.lists(values(topic.record), min_size=1, max_size=3))
    def check(drawn: list[object]) -> None:
        records = [record for record in drawn if isinstance(record, Record)]
        rows = tabulate([(topic.name, 5 + place, record) for place, record in enumerate(records)])
        assert [row.pop("log_time_ns") for row in rows[topic.name]] == list(range(5, 5 + len(records)))
        for row, record in zip(rows.pop(topic.name), records, strict=True):
            expect(row, record)
        for name, inner in rows.items():
            field = name.removeprefix(f"{topic.name}.")
            wanted = [
                (number, place, one)
                for number, record in enumerate(records)
                for place, one in enumerate(getattr(record, field))
            ]
            for row, (number, place, one) in zip(inner, wanted, strict=True):
                assert [row.pop(key) for key in ("log_time_ns", "row", "place")] == [5 + number, number, place]
                expect(row, one)

    check()


def test_columns_are_named_after_fields_axes_and_places() -> None:
    estimate = Estimate(at_ns=1, captured_ns=0, mean=(1.0, 2.0), cov=((1.0, 0.0), (0.0, 1.0)))
    (row,) = tabulate([("/uavctl/estimate", 9, estimate)])["/uavctl/estimate"]
    assert list(row) == [
        "log_time_ns", "at_ns", "captured_ns", "mean_0", "mean_1", "cov_0_0", "cov_0_1", "cov_1_0", "cov_1_1",
    ]  # fmt: skip
    setpoint = Setpoint(at_ns=1, accel_mps2=(math.nan, -0.0, math.inf), source=SetpointSource.PLAN, limited=("speed",))
    (row,) = tabulate([("/uavctl/setpoint", 9, setpoint)])["/uavctl/setpoint"]
    names = ("accel_mps2_x", "accel_mps2_y", "accel_mps2_z", "yaw_rad", "source", "limited_0")
    assert repr([row[name] for name in names]) == "[nan, -0.0, inf, None, 'plan', 'speed']"


def test_lists_of_records_have_tables_of_their_own() -> None:
    sample = PositionSample(captured_ns=3, received_ns=4, position_m=(1.0, 2.0, 3.0), std_m=0.1, source="a", seq=1)
    vehicle = VehicleStatus(at_ns=5, autopilot="px4", armed=True, mode="OFFBOARD", external=True)
    order = Command(order=Order.GOTO, position_m=(0.0, 0.0, -1.0))
    rows = tabulate(
        [
            ("/uavctl/step_input", 10, StepInput(tick=0, at_ns=10)),
            ("/uavctl/step_input", 20, StepInput(tick=1, at_ns=20, samples=(sample, sample), commands=(order,))),
            ("/uavctl/step_input", 30, StepInput(tick=2, at_ns=30, vehicle=vehicle)),
        ]
    )
    assert [row["samples"] for row in rows["/uavctl/step_input"]] == [0, 2, 0]
    assert [row["vehicle.mode"] for row in rows["/uavctl/step_input"]] == [None, None, "OFFBOARD"]
    samples = rows["/uavctl/step_input.samples"]
    assert [(row["log_time_ns"], row["row"], row["place"]) for row in samples] == [(20, 1, 0), (20, 1, 1)]
    assert samples[0]["position_m_z"] == 3.0 and samples[0]["velocity_mps_z"] is None
    assert rows["/uavctl/step_input.commands"][0]["order"] == "goto"


def test_a_longer_list_later_gives_its_column_to_all() -> None:
    def truth(at_ns: int, faults: tuple[str, ...]) -> tuple[str, int, Record]:
        zero = (0.0, 0.0, 0.0)
        return "/sim/truth", at_ns, Truth(
            at_ns=at_ns, position_m=zero, velocity_mps=zero, state=(), input=(), sent=0, lost=0, mode="", faults=faults
        )  # fmt: skip

    rows = tabulate([truth(1, ()), truth(2, ("gps", "motor")), truth(3, ("gps",))])["/sim/truth"]
    assert [(row["faults_0"], row["faults_1"]) for row in rows] == [(None, None), ("gps", "motor"), ("gps", None)]


def test_what_has_any_value_is_json() -> None:
    design = {"gamma": [1.0, 0.5], "name": None}
    header = get_record_type("/uavctl/header")(
        started_ns=0, started_utc="", seed=0, command="", config_toml="", design_id="", design=design,
        versions={"a": "1"}, cpu="",
    )  # fmt: skip
    (row,) = tabulate([("/uavctl/header", 0, header)])["/uavctl/header"]
    assert json.loads(str(row["design"])) == design and row["versions.a"] == "1"
