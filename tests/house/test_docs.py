"""The pages of docs/ that are made from types and tables say what those do; tools/check.py has them up to date."""

from __future__ import annotations

import re

import msgspec

from docs import topics_page, transitions_list
from logs.recording.derived_topics import PLOTS, VIEWS
from logs.recording.topics import TOPICS
from uavctl.mavlink.handover_states import TRANSITIONS, HandoverState


def test_the_list_of_the_hand_over_has_every_transition_once() -> None:
    items = re.findall(r"^\* \*\*`(\w+)`\*\*: [^.]+\. (.+)\.$", transitions_list().replace("\n  ", " "), re.MULTILINE)
    ways = [
        (before, event, after)
        for before, cell in items
        for events, _, after in (way.partition(": ") for way in cell.split("; ") if ": " in way)
        for event in events.replace("`", "").split(", ")
    ]
    assert [before for before, _ in items] == [state.name for state in HandoverState]
    assert len(set(ways)) == len(ways)
    assert set(ways) == {
        (before.name, event, after.name) for (before, event), (after, _) in TRANSITIONS.items() if before is not after
    }


def read_section(page: str, topic: str) -> str:
    """The section of a topic, as one line."""
    assert page.count(f"## `{topic}`\n") == 1
    return " ".join(page.split(f"## `{topic}`\n")[1].split("\n#")[0].split())


def test_page_lists_every_topic_and_field() -> None:
    page = topics_page()
    for topic in TOPICS:
        section = read_section(page, topic.name)
        assert section.startswith(f"`{topic.record.__name__}`: {topic.text}. Fields: ")
        fields = re.findall(r"[ ;]`(\w+)`\??(?=[,;.])", section.partition(" Fields: ")[2])
        assert sorted(fields) == sorted(field.name for field in msgspec.structs.fields(topic.record))
    assert "; number[] `accel_mps2`; number `yaw_rad`?; `SetpointSource` `source`; " in read_section(
        page, "/uavctl/setpoint"
    )


def test_page_lists_every_topic_for_viewers_and_every_field_to_plot() -> None:
    page = topics_page()
    for view in VIEWS:
        if view.name in PLOTS.values():
            assert read_section(page, view.name).startswith(f"`{view.schema_name}`: {view.text}. Fields: ")
        else:
            assert page.count(f"| `{view.name}` | `{view.schema_name}` | {view.text} |") == 1
    for kind, name in PLOTS.items():
        section = read_section(page, name)
        for field in msgspec.structs.fields(kind):
            assert re.search(rf" `{field.name}`[,;.]", section)
