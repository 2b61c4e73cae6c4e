"""What is in a recording: duration, topics, gaps, losses, and how it was made."""

from __future__ import annotations

import tomllib
from pathlib import Path

import msgspec

from logs.chunks import Damage, End, Message
from logs.encoding import decode
from logs.reader import segment_files, walk
from logs.topics import HEADER, LIBRARY, RECORDER, RecorderNote
from uavctl.data import Header, PolicyLibrary
from uavctl.errors import RecordingError

_OWN = (HEADER, LIBRARY, RECORDER)  # of the recording itself, not of the flight


class TopicInfo(msgspec.Struct, frozen=True, kw_only=True):
    """One topic's messages."""

    topic: str
    encoding: str
    messages: int
    bytes: int
    rate_hz: float  # mean, from first to last message; 0 with one message
    longest_gap_s: float  # between two messages in a row
    longest_gap_at_s: float  # its start, since the recording's first message


class Origin(msgspec.Struct, frozen=True, kw_only=True):
    """How the recording was made, from its header."""

    config: str
    seed: int
    command: str
    started_utc: str
    design_id: str
    library_id: str | None  # None if no policy library was flown with
    versions: dict[str, str]
    cpu: str


class LibraryInfo(msgspec.Struct, frozen=True, kw_only=True):
    """The policy library that the recording carries."""

    library_id: str
    bytes: int


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
    topics: tuple[TopicInfo, ...]
    origin: Origin | None  # None without a readable header
    library: LibraryInfo | None  # None without a readable policy library


class _Course:
    """One topic's times as they go by."""

    def __init__(self, message: Message) -> None:
        self.encoding = message.definition.encoding
        self.messages = self.bytes = self.gap_ns = 0
        self.first_ns = self.last_ns = self.gap_at_ns = message.at_ns

    def add(self, message: Message) -> None:
        if message.at_ns - self.last_ns > self.gap_ns:
            self.gap_ns, self.gap_at_ns = message.at_ns - self.last_ns, self.last_ns
        self.last_ns = message.at_ns
        self.messages += 1
        self.bytes += len(message.data)

    def info(self, topic: str, start_ns: int) -> TopicInfo:
        span_s = (self.last_ns - self.first_ns) * 1e-9
        return TopicInfo(
            topic=topic,
            encoding=self.encoding,
            messages=self.messages,
            bytes=self.bytes,
            rate_hz=(self.messages - 1) / span_s if span_s > 0 else 0.0,
            longest_gap_s=self.gap_ns * 1e-9,
            longest_gap_at_s=(self.gap_at_ns - start_ns) * 1e-9,
        )


def info(path: Path) -> RecordingInfo:
    """Summary of a recording, finished, torn or damaged.

    Raises:
        RecordingError: there is no such recording, it holds nothing, or a file of it is none.
    """
    courses: dict[str, _Course] = {}
    damage: list[str] = []
    finished = True
    missing = 0
    following: int | None = None
    note: RecorderNote | None = None
    origin: Origin | None = None
    library: LibraryInfo | None = None
    for item in walk(path):
        if isinstance(item, Damage):
            damage.append(str(item))
            continue
        if isinstance(item, End):
            finished &= item.finished
            continue
        missing += max(0, item.sequence - (following or 1))
        following = item.sequence + 1
        topic = item.definition.topic
        if item.repeated:
            continue
        courses.setdefault(topic, _Course(item)).add(item)
        if topic in _OWN:
            record = decode(topic, item.data, item.at_ns)
            note = record if isinstance(record, RecorderNote) else note
            origin = _origin(record) if isinstance(record, Header) else origin
            if isinstance(record, PolicyLibrary):
                library = LibraryInfo(library_id=record.library_id, bytes=len(record.data))
    if not courses and not damage:
        raise RecordingError(f"{path}: holds nothing; it is empty, or was ended before its first chunk was written")
    files = segment_files(path)
    flown = [one for topic, one in courses.items() if topic not in _OWN] or list(courses.values())
    start_ns = min((one.first_ns for one in flown), default=0)
    end_ns = max((one.last_ns for one in flown), default=0)
    return RecordingInfo(
        files=tuple(map(str, files)),
        bytes=sum(one.stat().st_size for one in files),
        finished=finished,
        damage=tuple(damage),
        messages=sum(one.messages for one in courses.values()),
        missing=missing,
        start_ns=start_ns,
        end_ns=end_ns,
        duration_s=(end_ns - start_ns) * 1e-9,
        dropped=0 if note is None else note.dropped,
        refused=0 if note is None else note.refused,
        failures=0 if note is None else note.failures,
        topics=tuple(courses[topic].info(topic, start_ns) for topic in sorted(courses)),
        origin=origin,
        library=library,
    )


def _origin(header: Header) -> Origin:
    try:
        name = str(tomllib.loads(header.config_toml).get("name", ""))
    except tomllib.TOMLDecodeError:
        name = ""
    return Origin(
        config=name,
        seed=header.seed,
        command=header.command,
        started_utc=header.started_utc,
        design_id=header.design_id,
        library_id=header.library_id,
        versions=header.versions,
        cpu=header.cpu,
    )
