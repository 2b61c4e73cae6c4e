"""A short flight's records, and its file as `uavctl loopback` writes it, for the tests of what viewers get."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

from loopback_rig import MemorySink, lockstep
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from logs.recording.recorder import DerivedTopics, SyncRecorder
from logs.recording.views import ViewBuilder
from uavctl.records import Decision, Timing

SECONDS = 6.0


@cache
def fly_view() -> MemorySink:
    """Six seconds in the room, with times as a shell measures them."""
    memory = lockstep("room-hahn-stursberg", SECONDS, "solver.method=exact")
    for decision in memory.of(Decision):
        timing = Timing(tick=decision.tick, at_ns=decision.at_ns, lateness_ns=1500, step_ns=250_000, send_ns=400_000)
        memory.put("/uavctl/timing", decision.at_ns, timing)
    memory.entries.sort(key=lambda entry: entry[1])
    return memory


def record(path: Path) -> Path:
    """The flight's file."""
    recorder = SyncRecorder(path, derived_topics=DerivedTopics(ViewBuilder()))
    for entry in fly_view().entries:
        recorder.put(*entry)
    status = recorder.close()
    assert status.ok and not status.unseen
    return path


def read_protobuf(path: Path) -> Iterator[tuple[str, str, int, Any]]:
    """Topic, schema name, log time and decoded message of each protobuf message, through the reader of others."""
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        names = [c.topic for c in reader.get_summary().channels.values() if c.message_encoding == "protobuf"]  # type: ignore[union-attr]
        for schema, channel, message, decoded in reader.iter_decoded_messages(topics=names):
            assert schema is not None
            yield channel.topic, schema.name, message.log_time, decoded
