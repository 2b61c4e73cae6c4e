from __future__ import annotations

import json

import msgspec
import pytest

from logs.recording.derived_topics import VIEWS
from logs.recording.topics import TOPICS, get_definition, get_record_type, is_view, parse_raw_topic
from uavctl import fleet_records
from uavctl import records as data
from uavctl.records import Datagram, Decision, Record, raw_topic


def test_every_recorded_type_has_one_topic() -> None:
    # Not on their own topic: parts of other records, and what never leaves the process.
    inside = {
        "Record",
        "PositionSample",
        "GaveWay",
        "Command",
        "Datagram",
        "Outgoing",
        "VehicleMotion",
        "InertialSample",
        "RiskRecord",
        "VehicleTruth",
        "CellMessage",
        "CellReport",
        "ScheduledVehicle",
        "VehicleCycle",
    }
    types = {
        name
        for name, kind in {**vars(data), **vars(fleet_records)}.items()
        if isinstance(kind, type) and issubclass(kind, Record) and name not in inside
    }
    assert {topic.record.__name__ for topic in TOPICS} == types | {"RecorderNote"}
    assert len({topic.name for topic in TOPICS}) == len(TOPICS) == len(types) + 1


@pytest.mark.parametrize("topic", TOPICS, ids=lambda topic: topic.name)
def test_schema_is_an_object_with_the_record_s_fields(topic: object) -> None:
    assert isinstance(topic, type(TOPICS[0]))
    schema = json.loads(topic.definition.schema)
    assert schema["type"] == "object"
    assert list(schema["properties"]) == [field.name for field in msgspec.structs.fields(topic.record)]
    references = {part.split('"')[0] for part in topic.definition.schema.decode().split('"$ref":"#/$defs/')[1:]}
    assert references <= set(schema.get("$defs", {}))


def test_raw_topics_name_link_and_direction() -> None:
    assert raw_topic("vehicle", outgoing=False) == "/raw/vehicle/in"
    assert parse_raw_topic("/raw/mocap/out") == ("mocap", True)
    assert parse_raw_topic("/raw/a/b/in") is None
    assert get_record_type("/raw/vehicle/in") is Datagram
    assert get_definition("/raw/vehicle/in").encoding == "mavlink"
    assert get_definition("/raw/vehicle/in").schema == b""


def test_unknown_topic() -> None:
    assert get_record_type("/uavctl/decision") is Decision
    with pytest.raises(KeyError):
        get_record_type("/uavctl/unknown")
    with pytest.raises(KeyError):
        get_definition("/raw/vehicle/sideways")


def test_topics_for_viewers_are_no_records() -> None:
    names = {view.name for view in VIEWS}
    assert len(names) == len(VIEWS) and not names & {topic.name for topic in TOPICS}
    for name in names:
        assert is_view(name) and get_definition(name).encoding == get_definition(name).schema_encoding == "protobuf"
        with pytest.raises(KeyError):
            get_record_type(name)
    assert not any(is_view(topic.name) for topic in TOPICS) and not is_view("/raw/vehicle/in")
