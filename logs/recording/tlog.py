"""Files `.tlog` of MAVLink: read, written, replayed; clocks of other programs."""

from __future__ import annotations

import heapq
import re
import struct
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

import msgspec
import numpy as np

from logs.recording.budget import read_whole
from logs.recording.export import Watch, count_messages, ignore_progress
from logs.recording.file_kind import describe_kind_error
from logs.recording.file_scan import RecordedMessage
from logs.recording.output_files import refuse_existing_files, remove_on_error, write_temporary_files
from logs.recording.reader import read_header, read_messages
from logs.recording.summary import count
from logs.recording.topics import parse_raw_topic
from uavctl.config.load import parse_stored_toml
from uavctl.errors import ConfigError, RecordingError, UsageError
from uavctl.loop import ControlLoop
from uavctl.mavlink.connection import STREAM_SCHEMES
from uavctl.mavlink.framing import is_frame
from uavctl.records import Decision, Header, LinkStats, PositionSample, Record, Sink, StepInput, discard

# Clocks are set by hand, by a GPS or by a server; what is no more than this is order, or a silence.
MAX_BACKSTEP_NS = 1_000_000_000
MAX_SILENCE_NS = 3600 * 1_000_000_000
_MIN_REPORTED_SILENCE_NS = 10_000_000_000  # a vehicle's heartbeats come once a second
_MAX_SAME_STAMPS = 200  # packets of one stamp: what a fast link brings within the 16 ms of a coarse clock is less


class MonotonicClock:
    """Clock that goes on steadily where the stamps of a recording leap.

    After a leap time goes on from the last one before it. When the stamps come back to what they were (a single one
    was wrong), so do the times. A stamp of zero among others is none: the time is that of the last.
    """

    def __init__(self) -> None:
        self._offset_ns = self._former_ns = 0
        self._last_ns: int | None = None  # the latest time given
        self._stamps = self._zeros = self._missing = self._backward = self._jumps = 0
        self._first_ns: int | None = None  # the first stamp
        self._same = True  # all stamps so far are that one
        self._farthest_ns = self._silence_ns = 0

    def can_follow(self, stamp_ns: int) -> bool:
        """Return whether a stamp may follow the others without a leap; not before the first."""
        return self._find_offset_ns(stamp_ns) is not None

    def convert(self, stamp_ns: int) -> int:
        """Return the steady time of a stamp [ns]; stamps come in the order of the recording."""
        self._stamps += 1
        self._zeros += stamp_ns == 0
        self._first_ns = stamp_ns if self._first_ns is None else self._first_ns
        self._same = self._same and stamp_ns == self._first_ns
        if self._last_ns is None:
            self._last_ns = stamp_ns
        offset_ns = self._find_offset_ns(stamp_ns)
        if offset_ns is None and stamp_ns == 0:
            self._missing += 1
            return self._last_ns
        if offset_ns is None:
            offset_ns = self._last_ns - stamp_ns
        if offset_ns != self._offset_ns:
            self._jumps += 1
            self._farthest_ns = max(self._farthest_ns, abs(offset_ns - self._offset_ns))
            self._former_ns, self._offset_ns = self._offset_ns, offset_ns
        at_ns = stamp_ns + offset_ns
        self._backward += at_ns < self._last_ns
        self._silence_ns = max(self._silence_ns, at_ns - self._last_ns)
        self._last_ns = max(self._last_ns, at_ns)
        return at_ns

    def check(self, name: str) -> None:
        """Refuse stamps that carry no time.

        Raises:
            RecordingError: There are several, and all are zero; or many, and all are the same.
        """
        if self._zeros == self._stamps > 1:
            raise RecordingError(
                f"{name}: all {self._stamps} time stamps are zero, so the times of packets are unknown"
            )
        if self._same and self._stamps > _MAX_SAME_STAMPS:
            raise RecordingError(
                f"{name}: all {self._stamps} time stamps are the same, so the times of packets are unknown"
            )

    def describe_oddities(self, name: str) -> tuple[str, ...]:
        """Return sentences on oddities of the stamps."""
        notes = []
        if self._jumps:
            notes.append(
                f"{name}: its clock jumps ({count(self._jumps, 'time')}, by up to {self._farthest_ns * 1e-9:.0f} s); "
                "the jumps are removed"
            )
        if self._missing:
            notes.append(f"{name}: {count(self._missing, 'time stamp')} of zero; replaced by the time before")
        if self._backward:
            notes.append(f"{name}: {count(self._backward, 'time stamp')} not in order; put in order")
        if self._silence_ns > _MIN_REPORTED_SILENCE_NS:
            notes.append(f"{name}: nothing in it for {self._silence_ns * 1e-9:.0f} s")
        return tuple(notes)

    def _find_offset_ns(self, stamp_ns: int) -> int | None:
        """Return which of the last two offsets a stamp fits [ns]; None if neither."""
        if self._last_ns is None:
            return None
        for offset_ns in (self._offset_ns, self._former_ns):
            if -MAX_BACKSTEP_NS <= stamp_ns + offset_ns - self._last_ns <= MAX_SILENCE_NS:
                return offset_ns
        return None


GROUND_SYSTEMS = frozenset({245, 255})  # our own system id, and that of ground stations
_STAMP = struct.Struct(">Q")
_OLD_STAMP = struct.Struct("<Q")  # as QGroundControl wrote them before 2014
# A stamp before a frame: its highest byte is zero up to the year 4253
_LIKELY = {_STAMP: re.compile(b"\0.{7}[\xfd\xfe]", re.DOTALL), _OLD_STAMP: re.compile(b".{7}\0[\xfd\xfe]", re.DOTALL)}
_STX_V1, _STX_V2 = MARKERS = 0xFE, 0xFD  # first byte of a frame
_ANY_MARKER = re.compile(b"[\xfd\xfe]")
_SIGNED = 0x01
_LAST_STAMP_US = 2**63 // 1000  # later ones have no place in 64 bits of nanoseconds
_PROBED_BYTES = 65_536  # of a file: enough to see whether its frames have stamps


@dataclass(frozen=True, slots=True)
class TlogPacket:
    """One packet; `outgoing` is guessed from its system id (one of a ground station counts as sent by us)."""

    at_ns: int  # since the epoch, up to a leap of the recorder's clock
    data: bytes
    outgoing: bool


@dataclass(frozen=True)
class Tlog:
    """Packets of a `.tlog` in order of time, and counts of the omissions."""

    packets: tuple[TlogPacket, ...]
    torn_bytes: int = 0  # of an unfinished packet at the end
    skipped_bytes: int = 0  # between packets
    clock_notes: tuple[str, ...] = ()

    def __iter__(self) -> Iterator[TlogPacket]:
        return iter(self.packets)

    @property
    def notes(self) -> tuple[str, ...]:
        """Return sentences on omissions, and on oddities of the clock."""
        notes = list(self.clock_notes)
        if self.skipped_bytes:
            notes.append(f"{count(self.skipped_bytes, 'byte')} between its packets left out: no packet with a stamp")
        if self.torn_bytes:
            notes.append(f"the recording is torn within a packet: its last {count(self.torn_bytes, 'byte')} left out")
        return tuple(notes)


def read_tlog(path: Path) -> Tlog:
    """Read all packets of a file; unknown message ids and bad checksums are left to the parser.

    Stamps are big-endian, or else little-endian where far more of the file is packets then.

    Raises:
        RecordingError: The file cannot be read, holds no packet, its packets have no stamps, or stamps without a time.
    """
    data = bytes(read_whole(path))
    cutter = _Cutter(data, _STAMP)
    note: tuple[str, ...] = ()
    if 2 * cutter.skipped_bytes > len(data) or not cutter.packets:
        other_cutter = _Cutter(data, _OLD_STAMP)
        if 2 * other_cutter.skipped_bytes < cutter.skipped_bytes or len(other_cutter.packets) > 2 * len(cutter.packets):
            cutter = other_cutter
            note = (f"{path.name}: its time stamps are little-endian, as QGroundControl wrote them before 2014",)
    if cutter.lacks_stamps():
        raise RecordingError(
            f"{path}: its MAVLink packets have no time stamps (the bytes of a link as they came, like MAVProxy's "
            ".tlog.raw), so their times are unknown; give the .tlog of that flight"
        )
    if not cutter.packets:
        raise RecordingError(
            f"{path}: no MAVLink packet with a time stamp in it; is it a .tlog?{describe_kind_error(path)}"
        )
    cutter.clock.check(str(path))
    return Tlog(
        sort_packets(cutter.packets),
        torn_bytes=cutter.torn_bytes,
        skipped_bytes=cutter.skipped_bytes,
        clock_notes=(*note, *cutter.clock.describe_oddities(path.name)),
    )


class _Cutter:
    """Bytes of a file cut into packets, each after its stamp.

    Args:
        data: the whole file.
        stamp: byte order of its stamps.
    """

    def __init__(self, data: bytes, stamp: struct.Struct) -> None:
        self._data, self._stamp = data, stamp
        self._first = 0  # where the first packet begins
        self.packets: list[TlogPacket] = []
        self.clock = MonotonicClock()
        self.skipped_bytes = self.torn_bytes = 0
        self._cut()

    def _cut(self) -> None:
        data, at = self._data, 0
        min_bytes = self._stamp.size + 3  # of a packet: enough to know its length
        while at + min_bytes <= len(data):
            begin = at + self._stamp.size
            length = get_frame_length(data, begin)
            end = begin + length
            stamp_us = self._stamp_us(at)
            expected = bool(length) and self.clock.can_follow(stamp_us * 1000)
            if expected and end > len(data):
                break
            if expected or (length and self._is_believed(stamp_us, begin, end)):
                self._first = self._first if self.packets else begin
                self.packets.append(make_packet(self.clock.convert(stamp_us * 1000), data[begin:end]))
                at = end
            else:
                likely = _LIKELY[self._stamp].search(data, at + 1)
                later = min(len(data) if likely is None else likely.start(), len(data) - min_bytes + 1)
                self.skipped_bytes += later - at
                at = later
        self.torn_bytes = len(data) - at

    def lacks_stamps(self) -> bool:
        """Return whether most frames follow each other without a stamp, by those near the first packet."""
        at, last = self._first, min(self._first + _PROBED_BYTES, len(self._data))
        frames = stamped = 0
        frame_end = -1  # the end of the frame before
        while (at := find_next_marker(self._data, at)) < last:
            end = at + get_frame_length(self._data, at)
            if end <= at or end > len(self._data) or not is_frame(self._data[at:end]):
                at += 1
                continue
            frames += 1
            stamped += at != frame_end
            at = frame_end = end
        return frames > 2 * stamped

    def _stamp_us(self, at: int) -> int:
        return int(self._stamp.unpack_from(self._data, at)[0])

    def _is_believed(self, stamp_us: int, begin: int, end: int) -> bool:
        """Return whether a packet with an unexpected stamp is real: by the packet after it, or by its checksum."""
        data = self._data
        if end > len(data) or stamp_us >= _LAST_STAMP_US:
            return False
        follows = get_frame_length(data, end + self._stamp.size) > 0
        if follows and abs(self._stamp_us(end) - stamp_us) * 1000 <= MAX_SILENCE_NS:
            return True
        return is_frame(data[begin:end])


def find_next_marker(data: bytes, start: int) -> int:
    """Return the index of the next byte that could begin a frame, or the end."""
    match = _ANY_MARKER.search(data, start)
    return len(data) if match is None else match.start()


def get_frame_length(data: bytes, at: int) -> int:
    """Return the length of the frame that begins at `at` by its head [bytes]; 0 if none does."""
    if at + 3 > len(data):
        return 0
    if data[at] == _STX_V2:
        return 12 + data[at + 1] + (13 if data[at + 2] & _SIGNED else 0)
    if data[at] == _STX_V1:
        return 8 + data[at + 1]
    return 0


def make_packet(at_ns: int, data: bytes) -> TlogPacket:
    """Return a packet with its direction guessed; one too short to name a system counts as incoming."""
    offset = 5 if data[0] == _STX_V2 else 3
    return TlogPacket(at_ns=at_ns, data=data, outgoing=len(data) > offset and data[offset] in GROUND_SYSTEMS)


def sort_packets(packets: list[TlogPacket]) -> tuple[TlogPacket, ...]:
    """Return packets in order of time; those of the same time keep their order."""
    return tuple(sorted(packets, key=lambda packet: packet.at_ns))


_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_HEAD_BYTES = 3  # of a packet: enough to know its length
_OUT_OF_ORDER_NS = 1_000_000_000  # packets are put in order of time over such a span


class ExportedTlog(msgspec.Struct, frozen=True, kw_only=True):
    """Result of an export as `.tlog`."""

    file: str
    packets: dict[str, int]  # by connection and direction
    left_out_bytes: int  # that are no packet: garbage, and packets that were cut


def export_tlog(
    flight: Path, file: Path, *, link: str | None = None, force: bool = False, watch: Watch = ignore_progress
) -> ExportedTlog:
    """Write the packets of all connections, or of one, in both directions.

    Packets with a wrong checksum or an unknown id are kept: a recording holds what crossed the connection.

    Raises:
        RecordingError: The recording cannot be read, has no header (which maps its times to UTC) or no packet, or the
            file cannot be written.
        UsageError: There is no such connection, or the file exists and is not to be overwritten.
    """
    first = read_header(flight)
    zero_utc_ns = find_utc_of_zero(flight, first)
    refuse_existing_files([file], force=force)
    packets: Counter[str] = Counter()
    raw = _Raw(_find_streams(first))
    with remove_on_error([file]), write_temporary_files([file]) as parts, parts[file].open("wb") as out:
        messages = watch(read_messages(flight), count_messages(flight), "writing")
        for at_ns, topic, packet in _merge_packets(raw.packets(messages, link)):
            out.write(_STAMP.pack((zero_utc_ns + at_ns) // 1000) + packet)
            packets[topic] += 1
        if link is not None and link not in raw.links:
            there = f"it has {', '.join(sorted(raw.links))}" if raw.links else "it has none"
            raise UsageError(f"{flight}: no bytes of a connection {link!r} in it; {there}")
        if not packets:
            raise RecordingError(f"{flight}: no MAVLink packet in it, so there is nothing to export")
    return ExportedTlog(file=str(file), packets=dict(sorted(packets.items())), left_out_bytes=raw.left_out_bytes)


class _Raw:
    """Cutter of the raw bytes of connections into packets.

    Args:
        streams: connections that carry a stream of bytes, whose chunks end anywhere.
    """

    def __init__(self, streams: frozenset[str]) -> None:
        self._streams = streams
        self._partial_packets: dict[str, bytes] = {}  # of a stream: the packet that its last chunk ended in
        self._skipped_bytes = 0
        self.links: set[str] = set()

    @property
    def left_out_bytes(self) -> int:
        """Return the number of bytes so far that were no packet."""
        return self._skipped_bytes + sum(map(len, self._partial_packets.values()))

    def packets(
        self, messages: Iterable[RecordedMessage], vehicle_link: str | None
    ) -> Iterator[tuple[int, str, bytes]]:
        """Yield time [ns], topic and bytes of each packet of the wanted connection, or of all."""
        for message in messages:
            topic = message.definition.topic
            raw = parse_raw_topic(topic)
            if raw is None:
                continue
            link, _ = raw
            self.links.add(link)
            if vehicle_link in (None, link):
                data = self._partial_packets.pop(topic, b"") + message.data
                yield from ((message.at_ns, topic, packet) for packet in self._cut(topic, data, link in self._streams))

    def _cut(self, topic: str, data: bytes, goes_on: bool) -> Iterator[bytes]:
        at = 0
        while at < len(data):
            end = _find_packet_end(data, at)
            if end is None and goes_on:
                self._partial_packets[topic] = data[at:]
                return
            if end is not None and end > at:
                yield data[at:end]
                at = end
            else:
                self._skipped_bytes += 1
                at += 1


def _find_packet_end(data: bytes, at: int) -> int | None:
    """Return where the packet that begins at `at` ends; `at` if none does, None if it goes on beyond the data.

    It is believed to be one if another follows, or nothing; else only by its checksum.
    """
    if data[at] not in MARKERS:
        return at
    if at + _HEAD_BYTES > len(data):
        return None
    end = at + get_frame_length(data, at)
    if end > len(data):
        return None
    is_packet = end == len(data) or data[end] in MARKERS or is_frame(data[at:end])
    return end if is_packet else at


def _merge_packets(packets: Iterable[tuple[int, str, bytes]]) -> Iterator[tuple[int, str, bytes]]:
    """Yield the packets in order of time: incoming and outgoing bytes are recorded separately."""
    waiting: list[tuple[int, int, str, bytes]] = []
    for number, (at_ns, topic, packet) in enumerate(packets):
        heapq.heappush(waiting, (at_ns, number, topic, packet))
        while waiting[0][0] < at_ns - _OUT_OF_ORDER_NS:
            first = heapq.heappop(waiting)
            yield first[0], first[2], first[3]
    yield from ((first[0], first[2], first[3]) for first in sorted(waiting))


def find_utc_of_zero(flight: Path, first: Header) -> int:
    """Return UTC of time 0 of a recording's clock [ns since the epoch]; of an older one by when it began.

    Raises:
        RecordingError: It does not say when it began.
    """
    if first.zero_utc_ns is not None:
        return first.zero_utc_ns
    try:
        began = datetime.fromisoformat(first.started_utc)
    except ValueError as error:
        raise RecordingError(f"{flight}: its header has no usable start time ({error})") from error
    began_us = ((began if began.tzinfo else began.replace(tzinfo=UTC)) - _EPOCH) // timedelta(microseconds=1)
    return began_us * 1000 - first.started_ns


def _find_streams(first: Header) -> frozenset[str]:
    """Return the connections that carry a stream of bytes, by the configuration that was flown."""
    try:
        urls = parse_stored_toml(first.config_toml, "configuration").get("daemon", {})
    except ConfigError:
        return frozenset()
    return frozenset(name for name, url in urls.items() if isinstance(url, str) and url.startswith(STREAM_SCHEMES))


class DelayQuantiles(msgspec.Struct, frozen=True, kw_only=True):
    """Quantiles of a delay."""

    min: float
    p05: float
    p50: float
    p95: float
    max: float


class ForeignReplay(msgspec.Struct, frozen=True, kw_only=True):
    """Result of a replay of another program's recording."""

    datagrams: int
    positions: int
    out_of_order: int
    accepted: int
    rejected: int
    ticks: int
    decisions: int
    solves: dict[str, int]
    modes: dict[str, int]
    left_out: dict[str, int]  # what the connection did not take, by reason
    age_ms: DelayQuantiles | None  # capture -> arrival, after clock conversion
    age_steps: dict[str, int]  # at Δt boundaries


class _Collector:
    """Sink that keeps the figures and drops the records."""

    def __init__(self) -> None:
        self.samples: list[PositionSample] = []
        self.decisions: list[Decision] = []
        self.stats: dict[str, LinkStats] = {}  # the last of each connection
        self.over = False  # the flight is, and only the counters are waited for

    def put(self, _topic: str, _at_ns: int, record: Record) -> None:
        if isinstance(record, LinkStats):
            self.stats[record.link] = record
        elif self.over:
            return
        elif isinstance(record, StepInput):
            self.samples.extend(record.samples)
        elif isinstance(record, Decision):
            self.decisions.append(record)


def replay_tlog(
    packets: Iterable[tuple[int, bytes]], make_loop: Callable[[Sink], ControlLoop], *, link: str, tick_ns: int
) -> ForeignReplay:
    """Feed incoming packets to a loop on a virtual grid of ticks.

    Args:
        packets: (arrival [ns], bytes) in order of arrival, without the client's own.
        make_loop: builds the loop around the given sink.
        link: name of the connection that they came over.
        tick_ns: grid of the control loop [ns].
    """
    collector = _Collector()
    loop = make_loop(collector)
    datagrams = tick = 0
    start_ns: int | None = None
    for at_ns, data in packets:
        start_ns = at_ns if start_ns is None else start_ns
        while start_ns + tick * tick_ns < at_ns:
            loop.tick(tick, start_ns + tick * tick_ns, discard)
            tick += 1
        loop.receive(link, data, at_ns)
        datagrams += 1
    if start_ns is None:
        return _summarise_delays(collector, link, datagrams, tick)
    end_ns = start_ns + tick * tick_ns
    loop.tick(tick, end_ns, discard)  # sees the last packets
    tick += 1
    collector.over, later = True, tick
    while collector.stats[link].at_ns < end_ns:  # they are told once a second
        loop.tick(later, start_ns + later * tick_ns, discard)
        later += 1
    return _summarise_delays(collector, link, datagrams, tick)


def _summarise_delays(collector: _Collector, link: str, datagrams: int, ticks: int) -> ForeignReplay:
    captured = np.array([s.captured_ns for s in collector.samples], dtype=np.int64)
    age_ms = np.array([(s.received_ns - s.captured_ns) * 1e-6 for s in collector.samples])
    boundaries = [d for d in collector.decisions if d.boundary]
    ages = Counter(d.age_steps for d in boundaries if d.age_steps is not None)
    return ForeignReplay(
        datagrams=datagrams,
        positions=len(captured),
        out_of_order=int(np.count_nonzero(np.diff(captured) < 0)),
        accepted=sum(d.accepted for d in collector.decisions),
        rejected=sum(d.rejected for d in collector.decisions),
        ticks=ticks,
        decisions=len(boundaries),
        solves=dict(Counter(d.solve.value for d in collector.decisions if d.solve is not None)),
        modes=dict(Counter(d.mode.value for d in collector.decisions)),
        left_out=dict(sorted(collector.stats[link].bad.items())) if link in collector.stats else {},
        age_ms=_compute_quantiles(age_ms),
        age_steps={str(age): count for age, count in sorted(ages.items())},
    )


def _compute_quantiles(values: np.ndarray[tuple[int], np.dtype[np.float64]]) -> DelayQuantiles | None:
    if not len(values):
        return None
    low, p05, p50, p95, high = (float(q) for q in np.quantile(values, [0.0, 0.05, 0.5, 0.95, 1.0]))
    return DelayQuantiles(min=low, p05=p05, p50=p50, p95=p95, max=high)
