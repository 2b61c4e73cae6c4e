"""Recorder: a bounded queue of records, the messages for viewers made beside them, and notes on losses.

A record that cannot be kept is counted, and the count is part of the recording. While the disk takes nothing, records
wait in the queue, as long as there is room in it.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Protocol

import msgspec

from logs.recording import attachments
from logs.recording.disk import DiskFile, OutputFile, find_later_segments, get_free_bytes
from logs.recording.notes import NoteKind, RecorderNote
from logs.recording.parameters import ParameterReader
from logs.recording.segment import Rotation
from logs.recording.topics import HEADER, RECORDER, encode, encode_message
from uavctl.config.types import LogConfig
from uavctl.errors import RecordingError
from uavctl.fleet_records import CoordinatorHeader, SenderHeader
from uavctl.records import Datagram, Header, Record

Watcher = Callable[[str, int, bytes], None]


class ViewMaker(Protocol):
    """Interface of makers of messages for viewers, as `logs.recording.views.ViewBuilder`."""

    def derive(self, at_ns: int, record: Record) -> list[tuple[str, bytes]]:
        """Return topic and message of all that is derived from a record."""
        ...


class DerivedTopics:
    """Derives messages for viewers from records, and passes both on to live viewers.

    Args:
        views: makes the messages for viewers; None: there are none.
        watch: is given topic, log time [ns] (that of the file) and bytes of each message, soon after its record was
            taken; returns at once and raises nothing.

    Attributes:
        unseen: number of records that no messages for viewers could be made of; the recording has them.
        reason: why, for the newest of them.
    """

    def __init__(self, views: ViewMaker | None = None, watch: Watcher | None = None) -> None:
        self._views, self._watch = views, watch
        self._zero_utc_ns = 0
        self.unseen = 0
        self.reason = ""

    def derive_messages(self, topic: str, at_ns: int, record: Record, data: bytes) -> list[tuple[str, int, bytes]]:
        """Return topic, log time [ns] and message of all that is derived from a record, whose message is `data`."""
        if isinstance(record, Header):
            self._zero_utc_ns = record.zero_utc_ns or 0
        messages = [(name, at_ns, view) for name, view in self._derive_views(at_ns, record)]
        if self._watch is not None:
            try:
                for name, time_ns, message in ((topic, at_ns, data), *messages):
                    self._watch(name, time_ns + self._zero_utc_ns, message)
            except Exception as error:  # noqa: BLE001 who looks on ends no recording
                self._note_unseen(record, error)
        return messages

    def _derive_views(self, at_ns: int, record: Record) -> list[tuple[str, bytes]]:
        if self._views is None:
            return []
        try:
            return self._views.derive(at_ns, record)
        except Exception as error:  # noqa: BLE001 views are not needed to decide alike
            self._note_unseen(record, error)
            return []

    def _note_unseen(self, record: Record, error: Exception) -> None:
        self.unseen += 1
        self.reason = f"{type(record).__name__}: {error}"


LOOK_S = 1.0  # between two syncs, and looks at the disk's room
LATE_S = 3.0  # a last completed write that is older means that the disk hangs
LAST_TRIES = 3  # files that closing may begin on a failing disk


class RecorderStatus(msgspec.Struct, frozen=True, kw_only=True):
    """State of a recorder."""

    ok: bool  # the disk takes records, and none was lost
    written: int  # records on the disk
    waiting: int  # records in memory
    dropped: int  # records that found the queue full, or came after the end
    refused: int  # records that could not be encoded
    failures: int  # failed writes
    reason: str  # what is wrong now, or was last (a failed write); "" while nothing was
    refusal: str  # of the newest refused record
    bytes: int  # on the disk
    segments: tuple[str, ...]  # files with at least one chunk
    warning: str = ""  # the disk gets low
    unwritten_s: float = 0.0  # since the last completed write, while something waits for the disk [s]
    unseen: int = 0  # records of which no messages for viewers could be made; they are in the recording

    @property
    def problem(self) -> str:
        """What is wrong, in words; empty if nothing is."""
        return "" if self.ok else self.reason or f"{self.dropped + self.refused + self.waiting} records lost"


class WriteQueue:
    """Writes the records of a bounded queue into files; once it is made, nothing raises.

    `drop` and `status` may be called, and `queue` appended to, beside a thread that runs the other methods.

    Args:
        path: file of the recording; it and its later segments must not exist yet.
        log: sizes of chunks, files and queue; free space below which it warns.
        free: gives the free space of a folder [bytes], or None.
        clock: wall time [s].
        derived_topics: makes the messages for viewers, which are written beside the records.

    Attributes:
        queue: topic, log time [ns] and record of what waits; who appends keeps to `log.queue`.
        closed: no more records will come.
        finished: all that could be done is done.

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
        derived_topics: DerivedTopics,
    ) -> None:
        existing_files = [file for file in (path, *find_later_segments(path)) if file.exists()]
        if existing_files:
            raise RecordingError(f"{existing_files[0]} exists and a recording never overwrites; choose another name")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise RecordingError(f"{path.parent}: {error.strerror}; choose another folder") from error
        self._folder, self._free, self._low_bytes = path.parent, free, log.low_bytes
        self._is_low, self._free_text = False, ""
        self._check_free_space()
        self._files = Rotation(path, log, open_file, clock)
        self._parameters = ParameterReader()
        self._clock = clock
        self._derived_topics = derived_topics
        self._written_s = clock()  # nothing that waited for the disk then does so now
        self._next_look_s = self._written_s + LOOK_S
        self._noted = (0, 0)  # dropped and refused, as last written down
        self._is_low_noted = False
        self._drop_lock = threading.Lock()
        self._dropped = 0
        self._refused = 0
        self._refusal = ""
        self.queue: deque[tuple[str, int, Record]] = deque()
        self.closed = self.finished = False

    def drop(self) -> None:
        """Count a record that found no room in the queue."""
        with self._drop_lock:
            self._dropped += 1

    def drain(self, records: int) -> None:
        """Write up to `records` waiting records and their messages for viewers; once a second wait for the disk."""
        due = self._clock() >= self._next_look_s
        if due:
            self._next_look_s = self._clock() + LOOK_S
            self._check_free_space()
        try:
            if self._files.unwritten and self._open_next_file():
                self._files.write_unwritten()
            if self._files.is_open and self._dropped and not self._noted[0]:
                self._note_changes()  # before all that was put after it: a recording without an end tells of it, too
            files = self._files
            for _ in range(min(records, len(self.queue))):
                if not (files.has_room or self._open_next_file()):
                    return
                self._write_message(*self.queue.popleft())
            if due and self._files.is_open:
                self._note_changes()
                self._files.sync()
            if due:
                self._written_s = self._clock()
        except OSError as error:
            self._files.fail(error)
        except Exception as error:  # noqa: BLE001 no memory, or a defect: the record at hand is lost
            self.drop()
            self._files.fail(error)

    def finish(self) -> None:
        """Write all that waits and close the file; after a failed write, in a new file."""
        self.closed = True
        for _ in range(LAST_TRIES):
            self._files.allow_retry()
            self.drain(len(self.queue))
            if self._files.is_open:
                self._finish_file(NoteKind.END, "end")
        self.finished = True

    def status(self) -> RecorderStatus:
        """Return the state of the recorder."""
        files = self._files
        parts = files.parts()
        waiting = len(self.queue) + files.open_messages
        lost = self._dropped + self._refused + (waiting if self.closed else 0)
        stuck = bool(files.reason) and not self.closed and not files.has_chunk
        hangs = self.closed and not self.finished
        unwritten_s = max(0.0, self._clock() - self._written_s) if waiting or hangs else 0.0
        is_late = hangs or unwritten_s > LATE_S
        reasons = (
            (is_late, f"the recording was last written {unwritten_s:.1f} s ago"),
            (bool(files.reason), files.reason),
        )
        return RecorderStatus(
            ok=not lost and not stuck and not is_late,
            written=sum(messages for _, messages, _ in parts),
            waiting=waiting,
            dropped=self._dropped,
            refused=self._refused,
            failures=files.failures,
            reason="; ".join(text for holds, text in reasons if holds),
            refusal=self._refusal,
            bytes=sum(size for _, _, size in parts),
            segments=tuple(str(path) for path, _, _ in parts),
            warning=self._free_text if self._is_low else "",
            unwritten_s=unwritten_s,
            unseen=self._derived_topics.unseen,
        )

    def _check_free_space(self) -> None:
        """Look at the free space; nothing changes if the system cannot tell it."""
        free = self._free(self._folder)
        if free is not None:
            self._is_low, self._free_text = free < self._low_bytes, f"{free} bytes free in {self._folder}"

    def _open_next_file(self) -> bool:
        """Return whether there is a file to write to; one is begun if something waits for it."""
        files = self._files
        if files.has_room:
            return True
        waits = bool(self.queue or files.unwritten)
        if waits and files.is_open:
            files.because = f"continues after {files.name}"
            self._finish_file(NoteKind.CONTINUED, "continues in the next file")
        if files.is_open:
            return True
        if not waits or not files.may_begin:
            return False
        head = self.queue[0][2] if self.queue else None
        if isinstance(head, HEADERS):  # it comes first, and tells the time of all that follows
            files.zero_utc_ns = head.zero_utc_ns or 0
        files.begin(self._write_note)
        return True

    def _write_message(self, topic: str, at_ns: int, record: Record) -> None:
        if isinstance(record, Datagram):
            at_ns = record.at_ns  # the log time is the only place that keeps it
        try:
            data = encode_message(topic, at_ns, record, self._files.zero_utc_ns)
        except RecordingError as error:
            self._refused += 1
            self._refusal = str(error)
            return
        derived = self._derived_topics.derive_messages(topic, at_ns, record, data)
        try:
            self._files.write_record(topic, at_ns, data)
            if topic == HEADER:
                self._write_note("begin", NoteKind.BEGIN)
                self._files.commit()
        finally:  # after a failed write they come after the record, in the next file
            self._files.unwritten.extend(derived)
        self._files.write_unwritten()
        if isinstance(record, Header):
            utc_ns = at_ns + self._files.zero_utc_ns
            self._files.attach(
                attachments.make_header_attachments(record, utc_ns), attachments.make_layout_attachment(utc_ns)
            )
        else:
            self._parameters.take(record)

    def _note_changes(self) -> None:
        if (self._dropped, self._refused) != self._noted:
            self._publish_note("records lost" + (f"; newest refusal: {self._refusal}" if self._refusal else ""))
        if self._is_low != self._is_low_noted:
            self._is_low_noted = self._is_low
            self._publish_note(f"disk {'gets low' if self._is_low else 'has room again'}: {self._free_text}")

    def _publish_note(self, text: str) -> None:
        """Write a note, which watchers see too."""
        note = self._write_note(text)
        self._files.unwritten.extend(self._derived_topics.derive_messages(RECORDER, note.at_ns, note, encode(note)))
        self._files.write_unwritten()

    def _write_note(self, text: str, kind: NoteKind = NoteKind.STATE) -> RecorderNote:
        self._noted = (self._dropped, self._refused)
        note = RecorderNote(
            at_ns=self._files.at_ns,
            segment=self._files.number,
            written=self._files.written,
            dropped=self._dropped,
            refused=self._refused,
            failures=self._files.failures,
            text=text,
            kind=kind,
        )
        self._files.write(RECORDER, note.at_ns, encode(note))
        return note

    def _finish_file(self, kind: NoteKind, text: str) -> None:
        derived = self._derived_topics
        try:
            self._write_note(
                f"{text}; {derived.unseen} without views: {derived.reason}" if derived.unseen else text, kind
            )
            utc_ns = self._files.at_ns + self._files.zero_utc_ns
            self._files.finish(attachments.make_parameter_attachments(self._parameters, utc_ns))
        except OSError as error:
            self._files.fail(error)


HEADERS = Header, SenderHeader, CoordinatorHeader
POLL_S = 0.02
# Records of a round. Each takes some 30 us with its messages for viewers, so that the interpreter, which a tick waits
# for, is free again after 2 ms. A round every POLL_S makes 3200 records a second, several times what a flight has.
RECORDS = 64


class _Base:
    """Base of the recorders: a write queue and its begin; arguments and errors are those of `WriteQueue`."""

    def __init__(
        self,
        path: Path,
        log: LogConfig | None = None,
        *,
        open_file: Callable[[Path], OutputFile] = DiskFile,
        free: Callable[[Path], int | None] = get_free_bytes,
        clock: Callable[[], float] = time.monotonic,
        derived_topics: DerivedTopics | None = None,
    ) -> None:
        self._log = log or LogConfig()
        self._journal = WriteQueue(path, self._log, open_file, free, clock, derived_topics or DerivedTopics())
        self._queue = self._journal.queue
        self._max_waiting = self._log.queue  # records in the queue; 0 from the end on
        self._begin()

    def put(self, topic: str, at_ns: int, record: Record) -> None:
        """Queue one value under a topic, or count it as dropped; errors are in `status()`."""
        # Each tick comes here after a rest, when nothing of this is in the processor's caches: so it is one function,
        # that looks at little, takes no lock and wakes no thread.
        queue = self._queue
        if len(queue) < self._max_waiting:
            try:
                queue.append((topic, at_ns, record))
            except MemoryError:
                self._journal.drop()
        else:
            self._journal.drop()

    def _begin(self) -> None:
        """Start the threads and processes beside the queue."""
        return


class SyncRecorder(_Base):
    """Recorder that writes in `put`: for virtual time, where the disk may hold up the caller."""

    def put(self, topic: str, at_ns: int, record: Record) -> None:
        """Record one value under a topic; errors are in `status()`."""
        super().put(topic, at_ns, record)
        self._journal.drain(self._log.queue)

    def close(self) -> RecorderStatus:
        """Write the rest, the index and the footer; later records are dropped."""
        self._max_waiting = 0
        if not self._journal.closed:
            self._journal.finish()
        return self.status()

    def status(self) -> RecorderStatus:
        """Return the state of the recorder."""
        return self._journal.status()


class BatchRecorder(SyncRecorder):
    """Recorder of a flight in virtual time: writes `RECORDS` at a time, which takes a tenth off the flight's time."""

    def _begin(self) -> None:
        self._batch = min(RECORDS, self._log.queue)

    def put(self, topic: str, at_ns: int, record: Record) -> None:
        """Queue one value under a topic, and write all that wait once they are a batch."""
        _Base.put(self, topic, at_ns, record)
        if len(self._queue) >= self._batch:
            self._journal.drain(self._log.queue)


class Recorder(_Base):
    """Recorder with a thread of its own, which encodes and writes; `put` only queues.

    A process that is killed loses the open chunk, and what was put since the thread last began a round: every `POLL_S`,
    later where the computer does not let it run or the disk holds it up. That can be `log.queue` records and no more.
    """

    def catch_up(self) -> None:
        """Begin a round now: right after a tick, when the control loop has the longest time until the next one."""
        if not self._thread.is_alive():
            self._start_thread()
        self._due.set()

    def _begin(self) -> None:
        self._stop, self._due = threading.Event(), threading.Event()
        self._start_thread()

    def _start_thread(self) -> None:
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._thread.start()

    def close(self, timeout_s: float = 5.0) -> RecorderStatus:
        """Stop taking records and write those that wait; gives up after `timeout_s` on a disk that hangs."""
        self._max_waiting = 0
        self._journal.closed = True
        self._stop.set()
        self._due.set()
        if self._thread.is_alive():
            self._thread.join(timeout_s)
        if not (self._thread.is_alive() or self._journal.finished):
            self._journal.finish()  # the thread has died, and perhaps none can be started
        return self.status()

    def status(self) -> RecorderStatus:
        """Return the state of the recorder."""
        status = self._journal.status()
        return msgspec.structs.replace(status, ok=status.ok and (self._thread.is_alive() or self._journal.closed))

    def _run(self) -> None:
        journal = self._journal
        while not self._stop.is_set():
            self._due.wait(POLL_S)
            self._due.clear()
            with suppress(Exception):  # no memory, say: the next round tries again
                journal.drain(RECORDS)
        journal.finish()
