"""The raw MAVLink of a recording as a `.tlog`: each packet after 8 bytes of big-endian microseconds since the epoch."""

from __future__ import annotations

import heapq
import struct
import tomllib
from collections import Counter
from collections.abc import Iterable, Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import msgspec

from logs.chunks import Message
from logs.export import Watch, known_number, unwatched
from logs.made_folders import all_or_none
from logs.outputs import check_free, unfinished
from logs.reader import good_messages, header
from logs.tlog import MARKERS, frame_length
from logs.topics import raw_link
from uavctl.data import Header
from uavctl.errors import RecordingError, UsageError
from uavctl.mavlink.framing import scan
from uavctl.mavlink.link import STREAM_SCHEMES

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_STAMP = struct.Struct(">Q")
_HEAD_BYTES = 3  # of a packet: enough to know its length
_OUT_OF_ORDER_NS = 1_000_000_000  # packets are put in order of time over such a span


class ExportedTlog(msgspec.Struct, frozen=True, kw_only=True):
    """What was written of a recording."""

    file: str
    packets: dict[str, int]  # by connection and direction
    left_out_bytes: int  # that are no packet: garbage, and packets that were cut


def export_tlog(
    flight: Path, file: Path, *, link: str | None = None, force: bool = False, watch: Watch = unwatched
) -> ExportedTlog:
    """Write the packets of all connections, or of one, in both directions.

    Packets with a wrong checksum or an unknown id are kept: a recording holds what crossed the connection.

    Raises:
        RecordingError: The recording cannot be read, has no header (which maps its times to UTC) or no packet, or the
            file cannot be written.
        UsageError: There is no such connection, or the file exists and is not to be overwritten.
    """
    first = header(flight)
    began_us = _began_us(flight, first)
    check_free([file], force=force)
    packets: Counter[str] = Counter()
    raw = _Raw(_streams(first))
    with all_or_none([file]), unfinished([file]) as parts, parts[file].open("wb") as out:
        messages = watch(good_messages(flight), known_number(flight), "writing")
        for at_ns, topic, packet in _in_order(raw.packets(messages, link)):
            out.write(_STAMP.pack(began_us + (at_ns - first.started_ns) // 1000) + packet)
            packets[topic] += 1
        if link is not None and link not in raw.links:
            there = f"it has {', '.join(sorted(raw.links))}" if raw.links else "it has none"
            raise UsageError(f"{flight}: no bytes of a connection {link!r} in it; {there}")
        if not packets:
            raise RecordingError(f"{flight}: no MAVLink packet in it, so there is nothing to export")
    return ExportedTlog(file=str(file), packets=dict(sorted(packets.items())), left_out_bytes=raw.left_out_bytes)


class _Raw:
    """Cuts the raw bytes of connections into packets.

    Args:
        streams: connections that carry a stream of bytes, whose chunks end anywhere.
    """

    def __init__(self, streams: frozenset[str]) -> None:
        self._streams = streams
        self._rest: dict[str, bytes] = {}  # of a stream: the packet that its last chunk ended in
        self._skipped_bytes = 0
        self.links: set[str] = set()

    @property
    def left_out_bytes(self) -> int:
        """Bytes so far that were no packet."""
        return self._skipped_bytes + sum(map(len, self._rest.values()))

    def packets(self, messages: Iterable[Message], wanted: str | None) -> Iterator[tuple[int, str, bytes]]:
        """Time [ns], topic and bytes of each packet of the wanted connection, or of all."""
        for message in messages:
            topic = message.definition.topic
            raw = raw_link(topic)
            if raw is None:
                continue
            link, _ = raw
            self.links.add(link)
            if wanted in (None, link):
                data = self._rest.pop(topic, b"") + message.data
                yield from ((message.at_ns, topic, packet) for packet in self._cut(topic, data, link in self._streams))

    def _cut(self, topic: str, data: bytes, goes_on: bool) -> Iterator[bytes]:
        at = 0
        while at < len(data):
            end = _packet_end(data, at)
            if end is None and goes_on:
                self._rest[topic] = data[at:]
                return
            if end is not None and end > at:
                yield data[at:end]
                at = end
            else:
                self._skipped_bytes += 1
                at += 1


def _packet_end(data: bytes, at: int) -> int | None:
    """Where the packet that begins at `at` ends; `at` if none does, None if it goes on beyond the data.

    It is believed to be one if another follows, or nothing; else only by its checksum.
    """
    if data[at] not in MARKERS:
        return at
    if at + _HEAD_BYTES > len(data):
        return None
    end = at + frame_length(data, at)
    if end > len(data):
        return None
    good = end == len(data) or data[end] in MARKERS or bool(scan(data[at:end], final=True).frames)
    return end if good else at


def _in_order(packets: Iterable[tuple[int, str, bytes]]) -> Iterator[tuple[int, str, bytes]]:
    """The packets in order of time: what comes in and what goes out is recorded each by itself."""
    waiting: list[tuple[int, int, str, bytes]] = []
    for number, (at_ns, topic, packet) in enumerate(packets):
        heapq.heappush(waiting, (at_ns, number, topic, packet))
        while waiting[0][0] < at_ns - _OUT_OF_ORDER_NS:
            first = heapq.heappop(waiting)
            yield first[0], first[2], first[3]
    yield from ((first[0], first[2], first[3]) for first in sorted(waiting))


def _began_us(flight: Path, first: Header) -> int:
    """When the recording began [µs since the epoch]."""
    try:
        began = datetime.fromisoformat(first.started_utc)
    except ValueError as error:
        raise RecordingError(f"{flight}: its header has no usable start time ({error})") from error
    return ((began if began.tzinfo else began.replace(tzinfo=UTC)) - _EPOCH) // timedelta(microseconds=1)


def _streams(first: Header) -> frozenset[str]:
    """Connections that carry a stream of bytes, by the configuration that was flown with."""
    try:
        urls = tomllib.loads(first.config_toml).get("daemon", {})
    except tomllib.TOMLDecodeError:
        return frozenset()
    return frozenset(name for name, url in urls.items() if isinstance(url, str) and url.startswith(STREAM_SCHEMES))
