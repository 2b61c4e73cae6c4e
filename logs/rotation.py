"""A recording's files, one after the other: when the next one is begun, and what goes over to it.

A file that has grown to its size is closed and the next one begun (name-2.mcap ...). So it is after a failed write, as
well as possible and once the disk takes it; what the failed chunk held goes to the next file.
"""

from __future__ import annotations

import contextlib
import errno
import os
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from logs.disk import OutputFile, is_there, segment_path
from logs.segment import Entry, Segment
from logs.topics import HEADER, LIBRARY, definition
from uavctl.config.log import LogConfig

RETRY_S = 1.0  # between tries to begin a file after a failed write


class _Part(NamedTuple):
    """A file with what was written to it."""

    path: Path
    messages: int
    bytes: int
    records: int  # messages that were not made for viewers


class Rotation:
    """Writer of a recording's files.

    Args:
        path: the first file.
        log: sizes of chunks and files.
        open_file: opens a new file.
        clock: wall time [s].

    Attributes:
        unwritten: topic, log time [ns] and message of what goes first into the next file.
        because: why the next file is begun.
        number: of the file that is open, or comes next.
        written: messages so far, repeated ones included.
        at_ns: log time of the newest record.
        failures: failed writes.
        reason: of the newest one, or why recording rests.
        gone: names of files that were written and are no longer there.
        gone_records: that were in them.
    """

    def __init__(
        self, path: Path, log: LogConfig, open_file: Callable[[Path], OutputFile], clock: Callable[[], float]
    ) -> None:
        self._path, self._log, self._open_file, self._clock = path, log, open_file, clock
        self._segment: Segment | None = None
        self._preface = 0  # records at the start of this segment that only repeat
        self._repeats: dict[str, bytes] = {}  # header and library, for each segment
        self._repeats_bytes = 0
        self._retry_s = clock()
        self._opened: os.stat_result | None = None  # what the open file is
        self._done: list[_Part] = []
        self.gone: list[str] = []
        self.gone_records = 0
        self.unwritten: deque[tuple[str, int, bytes]] = deque()
        self.because = ""
        self.number = 1
        self.written = 0
        self.at_ns = 0
        self.failures = 0
        self.reason = ""

    @property
    def is_open(self) -> bool:
        """Whether there is a file to write to."""
        return self._segment is not None

    @property
    def name(self) -> str:
        """Of the file that is open, or comes next."""
        return segment_path(self._path, self.number).name

    @property
    def has_chunk(self) -> bool:
        """Whether the open file has a chunk on the disk."""
        segment = self._segment  # asked beside the thread that writes
        return segment is not None and bool(segment.bytes)

    @property
    def is_full(self) -> bool:
        """Whether the open file has its bytes beside what every file begins with."""
        return self._segment is not None and self._segment.bytes >= self._log.segment_bytes + self._repeats_bytes

    @property
    def may_begin(self) -> bool:
        """Whether enough time has gone by since a failed write."""
        return self._clock() >= self._retry_s

    @property
    def open_messages(self) -> int:
        """Messages that are in memory only."""
        segment = self._segment
        return len(self.unwritten) + (0 if segment is None else len(segment.open_entries))

    def parts(self) -> list[tuple[Path, int, int]]:
        """Files with at least one chunk: path, messages and bytes on the disk."""
        segment, done = self._segment, [*self._done]
        if segment is not None and segment.bytes:
            done.append(self._part(segment))
        return [(one.path, one.messages, one.bytes) for one in done]

    def look(self) -> None:
        """See whether what was written is still where it was made.

        Raises:
            OSError: the open file is not; closed ones are remembered as gone.
        """
        for part in [*self._done]:
            if not is_there(part.path, part.bytes):
                self._done.remove(part)
                self._lose(part)
        if self._segment is not None and not self._is_there(self._segment):
            raise FileNotFoundError(errno.ENOENT, "the file was deleted, moved or replaced", self.name)

    def try_again(self) -> None:
        """A file may be begun at once."""
        self._retry_s = self._clock()

    def begin(self, tell: Callable[[str], object]) -> None:
        """Open the next file; a later one than the first repeats header and library.

        Args:
            tell: writes a note into it.

        Raises:
            OSError: it cannot be opened or written.
        """
        path = segment_path(self._path, self.number)
        path.parent.mkdir(parents=True, exist_ok=True)  # somebody may have removed it with the file before
        self._segment = Segment(self._open_file(path), self._log.chunk_bytes)
        self._opened = path.stat()
        self._preface = 0
        if self.number > 1:
            self._preface = 1 + len(self._repeats)
            self._repeat(HEADER)
            tell(self.because)
            self._repeat(LIBRARY)

    def write(self, topic: str, at_ns: int, data: bytes) -> None:
        """Add a message to the open file.

        Raises:
            OSError: a chunk could not be written; `fail` keeps what it held, this message included.
        """
        self.written += 1
        self._open_segment().add(Entry(definition(topic), self.written, at_ns, data))

    def write_record(self, topic: str, at_ns: int, data: bytes) -> None:
        """Add a record's message; header and library are kept for later files.

        Raises:
            OSError: as `write`.
        """
        self.at_ns = at_ns
        if topic in (HEADER, LIBRARY):
            self._repeats[topic] = data
            self._repeats_bytes = sum(map(len, self._repeats.values()))
        self.write(topic, at_ns, data)

    def write_unwritten(self) -> None:
        """Add what has to go first.

        Raises:
            OSError: as `write`.
        """
        while self.unwritten:
            self.write(*self.unwritten.popleft())

    def commit(self) -> None:
        """Hand the open chunk to the operating system.

        Raises:
            OSError: it could not be written.
        """
        self._open_segment().commit()

    def sync(self) -> None:
        """Write the open chunk and wait until the disk has it.

        Raises:
            OSError: that could not be done.
        """
        self._open_segment().sync()

    def finish(self) -> None:
        """Close the open file with index and footer.

        Raises:
            OSError: not all of it could be done.
        """
        segment = self._open_segment()
        segment.finish()
        self._retire(segment, there=self._is_there(segment))

    def fail(self, error: OSError) -> None:
        """After a failed write: keep what the open chunk held, and close the file as well as possible."""
        self.failures += 1
        self.reason = str(error)
        self.because = f"after a failed write: {self.reason}"
        self._retry_s = self._clock() + RETRY_S
        segment = self._segment
        if segment is None:
            return  # it could not even be opened
        self.written -= len(segment.open_entries)  # they are numbered anew
        kept = segment.open_entries[max(0, self._preface - segment.messages) :]
        self.unwritten.extendleft((one.definition.topic, one.at_ns, one.data) for one in reversed(kept))
        # what abandon cannot do is no second alarm: whole chunks are readable without it
        there = self._is_there(segment)
        with contextlib.suppress(OSError):
            segment.abandon() if there else segment.leave()
        self._retire(segment, there=there)

    def _repeat(self, topic: str) -> None:
        if topic in self._repeats:
            self.write(topic, self.at_ns, self._repeats[topic])

    def _open_segment(self) -> Segment:
        assert self._segment is not None  # who calls has asked is_open
        return self._segment

    def _part(self, segment: Segment) -> _Part:
        return _Part(segment_path(self._path, self.number), segment.messages, segment.bytes, segment.records)

    def _lose(self, part: _Part) -> None:
        self.gone.append(part.path.name)
        self.gone_records += part.records

    def _is_there(self, segment: Segment) -> bool:
        return is_there(segment_path(self._path, self.number), segment.bytes, self._opened)

    def _retire(self, segment: Segment, *, there: bool) -> None:
        part = self._part(segment)
        if segment.bytes:
            if there:
                self._done.append(part)
            else:
                self._lose(part)
            self.number += 1
        else:
            try:
                part.path.unlink(missing_ok=True)
            except OSError:
                self.number += 1  # the name stays taken
        self._segment = None
