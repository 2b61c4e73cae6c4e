"""A recording's bounded queue and its files, one after the other.

A record that cannot be kept is counted, and the count is part of the recording. After a failed
write the file is closed as well as possible and a new one begun (name-2.mcap ...) once the disk
takes it; records wait for that in the queue, as long as there is room in it.
"""

from __future__ import annotations

import contextlib
import threading
from collections import deque
from collections.abc import Callable
from pathlib import Path

import msgspec

from logs.disk import OutputFile, later_segments, segment_path
from logs.encoding import encode
from logs.segment import Entry, Segment
from logs.topics import HEADER, LIBRARY, RECORDER, RecorderNote, definition, record_type
from uavctl.data import Datagram, Record, raw_topic
from uavctl.errors import RecordingError

SYNC_S = 1.0
RETRY_S = 1.0
LAST_TRIES = 3  # files that closing may begin on a failing disk
_MAX_TIME_NS = 2**64 - 1


class RecorderStatus(msgspec.Struct, frozen=True, kw_only=True):
    """How a recorder is doing."""

    ok: bool  # the disk takes records, and none was lost
    written: int  # records on the disk
    waiting: int  # records in memory
    dropped: int  # records that found the queue full, or came after the end
    refused: int  # records that could not be encoded
    failures: int  # failed writes
    reason: str  # of the newest failed write; "" while there was none
    refusal: str  # of the newest refused record
    bytes: int  # on the disk
    segments: tuple[str, ...]  # files with at least one chunk


class Journal:
    """Bounded queue in front of the segments; nothing raises once it is made.

    `append` and `status` may be called beside a thread that runs the other methods.

    Args:
        path: file of the recording; it and its later segments must not exist yet.
        chunk_bytes: largest chunk [bytes].
        queue: records that may wait for the disk.
        open_file: opens a new file.
        clock: wall time [s].

    Raises:
        RecordingError: the name is taken, or the folder cannot be made.
    """

    def __init__(
        self,
        path: Path,
        chunk_bytes: int,
        queue: int,
        open_file: Callable[[Path], OutputFile],
        clock: Callable[[], float],
    ) -> None:
        taken = [one for one in (path, *later_segments(path)) if one.exists()]
        if taken:
            raise RecordingError(f"{taken[0]} exists and a recording never overwrites; choose another name")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise RecordingError(f"{path.parent}: {error.strerror}; choose another folder") from error
        self._path, self._chunk_bytes, self._limit = path, chunk_bytes, queue
        self._open_file, self._clock = open_file, clock
        self._queue: deque[tuple[str, int, Record]] = deque()
        self._unwritten: deque[tuple[str, int, bytes]] = deque()  # of a failed chunk; they go first
        self._segment: Segment | None = None
        self._preface = 0  # records at the start of this segment that only repeat
        self._number = 1
        self._sequence = 0
        self._repeats: dict[str, bytes] = {}  # header and library, for each segment
        self._at_ns = 0
        self._next_sync_s = clock() + SYNC_S
        self._retry_s = clock()
        self._noted = (0, 0)  # dropped and refused, as last written down
        self._done: list[tuple[Path, int, int]] = []  # closed segments: file, messages, bytes
        self._drop_lock = threading.Lock()
        self._dropped = 0
        self._refused = 0
        self._failures = 0
        self._reason = ""
        self._refusal = ""
        self.closed = False

    @property
    def queued(self) -> int:
        """Records in the queue."""
        return len(self._queue)

    def append(self, topic: str, at_ns: int, record: Record) -> None:
        """Queue a record, or count it as dropped."""
        if self.closed or len(self._queue) >= self._limit:
            with self._drop_lock:
                self._dropped += 1
        else:
            self._queue.append((topic, at_ns, record))

    def drain(self, most: int) -> None:
        """Write up to `most` of the waiting records; once a second see to it that the disk has them."""
        try:
            if not self._ready():
                return
            while self._unwritten:
                self._write(*self._unwritten.popleft())
            for _ in range(min(most, len(self._queue))):
                self._take(*self._queue.popleft())
            if self._clock() >= self._next_sync_s:
                self._next_sync_s = self._clock() + SYNC_S
                self._note_losses()
                self._open_segment().sync()
        except OSError as error:
            self._fail(error)

    def finish(self) -> None:
        """Write all that waits and close the file; after a failed write, in a new file."""
        self.closed = True
        for _ in range(LAST_TRIES):
            self._retry_s = self._clock()
            self.drain(self._limit)
            if self._segment is not None:
                self._finish_segment(self._segment)

    def status(self) -> RecorderStatus:
        """How it is doing."""
        segment = self._segment
        parts = [*self._done]
        if segment is not None and segment.bytes:
            parts.append((segment_path(self._path, self._number), segment.messages, segment.bytes))
        waiting = len(self._queue) + len(self._unwritten) + (0 if segment is None else len(segment.open_entries))
        lost = self._dropped + self._refused + (waiting if self.closed else 0)
        stuck = bool(self._failures) and not self.closed and (segment is None or not segment.bytes)
        return RecorderStatus(
            ok=not lost and not stuck,
            written=sum(messages for _, messages, _ in parts),
            waiting=waiting,
            dropped=self._dropped,
            refused=self._refused,
            failures=self._failures,
            reason=self._reason,
            refusal=self._refusal,
            bytes=sum(size for _, _, size in parts),
            segments=tuple(str(path) for path, _, _ in parts),
        )

    def _ready(self) -> bool:
        """Whether there is a segment to write to; begins one if something waits for it."""
        if self._segment is not None:
            return True
        if not (self._queue or self._unwritten) or self._clock() < self._retry_s:
            return False
        self._segment = Segment(self._open_file(segment_path(self._path, self._number)), self._chunk_bytes)
        self._preface = 0
        if self._number > 1:
            self._preface = 1 + len(self._repeats)
            if HEADER in self._repeats:
                self._write(HEADER, self._at_ns, self._repeats[HEADER])
            self._write_note(f"after a failed write: {self._reason}")
            if LIBRARY in self._repeats:
                self._write(LIBRARY, self._at_ns, self._repeats[LIBRARY])
        return True

    def _take(self, topic: str, at_ns: int, record: Record) -> None:
        if isinstance(record, Datagram):
            at_ns = record.at_ns  # the log time is the only place that keeps it
        try:
            data = _checked(topic, at_ns, record)
        except RecordingError as error:
            self._refused += 1
            self._refusal = str(error)
            return
        self._at_ns = at_ns
        if topic in (HEADER, LIBRARY):
            self._repeats[topic] = data
        self._write(topic, at_ns, data)
        if topic == HEADER:
            self._write_note("begin")
        if topic in (HEADER, LIBRARY):
            self._open_segment().commit()

    def _write(self, topic: str, at_ns: int, data: bytes) -> None:
        self._sequence += 1
        self._open_segment().add(Entry(definition(topic), self._sequence, at_ns, data))

    def _open_segment(self) -> Segment:
        assert self._segment is not None  # _ready() saw to it
        return self._segment

    def _note_losses(self) -> None:
        if (self._dropped, self._refused) != self._noted:
            self._write_note("records lost" + (f"; newest refusal: {self._refusal}" if self._refusal else ""))

    def _write_note(self, text: str) -> None:
        self._noted = (self._dropped, self._refused)
        note = RecorderNote(
            at_ns=self._at_ns,
            segment=self._number,
            written=self._sequence,
            dropped=self._dropped,
            refused=self._refused,
            failures=self._failures,
            text=text,
        )
        self._write(RECORDER, self._at_ns, encode(note))

    def _finish_segment(self, segment: Segment) -> None:
        try:
            self._write_note("end")
            segment.finish()
        except OSError as error:
            self._fail(error)
        else:
            self._retire(segment)

    def _fail(self, error: OSError) -> None:
        self._failures += 1
        self._reason = str(error)
        self._retry_s = self._clock() + RETRY_S
        segment = self._segment
        if segment is None:
            return  # it could not even be opened
        self._sequence -= len(segment.open_entries)  # they are numbered anew
        kept = segment.open_entries[max(0, self._preface - segment.messages) :]
        self._unwritten.extendleft((one.definition.topic, one.at_ns, one.data) for one in reversed(kept))
        # what abandon cannot do is no second alarm: whole chunks are readable without it
        with contextlib.suppress(OSError):
            segment.abandon()
        self._retire(segment)

    def _retire(self, segment: Segment) -> None:
        path = segment_path(self._path, self._number)
        if segment.bytes:
            self._done.append((path, segment.messages, segment.bytes))
            self._number += 1
        else:
            try:
                path.unlink(missing_ok=True)
            except OSError:
                self._number += 1  # the name stays taken
        self._segment = None


def _checked(topic: str, at_ns: int, record: Record) -> bytes:
    """Encoded record, if a reader will get it back from under this topic and time."""
    try:
        expected = record_type(topic)
    except KeyError:
        raise RecordingError(f"there is no topic {topic}") from None
    if type(record) is not expected:
        raise RecordingError(f"topic {topic} takes {expected.__name__}, not {type(record).__name__}")
    if isinstance(record, Datagram) and topic != raw_topic(record.link, outgoing=record.outgoing):
        raise RecordingError(f"topic {topic} is not that of connection {record.link}")
    if not 0 <= at_ns <= _MAX_TIME_NS:
        raise RecordingError(f"topic {topic}: time {at_ns} ns does not fit a recording")
    return encode(record)
