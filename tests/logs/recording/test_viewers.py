"""A recording of `uavctl loopback` opened by the viewers' own readers, topic by topic, and the layout against it."""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from collections.abc import Iterator
from importlib import resources
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from mcap.reader import make_reader
from report_rig import omit_pages
from view_rig import read_protobuf

from logs.recording.derived_topics import VIEWS
from logs.recording.info import read_info
from logs.recording.reader import read
from logs.recording.topics import TOPICS, get_definition
from uavctl.cli.app import run
from uavctl.records import Decision, Estimate, Plan

if TYPE_CHECKING:
    from rerun.chunk import McapReader

# What a flight without trouble never says.
SILENT = {f"/uavctl/{name}" for name in ("library", "relay", "check", "parameter", "refused", "failure")}
OF_SEVERAL = {"/sim/fleet", "/sim/collision", "/sim/closest", "/uavctl/cell"}  # in a world of several vehicles
WELL_KNOWN = {"FrameTransforms", "FrameTransform", "PoseInFrame", "PosesInFrame", "Log", "SceneUpdate"}
# What Rerun makes of a well-known message; of the others it shows the fields.
DRAWN = {
    "foxglove.FrameTransforms": "Transform3D:quaternion",
    "foxglove.FrameTransform": "Transform3D:translation",
    "foxglove.PoseInFrame": "InstancePoses3D:translations",
    "foxglove.PosesInFrame": "InstancePoses3D:translations",
    "foxglove.Log": "TextLog:text",
}


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("viewers")
    # What `make fly` types, but for its length.
    with omit_pages():
        assert (
            run(
                ["loopback", "--udp", "--config", "room-hahn-stursberg", "--duration", "6", "--out", str(out), "--json"]
            )
            == 0
        )
    return out / "flight.mcap"


@pytest.fixture(scope="module")
def decoded(recording: Path) -> dict[str, list[tuple[str, int, Any]]]:
    found: defaultdict[str, list[tuple[str, int, Any]]] = defaultdict(list)
    for topic, schema, at_ns, message in read_protobuf(recording):
        found[topic].append((schema, at_ns, message))
    return found


@pytest.mark.slow
def test_mcap_decodes_every_message_of_every_topic(
    recording: Path, decoded: dict[str, list[tuple[str, int, Any]]]
) -> None:
    assert decoded.keys() == {view.name for view in VIEWS}
    schemas = {schema for messages in decoded.values() for schema, _, _ in messages}
    assert {name.removeprefix("foxglove.") for name in schemas if name.startswith("foxglove.")} == WELL_KNOWN
    assert {name.split(".")[0] for name in schemas} == {"foxglove", "uavctl"}
    counted = {one.topic: one.messages for one in read_info(recording).topics}
    assert {topic: len(messages) for topic, messages in decoded.items()} == {
        view.name: counted[view.name] for view in VIEWS
    }
    for messages in decoded.values():
        assert all(earlier[1] <= later[1] for earlier, later in pairwise(messages))


@pytest.mark.slow
def test_our_own_records_are_there_and_json(recording: Path) -> None:
    with recording.open("rb") as file:
        kinds: dict[str, set[str]] = defaultdict(set)
        for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages():
            kinds[channel.topic].add(channel.message_encoding)
            if channel.message_encoding == "json":
                assert schema is not None and isinstance(json.loads(message.data), dict)
    of_fleets = {topic.name for topic in TOPICS if topic.record.__module__ == "uavctl.fleet_records"}
    assert {topic.name for topic in TOPICS} - kinds.keys() <= SILENT | OF_SEVERAL | of_fleets
    assert all(len(encodings) == 1 for encodings in kinds.values())


def test_views_are_as_many_as_the_records_that_they_are_made_from(
    recording: Path, decoded: dict[str, list[tuple[str, int, Any]]]
) -> None:
    of = Counter(type(record) for _, _, record in read(recording))
    assert len(decoded["/view/estimate"]) == of[Estimate] > 100
    assert len(decoded["/plot/age"]) == of[Decision] > 100
    assert len(decoded["/plot/solve"]) == of[Plan] > 10


def test_views_at_most_double_the_file(recording: Path) -> None:
    sizes = {one.topic: one.bytes for one in read_info(recording).topics}
    made = sum(sizes[view.name] for view in VIEWS)
    assert made < sum(sizes.values()) - made


def make_mcap_reader(recording: Path, **options: Any) -> McapReader:
    """Import Rerun here: that takes a third of a second in each process that collects this file."""
    from rerun.chunk import McapReader

    return McapReader(recording, **options)


def test_rerun_loads_every_topic(recording: Path, decoded: dict[str, list[tuple[str, int, Any]]]) -> None:
    rows: Counter[str] = Counter()
    components: defaultdict[str, set[str]] = defaultdict(set)
    for chunk in make_mcap_reader(recording).stream().to_chunks():
        names = set(chunk.to_record_batch().schema.names)
        rows[chunk.entity_path] += chunk.num_rows if "message_log_time" in names else 0
        components[chunk.entity_path] |= names
    assert {one.topic for one in read_info(recording).topics} <= rows.keys()
    for view in VIEWS:
        assert rows[view.name] == len(decoded[view.name]), view.name
        assert DRAWN.get(view.schema_name, f"{view.schema_name}:message") in components[view.name]


def test_rerun_has_the_numbers_to_plot(recording: Path, decoded: dict[str, list[tuple[str, int, Any]]]) -> None:
    reader = make_mcap_reader(recording, include_topic_regex=["^/plot/age$", "^/view/estimate$"])
    ages: list[float] = []
    places: list[list[float]] = []
    for chunk in reader.stream().to_chunks():
        batch = chunk.to_record_batch()
        if "uavctl.AgePlot:message" in batch.schema.names:
            ages += [row[0]["limit_steps"] for row in batch.column("uavctl.AgePlot:message").to_pylist() if row]
        if "InstancePoses3D:translations" in batch.schema.names:
            places += [row[0] for row in batch.column("InstancePoses3D:translations").to_pylist() if row]
    assert ages == [message.limit_steps for _, _, message in decoded["/plot/age"]]
    want = [message.pose.position for _, _, message in decoded["/view/estimate"]]
    # Rerun keeps places as single floats
    assert places == [pytest.approx([one.x, one.y, one.z], rel=1e-6) for one in want]


def layout() -> dict[str, Any]:
    text = resources.files("logs").joinpath("foxglove-layout.json").read_text(encoding="utf-8")
    parsed: dict[str, Any] = json.loads(text)
    return parsed


def panels(node: Any) -> Iterator[str]:
    if isinstance(node, str):
        yield node
    else:
        yield from panels(node["first"])
        yield from panels(node["second"])


def test_layout_places_each_panel_once() -> None:
    found = layout()
    assert sorted(panels(found["layout"])) == sorted(found["configById"])
    kinds = Counter(name.partition("!")[0] for name in found["configById"])
    assert kinds["3D"] == 1 and kinds["Plot"] == 7 and kinds["StateTransitions"] == kinds["RosOut"] == 1


def test_every_topic_of_the_layout_is_in_the_file(decoded: dict[str, list[tuple[str, int, Any]]]) -> None:
    scene = layout()["configById"]["3D!room"]
    assert set(scene["topics"]) <= decoded.keys()
    assert {topic for topic, one in scene["topics"].items() if one["visible"]} >= {
        view.name for view in VIEWS if view.name.startswith("/view/scene/")
    }
    assert scene["followTf"] == decoded["/view/frames"][0][2].transforms[0].parent_frame_id
    assert layout()["configById"]["RosOut!events"]["topicToRender"] in decoded


@pytest.mark.parametrize("kind", ["Plot", "StateTransitions"])
def test_every_path_of_the_layout_is_a_field(kind: str, decoded: dict[str, list[tuple[str, int, Any]]]) -> None:
    paths = [
        path["value"]
        for name, config in layout()["configById"].items()
        if name.startswith(f"{kind}!")
        for path in config["paths"]
    ]
    assert len(paths) == len(set(paths)) >= 3
    for path in paths:
        topic, *fields = path.split(".")
        value = decoded[topic][-1][2]
        for field in fields:
            value = getattr(value, field)
        assert isinstance(value, (int, float) if kind == "Plot" else str), path


def test_the_command_line_prints_the_layout(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["log", "layout"]) == 0
    assert json.loads(capsys.readouterr().out) == layout()


def test_definitions_are_what_the_file_says(recording: Path) -> None:
    with recording.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    for channel in summary.channels.values():
        if channel.message_encoding == "protobuf":
            schema, want = summary.schemas[channel.schema_id], get_definition(channel.topic)
            assert (schema.name, schema.encoding, schema.data) == (want.schema_name, "protobuf", want.schema)
