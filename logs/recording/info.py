"""Contents of a recording: duration, topics, gaps, losses, and how it was made."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from datetime import UTC, datetime
from operator import itemgetter
from pathlib import Path

import msgspec

from logs.recording.design_view import get_config_name
from logs.recording.file_scan import AttachedFile, Damage, EndOfFile, RecordedMessage
from logs.recording.fleet_info import CoordinatorInfo, FleetAccount, SenderInfo
from logs.recording.notes import NoteKind, RecorderNote
from logs.recording.parameters import ParameterReader, VehicleParameter
from logs.recording.reader import find_segments, scan_recording
from logs.recording.topics import (
    COORDINATOR_HEADER,
    CYCLE,
    HEADER,
    LIBRARY,
    PARAMETER,
    RECORDER,
    SENDER_HEADER,
    SENT,
    decode,
    parse_raw_topic,
)
from uavctl.errors import RecordingError
from uavctl.records import Header, LinkEstimate, LinkStats, PolicyLibrary, Record, Refused, Truth

_OF_FLEETS = (SENDER_HEADER, SENT, COORDINATOR_HEADER, CYCLE)
_OWN = (HEADER, LIBRARY, RECORDER, SENDER_HEADER, COORDINATOR_HEADER)  # of the recording itself, not of the flight
_LOOKED_INTO = (HEADER, LIBRARY, RECORDER, "/uavctl/link", "/uavctl/refused")
_LATEST_ONLY = ("/uavctl/link_estimate", "/sim/truth")
_PLAIN_NOTES = (NoteKind.BEGIN, NoteKind.END)


class TopicInfo(msgspec.Struct, frozen=True, kw_only=True):
    """Messages of one topic."""

    topic: str
    encoding: str
    messages: int
    bytes: int
    rate_hz: float  # mean, from first to last message; 0 with one message
    longest_gap_s: float  # without a message, also before its first and after its last
    longest_gap_at_s: float  # its start, since the recording's first message


class RecordingOrigin(msgspec.Struct, frozen=True, kw_only=True):
    """How the recording was made, from its header."""

    config: str
    seed: int
    command: str
    started_utc: str
    design_id: str
    library_id: str | None  # None if no policy library was flown with
    versions: dict[str, str]
    cpu: str
    platform: str = ""
    zero_utc_ns: int | None = None  # UTC of time 0 of the recording's clock [ns since 1970]; None: not known


class LibraryInfo(msgspec.Struct, frozen=True, kw_only=True):
    """The policy library that the recording carries."""

    library_id: str
    bytes: int


class AttachmentInfo(msgspec.Struct, frozen=True, kw_only=True):
    """A file that the recording carries for other programs."""

    name: str
    media_type: str
    bytes: int


class SegmentInfo(msgspec.Struct, frozen=True, kw_only=True):
    """One file of the recording."""

    file: str
    bytes: int
    messages: int
    finished: bool  # it has its index and footer


class NoteInfo(msgspec.Struct, frozen=True, kw_only=True):
    """A note of the recorder: why a file was begun, that the disk got low, that records were lost."""

    at_s: float  # since the recording's first message
    text: str


class ConnectionInfo(msgspec.Struct, frozen=True, kw_only=True):
    """Counters of one connection at the end of the recording."""

    link: str
    datagrams: int
    messages: int
    samples: int  # positions
    bad: dict[str, int]  # what could not be used, by reason
    refused: dict[str, int]  # what was dropped unread, by reason


class PositionLoss(msgspec.Struct, frozen=True, kw_only=True):
    """Share of steps without a new position, on the link that carries the positions."""

    believed: float | None  # at the end: mean of its posterior; None if there was no estimate
    below_promise: bool  # at the end: worse than the design counts on
    bursts: bool  # at the end: losses do not come one by one
    simulated_sent: int | None  # positions that the simulator sent; None for a real flight
    simulated_lost: int | None  # of which its channel lost


class RecordingInfo(msgspec.Struct, frozen=True, kw_only=True):
    """Summary of a recording."""

    files: tuple[str, ...]
    bytes: int
    finished: bool  # every file has its index and footer
    damage: tuple[str, ...]  # damaged or torn places, in words
    messages: int
    missing: int  # by the messages' running numbers
    start_ns: int
    end_ns: int
    duration_s: float
    dropped: int  # records that the recorder had to drop
    refused: int  # records that it could not encode
    failures: int  # failed writes
    segments: tuple[SegmentInfo, ...]
    notes: tuple[NoteInfo, ...]  # without those of every recording, of begin and end
    connections: tuple[ConnectionInfo, ...]
    position_loss: PositionLoss
    topics: tuple[TopicInfo, ...]
    origin: RecordingOrigin | None  # None without a readable header
    library: LibraryInfo | None  # None without a readable policy library
    begin_utc: str | None = None  # of the first message; None if the recording does not tell
    attachments: tuple[AttachmentInfo, ...] = ()
    parameters: dict[str, VehicleParameter] = {}  # of the vehicle, as it told them
    parameter_count: int | None = None  # parameters that it says it has
    sender: SenderInfo | None = None  # of `sender.mcap`
    coordinator: CoordinatorInfo | None = None  # of `coordinator.mcap`


class _TopicTimes:
    """Times of one topic's messages, taken one by one."""

    def __init__(self, message: RecordedMessage) -> None:
        self.encoding = message.definition.encoding
        self.messages = self.bytes = self.gap_ns = 0
        self.first_ns = self.last_ns = self.gap_at_ns = message.at_ns

    def add(self, message: RecordedMessage) -> None:
        if message.at_ns - self.last_ns > self.gap_ns:
            self.gap_ns, self.gap_at_ns = message.at_ns - self.last_ns, self.last_ns
        self.last_ns = message.at_ns
        self.messages += 1
        self.bytes += len(message.data)

    def info(self, topic: str, start_ns: int, end_ns: int) -> TopicInfo:
        span_s = (self.last_ns - self.first_ns) * 1e-9
        gaps = [(self.gap_ns, self.gap_at_ns)]
        if topic not in _OWN:  # what begins late, or falls silent before the end, was missing there
            gaps += [(self.first_ns - start_ns, start_ns), (end_ns - self.last_ns, self.last_ns)]
        gap_ns, gap_at_ns = max(gaps, key=itemgetter(0))
        return TopicInfo(
            topic=topic,
            encoding=self.encoding,
            messages=self.messages,
            bytes=self.bytes,
            rate_hz=round((self.messages - 1) / span_s, 6) if span_s > 0 else 0.0,
            longest_gap_s=gap_ns * 1e-9,
            longest_gap_at_s=(gap_at_ns - start_ns) * 1e-9,
        )


@dataclass
class _Segment:
    path: Path
    messages: int = 0
    finished: bool = False


class _Account:
    """Notes of the recorder and counters of the links, taken record by record."""

    def __init__(self) -> None:
        self.note: RecorderNote | None = None
        self.notes: list[tuple[int, str]] = []
        self.origin: RecordingOrigin | None = None
        self.library: LibraryInfo | None = None
        self._stats: dict[str, LinkStats] = {}
        self._refused: dict[str, Counter[str]] = {}
        self._estimate: LinkEstimate | None = None
        self._truth: Truth | None = None

    def add(self, record: Record) -> None:
        match record:
            case RecorderNote():
                self.note = record
                if record.kind not in _PLAIN_NOTES:
                    self.notes.append((record.at_ns, record.text))
            case Header():
                self.origin = _get_origin(record)
            case PolicyLibrary():
                self.library = LibraryInfo(library_id=record.library_id, bytes=len(record.data))
            case LinkStats():
                self._stats[record.link] = record
            case Refused():
                self._refused.setdefault(record.link, Counter()).update(record.counts)
            case LinkEstimate():
                self._estimate = record
            case Truth():
                self._truth = record

    def connections(self) -> tuple[ConnectionInfo, ...]:
        return tuple(
            ConnectionInfo(
                link=link,
                datagrams=0 if stats is None else stats.datagrams,
                messages=0 if stats is None else stats.messages,
                samples=0 if stats is None else stats.samples,
                bad={} if stats is None else stats.bad,
                refused=dict(self._refused.get(link, {})),
            )
            for link in sorted({*self._stats, *self._refused})
            for stats in [self._stats.get(link)]
        )

    def position_loss(self) -> PositionLoss:
        estimate, truth = self._estimate, self._truth
        return PositionLoss(
            believed=None if estimate is None else 1.0 - estimate.arrival_mean,
            below_promise=estimate is not None and estimate.below_promise,
            bursts=estimate is not None and estimate.bursts,
            simulated_sent=None if truth is None else truth.sent,
            simulated_lost=None if truth is None else truth.lost,
        )


def read_info(path: Path) -> RecordingInfo:
    """Summarise a recording, be it finished, torn or damaged.

    Raises:
        RecordingError: there is no such recording, it holds nothing, or a file of it is none.
    """
    courses: dict[str, _TopicTimes] = {}
    damage: list[str] = []
    missing = 0
    following: int | None = None
    zero_utc_ns = 0
    account, fleet = _Account(), FleetAccount()
    newest: dict[str, RecordedMessage] = {}
    attachments: dict[str, AttachmentInfo] = {}  # each file of the recording has them, the last one all
    parameters = ParameterReader()
    segments = [_Segment(file) for file in find_segments(path)]
    ended = 0
    for item in scan_recording(path):
        if isinstance(item, Damage):
            damage.append(str(item))
            continue
        if isinstance(item, EndOfFile):
            segments[ended].finished = item.finished
            ended += 1
            continue
        if isinstance(item, AttachedFile):
            attachments[item.name] = AttachmentInfo(name=item.name, media_type=item.media_type, bytes=item.bytes)
            continue
        missing += max(0, item.sequence - (following or 1))
        following = item.sequence + 1
        segments[ended].messages += 1
        topic = item.definition.topic
        if item.repeated:
            continue
        courses.setdefault(topic, _TopicTimes(item)).add(item)
        if topic in _LOOKED_INTO:
            account.add(decode(topic, item.data, item.at_ns))
        elif topic in _OF_FLEETS:
            fleet.add(item.at_ns, decode(topic, item.data, item.at_ns))
        elif topic in _LATEST_ONLY:
            newest[topic] = item
        elif topic == PARAMETER or parse_raw_topic(topic) is not None:
            parameters.take(decode(topic, item.data, item.at_ns))
        zero_utc_ns = item.zero_utc_ns
    for topic, item in newest.items():
        account.add(decode(topic, item.data, item.at_ns))
    if not courses and not damage:
        raise RecordingError(f"{path}: holds nothing; it is empty, or was ended before its first chunk was written")
    flown = [topic_counts for topic, topic_counts in courses.items() if topic not in _OWN] or list(courses.values())
    start_ns = min((decision.first_ns for decision in flown), default=0)
    end_ns = max((decision.last_ns for decision in flown), default=0)
    note = account.note
    files = tuple(
        SegmentInfo(
            file=str(segment.path),
            bytes=segment.path.stat().st_size,
            messages=segment.messages,
            finished=segment.finished,
        )
        for segment in segments
    )
    return RecordingInfo(
        files=tuple(segment.file for segment in files),
        bytes=sum(segment.bytes for segment in files),
        finished=all(segment.finished for segment in files),
        damage=tuple(damage),
        messages=sum(course.messages for course in courses.values()),
        missing=missing,
        start_ns=start_ns,
        end_ns=end_ns,
        duration_s=(end_ns - start_ns) / 1e9,
        dropped=0 if note is None else note.dropped,
        refused=0 if note is None else note.refused,
        failures=0 if note is None else note.failures,
        segments=files,
        notes=tuple(NoteInfo(at_s=(at_ns - start_ns) * 1e-9, text=text) for at_ns, text in account.notes),
        connections=account.connections(),
        position_loss=account.position_loss(),
        topics=tuple(courses[topic].info(topic, start_ns, end_ns) for topic in sorted(courses)),
        origin=account.origin,
        library=account.library,
        begin_utc=_format_utc(start_ns + zero_utc_ns) if zero_utc_ns else None,
        attachments=tuple(attachments.values()),
        parameters=parameters.parameters(),
        parameter_count=parameters.count,
        sender=fleet.make_sender(),
        coordinator=fleet.make_coordinator(),
    )


def _format_utc(utc_ns: int) -> str:
    return datetime.fromtimestamp(utc_ns // 1_000_000 / 1000, UTC).isoformat(timespec="milliseconds")


def _get_origin(header: Header) -> RecordingOrigin:
    copied = {key: getattr(header, key) for key in RecordingOrigin.__struct_fields__ if key != "config"}
    return RecordingOrigin(config=get_config_name(header) or "", **copied)
