"""A recording's bounded queue and its files, one after the other.

A record that cannot be kept is counted, and the count is part of the recording. A file that has
grown to its size is closed and the next one begun (name-2.mcap ...). So it is after a failed write,
as well as possible and once the disk takes it; records wait for that in the queue, as long as there
is room in it. Before the disk is full the file is closed in order, and recording rests.
"""

from __future__ import annotations

import contextlib
import threading
from collections import deque
from collections.abc import Callable
from pathlib import Path

import msgspec

from logs.disk import OutputFile, RoomWatch, later_segments, segment_path
from logs.encoding import encode, encode_message
from logs.onlookers import Onlookers
from logs.segment import Entry, Segment
from logs.topics import HEADER, LIBRARY, RECORDER, RecorderNote, definition
from uavctl.config.log import LogConfig
from uavctl.data import Datagram, Record
from uavctl.errors import RecordingError

LOOK_S = 1.0  # between two syncs, and looks at the disk's room
RETRY_S = 1.0
LAST_TRIES = 3  # files that closing may begin on a failing disk


class RecorderStatus(msgspec.Struct, frozen=True, kw_only=True):
    """How a recorder is doing."""

    ok: bool  # the disk takes records, and none was lost
    written: int  # records on the disk
    waiting: int  # records in memory
    dropped: int  # records that found the queue full, or came after the end
    refused: int  # records that could not be encoded
    failures: int  # failed writes
    reason: str  # of the newest failed write, or rest; "" while there was none
    refusal: str  # of the newest refused record
    bytes: int  # on the disk
    segments: tuple[str, ...]  # files with at least one chunk
    warning: str = ""  # the disk gets low
    unseen: int = 0  # records of which no messages for viewers could be made; they are in the recording


class Journal:
    """Bounded queue in front of the segments; nothing raises once it is made.

    `append` and `status` may be called beside a thread that runs the other methods.

    Args:
        path: file of the recording; it and its later segments must not exist yet.
        log: sizes of chunks, files and queue; free space to keep.
        open_file: opens a new file.
        free: gives the free space of a folder [bytes], or None.
        clock: wall time [s].
        onlookers: makes what is written beside the records for viewers.

    Raises:
        RecordingError: the name is taken, or the folder cannot be made.
    """

    def __init__(
        self,
        path: Path,
        log: LogConfig,
        open_file: Callable[[Path], OutputFile],
        free: Callable[[Path], int | None],
        clock: Callable[[], float],
        onlookers: Onlookers,
    ) -> None:
        taken = [one for one in (path, *later_segments(path)) if one.exists()]
        if taken:
            raise RecordingError(f"{taken[0]} exists and a recording never overwrites; choose another name")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise RecordingError(f"{path.parent}: {error.strerror}; choose another folder") from error
        self._path, self._log = path, log
        self._room = RoomWatch(path.parent, free, log.low_bytes, log.stop_bytes)
        self._room.look()
        self._open_file, self._clock = open_file, clock
        self._onlookers = onlookers
        self._queue: deque[tuple[str, int, Record]] = deque()
        self._unwritten: deque[tuple[str, int, bytes]] = deque()  # of a failed chunk, or made for viewers; go first
        self._segment: Segment | None = None
        self._preface = 0  # records at the start of this segment that only repeat
        self._because = ""  # why the next segment is begun
        self._number = 1
        self._sequence = 0
        self._repeats: dict[str, bytes] = {}  # header and library, for each segment
        self._repeats_bytes = 0
        self._at_ns = 0
        self._next_look_s = clock() + LOOK_S
        self._retry_s = clock()
        self._noted = (0, 0)  # dropped and refused, as last written down
        self._told_low = False
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
        if self.closed or len(self._queue) >= self._log.queue:
            with self._drop_lock:
                self._dropped += 1
        else:
            self._queue.append((topic, at_ns, record))

    def drain(self, most: int) -> None:
        """Write up to `most` of the waiting records; once a second see to it that the disk has them."""
        due = self._clock() >= self._next_look_s
        if due:
            self._next_look_s = self._clock() + LOOK_S
            self._room.look()
            self._rest()
        try:
            if self._unwritten and self._ready():
                self._write_unwritten()
            for _ in range(min(most, len(self._queue))):
                if not self._ready():
                    return
                self._take(*self._queue.popleft())
                self._write_unwritten()
            if due and self._segment is not None:
                self._note_news()
                self._open_segment().sync()
        except OSError as error:
            self._fail(error)

    def finish(self) -> None:
        """Write all that waits and close the file; after a failed write, in a new file."""
        self.closed = True
        for _ in range(LAST_TRIES):
            self._retry_s = self._clock()
            self.drain(self._log.queue)
            if self._segment is not None:
                self._finish_segment(self._segment, "end")

    def status(self) -> RecorderStatus:
        """How it is doing."""
        segment = self._segment
        parts = [*self._done]
        if segment is not None and segment.bytes:
            parts.append((segment_path(self._path, self._number), segment.messages, segment.bytes))
        waiting = len(self._queue) + len(self._unwritten) + (0 if segment is None else len(segment.open_entries))
        lost = self._dropped + self._refused + (waiting if self.closed else 0)
        stuck = bool(self._reason) and not self.closed and (segment is None or not segment.bytes)
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
            warning=self._room.text if self._room.low else "",
            unseen=self._onlookers.unseen,
        )

    def _ready(self) -> bool:
        """Whether there is a segment to write to; begins one if something waits for it."""
        segment = self._segment
        waits = bool(self._queue or self._unwritten)
        if segment is not None and waits and self._is_full(segment):
            self._because = f"goes on after {segment_path(self._path, self._number).name}"
            self._finish_segment(segment, "goes on in the next file")
        if self._segment is not None:
            return True
        if not waits or self._clock() < self._retry_s or (self._room.resting and not self.closed):
            return False
        self._segment = Segment(self._open_file(segment_path(self._path, self._number)), self._log.chunk_bytes)
        self._preface = 0
        if self._number > 1:
            self._preface = 1 + len(self._repeats)
            if HEADER in self._repeats:
                self._write(HEADER, self._at_ns, self._repeats[HEADER])
            self._write_note(self._because)
            if LIBRARY in self._repeats:
                self._write(LIBRARY, self._at_ns, self._repeats[LIBRARY])
        return True

    def _is_full(self, segment: Segment) -> bool:
        """Whether it has its bytes beside what every segment begins with."""
        return segment.bytes >= self._log.segment_bytes + self._repeats_bytes

    def _rest(self) -> None:
        """Close the file in order while the disk has room for that."""
        if not self._room.resting or self.closed:
            return
        self._reason = self._room.text
        if self._segment is not None:
            self._because = f"after a rest: {self._reason}"
            self._finish_segment(self._segment, self._reason)

    def _take(self, topic: str, at_ns: int, record: Record) -> None:
        if isinstance(record, Datagram):
            at_ns = record.at_ns  # the log time is the only place that keeps it
        try:
            data = encode_message(topic, at_ns, record)
        except RecordingError as error:
            self._refused += 1
            self._refusal = str(error)
            return
        self._at_ns = at_ns
        if topic in (HEADER, LIBRARY):
            self._repeats[topic] = data
            self._repeats_bytes = sum(map(len, self._repeats.values()))
        self._unwritten.extend(self._onlookers.beside(topic, at_ns, record, data))
        self._write(topic, at_ns, data)
        if topic == HEADER:
            self._write_note("begin")
        if topic in (HEADER, LIBRARY):
            self._open_segment().commit()

    def _write(self, topic: str, at_ns: int, data: bytes) -> None:
        self._sequence += 1
        self._open_segment().add(Entry(definition(topic), self._sequence, at_ns, data))

    def _write_unwritten(self) -> None:
        while self._unwritten:
            self._write(*self._unwritten.popleft())

    def _open_segment(self) -> Segment:
        assert self._segment is not None  # _ready() saw to it
        return self._segment

    def _note_news(self) -> None:
        if (self._dropped, self._refused) != self._noted:
            self._tell_note("records lost" + (f"; newest refusal: {self._refusal}" if self._refusal else ""))
        if self._room.low != self._told_low:
            self._told_low = self._room.low
            self._tell_note(f"disk {'gets low' if self._told_low else 'has room again'}: {self._room.text}")

    def _tell_note(self, text: str) -> None:
        """Write a note that those who look on see, too."""
        note = self._write_note(text)
        self._unwritten.extend(self._onlookers.beside(RECORDER, self._at_ns, note, encode(note)))
        self._write_unwritten()

    def _write_note(self, text: str) -> RecorderNote:
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
        return note

    def _finish_segment(self, segment: Segment, text: str) -> None:
        try:
            blind = self._onlookers
            self._write_note(f"{text}; {blind.unseen} without views: {blind.reason}" if blind.unseen else text)
            segment.finish()
        except OSError as error:
            self._fail(error)
        else:
            self._retire(segment)

    def _fail(self, error: OSError) -> None:
        self._failures += 1
        self._reason = str(error)
        self._because = f"after a failed write: {self._reason}"
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
