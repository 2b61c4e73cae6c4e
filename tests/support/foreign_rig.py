"""Recordings as other programs make them, and what the controller of preset `room` makes of one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path

from mcap.writer import Writer
from places import DATA

from logs.recording.tlog import ForeignReplay, TlogPacket, read_tlog, replay_tlog
from uavctl.config import load_config
from uavctl.loop import ControlLoop
from uavctl.mavlink.connection import VEHICLE
from uavctl.wiring.controller import build_controller

TLOGS = ("arducopter-vicon.tlog", "px4-offboard.tlog", "hand-over-arducopter-gps.tlog")
Row = tuple[str, str, int, bytes]  # topic, encoding, log time, message
Described = tuple[str, str, str]  # name, encoding and text of a schema


def write(
    path: Path,
    rows: list[Row],
    *,
    finish: bool = True,
    schemas: Mapping[str, Described] | None = None,
    publish_ns: int | None = None,
    **options: object,
) -> Path:
    """An MCAP by the official writer; schemas by topic."""
    with path.open("wb") as file:
        writer = Writer(file, **options)  # type: ignore[arg-type]
        writer.start(profile="", library="another program")
        channels: dict[tuple[str, str], int] = {}
        for number, (topic, encoding, at_ns, data) in enumerate(rows):
            if (topic, encoding) not in channels:
                schema_id = 0
                if schemas and topic in schemas:
                    name, kind, text = schemas[topic]
                    schema_id = writer.register_schema(name, kind, text.encode())
                channels[topic, encoding] = writer.register_channel(topic, encoding, schema_id=schema_id)
            writer.add_message(
                channels[topic, encoding], at_ns, data, at_ns if publish_ns is None else publish_ns, number
            )
        if finish:
            writer.finish()  # type: ignore[no-untyped-call]
    return path


def rows_of(tlog: str, topic: str = "/mavlink", encoding: str = "mavlink") -> list[Row]:
    return [(topic, encoding, packet.at_ns, packet.data) for packet in read_tlog(DATA / tlog)]


def flown(packets: tuple[TlogPacket, ...]) -> ForeignReplay:
    config = load_config("room-hahn-stursberg", ["daemon.vehicle=tlog", "daemon.mocap=tlog", "solver.method=exact"])
    incoming = [(packet.at_ns, packet.data) for packet in packets if not packet.outgoing]
    controller = replace(build_controller(config), envelope=None)  # as `uavctl log replay` does: others flew it
    return replay_tlog(
        incoming, lambda sink: ControlLoop(config, controller, sink, lambda: 0), link=VEHICLE, tick_ns=50_000_000
    )


@cache
def replay_as_tlog(name: str) -> ForeignReplay:
    return flown(read_tlog(DATA / name).packets)
