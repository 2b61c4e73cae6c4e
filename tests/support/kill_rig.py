"""A recording process that is killed at a random moment, and what is left of its recording."""

from __future__ import annotations

import mmap
import os
import random
import signal
import time
from dataclasses import dataclass
from pathlib import Path
from unittest.mock import patch

from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from recording_fakes import Item, drop_recorder_notes, flight

from logs.recording.disk import make_segment_path
from logs.recording.reader import find_segments, read
from logs.recording.recorder import RECORDS as AT_ONCE
from logs.recording.recorder import Recorder, SyncRecorder, WriteQueue
from logs.recording.recover import recover
from logs.recording.topics import encode
from uavctl.config.types import LogConfig

KINDS = ("sync", "thread")
LOG = LogConfig(segment_bytes=60_000)  # so that kills hit the change of files, too
RECORDS = 30_000
MOST_S = 0.25  # from the start to the kill
THREAD_PAUSE_S = 0.006  # after 8 records: up to 1200 a second, several times what a flight has
BURST_EVERY, BURST = 256, 120  # records without a pause: what waits for a thread that a busy computer did not let run
MESSAGE_HEAD = 31  # bytes that a message has in a chunk besides its own


@dataclass(frozen=True)
class KillResult:
    """What one kill left.

    Attributes:
        kind: Which recorder.
        put: Records that were put.
        taken: Of these, records that the newest complete round of writing found, or earlier ones.
        kept: Records that were recovered.
        lost_bytes: Chunk bytes of the records that were taken and are lost.
        files: Segments that were begun.
        wrong: What must not be; empty if all is well.
    """

    kind: str
    put: int
    taken: int
    kept: int
    lost_bytes: int
    files: int
    wrong: str

    @property
    def since(self) -> int:
        """Records that were put since that round began, and what it did not take of a large backlog."""
        return self.put - self.taken


def kill_once(folder: Path, kind: str, seed: int, items: list[Item]) -> KillResult:
    """Record in a process of its own, kill it at a moment that `seed` draws, and look at what it left.

    The caller has no other threads, since it is forked.
    """
    path = folder / "flight.mcap"
    shared = mmap.mmap(-1, 16)
    with memoryview(shared) as raw, raw.cast("Q") as counts:
        child = os.fork()
        if child == 0:
            try:
                _record(path, kind, items, counts)
            finally:
                os._exit(1)  # it is killed before it comes here
        time.sleep(random.Random(seed).uniform(0.0, MOST_S))
        os.kill(child, signal.SIGKILL)
        _, status = os.waitpid(child, 0)
        put, taken = counts[0], counts[1]
    shared.close()
    assert os.WIFSIGNALED(status), "the recording ended before the kill"
    return _look(folder, kind, put, taken, items)


def _record(path: Path, kind: str, items: list[Item], counts: memoryview) -> None:
    drain = WriteQueue.drain

    def watched(journal: WriteQueue, records: int) -> None:
        begun = counts[0] - max(0, len(journal.queue) - AT_ONCE)
        drain(journal, records)
        counts[1] = begun

    with patch.object(WriteQueue, "drain", watched):
        _put_all(SyncRecorder(path, LOG) if kind == "sync" else Recorder(path, LOG), items, counts)


def _put_all(recorder: SyncRecorder | Recorder, items: list[Item], counts: memoryview) -> None:
    paced = isinstance(recorder, Recorder)
    for number, item in enumerate(items, 1):
        recorder.put(*item)
        counts[0] = number
        if paced and number % 8 == 0 and number % BURST_EVERY >= BURST:
            time.sleep(THREAD_PAUSE_S)
    while True:
        time.sleep(1.0)


def _look(folder: Path, kind: str, put: int, taken: int, items: list[Item]) -> KillResult:
    path, out = folder / "flight.mcap", folder / "out.mcap"
    files, kept, wrong = 0, 0, ""
    if path.exists() and path.stat().st_size:
        files = len(find_segments(path))
        direct = drop_recorder_notes(list(read(path)))
        kept = len(direct)
        recover(path, out)
        restored = drop_recorder_notes(list(read(out)))
        if direct != items[:kept] or restored != direct:
            wrong = "a record differs"
        elif _independent(out) != len(list(read(out))):
            wrong = "the format's own reader finds something else"
        for number in range(1, files):
            with make_segment_path(path, number).open("rb") as file:
                if make_reader(file, validate_crcs=True).get_summary() is None:
                    wrong = f"file {number} is not closed"
    lost = [len(encode(record)) + MESSAGE_HEAD for _, _, record in items[kept:taken]]
    if sum(lost) > LOG.chunk_bytes:  # they cannot all have been in the open chunk
        wrong = f"{len(lost)} records, {sum(lost)} bytes lost"
    return KillResult(kind, put, taken, kept, sum(lost), files, wrong)


def _independent(out: Path) -> int:
    """Messages of a recovered file by the format's own reader, each chunk's checksum looked at."""
    with out.open("rb") as file:
        return sum(type(record).__name__ == "Message" for record in StreamReader(file, validate_crcs=True).records)


def truth() -> list[Item]:
    """What a recording process puts."""
    return flight(RECORDS)
